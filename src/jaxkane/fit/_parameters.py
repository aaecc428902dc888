"""The free parameters of a fit, checked: free numbers to values and back, and subsets of them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float, Int

from .._common.lookup import as_names, hint, real_number, refuse_unknown
from .._kane.rhs import output_names
from .._scalarjit.cache_key import jit
from .._scalarjit.compat import Tracer, on_device
from .._scalarjit.function import ScalarFunction
from .._system.parameters import ANY, ParameterInfo, declared, leaf_name, learned_part, names_of_leaf
from .._system.system import System, unit_of, units_of
from ._bijections import Interval, PossibleBody
from ._declarations import (
    CalibrationTerm,
    Delay,
    Free,
    Inertia,
    LowPass,
    Named,
    NoiseScale,
    Offset,
    Prior,
    SpectralDensity,
    Where,
)


def one_leaf(system: System, name: str, shape: tuple[int, ...] = ()) -> int:
    """The leaf of this name, which has this shape."""
    (chosen, leaves) = find_leaves(system, name)
    if len(chosen) != 1 or leaves[chosen[0]][1].shape != shape:
        raise ValueError(f"{type(system).__name__}.{name} must have the shape {shape}.")
    return chosen[0]


def find_leaves(system: System, where: str | Callable[[Any], Any]) -> tuple[list[int], list[Any]]:
    """Numbers of the leaves that are meant, and all (path, leaf)."""
    title = type(system).__name__
    leaves, structure = jax.tree_util.tree_flatten_with_path(system)
    if isinstance(where, str):
        chosen = [i for i, (path, _) in enumerate(leaves) if where in names_of_leaf(path)]
    else:
        numbered = jax.tree.unflatten(structure, range(len(leaves)))  # where a leaf stands, its place in the list
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
            raise ValueError(f"{title}.{leaf_name(path)} is no real number and cannot be fitted.")
    return chosen, leaves


def leaf_names(system: System) -> tuple[str, ...]:
    """The names of all parameters of a system, by which they can be freed."""
    return tuple(leaf_name(path) for path, _ in jax.tree_util.tree_flatten_with_path(system)[0])


@dataclasses.dataclass(frozen=True)
class Entry:
    """One value: what it is called, and where it goes: (leaf, place, factor) of the system, or an input's role."""

    name: str
    unit: str
    targets: tuple[tuple[int, int, float], ...] = ()
    role: tuple[str, str] | None = (
        None  # such as ("gain of input", name), ("spectral density", disturbed), ("noise scale", channel)
    )
    part: str = ""  # the learned function that it belongs to

    @property
    def start_means_something(self) -> bool:
        """Whether its initial guess says of what size it is: not of a learned number, of the size of noise, nor of what
        has no zero of its own, as a delay."""
        kind = self.role[0].partition(" of ")[0] if self.role else ""
        return not self.part and kind not in ("spectral density", "noise scale", "offset", "delay", *LOW_PASSES)


