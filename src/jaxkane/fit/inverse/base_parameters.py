"""Base parameters: the combinations of parameters that trajectories determine, and their estimates by linear least
squares of the equation error.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from ..._common.lookup import positive_number, refuse_if, refuse_unknown
from ..._kane.consistent_state import assemble
from ..._kane.constraint_residuals import has_configuration_constraints
from ..._kane.regressor import Bodies
from ..._scalarjit.cache_key import jit
from ..._system.parameters import leaf_name
from ..._system.system import System
from ..result.data import text_table
from ..result.identifiability import combination
from ..result.statistics import Clusters, infinite_along, jackknife
from .kinematics import KinematicSamples, Motions, kinematic_samples
from .regressor import Names, Regressor, RegressorSpec, check_linear, input_names, regressor_spec


@dataclasses.dataclass(frozen=True)
class BaseParameters:
    """The combinations of p parameters that trajectories determine: b base parameters. Print it for a table.

    - `names`, `units`, `values` (p): the parameters, with the values of the system.
    - `matrix` (b, p): base parameters = matrix @ parameters.
    - `places` (b): index of the leading parameter of each base parameter. It is in no other base parameter.
    - `texts` (b), `base_units` (b): each base parameter as text, and its unit.
    - `without_influence`: names of the parameters that are in no equation.
    - `ratios_only`: whether only ratios are determined, because no force acts that is independent of the parameters, as
        in a free swing. The equations then allow multiplying all base parameters by a common factor.

    The following fields require data. Without data, the arrays are NaN:

    - `estimates` (b): by weighted least squares. If only ratios are determined, the base parameter `fixed` has the
        value of the system.
    - `deviations` (b), `covariance` (b, b): standard deviations and covariance of the estimates. They are robust to
        residuals that are correlated within blocks of a fortieth of the data.
    - `information` (b, b): W^T W of the weighted equations W b = tau, before a base parameter is fixed.
    - `undetermined`: combinations that these data do not determine, as text. They keep the values of the system.
    - `fixed`: index of the base parameter that is fixed, or None.
    - `noise`: by speed, the root mean square of the residual of its equation.
    - `unexplained`: norm of the residuals, relative to the norm of the terms of the equations.
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
    fixed: int | None
    noise: Mapping[str, float]
    unexplained: float

    @property
    def count(self) -> int:
        """The number of base parameters or combinations that are determined."""
        return len(self.places) - self.ratios_only - len(self.undetermined)

    @property
    def base_units(self) -> tuple[str, ...]:
        return tuple(self.units[i] for i in self.places)

    def of(self, values: ArrayLike) -> np.ndarray:
        """Base parameters (b,) of parameters (p,)."""
        return self.matrix @ np.asarray(values)

    def __repr__(self) -> str:
        b, p = len(self.places), len(self.names)
        only = ". Only their ratios can be determined, because no known force acts" if self.ratios_only else ""
        estimated = bool(np.isfinite(self.estimates).any())
        errors = ["(fixed)" if i == self.fixed else f"+- {error:.2g}" for i, error in enumerate(self.deviations)]
        columns = [self.texts, [f"{x:.5g}" for x in self.of(self.values)], self.base_units]
        columns += [[f"{x:.5g}" for x in self.estimates], errors] if estimated else []
        lines = [f"{b} base parameters of {p} parameters{only}. Rank{' of these data' * estimated}: {self.count}"]
        lines += [text_table([*zip(*columns, strict=True)], left=(0, 2, 4))] if b else []
        if self.without_influence:
            lines.append(f"without influence: {', '.join(self.without_influence)}")
        lines += [f"not determined by these data: {text}" for text in self.undetermined]
        if estimated:
            lines.append(f"unexplained: {100 * self.unexplained:.3g} % of the equations' size")
        return "\n".join(lines)


