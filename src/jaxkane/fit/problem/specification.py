"""The specification of the problem that a fit solves: from declarations to `Parameters`, groups and constraints; checks
of names and initial values.
"""

from __future__ import annotations

import copy
import dataclasses
import inspect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np

from ..._common.lookup import as_names, hint, real_number, refuse, refuse_unknown
from ..._kane.consistent_state import AssemblyProblem, euler_parameters
from ..._kane.constraint_residuals import has_configuration_constraints
from ..._kane.right_hand_side import output_names
from ..._scalarjit.compat import on_device
from ..._system.system import System
from .declarations import Declaration, Delay, Free, Items, Part, is_lognormal, scalar
from .model import Nuisance, Simulation
from .parameters import Entry, Interval, Parameters, Prior, checked_prior, floats, places_of
from .trial import Trial, groups_of
from .windows import DelayRange, state_names


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


def as_items(free: object, kinds: tuple[type, ...] = (Declaration,)) -> list[Any]:
    """The argument `free` of a fit as a list, with a `Free` for each name and function.

    `kinds`: the types of elements that do not change.
    """
    items: Any = [free] if isinstance(free, (str, *kinds)) or callable(free) else free
    if not isinstance(items, Iterable):
        raise TypeError(f"`free` must be a name, a declaration such as Free('mass'), or a list of these, got {free!r}.")
    return [item if isinstance(item, kinds) else Free(item) for item in items]


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


Names = Sequence[str] | Mapping[str, float | None]
"""Names, or names with the standard deviation of a Gaussian prior around the initial guess (None: no prior)."""


@dataclasses.dataclass(frozen=True)
class ProblemSpec:
    """The specification of a `Problem` without its trials. `jaxkane.fit.fit` documents the arguments."""

    system: System
    free: Any
    _: dataclasses.KW_ONLY
    unknown: Names = ()
    priors: Mapping[str, Prior] | None = None
    constraints: Sequence[Linear | JointPrior] = ()
    zero_order_hold: Sequence[str] = ()
    window: float | None = None
    defect_std: Mapping[str, float] | None = None
    noise: Mapping[str, float] | None = None
    errors: Any = None
    simulation: Simulation | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "free", tuple(as_items(self.free)))
        for name, value in vars(self).items():
            if isinstance(value, (list, dict)):  # a copy, because the caller may change the original later
                object.__setattr__(self, name, copy.copy(value))
        if self.simulation is not None:
            refuse_other(self.simulation, Simulation, "`simulation=`", "Simulation(step=0.01)")
        dicts = {"priors": self.priors, "defect_std": self.defect_std}
        refuse(
            (
                not isinstance(self.system, System),
                f"`system` must be a jaxkane.System, got {type(self.system).__name__}.",
            ),
            *(
                (not isinstance(x, (Mapping, type(None))), f"`{n}` must be a dict, got {x!r}.")
                for n, x in dicts.items()
            ),
            error=TypeError,
        )
        other = "noise" if self.noise is not None else "defect_std"
        refuse(
            (
                self.window is not None and not real_number(self.window, "`window`") > 0,
                f"`window` must be a positive duration [s], got {self.window}.",
            ),
            (
                self.defect_std is not None and self.window is None,
                "`defect_std` is given without `window`. Pass the length of a window [s]: `defect_std` links the "
                "windows of a trial.",
            ),
            (
                self.errors is not None and getattr(self, other) is not None,
                f"Pass either `errors` or `{other}`, not both. Error models require a motion without process noise. "
                "With `noise`, `NoiseScale` in `free` estimates the standard deviation of a channel.",
            ),
        )


F = TypeVar("F", bound=Callable[..., Any])


def with_options(function: F) -> F:
    """Add the options of a `ProblemSpec`, which a function takes as `**options`, to its signature."""
    signature, spec = inspect.signature(function), inspect.signature(ProblemSpec)
    parameters = list(signature.parameters.values())
    options = [p for p in spec.parameters.values() if p.kind is p.KEYWORD_ONLY and p.name not in signature.parameters]
    places = [i for i, p in enumerate(parameters) if p.kind in (p.KEYWORD_ONLY, p.VAR_KEYWORD)]
    parameters[places[0] : places[0]] = options
    parameters = [p for p in parameters if p.kind is not p.VAR_KEYWORD]
    function.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    return function


