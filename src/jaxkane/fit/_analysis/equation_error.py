"""Base parameters from data: weighted least squares of the equations of motion. Knows matrices; knows no system.

Each speed's equation is weighed by what remains in it, which is found by doing so a few times (Gautier 1997).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..._common.lookup import refuse_unknown
from .._result.base_parameters import BaseParameters
from .._result.identifiability import combination

_BLOCKS = 40  # of data, whose residuals are taken as independent of each other
_EXACT = 1e-6  # of an equation's size: no smaller deviation is assumed
_ROUNDING = 1e-10  # of the largest singular value


def estimated(
    structure: BaseParameters,
    speeds: Sequence[str],
    Y: np.ndarray,
    tau: np.ndarray,
    trial: np.ndarray,
    sigma: Mapping[str, float] | None,
    flat: float,
) -> BaseParameters:
    """The same with estimates from the equations at N instants: Y (N, n, p), tau (N, n), the trials (N,)."""
    if sigma is not None:
        refuse_unknown(sigma, speeds, "`sigma`: there is no equation of a speed named", "there are those of")
        missing = [name for name in speeds if name not in sigma]
        bad = [name for name in speeds if name in sigma and not sigma[name] > 0]
        if missing or bad:
            raise ValueError(f"`sigma` has a positive number for each speed; look at {', '.join(missing + bad)}.")
    return _Equations(structure, tuple(speeds), Y, tau, trial).solved(sigma, flat)


class _Equations:
    """Of the base parameters beside those of the system, in the size that each has: W z = rest, b = b0 + scale z."""

    def __init__(self, structure: BaseParameters, speeds: tuple[str, ...], Y: np.ndarray, tau: np.ndarray, trial: Any):
        self.structure, self.speeds, self.trial = structure, speeds, trial
        self.W: np.ndarray = Y[:, :, list(structure.places)].astype(float)  # (N,n,b)
        self.now = structure.of(structure.values)
        self.rest = tau.astype(float) - self.W @ self.now
        self.size = np.sqrt(np.mean((np.abs(self.W) @ np.abs(self.now)) ** 2, axis=0)) + np.abs(tau).max(axis=0)
        # A value of zero says nothing about its size: what gives the mean force does.
        force = np.sqrt(np.mean(self.W**2, axis=(0, 1)))
        typical = np.max(force * np.abs(self.now), initial=0.0) or 1.0
        guess = typical / np.where(force > 0, force, np.inf)
        self.scale = np.where(self.now != 0, np.abs(self.now), np.where(guess > 0, guess, 1.0))
        nothing_acts = np.linalg.norm(tau) <= 1e3 * np.finfo(Y.dtype).eps * np.linalg.norm(self.size) * len(tau) ** 0.5
        self.held = int(np.argmax(force * np.abs(self.now))) if nothing_acts and len(force) else None

    def solved(self, sigma: Mapping[str, float] | None, flat: float) -> BaseParameters:
        b = self.W.shape[2]
        moving = [j for j in range(b) if j != self.held]
        A: Any = self.W[:, :, moving] * self.scale[moving]  # (N,n,m)
        if not self.size.any():
            raise ValueError("Nothing moves and nothing acts at these instants: every term of the equations is zero.")
        least = _EXACT * np.where(self.size > 0, self.size, self.size.max())
        deviation: Any = np.ones(len(self.speeds))
        if sigma:
            deviation = np.array([sigma[name] for name in self.speeds])
        s, V, z = self._solve(A / deviation[:, None], self.rest / deviation)
        freedom = self.rest.size - int(np.sum(s > _ROUNDING * s.max(initial=0.0)))
        if not sigma and freedom <= 0:
            raise ValueError(
                f"{self.rest.size} equations of motion, at {len(self.rest)} instants, determine "
                f"{self.rest.size - freedom} numbers, and not how large "
                "their errors are: give more instants, or `sigma`."
            )
        for _ in range(0 if sigma else 4):  # each equation weighed by what remains in it
            left = self.rest - A @ z
            deviation = np.maximum(np.sqrt(np.mean(left**2, axis=0) * left.size / freedom), least)
            s, V, z = self._solve(A / deviation[:, None], self.rest / deviation)
        left = self.rest - A @ z
        along = self._covariance(A / deviation[:, None], left / deviation, s, V, bool(sigma))
        known = np.diag(along) <= flat**2
        z = V[known].T @ (V[known] @ z)  # what is not determined stays
        left = self.rest - A @ z
        spread = _from_directions(V, along)
        full, covariance = np.zeros(b), np.zeros((b, b))
        full[moving] = z * self.scale[moving]
        covariance[np.ix_(moving, moving)] = spread * np.outer(self.scale[moving], self.scale[moving])
        base = [f"({self.structure.texts[j]})" for j in moving]
        return dataclasses.replace(
            self.structure,
            ratios_only=self.held is not None,
            estimates=self.now + full,
            deviations=np.sqrt(np.diag(covariance)),
            covariance=covariance,
            information=np.einsum("inb,inc,n->bc", self.W, self.W, deviation**-2.0, optimize=True),
            undetermined=tuple(combination(base, row) for row in V[~known]),
            held=self.held,
            noise=dict(zip(self.speeds, np.sqrt(np.mean(left**2, axis=0)).tolist(), strict=True)),
            unexplained=float(
                np.linalg.norm(left / deviation) / np.linalg.norm(self._terms(full) / deviation[:, None])
            ),
        )

    def _terms(self, moved: np.ndarray) -> np.ndarray:
        """What balances in the equations (N, n, b)."""
        return self.W * (self.now + moved)

    def _solve(self, A: np.ndarray, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Singular values (m,), a row (m, m) for each, and the solution (m,), zero where nothing is determined."""
        m = A.shape[2]
        rows = np.column_stack([A.reshape(-1, m), rest.ravel()])
        R: Any = np.linalg.qr(rows, mode="r") if len(rows) > m else rows
        _, s, V = np.linalg.svd(R[:, :m], full_matrices=True)
        s = np.pad(s, (0, m - len(s)))
        V = V * np.sign(V[np.arange(m), np.abs(V).argmax(axis=1)])[:, None] if m else V
        fine = s > _ROUNDING * s.max(initial=0.0)
        if not fine.any():
            return s, V, np.zeros(m)
        z = np.linalg.lstsq(R[:, :m] @ V[fine].T, R[:, m], rcond=None)[0]
        return s, V, V[fine].T @ z

    def _covariance(self, A: np.ndarray, left: np.ndarray, s: np.ndarray, V: np.ndarray, known: bool) -> np.ndarray:
        """Of z along each row of V (m, m): by what is left in blocks of the data, whose sum is what was fitted."""
        with np.errstate(divide="ignore"):
            inverse = np.where(s > _ROUNDING * s.max(initial=0.0), 1.0 / s, np.inf)
        blocks = self._blocks()
        if known or len(left) < 5 * _BLOCKS or blocks.max() == 0:
            return np.diag(inverse**2)
        scores = np.zeros((blocks.max() + 1, len(s)))
        np.add.at(scores, blocks, np.einsum("inm,in->im", A @ V.T, left))
        finite = np.where(np.isfinite(inverse), inverse, 0.0)
        spread = (scores * finite).T @ (scores * finite) * len(scores) / (len(scores) - 1) * np.outer(finite, finite)
        return spread + np.diag(np.where(np.isfinite(inverse), 0.0, np.inf))

    def _blocks(self) -> np.ndarray:
        """The number (N,) of the block of each instant: equal stretches of the trials, about `_BLOCKS` in all."""
        length = max(len(self.trial) // _BLOCKS, 1)
        found, first = np.zeros(len(self.trial), int), 0
        for one in np.unique(self.trial):
            places = np.flatnonzero(self.trial == one)
            found[places] = first + np.arange(len(places)) // length
            first = found[places].max() + 1
        return found


def _from_directions(V: np.ndarray, along: np.ndarray) -> np.ndarray:
    """A covariance (m, m) of directions, the rows of V, as that of what they are directions of: infinite variances, and
    covariances NaN, of all that has a part in a direction without information."""
    seen = np.isfinite(np.diag(along))
    spread: Any = V[seen].T @ along[np.ix_(seen, seen)] @ V[seen]
    loose = np.any(np.abs(V[~seen]) > 1e-6, axis=0)
    spread[loose] = spread[:, loose] = np.nan
    spread[loose, loose] = np.inf
    return spread
