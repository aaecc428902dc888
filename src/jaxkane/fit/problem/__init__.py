"""The problem of a fit: trials, windows, parameters, the model of the measurements, and the specification."""