class Parameters(eqx.Module):
    """The free parameters of a fit: x (p,), zero where the search begins and about one where much has changed, to
    values (p,). `start` are the initial guesses; of one on its bound the search begins inside (see `Free`).

    The maps are bijections, each from its own part of all x to as many values: see `Interval` and `PossibleBody`. Of a
    `subset` only those at `places` (p,) are free, and `rest` is the x of all. The places are data: every choice of as
    many runs the same compiled program.
    """

    all_entries: tuple[Entry, ...] = eqx.field(static=True)
    bijections: tuple[Interval | PossibleBody, ...]
    start: Float[Array, " p"]
    scale: Float[Array, " p"]
    prior_mean: Float[Array, " p"]
    prior_deviation: Float[Array, " p"]
    places: Int[Array, " p"]
    rest: Float[Array, " all"]

    @property
    def has_prior(self) -> np.ndarray:
        """Which of them (p,) have a prior."""
        return np.isfinite(np.asarray(self.prior_deviation))

    def subset(self, places: Sequence[int], x: Float[Array, " p"]) -> Parameters:
        """Those at `places`; all others keep their values at x."""
        names = ("start", "scale", "prior_mean", "prior_deviation", "places")
        new = {name: on_device(np.asarray(getattr(self, name))[list(places)]) for name in names}
        return dataclasses.replace(self, **new, rest=self.all(x))

    @property
    def size(self) -> int:
        """How many are free."""
        return self.places.size

    @property
    def whole(self) -> Parameters:
        """All of them, free, without priors: of every subset the same."""
        n, zeros = self.rest.size, jnp.zeros_like(self.rest)
        new = {"start": zeros, "scale": zeros, "prior_mean": zeros, "prior_deviation": jnp.full_like(zeros, jnp.inf)}
        return dataclasses.replace(self, **new, places=jnp.arange(n, dtype=self.places.dtype), rest=zeros)

    def all(self, x: Float[Array, " p"]) -> Float[Array, " all"]:
        """The x of all of them."""
        every = with_entries(self.rest, self.places, x)
        return every if _are_traced(every) else on_device(every)

    @property
    def sizes(self) -> tuple[int, ...]:
        """How many values each bijection has."""
        return tuple(f.size for f in self.bijections)

    @property
    def entries(self) -> tuple[Entry, ...]:
        return tuple(self.all_entries[i] for i in np.asarray(self.places).tolist())

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(e.name for e in self.entries)

    @property
    def owners(self) -> list[int]:
        """Of every value the number of its bijection."""
        return np.repeat(np.arange(len(self.sizes)), self.sizes).tolist()

    @property
    def units(self) -> tuple[str, ...]:
        return tuple(e.unit for e in self.entries)

    @property
    def learned(self) -> tuple[str, ...]:
        """Of every value the learned function that it belongs to, or "": such a number means nothing by itself."""
        return tuple(e.part for e in self.entries)

    @property
    def bounds(self) -> np.ndarray:
        """The least and the largest value of each (p, 2), infinite where there is none, as for the values of bodies."""
        none = [(-math.inf, math.inf)]
        pairs = [[(f.lower, f.upper)] if isinstance(f, Interval) else none * f.size for f in self.bijections]
        return np.array([pair for of_one in pairs for pair in of_one], float)[np.asarray(self.places)]

    def values(self, x: Float[Array, " p"]) -> Float[Array, " p"]:
        """Parameters in their own units."""
        return self._of_free(self._all_values(x))

    def inverse(self, values: Float[Array, " p"]) -> Float[Array, " p"]:
        """The x (p,) of parameters in their own units; NaN outside their bounds."""
        every = with_entries(self._each(_value, self.rest), self.places, values)
        return self._of_free(self._each(_inverse, every))

    def slopes(self, x: Float[Array, " p"]) -> Float[Array, "p p"]:
        """d values / d x."""
        return self._of_free(self._each(_slope, with_entries(self.rest, self.places, x)))

    def _each(self, evaluate: Any, numbers: Any) -> Any:
        """Of every bijection, joined: vectors in a row, matrices on the diagonal. Numbers are evaluated by a program of
        each kind of bijection, which all fits share, also while something else is traced."""
        if _are_traced(self, numbers):
            parts = [evaluate.__wrapped__(*pair) for pair in zip(self.bijections, self._parts(numbers), strict=True)]
            return jnp.concatenate(parts) if parts[0].ndim == 1 else jsl.block_diag(*parts)
        with jax.ensure_compile_time_eval():
            pairs = zip(self.bijections, self._parts(np.asarray(numbers)), strict=True)
            parts = [np.asarray(evaluate(*pair)) for pair in pairs]
        return np.concatenate(parts) if parts[0].ndim == 1 else scipy.linalg.block_diag(*parts)

    def _of_free(self, of_all: Any) -> Array:
        if _are_traced(self.places, of_all):
            return of_all[jnp.ix_(*[self.places] * of_all.ndim)]
        return on_device(of_all[np.ix_(*[np.asarray(self.places)] * of_all.ndim)])

    def log_determinant(self, x: Float[Array, " p"]) -> Array:
        """log |det d values / d x|: what a density over the values is multiplied by to be one over x."""
        pairs = zip(self.bijections, self._parts(self.all(x)), strict=True)
        return sum((jnp.linalg.slogdet(jax.jacfwd(f)(part))[1] for f, part in pairs), jnp.zeros((), x.dtype))

    def _all_values(self, x: Float[Array, " p"]) -> Any:
        every = with_entries(self.rest, self.places, x)
        return jnp.stack(_values(self.bijections, every)) if _are_traced(self, every) else self._each(_value, every)

    def _parts(self, x: Any) -> list[Any]:
        split = np.split if isinstance(x, np.ndarray) else jnp.split
        return split(x, np.cumsum(self.sizes)[:-1])

    @jit
    def apply(self, system: System, x: Float[Array, " p"]) -> tuple[System, dict[tuple[str, str], Array]]:
        """The system with these parameters; gains, offsets, delays and the noise's by ("gain of input", name)."""
        leaves, structure = jax.tree.flatten(system)
        calibration = {}
        values = _values(self.bijections, self.all(x))
        for entry, value in zip(self.all_entries, values, strict=True):
            if entry.role is not None:
                calibration[entry.role] = value
            for number, place, factor in entry.targets:
                leaf, new = leaves[number], factor * value
                new = new.astype(leaf.dtype)
                leaves[number] = new if leaf.ndim == 0 else jnp.ravel(leaf).at[place].set(new).reshape(leaf.shape)
        return jax.tree.unflatten(structure, leaves), calibration

    def prior_residuals(self, x: Float[Array, " p"]) -> Float[Array, " p"]:
        """(value - mean) / deviation; zero without a prior."""
        numbers = self.values(x), self.prior_mean, self.prior_deviation
        if _are_traced(numbers):
            return (numbers[0] - numbers[1]) / numbers[2]
        value, mean, deviation = map(np.asarray, numbers)
        return on_device((value - mean) / deviation)

    @property
    def log_prior_constants(self) -> np.ndarray:
        """log p(value) + prior_residual^2 / 2 of every entry (p,), with p its prior's density in its unit: the Gaussian
        inside the bounds, or uniform between them; NaN where it has neither."""
        parts = [self._parts(np.asarray(x, float)) for x in (self.prior_mean, self.prior_deviation)]
        constants = [f.log_prior_constants(*pair) for f, *pair in zip(self.bijections, *parts, strict=True)]
        return np.concatenate(constants)

    def with_priors(self, priors: Mapping[str, Prior]) -> Parameters:
        """The same parameters with priors (mean, standard deviation) by name; names that are not free are left out."""
        mean, deviation = np.array(self.prior_mean), np.array(self.prior_deviation)
        for i, name in enumerate(self.names):
            if name in priors:
                mean[i], deviation[i] = checked_prior(name, priors[name])
        new = (on_device(mean, self.start.dtype), on_device(deviation, self.start.dtype))
        return eqx.tree_at(lambda p: (p.prior_mean, p.prior_deviation), self, new)


