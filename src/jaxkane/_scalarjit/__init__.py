"""Programs of scalars: exact zeros, one operation of a whole program, native kernels. Knows no mechanics."""
