"""URDF files as mechanisms of joints: links and joints of the file, with Python's reader of XML, and the mechanism.

The format is that of the ROS wiki (urdf/XML). Meshes, materials and sensors are not read, so files of meshes need not
exist.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from .. import rotations, shapes
from .._common.lookup import not_there, refuse_any, refuse_if
from .._scalarjit.components import ComponentsLike
from ..joints import Coupling, Joint, Link, Mechanism, ball, free, hinge, mechanism, planar, slide
from ._reading import (
    Choice,
    FileBody,
    Path,
    Selection,
    check_distinct,
    possible_inertias,
    report_left_out,
    selected,
    text_of,
    without_dots,
)

Element = ElementTree.Element

_XACRO = (
    "The model contains macros of xacro. Expand them first: `xacro robot.urdf.xacro > robot.urdf`, "
    "or `pip install xacro`."
)
KINDS = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")


class Inertial(NamedTuple):
    """The mass [kg], the mass centre (3,) [m], and the inertia (3, 3) [kg m^2] about it, along the link's axes."""

    mass: float
    center: np.ndarray
    inertia: np.ndarray


class FileJoint(NamedTuple):
    """A joint of the file.

    - `name`, `kind`, `parent`, `child`: as in the file, without dots.
    - `position` (3,) [m], `orientation` (3, 3): of the child in the parent. Columns are the axes of the child.
    - `axis` (3,): in the child.
    - `limits`: of the coordinate; None without.
    - `damping`, `friction`: in SI units.
    - `mimic`: (joint, multiplier, offset); None for an independent joint.
    """

    name: str
    kind: str
    parent: str
    child: str
    position: np.ndarray
    orientation: np.ndarray
    axis: np.ndarray
    limits: tuple[float, float] | None
    damping: float
    friction: float
    mimic: tuple[str, float, float] | None


class UrdfFile(NamedTuple):
    """A tree of links.

    - `name`: of the robot.
    - `root`: the name of its root link.
    - `links`: by name, None for a link without inertia.
    - `shapes`: of the links, by name: boxes, cylinders and spheres among their <visual>.
    - `joints`: parents before their children, branch by branch.
    - `balance`: whether the file asks for balanced inertias (`balanceinertia` of MuJoCo's extension).
    - `left_out`: elements that affect the motion and are not read, and shapes with errors.
    """

    name: str
    root: str
    links: dict[str, Inertial | None]
    shapes: dict[str, list[shapes.Shape]]
    joints: list[FileJoint]
    balance: bool
    left_out: list[str]


def read_urdf(text: str) -> UrdfFile:
    """The links and joints of a URDF.

    **Raises:** `ValueError` for a text that is not a URDF or a tree of links, and for numbers that are not finite, are
    missing, or are in degrees.
    """
    robot = _robot(text)
    name = robot.get("name") or "Mechanism"
    links, joints = robot.findall("link"), robot.findall("joint")
    refuse_if(not links, f"{name}: the URDF has no link.")
    for kinds, elements in (("links", links), ("joints", joints)):
        unnamed = [ElementTree.tostring(x, encoding="unicode").strip()[:80] for x in elements if not x.get("name")]
        refuse_any(unnamed[:1], f"{name}: one of the {kinds} has no name:", "")
        check_distinct(name, kinds, [x.get("name", "") for x in elements])
    inertials = {without_dots(x.get("name", "")): _inertial(x, f"{name}, link {x.get('name')!r}") for x in links}
    left_out = _left_out(robot)
    drawn = {without_dots(x.get("name", "")): [*_shapes(x, f"link {x.get('name')!r}", left_out)] for x in links}
    read = [_joint(x, f"{name}, joint {x.get('name')!r}") for x in joints]
    root = _root(name, list(inertials), read)
    is_balanced = any(x.get("balanceinertia") == "true" for x in robot.findall("mujoco/compiler"))
    return UrdfFile(name, root, inertials, drawn, _in_order(name, root, read), is_balanced, left_out)


