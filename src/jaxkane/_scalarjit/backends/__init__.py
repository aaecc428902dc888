"""What a program of scalars becomes: NumPy calls, LLVM kernels, source in another language."""
