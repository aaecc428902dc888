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
are projected onto all speeds at once by the transpose of the map u -> (v, omega), which `jax.vjp` gives. The native
kernel of u_dot needs no M: unknowns are eliminated along that map (`_scalarjit.elimination`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._scalarjit.cache_key import version_of
from .._scalarjit.compat import Tracer
from .._scalarjit.components import (
    Component,
    Rows,
    add,
    add3,
    as_vector,
    component,
    cross,
    dot,
    is_exact,
    is_written_out,
    is_zero,
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
from .._scalarjit.function import ScalarFunction
from .._system.kinematics import Frame
from .._system.motion import Body, Load, Motion, flatten_loads, flatten_residuals
from .._system.parameters import in_batches
from .._system.system import System
from .arguments import Inputs, Row, as_row, checked_values, inputs_of


def jvp(f: Callable[..., Any], primals: Sequence[Component], tangents: Sequence[Component]) -> tuple[Any, Any]:
    """`jax.jvp` of a function of components: exact inputs and outputs stay exact, and have exact zero derivatives."""
    moving = [i for i, dx in enumerate(tangents) if not is_zero(dx)]
    constants: list[Component | None] = []
    treedef = None

    def arrays_only(*xs):
        nonlocal treedef
        arguments = list(primals)
        for i, x in zip(moving, xs, strict=True):
            arguments[i] = x
        leaves, treedef = jax.tree.flatten(f(*arguments))
        constants[:] = [x if is_exact(x) else None for x in leaves]
        return [x for x in leaves if not is_exact(x)]

    arrays = [x for x in (*primals, *tangents) if not is_exact(x)]
    xs = [jnp.asarray(primals[i], dtype=jnp.result_type(*arrays)) for i in moving]
    dxs = [jnp.asarray(tangents[i], dtype=x.dtype) for i, x in zip(moving, xs, strict=True)]
    if moving:
        values, derivatives = jax.jvp(arrays_only, xs, dxs)
    else:
        values = arrays_only()
        derivatives = [0.0] * len(values)
    values, derivatives = iter(values), iter(derivatives)
    f_x = [next(values) if c is None else c for c in constants]
    f_dx = [next(derivatives) if c is None else 0.0 for c in constants]
    return jax.tree.unflatten(treedef, f_x), jax.tree.unflatten(treedef, f_dx)


def transposed(f: Callable[..., Any], primals: Sequence[Component], cotangents: Any) -> Row:
    """`jax.vjp` of a function of components: the derivative of `f` at `primals`, transposed, times `cotangents`.

    `cotangents` stand as f's outputs do. What f returns exactly is constant, and what meets it is dropped.
    """
    moves: list[bool] = []

    def arrays_only(*xs):
        leaves = jax.tree.leaves(f(*xs))
        moves[:] = [not is_exact(x) for x in leaves]
        return [x for x in leaves if not is_exact(x)]

    outputs, pull = jax.vjp(arrays_only, *primals)
    leaves = [ct for ct, m in zip(jax.tree.leaves(cotangents), moves, strict=True) if m]
    return pull([jnp.asarray(ct, dtype=x.dtype) for ct, x in zip(leaves, outputs, strict=True)])


def unit(n: int, r: int) -> Row:
    """The r-th of n directions of the speeds."""
    return tuple(1.0 if i == r else 0.0 for i in range(n))


class DescriptionEvaluator:
    """The description of a system, at any time, coordinates and speeds.

    `read` gives parts of it as components, from one trace of the description; `motion` evaluates the method itself.
    """

    def __init__(self, system: System, inputs: Mapping[str, Component] | None = None):
        self.system = system
        self.name = type(system).__name__
        if batched := in_batches(system):
            raise ValueError(
                f"{self.name}: {', '.join(batched)} has more axes than it was declared with. For a batch of systems "
                "use jax.vmap, or jaxkane.sweep.sweep for their motions."
            )
        self.n, self.k = len(system.speeds), len(system.dependent_speeds)
        self.inputs = Inputs(checked_values(system, inputs), inputs_of(system))
        self._memory: dict[Any, Any] = {}

    def read(self, part: str, t: Component, q: Row, u: Row) -> Any:
        """One of the parts of `EvaluatedDescription`."""
        return _parts.replay(part, self.system, (dict(self.inputs), t, tuple(q), tuple(u)), self._memory)

    def motion(self, t: Component, q: Row, u: Row) -> Motion:
        motion = self.system.motion(t, q, u)
        if not isinstance(motion, Motion):
            raise TypeError(f"{self.name}.motion must return a jaxkane.Motion, got {motion!r}.")
        return motion

    def loads_at(self, t: Component, q: Row, u: Row, motion: Motion) -> tuple[Load, ...]:
        return flatten_loads(self.system.loads(t, q, u, motion, self.inputs), f"{self.name}.loads")

    def rates(self, t: Component, q: Row, u: Row) -> Row:
        return self.read("rates", t, q, u)

    def configuration(self, t: Component, q: Row) -> Row:
        return self.read("configuration", t, q, (0.0,) * (self.n + self.k))

    def residuals(self, t: Component, q: Row, u: Row) -> Row:
        """Velocity residuals c(t, q, u), one for each dependent speed."""
        c = self.read("velocity_residuals", t, q, u)
        if len(c) == self.k:
            return c  # the configuration constraints, if there are any, are integrals of these
        h, h_dot = jvp(lambda t, *q: self.configuration(t, q), (t, *q), (1.0, *self.rates(t, q, u)))
        if len(c) + len(h) != self.k:
            names = ", ".join(self.system.dependent_speeds) or "none"
            raise ValueError(
                f"{self.name}: {self.k} dependent speeds are named ({names}), but there are {len(c)} velocity "
                f"residuals in its motion and {len(h)} configuration constraints. Name as many dependent speeds as "
                "there are velocity residuals; or as many as both together, and the constraints' rates are added."
            )
        return (*c, *h_dot)


class EvaluatedDescription:
    """A description at one time, coordinates and speeds, in parts that are components."""

    parts = ("rates", "configuration", "velocity_residuals", "bodies", "orientations")
    parts += ("velocities", "momenta", "frame_velocities", "forces")

    def __init__(self, evaluator: DescriptionEvaluator, t: Component, q: Row, u: Row):
        self.evaluator, self.t, self.q, self.u = evaluator, t, q, u

    def all_parts(self) -> dict[str, Any]:
        return {part: getattr(self, part)() for part in self.parts}

    @functools.cached_property
    def motion(self) -> Motion:
        return self.evaluator.motion(self.t, self.q, self.u)

    @functools.cached_property
    def loads(self) -> tuple[Load, ...]:
        # `loads` makes points of its own from these speeds. No exact zero may divide there.
        dtype = jnp.result_type(*([x for x in (*self.q, *self.u) if not is_exact(x)] or [float]))
        u = tuple(jnp.asarray(x, dtype) if is_exact(x) else x for x in self.u)
        return self.evaluator.loads_at(self.t, self.q, u, self.motion)

    def rates(self) -> Row:
        """q_dot (n_q,)."""
        system = self.evaluator.system
        return as_row(system.q_dot(self.t, self.q, self.u), system.coordinates, f"{self.evaluator.name}.q_dot")

    def configuration(self) -> Row:
        """Residuals (h,) of the configuration constraints."""
        residuals = self.evaluator.system.configuration_constraints(self.t, self.q)
        return flatten_residuals(residuals, f"{self.evaluator.name}: the residuals of configuration_constraints")

    def velocity_residuals(self) -> Row:
        """Those of the motion itself."""
        return self.motion.constraints

    def bodies(self) -> list[tuple[Component, Rows]]:
        """Masses and inertias, each in its body's frame."""
        return [(body.mass, body.inertia) for body in self.motion.bodies]

    def orientations(self) -> tuple[list[Rows], list[tuple[Row, ...]]]:
        """[R] of the frames in their parents; and of the bodies that turn in their frames, how, and their inertia."""
        spins = [
            ((x.angular_velocity - x.frame.angular_velocity).components_in(x.frame), *x.inertia)
            for x in turning_bodies(self.motion)
        ]
        return [frame._to_child for frame in frames_of(self.motion)], spins

    def velocities(self) -> tuple[list, list]:
        """Velocities (v, omega) of the bodies, each in the frame where it stands, and those that the loads act on."""
        bodies = [(b.center.velocity.components, b.angular_velocity.components_in(b.frame)) for b in self.motion.bodies]
        return bodies, [load.velocity.components for load in self.loads]

    def momenta(self) -> list[tuple[Row, Row]]:
        """p = m v and H = I . omega of the bodies."""
        return [
            (scale3(b.mass, b.center.velocity.components), matvec(b.inertia, b.angular_velocity.components_in(b.frame)))
            for b in self.motion.bodies
        ]

    def frame_velocities(self) -> list[tuple[Row, Row]]:
        """Angular velocities of the frames in which the bodies' momenta stand."""
        frames = [(body.center.velocity.frame, body.frame) for body in self.motion.bodies]
        return [(a.angular_velocity.components, b.angular_velocity.components) for a, b in frames]

    def forces(self) -> list[Row]:
        """The loads' vectors, in the frames of the velocities that they act on."""
        return [load.vector.components_in(load.velocity.frame) for load in self.loads]


@ScalarFunction
def _parts(system: System, components: Any) -> dict[str, Any]:
    inputs, t, q, u = components
    return EvaluatedDescription(DescriptionEvaluator(system, inputs), t, q, u).all_parts()


def turning_bodies(motion: Motion) -> list[Body]:
    """The bodies that turn in their frames."""
    return [body for body in motion.bodies if body.angular_velocity is not body.frame.angular_velocity]


def frames_of(motion: Motion, loads: Iterable[Load] = ()) -> list[Frame]:
    """All frames that bodies, named points and frames, and loads stand in, but for the inertial one."""
    starts = [*(body.frame for body in motion.bodies), *motion.frames.values()]
    vectors = (*(body.center for body in motion.bodies), *motion.points.values(), *loads)
    starts += [x.velocity.frame for x in vectors]
    frames: dict[Frame, None] = {}
    for start in starts:
        frame: Frame | None = start
        while frame is not None and frame.parent is not None and frame not in frames:
            frames[frame] = None
            frame = frame.parent
    return list(frames)


def structure_of(system: System) -> tuple[Any, ...]:
    """A description, apart from the values of its parameters."""
    return (version_of(system), jax.tree.structure(system), *(np.shape(x) for x in jax.tree.leaves(system)))


def dtype_of(system: System) -> Any:
    """The type of a system's parameters; that of Python's floats where it has none."""
    leaves = [x for x in jax.tree.leaves(system) if hasattr(x, "dtype")]
    dtypes = [x.dtype for x in leaves if jnp.issubdtype(x.dtype, jnp.floating)]
    return np.result_type(*dtypes) if dtypes else jnp.result_type(float)


def at_random_point(tree: tuple[System, Any, Any], rng: np.random.Generator) -> tuple[System, Any, Any]:
    """A random test point for what is traced: positive parameters, small coordinates; arrays of length 1, as axes and
    quaternions are, and unit matrices."""
    system, t, q = tree

    def parameter(x: Any) -> Any:
        if not isinstance(x, Tracer):
            return x
        if np.ndim(x) == 2 and x.shape[0] == x.shape[1]:
            return np.eye(len(x), dtype=x.dtype)
        value = rng.uniform(0.5, 1.5, x.shape)
        return np.asarray(value / np.linalg.norm(value) if value.ndim else value, x.dtype)

    system = jax.tree.map(parameter, system)
    if q is None or isinstance(q, Tracer):
        n, dtype = len(system.coordinates), dtype_of(system) if q is None else q.dtype
        q = rng.uniform(0.1, 0.5, n) * rng.choice((-1.0, 1.0), n)
        q = q.astype(dtype)
    return system, 0.3 if isinstance(t, Tracer) else t, np.asarray(q)


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

    def forcing(self, u_dot: Row | None = None) -> Row:
        """f of M u_dot = f, or f - M u_dot, without partial velocities: all vectors onto all speeds at once."""
        u_dot_all = None if u_dot is None else (*u_dot, *self.dependent_accelerations(u_dot))
        inertia = [tuple(scale3(-1.0, rate) for rate in rates) for rates in self.momentum_rates(u_dot_all)]
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
    q_dot, f = _rates_and_forcing(system, t, q, u, inputs)
    # The equation is differentiated, never the solution of the solve.
    times = lambda u_dot: _mass_times(system, t, q, u, inputs, u_dot)  # noqa: E731
    solve = lambda _, f: _accelerations_under(system, t, q, u, inputs, f)  # noqa: E731
    return q_dot, jax.lax.custom_linear_solve(times, f, solve, symmetric=True)


def motion_rates_by_matrix(
    system: System, t: Array, q: Array, u: Array, inputs: dict[str, Array]
) -> tuple[Float[Array, " n_q"], Float[Array, " n"]]:
    """As `motion_rates`, in operations that can be exported."""
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
    q_dot, f = _rates_and_forcing(system, t, q, u, inputs)
    return q_dot, _columns(system, t, q, u, inputs), f


def _columns(system: System, t: Array, q: Array, u: Array, inputs: dict[str, Array]) -> Float[Array, "n n"]:
    """M. Its columns are one program, whose lanes are the directions."""
    times = jax.vmap(lambda direction: _mass_times(system, t, q, u, inputs, direction))
    return times(np.eye(len(system.speeds), dtype=q.dtype))


def accelerations_and_mass_matrix(
    system: System, t: Array, q: Array, u: Array, inputs: dict[str, Array]
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """u_dot and M, from arrays that were checked."""
    if is_written_out(len(system.speeds)):
        return _accelerations_and_mass_matrix(system, t, q, u, inputs)
    return motion_rates(system, t, q, u, inputs)[1], _columns(system, t, q, u, inputs)


def _equations_at(system, t, q, u, inputs, u_dot, r):
    kane = KaneEquations(system, t, q, u, inputs)
    u_dot, r = (as_row(x, system.speeds, "u_dot") for x in (u_dot, r))
    solution = solve_positive(kane.mass_matrix(kane.partials()), r)
    return as_vector(kane.q_dot, q), as_vector(kane.forcing(u_dot), q), as_vector(solution, q)


@functools.partial(LinearSolution, equations=_equations_at)
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


def _accelerations_by_lapack(system, t, q, u, inputs, f):
    return solve_positive_array(_columns(system, t, q, u, inputs), f)


@functools.partial(ScalarSolve, by_lapack=_accelerations_by_lapack)
def _accelerations_under(system, t, q, u, inputs, u_dot):
    # M u_dot = f. Twice the kinetic energy is u^T M u = sum_i v_i . m_i v_i + omega_i . I_i omega_i
    kane = KaneEquations(system, t, q, u, inputs)
    direction = kane.with_dependent(as_row(u_dot, system.speeds, "u_dot"))
    vectors = [x for pair in kane.along_speeds(kane.velocities, direction)[0] for x in pair]
    rows: list[Row] = []
    for mass, inertia in kane.read("bodies", kane.t, kane.q, kane.u_all):
        rows += [(mass, 0.0, 0.0), (0.0, mass, 0.0), (0.0, 0.0, mass), *inertia]
    return stack(vectors).astype(q.dtype), stack(rows).astype(q.dtype).reshape(-1, 3, 3)
