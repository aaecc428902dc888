"""Base parameters: the sums of parameters that motions determine, and their values by least squares."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import qr

from .._common.lookup import refuse_unknown
from .._kane.assembly import assemble
from .._kane.constraints import has_configuration_constraints
from .._kane.regressor import Bodies
from .._scalarjit.cache_key import jit
from .._system.parameters import leaf_name
from .._system.system import System
from ._identifiability import combination
from ._kinematics import KinematicSamples, Motions, kinematic_samples
from ._regressor import Chosen, Names, Regressor, check_linear, chosen_of, values_by_name


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


_ORDER = ("Ixx", "Ixy", "Ixz", "Iyz", "Izz", "mx", "my", "mz", "Iacross", "Iyy", "m")
"""Of a body's parameters: what comes late is counted among what comes early, where it can be."""


def equations_at(chosen: Chosen, at: KinematicSamples) -> tuple[tuple[str, ...], np.ndarray, np.ndarray, np.ndarray]:
    """The names of the speeds, and Y (N, n, p), tau (N, n) and the trials (N,) of all instants at which they exist."""
    dtype = jnp.result_type(float)
    # Padded to a power of two with the last instant, so that few different sizes are compiled.
    n = len(at)
    places = np.minimum(np.arange(1 << (n - 1).bit_length()), n - 1)
    row = [jnp.asarray(x[places], dtype) for x in (at.t, at.q, at.u, at.u_dot)]
    inputs = {name: jnp.asarray(x[places], dtype) for name, x in at.inputs.items()}
    Y, tau = (x[:n] for x in jax.device_get(_at_all(chosen, *row[:3], inputs, row[3])))
    fine = np.all(np.isfinite(Y), axis=(1, 2)) & np.all(np.isfinite(tau), axis=1)
    if not fine.any():
        raise ValueError(
            f"{type(chosen.system).__name__}: the equations of motion exist at none of the {len(at)} instants: are the "
            "constraints singular there, or numbers not finite?"
        )
    return chosen.system.speeds, Y[fine], tau[fine], at.trial[fine]


@jit
def _at_all(chosen, t, q, u, inputs, u_dot):
    found = jax.vmap(chosen.at)(t, q, u, inputs, u_dot)
    return found.matrix, found.forces


def random_states(system: System, n: int) -> KinematicSamples:
    """States that the constraints admit, near and far."""
    rng, dtype = np.random.default_rng(0), jnp.result_type(float)
    n_q, n_u = len(system.coordinates), len(system.speeds)
    t = rng.uniform(0.0, 1.0, n)
    q = rng.uniform(-2.5, 2.5, (n, n_q))
    if has_configuration_constraints(system, jnp.zeros((), dtype), jnp.zeros(n_q, dtype)):
        t = rng.uniform(0.0, 1.0, 12 * n)
        # Half of them anywhere; half at all distances from zero, where a closed loop is often drawn.
        sizes = np.concatenate([np.full(6 * n, np.pi), np.geomspace(0.05, 2.5, 6 * n)])
        q = sizes[:, None] * rng.uniform(-1.0, 1.0, (12 * n, n_q))
        q = np.array(_assembled(system, jnp.asarray(t, dtype), jnp.asarray(q, dtype)))
        fine = np.flatnonzero(np.all(np.isfinite(q), axis=1))
        if len(fine) < n:
            raise ValueError(
                f"{type(system).__name__}: {len(fine)} of {len(q)} random coordinates could be assembled, and {n} are "
                "needed to find what motions determine: give a Regressor of states of your own, by jax.vmap."
            )
        fine = fine[np.linspace(0, len(fine) - 1, n).astype(int)]
        t, q = t[fine], q[fine]
    inputs = {name: rng.normal(0.0, 3.0, n) for name in values_by_name(system)}
    return KinematicSamples(t, q, rng.normal(0.0, 3.0, (n, n_u)), rng.normal(0.0, 10.0, (n, n_u)), inputs)


@jit
def _assembled(system, t, q):
    return jax.vmap(lambda t, q: assemble(system, q, t=t).q)(t, q)


