"""Kane's equations as a regressor: the equations are linear in the inertial parameters, one column each."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._common.lookup import as_names, refuse_any, refuse_unknown
from .._scalarjit.cache import Cache
from .._scalarjit.compat import concretely, depends_on
from .._scalarjit.components import ZERO3, Component, Numbers, Rows, add, add3, as_vector, is_zero, mul, stack
from .._scalarjit.scalar_function import ScalarFunction
from .._system.kinematics import Point, Vector
from .._system.motion import UNNAMED, Body, Force, Motion, parallel_axis
from .._system.system import System
from .arguments import Coordinates, InputArrays, InputValues, Row, Speeds, Time
from .description import DescriptionEvaluator, EvaluatedDescription, at_random_point, dtype_of, jvp, structure_of
from .kanes_method import KaneEquations

TEN = ("m", "mx", "my", "mz", "Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz")
"""Mass [kg], first moment [kg m], and inertia [kg m^2] as matrix entries, about the body's origin (`origin_of`)."""
UNITS = ("kg", *["kg m"] * 3, *["kg m^2"] * 6)


Bodies = str | Sequence[str] | Mapping[str, str | Sequence[str]] | None
"""Names of bodies, or a dict that gives the names of the parameters for each body. None selects all."""


class BodyParameters(NamedTuple):
    place: int  # index of the body in the bodies of the motion
    name: str
    about: str  # name of the point that the first moment and the inertia are about
    indices: tuple[int, ...] = tuple(range(10))  # of the parameters in TEN
    axis: int | None = None  # spin axis in the frame: both transverse moments of inertia are one parameter
    has_constant_mass: bool = False  # its mass is a constant in the code, not a parameter of the system

    @property
    def basis(self) -> np.ndarray:
        """(10, k): each parameter as a linear combination of the ten."""
        columns = np.eye(10)[:, list(self.indices)]
        if self._across in self.indices:
            columns[4:7, self.indices.index(self._across)] = [i != self.axis for i in range(3)]
        return columns

    @property
    def _across(self) -> int | None:
        return None if self.axis is None else 4 + (self.axis + 1) % 3

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"{self.name}.{'Iacross' if i == self._across else TEN[i]}" for i in self.indices)

    def only(self, names: Sequence[str] | str) -> BodyParameters:
        names = as_names(names, "names")
        known = [name.rpartition(".")[2] for name in self.names]
        refuse_unknown(names, known, f"`bodies`: {self.name} has no parameter", "it has")
        chosen = [i for i, name in zip(self.indices, known, strict=True) if name in names]
        return self._replace(indices=tuple(chosen))


class RegressorModel(eqx.Module):
    """A system and the bodies in its regressor. `leaves`: indices of the leaves on which the masses depend."""

    system: System
    bodies: tuple[BodyParameters, ...] = eqx.field(static=True)
    leaves: tuple[int, ...] = eqx.field(static=True)


def origin_of(body: Body) -> tuple[Point, list[Vector]]:
    """The farthest point in a body from which its mass centre was created, e.g. a joint; the vectors between them."""
    # If a body spins in its frame, only points of the axis are fixed in both.
    turns = not body.is_particle and body.angular_velocity is body.frame.angular_velocity
    point, way = body.center, []
    for base in [*point.chain()][1:]:
        relative = point._relative_motion
        is_fixed = relative is not None and relative.frame is body.frame
        if not (turns and is_fixed and all(map(is_zero, relative.velocity.components))):  # type: ignore[union-attr]
            break
        way.append(point._offset)
        point = base
    return point, way


_BODIES = Cache()  # by structure


def regressor_model(system: System, bodies: Bodies) -> RegressorModel:
    """A system and its named bodies, by default all bodies with a mass.

    **Raises:** `ValueError` for an unknown or repeated body, and for a parameter that the body does not have. Also for
    a body that rotates in its frame about an axis other than one of the frame's axes.
    """
    chosen, leaves = _BODIES.get(structure_of(system), lambda: _bodies_of(system))
    if bodies is not None:
        names, parameters = as_names(bodies, "bodies"), bodies if isinstance(bodies, Mapping) else {}
        known = [body.name for body in chosen]
        refuse_unknown(names, known, f"{type(system).__name__} has no body with a mass named", "it has")
        twice = sorted({name for name in names if names.count(name) > 1})
        refuse_any(twice, "`bodies` contains", " twice. Name each body once.")
        chosen = tuple(
            body if parameters.get(body.name) is None else body.only(parameters[body.name])
            for body in chosen
            if body.name in names
        )
    skew = [body.name for body in chosen if body.axis == SKEW]
    after = " rotates in its frame about an axis that is not an axis of the frame. "
    after += "Pass a frame that rotates with the body, or name only the other bodies in `bodies`."
    refuse_any(skew, f"{type(system).__name__}: the body", after)
    return RegressorModel(system, chosen, leaves)


