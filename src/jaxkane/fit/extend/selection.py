"""Search for model extensions: add, exchange and remove candidates, decided by tests and by held-out trials."""

from __future__ import annotations

import dataclasses
import html
import math
from collections.abc import Mapping, Sequence
from typing import Any

from tqdm import tqdm

from ..._common.lookup import refuse, refuse_unknown, whole_number
from ..problem.from_declarations import parameters_of
from ..problem.specification import refuse_other
from ..result.diagnostics import Plausible, plausible_of, refuse_unless_at_a_minimum
from ..result.fit_result import Fit
from ..result.linearized import trial_folds
from ..result.statistics import check_level
from ..result.studies import energy_sources
from ..result.tables import Rows, Tables, html_tables, text_tables
from ..solve.fit import solve
from ..solve.optimizers import LeastSquares
from .candidates import (
    Candidates,
    Terms,
    checked_terms,
    extended_specification,
    mapped_point,
    scaled_terms,
)
from .search import Alternative, Extension, Search

HEAD = ("candidate", "estimate", "std. error", "predicted cost", "cost", "p", "criterion", "held-out cost", "decision")


@dataclasses.dataclass(frozen=True, repr=False)
class ForwardSelection:
    """The result of `forward_selection`. Print it for the tables.

    - `before`: the fit that was passed.
    - `rounds`: the extensions that were tried in each round, the accepted one first.
    - `costs`, `held_out_costs`: sums of squares at the start of each round, of the fit and of trials left out in turn.
    - `selected`: names of the candidates in the final model.
    - `removed`: names of the parameters that were removed from the model.
    - `held_out`: which trials were left out together, as text.
    - `alternatives`: other accepted models, the best first.
    - `level`: significance level of the test.
    - `bound_violations`: a sentence for each implausible estimate of `fit`, also for parameters that were free before.
    - `fit`: the fit of the final model. It is `before` if nothing has changed.
    """

    before: Fit
    rounds: tuple[tuple[Extension, ...], ...]
    costs: tuple[float, ...]
    held_out_costs: tuple[float, ...]
    selected: tuple[str, ...]
    removed: tuple[str, ...]
    held_out: str
    alternatives: tuple[Alternative, ...]
    level: float
    bound_violations: tuple[str, ...]
    fit: Fit

    @property
    def best(self) -> Extension | None:
        return self.rounds[0][0] if self.selected or self.removed else None

    @property
    def tables(self) -> Tables:
        """The table of each round, as a heading and rows. The first row is the header."""
        tables: list[tuple[str, Rows]] = []
        for i, extensions in enumerate(self.rounds):
            after = f" after {', '.join(done[0].name for done in self.rounds[:i])}" if i else ""
            held_out = "with one trial, there is no held-out cost"
            if not math.isnan(self.held_out_costs[i]):
                held_out = f"{self.held_out_costs[i]:.5g} of trials left out in turn ({self.held_out})"
            heading = f"Sum of squares{after} {self.costs[i]:.6g}; {held_out}."
            tables.append((heading, [HEAD, *(extension.cells for extension in extensions)]))
        if self.alternatives:
            rows = [("also accepted", "cost", "held-out cost", "compared with the selection")]
            for one in self.alternatives:
                held_out = "" if math.isnan(one.held_out_cost) else f"{one.held_out_cost:.5g}"
                rows.append((", ".join(one.names), f"{one.cost:.5g}", held_out, "predicts as well" * one.is_as_good))
            tables.append(("Alternatives.", rows))
        return tables

    @property
    def conclusion(self) -> str:
        best = [of_round[0] for of_round in self.rounds if of_round and of_round[0].accepted]
        text = f"Nothing is selected: no candidate is accepted at a level of {self.level:g}."
        if best:
            held_out = ""
            if not math.isnan(best[-1].held_out_cost):
                costs = f"{self.held_out_costs[0]:.5g} -> {best[-1].held_out_cost:.5g}"
                held_out = f" (of trials left out, {self.held_out}: {costs})"
            not_nested = {one.name for one in best if not one.nested}
            names = [f"{n} (not nested: by trials left out)" if n in not_nested else n for n in self.selected]
            text = f"Selected: {', '.join(names)}." if names else "Nothing is added."
            text += f" Removed: {', '.join(self.removed)}." if self.removed else ""
            text += f" Sum of squares {self.before.cost:.6g} -> {self.fit.cost:.6g}{held_out}."
        if self.bound_violations:
            text += f" Not plausible: {', '.join(self.bound_violations)}."
        as_good = [" and ".join(one.names) for one in self.alternatives if one.is_as_good]
        return text + (f" These data do not distinguish it from {'; '.join(as_good)}." if as_good else "")

    def __str__(self) -> str:
        tables = "\n\n".join(text_tables([table], (0, len(table[1][0]) - 1)) for table in self.tables)
        return f"{tables}\n\n{self.conclusion}"

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return f"{html_tables(self.tables)}<p>{html.escape(self.conclusion)}</p>"


