"""Riders on the frame, rigid or leaning on a hinge, and arms from their shoulders to the handlebar."""

from __future__ import annotations

import abc
import os
from collections.abc import Iterable, Iterator, Mapping
from itertools import takewhile
from typing import Any, NamedTuple, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._kane.arguments import is_concrete
from .._kane.checks import why_no_body
from .._scalarjit.components import Component, Scalar, add
from .._system.kinematics import Frame, Point
from .._system.motion import Body, Torque
from .._system.parameters import in_batches, parameter
from ..catalog import read_bicycle_file
from ..catalog.bicycle import ABOVE_GROUND, FAR, TILT
from ._part import Part

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
    def from_file(cls, path: str | os.PathLike[str], **parameters: Any) -> Self:
        """A rider whose body is that of a rider's text file of BicycleParameters (`mB = value`, to `IBxz`).

        **Arguments:** `parameters`: the other parameters, as the hinge of one who leans.

        **Raises:** `ValueError` that names the lines that are unknown, repeated or malformed, and what is missing.
        """
        values, _ = read_bicycle_file(path, known=(*_IN_A_FILE, "yB"))
        missing = [name for name in _IN_A_FILE if name not in values]
        if missing or abs(values.get("yB", 0.0)) > 1e-3:
            why = f"missing: {', '.join(missing)}" if missing else f"the rider sits aside, yB = {values['yB']:.4g} m"
            raise ValueError(f"{os.fspath(path)}: {why}.")
        return cls(**{_IN_A_FILE[name]: values[name] for name in _IN_A_FILE}, **parameters)

    @abc.abstractmethod
    def carried(self, bicycle: Any, motion: Any, q: Any, u: Any) -> tuple[Frame, Point, Scalar, Scalar]:
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


def separate_rider(bicycle: Any, rider: Rider) -> Any:
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
    of_frame = _about(bicycle.mB, bicycle.xB, bicycle.zB, bicycle.IBxx, bicycle.IByy, bicycle.IBzz, bicycle.IBxz)
    of_rider = _about(rider.mass, rider.x, rider.z, rider.Ixx, rider.Iyy, rider.Izz, rider.Ixz)
    rest = [a - b for a, b in zip(of_frame, of_rider, strict=True)]  # about the rear contact
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


_SIDES = {"left": -1.0, "right": 1.0}
_JOINTS = ("shoulder_flexion", "shoulder_rotation", "elbow")


class _Arm(NamedTuple):
    bodies: tuple[Body, Body]
    elbow: Point
    hand: Point