@ScalarFunction.once
def _values(bijections: tuple[Interval | PossibleBody, ...], x: Array) -> list[Array]:
    """The value of each, as one program: XLA would make a dozen kernels of it."""
    places = np.cumsum([f.size for f in bijections])[:-1]
    return [y for f, part in zip(bijections, jnp.split(x, places), strict=True) for y in f(part)]


_value = jax.jit(lambda bijection, x: bijection(x))
_inverse = jax.jit(lambda bijection, values: bijection.inverse(values))
_slope = jax.jit(lambda bijection, x: jax.jacfwd(bijection)(x))


def _are_traced(*numbers: Any) -> bool:
    return any(isinstance(x, Tracer) for x in jax.tree.leaves(numbers))


def with_entries(every: Any, places: Any, some: Any) -> Any:
    """`every` with `some` at `places` of its first axis, each of them once; an array of NumPy unless one is traced."""
    if _are_traced(every, places, some):
        # Told that the places differ, JAX differentiates this as one assignment; else as ten kernels.
        return jnp.asarray(every).at[places].set(some, unique_indices=True, mode="promise_in_bounds")
    every = np.array(every)
    every[np.asarray(places)] = some
    return every


def checked_prior(name: str, prior: Any) -> Prior:
    try:
        mean, deviation = (real_number(x, f"{name}: in a prior, what is given") for x in prior)
    except (TypeError, ValueError):
        mean = deviation = math.nan
    if not (math.isfinite(mean) and deviation > 0):
        raise ValueError(f"{name}: a prior is (mean, standard deviation > 0), got {prior!r}.")
    return mean, deviation


