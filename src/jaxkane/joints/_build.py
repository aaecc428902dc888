"""A mechanism from its links: checks of names and of the tree, and parameters."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from jax.core import Tracer

from .._common.lookup import not_there
from ._joints import Hinge, Joint, Shape, Slide, components, exact_numbers, is_structural_zero
from ._links import Actuator, Coupling, Link, Loop, Site, matrix_of
from ._loops import with_dependent
from ._mechanism import Field, Mechanism, class_of
from ._tree import MOMENTS, ActuatorShape, CouplingShape, LinkShape, LoopShape, SiteShape, Structure

_POSITIVE_MOMENTS = frozenset(MOMENTS[:3])


def mechanism(
    links: Sequence[Link],
    *,
    gravity: Any = (0.0, 0.0, -9.81),
    actuators: Sequence[Actuator] = (),
    sites: Sequence[Site] = (),
    loops: Sequence[Loop | Coupling] = (),
    dependent: Sequence[str] | None = None,
    name: str = "Mechanism",
    left_out: Sequence[str] = (),
) -> Mechanism:
    """A `System` of links in a tree, joined as they say.

        upper = Link("upper", joints=hinge("q1", (0, 1, 0)), mass=2.0, center=(0, 0, -0.2), inertia=(0.02, 0.02, 0))
        arm = mechanism([upper], actuators=[Actuator("motor", "q1")])

    **Arguments:**

    - `links`: in any order, a parent before or behind its children.
    - `gravity` [m/s^2] in the inertial frame N; parameters `gravity.x` and so on.
    - `actuators`, `sites`: inputs that drive joints; named points.
    - `loops`: what closes loops, `Loop` and `Coupling`. They are configuration constraints and velocity residuals.
    - `dependent`: the hinges and sliders that are solved for, as many as there are residuals; by default those are
        found by which the residuals can best be solved, at trial coordinates.
    - `name`: of its class, for messages.

    **Returns:** a `Mechanism`, of one class for each structure. Its coordinates and speeds are those of its joints, in
    the order of the tree.

    **Raises:** `ValueError` for names that stand for two things or hold a dot, a parent that is not there, links in a
    circle, and whatever has not the numbers that it should.
    """
    for what, given, kind in (
        ("links", links, "Link"),
        ("actuators", actuators, "Actuator"),
        ("sites", sites, "Site"),
        ("loops", loops, "Loop"),
    ):
        if isinstance(given, str) or not isinstance(given, Iterable):
            raise TypeError(
                f"mechanism: `{what}` is a list, such as [{kind}(...), ...], of one thing too; got a "
                f"{type(given).__name__}."
            )
    if isinstance(dependent, str):
        raise TypeError(f"mechanism: `dependent` is a list of names, such as [{dependent!r}]; got {dependent!r}.")
    if not isinstance(name, str):
        raise TypeError(f"mechanism: `name` is a text, got {name!r}.")
    values: dict[str, Any] = components("gravity", gravity)
    links = _in_order([_checked(link, Link) for link in links])
    shapes = tuple(_link(link, values) for link in links)
    joints = {joint.name: joint for link in shapes for joint in link.joints}
    names = [link.name for link in links]
    structure = Structure(
        name,
        shapes,
        tuple(_site(_checked(site, Site), names, values) for site in sites),
        tuple(_actuator(_checked(actuator, Actuator), joints, values) for actuator in actuators),
        left_out=tuple(left_out),
    )
    if not joints:
        raise ValueError(f"{name}: no link has a joint, so that nothing moves: Link(..., joints=hinge(...)).")
    if not any(link.has_mass for link in shapes):
        raise ValueError(f"{name}: no link that could be moved by a force has a mass: Link(..., mass=1.0).")
    _check_names(structure)
    made = [_loop(loop, structure, joints) for loop in loops]
    structure = structure._replace(
        loops=tuple(x for x in made if isinstance(x, LoopShape)),
        couplings=tuple(x for x in made if isinstance(x, CouplingShape)),
    )
    fields = tuple(_field(name, joints) for name in values)
    return class_of(with_dependent(structure, fields, values, dependent), fields)(**values)


def _checked(part: Any, kind: type) -> Any:
    if not isinstance(part, kind):
        raise TypeError(f"mechanism: this is no {kind.__name__}: {part!r}.")
    return part


def _in_order(links: list[Link]) -> list[Link]:
    """Parents before their children, otherwise as they were given."""
    names = [link.name for link in links]
    for link in links:
        _check_name(link.name, "link")
        if names.count(link.name) > 1:
            raise ValueError(f"Two links have the name {link.name!r}.")
        if link.parent is not None and link.parent not in names:
            raise ValueError(
                f"The parent of the link {link.name!r}: " + str(not_there(link.parent, names, "the links").args[0])
            )
    done: dict[str | None, Link | None] = {None: None}
    waiting = links
    while waiting:
        ready = [link for link in waiting if link.parent in done]
        if not ready:
            raise ValueError(f"Links carry each other in a circle: {', '.join(link.name for link in waiting)}.")
        first = ready[0]
        done[first.name] = first
        waiting = [link for link in waiting if link is not first]
    return [link for link in done.values() if link is not None]


def _check_name(name: Any, what: str) -> None:
    if not isinstance(name, str) or not name or "." in name:
        raise ValueError(
            f"The name of a {what} is a text without a dot, which stands between the parts of a parameter's name as in "
            f"mass.forearm; got {name!r}."
        )


def _link(link: Link, values: dict[str, Any]) -> LinkShape:
    if not isinstance(link.joints, (Joint, list, tuple)):
        raise TypeError(f"The joints of the link {link.name!r} are a Joint or a list of them, got {link.joints!r}.")
    given = (link.joints,) if isinstance(link.joints, Joint) else tuple(link.joints)
    shapes: list[Shape] = []
    for joint in given:
        _checked(joint, Joint)
        shapes += joint.shapes
        values |= joint.values
    values |= components(f"position.{link.name}", link.position)
    if any(len(shape.speeds) == 6 for shape in shapes) and (link.parent is not None or len(shapes) > 1):
        raise ValueError(
            f"The link {link.name!r} is free of its parent: a free joint is the only one of a link on the ground "
            "(parent=None). To fly relative to a moving link, chain three sliders and a ball joint."
        )
    if link.mass is not None:
        values[f"mass.{link.name}"] = link.mass
        values |= components(f"center.{link.name}", link.center)
        values |= _moments(link)
    return LinkShape(
        link.name, link.parent, matrix_of(link.orientation, link.name), tuple(shapes), link.mass is not None
    )


def _moments(link: Link) -> dict[str, Any]:
    rows = link.inertia
    lengths = [np.shape(row) for row in rows] if hasattr(rows, "__len__") else []
    if lengths not in ([()] * 3, [(3,)] * 3):
        raise ValueError(f"The inertia of {link.name!r} is three moments or a (3, 3) matrix, got {rows!r}.")
    if lengths[0] == ():
        entries = dict(zip(MOMENTS, (*rows, 0.0, 0.0, 0.0), strict=True))
    else:
        entries = {ij: rows["xyz".index(ij[0])]["xyz".index(ij[1])] for ij in MOMENTS}
        for i, j in ((0, 1), (0, 2), (1, 2)):
            a, b = rows[i][j], rows[j][i]
            if isinstance(a, Tracer) or isinstance(b, Tracer):
                continue
            if np.any(np.abs(np.subtract(a, b)) > 1e-9 * (np.abs(a) + np.abs(b))):  # more than rounding errors
                raise ValueError(f"The inertia matrix of {link.name!r} is not symmetric: {a} and {b}.")
    return {f"inertia.{link.name}.{ij}": x for ij, x in entries.items() if not is_structural_zero(x)}


def _site(site: Site, links: list[str], values: dict[str, Any]) -> SiteShape:
    _check_name(site.name, "site")
    if site.link is not None and site.link not in links:
        raise ValueError(f"The site {site.name!r}: " + str(not_there(site.link, links, "the links").args[0]))
    values |= components(f"site.{site.name}", site.position)
    return SiteShape(site.name, site.link, matrix_of(site.orientation, site.name))


def _actuator(actuator: Actuator, joints: Mapping[str, Shape], values: dict[str, Any]) -> ActuatorShape:
    _check_name(actuator.name, "actuator")
    if actuator.joint not in joints:
        raise ValueError(
            f"The actuator {actuator.name!r}: " + str(not_there(actuator.joint, joints, "the joints").args[0])
        )
    joint = joints[actuator.joint]
    gear = tuple(float(x) for x in np.atleast_1d(exact_numbers(actuator.gear, f"The gear of {actuator.name!r}")))
    if len(gear) != len(joint.speeds):
        raise ValueError(
            f"The gear of the actuator {actuator.name!r} is {len(joint.speeds)} numbers, one for each speed of "
            f"{joint.name!r}; got {actuator.gear!r}."
        )
    for kind in ("gain", "offset", "position_gain", "velocity_gain"):
        value = getattr(actuator, kind)
        if not is_structural_zero(value):
            values[f"{kind}.{actuator.name}"] = value
    if f"position_gain.{actuator.name}" in values and len(gear) > 1:
        raise ValueError(
            f"The actuator {actuator.name!r}: {joint.name!r} has no length that a position gain could act on."
        )
    return ActuatorShape(actuator.name, joint.name, gear)


def _loop(loop: Any, structure: Structure, joints: Mapping[str, Shape]) -> LoopShape | CouplingShape:
    if isinstance(loop, Loop):
        sites = [site.name for site in structure.sites]
        for end in (loop.first, loop.second):
            if end not in sites:
                raise ValueError("What closes a loop: " + str(not_there(end, sites, "the sites").args[0]))
        if loop.first == loop.second:
            raise ValueError(f"Loop({loop.first!r}, {loop.second!r}): a site is always where it is; name two.")
        return LoopShape(loop.first, loop.second, bool(loop.rigid), tuple(range(6 if loop.rigid else 3)))
    _checked(loop, Coupling)
    for end in [loop.first, *([] if loop.second is None else [loop.second])]:
        if not isinstance(joints.get(end), (Hinge, Slide)):
            raise ValueError(f"A coupling is of hinges and sliders; {end!r} is none.")
    if loop.first == loop.second:
        raise ValueError(f"Coupling({loop.first!r}, {loop.second!r}): a joint cannot follow itself; name two.")
    what = f"The coefficients of the coupling of {loop.first!r}"
    coefficients = tuple(float(a) for a in np.atleast_1d(exact_numbers(loop.coefficients, what)))
    if not coefficients:
        raise ValueError(f"{what} are one number at least, got none.")
    return CouplingShape(loop.first, loop.second, coefficients, True)


def _check_names(structure: Structure) -> None:
    """Names are those of the parts of one motion, of its coordinates, speeds and inputs, and of parameters."""
    for joint in structure.joints:
        _check_name(joint.name, "joint")
    for what, names in (
        ("joints", [joint.name for joint in structure.joints]),
        ("sites or links", [*(link.name for link in structure.links), *(site.name for site in structure.sites)]),
        ("actuators", [actuator.name for actuator in structure.actuators]),
    ):
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"Two {what} have the name {twice[0]!r}.")


_UNITS = {"mass": "kg", "inertia": "kg m^2", "gravity": "m/s^2"} | dict.fromkeys(
    ("center", "position", "anchor", "site"), "m"
)
_OF_HINGES = {"damping": "N m s/rad", "stiffness": "N m/rad", "rest": "rad", "armature": "kg m^2"}
_OF_SLIDERS = {"damping": "N s/m", "stiffness": "N/m", "rest": "m", "armature": "kg"}


def _field(name: str, joints: Mapping[str, Shape]) -> Field:
    kind, *_, last = name.split(".")
    positive = kind in ("mass", "armature") or (kind == "inertia" and last in _POSITIVE_MOMENTS)
    if kind not in _OF_HINGES:
        return name, positive, _UNITS.get(kind, "")
    joint = joints[name.split(".")[1]]
    if len(joint.speeds) == 6:  # newtons and newton metres in one
        return name, positive, "m" if kind == "rest" else ""
    return name, positive, (_OF_SLIDERS if isinstance(joint, Slide) else _OF_HINGES)[kind]