def _robot(text: str) -> Element:
    """The root element. Its tags have no namespaces."""
    refuse_if("<xacro:" in re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL), _XACRO)
    try:
        # Extensions may have an undeclared prefix.
        robot = ElementTree.fromstring(re.sub(r"<(/?)\w+:", r"<\1", text.lstrip()))
    except ElementTree.ParseError as error:
        raise ValueError(f"The model is not a URDF: {error}. Check whether the file is complete.") from error
    for element in robot.iter():
        element.tag = element.tag.rpartition("}")[2]
    refuse_if(robot.tag != "robot", f"The model is not a URDF: its root must be <robot>, got <{robot.tag}>.")
    # Other elements, such as those of ros2_control, are not read.
    read = [x for part in (*robot.findall("link"), *robot.findall("joint")) for x in part.iter()]
    refuse_if(any("${" in value for x in (robot, *read) for value in x.attrib.values()), _XACRO)
    return robot


def _inertial(link: Element, label: str) -> Inertial | None:
    found = link.findall("inertial")
    refuse_if(len(found) > 1, f"{label}: the link has {len(found)} <inertial>. Keep one.")
    if not found:
        return None
    inertial = found[0]
    mass, tensor = inertial.find("mass"), inertial.find("inertia")
    if mass is None or tensor is None:
        missing = "mass" if mass is None else "inertia"
        raise ValueError(f"{label}: <inertial> has no <{missing}>. Add it, or omit <inertial> for a link without mass.")
    m = _number(mass, "value", label)
    refuse_if(m < 0.0, f"{label}: the mass is {m} kg; it must not be negative.")
    I = np.zeros((3, 3))
    for i, a in enumerate("xyz"):
        for j, b in enumerate("xyz"[i:], start=i):
            I[i, j] = I[j, i] = _number(tensor, f"i{a}{b}", label, None if a == b else 0.0)
    center, R = _placement(inertial, label)
    return Inertial(m, center, _turned(I, R)) if m or I.any() else None


_SIZES = {"sphere": {"radius": 1}, "box": {"size": 3}, "cylinder": {"radius": 1, "length": 1}}
"""For each primitive geometry the number of values of its attributes."""


def _shapes(link: Element, label: str, left_out: list[str]) -> Iterator[shapes.Shape]:
    for visual in link.findall("visual"):
        for x in [x for x in visual.findall("geometry/*") if x.tag in _SIZES]:
            try:
                sizes = [y for name, n in _SIZES[x.tag].items() for y in _read(x.get(name, ""), n, x, name, label)]
                position, R = _placement(visual, label)
            except ValueError as error:  # which does not affect the motion
                left_out.append(f"a shape: {error}")
            else:
                yield getattr(shapes, x.tag)(*([sizes] if x.tag == "box" else sizes), position, R.T)


def _turned(I: np.ndarray, R: np.ndarray) -> np.ndarray:
    return I if np.array_equal(R, np.eye(3)) else R @ I @ R.T


def _joint(joint: Element, label: str) -> FileJoint:
    kind = joint.get("type", "")
    refuse_if(kind not in KINDS, f"{label}: the type must be one of {', '.join(KINDS)}; got {kind!r}.")
    parent, child = (_end(joint, end, label) for end in ("parent", "child"))
    position, orientation = _placement(joint, label)
    axis, dynamics, mimic = joint.find("axis"), joint.find("dynamics"), joint.find("mimic")
    direction = np.array([1.0, 0.0, 0.0]) if axis is None else _numbers(axis, "xyz", label, (1.0, 0.0, 0.0))
    refuse_if(
        kind not in ("fixed", "floating") and not direction.any(),
        f"{label}: the axis is zero. Give it a direction, or make the joint fixed.",
    )
    damping, friction = (0.0 if dynamics is None else _number(dynamics, x, label, 0.0) for x in ("damping", "friction"))
    for what, value in (("damping", damping), ("friction", friction)):
        refuse_if(value < 0.0, f"{label}: the {what} is {value}; it must not be negative.")
    follows = None
    if mimic is not None:
        refuse_if(not mimic.get("joint"), f'{label}: <mimic joint="..."/> names no joint.')
        factor, offset = (_number(mimic, x, label, default) for x, default in (("multiplier", 1.0), ("offset", 0.0)))
        follows = without_dots(mimic.get("joint", "")), factor, offset
    return FileJoint(
        without_dots(joint.get("name", "")),
        kind,
        parent,
        child,
        position,
        orientation,
        direction,
        _limits(joint, kind, label),
        damping,
        friction,
        follows,
    )


