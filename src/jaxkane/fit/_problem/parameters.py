"""The free parameters of a fit: free numbers to values and back. Knows the leaves of a system and no dynamics."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._common.real_numbers import real_number
from ..._description.system import System
from .bijections import Interval, PossibleBody
from .free import Prior


@dataclasses.dataclass(frozen=True)
class Entry:
    """One value: what it is called, and where it goes: (leaf, place, factor) of the system, or an input's role."""

    name: str
    unit: str
    targets: tuple[tuple[int, int, float], ...] = ()
    role: tuple[str, str] | None = None  # such as ("gain of input", name), ("intensity", disturbed), ("sigma", channel)
    part: str = ""  # the learned function that it belongs to

    @property
    def start_means_something(self) -> bool:
        """Whether its initial guess says of what size it is: not of a learned number, of the size of noise, nor of what
        has no zero of its own, as a delay."""
        kind = self.role[0].split()[0] if self.role else ""
        return not self.part and kind not in ("intensity", "sigma", "offset", "delay")


class Parameters(eqx.Module):
    """The free parameters of a fit: x (p,), zero where the search begins and about one where much has changed, to
    values (p,). `start` are the values that were given; of one on its bound the search begins inside (see `Free`).

    The maps are bijections, each from its own part of x to as many values: see `Interval` and `PossibleBody`.
    """

    entries: tuple[Entry, ...] = eqx.field(static=True)
    bijections: tuple[Interval | PossibleBody, ...]
    sizes: tuple[int, ...] = eqx.field(static=True)
    start: Float[Array, " p"]
    scale: Float[Array, " p"]
    prior_mean: Float[Array, " p"]
    prior_deviation: Float[Array, " p"]

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

    def values(self, x: Float[Array, " p"]) -> Float[Array, " p"]:
        """Parameters in their own units."""
        return jnp.concatenate([f(part) for f, part in zip(self.bijections, self._parts(x), strict=True)])

    def inverse(self, values: Float[Array, " p"]) -> Float[Array, " p"]:
        """The x (p,) of parameters in their own units; NaN outside their bounds."""
        parts = self._parts(values)
        return jnp.concatenate([f.inverse(part) for f, part in zip(self.bijections, parts, strict=True)])

    def slopes(self, x: Float[Array, " p"]) -> Float[Array, "p p"]:
        """d values / d x."""
        return jax.jacfwd(self.values)(x)

    def log_determinant(self, x: Float[Array, " p"]) -> Array:
        """log |det d values / d x|: what a density over the values is multiplied by to be one over x."""
        pairs = zip(self.bijections, self._parts(x), strict=True)
        return sum((jnp.linalg.slogdet(jax.jacfwd(f)(part))[1] for f, part in pairs), jnp.zeros((), x.dtype))

    def _parts(self, x: Any) -> list[Any]:
        split = np.split if isinstance(x, np.ndarray) else jnp.split
        return split(x, np.cumsum(self.sizes)[:-1])

    def apply(self, system: System, x: Float[Array, " p"]) -> tuple[System, dict[tuple[str, str], Array]]:
        """The system with these parameters; gains, offsets, delays and the noise's by ("gain of input", name)."""
        leaves, structure = jax.tree.flatten(system)
        roles = {}
        values = self.values(x)
        for i, entry in enumerate(self.entries):
            value = values[i]
            if entry.role is not None:
                roles[entry.role] = value
            for number, place, factor in entry.targets:
                leaf = leaves[number]
                flat = jnp.ravel(leaf).at[place].set((factor * value).astype(leaf.dtype))
                leaves[number] = flat.reshape(leaf.shape)
        return jax.tree.unflatten(structure, leaves), roles

    def prior_residuals(self, x: Float[Array, " p"]) -> Float[Array, " p"]:
        """(value - mean) / deviation; zero without a prior."""
        return (self.values(x) - self.prior_mean) / self.prior_deviation

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
        new = (jnp.asarray(mean, self.start.dtype), jnp.asarray(deviation, self.start.dtype))
        return eqx.tree_at(lambda p: (p.prior_mean, p.prior_deviation), self, new)


def checked_prior(name: str, prior: Any) -> Prior:
    try:
        mean, deviation = (real_number(x, f"{name}: in a prior, what is given") for x in prior)
    except (TypeError, ValueError):
        mean = deviation = math.nan
    if not (math.isfinite(mean) and deviation > 0):
        raise ValueError(f"{name}: a prior is (mean, standard deviation > 0), got {prior!r}.")
    return mean, deviation
