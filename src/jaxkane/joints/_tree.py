"""Motion, loads and constraints of a tree of links, from its structure. Knows kinematics and no dynamics."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from .._common.lookup import not_there
from .._scalarjit.components import (
    ZERO3,
    Component,
    Triple,
    add,
    component,
    dot,
    is_exact,
    is_zero,
    mul,
    scale3,
    sub,
    total,
)
from .._system.bodies import Body, Force
from .._system.kinematics import Frame, Point, inertial
from .._system.motion import Motion
from .._system.system import System
from ..rotations import Matrix
from ._joints import Placed, Shape

KINDS = "mass center inertia position anchor site gravity damping stiffness rest armature"
KINDS += " gain offset position_gain velocity_gain"
"""Kinds of parameters: the first part of their names."""


MOMENTS = ("xx", "yy", "zz", "xy", "xz", "yz")


class LinkShape(NamedTuple):
    name: str
    parent: str | None
    orientation: Matrix | None
    joints: tuple[Shape, ...]
    has_mass: bool


class SiteShape(NamedTuple):
    name: str
    link: str | None
    orientation: Matrix | None


class ActuatorShape(NamedTuple):
    name: str
    joint: str
    gear: tuple[float, ...]


class LoopShape(NamedTuple):
    first: str
    second: str
    rigid: bool
    kept: tuple[int, ...]  # of its residuals

    @property
    def size(self) -> int:
        return 6 if self.rigid else 3


class CouplingShape(NamedTuple):
    first: str
    second: str | None
    coefficients: tuple[float, ...]
    is_kept: bool


class Structure(NamedTuple):
    """All that is static in a mechanism."""

    name: str
    links: tuple[LinkShape, ...]  # parents before children
    sites: tuple[SiteShape, ...] = ()
    actuators: tuple[ActuatorShape, ...] = ()
    loops: tuple[LoopShape, ...] = ()
    couplings: tuple[CouplingShape, ...] = ()
    dependent_speeds: tuple[str, ...] = ()
    dependent_coordinates: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()

    @property
    def joints(self) -> tuple[Shape, ...]:
        return tuple(joint for link in self.links for joint in link.joints)


_OF_LINKS, _OF_JOINTS, _OF_ACTUATORS = (
    lambda structure: [link.name for link in structure.links],
    lambda structure: [joint.name for joint in structure.joints],
    lambda structure: [actuator.name for actuator in structure.actuators],
)
_PARTS_OF: dict[str, Callable[[Structure], Sequence[str]]] = {
    **dict.fromkeys(("mass", "center", "inertia", "position"), _OF_LINKS),
    **dict.fromkeys(("anchor", "damping", "stiffness", "rest", "armature"), _OF_JOINTS),
    **dict.fromkeys(("gain", "offset", "position_gain", "velocity_gain"), _OF_ACTUATORS),
    "site": lambda structure: [site.name for site in structure.sites],
    "gravity": lambda structure: ("x", "y", "z"),
}


class Named(dict[str, Any]):
    """Parameters by name. One that is zero in the structure is none, and is refused as such."""

    def __init__(self, of: str, structure: Structure):
        super().__init__()
        self.of, self.structure = of, structure

    def __missing__(self, name: str) -> Any:
        kind, *parts = self.of.split(".")
        if name not in (_PARTS_OF[kind](self.structure) if not parts else (*"xyz", *MOMENTS)):
            raise not_there(name, self, f"`{self.of}`")
        raise KeyError(
            f"{self.structure.name} has no parameter {self.of}.{name}: it was written as 0 where the mechanism was "
            "made, and is part of its structure, which cannot be changed. Give jax.numpy.zeros(()) there."
        )


def _flat(named: Named) -> tuple[list[tuple[Any, Any]], tuple[Any, ...]]:
    names = sorted(named)
    return [(jax.tree_util.DictKey(name), named[name]) for name in names], (named.of, named.structure, *names)


def _from_flat(static: tuple[Any, ...], values: Any) -> Named:
    of, structure, *names = static
    named = Named(of, structure)
    named.update(zip(names, values, strict=True))
    return named


jax.tree_util.register_pytree_with_keys(Named, _flat, _from_flat)


class Tree(System):
    """A system that reads what it is from its `structure`, and numbers from fields named by kind, as "mass.forearm"."""

    structure: ClassVar[Structure]

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
        resisted = add(mul(damp, dot(actuator.gear, u)), mul(stiff, mul(actuator.gear[0], q[0])))
        return total(map(component, (mul(gain, control), offset, mul(-1.0, resisted))))

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
                apart = (*apart, *_turned_apart(A, B))
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


class TreeMotion(Motion):
    """A motion that knows the frames and points at its joints and sites."""

    __slots__ = ("placed", "sites")

    placed: dict[str, Placed]
    sites: dict[str, tuple[Frame, Point]]


def _moved(P: Point, F: Frame, r: Triple) -> Point:
    return P if all(is_zero(x) for x in r) else P.fixed(F.vector(*r))


def _turned(F: Frame, orientation: Matrix | None, name: str) -> Frame:
    return F if orientation is None else Frame(f"{name}, placed", F, orientation, ZERO3)


def _turned_apart(A: Frame, B: Frame) -> Triple:
    """The axis by which B is turned from A, times twice the tangent of half the angle: zero in one orientation only."""
    x, y, z = (axis.components_in(A) for axis in (B.x, B.y, B.z))
    sines = sub(y[2], z[1]), sub(z[0], x[2]), sub(x[1], y[0])
    size = dot(x, x)  # of Euler parameters that `assemble` moves it is not yet 1
    cosines = total((math.sqrt(size) if is_exact(size) else jnp.sqrt(size), x[0], y[1], z[2]))
    if is_exact(cosines):
        return scale3(2.0 / cosines, sines) if cosines > _HALF_A_TURN else (1.0, 1.0, 1.0)
    # Half a turn away no direction is nearest: there the residuals say that it is far, and `assemble` starts beside.
    is_far = jnp.abs(cosines) < _HALF_A_TURN
    factor = 2.0 / jnp.where(is_far, 1.0, cosines)
    return tuple(jnp.where(is_far, 1.0, mul(factor, x)) for x in sines)  # type: ignore[return-value]


_HALF_A_TURN = 1e-6  # 1 + the sum of the direction cosines: within 0.06 degrees of it


def _polynomial(coefficients: tuple[float, ...], x: Component) -> tuple[Component, Component]:
    """Value and slope."""
    value: Component = 0.0
    slope: Component = 0.0
    for a in reversed(coefficients):
        slope = add(mul(slope, x), value)
        value = add(mul(value, x), a)
    return value, slope
