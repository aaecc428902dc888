"""A bicycle assembled from parts, with the parameters of the Whipple bicycle.

The kinematics follow Example 7 and Meijaard et al. (2007). If a tyre slips, the slip velocities of its contact are
generalized speeds, and tyre forces replace the constraint forces of ideal rolling.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import equinox as eqx
import jax.numpy as jnp

from .._common.lookup import not_there, refuse_unknown
from .._kane.arguments import as_row, is_concrete
from .._kane.right_hand_side import MeasurementContext, named_row
from .._scalarjit.components import Component, add, component, total
from .._system.kinematics import Frame, Point, Vector, inertial
from .._system.motion import Body, DuplicateName
from .._system.parameters import parameters_in, with_parameters
from .._system.system import NamedVector
from ..catalog._entry import Loads, Quantity, Values
from ..catalog.bicycle import WhippleBicycle
from ._equipment import HeadTwist
from ._files import as_meijaard, read_yaml
from ._part import NAMES, BicycleMotion, Contact, Part, called
from ._tyre import Ground, Slope, Tyre

OFF_ROAD = 1e-3
"""[m]: a simulation on a `Road` ends if the distance of a contact from the road exceeds this value."""

REAR, FRONT = "rear", "front"
_ORDER = "rider, control, steering, drive, extra"
_SECOND_OF_A_KIND = "Values are read by name. For a second part of this kind, write your own Part with other names."
_ASIDE = ("_lateral_slip", "_lateral_deflection")


def _as_tuple(parts: object) -> tuple[Any, ...]:
    if isinstance(parts, (tuple, list)):
        return tuple(parts)
    return () if parts is None else (parts,)


class Bicycle(WhippleBicycle):
    """A bicycle with parts: tyres, a rider, a controller, steering, a drive, and others.

        Bicycle.benchmark().with_parts(
            front_tyre=Tyre(lateral=LateralSlip(9000.0, 900.0, relaxation_length=0.1)),
            rider=LeaningRider(...),
        )

    Without parts it is the `WhippleBicycle`, with the same parameters. The parameters of a part are prefixed by its
    name: "rider.stiffness", "front_tyre.lateral.cornering_stiffness".

    **Arguments** in addition to Meijaard's parameters:

    - `rear_tyre`, `front_tyre`: `Tyre`. Default: a knife edge that rolls without slip. A slipping tyre adds the
        velocity of its contact as a speed, "rear_lateral_slip" and "front_longitudinal_slip" [m/s], which is zero in
        ideal rolling. A relaxation length adds states, e.g. "front_lateral_deflection" [m].
    - `head`: `HeadTwist`, a frame with torsional compliance at the steering head.
    - `rider`, `control`, `steering`, `drive`: a `Part` each, or several in a tuple.
    - `extra`: any further parts.
    - `road`: a `Slope`, or a `Road` of given height. Default: level ground. On a `Road`, the position of the front
        contact and the height of the rear one are coordinates too: "front_x", "front_y" and "rear_height" [m]. Yaw,
        roll and pitch are then measured from the tangent plane.

    Methods of parts are called in this order: `rider`, `control`, `steering`, `drive`, `extra`. A subclass may have its
    own fields that contain parts.

    The motion contains the names of the motion of `WhippleBicycle`, and the frame "H" of the fork at zero steer. Inputs
    that parts add to are outputs too, e.g. "applied_steer_torque", the sum including the external input.
    """

    rear_tyre: Tyre = eqx.field(default_factory=Tyre)
    front_tyre: Tyre = eqx.field(default_factory=Tyre)
    head: HeadTwist | None = None
    rider: Part | None = None
    control: Part | tuple[Part, ...] | None = None
    steering: Part | tuple[Part, ...] | None = None
    drive: Part | tuple[Part, ...] | None = None
    extra: tuple[Part, ...] = eqx.field(default=(), converter=_as_tuple)
    road: Ground = eqx.field(default_factory=Ground)

    def __check_init__(self) -> None:
        name = type(self).__name__
        for field, kind in (("rear_tyre", Tyre), ("front_tyre", Tyre), ("head", HeadTwist), ("road", Ground)):
            value = getattr(self, field)
            if not (isinstance(value, kind) or (field == "head" and value is None)):
                or_none = " or None" if field == "head" else ""
                raise TypeError(f"{name}: `{field}` must be a {kind.__name__}{or_none}, got {called(value)}.")
        for field in _ORDER.split(", "):
            for part in _as_tuple(getattr(self, field)):
                if not isinstance(part, Part):
                    raise TypeError(f"{name}: `{field}` must be a Part of jaxkane.bicycles, got {called(part)}.")
        owners: dict[tuple[str, str], str] = {}  # values are read by name
        for _, place, part in self._placed_parts():
            for named in ((kind, each) for kind in NAMES for each in getattr(part, kind)):
                if owners.setdefault(named, place) != place:
                    raise ValueError(
                        f"{name}: the name {named[1]!r} appears twice in `{named[0]}`: in {owners[named]} and in "
                        f"{place}. {_SECOND_OF_A_KIND}"
                    )
        known = (*self.coordinates, *self.speeds, *self.dependent_speeds, *self.states)
        for part in self.parts:
            part.check(self)
            refuse_unknown(part.lateral(), known, f"{_method(part, 'lateral')}: {name} has no")
        for end, tyre, radius in self._tyres():
            crown = tyre.crown
            if crown is None or not is_concrete(crown, radius) or crown.ndim or radius.ndim:
                continue  # members of a batch are not checked
            if float(crown) >= float(radius):  # Python numbers, also while others are traced
                raise ValueError(
                    f"{name}: {end}_tyre.crown = {crown} m is the radius of the tyre's cross section. It must be less "
                    f"than the radius of the wheel, {radius} m."
                )

    def with_parts(self, **parts: Any) -> Self:
        """A copy with other parts or parameters.

        **Arguments:**

        - `parts`: parts by the names of the fields, or parameters by name, also those of parts:
            `with_parts(**{"extra[0].mass": 4.0})`.

        **Raises:** `ValueError` for an unknown name.
        """
        fields = [field.name for field in dataclasses.fields(self)]
        changed = dataclasses.replace(self, **{name: part for name, part in parts.items() if name in fields})
        rest = {name: value for name, value in parts.items() if name not in fields}
        names = [name for name, _, _ in parameters_in(changed)]
        refuse_unknown(rest, [*fields, *names], f"{type(self).__name__} has no field")
        return with_parameters(changed, rest)

    @classmethod
    def from_file(cls, path: str | os.PathLike[str]) -> Self:
        """A bicycle from a file of BicycleParameters: a text file (`NAME = value+/-deviation`), or YAML by its suffix.

        A YAML file may also contain a rider: a rigid one ("Moore2019", "principal"), or a leaning one
        ("MooreRiderLean2012"). The speed `v` is ignored.

        **Raises:** `ValueError` with the lines that are unknown, repeated or malformed, the missing names, and the
        values that do not seem to be in metres or radians.
        """
        if Path(path).suffix.lower() not in (".yml", ".yaml"):
            return super().from_file(path)
        kind, values = read_yaml(path)
        try:
            return cls.from_parameters(as_meijaard(kind, values))
        except ValueError as error:
            raise ValueError(f"{os.fspath(path)}: {error}") from None

    @property
    def parts(self) -> tuple[Part, ...]:
        """All parts, in the order in which their methods are called. Tyres are not included."""
        return tuple(part for _, _, part in self._placed_parts())

    def _placed_parts(self) -> Iterator[tuple[str, str, Part]]:
        """Each part with the name of its field and its place, e.g. "extra[0], a Trailer"."""
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            for i, part in enumerate(_as_tuple(value)):
                if isinstance(part, Part):
                    index = f"[{i}]" if isinstance(value, (tuple, list)) else ""
                    yield field.name, f"{field.name}{index}, {called(part)}", part

    def _tyres(self) -> tuple[tuple[str, Tyre, Component], ...]:
        """Each tyre with the name of its end and the radius of its wheel."""
        return (REAR, self.rear_tyre, self.rR), (FRONT, self.front_tyre, self.rF)

    @property
    def coordinates(self) -> tuple[str, ...]:
        return (*WhippleBicycle.coordinates, *_road_coordinates(self), *_of_parts(self, "coordinates"))

    @property
    def speeds(self) -> tuple[str, ...]:
        dependent = _of_parts(self, "dependent_speeds")  # a part may prescribe a speed of the bicycle
        independent = (*WhippleBicycle.speeds, *_slip_speeds(self), *_of_parts(self, "speeds"))
        return tuple(name for name in independent if name not in dependent)

    @property
    def dependent_speeds(self) -> tuple[str, ...]:
        return (*WhippleBicycle.dependent_speeds, *_front_speeds(self), *_of_parts(self, "dependent_speeds"))

    @property
    def dependent_coordinates(self) -> tuple[str, ...]:
        own = (*WhippleBicycle.dependent_coordinates, *_road_coordinates(self))
        return (*own, *_of_parts(self, "dependent_coordinates"))

    @property
    def inputs(self) -> tuple[str, ...]:
        return (*WhippleBicycle.inputs, *_of_parts(self, "inputs"))

    @property
    def states(self) -> tuple[str, ...]:
        return (*_deflections(self), *_load_transfers(self), *_of_parts(self, "states"))

    @property
    def units(self) -> Mapping[str, str]:
        units = {**WhippleBicycle.units, **dict.fromkeys((*_slip_speeds(self), *_front_speeds(self)), "m/s")}
        units |= dict.fromkeys((*_deflections(self), *_road_coordinates(self)), "m")
        for part in self.parts:
            units |= part.units
        return units | {f"applied_{name}": units[name] for name in self.inputs if name in units}

    @property
    def lateral(self) -> tuple[str, ...]:
        """Names of the states of its linear model about straight riding: coordinates, speeds and states that change to
        first order when it leaves the upright plane."""
        of_tyres = [name for name in (*_slip_speeds(self), *_deflections(self)) if name.endswith(_ASIDE)]
        moving = {*WhippleBicycle.lateral, *of_tyres, *(name for part in self.parts for name in part.lateral())}
        return tuple(name for name in (*self.coordinates, *self.speeds, *self.states) if name in moving)

    @property
    def needs_trim(self) -> bool:
        """Whether riding straight needs a drive torque, or changes coordinates of parts that gravity loads."""
        resists = any(part.resists for part in self.parts) or isinstance(self.road, Slope)
        moves = any(
            name not in (*part.lateral(), *part.dependent_coordinates)
            for part in self.parts
            for name in part.coordinates
        )
        return resists or moves or any(tyre.rolling_resistance is not None for _, tyre, _ in self._tyres())

    @property
    def mode_groups(self) -> dict[str, tuple[str, ...]]:
        """The names of `lateral` that the Whipple bicycle does not have, grouped by the names of their modes.

        The front end is compliant if the tyre has a relaxation length or the frame has torsion. It can then wobble.
        """
        lateral, groups = self.lateral, {}
        for end in (REAR, FRONT):
            names = (f"{end}_lateral_slip", f"{end}_lateral_deflection")
            groups[f"{end} tyre"] = tuple(name for name in names if name in lateral)
        for field, _, part in self._placed_parts():
            groups[field] = (*groups.get(field, ()), *part.lateral())
        elastic = [groups.pop("head", ()), *([groups.pop("front tyre")] if len(groups["front tyre"]) == 2 else [])]
        groups |= dict(zip(("wobble", "front end"), [names for names in elastic if names], strict=False))
        return {name: names for name, names in groups.items() if names}

    def q_dot(self, t: Component, q: NamedVector, u: NamedVector) -> Sequence[Component]:
        turning = [u[f"{name}_rate"] for name in ("roll", "rear_wheel", "steer", "yaw", "pitch", "front_wheel")]
        road: Any = self.road
        rates = road.rates(q["x"], q["y"], q["yaw"], *self._contact_rates(q, u))
        moving = list(rates)
        if road.curved:
            moving += [*(u[name] for name in _front_speeds(self)), road.climbing(q["x"], q["y"], rates)]
        for part in self.parts:
            moving += as_row(part.q_dot(self, t, q, u), part.coordinates, _method(part, "q_dot"))
        return (*turning, *moving)

    @property
    def steer_point(self) -> tuple[Component, Component]:
        """x, z of the point S [m], measured from the rear contact of the upright bicycle. S is the point on the steer
        axis that is nearest to the rear wheel's centre (Example 7)."""
        x, above = self._steer_point()
        return x, -self.rR - above

    def motion(self, t: Component, q: NamedVector, u: NamedVector) -> BicycleMotion:
        motion = self._motion_without_parts(q, u)
        for _, place, part in self._placed_parts():
            try:
                extended = part.motion(self, motion, t, q, u)
            except DuplicateName as error:
                raise ValueError(f"{type(self).__name__}: {place}: {error} {_SECOND_OF_A_KIND}") from None
            if not isinstance(extended, BicycleMotion):
                raise TypeError(
                    f"{_method(part, 'motion')} must return `motion.extended(...)`, got {_returned(extended)}"
                )
            motion = extended
        return motion

    def _motion_without_parts(self, q: NamedVector, u: NamedVector) -> BicycleMotion:
        N, O = inertial()
        forward, contact_aside = self._contact_rates(q, u)
        T = self.road.tangent(
            N, q["x"], q["y"], lambda: self.road.rates(q["x"], q["y"], q["yaw"], forward, contact_aside)
        )
        Y = T.rotate(3, q["yaw"], u["yaw_rate"], "Y")
        R = Y.rotate(1, q["roll"], u["roll_rate"], "R")
        along, across = self._slip(REAR, u)
        place = q["x"] * N.x + q["y"] * N.y
        if self.road.curved:
            place = place - q["rear_height"] * N.z
        P = Point(Y.vector(along, across, 0.0), O, place)  # point of the tyre
        r_P_A, head = -self.rear_tyre.reach(R.z, T.z, self.rR), self.head
        twisted = None if head is None else lambda tilted, S: head.turned(tilted, S, q, u)
        bodies, S, B, C, H = self._linkage(R, P, r_P_A, q, u, twisted)
        front = bodies[-1]
        normal = self.road.normal(N, *self._front_place(q))
        n1, _, n3 = normal.components_in(C)
        down = C.vector(n1, 0.0, n3).normalize()  # in the plane of the front wheel
        r_D_Q = self.front_tyre.reach(down, normal, self.rF)
        Q = Point(front.center.velocity + front.angular_velocity.cross(r_D_Q), front.center, r_D_Q)
        frames = {"Y": Y, "B": B, "C": C, "H": H}
        motion = BicycleMotion(bodies, points={"P": P, "Q": Q, "S": S}, frames=frames)
        motion.rear = Contact(P, Y.x, Y.y, T.z, R.z, q["roll"], forward, (along, across))
        motion.front, residuals = self._front_contact(Q, C, down, normal, q, u)
        return motion.extended((), residuals)

    def _front_place(self, q: NamedVector) -> tuple[Component, Component]:
        return (q["front_x"], q["front_y"]) if self.road.curved else (0.0, 0.0)

    def _slip(self, end: str, u: NamedVector) -> tuple[Component, Component]:
        """Velocities of a tyre's contact, along the heading and across it [m/s]; exactly zero in rolling."""
        tyre = self.rear_tyre if end == REAR else self.front_tyre
        along = 0.0 if tyre.longitudinal is None else u[f"{end}_longitudinal_slip"]
        return along, 0.0 if tyre.lateral is None else u[f"{end}_lateral_slip"]

    def _contact_rates(self, q: NamedVector, u: NamedVector) -> tuple[Component, Component]:
        """Velocities of the position of the rear contact on the ground, forward and to the right [m/s].

        For a torus with the crown radius c that rolls without slip: -(spin) (r - c + c cos(roll)) and c * roll_rate.
        """
        tyre, (along, across) = self.rear_tyre, self._slip(REAR, u)
        spin = u["rear_wheel_rate"] + u["pitch_rate"]
        forward = tyre.rolling_speed(spin, jnp.cos(q["roll"]), self.rR, along)
        return forward, across if tyre.crown is None else add(across, tyre.crown * u["roll_rate"])

    def _front_contact(
        self, Q: Point, C: Frame, down: Vector, normal: Vector, q: NamedVector, u: NamedVector
    ) -> tuple[Contact, list[Any]]:
        """The front contact and its velocity residuals [m/s].

        The heading is the intersection of the wheel's plane and the ground. The normal n changes, and the fork has the
        angular velocity omega. The wheel's spin relative to its contact is then front_wheel_rate + (omega . across -
        heading . n_dot) / cos(camber). The rate of the camber is omega . heading + (axle . n_dot) / cos(camber).
        """
        tyre, slip = self.front_tyre, self._slip(FRONT, u)
        road: Any = self.road
        heading = C.y.cross(normal).normalize()
        across = normal.cross(heading)
        sin_camber, cos_camber = C.y.dot(normal), down.dot(normal)
        spin = u["front_wheel_rate"] + C.angular_velocity.dot(across) / cos_camber
        if road.curved:
            at = (q["front_x"], q["front_y"]), (u["front_x_rate"], u["front_y_rate"])
            turning = road.normal_rate(C.root, *at[0], at[1])
            spin = spin - turning.dot(heading) / cos_camber
        speed = tyre.rolling_speed(spin, cos_camber, self.rF, slip[0])
        contact = Contact(Q, heading, across, normal, down, jnp.arctan2(sin_camber, cos_camber), speed, slip)
        residuals = tyre.residuals(contact)
        if road.curved:
            aside, moved = slip[1], road.velocity(C.root, *at[0], at[1])
            if tyre.crown is not None:
                aside = aside + tyre.crown * (C.angular_velocity.dot(heading) + turning.dot(C.y) / cos_camber)
            residuals += [moved.dot(heading) - speed, moved.dot(across) - aside]
        return contact, residuals

    def _wheels(self, motion: BicycleMotion) -> Iterator[tuple[str, Tyre, Contact, Body, Component]]:
        for (end, tyre, radius), contact in zip(self._tyres(), (motion.rear, motion.front), strict=True):
            yield end, tyre, contact, motion[f"{end} wheel"], radius

    def _off_road(self, motion: BicycleMotion, q: NamedVector) -> list[Component]:
        """The distances of the contacts from the ground [m]."""
        Q, N = motion["Q"].position, motion.N
        road: Any = self.road
        if not road.curved:
            return [Q.dot(N.z)]
        front = Q - road.place(N, *self._front_place(q))
        return [*(front.dot(axis) for axis in (N.x, N.y, N.z)), q["rear_height"] - road.at(q["x"], q["y"])]

    def _clearance(self, motion: BicycleMotion) -> Component:
        """The smaller clearance of both wheels, see `Road.clearance`."""
        road: Any = self.road
        wheels = self._wheels(motion)
        return jnp.minimum(
            *(road.clearance(motion.N, at, wheel.center, r, tyre.crown) for _, tyre, at, wheel, r in wheels)
        )

    def on_frame(self, motion: BicycleMotion, x: Component, y: Component, z: Component) -> Point:
        """A point that is fixed in the frame B.

        **Arguments:**

        - `motion`: the motion of the bicycle.
        - `x`, `y`, `z` [m]: forward, to the right and down, from the rear contact of the upright bicycle (Meijaard's
            convention).
        """
        return motion["rear wheel"].center.fixed(motion["B"].vector(x, y, add(z, self.rR)))

    def on_fork(self, motion: BicycleMotion, x: Component, y: Component, z: Component) -> Point:
        """A point that is fixed in the fork; x, y, z [m] as in `on_frame`, at zero steer."""
        return motion["fork"].center.fixed(motion["H"].vector(x - self.xH, y, z - self.zH))

    def gravity(self, N: Frame) -> Vector:
        return self.road.gravity(self.g, N)

    def tyre_loads(self, motion: BicycleMotion) -> dict[str, Component]:
        """Static loads under the wheels [N], "rear" and "front": the moments of all weights about the contacts, without
        accelerations."""
        gravity, Y, P = self.gravity(motion.N), motion["Y"], motion["P"]
        moments = [body.center.position_from(P).cross(body.mass * gravity).dot(Y.y) for body in motion.bodies]
        front = sum(moments[1:], moments[0]) / motion["Q"].position_from(P).cross(motion.front.normal).dot(Y.y)
        pressing = _mass(motion) * gravity.dot(motion.rear.normal)
        return {REAR: pressing - front * motion.front.normal.dot(motion.rear.normal), FRONT: front}

    def tyre_forces(self, motion: BicycleMotion, values: Values) -> dict[str, Component]:
        """Forces of the ground on the slipping tyres [N], e.g. "front_lateral_force". `values` as in `loads`."""
        carried, forces = _loads_with_transfer(self, motion, values), {}
        for end, tyre, contact, _, _ in self._wheels(motion):
            of_tyre = tyre.forces(contact, carried[end], _deflections_of(end, tyre, values))
            forces |= {f"{end}_{name}_force": force for name, force in of_tyre.items()}
        return forces

    def why_not_finite(self, motion: BicycleMotion, inputs: Values) -> str:
        carried = _loads_with_transfer(self, motion, inputs)
        return " and ".join(
            f"the {end} tyre carries {float(carried[end]):.4g} N, more than the largest_load of its "
            f"{type(law).__name__}, {law.largest_load:g} N,"
            for end, tyre, _ in self._tyres()
            for _, law in tyre.laws
            if float(carried[end]) > law.largest_load
        )

    def loads(self, t: Component, q: NamedVector, u: NamedVector, motion: BicycleMotion, inputs: Values) -> Loads:
        values = _commanded(self, t, q, u, motion, inputs)
        loads: list[Any] = [super().loads(t, q, u, motion, values)]
        slipping = [each for each in self._wheels(motion) if each[1].laws or each[1].rolling_resistance is not None]
        carried = _loads_with_transfer(self, motion, values) if slipping else {}
        for end, tyre, contact, wheel, radius in slipping:
            deflections = _deflections_of(end, tyre, values)
            loads.append(tuple(tyre.loads(contact, wheel, radius, carried[end], deflections)))
        loads += [part.loads(self, t, q, u, motion, values) for part in self.parts]
        return loads

    def state_rates(
        self,
        t: Component,
        q: NamedVector,
        u: NamedVector,
        x: NamedVector,
        motion: BicycleMotion,
        now: MeasurementContext,
    ) -> Sequence[Component]:
        now = now.with_values(_commanded(self, t, q, u, motion, now))
        rates = []
        for end, tyre, contact, _, _ in self._wheels(motion):
            rates += tyre.deflection_rates(contact, _deflections_of(end, tyre, x))
        carried = _loads_with_transfer(self, motion, now) if _load_transfers(self) else {}
        for (end, tyre, contact, _, _), point in zip(self._wheels(motion), "PQ", strict=True):
            if tyre.load_lag is not None:
                load = -now.force(point).dot(contact.normal)
                rates.append((load - carried[end]) / (_mass(motion) * self.g * tyre.load_lag))
        for part in self.parts:
            of_part = part.state_rates(self, t, q, u, x, motion, now)
            rates += named_row(of_part, part.states, _method(part, "state_rates"))
        return rates

    def outputs(
        self, t: Component, q: NamedVector, u: NamedVector, motion: BicycleMotion, now: MeasurementContext
    ) -> Values:
        values = _commanded(self, t, q, u, motion, now)
        now = now.with_values(values)
        outputs: dict[str, Any] = dict(self.tyre_forces(motion, now))
        outputs |= {f"applied_{name}": now[name] for name in values.commanded}
        for part in self.parts:
            label = _method(part, "outputs")
            of_part = _checked_dict(part.outputs(self, t, q, u, motion, now), label)
            twice = [name for name in of_part if name in outputs]
            if twice:
                raise ValueError(f"{label}: the output {twice[0]!r} exists already. Rename it.")
            outputs |= of_part
        return outputs

    def configuration_constraints(self, t: Component, q: NamedVector) -> Sequence[Component]:
        motion = self._motion_at_rest(t, q)
        residuals = self._off_road(motion, q)
        if self.road.curved:
            # only near a solution: intermediate iterates of a solver must stay finite
            on_road = sum(x * x for x in residuals) < (1e-3 * OFF_ROAD) ** 2
            refused = on_road & (self._clearance(motion) <= 0.0)
            residuals = [jnp.where(refused, jnp.nan, x) for x in residuals]
        return [*residuals, *(x for part in self.parts for x in part.configuration_constraints(self, t, q, motion))]

    def events(self, t: Component, q: NamedVector, u: NamedVector) -> Mapping[str, Quantity]:
        events = super().events(t, q, u)
        if not self.road.curved:
            return events
        motion = self._motion_at_rest(t, q)
        # If an edge is narrower than a step of the solver, it is detected by the distance from the road after the step.
        on_road = 1.0 - sum(x * x for x in self._off_road(motion, q)) / OFF_ROAD**2
        return {**events, "wheel_touches_twice": self._clearance(motion), "wheel_off_the_road": on_road}


