"""The links and joints of a URDF file, checked. Does not make a mechanism.

The format is that of the ROS wiki (urdf/XML). Shapes, materials and sensors are not read, so files of meshes need not
exist.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from typing import NamedTuple

import numpy as np

from .. import rotations
from .._common.lookup import not_there, refuse_any, refuse_if
from ._reading import check_distinct, without_dots

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
    - `joints`: parents before their children, branch by branch.
    - `balance`: whether the file asks for balanced inertias (`balanceinertia` of MuJoCo's extension).
    - `left_out`: elements that affect the motion and are not read.
    """

    name: str
    root: str
    links: dict[str, Inertial | None]
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
    read = [_joint(x, f"{name}, joint {x.get('name')!r}") for x in joints]
    root = _root(name, list(inertials), read)
    is_balanced = any(x.get("balanceinertia") == "true" for x in robot.findall("mujoco/compiler"))
    return UrdfFile(name, root, inertials, _in_order(name, root, read), is_balanced, _left_out(robot))


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
