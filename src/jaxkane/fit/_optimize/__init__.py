"""The optimizers, and what they share: initial guesses, steps, checkpoints."""
