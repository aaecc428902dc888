"""The same mechanism with other independent speeds. Knows descriptions; differentiates and solves nothing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from .._common.lookup import as_names
from .._description.system import System
from .._description.values import Values


class _Respeeded(System):
    """A system read with its speeds in another order, other ones being independent."""

    inner: System

    def _in_order(self, u: Any) -> Values:
        names = (*self.inner.speeds, *self.inner.dependent_speeds, *self.inner.auxiliary_speeds)
        return Values([u[name] for name in names], names)

    def q_dot(self, t, q, u):
        return self.inner.q_dot(t, q, self._in_order(u))

    def motion(self, t, q, u):
        return self.inner.motion(t, q, self._in_order(u))

    def loads(self, t, q, u, motion, inputs):
        return self.inner.loads(t, q, self._in_order(u), motion, inputs)

    def configuration_constraints(self, t, q):
        return self.inner.configuration_constraints(t, q)

    def implied_constraints(self, t, q):
        return self.inner.implied_constraints(t, q)

    def events(self, t, q, u):
        return self.inner.events(t, q, self._in_order(u))


def with_speeds(system: System, speeds: Sequence[str]) -> System:
    """The same system with other independent speeds, for motions in which its own do not determine the others.

    A bicycle that pivots about its rear wheel's contact has a yaw rate although neither its rear wheel nor its roll
    or steer turns: `with_speeds(bicycle, ("roll_rate", "yaw_rate", "steer_rate"))`.
    `jaxkane.best_dependent_speeds` says which choice is well conditioned.

    **Arguments:** `speeds`: names of as many speeds as there are independent ones, of the independent and the
    dependent ones.

    **Returns:** a system whose parameters are those of `.inner`.

    **Raises:** `ValueError` for other names, or another number of them.
    """
    everything = (*system.speeds, *system.dependent_speeds)
    speeds = as_names(speeds)
    if len(set(speeds)) != len(system.speeds) or not set(speeds) <= set(everything) or len(speeds) != len(set(speeds)):
        raise ValueError(
            f"{type(system).__name__}: name {len(system.speeds)} different ones of {', '.join(everything)}; got "
            f"{', '.join(speeds)}."
        )
    attributes = {
        "coordinates": system.coordinates,
        "speeds": speeds,
        "dependent_speeds": tuple(name for name in everything if name not in speeds),
        "auxiliary_speeds": system.auxiliary_speeds,
        "dependent_coordinates": system.dependent_coordinates,
        "inputs": system.inputs,
        "__doc__": type(system).__doc__,
    }
    key = (type(system), speeds)
    if key not in _MADE:
        _MADE[key] = type(type(system).__name__, (_Respeeded,), attributes)
    return _MADE[key](system)


_MADE: dict[Any, Any] = {}
