"""The free parameters of a fit: bijections between unconstrained variables and values, priors, and subsets."""

from __future__ import annotations

import abc
import contextlib
import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike
from scipy.special import log_ndtr

from ..._common.lookup import real_number
from ..._scalarjit.cache_key import jit
from ..._scalarjit.compat import Tracer, on_device
from ..._scalarjit.components import Numbers
from ..._scalarjit.scalar_function import ScalarFunction
from ..._system.system import System
from .trial import Trial, groups_of

Prior = tuple[float, float] | tuple[str, float, float] | Literal["normal", "lognormal"]


class Bijection(eqx.Module):
    """Maps unconstrained variables x (n,) to n physically possible values. Independent of a system.

    x is zero at the initial guess, and a change of x by one is typical.
    """

    @property
    def size(self) -> int:
        return 1

    @property
    def bounds(self) -> Float[np.ndarray, "n 2"]:
        """The lower and upper bounds of the values, infinite without a bound."""
        return np.tile([-np.inf, np.inf], (self.size, 1))

    @property
    def longest_steps(self) -> Float[np.ndarray, " n"]:
        """The longest allowed steps of x."""
        return np.full(self.size, np.inf)

    @abc.abstractmethod
    def __call__(self, x: Float[Array, " n"]) -> Float[Array, " n"]: ...

    @abc.abstractmethod
    def inverse(self, values: Float[Array, " n"]) -> Float[Array, " n"]: ...

    @abc.abstractmethod
    def log_prior_constants(self, mean: np.ndarray, deviation: np.ndarray) -> np.ndarray:
        """log p(values) + (values - mean)^2 / (2 deviation^2), (n,); NaN for a value without a density p."""


class Interval(Bijection):
    """A single value on the real line, a half-line or an interval.

        start + s x,   lower + (start - lower) exp(c x),   lower + (upper - lower) logistic(c x + d)

    c is such that the slope at the initial guess is `scale`. A positive parameter is start * exp(x).

    `uniform`: whether the user gave both bounds. Without a prior, the density is then uniform between them. The bounds
    in the declaration of a parameter only limit the search. They are not a prior.
    """

    start: Float[Array, ""]
    lower: Float[Array, ""]
    upper: Float[Array, ""]
    scale: Float[Array, ""]
    bounded: tuple[bool, bool] = eqx.field(static=True)
    uniform: bool = eqx.field(static=True, default=True)

    @property
    def far(self) -> float:
        """An x at which the value equals the bound within rounding. The x of the bound itself is infinite."""
        ends = [abs(float(self.start - end)) for end in (self.lower, self.upper) if np.isfinite(float(end))]
        # exp(-50) = 2e-22 is below the rounding error of float64.
        return 50.0 * max(ends) / float(self.scale)

    def __call__(self, x: Float[Array, " 1"]) -> Float[Array, " 1"]:
        start, scale = self.start, self.scale
        if self.bounded == (False, False):
            return start + scale * x
        if self.bounded == (False, True):
            return self.upper - (self.upper - start) * jnp.exp(-scale / (self.upper - start) * x)
        if self.bounded == (True, False):
            return self.lower + (start - self.lower) * jnp.exp(scale / (start - self.lower) * x)
        width, share = self._share(start)
        return self.lower + width * jax.nn.sigmoid(_logit(share) + scale / (width * share * (1 - share)) * x)

    def inverse(self, value: Float[Array, " 1"]) -> Float[Array, " 1"]:
        start, scale = self.start, self.scale
        if self.bounded == (False, False):
            return (value - start) / scale
        if self.bounded == (False, True):
            return -jnp.log((self.upper - value) / (self.upper - start)) * (self.upper - start) / scale
        if self.bounded == (True, False):
            return jnp.log((value - self.lower) / (start - self.lower)) * (start - self.lower) / scale
        width, share = self._share(start)
        return (_logit(self._share(value)[1]) - _logit(share)) * width * share * (1 - share) / scale

    @property
    def bounds(self) -> Float[np.ndarray, "1 2"]:
        return np.array([[self.lower, self.upper]], float)

    @property
    def longest_steps(self) -> Float[np.ndarray, " 1"]:
        """The longest allowed step of x: a factor of 20 in the distance to a bound.

        A linear prediction beyond a bound is a long step along the exponential. Without this limit, a friction
        coefficient became 1e-74. Its slope was then lost in rounding, and the search could not return.
        """
        near = np.sum(1.0 / np.abs(self.bounds - float(self.start)), axis=1)  # zero without bounds
        with np.errstate(divide="ignore"):
            return 3.0 / (near * float(self.scale))  # exp(3) = 20

    def log_prior_constants(self, mean: np.ndarray, deviation: np.ndarray) -> np.ndarray:
        """The Gaussian is truncated at the bounds. Without a prior (infinite standard deviation), the density is
        uniform if the user gave both bounds."""
        lower, upper = float(self.lower), float(self.upper)
        if np.all(np.isfinite(deviation)):
            return gaussian_constant(deviation) - log_gaussian_mass(
                (lower - mean) / deviation, (upper - mean) / deviation
            )
        return np.array([-np.log(upper - lower) if all(self.bounded) and self.uniform else np.nan])

    def _share(self, value: Array) -> tuple[Array, Array]:
        width = self.upper - self.lower
        return width, (value - self.lower) / width


