"""Kane's dynamical equations in momentum form. Depends on bodies, speeds and JAX only.

With p_i = m_i v_i, H_i = I_i . omega_i and d/dt in the inertial frame (Kamman, Unit 5, "Kane's Equations"):

    V_ir = dv_i/du_r,  W_ir = domega_i/du_r                         partial velocities
    c = C_ind u + C_dep u_dep + c0 = 0,  J = -C_dep^-1 C_ind        dependent speeds
    M_rs = sum_i V_ir . m_i V_is + W_ir . I_i W_is
    F_r  = sum F . V_r + T . W_r                                    active loads
    F*_r = -sum_i V_ir . dp_i/dt + W_ir . dH_i/dt                   inertia, at u_dot = 0
    M u_dot = f = F_r + F*_r

`jax.jvp` of positions and velocities gives partial velocities, C and the time derivatives. Only the required directions
are computed: the residuals along every speed, and the bodies along the n columns of [1; J].

There are two formulations with equal results:

- By partial velocities, for few speeds. All sums are written out as scalars. For b bodies, this takes time of order
  n^2 b.
- By transposition, for many speeds. The transpose of the map u -> (v, omega), by `jax.vjp`, projects the vectors of all
  bodies onto all speeds at once. f and each column of M take time of order b. The native kernel of u_dot does not form
  M. It eliminates the unknowns along this map (`_scalarjit.elimination`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._scalarjit.cache_key import jit
from .._scalarjit.components import (
    Component,
    Numbers,
    Rows,
    add,
    add3,
    as_vector,
    component,
    cross,
    dot,
    is_exact,
    is_written_out,
    matvec,
    mul,
    scale3,
    solve,
    solve_positive,
    solve_positive_array,
    stack,
    total,
)
from .._scalarjit.elimination import LinearSolution, ScalarSolve
from .._scalarjit.scalar_function import ScalarFunction
from .._system.motion import Load, Motion
from .._system.system import System
from .arguments import Coordinates, InputArrays, Row, Speeds, Time, as_row
from .description import (
    DescriptionEvaluator,
    jvp,
    transposed,
)


def unit(n: int, r: int) -> Row:
    """The r-th of n directions of the speeds."""
    return tuple(1.0 if i == r else 0.0 for i in range(n))


class KaneEquations(DescriptionEvaluator):
    """Kane's equations of a system at one time, coordinates and independent speeds.

    - `u_dep` (k,), `u_all` (n + k,): dependent speeds; independent and dependent speeds.
    - `q_dot` (n_q,): rates of the coordinates.
    - `J`: its n columns (k,).
    """

    def __init__(
        self, system: System, t: Component, q: Numbers, u: Numbers, inputs: Mapping[str, Component] | None = None
    ):
        super().__init__(system, inputs)
        self.t = component(t)
        self.q = as_row(q, system.coordinates, f"{self.name}: q")
        self.u = as_row(u, system.speeds, f"{self.name}: u")
        self.C_ind, self.C_dep, c0 = self._constraint_rows()
        # J = -C_dep^-1 C_ind,   u_dep = -C_dep^-1 (C_ind u + c0)
        known = [add(x, y) for x, y in zip(matvec(self.C_ind, self.u), c0, strict=True)]
        *columns, u_dep = solve(self.C_dep, *zip(*self.C_ind, strict=True), known) if self.k else [()] * (self.n + 1)
        self.J = [_negative(column) for column in columns]  # n columns (k,)
        self.u_dep = _negative(u_dep)
        self.u_all = (*self.u, *self.u_dep)
        self.q_dot = self.rates(self.t, self.q, self.u_all)

    @property
    def dtype(self) -> Any:
        return jnp.result_type(*([x for x in (*self.q, *self.u) if not is_exact(x)] or [float]))

    def _zero(self) -> Array:
        return jnp.zeros((), self.dtype)

    def loads(self, motion: Motion) -> tuple[Load, ...]:
        return self.loads_at(self.t, self.q, self.u_all, motion)

    def velocities(self, u: Row) -> tuple[list, list]:
        """Velocities (v, omega) of the bodies, and of the points and frames of the loads, at the speeds u."""
        return self.read("velocities", self.t, self.q, u)

    def momenta(self, u: Row) -> list[tuple[Row, Row]]:
        return self.read("momenta", self.t, self.q, u)

    def force_components(self) -> list[Row]:
        return self.read("forces", self.t, self.q, self.u_all)

    def along_speeds(self, f: Callable[[Row], Any], direction: Row) -> PyTree:
        """The derivative of `f(u)` along a direction of the speeds. f is affine, so u = 0 is used."""
        return jvp(lambda s: f(tuple(mul(s, x) for x in direction)), (self._zero(),), (jnp.ones_like(self._zero()),))[1]

    def jacobian(self, f: Callable[[Row], Any]) -> Array:
        """The derivatives (m, n) of the affine `f(u)` (m,) by the independent speeds."""
        columns = [self.along_speeds(f, self.with_dependent(unit(self.n, r))) for r in range(self.n)]
        return stack(columns).astype(self.dtype).T

    # -- Constraints: J, J_dot and the bias of the dependent accelerations.

    def _constraint_rows(self) -> tuple[Rows, Rows, Row]:
        # c = C_ind u + C_dep u_dep + c0
        n, k = self.n, self.k
        c0 = self.residuals(self.t, self.q, (0.0,) * (n + k))
        if not k:
            return [], [], c0
        along = [self.along_speeds(lambda u: self.residuals(self.t, self.q, u), unit(n + k, r)) for r in range(n + k)]
        rows = tuple(zip(*along, strict=True))
        return [row[:n] for row in rows], [row[n:] for row in rows], c0

    def with_dependent(self, direction: Row) -> Row:
        """[1; J] times a direction (n,) of the independent speeds: a direction (n + k,) of all speeds."""
        return (*direction, *(dot(row, direction) for row in zip(*self.J, strict=True)))

    def J_dot(self) -> list[Row]:
        """The columns (k,) of J_dot, the derivative of J(t, q) along (1, q_dot).

            J_dot = -C_dep^-1 (C_ind_dot + C_dep_dot J)

        The textbook prints a minus before C_dep_dot (Example 7).
        """
        at_rest = (0.0,) * self.n
        along = (1.0, *self.q_dot)
        return jvp(lambda t, *q: KaneEquations(self.system, t, q, at_rest).J, (self.t, *self.q), along)[1]

    def bias(self) -> Row:
        """The dependent accelerations (k,) at u_dot = 0.

        u_dep_dot = J u_dot - C_dep^-1 (dc/dt at constant speeds)
        """
        # Differentiate the residual. Differentiating the solution u_dep of the linear system gives the same value, but
        # needs the derivatives of C_ind, C_dep and their factorization.
        if not self.k:
            return ()
        _, c_dot = jvp(lambda t, *q: self.residuals(t, q, self.u_all), (self.t, *self.q), (1.0, *self.q_dot))
        return _negative(solve(self.C_dep, c_dot)[0])

    def dependent_accelerations(self, u_dot: Row) -> Row:
        if not self.k:
            return ()
        return tuple(add(dot(row, u_dot), b) for row, b in zip(zip(*self.J, strict=True), self.bias(), strict=True))

    # -- Rates of momenta, for both formulations.

    def momentum_rates(self, u_dot: Row | None = None) -> list[tuple[Row, ...]]:
        """dp/dt and dH/dt of every body in the inertial frame, with components in the frame of the body.

        `u_dot` (n + k,): rates of all speeds. By default the rates of the independent speeds are zero, and those of
        the dependent speeds are `bias`.
        """

        at, along = (self.t, *self.q), (1.0, *self.q_dot)
        values, rates = jvp(lambda t, *q: self.read("momenta", t, q, self.u_all), at, along)
        if u_dot is None and self.k:
            u_dot = (*(0.0,) * self.n, *self.bias())
        if u_dot is not None:
            along = self.along_speeds(self.momenta, u_dot)
            rates = [tuple(map(add3, *pair)) for pair in zip(rates, along, strict=True)]
        # dx/dt in N = derivative of the components + omega x
        frames = self.read("frame_velocities", self.t, self.q, self.u_all)
        return [
            tuple(add3(x_dot, cross(omega, x)) for x_dot, omega, x in zip(*each, strict=True))
            for each in zip(rates, frames, values, strict=True)
        ]

    # -- Formulation by partial velocities: sums over the bodies for each pair of speeds. For few speeds.

    def partial_velocities(self) -> list[tuple[list, list]]:
        """For each independent speed, the partial velocities (V, W) of the bodies and those of the loads."""
        # V_ir = dv_i/du_r,  W_ir = domega_i/du_r, along the columns of [1; J]
        return [self.along_speeds(self.velocities, self.with_dependent(unit(self.n, r))) for r in range(self.n)]

    def active_forces(self, partials: list) -> Row:
        # F_r = sum F . V_r + T . W_r
        vectors = self.force_components()
        return tuple(total(dot(v, x) for v, x in zip(columns, vectors, strict=True)) for _, columns in partials)

    def inertia_forces(self, partials: list, u_dot: Row | None = None) -> Row:
        # F*_r = -sum_i V_ir . dp_i/dt + W_ir . dH_i/dt
        rates = self.momentum_rates(u_dot)
        return tuple(
            mul(-1.0, total(add(dot(V, p), dot(W, H)) for (V, W), (p, H) in zip(bodies, rates, strict=True)))
            for bodies, _ in partials
        )

    def mass_matrix(self, partials: list) -> list[list[Component]]:
        # M_rs = sum_i V_ir . m_i V_is + W_ir . I_i W_is
        n = len(partials)
        M: list[list[Component]] = [[0.0] * n for _ in range(n)]
        for i, (mass, inertia) in enumerate(self.read("bodies", self.t, self.q, self.u_all)):
            for s in range(n):
                V, W = partials[s][0][i]
                mV, IW = scale3(mass, V), matvec(inertia, W)
                for r in range(s + 1):
                    V, W = partials[r][0][i]
                    M[r][s] = add(M[r][s], add(dot(V, mV), dot(W, IW)))
        for s in range(n):
            for r in range(s):
                M[s][r] = M[r][s]
        return M

    def equations_by_partial_velocities(self) -> tuple[list[list[Component]], Row]:
        partials = self.partial_velocities()
        # f = F_r + F*_r
        f = tuple(map(add, self.active_forces(partials), self.inertia_forces(partials)))
        return self.mass_matrix(partials), f

    # -- Formulation by transposition: all vectors are projected onto all speeds at once. For many speeds.

    def projected_onto_speeds(self, f: Callable[[Row], Any], cotangents: PyTree) -> Row:
        """The derivatives of `f(u)` with respect to the independent speeds, times `cotangents` (n,). Costs a few f."""
        return transposed(lambda *u: f(self.with_dependent(u)), (self._zero(),) * self.n, cotangents)

    def forcing_by_transposition(self, u_dot: Row | None = None) -> Row:
        """f (n,) of M u_dot = f. With `u_dot`, f - M u_dot."""
        u_dot_all = None if u_dot is None else (*u_dot, *self.dependent_accelerations(u_dot))
        inertia = [tuple(scale3(-1.0, rate) for rate in rates) for rates in self.momentum_rates(u_dot_all)]
        return self.projected_onto_speeds(self.velocities, (inertia, self.force_components()))


def _negative(row: Sequence[Component]) -> Row:
    return tuple(mul(-1.0, x) for x in row)


def motion_rates(
    system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays
) -> tuple[Float[Array, " n_q"], Float[Array, " n"]]:
    """q_dot and u_dot, from checked arrays."""
    if is_written_out(len(system.speeds)):
        return _motion_rates(system, t, q, u, inputs)
    q_dot, f = rates_and_forcing(system, t, q, u, inputs)

    # Its derivative is that of M u_dot = f (implicit function theorem). The elimination itself is never differentiated.
    return q_dot, jax.lax.custom_linear_solve(
        lambda u_dot: _mass_times(system, t, q, u, inputs, u_dot),
        f,
        lambda _, f: _accelerations_under(system, t, q, u, inputs, f),
        symmetric=True,
    )


def motion_rates_by_matrix(
    system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays
) -> tuple[Float[Array, " n_q"], Float[Array, " n"]]:
    """As `motion_rates`, with operations that can be exported: no custom derivative and no native kernel."""
    if is_written_out(len(system.speeds)):
        return _motion_rates(system, t, q, u, inputs)
    q_dot, M, f = rates_and_equations(system, t, q, u, inputs)
    return q_dot, solve_positive_array(M, f)


def rates_and_equations(
    system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays
) -> tuple[Float[Array, " n_q"], Float[Array, "n n"], Float[Array, " n"]]:
    """q_dot, M and f of M u_dot = f, from checked arrays."""
    if is_written_out(len(system.speeds)):
        return _equations_written_out(system, t, q, u, inputs)
    q_dot, f = rates_and_forcing(system, t, q, u, inputs)
    return q_dot, mass_matrix_columns(system, t, q, u, inputs), f


def mass_matrix_columns(system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays) -> Float[Array, "n n"]:
    """M (n, n), by one batched program for all columns."""

    column = functools.partial(_mass_times, system, t, q, u, inputs)
    return jax.vmap(column)(np.eye(len(system.speeds), dtype=q.dtype))


def accelerations_and_mass_matrix(
    system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """u_dot and M, from checked arrays."""
    if is_written_out(len(system.speeds)):
        return _accelerations_and_mass_matrix(system, t, q, u, inputs)
    return motion_rates(system, t, q, u, inputs)[1], mass_matrix_columns(system, t, q, u, inputs)


def _equations_at(system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays, u_dot: Speeds, r: Speeds):
    kane = KaneEquations(system, t, q, u, inputs)
    accelerations, right = (as_row(x, system.speeds, "u_dot") for x in (u_dot, r))
    solution = solve_positive(kane.mass_matrix(kane.partial_velocities()), right)
    return as_vector(kane.q_dot, q), as_vector(kane.forcing_by_transposition(accelerations), q), as_vector(solution, q)


@functools.partial(LinearSolution, equations=_equations_at)
def _motion_rates(system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays):
    kane = KaneEquations(system, t, q, u, inputs)
    return as_vector(kane.q_dot, q), as_vector(solve_positive(*kane.equations_by_partial_velocities()), q)


@ScalarFunction
def _equations_written_out(system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays):
    kane = KaneEquations(system, t, q, u, inputs)
    M, f = kane.equations_by_partial_velocities()
    return as_vector(kane.q_dot, q), stack(M).astype(q.dtype), as_vector(f, q)


@ScalarFunction
def _accelerations_and_mass_matrix(system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays):
    M, f = KaneEquations(system, t, q, u, inputs).equations_by_partial_velocities()
    return as_vector(solve_positive(M, f), q), stack(M).astype(q.dtype)


@ScalarFunction
def rates_and_forcing(system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays):
    kane = KaneEquations(system, t, q, u, inputs)
    return as_vector(kane.q_dot, q), as_vector(kane.forcing_by_transposition(), q)


@ScalarFunction
def _mass_times(system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays, direction: Speeds):
    # M times a direction of the independent speeds: its momenta, projected onto all speeds. Order b.
    kane = KaneEquations(system, t, q, u, inputs)
    along = kane.along_speeds(kane.momenta, kane.with_dependent(as_row(direction, system.speeds, "direction")))
    return as_vector(kane.projected_onto_speeds(lambda u: kane.velocities(u)[0], along), q)


def _accelerations_by_lapack(system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays, f: Speeds):
    return solve_positive_array(mass_matrix_columns(system, t, q, u, inputs), f)


@functools.partial(ScalarSolve, by_lapack=_accelerations_by_lapack)
def _accelerations_under(system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays, u_dot: Speeds):
    # M u_dot = f. Twice the kinetic energy is u^T M u = sum_i v_i . m_i v_i + omega_i . I_i omega_i
    kane = KaneEquations(system, t, q, u, inputs)
    direction = kane.with_dependent(as_row(u_dot, system.speeds, "u_dot"))
    vectors = [x for pair in kane.along_speeds(kane.velocities, direction)[0] for x in pair]
    rows: list[Row] = []
    for mass, inertia in kane.read("bodies", kane.t, kane.q, kane.u_all):
        rows += [(mass, 0.0, 0.0), (0.0, mass, 0.0), (0.0, 0.0, mass), *inertia]
    return stack(vectors).astype(q.dtype), stack(rows).astype(q.dtype).reshape(-1, 3, 3)


compiled = {f: jit(f) for f in (motion_rates, rates_and_equations)}


def as_one_program(f: Callable[..., Any], system: System) -> Callable[..., Any]:
    """`f` as one compiled program also outside of `jax.jit`. With few speeds it is one program already. With many
    speeds it is several operations. One of these, `custom_linear_solve`, is traced in each call: 14 ms, 30 speeds."""
    return f if is_written_out(len(system.speeds)) else compiled[f]