START_INSIDE = 0.1
"""How far inside a bound that was given a search begins which would start on it, in scales (or of the bounds' width,
where that is less)."""


POSITIVE = ParameterInfo(True, ())


def as_items(free: Any) -> list[Any]:
    """What a fit takes as `free`, one by one."""
    if isinstance(free, (str, Free, Inertia, Named)) or callable(free):
        return [free]
    if not isinstance(free, Iterable):
        raise TypeError(
            f"`free` is what is to be found, one or a list of such, as 'mass' or Free('mass'); got {free!r}."
        )
    return list(free)


def parameters_of(
    system: System,
    free: Sequence[Any] | Any,
    noise: Mapping[str, float] | None = None,
    channels: Sequence[str] = (),
) -> Parameters:
    """The free parameters of a system, and of its process noise and sensors.

    **Raises:** `ValueError` that names a parameter, input, disturbed speed or channel that does not exist, is named
    twice, starts outside its bounds, or as a body that cannot be.
    """
    free = as_items(free)
    for item in free:
        if isinstance(item, Free) and not isinstance(item.tied, Mapping):
            raise TypeError(f"`tied` is a dict from names to factors, as {{'rF': 1.0}}; got {item.tied!r}.")
        if not isinstance(getattr(item, "name", None), (str, type(None))):
            raise TypeError(f"`name` of what is free is text, got {item.name!r}.")
    parts: list[tuple[list[Entry], Any, list[float], list[float], list[Prior | None]]] = []
    for item in free:
        if isinstance(item, CalibrationTerm):
            parts.append(_of_all_trials(system, item, noise))
        elif isinstance(item, (SpectralDensity, NoiseScale)):
            parts.append(_of_noise(system, item, noise, channels))
        elif isinstance(item, Inertia):
            parts.append(_of_body(system, item))
        else:
            parts.extend(_of_leaves(system, item if isinstance(item, Free) else Free(item)))
    if not parts:
        raise ValueError("`free` names no parameter: give names such as ('IBxx', 'steer_damping').")
    entries = [e for part in parts for e in part[0]]
    names = [e.name for e in entries]
    places = [place for e in entries for place in [*[t[:2] for t in e.targets], *([e.role] if e.role else [])]]
    twice = [e.name for e in entries if any(places.count(t[:2]) > 1 for t in e.targets) or places.count(e.role) > 1]
    twice += [name for name in names if names.count(name) > 1]
    if twice:
        raise ValueError(f"`free` names {', '.join(sorted(set(twice)))} twice, or ties it too: {', '.join(names)}.")
    priors = [prior if prior else (0.0, math.inf) for part in parts for prior in part[4]]
    array = lambda numbers: on_device(numbers, jnp.result_type(float))  # noqa: E731
    return Parameters(
        all_entries=tuple(entries),
        bijections=tuple(part[1] for part in parts),
        start=array([s for part in parts for s in part[2]]),
        scale=array([s for part in parts for s in part[3]]),
        prior_mean=array([mean for mean, _ in priors]),
        prior_deviation=array([deviation for _, deviation in priors]),
        places=on_device(np.arange(len(entries)), np.int32),
        rest=array(np.zeros(len(entries))),
    )


def _of_all_trials(system: System, item: CalibrationTerm, noise: Mapping[str, float] | None):
    kind, where = type(item).__name__.lower(), where_of(system, item)
    if isinstance(item, LowPass):
        if item.order not in (1, 2):
            raise ValueError(f"LowPass({item.what!r}): `order` is 1 or 2, got {item.order!r}.")
        kind = LOW_PASSES[int(item.order) - 1]
    if noise is not None and where == "sensor" and isinstance(item, (Delay, LowPass)):
        state = "delayed" if isinstance(item, Delay) else "low_pass"
        raise ValueError(
            f"{type(item).__name__}({item.what!r}): a filter of process noise compares each measurement with the "
            f"motion at its time. Let it be a state of the system, `jaxkane.sensors.{state}`."
        )
    label = f"{kind} of {'start of ' if where == 'start' else ''}{item.what}"
    unit = item.unit or (units_of(system).get(item.what, "") if isinstance(item, Offset) else "")
    entry = Entry(item.name or label, unit, role=(f"{kind} of {where}", item.what))
    return _scalar(entry, item, item.start, ANY)