def _end(joint: Element, end: str, label: str) -> str:
    element = joint.find(end)
    if element is None or not element.get("link"):
        raise ValueError(f'{label}: <{end} link="..."/> is missing.')
    return without_dots(element.get("link", ""))


def _limits(joint: Element, kind: str, label: str) -> tuple[float, float] | None:
    limit = joint.find("limit")
    if limit is None or kind not in ("revolute", "prismatic") or not {"lower", "upper"} & limit.attrib.keys():
        return None
    lower, upper = (_number(limit, x, label, 0.0, infinite=True) for x in ("lower", "upper"))
    refuse_if(
        kind == "revolute" and (lower in _DEGREES or upper in _DEGREES),
        f"{label}: the limits {lower:g} and {upper:g} are in degrees, but a URDF has radians. Convert the angles "
        "of the file.",
    )
    return lower, upper


_DEGREES = {
    sign * x for sign in (-1.0, 1.0) for x in (30.0, 45.0, 60.0, 90.0, 120.0, 135.0, 150.0, 180.0, 270.0, 360.0)
}
"""Limits that are written like this are in degrees. Other large limits are not unusual: some files have limits of
100 rad for a joint that turns freely."""


def _placement(element: Element, label: str) -> tuple[np.ndarray, np.ndarray]:
    """Position (3,) and orientation (3, 3) of the <origin> of an element. Columns are the axes of the child.

    **Raises:** `ValueError` for angles above a full turn, which are in degrees.
    """
    origin = element.find("origin")
    if origin is None:
        return np.zeros(3), np.eye(3)
    position, angles = (_numbers(origin, x, label, (0.0, 0.0, 0.0)) for x in ("xyz", "rpy"))
    refuse_if(
        np.abs(angles).max() > 2.0 * math.pi + 0.01,
        f'{label}: rpy="{origin.get("rpy")}" exceeds a full turn. A URDF has radians. Convert the angles of the '
        "file if they are in degrees.",
    )
    # Rotations about the fixed axes x, y and z are those about the turned axes z, y and x.
    return position, np.array(rotations.sequence_matrix("3-2-1", angles[::-1].tolist())).T


def _number(
    element: Element, attribute: str, label: str, default: float | None = None, infinite: bool = False
) -> float:
    text = element.get(attribute)
    if text is None:
        if default is None:
            raise ValueError(f'{label}: <{element.tag}> has no {attribute}="...".')
        return default
    return float(_read(text, 1, element, attribute, label, infinite)[0])


def _numbers(element: Element, attribute: str, label: str, default: tuple[float, ...]) -> np.ndarray:
    text = element.get(attribute)
    return np.array(default) if text is None else _read(text, len(default), element, attribute, label)


def _read(text: str, n: int, element: Element, attribute: str, label: str, infinite: bool = False) -> np.ndarray:
    try:
        numbers = np.array([float(x) for x in text.split()])
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) != n or np.isnan(numbers).any() or not (infinite or np.isfinite(numbers).all()):
        what = "a finite number" if n == 1 else f"{n} finite numbers"
        raise ValueError(f'{label}: <{element.tag} {attribute}="{text}"> must be {what}.')
    return numbers


