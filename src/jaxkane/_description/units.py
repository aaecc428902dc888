"""Units of coordinates, speeds and inputs, for pictures: as declared, or as a usual name tells. Converts no number."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

from .._common.lookup import refuse_unknown
from .system import System

# The unit that a name tells: of the coordinate, before "_rate" or "_dot".
_USUAL = {
    r"roll|pitch|yaw|steer|lean|heading|spin|.*angle\d*|theta\d*|phi\d*|psi\d*|alpha\d*|beta\d*": "rad",
    r"[xyz]\d*|.*(position|distance|displacement|height)\d*": "m",
    r"omega\d*": "rad/s",
    r"v\d*|.*_speed": "m/s",
    r".*_?torque\d*": "N m",
    r".*_?force\d*": "N",
    r"e\d": "",
}


def unit_of(name: str, declared: Mapping[str, str] | None = None) -> str:
    """The unit of a name: the declared one, or what a usual name tells; "" where neither is known.

    "roll" rad, "yaw_rate" rad/s, "x" m, "steer_torque" N m; "q0_dot" rad/s where "q0" is declared in rad.
    """
    declared = declared or {}
    if name in declared:
        return declared[name]
    base, rate = re.fullmatch(r"(.*?)((?:_rate|_dot)?)", name).groups()  # type: ignore[union-attr]
    unit = declared.get(base) or next((unit for pattern, unit in _USUAL.items() if re.fullmatch(pattern, base)), "")
    if base.endswith("wheel") and rate:
        unit = "rad"
    return _rate_of(unit) if rate else unit


def units_of(system: System) -> dict[str, str]:
    """Units by name that a system declares; and of speeds that are the rates of such coordinates.

    **Raises:** `ValueError` for a unit of what is no coordinate, speed or input.
    """
    speeds = (*system.speeds, *system.dependent_speeds)
    names = (*system.coordinates, *speeds, *system.auxiliary_speeds, *system.inputs)
    refuse_unknown(system.units, names, f"{type(system).__name__}.units names what is no coordinate, speed or input:")
    units = dict(system.units)
    if type(system).q_dot is System.q_dot:
        for coordinate, speed in zip(system.coordinates, speeds, strict=False):
            if coordinate in units:
                units.setdefault(speed, _rate_of(units[coordinate]))
    return units


def in_degrees(unit: str) -> bool:
    """Whether a unit can be told in degrees."""
    return unit in ("rad", "rad/s", "rad/s^2")


def refuse_no_angle(names: Iterable[str], units: Iterable[str]) -> None:
    """`ValueError` where degrees are asked for and nothing that is drawn is known to be an angle."""
    names = tuple(names)
    if not any(in_degrees(unit) for unit in units):
        raise ValueError(
            f"degrees=True: none of {', '.join(names)} is known to be an angle. Say so where they are named, in the "
            f'system: `units = {{{names[0]!r}: "rad"}}`; or here, by `units={{{names[0]!r}: "rad"}}`.'
        )


def _rate_of(unit: str) -> str:
    return f"{unit}/s" if unit else ""
