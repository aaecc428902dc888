"""The solution of a problem: linearization, elimination of nuisance values, optimizers, checkpoints."""
