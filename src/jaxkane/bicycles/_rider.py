"""Riders: a body on the frame, fixed or leaning on a hinge. Knows the frame; knows no steering and no ground."""

from __future__ import annotations

import abc
import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._kane.checks import is_concrete, why_no_body
from .._scalarjit.components import Scalar
from .._system.bodies import Body, Torque
from .._system.kinematics import Frame, Point
from .._system.parameters import in_batches, parameter
from ..catalog import read_bicycle_file
from ..catalog.bicycle import ABOVE_GROUND, FAR, TILT
from ._parts import Part

if TYPE_CHECKING:
    from ._bicycle import Bicycle


_IN_A_FILE = {"mB": "mass", "xB": "x", "zB": "z", "IBxx": "Ixx", "IByy": "Iyy", "IBzz": "Izz", "IBxz": "Ixz"}


class Rider(Part):
    """A rider with one body above the saddle, in places and directions as Meijaard's: from the rear contact of the
    upright bicycle, x forward and z down, with the rider upright.

    Its motion names the body "rider", its frame "U" and, where the rider has them, the points "left_shoulder" and
    "right_shoulder". A rider of your own gives `carried`.
    """

    mass: Scalar = parameter(positive=True, within=(0.0, 300.0), unit="kg")
    x: Scalar = parameter(within=(-FAR, FAR), unit="m")
    z: Scalar = parameter(within=ABOVE_GROUND, unit="m")
    Ixx: Scalar = parameter(positive=True, unit="kg m^2")
    Iyy: Scalar = parameter(positive=True, unit="kg m^2")
    Izz: Scalar = parameter(positive=True, unit="kg m^2")
    Ixz: Scalar = parameter(unit="kg m^2")

    @property
    def right_shoulder(self) -> Float[Array, 3] | None:
        """Where the right shoulder is, or None."""
        return getattr(self, "shoulder", None)

    @classmethod
    def from_file(cls, path: str | os.PathLike[str], **more: Any) -> Self:
        """A rider whose body is that of a rider's text file of BicycleParameters (`mB = value`, to `IBxz`).

        **Arguments:** `more`: the other parameters, as the hinge of one who leans.

        **Raises:** `ValueError` that names the lines that are unknown, repeated or malformed, and what is missing.
        """
        values, _ = read_bicycle_file(path, known=(*_IN_A_FILE, "yB"))
        missing = [name for name in _IN_A_FILE if name not in values]
        if missing or abs(values.get("yB", 0.0)) > 1e-3:
            why = f"missing: {', '.join(missing)}" if missing else f"the rider sits aside, yB = {values['yB']:.4g} m"
            raise ValueError(f"{os.fspath(path)}: {why}.")
        return cls(**{_IN_A_FILE[name]: values[name] for name in _IN_A_FILE}, **more)

    @abc.abstractmethod
    def carried(self, bicycle: Bicycle, motion: Any, q: Any, u: Any) -> tuple[Frame, Point, Scalar, Scalar]:
        """The rider's frame, a point that is fixed in it, and where that point is, x and z, with the rider upright."""

    def motion(self, bicycle, motion, t, q, u):
        U, hinge, x, z = self.carried(bicycle, motion, q, u)
        center = hinge.fixed(U.vector(self.x - x, 0.0, self.z - z))
        inertia = ((self.Ixx, 0.0, self.Ixz), (0.0, self.Iyy, 0.0), (self.Ixz, 0.0, self.Izz))
        points = {}
        shoulder = self.right_shoulder
        if shoulder is not None:
            aside = {"left_shoulder": -shoulder[1], "right_shoulder": shoulder[1]}
            forward, down = shoulder[0] - x, shoulder[2] - z
            points = {name: hinge.fixed(U.vector(forward, y, down)) for name, y in aside.items()}
        body = Body(self.mass, inertia, center, U, name="rider")
        return motion.extended([body], points=points, frames={"U": U})


class RigidRider(Rider):
    """A rider who is fixed to the frame: a body of its own, where that of the frame does not count it already.

    **Arguments:** `mass` [kg]; `x`, `z` [m]: mass centre; `Ixx`, `Iyy`, `Izz`, `Ixz` [kg m^2] about it; `shoulder`
    [m]: x, y and z of the right shoulder, for `Arms`; the left one is its mirror image.
    """

    shoulder: Float[Array, 3] | None = parameter(None, within=(-FAR, FAR), shape=(3,), unit="m")

    def carried(self, bicycle, motion, q, u):
        B = motion["B"]
        return B.rotate(2, 0.0, 0.0, "U"), bicycle.on_frame(motion, self.x, 0.0, self.z), self.x, self.z