def base_parameters(
    system: System | Regressor,
    motions: Motions | None = None,
    *,
    bodies: Bodies = None,
    parameters: Names = (),
    sigma: Mapping[str, float] | None = None,
    spacing: float | None = None,
    flat: float = 0.5,
) -> BaseParameters:
    """Find the combinations of mass, first moment, inertia and other parameters that are determined. With data,
    estimate their values.

        print(base_parameters(arm, parameters=("friction",)))     # determined by any trajectory
        print(base_parameters(arm, trials))                       # determined by these trials, with estimates

    **Arguments:**

    - `system`: a system, or a `Regressor` of many instants (by `jax.vmap`). Do not pass `motions`,
        `bodies` or `parameters` with a `Regressor`.
    - `motions`: measured or simulated trajectories, as in `jaxkane.fit.inverse.kinematics.kinematic_samples`. None for
        the combinations that any trajectory determines.
    - `bodies`, `parameters`: as in `regressor`.
    - `sigma`: by speed, the standard deviation of the residual of its equation [N m, N]. By default estimated.
    - `spacing`: distance of the knots of the splines [s], as in `kinematic_samples`.
    - `flat`: a combination is undetermined if its relative standard deviation exceeds this value.

    **Returns:** a `BaseParameters`. The accelerations are second derivatives of noisy measurements, so estimates are
    biased towards zero unless the noise is small. Use them as initial guesses of a fit.

    **Raises:** `ValueError` in the cases of `regressor`, and for trajectories without accelerations.
    """
    if not isinstance(system, Regressor):
        spec = regressor_spec(system, bodies, parameters)
        check_linear(spec, np.zeros((), jnp.result_type(float)), None)
        structure = base_structure(spec)
        if motions is None:
            return structure
        samples = kinematic_samples(system, motions, spacing=spacing)
        return estimated(structure, system.speeds, *equations_at(spec, samples), sigma, flat)
    n, p = system.matrix.shape[-2:]
    if system.matrix.ndim < 3:
        raise ValueError(
            "base_parameters: the Regressor contains one instant only. Compute it at many instants: jax.vmap(lambda "
            "t, q, u, u_dot: regressor(system, t, q, u, u_dot))(...)."
        )
    Y, tau = np.asarray(system.matrix).reshape(-1, n, p), np.asarray(system.forces).reshape(-1, n)
    finite = _finite(Y, tau)
    Y, tau, values = Y[finite], tau[finite], np.asarray(system.values).reshape(-1, p)[0]
    structure = _structure(system.names, system.units, values, Y, tau)
    return estimated(structure, system.speeds, Y, tau, np.zeros(len(Y), int), sigma, flat)


# ---- the equations at samples of trajectories