def gaussian_constant(deviation: np.ndarray) -> np.ndarray:
    """The logarithm of the largest density of normal distributions."""
    return -np.log(deviation) - 0.5 * np.log(2 * np.pi)


def log_gaussian_mass(a: Numbers, b: Numbers) -> Any:
    """log (Phi(b) - Phi(a)) for a < b, without cancellation in either tail."""
    a, b = np.where(a > 0, -b, a), np.where(a > 0, -a, b)
    return log_ndtr(b) + np.log1p(-np.exp(log_ndtr(a) - log_ndtr(b)))


def _logit(share: Array) -> Array:
    return jnp.log(share) - jnp.log1p(-share)


LOW_PASSES = ("time constant", "time constant (twice)")
"""Kinds of `LowPass`, by their order."""


class Entry(NamedTuple):
    """One estimated value: a parameter of the system, of an input, of a channel or of the noise.

    - `name`: the name of the value.
    - `unit`: its unit.
    - `targets`: the entries of the system that are set: triples (index of the leaf, index of the entry, factor).
    - `roles`: pairs such as ("gain of input", name), ("spectral density", name), ("noise scale", channel).
    - `part`: the name of the learned function to which the value belongs, or "".
    - `group`: the label and its value for the trials to which the value applies; None for all trials.
    """

    # A tuple, because JAX compares these entries when it looks up a compiled program. With an __eq__ in Python, Ctrl-C
    # raised KeyboardInterrupt there. JAX converted it to a ValueError, and the fit was lost.
    name: str
    unit: str
    targets: tuple[tuple[int, int, float], ...] = ()
    roles: tuple[tuple[str, str], ...] = ()
    part: str = ""
    group: tuple[str, str | float] | None = None

    @property
    def start_means_something(self) -> bool:
        """Whether the initial guess indicates the size of the value. This is not so for learned parameters, noise,
        offsets, delays and time constants."""
        kind = self.roles[0][0].partition(" of ")[0] if self.roles else ""
        return not self.part and kind not in ("spectral density", "noise scale", "offset", "delay", *LOW_PASSES)


