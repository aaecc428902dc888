"""The methods of a bicycle's parts, called and checked, and the names that parts and tyres bring."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from .._common.lookup import not_there, refuse_unknown
from .._kane.checks import is_concrete
from .._scalarjit.components import Component, add, component
from .._system.motion import NameTaken
from ..catalog.bicycle import WhippleBicycle
from ._ground import Ground, Slope
from ._parts import NAMES, Part, called
from ._steering import HeadTwist
from ._tyre import Tyre

if TYPE_CHECKING:
    from ._bicycle import Bicycle
    from ._kinematics import BicycleMotion


_ORDER = "rider, control, steering, drive, extra"


def as_tuple(parts: Any) -> tuple[Any, ...]:
    if isinstance(parts, (tuple, list)):
        return tuple(parts)
    return () if parts is None else (parts,)


def refuse_misfits(bicycle: Bicycle) -> None:
    """Refuse objects in the wrong field, parts that do not fit, and tyres thicker than their wheels."""
    name = type(bicycle).__name__
    for field, kind in (("rear_tyre", Tyre), ("front_tyre", Tyre), ("head", HeadTwist), ("road", Ground)):
        held = getattr(bicycle, field)
        if not (isinstance(held, kind) or (field == "head" and held is None)):
            or_none = " or None" if field == "head" else ""
            raise TypeError(f"{name}: `{field}` is a {kind.__name__}{or_none}, got {called(held)}.")
    for field in _ORDER.split(", "):
        for part in as_tuple(getattr(bicycle, field)):
            if not isinstance(part, Part):
                raise TypeError(f"{name}: `{field}` holds a Part of jaxkane.bicycles, got {called(part)}.")
    _refuse_names_twice(bicycle)
    known = (*bicycle.coordinates, *bicycle.speeds, *bicycle.dependent_speeds, *bicycle.states)
    for part in bicycle.parts:
        part.check(bicycle)
        refuse_unknown(part.lateral(), known, f"{label_of(part, 'lateral')}: {name} has no")
    for end, tyre, radius in (("rear", bicycle.rear_tyre, bicycle.rR), ("front", bicycle.front_tyre, bicycle.rF)):
        crown = tyre.crown
        if crown is None or not is_concrete(crown, radius) or crown.ndim or radius.ndim:
            continue  # members of a batch are not looked at
        if float(crown) >= float(radius):  # numbers, where others are traced
            raise ValueError(
                f"{name}: {end}_tyre.crown = {crown} m is the radius of the tyre's cross section, and must be less "
                f"than that of its wheel, {radius} m."
            )


def _refuse_names_twice(bicycle: Bicycle) -> None:
    """Parts of one kind have the same names: values could not be told apart."""
    owners: dict[str, int] = {}
    places = _places(bicycle)
    for i, part in enumerate(bicycle.parts):
        for kind in NAMES:
            for name in getattr(part, kind):
                if owners.setdefault(name, i) != i:
                    raise ValueError(
                        f"{type(bicycle).__name__}: the name {name!r} stands twice in `{kind}`: of "
                        f"{places[owners[name]]} and of {places[i]}. {_APART}"
                    )


_APART = "Values are read by name: for a second part of a kind write a Part of your own, with other names."


def place_of(bicycle: Bicycle, part: Part) -> str:
    """Where a part stands first, and what it is: "extra[0], a Trailer"."""
    places = zip(bicycle.parts, _places(bicycle), strict=True)
    return next((place for each, place in places if each is part), called(part))


def _places(bicycle: Bicycle) -> list[str]:
    """Where the parts stand, in their order: one may stand in two places."""
    places = []
    for field in dataclasses.fields(bicycle):
        value = getattr(bicycle, field.name)
        for i, part in enumerate(as_tuple(value)):
            if isinstance(part, Part):
                place = f"{field.name}[{i}]" if isinstance(value, (tuple, list)) else field.name
                places.append(f"{place}, {called(part)}")
    return places


def label_of(part: Part, method: str) -> str:
    return f"{type(part).__name__}.{method}"


def by_name(given: Any, label: str) -> Mapping[str, Any]:
    """What a part's method returned, by name."""
    if not isinstance(given, Mapping):
        hint = " Does it end without a `return`?" if given is None else ""
        raise TypeError(f"{label} returns numbers by name, in a dict; got {given!r}.{hint}")
    return given


def moved(part: Part, bicycle: Bicycle, motion: BicycleMotion, t: Component, q: Any, u: Any) -> BicycleMotion:
    """The motion with what a part adds."""
    try:
        found = part.motion(bicycle, motion, t, q, u)
    except NameTaken as error:
        raise ValueError(f"{type(bicycle).__name__}: {place_of(bicycle, part)}: {error} {_APART}") from None
    if not isinstance(found, type(motion)):
        hint = " Does it end without a `return`?" if found is None else ""
        raise TypeError(f"{label_of(part, 'motion')} returns `motion.extended(...)`, got {found!r}.{hint}")
    return found


class Commanded(dict[str, Any]):
    """Inputs and states by name, as parts receive them.

    `commanded`: names of those inputs that parts add to; `read`: names that were looked up.
    """

    def __init__(self, values: Mapping[str, Component]):
        super().__init__(values)
        self.commanded: dict[str, None] = {}
        self.read: set[str] = set()

    def __getitem__(self, name: str) -> Component:
        self.read.add(name)
        return super().__getitem__(name)

    def __missing__(self, name: str) -> Component:
        raise not_there(name, self, "the inputs and states of this bicycle")


def commanded(bicycle: Bicycle, t: Any, q: Any, u: Any, motion: Any, values: Mapping[str, Component]) -> Commanded:
    """Inputs and states by name, with what the parts add to the inputs.

    **Raises:** `KeyError` for an input that no part has; `ValueError` for one that its part has read before.
    """
    name = type(bicycle).__name__
    found = Commanded(values)
    late: set[str] = set()
    for part in bicycle.parts:
        found.read.clear()
        given = by_name(part.commands(bicycle, t, q, u, motion, found), label_of(part, "commands"))
        for to, command in given.items():
            if to not in bicycle.inputs:
                raise not_there(
                    to, bicycle.inputs, f"the inputs of {name}, of which {type(part).__name__} adds to this one"
                )
            if to in late:
                raise ValueError(
                    f"{name}: {type(part).__name__} adds to {to!r} after the part that reads it, which would "
                    f"miss it. Put it before that part; parts are called in the order {_ORDER}."
                )
            found[to] = add(found.get(to), component(command))
            found.commanded[to] = None
        late |= found.read.intersection(part.inputs)
    return found


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
