"""Names, digests and files. Knows nothing of JAX and nothing of mechanics."""