LOW_PASSES = ("time constant", "time constant (twice)")
"""Kinds of `LowPass`, by their order."""


def _of_noise(
    system: System, item: SpectralDensity | NoiseScale, noise: Mapping[str, float] | None, channels: Sequence[str]
):
    kind = "spectral density" if isinstance(item, SpectralDensity) else "noise scale"
    what, of = item.what, (noise or {}) if isinstance(item, SpectralDensity) else channels
    if noise is None:
        raise ValueError(
            f"{type(item).__name__}({what!r}) is estimated by its likelihood, and this is a fit of least squares: give "
            "`noise`, the spectral densities of what disturbs the motion by name, or {} where nothing does."
        )
    if what not in of:
        where = "`noise`" if isinstance(item, SpectralDensity) else "the measured channels"
        raise ValueError(f"{type(item).__name__}({what!r}): {hint(what, tuple(of), f'{where} has')}")
    given = (noise[what] if item.start is None else item.start) if isinstance(item, SpectralDensity) else item.start
    start = real_number(given, f"{kind} of {what}: `start`")
    if not 0 < start < math.inf:
        raise ValueError(f"{kind} of {what} starts at {start}: it is searched for among positive numbers.")
    if item.bounds is not None:
        lower, upper = _checked_bounds(f"{kind} of {what}", item.bounds)
        if -math.inf < lower < 0:
            raise ValueError(f"{kind} of {what}: nothing below zero is possible, got the bounds {item.bounds}.")
        item = dataclasses.replace(item, bounds=(max(lower, 0.0), upper))
    known = unit_of(what, units_of(system)) if kind == "spectral density" else ""
    known = f"({known})" if set(known) & set(" /^") else known
    unit = (f"{known}^2 s" if what in system.inputs else f"{known}^2/s") if known else ""
    entry = Entry(item.name or f"{kind} of {what}", item.unit or unit, role=(kind, what))
    return _scalar(entry, item, start, POSITIVE)


def where_of(system: System, item: CalibrationTerm) -> Where:
    """Whether it is of an input, of a sensor or of the starts.

    **Raises:** `ValueError` where there is nothing of that name.
    """
    title, kind, of = type(system).__name__, type(item).__name__, item.of
    if not isinstance(item.what, str):
        raise TypeError(f"{kind}({item.what!r}): it takes the name of a channel, an input or a speed, a text.")
    wheres = {"Delay": ("input", "sensor"), "LowPass": ("sensor",)}.get(kind, ("input", "sensor", "start"))
    if of not in (None, *wheres):
        raise ValueError(f"{kind}({item.what!r}): `of` is {' or '.join(map(repr, wheres))}, or None; got {of!r}.")
    of = wheres[0] if len(wheres) == 1 else of
    if of in (None, "input") and item.what in system.inputs:
        return "input"
    starts = (*system.coordinates, *system.speeds, *system.states) if of != "input" else ()
    sensors = (*starts, *system.dependent_speeds, *output_names(system)) if of in (None, "sensor") else ()
    among, named = {
        None: ((*system.inputs, *sensors), "input or channel"),
        "input": (system.inputs, "input"),
        "sensor": (sensors, "channel"),
        "start": (starts, "coordinate, independent speed or state"),
    }[of]
    if item.what not in among:
        raise ValueError(f"{title} has no {named} {item.what!r}; {hint(item.what, among, 'it has')}")
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
            raise ValueError(f"{leaf_name(path)} has several entries; only a number can have others tied to it.")
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
    """(leaf, place, factor) of every entry of what is tied."""
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
    """Of one number: its declaration, and those of what follows it with a factor."""
    name = entry.name
    start = real_number(start, f"{name}: `start`")
    if not math.isfinite(start):
        raise ValueError(f"{name} starts at {start}.")
    stated = _checked_bounds(name, item.bounds)
    lower, upper = stated
    if item.bounds is None or stated != (-math.inf, math.inf):  # (None, None) asks for a search without bounds
        limits = [_limits(what, factor) for what, factor in ((info, 1.0), *tied)]
        lower, upper = max(lower, *(low for low, _ in limits)), min(upper, *(high for _, high in limits))
    prior = checked_prior(name, item.prior) if item.prior is not None else None
    scale = abs(start) or (prior[1] if prior is not None and math.isfinite(prior[1]) else 1.0)
    if item.scale is not None:
        scale = real_number(item.scale, f"{name}: `scale`")
        if not 0 < scale < math.inf:
            raise ValueError(f"{name}: the scale must be positive and finite, got {item.scale}.")
    begin = start
    if start in (lower, upper) and info.allows(start):  # where the bijection has no slope
        begin += (1 if start == lower else -1) * START_INSIDE * min(scale, upper - lower)
    if not lower < begin < upper:
        raise ValueError(
            f"{name} starts at {start:.6g}, which is not inside its bounds ({lower:g}, {upper:g}), those that it and "
            "what is tied to it were declared with among them: give it another `start`."
        )
    numbers = [jnp.asarray(float(x), jnp.result_type(float)) for x in (begin, lower, upper, scale)]
    bounded = (lower > -math.inf, upper < math.inf)
    bijection = Interval(*numbers, bounded=bounded, uniform=bool(np.all(np.isfinite(stated))))
    return [entry], bijection, [start], [scale], [prior]


