"""How a mechanism is described: vectors, frames, points, bodies, loads, the system. Differentiates nothing."""
