"""Programs of scalars: exact zeros, a whole program as one operation of JAX, native kernels. Independent of
mechanics."""
