"""A first estimate of parameters of bodies by linear least squares, projected onto physically consistent inertias."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import least_squares

from ..._kane.checks import check_bodies
from ..._kane.regressor import regressor_model
from ..._scalarjit.cache_key import jit
from ..._system.system import System
from ..problem.declarations import Items
from ..problem.parameters import Parameters
from ..problem.specification import parameters_of
from ..problem.trial import Trial
from ..result.data import text_table
from ..result.diagnostics import describe_bodies
from .base_parameters import BaseParameters, base_structure, equations_at, estimated, states_for
from .kinematics import Motions, kinematic_samples, max_spacing
from .regressor import RegressorSpec, check_linear

_PULL = 1e-2  # weight of the deviation from the start: determines what the data do not
_SPACINGS = 7  # number of knot spacings that are tried


@dataclasses.dataclass(frozen=True)
class FirstEstimate:
    """The result of `first_estimate`: estimates of free parameters from the equations of motion. Print it for a table.

    - `system`: the system with the estimates, a starting point for a fit.
    - `values`, `starts`: by name, the estimates and the initial guesses.
    - `base`: the `BaseParameters` from linear least squares, with their standard deviations.
    - `feasible` (b): the base parameters of `system`, which are physically consistent.
    - `distance`: distance between `feasible` and `base`, in standard deviations. Above 3 (`ok` is False), no physically
        consistent body satisfies the equations: the model is incomplete, or the accelerations are too noisy.
    - `spacing`: distance [s] of the knots of the splines from which the accelerations were computed. NaN if nothing was
        smoothed.
    - `infeasibility`: why bodies that were not freed as `Inertia(...)` are not physically consistent. Empty if they
        are.
    - `bodies`: one text for each body that was freed as `Inertia(...)`.
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

    def __repr__(self) -> str:
        rows = [("", "start", "estimate"), *((n, f"{self.starts[n]:.5g}", f"{x:.5g}") for n, x in self.values.items())]
        nearest = f"the nearest feasible bodies are {self.distance:.2g} standard deviations from these"
        return "\n".join([text_table(rows), *self.bodies, "", str(self.base), nearest, self.infeasibility]).rstrip()


