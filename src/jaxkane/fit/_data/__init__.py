"""Measured motion: trials, files, windows. Knows no optimizer."""