def equations_at(spec: RegressorSpec, samples: KinematicSamples) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Y (N, n, p), tau (N, n) and the trials (N,) of all samples at which the equations are finite."""
    dtype, n = jnp.result_type(float), len(samples)
    # Pad to a power of two with copies of the last sample, so that only a few sizes are compiled.
    rows = np.minimum(np.arange(1 << (n - 1).bit_length()), n - 1)
    t, q, u, u_dot = (jnp.asarray(x[rows], dtype) for x in (samples.t, samples.q, samples.u, samples.u_dot))
    inputs = {name: jnp.asarray(x[rows], dtype) for name, x in samples.inputs.items()}
    Y, tau = (x[:n] for x in jax.device_get(_equations(spec, t, q, u, inputs, u_dot)))
    finite = _finite(Y, tau)
    if not finite.any():
        raise ValueError(
            f"{type(spec.system).__name__}: the equations of motion are not finite at any of the {n} instants. Check "
            "whether the constraints are singular there, and whether all given numbers are finite."
        )
    return Y[finite], tau[finite], samples.trial[finite]


@jit
def _equations(
    spec: RegressorSpec,
    t: Float[Array, " N"],
    q: Float[Array, "N n_q"],
    u: Float[Array, "N n_u"],
    inputs: Mapping[str, Array],
    u_dot: Float[Array, "N n_u"],
):
    rows, _ = jax.vmap(spec.at)(t, q, u, inputs, u_dot)
    return rows.matrix, rows.forces


def _finite(Y: np.ndarray, tau: np.ndarray) -> np.ndarray:
    return np.all(np.isfinite(Y), axis=(1, 2)) & np.all(np.isfinite(tau), axis=1)


def random_states(system: System, n: int) -> KinematicSamples:
    """Random states that satisfy the configuration constraints."""
    rng, dtype = np.random.default_rng(0), jnp.result_type(float)
    n_q, n_u = len(system.coordinates), len(system.speeds)
    t = rng.uniform(0.0, 1.0, n)
    q = rng.uniform(-2.5, 2.5, (n, n_q))
    if has_configuration_constraints(system, jnp.zeros((), dtype), jnp.zeros(n_q, dtype)):
        t = rng.uniform(0.0, 1.0, 12 * n)
        # Half of the coordinates are uniform. The other half have magnitudes from 0.05 to 2.5, because a closed loop is
        # often drawn near zero.
        sizes = np.concatenate([np.full(6 * n, np.pi), np.geomspace(0.05, 2.5, 6 * n)])
        q = sizes[:, None] * rng.uniform(-1.0, 1.0, (12 * n, n_q))
        q = np.array(_assembled(system, jnp.asarray(t, dtype), jnp.asarray(q, dtype)))
        finite = np.flatnonzero(np.all(np.isfinite(q), axis=1))
        if len(finite) < n:
            raise ValueError(
                f"{type(system).__name__}: only {len(finite)} of {len(q)} random configurations satisfy the "
                f"constraints, and {n} are needed. Pass a Regressor at states of your own, computed with jax.vmap."
            )
        finite = finite[np.linspace(0, len(finite) - 1, n).astype(int)]
        t, q = t[finite], q[finite]
    inputs = {name: rng.normal(0.0, 3.0, n) for name in input_names(system)}
    return KinematicSamples(t, q, rng.normal(0.0, 3.0, (n, n_u)), rng.normal(0.0, 10.0, (n, n_u)), inputs)


@jit
def _assembled(system: System, t: Float[Array, " N"], q: Float[Array, "N n_q"]):
    return jax.vmap(lambda t, q: assemble(system, q, t=t).q)(t, q)


def states_for(spec: RegressorSpec) -> KinematicSamples:
    """Random states that give about three times as many equations as there are parameters.

    The speeds are scaled if the unit of time differs by a factor of thousands from the time scale of the system.
    Otherwise the columns of gravity would be negligible, or all other columns.
    """
    refuse_if(not spec.system.speeds, f"{type(spec.system).__name__} has no speeds, so it has no equations of motion.")
    states = random_states(spec.system, 10 + 3 * -(-len(spec.names) // len(spec.system.speeds)))
    values = np.asarray(spec.values(jnp.asarray(states.t[0]), jnp.asarray(states.q[0])))
    still, no_input = np.zeros_like(states.u), {name: 0.0 * x for name, x in states.inputs.items()}

    def force(u_dot: np.ndarray) -> np.ndarray:
        Y, tau, _ = equations_at(spec, KinematicSamples(states.t, states.q, still, u_dot, no_input))
        return Y @ values - tau

    at_rest, accelerated = force(still), force(states.u_dot)
    squares = [np.sum(x**2) for x in (at_rest, accelerated - at_rest)] if at_rest.shape == accelerated.shape else [0, 0]
    if not all(squares):
        return states
    time = 1e3 ** round(np.log10(squares[1] / squares[0]) / 12)
    return dataclasses.replace(states, u=states.u / time, u_dot=states.u_dot / time**2)


# ---- which combinations are determined


# Order of a body's parameters. If columns are linearly dependent, the earliest parameter leads the combination.
_ORDER = ("Ixx", "Ixy", "Ixz", "Iyz", "Izz", "mx", "my", "mz", "Iacross", "Iyy", "m")


def base_structure(spec: RegressorSpec) -> BaseParameters:
    """The base parameters from the regressor at random states, without data."""
    states = states_for(spec)
    t, q = jnp.asarray(states.t[0]), jnp.asarray(states.q[0])
    Y, tau, _ = equations_at(spec, states)
    structure = _structure(spec.names, spec.units, np.asarray(spec.values(t, q)), Y, tau)
    if has_configuration_constraints(spec.system, jnp.zeros((), jnp.result_type(float)), q):
        return structure
    return dataclasses.replace(structure, texts=_texts_with_lengths(structure, spec, states))


def _structure(
    names: Sequence[str], units: Sequence[str], values: np.ndarray, Y: np.ndarray, tau: np.ndarray
) -> BaseParameters:
    W = Y.reshape(-1, len(names)).astype(float)
    eps = float(np.finfo(Y.dtype).eps)
    norms = np.linalg.norm(W, axis=0)
    # A column matters by its norm or by its force (norm times value). The norms alone depend on the units of time,
    # length and mass.
    forces = norms * np.abs(values)
    sensitive = (norms > eps**0.75 * norms.max(initial=0.0)) | (forces > eps**0.75 * forces.max(initial=0.0))
    parts = [name.rpartition(".")[::2] for name in names]
    bodies = [body for body, _ in parts]
    # Bodies in their order, and their parameters in that of `_ORDER`. All other parameters come last.
    ranks = [
        (bodies.index(body), _ORDER.index(last)) if last in _ORDER else (len(names), i)
        for i, (body, last) in enumerate(parts)
    ]
    places: list[int] = []
    for i in sorted(np.flatnonzero(sensitive).tolist(), key=ranks.__getitem__):
        known, column = W[:, places] / norms[places], W[:, i] / norms[i]
        rest = column - known @ np.linalg.lstsq(known, column, rcond=None)[0]
        if np.linalg.norm(rest) > eps**0.5:  # linearly independent of the previous columns
            places.append(i)
    B, b = np.zeros((len(places), len(names))), len(places)
    if places:
        rest = [i for i in np.flatnonzero(sensitive).tolist() if i not in places]
        beta = np.linalg.lstsq(W[:, places] / norms[places], W[:, rest] / norms[rest], rcond=None)[0]
        beta = np.where(np.abs(beta) > eps**0.5, beta, 0.0)
        B[:, rest] = beta * norms[rest] / norms[places][:, None]
        B[np.arange(b), places] = 1.0
    size = np.abs(W) @ np.abs(values) if len(W) else np.zeros(1)
    return BaseParameters(
        names=tuple(names),
        units=tuple(units),
        values=values,
        places=tuple(places),
        matrix=B,
        texts=tuple(_text(names, B[j], place, [f"{abs(x):.4g}" for x in B[j]]) for j, place in enumerate(places)),
        without_influence=tuple(names[i] for i in np.flatnonzero(~sensitive).tolist()),
        ratios_only=bool(np.linalg.norm(tau) <= 1e3 * eps * np.linalg.norm(size)) and bool(places),
        estimates=np.full(b, np.nan),
        deviations=np.full(b, np.nan),
        covariance=np.full((b, b), np.nan),
        information=np.full((b, b), np.nan),
        undetermined=(),
        fixed=None,
        noise={},
        unexplained=float("nan"),
    )


def _text(names: Sequence[str], row: np.ndarray, place: int, factors: Sequence[str]) -> str:
    """A base parameter as text, such as `link1.Izz + 0.04 link2.m`."""
    words = [names[place]]
    for i in np.flatnonzero(row).tolist():
        if i != place:
            factor = "" if factors[i] == "1" else f"{factors[i]} "
            words.append(f"{'-' if row[i] < 0 else '+'} {factor}{names[i]}")
    return " ".join(words)


def _texts_with_lengths(structure: BaseParameters, spec: RegressorSpec, states: KinematicSamples) -> tuple[str, ...]:
    """The texts, with factors that are products of powers of system parameters written as these, such as `length^2`."""
    places, matrix = structure.places, structure.matrix
    rest = [i for i in range(len(structure.names)) if i not in places and np.any(matrix[:, i])]
    if not rest:
        return structure.texts
    B = matrix[:, rest]
    # By name of a parameter, its value and its power in each factor, from a change of the parameter by 10 %.
    powers: dict[str, tuple[float, np.ndarray]] = {}
    with_path, tree = jax.tree_util.tree_flatten_with_path(spec.system)
    leaves = [leaf for _, leaf in with_path]
    for k, (path, leaf) in enumerate(with_path):
        if np.ndim(leaf) or not jnp.issubdtype(leaf.dtype, jnp.floating) or not float(leaf):
            continue
        changed = jax.tree.unflatten(tree, [*leaves[:k], leaf * 1.1, *leaves[k + 1 :]])
        W = equations_at(spec.of(changed), states)[0].reshape(-1, len(structure.names))
        changed_B = np.linalg.lstsq(W[:, places], W[:, rest], rcond=None)[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            power = np.where(B != 0.0, np.log(changed_B / B) / np.log(1.1), 0.0)
        if not np.all(np.abs(power) <= 1e-5):
            powers[leaf_name(path)] = abs(float(leaf)), power

    def factor(j: int, c: int) -> str:
        """A factor such as `2 L1^2 L2`. A number if a power is not an integer or the number in front is not simple."""
        each = {name: (value, power[j, c]) for name, (value, power) in powers.items()}
        if all(np.isfinite(power) and abs(power - np.rint(power)) <= 1e-4 for _, power in each.values()):
            size = abs(B[j, c]) / np.prod([value ** np.rint(power) for value, power in each.values()])
            simple = [f"{x:g}" * (x != 1) for x in (1.0, 2.0, 0.5, 0.25, 4.0) if abs(size - x) < 1e-6 * x]
            words = [name if round(n) == 1 else f"{name}^{round(n)}" for name, (_, n) in each.items() if round(n)]
            if words and simple:
                return " ".join([*filter(None, simple), *words])
        return f"{abs(B[j, c]):.4g}"

    texts = []
    for j, place in enumerate(places):
        factors = [f"{abs(x):.4g}" for x in matrix[j]]
        for c in np.flatnonzero(B[j]).tolist():
            factors[rest[c]] = factor(j, c)
        texts.append(_text(structure.names, matrix[j], place, factors))
    return tuple(texts)


# ---- estimates by least squares of the equation error


_BLOCKS = 40  # number of blocks of data whose residuals are assumed to be independent
_EXACT = 1e-6  # smallest standard deviation of an equation, relative to its size
_ROUNDING = 1e-10  # singular values below this are zero, relative to the largest one


def estimated(
    structure: BaseParameters,
    speeds: Sequence[str],
    Y: np.ndarray,
    tau: np.ndarray,
    trial: np.ndarray,
    sigma: Mapping[str, float] | None,
    flat: float,
) -> BaseParameters:
    """The base parameters with estimates from the equations at N instants: Y (N, n, p), tau (N, n), the trials (N,).

    The unknowns z are scaled deviations from the base parameters b0 of the system: b = b0 + scale z, A z = rest.
    """
    W: Any = Y[:, :, list(structure.places)].astype(float)  # (N,n,b)
    b0, b = structure.of(structure.values), W.shape[2]
    size = np.sqrt(np.mean((np.abs(W) @ np.abs(b0)) ** 2, axis=0)) + np.abs(tau).max(axis=0)  # (n,)
    if not size.any():
        raise ValueError(
            "All terms of the equations of motion are zero at these instants: nothing moves, and no load acts. Pass "
            "other data."
        )
    # A value of zero gives no scale. Use the value at which the term has a typical force.
    force = np.sqrt(np.mean(W**2, axis=(0, 1)))
    typical = np.max(force * np.abs(b0), initial=0.0) or 1.0
    scale = np.where(b0 != 0, np.abs(b0), np.where(force > 0, typical / np.where(force > 0, force, 1.0), 1.0))
    nothing_acts = np.linalg.norm(tau) <= 1e3 * np.finfo(Y.dtype).eps * np.linalg.norm(size) * len(tau) ** 0.5
    fixed = int(np.argmax(force * np.abs(b0))) if nothing_acts and b else None
    free = [j for j in range(b) if j != fixed]
    A, rest = W[:, :, free] * scale[free], tau.astype(float) - W @ b0  # (N,n,m) (N,n)

    deviation: Any = np.ones(len(speeds))
    if sigma is not None:
        refuse_unknown(sigma, speeds, "`sigma` contains unknown speeds:", "the independent speeds are")
        deviation = np.array([positive_number(sigma.get(name), f"`sigma` of {name}") for name in speeds])
    s, V, z = _least_squares(A / deviation[:, None], rest / deviation)
    degrees_of_freedom = rest.size - int(np.sum(s > 0))
    if not sigma and degrees_of_freedom <= 0:
        raise ValueError(
            f"{rest.size} equations of motion at {len(rest)} instants determine {rest.size - degrees_of_freedom} "
            "numbers, so nothing remains to estimate the errors. Pass more instants, or `sigma`."
        )
    for _ in range(0 if sigma else 4):  # weight each equation by its residual
        remains = np.sqrt(np.mean((rest - A @ z) ** 2, axis=0) * rest.size / degrees_of_freedom)
        deviation = np.maximum(remains, _EXACT * np.where(size > 0, size, size.max()))
        s, V, z = _least_squares(A / deviation[:, None], rest / deviation)
    along = _covariance(A / deviation[:, None] @ V.T, (rest - A @ z) / deviation, s, trial, bool(sigma))
    known = np.diag(along) <= flat**2
    z = V[known].T @ (V[known] @ z)  # keep the system's values of undetermined directions
    finite = np.isfinite(np.diag(along))
    spread = infinite_along(V[finite].T @ along[np.ix_(finite, finite)] @ V[finite], V[~finite])
    moved, covariance = np.zeros(b), np.zeros((b, b))
    moved[free] = z * scale[free]
    covariance[np.ix_(free, free)] = spread * np.outer(scale[free], scale[free])
    residuals, terms = rest - A @ z, W * (b0 + moved)
    texts = [f"({structure.texts[j]})" for j in free]
    return dataclasses.replace(
        structure,
        ratios_only=fixed is not None,
        estimates=b0 + moved,
        deviations=np.sqrt(np.diag(covariance)),
        covariance=covariance,
        information=np.einsum("inb,inc,n->bc", W, W, deviation**-2.0, optimize=True),
        undetermined=tuple(combination(texts, row * np.sign(row[np.abs(row).argmax()])) for row in V[~known]),
        fixed=fixed,
        noise=dict(zip(speeds, np.sqrt(np.mean(residuals**2, axis=0)).tolist(), strict=True)),
        unexplained=float(np.linalg.norm(residuals / deviation) / np.linalg.norm(terms / deviation[:, None])),
    )


def _least_squares(A: np.ndarray, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Singular values (m,), zero if they are rounding errors, a row (m, m) for each, and the solution z (m,)."""
    m = A.shape[2]
    U, s, V = np.linalg.svd(np.vstack([A.reshape(-1, m), np.zeros((m, m))]), full_matrices=False)
    known = s > _ROUNDING * s.max(initial=0.0)
    z = V[known].T @ ((U[: rest.size].T @ rest.ravel())[known] / s[known])
    return np.where(known, s, 0.0), V, z


