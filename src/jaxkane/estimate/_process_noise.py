"""White process noise and its approximation by random coefficients. Does not depend on filters.

    dq = q_dot dt,   du = u_dot(t, q, u, x, inputs + e) dt + dw,   dx = x_dot(...) dt + dw

w and the integral of e are Wiener processes: Q is the spectral density of e, and dw has the variance Q dt.
Accelerometers and sensors of inputs read the values without noise, because white noise has no value at an instant.

In a short time h, white noise is approximated by orthonormal Legendre polynomials with independent coefficients of
variance one. The effect of a coefficient on the state at the end is a derivative of the simulation, like the derivative
with respect to a parameter. The noise therefore adds the covariance C C^T, where the derivatives are the columns of C.
This covariance is never indefinite. Its order is h^(2 MODES + 1), like that of a Gauss quadrature with as many nodes.
Reference: Lyons, Sarkka and Storkey, Series expansion approximations of Brownian motion, 2014. The polynomials replace
the first terms of the Karhunen-Loeve expansion.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._common.lookup import real_number, refuse_unknown
from .._system.system import State, System

MODES = 3
"""Number of polynomials of time that approximate the noise of one step."""


class Disturbance(eqx.Module):
    """White noise from t0 to t1 [s]. Coefficients `xi` (MODES, n_w) of variance one give the spectral density one."""

    t0: Float[Array, ""]
    t1: Float[Array, ""]
    xi: Float[Array, "modes n_w"]
    names: tuple[str, ...] = eqx.field(static=True)
    speeds: tuple[str, ...] = eqx.field(static=True)
    states: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, t: Any, inputs: dict[str, Array], state: State) -> tuple[dict[str, Array], State]:
        """Disturbed inputs, and the noise that is added to the rates of a state."""
        h = self.t1 - self.t0
        s = 2 * (t - self.t0) / h - 1
        legendre = jnp.stack([jnp.ones_like(s), 3**0.5 * s, 5**0.5 * (1.5 * s**2 - 0.5)])
        added = dict(zip(self.names, legendre @ self.xi / jnp.sqrt(h), strict=True))
        zero = jnp.zeros_like(s)

        def row(names):
            return jnp.stack([added.get(name, zero) for name in names])

        x = None if state.x is None else row(self.states)
        of_inputs = {name: e for name, e in added.items() if name not in (*self.speeds, *self.states)}
        disturbed = inputs | {name: inputs.get(name, zero) + e for name, e in of_inputs.items()}
        return disturbed, State(jnp.zeros_like(state.q), row(self.speeds), x)


class Noise(eqx.Module):
    """The process noise of a fit.

    - `names`: names of the disturbed independent speeds, first-order states and inputs.
    - `spectral_density`: spectral densities (n_w,) that the user gave.
    - `random`: which unknowns of a trial (n_z + n_b,) have a standard deviation, and are therefore variables of the
        filter.
    - `starts_at_samples`: whether the motion of a trial starts at measured samples.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    spectral_density: Float[Array, " n_w"]
    random: tuple[bool, ...] = eqx.field(static=True)
    starts_at_samples: bool = eqx.field(static=True, default=False)

    def spectral_densities(self, calibration: Mapping[tuple[str, str], Array]) -> Array:
        """Spectral densities (n_w,). Free ones are read from `calibration` at ("spectral density", name)."""
        pairs = zip(self.names, self.spectral_density, strict=True)
        densities = [calibration.get(("spectral density", name), x) for name, x in pairs]
        return jnp.stack(densities) if densities else self.spectral_density


def noise_of(system: System, noise: Any, deviations: Array, window: float | None) -> Noise:
    """Check process noise by name. `deviations`: standard deviations (n_z + n_b,) of the unknowns of a trial."""
    names, density = checked_noise(system, noise, "`noise`")
    if window is not None:
        raise ValueError(
            "Pass either `noise` or `window`, not both. Both make the motion follow the measurements: `noise` by a "
            "filter, `window` by free initial states."
        )
    return Noise(names, density, tuple(bool(x) for x in np.isfinite(np.asarray(deviations))))


def checked_noise(system: System, noise: Any, label: str) -> tuple[tuple[str, ...], Float[Array, " n_w"]]:
    """Names of the disturbed quantities, and their spectral densities.

    **Raises:** `TypeError` and `ValueError` for invalid process noise. The messages begin with `label`.
    """
    if isinstance(noise, Mapping) and (impossible := {*noise} & {*system.dependent_speeds, *system.coordinates}):
        raise ValueError(
            f"{label} contains {', '.join(sorted(impossible))}. Coordinates and dependent speeds have no noise of "
            "their own: they follow from the independent speeds. Name independent speeds, first-order states or inputs."
        )
    known = (*system.speeds, *system.states, *system.inputs)
    density = checked_numbers(noise, known, label, f"To estimate one, add SpectralDensity({known[0]!r}) to `free`.")
    return tuple(density), jnp.asarray([*density.values()], jnp.result_type(float))


def checked_numbers(
    given: Any, known: Iterable[str], label: str, advice: str = "", positive: bool = False
) -> dict[str, float]:
    """Finite numbers by name, not negative.

    **Raises:** `TypeError` and `ValueError` for unknown names and other numbers. The messages begin with `label`.
    """
    if not isinstance(given, Mapping):
        raise TypeError(f"{label} must be a dict of numbers by name, got {given!r}. {advice}".rstrip())
    refuse_unknown(given, known, f"{label} contains unknown names:", "possible names are")
    numbers = {name: real_number(value, f"{label} of {name}") for name, value in given.items()}
    wrong = [name for name, x in numbers.items() if not 0 <= x < math.inf or (positive and x == 0)]
    if wrong:
        allowed = "positive and finite" if positive else "finite and not negative"
        raise ValueError(f"{label} of {wrong[0]} must be {allowed}, got {numbers[wrong[0]]}. {advice}".rstrip())
    return numbers
