"""What the description of a system says at a time, in parts that are components. Knows no equation of motion."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from typing import Any

import jax.numpy as jnp

from .._description.bodies import Body
from .._description.frames import Frame
from .._description.loads import Load, flatten_loads
from .._description.motion import Motion, flatten_residuals
from .._description.parameters import in_batches
from .._description.system import System
from .._scalars.components import is_exact, matvec, scale3
from .._scalars.linear import Rows
from .._scalars.record import recorded
from .._scalars.types import Component
from .derivatives import jvp
from .values import Inputs, Row, as_row, checked_values, inputs_of


class Reading:
    """What the description of a system says, at any time, coordinates and speeds.

    `read` gives parts of it as components, from a record of the description; `motion` reads the description itself.
    """

    def __init__(self, system: System, inputs: Mapping[str, Component] | None = None):
        self.system = system
        self.name = type(system).__name__
        if several := in_batches(system):
            raise ValueError(
                f"{self.name}: {', '.join(several)} has more axes than it was declared with. For a batch of systems "
                "use jax.vmap, or jaxkane.sweep.sweep for their motions."
            )
        self.n, self.k = len(system.speeds), len(system.dependent_speeds)
        self.inputs = Inputs(checked_values(system, inputs), inputs_of(system))
        self._memory: dict[Any, Any] = {}

    def read(self, part: str, t: Component, q: Row, u: Row) -> Any:
        """One of the parts of `Parts`."""
        return _parts(part, self.system, (dict(self.inputs), t, tuple(q), tuple(u)), self._memory)

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
        rolling = self.read("rolling", t, q, u)
        if len(rolling) == self.k:
            return rolling  # the configuration constraints, if there are any, are integrals of these
        h, h_dot = jvp(lambda t, *q: self.configuration(t, q), (t, *q), (1.0, *self.rates(t, q, u)))
        if len(rolling) + len(h) != self.k:
            names = ", ".join(self.system.dependent_speeds) or "none"
            raise ValueError(
                f"{self.name}: {self.k} dependent speeds are named ({names}), but there are {len(rolling)} velocity "
                f"residuals in its motion and {len(h)} configuration constraints. Name as many dependent speeds as "
                "there are velocity residuals; or as many as both together, and the constraints' rates are added."
            )
        return (*rolling, *h_dot)


class Parts:
    """What a description says at one time, coordinates and speeds, in parts that are components."""

    def __init__(self, reading: Reading, t: Component, q: Row, u: Row):
        self.reading, self.t, self.q, self.u = reading, t, q, u

    @functools.cached_property
    def motion(self) -> Motion:
        return self.reading.motion(self.t, self.q, self.u)

    @functools.cached_property
    def loads(self) -> tuple[Load, ...]:
        # `loads` makes points of its own from the speeds that it is given. No exact zero may divide there.
        dtype = jnp.result_type(*([x for x in (*self.q, *self.u) if not is_exact(x)] or [float]))
        u = tuple(jnp.asarray(x, dtype) if is_exact(x) else x for x in self.u)
        return self.reading.loads_at(self.t, self.q, u, self.motion)

    def rates(self) -> Row:
        """q_dot (n_q,)."""
        q_dot = self.reading.system.q_dot(self.t, self.q, self.u)
        return as_row(q_dot, self.reading.system.coordinates, f"{self.reading.name}.q_dot")

    def configuration(self) -> Row:
        """Residuals (h,) of the configuration constraints."""
        residuals = self.reading.system.configuration_constraints(self.t, self.q)
        return flatten_residuals(residuals, f"{self.reading.name}: the residuals of configuration_constraints")

    def rolling(self) -> Row:
        """The velocity residuals of the motion itself."""
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
        return [_momenta(body) for body in self.motion.bodies]

    def turning(self) -> list[tuple[Row, Row]]:
        """Angular velocities of the frames in which the bodies' momenta stand."""
        frames = [(body.center.velocity.frame, body.frame) for body in self.motion.bodies]
        return [(a.angular_velocity.components, b.angular_velocity.components) for a, b in frames]

    def forces(self) -> list[Row]:
        """The loads' vectors, in the frames of the velocities that they act on."""
        return [load.vector.components_in(load.velocity.frame) for load in self.loads]


def turning_bodies(motion: Motion) -> list[Body]:
    """The bodies that turn in their frames."""
    return [body for body in motion.bodies if body.angular_velocity is not body.frame.angular_velocity]


def frames_of(motion: Motion, loads: Iterable[Load] = ()) -> list[Frame]:
    """All frames that bodies, named points and frames, and loads stand in, but for the inertial one."""
    starts = [*(body.frame for body in motion.bodies), *motion.frames.values()]
    vectors = (*(body.center for body in motion.bodies), *motion.points.values(), *loads)
    starts += [x.velocity.frame for x in vectors]
    seen: dict[Frame, None] = {}
    for start in starts:
        frame: Frame | None = start
        while frame is not None and frame.parent is not None and frame not in seen:
            seen[frame] = None
            frame = frame.parent
    return list(seen)


@recorded
def _parts(system: System, components: Any) -> dict[str, Any]:
    inputs, t, q, u = components
    said = Parts(Reading(system, inputs), t, q, u)
    parts = "rates configuration rolling bodies orientations velocities momenta turning forces"
    return {part: getattr(said, part)() for part in parts.split()}


def _momenta(body: Body) -> tuple[Row, Row]:
    p = scale3(body.mass, body.center.velocity.components)
    H = matvec(body.inertia, body.angular_velocity.components_in(body.frame))
    return p, H
