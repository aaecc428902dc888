"""Measured channels as splines, and coordinates, speeds and accelerations from them. Knows a trial and its system.

An acceleration that is not measured is a second derivative, which noise spoils. Each channel is approximated by least
squares by a spline of fifth degree (scipy's `make_lsq_spline`), whose knots are as far apart as the measurements'
standard deviations allow: the smoothest curve that agrees with them (Reinsch, Smoothing by spline functions, Numerische
Mathematik 1967, asks the same of another spline). Inputs are approximated between the same knots: what filters both
sides of a linear equation alike does not bend it (Gautier, Dynamic identification of robots with power model, ICRA
1997).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import make_lsq_spline

from ..._method.equations import coordinate_rates
from ..._scalars.versions import compiled
from .._data.trial import Trial

DEGREE = 5
_MOST_OF_A_SAMPLE = 4.0  # knots are no closer than so many samples
_RATIO = 1.25  # between spacings that are tried


@compiled
def speeds_and_rates(system, t, q, q_dot, q_ddot):
    """Independent speeds and their rates (n, n_u), from the coordinates' rates, which are affine in them."""
    zero = jnp.zeros(len(system.speeds), q.dtype)

    def speeds(t, q, q_dot):
        rates = lambda u: coordinate_rates(system, t, q, u)  # noqa: E731
        return jnp.linalg.pinv(jax.jacfwd(rates)(zero)) @ (q_dot - rates(zero))

    def along(t, q, q_dot, q_ddot):
        return jax.jvp(speeds, (t, q, q_dot), (jnp.ones_like(t), q_dot, q_ddot))

    return jax.vmap(along)(t, q, q_dot, q_ddot)


def max_spacing(trial: Trial, channels: Mapping[str, np.ndarray]) -> float:
    """The largest spacing [s] of knots at which every channel is met within its standard deviation."""
    span = trial.t[-1] - trial.t[0]
    spacing, least = span / 2, _MOST_OF_A_SAMPLE * float(np.median(np.diff(trial.t)))
    for name, y in channels.items():
        seen = np.isfinite(y)
        while spacing > least:
            misfit = (spline(trial, name, y, spacing)(trial.t[seen]) - y[seen]) / trial.sigma[name][seen]
            if np.mean(misfit**2) <= 1.0:
                break
            spacing /= _RATIO
    return max(spacing, least)


def spline(trial: Trial, name: str, y: np.ndarray, spacing: float) -> Any:
    """The spline of least squares, whose knots are as far apart; without those between which nothing was measured."""
    seen = np.isfinite(y)
    t, y = trial.t[seen], y[seen]
    if len(t) < 3 * (DEGREE + 1):
        raise ValueError(
            f"{trial.name}: {name} has {len(t)} samples; {3 * (DEGREE + 1)} are the least to take accelerations from."
        )
    steps = np.abs(np.diff(y))
    usual = np.median(steps)
    if usual < 0.8 and np.any(np.abs(steps - 2 * np.pi) < 0.2 + 2 * usual):
        raise ValueError(
            f"{trial.name}: {name} jumps by a whole turn at t = {t[steps.argmax()]:g} s: make it one curve by "
            "np.unwrap."
        )
    weights = None if name not in trial.sigma else 1.0 / trial.sigma[name][seen]
    n = max(1, round((t[-1] - t[0]) / spacing))
    inner, last = [], 0
    for knot in np.linspace(t[0], t[-1], n + 1)[1:-1]:
        upto = int(np.searchsorted(t, knot))
        if upto - last >= 2 and len(t) - upto >= 2:
            inner.append(knot)
            last = upto
    knots = np.r_[[t[0]] * (DEGREE + 1), inner, [t[-1]] * (DEGREE + 1)]
    return make_lsq_spline(t, y, knots, DEGREE, w=weights)


def covered(t: np.ndarray, channels: Mapping[str, np.ndarray], spacing: float) -> np.ndarray:
    """Where every channel was measured, and has no end nor a gap of a spacing within a spacing."""
    fine = np.ones(t.shape, bool)
    for y in channels.values():
        seen = t[np.isfinite(y)]
        fine &= (t >= seen[0] + spacing) & (t <= seen[-1] - spacing)
        for i in np.flatnonzero(np.diff(seen) > spacing):
            fine &= (t <= seen[i] - spacing) | (t >= seen[i + 1] + spacing)
    return fine
