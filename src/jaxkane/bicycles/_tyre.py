"""The ground under a bicycle, and tyres: their shape, rolling with or without slip, and laws of forces and moments.

The ground is level, a slope, or a road of given height. The inertial frame N has x and y along the ground and z
downwards. On a slope, N is aligned with the road's plane, so gravity is tilted. On a road of given height N.z is
vertical.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._scalarjit.components import Component, Scalar, add, dot, is_zero, mul, sub
from .._system.kinematics import Frame, Point, Vector
from .._system.motion import Body, Force, Torque
from .._system.parameters import learned, parameter
from ..catalog.bicycle import FAR, TILT
from ._part import Contact, ParametricModule, called

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

    def gravity(self, g: Component, N: Frame) -> Vector:
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

    def at(self, x: Component, y: Component) -> Float[Array, ""]:
        """The height [m], an array of shape ()."""
        z = jnp.asarray(self.height(x, y), float)
        if z.shape != ():
            raise ValueError(f"Road: `height` must return one number [m] for x, y; got an array of shape {z.shape}.")
        return z

    def slopes(self, x: Component, y: Component) -> Pair:
        """dh/dx and dh/dy."""
        x, y = jnp.asarray(x, float), jnp.asarray(y, float)
        one = jnp.ones((), x.dtype)
        along_x, along_y = ((one, 0.0 * one), (0.0 * one, one))
        return jax.jvp(self.at, (x, y), along_x)[1], jax.jvp(self.at, (x, y), along_y)[1]

    def slope_rates(self, x: Component, y: Component, rates: Pair) -> Pair:
        """The rates of dh/dx and dh/dy at a moving point [1/s]; exactly zero if it does not move."""
        x, y = jnp.asarray(x, float), jnp.asarray(y, float)
        one = jnp.ones((), x.dtype)
        h_xx, h_xy = jax.jvp(self.slopes, (x, y), (one, 0.0 * one))[1]
        h_yy = jax.jvp(lambda y: self.slopes(x, y)[1], (y,), (one,))[1]
        return dot((h_xx, h_xy), rates), dot((h_xy, h_yy), rates)

    def place(self, N: Frame, x: Component, y: Component) -> Vector:
        return x * N.x + y * N.y - self.at(x, y) * N.z

    def climbing(self, x: Component, y: Component, rates: Pair) -> Component:
        """The rate of the height of a point that moves on the road [m/s]."""
        return dot(self.slopes(x, y), rates)

    def velocity(self, N: Frame, x: Component, y: Component, rates: Pair) -> Vector:
        """The velocity of a point that stays on the road [m/s]."""
        return N.vector(rates[0], rates[1], mul(-1.0, self.climbing(x, y, rates)))

    def normal(self, N: Frame, x: Component, y: Component) -> Vector:
        a, b = self.slopes(x, y)
        return N.vector(a, b, 1.0).normalize()

    def normal_rate(self, N: Frame, x: Component, y: Component, rates: Pair) -> Vector:
        """The rate of the normal at a moving point [1/s]."""
        (a, b), (a_dot, b_dot) = self.slopes(x, y), self.slope_rates(x, y, rates)
        shrink = 1.0 / jnp.sqrt(a * a + b * b + 1.0)
        n, change = shrink * N.vector(a, b, 1.0), shrink * N.vector(a_dot, b_dot, 0.0)
        return change - n.dot(change) * n

    def rates(self, x: Component, y: Component, yaw: Component, forward: Component, aside: Component) -> Pair:
        a, b = self.slopes(x, y)
        length, of_x = jnp.sqrt(a * a + b * b + 1.0), jnp.sqrt(a * a + 1.0)
        ahead, right = super().rates(x, y, yaw, forward, aside)  # in the tangent plane
        along, across = mul(ahead, 1.0 / of_x), mul(right, 1.0 / (length * of_x))
        return sub(along, mul(across, a * b)), mul(across, of_x**2)

    def tangent(self, N: Frame, x: Component, y: Component, rates: Callable[[], Pair]) -> Frame:
        # x is rotated about N.y by atan(a), then y about that x by -atan(b / s), s^2 = 1 + a^2.
        (a, b), (a_dot, b_dot) = self.slopes(x, y), self.slope_rates(x, y, rates())
        s2 = 1.0 + a * a
        s = jnp.sqrt(s2)
        tilt_rate = mul(sub(mul(a_dot, a * b), mul(b_dot, s2)), 1.0 / (s * (s2 + b * b)))
        turned = N.rotate(2, jnp.arctan(a), mul(a_dot, 1.0 / s2))
        return turned.rotate(1, -jnp.arctan(b / s), tilt_rate, "tangent")

    def clearance(
        self, N: Frame, contact: Contact, center: Point, radius: Component, crown: Component | None
    ) -> Component:
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


CREEPING = 0.01
"""[m/s]: the law of a tyre without relaxation length is smoothed below this speed, so that the force is finite."""


class TyreForceLaw(ParametricModule):
    """The force of a tyre as a function of its slip. A subclass defines `force`, and `equivalent` if camber has an
    effect."""

    if TYPE_CHECKING:
        relaxation_length: Scalar | None
        largest_load: float
    else:
        largest_load = math.inf  # [N]; above it `force` is NaN

    @abc.abstractmethod
    def force(self, slip: Component, load: Component, camber: Component) -> Component:
        """The force of the ground on the tyre [N].

        **Arguments:**

        - `slip`: positive if the contact moves to the negative side; it includes the `equivalent` of the camber.
        - `load` [N]: normal load.
        - `camber` [rad]: inclination of the wheel.
        """

    def equivalent(self, camber: Component) -> Component:
        """The slip that has the same force as a camber angle [rad]."""
        return 0.0

    def moment(self, force: Component, slip: Component, load: Component, camber: Component) -> Component:
        """The moment about the ground's normal, downwards [N m]; `force` [N] is the force for the same arguments."""
        return 0.0

    def slip(self, velocity: Component, speed: Component, camber: Component, deflection: Component | None) -> Component:
        if deflection is not None:
            return deflection / self.relaxation_length
        return self.equivalent(camber) - velocity / jnp.sqrt(speed * speed + CREEPING**2)

    def deflection_rate(
        self, velocity: Component, speed: Component, camber: Component, deflection: Component
    ) -> Component:
        """The rate of the deflection [m/s], for a law with a relaxation length."""
        lag = deflection / self.relaxation_length - self.equivalent(camber)
        return -velocity - jnp.abs(speed) * lag


