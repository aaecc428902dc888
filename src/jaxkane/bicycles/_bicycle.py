"""A bicycle put together from parts, on the parameters of the Whipple bicycle. Knows kinematics and its parts' methods.

Its motion follows Example 7 and Meijaard et al. (2007). Where a tyre slips, velocities of its contact that ideal
rolling makes zero are speeds, and forces of the tyre stand in the place of those of the constraint.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Self

import equinox as eqx
import jax.numpy as jnp

from .._common.lookup import not_there, refuse_unknown
from .._description.bodies import Body, Motion
from .._description.vectors import Frame, Point, Vector, inertial
from .._scalars.components import add, mul
from .._scalars.types import Component
from ..catalog.bicycle import WhippleBicycle
from ._files import as_meijaard, read_yaml
from ._head import HeadTwist
from ._part import Part
from ._rider import rider_of
from ._tyre import Contact, Tyre, rolling_speed

REAR, FRONT = "rear", "front"
_ASIDE = ("_lateral_slip", "_lateral_deflection")


def _as_tuple(parts: Any) -> tuple[Any, ...]:
    if isinstance(parts, (tuple, list)):
        return tuple(parts)
    return () if parts is None else (parts,)


class Bicycle(WhippleBicycle):
    """A bicycle with parts: tyres, a rider, steering, a drive, who steers it, and what else it carries.

        Bicycle.benchmark().with_parts(
            front_tyre=Tyre(lateral=LateralSlip(9000.0, 900.0, relaxation_length=0.1)),
            rider=LeaningRider(...),
        )

    Without parts it is the `WhippleBicycle`, whose parameters it has under the same names; those of a part have its
    name before theirs: "rider.stiffness", "front_tyre.lateral.cornering_stiffness".

    **Arguments** beside Meijaard's parameters:

    - `rear_tyre`, `front_tyre`: `Tyre`, by default a knife edge that rolls. A tyre that slips has the velocity of its
        contact as a speed of its own, "rear_lateral_slip" and "front_longitudinal_slip" [m/s], which is zero in ideal
        rolling; with a relaxation length it has states, as "front_lateral_deflection" [m].
    - `head`: `HeadTwist`, a frame that gives way in torsion at the steering head.
    - `rider`, `control`, `steering`, `drive`: a `Part` each, or several in a tuple. `extra`: any more.

    Parts are asked in this order: `rider`, `control`, `steering`, `drive`, `extra`. A class that inherits from this one
    may have fields of its own that hold parts.

    The motion names what that of `WhippleBicycle` names, and the frame "H" of the fork at zero steer. Inputs that parts
    command are outputs too, with what came from outside: "applied_steer_torque".
    """

    rear_tyre: Tyre = eqx.field(default_factory=Tyre)
    front_tyre: Tyre = eqx.field(default_factory=Tyre)
    head: HeadTwist | None = None
    rider: Part | None = None
    control: Part | tuple[Part, ...] | None = None
    steering: Part | tuple[Part, ...] | None = None
    drive: Part | tuple[Part, ...] | None = None
    extra: tuple[Part, ...] = eqx.field(default=(), converter=_as_tuple)

    def __check_init__(self) -> None:
        for name, kind in (("rear_tyre", Tyre), ("front_tyre", Tyre), ("head", HeadTwist | None)):
            if not isinstance(getattr(self, name), kind):
                raise TypeError(f"{type(self).__name__}: `{name}` is a {_called(kind)}, got {getattr(self, name)!r}.")
        for name in ("rider", "control", "steering", "drive", "extra"):
            for part in _as_tuple(getattr(self, name)):
                if not isinstance(part, Part):
                    raise TypeError(f"{type(self).__name__}: `{name}` holds a Part of jaxkane.bicycles, got {part!r}.")
        for part in self.parts:
            part.check(self)

    def with_parts(self, **parts: Any) -> Self:
        """A copy with other parts, or parameters, by the names of the fields."""
        refuse_unknown(parts, [f.name for f in dataclasses.fields(self)], f"{type(self).__name__} has no field")
        return dataclasses.replace(self, **parts)

    @classmethod
    def from_file(cls, path: str | os.PathLike[str]) -> Self:
        """A bicycle from a file of BicycleParameters: a text file (`NAME = value+/-deviation`), or YAML by its suffix.

        A YAML file may also hold a rider: a rigid one ("Moore2019", "principal"), or one who leans
        ("MooreRiderLean2012"). The speed `v` is passed over.

        **Raises:** `ValueError` that names the lines that are unknown, repeated or malformed, and what is missing.
        """
        if Path(path).suffix.lower() not in (".yml", ".yaml"):
            return super().from_file(path)
        kind, values = read_yaml(path)
        try:
            found, rider = as_meijaard(kind, values)
            return cls.from_parameters(found | ({} if rider is None else {"rider": rider_of(rider)}))
        except ValueError as error:
            raise ValueError(f"{os.fspath(path)}: {error}") from None

    @property
    def parts(self) -> tuple[Part, ...]:
        """All parts, in the order in which they are asked; tyres are none of them."""
        held = (getattr(self, field.name) for field in dataclasses.fields(self))
        return tuple(part for each in held for part in _as_tuple(each) if isinstance(part, Part))

    @property
    def coordinates(self) -> tuple[str, ...]:
        return (*WhippleBicycle.coordinates, *self._of_parts("coordinates"))

    @property
    def speeds(self) -> tuple[str, ...]:
        held = self._of_parts("dependent_speeds")  # a part may hold a speed of the bicycle
        independent = (*WhippleBicycle.speeds, *self._slips(), *self._of_parts("speeds"))
        return tuple(name for name in independent if name not in held)

    @property
    def dependent_speeds(self) -> tuple[str, ...]:
        return (*WhippleBicycle.dependent_speeds, *self._of_parts("dependent_speeds"))

    @property
    def dependent_coordinates(self) -> tuple[str, ...]:
        return (*WhippleBicycle.dependent_coordinates, *self._of_parts("dependent_coordinates"))

    @property
    def inputs(self) -> tuple[str, ...]:
        return (*WhippleBicycle.inputs, *self._of_parts("inputs"))

    @property
    def states(self) -> tuple[str, ...]:
        return (*self._deflected(), *self._of_parts("states"))

    @property
    def units(self) -> Mapping[str, str]:
        found = {**WhippleBicycle.units, **dict.fromkeys(self._slips(), "m/s")}
        found |= dict.fromkeys(self._deflected(), "m")
        for part in self.parts:
            found |= part.units
        return found | {f"applied_{name}": found[name] for name in self.inputs if name in found}

    @property
    def lateral(self) -> tuple[str, ...]:
        """Names of what its linear model about straight riding holds: the coordinates, speeds and states that move to
        first order when it leaves the upright plane."""
        of_tyres = [name for name in (*self._slips(), *self._deflected()) if name.endswith(_ASIDE)]
        moving = {*WhippleBicycle.lateral, *of_tyres, *(name for part in self.parts for name in part.lateral())}
        return tuple(name for name in (*self.coordinates, *self.speeds, *self.states) if name in moving)

    @property
    def mode_groups(self) -> dict[str, tuple[str, ...]]:
        """Those of `lateral` that it has beside the Whipple bicycle's, by the name of the modes that they bring.

        The front end gives way in the tyre's relaxation or the frame's torsion: then it can wobble.
        """
        tyres = {end: [f"{end}_lateral_{what}" for what in ("slip", "deflection")] for end in (REAR, FRONT)}
        found = {f"{end} tyre": tuple(name for name in names if name in self.lateral) for end, names in tyres.items()}
        for field in dataclasses.fields(self):
            held = [part for part in _as_tuple(getattr(self, field.name)) if isinstance(part, Part)]
            found[field.name] = tuple(name for part in held for name in part.lateral())
        elastic = [found.pop("head"), *([found.pop("front tyre")] if len(found["front tyre"]) == 2 else [])]
        found |= dict(zip(("wobble", "front end"), [names for names in elastic if names], strict=False))
        return {name: names for name, names in found.items() if names}

    def _of_parts(self, kind: str) -> tuple[str, ...]:
        return tuple(name for part in self.parts for name in getattr(part, kind))

    def _tyres(self) -> Iterator[tuple[str, Tyre]]:
        yield from ((REAR, self.rear_tyre), (FRONT, self.front_tyre))

    def _slips(self) -> tuple[str, ...]:
        return tuple(f"{end}_{name}_slip" for end, tyre in self._tyres() for name, _ in tyre.laws)

    def _deflected(self) -> tuple[str, ...]:
        return tuple(f"{end}_{name}_deflection" for end, tyre in self._tyres() for name in tyre.deflects)

    def _slip(self, end: str, u: Any) -> tuple[Component, Component]:
        """Velocities of a tyre's contact, along the heading and across it [m/s]; exactly zero where it rolls."""
        tyre = self.rear_tyre if end == REAR else self.front_tyre
        along = 0.0 if tyre.longitudinal is None else u[f"{end}_longitudinal_slip"]
        return along, 0.0 if tyre.lateral is None else u[f"{end}_lateral_slip"]

    def q_dot(self, t, q, u):
        forward, aside = self._contact_rates(q, u)
        turning = [u[f"{part}_rate"] for part in ("roll", "rear_wheel", "steer", "yaw", "pitch", "front_wheel")]
        cos, sin = jnp.cos(q["yaw"]), jnp.sin(q["yaw"])
        moving = [add(mul(forward, cos), mul(-1.0, mul(aside, sin))), add(mul(forward, sin), mul(aside, cos))]
        return (*turning, *moving, *(rate for part in self.parts for rate in part.q_dot(self, t, q, u)))

    @property
    def steer_point(self) -> tuple[Component, Component]:
        """x, z of the point S [m], of the upright bicycle and from the rear contact: on the steer axis, nearest to the
        rear wheel's centre (Example 7)."""
        cos, sin = jnp.cos(self.lam), jnp.sin(self.lam)
        x = (self.w + self.c) * cos * cos - self.rR * sin * cos
        return x, -self.rR - x * sin / cos

    def _contact_rates(self, q: Any, u: Any) -> tuple[Component, Component]:
        """Velocities of the place of the rear contact on the ground, forward and to the right [m/s].

        Of a torus with the crown radius c, that rolls without slip: -(spin) (r - c + c cos(roll)) and c * roll_rate.
        """
        tyre, (along, across) = self.rear_tyre, self._slip(REAR, u)
        spin = u["rear_wheel_rate"] + u["pitch_rate"]
        forward = rolling_speed(tyre, spin, jnp.cos(q["roll"]), self.rR, along)
        return forward, across if tyre.crown is None else add(across, tyre.crown * u["roll_rate"])

    def motion(self, t, q, u):
        N, O = inertial()
        Y = N.rotate(3, q["yaw"], u["yaw_rate"], "Y")
        R = Y.rotate(1, q["roll"], u["roll_rate"], "R")
        B = R.rotate(2, q["pitch"], u["pitch_rate"], "B")  # rear frame
        tilted = B.rotate(2, self.lam, 0.0, "tilt")

        xS, zS = self.steer_point
        omega_A = B.angular_velocity + u["rear_wheel_rate"] * B.y
        along, across = self._slip(REAR, u)
        place = q["x"] * N.x + q["y"] * N.y
        r_P_A = -self.rear_tyre.reach(R.z, N.z, self.rR)
        P = Point(Y.vector(along, across, 0.0), O, place)  # of the tyre
        G_A = Point(P.velocity + omega_A.cross(r_P_A), P, r_P_A)
        G_B = G_A.fixed(self.xB * B.x + (self.zB + self.rR) * B.z)
        S = G_A.fixed(xS * B.x + (zS + self.rR) * B.z)
        if self.head is not None:
            tilted, S = self.head.turned(tilted, S, q, u)
        C = tilted.rotate(3, q["steer"], u["steer_rate"], "C")  # fork, 3 along the steer axis
        H = C.rotate(2, -self.lam, 0.0, "H")  # fork, aligned with B at zero steer

        def from_S(x, z):  # a place measured from P, upright, as a vector fixed in the fork
            return ((x - xS) * H.x + (z - zS) * H.z).express(C)

        G_C = S.fixed(from_S(self.xH, self.zH))
        G_D = S.fixed(from_S(self.w, -self.rF))
        omega_D = C.angular_velocity + u["front_wheel_rate"] * C.y
        n1, _, n3 = N.z.components_in(C)
        down = C.vector(n1, 0.0, n3).normalize()  # in the plane of the front wheel
        r_D_Q = self.front_tyre.reach(down, N.z, self.rF)
        Q = Point(G_D.velocity + omega_D.cross(r_D_Q), G_D, r_D_Q)

        A_inertia = (self.IRxx, self.IRyy, self.IRxx)
        B_inertia = ((self.IBxx, 0.0, self.IBxz), (0.0, self.IByy, 0.0), (self.IBxz, 0.0, self.IBzz))
        H_inertia = ((self.IHxx, 0.0, self.IHxz), (0.0, self.IHyy, 0.0), (self.IHxz, 0.0, self.IHzz))
        D_inertia = (self.IFxx, self.IFyy, self.IFxx)
        bodies = (
            Body(self.mR, A_inertia, G_A, R, omega_A, name="rear wheel"),
            Body(self.mB, B_inertia, G_B, B, name="rear frame"),
            Body(self.mH, H_inertia, G_C, H, name="fork"),
            Body(self.mF, D_inertia, G_D, C, omega_D, name="front wheel"),
        )
        frames = {"Y": Y, "B": B, "C": C, "H": H}
        motion = BicycleMotion(bodies, points={"P": P, "Q": Q, "S": S}, frames=frames)
        forward, _ = self._contact_rates(q, u)
        motion.rear = Contact(P, Y.x, Y.y, N.z, q["roll"], forward, (along, across))
        motion.front = self._front_contact(Q, C, down, omega_D, u)
        motion = motion.extended((), self.front_tyre.residuals(motion.front))
        for part in self.parts:
            motion = part.motion(self, motion, t, q, u)
        return motion

    def _front_contact(self, Q: Point, C: Frame, down: Vector, omega_D: Vector, u: Any) -> Contact:
        N, tyre = C.root, self.front_tyre
        if tyre.rolls and tyre.rolling_resistance is None:  # what follows is not asked for
            return Contact(Q, C.x, C.y, N.z, 0.0, 0.0, (0.0, 0.0))
        heading = C.y.cross(N.z).normalize()
        sin_camber, cos_camber = C.y.dot(N.z), down.dot(N.z)
        turning = omega_D.dot(down) / cos_camber  # about the ground's normal; the rest of omega_D is spin and camber
        spin = omega_D.dot(C.y) - turning * sin_camber
        slip = self._slip(FRONT, u)
        speed = rolling_speed(tyre, spin, cos_camber, self.rF, slip[0])
        return Contact(Q, heading, N.z.cross(heading), N.z, jnp.arctan2(sin_camber, cos_camber), speed, slip)

    def _wheels(self, motion: Any) -> Iterator[tuple[str, Tyre, Contact, Body, Component]]:
        yield REAR, self.rear_tyre, motion.rear, motion["rear wheel"], self.rR
        yield FRONT, self.front_tyre, motion.front, motion["front wheel"], self.rF

    def on_frame(self, motion: Motion, x: Component, y: Component, z: Component) -> Point:
        """A point that is fixed in the frame B, in Meijaard's measures: from the rear contact of the upright bicycle,
        x forward, y to the right, z down [m]."""
        return motion["rear wheel"].center.fixed(motion["B"].vector(x, y, add(z, self.rR)))

    def on_fork(self, motion: Motion, x: Component, y: Component, z: Component) -> Point:
        """A point that is fixed in the fork, in the same measures, at zero steer."""
        return motion["fork"].center.fixed(motion["H"].vector(x - self.xH, y, z - self.zH))

    def tyre_loads(self, motion: Motion) -> dict[str, Component]:
        """What the ground carries under each wheel [N], "rear" and "front", if nothing accelerated: from the moments of
        all weights about the contacts."""
        gravity, N, Y = self.g * motion.N.z, motion.N, motion["Y"]
        P = motion["P"]
        moments = [body.center.position_from(P).cross(body.mass * gravity).dot(Y.y) for body in motion.bodies]
        apart = motion["Q"].position_from(P).cross(N.z).dot(Y.y)
        front = sum(moments[1:], moments[0]) / apart
        masses = [body.mass for body in motion.bodies]
        total = sum(masses[1:], masses[0]) * gravity.dot(N.z)
        return {REAR: total - front, FRONT: front}

    def _deflections(self, end: str, tyre: Tyre, values: Any) -> dict[str, Component]:
        return {name: values[f"{end}_{name}_deflection"] for name in tyre.deflects}

    def tyre_forces(self, motion: Any, values: Mapping[str, Component]) -> dict[str, Component]:
        """Forces of the ground on the tyres that slip [N], as "front_lateral_force"; `values` as of `loads`."""
        carried = self.tyre_loads(motion)
        found = {}
        for end, tyre, contact, _, _ in self._wheels(motion):
            forces = tyre.forces(contact, carried[end], self._deflections(end, tyre, values))
            found |= {f"{end}_{name}_force": force for name, force in forces.items()}
        return found

    def _commanded(self, t: Any, q: Any, u: Any, motion: Any, values: Mapping[str, Component]) -> Commanded:
        """Inputs and states by name, with what the parts add to the inputs."""
        values = Commanded(values)
        for part in self.parts:
            for name, command in part.commands(self, t, q, u, motion, values).items():
                if name not in self.inputs:
                    label = f"the inputs of {type(self).__name__}, of which {type(part).__name__} adds to this one"
                    raise not_there(name, self.inputs, label)
                values[name] = add(values[name], command)
                values.commanded[name] = None
        return values

    def loads(self, t, q, u, motion, inputs):
        values = self._commanded(t, q, u, motion, inputs)
        found: list[Any] = [super().loads(t, q, u, motion, values)]
        ground = [each for each in self._wheels(motion) if each[1].laws or each[1].rolling_resistance is not None]
        carried = self.tyre_loads(motion) if ground else {}
        for end, tyre, contact, wheel, radius in ground:
            deflections = self._deflections(end, tyre, values)
            found.append(tuple(tyre.loads(contact, wheel, radius, carried[end], deflections)))
        found += [part.loads(self, t, q, u, motion, values) for part in self.parts]
        return found

    def state_rates(self, t, q, u, x, motion: Any, now):
        now = now.with_values(self._commanded(t, q, u, motion, now))
        rates = []
        for end, tyre, contact, _, _ in self._wheels(motion):
            rates += tyre.deflection_rates(contact, self._deflections(end, tyre, x))
        for part in self.parts:
            rates += list(part.state_rates(self, t, q, u, x, motion, now))
        return rates

    def outputs(self, t, q, u, motion: Any, now):
        given = self._commanded(t, q, u, motion, now)
        now = now.with_values(given)
        found: dict[str, Any] = dict(self.tyre_forces(motion, now))
        found |= {f"applied_{name}": now[name] for name in given.commanded}
        for part in self.parts:
            found |= part.outputs(self, t, q, u, motion, now)
        return found

    def configuration_constraints(self, t, q):
        motion = self.motion(t, q, (0.0,) * (len(self.speeds) + len(self.dependent_speeds)))
        height = motion["Q"].position.dot(motion.N.z)  # of the front contact, downwards
        return [height, *(x for part in self.parts for x in part.configuration_constraints(self, t, q, motion))]


class BicycleMotion(Motion):
    """A motion that knows both contacts with the ground."""

    __slots__ = ("front", "rear")

    rear: Contact
    front: Contact


class Commanded(dict[str, Any]):
    """Inputs and states by name, as parts receive them; `commanded`: names of those inputs that parts add to."""

    def __init__(self, values: Mapping[str, Component]):
        super().__init__(values)
        self.commanded: dict[str, None] = {}

    def __missing__(self, name: str) -> Component:
        raise not_there(name, self, "the inputs and states of this bicycle")


def _called(kind: Any) -> str:
    return getattr(kind, "__name__", "HeadTwist or None")
