"""The motion of every trial of a fit with process noise, from all that was measured. Knows filters; fits nothing."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy import stats

from .._common.lookup import not_there
from .._kane.equations import _dependent_speeds
from .._scalarjit.cache_key import jit
from .._system.system import unpacked
from ..estimate._filter import brought_back
from ._kalman import filtered, smoothed_moments
from ._linearize import map_windows, starts_of
from ._model import Model, Unknowns
from ._problem import refuse_other
from ._result import Fit
from ._statistics import check_level
from ._windows import state_names

DIFFUSE = 1e4
"""How many times its own standard error a start, or a trial's unknown, that was given no deviation may be off before
anything is measured."""


@dataclasses.dataclass(frozen=True, repr=False)
class Smoothed:
    """The motion of one trial, given all of its measurements and the parameters that were found.

        motion = smoothed(fit)["ride 1"]
        motion["roll"], motion.deviation("roll"), motion.band("roll")

    - `t` (n_t,) [s]: the trial's times. `names`: coordinates, independent speeds, states, dependent speeds, and the
        trial's own unknowns, such as "bias of roll".
    - `mean` (n_t, n), `covariance` (n_t, n, n), in the order of `names`. Dependent speeds, and coordinates that
        constraints bind, follow from the others to first order, so that the covariance is singular.

    What is uncertain about the parameters is not in it.
    """

    t: np.ndarray
    names: tuple[str, ...]
    mean: np.ndarray
    covariance: np.ndarray

    def __getitem__(self, name: str) -> np.ndarray:
        return self.mean[:, self._place(name)]

    def deviation(self, name: str) -> np.ndarray:
        """Standard deviation (n_t,)."""
        i = self._place(name)
        return np.sqrt(self.covariance[:, i, i])

    def band(self, name: str, level: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper ends (n_t,), between which the value lies with this probability at each time."""
        check_level(level)
        half = float(stats.norm.ppf(0.5 * (1 + level))) * self.deviation(name)
        return self[name] - half, self[name] + half

    def _place(self, name: str) -> int:
        if name not in self.names:
            raise not_there(name, self.names, "this motion")
        return self.names.index(name)

    def __repr__(self) -> str:
        return f"Smoothed({len(self.t)} times from {self.t[0]:g} to {self.t[-1]:g} s: {', '.join(self.names)})"


def smoothed(fit: Fit) -> dict[str, Smoothed]:
    """By trial, the motion as estimated from all its measurements, with its uncertainty: what is left of process noise
    and sensors' noise when both are known.

    The extended smoother of Bryson and Frazier (as that of Rauch, Tung and Striebel, without an inverse). A start, or a
    bias, that was given no standard deviation may be anywhere: its uncertainty is that which the data leave.

    **Raises:** `TypeError` for what is no `Fit`; `ValueError` for a fit without process noise, whose motion is
    determined by its start: see `trajectories`.
    """
    refuse_other(fit, Fit, "smoothed", "smoothed(fit(..., noise={...}))")
    problem, system = fit.problem, fit.problem.system
    if problem.model.noise is None:
        raise ValueError(
            "smoothed: this fit has no process noise, so its motion is what its start makes of it: see "
            "`trajectories(fit)`, `fit.fitted`. Fit with `noise={...}` to have a motion that is disturbed."
        )
    starts, _ = starts_of(problem.model, problem.windows, fit.point)
    mean, root = _smoothed(problem.model, problem.windows, fit.point, starts, _beginnings(fit))
    unknowns = [f"{kind.split()[0]} of {what}" for kind, what in problem.model.nuisance.trial]
    names = (*state_names(system), *system.dependent_speeds, *unknowns)
    mean, root = np.array(mean, float), np.asarray(root, float)
    factors = [1.0 if kind.startswith("gain") else 0.0 for kind, _ in problem.model.nuisance.trial]
    mean[:, :, len(names) - len(unknowns) :] += np.array(factors)
    motions = {}
    for k, name in enumerate(fit.trial_names):
        n, S = len(problem.trials[k].t), root[k]
        covariance = np.einsum("tik,tjk->tij", S[:n], S[:n])
        motions[name] = Smoothed(problem.trials[k].t, names, mean[k, :n], covariance)
    return motions


def _beginnings(fit: Fit) -> Array:
    """Standard deviations (W, n + n_b) with which the filters begin: those that were given, else very large ones."""
    problem, blocks = fit.problem, fit.linearization.blocks
    nuisance, n = problem.model.nuisance, len(state_names(problem.system))
    R, n_z, n_b = np.asarray(blocks.R, float), blocks.n_z, blocks.n_b
    information = np.linalg.norm(R[:, :, : n_z + n_b], axis=1)  # (W, n_z + n_b)
    wide = DIFFUSE / np.where(information > 0, information, 1.0)
    stated = np.concatenate([np.asarray(nuisance.start_deviation), np.asarray(nuisance.trial_deviation)])
    deviations = np.where(np.isfinite(stated), stated, wide)
    begin = np.zeros((R.shape[0], n + n_b))
    begin[:, problem.model.unknown_places] = deviations[:, :n_z]
    begin[:, n:] = deviations[:, n_z:]
    return jnp.asarray(begin, problem.windows.t.dtype)


@jit
def _smoothed(model: Model, windows: Any, point: Unknowns, starts: Array, begin: Array) -> tuple[Array, Array]:
    """Of every trial, mean (W, n_t, n) and a root of the covariance (W, n_t, n, k) of [q, u, x, u_dep, b]."""
    n = len(state_names(model.system))

    def of_trial(arguments: Any) -> tuple[Array, Array]:
        window, b, start, begin = arguments
        system, _ = model.parameters.apply(model.system, point.x)
        result = filtered(model, window, start, b, point.x, begin)
        v, S = smoothed_moments(result.steps)
        v, S = jax.vmap(lambda t, v, S: brought_back(system, t, v, S))(window.t, v, S)

        def whole(t: Array, v: Array) -> Array:
            state = unpacked(system, v[:n])
            u_dep = _dependent_speeds(system, t, state.q, state.u, {})
            return jnp.concatenate([v[:n], u_dep, v[n:]])

        def at(t: Array, v: Array, S: Array) -> tuple[Array, Array]:
            along = lambda direction: jax.jvp(lambda v: whole(t, v), (v,), (direction,))  # noqa: E731
            return jax.vmap(along, in_axes=1, out_axes=(None, 1))(S)

        return jax.vmap(at)(window.t, v, S)

    return map_windows(of_trial, (windows, point.b[windows.trial], starts, begin))