class _AligningLaw(TyreForceLaw):
    """A law whose lateral force acts behind the contact, and whose camber causes a twisting moment."""

    if TYPE_CHECKING:
        pneumatic_trail: Scalar | None
        twisting_stiffness: Scalar | None

    def moment(self, force: Component, slip: Component, load: Component, camber: Component) -> Component:
        moment: Component = 0.0
        if self.pneumatic_trail is not None:
            moment = moment - self.pneumatic_trail * force
        if self.twisting_stiffness is not None:
            moment = moment + self.twisting_stiffness * camber
        return moment


class LateralSlip(_AligningLaw):
    """Lateral force proportional to slip and camber, as in Sharp (1971).

        sigma / |V| dF/dt + F = cornering_stiffness * slip + camber_stiffness * camber

    **Arguments:**

    - `cornering_stiffness`, `camber_stiffness` [N/rad].
    - `relaxation_length` sigma [m]: None for a force without lag.
    - `pneumatic_trail` [m]: distance behind the contact at which the force acts.
    - `twisting_stiffness` [N m/rad]: moment per camber.
    """

    cornering_stiffness: Scalar = parameter(positive=True, unit="N/rad")
    camber_stiffness: Scalar | None = parameter(None, unit="N/rad")
    relaxation_length: Scalar | None = parameter(None, positive=True, within=(0.0, FAR), unit="m")
    pneumatic_trail: Scalar | None = parameter(None, within=(-FAR, FAR), unit="m")
    twisting_stiffness: Scalar | None = parameter(None, unit="N m/rad")

    def force(self, slip: Component, load: Component, camber: Component) -> Component:
        return self.cornering_stiffness * slip

    def equivalent(self, camber: Component) -> Component:
        if self.camber_stiffness is None:
            return 0.0
        return self.camber_stiffness / self.cornering_stiffness * camber