class Parameters(eqx.Module):
    """The free parameters of a fit: maps from unconstrained variables x (p,) to values (p,).

    The search starts at x = 0. A change of x by one is a typical change of the parameter. `start` contains the initial
    guesses. If one is at its bound, the search starts inside (see `Free`).

    Each map is a bijection from its own part of x to the same number of values: see `Interval` and `PossibleBody`. In a
    `subset`, only the entries at `places` (p,) are free, and `rest` contains the x of all entries. The places are data,
    so all subsets of the same size use the same compiled program.

    Joint priors of several values, and priors of logarithms, are rows (joint_matrix [values, log values] -
    joint_target) / joint_deviation. `distributions` contains (name, first row, end of the rows) of each distribution.
    Its standard deviation is estimated, in standard deviations of a residual.

    With exact sums and inequalities, the bijections give `mixing`^-1 values: each sum replaces one of its parameters.
    This parameter must remain within `limits` (all, 2). `inequalities` contains each sum as text and its index. The
    indices of exact sums are not free.
    """

    all_entries: tuple[Entry, ...] = eqx.field(static=True)
    bijections: tuple[Bijection, ...]
    start: Float[Array, " p"]
    scale: Float[Array, " p"]
    prior_mean: Float[Array, " p"]
    prior_deviation: Float[Array, " p"]
    places: Int[Array, " p"]
    rest: Float[Array, " all"]
    joint_matrix: Float[Array, "k 2*all"]
    joint_target: Float[Array, " k"]
    joint_deviation: Float[Array, " k"]
    distributions: tuple[tuple[str, int, int], ...] = eqx.field(static=True, default=())
    mixing: Float[Array, "all all"] | None = None
    limits: Float[Array, "all 2"] | None = None
    inequalities: tuple[tuple[str, int], ...] = eqx.field(static=True, default=())

    @property
    def has_prior(self) -> np.ndarray:
        """Whether each parameter (p,) has a prior, separate or joint."""
        return np.isfinite(np.asarray(self.prior_deviation)) | self._in_rows(slice(None))[np.asarray(self.places)]

    def _in_rows(self, rows: np.ndarray | slice) -> np.ndarray:
        """Whether each parameter, free or fixed, is part of these joint priors."""
        return np.any(np.asarray(self.joint_matrix)[rows] != 0, axis=0).reshape(2, -1).any(axis=0)

    @property
    def has_distribution(self) -> np.ndarray:
        """Whether each parameter (p,) is the value of a group that has a distribution over groups."""
        own = np.array([entry.group is not None for entry in self.all_entries])
        rows = np.zeros(len(self.joint_target), bool)
        for _, first, last in self.distributions:
            rows[first:last] = True
        return (own & self._in_rows(rows))[np.asarray(self.places)]

    @property
    def has_groups(self) -> bool:
        """Whether some parameters differ between trials."""
        return any(entry.group is not None for entry in self.all_entries)

    @property
    def shared_directions(self) -> Array:
        """Directions (p, n) of differentiation: one per parameter, shared by all groups of the parameter."""
        kinds = [tuple(places_of(e)) if e.group is not None else i for i, e in enumerate(self.all_entries)]
        of = np.array([[kind == other for other in dict.fromkeys(kinds)] for kind in kinds], float)
        return jnp.asarray(of)[self.places] if self.has_groups else jnp.eye(self.size)

    def applies(self, trials: Sequence[Trial]) -> np.ndarray:
        """Whether each parameter applies to each trial (T, all).

        **Raises:** `ValueError` that names a trial whose group has no value of a parameter.
        """
        groups = {each: groups_of(trials, each) for each, _ in filter(None, (e.group for e in self.all_entries))}
        own = np.ones((len(trials), len(self.all_entries)), bool)
        values: dict[Any, list[int]] = {}  # by the entries that they set, the parameters of one group or of all trials
        for i, entry in enumerate(self.all_entries):
            if entry.group is not None:
                each, value = entry.group
                own[:, i] = [group == value for group in groups[each]]
            values.setdefault(tuple(places_of(entry)), []).append(i)
        for same in values.values():
            has_value = own[:, same].any(axis=1)
            if not has_value.all():
                raise ValueError(
                    f"{trials[int(np.argmin(has_value))].name} belongs to none of the groups of "
                    f"{', '.join(self.all_entries[i].name for i in same)}. Omit the trial, or give the parameter "
                    "a distribution (prior='normal'), whose mean applies to other groups."
                )
        return own

    def subset(self, places: Sequence[int], x: Float[Array, " p"]) -> Parameters:
        """The parameters at `places`. All others keep their values at x."""
        names = ("start", "scale", "prior_mean", "prior_deviation", "places")
        new = {name: on_device(np.asarray(getattr(self, name))[list(places)]) for name in names}
        return dataclasses.replace(self, **new, rest=self.all(x))

    @property
    def size(self) -> int:
        return self.places.size

    @property
    def whole(self) -> Parameters:
        """All parameters as free ones, with the priors of this subset."""
        n, zeros = self.rest.size, jnp.zeros_like(self.rest)
        mean, deviation = map(on_device, self._all_priors)
        new = {"start": zeros, "scale": zeros, "prior_mean": mean, "prior_deviation": deviation}
        return dataclasses.replace(self, **new, places=jnp.arange(n, dtype=self.places.dtype), rest=zeros)

    @property
    def _all_priors(self) -> tuple[Any, Any]:
        """Means and standard deviations (all,) of the priors; infinite standard deviations for fixed parameters."""
        none, dtype = np.zeros(self.rest.size), self.start.dtype
        pairs = ((none, self.prior_mean), (none + math.inf, self.prior_deviation))
        mean, deviation = (with_entries(every.astype(dtype), self.places, np.asarray(x)) for every, x in pairs)
        return mean, deviation

    def all(self, x: Float[Array, " p"]) -> Float[Array, " all"]:
        """The unconstrained variables of all parameters, free or fixed."""
        every = with_entries(self.rest, self.places, x)
        return on_device(every) if isinstance(every, np.ndarray) else every

    @property
    def sizes(self) -> tuple[int, ...]:
        return tuple(f.size for f in self.bijections)

    @property
    def entries(self) -> tuple[Entry, ...]:
        return tuple(self.all_entries[i] for i in np.asarray(self.places).tolist())

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(e.name for e in self.entries)

    @property
    def owners(self) -> list[int]:
        """For every value, the index of its bijection."""
        return np.repeat(np.arange(len(self.sizes)), self.sizes)[np.asarray(self.places)].tolist()

    @property
    def units(self) -> tuple[str, ...]:
        return tuple(e.unit for e in self.entries)

    @property
    def learned(self) -> tuple[str, ...]:
        """For every value, the name of its learned function, or "". A learned value is not meaningful by itself."""
        return tuple(e.part for e in self.entries)

    @property
    def bounds(self) -> np.ndarray:
        """The lower and upper bound of each value (p, 2), infinite without a bound. Values of bodies are not
        bounded."""
        bounds = np.concatenate([f.bounds for f in self.bijections])
        if self.mixing is not None:
            own = np.any(np.asarray(self.mixing) != np.eye(len(bounds)), axis=1)
            bounds = np.where(own[:, None], np.asarray(self.limits), bounds)
        return bounds[np.asarray(self.places)]

    @property
    def longest_steps(self) -> np.ndarray:
        return np.concatenate([f.longest_steps for f in self.bijections])[np.asarray(self.places)]

    def values(self, x: Float[Array, " p"]) -> Float[Array, " p"]:
        """Parameters in their own units."""
        return self._of_free(self.all_values(x))

    def inverse(self, values: Float[Array, " p"]) -> Float[Array, " p"]:
        """The x (p,) of parameters in their own units; NaN outside their bounds."""
        every = self._each(_value, self.rest)  # contains sums instead of some parameters
        if self.mixing is not None:
            sums, free = np.linalg.inv(np.asarray(self.mixing)), np.isin(np.arange(every.size), np.asarray(self.places))
            new = np.array(with_entries(every, self.places, values))
            rest = sums[np.ix_(~free, free)] @ new[free]
            new[~free] = np.linalg.solve(sums[np.ix_(~free, ~free)], every[~free] - rest)
            every = sums @ new
        else:
            every = with_entries(every, self.places, values)
        return self._of_free(self._each(_inverse, every))

    def slopes(self, x: Float[Array, " p"]) -> Float[Array, "p p"]:
        """d values / d x."""
        return self._of_free(self.all_slopes(x))

    def all_slopes(self, x: Float[Array, " p"]) -> Any:
        """d all_values / d all x (all, all)."""
        slopes = self._each(_slope, with_entries(self.rest, self.places, x))
        return slopes if self.mixing is None else _numpy_of(slopes).asarray(self.mixing) @ slopes

    def _each(self, evaluate: Any, numbers: Numbers) -> Any:
        """The results of all bijections: concatenated vectors, or a block-diagonal matrix.

        Concrete numbers are evaluated by one compiled program per kind of bijection, which all fits share. This also
        applies while another function is traced.
        """
        xp, linalg = (jnp, jsl) if _numpy_of(self, numbers) is jnp else (np, scipy.linalg)
        split = xp.split(xp.asarray(numbers), np.cumsum(self.sizes)[:-1])
        with contextlib.nullcontext() if xp is jnp else jax.ensure_compile_time_eval():
            evaluate = evaluate.__wrapped__ if xp is jnp else evaluate
            parts = [xp.asarray(evaluate(*pair)) for pair in zip(self.bijections, split, strict=True)]
        return xp.concatenate(parts) if parts[0].ndim == 1 else linalg.block_diag(*parts)

    def _of_free(self, of_all: Numbers) -> Array:
        xp = _numpy_of(self.places, of_all)
        of_free = of_all[xp.ix_(*[xp.asarray(self.places)] * of_all.ndim)]
        return of_free if xp is jnp else on_device(of_free)

    def log_determinant(self, x: Float[Array, " p"]) -> Array:
        """log |det d values / d x|. Added to a log density of the values, this gives a log density of x."""
        return jnp.linalg.slogdet(jnp.asarray(self.slopes(x)))[1]

    def all_values(self, x: Float[Array, " p"]) -> Any:
        """The values of all parameters, free or fixed (all,)."""
        every = with_entries(self.rest, self.places, x)
        xp = _numpy_of(self, every)
        values = xp.stack(_values(self.bijections, every)) if xp is jnp else self._each(_value, every)
        if self.mixing is None:
            return values
        values, limits = xp.asarray(self.mixing) @ values, xp.asarray(self.limits)
        # A bijection does not keep a parameter that follows from a sum within its bounds. NaN makes the optimizer
        # reject such a step.
        return xp.where((values >= limits[:, 0]) & (values <= limits[:, 1]), values, xp.nan)

    @jit
    def apply(
        self, system: System, x: Float[Array, " p"], applies: Array | None = None
    ) -> tuple[System, dict[tuple[str, str], Array]]:
        """Set the parameters.

        **Arguments:**

        - `system`: the `System` to change.
        - `x`: the unconstrained variables (p,).
        - `applies`: whether each parameter applies to the trial (all,). By default, parameters of groups do not.

        **Returns:** the system, and a dict of gains, offsets, delays and noise parameters by ("gain of input", name).
        """
        leaves, structure = jax.tree.flatten(system)
        calibration = {}
        values = _values(self.bijections, self.all(x)) if self.mixing is None else [*self.all_values(x)]
        for i, (entry, value) in enumerate(zip(self.all_entries, values, strict=True)):
            if entry.group is not None and applies is None:
                continue

            def own(new: Array, old: Array, i: int = i, entry: Entry = entry):
                return new if entry.group is None else jnp.where(applies[i], new, old)  # type: ignore[index]

            calibration |= {role: own(value, calibration.get(role, value)) for role in entry.roles}
            for number, place, factor in entry.targets:
                leaf, new = leaves[number], factor * value
                new = own(new.astype(leaf.dtype), jnp.ravel(leaf)[place])
                leaves[number] = new if leaf.ndim == 0 else jnp.ravel(leaf).at[place].set(new).reshape(leaf.shape)
        return jax.tree.unflatten(structure, leaves), calibration

    @property
    def prior_terms(self) -> tuple[Any, Any, Any]:
        """Matrix (p + k, 2 all), targets and standard deviations (p + k,) of all priors: one row per parameter, with an
        infinite standard deviation without a prior, followed by the joint priors."""
        xp = _numpy_of(self)
        n, matrix, join = self.rest.size, xp.asarray(self.joint_matrix), xp.concatenate
        own = xp.eye(n, 2 * n, dtype=matrix.dtype)[xp.asarray(self.places)]
        targets, deviations = (self.prior_mean, self.joint_target), (self.prior_deviation, self.joint_deviation)
        return join([own, matrix]), *(join([*map(xp.asarray, pair)]) for pair in (targets, deviations))

    @np.errstate(invalid="ignore")  # a step of a search to an infinite value is rejected later
    def prior_residuals(self, x: Float[Array, " p"]) -> Any:
        """(matrix [values, log values] - target) / deviation (p + k,) of all priors; zero without a prior."""
        (matrix, target, deviation), xp = self.prior_terms, _numpy_of(self, x)
        values = xp.asarray(self.all_values(x))
        return (matrix @ xp.concatenate([values, xp.log(self._positive(values))]) - target) / deviation

    @np.errstate(invalid="ignore")  # a step of a search to an infinite value is rejected later
    def prior_rows(self, x: Float[Array, " p"]) -> Any:
        """The derivatives of `prior_residuals` by x, followed by the residuals: (p + k, p + 1)."""
        (matrix, _, deviation), xp, n = self.prior_terms, _numpy_of(self, x), self.rest.size
        by_values = matrix[:, :n] + matrix[:, n:] / self._positive(xp.asarray(self.all_values(x)))[None]
        slopes = by_values @ xp.asarray(self.all_slopes(x))[:, xp.asarray(self.places)]
        return xp.column_stack([slopes / deviation[:, None], self.prior_residuals(x)])

    def _positive(self, values: Numbers) -> Any:
        """The values (all,) with a prior of their logarithm; 1 for the others, which may be negative."""
        xp = _numpy_of(self, values)
        return xp.where(xp.any(xp.asarray(self.joint_matrix)[:, self.rest.size :] != 0, axis=0), values, 1.0)

    def sums(self, x: Float[Array, " p"]) -> np.ndarray:
        """All values (all,), in which each exact sum or inequality replaces one parameter."""
        return self._each(_value, self.all(x))

    def resting(self, place: int, x: Float[Array, " p"]) -> tuple[Parameters, np.ndarray] | None:
        """The parameters with the sum at this index fixed at its nearer bound, and the x that remain free.

        None if the sum is not near a bound, i.e. if its slope is above a tenth of that at the initial guess. With a
        smaller slope, the sum has covered nine tenths of the distance to the bound.
        """
        free = np.asarray(self.places)
        now, first = (abs(np.diagonal(self._each(_slope, at))[place]) for at in (self.all(x), np.zeros(self.rest.size)))
        if place not in free or not now < 0.1 * first:
            return None
        bijection: Any = self.bijections[self.owners[int(np.flatnonzero(free == place)[0])]]
        kept, value = np.flatnonzero(free != place), float(self.sums(x)[place])
        fixed = self.subset(kept.tolist(), x)
        rest = np.array(fixed.rest)
        rest[place] = bijection.far if value - bijection.lower >= bijection.upper - value else -bijection.far
        return dataclasses.replace(fixed, rest=on_device(rest)), np.asarray(x)[kept]

    @property
    def deviations(self) -> np.ndarray:
        """The standard deviations (n,) of the distributions, in standard deviations of a residual."""
        return np.asarray(self.joint_deviation, float)[[first for _, first, _ in self.distributions]]

    def with_deviations(self, deviations: np.ndarray) -> Parameters:
        """The same parameters with these standard deviations (n,) of the distributions."""
        new = np.array(self.joint_deviation)
        for (_, first, last), deviation in zip(self.distributions, deviations, strict=True):
            new[first:last] = deviation
        return dataclasses.replace(self, joint_deviation=on_device(new))

    @property
    def log_prior_constants(self) -> np.ndarray:
        """log p(value) + prior_residual^2 / 2 of every entry (p,), with p the prior density in the entry's unit.

        The density is Gaussian and truncated at the bounds, or uniform between the bounds. The result is NaN for
        entries without such a density and for entries with a joint prior.
        """
        parts = [np.split(np.asarray(x, float), np.cumsum(self.sizes)[:-1]) for x in self._all_priors]
        constants = [f.log_prior_constants(*pair) for f, *pair in zip(self.bijections, *parts, strict=True)]
        alone = ~self._in_rows(slice(None)) & (self.mixing is None)
        return np.where(alone, np.concatenate(constants), np.nan)[np.asarray(self.places)]

    def with_priors(self, priors: Mapping[str, Prior]) -> Parameters:
        """The same parameters with priors (mean, standard deviation) by name. Names that are not free are ignored."""
        mean, deviation = np.array(self.prior_mean), np.array(self.prior_deviation)
        for i, name in enumerate(self.names):
            if name in priors:
                mean[i], deviation[i] = checked_prior(name, priors[name])
        new = (on_device(mean, self.start.dtype), on_device(deviation, self.start.dtype))
        return eqx.tree_at(lambda p: (p.prior_mean, p.prior_deviation), self, new)


