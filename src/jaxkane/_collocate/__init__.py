"""Nonlinear programs whose functions are small and repeated, Lobatto methods, and the solvers of such programs."""