def _bodies_of(system: System) -> tuple[tuple[BodyParameters, ...], tuple[int, ...]]:
    """The bodies with a mass, and the indices of the leaves on which the masses depend."""
    leaves, structure = jax.tree.flatten(system)
    motions: list[Motion] = []

    def masses_and_spins(leaves: list[Numbers], t: Component, q: Numbers, u: Numbers) -> tuple[list[Any], list[Any]]:
        motion = DescriptionEvaluator(jax.tree.unflatten(structure, leaves)).motion(t, tuple(q), tuple(u))
        motions[:] = [motion]
        bodies = [body for body in motion.bodies if not is_zero(body.mass)]
        spins = [body.angular_velocity - body.frame.angular_velocity for body in bodies]
        rows = [spin.components_in(body.frame) for spin, body in zip(spins, bodies, strict=True)]
        return [jnp.asarray(body.mass, float) for body in bodies], [jnp.stack([*map(jnp.asarray, row)]) for row in rows]

    number = jax.ShapeDtypeStruct((), dtype_of(system))
    n_u = len(system.speeds) + len(system.dependent_speeds)
    rows = [[number] * n for n in (len(system.coordinates), n_u)]
    program = jax.make_jaxpr(lambda *args: masses_and_spins(*args)[0])(leaves, number, *rows)
    (motion,) = motions
    bodies = [(i, body) for i, body in enumerate(motion.bodies) if not is_zero(body.mass)]
    axes: list[int | None] = [None] * len(bodies)
    spinning = [b.angular_velocity is not b.frame.angular_velocity and not b.is_particle for _, b in bodies]
    if any(spinning):
        rng = np.random.default_rng(0)
        point, t, q = at_random_point((system, 0.3, None), rng)
        u = rng.uniform(0.5, 1.5, n_u).astype(q.dtype)
        with concretely():
            at = jax.tree.leaves(point), jnp.asarray(t, q.dtype), list(q), list(u)
            spins = jax.device_get(jax.jit(lambda *args: masses_and_spins(*args)[1])(*at))
        axes = [_axis(spin) if spins_in_frame else None for spins_in_frame, spin in zip(spinning, spins, strict=True)]
    reads = np.array([depends_on(program, [i]) for i in range(len(leaves))], bool).reshape(len(leaves), -1)
    named = {point: name for name, point in motion.points.items()}
    unnamed = sum(body.name == UNNAMED for body in motion.bodies) > 1
    parameters = []
    for (i, body), axis, depends_on_leaves in zip(bodies, axes, reads.any(axis=0), strict=True):
        origin, _ = origin_of(body)
        indices = tuple(range(10))
        if body.is_particle:
            indices = (0,)
        elif axis is not None and axis != SKEW:
            indices = (0, 1 + axis, 4 + axis, 4 + (axis + 1) % 3)
        name = f"{body.name}[{i}]" if unnamed and body.name == UNNAMED else body.name
        about = "its mass centre" if origin is body.center else named.get(origin, origin.name)
        parameters.append(BodyParameters(i, name, about, indices, axis, not depends_on_leaves))
    return tuple(parameters), tuple(int(i) for i in np.flatnonzero(reads.any(axis=1)))


SKEW = -1  # the body rotates in its frame about an axis that is not one of the frame's axes


def _axis(spin: np.ndarray) -> int | None:
    """The axis of the frame about which an axisymmetric body spins. None if the body rotates with its frame."""
    turning = np.flatnonzero(np.abs(spin) > np.finfo(spin.dtype).eps ** 0.5 * max(1.0, float(np.abs(spin).max())))
    return None if not turning.size else int(turning[0]) if turning.size == 1 else SKEW


class RegressorKinematics(NamedTuple):
    """Kinematics of the origins of b bodies. Components are in the frame of the body."""

    V: Float[Array, "b 3 n"]  # partial velocities
    W: Float[Array, "b 3 n"]  # partial angular velocities
    a: Float[Array, "b 3"]  # [m/s^2]
    alpha: Float[Array, "b 3"]
    omega: Float[Array, "b 3"]
    g: Float[Array, "b 3"]  # weight per mass [m/s^2]


