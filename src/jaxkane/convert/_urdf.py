"""URDF files as mechanisms of joints, with Python's reader of XML."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .._common.lookup import not_there, refuse_if
from .._scalarjit.components import ComponentsLike
from ..joints import Coupling, Joint, Link, Mechanism, ball, free, hinge, mechanism, planar, slide
from ._inertias import Choice, FileBody, possible_inertias
from ._reading import Path, Selection, report_left_out, selected, text_of
from ._urdf_file import FileJoint, Inertial, UrdfFile, read_urdf


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
    no mass, even if it has shapes. `mimic` becomes a coupling. `package://` paths and meshes are not read.

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
        range. A system can have at most four contacts, so name only the joints that reach their limits.
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
            own: dict[str, Any] = {}
            if link in bodies:
                inertial = bodies[link][1]
                I = _without_rounding(matrices[link], np.trace(matrices[link]))
                own = {"mass": inertial.mass, "center": inertial.center.tolist(), "inertia": I.tolist()}
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
