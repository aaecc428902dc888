"""Riders on the frame, rigid or leaning on a hinge, and arms from the shoulders to the handlebar."""

from __future__ import annotations

import abc
import os
from collections.abc import Iterable, Sequence
from itertools import takewhile
from typing import Any, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._kane.arguments import is_concrete
from .._kane.checks import why_no_body
from .._scalarjit.components import Component, Scalar, add
from .._system.kinematics import Frame, Point
from .._system.motion import Body, Motion, Torque
from .._system.parameters import in_batches, parameter
from .._system.system import NamedVector
from ..catalog import read_bicycle_file
from ..catalog._entry import Loads, Values
from ..catalog.bicycle import ABOVE_GROUND, FAR, TILT
from ._part import BicycleLike, BicycleMotion, Part

_IN_A_FILE = {"mB": "mass", "xB": "x", "zB": "z", "IBxx": "Ixx", "IByy": "Iyy", "IBzz": "Izz", "IBxz": "Ixz"}


class Rider(Part):
    """A rider with one body above the saddle.

    Positions and axes follow Meijaard: from the rear contact of the upright bicycle, x forward and z down, with the
    rider upright. The motion contains the body "rider", its frame "U" and, if the rider has shoulders, the points
    "left_shoulder" and "right_shoulder". A subclass defines `carried`.
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
        """The position of the right shoulder, or None."""
        return getattr(self, "shoulder", None)

    @classmethod
    def from_file(cls, path: str | os.PathLike[str], **parameters: Any) -> Self:
        """A rider from a rider's text file of BicycleParameters (`mB = value`, to `IBxz`).

        **Arguments:**

        - `path`: the file.
        - `parameters`: the other parameters, e.g. the hinge of a leaning rider.

        **Raises:** `ValueError` with the lines that are unknown, repeated or malformed, and the missing names.
        """
        values, _ = read_bicycle_file(path, known=(*_IN_A_FILE, "yB"))
        missing = [name for name in _IN_A_FILE if name not in values]
        if missing or abs(values.get("yB", 0.0)) > 1e-3:
            why = f"missing: {', '.join(missing)}" if missing else f"yB = {values['yB']:.4g} m must be zero"
            raise ValueError(f"{os.fspath(path)}: {why}.")
        return cls(**{_IN_A_FILE[name]: values[name] for name in _IN_A_FILE}, **parameters)

    @abc.abstractmethod
    def carried(
        self, bicycle: BicycleLike, motion: Motion, q: NamedVector, u: NamedVector
    ) -> tuple[Frame, Point, Scalar, Scalar]:
        """The rider's frame, a point that is fixed in it, and x and z of this point for an upright rider."""

    def motion(
        self, bicycle: BicycleLike, motion: BicycleMotion, t: Component, q: NamedVector, u: NamedVector
    ) -> BicycleMotion:
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
    """A rider who is fixed to the frame, as a separate body that the frame's inertia does not include.

    **Arguments:**

    - `mass` [kg]: of the rider.
    - `x`, `z` [m]: mass centre.
    - `Ixx`, `Iyy`, `Izz`, `Ixz` [kg m^2]: inertia about the mass centre.
    - `shoulder` (3,) [m]: x, y and z of the right shoulder, for `Arms`; the left one is its mirror image.
    """

    shoulder: Float[Array, 3] | None = parameter(None, within=(-FAR, FAR), shape=(3,), unit="m")

    def carried(self, bicycle: BicycleLike, motion: BicycleMotion, q: NamedVector, u: NamedVector):
        B = motion["B"]
        return B.rotate(2, 0.0, 0.0, "U"), bicycle.on_frame(motion, self.x, 0.0, self.z), self.x, self.z


