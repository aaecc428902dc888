"""The same mechanism with other independent speeds. Knows descriptions; differentiates and solves nothing."""

from __future__ import annotations

import copy
import functools
from collections.abc import Sequence
from typing import Any

import equinox as eqx

from .._common.lookup import as_names
from .._description.system import System
from .._description.values import Values
from .._method.outputs import has_outputs


class _Respeeded(System):
    """A system read with its speeds in another order, other ones being independent."""

    inner: System
    independent: tuple[str, ...] = eqx.field(static=True)
    dependent: tuple[str, ...] = eqx.field(static=True)

    def _in_order(self, u: Any) -> Values:
        names = (*self.inner.speeds, *self.inner.dependent_speeds, *self.inner.auxiliary_speeds)
        return Values([u[name] for name in names], names)

    def _of_inner(self, now: Any) -> Any:
        """The same instant, with the accelerations in the order of the inner system's speeds."""
        names = (*self.inner.speeds, *self.inner.dependent_speeds)
        other = copy.copy(now)
        other.u_dot = Values([now.u_dot[name] for name in names], names)
        return other

    def q_dot(self, t, q, u):
        return self.inner.q_dot(t, q, self._in_order(u))

    def motion(self, t, q, u):
        return self.inner.motion(t, q, self._in_order(u))

    def loads(self, t, q, u, motion, inputs):
        return self.inner.loads(t, q, self._in_order(u), motion, inputs)

    def state_rates(self, t, q, u, x, motion, now):
        return self.inner.state_rates(t, q, self._in_order(u), x, motion, self._of_inner(now))

    def configuration_constraints(self, t, q):
        return self.inner.configuration_constraints(t, q)

    def implied_constraints(self, t, q):
        return self.inner.implied_constraints(t, q)

    def events(self, t, q, u):
        return self.inner.events(t, q, self._in_order(u))


for _name in ("coordinates", "auxiliary_speeds", "dependent_coordinates", "inputs", "states", "units", "check_inertia"):
    setattr(_Respeeded, _name, property(lambda self, name=_name: getattr(self.inner, name)))
setattr(_Respeeded, "speeds", property(lambda self: self.independent))  # noqa: B010
setattr(_Respeeded, "dependent_speeds", property(lambda self: self.dependent))  # noqa: B010


class _WithOutputs(_Respeeded):
    def outputs(self, t, q, u, motion, now):
        return self.inner.outputs(t, q, self._in_order(u), motion, self._of_inner(now))


def with_speeds(system: System, speeds: Sequence[str]) -> System:
    """The same system with other independent speeds, for motions in which its own do not determine the others.

    A bicycle that pivots about its rear wheel's contact has a yaw rate although neither its rear wheel nor its roll
    or steer turns: `with_speeds(bicycle, ("roll_rate", "yaw_rate", "steer_rate"))`.
    `jaxkane.best_dependent_speeds` says which choice is well conditioned.

    **Arguments:** `speeds`: names of as many speeds as there are independent ones, of the independent and the
    dependent ones.

    **Returns:** a system whose parameters are those of `.inner`, and all else is the system's.

    **Raises:** `ValueError` for other names, or another number of them.
    """
    everything = (*system.speeds, *system.dependent_speeds)
    speeds = as_names(speeds)
    if len(set(speeds)) != len(system.speeds) or not set(speeds) <= set(everything) or len(speeds) != len(set(speeds)):
        raise ValueError(
            f"{type(system).__name__}: name {len(system.speeds)} different ones of {', '.join(everything)}; got "
            f"{', '.join(speeds)}."
        )
    inner: Any = type(system)
    base: Any = _WithOutputs if has_outputs(system) else _Respeeded
    return _kind_of(inner, base)(system, speeds, tuple(name for name in everything if name not in speeds))


@functools.lru_cache(maxsize=1000)
def _kind_of(inner: Any, base: Any) -> Any:
    """The class of such systems, under the name of the inner one for messages."""
    return type(base)(inner.__name__, (base,), {"__doc__": inner.__doc__})
