"""Units of coordinates, speeds and inputs, as a system declares them, for tables and pictures. Converts no number."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from .system import System


def unit_of(name: str, declared: Mapping[str, str]) -> str:
    """The declared unit of a name, or "".

    A name with `_rate` or `_dot` behind one that was declared has its unit by the second: "q0_dot" rad/s where "q0" is
    declared in rad.
    """
    base = name.removesuffix("_rate").removesuffix("_dot")
    return declared.get(name) or (_rate_of(declared.get(base, "")) if base != name else "")


def units_of(system: System) -> dict[str, str]:
    """Units by name that a system declares; and of speeds that are the rates of such coordinates."""
    speeds = (*system.speeds, *system.dependent_speeds)
    has_outputs = type(system).outputs is not System.outputs  # whose names are known when they are read
    names = (*system.coordinates, *speeds, *system.auxiliary_speeds, *system.inputs, *system.states)
    units = {name: unit for name, unit in system.units.items() if name in names or has_outputs}
    if type(system).q_dot is System.q_dot:
        for coordinate, speed in zip(system.coordinates, speeds, strict=False):
            if coordinate in units:
                units.setdefault(speed, _rate_of(units[coordinate]))
    return units


def in_degrees(unit: str) -> bool:
    """Whether a unit can be shown in degrees."""
    return unit in ("rad", "rad/s", "rad/s^2")


def refuse_no_angle(names: Iterable[str], units: Iterable[str]) -> None:
    """`ValueError` where degrees are asked for and nothing that is drawn is known to be an angle."""
    names = tuple(names)
    if not any(in_degrees(unit) for unit in units):
        raise ValueError(
            f"degrees=True: none of {', '.join(names)} is declared to be an angle. Say so where they are named, in the "
            f'system: `units = {{{names[0]!r}: "rad"}}`; or here, by `units={{{names[0]!r}: "rad"}}`.'
        )


def _rate_of(unit: str) -> str:
    return f"{unit}/s" if unit else ""
