"""A first estimate of bodies by linear least squares, projected onto feasible inertias."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

from .._kane.checks import check_bodies
from .._kane.regressor import regressor_model
from .._scalarjit.cache_key import jit
from .._system.system import System
from ._base_parameters import BaseParameters, base_structure, equations_at, estimated, states_for
from ._diagnostics import describe_bodies
from ._kinematics import Motions, kinematic_samples, max_spacing
from ._parameters import Parameters, parameters_of
from ._regressor import RegressorSpec, check_linear
from ._trial import Trial

_PULL = 1e-2  # of a free number towards its start, in standard deviations: decides what the data do not determine
_SPACINGS = 7  # of knots that are tried


@dataclasses.dataclass(frozen=True)
class FirstEstimate:
    """What the equations of motion determine of the free parameters, without any simulation.

    - `system`: with the estimates in it; a fit may begin from it.
    - `values` (p) by name, `starts` (p) from which they came.
    - `base`: the `BaseParameters` of linear least squares, with their deviations, and `feasible` (b): those of
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
        lines = [f"{'':<{width}}         start      estimate"]
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

    The base parameters of what is free are estimated from Y pi = tau at the measured instants (see `base_parameters`),
    and projected onto feasible inertias: the free parameters are those whose base parameters are nearest to the
    estimates, measured by their covariance. A positive parameter stays positive, the pseudo-inertia of an
    `Inertia(...)` positive definite (Wensing, Kim and Slotine, Linear matrix inequalities for physically consistent
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
    spec = _regressor_spec(system, parameters)
    _check_linear(spec, parameters)
    base, spacing = _best_estimate(spec, motions, sigma, spacing)
    x, feasible, distance = _projection(spec, parameters, base)
    result, values = parameters.apply(system, x)[0], np.asarray(parameters.values(x))
    try:
        check_bodies(result, jnp.zeros(()), jnp.full(len(result.coordinates), 0.3))
        infeasibility = ""
    except ValueError as error:
        infeasibility = f"{error} Free the body's numbers together, as Inertia(...): see inertia_of."
    return FirstEstimate(
        result,
        dict(zip(parameters.names, values.tolist(), strict=True)),
        dict(zip(parameters.names, np.asarray(parameters.start).tolist(), strict=True)),
        base,
        feasible,
        distance,
        spacing,
        infeasibility,
        tuple(describe_bodies(parameters, x)),
    )


def _regressor_spec(system: System, parameters: Parameters) -> RegressorSpec:
    """The bodies' parameters that the free ones move, and those of the free ones that move no body."""
    roles = [entry.name for entry in parameters.entries if entry.role is not None]
    if roles:
        raise ValueError(
            f"first_estimate: {', '.join(roles)} is no parameter in which the equations of motion are linear: "
            "leave it to the fit."
        )
    every = RegressorSpec(regressor_model(system, None), (), (), ())
    # At the start and beside it: the moment of inertia about a joint does not change with a centre that is there.
    at = [jnp.full_like(parameters.start, x) for x in (0.0, 0.37)]
    slopes = np.max([np.abs(_values_with_slopes(every, parameters, x)[1][0]) for x in at], axis=0)  # (columns, p)
    size = slopes.max(axis=1, initial=0.0, keepdims=True)
    moved: np.ndarray = slopes > 1e-9 * np.where(size > 0, size, 1.0)
    bodies: dict[str, tuple[str, ...]] = {}
    rows = iter(np.any(moved, axis=1).tolist())
    for part in every.model.bodies:
        names = [name.rpartition(".")[2] for name, is_moved in zip(part.names, rows) if is_moved]
        if names:
            bodies[part.name] = tuple(names)
    # What an entry moves beside bodies has columns of its own.
    own = [entry for entry, of_body in zip(parameters.entries, np.any(moved, axis=0), strict=True) if not of_body]
    places, names, units = [], [], []
    for entry in own:
        for i, (leaf, place, _) in enumerate(entry.targets):
            places.append((leaf, place))
            names.append(entry.name if i == 0 else f"{entry.name}, tied {i}")
            units.append(entry.unit)
    return RegressorSpec(regressor_model(system, bodies), tuple(places), tuple(names), tuple(units))


def _check_linear(spec: RegressorSpec, parameters: Parameters) -> None:
    """A free parameter with which columns change moves points, and not bodies alone."""
    states = states_for(spec)
    Y, _, _ = equations_at(spec, states)
    for i, name in enumerate(parameters.names):
        x = np.zeros(len(parameters.names))
        x[i] = 0.3
        changed, _ = parameters.apply(spec.system, jnp.asarray(x, parameters.start.dtype))
        after, _, _ = equations_at(spec.of(changed), states)
        if after.shape != Y.shape or np.abs(after - Y).max() > 1e-6 * np.abs(Y).max():
            raise ValueError(
                f"{type(spec.system).__name__}: {name} changes lengths, places or inputs, in which the equations of "
                "motion are not linear: hold it for the first guess, and free it in the fit."
            )
    check_linear(spec, np.zeros((), jnp.result_type(float)), None)


def _best_estimate(
    spec: RegressorSpec, motions: Motions, sigma: Mapping[str, float] | None, spacing: float | None
) -> tuple[BaseParameters, float]:
    """The estimate with the smallest unexplained part, and its spacing."""
    system, structure, spacings = spec.system, base_structure(spec), [spacing]
    trials = [motion for motion in (motions if isinstance(motions, (list, tuple)) else [motions])
              if isinstance(motion, Trial)]  # fmt: skip
    if spacing is None and trials:
        known = (*system.coordinates, *system.speeds)
        widest = [max_spacing(t, {n: y for n, y in t.measured.items() if n in known}) for t in trials]
        spacings = [float(np.median(widest)) / 1.5**i for i in range(_SPACINGS)]
    best, best_spacing = None, None
    for one in spacings:
        samples = kinematic_samples(system, motions, spacing=one)
        estimate = estimated(structure, system.speeds, *equations_at(spec, samples), sigma, 0.5)
        if best is None or estimate.unexplained < best.unexplained:
            best, best_spacing = estimate, one
        elif estimate.unexplained > 1.5 * best.unexplained:
            break
    assert best is not None
    return best, float("nan") if best_spacing is None else best_spacing


def _projection(
    spec: RegressorSpec, parameters: Parameters, base: BaseParameters
) -> tuple[jax.Array, np.ndarray, float]:
    """Free numbers (p,) whose base parameters are nearest to the estimates, these (b,), and their distance."""
    eigenvalues, V = np.linalg.eigh(base.information)
    root = np.sqrt(np.maximum(eigenvalues, 0.0))[:, None] * V.T
    if base.fixed is not None:
        # As firmly as the best determined number.
        row = np.zeros(len(base.places))
        row[base.fixed] = 10.0 * np.sqrt(max(eigenvalues.max(initial=0.0), 1e-300))
        root = np.vstack([root, row])
    has_prior = parameters.has_prior
    memory: dict[bytes, Any] = {}

    def evaluate(x: np.ndarray) -> Any:
        if x.tobytes() not in memory:
            memory.clear()
            at = jnp.asarray(x, parameters.start.dtype)
            memory[x.tobytes()] = jax.device_get(_values_with_slopes(spec, parameters, at))
        return memory[x.tobytes()]

    def residuals(x: Any) -> np.ndarray:
        values, priors = evaluate(x)[0]
        return np.concatenate([root @ (base.of(values) - base.estimates), _PULL * x, priors[has_prior]])

    def slopes(x: Any) -> np.ndarray:
        values, priors = evaluate(x)[1]
        return np.vstack([root @ base.matrix @ values, _PULL * np.eye(len(x)), priors[has_prior]])

    jac: Any = slopes
    x = least_squares(residuals, np.zeros(len(parameters.names)), jac, method="trf", x_scale=1.0, max_nfev=200).x
    distance = float(np.linalg.norm(residuals(x)[: len(root)]))
    return jnp.asarray(x, parameters.start.dtype), base.of(evaluate(x)[0][0]), distance


@jit
def _values_with_slopes(spec, parameters, x):
    """The values of the columns and the residuals of the priors, and how both change with the free numbers."""

    def values(x):
        system = parameters.apply(spec.system, x)[0]
        columns = spec.of(system).values(jnp.zeros(()), jnp.full(len(system.coordinates), 0.3))
        return columns, parameters.prior_residuals(x)

    return values(x), jax.jacfwd(values)(x)