def _of_parts(bicycle: Bicycle, kind: str) -> tuple[str, ...]:
    return tuple(name for part in bicycle.parts for name in getattr(part, kind))


def _slip_speeds(bicycle: Bicycle) -> tuple[str, ...]:
    return tuple(f"{end}_{name}_slip" for end, tyre, _ in bicycle._tyres() for name, _ in tyre.laws)


def _deflections(bicycle: Bicycle) -> tuple[str, ...]:
    return tuple(f"{end}_{name}_deflection" for end, tyre, _ in bicycle._tyres() for name in tyre.deflects)


def _load_transfers(bicycle: Bicycle) -> tuple[str, ...]:
    """States by which the tyres' loads follow the ground's normal forces."""
    return tuple(f"{end}_load_transfer" for end, tyre, _ in bicycle._tyres() if tyre.load_lag is not None)


def _road_coordinates(bicycle: Bicycle) -> tuple[str, ...]:
    return ("front_x", "front_y", "rear_height") if bicycle.road.curved else ()


def _front_speeds(bicycle: Bicycle) -> tuple[str, ...]:
    return ("front_x_rate", "front_y_rate") if bicycle.road.curved else ()


def _loads_with_transfer(bicycle: Bicycle, motion: BicycleMotion, values: Values) -> dict[str, Component]:
    """Loads that the tyre laws use [N]."""
    loads = bicycle.tyre_loads(motion)
    for name in _load_transfers(bicycle):
        end = name.partition("_")[0]
        loads[end] = loads[end] + _mass(motion) * bicycle.g * values[name]
    return loads


