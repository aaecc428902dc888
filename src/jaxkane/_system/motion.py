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


def flatten_residuals(given: Any, what: str) -> tuple[Component, ...]:
    """Residuals out of numbers, arrays, Vectors (three components each) and nested tuples and lists of these."""
    if isinstance(given, Vector):
        return given.components
    if isinstance(given, (jax.Array, np.ndarray)) and given.ndim:
        return tuple(component(x) for x in given.reshape(-1))
    if isinstance(given, Iterable) and not isinstance(given, (str, Mapping, jax.Array, np.ndarray)):
        return tuple(x for item in given for x in flatten_residuals(item, what))
    try:
        return (component(given),)
    except TypeError:
        hint = " Does the method end without a `return`?" if given is None else ""
        raise TypeError(f"{what} are numbers and Vectors in a list, got {given!r}.{hint}") from None


_moments = itertools.count()


def now() -> int:
    """A number that is larger each time, which distinguishes a motion from one that was made before."""
    return next(_moments)


class NameTaken(ValueError):
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

    __slots__ = ("N", "_named", "bodies", "constraints", "frames", "made", "points", "vanishing")

    def __init__(
        self,
        bodies: Iterable[Body],
        constraints: Iterable[Component | Vector] = (),
        *,
        points: Mapping[str, Point] | None = None,
        frames: Mapping[str, Frame] | None = None,
    ):
        for what, given, kind in (("bodies", bodies, Body), ("constraints", constraints, (float, int, Vector))):
            if not isinstance(given, (kind, Iterable)) or isinstance(given, str):
                raise TypeError(f"Motion(bodies, constraints): the {what} are a list, got {given!r}.")
        for what, given in (("points", points), ("frames", frames)):
            if not isinstance(given, (Mapping, type(None))):
                raise TypeError(f"Motion: the {what} are a dict by name, as {{'P': P}}; got {given!r}.")
        self.bodies: tuple[Body, ...] = (bodies,) if isinstance(bodies, Body) else tuple(bodies)
        if not self.bodies:
            raise ValueError("A Motion needs at least one Body.")
        given = (constraints,) if isinstance(constraints, (Vector, float, int, jax.Array)) else tuple(constraints)
        self.vanishing = given  # the residuals as they were given
        self.constraints = flatten_residuals(given, "Motion(bodies, constraints): the velocity residuals")
        self.points = dict(points or {})
        self.frames = dict(frames or {})
        self._named = self._by_name()
        self.made = now()
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
        more = copy.copy(self)  # with what a class that inherits from this one knows besides
        bodies = (bodies,) if isinstance(bodies, Body) else tuple(bodies)
        given = (constraints,) if isinstance(constraints, (Vector, float, int, jax.Array)) else tuple(constraints)
        for kind, there, new in (("point", self.points, points), ("frame", self.frames, frames)):
            twice = [name for name in new or {} if name in there]
            if twice:
                raise NameTaken(f"Motion.extended: there is a {kind} of the name {twice[0]!r} already.")
        Motion.__init__(
            more,
            (*self.bodies, *bodies),
            (*self.vanishing, *given),
            points={**self.points, **(points or {})},
            frames={**self.frames, **(frames or {})},
        )
        return more

    def _by_name(self) -> dict[str, Body | Point | Frame]:
        named: dict[str, Any] = {}
        kinds = (
            (Body, [(getattr(body, "name", None), body) for body in self.bodies]),
            (Point, self.points.items()),
            (Frame, self.frames.items()),
        )
        for kind, parts in kinds:
            for name, part in parts:
                if not isinstance(part, kind):
                    raise TypeError(f"Motion: this is no {kind.__name__}, but stands among these: {part!r}.")
                if not isinstance(name, str):
                    raise TypeError(f"Motion: the name of {part!r} must be a string, got {name!r}.")
                if name in named and not (name == UNNAMED and kind is Body):
                    raise NameTaken(
                        f"Motion: two parts have the name {name!r}, {_kind_of(named[name])} and {_kind_of(part)}: "
                        f"motion[{name!r}] could be either. Give them different names."
                    )
                named[name] = part
        return named

    def __getitem__(self, name: str) -> Any:
        if name not in self._named:
            raise not_there(name, self._named, "this motion, among its bodies, points and frames")
        if name == UNNAMED and sum(body.name == UNNAMED for body in self.bodies) > 1:
            raise KeyError("Several bodies of this motion have no name of their own: Body(..., name=...).")
        return self._named[name]


def _kind_of(part: Body | Point | Frame) -> str:
    return f"a {type(part).__name__.lower()}"


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