def refuse_other(value: object, wanted: type, name: str, instead: str) -> None:
    """Check the type of an argument: some functions require a `Problem`, others a `Fit`.

    **Raises:** `TypeError` for another type.
    """
    if not isinstance(value, wanted):
        raise TypeError(f"{name} requires a {wanted.__name__}, as in {instead}; got {type(value).__name__}.")


def checked_trials(system: System, trials: Sequence[Trial]) -> tuple[str, ...]:
    """The channels of all trials.

    **Raises:** `ValueError` if the system has no such channel, input or initial value.
    """
    title = type(system).__name__
    named = (*system.coordinates, *system.speeds, *system.dependent_speeds, *system.states, *output_names(system))
    for trial in trials:
        for what, names, known in (
            ("channel", trial.measured, named),
            ("input", trial.inputs, system.inputs),
            ("coordinate, independent speed or state", trial.initial, state_names(system)),
        ):
            refuse_unknown(names, known, f"{trial.name}: {title} has no {what}")
    return tuple(dict.fromkeys(channel for trial in trials for channel in trial.measured))


def deviations_by_name(names: Names, argument: str = "unknown") -> dict[str, float | None]:
    """Each name with its standard deviation, or None."""
    return dict(names) if isinstance(names, Mapping) else dict.fromkeys(as_names(names, argument))


def checked_names(system: System, what: str, names: Names, known: Sequence[str]) -> dict[str, float]:
    """Each name with the standard deviation of its prior, infinite without a prior.

    **Raises:** `ValueError` for an unknown name, or a standard deviation that is not positive.
    """
    names = deviations_by_name(names, what)
    wrong = [name for name in names if name not in known]
    if wrong:
        raise ValueError(
            f"{type(system).__name__}: `{what}` contains unknown names: {', '.join(wrong)}; "
            f"{hint(wrong, known, 'the names are')}"
            + (" Dependent coordinates and speeds follow from the constraints." if what == "unknown" else "")
        )
    numbers = {}
    for name, deviation in names.items():
        label = f"`{what}`: the standard deviation of {name}"
        numbers[name] = float("inf") if deviation is None else real_number(deviation, label)
        if not numbers[name] > 0:
            raise ValueError(f"{label} must be positive, or None for no prior; got {deviation!r}.")
    return numbers


class StartAssembly(NamedTuple):
    """How `assemble` makes the initial states of windows satisfy the constraints.

    - `moved`: names of the coordinates that `assemble` adjusts; None for its default choice.
    - `quaternions`: indices of each set of four Euler parameters that every trial names. They are normalized first.
    - `guess`: by name, initial guesses other than zero for coordinates without data.
    """

    moved: tuple[str, ...] | None
    quaternions: tuple[tuple[int, ...], ...]
    guess: dict[str, float]


def start_assembly(system: System, trials: Sequence[Trial], unknown: Sequence[str]) -> StartAssembly:
    """How coordinates without data are computed.

    **Raises:** `ValueError` if a trial has no data for a coordinate that other trials specify.
    """
    by_trial = [{*trial.initial, *trial.measured, *unknown} for trial in trials]
    named = [c for c in system.coordinates if any(c in names for names in by_trial)]
    fours = [(four, {system.coordinates[i] for i in four}) for four in euler_parameters(system)]
    quaternions = tuple(four for four, names in fours if all(names <= known for known in by_trial))
    moved = AssemblyProblem.of(system, dict.fromkeys(named, 0.0)).moved
    guess = AssemblyProblem.of(system, dict.fromkeys([c for c in named if c not in unknown], 0.0)).guess
    t, q = (on_device(np.zeros(shape), jnp.result_type(float)) for shape in ((), len(system.coordinates)))
    if system.dependent_coordinates or not has_configuration_constraints(system, t, q):
        return StartAssembly(None, quaternions, guess)
    for trial, names in zip(trials, by_trial, strict=True):
        missing = [c for c in named if c not in names]
        if missing:
            raise ValueError(
                f"{trial.name}: there are no data for {', '.join(missing)}, whose initial value is specified by other "
                f"trials. Add it to `initial`, or define `dependent_coordinates` in {type(system).__name__}."
            )
    return StartAssembly(None if len(named) == len(system.coordinates) else moved, quaternions, guess)


