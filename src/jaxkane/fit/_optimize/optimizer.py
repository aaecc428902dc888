"""What an optimizer says of itself, so that one loop can run them all: `minimize`. Knows points and their costs."""

from __future__ import annotations

import abc
import dataclasses
from typing import Any, ClassVar

from ..._common.real_numbers import real_number
from .._problem.linearization import Linearization
from .._problem.model import Unknowns
from .._problem.problem import Problem


@dataclasses.dataclass(frozen=True)
class Iterate:
    """Where a descent stands.

    - `point`, and `cost`: the sum of squares there. `at`: the problem linearized there, where the optimizer needs that.
    - `memory`: a tree of arrays, all else that the next step depends on.
    """

    point: Unknowns
    cost: float
    at: Linearization | None
    memory: Any


class Optimizer(abc.ABC):
    """A method and its options, without a state: a frozen dataclass.

    A new one is a file with a class like those beside this, and its line in `jaxkane.fit`.
    """

    steps: ClassVar[int]
    """At most, where `minimize` is not asked for another number."""

    def __post_init__(self) -> None:
        for name in ("rtol", "damping"):
            label = f"{type(self).__name__}: `{name}`"
            value = real_number(getattr(self, name, 0.0), label)
            if not 0 <= value < float("inf"):
                raise ValueError(f"{label} is a number that is not negative, got {value}.")

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """For tables."""

    def depends_on(self, problem: Problem, steps: int) -> dict[str, Any]:
        """By name, what the next step depends on besides the problem and the memory: a checkpoint goes on only where
        that is the same."""
        return {}

    def for_steps(self, steps: int) -> Optimizer:
        """The same for so many steps at most, where its options follow from that."""
        return self

    def before(self, problem: Problem, point: Unknowns, steps: int) -> Unknowns:
        """The point from which the descent shall begin, where another one is better."""
        return point

    def without_preparation(self) -> Optimizer:
        """The same for a start that is near the end: what `before` would do is left out."""
        return self

    @abc.abstractmethod
    def begin(self, problem: Problem, point: Unknowns, at: Linearization) -> Any:
        """The memory before the first step."""

    @abc.abstractmethod
    def step(self, problem: Problem, now: Iterate, taken: int) -> Iterate | str:
        """After one more step, of which `taken` were made before; or the status (see `STATUS`) with which it ends."""

    def after(self, problem: Problem, best: Iterate, status: str) -> tuple[Iterate, str]:
        """What is left to do with the best point that was seen, and the status."""
        return best, status
