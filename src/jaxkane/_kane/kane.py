"""Kane's dynamical equations in momentum form. Knows bodies, speeds and JAX; knows no mechanism and no integrator.

With p_i = m_i v_i, H_i = I_i . omega_i and d/dt in the inertial frame (Kamman, Unit 5, "Kane's Equations"):

    V_ir = dv_i/du_r,  W_ir = domega_i/du_r                         partial velocities
    c = C_ind u + C_dep u_dep + c0 = 0,  J = -C_dep^-1 C_ind        dependent speeds
    M_rs = sum_i V_ir . m_i V_is + W_ir . I_i W_is
    F_r  = sum F . V_r + T . W_r                                    active loads
    F*_r = -sum_i V_ir . dp_i/dt + W_ir . dH_i/dt                   inertia, at u_dot = 0
    M u_dot = f = F_r + F*_r

`jax.jvp` of the description gives partial velocities, C and the time derivatives. Only the directions that
are needed are pushed: the residuals along every speed, the bodies along the n independent columns of [1; J].

For a few speeds this is written out, as scalars. For many, sums over bodies for every pair of speeds would be of order
n^2 b. Then f and the columns of M are found without partial velocities, each in order b: vectors that stand on bodies
are projected onto all speeds at once by the transpose of the map u -> (v, omega), which `jax.vjp` gives.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._scalarjit.components import Component, add, add3, component, cross, dot, is_exact, matvec, mul, scale3, total
from .._scalarjit.function import ScalarFunction
from .._scalarjit.linear import Rows, as_vector, is_written_out, solve, solve_positive, solve_positive_array, stack
from .._system.bodies import Load
from .._system.motion import Motion
from .._system.system import System
from .arguments import Row, as_row
from .evaluate import DescriptionEvaluator, jvp, transposed, unit


class KaneEquations(DescriptionEvaluator):
    """Kane's equations of a system at a state: one time, coordinates and independent speeds.

    `u_dep`, `q_dot` and the columns of `J` are formed at once, since everything else needs them.
    """

    def __init__(self, system: System, t: Component, q: Any, u: Any, inputs: Mapping[str, Component] | None = None):
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

    def loads(self, motion: Motion) -> tuple[Load, ...]:
        return self.loads_at(self.t, self.q, self.u_all, motion)

    def along_speeds(self, f: Callable[[Row], Any], direction: Row) -> Any:
        """The derivative of `f(u)` along a direction of speeds, at u = 0: all of it, since f is affine in them."""
        return jvp(lambda s: f(tuple(mul(s, x) for x in direction)), (self._zero(),), (jnp.ones_like(self._zero()),))[1]

    @property
    def dtype(self) -> Any:
        return jnp.result_type(*([x for x in (*self.q, *self.u) if not is_exact(x)] or [float]))

    def _zero(self) -> Array:
        return jnp.zeros((), self.dtype)

    def _constraint_rows(self) -> tuple[Rows, Rows, Row]:
        # c = C_ind u + C_dep u_dep + c0
        n, k = self.n, self.k
        c0 = self.residuals(self.t, self.q, (0.0,) * (n + k))
        if not k:
            return [], [], c0
        along = [self.along_speeds(lambda u: self.residuals(self.t, self.q, u), unit(n + k, r)) for r in range(n + k)]
        rows = tuple(zip(*along, strict=True))
        return [row[:n] for row in rows], [row[n:] for row in rows], c0

    def partials(self) -> list[tuple[list, list]]:
        """For each independent speed: the partial velocities (V, W) of the bodies, and those of the loads."""
        # V_ir = dv_i/du_r,  W_ir = domega_i/du_r, along the columns of [1; J]
        return [self.along_speeds(self.velocities, (*unit(self.n, r), *self.J[r])) for r in range(self.n)]

    def velocities(self, u: Row) -> tuple[list, list]:
        """Velocities (v, omega) of the bodies, and those that the loads act on, at speeds `u`."""
        return self.read("velocities", self.t, self.q, u)

    def momenta(self, u: Row) -> list[tuple[Row, Row]]:
        return self.read("momenta", self.t, self.q, u)

    def with_dependent(self, direction: Row) -> Row:
        """A direction of the independent speeds, with what the dependent ones do: [1; J] of it."""
        return (*direction, *(dot(row, direction) for row in zip(*self.J, strict=True)))

    def onto_speeds(self, f: Callable[[Row], Any], cotangents: Any) -> Row:
        """For every independent speed, the derivative of `f(u)` along it times `cotangents`; at the cost of a few f."""
        return transposed(lambda *u: f(self.with_dependent(u)), (self._zero(),) * self.n, cotangents)

    def mass_times(self, direction: Row) -> Row:
        """M times a direction of the independent speeds: the momenta along it, onto all speeds. Order b, not n b."""
        along = self.along_speeds(self.momenta, self.with_dependent(direction))
        return self.onto_speeds(lambda u: self.velocities(u)[0], along)

    def forcing(self) -> Row:
        """f of M u_dot = f, without partial velocities: all vectors onto all speeds at once."""
        inertia = [tuple(scale3(-1.0, rate) for rate in rates) for rates in self.momentum_rates()]
        return self.onto_speeds(self.velocities, (inertia, self.force_components()))

    def bias(self) -> Row:
        """u_dep_dot at u_dot = 0: the residual is differentiated, never the solution of the solve.

        u_dep_dot = J u_dot - C_dep^-1 (dc/dt at frozen speeds)
        """
        if not self.k:
            return ()
        _, c_dot = jvp(lambda t, *q: self.residuals(t, q, self.u_all), (self.t, *self.q), (1.0, *self.q_dot))
        return _negative(solve(self.C_dep, c_dot)[0])

    def dependent_accelerations(self, u_dot: Row) -> Row:
        """u_dep_dot = J u_dot + bias."""
        if not self.k:
            return ()
        return tuple(add(dot(row, u_dot), b) for row, b in zip(zip(*self.J, strict=True), self.bias(), strict=True))

    def momentum_rates(self, u_dot: Row | None = None) -> list[tuple[Row, ...]]:
        """dp/dt and dH/dt of every body in the inertial frame; each in the frame where it stands.

        `u_dot` (n + k,) of the independent and the dependent speeds; by default u_dot = 0 and `bias`.
        """
        momenta = lambda t, *q: self.read("momenta", t, q, self.u_all)  # noqa: E731
        values, rates = jvp(momenta, (self.t, *self.q), (1.0, *self.q_dot))
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

    def active_forces(self, partials: list) -> Row:
        # F_r = sum F . V_r + T . W_r
        vectors = self.force_components()
        return tuple(total(dot(v, x) for v, x in zip(columns, vectors, strict=True)) for _, columns in partials)

    def force_components(self) -> list[Row]:
        return self.read("forces", self.t, self.q, self.u_all)

    def inertia_forces(self, partials: list, u_dot: Row | None = None) -> Row:
        # F*_r = -sum_i V_ir . dp_i/dt + W_ir . dH_i/dt
        rates = self.momentum_rates(u_dot)
        return tuple(
            mul(-1.0, total(add(dot(V, p), dot(W, H)) for (V, W), (p, H) in zip(bodies, rates, strict=True)))
            for bodies, _ in partials
        )

    def mass_matrix(self, partials: list) -> list[list[Component]]:
        # M_rs = sum_i V_ir . m_i V_is + W_ir . I_i W_is
        n = self.n
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

    def equations(self) -> tuple[list[list[Component]], Row]:
        """M and f of M u_dot = f."""
        partials = self.partials()
        # f = F_r + F*_r
        f = tuple(map(add, self.active_forces(partials), self.inertia_forces(partials)))
        return self.mass_matrix(partials), f

    def accelerations(self) -> Row:
        return solve_positive(*self.equations())


def _negative(row: Sequence[Component]) -> Row:
    return tuple(mul(-1.0, x) for x in row)


def motion_rates(
    system: System, t: Array, q: Array, u: Array, inputs: dict[str, Array]
) -> tuple[Float[Array, " n_q"], Float[Array, " n"]]:
    """q_dot and u_dot: the right-hand side, from arrays that were checked."""
    if is_written_out(len(system.speeds)):
        return _motion_rates(system, t, q, u, inputs)
    q_dot, M, f = rates_and_equations(system, t, q, u, inputs)
    return q_dot, solve_positive_array(M, f)


def rates_and_equations(
    system: System, t: Array, q: Array, u: Array, inputs: dict[str, Array]
) -> tuple[Float[Array, " n_q"], Float[Array, "n n"], Float[Array, " n"]]:
    """q_dot, M and f of M u_dot = f, from arrays that were checked."""
    if is_written_out(len(system.speeds)):
        return _equations_written_out(system, t, q, u, inputs)
    # The columns of M are one program, whose lanes are the directions.
    q_dot, f = _rates_and_forcing(system, t, q, u, inputs)
    columns = jax.vmap(lambda direction: _mass_times(system, t, q, u, inputs, direction))
    return q_dot, columns(np.eye(len(system.speeds), dtype=q.dtype)), f


def accelerations_and_mass_matrix(
    system: System, t: Array, q: Array, u: Array, inputs: dict[str, Array]
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """u_dot and M, from arrays that were checked."""
    if is_written_out(len(system.speeds)):
        return _accelerations_and_mass_matrix(system, t, q, u, inputs)
    _, M, f = rates_and_equations(system, t, q, u, inputs)
    return solve_positive_array(M, f), M


@ScalarFunction
def _motion_rates(system, t, q, u, inputs):
    kane = KaneEquations(system, t, q, u, inputs)
    return as_vector(kane.q_dot, q), as_vector(kane.accelerations(), q)


@ScalarFunction
def _equations_written_out(system, t, q, u, inputs):
    kane = KaneEquations(system, t, q, u, inputs)
    M, f = kane.equations()
    return as_vector(kane.q_dot, q), stack(M).astype(q.dtype), as_vector(f, q)


@ScalarFunction
def _accelerations_and_mass_matrix(system, t, q, u, inputs):
    M, f = KaneEquations(system, t, q, u, inputs).equations()
    return as_vector(solve_positive(M, f), q), stack(M).astype(q.dtype)


@ScalarFunction
def _rates_and_forcing(system, t, q, u, inputs):
    kane = KaneEquations(system, t, q, u, inputs)
    return as_vector(kane.q_dot, q), as_vector(kane.forcing(), q)


@ScalarFunction
def _mass_times(system, t, q, u, inputs, direction):
    kane = KaneEquations(system, t, q, u, inputs)
    return as_vector(kane.mass_times(as_row(direction, system.speeds, "direction")), q)
