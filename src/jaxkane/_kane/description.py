"""The evaluation of a system: its positions, velocities, residuals and loads as scalars, and their derivatives."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from .._common.lookup import checked, refuse_any, refuse_if
from .._scalarjit.cache_key import version_of
from .._scalarjit.compat import Tracer
from .._scalarjit.components import (
    Component,
    Numbers,
    Rows,
    is_exact,
    is_zero,
    matvec,
    scale3,
)
from .._scalarjit.scalar_function import ScalarFunction
from .._system.kinematics import Frame
from .._system.motion import Body, Load, Motion, SomeComponents, flatten_loads, residual_groups
from .._system.parameters import in_batches
from .._system.system import System
from .arguments import Inputs, Row, as_row, checked_values, inputs_of


def jvp(f: Callable[..., Any], primals: Sequence[Component], tangents: Sequence[Component]) -> tuple[Any, Any]:
    """`jax.jvp` of a function of components. Exact inputs and outputs stay exact; their derivatives are exact zeros."""
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


def transposed(f: Callable[..., Any], primals: Sequence[Component], cotangents: PyTree) -> Row:
    """`jax.vjp` of a function of components: the transposed derivative of `f` at `primals`, times `cotangents`.

    `cotangents` have the structure of the outputs of f. Exact outputs are constants, so their cotangents are ignored.
    """
    moves: list[bool] = []

    def arrays_only(*xs):
        leaves = jax.tree.leaves(f(*xs))
        moves[:] = [not is_exact(x) for x in leaves]
        return [x for x in leaves if not is_exact(x)]

    outputs, pull = jax.vjp(arrays_only, *primals)
    leaves = [ct for ct, m in zip(jax.tree.leaves(cotangents), moves, strict=True) if m]
    return pull([jnp.asarray(ct, dtype=x.dtype) for ct, x in zip(leaves, outputs, strict=True)])


class DescriptionEvaluator:
    """Evaluates a system at any time, coordinates and speeds.

    `read` returns quantities of the system as components, from a trace that is recorded once. `motion` calls the method
    of the system.
    """

    def __init__(self, system: System, inputs: Mapping[str, Component] | None = None):
        self.system = system
        self.name = type(system).__name__
        after = " has more axes than declared. For a batch of systems, use jax.vmap or jaxkane.sweep.sweep."
        refuse_any(in_batches(system), f"{self.name}:", after)
        self.n, self.k = len(system.speeds), len(system.dependent_speeds)
        self.inputs = Inputs(checked_values(system, inputs), inputs_of(system))
        self._memory: dict[Any, Any] = {}

    def read(self, quantity: str, t: Component, q: Row, u: Row) -> PyTree:
        """One of the `quantities` of `EvaluatedDescription`, by name."""
        return _quantities.replay(quantity, self.system, (dict(self.inputs), t, tuple(q), tuple(u)), self._memory)

    def motion(self, t: Component, q: Row, u: Row) -> Motion:
        motion = checked(self.system.motion(t, q, u), Motion, f"{self.name}.motion must return a jaxkane.Motion")
        refuse_if(self.n and not motion.bodies, f"{self.name} has speeds, so its Motion needs at least one Body.")
        return motion

    def loads_at(self, t: Component, q: Row, u: Row, motion: Motion) -> tuple[Load, ...]:
        return flatten_loads(self.system.loads(t, q, u, motion, self.inputs), f"{self.name}.loads")

    def rates(self, t: Component, q: Row, u: Row) -> Row:
        return self.read("rates", t, q, u)

    def configuration(self, t: Component, q: Row) -> Row:
        return self.read("configuration", t, q, (0.0,) * (self.n + self.k))

    def residuals(self, t: Component, q: Row, u: Row) -> Row:
        """Velocity residuals c(t, q, u) (k,), one for each dependent speed."""
        c = self.read("velocity_residuals", t, q, u)
        if len(c) == self.k:
            return c  # the configuration constraints, if any, are integrals of these residuals
        h, h_dot = jvp(lambda t, *q: self.configuration(t, q), (t, *q), (1.0, *self.rates(t, q, u)))
        if len(c) + len(h) != self.k:
            names = ", ".join(self.system.dependent_speeds) or "none"
            raise ValueError(
                f"{self.name}: {self.k} dependent speeds are named ({names}), but its motion has {len(c)} velocity "
                f"residuals and there are {len(h)} configuration constraints. Name one dependent speed for each "
                "velocity residual, or one for each residual and each constraint: the rates of the constraints are "
                "then added."
            )
        return (*c, *h_dot)


class EvaluatedDescription:
    """The quantities of a system at one time, coordinates and speeds, as components."""

    quantities = ("rates", "configuration", "configuration_vectors", "velocity_residuals", "bodies", "orientations")
    quantities += ("velocities", "momenta", "frame_velocities", "forces")

    def __init__(self, evaluator: DescriptionEvaluator, t: Component, q: Row, u: Row):
        self.evaluator, self.t, self.q, self.u = evaluator, t, q, u

    def all_quantities(self) -> dict[str, Any]:
        return {name: getattr(self, name)() for name in self.quantities}

    @functools.cached_property
    def motion(self) -> Motion:
        return self.evaluator.motion(self.t, self.q, self.u)

    @functools.cached_property
    def loads(self) -> tuple[Load, ...]:
        # `loads` may divide by a speed. An exact zero would raise ZeroDivisionError there, so pass arrays.
        dtype = jnp.result_type(*([x for x in (*self.q, *self.u) if not is_exact(x)] or [float]))
        u = tuple(jnp.asarray(x, dtype) if is_exact(x) else x for x in self.u)
        return self.evaluator.loads_at(self.t, self.q, u, self.motion)

    def rates(self) -> Row:
        system = self.evaluator.system
        return as_row(system.q_dot(self.t, self.q, self.u), system.coordinates, f"{self.evaluator.name}.q_dot")

    @functools.cached_property
    def residual_groups(self) -> list[SomeComponents]:
        residuals = self.evaluator.system.configuration_constraints(self.t, self.q)
        return [*residual_groups(residuals, f"{self.evaluator.name}: the residuals of configuration_constraints")]

    def configuration(self) -> Row:
        return tuple(x for group in self.residual_groups for x in group.components)

    def configuration_vectors(self) -> list[Row]:
        """For each of these residuals, all components of the vector that contains it."""
        return [group.all for group in self.residual_groups for _ in group.components]

    def velocity_residuals(self) -> Row:
        return self.motion.constraints

    def bodies(self) -> list[tuple[Component, Rows]]:
        """Masses and inertias, with components in the frame of the body."""
        return [(body.mass, body.inertia) for body in self.motion.bodies]

    def orientations(self) -> tuple[list[Rows], list[tuple[Row, ...]]]:
        """Rotation matrices of the frames in their parents. For bodies that rotate in their frames: angular velocity
        in the frame and the inertia."""
        spins = [
            ((x.angular_velocity - x.frame.angular_velocity).components_in(x.frame), *x.inertia)
            for x in turning_bodies(self.motion)
        ]
        return [frame._to_child for frame in frames_of(self.motion)], spins

    def velocities(self) -> tuple[list, list]:
        """Velocities (v, omega) of the bodies, and of the points and frames of the loads, each in its own frame."""
        bodies = [(b.center.velocity.components, b.angular_velocity.components_in(b.frame)) for b in self.motion.bodies]
        return bodies, [load.velocity.components for load in self.loads]

    def momenta(self) -> list[tuple[Row, Row]]:
        return [
            (scale3(b.mass, b.center.velocity.components), matvec(b.inertia, b.angular_velocity.components_in(b.frame)))
            for b in self.motion.bodies
        ]

    def frame_velocities(self) -> list[tuple[Row, Row]]:
        """Angular velocities of the frames in which the components of the momenta are given."""
        frames = [(body.center.velocity.frame, body.frame) for body in self.motion.bodies]
        return [(a.angular_velocity.components, b.angular_velocity.components) for a, b in frames]

    def forces(self) -> list[Row]:
        """The vectors of the loads, in the frames of the velocities of their points and frames."""
        return [load.vector.components_in(load.velocity.frame) for load in self.loads]


@ScalarFunction
def _quantities(system: System, components: PyTree) -> dict[str, Any]:
    inputs, t, q, u = components
    return EvaluatedDescription(DescriptionEvaluator(system, inputs), t, q, u).all_quantities()


def turning_bodies(motion: Motion) -> list[Body]:
    return [body for body in motion.bodies if body.angular_velocity is not body.frame.angular_velocity]


def frames_of(motion: Motion, loads: Iterable[Load] = ()) -> list[Frame]:
    """All frames of bodies, named points, named frames and loads, except N."""
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
    """A key of a system that does not depend on the values of its parameters."""
    return (version_of(system), jax.tree.structure(system), *(np.shape(x) for x in jax.tree.leaves(system)))


def dtype_of(system: System) -> Any:
    """The dtype of the parameters of a system, or the default dtype if it has no parameters."""
    leaves = [x for x in jax.tree.leaves(system) if hasattr(x, "dtype")]
    dtypes = [x.dtype for x in leaves if jnp.issubdtype(x.dtype, jnp.floating)]
    return np.result_type(*dtypes) if dtypes else jnp.result_type(float)


def at_random_point(tree: tuple[System, Any, Any], rng: np.random.Generator) -> tuple[System, Any, Any]:
    """Replace traced values by random test values: positive parameters and small coordinates. Vectors have length 1,
    because they may be axes or quaternions. Square matrices are unit matrices."""
    system, t, q = tree

    def parameter(x: Numbers) -> Any:
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