@ScalarFunction.compile_cheaply
def _values(bijections: tuple[Bijection, ...], x: Array) -> list[Array]:
    """The value of each bijection, as one scalar function. XLA would compile this to a dozen kernels."""
    places = np.cumsum([f.size for f in bijections])[:-1]
    return [y for f, part in zip(bijections, jnp.split(x, places), strict=True) for y in f(part)]


_value = jax.jit(lambda bijection, x: bijection(x))
_inverse = jax.jit(lambda bijection, values: bijection.inverse(values))
_slope = jax.jit(lambda bijection, x: jax.jacfwd(bijection)(x))


def _numpy_of(*numbers: Any) -> Any:
    """jax.numpy if one of the numbers is traced, else numpy."""
    return jnp if any(isinstance(x, Tracer) for x in jax.tree.leaves(numbers)) else np


def with_entries(every: Numbers, places: Numbers, some: Numbers) -> Any:
    """A copy of `every` with `some` at the unique indices `places` of the first axis. The result is a NumPy array if
    no argument is traced."""
    if _numpy_of(every, places, some) is jnp:
        # With `unique_indices`, JAX differentiates this as one assignment. Without it, the derivative is ten kernels.
        return jnp.asarray(every).at[places].set(some, unique_indices=True, mode="promise_in_bounds")
    every = np.array(every)
    every[np.asarray(places)] = some
    return every


def floats(numbers: ArrayLike) -> Array:
    """Numbers as an array of JAX, with its default type."""
    return on_device(numbers, jnp.result_type(float))


def places_of(entry: Entry) -> list[Any]:
    """The entries of the system and the roles that an entry sets."""
    return [*[target[:2] for target in entry.targets], *entry.roles]


def checked_prior(name: str, prior: Prior) -> tuple[float, float]:
    """A mean and a positive standard deviation."""
    try:
        mean, deviation = (real_number(x, f"{name}: in a prior, what is given") for x in prior)
    except (TypeError, ValueError):
        mean = deviation = math.nan
    if not (math.isfinite(mean) and deviation > 0):
        raise ValueError(
            f"{name}: `prior` must be (mean, standard deviation) with a positive standard deviation, got {prior!r}."
        )
    return mean, deviation