def _limits(info: ParameterInfo, factor: float) -> tuple[float, float]:
    """Between which numbers x the parameter factor * x can be."""
    low, high = info.within
    low = max(low, 0.0) if info.positive else low
    if not factor:
        return -math.inf, math.inf
    ends = low / factor, high / factor
    return min(ends), max(ends)


def _checked_bounds(name: str, bounds: Any) -> tuple[float, float]:
    """(lower, upper), infinite where there is none."""
    if bounds is None:
        return -math.inf, math.inf
    if isinstance(bounds, str) or not hasattr(bounds, "__len__") or len(bounds) != 2:
        raise ValueError(f"{name}: `bounds` are (lower, upper), of which either may be None; got {bounds!r}.")
    ends = zip(bounds, (-math.inf, math.inf), strict=True)
    lower, upper = (end if b is None else real_number(b, f"{name}: a bound") for b, end in ends)
    if not lower < upper:
        raise ValueError(
            f"{name}: nothing lies between the bounds {bounds}; they are (lower, upper), or None for none."
        )
    return lower, upper


_PRODUCTS = ((0, 1), (0, 2), (1, 2))


def _of_body(system: System, item: Inertia):
    """One `PossibleBody` and its entries. A value is found by (leaf, places)."""
    if (item.matrix is None) == (item.moments is None):
        raise ValueError("Inertia: give `moments` (and `products`), or `matrix`.")
    for what in ("center", "moments", "products"):
        three = getattr(item, what)
        if three is not None and (isinstance(three, str) or len(three) != 3):
            raise ValueError(f"Inertia: `{what}` are three names, got {three!r}.")
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
                "Inertia: name all three `products`, or the one that a plane of symmetry leaves, or none where the "
                "axes are principal, as a wheel's are."
            )
        if len(set(moments)) < 3:
            a, b = next((a, b) for a, b in _PRODUCTS if moments[a] == moments[b])
            wheel = (a, b)
        names += [*moments, *item.products]
        spots += [None if name is None else (one_leaf(system, name), (0,)) for name in (*moments, *item.products)]
    refuse_unknown(item.prior, [name for name in names if name], "Inertia: `prior` names", "of this body are named")
    leaves = jax.tree.leaves(system)
    values = [0.0 if s is None else float(np.ravel(leaves[s[0]])[s[1][0]]) for s in spots]
    values[0] = values[0] if spots[0] is not None else 1.0
    fixed = as_names(item.fixed)
    unknown = sorted(set(fixed) - {name for name in names[:4] if name})
    if unknown:
        raise ValueError(f"Inertia: `fixed` may name the mass and the place of its centre, not {', '.join(unknown)}.")
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
