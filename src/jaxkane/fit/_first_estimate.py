"""A first estimate of bodies by linear least squares, and the free numbers whose bodies are nearest to it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

from .._kane.checks import check_bodies
from .._kane.regressor import described
from .._scalarjit.cache_key import jit
from .._system.system import System
from ._base_parameters import BaseParameters, equations_at, estimated, states_for, structure_of_states
from ._kinematics import Motions, kinematic_samples, max_spacing
from ._parameters import Parameters, parameters_of
from ._regressor import Chosen, check_linear
from ._tables import bodies_in_words
from ._trial import Trial

_PULL = 1e-2  # of a free number towards its start, in standard deviations: decides what the data do not determine


def _values_at(chosen: Chosen, parameters: Parameters, x: Any) -> Any:
    return _values(chosen.of(parameters.apply(chosen.system, x)[0]))


def _values(chosen: Chosen) -> Any:
    return chosen.values(jnp.zeros(()), jnp.full(len(chosen.system.coordinates), 0.3))


_compiled_values = jit(_values)


def column_values(chosen: Chosen, system: System) -> np.ndarray:
    return np.asarray(_compiled_values(chosen.of(system)))


def nearest(chosen: Chosen, parameters: Parameters, base: BaseParameters) -> tuple[np.ndarray, float]:
    """Free numbers (p,) whose base parameters are nearest to those that were found, and how far they are."""
    eigenvalues, V = np.linalg.eigh(base.information)
    root = np.sqrt(np.maximum(eigenvalues, 0.0))[:, None] * V.T
    if base.held is not None:
        # Held as firmly as the best determined number.
        hold = np.zeros(len(base.places))
        hold[base.held] = 10.0 * np.sqrt(max(eigenvalues.max(initial=0.0), 1e-300))
        root = np.vstack([root, hold])
    known = np.isfinite(np.asarray(parameters.prior_deviation))

    def residuals(x: Any) -> np.ndarray:
        columns, priors = look(x)[0]
        return np.concatenate([root @ (base.of(columns) - base.estimates), _PULL * x, priors[known]])

    def slopes(x: Any) -> np.ndarray:
        columns, priors = look(x)[1]
        return np.vstack([root @ base.matrix @ columns, _PULL * np.eye(len(x)), priors[known]])

    seen: dict[bytes, Any] = {}

    def look(x: Any) -> Any:
        if x.tobytes() not in seen:
            seen.clear()
            seen[x.tobytes()] = jax.device_get(
                values_with_slopes(chosen, parameters, jnp.asarray(x, parameters.start.dtype))
            )
        return seen[x.tobytes()]

    jac: Any = slopes
    found = least_squares(residuals, np.zeros(len(parameters.names)), jac, method="trf", x_scale=1.0, max_nfev=200)
    return found.x, float(np.linalg.norm(residuals(found.x)[: len(root)]))


@jit
def values_with_slopes(chosen, parameters, x):
    """The values of the columns and the residuals of the priors, and how both change with the free numbers."""
    both = lambda x: (_values_at(chosen, parameters, x), parameters.prior_residuals(x))  # noqa: E731
    return both(x), jax.jacfwd(both)(x)


_TRIED = 7  # spacings of knots


@dataclasses.dataclass(frozen=True)
class FirstEstimate:
    """What the equations of motion determine of the free parameters, without any simulation.

    - `system`: with what was found in it; a fit may begin from it.
    - `values` (p) by name, `starts` (p) from which they came.
    - `base`: the `BaseParameters` that linear least squares found, with their deviations, and `feasible` (b): those of
        `system`, whose bodies can be.
    - `distance`: how far the second are from the first, in standard deviations; where it is above 3 (`ok`), no body has
        what the equations ask for: the model lacks something, or the accelerations are too noisy.
    - `spacing` [s]: of the knots from which accelerations were taken; NaN where nothing had to be smoothed.
    - `bodies`: those that were freed as `Inertia(...)`, each as a whole, in words.
    - `infeasibility`: why bodies are refused that were not freed as `Inertia(...)`; empty where all can be.
    """

    system: System
    values: Mapping[str, float]
    starts: Mapping[str, float]
    base: BaseParameters
    feasible: np.ndarray
    distance: float
    spacing: float
    infeasibility: str
    bodies: tuple[str, ...]

    @property
    def ok(self) -> bool:
        return self.distance <= 3.0 and not self.infeasibility

    def __str__(self) -> str:
        width = max(map(len, self.values))
        lines = [f"{'':<{width}}         start         found"]
        lines += [f"{name:<{width}}  {self.starts[name]:12.5g}  {x:12.5g}" for name, x in self.values.items()]
        lines += [
            *self.bodies,
            "",
            str(self.base),
            f"the nearest feasible bodies are {self.distance:.2g} standard deviations from these",
        ]
        return "\n".join([*lines, *[self.infeasibility] * bool(self.infeasibility)])

    __repr__ = __str__


def first_estimate(
    system: System,
    motions: Motions,
    free: Any,
    *,
    sigma: Mapping[str, float] | None = None,
    spacing: float | None = None,
) -> FirstEstimate:
    """Parameters of bodies, dampers and springs from measured motion by linear least squares, to begin a fit from.

        guess = first_estimate(system, trials, free)
        result = fit(guess.system, trials, free, unknown=...)

    The base parameters of what is free are found from Y pi = tau at the measured instants (see `base_parameters`). Then
    those values of the free parameters are taken whose base parameters are nearest to them, measured by their
    covariance: a positive parameter stays positive, an `Inertia(...)` stays what a body can have, since its pseudo-
    inertia stays positive definite (Wensing, Kim and Slotine, Linear matrix inequalities for physically consistent
    inertial parameter identification, IEEE Robotics and Automation Letters, 2018; Rucker and Wensing 2022). Where the
    data determine nothing, they stay nearest to the system's values in the free numbers of a fit.

    **Arguments:**

    - `system`: with initial guesses. `motions`: trials, trajectories or `KinematicSamples`, as of `kinematic_samples`.
    - `free`: as of `fit`: names, `Free`, `Inertia(...)`. In what does not belong to a body, as dampers, springs and dry
        friction, the equations must be linear.
    - `sigma`: by speed, the standard deviation of what remains in its equation; by default estimated.
    - `spacing` [s]: of the knots of the splines that give accelerations; by default that one, of some beginning with
        what `sigma` of the trials allows, with which the equations are met best.

    **Returns:** a `FirstEstimate`; print it.

    **Raises:** `ValueError` as `fit`, `regressor` and `kinematic_samples`; for gains and delays, and parameters that
    change lengths or places, in which the equations are not linear.
    """
    parameters = parameters_of(system, free)
    _refuse_roles(parameters)
    chosen = _chosen_by(system, parameters)
    _refuse_lengths(chosen, parameters)
    check_linear(chosen, np.zeros((), jnp.result_type(float)), None)
    structure = structure_of_states(chosen)
    base, spacing = _best(system, chosen, structure, motions, sigma, spacing)
    x, distance = nearest(chosen, parameters, base)
    at = jnp.asarray(x, parameters.start.dtype)
    found, values = parameters.apply(system, at)[0], np.asarray(parameters.values(at))
    return FirstEstimate(
        found,
        dict(zip(parameters.names, values.tolist(), strict=True)),
        dict(zip(parameters.names, np.asarray(parameters.start).tolist(), strict=True)),
        base,
        base.of(column_values(chosen, found)),
        distance,
        spacing,
        _infeasibility(found),
        tuple(bodies_in_words(parameters, at)),
    )


def _refuse_roles(parameters: Parameters) -> None:
    roles = [entry.name for entry in parameters.entries if entry.role is not None]
    if roles:
        raise ValueError(
            f"first_estimate: {', '.join(roles)} is no parameter in which the equations of motion are linear: "
            "leave it to the fit."
        )


def _chosen_by(system: System, parameters: Parameters) -> Chosen:
    """The bodies' parameters that the free ones move, and those of the free ones that move no body."""
    every = Chosen(described(system, None), (), (), ())
    # At the start and beside it: the moment of inertia about a joint does not change with a centre that is there.
    at = [jnp.full_like(parameters.start, x) for x in (0.0, 0.37)]
    slopes = np.max(
        [np.abs(values_with_slopes(every, parameters, x)[1][0]) for x in at], axis=0
    )  # (all of all bodies, p)
    size = slopes.max(axis=1, initial=0.0, keepdims=True)
    moved: np.ndarray = slopes > 1e-9 * np.where(size > 0, size, 1.0)
    bodies: dict[str, tuple[str, ...]] = {}
    rows = iter(np.any(moved, axis=1).tolist())
    for part in every.described.parts:
        names = [name.rpartition(".")[2] for name, is_moved in zip(part.names, rows) if is_moved]
        if names:
            bodies[part.name] = tuple(names)
    # What an entry moves beside bodies has columns of its own.
    own = [
        entry
        for entry, is_of_body in zip(parameters.entries, np.any(moved, axis=0).tolist(), strict=True)
        if not is_of_body
    ]
    places = [(leaf, place) for entry in own for leaf, place, _ in entry.targets]
    names = [
        f"{entry.name}" if i == 0 else f"{entry.name}, tied {i}" for entry in own for i in range(len(entry.targets))
    ]
    units = [entry.unit for entry in own for _ in entry.targets]
    return Chosen(described(system, bodies), tuple(places), tuple(names), tuple(units))