def _root(name: str, links: list[str], joints: list[FileJoint]) -> str:
    """The root link. **Raises:** `ValueError` if the joints do not connect the links to one tree."""
    carrier: dict[str, FileJoint] = {}
    for joint in joints:
        for link in (joint.parent, joint.child):
            if link not in links:
                raise ValueError(f"{name}, joint {joint.name!r}: {not_there(link, links, 'the links').args[0]}")
        if joint.child in carrier:
            raise ValueError(
                f"{name}: the joints {carrier[joint.child].name!r} and {joint.name!r} both carry the link "
                f"{joint.child!r}. A URDF is a tree. For a closed loop, use `jaxkane.joints.Loop`, or an MJCF "
                "file with <equality>.",
            )
        carrier[joint.child] = joint
    roots = [link for link in links if link not in carrier]
    if len(roots) != 1:
        remedy = "Connect them by fixed joints." if roots else "The joints form a loop. Remove one of them."
        raise ValueError(f"{name}: a URDF must have one root link; this one has {', '.join(roots) or 'none'}. {remedy}")
    return roots[0]


def _in_order(name: str, root: str, joints: list[FileJoint]) -> list[FileJoint]:
    """Joints from the root, branch by branch. **Raises:** `ValueError` for joints that form a loop."""
    children: dict[str, list[FileJoint]] = {}
    for joint in joints:
        children.setdefault(joint.parent, []).append(joint)
    ordered, waiting = [], list(reversed(children.get(root, [])))
    while waiting:
        ordered.append(waiting.pop())
        waiting += reversed(children.get(ordered[-1].child, []))
    circular = [joint.name for joint in joints if joint not in ordered]
    refuse_if(circular, f"{name}: the joints {', '.join(circular)} form a loop. Remove one of them.")
    return ordered


def _left_out(robot: Element) -> list[str]:
    """Elements that may affect the motion and are not read."""
    effects = {
        "contacts": "link/collision",
        "transmissions": "transmission",
        "extensions of Gazebo": "gazebo",
    }
    found = [effect for effect, path in effects.items() if robot.find(path) is not None]
    changes = {x for compiler in robot.findall("mujoco/compiler") for x in compiler.attrib}
    return [
        *found,
        *(f"{x} of MuJoCo's compiler" for x in sorted(changes & {"boundmass", "boundinertia", "settotalmass"})),
    ]


