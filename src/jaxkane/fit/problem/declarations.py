"""Declarations of parameters to estimate. Each makes its entries, with their bijection, initial guesses and priors."""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..._common.lookup import as_names, hint, positive_number, real_number, refuse, refuse_if, refuse_unknown
from ..._kane.right_hand_side import output_names
from ..._system.parameters import ANY, ParameterInfo, declared, leaf_name, learned_part, names_of_leaf
from ..._system.system import System, unit_of, units_of
from .parameters import LOW_PASSES, Bijection, Entry, Interval, Prior, checked_prior

Bounds = tuple[float | None, float | None]
Where = Literal["input", "sensor", "start"]


class Part(NamedTuple):
    """Declared parameters that share one bijection. `start`, `scale`, `priors`: initial guesses, scales and priors."""

    entries: list[Entry]
    bijection: Bijection
    start: list[float]
    scale: list[float]
    priors: list[tuple[float, float] | None]


@dataclasses.dataclass(frozen=True)
class Declaration(abc.ABC):
    """An element of the argument `free` of a fit. Subclasses are frozen dataclasses."""

    @abc.abstractmethod
    def parts(self, system: System, noise: Mapping[str, float] | None, channels: Sequence[str]) -> list[Part]:
        """The declared parameters. `noise`, `channels`: those of the fit.

        **Raises:** `ValueError` if the system, the noise or the channels do not contain them.
        """

    @property
    def is_eliminated(self) -> bool:
        """Whether each trial or window has its own value, which is eliminated in every step and reported in
        `Fit.nuisance`."""
        return False


Item = str | Callable[[System], object] | Declaration
Items = Item | Sequence[Item]
"""The argument `free` of a fit."""


@dataclasses.dataclass(frozen=True)
class Free(Declaration):
    """A parameter to estimate, with its bounds, scale and prior.

        Free("IBxx", bounds=(0.5, 20.0)), Free(lambda system: system.body.mass, prior=(12.0, 0.5))

    **Arguments:**

    - `where`: a name ("IBxx"), a path ("body.mass"), or a function from the system to a leaf as in `eqx.tree_at`. Each
        entry of an array is estimated separately.
    - `start`: the initial guess, in the parameter's unit; by default the value of the system.
    - `bounds`: (lower, upper), in the parameter's unit; either may be None. The declarations `positive` (on a
        logarithmic scale) and `within`, of this parameter and of those tied to it, are bounds too. With (None, None),
        the search is not bounded. If the initial guess is at a bound, the search starts a tenth of the scale inside:
        `Free("dry", bounds=(0.0, None), scale=0.5)` starts at 0.05.
    - `scale`: a typical change of the parameter, in its unit. The default is the magnitude of `start`. If `start` is
        zero, the default is the standard deviation of the prior, or 1. Pass a scale in this case, because it is the
        unit in which a parameter is judged to be undetermined.
    - `prior`: (mean, standard deviation) from an independent measurement, or ("lognormal", median, standard deviation
        of the logarithm) for a positive parameter. With `each`, "normal" or "lognormal" is a distribution over the
        groups. Its mean and standard deviation are estimated too (mixed effects; `Fit.deviations`).
    - `tied`: by name, the factors of other parameters that are set to factor times this one, for example
        `Free("rR", tied={"rF": 1.0})`. For an array, this applies to all its entries.
    - `name`: the name in tables; by default that of the parameter.
    - `unit`: the unit in tables; by default that of the parameter.
    - `each`: None for one value in all trials, "trial" for one value per trial, or a label of the trials
        (`Trial.labels`) for one value per group: `Free("friction", each="rider")`.
    """

    where: str | Callable[[System], object]
    start: float | None = None
    bounds: Bounds | None = None
    scale: float | None = None
    prior: Prior | None = None
    # A frozen dataclass hashes all its fields, and a dict has no hash.
    tied: Mapping[str, float] = dataclasses.field(default_factory=dict, hash=False)
    name: str | None = None
    unit: str = ""
    each: str | None = None

    def parts(
        self, system: System, noise: Mapping[str, float] | None = None, channels: Sequence[str] = ()
    ) -> list[Part]:
        if not isinstance(self.tied, Mapping):
            raise TypeError(f"`tied` must be a dict from names to factors, such as {{'rF': 1.0}}, got {self.tied!r}.")
        chosen, leaves = find_leaves(system, self.where)
        followers: list[tuple[int, int, float]] = []
        limits = []
        for name, factor in self.tied.items():
            factor = real_number(factor, f"`tied`: the factor of {name}")
            for i in find_leaves(system, name)[0]:
                path, leaf = leaves[i]
                info = declared(system, path)
                if not math.isfinite(factor) or (factor <= 0 and info.positive):
                    must = "positive, as the parameter is declared" if math.isfinite(factor) else "a finite number"
                    raise ValueError(f"`tied`: the factor of {leaf_name(path)} must be {must}; got {factor}.")
                followers += [(i, place, factor) for place in range(leaf.size)]
                limits.append(_limits(info, factor))
        parts = []
        for i in chosen:
            path, leaf = leaves[i]
            many, info = leaf.size > 1 or len(chosen) > 1, declared(system, path)
            if followers and many:
                raise ValueError(
                    f"{leaf_name(path)} has several entries, and other parameters can be tied to a single number only. "
                    "Omit `tied`."
                )
            for place, index in enumerate(np.ndindex(leaf.shape)):
                label = self.name if self.name and not many else leaf_name(path)
                label += str(list(index)) if leaf.ndim else ""
                targets = ((i, place, 1.0), *followers)
                entry = Entry(label, self.unit or info.unit, targets, part=learned_part(system, path))
                parts.append(
                    scalar(entry, self, float(leaf[index]) if self.start is None else self.start, info, limits)
                )
        return parts


