"""A fit as a problem of least squares: parameters, windows' unknowns, the model, its linearization."""
