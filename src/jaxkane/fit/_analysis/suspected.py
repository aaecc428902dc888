"""What a search for a model's lacks found: rows, rounds, and the fit with what was taken. Numbers and words only."""

from __future__ import annotations

import dataclasses
import html
import math
from collections.abc import Mapping, Sequence

from .._result.result import Fit
from .._result.tables import plain, table

HEAD = ("candidate", "estimate", "std. error", "promised", "fitted", "p", "criterion", "left out", "verdict")


@dataclasses.dataclass(frozen=True)
class Suspect:
    """One candidate.

    - `parameters`: what it frees; `values`: by name, of these and of all that was free; `errors`: of these. Fitted
        where `cost` is a number, else as the linearization has them.
    - `promised`, `cost`: the sum of squares by the linearization, and fitted (NaN where it was not). `p`: the
        probability that chance promises as much, of what is nested. `criterion`: what decides beside the trials left
        out: "score test" before it is fitted, "F test" or "t test" after; of what is not nested "trials left out"
        alone, or "BIC" where none can be left out.
    - `predicted`: the sum of squares of trials that are left out in turn; unknowns of the trials' own, which those that
        are left out find too, count twice the variance of a residual each.
    - `objections`: what is not plausible, in words. `verdict`: why it does not stand, or "stands"; `stands`.
    """

    name: str
    parameters: tuple[str, ...] = ()
    values: Mapping[str, float] = dataclasses.field(default_factory=dict, hash=False)
    errors: Mapping[str, float] = dataclasses.field(default_factory=dict, hash=False)
    promised: float = math.nan
    cost: float = math.nan
    p: float = math.nan
    criterion: str = ""
    predicted: float = math.nan
    objections: tuple[str, ...] = ()
    verdict: str = ""
    stands: bool = False

    @property
    def least(self) -> float:
        """What is known of the sum of squares with it; infinite where nothing is."""
        known = [x for x in (self.cost, self.promised) if not math.isnan(x)]
        return known[0] if known else math.inf

    @property
    def cells(self) -> tuple[str, ...]:
        number = lambda x, form=".5g": "" if math.isnan(x) else f"{x:{form}}"  # noqa: E731
        known = [name for name in self.parameters if not math.isnan(self.errors[name])]
        estimates = ", ".join(f"{self.values[name]:.4g}" for name in known)
        errors = ", ".join(f"{self.errors[name]:.2g}" for name in known)
        tested = (number(self.promised), number(self.cost), number(self.p, ".2g"), self.criterion)
        return (self.name, estimates, errors, *tested, number(self.predicted), self.verdict)


@dataclasses.dataclass(frozen=True, repr=False)
class Suspects:
    """What `suspects` found; print it for the tables.

    - `rows`: of the first round, those that stand first; `best`: the one that was taken there, or None. `rounds`: the
        rows of all rounds; `costs`, `left_out`: the sums of squares with which each began, fitted and of trials left
        out in turn.
    - `taken`: names of what was taken, in that order. `fit`: with all of it free; where nothing was, the one `before`.
    - `level`: of the test.
    """

    before: Fit
    rounds: tuple[tuple[Suspect, ...], ...]
    costs: tuple[float, ...]
    left_out: tuple[float, ...]
    taken: tuple[str, ...]
    level: float
    fit: Fit

    @property
    def rows(self) -> tuple[Suspect, ...]:
        return self.rounds[0]

    @property
    def best(self) -> Suspect | None:
        return self.rows[0] if self.taken else None

    @property
    def headings(self) -> tuple[str, ...]:
        """Of every round, in words."""
        found = []
        for i, (cost, out) in enumerate(zip(self.costs, self.left_out, strict=True)):
            beside = f" with {', '.join(self.taken[:i])}" if i else ""
            left = "one trial, nothing is left out" if math.isnan(out) else f"{out:.5g} of trials left out in turn"
            found.append(f"Sum of squares{beside} {cost:.6g}; {left}.")
        return tuple(found)

    @property
    def conclusion(self) -> str:
        if not self.taken:
            return f"Nothing is taken: no candidate stands at a level of {self.level:g}."
        left = "" if math.isnan(self.left_out[0]) else f" (of trials left out: {self.left_out[0]:.5g} before)"
        best = zip(self.taken, self.rounds, strict=False)
        taken = [f"{name} (not nested: by {r[0].criterion})" if math.isnan(r[0].p) else name for name, r in best]
        return f"Taken: {', '.join(taken)}. Sum of squares {self.before.cost:.6g} -> {self.fit.cost:.6g}{left}."

    def __str__(self) -> str:
        parts = [
            f"{heading}\n{plain(_lines(rows), (0, len(HEAD) - 1))}"
            for heading, rows in zip(self.headings, self.rounds, strict=True)
        ]
        return "\n\n".join([*parts, self.conclusion])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        parts = [
            f"<p>{html.escape(heading)}</p>{table(_lines(rows))}"
            for heading, rows in zip(self.headings, self.rounds, strict=True)
        ]
        return "".join([*parts, f"<p>{html.escape(self.conclusion)}</p>"])


def _lines(rows: Sequence[Suspect]) -> list[tuple[str, ...]]:
    return [HEAD, *(row.cells for row in rows)]