class Arms(Part):
    """Two arms, each with an upper arm and a forearm, whose hands stay at the grips of the handlebar.

    A shoulder turns by flexion about the rider's axis to the right, then by rotation about the upper arm; an elbow by
    flexion. Three angles place a hand, so that steering and leaning determine both arms: "left_shoulder_flexion",
    "left_shoulder_rotation", "left_elbow" and the same of the right are dependent coordinates. All [rad] are counted
    from the posture in which the hands hold the grips of the upright bicycle: zeros are always a start, and `assemble`
    finds the rest. Flexion raises the hand forwards; rotation turns the flexed forearm outwards.

    The arms need a rider with shoulders: `LeaningRider(..., shoulder=(x, y, z))`. Their masses are none of the rider's
    or the fork's. The inputs "left_elbow_torque" and "right_elbow_torque" [N m] bend the elbows.

    **Arguments**, the same of both arms:

    - `grip` (3,) [m]: x, y and z of the right grip at zero steer, in Meijaard's measures; the left is its mirror image.
    - `upper_length`, `fore_length` [m]: from shoulder to elbow and from elbow to hand.
    - `upper_mass`, `fore_mass` [kg]; `upper_center`, `fore_center` [m]: of the mass centres from shoulder and elbow;
        `upper_inertia`, `fore_inertia` (3,) [kg m^2] about them: forwards, sideways and along the arm as it hangs down.
    - `shoulder_stiffness`, `shoulder_damping`, `elbow_stiffness`, `elbow_damping` [N m/rad, N m s/rad], of each angle
        from that posture; by default none.

    **Raises:** `ValueError` for a bicycle without a rider who has shoulders, and for arms too short or too long for
    the grips. Where numbers are traced the coordinates become NaN instead.
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

    def check(self, bicycle):
        rider = _with_shoulders(takewhile(lambda part: part is not self, bicycle.parts))
        if rider is None:
            raise ValueError(
                f"Arms need a rider with shoulders, whom this {type(bicycle).__name__} does not have before them: "
                "with_parts(rider=LeaningRider(..., shoulder=(x, y, z))) or RigidRider."
            )
        if not is_concrete(self, rider) or in_batches(self) or in_batches(rider):
            return  # members that cannot be have NaN
        shoulder: Any = rider.right_shoulder
        reach, longest = self.grip - shoulder, self.upper_length + self.fore_length
        distance, shortest = jnp.sqrt(reach @ reach), abs(self.upper_length - self.fore_length)
        if not shortest < distance < longest:
            raise ValueError(
                f"Arms: from the shoulder to the grip it is {float(distance):.4g} m, and these arms reach from "
                f"{float(shortest):.4g} to {float(longest):.4g} m. Change their lengths, the grips or the shoulders."
            )
        if not np.all(np.isfinite(self.posture(shoulder))):
            raise ValueError(
                "Arms: a hand is too far aside for an elbow that bends forwards: bring `grip` and the rider's "
                "`shoulder` closer to each other across the bicycle, or lengthen the forearm."
            )

    @classmethod
    def of_person(cls, mass: float, height: float, grip: Any, **parameters: Any) -> Self:
        """The arms of a person of this mass [kg] and height [m], by the means of Winter (2009), *Biomechanics and Motor
        Control of Human Movement*, Table 4.1 and Figure 4.1: lengths in parts of the height, masses of the mass.

        The hand is counted to the forearm and holds the grip in its middle. About its length a part has a tenth of the
        moment of inertia across it, which has little effect. `parameters`: stiffness and damping.
        """
        upper, fore, hand = 0.186 * height, 0.146 * height, 0.108 * height
        across = {"upper": 0.028 * mass * (0.322 * upper) ** 2, "fore": 0.022 * mass * (0.468 * fore) ** 2}
        inertia = {f"{name}_inertia": [moment, moment, 0.1 * moment] for name, moment in across.items()}
        lengths = {"upper_length": upper, "fore_length": fore + 0.5 * hand}
        centers = {"upper_center": 0.436 * upper, "fore_center": 0.682 * fore}
        masses = {"upper_mass": 0.028 * mass, "fore_mass": 0.022 * mass}
        return cls(grip=grip, **masses, **lengths, **centers, **inertia, **parameters)

    def posture(self, shoulder: Any) -> tuple[Component, Component, Component]:
        """Flexion and rotation of the shoulder, and flexion of the elbow [rad]: from an arm that hangs down to one
        whose hand is at the grip of the upright bicycle. NaN where it does not reach it. `shoulder` (3,) [m]: right.
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

    def _arms(self, bicycle: Any, motion: Any, q: Any, u: Any) -> Iterator[tuple[str, _Arm]]:
        U, angles = motion["U"], self.posture(_with_shoulders(bicycle.parts).right_shoulder)  # type: ignore[union-attr]
        for side, sign in _SIDES.items():
            names = [f"{side}_{joint}" for joint in _JOINTS]
            flexion, rotation, elbow = (add(q[name], angle) for name, angle in zip(names, angles, strict=True))
            rates = [u[f"{name}_rate"] for name in names]
            shoulder = U.rotate(2, flexion, rates[0])
            upper = shoulder.rotate(3, sign * rotation, sign * rates[1], f"{side} upper arm")
            fore = upper.rotate(2, elbow, rates[2], f"{side} forearm")
            begin = motion[f"{side}_shoulder"]
            bend = begin.fixed(self.upper_length * upper.z)
            bodies = (
                self._body(side, "upper arm", self.upper_mass, self.upper_inertia, begin, self.upper_center, upper),
                self._body(side, "forearm", self.fore_mass, self.fore_inertia, bend, self.fore_center, fore),
            )
            yield side, _Arm(bodies, bend, bend.fixed(self.fore_length * fore.z))

    def _body(self, side: str, name: str, mass: Scalar, inertia: Any, begin: Point, center: Scalar, A: Frame) -> Body:
        moments = [inertia[i] for i in range(3)]
        return Body(mass, moments, begin.fixed(center * A.z), A, name=f"{side} {name}")

    def motion(self, bicycle, motion, t, q, u):
        bodies, residuals, points = [], [], {}
        for side, arm in self._arms(bicycle, motion, q, u):
            grip = bicycle.on_fork(motion, self.grip[0], _SIDES[side] * self.grip[1], self.grip[2])
            bodies += arm.bodies
            residuals.append(arm.hand.velocity - grip.velocity)
            points |= {f"{side}_elbow": arm.elbow, f"{side}_hand": arm.hand, f"{side}_grip": grip}
        return motion.extended(bodies, residuals, points=points)

    def configuration_constraints(self, bicycle, t, q, motion):
        apart = [motion[f"{side}_hand"].position_from(motion[f"{side}_grip"]) for side in _SIDES]
        return [x for r in apart for x in r.components_in(motion["H"])]

    def loads(self, bicycle, t, q, u, motion, values):
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

    def _torque(self, name: str, stiffness: Scalar | None, damping: Scalar | None, q: Any, u: Any) -> Component:
        torque: Component = 0.0
        if stiffness is not None:
            torque = torque - stiffness * q[name]
        if damping is not None:
            torque = torque - damping * u[f"{name}_rate"]
        return torque


def _with_shoulders(parts: Iterable[Any]) -> Rider | None:
    """The rider whose arms they are, in whichever field he is."""
    return next((part for part in parts if isinstance(part, Rider) and part.right_shoulder is not None), None)
