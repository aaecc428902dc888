"""From declarations (names, `Free`, `Gain`, `Inertia` and others) to the `Parameters` of a fit, with all checks."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..._common.lookup import as_names, hint, real_number, refuse_unknown
from ..._kane.right_hand_side import output_names
from ..._scalarjit.compat import on_device
from ..._system.parameters import ANY, ParameterInfo, declared, leaf_name, learned_part, names_of_leaf
from ..._system.system import System, unit_of, units_of
from .bijections import Interval, PossibleBody
from .declarations import (
    CalibrationTerm,
    Delay,
    Free,
    Inertia,
    Item,
    Items,
    JointPrior,
    Linear,
    LowPass,
    Named,
    NoiseScale,
    Offset,
    SpectralDensity,
    Where,
)
from .parameters import LOW_PASSES, Entry, Parameters, checked_prior, floats, places_of
from .trial import Trial, groups_of


def one_leaf(system: System, name: str, shape: tuple[int, ...] = ()) -> int:
    """The index of the leaf with this name. **Raises:** `ValueError` if there is no unique leaf with this shape."""
    (chosen, leaves) = find_leaves(system, name)
    if len(chosen) != 1 or leaves[chosen[0]][1].shape != shape:
        raise ValueError(
            f"Inertia: {type(system).__name__}.{name} must be one parameter with the shape {shape}, got "
            f"{[leaves[i][1].shape for i in chosen]}."
        )
    return chosen[0]


def find_leaves(system: System, where: str | Callable[[System], object]) -> tuple[list[int], list[Any]]:
    """The indices of the leaves that `where` selects, and all pairs (path, leaf)."""
    title = type(system).__name__
    leaves, structure = jax.tree_util.tree_flatten_with_path(system)
    if isinstance(where, str):
        chosen = [i for i, (path, _) in enumerate(leaves) if where in names_of_leaf(path)]
    else:
        numbered = jax.tree.unflatten(structure, range(len(leaves)))  # each leaf is its index
        try:
            chosen = jax.tree.leaves(where(numbered))
        except (AttributeError, IndexError, KeyError, TypeError):
            chosen = []
    if not chosen or not all(isinstance(i, int) and 0 <= i < len(leaves) for i in chosen):
        known = [leaf_name(path) for path, _ in leaves]
        raise ValueError(f"{title} has no parameter {where!r}; {hint(str(where), known, 'it has')}")
    for i in chosen:
        path, leaf = leaves[i]
        if not (eqx.is_inexact_array(leaf) and not jnp.issubdtype(leaf.dtype, jnp.complexfloating)):
            raise ValueError(
                f"{title}.{leaf_name(path)} is not a real floating-point number and cannot be fitted. Omit it from "
                "`free`, or use a value such as 1.0."
            )
    return chosen, leaves


def leaf_names(system: System) -> tuple[str, ...]:
    """The names of all parameters of a system, as they are used in `free`."""
    return tuple(leaf_name(path) for path, _ in jax.tree_util.tree_flatten_with_path(system)[0])


START_INSIDE = 0.1
"""The distance from the bound at which the search starts if the initial guess is at a bound. It is a fraction of the
scale, or of the distance between the bounds if that is less."""


POSITIVE = ParameterInfo(True, ())


def is_eliminated(item: Item) -> bool:
    """Whether the item is eliminated as an unknown of each trial (see `CalibrationTerm`)."""
    return isinstance(item, CalibrationTerm) and item.is_eliminated


def as_items(free: Any) -> list[Any]:
    """The argument `free` of a fit as a list."""
    if isinstance(free, (str, Free, Inertia, Named)) or callable(free):
        return [free]
    if not isinstance(free, Iterable):
        raise TypeError(f"`free` must be a name, a declaration such as Free('mass'), or a list of these, got {free!r}.")
    return list(free)


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
    free = as_items(free)
    for item in free:
        if isinstance(item, Free) and not isinstance(item.tied, Mapping):
            raise TypeError(f"`tied` must be a dict from names to factors, such as {{'rF': 1.0}}, got {item.tied!r}.")
        if not isinstance(getattr(item, "name", None), (str, type(None))):
            raise TypeError(f"`name` of an element of `free` must be a string, got {item.name!r}.")
    parts: list[Part] = []
    origins: list[Any] = []
    for item in free:
        if isinstance(item, CalibrationTerm):
            parts.append(_of_calibration(system, item, noise))
        elif isinstance(item, (SpectralDensity, NoiseScale)):
            parts.append(_of_noise(system, item, noise, channels))
        elif isinstance(item, Inertia):
            parts.append(_of_body(system, item))
        else:
            parts.extend(_of_leaves(system, item if isinstance(item, Free) else Free(item)))
        origins += [item] * (len(parts) - len(origins))
    entries = [e for part in parts for e in part[0]]
    names = [e.name for e in entries]
    places = [place for e in entries for place in places_of(e)]
    twice = [e.name for e in entries if any(places.count(place) > 1 for place in places_of(e))]
    twice += [name for name in names if names.count(name) > 1]
    if twice:
        raise ValueError(
            f"`free` sets {', '.join(sorted(set(twice)))} more than once. Set each parameter once, either by its name "
            f"or by `tied`. The parameters are {', '.join(names)}."
        )
    joint: list[JointRow] = []
    parts = [new for part, item in zip(parts, origins, strict=True) for new in _with_groups(part, item, trials, joint)]
    entries = [e for part in parts for e in part[0]]
    parts, sums, fixed = _with_constraints(parts, constraints, joint)
    priors = [prior if prior else (0.0, math.inf) for part in parts for prior in part[4]]
    parameters = Parameters(
        all_entries=tuple(entries),
        bijections=tuple(part[1] for part in parts),
        start=floats([s for part in parts for s in part[2]]),
        scale=floats([s for part in parts for s in part[3]]),
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


Part = tuple[list[Entry], Any, list[float], list[float], list[tuple[float, float] | None]]
"""Entries, their bijection, initial guesses, scales and priors."""


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
    """The fields of `Parameters` for joint priors."""
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


def _with_groups(part: Part, item: Item, trials: Sequence[Trial], joint: list[JointRow]) -> list[Part]:
    """The part itself, or one part per group of trials. The mean of a distribution over the groups comes first.

    Rows for log-normal priors and distributions are appended to `joint`.
    """
    entries, bijection, starts, scales, priors = part
    each, prior = getattr(item, "each", None), getattr(item, "prior", None)
    name, title = entries[0].name, type(item).__name__
    logarithmic = prior == "lognormal" or _is_lognormal(prior)
    if logarithmic and not float(bijection.lower) >= 0.0:
        raise ValueError(f"{name}: a log-normal prior needs a positive parameter. Add bounds=(0.0, None).")
    if each is None or is_eliminated(item):
        if isinstance(prior, str):
            raise ValueError(
                f"{name}: prior={prior!r} is a distribution over groups, but the parameter has no groups. Add "
                "each='trial' or the name of a label."
            )
        parts, members = [part], [name]
    else:
        if not isinstance(each, str) or not trials:
            raise TypeError(f"{title} {name}: `each` must be 'trial' or a label of the trials of a fit, got {each!r}.")
        groups = [*dict.fromkeys(groups_of(trials, each))]
        labels = [f"{value:g}" if isinstance(value, float) else str(value) for value in groups]
        members = [f"{name} [{label}]" for label in labels]
        parts = [([entries[0]._replace(name=member, group=(each, value))], bijection, starts, scales, priors)
                 for member, value in zip(members, groups, strict=True)]  # fmt: skip
    if _is_lognormal(prior):
        median, deviation = checked_prior(name, prior[1:])  # type: ignore[index]
        joint += [JointRow({member: 1.0}, math.log(median), deviation, True) for member in members]
    elif isinstance(prior, str):
        if len(members) < 3:
            raise ValueError(
                f"{name}: a distribution needs at least three groups, but {each!r} has {len(members)}. Pass "
                "prior=(mean, standard deviation), or omit `prior`."
            )
        mean = f"{'median' if logarithmic else 'mean'} of {name}"
        parts = [([entries[0]._replace(name=mean)], bijection, starts, scales, priors), *parts]
        wide = 1.0 if logarithmic else scales[0]
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
    names = [e.name for part in parts for e in part[0]]
    owner = np.repeat(np.arange(len(parts)), [len(part[0]) for part in parts]).tolist()
    start = [s for part in parts for s in part[2]]
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
            joint += [JointRow(dict(zip(named, row.tolist(), strict=True)), float(mean), 1.0)
                      for row, mean in zip(L, means, strict=True)]  # fmt: skip
            continue
        if item.std is not None:
            assert item.equals is not None
            joint.append(JointRow(dict(item.factors), item.equals, item.std))
            continue
        taken = {place for _, place in inequalities} | {*fixed}
        # Prefer a parameter without bounds, because only its own bijection keeps a parameter within its bounds. Among
        # those, prefer the largest scale in the sum.
        usual = {}
        for name, factor in item.factors.items():
            i = names.index(name)
            _, bijection, _, scales, _ = parts[owner[i]]
            if isinstance(bijection, Interval) and i not in taken:
                usual[i] = not any(bijection.bounded), abs(factor) * scales[0]
        if not usual:
            raise ValueError(
                f"Linear({item.text}): none of its parameters can be computed from the others, because each belongs to "
                "an Inertia or to another sum. Add a parameter that is free by itself, or pass `std`."
            )
        i = max(usual, key=lambda i: usual[i])
        entries, bijection, _, scales, priors = parts[owner[i]]
        sums[i] = [item.factors.get(name, 0.0) for name in names]
        limits[i] = float(bijection.lower), float(bijection.upper)
        if priors[0] is not None:  # the bijection now gives the sum, so the prior of the parameter becomes a row
            joint.append(JointRow({names[i]: 1.0}, *priors[0]))
        value = float(sums[i] @ start) if item.equals is None else item.equals
        stated = Named(item.text, bounds=(item.at_least, item.at_most), scale=usual[i][1])
        new = _scalar(Entry(item.text, entries[0].unit), stated, value, ANY)[1]
        parts[owner[i]] = (entries, new, parts[owner[i]][2], scales, [None])
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


def _of_calibration(system: System, item: CalibrationTerm, noise: Mapping[str, float] | None):
    kind, wheres = type(item).__name__.lower(), [where_of(system, item, name) for name in item.channels]
    if isinstance(item, LowPass):
        if item.order not in (1, 2):
            raise ValueError(f"LowPass({item.what!r}): `order` must be 1 or 2, got {item.order!r}.")
        kind = LOW_PASSES[int(item.order) - 1]
    if noise is not None and "sensor" in wheres and isinstance(item, (Delay, LowPass)):
        state = "delayed" if isinstance(item, Delay) else "low_pass"
        raise ValueError(
            f"{type(item).__name__}({item.what!r}): a fit with `noise` does not support delays or filters of sensors. "
            f"Add a state to the system instead: `jaxkane.sensors.{state}`."
        )
    label = f"{kind} of {'start of ' if item.of == 'start' else ''}{', '.join(item.channels)}"
    unit = item.unit or (units_of(system).get(item.channels[0], "") if isinstance(item, Offset) else "")
    roles = tuple((f"{kind} of {where}", name) for where, name in zip(wheres, item.channels, strict=True))
    return _scalar(Entry(item.name or label, unit, roles=roles), item, item.start, ANY)


def _of_noise(
    system: System, item: SpectralDensity | NoiseScale, noise: Mapping[str, float] | None, channels: Sequence[str]
):
    kind = "spectral density" if isinstance(item, SpectralDensity) else "noise scale"
    what, of = item.what, (noise or {}) if isinstance(item, SpectralDensity) else channels
    if noise is None:
        raise ValueError(
            f"{type(item).__name__}({what!r}) needs a fit with a likelihood, and `noise` is not given. Pass `noise`, "
            "the spectral densities of the disturbances by name, or {} without disturbances."
        )
    if what not in of:
        where = "`noise`" if isinstance(item, SpectralDensity) else "the measured channels"
        raise ValueError(f"{type(item).__name__}({what!r}): unknown name; {hint(what, tuple(of), f'{where} has')}")
    given = (noise[what] if item.start is None else item.start) if isinstance(item, SpectralDensity) else item.start
    start = real_number(given, f"{kind} of {what}: `start`")
    if not 0 < start < math.inf:
        raise ValueError(f"{kind} of {what}: `start` must be positive and finite, got {start}.")
    if item.bounds is not None:
        lower, upper = _checked_bounds(f"{kind} of {what}", item.bounds)
        if -math.inf < lower < 0:
            raise ValueError(f"{kind} of {what}: the lower bound must not be negative, got bounds={item.bounds}.")
        item = dataclasses.replace(item, bounds=(max(lower, 0.0), upper))
    known = unit_of(what, units_of(system)) if kind == "spectral density" else ""
    known = f"({known})" if set(known) & set(" /^") else known
    unit = (f"{known}^2 s" if what in system.inputs else f"{known}^2/s") if known else ""
    entry = Entry(item.name or f"{kind} of {what}", item.unit or unit, roles=((kind, what),))
    return _scalar(entry, item, start, POSITIVE)


def where_of(system: System, item: CalibrationTerm, what: str) -> Where:
    """Whether the name `what` of an item is an input, a sensor or an initial value.

    **Raises:** `ValueError` if the name does not exist.
    """
    title, kind, of = type(system).__name__, type(item).__name__, item.of
    wheres = {"Delay": ("input", "sensor"), "LowPass": ("sensor",)}.get(kind, ("input", "sensor", "start"))
    if of not in (None, *wheres):
        raise ValueError(f"{kind}({what!r}): `of` must be {', '.join(map(repr, wheres))} or None, got {of!r}.")
    of = wheres[0] if len(wheres) == 1 else of
    if of in (None, "input") and what in system.inputs:
        return "input"
    starts = (*system.coordinates, *system.speeds, *system.states) if of != "input" else ()
    sensors = (*starts, *system.dependent_speeds, *output_names(system)) if of in (None, "sensor") else ()
    among, named = {
        None: ((*system.inputs, *sensors), "input or channel"),
        "input": (system.inputs, "input"),
        "sensor": (sensors, "channel"),
        "start": (starts, "coordinate, independent speed or state"),
    }[of]
    if what not in among:
        raise ValueError(f"{title} has no {named} {what!r}; {hint(what, among, 'it has')}")
    return of or "sensor"


def _of_leaves(system: System, item: Free):
    chosen, leaves = find_leaves(system, item.where)
    followers = [follower for name, factor in item.tied.items() for follower in _followers(system, name, factor)]
    tied = [(declared(system, leaves[i][0]), factor) for i, _, factor in followers]
    parts = []
    for i in chosen:
        path, leaf = leaves[i]
        many = leaf.size > 1 or len(chosen) > 1
        if followers and many:
            raise ValueError(
                f"{leaf_name(path)} has several entries, and other parameters can be tied to a single number only. "
                "Omit `tied`."
            )
        for place, index in enumerate(np.ndindex(leaf.shape)):
            label = item.name if item.name and not many else leaf_name(path)
            label += str(list(index)) if leaf.ndim else ""
            start = float(leaf[index]) if item.start is None else item.start
            info = declared(system, path)
            targets = ((i, place, 1.0), *followers)
            entry = Entry(label, item.unit or info.unit, targets, part=learned_part(system, path))
            parts.append(_scalar(entry, item, start, info, tied))
    return parts


def _followers(system: System, name: str, factor: float) -> list[tuple[int, int, float]]:
    """Triples (index of the leaf, index of the entry, factor) of every entry of a tied parameter."""
    factor = real_number(factor, f"`tied`: the factor of {name}")
    chosen, leaves = find_leaves(system, name)
    for path in (leaves[i][0] for i in chosen):
        if not math.isfinite(factor) or (factor <= 0 and declared(system, path).positive):
            must = "positive, as the parameter is declared" if math.isfinite(factor) else "a finite number"
            raise ValueError(f"`tied`: the factor of {leaf_name(path)} must be {must}; got {factor}.")
    return [(i, place, float(factor)) for i in chosen for place in range(leaves[i][1].size)]


def _scalar(
    entry: Entry,
    item: Free | Named,
    start: Any,
    info: ParameterInfo,
    tied: Sequence[tuple[ParameterInfo, float]] = (),
):
    """The part of a single value, bounded by its own declaration and by those of the parameters tied to it."""
    name = entry.name
    start = real_number(start, f"{name}: `start`")
    if not math.isfinite(start):
        raise ValueError(f"{name}: the initial guess must be finite, got {start}. Pass another `start`.")
    stated = _checked_bounds(name, item.bounds)
    lower, upper = stated
    if item.bounds is None or stated != (-math.inf, math.inf):  # (None, None): a search without bounds
        limits = [_limits(what, factor) for what, factor in ((info, 1.0), *tied)]
        lower, upper = max(lower, *(low for low, _ in limits)), min(upper, *(high for _, high in limits))
    if isinstance(item.prior, str) and item.prior not in ("normal", "lognormal"):
        raise ValueError(
            f"{name}: `prior` must be (mean, standard deviation), 'normal' or 'lognormal', got {item.prior!r}."
        )
    alone = item.prior is not None and not isinstance(item.prior, str) and not _is_lognormal(item.prior)
    prior = checked_prior(name, item.prior) if alone else None
    scale = abs(start) or (prior[1] if prior is not None and math.isfinite(prior[1]) else 1.0)
    if item.scale is not None:
        scale = real_number(item.scale, f"{name}: `scale`")
        if not 0 < scale < math.inf:
            raise ValueError(f"{name}: `scale` must be positive and finite, got {item.scale}.")
    begin = start
    if start in (lower, upper) and info.allows(start):  # the slope of the bijection is zero at a bound
        begin += (1 if start == lower else -1) * START_INSIDE * min(scale, upper - lower)
    if not lower < begin < upper:
        raise ValueError(
            f"{name}: the initial guess {start:.6g} is not inside its bounds ({lower:g}, {upper:g}). These combine "
            "`bounds` with the declared limits of the parameter and of the parameters tied to it. Pass another `start`."
        )
    numbers = [jnp.asarray(float(x), jnp.result_type(float)) for x in (begin, lower, upper, scale)]
    bounded = (lower > -math.inf, upper < math.inf)
    bijection = Interval(*numbers, bounded=bounded, uniform=bool(np.all(np.isfinite(stated))))
    return [entry], bijection, [start], [scale], [prior]


def _is_lognormal(prior: Any) -> bool:
    """Whether the prior is ("lognormal", median, standard deviation of the logarithm)."""
    return isinstance(prior, (tuple, list)) and len(prior) == 3 and prior[0] == "lognormal"


def _limits(info: ParameterInfo, factor: float) -> tuple[float, float]:
    """The bounds of x for which the tied parameter factor * x is within its declared bounds."""
    low, high = info.within
    low = max(low, 0.0) if info.positive else low
    if not factor:
        return -math.inf, math.inf
    ends = low / factor, high / factor
    return min(ends), max(ends)


def _checked_bounds(name: str, bounds: Any) -> tuple[float, float]:
    """The bounds (lower, upper), infinite for None."""
    if bounds is None:
        return -math.inf, math.inf
    if isinstance(bounds, str) or not hasattr(bounds, "__len__") or len(bounds) != 2:
        raise ValueError(f"{name}: `bounds` must be (lower, upper), each a number or None, got {bounds!r}.")
    ends = zip(bounds, (-math.inf, math.inf), strict=True)
    lower, upper = (end if b is None else real_number(b, f"{name}: a bound") for b, end in ends)
    if not lower < upper:
        raise ValueError(
            f"{name}: the lower bound must be less than the upper bound, got bounds={bounds}. Pass None for no bound."
        )
    return lower, upper


_PRODUCTS = ((0, 1), (0, 2), (1, 2))


def _of_body(system: System, item: Inertia):
    """The part of an `Inertia`: a `PossibleBody` and its entries."""
    if (item.matrix is None) == (item.moments is None):
        raise ValueError("Inertia: pass `moments` (and `products`) or `matrix`, but not both.")
    for what in ("center", "moments", "products"):
        three = getattr(item, what)
        if three is not None and (isinstance(three, str) or len(three) != 3):
            raise ValueError(f"Inertia: `{what}` must be three names, got {three!r}.")
    names: list[str | None] = [item.mass, *item.center]
    spots: list[Any] = [None if name is None else (one_leaf(system, name), (0,)) for name in names]
    wheel = None
    if item.matrix is not None:
        leaf = one_leaf(system, item.matrix, (3, 3))
        pairs = [(0, 0), (1, 1), (2, 2), *_PRODUCTS]
        names += [f"{item.matrix}[{a}, {b}]" for a, b in pairs]
        spots += [(leaf, tuple({3 * a + b, 3 * b + a})) for a, b in pairs]
    else:
        moments = item.moments or ("", "", "")
        number = sum(name is not None for name in item.products)
        if number == 2 or (number and len(set(moments)) < 3):
            raise ValueError(
                f"Inertia: `products` = {item.products} does not match `moments` = {moments}. Name all three products, "
                "or one for a body with a plane of symmetry, or none for principal axes, such as those of a wheel."
            )
        if len(set(moments)) < 3:
            a, b = next((a, b) for a, b in _PRODUCTS if moments[a] == moments[b])
            wheel = (a, b)
        names += [*moments, *item.products]
        spots += [None if name is None else (one_leaf(system, name), (0,)) for name in (*moments, *item.products)]
    refuse_unknown(
        item.prior, [name for name in names if name], "Inertia: `prior` contains unknown names:", "the names are"
    )
    leaves = jax.tree.leaves(system)
    values = [0.0 if s is None else float(np.ravel(leaves[s[0]])[s[1][0]]) for s in spots]
    values[0] = values[0] if spots[0] is not None else 1.0
    fixed = as_names(item.fixed, "fixed")
    unknown = sorted(set(fixed) - {name for name in names[:4] if name})
    if unknown:
        raise ValueError(
            f"Inertia: `fixed` contains {', '.join(unknown)}. It may contain only the mass and the coordinates of the "
            "mass centre."
        )
    still = {i for i in range(4) if names[i] is None or names[i] in fixed} | ({4 + wheel[1]} if wheel else set())
    moves = tuple(i for i in range(10) if spots[i] is not None and i not in still)
    try:
        body = PossibleBody.of(values, moves, wheel)
    except ValueError as error:
        raise ValueError(f"Inertia of {', '.join(n for n in names[4:7] if n)}: {error}") from None
    units = ["kg", "m", "m", "m", *[item.unit] * 6]
    entries, start, scale, priors = [], [], [], []
    for i in moves:
        name, (leaf, places) = str(names[i]), spots[i]
        entries.append(Entry(name, units[i], tuple((leaf, place, 1.0) for place in places)))
        start.append(values[i])
        scale.append(abs(values[i]) or float(body.scale[i]) if i < 4 else abs(values[i]) or max(values[4:7]))
        priors.append(checked_prior(name, item.prior[name]) if name in item.prior else None)
    return entries, body, start, scale, priors
