"""The system of a tree of links. Reads its structure; knows kinematics and no dynamics.

For every structure there is one class, whose fields are the parameters that the structure has: `mass.forearm` is a
field like any other, so that sweeps, fits and tables know it by this name. Programs are kept by class.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

from .._common.lookup import hint
from .._description.bodies import Body, Force, Motion
from .._description.frames import Frame
from .._description.parameters import parameter, parameter_info
from .._description.points import Point, inertial
from .._description.system import System
from .._scalars.components import ZERO3, add, dot, is_zero, mul, sub
from .._scalars.types import Component, Scalar, Triple
from ..rotations import Matrix
from ._joints import Placed, Shape, total
from ._structure import KINDS, MOMENTS, ActuatorShape, Named, Structure


class Mechanism(System):
    """A tree of links and joints; made by `jaxkane.joints.mechanism`, or from a file by `jaxkane.convert`.

    Parameters are read by kind and name, as `arm.mass["forearm"]` or `arm.center["forearm"]["z"]`, and named so in a
    fit or the columns of a sweep: "mass.forearm", "center.forearm.z". `arm.replace({"mass.forearm": 1.3})` is a copy.
    """

    structure: ClassVar[Structure]
    left_out: ClassVar[tuple[str, ...]] = ()
    """What a file said and the mechanism does not have."""

    def __init__(self, **values: Any):
        for field in dataclasses.fields(self):  # names with a dot cannot be those of arguments
            setattr(self, field.name, values.pop(field.name) if field.name in values else _default(self, field))
        if values:
            raise TypeError(f"{type(self).__name__} has no parameter {', '.join(values)}.")

    def __reduce__(self) -> Any:
        if type(self) is not class_of(self.structure, _fields(type(self))):  # one that inherits from it
            return super().__reduce__()
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return _restored, (self.structure, _fields(type(self)), values)

    def replace(self, values: Mapping[str, Any]) -> Mechanism:
        """A copy with other parameters, by name. **Raises:** `ValueError` for a name that is none."""
        names = [field.name for field in dataclasses.fields(self)]
        wrong = [name for name in values if name not in names]
        if wrong:
            raise ValueError(f"{type(self).__name__} has no parameter {wrong[0]!r}; {hint(wrong, names, 'it has')}")
        return dataclasses.replace(self, **values)

    def with_outputs(self, outputs: Callable[..., Any], parameters: Mapping[str, Any] | None = None) -> Mechanism:
        """A copy that carries sensors: `outputs(self, t, q, u, motion, now)`, as that of a `System`.

            def outputs(self, t, q, u, motion, now):
                frame, point = motion.sites["imu"]
                box = frame.rotate_fixed((self.tilt, 0.0, 0.0))
                return {"imu": jk.sensors.imu(now, point, box, -9.81 * motion.N.z)}

            arm = arm.with_outputs(outputs, {"tilt": 0.0})

        **Arguments:** `parameters`: numbers by name that it reads of itself, parameters as all others. `motion.sites`
        are pairs of the frame and the point of every site.

        **Raises:** `ValueError` for a parameter that it has already, or that is no name of Python.
        """
        given = dict(parameters or {})
        twice = [name for name in given if hasattr(self, name) or not name.isidentifier()]
        if twice:
            raise ValueError(f"{type(self).__name__}: {twice[0]!r} cannot be the name of another parameter.")
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        kind: Any = type(self)
        return _equipped(kind, outputs, tuple(given))(**values, **given)

    def _read(self, name: str) -> Component:
        return getattr(self, name, 0.0)

    def _triple(self, name: str) -> Triple:
        return self._read(f"{name}.x"), self._read(f"{name}.y"), self._read(f"{name}.z")

    def _of(self, joint: Shape, q: Any, u: Any) -> tuple[list[Component], list[Component]]:
        """The joint's own coordinates and speeds."""
        return [q[name] for name in joint.names(joint.coordinates)], [u[name] for name in joint.names(joint.speeds)]

    def q_dot(self, t, q, u):
        return [rate for joint in self.structure.joints for rate in joint.rates(*self._of(joint, q, u))]

    def motion(self, t, q, u):
        N, O = inertial()
        carried: dict[str | None, tuple[Frame, Point]] = {None: (N, O)}
        bodies, points, placed = [], {}, {}
        for link in self.structure.links:
            F, P = carried[link.parent]
            P = _moved(P, F, self._triple(f"position.{link.name}"))
            F = _turned(F, link.orientation, link.name)
            for joint in link.joints:
                at = placed[joint.name] = joint.move(F, P, *self._of(joint, q, u), self._triple(f"anchor.{joint.name}"))
                F, P = at.moved, at.end
            carried[link.name] = F, P
            if link.has_mass:
                G = _moved(P, F, self._triple(f"center.{link.name}"))
                bodies.append(Body(self._read(f"mass.{link.name}"), self._inertia(link.name), G, F, name=link.name))
            else:
                points[link.name] = P.fixed(F.vector(0.0, 0.0, 0.0))
        for joint in self.structure.joints:
            armature = self._read(f"armature.{joint.name}")
            if not is_zero(armature):
                bodies += joint.rotors(N, placed[joint.name].end, armature, self._of(joint, q, u)[1])
        sites = {}
        for site in self.structure.sites:
            F, P = carried[site.link]
            points[site.name] = P.fixed(F.vector(*self._triple(f"site.{site.name}")))
            sites[site.name] = _turned(F, site.orientation, site.name), points[site.name]
        frames = {at.moved.name: at.moved for at in placed.values() if at.moved is not at.frame}
        motion = TreeMotion(bodies, self._closed(sites, q, u)[1], points=points, frames=frames)
        motion.placed, motion.sites = placed, sites
        return motion

    def loads(self, t, q, u, motion: Any, inputs):
        gravity = motion.N.vector(*self._triple("gravity"))
        falls = not all(is_zero(x) for x in gravity.components)
        weighed = [body for body in motion.bodies if falls and not is_zero(body.mass)]  # rotors have none
        loads: list[Any] = [Force(body.mass * gravity, body.center) for body in weighed]
        for joint in self.structure.joints:
            forces = self._forces(joint, *self._of(joint, q, u), inputs)
            if not all(is_zero(x) for x in forces):
                loads += joint.loads(motion.placed[joint.name], forces)
        return loads

    def configuration_constraints(self, t, q):
        own = lambda joint: [q[name] for name in joint.names(joint.coordinates)]  # noqa: E731
        norms = [x for joint in self.structure.joints for x in joint.norm(own(joint))]
        if not (self.structure.loops or self.structure.couplings):
            return norms
        return [*self._apart(t, q, left_out=False), *norms]

    def implied_constraints(self, t, q):
        structure = self.structure
        all_kept = all(len(loop.kept) == loop.size for loop in structure.loops)
        if all_kept and all(coupling.is_kept for coupling in structure.couplings):
            return []
        return self._apart(t, q, left_out=True)

    def _apart(self, t: Any, q: Any, left_out: bool) -> list[Any]:
        """How far what closes the loops is from closing them: the residuals that count, or those that follow."""
        still = dict.fromkeys((*self.speeds, *self.dependent_speeds), 0.0)
        return self._closed(self.motion(t, q, tuple(still.values())).sites, q, still, left_out)[0]

    def _forces(self, joint: Shape, q: list[Component], u: list[Component], inputs: Any) -> list[Component]:
        """Forces along the joint's speeds [N or N m]: of its spring, damper and actuators."""
        damping, stiffness = self._read(f"damping.{joint.name}"), self._read(f"stiffness.{joint.name}")
        forces = [mul(-1.0, mul(damping, w)) for w in u]
        if not is_zero(stiffness):
            rest = self._triple(f"rest.{joint.name}") if len(u) == 6 else (self._read(f"rest.{joint.name}"),)
            forces = [sub(f, mul(stiffness, x)) for f, x in zip(forces, joint.stretch(q, rest), strict=True)]
        for actuator in self.structure.actuators:
            if actuator.joint == joint.name:
                drive = self._drive(actuator, q, u, inputs[actuator.name])
                forces = [add(f, mul(g, drive)) for f, g in zip(forces, actuator.gear, strict=True)]
        return forces

    def _drive(self, actuator: ActuatorShape, q: list[Component], u: list[Component], control: Component) -> Component:
        gain, offset, stiff, damp = (
            self._read(f"{kind}.{actuator.name}") for kind in ("gain", "offset", "position_gain", "velocity_gain")
        )
        terms = [mul(gain, control), offset, mul(-1.0, mul(damp, dot(actuator.gear, u)))]
        return total([*terms, mul(-1.0, mul(stiff, mul(actuator.gear[0], q[0])))])

    def _inertia(self, link: str) -> Matrix:
        xx, yy, zz, xy, xz, yz = (self._read(f"inertia.{link}.{ij}") for ij in MOMENTS)
        return ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))

    def _closed(
        self, sites: dict[str, tuple[Frame, Point]], q: Any, u: Any, left_out: bool = False
    ) -> tuple[list[Any], list[Any]]:
        """What closes the loops: residuals of the configuration, and of the velocities; or those that are left out,
        since they follow."""
        h: list[Any] = []
        c: list[Any] = []
        for loop in self.structure.loops:
            (A, P), (B, Q) = sites[loop.first], sites[loop.second]
            apart = Q.position_from(P).components_in(A)
            parting = (Q.velocity - P.velocity).components_in(A)
            if loop.rigid:
                x, y, z = (axis.components_in(A) for axis in (B.x, B.y, B.z))
                apart = (*apart, z[1], x[2], y[0])  # cosines between axes that are across
                parting = (*parting, *(B.angular_velocity - A.angular_velocity).components_in(A))
            rows = [i for i in range(loop.size) if (i in loop.kept) != left_out]
            h += [apart[i] for i in rows]
            c += [parting[i] for i in rows]
        for coupling in self.structure.couplings:
            if coupling.is_kept != left_out:
                value, slope = _polynomial(coupling.coefficients, q[coupling.second] if coupling.second else 0.0)
                h.append(q[coupling.first] - value)
                rate = mul(slope, u[f"{coupling.second}_rate"]) if coupling.second else 0.0
                c.append(sub(u[f"{coupling.first}_rate"], rate))
        return h, c