class MagicFormula(_AligningLaw):
    """Lateral force by the Magic Formula, proportional to the load (Pacejka 2012, eq. 4.1 to 4.6).

        F = load * friction * sin(shape * atan(b - curvature * (b - atan(b)))),
        b = stiffness / (shape * friction) * (slip + camber_ratio * camber)

    **Arguments:**

    - `stiffness` [1/rad]: cornering stiffness over load.
    - `friction`: largest force over load.
    - `shape`, `curvature`: C and E of the formula.
    - `camber_ratio`: camber stiffness over cornering stiffness.
    - the others as in `LateralSlip`.
    """

    stiffness: Scalar = parameter(positive=True, unit="1/rad")
    friction: Scalar = parameter(1.0, positive=True, within=(0.0, 10.0))
    shape: Scalar = parameter(1.3, positive=True, within=(0.0, 3.0))
    curvature: Scalar = parameter(0.0)
    camber_ratio: Scalar | None = parameter(None)
    relaxation_length: Scalar | None = parameter(None, positive=True, within=(0.0, FAR), unit="m")
    pneumatic_trail: Scalar | None = parameter(None, within=(-FAR, FAR), unit="m")
    twisting_stiffness: Scalar | None = parameter(None, unit="N m/rad")

    def force(self, slip: Component, load: Component, camber: Component) -> Component:
        b = self.stiffness / (self.shape * self.friction) * slip
        b = b - self.curvature * (b - jnp.arctan(b))
        carried = jnp.maximum(load, 0.0)  # the load of a lifting wheel is zero, not negative
        return carried * self.friction * jnp.sin(self.shape * jnp.arctan(b))

    def equivalent(self, camber: Component) -> Component:
        return 0.0 if self.camber_ratio is None else self.camber_ratio * camber


class LongitudinalSlip(TyreForceLaw):
    """Longitudinal force proportional to the slip ratio.

    **Arguments:**

    - `stiffness` [N]: force over slip ratio.
    - `relaxation_length` [m]: as in `LateralSlip`.
    """

    stiffness: Scalar = parameter(positive=True, unit="N")
    relaxation_length: Scalar | None = parameter(None, positive=True, within=(0.0, FAR), unit="m")

    def force(self, slip: Component, load: Component, camber: Component) -> Component:
        return self.stiffness * slip


_DEGREE = math.pi / 180.0


