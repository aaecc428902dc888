"""The forms of a program of scalars: NumPy calls, LLVM kernels, XLA functions, source code in another language."""
