"""Mechanisms: motion, loads and constraints of links in a tree, one class for each structure of links."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from .._common.lookup import not_there, refuse_any, refuse_unknown
from .._kane.contact.declarations import Contact, DryFriction
from .._scalarjit.components import (
    ZERO3,
    Component,
    Scalar,
    Triple,
    add,
    add3,
    component,
    dot,
    is_exact,
    is_zero,
    mul,
    scale3,
    sub,
    total,
)
from .._system.kinematics import Frame, Point, inertial
from .._system.motion import Body, Force, GroupedResiduals, Motion, SomeComponents
from .._system.parameters import parameter, parameter_info
from .._system.system import NamedVector, System
from ..rotations import Matrix
from ..shapes import Shape
from ._joints import JointKinematics, JointType

Named = Mapping[str, Component] | NamedVector

MOMENTS = ("xx", "yy", "zz", "xy", "xz", "yz")


class LinkStructure(NamedTuple):
    name: str
    parent: str | None
    orientation: Matrix | None
    joints: tuple[JointType, ...]
    has_mass: bool
    shapes: tuple[Shape, ...] = ()  # from the link's origin


class SiteStructure(NamedTuple):
    name: str
    link: str | None
    orientation: Matrix | None


class ActuatorStructure(NamedTuple):
    name: str
    joint: str
    gear: tuple[float, ...]


class LoopStructure(NamedTuple):
    first: str
    second: str
    rigid: bool
    independent: tuple[int, ...]  # indices of its independent residuals
    dropped: tuple[int, ...] = ()  # residuals that nearly depend on the others, and are omitted

    @property
    def size(self) -> int:
        return 6 if self.rigid else 3


class CouplingStructure(NamedTuple):
    first: str
    second: str | None
    coefficients: tuple[float, ...]
    is_independent: bool


class Structure(NamedTuple):
    """The static data of a mechanism."""

    name: str
    links: tuple[LinkStructure, ...]  # parents before children
    sites: tuple[SiteStructure, ...] = ()
    actuators: tuple[ActuatorStructure, ...] = ()
    loops: tuple[LoopStructure, ...] = ()
    couplings: tuple[CouplingStructure, ...] = ()
    dependent_speeds: tuple[str, ...] = ()
    dependent_coordinates: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    poses: tuple[tuple[str, tuple[float, ...]], ...] = ()

    @property
    def joints(self) -> tuple[JointType, ...]:
        return tuple(joint for link in self.links for joint in link.joints)


_OWNERS = {
    **dict.fromkeys(("mass", "center", "inertia", "position"), "links"),
    **dict.fromkeys(("anchor", "damping", "stiffness", "rest", "armature", "lower", "upper", "friction"), "joints"),
    **dict.fromkeys(("gain", "offset", "position_gain", "velocity_gain"), "actuators"),
    "site": "sites",
}
"""The owners of parameters of each kind, the first part of their names. "gravity" belongs to the mechanism."""


class NamedParameters(dict[str, Any]):
    """Parameters by name. A structural zero is not a parameter; looking it up raises an exception."""

    def __init__(self, of: str, structure: Structure, values: Iterable[tuple[str, Any]] = ()):
        super().__init__(values)
        self.of, self.structure = of, structure

    def __missing__(self, name: str) -> Any:
        kind, *parts = self.of.split(".")
        owners = [x.name for x in getattr(self.structure, _OWNERS[kind])] if kind in _OWNERS else "xyz"
        if name not in ((*"xyz", *MOMENTS) if parts else owners):
            raise not_there(name, self, f"`{self.of}`")
        raise KeyError(
            f"{self.structure.name} has no parameter {self.of}.{name}: it was defined as the number 0, which is part "
            "of the structure and cannot be changed. Use jax.numpy.zeros(()) in the definition of the mechanism."
        )


def _flat(named: NamedParameters) -> tuple[list[tuple[Any, Any]], tuple[Any, ...]]:
    names = sorted(named)
    return [(jax.tree_util.DictKey(name), named[name]) for name in names], (named.of, named.structure, *names)


def _from_flat(static: tuple[Any, ...], values: Iterable[PyTree]) -> NamedParameters:
    of, structure, *names = static
    return NamedParameters(of, structure, zip(names, values, strict=True))


jax.tree_util.register_pytree_with_keys(NamedParameters, _flat, _from_flat)


class Mechanism(System):
    """A tree of links and joints, made by `jaxkane.joints.mechanism`, or from a file by `jaxkane.convert`.

    Parameters are read by kind and name, e.g. `arm.mass["forearm"]` or `arm.center["forearm"]["z"]`. Their names in a
    fit or in the columns of a sweep are "mass.forearm" and "center.forearm.z". `arm.replace({"mass.forearm": 1.3})` is
    a copy.
    """

    structure: ClassVar[Structure]
    left_out: ClassVar[tuple[str, ...]] = ()
    """Elements of the file that are not part of the mechanism."""

    @property
    def poses(self) -> dict[str, dict[str, float]]:
        """Coordinates by the name of a pose, e.g. of the key frames of a file, to start from: `jk.assemble(arm,
        arm.poses["stand"])`."""
        return {name: dict(zip(self.coordinates, q, strict=True)) for name, q in self.structure.poses}

    def __init__(self, **values: Any):
        for field in dataclasses.fields(self):  # names with a dot cannot be keyword arguments
            value = values.pop(field.name, dataclasses.MISSING)
            if value is dataclasses.MISSING:  # a parameter that a subclass of a mechanism's class adds
                factory = field.default_factory
                value = field.default if factory is dataclasses.MISSING else factory()
            if value is dataclasses.MISSING:
                raise TypeError(f"{type(self).__name__}: the parameter {field.name} is missing and has no default.")
            setattr(self, field.name, value)
        if values:
            raise TypeError(f"{type(self).__name__} has no parameter {', '.join(values)}.")

    def __reduce__(self) -> Any:
        if equipment := vars(type(self)).get("equipment"):
            kind, outputs, names = equipment
            own = {name: getattr(self, name) for name in names}
            rest = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name not in own}
            return Mechanism.with_outputs, (kind(**rest), outputs, own)
        if type(self) is not class_of(self.structure, _fields(type(self))):  # a class that inherits from it
            return super().__reduce__()
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return _restored, (self.structure, _fields(type(self)), values)

    def replace(self, values: Mapping[str, Any]) -> Mechanism:
        """A copy with other parameters, by name. **Raises:** `ValueError` for an unknown name."""
        names = [field.name for field in dataclasses.fields(self)]
        refuse_unknown(values, names, f"{type(self).__name__} has no parameter", "it has")
        return dataclasses.replace(self, **values)

    def with_outputs(self, outputs: Callable[..., Any], parameters: Mapping[str, Any] | None = None) -> Mechanism:
        """A copy with sensors: `outputs(self, t, q, u, motion, now)`, as the method of a `System`.

            def outputs(self, t, q, u, motion, now):
                frame, point = motion.sites["imu"]
                box = frame.rotate_fixed((self.tilt, 0.0, 0.0))
                return {"imu": jk.sensors.imu(now, point, box, -9.81 * motion.N.z)}

            arm = arm.with_outputs(outputs, {"tilt": 0.0})

        **Arguments:**

        - `outputs`: the function. `motion.sites` are pairs of the frame and the point of each site.
        - `parameters`: additional parameters by name, which the function reads as attributes of `self`.

        **Raises:** `ValueError` for a parameter that exists already, or whose name is not a Python identifier.
        """
        extra = dict(parameters or {})
        twice = [name for name in extra if hasattr(self, name) or not name.isidentifier()]
        after = " cannot be the name of an additional parameter. Use a new identifier."
        refuse_any(twice, f"{type(self).__name__}:", after)
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        kind: Any = type(self)
        return _equipped(kind, outputs, tuple(extra))(**values, **extra)

    def q_dot(self, t: Component, q: Named, u: Named):
        return [rate for joint in self.structure.joints for rate in joint.rates(*_own(joint, q, u))]

    def _tree(self, q: Named, u: Named) -> tuple[dict[str | None, tuple[Frame, Point]], dict[str, JointKinematics]]:
        """The frame and the origin of each link (None: the ground), and the kinematics of the joints."""
        carried: dict[str | None, tuple[Frame, Point]] = {None: inertial()}
        joints: dict[str, JointKinematics] = {}
        for link in self.structure.links:
            F, P = carried[link.parent]
            P = _moved(P, F, _triple(self, f"position.{link.name}"))
            F = _turned(F, link.orientation, link.name)
            for joint in link.joints:
                at = joint.kinematics(F, P, *_own(joint, q, u), _triple(self, f"anchor.{joint.name}"))
                joints[joint.name] = at
                F, P = at.child_frame, at.child_point
            carried[link.name] = F, P
        return carried, joints

    def sites_at(
        self, q: Named, u: Named, carried: dict[str | None, tuple[Frame, Point]] | None = None
    ) -> dict[str, tuple[Frame, Point]]:
        """The frames and points of the sites. `carried`: those of the links, if known."""
        carried, sites = self._tree(q, u)[0] if carried is None else carried, {}
        for site in self.structure.sites:
            F, P = carried[site.link]
            point = P.fixed(F.vector(*_triple(self, f"site.{site.name}")))
            sites[site.name] = _turned(F, site.orientation, site.name), point
        return sites

    def motion(self, t: Component, q: Named, u: Named):
        carried, joints = self._tree(q, u)
        N, bodies, points = carried[None][0], [], {}
        for link in self.structure.links:
            F, P = carried[link.name]
            if link.has_mass:
                center = _triple(self, f"center.{link.name}")
                m, I, G = _read(self, f"mass.{link.name}"), _inertia(self, link.name), _moved(P, F, center)
                shapes = [s._replace(center=add3(s.center, scale3(-1.0, center))) for s in link.shapes]
                bodies.append(Body(m, I, G, F, name=link.name, shape=shapes))
            else:
                points[link.name] = P.fixed(F.vector(0.0, 0.0, 0.0))
                if link.shapes:  # the point keeps the name
                    bodies.append(Body(0.0, 0.0, P, F, name=f"{link.name} shape", shape=link.shapes))
        for joint in self.structure.joints:
            armature = _read(self, f"armature.{joint.name}")
            if not is_zero(armature):
                bodies += joint.rotors(N, joints[joint.name].child_point, armature, _own(joint, q, u)[1])
        sites = self.sites_at(q, u, carried)
        points |= {name: point for name, (_, point) in sites.items()}
        frames = {
            at.child_frame.name: at.child_frame for at in joints.values() if at.child_frame is not at.parent_frame
        }
        motion = MechanismMotion(bodies, loop_residuals(self, sites, q, u)[1], points=points, frames=frames)
        motion.joints, motion.sites = joints, sites
        return motion

    def loads(self, t: Component, q: Named, u: Named, motion: MechanismMotion, inputs: Mapping[str, Component]):
        gravity = motion.N.vector(*_triple(self, "gravity"))
        falls = not all(is_zero(x) for x in gravity.components)
        weighed = [body for body in motion.bodies if falls and not is_zero(body.mass)]  # rotors have no weight
        loads: list[Any] = [Force(body.mass * gravity, body.center) for body in weighed]
        for joint in self.structure.joints:
            forces = _forces(self, joint, *_own(joint, q, u), inputs)
            if not all(is_zero(x) for x in forces):
                loads += joint.loads(motion.joints[joint.name], forces)
        return loads

    def configuration_constraints(self, t: Component, q: Named):

        own = [[q[name] for name in joint.names(joint.coordinates)] for joint in self.structure.joints]
        norms = [x for joint, values in zip(self.structure.joints, own, strict=True) for x in joint.norm(values)]
        if not (self.structure.loops or self.structure.couplings):
            return norms
        loops = self._loops_at_rest(t, q, independent=True)
        return GroupedResiduals([*loops.groups, *(SomeComponents((x,), (x,)) for x in norms)])

    def implied_constraints(self, t: Component, q: Named):
        structure = self.structure
        all_independent = all(len(loop.independent) + len(loop.dropped) == loop.size for loop in structure.loops)
        if all_independent and all(coupling.is_independent for coupling in structure.couplings):
            return []
        return self._loops_at_rest(t, q, independent=False)

    def stops(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion) -> dict[str, Contact | DryFriction]:
        """The limits and the dry friction of the joints: the `contacts` of a mechanism that has these."""
        contacts: dict[str, Contact | DryFriction] = {}
        for joint in self.structure.joints:
            for end, sign, has in zip(("lower", "upper"), (1.0, -1.0), joint.has_stops, strict=True):
                if has:
                    gap = mul(sign, sub(q[joint.name], _read(self, f"{end}.{joint.name}")))
                    contacts[f"{joint.name} {end}"] = Contact(gap=gap)
            if joint.has_friction:
                friction = _read(self, f"friction.{joint.name}")
                contacts[f"{joint.name} friction"] = DryFriction(u[f"{joint.name}_rate"], friction)
        return contacts

    def _loops_at_rest(self, t: Component, q: Named, independent: bool) -> GroupedResiduals:
        rest = dict.fromkeys((*self.speeds, *self.dependent_speeds), 0.0)
        return loop_residuals(self, self.sites_at(q, rest), q, rest, independent)[0]


# Functions and not methods: equinox makes an object of a method at each access, in a time that grows with the number of
# parameters. For 200 links, 10 000 accesses took a sixth of the time of the first accelerations.


def _read(mechanism: Mechanism, name: str) -> Component:
    return getattr(mechanism, name, 0.0)


def _triple(mechanism: Mechanism, name: str) -> Triple:
    return _read(mechanism, f"{name}.x"), _read(mechanism, f"{name}.y"), _read(mechanism, f"{name}.z")


def _own(joint: JointType, q: Named, u: Named) -> tuple[list[Component], list[Component]]:
    return [q[name] for name in joint.names(joint.coordinates)], [u[name] for name in joint.names(joint.speeds)]


def _forces(
    mechanism: Mechanism, joint: JointType, q: list[Component], u: list[Component], inputs: Mapping[str, Component]
) -> list[Component]:
    """Forces along the joint's speeds [N or N m], by its spring, damper and actuators."""
    damping, stiffness = _read(mechanism, f"damping.{joint.name}"), _read(mechanism, f"stiffness.{joint.name}")
    forces = [mul(-1.0, mul(damping, w)) for w in u]
    if not is_zero(stiffness):
        rest = _triple(mechanism, f"rest.{joint.name}") if len(u) == 6 else (_read(mechanism, f"rest.{joint.name}"),)
        forces = [sub(f, mul(stiffness, x)) for f, x in zip(forces, joint.displacement(q, rest), strict=True)]
    for actuator in mechanism.structure.actuators:
        if actuator.joint == joint.name:
            drive = _drive(mechanism, actuator, q, u, inputs[actuator.name])
            forces = [add(f, mul(g, drive)) for f, g in zip(forces, actuator.gear, strict=True)]
    return forces


