"""Declarations of a system: contacts that push and do not pull, and dry friction."""

from __future__ import annotations

import dataclasses
from typing import Any

from ..._common.lookup import checked, refuse_if
from ..._scalarjit.components import (
    component,
    is_zero,
)
from ..._system.kinematics import Point, Vector
from ..._system.motion import Body
from ..arguments import check_number, is_concrete
from .impulses import checked_restitution


@dataclasses.dataclass(frozen=True)
class Contact:
    """For `System.contacts`: a contact that pushes but does not pull.

        def contacts(self, t, q, u, motion):
            return {
                "heel": jk.Contact(motion["heel"], motion.N.y, friction=self.friction),
                "stop": jk.Contact(gap=self.limit - q["knee"], restitution=0.2),
            }

    **Arguments:**

    - `point`: a Point of the body that touches.
    - `normal`: the direction in which the surface pushes this point, a Vector. Its length does not matter.
    - `gap`: the distance, zero at the contact and positive before it. By default, the distance of the point from the
        plane through the surface point (the origin O without one), along the normal. With a gap and no point, the
        contact has no friction. For example, the gap of a stop is an angle.
    - `restitution`: Newton's coefficient e of restitution, from 0 to 1: v_N+ = -e v_N-.
    - `friction`: the coefficient mu of kinetic friction. An impact has Coulomb friction with the impulses of the whole
        impact (Moreau).
    - `static`: the coefficient of static friction. By default, that of kinetic friction.
    - `surface`: a Point of the surface, if the surface moves. Its velocity is subtracted. If it is a point of a body of
        the system, the reaction acts on this body, at this point.

    **Raises:** `TypeError` and `ValueError` for arguments of a wrong type or outside their range.
    """

    point: Point | None = None
    normal: Vector | None = None
    gap: Any = None
    restitution: Any = 0.0
    friction: Any = 0.0
    static: Any = None
    surface: Point | None = None

    def __post_init__(self):
        remedy = ' Pass one of its points, such as motion["heel"] or body.center.'
        for name, value, kind in (
            ("point", self.point, Point),
            ("normal", self.normal, Vector),
            ("surface", self.surface, Point),
        ):
            what = f"Contact: `{name}` must be a {kind.__name__}"
            checked(value, kind | None, what, remedy * isinstance(value, Body))
        refuse_if(
            (self.point is None) != (self.normal is None) or (self.point is None and self.gap is None),
            "Contact: pass a point and a normal, or a gap, or all three.",
        )
        refuse_if(self.point is None and self.surface is not None, "Contact: `surface` needs a point and a normal.")
        check_number(self.restitution, "Contact: the restitution")
        checked_restitution(self.restitution, "Contact")
        _set_static(self, "friction", "gap")
        refuse_if(
            self.point is None and not is_zero(component(self.friction)),
            "Contact: a contact with friction needs a point and a normal, because a gap does not determine the "
            "slip. For friction along a coordinate use jaxkane.DryFriction.",
        )


@dataclasses.dataclass(frozen=True)
class DryFriction:
    """For `System.contacts`: dry friction of a bearing, a slide or a belt, whose normal force is known.

        def contacts(self, t, q, u, motion):
            return {"belt": jk.DryFriction(u["x_dot"] - self.speed, self.kinetic, static=self.static)}

    **Arguments:**

    - `slip`: the slip velocity [m/s or rad/s], affine in the speeds.
    - `kinetic`: the friction force while it slips [N or N m].
    - `static`: the largest friction force while it sticks [N or N m]. By default, the kinetic one.

    **Raises:** `TypeError` and `ValueError` for arguments of a wrong type or outside their range.
    """

    slip: Any
    kinetic: Any
    static: Any = None

    def __post_init__(self):
        _set_static(self, "kinetic", "slip")


def _set_static(contact: Contact | DryFriction, kinetic: str, other: str) -> None:
    """Check the numbers of a contact, and set the static friction to the kinetic one by default."""
    label, numbers = type(contact).__name__, {name: getattr(contact, name) for name in (other, kinetic, "static")}
    for name, value in numbers.items():
        if value is not None or name == kinetic or (name == other and other == "slip"):
            check_number(value, f"{label}: `{name}`")
    moving, static = numbers[kinetic], numbers["static"]
    if is_concrete(moving) and not float(moving) >= 0:
        raise ValueError(f"{label}: `{kinetic}` is {float(moving)}. It must not be negative.")
    if static is None:
        object.__setattr__(contact, "static", moving)
    elif is_concrete(moving, static) and not float(static) >= float(moving):
        raise ValueError(
            f"{label}: the static friction {float(static)} is smaller than the kinetic friction {float(moving)}."
        )
