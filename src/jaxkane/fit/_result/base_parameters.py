"""Base parameters: the sums of parameters that motions determine, as a table. Knows numbers and names."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


@dataclasses.dataclass(frozen=True)
class BaseParameters:
    """What motions determine of p parameters: b sums of them. `print` shows it in words.

    - `names`, `units`, `values` (p): the parameters as the system has them.
    - `matrix` (b, p): base parameters = matrix @ parameters. `places` (b): the parameter that each begins with, which
        no other base parameter has in it. `texts` (b), `base_units` (b).
    - `without_influence`: names of the parameters that appear in no equation.
    - `ratios_only`: whether nothing acts that is not in the matrix itself, as in a free swing: all base parameters
        could be multiplied by one number.

    From data, else NaN:

    - `estimates` (b) and their `deviations` (b), `covariance` (b, b): by weighted least squares. The deviations allow
        for residuals that are correlated within a fortieth of the data. Where only ratios are determined, the parameter
        `held` has the system's value.
    - `information` (b, b): W^T W of the weighed equations W b = tau, before anything is held.
    - `undetermined`: combinations that these data do not determine, in words; they stay at the system's values.
    - `noise`: by speed, the root mean square of what remains in its equation. `unexplained`: the part of the equations'
        size that it is.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: np.ndarray
    places: tuple[int, ...]
    matrix: np.ndarray
    texts: tuple[str, ...]
    without_influence: tuple[str, ...]
    ratios_only: bool
    estimates: np.ndarray
    deviations: np.ndarray
    covariance: np.ndarray
    information: np.ndarray
    undetermined: tuple[str, ...]
    held: int | None
    noise: Mapping[str, float]
    unexplained: float

    @property
    def count(self) -> int:
        """How many numbers are determined."""
        return len(self.places) - self.ratios_only - len(self.undetermined)

    @property
    def base_units(self) -> tuple[str, ...]:
        return tuple(self.units[i] for i in self.places)

    def of(self, values: Any) -> np.ndarray:
        """Base parameters (b,) of parameters (p,)."""
        return self.matrix @ np.asarray(values)

    def __str__(self) -> str:
        b, p = len(self.places), len(self.names)
        only = ", and only their ratios: nothing acts that is known" if self.ratios_only else ""
        determined = f"of {p} parameters {b} sums can be determined{only}"
        given = bool(np.isfinite(self.estimates).any())
        lines = [f"{determined}; {self.count} numbers{' by these data' * given}"]
        width = max((len(text) for text in self.texts), default=0)
        now = self.of(self.values)
        for i, (text, unit) in enumerate(zip(self.texts, self.base_units, strict=True)):
            number = f"{now[i]:12.5g}"
            if given:
                number += f"  {self.estimates[i]:12.5g}" + (
                    f"  +- {self.deviations[i]:.2g}" if i != self.held else "  (held)"
                )
            lines.append(f"{text:<{width}}  {number} {unit}".rstrip())
        if self.without_influence:
            lines.append(f"without influence: {', '.join(self.without_influence)}")
        lines += [f"not determined by these data: {text}" for text in self.undetermined]
        if given:
            lines.append(f"unexplained: {100 * self.unexplained:.3g} % of the equations' size")
        return "\n".join(lines)

    __repr__ = __str__


def sum_in_words(names: Sequence[str], row: np.ndarray, place: int, sizes: Sequence[str]) -> str:
    """`link1.Izz + 0.04 link2.m`."""
    words = [names[place]]
    for i in np.flatnonzero(row).tolist():
        if i != place:
            factor = "" if sizes[i] == "1" else f"{sizes[i]} "
            words.append(f"{'-' if row[i] < 0 else '+'} {factor}{names[i]}")
    return " ".join(words)