def first_estimate(
    system: System,
    motions: Motions,
    free: Items,
    *,
    sigma: Mapping[str, float] | None = None,
    spacing: float | None = None,
) -> FirstEstimate:
    """Estimate parameters of bodies, dampers and springs by linear least squares, as initial guesses for a fit.

        guess = first_estimate(system, trials, free)
        result = fit(guess.system, trials, free, unknown=...)

    The base parameters of the free parameters are estimated from Y pi = tau at the measured instants (see
    `base_parameters`). The free parameters are then chosen so that their base parameters are nearest to these
    estimates, measured by their covariance. Positive parameters remain positive, and the pseudo-inertia of an
    `Inertia(...)` remains positive definite (Wensing, Kim and Slotine, Linear matrix inequalities for physically
    consistent inertial parameter identification, IEEE Robotics and Automation Letters, 2018; Rucker and Wensing 2022).
    Combinations that the data do not determine remain as near as possible to the system's values, in the unconstrained
    parameters of a fit.

    **Arguments:**

    - `system`: a system with initial guesses.
    - `motions`: trials, trajectories or `jaxkane.fit.inverse.kinematics.KinematicSamples`.
    - `free`: as in `fit`: names, `Free`, `Inertia(...)`. The equations must be linear in parameters that do not belong
        to a body, such as those of dampers, springs and dry friction.
    - `sigma`: by speed, the standard deviation of the residual of its equation. By default estimated.
    - `spacing`: distance [s] of the knots of the splines from which the accelerations are computed. By default several
        are tried, starting with the largest that `sigma` of the trials permits. The one with the smallest relative
        residual of the equations is used.

    **Returns:** a `FirstEstimate`. Print it for a table.

    **Raises:** `ValueError` in the cases of `fit` and `regressor`, for gains and delays, and for parameters that change
    lengths or positions, because the equations are not linear in these.
    """
    parameters = parameters_of(system, free)
    spec = _regressor_spec(system, parameters)
    states = states_for(spec)
    Y, _, _ = equations_at(spec, states)
    for i, name in enumerate(parameters.names):
        x = 0.3 * jnp.eye(len(parameters.names), dtype=parameters.start.dtype)[i]
        after, _, _ = equations_at(spec.of(parameters.apply(system, x)[0]), states)
        if after.shape != Y.shape or np.abs(after - Y).max() > 1e-6 * np.abs(Y).max():
            raise ValueError(
                f"{type(system).__name__}: the equations of motion are not linear in {name}, which changes lengths, "
                "positions or inputs. Omit it here, and free it in the fit."
            )
    check_linear(spec, np.zeros((), jnp.result_type(float)), None)
    base, spacing = _best_estimate(spec, motions, sigma, spacing)
    x, feasible, distance = _projection(spec, parameters, base)
    result, values = parameters.apply(system, x)[0], np.asarray(parameters.values(x))
    try:
        check_bodies(result, jnp.zeros(()), jnp.full(len(result.coordinates), 0.3))
        infeasibility = ""
    except ValueError as error:
        infeasibility = f"{error} Free the body's numbers together, as Inertia(...): see Inertia.of."
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
    """The regressor whose columns are the body parameters that the free parameters affect, and the free parameters that
    affect no body.
    """
    roles = [entry.name for entry in parameters.entries if entry.roles]
    if roles:
        raise ValueError(
            f"first_estimate: the equations of motion are not linear in {', '.join(roles)}. Omit it here, and free "
            "it in the fit."
        )
    every = RegressorSpec(regressor_model(system, None), (), (), ())
    # At the start and nearby: the derivative of the inertia about a joint is zero if the mass centre is at the joint.
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
    # Entries that affect no body have columns of their own.
    own = [entry for entry, of_body in zip(parameters.entries, np.any(moved, axis=0), strict=True) if not of_body]
    places, names, units = [], [], []
    for entry in own:
        for i, (leaf, place, _) in enumerate(entry.targets):
            places.append((leaf, place))
            names.append(entry.name if i == 0 else f"{entry.name}, tied {i}")
            units.append(entry.unit)
    return RegressorSpec(regressor_model(system, bodies), tuple(places), tuple(names), tuple(units))


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
        # Knots are at least two samples apart. Below one sample, every interval would be treated as a gap in the data.
        finest = 2 * max(float(np.median(np.diff(t.t))) for t in trials)
        spacings = [spacings[0], *(x for x in spacings[1:] if x >= finest)]
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
    """Unconstrained parameters (p,) whose base parameters are nearest to the estimates, these base parameters (b,), and
    their distance.
    """
    eigenvalues, V = np.linalg.eigh(base.information)
    root = np.sqrt(np.maximum(eigenvalues, 0.0))[:, None] * V.T
    if base.fixed is not None:
        # Give the fixed base parameter ten times the weight of the best determined direction.
        row = np.zeros(len(base.places))
        row[base.fixed] = 10.0 * np.sqrt(max(eigenvalues.max(initial=0.0), 1e-300))
        root = np.vstack([root, row])

    @functools.lru_cache(1)  # `least_squares` calls `residuals` and `slopes` at the same x
    def evaluate(x: bytes) -> Any:
        at = jnp.asarray(np.frombuffer(x), parameters.start.dtype)
        return jax.device_get(_values_with_slopes(spec, parameters, at))

    def residuals(x: np.ndarray) -> np.ndarray:
        values, priors = evaluate(x.tobytes())[0]
        return np.concatenate([root @ (base.of(values) - base.estimates), _PULL * x, priors])

    def slopes(x: np.ndarray) -> np.ndarray:
        values, priors = evaluate(x.tobytes())[1]
        return np.vstack([root @ base.matrix @ values, _PULL * np.eye(len(x)), priors])

    jac: Any = slopes
    x = least_squares(residuals, np.zeros(len(parameters.names)), jac, method="trf", x_scale=1.0, max_nfev=200).x
    distance = float(np.linalg.norm(residuals(x)[: len(root)]))
    return jnp.asarray(x, parameters.start.dtype), base.of(evaluate(x.tobytes())[0][0]), distance


@jit
def _values_with_slopes(spec: RegressorSpec, parameters: Parameters, x: Float[Array, " p"]):
    """The values of the columns and the residuals of the priors, and their derivatives with respect to the
    unconstrained parameters.
    """

    def values(x: Float[Array, " p"]):
        system = parameters.apply(spec.system, x)[0]
        columns = spec.of(system).values(jnp.zeros(()), jnp.full(len(system.coordinates), 0.3))
        return columns, parameters.prior_residuals(x)

    return values(x), jax.jacfwd(values)(x)
