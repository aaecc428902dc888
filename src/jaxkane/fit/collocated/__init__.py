"""Parameters from long or unstable motions by direct collocation, with unknown inputs."""
