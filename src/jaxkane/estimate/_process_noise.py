"""White noise: what disturbs a motion at random, and how it is written as numbers. Knows no filter.

    dq = q_dot dt,   du = u_dot(t, q, u, x, inputs + e) dt + dw,   dx = x_dot(...) dt + dw

with w and the integral of e Wiener processes: Q is the spectral density of e, and dw has the variance Q dt.
What a sensor reads of accelerations and inputs is that of the motion without them: white noise has no value.

Within a short time h white noise is a sum of orthonormal polynomials (Legendre's) with independent coefficients of
variance one. What a coefficient does to the state at its end is a derivative of the simulation, as that by a
parameter is; so the covariance that the noise adds is C C^T, with the derivatives as the columns of C: never
indefinite, and right to the order h^(2 MODES + 1), as a Gauss quadrature with as many nodes is. (The first terms of the
expansion by Karhunen and Loeve: Lyons, Sarkka and Storkey, Series expansion approximations of Brownian motion, 2014.)
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
from .._system.system import State, System

MODES = 3
"""Polynomials of time by which the noise of one step is written."""


class Disturbance(eqx.Module):
    """White noise of spectral density one from t0 to t1 [s], times a factor: `xi` (MODES, n_w) its coefficients."""

    t0: Float[Array, ""]
    t1: Float[Array, ""]
    xi: Float[Array, "modes n_w"]
    names: tuple[str, ...] = eqx.field(static=True)
    speeds: tuple[str, ...] = eqx.field(static=True)
    states: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, t: Any, inputs: dict[str, Array], state: State) -> tuple[dict[str, Array], State]:
        """Inputs that are disturbed, and what is added to the rates of a state."""
        h = self.t1 - self.t0
        s = 2 * (t - self.t0) / h - 1
        legendre = jnp.stack([jnp.ones_like(s), 3**0.5 * s, 5**0.5 * (1.5 * s**2 - 0.5)])
        added = dict(zip(self.names, legendre @ self.xi / jnp.sqrt(h), strict=True))
        zero = jnp.zeros_like(s)
        row = lambda names: jnp.stack([added.get(name, zero) for name in names])  # noqa: E731
        x = None if state.x is None else row(self.states)
        of_inputs = {name: e for name, e in added.items() if name not in (*self.speeds, *self.states)}
        disturbed = inputs | {name: inputs.get(name, zero) + e for name, e in of_inputs.items()}
        return disturbed, State(jnp.zeros_like(state.q), row(self.speeds), x)


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
    names, density = checked_noise(system, noise, "`noise`")
    if window is not None:
        raise ValueError(
            "`noise` and `window` are two ways to follow a motion that one start does not determine: a filter, which "
            "goes on from every measurement, and windows, each with a start of its own. Give one of them."
        )
    return Noise(names, density, tuple(bool(x) for x in np.isfinite(np.asarray(deviations))))


def checked_noise(system: System, noise: Any, label: str) -> tuple[tuple[str, ...], Float[Array, " n_w"]]:
    """Names of what is disturbed, and spectral densities.

    **Raises:** `TypeError` and `ValueError` for what is no process noise, which begin with the label.
    """
    if not isinstance(noise, Mapping):
        example = f"{{{system.speeds[0]!r}: 0.1}}"
        raise TypeError(f"{label} is a dict of spectral densities by name, {example}; got {noise!r}.")
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
            raise ValueError(f"{label} names {name}; {hint(name, known, 'it may name')}{advice}")
        if not 0 <= real_number(density, f"{label}: the spectral density of {name}") < math.inf:
            raise ValueError(
                f"{label}: the spectral density of {name} is not negative, and finite; got {density!r}. A fit finds "
                f"it with SpectralDensity({name!r}) among `free`, starting from such a number."
            )
    return tuple(noise), jnp.asarray([float(x) for x in noise.values()], jnp.result_type(float))