def from_urdf(
    model: Path,
    *,
    floating: bool = False,
    inertias: Choice = "refuse",
    merge_fixed: bool = True,
    stops: Selection = (),
    friction: Selection = (),
    gravity: ComponentsLike = (0.0, 0.0, -9.81),
    strict: bool = False,
    dependent: Sequence[str] | None = None,
    name: str | None = None,
) -> Mechanism:
    """The mechanism of a URDF file, with the names of its links and joints.

        arm = jk.convert.from_urdf("arm.urdf", stops=["elbow"])
        dog = jk.convert.from_urdf("dog.urdf", floating=True)

    Revolute, continuous, prismatic, fixed, floating and planar joints are supported. A link without an `inertial` has
    no mass, even if it has shapes. `mimic` becomes a coupling. `package://` paths and meshes are not read. Animations
    draw boxes, cylinders and spheres of `visual`.

    **Arguments:**

    - `model`: a path, or the text of a file. A text must begin with "<".
    - `floating`: True: a free joint named `root` connects the root link to the ground. False: the root link is fixed to
        the ground.
    - `inertias`: how to treat inertias that violate the triangle inequality by more than 5 %. "refuse" raises an
        exception with a table of links. "nearest" uses the nearest possible inertias. For both, an excess of up to
        0.2 % is attributed to rounding, and an excess of up to 5 % causes a warning. Inertias that do not affect the
        motion are never refused.
    - `merge_fixed`: True: links that are connected rigidly become one body, named after the first link with a mass. The
        other links remain as points. False: each link keeps its own parameters.
    - `stops`: names of hinges and sliders whose limits become contacts without restitution. The contacts are named
        `NAME lower` and `NAME upper`, and their parameters are `lower.NAME` and `upper.NAME`. True: all joints with a
        range. At most eight contacts are possible, or six with friction of joints. Name those that reach their limits.
    - `friction`: names of hinges and sliders whose friction becomes dry friction. The contact is named `NAME friction`,
        and its parameter is `friction.NAME`. True: all joints with friction.
    - `gravity` (3,): the acceleration of gravity in the inertial frame [m/s^2].
    - `strict`: raise an exception for elements that are not supported, instead of omitting them with a warning.
    - `dependent`: names of hinges and sliders that are dependent, as in `jaxkane.joints.mechanism`.
    - `name`: the name of the class. Default: the name of the robot.

    **Returns:** a `jaxkane.joints.Mechanism`. `left_out` lists omitted elements. A dot in a name becomes an underscore.
    A floating joint on the ground becomes a free joint. A floating joint on a moving link becomes three sliders,
    `NAME_x`, `NAME_y` and `NAME_z`, and a ball joint `NAME`. Joints that move no mass are fixed.

    **Raises:**

    - `ValueError` for a file that is not a URDF, contains macros of xacro, or is not one tree of links; for numbers
        that are missing, not finite or in degrees; for impossible inertias; for a file in which nothing moves.
    - `ValueError` for joints in `stops` without a range, for joints in `friction` without friction, for more than four
        contacts, and with `strict` for omitted elements.
    - `FileNotFoundError` for a missing file.
    """
    file = read_urdf(text_of(model))
    file = _without_massless_joints(file._replace(name=name or file.name))
    refuse_if(
        not floating and all(joint.kind == "fixed" for joint in file.joints),
        f"{file.name}: no joint moves a mass, so nothing can move. Pass floating=True if the root link is free.",
    )
    refuse_if(
        floating and file.root == "world", f"{file.name}: the root link 'world' is the ground: omit floating=True."
    )
    reader = _UrdfReader(file, floating, stops, friction)
    links = reader.links(inertias, merge_fixed)
    couplings = reader.couplings()
    left_out = report_left_out(file.name, [*file.left_out, *reader.left_out()], strict, stacklevel=2)
    return mechanism(links, gravity=gravity, loops=couplings, dependent=dependent, name=file.name, left_out=left_out)


class _Group:
    """Links that are connected rigidly.

    - `head`: the first of them, which a movable joint carries.
    - `placements`: of each link in the head: position (3,), orientation (3, 3).
    - `axis`: as in `FileBody`, in the head.
    - `moves`: whether it is not part of the ground.
    """

    def __init__(self, head: str, moves: bool, axis: np.ndarray | None):
        self.head, self.moves, self.axis = head, moves, axis
        self.placements = {head: (np.zeros(3), np.eye(3))}


