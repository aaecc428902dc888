"""URDF files before MuJoCo reads them: shapes out, the root on the ground, inertias along the links, couplings."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree

import numpy as np

from ..joints import Coupling, Loop


def robot_of(text: str) -> ElementTree.Element:
    try:
        robot = ElementTree.fromstring(re.sub(r"<(/?)\w+:", r"<\1", text))  # extensions with an undeclared prefix
    except ElementTree.ParseError as error:
        raise ValueError(f"This is no URDF: {error}.") from error
    if robot.tag != "robot":
        raise ValueError(f"This is no URDF, whose root is <robot>, but <{robot.tag}>.")
    return robot


def for_mujoco(text: str, floating: bool) -> str:
    """Shapes go, since URDF's masses do not come from them; the root link gets a joint on the ground."""
    robot = robot_of(text)
    links = [link.get("name", "") for link in robot.findall("link")]
    children = [child.get("link") for child in robot.findall("joint/child")]
    roots = [name for name in links if name not in children]
    if len(roots) != 1:
        raise ValueError(f"A URDF has one root link; this one has {', '.join(roots) or 'none'}.")
    for part in list(robot):
        if part.tag not in ("link", "joint"):
            robot.remove(part)
    for link in robot.findall("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
    for inertial in robot.findall("link/inertial"):
        _turn_back(inertial)
    if floating or roots[0] != "world":
        if "world" in links:
            why = "is the ground: leave out floating=True" if roots[0] == "world" else "is not the root: rename it"
            raise ValueError(f"The link 'world' of a URDF {why}.")
        ElementTree.SubElement(robot, "link", name="world")
        joint = ElementTree.SubElement(robot, "joint", name="root", type="floating" if floating else "fixed")
        ElementTree.SubElement(joint, "parent", link="world")
        ElementTree.SubElement(joint, "child", link=roots[0])
    compiler = ElementTree.SubElement(ElementTree.SubElement(robot, "mujoco"), "compiler")
    compiler.attrib |= {"fusestatic": "false", "balanceinertia": "false", "discardvisual": "false"}
    return ElementTree.tostring(robot, encoding="unicode")


def _turn_back(inertial: ElementTree.Element) -> None:
    """Resolve an inertia along the link's axes: some versions of MuJoCo pass over the angles it is given in."""
    origin, tensor = inertial.find("origin"), inertial.find("inertia")
    angles = [float(x) for x in origin.get("rpy", "0 0 0").split()] if origin is not None else []
    if origin is None or tensor is None or not any(angles):
        return
    c, s = np.cos(angles), np.sin(angles)
    about_x = np.array([[1, 0, 0], [0, c[0], -s[0]], [0, s[0], c[0]]])
    about_y = np.array([[c[1], 0, s[1]], [0, 1, 0], [-s[1], 0, c[1]]])
    about_z = np.array([[c[2], -s[2], 0], [s[2], c[2], 0], [0, 0, 1]])
    R = about_z @ about_y @ about_x
    I = np.array([[float(tensor.get(f"i{min(a, b)}{max(a, b)}", 0.0)) for b in "xyz"] for a in "xyz"])
    turned = R @ I @ R.T
    for i, a in enumerate("xyz"):
        for j, b in enumerate("xyz"[i:], start=i):
            tensor.set(f"i{a}{b}", repr(float(turned[i, j])))
    origin.set("rpy", "0 0 0")


def has_friction(text: str) -> bool:
    return any(float(dynamics.get("friction", 0.0)) for dynamics in robot_of(text).findall("joint/dynamics"))


def mimics(text: str) -> list[Loop | Coupling]:
    found: list[Loop | Coupling] = []
    for joint in robot_of(text).findall("joint"):
        mimic = joint.find("mimic")
        if mimic is not None:
            numbers = float(mimic.get("offset", 0.0)), float(mimic.get("multiplier", 1.0))
            names = [str(x).replace(".", "_") for x in (joint.get("name"), mimic.get("joint"))]
            found.append(Coupling(names[0], names[1], numbers))
    return found