class _EvaluatedOrigins(EvaluatedDescription):
    """As `EvaluatedDescription`, with the velocities of the bodies' origins instead of the momenta."""

    quantities = ("rates", "configuration", "velocity_residuals", "velocities", "momenta", "frame_velocities")

    def __init__(self, evaluator: DescriptionEvaluator, bodies: tuple[BodyParameters, ...], *at: Any):
        super().__init__(evaluator, *at)
        self._parameters = bodies

    @functools.cached_property
    def _origins(self) -> list[tuple[Body, Point]]:
        bodies = [self.motion.bodies[body.place] for body in self._parameters]
        return [(body, origin_of(body)[0]) for body in bodies]

    def velocities(self) -> tuple[list, list]:
        return self.momenta(), []

    def momenta(self) -> list[tuple[Row, Row]]:
        return [(P.velocity.components, b.angular_velocity.components_in(b.frame)) for b, P in self._origins]

    def frame_velocities(self) -> list[tuple[Row, Row]]:
        frames = [(origin.velocity.frame, body.frame) for body, origin in self._origins]
        return [(a.angular_velocity.components, b.angular_velocity.components) for a, b in frames]


@ScalarFunction
def _quantities_of_origins(model: RegressorModel, components: PyTree) -> dict[str, Any]:
    inputs, t, q, u = components
    return _EvaluatedOrigins(DescriptionEvaluator(model.system, inputs), model.bodies, t, q, u).all_quantities()


class _OriginKinematics(KaneEquations):
    """Kane's equations at a state. `velocities` and `momenta` return the velocities of the bodies' origins."""

    def __init__(self, model: RegressorModel, t: Component, q: Numbers, u: Numbers, inputs: InputValues):
        self.model = model
        super().__init__(model.system, t, q, u, inputs)

    def read(self, quantity: str, t: Component, q: Row, u: Row) -> PyTree:
        components = dict(self.inputs), t, tuple(q), tuple(u)
        return _quantities_of_origins.replay(quantity, self.model, components, self._memory)

    def weights(self) -> list[tuple[Component, Row]]:
        """For each body, derivatives of the mass and of the forces at the mass centre, along a change of the mass.

        The change is made in the parameters on which the masses depend. A mass that does not depend on parameters is
        changed in the `Body`, from which `weight` reads it.
        """
        leaves, structure = jax.tree.flatten(self.system)
        places, parameters = self.model.leaves, self.model.bodies
        u = tuple(jnp.asarray(x, self._zero().dtype) for x in self.u_all)

        def masses_and_weights(*values: Any) -> list[tuple[Component, Row]]:
            *own, added_mass = values
            changed = list(leaves)
            for i, x in zip(places, own, strict=True):
                changed[i] = x
            evaluator = DescriptionEvaluator(jax.tree.unflatten(structure, changed), self.inputs)
            motion = evaluator.motion(self.t, self.q, u)
            bodies = [motion.bodies[each.place] for each in parameters]
            for body, each in zip(bodies, parameters, strict=True):
                body.mass = add(body.mass, added_mass) if each.has_constant_mass else body.mass
            loads = evaluator.loads_at(self.t, self.q, u, motion)
            at_center = [
                [x.vector.components_in(body.frame) for x in loads if isinstance(x, Force) and x.point is body.center]
                for body in bodies
            ]
            return [
                (body.mass, functools.reduce(add3, each, ZERO3)) for body, each in zip(bodies, at_center, strict=True)
            ]

        primals = [*[leaves[i] for i in places], self._zero()]
        # Use a different tangent for each parameter, so that no sum or difference of them remains constant.
        tangents = [jnp.full_like(x, 1.0 + 0.1 * i) for i, x in enumerate(primals)]
        return jvp(masses_and_weights, primals, tangents)[1]


@ScalarFunction
def regressor_kinematics(
    model: RegressorModel, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays, u_dot: Speeds
) -> RegressorKinematics:
    """Kinematics of the bodies of a model, at accelerations `u_dot` (n,) of the independent speeds."""
    kane = _OriginKinematics(model, t, q, u, inputs)
    row = tuple(u_dot[i] for i in range(kane.n))
    partials = kane.partial_velocities()
    rates = kane.momentum_rates((*row, *kane.dependent_accelerations(row)))
    omegas = [omega for _, omega in kane.momenta(kane.u_all)]
    motion = kane.motion(kane.t, kane.q, kane.u_all)
    V, W, a, alpha, g = [], [], [], [], []
    for i, (each, (dm, dF)) in enumerate(zip(model.bodies, kane.weights(), strict=True)):
        body = motion.bodies[each.place]
        own = origin_of(body)[0].velocity.frame
        *v, a_i = (own.vector(*x).components_in(body.frame) for x in (*(b[i][0] for b, _ in partials), rates[i][0]))
        V.append(v)
        W.append([bodies[i][1] for bodies, _ in partials])
        a.append(a_i)
        alpha.append(rates[i][1])
        dm = jnp.asarray(dm)
        reciprocal = jnp.where(dm == 0.0, 0.0, 1.0 / jnp.where(dm == 0.0, 1.0, dm))
        g.append(tuple(mul(x, reciprocal) for x in dF))
    n, b = kane.n, len(model.bodies)

    def array(rows: Rows, *shape: int) -> Array:
        return stack(rows).astype(q.dtype).reshape(b, *shape, 3) if b else jnp.zeros((0, *shape, 3), q.dtype)

    V, W = (jnp.swapaxes(array([x for row in rows for x in row], n), 1, 2) for rows in (V, W))  # (b,3,n)
    return RegressorKinematics(V, W, array(a), array(alpha), array(omegas), array(g))


