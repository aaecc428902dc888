"""Some of the parameters of a problem, the others held where they stand. Knows `Parameters`; knows no system."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int

from .free import Prior
from .parameters import Parameters


class Part(eqx.Module):
    """In the place of `Parameters` in a `Model`: those at `places` (k,) of the `whole`; the others stay at `rest` (p,).

    Which they are is a number and no part of a compiled program: all choices of as many run the same one.
    """

    whole: Parameters
    places: Int[Array, " k"]
    rest: Float[Array, " p"]

    @property
    def _chosen(self) -> list[int]:
        return np.asarray(self.places).tolist()

    @property
    def entries(self) -> tuple[Any, ...]:
        return tuple(self.whole.entries[i] for i in self._chosen)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.whole.names[i] for i in self._chosen)

    @property
    def start(self) -> Float[Array, " k"]:
        return self.whole.start[self.places]

    @property
    def scale(self) -> Float[Array, " k"]:
        return self.whole.scale[self.places]

    @property
    def prior_mean(self) -> Float[Array, " k"]:
        return self.whole.prior_mean[self.places]

    @property
    def prior_deviation(self) -> Float[Array, " k"]:
        return self.whole.prior_deviation[self.places]

    def values(self, x: Float[Array, " k"]) -> Float[Array, " k"]:
        return self.whole.values(self._all(x))[self.places]

    def slopes(self, x: Float[Array, " k"]) -> Float[Array, "k k"]:
        return jax.jacfwd(self.values)(x)

    def apply(self, system: Any, x: Float[Array, " k"]) -> Any:
        return self.whole.apply(system, self._all(x))

    def prior_residuals(self, x: Float[Array, " k"]) -> Float[Array, " k"]:
        return self.whole.prior_residuals(self._all(x))[self.places]

    def with_priors(self, priors: Mapping[str, Prior]) -> Part:
        return dataclasses.replace(self, whole=self.whole.with_priors(priors))

    def _all(self, x: Array) -> Array:
        return self.rest.at[self.places].set(x)
