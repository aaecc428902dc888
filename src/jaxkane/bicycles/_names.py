"""Names that tyres, parts and the road bring to a bicycle, and which of them move sideways. Knows no motion."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import TYPE_CHECKING

from ..catalog.bicycle import WhippleBicycle
from ._ground import Slope
from ._part import Part
from ._part_methods import as_tuple
from ._tyre import Tyre

if TYPE_CHECKING:
    from ._bicycle import Bicycle

REAR, FRONT = "rear", "front"
_ASIDE = ("_lateral_slip", "_lateral_deflection")


def road_coordinates(bicycle: Bicycle) -> tuple[str, ...]:
    """Names of the coordinates that a road of given height brings."""
    return ("front_x", "front_y", "rear_height") if bicycle.road.curved else ()


def front_speeds(bicycle: Bicycle) -> tuple[str, ...]:
    """Names of the speeds of the front contact's place."""
    return ("front_x_rate", "front_y_rate") if bicycle.road.curved else ()


def of_parts(bicycle: Bicycle, kind: str) -> tuple[str, ...]:
    return tuple(name for part in bicycle.parts for name in getattr(part, kind))


def tyres_of(bicycle: Bicycle) -> Iterator[tuple[str, Tyre]]:
    yield from ((REAR, bicycle.rear_tyre), (FRONT, bicycle.front_tyre))


def slip_speeds(bicycle: Bicycle) -> tuple[str, ...]:
    return tuple(f"{end}_{name}_slip" for end, tyre in tyres_of(bicycle) for name, _ in tyre.laws)


def deflections_of_tyres(bicycle: Bicycle) -> tuple[str, ...]:
    return tuple(f"{end}_{name}_deflection" for end, tyre in tyres_of(bicycle) for name in tyre.deflects)


def load_transfers(bicycle: Bicycle) -> tuple[str, ...]:
    """Names of the states by which tyres' loads follow what the ground carries."""
    return tuple(f"{end}_load_transfer" for end, tyre in tyres_of(bicycle) if tyre.load_lag is not None)


def lateral_names(bicycle: Bicycle) -> tuple[str, ...]:
    """Names of what its linear model about straight riding holds: the coordinates, speeds and states that move to
    first order when it leaves the upright plane."""
    of_tyres = [name for name in (*slip_speeds(bicycle), *deflections_of_tyres(bicycle)) if name.endswith(_ASIDE)]
    moving = {*WhippleBicycle.lateral, *of_tyres, *(name for part in bicycle.parts for name in part.lateral())}
    return tuple(name for name in (*bicycle.coordinates, *bicycle.speeds, *bicycle.states) if name in moving)


def needs_trim(bicycle: Bicycle) -> bool:
    """Whether riding straight on takes a torque of the drive, or moves coordinates of parts that gravity loads."""
    resists = any(part.resists for part in bicycle.parts) or isinstance(bicycle.road, Slope)
    moves = any(
        name not in (*part.lateral(), *part.dependent_coordinates)
        for part in bicycle.parts
        for name in part.coordinates
    )
    return resists or moves or any(tyre.rolling_resistance is not None for _, tyre in tyres_of(bicycle))


def mode_groups(bicycle: Bicycle) -> dict[str, tuple[str, ...]]:
    """Those of `lateral` that it has beside the Whipple bicycle's, by the name of the modes that they bring.

    The front end gives way in the tyre's relaxation or the frame's torsion: then it can wobble.
    """
    tyres = {end: [f"{end}_lateral_{what}" for what in ("slip", "deflection")] for end in (REAR, FRONT)}
    found = {f"{end} tyre": tuple(name for name in names if name in bicycle.lateral) for end, names in tyres.items()}
    for field in dataclasses.fields(bicycle):
        held = [part for part in as_tuple(getattr(bicycle, field.name)) if isinstance(part, Part)]
        found[field.name] = tuple(name for part in held for name in part.lateral())
    elastic = [found.pop("head"), *([found.pop("front tyre")] if len(found["front tyre"]) == 2 else [])]
    found |= dict(zip(("wobble", "front end"), [names for names in elastic if names], strict=False))
    return {name: names for name, names in found.items() if names}
