"""Links, sites, actuators and loops as users define them, and the mechanism that is made of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import jax
import numpy as np

from .. import rotations
from .._common.lookup import checked, refuse_any, refuse_if, refuse_unknown
from .._kane.contact.laws import most_contacts
from .._scalarjit.compat import Tracer
from .._scalarjit.components import Component, ComponentsLike
from ..rotations import Matrix
from ..shapes import Shape, as_shapes
from ._joints import Hinge, Joint, JointType, Slide, components, exact, exact_numbers, is_structural_zero
from ._loops import with_dependent
from ._mechanism import (
    MOMENTS,
    ActuatorStructure,
    CouplingStructure,
    Field,
    LinkStructure,
    LoopStructure,
    Mechanism,
    SiteStructure,
    Structure,
    class_of,
)

Orientation: TypeAlias = Any
"""Euler parameters, a sequence with its angles, a rotation matrix, or None for no rotation; see `Link`."""


@dataclasses.dataclass(frozen=True, eq=False)
class Link:
    """A rigid link, its position in the tree, and the joints to its parent.

        Link("forearm", parent="upper arm", joints=hinge("elbow", (0, 1, 0)), position=(0, 0, -0.3), mass=1.2,
             center=(0, 0, -0.12), inertia=(0.01, 0.01, 0.001))

    **Arguments:**

    - `name`: of the link, without a dot.
    - `parent`: the name of another link; None for the ground.
    - `joints`: one, or a chain of several, all defined in the link's frame; none for a rigid connection.
    - `position` [m], `orientation`: the link's frame in its parent's, for zero joint coordinates. The orientation is
        four Euler parameters (scalar last), a sequence and its angles, e.g. ("3-1-2", (a, b, c)) [rad], or a (3, 3)
        matrix whose columns are the link's axes in the parent.
    - `mass` [kg], `center` [m]: mass and mass centre. A link without a mass is a frame that carries others.
        A mass of zero is permitted if the link has moments of inertia.
    - `inertia` [kg m^2]: about the mass centre, along the link's axes: three principal moments, or a (3, 3) matrix.
    - `shape`: what animations draw, one of `jaxkane.shapes` or a list of these, with exact numbers. Those of a
        link without a mass belong to a body of mass zero, `NAME shape`.

    Numbers become parameters: `mass.forearm`, `center.forearm.z`, `inertia.forearm.xx`, `position.forearm.z`. A zero
    that is written as a number is not a parameter but part of the structure, and costs nothing. Write `jnp.zeros(())`
    for a parameter that is zero.
    """

    name: str
    parent: str | None = None
    joints: Joint | Sequence[Joint] = ()
    position: ComponentsLike = (0.0, 0.0, 0.0)
    orientation: Orientation = None
    mass: Component | None = None
    center: ComponentsLike = (0.0, 0.0, 0.0)
    inertia: ComponentsLike | Sequence[ComponentsLike] = (0.0, 0.0, 0.0)
    shape: Shape | Sequence[Shape] = ()


@dataclasses.dataclass(frozen=True, eq=False)
class Site:
    """A named point of a link (None: of the ground), for animations, sensors and loops: `motion["name"]`.

    - `position` [m]: in the link's frame, with the parameters `site.name.x`, ...
    - `orientation`: as of `Link`, for a rigid `Loop`.
    """

    name: str
    link: str | None
    position: ComponentsLike = (0.0, 0.0, 0.0)
    orientation: Orientation = None


@dataclasses.dataclass(frozen=True, eq=False)
class Actuator:
    """An input, `name`, that drives a joint.

        force along the joint's speeds = gear * (gain * input + offset - position_gain * length - velocity_gain * rate)

    **Arguments:**

    - `joint`: its name.
    - `gear`: one number for a hinge or a slider, three for a ball joint, six for a free one.
    - `gain`, `offset`, `position_gain`, `velocity_gain`: parameters, named `gain.name` and so on. A servo of stiffness
        k has `gain=k, position_gain=k`.

    length = gear * coordinate, for hinges and sliders; rate = gear . speeds.
    """

    name: str
    joint: str
    gear: Component | ComponentsLike = 1.0
    gain: Component = 1.0
    offset: Component = 0.0
    position_gain: Component = 0.0
    velocity_gain: Component = 0.0


@dataclasses.dataclass(frozen=True, eq=False)
class Loop:
    """A loop closure: two sites that coincide. With `rigid` their orientations coincide too, and may not differ by half
    a turn.

    Only independent residuals are used, chosen at the `pose` of the mechanism. A spatial loop has three (six if rigid),
    a planar loop two (three).
    """

    first: str
    second: str
    rigid: bool = False


@dataclasses.dataclass(frozen=True, eq=False)
class Coupling:
    """A joint that follows another, as by gears: first = c0 + c1 * second + c2 * second^2 + ...

    The arguments are names of hinges or sliders, and exact numbers. Without `second` the joint is fixed at c0.
    """

    first: str
    second: str | None = None
    coefficients: Sequence[float] = (0.0, 1.0)


def mechanism(
    links: Sequence[Link],
    *,
    gravity: ComponentsLike = (0.0, 0.0, -9.81),
    actuators: Sequence[Actuator] = (),
    sites: Sequence[Site] = (),
    loops: Sequence[Loop | Coupling] = (),
    dependent: Sequence[str] | None = None,
    independent: Sequence[str] = (),
    pose: Mapping[str, float] | None = None,
    poses: Mapping[str, Mapping[str, float]] | None = None,
    name: str = "Mechanism",
    left_out: Sequence[str] = (),
) -> Mechanism:
    """A `System` of links in a tree.

        upper = Link("upper", joints=hinge("q1", (0, 1, 0)), mass=2.0, center=(0, 0, -0.2), inertia=(0.02, 0.02, 0))
        arm = mechanism([upper], actuators=[Actuator("motor", "q1")])

    **Arguments:**

    - `links`: in any order.
    - `gravity` (3,) [m/s^2]: in the inertial frame N; parameters `gravity.x` and so on.
    - `actuators`: inputs that drive joints.
    - `sites`: named points.
    - `loops`: closed loops, `Loop` and `Coupling`. They become configuration constraints and velocity residuals.
    - `dependent`: the hinges and sliders that are solved for, one for each residual. Default: the best-conditioned
        choice at the `pose`.
    - `independent`: joints that are not solved for, e.g. those with motors.
    - `pose`: coordinates by name at which loops are closed approximately. Independent residuals and dependent joints
        are chosen there. Default: near zero coordinates. Residuals that nearly depend on others there are omitted with
        a warning.
    - `poses`: further poses by name, which `system.poses` returns. Each has a value for every coordinate.
    - `name`: of its class, for messages.
    - `left_out`: elements of a file that were not imported.

    **Returns:** a `Mechanism`, with one class for each structure. Its coordinates and speeds are those of its joints,
    in the order of the tree.

    **Raises:** `ValueError` for names that are used twice or contain a dot, an unknown parent, links that carry each
    other in a circle, more than four stops, and wrong numbers of values.
    """
    for what, given, kind in (
        ("links", links, "Link"),
        ("actuators", actuators, "Actuator"),
        ("sites", sites, "Site"),
        ("loops", loops, "Loop"),
    ):
        if isinstance(given, str) or not isinstance(given, Iterable):
            raise TypeError(
                f"mechanism: `{what}` must be a list, e.g. [{kind}(...), ...], also for one element; got a "
                f"{type(given).__name__}."
            )
    for what, names in (("dependent", dependent), ("independent", independent)):
        if isinstance(names, str):
            raise TypeError(f"mechanism: `{what}` must be a list of names, e.g. [{names!r}]; got {names!r}.")
    checked(name, str, "mechanism: `name` must be a string")
    values: dict[str, Any] = components("gravity", gravity)
    links = _in_order([_checked(link, Link) for link in links])
    link_structures = tuple(_link(link, values) for link in links)
    joints = {joint.name: joint for link in link_structures for joint in link.joints}
    names = [link.name for link in links]
    structure = Structure(
        name,
        link_structures,
        tuple(_site(_checked(site, Site), names, values) for site in sites),
        tuple(_actuator(_checked(actuator, Actuator), joints, values) for actuator in actuators),
        left_out=tuple(left_out),
    )
    refuse_if(not joints, f"{name}: no link has a joint, so nothing can move. Pass Link(..., joints=hinge(...)).")
    refuse_if(
        not any(link.has_mass for link in link_structures),
        f"{name}: no movable link has a mass. Pass Link(..., mass=1.0).",
    )
    _check_names(structure)
    _check_stops(structure)
    closures = [_loop(loop, structure, joints) for loop in loops]
    structure = structure._replace(
        loops=tuple(x for x in closures if isinstance(x, LoopStructure)),
        couplings=tuple(x for x in closures if isinstance(x, CouplingStructure)),
    )
    fields = tuple(_field(name, joints) for name in values)
    structure = with_dependent(structure, fields, values, dependent, independent, pose)
    return class_of(structure._replace(poses=_poses(structure, poses or {})), fields)(**values)


def _poses(structure: Structure, poses: Mapping[str, Mapping[str, float]]) -> tuple[tuple[str, tuple[float, ...]], ...]:
    names = [name for joint in structure.joints for name in joint.names(joint.coordinates)]
    for label, pose in poses.items():
        if set(pose) != set(names):
            wrong = sorted(set(pose) ^ set(names))
            raise ValueError(f"{structure.name}: the pose {label!r} needs one value per coordinate; see {wrong[0]!r}.")
    return tuple((label, tuple(float(pose[name]) for name in names)) for label, pose in poses.items())


def _checked(part: object, kind: type) -> Any:
    return checked(part, kind, f"mechanism needs a {kind.__name__}")


def _in_order(links: list[Link]) -> list[Link]:
    names = [link.name for link in links]
    for link in links:
        _check_name(link.name, "link")
        refuse_if(names.count(link.name) > 1, f"Two links have the name {link.name!r}.")
        if link.parent is not None:
            _check_known(f"The parent of the link {link.name!r}", link.parent, names, "the links")
    ordered: dict[str, Link] = {}
    while len(ordered) < len(links):
        waiting = [link for link in links if link.name not in ordered]
        ready = next((link for link in waiting if link.parent is None or link.parent in ordered), None)
        if ready is None:
            raise ValueError(
                f"The parents of the links form a cycle: {', '.join(link.name for link in waiting)}. Connect one of "
                "these links to the ground (parent=None). If they form a closed chain, close it with loops=[Loop(...)]."
            )
        ordered[ready.name] = ready
    return list(ordered.values())


def _check_name(name: object, what: str) -> None:
    if not isinstance(name, str) or not name or "." in name:
        raise ValueError(
            f"The name of a {what} must be a string without a dot, because dots separate the parts of a parameter's "
            f"name, e.g. mass.forearm; got {name!r}."
        )


def _check_known(label: str, name: str, known: Iterable[str], where: str) -> None:
    refuse_unknown([name], known, f"{label} is not among {where}:")


def _link(link: Link, values: dict[str, Any]) -> LinkStructure:
    what = f"The joints of the link {link.name!r} must be a Joint or a list of Joints"
    checked(link.joints, (Joint, list, tuple), what)
    types: list[JointType] = []
    for joint in [link.joints] if isinstance(link.joints, Joint) else link.joints:
        types += _checked(joint, Joint).types
        values |= joint.values
    values |= components(f"position.{link.name}", link.position)
    refuse_if(
        any(len(joint.speeds) == 6 for joint in types) and (link.parent is not None or len(types) > 1),
        f"The link {link.name!r} has a free joint, which must be its only joint and needs the ground as parent "
        "(parent=None). For free motion relative to a moving link, chain three sliders and a ball joint.",
    )
    if link.mass is not None:
        moments = _moments(link)
        if not (moments and is_structural_zero(link.mass)):  # a gimbal may have moments of inertia only
            values[f"mass.{link.name}"] = link.mass
        values |= components(f"center.{link.name}", link.center) | moments
    shapes = tuple(_exact(shape, link.name) for shape in as_shapes(link.shape, link.name))
    orientation = _matrix(link.orientation, link.name)
    return LinkStructure(link.name, link.parent, orientation, tuple(types), link.mass is not None, shapes)


def _exact(shape: Shape, name: str) -> Shape:
    x, y, z, *halves = exact_numbers([*shape.center, *shape.halves], f"A shape of {name!r}").tolist()
    return shape._replace(center=(x, y, z), halves=tuple(halves))


def _moments(link: Link) -> dict[str, Any]:
    rows = link.inertia
    lengths = [np.shape(row) for row in rows] if hasattr(rows, "__len__") else []
    refuse_if(
        lengths not in ([()] * 3, [(3,)] * 3),
        f"The inertia of {link.name!r} must be three moments or a (3, 3) matrix, got {rows!r}.",
    )
    if lengths[0] == ():
        entries = dict(zip(MOMENTS, (*rows, 0.0, 0.0, 0.0), strict=True))
    else:
        entries = {ij: rows["xyz".index(ij[0])]["xyz".index(ij[1])] for ij in MOMENTS}
        for i, j in ((0, 1), (0, 2), (1, 2)):
            a, b = rows[i][j], rows[j][i]
            if isinstance(a, Tracer) or isinstance(b, Tracer):
                continue
            # more than rounding errors
            refuse_if(
                np.any(np.abs(np.subtract(a, b)) > 1e-9 * (np.abs(a) + np.abs(b))),
                f"The inertia matrix of {link.name!r} is not symmetric: {a} and {b}.",
            )
    return {f"inertia.{link.name}.{ij}": x for ij, x in entries.items() if not is_structural_zero(x)}


def _site(site: Site, links: list[str], values: dict[str, Any]) -> SiteStructure:
    _check_name(site.name, "site")
    if site.link is not None:
        _check_known(f"The site {site.name!r}", site.link, links, "the links")
    values |= components(f"site.{site.name}", site.position)
    return SiteStructure(site.name, site.link, _matrix(site.orientation, site.name))


def _actuator(actuator: Actuator, joints: Mapping[str, JointType], values: dict[str, Any]) -> ActuatorStructure:
    _check_name(actuator.name, "actuator")
    _check_known(f"The actuator {actuator.name!r}", actuator.joint, joints, "the joints")
    joint = joints[actuator.joint]
    gear = tuple(float(x) for x in np.atleast_1d(exact_numbers(actuator.gear, f"The gear of {actuator.name!r}")))
    refuse_if(
        len(gear) != len(joint.speeds),
        f"The gear of the actuator {actuator.name!r} must be {len(joint.speeds)} numbers, one for each speed of "
        f"{joint.name!r}; got {actuator.gear!r}.",
    )
    for kind in ("gain", "offset", "position_gain", "velocity_gain"):
        value = getattr(actuator, kind)
        if not is_structural_zero(value):
            values[f"{kind}.{actuator.name}"] = value
    refuse_if(
        f"position_gain.{actuator.name}" in values and len(gear) > 1,
        f"The actuator {actuator.name!r}: `position_gain` needs a joint with one speed, but {joint.name!r} has "
        "several. Omit `position_gain`.",
    )
    return ActuatorStructure(actuator.name, joint.name, gear)


def _loop(
    loop: Loop | Coupling, structure: Structure, joints: Mapping[str, JointType]
) -> LoopStructure | CouplingStructure:
    if isinstance(loop, Loop):
        sites = [site.name for site in structure.sites]
        for end in (loop.first, loop.second):
            _check_known("A loop", end, sites, "the sites")
        refuse_if(
            loop.first == loop.second,
            f"Loop({loop.first!r}, {loop.second!r}): the sites are equal. Name two different sites.",
        )
        return LoopStructure(loop.first, loop.second, bool(loop.rigid), tuple(range(6 if loop.rigid else 3)))
    _checked(loop, Coupling)
    for end in [loop.first, *([] if loop.second is None else [loop.second])]:
        if not isinstance(joints.get(end), (Hinge, Slide)):
            raise ValueError(f"Coupling: {end!r} is not a hinge or a slider of the mechanism. Name one of these.")
    refuse_if(
        loop.first == loop.second,
        f"Coupling({loop.first!r}, {loop.second!r}): a joint cannot follow itself. Name two different joints.",
    )
    what = f"The coefficients of the coupling of {loop.first!r}"
    coefficients = tuple(float(a) for a in np.atleast_1d(exact_numbers(loop.coefficients, what)))
    refuse_if(not coefficients, f"{what} must be at least one number, got none.")
    return CouplingStructure(loop.first, loop.second, coefficients, True)


def _check_names(structure: Structure) -> None:
    """Check that names are unique among parts of the motion; coordinates, speeds and inputs; and parameters."""
    for joint in structure.joints:
        _check_name(joint.name, "joint")
    for what, names in (
        ("joints", [joint.name for joint in structure.joints]),
        ("sites or links", [*(link.name for link in structure.links), *(site.name for site in structure.sites)]),
        ("actuators", [actuator.name for actuator in structure.actuators]),
    ):
        twice = sorted({name for name in names if names.count(name) > 1})
        refuse_any(twice, f"Two {what} have the name", ". Rename one.")


def _check_stops(structure: Structure) -> None:
    stops = [joint.name for joint in structure.joints for has in joint.has_stops if has]
    rough = [joint.name for joint in structure.joints if joint.has_friction]
    if len(stops) + len(rough) > (most := most_contacts(bool(rough), False)):
        kinds = (("the limits of", stops, "stops"), ("the dry friction of", rough, "friction"))
        parts = [f"{what} {', '.join(dict.fromkeys(names))}" for what, names, _ in kinds if names]
        options = [f"`{option}`" for _, names, option in kinds if names]
        raise ValueError(
            f"{structure.name} has {len(stops) + len(rough)} contacts, which are {' and '.join(parts)}. At most "
            f"{most} are possible. Name fewer joints in {' and '.join(options)}, or use MuJoCo."
        )


_UNITS = {"mass": "kg", "inertia": "kg m^2", "gravity": "m/s^2"} | dict.fromkeys(
    ("center", "position", "anchor", "site"), "m"
)
_OF_HINGES = {"damping": "N m s/rad", "stiffness": "N m/rad", "rest": "rad", "armature": "kg m^2"}
_OF_HINGES |= {"lower": "rad", "upper": "rad", "friction": "N m"}
_OF_SLIDERS = {"damping": "N s/m", "stiffness": "N/m", "rest": "m", "armature": "kg"}
_OF_SLIDERS |= {"lower": "m", "upper": "m", "friction": "N"}


def _field(name: str, joints: Mapping[str, JointType]) -> Field:
    kind, *_, last = name.split(".")
    positive = kind in ("mass", "armature") or (kind == "inertia" and last in MOMENTS[:3])
    if kind not in _OF_HINGES:
        return name, positive, _UNITS.get(kind, "")
    joint = joints[name.split(".")[1]]
    if len(joint.speeds) == 6:  # the speeds have different units, m and rad
        return name, positive, "m" if kind == "rest" else ""
    return name, positive, (_OF_SLIDERS if isinstance(joint, Slide) else _OF_HINGES)[kind]


def _matrix(orientation: Orientation, name: str) -> Matrix | None:
    """[R] (components in the parent -> components here) as exact floats; None for no rotation.

    **Raises:** `ValueError` if it is not a rotation.
    """
    if orientation is None:
        return None
    exact_numbers([x for x in jax.tree.leaves(orientation) if not isinstance(x, str)], f"The orientation of {name!r}")
    try:
        if len(orientation) == 2 and isinstance(orientation[0], str):
            R = np.array(rotations.sequence_matrix(orientation[0], [float(x) for x in orientation[1]]))
        elif np.shape(orientation) == (4,):
            e = np.asarray(orientation, float)
            R = np.array(rotations.euler_parameters_matrix([float(x) for x in e / np.linalg.norm(e)]))
        else:
            R = np.asarray(orientation, float).T  # columns are the axes
        refuse_if(
            R.shape != (3, 3) or not (np.abs(R @ R.T - np.eye(3)).max() < 1e-6 and np.linalg.det(R) > 0),
            "not a rotation matrix",
        )
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{name!r}: the orientation must be four Euler parameters (scalar last), a sequence with its angles, e.g. "
            f'("3-1-2", (a, b, c)), or a (3, 3) rotation matrix; got {orientation!r}.'
        ) from error
    U, _, Vt = np.linalg.svd(R)
    R = R if np.abs(U @ Vt - R).max() < 1e-15 else U @ Vt
    R = np.array([[exact(x) for x in row] for row in R])
    return None if np.array_equal(R, np.eye(3)) else tuple(tuple(float(x) for x in row) for row in R)  # type: ignore