def _commanded(
    bicycle: Bicycle, t: Component, q: NamedVector, u: NamedVector, motion: BicycleMotion, values: Values
) -> _Commanded:
    """Inputs and states by name, including what the parts add to the inputs.

    **Raises:** `KeyError` for an input that no part has; `ValueError` if a part adds to an input after it was read.
    """
    name = type(bicycle).__name__
    commanded = _Commanded(values)
    late: set[str] = set()
    for part in bicycle.parts:
        commanded.read.clear()
        kind = type(part).__name__
        commands = _checked_dict(part.commands(bicycle, t, q, u, motion, commanded), _method(part, "commands"))
        for to, command in commands.items():
            if to not in bicycle.inputs:
                raise not_there(to, bicycle.inputs, f"the inputs of {name}, of which {kind} adds to this one")
            if to in late:
                raise ValueError(
                    f"{name}: {kind} adds to {to!r} after the part that reads it, so it would have no effect. Put it "
                    f"before that part; parts are called in the order {_ORDER}."
                )
            commanded[to] = add(commanded.get(to), component(command))
            commanded.commanded[to] = None
        late |= commanded.read.intersection(part.inputs)
    return commanded


class _Commanded(dict[str, Any]):
    """Inputs and states by name, as parts receive them.

    - `commanded`: names of the inputs that parts add to.
    - `read`: names that were looked up.
    """

    def __init__(self, values: Values):
        super().__init__(values)
        self.commanded: dict[str, None] = {}
        self.read: set[str] = set()

    def __getitem__(self, name: str) -> Component:
        self.read.add(name)
        return super().__getitem__(name)

    def __missing__(self, name: str) -> Component:
        raise not_there(name, self, "the inputs and states of this bicycle")


def _method(part: Part, method: str) -> str:
    return f"{type(part).__name__}.{method}"


def _checked_dict(returned: object, label: str) -> Mapping[str, Any]:
    if not isinstance(returned, Mapping):
        raise TypeError(f"{label} must return a dict of numbers by name, got {_returned(returned)}")
    return returned


def _returned(value: object) -> str:
    return f"{value!r}." + " Does it end without a `return`?" * (value is None)


def _deflections_of(end: str, tyre: Tyre, values: Values | NamedVector) -> dict[str, Component]:
    return {name: values[f"{end}_{name}_deflection"] for name in tyre.deflects}


def _mass(motion: BicycleMotion) -> Component:
    return total(component(body.mass) for body in motion.bodies)
