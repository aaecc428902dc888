"""MJCF files as mechanisms of joints. MuJoCo compiles them; it is not needed afterwards."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from types import ModuleType
from typing import Any, TypeAlias

import numpy as np

from .. import rotations, shapes
from .._common.lookup import refuse_if
from ..joints import Actuator, Coupling, Joint, Link, Loop, Mechanism, Site, ball, free, hinge, mechanism, slide
from ._reading import (
    Path,
    Selection,
    check_distinct,
    check_exists,
    is_text,
    names_without_dots,
    report_left_out,
    selected,
    unused_name,
    unused_names,
    without_dots,
)

MjModel: TypeAlias = Any
"""A compiled model of MuJoCo, which is an optional dependency."""


def from_mjcf(
    model: Path,
    *,
    strict: bool = False,
    stops: Selection = (),
    friction: Selection = (),
    dependent: Sequence[str] | None = None,
    independent: Sequence[str] = (),
    pose: str | Mapping[str, float] | None = None,
    name: str | None = None,
) -> Mechanism:
    """The mechanism of an MJCF file.

        arm = jk.convert.from_mjcf("arm.xml")
        jk.fit.fit(arm, trials, free=["mass.forearm", "damping.elbow"])

    Supported are bodies; hinge, slide, ball and free joints with damping, stiffness, springref, armature and ref;
    gravity; sites; actuators on joints whose force is affine in control, length and velocity; `connect`, `weld` and
    `joint` equalities, as rigid constraints. Other elements are omitted and listed in `left_out`: contacts, friction,
    tendons, ... Limits of joints are omitted unless `stops` contains the joint.

    **Arguments:**

    - `model`: a path, or the text of a file, which begins with "<".
    - `strict`: raise an exception for unsupported elements, instead of omitting them with a warning.
    - `stops`: names of hinges and sliders whose limits become contacts without restitution, `NAME lower` and
        `NAME upper`, with the parameters `lower.NAME`, `upper.NAME`. True: all that have a range. A system has at
        most eight contacts, or six with friction of joints. Name the joints that reach their limits.
    - `friction`: names of hinges and sliders whose `frictionloss` becomes dry friction, the contact `NAME friction`
        with the parameter `friction.NAME`. True: all that have friction.
    - `dependent`: hinges and sliders that are solved for in closed loops, as in `jaxkane.joints.mechanism`.
    - `independent`: joints that are not solved for, e.g. those with motors.
    - `pose`: where loops are closed approximately: the name of a key frame, "qpos0", or coordinates by name.
        Independent residuals and dependent joints are chosen there.
    - `name`: of the class; the model's name by default.

    **Returns:** a `jaxkane.joints.Mechanism` with the names of the file. Its coordinates are `qpos`, except for the
    order of the Euler parameters, which are scalar-last here. Its speeds are `qvel`, its inputs `ctrl`. A dot in a name
    becomes an underscore. An actuator or a site whose name is already used gets the suffix `_input` or `_site`. Masses
    and inertias are those that MuJoCo compiles, also from geoms and meshes. `poses` has the coordinates `qpos0` and
    those of the key frames, from which `jk.assemble(system, system.poses["qpos0"])` starts. Animations draw the
    spheres, boxes, cylinders and capsules (as cylinders) of the groups 0 to 2.

    **Raises:** `ImportError` without MuJoCo; `ValueError` for a file that MuJoCo cannot read, one without a moving
    body, two names that differ only by a dot, `stops` without a limit, too many contacts, and with `strict` for
    unsupported elements.
    """
    try:
        import mujoco  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError(
            "Reading MJCF files needs MuJoCo: `pip install mujoco`, or `pip install 'jaxkane[mujoco]'`."
        ) from error
    return _ModelReader(mujoco, _compiled(mujoco, model), name, stops, friction).mechanism(
        strict, dependent, independent, pose
    )


def _compiled(mujoco: ModuleType, model: Path) -> Any:
    from_text = is_text(model)
    if not from_text:
        check_exists(model)
    try:
        spec = mujoco.MjSpec.from_string(model) if from_text else mujoco.MjSpec.from_file(os.fspath(model))
        spec.compiler.fusestatic = False
        return spec.compile()
    except ValueError as error:
        where = "the text" if from_text else repr(os.fspath(model))
        raise ValueError(f"MuJoCo cannot read {where}: {error}") from error


class _ModelReader:
    """Reads a compiled model into links, sites, actuators and loops of a mechanism, and lists omitted elements."""

    def __init__(self, mujoco: ModuleType, model: MjModel, name: str | None, stops: Selection, friction: Selection):
        self.m, self.kinds = model, mujoco
        own = bytes(model.names[:200]).split(b"\0", 1)[0].decode("utf-8", "replace")
        own = "" if own == "MuJoCo Model" else own  # the name of a file without a name
        self.name = name or own or "Mechanism"
        self.left_out: list[str] = []
        self.gravity = (0.0, 0.0, 0.0) if self._is_off("GRAVITY") else _floats(model.opt.gravity)
        self.bodies = self._names("body", model.nbody)
        self.joints = self._names("joint", model.njnt)
        self.carriers: list[str | None] = [None, *self.bodies[1:]]
        types, off = model.jnt_type, self._is_off
        kinds = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
        self.with_axis = [j for j in range(model.njnt) if int(types[j]) in kinds]
        limited = [self.joints[j] for j in self.with_axis if model.jnt_limited[j]]
        rough = [self.joints[j] for j in self.with_axis if model.dof_frictionloss[model.jnt_dofadr[j]]]
        self.stops = selected("stops", stops, [] if off("LIMIT", "CONSTRAINT") else limited, "a range", self.name)
        rough = [] if off("FRICTIONLOSS", "CONSTRAINT") else rough
        self.friction = selected("friction", friction, rough, "friction", self.name)
        self.sites: list[Site] = []
        self.loops: list[Loop | Coupling] = []

    def _is_off(self, *flags: str) -> bool:
        """Whether the model disables one of these. Not every version has every flag."""
        bits = [int(getattr(self.kinds.mjtDisableBit, f"mjDSBL_{flag}", 0)) for flag in flags]
        return any(int(self.m.opt.disableflags) & bit for bit in bits)

    def _names(self, kind: str, n: int) -> list[str]:
        """The file's names. Elements without a name are numbered, without using these names."""
        given = [getattr(self.m, kind)(i).name for i in range(n)]
        check_distinct(self.name, _PLURALS.get(kind, kind + "s"), given)
        names = [without_dots(name) for name in given]
        for i, name in enumerate(names):
            if not name:
                names[i] = unused_name(f"{kind}{i}", names, "_")
        return names

    def mechanism(
        self,
        strict: bool,
        dependent: Sequence[str] | None,
        independent: Sequence[str],
        pose: str | Mapping[str, float] | None,
    ) -> Mechanism:
        m = self.m
        refuse_if(not m.nv, f"{self.name}: the file has no joint, so nothing can move.")
        links = [self._link(i) for i in range(1, m.nbody)]
        used = {*self.bodies, *(f"{j} joint" for j in self.joints)}
        for i, name in enumerate(unused_names(self._names("site", m.nsite), used, "_site")):
            self.sites.append(
                Site(name, self.carriers[m.site_bodyid[i]], _floats(m.site_pos[i]), _euler(m.site_quat[i]))
            )
        self._read_equalities({*used, *(site.name for site in self.sites)})
        actuators = list(self._actuators())
        self.left_out += self._left_out_effects()
        left_out = report_left_out(self.name, self.left_out, strict, stacklevel=3)
        return mechanism(
            links,
            gravity=self.gravity,
            actuators=actuators,
            sites=self.sites,
            loops=self.loops,
            dependent=names_without_dots(dependent),
            independent=names_without_dots(independent),
            pose=self._pose(pose),
            poses=self._poses(),
            name=self.name,
            left_out=left_out,
        )

    def _poses(self) -> dict[str, dict[str, float]]:
        poses: dict[str, dict[str, float]] = {}
        for pose, qpos in zip(
            ["qpos0", *self._names("key", self.m.nkey)], [self.m.qpos0, *self.m.key_qpos], strict=True
        ):
            values = poses.setdefault(pose, {})
            for j, name in enumerate(self.joints):
                own = qpos[int(self.m.jnt_qposadr[j]) :]
                if j in self.with_axis:
                    values[name] = float(own[0])
                    continue
                start = 3 if int(self.m.jnt_type[j]) == self.kinds.mjtJoint.mjJNT_FREE else 0
                values |= {f"{name}_{x}": float(own[i]) for i, x in enumerate("xyz"[:start])}
                values |= {f"{name}_e{i + 1}": x for i, x in enumerate(_euler(own[start : start + 4]))}
        return poses

    def _pose(self, pose: str | Mapping[str, float] | None) -> Mapping[str, float] | None:
        if not isinstance(pose, str):
            return pose
        poses = self._poses()
        refuse_if(
            pose not in poses, f"{self.name}: `pose` is {pose!r}, but the poses of the file are {', '.join(poses)}."
        )
        return poses[pose]

    def _link(self, i: int) -> Link:
        m = self.m
        first, count = int(m.body_jntadr[i]), int(m.body_jntnum[i])
        joints = [self._joint(j) for j in range(first, first + count)]
        # its coordinates determine its position
        is_free = count and m.jnt_type[first] == int(self.kinds.mjtJoint.mjJNT_FREE)
        moves = m.body_weldid[i] != 0
        mass = float(m.body_mass[i])
        has_mass = moves and (mass > 0.0 or bool(np.any(m.body_inertia[i] > 0.0)))
        return Link(
            self.bodies[i],
            self.carriers[m.body_parentid[i]],
            joints,
            position=(0.0, 0.0, 0.0) if is_free else _floats(m.body_pos[i]),
            orientation=None if is_free else _euler(m.body_quat[i]),
            mass=mass if has_mass else None,
            center=_floats(m.body_ipos[i]),
            inertia=_inertia(m.body_inertia[i], m.body_iquat[i]),
            shape=list(self._shapes(i)),
        )

    def _shapes(self, i: int) -> Iterator[shapes.Shape]:
        m, start = self.m, int(self.m.body_geomadr[i])
        kinds = {"sphere": "sphere", "box": "box", "cylinder": "cylinder", "capsule": "cylinder"}
        for g in range(start, start + int(m.body_geomnum[i])):
            # MuJoCo's viewer does not show the groups above 2, which are mostly copies for collisions.
            kind = kinds.get(self.kinds.mjtGeom(int(m.geom_type[g])).name.removeprefix("mjGEOM_").lower())
            if kind and m.geom_group[g] <= 2:
                radius, half, _ = halves = _floats(m.geom_size[g])
                sizes = {"box": [[2.0 * x for x in halves]], "cylinder": [radius, 2.0 * half], "sphere": [radius]}[kind]
                axes = rotations.euler_parameters_matrix(_euler(m.geom_quat[g]))
                yield getattr(shapes, kind)(*sizes, _floats(m.geom_pos[g]), axes)

    def _joint(self, j: int) -> Joint:
        m, kind, name = self.m, self.m.jnt_type[j], self.joints[j]
        dof, place = int(m.jnt_dofadr[j]), int(m.jnt_qposadr[j])
        common: dict[str, Any] = {
            "damping": 0.0 if self._is_off("DAMPER", "PASSIVE") else float(m.dof_damping[dof]),
            "armature": float(m.dof_armature[dof]),
            "stiffness": 0.0 if self._is_off("SPRING", "PASSIVE") else float(m.jnt_stiffness[j]),
        }
        types = self.kinds.mjtJoint
        if j in self.with_axis:
            common |= {"reference": float(m.qpos0[place])}
            common |= {"rest": float(m.qpos_spring[place])} if common["stiffness"] else {}
            common |= {"stops": _floats(m.jnt_range[j])} if name in self.stops else {}
            common |= {"friction": float(m.dof_frictionloss[dof])} if name in self.friction else {}
            if kind == int(types.mjJNT_SLIDE):
                return slide(name, _floats(m.jnt_axis[j]), **common)
            return hinge(name, _floats(m.jnt_axis[j]), anchor=_floats(m.jnt_pos[j]), **common)
        start = place + (3 if kind == int(types.mjJNT_FREE) else 0)
        if common["stiffness"] and not np.allclose(m.qpos_spring[start : start + 4], (1, 0, 0, 0), atol=1e-12):
            self.left_out.append(f"the stiffness of the joint {name!r}, whose rest orientation is not the reference")
            common["stiffness"] = 0.0
        if kind == int(types.mjJNT_BALL):
            return ball(name, anchor=_floats(m.jnt_pos[j]), **common)
        rest = _floats(m.qpos_spring[place : place + 3]) if common["stiffness"] else (0.0, 0.0, 0.0)
        return free(name, rest=rest, **common)

    def _actuators(self) -> Iterator[Actuator]:
        m, kinds = self.m, self.kinds
        used = {*self.joints, *(f"{self.joints[j]}_rate" for j in self.with_axis)}
        names = self._names("actuator", int(m.nu))
        for i, name in enumerate([] if self._is_off("ACTUATION") else unused_names(names, used, "_input")):
            group = int(m.actuator_group[i])
            if 0 <= group <= 30 and int(m.opt.disableactuator) >> group & 1:
                continue
            why = self._why_not(i)
            if why:
                self.left_out.append(f"the actuator {names[i]!r}, {why}")
                continue
            j = int(m.actuator_trnid[i, 0])
            size = 3 if m.jnt_type[j] == int(kinds.mjtJoint.mjJNT_BALL) else 1
            bias = m.actuator_biasprm[i] * (m.actuator_biastype[i] == int(kinds.mjtBias.mjBIAS_AFFINE))
            if m.actuator_ctrllimited[i] or m.actuator_forcelimited[i]:
                self.left_out.append("limits of controls and forces")
            yield Actuator(
                name,
                self.joints[j],
                _floats(m.actuator_gear[i, :size]),
                gain=float(m.actuator_gainprm[i, 0]),
                offset=float(bias[0]),
                position_gain=-float(bias[1]),
                velocity_gain=-float(bias[2]),
            )

    def _why_not(self, i: int) -> str:
        m, kinds = self.m, self.kinds
        joint = int(m.actuator_trnid[i, 0])
        if m.actuator_trntype[i] not in (int(kinds.mjtTrn.mjTRN_JOINT), int(kinds.mjtTrn.mjTRN_JOINTINPARENT)):
            return "which does not act on a joint"
        of_ball = m.jnt_type[joint] == int(kinds.mjtJoint.mjJNT_BALL)
        affine = m.actuator_biastype[i] == int(kinds.mjtBias.mjBIAS_AFFINE)
        own_terms = [getattr(m, f"actuator_{what}", None) for what in ("damping", "dampingpoly", "armature", "delay")]
        in_parent = m.actuator_trntype[i] == int(kinds.mjtTrn.mjTRN_JOINTINPARENT)
        has_state = m.actuator_dyntype[i] != int(kinds.mjtDyn.mjDYN_NONE) or m.actuator_actnum[i]
        reasons = {
            "which acts on a free joint": m.jnt_type[joint] == int(kinds.mjtJoint.mjJNT_FREE),
            "which acts on a ball joint along its parent's axes": of_ball and in_parent,
            "which has its own state": has_state,
            "whose gain is not constant": m.actuator_gaintype[i] != int(kinds.mjtGain.mjGAIN_FIXED),
            "whose bias is not affine": not affine and m.actuator_biastype[i] != int(kinds.mjtBias.mjBIAS_NONE),
            "which feeds back the rotation of a ball joint": of_ball and affine and m.actuator_biasprm[i, 1],
            "which has its own damping, armature or delay": any(x is not None and np.any(x[i]) for x in own_terms),
        }
        return next((reason for reason, is_so in reasons.items() if is_so), "")

    def _read_equalities(self, used: set[str]) -> None:
        m, kinds = self.m, self.kinds.mjtEq
        for i in range(0 if self._is_off("EQUALITY", "CONSTRAINT") else m.neq):
            kind, data = m.eq_type[i], m.eq_data[i]
            # prefix of the names of sites that are added for it
            name = m.eq(i).name.replace(".", "_") or f"equality{i}"
            if not m.eq_active0[i]:
                continue
            first, second = int(m.eq_obj1id[i]), int(m.eq_obj2id[i])
            if kind == int(kinds.mjEQ_JOINT):
                self.loops.append(self._coupling(first, second, data))
                continue
            if kind not in (int(kinds.mjEQ_CONNECT), int(kinds.mjEQ_WELD)):
                self.left_out.append(f"the equality {name!r}, which is not a connect, weld or joint")
                continue
            rigid = kind == int(kinds.mjEQ_WELD)
            if m.eq_objtype[i] == int(self.kinds.mjtObj.mjOBJ_SITE):
                self.loops.append(Loop(self.sites[first].name, self.sites[second].name, rigid))
                continue
            # connect: anchors in both bodies; weld: the anchor in the second body, and its pose relative to the first
            ends = (data[3:6], data[0:3]) if rigid else (data[0:3], data[3:6])
            turned = (_euler(data[6:10]), None) if rigid else (None, None)
            names = []
            for k, (body, place, orientation) in enumerate(zip((first, second), ends, turned, strict=True)):
                end = unused_name(f"{name}_{k + 1}", used, "_end")
                used.add(end)
                names.append(end)
                self.sites.append(Site(end, self.carriers[body], _floats(place), orientation))
            self.loops.append(Loop(names[0], names[1], rigid))

    def _coupling(self, first: int, second: int, data: np.ndarray) -> Coupling:
        m = self.m

        def zero(j: int) -> float:
            return float(m.qpos0[m.jnt_qposadr[j]])

        if second < 0:
            return Coupling(self.joints[first], None, (zero(first) + float(data[0]),))
        # q1 - zero1 = p(q2 - zero2)
        polynomial = np.polynomial.Polynomial(data[:5])(np.polynomial.Polynomial([-zero(second), 1.0]))
        coefficients = polynomial.coef + np.eye(1, len(polynomial.coef))[0] * zero(first)
        return Coupling(self.joints[first], self.joints[second], _floats(coefficients))

    def _left_out_effects(self) -> Iterator[str]:
        m = self.m
        collides = np.any(m.geom_contype != 0) and np.any(m.geom_conaffinity != 0)

        def off(flag: str) -> bool:
            return self._is_off(flag, "CONSTRAINT")

        def has(name: str) -> bool:
            return bool(np.any(getattr(m, name, 0)))  # older versions do not have every attribute

        effects = {
            "contacts": (collides or m.npair > 0) and not off("CONTACT"),
            "limits of joints": np.sum(m.jnt_limited) > len(self.stops) and not off("LIMIT"),
            "friction of joints": np.count_nonzero(m.dof_frictionloss) > len(self.friction) and not off("FRICTIONLOSS"),
            "limits of controls and forces": has("jnt_actfrclimited") and m.nu > 0,
            "tendons": m.ntendon > 0,
            "nonlinear damping or stiffness": any(has(n) for n in ("dof_dampingpoly", "jnt_stiffnesspoly")),
            "plastic springs": getattr(m, "nplastic", 0) > 0,
            "drag and lift of a medium": m.opt.density > 0 or m.opt.viscosity > 0,
            "gravity compensation": has("body_gravcomp"),
            "flexible bodies": m.nflex > 0,
            "plugins": m.nplugin > 0,
            "motion of mocap bodies": m.nmocap > 0,
        }
        return (effect for effect, is_present in effects.items() if is_present)


_PLURALS = {"body": "bodies"}


def _floats(values: Sequence[float] | np.ndarray) -> tuple[float, ...]:
    return tuple(float(x) for x in values)


def _euler(quaternion: Sequence[float] | np.ndarray) -> tuple[float, ...]:
    """Euler parameters, scalar last; MuJoCo has the scalar first."""
    w, x, y, z = _floats(quaternion)
    return (x, y, z, w)


def _inertia(moments: Sequence[float] | np.ndarray, quaternion: Sequence[float] | np.ndarray) -> list[list[float]]:
    """Inertia along the body's axes, from principal moments in rotated axes. Entries within rounding of zero are
    zero."""
    R = np.array(rotations.euler_parameters_matrix(_euler(quaternion))).T
    I = R @ np.diag(np.asarray(moments, float)) @ R.T
    I = 0.5 * (I + I.T)
    I[np.abs(I) < 1e-15 * np.trace(I)] = 0.0
    return I.tolist()
