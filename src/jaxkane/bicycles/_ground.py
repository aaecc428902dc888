"""The ground under a bicycle: level ground, a slope, or a road of given height.

The inertial frame N has x and y along the ground and z downwards. On a slope, N is aligned with the road's plane, so
gravity is tilted. On a road of given height N.z is vertical.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._scalarjit.components import Component, Scalar, add, dot, mul, sub
from .._system.kinematics import Frame, Point, Vector
from .._system.parameters import learned, parameter
from ..catalog.bicycle import TILT
from ._part import Contact, ParametricModule

Pair = tuple[Component, Component]
TURN = 2.0 * math.pi
_LOOK = np.outer([-1.0, 1.0], np.linspace(0.05, 1.5, 30)).ravel()  # [rad] from the contact along the tread


class Ground(ParametricModule):
    """Level ground; the base class of all others."""

    curved = False
    """Whether the normal depends on the position (a `Road`). The position of the front contact is then a coordinate."""

    def gravity(self, g: Component, N: Frame) -> Vector:
        """The acceleration of gravity [m/s^2]."""
        return g * N.z

    def place(self, N: Frame, x: Component, y: Component) -> Vector:
        """The vector from the origin to the point of the ground at x, y [m]."""
        return x * N.x + y * N.y

    def normal(self, N: Frame, x: Component, y: Component) -> Vector:
        """The unit normal of the ground, downwards."""
        return N.z

    def rates(self, x: Component, y: Component, yaw: Component, forward: Component, aside: Component) -> Pair:
        """Rates of x and y of a point that moves on the ground.

        **Arguments:**

        - `x`, `y` [m], `yaw` [rad]: position and heading.
        - `forward`, `aside` [m/s]: velocities along the heading and to its right.
        """
        cos, sin = jnp.cos(yaw), jnp.sin(yaw)
        return add(mul(forward, cos), mul(-1.0, mul(aside, sin))), add(mul(forward, sin), mul(aside, cos))

    def tangent(self, N: Frame, x: Component, y: Component, rates: Callable[[], Pair]) -> Frame:
        """A frame at a point of the ground, with z along the normal and x in a plane with N.x and N.z.

        **Arguments:**

        - `N`: the inertial frame.
        - `x`, `y` [m]: the point.
        - `rates`: () -> the rates of x and y [m/s].
        """
        return N


class Slope(Ground):
    """An inclined plane.

    **Arguments:**

    - `angle` [rad]: the inclination, less than a right angle.
    - `towards` [rad]: the uphill direction as a yaw angle: 0 along x, pi/2 along y.
    """

    angle: Scalar = parameter(within=TILT, unit="rad")
    towards: Scalar = parameter(0.0, within=(-TURN, TURN), unit="rad")

    def gravity(self, g, N):
        uphill = N.vector(jnp.cos(self.towards), jnp.sin(self.towards), 0.0)
        return g * (jnp.cos(self.angle) * N.z - jnp.sin(self.angle) * uphill)


class Road(Ground):
    """A road whose height is a smooth function of the position.

        Road(lambda x, y: 0.05 * jnp.exp(-(((x - 3.0) / 0.5) ** 2)))

    A wheel touches the road at one point, where it is tangent. The wheel cannot do so before an edge, or in a hollow
    that is sharper than the wheel. A simulation then ends with the reason "wheel touches twice", or "wheel off the
    road" if a step of the solver passed the edge. An initial state there is refused.

    **Arguments:**

    - `height`: x, y [m] -> upwards [m], by jax.numpy; or a callable pytree, whose arrays are parameters, e.g. an
        equinox module.
    """

    height: Any = learned()

    curved = True

    def at(self, x: Component, y: Component) -> Any:
        """The height [m], an array of shape ()."""
        z = jnp.asarray(self.height(x, y), float)
        if z.shape != ():
            raise ValueError(f"Road: `height` must return one number [m] for x, y; got an array of shape {z.shape}.")
        return z

    def slopes(self, x: Any, y: Any) -> tuple[Any, Any]:
        """dh/dx and dh/dy."""
        x, y = jnp.asarray(x, float), jnp.asarray(y, float)
        one = jnp.ones((), x.dtype)
        along_x, along_y = ((one, 0.0 * one), (0.0 * one, one))
        return jax.jvp(self.at, (x, y), along_x)[1], jax.jvp(self.at, (x, y), along_y)[1]

    def slope_rates(self, x: Any, y: Any, rates: Pair) -> Pair:
        """The rates of dh/dx and dh/dy at a moving point [1/s]; exactly zero if it does not move."""
        x, y = jnp.asarray(x, float), jnp.asarray(y, float)
        one = jnp.ones((), x.dtype)
        h_xx, h_xy = jax.jvp(self.slopes, (x, y), (one, 0.0 * one))[1]
        h_yy = jax.jvp(lambda y: self.slopes(x, y)[1], (y,), (one,))[1]
        return dot((h_xx, h_xy), rates), dot((h_xy, h_yy), rates)

    def place(self, N, x, y):
        return x * N.x + y * N.y - self.at(x, y) * N.z

    def climbing(self, x: Component, y: Component, rates: Pair) -> Component:
        """The rate of the height of a point that moves on the road [m/s]."""
        return dot(self.slopes(x, y), rates)

    def velocity(self, N: Frame, x: Component, y: Component, rates: Pair) -> Vector:
        """The velocity of a point that stays on the road [m/s]."""
        return N.vector(rates[0], rates[1], mul(-1.0, self.climbing(x, y, rates)))

    def normal(self, N, x, y):
        a, b = self.slopes(x, y)
        return N.vector(a, b, 1.0).normalize()

    def normal_rate(self, N: Frame, x: Component, y: Component, rates: Pair) -> Vector:
        """The rate of the normal at a moving point [1/s]."""
        (a, b), (a_dot, b_dot) = self.slopes(x, y), self.slope_rates(x, y, rates)
        shrink = 1.0 / jnp.sqrt(a * a + b * b + 1.0)
        n, change = shrink * N.vector(a, b, 1.0), shrink * N.vector(a_dot, b_dot, 0.0)
        return change - n.dot(change) * n

    def rates(self, x, y, yaw, forward, aside):
        a, b = self.slopes(x, y)
        length, of_x = jnp.sqrt(a * a + b * b + 1.0), jnp.sqrt(a * a + 1.0)
        ahead, right = super().rates(x, y, yaw, forward, aside)  # in the tangent plane
        along, across = mul(ahead, 1.0 / of_x), mul(right, 1.0 / (length * of_x))
        return sub(along, mul(across, a * b)), mul(across, of_x**2)

    def tangent(self, N, x, y, rates):
        # x is rotated about N.y by atan(a), then y about that x by -atan(b / s), s^2 = 1 + a^2.
        (a, b), (a_dot, b_dot) = self.slopes(x, y), self.slope_rates(x, y, rates())
        s2 = 1.0 + a * a
        s = jnp.sqrt(s2)
        tilt_rate = mul(sub(mul(a_dot, a * b), mul(b_dot, s2)), 1.0 / (s * (s2 + b * b)))
        turned = N.rotate(2, jnp.arctan(a), mul(a_dot, 1.0 / s2))
        return turned.rotate(1, -jnp.arctan(b / s), tilt_rate, "tangent")

    def clearance(self, N: Frame, contact: Contact, center: Point, radius: Any, crown: Any) -> Component:
        """The clearance of a wheel near its contact, relative to its clearance from the tangent plane.

        **Returns:** the minimum over some points of its tread. It is not positive if the wheel does not fit the road.
        """
        inner = radius if crown is None else radius - crown
        middle = center.position if crown is None else center.position + crown * contact.normal
        cos, sin = jnp.cos(_LOOK), jnp.sin(_LOOK)
        places = [
            m + inner * (cos * d + sin * h)
            for m, d, h in zip(*(v.components_in(N) for v in (middle, contact.down, contact.heading)), strict=True)
        ]
        above = -(places[2] + jax.vmap(self.at)(*places[:2]))
        return jnp.min(above / (inner * (1.0 - cos)))