def structure_of(
    names: Sequence[str], units: Sequence[str], values: np.ndarray, Y: np.ndarray, tau: np.ndarray
) -> BaseParameters:
    W = Y.reshape(-1, len(names)).astype(float)
    eps = float(np.finfo(Y.dtype).eps)
    norms = np.linalg.norm(W, axis=0)
    seen = norms > eps**0.75 * norms.max(initial=0.0)
    order = sorted((int(i) for i in np.flatnonzero(seen)), key=lambda i: _rank(names, i))
    places = _independent(W / np.where(seen, norms, 1.0), order, eps**0.5)
    B = np.zeros((len(places), len(names)))
    if places:
        others = [i for i in order if i not in places]
        beta = np.linalg.lstsq(W[:, places] / norms[places], W[:, others] / norms[others], rcond=None)[0]
        beta = np.where(np.abs(beta) > eps**0.5, beta, 0.0)
        B[:, others] = beta * norms[others] / norms[places][:, None]
        B[np.arange(len(places)), places] = 1.0
    size = np.abs(W) @ np.abs(values) if len(W) else np.zeros(1)
    free = bool(np.linalg.norm(tau) <= 1e3 * eps * np.linalg.norm(size)) and bool(places)
    b = len(places)
    texts = tuple(sum_in_words(names, B[j], place, [f"{abs(x):.4g}" for x in B[j]]) for j, place in enumerate(places))
    nothing = np.full(b, np.nan)
    return BaseParameters(
        tuple(names), tuple(units), values, tuple(int(i) for i in places), B, texts,
        tuple(names[i] for i in np.flatnonzero(~seen).tolist()), free, nothing, nothing, np.full((b, b), np.nan),
        np.full((b, b), np.nan), (), None, {},
        float("nan"),
    )  # fmt: skip


def _rank(names: Sequence[str], i: int) -> tuple[int, int]:
    """Bodies in their order, their parameters as in `_ORDER`; all others at the end."""
    bodies = list(dict.fromkeys(name.rpartition(".")[0] for name in names))
    body, _, last = names[i].rpartition(".")
    return (bodies.index(body), _ORDER.index(last)) if last in _ORDER else (len(names), i)


def _independent(W: np.ndarray, order: Sequence[int], tolerance: float) -> list[int]:
    """Places of the columns that are no sums of those before them in this order; by QR with pivoting where rounding
    makes the order a bad one."""
    Q = np.zeros((len(W), 0))
    places = []
    for i in order:
        rest = W[:, i]
        for _ in range(2):  # Gram and Schmidt, twice is enough
            rest = rest - Q @ (Q.T @ rest)
        size = np.linalg.norm(rest)
        if size > tolerance:
            Q = np.column_stack([Q, rest / size])
            places.append(i)
    chosen = W[:, list(order)]
    s = np.linalg.svd(chosen, compute_uv=False) if len(order) else np.zeros(0)
    rank = int(np.sum(s > tolerance * s[:1].max(initial=0.0)))
    if rank != len(places):
        found: Any = qr(chosen, mode="r", pivoting=True)
        pivots = found[1]
        places = sorted((order[i] for i in pivots[:rank]), key=list(order).index)
    return places


