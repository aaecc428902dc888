"""White noise as numbers: what disturbs a motion within one step. Knows names and time; knows no filter.

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

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._system.system import State

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
