"""Bodies that were found, each as a whole. Knows the maps of a fit's parameters."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from .._problem.bijections import PossibleBody
from .._problem.parameters import Parameters


def bodies_in_words(parameters: Parameters, x: Any) -> Iterator[str]:
    """Of everything that was freed as `Inertia(...)`: principal moments and axes; mass and centre where they moved."""
    first = 0
    for bijection, size in zip(parameters.bijections, parameters.sizes, strict=True):
        if isinstance(bijection, PossibleBody):
            values = np.asarray(bijection.all_values(bijection.factors(x[first : first + size])), float)
            yield f"body of {', '.join(parameters.names[first : first + size])}: {_in_words(values, bijection.moves)}"
        first += size


def _in_words(values: np.ndarray, moves: tuple[int, ...]) -> str:
    xx, yy, zz, xy, xz, yz = values[4:]
    moments, axes = np.linalg.eigh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
    words = [f"{values[0]:.5g} kg"] * (0 in moves)
    words += [f"centre at ({', '.join(f'{c:.4g}' for c in values[1:4])}) m"] * any(i in moves for i in (1, 2, 3))
    words.append(f"principal moments {', '.join(f'{moment:.5g}' for moment in moments)} kg m^2")
    if any((xy, xz, yz)):
        rows = [f"({', '.join(f'{a:.3f}' for a in axis * np.sign(axis[np.abs(axis).argmax()]))})" for axis in axes.T]
        words.append(f"along {', '.join(rows)}")
    return ", ".join(words)
