"""Many initial guesses: does the answer depend on where one starts? Knows least squares; draws at random by a seed."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from ..._common.real_numbers import real_number
from .._optimize.least_squares import LeastSquares
from .._optimize.minimize import minimize
from .._optimize.optimizer import Optimizer
from .._problem.arguments import refuse_other
from .._problem.linearization import cost
from .._problem.model import Unknowns
from .._problem.problem import Problem
from .._result.result import Fit


@dataclasses.dataclass(frozen=True, repr=False)
class MultiStart:
    """What came of many initial guesses; print it for a table.

    - `fits`: those that ran, the best first; `guesses`: the values that each began with, by name.
    - `failures`: why the others could not be simulated. `untried`: how many were left when Ctrl-C came.
    - `agreeing`: how many fits ended where the best did (their cost within 0.1 %, or 0.1 % of the residuals' number).
    - `spread`: by name, the standard deviation of these estimates: what is left of the initial guess in the answer.
    """

    fits: tuple[Fit, ...]
    guesses: tuple[dict[str, float], ...]
    failures: tuple[str, ...]
    untried: int = 0

    @property
    def best(self) -> Fit:
        return self.fits[0]

    @property
    def agreeing(self) -> int:
        return len(self._same)

    @property
    def spread(self) -> dict[str, float]:
        return {name: float(np.std([f.estimates[name] for f in self._same])) for name in self.best.names}

    @property
    def _same(self) -> list[Fit]:
        slack = 1e-3 * max(self.best.cost, self.best.variance * self.best.problem.size[0])
        return [f for f in self.fits if f.cost <= self.best.cost + slack]

    def __str__(self) -> str:
        names = self.best.names
        lines = [f"{'sum of squares':>15}  {'steps':>5}  {'ended':<12}" + "".join(f"{n[:14]:>15}" for n in names)]
        for f in self.fits:
            lines.append(
                f"{f.cost:>15.6g}  {len(f.history) - 1:>5}  {f.status:<12}"
                + "".join(f"{f.estimates[n]:>15.5g}" for n in names)
            )
        lines.append(f"{'spread':>36}" + "".join(f"{s:>15.2g}" for s in self.spread.values()))
        total = len(self.fits) + len(self.failures)
        lines.append(f"{self.agreeing} of {total} initial guesses end at the best.")
        if self.agreeing == 1 and total > 1:
            lines.append("Nothing confirms that this is the lowest minimum: try more, or shorter windows.")
        if self.untried:
            lines.append(f"Interrupted: {self.untried} more initial guesses were not tried.")
        return "\n".join([*lines, *self.failures])

    __repr__ = __str__


def multi_start(
    problem: Problem,
    n: int = 10,
    *,
    spread: float = 0.3,
    candidates: int | None = None,
    seed: int = 0,
    optimizer: Optimizer | None = None,
    steps: int | None = None,
    callback: Callable[[Unknowns, float], None] | None = None,
    progress: bool = False,
) -> MultiStart:
    """Fit from many initial guesses.

    They are run one after another by one compiled program, which every fit of these trials shares. A batch of ten under
    `vmap` was measured (ten windows of a bicycle, two cores): a step takes 0.27 s instead of 0.42 s, but a program of
    its own is compiled for 3.5 s, and all wait for the slowest.

    **Arguments:**

    - `n`: how many fits. `spread`: of the initial guesses, uniform within this many scales of every parameter on either
        side (for a positive one a factor between exp(-spread) and exp(spread)).
    - `candidates`: draw so many guesses, and fit the `n` with the lowest cost; by default `n`.
    - `seed`: of the random numbers. `optimizer`: by default `LeastSquares()`. `steps`, `callback`: of every fit, as in
        `minimize`. `progress`: a progress bar.

    **Returns:** a `MultiStart`; after an interruption (Ctrl-C) of what was tried until then.

    **Raises:** `ValueError` where no guess can be simulated.
    """
    refuse_other(problem, Problem, "multi_start", "multi_start(fit.problem)")
    if n < 1:
        raise ValueError(f"`n` is how many initial guesses are tried, one at least; got {n}.")
    if not 0 <= real_number(spread, "`spread`") < math.inf:
        raise ValueError(f"`spread` is how far guesses lie from the first, in scales, not negative; got {spread}.")
    optimizer = LeastSquares() if optimizer is None else optimizer
    rng = np.random.default_rng(seed)
    p = len(problem.parameters.names)
    drawn = rng.uniform(-spread, spread, (max(n, candidates or n), p))
    points = [eqx.tree_at(lambda q: q.x, problem.start, jnp.asarray(x, problem.windows.t.dtype)) for x in drawn]
    if len(points) > n:
        costs = np.nan_to_num([cost(problem, point) for point in points], nan=np.inf)
        points = [points[i] for i in np.argsort(costs)[:n]]
    found, failures, untried = [], [], 0
    for i, point in enumerate(tqdm(points, disable=not progress, desc="initial guesses")):
        values = np.asarray(problem.parameters.values(point.x)).tolist()
        guess = dict(zip(problem.parameters.names, values, strict=True))
        try:
            found.append((minimize(problem, optimizer, steps=steps, start=point, callback=callback), guess))
        except ValueError as error:
            failures.append(f"From {', '.join(f'{k} = {v:.4g}' for k, v in guess.items())}: {error}")
            continue
        except KeyboardInterrupt:  # before its first step
            if not found:
                raise
            untried = len(points) - i
            break
        if found[-1][0].status == "interrupted":
            untried = len(points) - i - 1
            break
    if not found:
        raise ValueError(f"None of {n} initial guesses can be simulated. The last: {failures[-1]}")
    found.sort(key=lambda pair: pair[0].cost)
    return MultiStart(tuple(f for f, _ in found), tuple(g for _, g in found), tuple(failures), untried)
