"""What the ground carries, and forces of the tyres of a bicycle. Knows contacts; knows no kinematics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from .._scalarjit.components import Component, component, total
from .._system.motion import Motion
from ._kinematics import wheels
from ._part_methods import FRONT, REAR, load_transfers, tyres_of
from ._tyre import Tyre

if TYPE_CHECKING:
    from ._bicycle import Bicycle


def loads_of_tyres(bicycle: Bicycle, motion: Any, values: Mapping[str, Component]) -> list[Any]:
    """Forces and torques of the ground on tyres that slip or resist."""
    ground = [each for each in wheels(bicycle, motion) if each[1].laws or each[1].rolling_resistance is not None]
    carried = carried_loads(bicycle, motion, values) if ground else {}
    return [
        tuple(tyre.loads(contact, wheel, radius, carried[end], deflections_in(end, tyre, values)))
        for end, tyre, contact, wheel, radius in ground
    ]


def deflection_rates(bicycle: Bicycle, motion: Any, x: Any) -> list[Component]:
    """Of what gives way in the tyres [m/s]."""
    return [
        rate
        for end, tyre, contact, _, _ in wheels(bicycle, motion)
        for rate in tyre.deflection_rates(contact, deflections_in(end, tyre, x))
    ]


def carried_loads(bicycle: Bicycle, motion: Any, values: Mapping[str, Component]) -> dict[str, Component]:
    """Loads that the tyres feel [N]."""
    found = bicycle.tyre_loads(motion)
    for name in load_transfers(bicycle):
        end = name.partition("_")[0]
        found[end] = found[end] + mass_of(motion) * bicycle.g * values[name]
    return found


def overloaded(bicycle: Bicycle, motion: Any, values: Mapping[str, Component]) -> str:
    """Which tyre carries more than its law holds for, in words."""
    carried = carried_loads(bicycle, motion, values)
    return " and ".join(
        f"the {end} tyre carries {float(carried[end]):.4g} N, more than the largest_load of its {type(law).__name__}, "
        f"{law.largest_load:g} N,"
        for end, tyre in tyres_of(bicycle)
        for _, law in tyre.laws
        if float(carried[end]) > law.largest_load
    )


def transfer_rates(bicycle: Bicycle, motion: Any, now: Any) -> Iterator[Component]:
    """Of the loads that follow what the ground carries, over the weight [1/s]."""
    felt = carried_loads(bicycle, motion, now) if load_transfers(bicycle) else {}
    for (end, tyre), point, contact in zip(tyres_of(bicycle), ("P", "Q"), (motion.rear, motion.front), strict=True):
        if tyre.load_lag is not None:
            carried = -now.force(point).dot(contact.normal)
            yield (carried - felt[end]) / (mass_of(motion) * bicycle.g * tyre.load_lag)


def deflections_in(end: str, tyre: Tyre, values: Any) -> dict[str, Component]:
    return {name: values[f"{end}_{name}_deflection"] for name in tyre.deflects}


def tyre_loads(bicycle: Bicycle, motion: Any) -> dict[str, Component]:
    """What the ground carries under each wheel [N], "rear" and "front", if nothing accelerated: from the moments of
    all weights about the contacts."""
    gravity, Y, P = bicycle.gravity(motion.N), motion["Y"], motion["P"]
    moments = [body.center.position_from(P).cross(body.mass * gravity).dot(Y.y) for body in motion.bodies]
    front = sum(moments[1:], moments[0]) / motion["Q"].position_from(P).cross(motion.front.normal).dot(Y.y)
    pressing = mass_of(motion) * gravity.dot(motion.rear.normal)
    return {REAR: pressing - front * motion.front.normal.dot(motion.rear.normal), FRONT: front}


def tyre_forces(bicycle: Bicycle, motion: Any, values: Mapping[str, Component]) -> dict[str, Component]:
    """Forces of the ground on the tyres that slip [N], as "front_lateral_force"; `values` as of `loads`."""
    carried = carried_loads(bicycle, motion, values)
    found = {}
    for end, tyre, contact, _, _ in wheels(bicycle, motion):
        forces = tyre.forces(contact, carried[end], deflections_in(end, tyre, values))
        found |= {f"{end}_{name}_force": force for name, force in forces.items()}
    return found


def mass_of(motion: Motion) -> Component:
    return total(component(body.mass) for body in motion.bodies)