def _drive(
    mechanism: Mechanism, actuator: ActuatorStructure, q: list[Component], u: list[Component], control: Component
) -> Component:
    gain, offset, stiff, damp = (
        _read(mechanism, f"{kind}.{actuator.name}") for kind in ("gain", "offset", "position_gain", "velocity_gain")
    )
    resisted = add(mul(damp, dot(actuator.gear, u)), mul(stiff, mul(actuator.gear[0], q[0])))
    return total(map(component, (mul(gain, control), offset, mul(-1.0, resisted))))


def _inertia(mechanism: Mechanism, link: str) -> Matrix:
    xx, yy, zz, xy, xz, yz = (_read(mechanism, f"inertia.{link}.{ij}") for ij in MOMENTS)
    return ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))


class MechanismMotion(Motion):
    """A motion with the kinematics of the joints by name, and the frames and points of the sites."""

    __slots__ = ("joints", "sites")

    joints: dict[str, JointKinematics]
    sites: dict[str, tuple[Frame, Point]]


def _view(kind: str) -> property:
    def read(self: Mechanism) -> NamedParameters:
        view = NamedParameters(kind, self.structure)
        for field in dataclasses.fields(self):
            first, *parents, last = field.name.split(".")
            if first == kind:
                inside = view
                for i, parent in enumerate(parents):
                    inside = inside.setdefault(
                        parent, NamedParameters(".".join((kind, *parents[: i + 1])), self.structure)
                    )
                inside[last] = getattr(self, field.name)
        return view

    return property(read, doc=f"The parameters `{kind}.NAME`, by name.")