@dataclasses.dataclass(frozen=True)
class Named(Declaration):
    """A parameter of the sensors, inputs or noise, not of the system. The options are as in `Free`."""

    what: str
    start: float | None = None
    bounds: Bounds | None = None
    scale: float | None = None
    prior: Prior | None = None
    name: str | None = None
    unit: str = ""


@dataclasses.dataclass(frozen=True)
class CalibrationTerm(Named):
    """A calibration parameter of an input, a sensor or the initial states. See `Gain`."""

    what: str | Sequence[str]
    start: float = 0.0
    of: Where | None = None
    each: str | None = None
    wheres: ClassVar[tuple[Where, ...]] = ("input", "sensor", "start")

    @property
    def kind(self) -> str:
        return type(self).__name__.lower()

    @property
    def channels(self) -> tuple[str, ...]:
        """The names of the inputs, channels or states."""
        try:
            return as_names(self.what, "what")
        except TypeError:
            raise TypeError(
                f"{type(self).__name__}({self.what!r}): the first argument must be the name of a channel, an input, a "
                "coordinate, a speed or a state, or a list of such names."
            ) from None

    @property
    def is_eliminated(self) -> bool:
        """A term with bounds, with a distribution as its prior or with `of="start"` is a parameter with an interval
        instead.
        """
        simple = self.bounds in (None, (None, None)) and not isinstance(self.prior, str) and self.of != "start"
        return simple and (self.each == "trial" or (self.each == "window" and isinstance(self, (Gain, Offset))))

    def parts(
        self, system: System, noise: Mapping[str, float] | None = None, channels: Sequence[str] = ()
    ) -> list[Part]:
        kind, wheres = self.kind, [self._where(system, name) for name in self.channels]
        if noise is not None and "sensor" in wheres and isinstance(self, (Delay, LowPass)):
            state = "delayed" if isinstance(self, Delay) else "low_pass"
            raise ValueError(
                f"{type(self).__name__}({self.what!r}): a fit with `noise` does not support delays or filters of "
                f"sensors. Add a state to the system instead: `jaxkane.sensors.{state}`."
            )
        label = f"{kind} of {'start of ' if self.of == 'start' else ''}{', '.join(self.channels)}"
        unit = self.unit or (units_of(system).get(self.channels[0], "") if isinstance(self, Offset) else "")
        roles = tuple((f"{kind} of {where}", name) for where, name in zip(wheres, self.channels, strict=True))
        return [scalar(Entry(self.name or label, unit, roles=roles), self, self.start)]

    def _where(self, system: System, what: str) -> Where:
        """Whether a name is an input, a sensor or an initial value."""
        title, kind, of = type(system).__name__, type(self).__name__, self.of
        if of not in (None, *self.wheres):
            raise ValueError(f"{kind}({what!r}): `of` must be {', '.join(map(repr, self.wheres))} or None, got {of!r}.")
        of = self.wheres[0] if len(self.wheres) == 1 else of
        if of in (None, "input") and what in system.inputs:
            return "input"
        starts = (*system.coordinates, *system.speeds, *system.states)
        sensors = (*starts, *system.dependent_speeds, *output_names(system)) if of in (None, "sensor") else ()
        among, named = {
            None: ((*system.inputs, *sensors), "input or channel"),
            "input": (system.inputs, "input"),
            "sensor": (sensors, "channel"),
            "start": (starts, "coordinate, independent speed or state"),
        }[of]
        refuse_unknown([what], among, f"{title} has no {named}", "it has")
        return of or "sensor"


