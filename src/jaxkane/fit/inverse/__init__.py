"""Parameters from accelerations: the regressor of a system, its base parameters, and first estimates."""