def with_lengths(found: BaseParameters, chosen: Chosen, states: KinematicSamples) -> tuple[str, ...]:
    """The texts, with factors that are products of powers of the system's parameters written as these: `length^2`."""
    others = [i for i in range(len(found.names)) if i not in found.places and np.any(found.matrix[:, i])]
    if not others:
        return found.texts
    B = found.matrix[:, others]
    numbered = B != 0.0
    numbers: list[tuple[str, float, np.ndarray]] = []
    with_path, structure = jax.tree_util.tree_flatten_with_path(chosen.system)
    leaves = [leaf for _, leaf in with_path]
    for k, (path, leaf) in enumerate(with_path):
        if np.ndim(leaf) or not jnp.issubdtype(leaf.dtype, jnp.floating) or not float(leaf):
            continue
        other = [*leaves[:k], leaf * 1.1, *leaves[k + 1 :]]
        _, Y, _, _ = equations_at(chosen.of(jax.tree.unflatten(structure, other)), states)
        W = Y.reshape(-1, len(found.names))
        now = np.linalg.lstsq(W[:, found.places], W[:, others], rcond=None)[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            powers = np.where(numbered, np.log(now / B) / np.log(1.1), 0.0)
        if np.any(np.abs(powers) > 1e-5) or not np.all(np.isfinite(powers)):
            numbers.append((leaf_name(path), float(leaf), powers))
    texts = []
    for j, place in enumerate(found.places):
        sizes = [f"{abs(x):.4g}" for x in found.matrix[j]]
        for c, i in enumerate(others):
            if numbered[j, c]:
                of_this = [(name, value, powers[j, c]) for name, value, powers in numbers]
                sizes[i] = _product(abs(B[j, c]), of_this) or sizes[i]
        texts.append(sum_in_words(found.names, found.matrix[j], place, sizes))
    return tuple(texts)


def _product(size: float, powers: Sequence[tuple[str, float, float]]) -> str:
    """`2 L1^2 L2`; nothing where a power is not whole, or the number before it is none of a few."""
    words = []
    for name, value, power in powers:
        whole = round(power) if np.isfinite(power) else 0
        if not np.isfinite(power) or abs(power - whole) > 1e-4:
            return ""
        if whole:
            words.append(name if whole == 1 else f"{name}^{whole}")
            size /= abs(value) ** whole
    near = [number for number in (1.0, 2.0, 0.5, 0.25, 4.0) if abs(size - number) < 1e-6 * number]
    if not words or not near:
        return ""
    return " ".join([f"{near[0]:g}"] * (near[0] != 1.0) + words)


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
    """Which sums of mass, first moment, inertia and other parameters are determined, and with data their values.

        print(base_parameters(arm, parameters=("friction",)))     # by any motion
        print(base_parameters(arm, trials))                       # by these, with values and deviations

    **Arguments:**

    - `system`; `bodies`, `parameters`: as of `regressor`. Or a `Regressor` of many instants (by `jax.vmap`) alone.
    - `motions`: none, for what any motion determines; or measured or simulated ones, as of `kinematic_samples`.
    - `sigma`: by speed, the standard deviation of what remains in its equation [N m, N]; by default estimated.
    - `spacing` [s]: of knots, as of `kinematic_samples`.
    - `flat`: a combination whose standard deviation exceeds this part of its size is called undetermined.

    **Returns:** `BaseParameters`. Estimates come from measured accelerations, second derivatives of noisy measurements:
    they are biased towards zero where the noise is not small, a guess to begin a fit from.

    **Raises:** `ValueError` as `regressor` and `kinematic_samples`.
    """
    if isinstance(system, Regressor):
        return _of_regressor(system, sigma, flat)
    chosen = chosen_of(system, bodies, parameters)
    dtype = jnp.result_type(float)
    check_linear(chosen, np.zeros((), dtype), None)
    structure = structure_of_states(chosen)
    if motions is None:
        return structure
    return estimated(structure, *equations_at(chosen, kinematic_samples(system, motions, spacing=spacing)), sigma, flat)


def _of_regressor(given: Regressor, sigma: Mapping[str, float] | None, flat: float) -> BaseParameters:
    n, p = given.matrix.shape[-2:]
    if given.matrix.ndim < 3:
        raise ValueError(
            "base_parameters of a Regressor needs those of many instants: jax.vmap(lambda t, q, u, u_dot: "
            "regressor(system, t, q, u, u_dot))(...), whose matrix has leading axes."
        )
    Y, tau = np.asarray(given.matrix).reshape(-1, n, p), np.asarray(given.forces).reshape(-1, n)
    values = np.asarray(given.values).reshape(-1, p)[0]
    fine = np.all(np.isfinite(Y), axis=(1, 2)) & np.all(np.isfinite(tau), axis=1)
    structure = structure_of(given.names, given.units, values, Y[fine], tau[fine])
    return estimated(structure, given.speeds, Y[fine], tau[fine], np.zeros(int(fine.sum()), int), sigma, flat)


def structure_of_states(chosen: Chosen) -> BaseParameters:
    """From the regressor at random states."""
    system, states = chosen.system, states_for(chosen)
    _, Y, tau, _ = equations_at(chosen, states)
    values = np.asarray(chosen.values(jnp.asarray(states.t[0]), jnp.asarray(states.q[0])))
    found = structure_of(chosen.names, chosen.units, values, Y, tau)
    if has_configuration_constraints(system, jnp.zeros((), jnp.result_type(float)), jnp.asarray(states.q[0])):
        return found
    return dataclasses.replace(found, texts=with_lengths(found, chosen, states))


def states_for(chosen: Chosen) -> KinematicSamples:
    """Random states, some three times as many as the numbers that they could determine."""
    return random_states(chosen.system, 10 + 3 * -(-len(chosen.names) // len(chosen.system.speeds)))