@dataclasses.dataclass(frozen=True)
class Gain(CalibrationTerm):
    """A factor of an input, of a sensor, or of the given initial values.

        Gain("steer_torque"), Gain("roll_rate", prior=(1.0, 0.02)), Gain("rear_wheel_rate", of="start")

    **Arguments:** those of `Free`, and:

    - `what`: the name of an input, a channel, a coordinate, a speed or a state. Several names share one factor. For an
        input, the system receives gain * samples + offset. For a channel, gain * simulated + offset is compared with
        the measurement.
    - `of`: "input", "sensor" or "start". With "start", every window starts at gain * (initial value from its trial) +
        offset. An example is a speedometer with the same factor in all rides. By default, an input if the system has
        one of this name, else a sensor.
    - `each`: None for one factor in all trials, "trial" for one per trial, "window" for one per window of a fit with
        `window`, or a label of the trials (`Trial.labels`) for one per group. With "trial" and "window",
        `Fit.nuisance` contains the factors, and `prior` applies to each of them.
    """

    start: float = 1.0


@dataclasses.dataclass(frozen=True)
class Offset(CalibrationTerm):
    """A constant that is added to an input, to the reading of a sensor, or to the given initial values.

        Offset("roll", prior=(0.0, 0.02))                  # the zero of a sensor, the same in all rides
        Offset("roll", each="trial")                       # the sensor is calibrated before every ride
        Offset("roll", each="window", prior=(0.0, 0.01))   # the zero of the sensor drifts

    **Arguments:** those of `Gain`.

    - `scale`: by default 1, in the unit of the input, channel or state. Pass another scale if 1 is a large value,
        because the scale is the unit in which the offset is judged to be undetermined.
    """