for _kind in (*_OWNERS, "gravity"):
    setattr(Mechanism, _kind, _view(_kind))


def loop_residuals(
    mechanism: Mechanism,
    sites: dict[str, tuple[Frame, Point]],
    q: Mapping[str, Component] | NamedVector,
    u: Mapping[str, Component] | NamedVector,
    independent: bool = True,
) -> tuple[GroupedResiduals, list[Any]]:
    """Configuration and velocity residuals of the loops: the independent ones, or the others.

    A component of a loop's vector is compared with the size of this vector, a component of a rotation with 1.
    """
    h: list[SomeComponents] = []
    c: list[Any] = []
    for loop in mechanism.structure.loops:
        (A, P), (B, Q) = sites[loop.first], sites[loop.second]
        apart = Q.position_from(P).components_in(A)
        parting = (Q.velocity - P.velocity).components_in(A)
        turned: tuple[Component, ...] = ()
        if loop.rigid:
            turned = _turned_apart(A, B)
            parting = (*parting, *(B.angular_velocity - A.angular_velocity).components_in(A))
        used = [i for i in range(loop.size) if i not in loop.dropped]
        rows = [i for i in used if (i in loop.independent) == independent]
        h.append(SomeComponents(tuple(apart[i] for i in rows if i < 3), apart))
        h.append(SomeComponents(tuple(turned[i - 3] for i in rows if i >= 3), (1.0,)))
        c += [parting[i] for i in rows]
    for coupling in mechanism.structure.couplings:
        if coupling.is_independent == independent:
            value, slope = polynomial(coupling.coefficients, q[coupling.second] if coupling.second else 0.0)
            h.append(SomeComponents((q[coupling.first] - value,), (q[coupling.first] - value,)))
            rate = mul(slope, u[f"{coupling.second}_rate"]) if coupling.second else 0.0
            c.append(sub(u[f"{coupling.first}_rate"], rate))
    return GroupedResiduals(h), c


