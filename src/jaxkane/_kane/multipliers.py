"""Systems whose constraints have multipliers instead of dependent speeds.

Dependent speeds become singular where the named speeds do not determine them, although the mechanism is regular there:
for example a chain of links between two fixed points, whose last two links are in line. If all
speeds are independent and each velocity residual has a multiplier, the equations have a solution there too:

    M u_dot = f + C^T lambda,   c = C u + c0 = 0

A residual that depends linearly on the others is omitted where it does, so overconstrained loops can be simulated.
"""

from __future__ import annotations

import functools
from typing import Any

from .._system.motion import Motion
from .._system.system import System, call_with_states, has_outputs
from .arguments import Row, check_is_system
from .contact import has_contacts, has_multipliers
from .description import DescriptionEvaluator, jvp


class _WithMultipliers(System):
    """A system with multipliers for all velocity residuals."""

    inner: System

    @property
    def speeds(self) -> tuple[str, ...]:  # type: ignore[override]
        return (*self.inner.speeds, *self.inner.dependent_speeds)

    def q_dot(self, t, q, u):
        return self.inner.q_dot(t, q, u)

    def motion(self, t, q, u):
        motion = self.inner.motion(t, q, u)
        return Motion(motion.bodies, points=motion.points, frames=motion.frames)

    def loads(self, t, q, u, motion, inputs):
        return self.inner.loads(t, q, u, motion, inputs)

    def state_rates(self, t, q, u, x, motion, now):
        return self.inner.state_rates(t, q, u, x, motion, now)

    def configuration_constraints(self, t, q):
        return self.inner.configuration_constraints(t, q)

    def implied_constraints(self, t, q):
        return self.inner.implied_constraints(t, q)

    def events(self, t, q, u, x=()):
        return call_with_states(self.inner.events, t, q, u, x)

    def multiplier_residuals(self, t: Any, q: Row, u: Row) -> Row:
        evaluator, q, u = DescriptionEvaluator(self.inner), tuple(q), tuple(u)
        c = evaluator.read("velocity_residuals", t, q, u)
        if self.inner.dependent_speeds and len(c) >= len(self.inner.dependent_speeds):
            return c  # the configuration constraints, if any, are integrals of these residuals
        rates = evaluator.rates(t, q, u)
        return (*c, *jvp(lambda t, *q: evaluator.configuration(t, q), (t, *q), (1.0, *rates))[1])


for _name in ("coordinates", "dependent_coordinates", "inputs", "states", "units", "check_inertia"):
    setattr(_WithMultipliers, _name, property(lambda self, name=_name: getattr(self.inner, name)))


class _Outputs(System):
    def outputs(self, t, q, u, motion, now):
        return self.inner.outputs(t, q, u, motion, now)  # type: ignore[attr-defined]


class _Contacts(System):
    def contacts(self, t, q, u, motion):
        return self.inner.contacts(t, q, u, motion)  # type: ignore[attr-defined]


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
    if system.auxiliary_speeds:
        raise ValueError(f"with_multipliers({name}): auxiliary speeds are not supported. Remove them.")
    kind: Any = type(system)
    return _class_of(kind, has_outputs(system), has_contacts(system))(system)


@functools.lru_cache(maxsize=1000)
def _class_of(inner: Any, outputs: bool, contacts: bool) -> Any:
    """A subclass with the name of the inner class, which messages show."""
    bases = [*([_Outputs] if outputs else []), *([_Contacts] if contacts else []), _WithMultipliers]
    kind: Any = type(_WithMultipliers)
    return kind(inner.__name__, tuple(bases), {"__doc__": inner.__doc__})