def _refuse_lengths(chosen: Chosen, parameters: Parameters) -> None:
    """A free parameter with which columns change moves points, and not bodies alone."""
    states = states_for(chosen)
    _, Y, _, _ = equations_at(chosen, states)
    for i, name in enumerate(parameters.names):
        x = np.zeros(len(parameters.names))
        x[i] = 0.3
        other, _ = parameters.apply(chosen.system, jnp.asarray(x, parameters.start.dtype))
        _, then, _, _ = equations_at(chosen.of(other), states)
        if then.shape != Y.shape or np.abs(then - Y).max() > 1e-6 * np.abs(Y).max():
            raise ValueError(
                f"{type(chosen.system).__name__}: {name} changes lengths, places or inputs, in which the equations of "
                "motion are not linear: hold it for the first guess, and free it in the fit."
            )


def _best(
    system: System,
    chosen: Chosen,
    structure: BaseParameters,
    motions: Motions,
    sigma: Mapping[str, float] | None,
    spacing: float | None,
) -> tuple[BaseParameters, float]:
    """The estimate with the spacing that leaves least unexplained."""
    trials = [motions] if isinstance(motions, Trial) else list(motions) if isinstance(motions, (list, tuple)) else []
    trials = [trial for trial in trials if isinstance(trial, Trial)]
    tried: list[float | None] = [spacing]
    if spacing is None and trials:
        known = (*system.coordinates, *system.speeds)
        widest = [max_spacing(t, {n: y for n, y in t.measured.items() if n in known}) for t in trials]
        tried = [float(np.median(widest)) / 1.5**i for i in range(_TRIED)]
    best, chosen_spacing = None, float("nan")
    for one in tried:
        found = estimated(structure, *equations_at(chosen, kinematic_samples(system, motions, spacing=one)), sigma, 0.5)
        if best is None or found.unexplained < best.unexplained:
            best, chosen_spacing = found, float("nan") if one is None else one
        elif found.unexplained > 1.5 * best.unexplained:
            break
    assert best is not None
    return best, chosen_spacing


def _infeasibility(system: System) -> str:
    try:
        check_bodies(system, jnp.zeros(()), jnp.full(len(system.coordinates), 0.3))
    except ValueError as error:
        return f"{error} Free the body's numbers together, as Inertia(...): see inertia_of."
    return ""