class LeaningRider(Rider):
    """A rider whose upper body leans to the side, on a hinge along the frame with a spring and a damper.

        LeaningRider(
            mass=48.8, x=0.23, z=-1.28, Ixx=2.04, Iyy=1.69, Izz=1.10, Ixz=0.0,
            hinge_x=0.1, hinge_z=-1.01, stiffness=128.0, damping=50.0,
        )

    The bicycle's `mB`, `xB`, ..., `IBxz` do not include the upper body. They include the frame and the fixed parts of
    the rider, e.g. the legs. If B includes the whole rider, subtract the upper body with `separate_rider`.

    The angle "rider_lean" [rad] is that of the upper body relative to the frame, positive to the right. The input
    "rider_lean_torque" [N m] turns the upper body to the right, and the frame to the left.

    **Arguments:**

    - `mass` [kg]: of the upper body.
    - `x`, `z` [m]: mass centre of the upright upper body.
    - `Ixx`, `Iyy`, `Izz`, `Ixz` [kg m^2]: inertia about the mass centre.
    - `hinge_x`, `hinge_z` [m]: a point of the hinge.
    - `hinge_tilt` [rad]: the upward inclination of the hinge towards the front. None: level when the frame is upright.
    - `stiffness` [N m/rad], `damping` [N m s/rad]: of the hinge.
    - `shoulder` (3,) [m]: x, y and z of the right shoulder, for `Arms`; the left one is its mirror image.
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

    def carried(self, bicycle: BicycleLike, motion: BicycleMotion, q: NamedVector, u: NamedVector):
        B = motion["B"]
        axis = 1 if self.hinge_tilt is None else self._axis(B)
        U = B.rotate(axis, q["rider_lean"], u["rider_lean_rate"], "U")
        return U, bicycle.on_frame(motion, self.hinge_x, 0.0, self.hinge_z), self.hinge_x, self.hinge_z

    def loads(
        self, bicycle: BicycleLike, t: Component, q: NamedVector, u: NamedVector, motion: BicycleMotion, values: Values
    ) -> Loads:
        torque = values["rider_lean_torque"] - self.stiffness * q["rider_lean"] - self.damping * u["rider_lean_rate"]
        B = motion["B"]
        return Torque(torque * self._axis(B), motion["U"], reaction_on=B)


def separate_rider(bicycle: BicycleLike, rider: Rider) -> Any:
    """The bicycle with this rider as a separate body, which is subtracted from the frame B.

        bicycle = separate_rider(Bicycle.benchmark(), LeaningRider(mass=49.0, ...))

    If the rider does not lean, the motion is the same as before.

    **Arguments:**

    - `bicycle`: its frame B includes the rider's body.
    - `rider`: the rider to separate.

    **Raises:** `ValueError` if the remaining B is impossible: no mass, or moments of inertia that no body can have; and
    for a bicycle that already has a separate rider.
    """
    if bicycle.rider is not None:
        raise ValueError(
            "separate_rider: the bicycle already has a separate rider, so its frame B does not include the rider's "
            "body. To replace the rider, use bicycle.with_parts(rider=...)."
        )
    body = [getattr(bicycle, name) for name in _IN_A_FILE]
    rest = without(body, [getattr(rider, name) for name in _IN_A_FILE.values()])
    m, _, _, Ixx, Iyy, Izz, Ixz = rest
    if is_concrete(bicycle, rider) and not (in_batches(bicycle) or in_batches(rider)):
        if not m > 0:
            raise ValueError(
                f"separate_rider: the rider is too heavy for the frame B. Without the rider, its mass would be {m:.4g} "
                "kg. The rider's mass must be less than mB, which includes it."
            )
        inertia = np.array([(Ixx, 0.0, Ixz), (0.0, Iyy, 0.0), (Ixz, 0.0, Izz)], dtype=float)
        fault = why_no_body(float(m), inertia, bicycle.check_inertia)
        if fault:
            raise ValueError(
                f"separate_rider: the frame B cannot include the rider's body. Without it: {fault} If mB does not "
                "include the rider's mass, use bicycle.with_parts(rider=...)."
            )
    return bicycle.with_parts(**dict(zip(_IN_A_FILE, rest, strict=True)), rider=rider)


def without(body: Sequence[Scalar], part: Sequence[Scalar]) -> list[Scalar]:
    """The body that remains if a part is removed.

    All have the values m, x, z, Ixx, Iyy, Izz, Ixz: the mass, the mass centre, and the inertia about it.
    """
    m = body[0] - part[0]
    x, z = ((body[0] * body[i] - part[0] * part[i]) / m for i in (1, 2))
    about_origin = zip(_about(*body), _about(*part), _about(m, x, z, 0.0, 0.0, 0.0, 0.0), strict=True)
    return [m, x, z, *(whole - removed - shift for whole, removed, shift in about_origin)]


def _about(m: Scalar, x: Scalar, z: Scalar, Ixx: Scalar, Iyy: Scalar, Izz: Scalar, Ixz: Scalar) -> tuple[Scalar, ...]:
    """Moments and product of inertia about the origin of x and z, from the central ones."""
    return Ixx + m * z * z, Iyy + m * (x * x + z * z), Izz + m * x * x, Ixz - m * x * z


_SIDES = {"left": -1.0, "right": 1.0}
_JOINTS = ("shoulder_flexion", "shoulder_rotation", "elbow")


class Arms(Part):
    """Two arms, each with an upper arm and a forearm, whose hands remain at the grips of the handlebar.

    A shoulder rotates by flexion about the rider's axis to the right, then by rotation about the upper arm. An elbow
    rotates by flexion. Three angles determine the position of a hand, so steering and leaning determine both arms.
    "left_shoulder_flexion", "left_shoulder_rotation", "left_elbow" and those of the right arm are therefore dependent
    coordinates. All angles [rad] are measured from the posture in which the hands are at the grips of the upright
    bicycle. Zeros are always a valid initial guess; `assemble` computes the others. Flexion raises the hand forwards;
    rotation turns the flexed forearm outwards.

    The arms need a rider with shoulders: `LeaningRider(..., shoulder=(x, y, z))`. Neither the rider's nor the fork's
    mass includes the arms. The inputs "left_elbow_torque" and "right_elbow_torque" [N m] bend the elbows.

    **Arguments**, equal for both arms:

    - `grip` (3,) [m]: x, y and z of the right grip at zero steer, in Meijaard's axes; the left is its mirror image.
    - `upper_length`, `fore_length` [m]: from shoulder to elbow and from elbow to hand.
    - `upper_mass`, `fore_mass` [kg]: masses.
    - `upper_center`, `fore_center` [m]: distances of the mass centres from shoulder and elbow.
    - `upper_inertia`, `fore_inertia` (3,) [kg m^2]: about the mass centres; forwards, sideways and along the hanging
        arm.
    - `shoulder_stiffness`, `shoulder_damping`, `elbow_stiffness`, `elbow_damping` [N m/rad, N m s/rad]: of each angle
        from that posture; none by default.

    **Raises:** `ValueError` for a bicycle without a rider with shoulders, and for arms too short or too long for the
    grips. For traced numbers the coordinates become NaN instead.
    """

    grip: Float[Array, 3] = parameter(within=(-FAR, FAR), shape=(3,), unit="m")
    upper_length: Scalar = parameter(positive=True, within=(0.0, FAR), unit="m")
    fore_length: Scalar = parameter(positive=True, within=(0.0, FAR), unit="m")
    upper_mass: Scalar = parameter(positive=True, unit="kg")
    fore_mass: Scalar = parameter(positive=True, unit="kg")
    upper_center: Scalar = parameter(within=(-FAR, FAR), unit="m")
    fore_center: Scalar = parameter(within=(-FAR, FAR), unit="m")
    upper_inertia: Float[Array, 3] = parameter(shape=(3,), positive=True, unit="kg m^2")
    fore_inertia: Float[Array, 3] = parameter(shape=(3,), positive=True, unit="kg m^2")
    shoulder_stiffness: Scalar | None = parameter(None, unit="N m/rad")
    shoulder_damping: Scalar | None = parameter(None, unit="N m s/rad")
    elbow_stiffness: Scalar | None = parameter(None, unit="N m/rad")
    elbow_damping: Scalar | None = parameter(None, unit="N m s/rad")

    coordinates = tuple(f"{side}_{joint}" for side in _SIDES for joint in _JOINTS)
    dependent_coordinates = coordinates
    dependent_speeds = tuple(f"{name}_rate" for name in coordinates)
    inputs = tuple(f"{side}_elbow_torque" for side in _SIDES)
    units = dict.fromkeys(coordinates, "rad") | dict.fromkeys(dependent_speeds, "rad/s") | dict.fromkeys(inputs, "N m")

    def lateral(self):
        return ()

    def check(self, bicycle: BicycleLike) -> None:
        rider = _with_shoulders(takewhile(lambda part: part is not self, bicycle.parts))
        if rider is None:
            raise ValueError(
                f"Arms need a rider with shoulders, but no part of this {type(bicycle).__name__} before them has "
                "shoulders. Use with_parts(rider=LeaningRider(..., shoulder=(x, y, z))), or a RigidRider."
            )
        if not is_concrete(self, rider) or in_batches(self) or in_batches(rider):
            return  # impossible members become NaN
        shoulder: Any = rider.right_shoulder
        reach, longest = self.grip - shoulder, self.upper_length + self.fore_length
        distance, shortest = jnp.sqrt(reach @ reach), abs(self.upper_length - self.fore_length)
        if not shortest < distance < longest:
            raise ValueError(
                f"Arms: the distance from the shoulder to the grip is {float(distance):.4g} m, but these arms reach "
                f"from {float(shortest):.4g} to {float(longest):.4g} m. Change the lengths, grips or shoulders."
            )
        if not np.all(np.isfinite(self.posture(shoulder))):
            raise ValueError(
                "Arms: a hand is too far to the side for an elbow that bends forwards. Move `grip` and the rider's "
                "`shoulder` closer to each other across the bicycle, or lengthen the forearm."
            )

    @classmethod
    def of_person(cls, mass: float, height: float, grip: Float[Array, " 3"], **parameters: Any) -> Self:
        """The arms of a person, by the means of Winter (2009), *Biomechanics and Motor Control of Human Movement*,
        Table 4.1 and Figure 4.1.

        Lengths are proportional to the height, and masses to the mass. The forearm includes the hand, whose middle is
        at the grip. The moment of inertia along a segment is assumed as a tenth of that across it; its effect is small.

        **Arguments:**

        - `mass` [kg], `height` [m]: of the person.
        - `grip` (3,) [m]: as for `Arms`.
        - `parameters`: stiffness and damping.
        """
        upper, fore, hand = 0.186 * height, 0.146 * height, 0.108 * height
        across = {"upper": 0.028 * mass * (0.322 * upper) ** 2, "fore": 0.022 * mass * (0.468 * fore) ** 2}
        inertia = {f"{name}_inertia": [moment, moment, 0.1 * moment] for name, moment in across.items()}
        lengths = {"upper_length": upper, "fore_length": fore + 0.5 * hand}
        centers = {"upper_center": 0.436 * upper, "fore_center": 0.682 * fore}
        masses = {"upper_mass": 0.028 * mass, "fore_mass": 0.022 * mass}
        return cls(grip=grip, **masses, **lengths, **centers, **inertia, **parameters)

    def posture(self, shoulder: Float[Array, " 3"]) -> tuple[Component, Component, Component]:
        """Flexion and rotation of the shoulder, and flexion of the elbow [rad], from a hanging arm to the grip of the
        upright bicycle. NaN if the arm does not reach it.

        **Arguments:**

        - `shoulder` (3,) [m]: the right shoulder.
        """
        upper, fore = self.upper_length, self.fore_length
        reach = self.grip - shoulder
        forwards, aside, down = (reach[i] for i in range(3))
        # |reach|^2 = upper^2 + fore^2 + 2 upper fore cos(elbow)
        cos_elbow = (forwards**2 + aside**2 + down**2 - upper**2 - fore**2) / (2.0 * upper * fore)
        elbow = jnp.arccos(cos_elbow)
        across = fore * jnp.sin(elbow)
        rotation = jnp.arcsin(aside / across)
        flexion = jnp.arctan2(forwards, down) - jnp.arctan2(across * jnp.cos(rotation), upper + fore * cos_elbow)
        return flexion, rotation, elbow

    def motion(
        self, bicycle: BicycleLike, motion: BicycleMotion, t: Component, q: NamedVector, u: NamedVector
    ) -> BicycleMotion:
        rider: Any = _with_shoulders(bicycle.parts)
        angles = self.posture(rider.right_shoulder)
        bodies, residuals, points = [], [], {}
        for side, sign in _SIDES.items():
            names = [f"{side}_{joint}" for joint in _JOINTS]
            flexion, rotation, elbow = (add(q[name], angle) for name, angle in zip(names, angles, strict=True))
            rates = [u[f"{name}_rate"] for name in names]
            shoulder = motion["U"].rotate(2, flexion, rates[0])
            upper = shoulder.rotate(3, sign * rotation, sign * rates[1], f"{side} upper arm")
            fore = upper.rotate(2, elbow, rates[2], f"{side} forearm")
            begin = motion[f"{side}_shoulder"]
            bend = begin.fixed(self.upper_length * upper.z)
            hand = bend.fixed(self.fore_length * fore.z)
            G_upper, G_fore = begin.fixed(self.upper_center * upper.z), bend.fixed(self.fore_center * fore.z)
            bodies.append(Body(self.upper_mass, self.upper_inertia, G_upper, upper, name=f"{side} upper arm"))
            bodies.append(Body(self.fore_mass, self.fore_inertia, G_fore, fore, name=f"{side} forearm"))
            grip = bicycle.on_fork(motion, self.grip[0], sign * self.grip[1], self.grip[2])
            residuals.append(hand.velocity - grip.velocity)
            points |= {f"{side}_elbow": bend, f"{side}_hand": hand, f"{side}_grip": grip}
        return motion.extended(bodies, residuals, points=points)

    def configuration_constraints(
        self, bicycle: BicycleLike, t: Component, q: NamedVector, motion: BicycleMotion
    ) -> Sequence[Component]:
        apart = [motion[f"{side}_hand"].position_from(motion[f"{side}_grip"]) for side in _SIDES]
        return [x for r in apart for x in r.components_in(motion["H"])]

    def loads(
        self, bicycle: BicycleLike, t: Component, q: NamedVector, u: NamedVector, motion: BicycleMotion, values: Values
    ) -> Loads:
        torques = []
        for side, sign in _SIDES.items():
            upper, fore = motion[f"{side} upper arm"].frame, motion[f"{side} forearm"].frame
            bend = self._torque(f"{side}_elbow", self.elbow_stiffness, self.elbow_damping, q, u)
            bend = add(bend, values[f"{side}_elbow_torque"])
            torques.append(Torque(bend * upper.y, fore, reaction_on=upper))
            if self.shoulder_stiffness is not None or self.shoulder_damping is not None:
                shoulder, law = upper.parent, (self.shoulder_stiffness, self.shoulder_damping, q, u)
                flex, turn = (self._torque(f"{side}_{joint}", *law) for joint in _JOINTS[:2])
                torques.append(Torque(flex * shoulder.y, shoulder, reaction_on=motion["U"]))
                torques.append(Torque(sign * turn * upper.z, upper, reaction_on=shoulder))
        return torques

    def _torque(
        self, name: str, stiffness: Scalar | None, damping: Scalar | None, q: NamedVector, u: NamedVector
    ) -> Component:
        torque: Component = 0.0
        if stiffness is not None:
            torque = torque - stiffness * q[name]
        if damping is not None:
            torque = torque - damping * u[f"{name}_rate"]
        return torque


def _with_shoulders(parts: Iterable[Any]) -> Rider | None:
    """The rider with shoulders, in any field."""
    return next((part for part in parts if isinstance(part, Rider) and part.right_shoulder is not None), None)
