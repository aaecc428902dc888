"""Smoothed trajectories of a fit with process noise, from all measurements of each trial. Uses filters; runs no fit."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy import stats

from ..._common.lookup import not_there
from ..._kane.api import _dependent_speeds
from ..._scalarjit.cache_key import jit
from ..._system.system import unpacked
from ...estimate._filter import brought_back
from ..problem.model import Model, Unknowns
from ..problem.windows import state_names
from ..solve.kalman import filtered, smoothed_moments
from ..solve.linearization import map_windows, starts_of
from .statistics import check_level

DIFFUSE = 1e4
"""Prior standard deviation of an initial state or trial unknown that has none, in multiples of its standard error."""


@dataclasses.dataclass(frozen=True, repr=False)
class Smoothed:
    """The trajectory of one trial, given all of its measurements and the estimated parameters.

        motion = fit.smoothed()["ride 1"]
        motion["roll"], motion.deviation("roll"), motion.band("roll")

    - `t` (n_t,): times of the trial [s].
    - `names`: coordinates, independent speeds, states, dependent speeds, and the trial unknowns, such as "offset of
        roll".
    - `mean` (n_t, n), `covariance` (n_t, n, n): in the order of `names`. Dependent speeds and dependent coordinates
        follow from the others to first order, so the covariance is singular.

    The uncertainty of the parameters is not included.
    """

    t: np.ndarray
    names: tuple[str, ...]
    mean: np.ndarray
    covariance: np.ndarray

    def __getitem__(self, name: str) -> np.ndarray:
        return self.mean[:, self._place(name)]

    def deviation(self, name: str) -> np.ndarray:
        """Standard deviation (n_t,).

        **Arguments:**

        - `name`: one of `names`.
        """
        i = self._place(name)
        return np.sqrt(self.covariance[:, i, i])

    def band(self, name: str, level: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
        """Pointwise probability band.

        **Arguments:**

        - `name`: one of `names`.
        - `level`: probability, between 0 and 1.

        **Returns:** lower and upper ends (n_t,), which contain the value with this probability at each time.

        **Raises:** `ValueError` if `level` is not between 0 and 1.
        """
        check_level(level)
        half = float(stats.norm.ppf(0.5 * (1 + level))) * self.deviation(name)
        return self[name] - half, self[name] + half

    def _place(self, name: str) -> int:
        if name not in self.names:
            raise not_there(name, self.names, "this motion")
        return self.names.index(name)

    def __repr__(self) -> str:
        return f"Smoothed({len(self.t)} times from {self.t[0]:g} to {self.t[-1]:g} s: {', '.join(self.names)})"


def smoothed(fit: Any) -> dict[str, Smoothed]:
    """See `Fit.smoothed`."""
    problem, system = fit.problem, fit.problem.system
    if problem.model.noise is None:
        raise ValueError(
            "fit.smoothed: the fit has no process noise, so the motion follows from its initial state. Use "
            "`fit.trajectories()` or `fit.fitted`, or fit with `noise={...}`."
        )
    starts, _ = starts_of(problem.model, problem.windows, fit.point)
    mean, root = _smoothed(problem.model, problem.windows, fit.point, starts, _beginnings(fit))
    unknowns = problem.model.nuisance.trial_names
    names = (*state_names(system), *system.dependent_speeds, *unknowns)
    mean, root = np.array(mean, float), np.asarray(root, float)
    mean[:, :, len(names) - len(unknowns) :] += np.asarray(problem.model.nuisance.trial_center)
    motions = {}
    for k, (name, (_, first, n)) in enumerate(zip(fit.trial_names, problem.slices, strict=True)):  # window = trial
        covariance = np.einsum("tik,tjk->tij", root[k, :n], root[k, :n])
        motions[name] = Smoothed(problem.trials[k].t[first : first + n], names, mean[k, :n], covariance)
    return motions


def _beginnings(fit: Any) -> Array:
    """Initial standard deviations of the filters (W, n + n_b): those that were passed, otherwise very large ones."""
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
    """By trial, the mean (W, n_t, n) and a square root of the covariance (W, n_t, n, k) of [q, u, x, u_dep, b]."""
    n = len(state_names(model.system))

    def of_trial(arguments: Any) -> tuple[Array, Array]:
        window, b, start, begin = arguments
        system, _ = model.parameters.apply(model.system, point.parameters, window.applies)
        result = filtered(model, window, start, b, point.parameters, begin)
        v, S = smoothed_moments(result.steps)
        v, S = jax.vmap(lambda t, v, S: brought_back(lambda _: system, t, v, S))(window.t, v, S)

        def whole(t: Array, v: Array) -> Array:
            state = unpacked(system, v[:n])
            u_dep = _dependent_speeds(system, t, state.q, state.u, {})
            return jnp.concatenate([v[:n], u_dep, v[n:]])

        def at(t: Array, v: Array, S: Array) -> tuple[Array, Array]:

            def along(direction):
                return jax.jvp(lambda v: whole(t, v), (v,), (direction,))

            return jax.vmap(along, in_axes=1, out_axes=(None, 1))(S)

        return jax.vmap(at)(window.t, v, S)

    return map_windows(of_trial, (windows, point.trial_unknowns[windows.trial], starts, begin))
