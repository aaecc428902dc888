"""Kane's equations: the method, its public functions, assembly, checks. Independent of mechanisms and integrators."""
