"""What `System.motion` returns: bodies, velocity residuals, and frames and points by name. Solves nothing."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Iterable, Mapping
from typing import Any, Self

import jax
import numpy as np

from .._common.lookup import not_there
from .._scalarjit.components import Component, component, dot
from .bodies import UNNAMED, Body, Force
from .kinematics import Frame, Point, Vector


def flatten_residuals(residuals: Any, label: str) -> tuple[Component, ...]:
    """Residuals out of numbers, arrays, Vectors (three components each) and nested tuples and lists of these."""
    if isinstance(residuals, Vector):
        return residuals.components
    if isinstance(residuals, (jax.Array, np.ndarray)) and residuals.ndim:
        return tuple(component(x) for x in residuals.reshape(-1))
    if isinstance(residuals, Iterable) and not isinstance(residuals, (str, Mapping, jax.Array, np.ndarray)):
        return tuple(x for item in residuals for x in flatten_residuals(item, label))
    try:
        return (component(residuals),)
    except TypeError:
        hint = " Does the method end without a `return`?" if residuals is None else ""
        raise TypeError(f"{label} are numbers and Vectors in a list, got {residuals!r}.{hint}") from None


motion_number = itertools.count().__next__
"""A number that is larger at every call: it distinguishes a motion from one that was made before."""


class DuplicateName(ValueError):
    """A body, a point or a frame with the name of another."""


class Motion:
    """What `System.motion` returns: bodies, velocity residuals, and the frames and points that others ask for.

    **Arguments:**

    - `bodies`: every Body.
    - `constraints`: velocity residuals [m/s or rad/s] that are zero in the motion and affine in the speeds; a Vector
        counts as its three components.
    - `points`, `frames`: those that `loads`, pictures or a user need, by name: `motion["P"]`.

    **Raises:** `ValueError` where one name stands for two of these; `TypeError` for what is no body, point or frame.
    """

    __slots__ = ("N", "_named", "bodies", "constraints", "frames", "number", "points", "residuals")

    def __init__(
        self,
        bodies: Iterable[Body],
        constraints: Iterable[Component | Vector] = (),
        *,
        points: Mapping[str, Point] | None = None,
        frames: Mapping[str, Frame] | None = None,
    ):
        for label, value, kind in (("bodies", bodies, Body), ("constraints", constraints, (float, int, Vector))):
            if not isinstance(value, (kind, Iterable)) or isinstance(value, str):
                raise TypeError(f"Motion(bodies, constraints): the {label} are a list, got {value!r}.")
        for label, value in (("points", points), ("frames", frames)):
            if not isinstance(value, (Mapping, type(None))):
                raise TypeError(f"Motion: the {label} are a dict by name, as {{'P': P}}; got {value!r}.")
        self.bodies = _as_tuple(bodies, Body)
        if not self.bodies:
            raise ValueError("A Motion needs at least one Body.")
        self.residuals = _as_tuple(constraints, (Vector, float, int, jax.Array))  # Vectors among them
        self.constraints = flatten_residuals(self.residuals, "Motion(bodies, constraints): the velocity residuals")
        self.points = dict(points or {})
        self.frames = dict(frames or {})
        self._named = self._by_name()
        self.number = motion_number()
        self.N: Frame = self.bodies[0].center.velocity.frame.root
        for name, part in (*self.points.items(), *self.frames.items()):
            part.name = name

    def extended(
        self,
        bodies: Iterable[Body] | Body = (),
        constraints: Iterable[Component | Vector] = (),
        *,
        points: Mapping[str, Point] | None = None,
        frames: Mapping[str, Frame] | None = None,
    ) -> Self:
        """The same motion and more, for a class that inherits from another system's.

            def motion(self, t, q, u):
                motion = super().motion(t, q, u)
                basket = jk.Body(self.load, 0.0, motion["S"].fixed(0.3 * motion["H"].x), name="basket")
                return motion.extended([basket])

        **Arguments:** as of `Motion`: what comes behind the bodies and residuals that there are, and under other names.
        """
        for kind, old, new in (("point", self.points, points), ("frame", self.frames, frames)):
            twice = [name for name in new or {} if name in old]
            if twice:
                raise DuplicateName(f"Motion.extended: there is a {kind} of the name {twice[0]!r} already.")
        extended = copy.copy(self)  # with the attributes that a subclass adds
        Motion.__init__(
            extended,
            (*self.bodies, *_as_tuple(bodies, Body)),
            (*self.residuals, *_as_tuple(constraints, (Vector, float, int, jax.Array))),
            points={**self.points, **(points or {})},
            frames={**self.frames, **(frames or {})},
        )
        return extended

    def _by_name(self) -> dict[str, Body | Point | Frame]:
        named: dict[str, Any] = {}
        parts = [(Body, getattr(body, "name", None), body) for body in self.bodies]
        parts += [(Point, *item) for item in self.points.items()] + [(Frame, *item) for item in self.frames.items()]
        for kind, name, part in parts:
            if not isinstance(part, kind):
                raise TypeError(f"Motion: this is no {kind.__name__}, but stands among these: {part!r}.")
            if not isinstance(name, str):
                raise TypeError(f"Motion: the name of {part!r} must be a string, got {name!r}.")
            if name in named and not (name == UNNAMED and kind is Body):
                kinds = " and ".join(f"a {type(each).__name__.lower()}" for each in (named[name], part))
                raise DuplicateName(
                    f"Motion: two parts have the name {name!r}, {kinds}: motion[{name!r}] could be either. Give them "
                    "different names."
                )
            named[name] = part
        return named

    def __getitem__(self, name: str) -> Any:
        if name not in self._named:
            raise not_there(name, self._named, "this motion, among its bodies, points and frames")
        if name == UNNAMED and sum(body.name == UNNAMED for body in self.bodies) > 1:
            raise KeyError("Several bodies of this motion have no name of their own: Body(..., name=...).")
        return self._named[name]


def _as_tuple(values: Any, one: Any) -> tuple[Any, ...]:
    return (values,) if isinstance(values, one) else tuple(values)


def weight(motion: Motion, gravity: Vector) -> tuple[Force, ...]:
    """The weight of every body of a motion; `gravity` [m/s^2] is a Vector such as `9.81 * N.z`."""
    if not isinstance(motion, Motion):
        raise TypeError(f"weight(motion, gravity): the first argument is a Motion, got {motion!r}.")
    return tuple(Force(body.mass * gravity, body.center) for body in motion.bodies)


def kinetic_energy_of(motion: Motion) -> Component:
    """1/2 sum of m v.v + omega . I . omega over the bodies [J]."""
    total: Component = 0.0
    for body in motion.bodies:
        v = body.center.velocity.components
        w = body.angular_velocity.components_in(body.frame)
        H = tuple(dot(row, w) for row in body.inertia)
        total = total + 0.5 * (body.mass * dot(v, v) + dot(w, H))
    return total