class MagicFormula89(TyreForceLaw):
    """Lateral force and aligning moment by the Magic Formula of 1989, with all its coefficients.

        C = a0,   D = a1 Fz^2 + a2 Fz,   B C D = a3 sin(2 atan(Fz / a4)) (1 - a5 |camber|),   E = a6 Fz + a7,
        Sh = a8 camber + a9 Fz + a10,   Sv = a11 Fz camber + a12 Fz + a13

    for the force [N], and for the moment [N m]

        C = c0,   D = c1 Fz^2 + c2 Fz,   B C D = (c3 Fz^2 + c4 Fz) (1 - c6 |camber|) exp(-c5 Fz),
        E = (c7 Fz^2 + c8 Fz + c9) (1 - c10 |camber|),
        Sh = c11 camber + c12 Fz + c13,   Sv = (c14 Fz^2 + c15 Fz) camber + c16 Fz + c17

    with Fz in kN and angles in degrees. In the axes of the coefficients, slip and camber give forces of the same sign,
    and a moment of the opposite sign. The force opposes the slip and acts towards the lean; the moment turns the tyre
    out of its slip.

    **Arguments:**

    - `force_coefficients` (14,): a0 to a13.
    - `moment_coefficients` (18,): c0 to c17. None: no moment.
    - `relaxation_length` [m]: as in `LateralSlip`. The slip angle has this lag; camber acts without lag.
    - `largest_slip` [rad]: slip is clipped to this value. Static, not a parameter of a fit.
    - `largest_load` [N]: above it the force is NaN and the simulation stops. Static, not a parameter of a fit.
    """

    force_coefficients: Float[Array, 14] = parameter(shape=(14,))
    moment_coefficients: Float[Array, 18] | None = parameter(None, shape=(18,))
    relaxation_length: Scalar | None = parameter(None, positive=True, within=(0.0, FAR), unit="m")
    largest_slip: float = eqx.field(default=10.0 * _DEGREE, static=True, converter=float)
    largest_load: float = eqx.field(default=1000.0, static=True, converter=float)

    def __check_init__(self) -> None:
        for name in ("largest_slip", "largest_load"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"MagicFormula89.{name} = {getattr(self, name)} must be positive.")
        if self.largest_slip > TILT[1]:
            raise ValueError(
                f"MagicFormula89.largest_slip = {self.largest_slip} rad must be less than a right angle. In degrees?"
            )

    def force(self, slip: Component, load: Component, camber: Component) -> Component:
        a, alpha, Fz, gamma = self.force_coefficients, *self._in_degrees(slip, load, camber)
        # B C D / Fz, with sin(2 atan x) = 2 x / (1 + x^2): a wheel without load then has a finite stiffness factor
        slope = 2.0 * a[3] / a[4] / (1.0 + (Fz / a[4]) ** 2) * (1.0 - a[5] * jnp.abs(gamma))
        angle, lifted = alpha + (a[8] * gamma + a[9] * Fz + a[10]), a[11] * Fz * gamma + a[12] * Fz + a[13]
        return self._carried(_magic(angle, Fz, a[0], a[1] * Fz + a[2], slope, a[6] * Fz + a[7]) + lifted, load)

    def moment(self, force: Component, slip: Component, load: Component, camber: Component) -> Component:
        if self.moment_coefficients is None:
            return 0.0
        c, alpha, Fz, gamma = self.moment_coefficients, *self._in_degrees(slip, load, camber)
        leaning = jnp.abs(gamma)
        slope = (c[3] * Fz + c[4]) * (1.0 - c[6] * leaning) * jnp.exp(-c[5] * Fz)
        curvature = (c[7] * Fz**2 + c[8] * Fz + c[9]) * (1.0 - c[10] * leaning)
        lifted = (c[14] * Fz**2 + c[15] * Fz) * gamma + c[16] * Fz + c[17]
        angle = alpha + (c[11] * gamma + c[12] * Fz + c[13])
        return self._carried(_magic(angle, Fz, c[0], c[1] * Fz + c[2], slope, curvature) + lifted, load)

    def _in_degrees(self, slip: Component, load: Component, camber: Component) -> tuple[Component, ...]:
        """Slip angle [deg], load [kN], camber [deg]."""
        angle = jnp.clip(jnp.arctan(slip), -self.largest_slip, self.largest_slip)
        return angle / _DEGREE, 1e-3 * jnp.maximum(load, 0.0), camber / _DEGREE

    def _carried(self, value: Component, load: Component) -> Component:
        """Zero for a lifting wheel; above the largest load NaN with NaN derivatives."""
        return jnp.where(load > self.largest_load, jnp.nan, 1.0) * jnp.where(load > 0.0, value, 0.0)


def _magic(angle: Component, Fz: Component, C: Component, peak: Component, slope: Component, E: Component) -> Component:
    """Y - Sv of the formula for the angle alpha + Sh [deg]; `peak` and `slope` are D and B C D over the load."""
    x = slope / (C * peak) * angle
    return Fz * peak * jnp.sin(C * jnp.arctan(x - E * (x - jnp.arctan(x))))