def _moved(P: Point, F: Frame, r: Triple) -> Point:
    return P if all(is_zero(x) for x in r) else P.fixed(F.vector(*r))


def _turned(F: Frame, orientation: Matrix | None, name: str) -> Frame:
    return F if orientation is None else Frame(f"{name}, placed", F, orientation, ZERO3)


def _turned_apart(A: Frame, B: Frame) -> Triple:
    """The axis of the rotation from A to B, times twice the tangent of half the angle. It is zero only if the
    orientations are equal."""
    x, y, z = (axis.components_in(A) for axis in (B.x, B.y, B.z))
    sines = sub(y[2], z[1]), sub(z[0], x[2]), sub(x[1], y[0])
    size = dot(x, x)  # Euler parameters that `assemble` changes do not have norm 1 yet
    cosines = total((math.sqrt(size) if is_exact(size) else jnp.sqrt(size), x[0], y[1], z[2]))
    if is_exact(cosines):
        return scale3(2.0 / cosines, sines) if cosines > _HALF_A_TURN else (1.0, 1.0, 1.0)
    # At half a turn no direction is nearest. The residuals are then large, and `assemble` starts from a perturbed
    # guess.
    is_far = jnp.abs(cosines) < _HALF_A_TURN
    factor = 2.0 / jnp.where(is_far, 1.0, cosines)
    return tuple(jnp.where(is_far, 1.0, mul(factor, x)) for x in sines)  # type: ignore[return-value]


