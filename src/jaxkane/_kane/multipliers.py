"""Constraint forces, by auxiliary speeds that the library adds. Depends on Kane's method, not on a mechanism.

An auxiliary speed is a virtual velocity of a point or a frame. Its value in the motion is zero. Its Kane equation
contains one more unknown, the force at this point (Kamman, Unit 5, Example 7, note on constraint forces; Kane and
Levinson, "Dynamics", section 4.9). Let R_r = F_r + F*_r at the accelerations of the motion, without elimination of the
dependent speeds. With the residuals c = C_ind u + C_dep u_dep + C_aux u_aux + c0:

    R_dep + C_dep^T lambda = 0                  multipliers of the residuals
    R_aux + C_aux^T lambda + Q = 0              the force (moment) Q that keeps the auxiliary speed at zero

Systems whose constraints have multipliers instead of dependent speeds.

Dependent speeds become singular where the named speeds do not determine them, although the mechanism is regular there:
for example a chain of links between two fixed points, whose last two links are in line. If all
speeds are independent and each velocity residual has a multiplier, the equations have a solution there too:

    M u_dot = f + C^T lambda,   c = C u + c0 = 0

A residual that depends linearly on the others is omitted where it does, so overconstrained loops can be simulated.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax.numpy as jnp
from jaxtyping import PyTree

from .._common.lookup import refuse_if
from .._scalarjit.cache_key import jit
from .._scalarjit.components import Component, Numbers, Triple, add, as_vector, dot, mul, solve, total
from .._scalarjit.scalar_function import ScalarFunction
from .._system.kinematics import Frame, Point, auxiliary_speed
from .._system.motion import Motion
from .._system.system import System, call_with_states
from .arguments import (
    Coordinates,
    InputArrays,
    InputValues,
    Row,
    Speeds,
    Time,
    as_row,
    check_is_system,
    has_multipliers,
)
from .description import DescriptionEvaluator, EvaluatedDescription, jvp
from .kanes_method import KaneEquations, motion_rates, unit

Partial = tuple[list, list]
"""Partial velocities of the bodies and of the loads along one direction of the speeds."""


@jit
def multipliers_now(system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays):
    """Multipliers of the velocity residuals (k,), at the accelerations of the motion."""
    return _multipliers(system, t, q, u, inputs, motion_rates(system, t, q, u, inputs)[1])


@jit
def forces_now(system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays):
    """Constraint forces by name, at the accelerations of the motion: numbers, or components in N (3,)."""
    return _forces(system, t, q, u, inputs, motion_rates(system, t, q, u, inputs)[1])


@ScalarFunction
def _multipliers(system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays, u_dot: Speeds):
    return as_vector(Reactions(system, t, q, u, inputs, u_dot).multipliers, q)


@ScalarFunction
def _forces(system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays, u_dot: Speeds):
    kane = Reactions(system, t, q, u, inputs, u_dot)
    vectors = {name: as_vector(row, q) for name, row in kane.forces_of_parts()}
    return vectors | {name: jnp.asarray(x, dtype=q.dtype) for name, x in kane.forces_of_auxiliary_speeds()}


class AuxiliarySpeeds(KaneEquations):
    """Kane's equations at a state, and derivatives along auxiliary speeds of points and frames."""

    def __init__(self, system: System, t: Component, q: Numbers, u: Numbers, inputs: InputValues = None):
        super().__init__(system, t, q, u, inputs)
        self.description: Motion = self.motion(self.t, self.q, self.u_all)

    def read(self, part: str, t: Component, q: Row, u: Row) -> PyTree:
        # Evaluate the system directly: the recorded trace contains neither auxiliary velocities nor auxiliary speeds.
        return getattr(EvaluatedDescription(self, t, q, u), part)()

    def auxiliary_residuals(self, part: Point | Frame, axis: int) -> Row:
        """C_aux: the derivatives of velocity residuals by an auxiliary velocity.

        For configuration constraints, the derivatives are by a displacement.
        """
        if not self.k:
            return ()
        still = (0.0,) * (self.n + self.k)
        rows = self.along_auxiliary(part, axis, lambda: self.read("velocity_residuals", self.t, self.q, still))
        if len(rows) < self.k:
            more = self.along_auxiliary(part, axis, lambda: self.configuration(self.t, self.q), displace=True)
            rows = (*rows, *more)
        return rows

    def along_auxiliary(self, part: Point | Frame, axis: int, read: Callable[[], Any], displace: bool = False) -> Any:
        """The derivative of `read()` along an auxiliary velocity (or displacement) of a point or a frame."""

        def displaced(row: Row) -> Any:
            along: Triple = tuple(row[0] if i == axis else 0.0 for i in range(3))  # type: ignore[assignment]
            with auxiliary_speed(part, **{"displacement" if displace else "velocity": along}):
                return read()

        return self.along_speeds(displaced, (1.0,))

    def is_cut(self, part: Point | Frame) -> bool:
        """Whether bodies are built from a point whose own velocity is not a constraint residual. True for frames."""
        if isinstance(part, Frame):
            return True
        if any(part.velocity is residual for residual in self.description.residuals):
            return False
        return any(part in body.center.chain() for body in self.description.bodies)