@dataclasses.dataclass(frozen=True)
class Delay(CalibrationTerm):
    """The delay [s] of an input or a sensor. `Delay(("roll", "steer"))` is one delay of two channels.

    The system receives samples(t - delay) of a delayed input. An input is not recorded before its first sample:

    - With `before`, the input has this value before its first sample, and all measurements are used.
    - With an upper bound but without `before`, measurements are not used until this time after the first sample, and
        each trial starts there.
    - Without either, the input has the value of its first sample before it. The fit is then not `ok` if the estimated
        delay is longer than two sample intervals.

    With a zero-order hold, the delay shifts the discontinuities. With fixed integration steps, each discontinuity is
    replaced by a ramp of two steps.

    A delayed sensor reports simulated(t - delay). The simulation is interpolated by cubics between the samples and
    extrapolated linearly before a window, so the delay should be short compared with a window.

    **Arguments:** those of `Gain`, without `of="start"`.

    - `bounds`: (lower, upper) [s]. They also determine how many samples of the inputs outside a window are kept.
    - `scale`: by default two sample intervals [s].
    - `before`: the value of the input before its first sample, in its unit.
    """

    unit: str = "s"
    before: float | None = None
    wheres: ClassVar[tuple[Where, ...]] = ("input", "sensor")


@dataclasses.dataclass(frozen=True)
class LowPass(CalibrationTerm):
    """The time constant [s] of a low-pass filter of a sensor, in its electronics or in the data logger.

        time_constant dx/dt = simulated - x

    The simulated signal is linear between the samples. The filter of each window starts as if the signal had always had
    its initial slope. The estimated time constant is therefore too small if windows are shorter than about twenty time
    constants and their initial states are free. Fit whole trials in this case. A time constant of 0 does not change the
    signal. To use a filter with its own parameters, add a state to the system: `jaxkane.sensors.low_pass_second_order`.

    **Arguments:** those of `Free`, and:

    - `what`: the name of the channel.
    - `order`: 1, or 2 for the same filter applied twice, which is critically damped.
    - `scale`: by default two sample intervals [s].
    """

    bounds: Bounds | None = (0.0, None)
    unit: str = "s"
    order: Literal[1, 2] = 1
    wheres: ClassVar[tuple[Where, ...]] = ("sensor",)

    @property
    def kind(self) -> str:
        if self.order not in (1, 2):
            raise ValueError(f"LowPass({self.what!r}): `order` must be 1 or 2, got {self.order!r}.")
        return LOW_PASSES[int(self.order) - 1]


@dataclasses.dataclass(frozen=True)
class NoiseTerm(Named):
    """A parameter of the process noise or of the measurement noise. It is always positive."""

    def parts(
        self, system: System, noise: Mapping[str, float] | None = None, channels: Sequence[str] = ()
    ) -> list[Part]:
        title, is_density = f"{type(self).__name__}({self.what!r})", isinstance(self, SpectralDensity)
        if noise is None:
            raise ValueError(
                f"{title} needs a fit with a likelihood, and `noise` is not given. Pass `noise`, the spectral "
                "densities of the disturbances by name, or {} without disturbances."
            )
        known, where = (noise, "`noise` has") if is_density else (channels, "the measured channels are")
        refuse_unknown([self.what], known, f"{title}: unknown name", where)
        kind, unit = ("spectral density" if is_density else "noise scale"), ""
        label = f"{kind} of {self.what}"
        start = positive_number(noise[self.what] if self.start is None else self.start, f"{label}: `start`")
        lower, upper = _checked_bounds(label, self.bounds)
        refuse_if(
            -math.inf < lower < 0,
            f"{label}: the lower bound must not be negative, got bounds={self.bounds}. Pass 0 or None.",
        )
        stated = self if self.bounds is None else dataclasses.replace(self, bounds=(max(lower, 0.0), upper))
        if is_density and (own := unit_of(self.what, units_of(system))):
            own = f"({own})" if set(own) & set(" /^") else own
            unit = f"{own}^2 s" if self.what in system.inputs else f"{own}^2/s"
        entry = Entry(self.name or label, self.unit or unit, roles=((kind, self.what),))
        return [scalar(entry, stated, start, ParameterInfo(True, ()))]


@dataclasses.dataclass(frozen=True)
class SpectralDensity(NoiseTerm):
    """The spectral density of the process noise of a speed, a state or an input: see `noise` in `fit`.

    The spectral density is always positive.

    **Arguments:** those of `Free`, and:

    - `what`: the name of an independent speed or state [unit^2/s], or of an input [unit^2 s]. `noise` must contain it.
    - `start`: the initial guess; by default the value in `noise`.
    """


