"""jaxkane against its peers: `python -m benchmarks`."""
