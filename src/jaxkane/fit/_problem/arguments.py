"""What a fit is asked, and what is checked of that before anything is posed. Knows types and numbers."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ..._common.real_numbers import real_number
from ..._description.system import System
from .entries import as_items
from .free import Prior
from .simulation import Simulation

if TYPE_CHECKING:
    from .names import Names


@dataclasses.dataclass(frozen=True)
class Specification:
    """The arguments of `jaxkane.fit.fit` that pose it, but for the trials: all that a `Problem` is derived from, and
    what it is posed by again."""

    system: System
    free: Any
    _: dataclasses.KW_ONLY
    unknown: Names = ()
    sensor_bias: Names = ()
    sensor_gain: Names = ()
    input_bias: Names = ()
    input_gain: Names = ()
    input_delay: Names = ()
    priors: Mapping[str, Prior] | None = None
    hold: Sequence[str] = ()
    window: float | None = None
    continuity: Mapping[str, float] | None = None
    noise: Mapping[str, float] | None = None
    simulation: Simulation | None = None
    processes: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "free", tuple(as_items(self.free)))
        for name, value in vars(self).items():
            if isinstance(value, (list, dict)):  # the caller's own, who may change it later
                object.__setattr__(self, name, copy.copy(value))
        if self.simulation is not None:
            refuse_other(self.simulation, Simulation, "`simulation=`", "Simulation(step=0.01)")
        if not isinstance(self.system, System):
            raise TypeError(f"`system` is a jaxkane.System, got {type(self.system).__name__}.")
        for name in ("priors", "continuity"):
            if not isinstance(getattr(self, name), (Mapping, type(None))):
                raise TypeError(f"`{name}` is a dict by name, got {getattr(self, name)!r}.")
        if self.window is not None and not real_number(self.window, "`window`") > 0:
            raise ValueError(f"`window` is a length of time [s], got {self.window}.")
        if self.continuity is not None and self.window is None:
            raise ValueError("`continuity` binds the windows of a trial together: give their length, `window` [s].")

    def with_priors(self, priors: Mapping[str, Prior]) -> Specification:
        """The same with these priors in the place of those of the same names."""
        return dataclasses.replace(self, priors={**(self.priors or {}), **priors})


def refuse_other(given: Any, wanted: type, name: str, instead: str) -> None:
    """What is asked before a fit takes a `Problem`, what is asked after it takes a `Fit`.

    **Raises:** `TypeError` for anything else.
    """
    if not isinstance(given, wanted):
        raise TypeError(f"{name} takes a {wanted.__name__}, as in {instead}; got {type(given).__name__}.")