_HALF_A_TURN = 1e-6  # 1 + the sum of the direction cosines: within 0.06 degrees of half a turn


def polynomial(coefficients: tuple[float, ...], x: Component) -> tuple[Component, Component]:
    """Value and derivative."""
    value: Component = 0.0
    slope: Component = 0.0
    for a in reversed(coefficients):
        slope = add(mul(slope, x), value)
        value = add(mul(value, x), a)
    return value, slope


Field = tuple[str, bool, str]
"""The name of a parameter, whether it must be positive, and its unit."""


@functools.lru_cache(maxsize=1000)
def class_of(structure: Structure, fields: tuple[Field, ...]) -> type[Mechanism]:
    """The class of a structure. It is always the same object, because compiled programs are cached by class."""
    joints = structure.joints
    coordinates = [pair for joint in joints for pair in zip(joint.names(joint.coordinates), joint.coordinates)]
    speeds = [pair for joint in joints for pair in zip(joint.names(joint.speeds), joint.speeds)]
    units = {name: unit for name, (_, unit) in (*coordinates, *speeds) if unit}
    of_parameters = {name: parameter(positive=positive, unit=unit) for name, positive, unit in fields}
    members: dict[str, Any] = {
        "__module__": __name__,
        "__doc__": f"A mechanism of {len(structure.links)} links and {len(joints)} joints.",
        "__annotations__": dict.fromkeys(of_parameters, Scalar),
        "__init__": Mechanism.__init__,
        "structure": structure,
        "left_out": structure.left_out,
        "coordinates": tuple(name for name, _ in coordinates),
        "speeds": tuple(name for name, _ in speeds if name not in structure.dependent_speeds),
        "dependent_speeds": structure.dependent_speeds,
        "dependent_coordinates": structure.dependent_coordinates,
        "inputs": tuple(actuator.name for actuator in structure.actuators),
        "units": units,
        "is_tree_of_joints": not (structure.loops or structure.couplings),  # see `check_description`
    }
    if any(any(joint.has_stops) or joint.has_friction for joint in joints):
        members["contacts"] = Mechanism.stops  # without it, a mechanism is simulated without contact states
    cls: Any = type(Mechanism)(structure.name, (Mechanism,), members | of_parameters)  # pyright: ignore
    return cls


@functools.lru_cache(maxsize=1000)
def _equipped(kind: type[Mechanism], outputs: Callable[..., Any], names: tuple[str, ...]) -> type[Mechanism]:
    members: dict[str, Any] = {
        "__module__": __name__,
        "__doc__": kind.__doc__,
        "__annotations__": dict.fromkeys(names, Scalar),
        "__init__": Mechanism.__init__,
        "outputs": outputs,
        "equipment": (kind, outputs, names),
        **{name: parameter() for name in names},
    }
    return type(Mechanism)(kind.__name__, (kind,), members)  # pyright: ignore


def _restored(structure: Structure, fields: tuple[Field, ...], values: dict[str, Any]) -> Mechanism:
    return class_of(structure, fields)(**values)


def _fields(cls: type[Mechanism]) -> tuple[Field, ...]:
    return tuple((name, info.positive, info.unit) for name, info in parameter_info(cls).items())
