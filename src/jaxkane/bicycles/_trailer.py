"""A trailer on a ball hitch at the frame."""

from __future__ import annotations

from .._scalarjit.components import Scalar
from .._system.motion import Body
from .._system.parameters import parameter
from ..catalog.bicycle import ABOVE_GROUND, FAR
from ._part import Part


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

    def check(self, bicycle):
        if bicycle.road.curved:
            raise ValueError("A Trailer needs level ground or a Slope; it cannot be used on a Road of given height.")

    def motion(self, bicycle, motion, t, q, u):
        heading = motion["Y"].rotate(3, q["trailer_angle"], u["trailer_angle_rate"])
        T = heading.rotate(2, q["trailer_pitch"], u["trailer_pitch_rate"], "trailer")
        hitch = bicycle.on_frame(motion, self.hitch_x, 0.0, self.hitch_z)
        axle = hitch.fixed(T.vector(-self.length, 0.0, -self.hitch_z - self.wheel_radius))
        center = axle.fixed(T.vector(self.center, 0.0, -self.height))
        box = Body(self.mass, (self.Ixx, self.Iyy, self.Izz), center, T, name="box")
        residuals = [axle.velocity.dot(motion.N.z), axle.velocity.dot(heading.y)]
        return motion.extended([box], residuals, points={"hitch": hitch, "axle": axle}, frames={"trailer": T})

    def configuration_constraints(self, bicycle, t, q, motion):
        return [motion["axle"].position.dot(motion.N.z) + self.wheel_radius]

    def draw(self, bicycle, motion, sketch):
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
