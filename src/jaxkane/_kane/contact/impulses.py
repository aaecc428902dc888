"""Impacts: Kane's impulse equations at one configuration. Independent of events and integrators.

During an impact, forces are infinite and the configuration does not change. Kane's equations, integrated over the
impact, relate generalized impulses to the change of generalized momenta (Kane and Levinson, "Dynamics: Theory and
Applications", 1985, sections 3.6 and 4.12):

    M (u+ - u-) = C^T p,   c(u+) = -e c(u-),   C = dc/du

c(u) are the velocity residuals of the impact, p their impulses, e the coefficients of restitution. The dependent speeds
are eliminated, so all permanent constraints also hold after the impact. The change of the speeds has the smallest
kinetic energy of all changes that satisfy the second equation (Gauss's principle). With M = X^-T X^-1:

    u+ - u- = X w,   w = the smallest solution of (C X) w = c(u+) - c(u-),   (C X)^T p = w

An orthogonalization of the rows of C X finds w and p. A row that depends linearly on previous rows is omitted. Then w
remains unique, and p is the smallest of all possible solutions.

A released point or frame has three auxiliary speeds during the impact (see `reactions`). Their generalized impulses
are zero, because no impulse is transmitted to the bodies that are built from the point.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
from jaxtyping import Array, Bool, Float

from ..._common.lookup import checked, not_there, refuse_if
from ..._scalarjit.components import (
    Component,
    Rows,
    add,
    as_vector,
    component,
    dot,
    is_written_out,
    matvec,
    mul,
    rounding_of_pivots,
    scale3,
    solve,
    stack,
    sub,
    total,
)
from ..._scalarjit.scalar_function import ScalarFunction
from ..._system.kinematics import Frame, Point
from ..._system.motion import flatten_residuals
from ..._system.parameters import module_text
from ..._system.system import System
from ..arguments import Coordinates, InputArrays, Row, Speeds, Time, as_row, check_number, has_multipliers, is_concrete
from ..kanes_method import KaneEquations, mass_matrix_columns
from ..multipliers import AuxiliarySpeeds
from ..scaling import RowBasis


class Impact(eqx.Module):
    """An impact: velocity residuals that an impulse changes.

        lands = jk.Impact(toe.dot(N.x), toe.dot(N.y), release=("foot",))

    Every residual c(u) is a velocity [m/s or rad/s] that is affine in the speeds. After the impact, c(u+) = -e c(u-).
    The impulses p [N s or N m s] follow from Kane's impulse equations (Kane and Levinson, "Dynamics: Theory and
    Applications", 1985, section 4.12):

        M (u+ - u-) = C^T p,   C = dc/du

    The permanent constraints of the system also hold after the impact. The relative velocity of a surface that moves
    belongs to the residual: `(v_point - v_surface).dot(n)`.

    **Arguments:**

    - `velocity_residuals`: numbers or Vectors. A Vector is three residuals. Lists are flattened.
    - `restitution`: the coefficient e of restitution, from 0 (plastic) to 1 (elastic). One number for all residuals, or
        one for each residual.
    - `release`: names of points and frames of the `Motion`. Their constraints transmit no impulse. For example, the
        stance foot of a walker is fixed by the description, but it leaves the ground when the other foot strikes. The
        speeds after the impact are those of the description, so the next stage must exchange the legs. A direction in
        which a released part moves no mass remains fixed, and no residual may depend on it.

    **Raises:** `ValueError` without residuals, and for a coefficient of restitution outside [0, 1]. `TypeError` for
    arguments of a wrong type.
    """

    residuals: tuple[Component, ...]
    restitution: tuple[Component, ...]
    release: tuple[str, ...] = eqx.field(static=True)

    def __init__(self, *velocity_residuals: Any, restitution: Coefficients = 0.0, release: str | Sequence[str] = ()):
        label = "Impact(*velocity_residuals): the velocity residuals"
        counts = [len(flatten_residuals(each, label)) for each in velocity_residuals]
        self.residuals = flatten_residuals(velocity_residuals, label)
        refuse_if(not self.residuals, "Impact(*velocity_residuals): pass at least one velocity residual.")
        self.restitution = _for_each(checked_restitution(restitution), counts)
        self.release = checked_release(release)


def checked_restitution(value: Coefficients, label: str = "Impact") -> Any:
    is_one = not isinstance(value, (tuple, list)) and getattr(value, "ndim", 0) != 1
    values: Any = (value,) if is_one else value
    for e in values:
        check_number(e, f"{label}: a coefficient of restitution")
        if is_concrete(e) and not 0 <= float(e) <= 1:
            raise ValueError(f"{label}: the coefficient of restitution is {float(e)}. It must be between 0 and 1.")
    return value if is_one else tuple(value)


def _for_each(restitution: Coefficients, counts: Sequence[int]) -> tuple[Component, ...]:
    """One coefficient for each residual. `counts`: the number of residuals in each argument."""
    values = restitution if isinstance(restitution, tuple) else (restitution,) * sum(counts)
    if len(values) == len(counts) != sum(counts):  # one for each Vector
        values = [e for e, count in zip(values, counts, strict=True) for _ in range(count)]
    refuse_if(
        len(values) != sum(counts),
        f"Impact: there are {sum(counts)} residuals, but {len(values)} coefficients of restitution. Pass a "
        "single number, or one number for each residual.",
    )
    return tuple(component(e) for e in values)


def checked_release(release: str | Sequence[str]) -> tuple[str, ...]:
    """Names of released parts, each once."""
    names = (release,) if isinstance(release, str) else release
    if not isinstance(names, (tuple, list)) or not all(isinstance(name, str) for name in names):
        raise TypeError(
            f"Impact: release is a tuple of names of points and frames, such as ('foot',), got {release!r}."
        )
    return tuple(dict.fromkeys(names))


Coefficients: TypeAlias = Component | Sequence[Component]
"""One coefficient of restitution for all residuals, or one for each."""

ReadImpact: TypeAlias = Callable[[Component, Row, Row], Impact]
"""(t, q, u_all) -> the impact, with its residuals at the speeds u_all (n + k,)."""

ReadImpactOf: TypeAlias = Callable[[System, Component, Row, Row], Impact]
"""(system, t, q, u_all) -> the impact. A Module: its static fields and the code that it calls belong to the key."""


class ImpactResult(eqx.Module):
    """The result of an impact.

    Attributes:

    - `u`: independent speeds (n,) after the impact.
    - `impulses`: impulses (m,) of the velocity residuals [N s or N m s]. An impulse is positive if it increases its
        residual.
    - `energy_lost`: kinetic energy before the impact minus that after it [J].
    - `unique`: whether the impulses are unique. False if a residual depends linearly on the others. Then the speeds are
        unique, and the impulses have the smallest sum of squares.
    """

    u: Float[Array, " n"]
    impulses: Float[Array, " m"]
    energy_lost: Float[Array, ""]
    unique: Bool[Array, ""]

    def __repr__(self) -> str:
        return module_text(self, ndim=1)


class ImpactSolution(NamedTuple):
    """An `ImpactResult` and the reasons for which it may be NaN.

    - `C` (m, N): derivatives of the residuals by the independent speeds and the speeds of released parts.
    - `is_affine` (m,): whether each residual is affine in the speeds.
    - `is_consistent` (): whether the residuals can be satisfied together.
    - `is_determined` (): whether no residual depends on a motion of a released part that moves no mass.
    """

    result: ImpactResult
    C: Array
    is_affine: Array
    is_consistent: Array
    is_determined: Array


def after_impact(kane: KaneEquations, read: ReadImpact) -> ImpactSolution:
    """The impact at a state, as a program of scalars. For few speeds (`is_written_out`).

    **Arguments:**

    - `kane`: Kane's equations at the state before the impact.
    - `read`: the impact as a function of time, coordinates and all speeds.

    **Returns:** the result. It is NaN if the residuals contradict each other or are not affine in the speeds, and if
    the mass matrix is singular.
    """
    before = BeforeImpact(kane, read)
    M = stack(kane.mass_matrix(kane.partial_velocities())).astype(kane.dtype)
    return _solved(M, kane.jacobian(before.residuals), before.quantities())


def impact_at(
    system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays, read: ReadImpactOf
) -> ImpactSolution:
    """`after_impact` from checked arrays, for any number of speeds.

    `read` is part of the key under which the program is stored. Its arrays are arguments of the program.
    """
    if is_written_out(len(system.speeds)):
        return _impact_written_out(system, t, q, u, inputs, read)

    column = functools.partial(_residuals_along, system, t, q, u, inputs, read)
    C = jax.vmap(column, out_axes=-1)(np.eye(len(system.speeds), dtype=q.dtype))
    return _solved(mass_matrix_columns(system, t, q, u, inputs), C, _quantities(system, t, q, u, inputs, read))


@ScalarFunction
def _impact_written_out(system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays, read: ReadImpactOf):
    return after_impact(KaneEquations(system, t, q, u, inputs), functools.partial(read, system))


@ScalarFunction
def _residuals_along(
    system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays, read: ReadImpactOf, direction: Speeds
):
    kane = KaneEquations(system, t, q, u, inputs)
    along = kane.with_dependent(as_row(direction, system.speeds, "direction"))
    return as_vector(BeforeImpact(kane, functools.partial(read, system)).along(along), q)


@ScalarFunction
def _quantities(system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays, read: ReadImpactOf):
    return BeforeImpact(KaneEquations(system, t, q, u, inputs), functools.partial(read, system)).quantities()


class Released(NamedTuple):
    """The a = 3 p auxiliary speeds of p released parts.

    - `M_own` (n, a), `M` (a, a): blocks of the mass matrix.
    - `C` (m, a): derivatives of the residuals of the impact.
    - `h` (a,): generalized momenta before the impact.
    """

    M_own: Array
    M: Array
    C: Array
    h: Array


class Quantities(NamedTuple):
    """The impact before it is solved.

    - `u` (n,): independent speeds before the impact.
    - `h` (n,): their generalized momenta.
    - `residuals`, `restitution` (m,): at these speeds.
    - `deviation` (m,): the part of each residual that is not affine in the speeds.
    - `size` (m,): the size of the terms of each residual.
    - `released`: None if nothing is released.
    - `permanent`: the residuals of permanent constraints with multipliers, None without them.
    """

    u: Array
    h: Array
    residuals: Array
    restitution: Array
    deviation: Array
    size: Array
    released: Released | None
    permanent: Permanent | None = None


REDUNDANT = 1e-6
"""A velocity residual with a multiplier is redundant if its part that does not depend on the others is relatively
smaller. Lengths in files are often rounded to six digits."""


class Permanent(NamedTuple):
    """Velocity residuals with multipliers: derivatives `C` (k, n) by the speeds, and `residuals` (k,)."""

    C: Array
    residuals: Array

    @classmethod
    def of(cls, kane: KaneEquations) -> Permanent | None:
        system: Any = kane.system
        if not has_multipliers(system):
            return None
        residuals = functools.partial(system.multiplier_residuals, kane.t, kane.q)
        return cls(kane.jacobian(residuals), stack([residuals(kane.u_all)])[0].astype(kane.dtype))

    def rows(self, X: Array) -> tuple[Array, Array]:
        """A (k, n) with orthonormal rows and b (k,), for which A w = b is the change X w onto the constraints."""
        basis = self.basis(X)
        return basis.Q, basis.solve(-self.residuals)[0]

    def basis(self, X: Array) -> RowBasis:
        return RowBasis.of(self.C @ X, REDUNDANT)


class BeforeImpact:
    """The state before an impact: the residuals, their derivatives and the momenta."""

    def __init__(self, kane: KaneEquations, read: ReadImpact):
        self.kane, self.read = kane, read
        self.rest = (0.0,) * (kane.n + kane.k)
        self.impact: Impact = checked(
            read(kane.t, kane.q, kane.u_all), Impact, f"{kane.name}: an impact must be a jaxkane.Impact"
        )

    def residuals(self, u: Row) -> Row:
        return self.read(self.kane.t, self.kane.q, u).residuals

    def along(self, direction: Row) -> Row:
        """Derivatives (m,) of the residuals along a direction (n + k,) of all speeds."""
        return self.kane.along_speeds(self.residuals, direction)

    def quantities(self) -> Quantities:
        kane, impact = self.kane, self.impact
        momenta = kane.momenta(kane.u_all)
        h = kane.projected_onto_speeds(lambda u: kane.velocities(u)[0], momenta)
        r, r0, slope = impact.residuals, self.residuals(self.rest), self.along(kane.u_all)
        deviation = [sub(sub(x, y), z) for x, y, z in zip(r, r0, slope, strict=True)]
        size = [total(map(abs, terms)) for terms in zip(r, r0, slope, strict=True)]
        refuse_if(
            impact.release and has_multipliers(kane.system),
            f"{kane.name}: an impact with `release` is not supported for a system with multipliers. Use the system "
            "with dependent speeds (its attribute `inner`).",
        )
        released = self._released(momenta) if impact.release else None
        rows: Any = (kane.u, h, r, impact.restitution, deviation, size)
        arrays = (self._matrix([row])[0] for row in rows)
        return Quantities(*arrays, released=released, permanent=Permanent.of(kane))

    def _matrix(self, rows: Rows) -> Array:
        return stack(rows).astype(self.kane.dtype)

    def _released(self, momenta: list[tuple[Row, Row]]) -> Released:
        kane = self.kane
        auxiliary = AuxiliarySpeeds(kane.system, kane.t, kane.q, kane.u, dict(kane.inputs))
        parts = [_part(auxiliary, name) for name in self.impact.release]
        partials = [self._partial(auxiliary, part, axis) for part in parts for axis in range(3)]
        bodies, along = kane.read("bodies", kane.t, kane.q, kane.u_all), lambda u: kane.velocities(u)[0]
        M_own = []
        for partial, _ in partials:
            # M_rs = sum_i V_ir . m_i V_is + W_ir . I_i W_is
            changes = [(scale3(m, V), matvec(I, W)) for (m, I), (V, W) in zip(bodies, partial[0], strict=True)]
            M_own.append(kane.projected_onto_speeds(along, changes))
        h = [
            total(add(dot(V, p), dot(W, H)) for (V, W), (p, H) in zip(partial[0], momenta, strict=True))
            for partial, _ in partials
        ]
        M = self._matrix(kane.mass_matrix([partial for partial, _ in partials]))
        C = self._matrix([column for _, column in partials])
        return Released(self._matrix(M_own).T, M, C.T, self._matrix([h])[0])

    def _partial(self, kane: AuxiliarySpeeds, part: Point | Frame, axis: int) -> tuple[Any, Row]:
        """Partial velocities and derivatives (m,) of the residuals for one auxiliary speed of a released part."""
        along = []
        if kane.k:
            # The permanent constraints hold:  C_dep u_dep + C_aux u_aux = 0
            u_dep = [mul(-1.0, x) for x in solve(kane.C_dep, kane.auxiliary_residuals(part, axis))[0]]
            direction = (*(0.0,) * kane.n, *u_dep)
            along.append((kane.along_speeds(kane.velocities, direction), self.along(direction)))
        if kane.is_cut(part):
            # Otherwise, no body is built from the part, and its auxiliary speed changes only the constraints.
            along.append(
                kane.along_auxiliary(part, axis, lambda: (kane.velocities(self.rest), self.residuals(self.rest)))
            )
        return functools.reduce(lambda a, b: jax.tree.map(add, a, b), along)


def _part(kane: AuxiliarySpeeds, name: str) -> Point | Frame:
    motion = kane.description
    parts: dict[str, Point | Frame] = {**motion.points, **motion.frames}
    if name not in parts:
        raise not_there(name, parts, f"the points and frames of {kane.name} that an impact can release")
    part = parts[name]
    refuse_if(
        isinstance(part, Frame) and part.parent is None,
        f"{kane.name}: the impact releases {name!r}, which is the inertial frame. Omit it.",
    )
    refuse_if(
        not kane.is_cut(part) and not kane.k,
        f"{kane.name}: the impact releases {name!r}, but the position of no body is defined from this point. The "
        "release has no effect. Release the point from which the positions of the bodies are defined.",
    )
    return part


def _solved(M: Array, C: Array, before: Quantities) -> ImpactSolution:
    """The impact with the mass matrix `M` (n, n) and the derivatives `C` (m, n) of the residuals.

    X (N, N) has X^T M X = 1, with the mass matrix of the N = n + a speeds and auxiliary speeds: u+ - u- = X w.
    """
    n, h, released = len(M), before.h, before.released
    X = stack(inverse_root(_rows(M))).astype(M.dtype) if is_written_out(n) else _root_by_lapack(M)
    tolerance, is_determined = float(jnp.finfo(M.dtype).eps) ** 0.5, jnp.ones((), bool)
    if released is not None:
        # M = [[M_oo, M_oa], [M_ao, M_aa]],   X^T M X = 1,   S = M_aa - M_ao M_oo^-1 M_oa
        B = X.T @ released.M_own
        S = released.M - B.T @ B
        sizes = [released.M[i, i] for i in range(len(S))]
        X_a, Z = (stack(rows).astype(M.dtype) for rows in _inverse_root(_rows(S), sizes))
        undetermined = jnp.sum(jnp.abs(released.C @ Z - (C @ X) @ B @ Z), axis=1)
        lower = jnp.concatenate([jnp.zeros_like(released.M_own.T), X_a], axis=1)
        X = jnp.concatenate([jnp.concatenate([X, -X @ B @ X_a], axis=1), lower], axis=0)
        C, h = jnp.concatenate([C, released.C], axis=1), jnp.concatenate([before.h, released.h])
        # No residual depends on a motion of a released part that moves no mass.
        is_determined = jnp.all(undetermined <= tolerance * jnp.sum(jnp.abs(C), axis=1))
    # C (u+ - u-) = c(u+) - c(u-) = -(1 + e) c(u-)
    b = -(1.0 + before.restitution) * before.residuals
    A, k = C @ X, 0
    if before.permanent is not None:
        rows, values = before.permanent.rows(X)
        A, b, k = jnp.concatenate([rows, A]), jnp.concatenate([values, b]), len(rows)
    basis = RowBasis.of(A)
    y, missing = basis.solve(b)
    w, T = y @ basis.Q, basis.T[k:, k:]
    p = RowBasis.of(T.T[::-1]).least_norm(y[k:][::-1])  # T^T p = y
    size = before.size + jnp.abs(b[k:]) + jnp.abs(T) @ jnp.abs(y[k:])
    is_consistent = jnp.all(jnp.abs(missing[k:]) <= tolerance * size)
    is_consistent &= jnp.all((before.restitution >= 0) & (before.restitution <= 1))
    is_affine = jnp.abs(before.deviation) <= tolerance * before.size
    # T(u+) - T(u-) = (change . M change) / 2 + h . change
    values = before.u + (X @ w)[:n], p, -(0.5 * w @ w + h @ (X @ w))
    u, p, energy_lost = (jnp.where(is_consistent & is_determined & jnp.all(is_affine), x, jnp.nan) for x in values)
    result = ImpactResult(u, p, energy_lost, jnp.all(basis.is_new[k:]))
    return ImpactSolution(result, C, is_affine, is_consistent, is_determined)


def _rows(A: Array) -> list[list[Component]]:
    return [[A[i, j] for j in range(A.shape[1])] for i in range(A.shape[0])]


@jax.jit
def _root_by_lapack(M: Array) -> Array:
    """X (n, n) with X^T M X = 1, upper triangular. NaN if M is singular within rounding."""
    K = jnp.linalg.cholesky(M)
    K = jnp.where(jnp.all(jnp.diag(K) ** 2 > rounding_of_pivots(M.dtype) * jnp.diag(M)), K, jnp.nan)
    return jsl.solve_triangular(K, jnp.eye(len(M), dtype=M.dtype), lower=True).T


def inverse_root(M: Rows) -> Rows:
    """X (n, n) with X^T M X = 1, upper triangular, by the Cholesky factors M = K K^T, X = K^-T.

    A pivot that is zero within rounding gives NaN.
    """
    X, _ = _inverse_root(M, None)
    return X


def _inverse_root(M: Rows, sizes: Sequence[Component] | None) -> tuple[Rows, Rows]:
    """X as `inverse_root`, and directions Z (n, n) with M Z = 0.

    If the `sizes` (n,) of the diagonal before cancellation are passed, a pivot that is zero within rounding gives a
    column of zeros in X and a column that is not zero in Z. This direction moves no mass.
    """
    n = len(M)
    K: list[list[Component]] = [[0.0] * n for _ in range(n)]
    regular, reciprocals = [], []
    for j in range(n):
        pivot = sub(M[j][j], dot(K[j][:j], K[j][:j]))
        size = M[j][j] if sizes is None else sizes[j]
        eps = float(jnp.finfo(jnp.result_type(pivot, size)).eps)
        # With cancelled digits, the rounding error of a pivot is that of the whole Schur complement.
        is_regular = pivot > (100 * eps if sizes is None else eps**0.75) * size
        root = jnp.sqrt(jnp.where(is_regular, pivot, 1.0))
        regular.append(is_regular)
        reciprocals.append(jnp.where(is_regular, 1.0 / root, math.nan if sizes is None else 1.0))
        for i in range(j + 1, n):
            column = mul(sub(M[i][j], dot(K[i][:j], K[j][:j])), reciprocals[j])
            K[i][j] = column if sizes is None else jnp.where(is_regular, column, 0.0)
    X: list[list[Component]] = [[0.0] * n for _ in range(n)]
    for i in range(n):
        X[i][i] = reciprocals[i]
        for j in range(i):
            # K K^-1 = 1
            X[j][i] = mul(mul(-1.0, reciprocals[i]), total(mul(K[i][k], X[j][k]) for k in range(j, i)))
    if sizes is None:
        return X, []
    Z = [[jnp.where(regular[i], 0.0, x) for i, x in enumerate(row)] for row in X]
    return [[jnp.where(regular[i], x, 0.0) for i, x in enumerate(row)] for row in X], Z
