"""What is static in a mechanism of links and joints, and its parameters by kind and name. Knows no motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax

from .._common.lookup import not_there
from ..rotations import Matrix
from ._shapes import Shape

KINDS = "mass center inertia position anchor site gravity damping stiffness rest armature"
KINDS += " gain offset position_gain velocity_gain"
"""Kinds of parameters: the first part of their names."""


MOMENTS = ("xx", "yy", "zz", "xy", "xz", "yz")


class LinkShape(NamedTuple):
    name: str
    parent: str | None
    orientation: Matrix | None
    joints: tuple[Shape, ...]
    has_mass: bool


class SiteShape(NamedTuple):
    name: str
    link: str | None
    orientation: Matrix | None


class ActuatorShape(NamedTuple):
    name: str
    joint: str
    gear: tuple[float, ...]


class LoopShape(NamedTuple):
    first: str
    second: str
    rigid: bool
    kept: tuple[int, ...]  # of its residuals

    @property
    def size(self) -> int:
        return 6 if self.rigid else 3


class CouplingShape(NamedTuple):
    first: str
    second: str | None
    coefficients: tuple[float, ...]
    is_kept: bool


class Structure(NamedTuple):
    """All that is static in a mechanism."""

    name: str
    links: tuple[LinkShape, ...]  # parents before children
    sites: tuple[SiteShape, ...] = ()
    actuators: tuple[ActuatorShape, ...] = ()
    loops: tuple[LoopShape, ...] = ()
    couplings: tuple[CouplingShape, ...] = ()
    dependent_speeds: tuple[str, ...] = ()
    dependent_coordinates: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()

    @property
    def joints(self) -> tuple[Shape, ...]:
        return tuple(joint for link in self.links for joint in link.joints)


_OF_LINKS, _OF_JOINTS, _OF_ACTUATORS = (
    lambda structure: [link.name for link in structure.links],
    lambda structure: [joint.name for joint in structure.joints],
    lambda structure: [actuator.name for actuator in structure.actuators],
)
_PARTS_OF: dict[str, Callable[[Structure], Sequence[str]]] = {
    **dict.fromkeys(("mass", "center", "inertia", "position"), _OF_LINKS),
    **dict.fromkeys(("anchor", "damping", "stiffness", "rest", "armature"), _OF_JOINTS),
    **dict.fromkeys(("gain", "offset", "position_gain", "velocity_gain"), _OF_ACTUATORS),
    "site": lambda structure: [site.name for site in structure.sites],
    "gravity": lambda structure: ("x", "y", "z"),
}


class Named(dict[str, Any]):
    """Parameters by name. One that is zero in the structure is none, and is refused as such."""

    def __init__(self, of: str, structure: Structure):
        super().__init__()
        self.of, self.structure = of, structure

    def __missing__(self, name: str) -> Any:
        kind, *parts = self.of.split(".")
        if name not in (_PARTS_OF[kind](self.structure) if not parts else (*"xyz", *MOMENTS)):
            raise not_there(name, self, f"`{self.of}`")
        raise KeyError(
            f"{self.structure.name} has no parameter {self.of}.{name}: it was written as 0 where the mechanism was "
            "made, and is part of its structure, which cannot be changed. Give jax.numpy.zeros(()) there."
        )


def _flat(named: Named) -> tuple[list[tuple[Any, Any]], tuple[Any, ...]]:
    names = sorted(named)
    return [(jax.tree_util.DictKey(name), named[name]) for name in names], (named.of, named.structure, *names)


def _from_flat(static: tuple[Any, ...], values: Any) -> Named:
    of, structure, *names = static
    named = Named(of, structure)
    named.update(zip(names, values, strict=True))
    return named


jax.tree_util.register_pytree_with_keys(Named, _flat, _from_flat)