# mechmotum/bicycle-kickplate-model, tire_data.py at commit 6cc4d65, BSD 3-clause, copyright 2023-2024 Jason K. Moore,
# from the measurements of Dell'Orto, Mastinu, Happee and Moore (2024), *Measurement of the lateral characteristics and
# identification of the Magic Formula parameters of city and cargo bicycle tyres*, Vehicle System Dynamics,
# doi:10.1080/00423114.2024.2338143. By pressure [kPa]: a0 to a13, c0 to c17.
_ENERGIZER = {
    300: (
        (
            3.11785071938867, -752.571579481671, 1187.6971313973, 124.4775039721, 0.760139546489959,
            0.000517867267912517, -0.019028353643261, 1.48507598866898, 0.0311484079416778, 0.0992266045584514,
            -0.0820737048903585, 7.30337892653729, -22.5925899864901, 5.37222617956484,
        ),
        (
            2.09906592639809, 10.5876618219117, 2.60441934159322, 0.0623247274902716, -3.31585328999185,
            -0.758382115661707, -0.00823334974409863, 5.98641545944234, -4.75600872857059, -0.99509757625686,
            0.0280636613550883, 0.0706921463627212, 0.228420786641289, -0.17813488285145, -0.0205023109359104,
            0.332376760298719, 0.233694325855722, -0.0113037558378034,
        ),
    ),
    400: (
        (
            2.4168758341421, -827.13747376476, 1237.66083004943, 395.200360397803, 3.0446816178572,
            0.00261138053320087, -0.922053239766776, 1.64994486504353, 0.0379083581395092, 0.736968117242096,
            -0.266395254094883, 5.5067068363462, -128.33228607201, 42.3694891796893,
        ),
        (
            2.21843255129583, 11.5353268949534, 0.999589243739601, -0.421820285221245, -4.40274539041674,
            0.18952433339822, 0.0052967747005171, 7.1844346628074, -16.9117717254093, 5.14613592375553,
            -0.126298815430486, 0.0745699176433646, -1.21219459523314, 0.453513932334205, 0.602307673841529,
            0.0536303220687809, -0.656371696645942, 0.407297064320888,
        ),
    ),
    500: (
        (
            2.82190142692177, -600.725093731511, 1126.13419486956, 108.195059542367, 0.683427366605219,
            0.00101429526187314, -0.885759309085851, 1.73048558338238, 0.0486094399802349, 0.66262538419806,
            -0.175004229143779, 3.48488836431515, 59.7995288076727, -24.3588719849742,
        ),
        (
            2.2328829887519, 5.6439542000348, 2.85799096871478, -16.6499069948331, -0.436719975133473,
            1.76980762416801, 0.0184170389395877, -53.2158085410518, 53.5007295689835, -16.1916676969663,
            -0.0098780637409612, 0.109973767496453, -0.0224995998383167, 0.0595781833578477, 0.652621022173824,
            0.0958581116776279, 0.0163525377116817, 0.0162591874180916,
        ),
    ),
}  # fmt: skip
_OFFSETS = ((9, 10, 12, 13), (12, 13, 16, 17))
"""Indices of the coefficients of forces and moments at zero slip and camber."""


def schwalbe_energizer(
    pressure: float = 400e3, *, relaxation_length: float | None = None, offsets: bool = False
) -> MagicFormula89:
    """The law of a measured tyre of a city bicycle: Schwalbe Energizer Plus G-Guard 5, 28 x 1.75 inch.

        tyre = Tyre(crown=0.022, lateral=schwalbe_energizer(300e3, relaxation_length=0.1))

    Dell'Orto et al. (2024) measured it on a flat track, with loads of about 340 to 530 N and cambers up to 5 deg. Their
    formula is valid for loads up to 1000 N; above that the force is NaN. Above 5 deg of camber it is nearly linear.
    Slip angles are clipped to 10 deg, which is beyond the peak. The friction is that of their track. They do not give a
    relaxation length.

    **Arguments:**

    - `pressure` [Pa]: 300e3, 400e3 or 500e3.
    - `relaxation_length` [m]: as in `LateralSlip`.
    - `offsets`: include the measured forces and moments at zero slip and camber. Default: zero, so that left and right
        are symmetric. They belong to one tyre as it was mounted; with them no bicycle rides straight, hands off.

    **Raises:** `ValueError` for a pressure that was not measured.
    """
    known = {1e3 * kPa: coefficients for kPa, coefficients in _ENERGIZER.items()}
    if pressure not in known:
        raise ValueError(
            f"schwalbe_energizer: pressure = {pressure!r} Pa was not measured. Use one of {', '.join(map(str, known))}."
        )
    force, moment = (
        jnp.array([0.0 if i in own and not offsets else x for i, x in enumerate(coefficients)])
        for coefficients, own in zip(known[pressure], _OFFSETS, strict=True)
    )
    return MagicFormula89(force_coefficients=force, moment_coefficients=moment, relaxation_length=relaxation_length)


