"""What a fit found: estimates, errors, identifiability, tests of the residuals. Numbers only."""
