"""Systems whose constraints have multipliers instead of dependent speeds.

Dependent speeds become singular where the named speeds do not determine them, although the mechanism is regular there:
for example a chain of links between two fixed points, whose last two links are in line. If all
speeds are independent and each velocity residual has a multiplier, the equations have a solution there too:

    M u_dot = f + C^T lambda,   c = C u + c0 = 0

A residual that depends linearly on the others is omitted where it does, so overconstrained loops can be simulated.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

from .._common.lookup import refuse_if
from .._scalarjit.components import Component, Numbers
from .._system.motion import Motion
from .._system.system import System, call_with_states
from .arguments import Row, check_is_system
from .contact.forces import has_multipliers
from .description import DescriptionEvaluator, jvp


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