def forward_selection(
    fit: Fit,
    candidates: Candidates,
    *,
    remove: str | Sequence[str] = (),
    exchange: bool = False,
    depth: int = 1,
    beam: int = 1,
    refits: int | None = 3,
    level: float = 0.05,
    plausible: Mapping[str, Any] | None = None,
    folds: int | str | Sequence[Sequence[int]] | None = None,
    progress: bool = False,
) -> ForwardSelection:
    """Select model extensions by forward selection.

    Each candidate is judged by the decrease of the sum of squares, the plausibility of the estimates, and the
    prediction of held-out trials.

        candidates = ["dry_friction", Gain("torque"), Offset("angle"), Candidate("lag", system=Lagging())]
        selection = forward_selection(fit, candidates, folds="speed")
        print(selection)
        selection.fit                                       # the fit with the selected candidates

    All candidates of a system are linearized together at the minimum of the fit, with all free parameters and other
    unknowns eliminated. For each candidate this gives a predicted cost and the p-value of a score test (Rao 1948). The
    candidates with the lowest predicted costs are fitted, together with all free parameters. One compiled program runs
    all these fits.

    A candidate is nested if it does not change the trajectories at its start. A nested candidate is accepted if three
    conditions are met. (1) Its p-value after the fit is below `level`, corrected for the number of candidates
    (Bonferroni). (2) No estimate becomes implausible, neither the candidate's nor one that was free before. (3) Trials
    that are left out in turn are predicted better with it.

    The accepted candidate that predicts best is selected. With `depth` above one, the others are then tested again in
    the extended model, until none is accepted. A candidate that is not nested, such as another system with different
    trajectories, is always fitted. It is accepted by (2) and (3).

    **Arguments:**

    - `fit`: a `Fit` that has converged.
    - `candidates`: a list of names of parameters, `Free`, `Gain`, `Offset`, `Delay`, `LowPass`, `Inertia`, and
        `Candidate`. A `Candidate` combines several of these, or is another system. Each starts where it does not change
        the model.
    - `remove`: names of free parameters that may be removed, or replaced by a candidate, if held-out trials are then
        predicted better. A parameter that is removed has the value of the system.
    - `exchange`: whether to also remove and replace selected candidates, and to test pairs if no single candidate is
        accepted. Single candidates and pairs then share `level`. Requires two trials.
    - `depth`: largest number of candidates that are selected.
    - `beam`: number of models that are extended in each round. With 1, only the best model is extended.
    - `refits`: number of nested candidates that are fitted in each round, and of exchanges and of pairs. None for all,
        0 for none.
    - `level`: significance level of the test, between 0 and 1.
    - `plausible`: by name, (lower, upper), or a relative deviation from the start such as 0.2. By default
        `Candidate.plausible`, three standard deviations of a prior, or the range between two bounds without its ends.
        For a parameter that starts on a bound, such as friction at zero, the search covers both sides. Only the side
        inside the bounds is plausible, and the test is one-sided.
    - `folds`: which trials are left out together, as in `cross_validate`. With the name of a label, as in
        `folds="speed"`, trials with the same value of the label are left out together.
    - `progress`: whether to show a progress bar.

    **Returns:** a `ForwardSelection`. Print it for the tables.

    **Raises:** `ValueError` for a fit that has not converged, without a candidate, for two candidates with the same
    name, for a parameter that is already free, and for names that do not exist.
    """
    refuse_other(fit, Fit, "forward_selection", "forward_selection(fit(...), candidates)")
    _check_arguments(fit, depth, beam, refits, level)
    terms = checked_terms(fit, candidates, remove)
    ranges = _plausible_ranges(fit, terms, plausible or {})
    groups, kind = None, ""
    if len(fit.problem.trials) >= 2:
        groups, kind = trial_folds(folds, fit.problem.trials)
    elif folds is not None or exchange:
        raise ValueError(
            "forward_selection: cross-validation (`folds`, `exchange`) needs at least two trials, got one. Cut the "
            "trial with `Trial.between`, or omit `folds` and `exchange`."
        )
    with tqdm(disable=not progress, desc="forward selection", unit=" step") as bar:
        terms = scaled_terms(fit, terms)
        ended, accepted = Search(fit, terms, exchange, depth, refits, level, ranges, groups, bar).run(beam)
    best = min([*ended, *accepted], key=lambda branch: branch.model.rank)
    after = fit
    changes = [extensions for _, extensions in best.rounds if extensions and extensions[0].accepted]
    if changes:  # refit in the specification that a user would write
        problem = fit.problem.with_specification(extended_specification(terms.base, best.model.terms))
        start = mapped_point(best.model.fit.problem, best.model.fit.point, problem, best.model.fit.names)
        after = solve(problem, LeastSquares(), start=start)
    # A subset of the selected model is an earlier stage of it, not an alternative.
    others = {branch.model.key: branch for branch in accepted if not branch.model.key <= best.model.key}
    others = sorted(others.values(), key=lambda branch: branch.model.rank)
    selected = tuple(c.name for c in best.model.terms if c in terms.candidates)
    return ForwardSelection(
        before=fit,
        rounds=tuple(round.extensions for round in best.rounds),
        costs=tuple(round.model.fit.cost for round in best.rounds),
        held_out_costs=tuple(round.model.held_out_cost for round in best.rounds),
        selected=selected,
        removed=tuple(c.name for c in terms.removable if c not in best.model.terms),
        held_out=kind,
        alternatives=tuple(branch.model.compared_with(best.model) for branch in others),
        level=level,
        bound_violations=tuple({**energy_sources(after), **best.model.bound_violations}.values()),
        fit=after,
    )


