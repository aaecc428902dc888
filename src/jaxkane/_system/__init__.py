"""The parts of a model: vectors, frames, points, bodies, loads, the system. The equations of motion are in `_kane`."""
