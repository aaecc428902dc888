"""Where a bicycle is to go: paths, and a rider who looks ahead on them. Knows the place and the heading; no balance."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from .._description.parameters import learned, parameter
from .._scalars.types import Component, Scalar
from ..catalog.bicycle import TILT
from ._part import Part, check_parameters


class LaneChange(eqx.Module):
    """A path y(x) [m] from one lane to another, with continuous curvature.

        y = width * s^3 (10 - 15 s + 6 s^2),   s = (x - start) / length from 0 to 1

    **Arguments:** `width` [m], positive to the right (y of the bicycle); `start`, `length` [m]; `back` [m]: where it
    begins to come back, over the same length; None: it stays.
    """

    width: Scalar = parameter(3.0, unit="m")
    start: Scalar = parameter(10.0, unit="m")
    length: Scalar = parameter(20.0, positive=True, unit="m")
    back: Scalar | None = parameter(None, unit="m")

    def __check_init__(self) -> None:
        check_parameters(self)

    def __call__(self, x: Component) -> Component:
        aside = self._passed(x - self.start)
        return self.width * (aside if self.back is None else aside - self._passed(x - self.back))

    def _passed(self, along: Component) -> Component:
        s = jnp.clip(along / self.length, 0.0, 1.0)
        return s**3 * (10.0 + s * (6.0 * s - 15.0))


class PathFollower(Part):
    """Looks ahead to a point of a path, and asks for the roll of the turn that leads there.

        aside = (path(x + L cos(yaw)) - y - L sin(yaw)) cos(yaw),   L = speed * preview
        desired_roll = gain * limit * tanh(2 aside / (g preview^2) / limit)

    An arc that begins along the heading and meets the point `aside` needs the lateral acceleration 2 aside / preview^2;
    over g it is the roll of a steady turn. Small deviations from a straight path then follow
    y'' + 2 / preview y' + 2 / preview^2 y = 0, with a damping ratio of 0.71, as far as the balance is faster.

    It writes to "desired_roll", which a balance reads that stands behind it:
    `control=(PathFollower(LaneChange()), LeanSteerGains(...))`.

    **Arguments:**

    - `path`: a function y(x) [m] of numbers that JAX can trace, such as a `LaneChange`; its arrays are parameters. It
        should have a slope everywhere: a jump is followed, but as a jump of the desired roll.
    - `preview` [s]: how far ahead it looks. Too short, and it asks for faster turns than the balance can make.
    - `gain`: of the roll, where the balance does not lean as far as it is asked, see `follow_gain`. `limit` [rad]: the
        largest roll before that gain.
    """

    path: Any = learned()
    preview: Scalar = parameter(2.0, positive=True, within=(0.0, 100.0), unit="s")
    gain: Scalar = parameter(1.0)
    limit: Scalar = parameter(0.3, positive=True, within=TILT, unit="rad")

    def commands(self, bicycle, t, q, u, motion, values):
        cos, sin = jnp.cos(q["yaw"]), jnp.sin(q["yaw"])
        ahead = motion.rear.speed * self.preview
        aside = (self.path(q["x"] + ahead * cos) - q["y"] - ahead * sin) * cos
        roll = 2.0 * aside / (bicycle.g * self.preview**2)
        return {"desired_roll": self.gain * self.limit * jnp.tanh(roll / self.limit)}
