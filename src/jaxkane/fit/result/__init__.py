"""Results of a fit: estimates and errors, tests, diagnostics, validation, comparison, reports."""
