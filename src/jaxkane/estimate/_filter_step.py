"""One step of a Kalman filter: white process noise, moments of a function, and their update in square-root form.

Shared by `fit` and `estimate`; `export.c_filter` writes the same step in C. Does not depend on filters.

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
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._common.lookup import real_number, refuse_unknown
from .._scalarjit.components import Component, as_vector
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

    def __call__(self, t: Component, inputs: dict[str, Array], state: State) -> tuple[dict[str, Array], State]:
        """Disturbed inputs, and the noise that is added to the rates of a state."""
        h = self.t1 - self.t0
        s = 2 * (t - self.t0) / h - 1
        legendre = jnp.stack([jnp.ones_like(s), 3**0.5 * s, 5**0.5 * (1.5 * s**2 - 0.5)])
        added = dict(zip(self.names, legendre @ self.xi / jnp.sqrt(h), strict=True))
        zero = jnp.zeros_like(s)

        def row(names: Sequence[str]):
            return as_vector([added.get(name, zero) for name in names], s)

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


def noise_of(system: System, noise: Mapping[str, float], deviations: Array, window: float | None) -> Noise:
    """Check process noise by name. `deviations`: standard deviations (n_z + n_b,) of the unknowns of a trial."""
    names, density = checked_noise(system, noise, "`noise`")
    if window is not None:
        raise ValueError(
            "Pass either `noise` or `window`, not both. Both make the motion follow the measurements: `noise` by a "
            "filter, `window` by free initial states."
        )
    return Noise(names, density, tuple(bool(x) for x in np.isfinite(np.asarray(deviations))))


def checked_noise(
    system: System, noise: Mapping[str, float], label: str
) -> tuple[tuple[str, ...], Float[Array, " n_w"]]:
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
    given: Mapping[str, float], known: Iterable[str], label: str, advice: str = "", positive: bool = False
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


def root(A: Float[Array, "n k"]) -> tuple[Float[Array, "n n"], Float[Array, "k n"]]:
    """S (n, n) = A Q with S S^T = A A^T, k >= n, and Q (k, n), whose columns are orthonormal.

    Q is constant in derivatives: dS = dA Q. This satisfies d(S S^T) = d(A A^T), because the rows of A are linear
    combinations of the columns of Q. Unlike the derivative of a triangular factor, it also exists if A does not have
    full rank.
    """
    Q = jax.lax.stop_gradient(jnp.linalg.qr(jax.lax.stop_gradient(A).T)[0])
    return A @ Q, Q


@jax.custom_jvp
def polar(B: Float[Array, "n k"]) -> tuple[Float[Array, "n n"], Float[Array, "n k"], Float[Array, "n n"]]:
    """The polar decomposition B = H X: the symmetric root H (n, n) of B B^T, X (n, k), and I - X X^T.

    X X^T is the projection onto the range of B. H depends only on the covariance B B^T, even if this is singular. A
    rounding error of B changes H by at most twice as much (Higham, Functions of Matrices, 2008, Section 8.2). A
    triangular root has neither property: if B does not have full rank, its columns depend on rounding errors.
    """
    return _polar(B)[:3]


def _polar(B: Array) -> Any:
    U, s, V = jnp.linalg.svd(B, full_matrices=False)
    # Singular values of rounding errors have arbitrary vectors, and `inverse` would divide by them.
    known = s > float(jnp.finfo(B.dtype).eps) ** (2 / 3) * s[0]
    inside, outside = jnp.where(known[None], U, 0.0), jnp.where(known[None], 0.0, U)
    return (U * s[None]) @ U.T, inside @ V, outside @ outside.T, U, s, known


@polar.defjvp
def _polar_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Any, Any]:
    """H dH + dH H = d(B B^T),  X = H^+ B. Exact as long as the rank does not change."""
    (B,), (dB,) = primals, tangents
    H, X, rest, U, s, known = _polar(B)
    half, either = U.T @ dB @ (B.T @ U), known[:, None] | known[None, :]
    dH = U @ jnp.where(either, (half + half.T) / jnp.where(either, s[:, None] + s[None, :], 1.0), 0.0) @ U.T
    inverse = (U * jnp.where(known, 1 / jnp.where(known, s, 1.0), 0.0)[None]) @ U.T
    turn = rest @ dH @ inverse
    return (H, X, rest), (dH, inverse @ (dB - dH @ X) + turn @ X, -turn - turn.T)


def moments(
    f: Callable[[Array, Array], Array], m: Array, S: Array, amplitude: Array, method: str = "extended"
) -> tuple[Float[Array, " c"], Float[Array, "c k_all"]]:
    """The mean (c,) of f(m + S x, amplitude * w) and a root (c, k_all) of its covariance.

    x (k,) and w are standard normal. The first k columns of the root belong to x. They contain the correlation with all
    other functions of x.

    "extended" linearizes f at (m, 0). "unscented" evaluates f at the 2 n points m +- sqrt(n) L e_j, L L^T = S S^T (the
    cubature rule of Arasaratnam and Haykin, Cubature Kalman filters, 2009), and at (m, +- amplitude) for each w. The
    points depend only on the covariance. They must not depend on the number of columns of S, which grows with `lag`,
    nor on the number of w. Otherwise, the present estimate would depend on both numbers.
    """
    n, n_w = S.shape[0], amplitude.size
    zero = jnp.zeros_like(amplitude)

    def with_w(steps: Array) -> tuple[Array, Array]:
        """Steps of m (j, n) and of w. Each step changes only one of the two."""
        w_alone, m_alone = jnp.zeros((n_w, n), S.dtype), jnp.zeros((len(steps), n_w), S.dtype)
        return jnp.concatenate([steps, w_alone]), jnp.concatenate([m_alone, jnp.diag(amplitude)])

    if method == "extended":

        def along(*direction):
            return jax.jvp(f, (m, zero), direction)

        return jax.vmap(along, out_axes=(None, 1))(*with_w(S.T))
    squares = jnp.sum(S**2, axis=1, keepdims=True)
    size = jnp.sqrt(jnp.where(squares > 0, squares, 1.0))  # so that units have no effect
    H, X, rest = polar(S / size)
    spread = jnp.sqrt(jnp.asarray(n, S.dtype))
    steps = with_w(spread * (size * H).T)
    plus, minus = (jax.vmap(lambda d, e, s=s: f(m + s * d, s * e))(*steps) for s in (1.0, -1.0))
    mean = jnp.mean(jnp.concatenate([plus[:n], minus[:n]]), axis=0)
    odd, even = (plus - minus).T / 2, (plus + minus - 2 * mean[None])[:n].T / 2
    parts = [odd[:, :n] / spread @ X, odd[:, :n] / spread @ rest, even / spread, odd[:, n:]]
    return mean, jnp.concatenate(parts, axis=1)


class Update(NamedTuple):
    """The update of a state m + S x by the measurements of one instant. Before the update, x (n,) is standard normal.

    - `innovation`: measured minus predicted (n_c,), where each prediction uses the previous measurements. Zero in gaps.
    - `deviation`: standard deviations (n_c,) of the innovations. One in gaps.
    - `known`: change (n_c,) of each prediction by the previous measurements.
    - `shift`: mean (n,) of x after the update.
    - `left`: root (n, n) of the covariance of x after the update, left left^T.
    """

    innovation: Float[Array, " n_c"]
    deviation: Float[Array, " n_c"]
    known: Float[Array, " n_c"]
    shift: Float[Array, " n"]
    left: Float[Array, "n n"]


def update(
    error: Float[Array, " n_c"], F: Float[Array, "n_c n"], sigma: Float[Array, " n_c"], measured: Bool[Array, " n_c"]
) -> Update:
    """Update by measurements with independent errors, one after the other.

    **Arguments:**

    - `error`: measured minus predicted at m (n_c,).
    - `F`: sensitivities of the predicted measurements to x (n_c, n).
    - `sigma`: standard deviations of the measurements (n_c,).
    - `measured`: which measurements exist (n_c,).

        s^2 = f f^T + sigma^2,   S+ = S (1 - f f^T / (s (s + sigma)))

    (Potter's form of the update; Bierman, Factorization Methods for Discrete Sequential Estimation, 1977, Chapter V.)
    """
    n = F.shape[1]
    shift, left = jnp.zeros(n, F.dtype), jnp.eye(n, dtype=F.dtype)
    innovations, deviations, known = [], [], []
    for c in range(F.shape[0]):
        is_measured = measured[c]
        f = jnp.where(is_measured, left.T @ F[c], 0.0)
        r = jnp.where(is_measured, sigma[c], 1.0)
        known.append(F[c] @ shift)
        e = jnp.where(is_measured, error[c] - known[-1], 0.0)
        s = jnp.sqrt(f @ f + r**2)
        moved = left @ f
        shift = shift + moved * e / s**2
        left = left - jnp.outer(moved, f) / (s * (s + r))
        innovations.append(e)
        deviations.append(s)
    return Update(jnp.stack(innovations), jnp.stack(deviations), jnp.stack(known), shift, left)