class Reactions(AuxiliarySpeeds):
    """Kane's equations at a state with accelerations `u_dot` (n,), and the multipliers of the velocity residuals.

    The accelerations are an argument, because a separate program computes them. With many speeds, it calls LAPACK.
    """

    def __init__(self, system: System, t: Component, q: Numbers, u: Numbers, inputs: InputValues, u_dot: Numbers):
        super().__init__(system, t, q, u, inputs)
        u_dot = as_row(u_dot, system.speeds, f"{self.name}: u_dot")
        u_dep_dot = self.dependent_accelerations(u_dot)
        self.momentum_derivatives = self.momentum_rates((*u_dot, *u_dep_dot))
        self.load_vectors = self.force_components()
        # R_dep + C_dep^T lambda = 0
        directions = [unit(self.n + self.k, self.n + r) for r in range(self.k)]
        R = [mul(-1.0, self.unbalanced(self.along_speeds(self.velocities, direction))) for direction in directions]
        self.multipliers: Row = solve(tuple(zip(*self.C_dep, strict=True)), R)[0] if self.k else ()

    def unbalanced(self, partial: Partial) -> Component:
        """R = sum F . V + T . W - V . dp/dt - W . dH/dt along one direction."""
        bodies, columns = partial
        active = [dot(V, F) for V, F in zip(columns, self.load_vectors, strict=True)]
        inertia = [
            mul(-1.0, add(dot(V, p_dot), dot(W, H_dot)))
            for (V, W), (p_dot, H_dot) in zip(bodies, self.momentum_derivatives, strict=True)
        ]
        return total([*active, *inertia])

    def power_of_prescribed_motions(self) -> Component:
        """Power [W] of prescribed motions and of moving constraints.

        sum V_t . dp/dt + W_t . dH/dt - F . V_t - T . W_t - lambda . c0

        V_t and W_t are the velocities that remain if all speeds are zero.
        """
        still = (0.0,) * (self.n + self.k)
        c0 = self.residuals(self.t, self.q, still)
        return mul(-1.0, add(self.unbalanced(self.velocities(still)), dot(c0, self.multipliers)))

    def forces_of_parts(self) -> Iterator[tuple[str, Row]]:
        """Forces at the named points, moments at the named frames."""
        for name, point in self.description.points.items():
            is_cut = self.is_cut(point)
            if is_cut or self.k:
                yield name, self._force(point, transmitted=is_cut)
        for name, frame in self.description.frames.items():
            if frame.parent is not None:
                yield name, self._force(frame, transmitted=True)

    def forces_of_auxiliary_speeds(self) -> Iterator[tuple[str, Component]]:
        names = self.system.auxiliary_speeds
        for i, name in enumerate(names):
            direction = unit(self.n + self.k + len(names), self.n + self.k + i)
            C_aux = self.along_speeds(lambda u: self.residuals(self.t, self.q, u), direction)
            # R_aux + C_aux^T lambda + Q = 0
            R = self.unbalanced(self.along_speeds(self.velocities, direction))
            yield name, mul(-1.0, add(R, dot(C_aux, self.multipliers)))

    def _force(self, part: Point | Frame, transmitted: bool) -> Row:
        """The force on a point or the moment on a frame, by three auxiliary speeds along N.x, N.y and N.z.

        If `transmitted`, this is the force that is transmitted to the bodies that are built from the part. Otherwise,
        it is the force of the constraint residuals that depend on the motion of the part.
        """
        still = (0.0,) * (self.n + self.k)
        Q = [dot(self.auxiliary_residuals(part, axis), self.multipliers) for axis in range(3)]
        if transmitted:
            partials = [self.along_auxiliary(part, axis, lambda: self.velocities(still)) for axis in range(3)]
            Q = [mul(-1.0, add(self.unbalanced(partial), x)) for partial, x in zip(partials, Q, strict=True)]
        return tuple(Q)


