"""Names, digests and files. Depends neither on JAX nor on mechanics."""
