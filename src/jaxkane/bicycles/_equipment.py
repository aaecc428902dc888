"""Parts other than riders and controllers: the steering head, steering by wire, drag, a prescribed speed, a trailer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from .._kane.right_hand_side import MeasurementContext
from .._scalarjit.components import Component, Scalar, mul
from .._system.kinematics import Frame, Point
from .._system.motion import Body, Force, Torque
from .._system.parameters import parameter
from .._system.system import NamedVector
from ..catalog._entry import Loads, Values
from ..catalog.bicycle import ABOVE_GROUND, FAR
from ..loads import coulomb, rotor, smooth_abs
from ._part import BicycleLike, BicycleMotion, Part


class HeadTwist(Part):
    """Torsional compliance of the frame at the steering head: one joint with a spring and a damper, before the steer
    axis.

    The front assembly turns by "head_twist" [rad]. The axis of torsion intersects the steer axis at a right angle, in
    the plane of the frame. See Sharp and Alstead (1980), *The influence of structural flexibilities on the
    straight-running stability of motorcycles*.

    **Arguments:**

    - `stiffness` [N m/rad], `damping` [N m s/rad]: of the joint.
    - `height` [m]: of the axis of torsion, upwards along the steer axis from its point nearest to the rear wheel's
        centre.
    """

    stiffness: Scalar = parameter(positive=True, unit="N m/rad")
    damping: Scalar = parameter(0.0, unit="N m s/rad")
    height: Scalar = parameter(0.0, within=(-FAR, FAR), unit="m")

    coordinates = ("head_twist",)
    speeds = ("head_twist_rate",)
    units = {"head_twist": "rad", "head_twist_rate": "rad/s"}

    def check(self, bicycle: BicycleLike) -> None:
        if bicycle.head is not self:
            raise ValueError("A HeadTwist belongs between frame and fork: use with_parts(head=HeadTwist(...)).")

    def turned(self, tilted: Frame, S: Point, q: NamedVector, u: NamedVector) -> tuple[Frame, Point]:
        """The frame along the steer axis and the point on it, after the torsion."""
        axis = S.fixed(-self.height * tilted.z)
        twisted = tilted.rotate(1, q["head_twist"], u["head_twist_rate"], "head")
        return twisted, axis.fixed(self.height * twisted.z)

    def motion(
        self, bicycle: BicycleLike, motion: BicycleMotion, t: Component, q: NamedVector, u: NamedVector
    ) -> BicycleMotion:
        return motion.extended(frames={"head": motion["C"].parent})

    def loads(
        self, bicycle: BicycleLike, t: Component, q: NamedVector, u: NamedVector, motion: BicycleMotion, values: Values
    ) -> Loads:
        torque = -self.stiffness * q["head_twist"] - self.damping * u["head_twist_rate"]
        head = motion["head"]
        return Torque(torque * head.x, head, reaction_on=motion["B"])


class SteeringFriction(Part):
    """Dry friction of the steering head, by `jaxkane.loads.coulomb`. Viscous friction is the bicycle's `steer_damping`.

    **Arguments:**

    - `level` [N m]: the friction torque.
    - `width` [rad/s]: of the smoothing. At slower rates the torque is level / width times the rate, so that a steady
        torque below `level` makes the fork creep.
    """

    level: Scalar = parameter(positive=True, unit="N m")
    width: Scalar = parameter(0.02, positive=True, unit="rad/s")

    def loads(
        self, bicycle: BicycleLike, t: Component, q: NamedVector, u: NamedVector, motion: BicycleMotion, values: Values
    ) -> Loads:
        torque = coulomb(u["steer_rate"], self.level, width=self.width)
        return Torque(-torque * motion["C"].z, motion["fork"], reaction_on=motion["rear frame"])


class SteeringMotor(Part):
    """A geared motor between frame and fork, with a delay, a torque limit and a lag.

        command -> delay -> limit -> lag -> torque on the fork, with its reaction on the frame

    It adds the input "steer_command" [N m], the commanded torque at the steer axis. Use `command="steer_command"` in a
    controller. The motor's torque is added to "steer_torque".

    **Arguments**, None for an absent element:

    - `lag` [s]: of the first order: d(torque)/dt = (limited command - torque) / lag, with the state
        "steer_motor_torque".
    - `delay` [s]: by the Pade approximation (1 - s T / 3) / (1 + 2 s T / 3 + (s T)^2 / 6), which is exact to the third
        order in s T and has no direct feedthrough. Its states are "steer_delayed" and "steer_delayed_slope" [N m]. If
        the torque does not depend on the motion, shift the times of its samples instead, which is exact: `jk.Samples(t
        + delay, ...)`.
    - `limit` [N m]: the largest torque, by limit * tanh(command / limit).
    - `rotor_inertia` [kg m^2], `ratio`: a rotor as a separate body; `ratio` is its rate over that of the steer. The
        steer has the additional inertia ratio^2 * rotor_inertia, and the gyroscopic moment acts on the frame.
    """

    lag: Scalar | None = parameter(None, positive=True, within=(0.0, 5.0), unit="s")
    delay: Scalar | None = parameter(None, positive=True, within=(0.0, 5.0), unit="s")
    limit: Scalar | None = parameter(None, positive=True, unit="N m")
    rotor_inertia: Scalar | None = parameter(None, positive=True, unit="kg m^2")
    ratio: Scalar = parameter(1.0)

    inputs = ("steer_command",)

    @property
    def states(self) -> tuple[str, ...]:
        delayed = ("steer_delayed", "steer_delayed_slope") if self.delay is not None else ()
        return (*delayed, "steer_motor_torque") if self.lag is not None else delayed

    @property
    def units(self) -> dict[str, str]:
        return dict.fromkeys((*self.inputs, *self.states), "N m")

    def motion(
        self, bicycle: BicycleLike, motion: BicycleMotion, t: Component, q: NamedVector, u: NamedVector
    ) -> BicycleMotion:
        if self.rotor_inertia is None:
            return motion
        head = motion["C"].parent
        spinning = mul(self.ratio, u["steer_rate"])
        return motion.extended([rotor(self.rotor_inertia, head.z, spinning, head, motion["S"], name="steering motor")])

    def commands(
        self, bicycle: BicycleLike, t: Component, q: NamedVector, u: NamedVector, motion: BicycleMotion, values: Values
    ) -> Values:
        return {"steer_torque": self._limited_command(values) if self.lag is None else values["steer_motor_torque"]}

    def _limited_command(self, values: Values) -> Component:
        """The command [N m], delayed and limited."""
        command = values["steer_command"]
        if self.delay is not None:
            command = values["steer_delayed"] - values["steer_delayed_slope"] / 3.0
        return command if self.limit is None else self.limit * jnp.tanh(command / self.limit)

    def state_rates(
        self,
        bicycle: BicycleLike,
        t: Component,
        q: NamedVector,
        u: NamedVector,
        x: NamedVector,
        motion: BicycleMotion,
        now: MeasurementContext,
    ) -> Sequence[Component]:
        rates = []
        if self.delay is not None:  # w and T w', with w + 2/3 T w' + T^2 w'' / 6 = command
            w, slope = now["steer_delayed"], now["steer_delayed_slope"]
            rates += [slope / self.delay, (6.0 * (now["steer_command"] - w) - 4.0 * slope) / self.delay]
        if self.lag is not None:
            rates.append((self._limited_command(now) - now["steer_motor_torque"]) / self.lag)
        return rates


class SteerByWire(Part):
    """A handlebar that turns about the steer axis independently of the fork, and motors that couple them.

        torque on the fork = stiffness * (ratio * handlebar - steer) + damping * (ratio * handlebar_rate - steer_rate)
        torque on the handlebar = handlebar_torque - feedback * ratio * torque on the fork

    Each torque has its reaction on the frame. The coordinate "handlebar" [rad] is the handlebar's angle,
    "handlebar_torque" [N m] the rider's torque on it. The bicycle's mH, xH, zH and IH.. are then those of the fork
    without the handlebar (S in the files of BicycleParameters). The handlebar's parameters (G in those files) are
    passed here.

    **Arguments:**

    - `mass` [kg]: of the handlebar.
    - `x`, `z` [m]: mass centre of the handlebar, from the rear contact of the upright bicycle.
    - `Ixx`, `Iyy`, `Izz`, `Ixz` [kg m^2]: inertia of the handlebar in the axes of the frame.
    - `stiffness` [N m/rad], `damping` [N m s/rad]: of the coupling.
    - `ratio`: the fork's angle over the handlebar's.
    - `feedback`: the share of the fork's torque that acts on the rider. With 1 the coupling is passive; only its
        damping dissipates.
    - `command`: the input to which the torque on the fork is added. Use "steer_command" with a `SteeringMotor`:
        `steering=(SteerByWire(..., command="steer_command"), SteeringMotor(...))`.
    """

    mass: Scalar = parameter(positive=True, unit="kg")
    x: Scalar = parameter(within=(-FAR, FAR), unit="m")
    z: Scalar = parameter(within=ABOVE_GROUND, unit="m")
    Ixx: Scalar = parameter(positive=True, unit="kg m^2")
    Iyy: Scalar = parameter(positive=True, unit="kg m^2")
    Izz: Scalar = parameter(positive=True, unit="kg m^2")
    stiffness: Scalar = parameter(positive=True, unit="N m/rad")
    Ixz: Scalar = parameter(0.0, unit="kg m^2")
    damping: Scalar = parameter(0.0, unit="N m s/rad")
    ratio: Scalar = parameter(1.0)
    feedback: Scalar = parameter(1.0)
    command: str = eqx.field(static=True, default="steer_torque")

    coordinates = ("handlebar",)
    speeds = ("handlebar_rate",)
    inputs = ("handlebar_torque",)
    units = {"handlebar": "rad", "handlebar_rate": "rad/s", "handlebar_torque": "N m"}

    def motion(
        self, bicycle: BicycleLike, motion: BicycleMotion, t: Component, q: NamedVector, u: NamedVector
    ) -> BicycleMotion:
        turned = motion["C"].parent.rotate(3, q["handlebar"], u["handlebar_rate"], "handlebar")
        G = turned.rotate(2, -bicycle.lam, 0.0, "grips")  # aligned with the rear frame at a zero angle
        x, z = bicycle.steer_point
        center = motion["S"].fixed(((self.x - x) * G.x + (self.z - z) * G.z).express(turned))
        inertia = ((self.Ixx, 0.0, self.Ixz), (0.0, self.Iyy, 0.0), (self.Ixz, 0.0, self.Izz))
        bar = Body(self.mass, inertia, center, G, name="handlebar")
        return motion.extended([bar], frames={"grips": G})

    def _torque(self, q: NamedVector, u: NamedVector) -> Component:
        apart, sliding = self.ratio * q["handlebar"] - q["steer"], self.ratio * u["handlebar_rate"] - u["steer_rate"]
        return self.stiffness * apart + self.damping * sliding

    def commands(
        self, bicycle: BicycleLike, t: Component, q: NamedVector, u: NamedVector, motion: BicycleMotion, values: Values
    ) -> Values:
        return {self.command: self._torque(q, u)}

    def loads(
        self, bicycle: BicycleLike, t: Component, q: NamedVector, u: NamedVector, motion: BicycleMotion, values: Values
    ) -> Loads:
        torque = values["handlebar_torque"] - self.feedback * self.ratio * self._torque(q, u)
        return Torque(torque * motion["C"].parent.z, motion["handlebar"], reaction_on=motion["rear frame"])


class Drag(Part):
    """Drag of still air at a point of the frame: -density / 2 * area * |v| v.

    **Arguments:**

    - `area` [m^2]: frontal area times drag coefficient; about 0.5 for an upright rider.
    - `height`, `ahead` [m]: the point at which the drag acts on the upright bicycle, above the ground and ahead of the
        rear contact.
    - `density` [kg/m^3]: of the air.
    """

    area: Scalar = parameter(0.5, positive=True, unit="m^2")
    height: Scalar = parameter(1.1, within=(0.0, FAR), unit="m")
    ahead: Scalar = parameter(0.4, within=(-FAR, FAR), unit="m")
    density: Scalar = parameter(1.2, positive=True, unit="kg/m^3")

    resists = True

    def motion(
        self, bicycle: BicycleLike, motion: BicycleMotion, t: Component, q: NamedVector, u: NamedVector
    ) -> BicycleMotion:
        B, hub = motion["B"], motion["rear wheel"].center
        place = hub.fixed(self.ahead * B.x + (bicycle.rR - self.height) * B.z, B)
        return motion.extended(points={"center of drag": place})

    def loads(
        self, bicycle: BicycleLike, t: Component, q: NamedVector, u: NamedVector, motion: BicycleMotion, values: Values
    ) -> Loads:
        v = motion["center of drag"].velocity
        size = 0.5 * self.density * self.area * smooth_abs(v, 1e-3)  # [N s/m]; smoothed below 1 mm/s
        return Force(-size * v, motion["center of drag"])


class ConstantSpeed(Part):
    """The rear wheel turns relative to the frame at a prescribed rate, with the torque that this needs.

        rear_wheel_rate = -speed / rR

    The rate is then a dependent speed; do not include it in an initial state. The output "holding_torque" [N m] is the
    necessary drive torque on the rear wheel, with its reaction on the frame. As for "drive_torque", a negative value
    accelerates. For linear models over speeds, remove this part. Straight, upright riding then has the "drive_torque"
    that it needs, and deviations from it change the speed to second order only.

    **Arguments:**

    - `speed` [m/s]: the forward speed.
    """

    speed: Scalar = parameter(within=(-100.0, 100.0), unit="m/s")

    dependent_speeds = ("rear_wheel_rate",)
    units = {"holding_torque": "N m"}

    def motion(
        self, bicycle: BicycleLike, motion: BicycleMotion, t: Component, q: NamedVector, u: NamedVector
    ) -> BicycleMotion:
        return motion.extended((), [u["rear_wheel_rate"] + self.speed / bicycle.rR])

    def outputs(
        self,
        bicycle: BicycleLike,
        t: Component,
        q: NamedVector,
        u: NamedVector,
        motion: BicycleMotion,
        now: MeasurementContext,
    ) -> Values:
        return {"holding_torque": now.multipliers[bicycle.dependent_speeds.index("rear_wheel_rate")]}


class Trailer(Part):
    """A trailer on a ball hitch at the frame. It rolls without lateral slip, and its axle remains level.

    Its frame, "trailer", is rotated from the bicycle's heading by "trailer_angle" [rad], positive to the right. The
    dependent coordinate "trailer_pitch" [rad] follows the height of the hitch. The bicycle's speeds determine both
    rates, so the trailer adds no independent speed. The rotation of its wheels is neglected; their mass is included.

    **Arguments:**

    - `hitch_x`, `hitch_z` [m]: the hitch, in Meijaard's axes.
    - `length` [m]: from the hitch to the axle.
    - `wheel_radius`, `track` [m]: of the wheels, and the distance between them (used for drawing only).
    - `mass` [kg]: of the trailer.
    - `center`, `height` [m]: of the mass centre, before the axle and above it.
    - `Ixx`, `Iyy`, `Izz` [kg m^2]: inertia about the mass centre.
    """

    hitch_x: Scalar = parameter(within=(-FAR, FAR), unit="m")
    hitch_z: Scalar = parameter(within=ABOVE_GROUND, unit="m")
    length: Scalar = parameter(positive=True, within=(0.0, FAR), unit="m")
    wheel_radius: Scalar = parameter(positive=True, within=(0.0, FAR), unit="m")
    mass: Scalar = parameter(positive=True, unit="kg")
    center: Scalar = parameter(within=(-FAR, FAR), unit="m")
    height: Scalar = parameter(within=(0.0, FAR), unit="m")
    Ixx: Scalar = parameter(positive=True, unit="kg m^2")
    Iyy: Scalar = parameter(positive=True, unit="kg m^2")
    Izz: Scalar = parameter(positive=True, unit="kg m^2")
    track: Scalar = parameter(0.6, within=(0.0, FAR), unit="m")

    coordinates = ("trailer_angle", "trailer_pitch")
    dependent_coordinates = ("trailer_pitch",)
    dependent_speeds = ("trailer_angle_rate", "trailer_pitch_rate")
    units = {
        "trailer_angle": "rad",
        "trailer_pitch": "rad",
        "trailer_angle_rate": "rad/s",
        "trailer_pitch_rate": "rad/s",
    }

    def check(self, bicycle: BicycleLike) -> None:
        if bicycle.road.curved:
            raise ValueError("A Trailer needs level ground or a Slope; it cannot be used on a Road of given height.")

    def motion(
        self, bicycle: BicycleLike, motion: BicycleMotion, t: Component, q: NamedVector, u: NamedVector
    ) -> BicycleMotion:
        heading = motion["Y"].rotate(3, q["trailer_angle"], u["trailer_angle_rate"])
        T = heading.rotate(2, q["trailer_pitch"], u["trailer_pitch_rate"], "trailer")
        hitch = bicycle.on_frame(motion, self.hitch_x, 0.0, self.hitch_z)
        axle = hitch.fixed(T.vector(-self.length, 0.0, -self.hitch_z - self.wheel_radius))
        center = axle.fixed(T.vector(self.center, 0.0, -self.height))
        box = Body(self.mass, (self.Ixx, self.Iyy, self.Izz), center, T, name="box")
        residuals = [axle.velocity.dot(motion.N.z), axle.velocity.dot(heading.y)]
        return motion.extended([box], residuals, points={"hitch": hitch, "axle": axle}, frames={"trailer": T})

    def configuration_constraints(
        self, bicycle: BicycleLike, t: Component, q: NamedVector, motion: BicycleMotion
    ) -> Sequence[Component]:
        return [motion["axle"].position.dot(motion.N.z) + self.wheel_radius]

    def draw(self, bicycle: BicycleLike, motion: BicycleMotion, sketch: Any) -> None:
        axle, T, half = motion["axle"].position, motion["trailer"], 0.5 * self.track
        for side in (-1.0, 1.0):
            sketch.circle("ink", axle + side * half * T.y, T.x, T.z, self.wheel_radius, width=3.0, fill=0.05)
        corners = [axle + x * T.x + y * T.y for x, y in ((0.4, -half), (0.4, half), (-0.4, half), (-0.4, -half))]
        top = [corner - 0.5 * T.z for corner in corners]
        sketch.line("green", *corners, closed=True, fill=0.15)
        sketch.line("green", *top, closed=True)
        for low, high in zip(corners, top, strict=True):
            sketch.line("green", low, high)
        sketch.line("green", motion["hitch"], axle + 0.4 * T.x, width=3.0)