def regressor_columns(kinematics: RegressorKinematics, bodies: Sequence[BodyParameters]) -> Float[Array, "n p"]:
    """The columns of the parameters of all bodies, side by side.

    For the ten parameters (m, m r, I) of a body about its origin, where a is the acceleration minus the weight per
    mass:

        F = m a + alpha x m r + omega x (omega x m r),   T = m r x a + I alpha + omega x I omega
    """
    # By default, JAX multiplies float32 matrices on NVIDIA GPUs with mantissas of 10 bits (TF32): relative errors of
    # 3e-4 were measured on an H100.
    with jax.default_matmul_precision("highest"):
        V, W, a, alpha, omega, g = kinematics
        a = a - g
        turn = _cross(omega)
        of_moment = _cross(alpha) + turn @ turn
        zero = jnp.zeros_like(of_moment)
        F = jnp.concatenate([a[:, :, None], of_moment, zero, zero], axis=2)  # (b,3,10)
        T = jnp.concatenate([jnp.zeros_like(a)[:, :, None], -_cross(a), _times(alpha) + turn @ _times(omega)], axis=2)
        Y = jnp.swapaxes(V, 1, 2) @ F + jnp.swapaxes(W, 1, 2) @ T  # (b,n,10)
        columns = [Y[i] @ jnp.asarray(body.basis, Y.dtype) for i, body in enumerate(bodies)]
        return jnp.concatenate([jnp.zeros((V.shape[2], 0), Y.dtype), *columns], axis=1)


@ScalarFunction
def parameter_values(model: RegressorModel, t: Time, q: Coordinates, u: Speeds) -> Float[Array, " p"]:
    """The parameters of the bodies, in the order of the columns. They do not depend on time. `u` has shape (n + k,)."""
    rows = [tuple(x[i] for i in range(x.shape[0])) for x in (q, u)]
    motion = DescriptionEvaluator(model.system).motion(t, *rows)
    values = [_ten(motion.bodies[each.place])[i] for each in model.bodies for i in each.indices]
    return as_vector(values, q) if values else jnp.zeros(0, q.dtype)


def _ten(body: Body) -> Row:
    m, steps = body.mass, [step.components_in(body.frame) for step in origin_of(body)[1]]
    r = functools.reduce(add3, steps, ZERO3)
    I = parallel_axis(body.inertia, mul(-1.0, m), r)
    return (m, *(mul(m, x) for x in r), I[0][0], I[1][1], I[2][2], I[0][1], I[0][2], I[1][2])


def _cross(x: Float[Array, "b 3"]) -> Float[Array, "b 3 3"]:
    """[x]: x cross y = [x] y."""
    zero = jnp.zeros_like(x[:, 0])
    a, b, c = x[:, 0], x[:, 1], x[:, 2]
    return jnp.stack([zero, -c, b, c, zero, -a, -b, a, zero], axis=1).reshape(-1, 3, 3)


def _times(x: Float[Array, "b 3"]) -> Float[Array, "b 3 6"]:
    """The matrix that maps (Ixx, Iyy, Izz, Ixy, Ixz, Iyz) to I x."""
    zero = jnp.zeros_like(x[:, 0])
    a, b, c = x[:, 0], x[:, 1], x[:, 2]
    rows = [a, zero, zero, b, c, zero, zero, b, zero, a, zero, c, zero, zero, c, zero, a, b]
    return jnp.stack(rows, axis=1).reshape(-1, 3, 6)


@ScalarFunction
def unbalanced(
    system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays, u_dot: Speeds
) -> Float[Array, " n"]:
    """-(F_r + F*_r) (n,) at accelerations `u_dot`. It is zero at the accelerations of the motion."""
    kane = KaneEquations(system, t, q, u, inputs)
    row = tuple(u_dot[i] for i in range(kane.n))
    partials = kane.partial_velocities()
    inertia = kane.inertia_forces(partials, (*row, *kane.dependent_accelerations(row)))
    return as_vector([mul(-1.0, add(x, F)) for x, F in zip(inertia, kane.active_forces(partials), strict=True)], q)
