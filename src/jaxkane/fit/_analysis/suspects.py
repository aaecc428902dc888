"""What a model may lack: candidates ranked by what they promise, keep and predict. Knows linearizations and refits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from tqdm import tqdm

from ..._common.lookup import refuse_unknown
from .._optimize.least_squares import LeastSquares
from .._optimize.solve import solve
from .._problem.arguments import refuse_other
from .._result.covariance import check_level
from .._result.result import Fit
from .candidates import Candidate, candidates_of, posed_with
from .held_back import folds_of
from .standing import Standing
from .suspected import Suspects
from .trying import Trying


def suspects(
    fit: Fit,
    candidates: Any,
    *,
    depth: int = 1,
    refits: int | None = 3,
    level: float = 0.05,
    plausible: Mapping[str, Any] | None = None,
    folds: int | Sequence[Sequence[int]] | None = None,
    progress: bool = False,
) -> Suspects:
    """Which of these extensions a model lacks: what each would lower the sum of squares by, whether it can be believed,
    and whether it predicts trials that were left out.

        found = suspects(fit, ["dry_friction", Gain("torque"), Offset("angle"), Candidate("lag", system=Lagging())])
        print(found)
        found.fit                                           # with what was taken

    All candidates of a system are linearized together, once, where the fit ended; what is free and unknown already is
    eliminated. That says how much each promises, its estimate with its error, and by a score test (Rao 1948) whether
    chance promises as much. Residuals that are correlated count as what they are (see the page on identification).
    The most promising ones are then fitted, together with all that is free, from the same compiled program.

    A nested candidate, which changes nothing where it starts, stands where (1) chance promises so much with a
    probability below `level`, over all candidates together (Bonferroni); (2) fitted, it keeps that; (3) no parameter
    becomes implausible, its own or one that was free; (4) trials left out in turn are predicted better with it.
    Of those that stand, the one that predicts best is taken; with `depth` above one the others are tried again beside
    it, and so on, until none stands.

    What is not nested, as another system whose motion differs from the start, promises nothing before it is fitted, and
    always is, besides the `refits`. In the place of (1) nothing is asked where trials can be left out, and where there
    is one alone, whether the Bayesian information criterion is lower. The `criterion` of each says what decided.

    **Arguments:**

    - `fit`: one that has converged. `candidates`: a list of names of parameters, `Free`, `Gain`, `Offset`, `Delay`,
        `Inertia`, and `Candidate`, which may be several of these together, what every trial has its own of, or another
        system. Each starts where it is neutral.
    - `depth`: how many may be taken, one after the other. `refits`: how many that are nested are fitted in each round;
        None for all that the data can distinguish, 0 for none at all. `level`: of the test.
    - `plausible`: by name, (lower, upper), or a share of the start such as 0.2. Else what `Candidate.plausible` says,
        three deviations of a prior, and two bounds, of which it must stay away. What starts on a bound, given
        or declared, as friction at zero, is searched for on both sides and believed on one.
    - `folds`: trials that are left out together, as in `cross_validate`. `progress`: a bar.

    **Returns:** `Suspects`: print it for the table.

    **Raises:** `ValueError` for a fit that has not converged, no candidate, two of the same name, one that is free
    already, and names that do not exist.
    """
    refuse_other(fit, Fit, "suspects", "suspects(fit(...), candidates)")
    _check(fit, depth, refits, level)
    left = list(candidates_of(fit, candidates))
    order = tuple(candidate.name for candidate in left)
    said = dict(plausible or {})
    T, groups = len(fit.problem.trials), None
    if T >= 2:
        groups = folds_of((T if T <= 10 else 5) if folds is None else folds, T)
    elif folds is not None:
        raise ValueError("`folds`: one trial alone cannot be left out: cut it with `Trial.between`.")
    standing, taken, rounds = Standing.of(fit), [], []
    with tqdm(disable=not progress, desc="suspects", unit=" step") as bar:
        for _ in range(depth):
            round = Trying(fit, standing, tuple(taken), order, level / len(left), said, groups)
            rows, ways = round.all_of(left, refits, bar)
            best = next((row for row in rows if row.stands), None)
            rounds.append((standing.cost, standing.left_out(groups), rows))
            if best is None:
                break
            taken.append(next(c for c in left if c.name == best.name))
            left = [c for c in left if c.name != best.name]
            standing = ways[best.name]
            if not left:
                break
    names = {name for _, _, rows in rounds for row in rows for name in row.values}
    refuse_unknown(said, (*fit.names, *names), "`plausible` names")
    return Suspects(
        before=fit,
        rounds=tuple(rows for *_, rows in rounds),
        costs=tuple(cost for cost, *_ in rounds),
        left_out=tuple(out for _, out, _ in rounds),
        taken=tuple(c.name for c in taken),
        level=level,
        fit=_fitted(fit, taken, standing) if taken else fit,
    )


def _check(fit: Fit, depth: Any, refits: Any, level: float) -> None:
    if fit.problem.specification.noise is not None:
        raise ValueError(
            "suspects asks fits of least squares, whose sum of squares candidates lower; this one has process noise, "
            "which stands in for what is missing. Ask without `noise`, or compare `marginal_likelihood` of two fits."
        )
    if fit.status != "converged":
        raise ValueError(
            f"The fit has not converged ({fit.status}): what is asked beside it is asked at a minimum. Go on with "
            "`minimize(fit.problem, LeastSquares(), start=fit.point)`."
        )
    for name, value, least in (("depth", depth, 1), ("refits", refits, 0)):
        if value is None and name == "refits":
            continue
        if not isinstance(value, int) or value < least:
            raise ValueError(f"`{name}` is a whole number of {least} at least, got {value!r}.")
    check_level(level)


def _fitted(fit: Fit, taken: Sequence[Candidate], standing: Standing) -> Fit:
    """The fit with what was taken, as a user would pose it."""
    problem = fit.problem.asking(posed_with(fit, taken))
    return solve(problem, LeastSquares(), start=standing.carried_to(problem))