class _WithMultipliers(System):
    inner: System

    @property
    def speeds(self) -> tuple[str, ...]:  # type: ignore[override]
        return (*self.inner.speeds, *self.inner.dependent_speeds)

    def motion(self, t: Component, q: Numbers, u: Numbers):
        motion = self.inner.motion(t, q, u)
        return Motion(motion.bodies, points=motion.points, frames=motion.frames)

    def events(self, t: Component, q: Numbers, u: Numbers, x: Numbers = ()):
        return call_with_states(self.inner.events, t, q, u, x)

    def multiplier_residuals(self, t: Component, q: Row, u: Row) -> Row:
        evaluator, q, u = DescriptionEvaluator(self.inner), tuple(q), tuple(u)
        c = evaluator.read("velocity_residuals", t, q, u)
        if self.inner.dependent_speeds and len(c) >= len(self.inner.dependent_speeds):
            return c  # the configuration constraints, if any, are integrals of these residuals
        rates = evaluator.rates(t, q, u)
        return (*c, *jvp(lambda t, *q: evaluator.configuration(t, q), (t, *q), (1.0, *rates))[1])


def _of_inner(name: str) -> Callable[..., Any]:
    return lambda self, *args: getattr(self.inner, name)(*args)


for _name in ("q_dot", "loads", "state_rates", "configuration_constraints", "implied_constraints"):
    setattr(_WithMultipliers, _name, _of_inner(_name))
for _name in ("coordinates", "dependent_coordinates", "inputs", "states", "units", "check_inertia"):
    setattr(_WithMultipliers, _name, property(lambda self, name=_name: getattr(self.inner, name)))


def with_multipliers(system: System) -> System:
    """The same system with all speeds independent, and a multiplier for each velocity residual.

    Use it for motions in which the dependent speeds become singular (status "singular speeds"), and for loops with
    redundant constraints. Its equations are larger, so a simulation takes longer.

        system = jk.with_multipliers(chain)
        ride = jk.simulate(system, jk.assemble(system, q, u), ts, stabilize=10.0)

    **Arguments:**

    - `system`: the system, with at most 12 independent and dependent speeds and without auxiliary speeds. It may have
        more constraints than dependent speeds, or no dependent speeds at all.

    **Returns:** a system for `assemble`, `simulate` and `sweep`. Its parameters are those of `.inner`. `State.u` also
    contains the dependent speeds. The speeds of a simulation are projected onto the constraints.

    **Raises:** `ValueError` for a system with auxiliary speeds.
    """
    check_is_system(system)
    name = type(system).__name__
    if has_multipliers(system):
        return system
    refuse_if(system.auxiliary_speeds, f"with_multipliers({name}): auxiliary speeds are not supported. Remove them.")
    kind: Any = type(system)
    return _class_of(kind)(system)


@functools.lru_cache(maxsize=1000)
def _class_of(inner: type[System]) -> Any:
    """A subclass with the name of the inner class, which messages show."""
    own = [name for name in ("outputs", "contacts") if getattr(inner, name) is not getattr(System, name)]
    kind: Any = type(_WithMultipliers)
    members = {"__doc__": inner.__doc__, **{name: _of_inner(name) for name in own}}
    return kind(inner.__name__, (_WithMultipliers,), members)