def _covariance(
    A: np.ndarray, residuals: np.ndarray, s: np.ndarray, trial: np.ndarray, sigma_known: bool
) -> np.ndarray:
    """Covariance along the singular directions (m, m). Infinite for undetermined directions.

    It is formal if the standard deviations are given or there are few samples. Otherwise it is robust to correlation
    within blocks, which are equal parts of the trials.
    """
    length, block, first = max(len(trial) // _BLOCKS, 1), np.zeros(len(trial), int), 0
    for one in np.unique(trial):
        rows = np.flatnonzero(trial == one)
        block[rows] = first + np.arange(len(rows)) // length
        first = block[rows].max() + 1
    known, k = s > 0, int(np.sum(s > 0))
    covariance = np.diag(np.where(known, 0.0, np.inf))
    if sigma_known or len(trial) < 5 * _BLOCKS or first == 1:
        covariance[known, known] = s[known] ** -2.0
        return covariance
    parts = [A[block == g][:, :, known].reshape(-1, k) for g in range(first)]
    information = np.array([part.T @ part for part in parts])
    scores = np.array([part.T @ residuals[block == g].ravel() for g, part in enumerate(parts)])
    places = np.tile(np.arange(k), (first, 1))
    clusters = Clusters(information, scores, places, np.zeros((k, k)))
    covariance[np.ix_(known, known)] = jackknife(clusters).covariance
    return covariance
