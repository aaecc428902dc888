"""Kane's equations: the method, its public functions, assembly, checks. Knows no mechanism and no integrator."""