def nuisance_of(spec: ProblemSpec, channels: Sequence[str], sampled: Sequence[str]) -> Nuisance:
    """The nuisance values. `sampled`: names of the inputs with samples."""
    system = spec.system
    items = [item for item in spec.free if item.is_eliminated]
    own = parameters_of(system, items, spec.noise, channels)
    of_window = np.array([item.each == "window" for item in items], bool)
    if of_window.any() and (spec.noise is not None or spec.defect_std is not None):
        raise ValueError(
            f"{own.names[int(np.argmax(of_window))]}: each='window' is not supported together with `noise` or "
            "`defect_std`. Use each='trial'."
        )
    # `Model.priors` is zero at z = 0 and b = 0. So these must be the prior mean, not the initial guess.
    center, deviation = np.where(own.has_prior, own.prior_mean, own.start), np.asarray(own.prior_deviation)
    for kind, name in (role for entry in own.entries for role in entry.roles):
        known = channels if kind.endswith("sensor") else system.inputs if kind == "offset of input" else sampled
        refuse_unknown(
            [name],
            known,
            f"{type(system).__name__}: {kind} with `each` needs samples of",
            "there are samples of",
        )
    turned = {system.coordinates[i] for four in euler_parameters(system) for i in four}
    independent = tuple(c for c in system.coordinates if c not in system.dependent_coordinates or c in turned)
    start = checked_names(system, "unknown", spec.unknown, (*independent, *system.speeds, *system.states))
    defects = checked_names(system, "defect_std", spec.defect_std or {}, tuple(start))
    return Nuisance(
        start=tuple(start),
        window=tuple(entry for entry, each in zip(own.entries, of_window, strict=True) if each),
        trial=tuple(entry for entry, each in zip(own.entries, of_window, strict=True) if not each),
        has_defects=spec.defect_std is not None,
        start_deviation=floats([*start.values(), *deviation[of_window]]),
        window_center=floats(center[of_window]),
        trial_center=floats(center[~of_window]),
        trial_deviation=floats(deviation[~of_window]),
        defect_std=floats([defects.get(name, float("inf")) for name in start]),
    )


def delay_range_of(trials: Sequence[Trial], parameters: Parameters, nuisance: Nuisance) -> DelayRange | None:
    """The largest delay and the largest advance of inputs [s], from the bounds; None if no input has a delay.

    **Raises:** `ValueError` if a delay may be longer than a trial.
    """
    if any(kind == "delay of input" for entry in nuisance.trial for kind, _ in entry.roles):
        # A delay of each trial has no bounds (`is_eliminated`), so all input samples of the trial are kept.
        return np.inf, np.inf
    shortest = min(trials, key=lambda trial: np.ptp(trial.t))
    ranges = [(0.0, 0.0)]
    for entry, start, (lower, upper) in zip(
        parameters.entries, np.asarray(parameters.start), parameters.bounds.tolist(), strict=True
    ):
        if not any(kind == "delay of input" for kind, _ in entry.roles):
            continue
        for delay in (lower, upper, float(start)):
            if np.isfinite(delay) and abs(delay) > np.ptp(shortest.t):
                raise ValueError(
                    f"The bounds of {entry.name} allow {delay:g} s, but {shortest.name} lasts only "
                    f"{np.ptp(shortest.t):.6g} s. Pass narrower `bounds`, or omit short trials."
                )
        ranges.append((upper, -lower))
    latest, earliest = map(max, zip(*ranges, strict=True))
    return (latest, earliest) if len(ranges) > 1 else None


def delayed_inputs(spec: ProblemSpec) -> tuple[dict[str, float], dict[str, float]]:
    """By input, the longest delay [s] of inputs with an upper bound and without `before`; and by input, the value of
    `before`."""
    longest_delays, before = {}, {}
    for item in (item for item in spec.free if isinstance(item, Delay) and item.of != "sensor"):
        upper = (item.bounds or (None, None))[1]
        for name in {*item.channels} & {*spec.system.inputs}:
            if item.before is not None:
                before[name] = real_number(item.before, f"Delay({name!r}): `before`")
            elif upper is not None:
                longest_delays[name] = max(upper, 0.0)
    return longest_delays, before