class LeaningRider(Rider):
    """A rider whose upper body leans to the side, on a hinge along the frame with a spring and a damper.

        LeaningRider(
            mass=48.8, x=0.23, z=-1.28, Ixx=2.04, Iyy=1.69, Izz=1.10, Ixz=0.0,
            hinge_x=0.1, hinge_z=-1.01, stiffness=128.0, damping=50.0,
        )

    Its mass is none of the frame's: `mB`, `xB`, ..., `IBxz` of the bicycle are those of the frame and what sits still
    on it, as the legs. Where B counts the whole rider, `separate_rider` takes the upper body out of it.

    The angle "rider_lean" [rad] is that of the upper body relative to the frame, positive to the right. The input
    "rider_lean_torque" [N m] turns the upper body to the right, and the frame to the left.

    **Arguments:** `mass` [kg]; `x`, `z` [m]: mass centre of the upright upper body; `Ixx`, `Iyy`, `Izz`, `Ixz`
    [kg m^2] about it; `hinge_x`, `hinge_z` [m]: a point of the hinge; `hinge_tilt` [rad]: how far the hinge points
    upwards in front, None: level with the upright frame; `stiffness` [N m/rad]; `damping` [N m s/rad]; `shoulder` [m]:
    x, y and z of the right shoulder, for `Arms`; the left one is its mirror image.
    """

    hinge_x: Scalar = parameter(within=(-FAR, FAR), unit="m")
    hinge_z: Scalar = parameter(within=ABOVE_GROUND, unit="m")
    hinge_tilt: Scalar | None = parameter(None, within=TILT, unit="rad")
    stiffness: Scalar = parameter(0.0, unit="N m/rad")
    damping: Scalar = parameter(0.0, unit="N m s/rad")
    shoulder: Float[Array, 3] | None = parameter(None, within=(-FAR, FAR), shape=(3,), unit="m")

    coordinates = ("rider_lean",)
    speeds = ("rider_lean_rate",)
    inputs = ("rider_lean_torque",)
    units = {"rider_lean": "rad", "rider_lean_rate": "rad/s", "rider_lean_torque": "N m"}

    def _axis(self, B: Frame) -> Any:
        if self.hinge_tilt is None:
            return B.x
        return jnp.cos(self.hinge_tilt) * B.x - jnp.sin(self.hinge_tilt) * B.z

    def carried(self, bicycle, motion, q, u):
        B = motion["B"]
        axis = 1 if self.hinge_tilt is None else self._axis(B)
        U = B.rotate(axis, q["rider_lean"], u["rider_lean_rate"], "U")
        return U, bicycle.on_frame(motion, self.hinge_x, 0.0, self.hinge_z), self.hinge_x, self.hinge_z

    def loads(self, bicycle, t, q, u, motion, values):
        torque = values["rider_lean_torque"] - self.stiffness * q["rider_lean"] - self.damping * u["rider_lean_rate"]
        B = motion["B"]
        return Torque(torque * self._axis(B), motion["U"], reaction_on=B)


def rider_of(values: Mapping[str, Any]) -> Rider:
    """A rider with these parameters, who leans where they hold a hinge."""
    return (LeaningRider if "hinge_z" in values else RigidRider)(**values)


def separate_rider(bicycle: Bicycle, rider: Rider) -> Bicycle:
    """The bicycle with this rider, whose body its frame B counts already: B is what is left of it.

        bicycle = separate_rider(Bicycle.benchmark(), LeaningRider(mass=49.0, ...))

    With a rider who does not lean its motion is that of the bicycle before.

    **Raises:** `ValueError` where what is left of B is no body: without mass, or with moments of inertia that no body
    has; and for a bicycle that has a rider already, who is none of B.
    """
    if bicycle.rider is not None:
        raise ValueError("separate_rider: the bicycle has a rider already, whom its frame B does not count.")
    m = bicycle.mB - rider.mass
    x = (bicycle.mB * bicycle.xB - rider.mass * rider.x) / m
    z = (bicycle.mB * bicycle.zB - rider.mass * rider.z) / m
    left = _about(bicycle.mB, bicycle.xB, bicycle.zB, bicycle.IBxx, bicycle.IByy, bicycle.IBzz, bicycle.IBxz)
    taken = _about(rider.mass, rider.x, rider.z, rider.Ixx, rider.Iyy, rider.Izz, rider.Ixz)
    rest = [a - b for a, b in zip(left, taken, strict=True)]  # about the rear contact
    Ixx, Iyy, Izz, Ixz = (a - b for a, b in zip(rest, _about(m, x, z, 0.0, 0.0, 0.0, 0.0), strict=True))
    if is_concrete(bicycle, rider) and not (in_batches(bicycle) or in_batches(rider)):
        if not m > 0:
            raise ValueError(
                f"separate_rider: the rider is as heavy as the frame B that should count it; {m:.4g} kg left."
            )
        inertia = np.array([(Ixx, 0.0, Ixz), (0.0, Iyy, 0.0), (Ixz, 0.0, Izz)], dtype=float)
        fault = why_no_body(float(m), inertia, bicycle.check_inertia)
        if fault:
            raise ValueError(
                f"separate_rider: the frame B does not hold the rider's body. Without it: {fault} Is the rider's mass "
                "counted in B at all? If not: bicycle.with_parts(rider=...)."
            )
    B = {"mB": m, "xB": x, "zB": z, "IBxx": Ixx, "IByy": Iyy, "IBzz": Izz, "IBxz": Ixz}
    return bicycle.with_parts(**B, rider=rider)


def _about(m: Scalar, x: Scalar, z: Scalar, Ixx: Any, Iyy: Any, Izz: Any, Ixz: Any) -> tuple[Any, Any, Any, Any]:
    """Central moments and the product of a body, about the point from which x and z are measured."""
    return Ixx + m * z * z, Iyy + m * (x * x + z * z), Izz + m * x * x, Ixz - m * x * z