class _UrdfReader:
    def __init__(self, file: UrdfFile, floating: bool, stops: Selection, friction: Selection):
        self.file, self.floating = file, floating
        simple = [x for x in file.joints if x.kind in ("revolute", "continuous", "prismatic")]
        self.limited = [x.name for x in simple if x.limits and np.any(np.isfinite(x.limits))]
        self.rough = [x.name for x in simple if x.friction]
        self.simple = {joint.name: joint for joint in simple}
        self.stops = selected("stops", stops, self.limited, "a range", file.name)
        self.friction = selected("friction", friction, self.rough, "friction", file.name)
        self.groups = self._groups()

    def _groups(self) -> dict[str, _Group]:
        root = _Group(self.file.root, self.floating, None if self.floating else np.zeros(3))
        groups = {root.head: root}
        for joint in self.file.joints:
            parent = groups[joint.parent]
            if joint.kind == "fixed":
                r, R = parent.placements[joint.parent]
                parent.placements[joint.child] = r + R @ joint.position, R @ joint.orientation
                groups[joint.child] = parent
            else:
                R = parent.placements[joint.parent][1] @ joint.orientation
                groups[joint.child] = _Group(joint.child, True, _axis_of_child(parent.axis, R, joint))
        return groups

    def links(self, inertias: Choice, merge_fixed: bool) -> list[Link]:
        bodies = self._bodies(merge_fixed)
        in_file = []
        for link, (label, inertial) in bodies.items():
            group = self.groups[link]
            axis = None if group.axis is None else group.placements[link][1].T @ group.axis  # in the link
            in_file.append(FileBody(label, inertial.inertia, axis))
        used = possible_inertias(self.file.name, in_file, inertias, self.file.balance)
        matrices = dict(zip(bodies, used, strict=True))
        carriers = {joint.child: joint for joint in self.file.joints}
        links = []
        for link in (self.file.root, *carriers):
            own: dict[str, Any] = {"shape": self.file.shapes[link]}
            if link in bodies:
                inertial = bodies[link][1]
                I = _without_rounding(matrices[link], np.trace(matrices[link]))
                own |= {"mass": inertial.mass, "center": inertial.center.tolist(), "inertia": I.tolist()}
            if link in carriers:
                links.append(self._link(carriers[link], own))
            elif link != "world":
                links.append(Link(link, None, free("root") if self.floating else (), **own))
        return links

    def _bodies(self, merge_fixed: bool) -> dict[str, tuple[str, Inertial]]:
        """By link that carries the mass: a label for messages, and the inertial data. Masses that do not move are
        omitted."""
        bodies: dict[str, tuple[str, Inertial]] = {}
        for group in {id(group): group for group in self.groups.values()}.values():
            heavy = {link: self.file.links[link] for link in group.placements if group.moves}
            heavy = {link: inertial for link, inertial in heavy.items() if inertial is not None}
            if merge_fixed and len(heavy) > 1:
                first = next(iter(heavy))
                label = f"{first} with {', '.join(list(heavy)[1:])}"
                bodies[first] = label, _merged(heavy, group.placements, first)
            else:
                bodies |= {link: (link, inertial) for link, inertial in heavy.items()}
        return bodies

    def _link(self, joint: FileJoint, own: dict[str, Any]) -> Link:
        parent: str | None = None if joint.parent == self.file.root == "world" else joint.parent
        on_ground = not self.groups[joint.parent].moves
        if joint.kind == "floating" and on_ground:
            return Link(joint.child, None, free(joint.name, damping=joint.damping), **own)  # its coordinates place it
        position = _without_rounding(joint.position, 1.0).tolist()
        return Link(joint.child, parent, self._joints(joint), position, joint.orientation, **own)

    def _joints(self, joint: FileJoint) -> list[Joint]:
        name, damping = joint.name, joint.damping
        if joint.kind == "fixed":
            return []
        if joint.kind == "floating":
            sliders = [slide(f"{name}_{x}", axis, damping=damping) for x, axis in zip("xyz", np.eye(3), strict=True)]
            return [*sliders, ball(name, damping=damping)]
        if joint.kind == "planar":
            return [planar(name, _in_plane(joint.axis), damping=damping)]
        options: dict[str, Any] = {"damping": damping}
        if name in self.stops and joint.limits:
            options["stops"] = tuple(x if np.isfinite(x) else None for x in joint.limits)
        if name in self.friction:
            options["friction"] = joint.friction
        return [(slide if joint.kind == "prismatic" else hinge)(name, joint.axis, **options)]

    def couplings(self) -> list[Coupling]:
        """**Raises:** `ValueError` for a joint that follows one that does not exist, or itself."""
        found = []
        for joint in self.simple.values():
            if joint.mimic is None:
                continue
            followed, factor, offset = joint.mimic
            if followed not in self.simple:
                names = not_there(followed, self.simple, "the revolute, continuous and prismatic joints").args[0]
                raise ValueError(
                    f"{self.file.name}: the joint {joint.name!r} cannot mimic {followed!r}: {names} Correct <mimic>, "
                    "or remove it."
                )
            chain = [joint.name]
            while (last := self.simple.get(chain[-1])) is not None and last.mimic is not None:
                refuse_if(
                    last.mimic[0] in chain,
                    f"{self.file.name}: the joints {', '.join(chain)} mimic each other in a circle. Remove one "
                    "<mimic>.",
                )
                chain.append(last.mimic[0])
            found.append(Coupling(joint.name, followed, (offset, factor)))
        return found

    def left_out(self) -> list[str]:
        omitted = []
        if len(self.limited) > len(self.stops):
            omitted.append("limits of joints")
        others = [joint for joint in self.file.joints if joint.friction and joint.name not in self.friction]
        if any(joint.kind != "fixed" for joint in others):
            omitted.append("friction of joints")
        ignored = [x.name for x in self.file.joints if x.mimic and x.name not in self.simple and x.kind != "fixed"]
        return [*omitted, *(f"mimic of the joint {name!r}" for name in ignored)]


