"""What disturbs a motion at random, and how it is written as numbers. Knows names and time; knows no filter.

    dq = q_dot dt,   du = u_dot(t, q, u, x, inputs + e) dt + dw,   dx = x_dot(...) dt + dw

with w and the integral of e Wiener processes: Q is the spectral density of e, and dw has the variance Q dt.
What a sensor reads of accelerations and inputs is that of the motion without them: white noise has no value.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._common.lookup import hint, real_number
from .._system.system import System


class Noise(eqx.Module):
    """What is disturbed, `names`: independent speeds, states and inputs; `spectral_density` (n_w,), as given.
    `random` (n_z + n_b,): which of a trial's unknowns have a standard deviation, and so are variables of the filter."""

    names: tuple[str, ...] = eqx.field(static=True)
    spectral_density: Float[Array, " n_w"]
    random: tuple[bool, ...] = eqx.field(static=True)

    def spectral_densities(self, calibration: Mapping[tuple[str, str], Array]) -> Array:
        """(n_w,), those that are free by ("spectral density", name)."""
        pairs = zip(self.names, self.spectral_density, strict=True)
        densities = [calibration.get(("spectral density", name), x) for name, x in pairs]
        return jnp.stack(densities) if densities else self.spectral_density


def noise_of(system: System, noise: Any, deviations: Array, window: float | None) -> Noise:
    """Process noise by name, checked. `deviations` (n_z + n_b,): of a trial's unknowns."""
    if not isinstance(noise, Mapping):
        example = f"{{{system.speeds[0]!r}: 0.1}}"
        raise TypeError(f"`noise` is a dict of spectral densities by name, {example}; got {noise!r}.")
    if window is not None:
        raise ValueError(
            "`noise` and `window` are two ways to follow a motion that one start does not determine: a filter, which "
            "goes on from every measurement, and windows, each with a start of its own. Give one of them."
        )
    known = (*system.speeds, *system.states, *system.inputs)
    for name, density in noise.items():
        if name not in known:
            advice = (
                " A dependent speed is disturbed by what disturbs the independent ones."
                if name in system.dependent_speeds
                else " A coordinate follows from the speeds: noise in its rate would break q_dot = q_dot(q, u)."
                if name in system.coordinates
                else ""
            )
            raise ValueError(f"`noise` names {name}; {hint(name, known, 'it may name')}{advice}")
        if not 0 <= real_number(density, f"`noise`: the spectral density of {name}") < math.inf:
            raise ValueError(
                f"`noise`: the spectral density of {name} is not negative, and finite; got {density!r}. "
                f"To estimate it, start from such a number and name SpectralDensity({name!r}) among `free`."
            )
    dtype = jnp.result_type(float)
    random = tuple(bool(x) for x in np.isfinite(np.asarray(deviations)))
    return Noise(tuple(noise), jnp.asarray([float(x) for x in noise.values()], dtype), random)
