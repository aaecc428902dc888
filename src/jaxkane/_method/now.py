"""What a description can read of one instant beside its speeds: accelerations and the forces of constraints.

`System.state_rates` and `System.outputs` are read here. Knows the method; knows no mechanism and no time.

A description may need accelerations, which are derivatives of what is being read. So it is read twice: the first
reading records the points and frames whose accelerations it needs; their velocities are differentiated along the
motion; the second reading receives the accelerations. A description that needs none is read once.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Self

import jax.numpy as jnp

from .._common.lookup import not_there
from .._description.frames import Frame
from .._description.motion import Motion
from .._description.points import Point
from .._description.system import System
from .._description.values import Values
from .._description.vectors import Vector
from .._scalars.components import add3, cross, is_exact
from .._scalars.types import Component
from .derivatives import jvp
from .kane import Instant
from .reactions import Reactions
from .values import Inputs, Row, inputs_of


class Now(Inputs):
    """One instant, as `state_rates` and `outputs` receive it: `now["command"]` is an input or a state by name.

    Attributes: `u_dot`, the time derivatives of all speeds, dependent ones too, by place and by name.
    """

    def __init__(self, instant: Instant, N: Frame, u_dot: Values, answers: Iterator[Row] | None):
        super().__init__(instant.inputs, inputs_of(instant.system))
        self.u_dot = u_dot
        self._instant, self._N, self._answers = instant, N, answers
        self._asked: list[Vector] = []

    def with_values(self, values: Mapping[str, Component]) -> Self:
        """The same instant, for a part of a system that receives other inputs than the system does."""
        other = copy.copy(self)
        other.update(values)
        return other

    def acceleration(self, point: Point) -> Vector:
        """Of a Point in the inertial frame [m/s^2]."""
        if not isinstance(point, Point):
            raise TypeError(f"now.acceleration(point): a Point is asked for, got {point!r}. Of a body, its `center`.")
        return self._rate(point.velocity)

    def angular_acceleration(self, frame: Frame) -> Vector:
        """Of a Frame in the inertial frame [rad/s^2]."""
        if not isinstance(frame, Frame):
            raise TypeError(f"now.angular_acceleration(frame): a Frame is asked for, got {frame!r}.")
        return self._rate(frame.angular_velocity)

    def force(self, name: str) -> Any:
        """What constraints carry at a named point [N] or frame [N m], a Vector, or along an auxiliary speed, a number:
        as `jaxkane.constraint_forces` gives it by that name."""
        forces = self._forces
        if name not in forces:
            raise not_there(name, forces, "the named points, frames and auxiliary speeds")
        found = forces[name]
        return self._N.vector(*found) if isinstance(found, tuple) else found

    @property
    def multipliers(self) -> Row:
        """Of the velocity residuals (k,): as `jaxkane.constraint_multipliers` gives them."""
        return self._reactions.multipliers

    @functools.cached_property
    def _reactions(self) -> Reactions:
        now = self._instant
        return Reactions(now.system, now.t, now.q, now.u, dict(now.inputs), self.u_dot[: now.n])

    @functools.cached_property
    def _forces(self) -> dict[str, Any]:
        return dict([*self._reactions.forces_of_parts(), *self._reactions.forces_of_auxiliary_speeds()])

    def _rate(self, vector: Vector) -> Vector:
        self._asked.append(vector)
        if self._answers is None:
            one = jnp.ones((), self._instant.dtype)
            return Vector(vector.frame, (one, one, one))
        return Vector(vector.frame, next(self._answers))  # type: ignore[arg-type]


Read = Callable[[System, Component, Row, Row, Motion, Now], Any]


def read_at(now: Instant, u_dot: Row, read: Read) -> Any:
    """What `read` finds in the description at an instant, whose independent speeds change with `u_dot` (n,)."""
    u_dot_all = (*u_dot, *now.dependent_accelerations(u_dot))
    names = (*now.system.speeds, *now.system.dependent_speeds)

    def reading(t: Component, q: Row, u: Row, answers: Iterator[Row] | None = None) -> tuple[Any, Now]:
        motion = now.motion(t, q, u)
        given = Now(now, motion.N, Values(u_dot_all, names), answers)
        return read(now.system, t, q, u, motion, given), given

    # Points that are made while it is read divide by speeds, perhaps: by no exact zero.
    q, u = (tuple(jnp.asarray(x, now.dtype) if is_exact(x) else x for x in row) for row in (now.q, now.u_all))
    found, given = reading(now.t, q, u)
    if not given._asked:
        return found
    n_q = len(q)

    def asked(t: Component, *z: Component) -> list[Row]:
        return [vector.components for vector in reading(t, z[:n_q], z[n_q:])[1]._asked]

    values, rates = jvp(asked, (now.t, *q, *u), (1.0, *now.q_dot, *u_dot_all))
    turning = [vector.frame.angular_velocity.components for vector in given._asked]
    # dv/dt in N = derivative of the components + omega x v
    answers = [add3(rate, cross(w, v)) for rate, w, v in zip(rates, turning, values, strict=True)]
    return reading(now.t, q, u, iter(answers))[0]