def _default(mechanism: Mechanism, field: dataclasses.Field[Any]) -> Any:
    """Of a parameter that a class which inherits from a mechanism's has besides."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    if field.default is not dataclasses.MISSING:
        return field.default
    raise TypeError(f"{type(mechanism).__name__}: the parameter {field.name} is missing, which has no default.")


class TreeMotion(Motion):
    """A motion that knows the frames and points at its joints and sites."""

    __slots__ = ("placed", "sites")

    placed: dict[str, Placed]
    sites: dict[str, tuple[Frame, Point]]


def _moved(P: Point, F: Frame, r: Triple) -> Point:
    return P if all(is_zero(x) for x in r) else P.fixed(F.vector(*r))


def _turned(F: Frame, orientation: Matrix | None, name: str) -> Frame:
    return F if orientation is None else Frame(f"{name}, placed", F, orientation, ZERO3)


def _polynomial(coefficients: tuple[float, ...], x: Component) -> tuple[Component, Component]:
    """Value and slope."""
    value: Component = 0.0
    slope: Component = 0.0
    for a in reversed(coefficients):
        slope = add(mul(slope, x), value)
        value = add(mul(value, x), a)
    return value, slope


def _view(kind: str) -> property:
    def read(self: Mechanism) -> Named:
        found = Named(kind, self.structure)
        for field in dataclasses.fields(self):
            first, *parents, last = field.name.split(".")
            if first == kind:
                inside = found
                for i, parent in enumerate(parents):
                    inside = inside.setdefault(parent, Named(".".join((kind, *parents[: i + 1])), self.structure))
                inside[last] = getattr(self, field.name)
        return found

    return property(read, doc=f"The parameters `{kind}.NAME`, by name.")


for _kind in KINDS.split():
    setattr(Mechanism, _kind, _view(_kind))

Field = tuple[str, bool, str]
"""Of a parameter: its name, whether it must be positive, its unit."""


@functools.lru_cache(maxsize=1000)
def class_of(structure: Structure, fields: tuple[Field, ...]) -> type[Mechanism]:
    """The class of a structure: the same one each time, since programs are kept by class."""
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
    }
    made: Any = type(Mechanism)(structure.name, (Mechanism,), members | of_parameters)  # pyright: ignore
    return made


@functools.lru_cache(maxsize=1000)
def _equipped(kind: type[Mechanism], outputs: Callable[..., Any], names: tuple[str, ...]) -> type[Mechanism]:
    """A class of mechanisms with outputs, and parameters that these read."""
    members: dict[str, Any] = {
        "__module__": __name__,
        "__doc__": kind.__doc__,
        "__annotations__": dict.fromkeys(names, Scalar),
        "__init__": Mechanism.__init__,
        "__reduce__": _reduced_with_outputs,
        "outputs": outputs,
        "equipment": (kind, outputs, names),
        **{name: parameter() for name in names},
    }
    return type(Mechanism)(kind.__name__, (kind,), members)  # pyright: ignore


def _reduced_with_outputs(self: Any) -> Any:
    kind, outputs, names = type(self).equipment
    own = {name: getattr(self, name) for name in names}
    rest = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name not in own}
    return _restored_with_outputs, (kind(**rest), outputs, own)


def _restored_with_outputs(mechanism: Mechanism, outputs: Callable[..., Any], own: dict[str, Any]) -> Mechanism:
    return mechanism.with_outputs(outputs, own)


def _restored(structure: Structure, fields: tuple[Field, ...], values: dict[str, Any]) -> Mechanism:
    return class_of(structure, fields)(**values)


def _fields(cls: type[Mechanism]) -> tuple[Field, ...]:
    return tuple((name, info.positive, info.unit) for name, info in parameter_info(cls).items())
