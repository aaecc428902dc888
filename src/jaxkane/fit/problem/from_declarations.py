"""From declarations (names, `Free`, `Gain` and others) to the `Parameters` of a fit; groups and constraints."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..._common.lookup import real_number, refuse, refuse_unknown
from ..._scalarjit.compat import on_device
from ..._system.system import System
from .declarations import Declaration, Free, Items, Part, is_lognormal, scalar
from .parameters import Entry, Interval, Parameters, checked_prior, floats, places_of
from .trial import Trial, groups_of


@dataclasses.dataclass(frozen=True)
class Linear:
    """A constraint on a sum of free parameters: sum of factor * parameter.

        Linear({"mass of frame": 1.0, "mass of rider": 1.0}, equals=92.0)             # exactly
        Linear({"mass of frame": 1.0, "mass of rider": 1.0}, equals=92.0, std=0.5)    # weighed on a scale
        Linear({"mass of frame": -0.2, "mass of rider": 1.0}, at_least=0.0)

    **Arguments:**

    - `factors`: by name of a free parameter, its factor in the sum.
    - `equals`: the value of the sum, in its unit. Without `std`, the value is exact, and one parameter follows from the
        others: `Fit.dependent` reports this parameter.
    - `std`: the standard deviation of `equals`, if the sum was measured.
    - `at_least`: the lower bound of the sum, in its unit.
    - `at_most`: the upper bound of the sum, in its unit. If the optimum is at a bound, the result is that of an exact
        sum with this value.
    """

    factors: Mapping[str, float] = dataclasses.field(hash=False)
    equals: float | None = None
    std: float | None = None
    at_least: float | None = None
    at_most: float | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.factors, Mapping) or not self.factors:
            raise TypeError(
                f"Linear: `factors` must be a dict from names of parameters to factors, got {self.factors!r}."
            )
        numbers = {f"the factor of {name}": factor for name, factor in self.factors.items()}
        numbers |= {f"`{name}`": getattr(self, name) for name in ("equals", "std", "at_least", "at_most")}
        for name, value in numbers.items():
            number, is_std, is_factor = 1.0, name == "`std`", name.startswith("the")
            number = 1.0 if value is None else real_number(value, f"Linear: {name}")
            must = f"finite{', and not zero' * is_factor}{' and positive' * is_std}"
            wrong = not np.isfinite(number) or (is_std and number <= 0) or (is_factor and not number)
            refuse((wrong, f"Linear: {name} must be {must}, got {value}."))
        bounded = self.at_least is not None or self.at_most is not None
        refuse(
            (
                (self.equals is None) != bounded or (self.std is not None and bounded),
                f"Linear({self.text}): pass either `equals` (with or without `std`), or `at_least` or `at_most` or "
                "both.",
            )
        )

    @property
    def text(self) -> str:
        parts = [name if c == 1 else f"{c:g} {name}" for name, c in self.factors.items()]
        return " + ".join(parts)


@dataclasses.dataclass(frozen=True, eq=False)
class JointPrior:
    """A Gaussian prior of several free parameters whose errors are correlated.

        JointPrior({"IBxx": 11.3, "zB": -1.0}, [[0.04, -0.002], [-0.002, 0.0004]])

    **Arguments:**

    - `mean`: by name of a free parameter, its mean.
    - `covariance`: the covariance matrix (n, n), in the order of `mean`. An example is
        `uncertainties.covariance_matrix` for bicycle parameters from BicycleParameters.

    **Raises:** `ValueError` if `covariance` is not symmetric and positive definite.
    """

    mean: Mapping[str, float]
    covariance: Any

    def __post_init__(self) -> None:
        C = np.asarray(self.covariance, float)
        n = len(self.mean)
        if C.shape != (n, n) or not np.allclose(C, C.T) or not np.all(np.linalg.eigvalsh(C) > 0):
            raise ValueError(
                f"JointPrior of {', '.join(self.mean)}: `covariance` must be a symmetric matrix ({n}, {n}) with "
                f"positive eigenvalues, got {self.covariance!r}."
            )


def as_items(free: Any, kinds: tuple[type, ...] = (Declaration,)) -> list[Any]:
    """The argument `free` of a fit as a list, with a `Free` for each name and function.

    `kinds`: the types of elements that do not change.
    """
    free = [free] if isinstance(free, (str, *kinds)) or callable(free) else free
    if not isinstance(free, Iterable):
        raise TypeError(f"`free` must be a name, a declaration such as Free('mass'), or a list of these, got {free!r}.")
    return [item if isinstance(item, kinds) else Free(item) for item in free]


def parameters_of(
    system: System,
    free: Items,
    noise: Mapping[str, float] | None = None,
    channels: Sequence[str] = (),
    trials: Sequence[Trial] = (),
    constraints: Sequence[Linear | JointPrior] = (),
) -> Parameters:
    """The free parameters of a system, of its process noise and sensors, and of groups of trials.

    **Raises:** `ValueError` that names a parameter, input, speed or channel, if it does not exist, is named twice or
    starts outside its bounds; `ValueError` if the initial inertia is not physically possible.
    """
    declared: list[tuple[Part, Declaration]] = []
    for item in as_items(free):
        if not isinstance(getattr(item, "name", None), (str, type(None))):
            raise TypeError(f"`name` of an element of `free` must be a string, got {item.name!r}.")
        declared += [(part, item) for part in item.parts(system, noise, channels)]
    entries = [e for part, _ in declared for e in part.entries]
    names = [e.name for e in entries]
    places = [place for e in entries for place in places_of(e)]
    twice = {e.name for e in entries if names.count(e.name) > 1 or any(places.count(x) > 1 for x in places_of(e))}
    if twice:
        raise ValueError(
            f"`free` sets {', '.join(sorted(twice))} more than once. Set each parameter once, either by its name "
            f"or by `tied`. The parameters are {', '.join(names)}."
        )
    joint: list[JointRow] = []
    parts = [new for part, item in declared for new in _with_groups(part, item, trials, joint)]
    entries = [e for part in parts for e in part.entries]
    parts, sums, fixed = _with_constraints(parts, constraints, joint)
    priors = [prior or (0.0, math.inf) for part in parts for prior in part.priors]
    parameters = Parameters(
        all_entries=tuple(entries),
        bijections=tuple(part.bijection for part in parts),
        start=floats([s for part in parts for s in part.start]),
        scale=floats([s for part in parts for s in part.scale]),
        prior_mean=floats([mean for mean, _ in priors]),
        prior_deviation=floats([deviation for _, deviation in priors]),
        places=on_device(np.arange(len(entries)), np.int32),
        rest=floats(np.zeros(len(entries))),
        **_joint_priors([e.name for e in entries], joint),
        **sums,
    )
    possible = np.isfinite(np.asarray(parameters.all_values(parameters.rest))) if sums else np.ones(1)
    if not possible.all():
        wrong = entries[int(np.argmin(possible))].name
        raise ValueError(
            f"`constraints`: with the initial guesses of the other parameters, {wrong} starts outside its bounds. Pass "
            "other initial guesses: Free(name, start=...)."
        )
    kept = [i for i in range(len(entries)) if i not in fixed]
    return parameters.subset(kept, parameters.rest) if fixed else parameters


class JointRow(NamedTuple):
    """A row of the joint priors: (sum of factors * values - target) / deviation.

    - `logarithmic`: whether the sum is over the logarithms of the values.
    - `distribution`: the name of the distribution, or "".
    """

    factors: dict[str, float]
    target: float
    deviation: float
    logarithmic: bool = False
    distribution: str = ""


def _joint_priors(names: Sequence[str], rows: Sequence[JointRow]) -> dict[str, Any]:
    n, matrix = len(names), np.zeros((len(rows), 2 * len(names)))
    for k, row in enumerate(rows):
        for name, factor in row.factors.items():
            matrix[k, names.index(name) + n * row.logarithmic] = factor
    of = [row.distribution for row in rows]
    return {
        "joint_matrix": floats(matrix),
        "joint_target": floats(np.array([row.target for row in rows])),
        "joint_deviation": floats(np.array([row.deviation for row in rows])),
        "distributions": tuple((d, of.index(d), of.index(d) + of.count(d)) for d in dict.fromkeys(filter(None, of))),
    }


def _with_groups(part: Part, item: Declaration, trials: Sequence[Trial], joint: list[JointRow]) -> list[Part]:
    """The part itself, or one part per group of trials. The mean of a distribution over the groups comes first.

    Rows for log-normal priors and distributions are appended to `joint`.
    """
    each, prior, entry = getattr(item, "each", None), getattr(item, "prior", None), part.entries[0]
    name = entry.name
    logarithmic = prior == "lognormal" or is_lognormal(prior)
    has_groups = each is not None and not item.is_eliminated
    refuse(
        (
            logarithmic and not part.bijection.bounds[0, 0] >= 0.0,
            f"{name}: a log-normal prior needs a positive parameter. Add bounds=(0.0, None).",
        ),
        (
            isinstance(prior, str) and not has_groups,
            f"{name}: prior={prior!r} is a distribution over groups, but the parameter has no groups. Add "
            "each='trial' or the name of a label.",
        ),
    )
    parts = [part]
    if has_groups:
        if not isinstance(each, str) or not trials:
            raise TypeError(
                f"{type(item).__name__} {name}: `each` must be 'trial' or a label of the trials of a fit, got {each!r}."
            )
        groups = dict.fromkeys(groups_of(trials, each))
        labels = [f"{value:g}" if isinstance(value, float) else str(value) for value in groups]
        parts = [
            part._replace(entries=[entry._replace(name=f"{name} [{label}]", group=(each, value))])
            for label, value in zip(labels, groups, strict=True)
        ]
    members = [one.entries[0].name for one in parts]
    if is_lognormal(prior):
        median, deviation = checked_prior(name, prior[1:])  # type: ignore[index]
        joint += [JointRow({member: 1.0}, math.log(median), deviation, True) for member in members]
    elif isinstance(prior, str):
        if len(members) < 3:
            raise ValueError(
                f"{name}: a distribution needs at least three groups, but {each!r} has {len(members)}. Pass "
                "prior=(mean, standard deviation), or omit `prior`."
            )
        mean = f"{'median' if logarithmic else 'mean'} of {name}"
        parts = [part._replace(entries=[entry._replace(name=mean)]), *parts]
        wide = 1.0 if logarithmic else part.scale[0]
        joint += [JointRow({member: 1.0, mean: -1.0}, 0.0, wide, logarithmic, name) for member in members]
    return parts


def _with_constraints(
    parts: Sequence[Part], constraints: Sequence[Linear | JointPrior], joint: list[JointRow]
) -> tuple[list[Part], dict[str, Any], list[int]]:
    """Replace one parameter by each exact sum or inequality.

    Rows for measured sums and joint priors are appended to `joint`.

    **Returns:** the parts, the fields of `Parameters` for the sums, and the indices that are fixed.
    """
    parts, fixed, inequalities = list(parts), [], []
    names = [e.name for part in parts for e in part.entries]
    owner = np.repeat(np.arange(len(parts)), [len(part.entries) for part in parts]).tolist()
    start = [s for part in parts for s in part.start]
    sums, limits = np.eye(len(names)), np.full((len(names), 2), [-math.inf, math.inf])
    for item in constraints:
        if not isinstance(item, (Linear, JointPrior)):
            raise TypeError(f"`constraints` must contain only Linear(...) and JointPrior(...), got {item!r}.")
        named = item.factors if isinstance(item, Linear) else item.mean
        refuse_unknown(
            named, names, f"{type(item).__name__} contains parameters that are not free:", "the free parameters are"
        )
        if isinstance(item, JointPrior):
            L = np.linalg.inv(np.linalg.cholesky(np.asarray(item.covariance, float)))
            means = L @ [float(x) for x in named.values()]
            joint += [
                JointRow(dict(zip(named, row, strict=True)), mean, 1.0) for row, mean in zip(L, means, strict=True)
            ]
            continue
        if item.std is not None:
            assert item.equals is not None
            joint.append(JointRow(dict(item.factors), item.equals, item.std))
            continue
        # Prefer a parameter without bounds, because only its own bijection keeps a parameter within its bounds. Among
        # those, prefer the largest scale in the sum.
        usual = {}
        for name, factor in item.factors.items():
            i = names.index(name)
            part = parts[owner[i]]
            if isinstance(part.bijection, Interval) and i not in (*fixed, *(place for _, place in inequalities)):
                usual[i] = not any(part.bijection.bounded), abs(factor) * part.scale[0]
        if not usual:
            raise ValueError(
                f"Linear({item.text}): none of its parameters can be computed from the others, because each belongs to "
                "an Inertia or to another sum. Add a parameter that is free by itself, or pass `std`."
            )
        i = max(usual, key=lambda i: usual[i])
        part = parts[owner[i]]
        sums[i] = [item.factors.get(name, 0.0) for name in names]
        limits[i] = part.bijection.bounds[0]
        if part.priors[0] is not None:  # the bijection now gives the sum, so the prior of the parameter becomes a row
            joint.append(JointRow({names[i]: 1.0}, *part.priors[0]))
        stated = Free("", bounds=(item.at_least, item.at_most), scale=usual[i][1])
        value = float(sums[i] @ start) if item.equals is None else item.equals
        new = scalar(Entry(item.text, part.entries[0].unit), stated, value).bijection
        parts[owner[i]] = part._replace(bijection=new, priors=[None])
        if item.equals is None:
            inequalities.append((item.text, i))
        else:
            fixed.append(i)
    if not fixed and not inequalities:
        return parts, {}, []
    if np.linalg.matrix_rank(sums) < len(names):
        raise ValueError("`constraints`: the exact sums are linearly dependent. Omit one of them.")
    fields = {"mixing": floats(np.linalg.inv(sums)), "limits": floats(limits), "inequalities": tuple(inequalities)}
    return parts, fields, fixed