def _without_massless_joints(file: UrdfFile) -> UrdfFile:
    """The file, in which joints that move no mass are fixed. Their accelerations are not determined, and the motion of
    the masses does not depend on them. Joints that mimic each other are fixed together.
    """
    heavy = {name: inertial is not None for name, inertial in file.links.items()}
    for joint in reversed(file.joints):
        heavy[joint.parent] |= heavy[joint.child]
    moves_mass = {joint.name: heavy[joint.child] for joint in file.joints if joint.kind != "fixed"}
    pairs = [(x.name, x.mimic[0]) for x in file.joints if x.mimic and {x.name, x.mimic[0]} <= moves_mass.keys()]
    for _ in pairs:  # a joint that follows another may in turn be followed
        for names in pairs:
            moves_mass |= dict.fromkeys(names, any(moves_mass[name] for name in names))
    massless = [name for name, moves in moves_mass.items() if not moves]
    joints = [x._replace(kind="fixed", mimic=None) if x.name in massless else x for x in file.joints]
    omitted = [f"joints that move no mass: {', '.join(massless)}"] if massless else []
    return file._replace(joints=joints, left_out=[*file.left_out, *omitted])


def _axis_of_child(parent: np.ndarray | None, R: np.ndarray, joint: FileJoint) -> np.ndarray | None:
    """The axis of a child (see `FileBody`), from that of its parent. R: orientation of the child in the parent.

    The axis of a hinge is the same in both links. Parallel axes therefore remain parallel.
    """
    if parent is None or joint.kind == "floating":
        return None
    inherited = R.T @ parent
    if joint.kind == "prismatic":
        return inherited
    own = joint.axis / np.linalg.norm(joint.axis)
    if not inherited.any():
        return own
    return own if np.linalg.norm(np.cross(own, inherited)) < 1e-9 else None


def _merged(heavy: dict[str, Inertial], placements: dict[str, tuple[np.ndarray, np.ndarray]], first: str) -> Inertial:
    """The mass, the mass centre and the inertia of several rigidly connected links, in the frame of the first."""
    origin, axes = placements[first]
    mass = sum(inertial.mass for inertial in heavy.values())
    places, turns = [], []
    for link, inertial in heavy.items():
        r, R = placements[link]
        turns.append(axes.T @ R)
        places.append(axes.T @ (r - origin) + turns[-1] @ inertial.center)
    masses = np.array([inertial.mass for inertial in heavy.values()])
    center = masses @ np.array(places) / mass if mass else np.zeros(3)
    I = np.zeros((3, 3))
    for m, r, R, inertial in zip(masses, places, turns, heavy.values(), strict=True):
        d = r - center
        I += R @ inertial.inertia @ R.T + m * ((d @ d) * np.eye(3) - np.outer(d, d))
    return Inertial(mass, _without_rounding(center, np.abs(places).max()), I)


def _without_rounding(values: np.ndarray, size: float) -> np.ndarray:
    """Entries within rounding of zero become structural zeros."""
    return np.where(np.abs(values) < 1e-15 * size, 0.0, values)


def _in_plane(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two axes in a plane: x and y for the normal z, and those cyclically for the normals x and y."""
    n = normal / np.linalg.norm(normal)
    seed = np.eye(3)[(int(np.argmax(np.abs(n))) + 1) % 3]
    first = seed - (seed @ n) * n
    first /= np.linalg.norm(first)
    return first, np.cross(n, first)