class Tyre(ParametricModule):
    """A tyre; by default a knife edge that rolls without slip, as in the Whipple bicycle.

        Tyre(crown=0.02, lateral=LateralSlip(9000.0, relaxation_length=0.15))

    **Arguments:**

    - `crown` [m]: radius of the cross section of a torus, whose outer radius is the wheel's. None: a knife edge.
    - `lateral`: law of the lateral force. None: the tyre does not slip sideways.
    - `longitudinal`: law of the longitudinal force. None: it rolls without slip.
    - `rolling_resistance`: resisting torque over load times radius; 0.003 to 0.01 for a bicycle. Without slip the force
        follows from the constraint.
    - `load_lag` [s]: time constant of a first-order lag. Laws and rolling resistance then use the ground's normal force
        with this lag. The state, e.g. "front_load_transfer", is its deviation from the static load, over the bicycle's
        weight. None: the static load is used.
    """

    crown: Scalar | None = parameter(None, positive=True, unit="m")
    lateral: TyreForceLaw | None = None
    longitudinal: LongitudinalSlip | None = None
    rolling_resistance: Scalar | None = parameter(None, within=(0.0, 1.0))
    load_lag: Scalar | None = parameter(None, positive=True, within=(0.0, 5.0), unit="s")

    def __check_init__(self) -> None:
        along, across = self.longitudinal, self.lateral
        if not (along is None or isinstance(along, LongitudinalSlip)):
            raise TypeError(f"Tyre: `longitudinal` must be a LongitudinalSlip or None, got {called(along)}.")
        if isinstance(across, LongitudinalSlip) or not (across is None or isinstance(across, TyreForceLaw)):
            raise TypeError(f"Tyre: `lateral` must be a law of lateral slip or None, got {called(across)}.")

    @property
    def laws(self) -> tuple[tuple[str, TyreForceLaw], ...]:
        """The directions in which it slips, with their laws."""
        laws = (("longitudinal", self.longitudinal), ("lateral", self.lateral))
        return tuple((name, law) for name, law in laws if law is not None)

    @property
    def deflects(self) -> tuple[str, ...]:
        """The directions in which its slip has a relaxation length."""
        return tuple(name for name, law in self.laws if law.relaxation_length is not None)

    def reach(self, down: Vector, normal: Vector, radius: Component) -> Vector:
        """The vector from the wheel's centre to the contact. `down` is the unit vector in the wheel's plane towards the
        ground."""
        if self.crown is None:
            return radius * down
        return (radius - self.crown) * down + self.crown * normal

    def rolling_speed(self, spin: Component, cos_camber: Component, radius: Component, slip: Component) -> Component:
        """The speed of a contact along the wheel's heading [m/s]: -spin r + slip, for a wheel whose axle points right.
        The rolled length r per angle is smaller for an inclined wheel."""
        rolled = radius if self.crown is None else radius - self.crown + self.crown * cos_camber
        return sub(slip, mul(spin, rolled))

    def residuals(self, contact: Contact) -> list[Any]:
        """Velocity residuals [m/s]: the velocity of the contact minus its slip."""
        v, (along, across) = contact.point.velocity, contact.slip
        if not self.laws:
            return [v]
        return [v.dot(contact.heading) - along, v.dot(contact.across) - across, v.dot(contact.normal)]

    def forces(self, contact: Contact, load: Component, deflection: dict[str, Component]) -> dict[str, Component]:
        """Forces of the ground on the tyre [N], by direction. `load` is in N; `deflection` in m, by direction."""
        return {name: law.force(slip, load, contact.camber) for name, law, slip in self._slips(contact, deflection)}

    def _slips(
        self, contact: Contact, deflection: dict[str, Component]
    ) -> Iterator[tuple[str, TyreForceLaw, Component]]:
        for name, law in self.laws:
            velocity = contact.slip[name == "lateral"]
            yield name, law, law.slip(velocity, contact.speed, contact.camber, deflection.get(name))

    def deflection_rates(self, contact: Contact, deflection: dict[str, Component]) -> Iterator[Component]:
        for name, law in self.laws:
            if name in deflection:
                velocity = contact.slip[name == "lateral"]
                yield law.deflection_rate(velocity, contact.speed, contact.camber, deflection[name])

    def loads(
        self, contact: Contact, wheel: Body, radius: Component, load: Component, deflection: dict[str, Component]
    ) -> Iterator[Force | Torque]:
        """Loads of the ground on the wheel, without the constraint force of ideal rolling."""
        for name, law, slip in self._slips(contact, deflection):
            force = law.force(slip, load, contact.camber)
            yield Force(force * (contact.across if name == "lateral" else contact.heading), contact.point)
            moment = law.moment(force, slip, load, contact.camber)
            if not is_zero(moment):
                yield Torque(moment * contact.normal, wheel)
        if self.rolling_resistance is not None:
            # Smoothed over 0.1 m/s: a wheel at rest then remains at rest.
            size = self.rolling_resistance * jnp.maximum(load, 0.0) * radius * jnp.tanh(contact.speed / 0.1)
            yield Torque(size * contact.across, wheel)
