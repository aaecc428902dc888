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

from .._common.lookup import refuse_unknown
from .._description.bodies import Body
from .._description.frames import Frame
from .._description.motion import Motion
from .._description.points import Point, inertial
from .._description.vectors import Vector
from .._method.kane import as_row
from .._method.right_hand_side import named_row
from .._scalars.components import add
from .._scalars.types import Component
from ..catalog._bicycle_file import refuse_other_units
from ..catalog.bicycle import WhippleBicycle
from ._asked import as_tuple, by_name, commanded, moved, refuse_misfits, told
from ._files import as_meijaard, read_yaml
from ._ground import Ground, Slope
from ._head import HeadTwist
from ._part import Part
from ._rider import rider_of
from ._tyre import Contact, Tyre, rolling_speed

REAR, FRONT = "rear", "front"
OFF_ROAD = 1e-3
"""[m]: a motion over a `Road` ends where a contact is further from it than that."""
_ASIDE = ("_lateral_slip", "_lateral_deflection")


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

    - `road`: a `Slope`, or a `Road` of given height; by default level ground. On a `Road` the place of the front
        contact and the height of the rear one are coordinates too, "front_x", "front_y" and "rear_height" [m]; yaw,
        roll and pitch begin at its tangent plane.

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
    extra: tuple[Part, ...] = eqx.field(default=(), converter=as_tuple)
    road: Ground = eqx.field(default_factory=Ground)

    def __check_init__(self) -> None:
        refuse_misfits(self)

    def with_parts(self, **parts: Any) -> Self:
        """A copy with other parts, or parameters, by the names of the fields."""
        refuse_unknown(parts, [f.name for f in dataclasses.fields(self)], f"{type(self).__name__} has no field")
        return dataclasses.replace(self, **parts)

    @classmethod
    def from_file(cls, path: str | os.PathLike[str]) -> Self:
        """A bicycle from a file of BicycleParameters: a text file (`NAME = value+/-deviation`), or YAML by its suffix.

        A YAML file may also hold a rider: a rigid one ("Moore2019", "principal"), or one who leans
        ("MooreRiderLean2012"). The speed `v` is passed over.

        **Raises:** `ValueError` that names the lines that are unknown, repeated or malformed, what is missing, and
        what is not in metres or radians.
        """
        if Path(path).suffix.lower() not in (".yml", ".yaml"):
            return super().from_file(path)
        kind, values = read_yaml(path)
        try:
            found, rider = as_meijaard(kind, values)
            refuse_other_units(found)
            return cls.from_parameters(found | ({} if rider is None else {"rider": rider_of(rider)}))
        except ValueError as error:
            raise ValueError(f"{os.fspath(path)}: {error}") from None

    @property
    def parts(self) -> tuple[Part, ...]:
        """All parts, in the order in which they are asked; tyres are none of them."""
        held = (getattr(self, field.name) for field in dataclasses.fields(self))
        return tuple(part for each in held for part in as_tuple(each) if isinstance(part, Part))

    @property
    def coordinates(self) -> tuple[str, ...]:
        return (*WhippleBicycle.coordinates, *self._of_road(), *self._of_parts("coordinates"))

    @property
    def speeds(self) -> tuple[str, ...]:
        held = self._of_parts("dependent_speeds")  # a part may hold a speed of the bicycle
        independent = (*WhippleBicycle.speeds, *self._slips(), *self._of_parts("speeds"))
        return tuple(name for name in independent if name not in held)

    @property
    def dependent_speeds(self) -> tuple[str, ...]:
        return (*WhippleBicycle.dependent_speeds, *self._of_front(), *self._of_parts("dependent_speeds"))

    @property
    def dependent_coordinates(self) -> tuple[str, ...]:
        return (*WhippleBicycle.dependent_coordinates, *self._of_road(), *self._of_parts("dependent_coordinates"))

    @property
    def inputs(self) -> tuple[str, ...]:
        return (*WhippleBicycle.inputs, *self._of_parts("inputs"))

    @property
    def states(self) -> tuple[str, ...]:
        return (*self._deflected(), *self._transferred(), *self._of_parts("states"))

    @property
    def units(self) -> Mapping[str, str]:
        found = {**WhippleBicycle.units, **dict.fromkeys(self._slips(), "m/s")}
        found |= dict.fromkeys((*self._deflected(), *self._of_road()), "m") | dict.fromkeys(self._of_front(), "m/s")
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
    def needs_trim(self) -> bool:
        """Whether riding straight on takes a torque of the drive, or moves coordinates of parts that gravity loads."""
        resists = any(part.resists for part in self.parts) or isinstance(self.road, Slope)
        settles = any(
            name not in (*part.lateral(), *part.dependent_coordinates)
            for part in self.parts
            for name in part.coordinates
        )
        return resists or settles or any(tyre.rolling_resistance is not None for _, tyre in self._tyres())

    @property
    def mode_groups(self) -> dict[str, tuple[str, ...]]:
        """Those of `lateral` that it has beside the Whipple bicycle's, by the name of the modes that they bring.

        The front end gives way in the tyre's relaxation or the frame's torsion: then it can wobble.
        """
        tyres = {end: [f"{end}_lateral_{what}" for what in ("slip", "deflection")] for end in (REAR, FRONT)}
        found = {f"{end} tyre": tuple(name for name in names if name in self.lateral) for end, names in tyres.items()}
        for field in dataclasses.fields(self):
            held = [part for part in as_tuple(getattr(self, field.name)) if isinstance(part, Part)]
            found[field.name] = tuple(name for part in held for name in part.lateral())
        elastic = [found.pop("head"), *([found.pop("front tyre")] if len(found["front tyre"]) == 2 else [])]
        found |= dict(zip(("wobble", "front end"), [names for names in elastic if names], strict=False))
        return {name: names for name, names in found.items() if names}

    def _of_road(self) -> tuple[str, ...]:
        """Names of the coordinates that a road of given height brings."""
        return ("front_x", "front_y", "rear_height") if self.road.curved else ()

    def _of_front(self) -> tuple[str, ...]:
        """Names of the speeds of the front contact's place."""
        return ("front_x_rate", "front_y_rate") if self.road.curved else ()

    def _front_place(self, q: Any) -> tuple[Component, Component]:
        return (q["front_x"], q["front_y"]) if self.road.curved else (0.0, 0.0)

    def _of_parts(self, kind: str) -> tuple[str, ...]:
        return tuple(name for part in self.parts for name in getattr(part, kind))

    def _tyres(self) -> Iterator[tuple[str, Tyre]]:
        yield from ((REAR, self.rear_tyre), (FRONT, self.front_tyre))

    def _slips(self) -> tuple[str, ...]:
        return tuple(f"{end}_{name}_slip" for end, tyre in self._tyres() for name, _ in tyre.laws)

    def _deflected(self) -> tuple[str, ...]:
        return tuple(f"{end}_{name}_deflection" for end, tyre in self._tyres() for name in tyre.deflects)

    def _transferred(self) -> tuple[str, ...]:
        """Names of the states by which tyres' loads follow what the ground carries."""
        return tuple(f"{end}_load_transfer" for end, tyre in self._tyres() if tyre.load_lag is not None)

    def _slip(self, end: str, u: Any) -> tuple[Component, Component]:
        """Velocities of a tyre's contact, along the heading and across it [m/s]; exactly zero where it rolls."""
        tyre = self.rear_tyre if end == REAR else self.front_tyre
        along = 0.0 if tyre.longitudinal is None else u[f"{end}_longitudinal_slip"]
        return along, 0.0 if tyre.lateral is None else u[f"{end}_lateral_slip"]

    def q_dot(self, t, q, u):
        turning = [u[f"{part}_rate"] for part in ("roll", "rear_wheel", "steer", "yaw", "pitch", "front_wheel")]
        moving = list(self._place_rates(q, u))
        if self.road.curved:
            climbing = self.road.climbing(q["x"], q["y"], self._place_rates(q, u))
            moving += [*(u[name] for name in self._of_front()), climbing]
        for part in self.parts:
            moving += as_row(part.q_dot(self, t, q, u), part.coordinates, told(part, "q_dot"))
        return (*turning, *moving)

    @property
    def steer_point(self) -> tuple[Component, Component]:
        """x, z of the point S [m], of the upright bicycle and from the rear contact: on the steer axis, nearest to the
        rear wheel's centre (Example 7)."""
        cos, sin = jnp.cos(self.lam), jnp.sin(self.lam)
        x = (self.w + self.c) * cos * cos - self.rR * sin * cos
        return x, -self.rR - x * sin / cos

    def _place_rates(self, q: Any, u: Any) -> tuple[Component, Component]:
        return self.road.rates(q["x"], q["y"], q["yaw"], *self._contact_rates(q, u))

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
        T = self.road.tangent(N, q["x"], q["y"], lambda: self._place_rates(q, u))
        Y = T.rotate(3, q["yaw"], u["yaw_rate"], "Y")
        R = Y.rotate(1, q["roll"], u["roll_rate"], "R")
        B = R.rotate(2, q["pitch"], u["pitch_rate"], "B")  # rear frame
        tilted = B.rotate(2, self.lam, 0.0, "tilt")

        xS, zS = self.steer_point
        omega_A = B.angular_velocity + u["rear_wheel_rate"] * B.y
        along, across = self._slip(REAR, u)
        place = q["x"] * N.x + q["y"] * N.y
        if self.road.curved:
            place = place - q["rear_height"] * N.z
        r_P_A = -self.rear_tyre.reach(R.z, T.z, self.rR)
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
        normal = self.road.normal(N, *self._front_place(q))
        n1, _, n3 = normal.components_in(C)
        down = C.vector(n1, 0.0, n3).normalize()  # in the plane of the front wheel
        r_D_Q = self.front_tyre.reach(down, normal, self.rF)
        Q = Point(G_D.velocity + omega_D.cross(r_D_Q), G_D, r_D_Q)

        bodies = self.bodies((G_A, G_B, G_C, G_D), (R, B, H, C), omega_A, omega_D)
        frames = {"Y": Y, "B": B, "C": C, "H": H}
        motion = BicycleMotion(bodies, points={"P": P, "Q": Q, "S": S}, frames=frames)
        forward, _ = self._contact_rates(q, u)
        motion.rear = Contact(P, Y.x, Y.y, T.z, R.z, q["roll"], forward, (along, across))
        motion.front, residuals = self._front_contact(Q, C, down, normal, q, u)
        motion = motion.extended((), residuals)
        for part in self.parts:
            motion = moved(part, self, motion, t, q, u)
        return motion

    def _front_contact(
        self, Q: Point, C: Frame, down: Vector, normal: Vector, q: Any, u: Any
    ) -> tuple[Contact, list[Any]]:
        """The front contact, and what is zero there [m/s].

        The wheel's plane and the ground meet along the heading. As its normal n turns, and the fork with omega, the
        wheel spins against its contact with the front wheel's rate + (omega . across - heading . n_dot) / cos(camber),
        and the camber grows with omega . heading + (axle . n_dot) / cos(camber).
        """
        tyre, slip = self.front_tyre, self._slip(FRONT, u)
        heading = C.y.cross(normal).normalize()
        across = normal.cross(heading)
        sin_camber, cos_camber = C.y.dot(normal), down.dot(normal)
        spin = u["front_wheel_rate"] + C.angular_velocity.dot(across) / cos_camber
        if not self.road.curved:
            speed = rolling_speed(tyre, spin, cos_camber, self.rF, slip[0])
            contact = Contact(Q, heading, across, normal, down, jnp.arctan2(sin_camber, cos_camber), speed, slip)
            return contact, tyre.residuals(contact)
        at = (u["front_x_rate"], u["front_y_rate"])
        turning = self.road.normal_rate(C.root, q["front_x"], q["front_y"], at)
        speed = rolling_speed(tyre, spin - turning.dot(heading) / cos_camber, cos_camber, self.rF, slip[0])
        aside = slip[1]
        if tyre.crown is not None:
            aside = aside + tyre.crown * (C.angular_velocity.dot(heading) + turning.dot(C.y) / cos_camber)
        contact = Contact(Q, heading, across, normal, down, jnp.arctan2(sin_camber, cos_camber), speed, slip)
        moved = self.road.velocity(C.root, q["front_x"], q["front_y"], at)
        return contact, [*tyre.residuals(contact), moved.dot(heading) - speed, moved.dot(across) - aside]

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

    def gravity(self, N: Frame) -> Vector:
        return self.road.gravity(self.g, N)

    def tyre_loads(self, motion: Any) -> dict[str, Component]:
        """What the ground carries under each wheel [N], "rear" and "front", if nothing accelerated: from the moments of
        all weights about the contacts."""
        gravity, Y, P = self.gravity(motion.N), motion["Y"], motion["P"]
        moments = [body.center.position_from(P).cross(body.mass * gravity).dot(Y.y) for body in motion.bodies]
        front = sum(moments[1:], moments[0]) / motion["Q"].position_from(P).cross(motion.front.normal).dot(Y.y)
        pressing = _mass(motion) * gravity.dot(motion.rear.normal)
        return {REAR: pressing - front * motion.front.normal.dot(motion.rear.normal), FRONT: front}

    def _carried(self, motion: Any, values: Mapping[str, Component]) -> dict[str, Component]:
        """Loads that the tyres feel [N]."""
        found = self.tyre_loads(motion)
        for name in self._transferred():
            end = name.partition("_")[0]
            found[end] = found[end] + _mass(motion) * self.g * values[name]
        return found

    def _transfer_rates(self, motion: Any, now: Any) -> Iterator[Component]:
        """Of the loads that follow what the ground carries, over the weight [1/s]."""
        felt = self._carried(motion, now) if self._transferred() else {}
        for (end, tyre), point, contact in zip(self._tyres(), ("P", "Q"), (motion.rear, motion.front), strict=True):
            if tyre.load_lag is not None:
                carried = -now.force(point).dot(contact.normal)
                yield (carried - felt[end]) / (_mass(motion) * self.g * tyre.load_lag)

    def _deflections(self, end: str, tyre: Tyre, values: Any) -> dict[str, Component]:
        return {name: values[f"{end}_{name}_deflection"] for name in tyre.deflects}

    def tyre_forces(self, motion: Any, values: Mapping[str, Component]) -> dict[str, Component]:
        """Forces of the ground on the tyres that slip [N], as "front_lateral_force"; `values` as of `loads`."""
        carried = self._carried(motion, values)
        found = {}
        for end, tyre, contact, _, _ in self._wheels(motion):
            forces = tyre.forces(contact, carried[end], self._deflections(end, tyre, values))
            found |= {f"{end}_{name}_force": force for name, force in forces.items()}
        return found

    def loads(self, t, q, u, motion, inputs):
        values = commanded(self, t, q, u, motion, inputs)
        found: list[Any] = [super().loads(t, q, u, motion, values)]
        ground = [each for each in self._wheels(motion) if each[1].laws or each[1].rolling_resistance is not None]
        carried = self._carried(motion, values) if ground else {}
        for end, tyre, contact, wheel, radius in ground:
            deflections = self._deflections(end, tyre, values)
            found.append(tuple(tyre.loads(contact, wheel, radius, carried[end], deflections)))
        found += [part.loads(self, t, q, u, motion, values) for part in self.parts]
        return found

    def state_rates(self, t, q, u, x, motion: Any, now):
        now = now.with_values(commanded(self, t, q, u, motion, now))
        rates = []
        for end, tyre, contact, _, _ in self._wheels(motion):
            rates += tyre.deflection_rates(contact, self._deflections(end, tyre, x))
        rates += self._transfer_rates(motion, now)
        for part in self.parts:
            rates += named_row(part.state_rates(self, t, q, u, x, motion, now), part.states, told(part, "state_rates"))
        return rates

    def outputs(self, t, q, u, motion: Any, now):
        given = commanded(self, t, q, u, motion, now)
        now = now.with_values(given)
        found: dict[str, Any] = dict(self.tyre_forces(motion, now))
        found |= {f"applied_{name}": now[name] for name in given.commanded}
        for part in self.parts:
            more = by_name(part.outputs(self, t, q, u, motion, now), told(part, "outputs"))
            twice = [name for name in more if name in found]
            if twice:
                raise ValueError(f"{told(part, 'outputs')}: there is an output {twice[0]!r} already.")
            found |= more
        return found

    def configuration_constraints(self, t, q):
        motion = self.motion(t, q, (0.0,) * (len(self.speeds) + len(self.dependent_speeds)))
        held = self._off_road(motion, q)
        if self.road.curved:
            there = sum(x * x for x in held) < (1e-3 * OFF_ROAD) ** 2  # not on the way of a solver
            refused = there & (self._clearance(motion) <= 0.0)
            held = [jnp.where(refused, jnp.nan, x) for x in held]
        return [*held, *(x for part in self.parts for x in part.configuration_constraints(self, t, q, motion))]

    def _off_road(self, motion: Motion, q: Any) -> list[Component]:
        """How far the contacts are from the ground [m]."""
        Q, N = motion["Q"].position, motion.N
        if not self.road.curved:
            return [Q.dot(N.z)]
        front = Q - self.road.place(N, *self._front_place(q))
        return [*(front.dot(axis) for axis in (N.x, N.y, N.z)), q["rear_height"] - self.road.at(q["x"], q["y"])]

    def _clearance(self, motion: Any) -> Component:
        """Of both wheels, see `Road.clearance`."""
        room = [
            self.road.clearance(motion.N, contact, wheel.center, radius, tyre.crown)
            for _, tyre, contact, wheel, radius in self._wheels(motion)
        ]
        return jnp.minimum(*room)

    def events(self, t, q, u):
        found = super().events(t, q, u)
        if not self.road.curved:
            return found
        at_rest = self.motion(t, q, (0.0,) * (len(self.speeds) + len(self.dependent_speeds)))
        # An edge that is narrower than a step of the solver shows by what is off the road after it.
        on_road = 1.0 - sum(x * x for x in self._off_road(at_rest, q)) / OFF_ROAD**2
        return {**found, "wheel_touches_twice": self._clearance(at_rest), "wheel_off_the_road": on_road}


class BicycleMotion(Motion):
    """A motion that knows both contacts with the ground."""

    __slots__ = ("front", "rear")

    rear: Contact
    front: Contact


def _mass(motion: Motion) -> Component:
    masses = [body.mass for body in motion.bodies]
    return sum(masses[1:], masses[0])
