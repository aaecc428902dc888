"""A bicycle put together from parts, on the parameters of the Whipple bicycle. Knows kinematics and its parts' methods.

Its motion follows Example 7 and Meijaard et al. (2007). Where a tyre slips, velocities of its contact that ideal
rolling makes zero are speeds, and forces of the tyre stand in the place of those of the constraint.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import equinox as eqx
import jax.numpy as jnp

from .._common.lookup import refuse_unknown
from .._kane.arguments import as_row
from .._kane.rhs import named_row
from .._scalarjit.components import Component, add
from .._system.kinematics import Frame, Point, Vector
from .._system.motion import Motion
from .._system.parameters import parameters_in, with_parameters
from ..catalog.bicycle import WhippleBicycle
from ._files import as_meijaard, read_yaml
from ._ground import Ground
from ._kinematics import clearance, motion_of, off_road, place_rates
from ._part_methods import (
    as_tuple,
    by_name,
    commanded,
    deflections_of_tyres,
    front_speeds,
    label_of,
    lateral_names,
    load_transfers,
    mode_groups,
    needs_trim,
    of_parts,
    refuse_misfits,
    road_coordinates,
    slip_speeds,
)
from ._parts import Part
from ._rider import rider_of
from ._steering import HeadTwist
from ._tyre import Tyre
from ._tyre_forces import deflection_rates, loads_of_tyres, overloaded, transfer_rates, tyre_forces, tyre_loads

OFF_ROAD = 1e-3
"""[m]: a motion over a `Road` ends where a contact is further from it than that."""


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

    Methods of parts are called in this order: `rider`, `control`, `steering`, `drive`, `extra`. A class that inherits
    from this one may have fields of its own that hold parts.

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
        """A copy with other parts by the names of the fields, or with other parameters by their names, those of a part
        too: `with_parts(**{"extra[0].mass": 4.0})`."""
        fields = [field.name for field in dataclasses.fields(self)]
        made = dataclasses.replace(self, **{name: part for name, part in parts.items() if name in fields})
        rest = {name: value for name, value in parts.items() if name not in fields}
        names = [name for name, _, _ in parameters_in(made)]
        refuse_unknown(rest, [*fields, *names], f"{type(self).__name__} has no field")
        return with_parameters(made, rest)

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
            return cls.from_parameters(found | ({} if rider is None else {"rider": rider_of(rider)}))
        except ValueError as error:
            raise ValueError(f"{os.fspath(path)}: {error}") from None

    @property
    def parts(self) -> tuple[Part, ...]:
        """All parts, in the order in which their methods are called; tyres are not among them."""
        held = (getattr(self, field.name) for field in dataclasses.fields(self))
        return tuple(part for each in held for part in as_tuple(each) if isinstance(part, Part))

    @property
    def coordinates(self) -> tuple[str, ...]:
        return (*WhippleBicycle.coordinates, *road_coordinates(self), *of_parts(self, "coordinates"))

    @property
    def speeds(self) -> tuple[str, ...]:
        held = of_parts(self, "dependent_speeds")  # a part may hold a speed of the bicycle
        independent = (*WhippleBicycle.speeds, *slip_speeds(self), *of_parts(self, "speeds"))
        return tuple(name for name in independent if name not in held)

    @property
    def dependent_speeds(self) -> tuple[str, ...]:
        return (*WhippleBicycle.dependent_speeds, *front_speeds(self), *of_parts(self, "dependent_speeds"))

    @property
    def dependent_coordinates(self) -> tuple[str, ...]:
        return (
            *WhippleBicycle.dependent_coordinates,
            *road_coordinates(self),
            *of_parts(self, "dependent_coordinates"),
        )

    @property
    def inputs(self) -> tuple[str, ...]:
        return (*WhippleBicycle.inputs, *of_parts(self, "inputs"))

    @property
    def states(self) -> tuple[str, ...]:
        return (*deflections_of_tyres(self), *load_transfers(self), *of_parts(self, "states"))

    @property
    def units(self) -> Mapping[str, str]:
        found = {**WhippleBicycle.units, **dict.fromkeys(slip_speeds(self), "m/s")}
        found |= dict.fromkeys((*deflections_of_tyres(self), *road_coordinates(self)), "m") | dict.fromkeys(
            front_speeds(self), "m/s"
        )
        for part in self.parts:
            found |= part.units
        return found | {f"applied_{name}": found[name] for name in self.inputs if name in found}

    @property
    def lateral(self) -> tuple[str, ...]:
        """Names of what its linear model about straight riding holds: the coordinates, speeds and states that move to
        first order when it leaves the upright plane."""
        return lateral_names(self)

    @property
    def needs_trim(self) -> bool:
        """Whether riding straight on takes a torque of the drive, or moves coordinates of parts that gravity loads."""
        return needs_trim(self)

    @property
    def mode_groups(self) -> dict[str, tuple[str, ...]]:
        """Those of `lateral` that it has beside the Whipple bicycle's, by the name of the modes that they bring.

        The front end gives way in the tyre's relaxation or the frame's torsion: then it can wobble.
        """
        return mode_groups(self)

    def q_dot(self, t, q, u):
        turning = [u[f"{part}_rate"] for part in ("roll", "rear_wheel", "steer", "yaw", "pitch", "front_wheel")]
        moving = list(place_rates(self, q, u))
        if self.road.curved:
            climbing = self.road.climbing(q["x"], q["y"], place_rates(self, q, u))
            moving += [*(u[name] for name in front_speeds(self)), climbing]
        for part in self.parts:
            moving += as_row(part.q_dot(self, t, q, u), part.coordinates, label_of(part, "q_dot"))
        return (*turning, *moving)

    @property
    def steer_point(self) -> tuple[Component, Component]:
        """x, z of the point S [m], of the upright bicycle and from the rear contact: on the steer axis, nearest to the
        rear wheel's centre (Example 7)."""
        cos, sin = jnp.cos(self.lam), jnp.sin(self.lam)
        x = (self.w + self.c) * cos * cos - self.rR * sin * cos
        return x, -self.rR - x * sin / cos

    def motion(self, t, q, u):
        return motion_of(self, t, q, u)

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
        return tyre_loads(self, motion)

    def tyre_forces(self, motion: Any, values: Mapping[str, Component]) -> dict[str, Component]:
        """Forces of the ground on the tyres that slip [N], as "front_lateral_force"; `values` as of `loads`."""
        return tyre_forces(self, motion, values)

    def loads(self, t, q, u, motion, inputs):
        values = commanded(self, t, q, u, motion, inputs)
        found: list[Any] = [super().loads(t, q, u, motion, values)]
        found += loads_of_tyres(self, motion, values)
        found += [part.loads(self, t, q, u, motion, values) for part in self.parts]
        return found

    def why_not_finite(self, motion, inputs):
        return overloaded(self, motion, inputs)

    def state_rates(self, t, q, u, x, motion: Any, now):
        now = now.with_values(commanded(self, t, q, u, motion, now))
        rates = [*deflection_rates(self, motion, x), *transfer_rates(self, motion, now)]
        for part in self.parts:
            rates += named_row(
                part.state_rates(self, t, q, u, x, motion, now), part.states, label_of(part, "state_rates")
            )
        return rates

    def outputs(self, t, q, u, motion: Any, now):
        given = commanded(self, t, q, u, motion, now)
        now = now.with_values(given)
        found: dict[str, Any] = dict(self.tyre_forces(motion, now))
        found |= {f"applied_{name}": now[name] for name in given.commanded}
        for part in self.parts:
            more = by_name(part.outputs(self, t, q, u, motion, now), label_of(part, "outputs"))
            twice = [name for name in more if name in found]
            if twice:
                raise ValueError(f"{label_of(part, 'outputs')}: there is an output {twice[0]!r} already.")
            found |= more
        return found

    def configuration_constraints(self, t, q):
        motion = self.motion(t, q, (0.0,) * (len(self.speeds) + len(self.dependent_speeds)))
        held = off_road(self, motion, q)
        if self.road.curved:
            there = sum(x * x for x in held) < (1e-3 * OFF_ROAD) ** 2  # not on the way of a solver
            refused = there & (clearance(self, motion) <= 0.0)
            held = [jnp.where(refused, jnp.nan, x) for x in held]
        return [*held, *(x for part in self.parts for x in part.configuration_constraints(self, t, q, motion))]

    def events(self, t, q, u):
        found = super().events(t, q, u)
        if not self.road.curved:
            return found
        at_rest = self.motion(t, q, (0.0,) * (len(self.speeds) + len(self.dependent_speeds)))
        # An edge that is narrower than a step of the solver shows by what is off the road after it.
        on_road = 1.0 - sum(x * x for x in off_road(self, at_rest, q)) / OFF_ROAD**2
        return {**found, "wheel_touches_twice": clearance(self, at_rest), "wheel_off_the_road": on_road}
