"""Joints as the user writes them: shapes, which are static, and numbers by name, which become parameters.

Knows the shapes of joints; knows no tree of links.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ._numbers import components, exact_numbers, is_structural_zero, unit_vector
from ._shapes import Ball, Free, Hinge, Shape, Slide


class Joint(NamedTuple):
    """What a link is joined by: shapes that follow each other, and numbers by the name of their parameter."""

    shapes: tuple[Shape, ...]
    values: Mapping[str, Any]


def hinge(
    name: str,
    axis: Any = (0.0, 0.0, 1.0),
    *,
    anchor: Any = (0.0, 0.0, 0.0),
    damping: Any = 0.0,
    stiffness: Any = 0.0,
    rest: Any = 0.0,
    armature: Any = 0.0,
    reference: float = 0.0,
) -> Joint:
    """A hinge: the coordinate `name` [rad], the speed `name_rate` [rad/s].

    **Arguments:**

    - `axis`, of any length, and `anchor` [m], the place of the hinge, in the link's frame.
    - `damping` [N m s/rad], `stiffness` [N m/rad] of a spring that rests at the angle `rest` [rad].
    - `armature` [kg m^2]: the inertia of a geared rotor as felt at the joint, on the diagonal of the mass matrix.
    - `reference` [rad], an exact number: the coordinate where the link stands as its position and orientation say.
    """
    values = _numbers(name, damping=damping, stiffness=stiffness, rest=rest, armature=armature)
    return Joint(
        (Hinge(name, unit_vector(axis, name), _reference(reference, name)),),
        values | components(f"anchor.{name}", anchor),
    )


def slide(
    name: str,
    axis: Any = (0.0, 0.0, 1.0),
    *,
    damping: Any = 0.0,
    stiffness: Any = 0.0,
    rest: Any = 0.0,
    armature: Any = 0.0,
    reference: float = 0.0,
) -> Joint:
    """A slider along `axis` of the link's frame: the coordinate `name` [m], the speed `name_rate` [m/s].

    `damping` [N s/m], `stiffness` [N/m], `rest` [m], `armature` [kg], `reference` [m]: as of `hinge`.
    """
    values = _numbers(name, damping=damping, stiffness=stiffness, rest=rest, armature=armature)
    return Joint((Slide(name, unit_vector(axis, name), _reference(reference, name)),), values)


def _reference(value: Any, name: str) -> float:
    return float(exact_numbers(value, f"The reference of {name!r}"))


def ball(
    name: str, *, anchor: Any = (0.0, 0.0, 0.0), damping: Any = 0.0, stiffness: Any = 0.0, armature: Any = 0.0
) -> Joint:
    """A ball joint: Euler parameters `name_e1` ... `name_e4`, scalar last, and the relative angular velocity
    `name_w1` ... `name_w3` along the link's axes [rad/s].

    `anchor` [m] in the link's frame; `damping` [N m s/rad]; `stiffness` [N m/rad] times the rotation vector from where
    all Euler parameters but the last are zero; `armature` [kg m^2] for each of the three.
    """
    values = _numbers(name, damping=damping, stiffness=stiffness, armature=armature)
    return Joint((Ball(name),), values | components(f"anchor.{name}", anchor))


def free(name: str, *, damping: Any = 0.0, stiffness: Any = 0.0, rest: Any = (0.0,) * 3, armature: Any = 0.0) -> Joint:
    """No joint at all, of a link that flies: place `name_x`, `name_y`, `name_z` of its origin in the inertial frame [m]
    and Euler parameters `name_e1` ... `name_e4`; velocity `name_vx` ... in the inertial frame [m/s], angular velocity
    `name_w1` ... along its own axes [rad/s].

    `damping`, `stiffness` and `armature` are for all six, in SI units; the spring rests at the place `rest` [m].
    """
    values = _numbers(name, damping=damping, stiffness=stiffness, armature=armature)
    return Joint((Free(name),), values | components(f"rest.{name}", rest))


def fixed() -> Joint:
    """A rigid connection: as no joint."""
    return Joint((), {})


def universal(name: str, axes: Any = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), **more: Any) -> Joint:
    """Two hinges, `name_1` on the carrier and `name_2` on the link, about two axes; `more` as of `hinge`, for both."""
    if len(axes) != 2:
        raise ValueError(f"A universal joint has two axes, {name!r} {len(axes)}: give several hinges to a link.")
    return _chain([hinge(f"{name}_{i + 1}", axis, **more) for i, axis in enumerate(axes)])


def planar(name: str, axes: Any = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), **more: Any) -> Joint:
    """Two sliders `name_x` and `name_y` along two axes, and a hinge `name_angle` about the normal of their plane.

    `more`, as `damping`, is of all three, in SI units.
    """
    first, second = (np.asarray(axis, float) for axis in axes)
    normal = np.cross(first, second)
    sliders = [slide(f"{name}_{end}", axis, **more) for end, axis in zip("xy", axes, strict=True)]
    return _chain([*sliders, hinge(f"{name}_angle", normal, **more)])


def _chain(joints: Sequence[Joint]) -> Joint:
    return Joint(
        tuple(shape for joint in joints for shape in joint.shapes),
        {name: value for joint in joints for name, value in joint.values.items()},
    )


def _numbers(joint: str, **values: Any) -> dict[str, Any]:
    return {f"{kind}.{joint}": x for kind, x in values.items() if not is_structural_zero(x)}
