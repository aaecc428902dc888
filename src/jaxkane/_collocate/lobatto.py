"""Lobatto IIIA methods: collocation at points that contain both ends of an interval.

Equations: E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, section IV.5. The collocation points are
both ends and the zeros of the derivative of a Legendre polynomial. The coefficients are integrals of the Lagrange
polynomials, so they are computed and not listed.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Polynomial
from numpy.polynomial.legendre import Legendre


class Lobatto(NamedTuple):
    """A method with s points per interval.

    - `c` (s,): the points, from 0 to 1.
    - `A` (s - 1, s): integrals of the Lagrange polynomials from 0 to each point but the first.
    - `order`: the order of the error at the ends of intervals, 2 (s - 1).
    """

    c: np.ndarray
    A: np.ndarray
    order: int

    @property
    def b(self) -> np.ndarray:
        """The weights (s,) of the quadrature over an interval."""
        return self.A[-1]


METHODS = {"trapezoid": 2, "hermite-simpson": 3, "lobatto": 4}
"""Numbers of points by the names of the methods. Their orders are 2, 4 and 6."""


@functools.cache
def lobatto(method: str) -> Lobatto:
    """The method of a name of `METHODS`.

    **Raises:** `ValueError` for another name.
    """
    if method not in METHODS:
        raise ValueError(f"`method` must be one of {', '.join(map(repr, METHODS))}, got {method!r}.")
    s = METHODS[method]
    inner = np.sort(np.real(Legendre.basis(s - 1).deriv().roots()))
    c = np.concatenate([[0.0], (inner + 1) / 2, [1.0]])
    integrals = [_lagrange(c, i).integ() for i in range(s)]
    A = np.array([[p(x) - p(0.0) for p in integrals] for x in c[1:]])
    return Lobatto(c, A, 2 * (s - 1))


def _lagrange(c: np.ndarray, i: int) -> Polynomial:
    """The polynomial that is 1 at c[i] and 0 at the other points."""
    others = np.delete(c, i)
    return Polynomial.fromroots(others) / np.prod(c[i] - others)