def _plausible_ranges(fit: Fit, terms: Terms, plausible: Mapping[str, Any]) -> Plausible:
    """Plausible ranges by name, of all parameters that are free or may be freed."""
    ranges, known, priors = {}, set(fit.names), fit.problem.specification.priors or {}
    for candidate in terms.all:
        if not candidate.items:
            continue
        parameters = parameters_of(candidate.system or fit.problem.system, candidate.items, trials=fit.problem.trials)
        parameters = parameters.with_priors(priors)
        of_fit = {name: pair for name, pair in plausible.items() if name in parameters.names}
        ranges |= plausible_of(parameters, {**candidate.plausible, **of_fit}).ranges
        known |= {*parameters.names, *candidate.plausible}
    refuse_unknown(plausible, known, "`plausible` contains unknown names:", "the names are")
    asked = {name: pair for candidate in terms.all for name, pair in candidate.plausible.items()} | {**plausible}
    # Parameters that are already free use the initial guess of the fit, not the value of a candidate's system.
    of_fit = {name: pair for name, pair in asked.items() if name in fit.names}
    return Plausible({**ranges, **plausible_of(fit.parameters, of_fit).ranges})


def _check_arguments(fit: Fit, depth: int, beam: int, refits: int | None, level: float) -> None:
    refuse(
        (
            fit.problem.model.errors is not None,
            "forward_selection: the fit has error models, and the search compares sums of squares. Fit without "
            "`errors`, or compare the `bic` of fits with each candidate.",
        ),
        (
            fit.problem.specification.noise is not None,
            "forward_selection: the fit has process noise, which can hide missing physics. Fit without `noise`, or "
            "compare `fit.marginal_likelihood()` of fits with each candidate.",
        ),
    )
    refuse_unless_at_a_minimum(fit.status, "forward_selection")  # a score test is only valid at a minimum
    for name, value, smallest in (
        ("depth", depth, 1),
        ("beam", beam, 1),
        ("refits", 0 if refits is None else refits, 0),
    ):
        whole_number(value, smallest, f"forward_selection: `{name}`")
    check_level(level)