@dataclasses.dataclass(frozen=True)
class NoiseScale(NoiseTerm):
    """A factor of `Trial.sigma` of a channel, the same in all trials, in a fit with `noise`.

    The factor is always positive. If `sigma` is 1, the factor is the standard deviation in the channel's unit.

    **Arguments:** those of `Free`, and:

    - `what`: the name of the channel.
    """

    start: float = 1.0


START_INSIDE = 0.1
"""The distance from the bound at which the search starts if the initial guess is at a bound. It is a fraction of the
scale, or of the distance between the bounds if that is less."""


def scalar(
    entry: Entry,
    item: Free | Named,
    start: float,
    info: ParameterInfo = ANY,
    tied_limits: Sequence[tuple[float, float]] = (),
) -> Part:
    """A single value, bounded by its own declaration and by those of the parameters tied to it."""
    name = entry.name
    start = real_number(start, f"{name}: `start`")
    refuse((not math.isfinite(start), f"{name}: the initial guess must be finite, got {start}. Pass another `start`."))
    stated = lower, upper = _checked_bounds(name, item.bounds)
    if item.bounds is None or stated != (-math.inf, math.inf):  # (None, None): a search without bounds
        limits = [stated, _limits(info, 1.0), *tied_limits]
        lower, upper = max(low for low, _ in limits), min(high for _, high in limits)
    refuse(
        (
            isinstance(item.prior, str) and item.prior not in ("normal", "lognormal"),
            f"{name}: `prior` must be (mean, standard deviation), 'normal' or 'lognormal', got {item.prior!r}.",
        )
    )
    given = None if isinstance(item.prior, str) else item.prior
    prior = None if given is None or is_lognormal(given) else checked_prior(name, given)
    scale = abs(start) or (prior[1] if prior is not None and math.isfinite(prior[1]) else 1.0)
    if item.scale is not None:
        scale = positive_number(item.scale, f"{name}: `scale`")
    begin = start
    if start in (lower, upper) and info.allows(start):  # the slope of the bijection is zero at a bound
        begin += (1 if start == lower else -1) * START_INSIDE * min(scale, upper - lower)
    if not lower < begin < upper:
        raise ValueError(
            f"{name}: the initial guess {start:.6g} is not inside its bounds ({lower:g}, {upper:g}). These combine "
            "`bounds` with the declared limits of the parameter and of the parameters tied to it. Pass another `start`."
        )
    numbers = (jnp.asarray(float(x), jnp.result_type(float)) for x in (begin, lower, upper, scale))
    bounded = (lower > -math.inf, upper < math.inf)
    bijection = Interval(*numbers, bounded=bounded, uniform=bool(np.all(np.isfinite(stated))))
    return Part([entry], bijection, [start], [scale], [prior])


def is_lognormal(prior: object) -> bool:
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


def _checked_bounds(name: str, bounds: Bounds | None) -> tuple[float, float]:
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


def one_leaf(system: System, name: str, shape: tuple[int, ...] = ()) -> int:
    """The index of the leaf with this name. **Raises:** `ValueError` if there is no unique leaf with this shape."""
    (chosen, leaves) = find_leaves(system, name)
    if len(chosen) != 1 or leaves[chosen[0]][1].shape != shape:
        raise ValueError(
            f"Inertia: {type(system).__name__}.{name} must be one parameter with the shape {shape}, got "
            f"{[leaves[i][1].shape for i in chosen]}."
        )
    return chosen[0]


def leaf_names(system: System) -> tuple[str, ...]:
    """The names of all parameters of a system, as they are used in `free`."""
    return tuple(leaf_name(path) for path, _ in jax.tree_util.tree_flatten_with_path(system)[0])
