"""MJCF and URDF files as mechanisms of joints. MuJoCo compiles them; nothing of it is needed afterwards."""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..joints import Coupling, Loop, Mechanism
from ._mujoco_model import Reader


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


Path = str | os.PathLike[str]


def from_mjcf(
    model: Path, *, strict: bool = False, dependent: Sequence[str] | None = None, name: str | None = None
) -> Mechanism:
    """The mechanism of an MJCF file.

        arm = jk.convert.from_mjcf("arm.xml")
        jk.fit.fit(arm, trials, free=["mass.forearm", "damping.elbow"])

    **Arguments:**

    - `model`: a path, or the text of a file, which begins with "<".
    - `strict`: refuse what has no counterpart, instead of leaving it out with a warning.
    - `dependent`: hinges and sliders that are solved for where loops are closed, as of `jaxkane.joints.mechanism`.
    - `name`: of the class; by default the model's.

    **Returns:** a `jaxkane.joints.Mechanism` with the names of the file. `qpos` are its coordinates but for the order
    of the Euler parameters, scalar last here; `qvel` its speeds; `ctrl` its inputs. A dot in a name becomes an
    underscore; an actuator or a site that has the name of something else gets `_input` or `_site` behind its own.
    Masses and inertias are those that MuJoCo compiles, of geoms and meshes too.

    Taken: bodies, hinge, slide, ball and free joints with damping, stiffness, springref, armature and ref; gravity;
    sites; actuators on joints whose force is affine in control, length and velocity; `connect`, `weld` and `joint`
    equalities, as rigid constraints. What is not is listed in `left_out`: contacts, limits, friction, tendons, ...

    **Raises:** `ImportError` without MuJoCo; `ValueError` for a file that MuJoCo does not read, one without a moving
    body, two names that differ by a dot alone, and with `strict` for what would be left out.
    """
    mujoco = _mujoco()
    return Reader(mujoco, _compiled(mujoco, model), name).mechanism(strict, dependent)


def from_urdf(
    model: Path,
    *,
    floating: bool = False,
    strict: bool = False,
    gravity: Any = (0.0, 0.0, -9.81),
    dependent: Sequence[str] | None = None,
    name: str | None = None,
) -> Mechanism:
    """The mechanism of a URDF file; links and joints have its names.

    `floating`: the root link flies, by a free joint named `root`; by default it is part of the ground. A link without
    an `inertial` has no mass, whatever its shapes. `mimic` becomes a coupling, joint damping is taken; the rest, the
    other arguments and the errors are those of `from_mjcf`.
    """
    mujoco = _mujoco()
    text = _text(model)
    couplings = mimics(text)
    compiled = _compiled(mujoco, for_mujoco(text, floating))
    reader = Reader(mujoco, compiled, name or robot_of(text).get("name"))
    reader.gravity = gravity
    reader.left_out += ["friction of joints"] * has_friction(text)
    reader.loops += couplings
    return reader.mechanism(strict, dependent)


def _mujoco() -> Any:
    try:
        import mujoco  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError(
            "Reading MJCF and URDF files needs MuJoCo: `pip install mujoco`, or `pip install 'jaxkane[mujoco]'`."
        ) from error
    return mujoco


def _is_text(model: Path) -> bool:
    return isinstance(model, str) and model.lstrip().startswith("<")


def _text(model: Path) -> str:
    if _is_text(model):
        return str(model)
    with open(model, encoding="utf-8") as file:
        return file.read()


def _compiled(mujoco: Any, model: Path) -> Any:
    if not _is_text(model) and not os.path.exists(model):
        raise FileNotFoundError(f"There is no file {os.fspath(model)!r}. The text of a model begins with '<'.")
    try:
        spec = mujoco.MjSpec.from_string(model) if _is_text(model) else mujoco.MjSpec.from_file(os.fspath(model))
        spec.compiler.fusestatic = False
        return spec.compile()
    except ValueError as error:
        where = "the text" if _is_text(model) else repr(os.fspath(model))
        raise ValueError(f"MuJoCo does not read {where}: {error}") from error
