"""Bijections between unconstrained variables and physically possible values. They do not depend on a system.

Each maps x (n,) to n values and has an `inverse`. x is zero at the initial guess, and a change of x by one is typical.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import log_ndtr


class Interval(eqx.Module):
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
    def size(self) -> int:
        return 1

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
    def longest_step(self) -> float:
        """The longest allowed step of x: a factor of 20 in the distance to a bound.

        A linear prediction beyond a bound is a long step along the exponential. Without this limit, a friction
        coefficient became 1e-74. Its slope was then lost in rounding, and the search could not return.
        """
        start, lower, upper = (float(x) for x in (self.start, self.lower, self.upper))
        reach = {(False, False): np.inf, (False, True): upper - start, (True, False): start - lower}
        both = (start - lower) * (upper - start) / (upper - lower) if all(self.bounded) else 0.0
        return 3.0 * reach.get(self.bounded, both) / float(self.scale)  # exp(3) = 20

    def log_prior_constants(self, mean: np.ndarray, deviation: np.ndarray) -> np.ndarray:
        """log p(value) + (value - mean)^2 / (2 deviation^2), (1,).

        The Gaussian is truncated at the bounds. Without a prior (infinite standard deviation), the density is uniform
        if the user gave both bounds. Otherwise the result is NaN.
        """
        lower, upper = float(self.lower), float(self.upper)
        if np.all(np.isfinite(deviation)):
            return _gaussian_constant(deviation) - log_gaussian_mass(
                (lower - mean) / deviation, (upper - mean) / deviation
            )
        return np.array([-np.log(upper - lower) if all(self.bounded) and self.uniform else np.nan])

    def _share(self, value: Array) -> tuple[Array, Array]:
        width = self.upper - self.lower
        return width, (value - self.lower) / width


def _gaussian_constant(deviation: np.ndarray) -> np.ndarray:
    return -np.log(deviation) - 0.5 * np.log(2 * np.pi)


def log_gaussian_mass(a: Any, b: Any) -> Any:
    """log (Phi(b) - Phi(a)) for a < b, without cancellation in either tail."""
    a, b = np.where(a > 0, -b, a), np.where(a > 0, -a, b)
    return log_ndtr(b) + np.log1p(-np.exp(log_ndtr(a) - log_ndtr(b)))


def _logit(share: Array) -> Array:
    return jnp.log(share) - jnp.log1p(-share)


class PossibleBody(eqx.Module):
    """Mass, mass centre and central inertia of a rigid body with a positive-definite pseudo-inertia.

        m = exp(2 a),   c = t,   Sigma = m S S^T,   I = tr(Sigma) 1 - Sigma

    with S upper triangular and a positive diagonal exp(d): the logarithmic Cholesky factors of the pseudo-inertia
    (Rucker and Wensing, Smooth parameterization of rigid-body inertia, IEEE Robotics and Automation Letters, 2022).
    Sigma is the matrix of central second moments. It is positive definite if every principal moment of inertia is less
    than the sum of the two others. Factors that are zero or equal by symmetry are not variables.

    The values are the free entries of [m, cx, cy, cz, Ixx, Iyy, Izz, Ixy, Ixz, Iyz], with products as matrix entries.
    For a wheel with equal moments about x and z, Izz is not a value.
    """

    start: Float[Array, " 10"]  # [a, t1, t2, t3, d1, d2, d3, s12, s13, s23]
    scale: Float[Array, " 10"]
    moves: tuple[int, ...] = eqx.field(static=True)  # indices of the free values
    wheel: tuple[int, int] | None = eqx.field(static=True)  # the two axes that are equal

    @classmethod
    def of(cls, values: Any, moves: tuple[int, ...], wheel: tuple[int, int] | None = None) -> PossibleBody:
        """The bijection for all ten values. **Raises:** `ValueError` if they are not physically possible."""
        values = np.asarray(values, float)
        start = np.asarray(_factors(jnp.asarray(values)))
        if not np.all(np.isfinite(start)):
            I = _matrix(values[4:])
            moments = ", ".join(f"{x:.5g}" for x in np.linalg.eigvalsh(I)) if np.all(np.isfinite(I)) else "not finite"
            raise ValueError(
                f"mass {values[0]:.5g} kg with principal moments of inertia {moments} kg m^2 is not physically "
                "possible. Each moment must be less than the sum of the other two. Change the values so that this "
                "holds with a margin of about one per cent."
            )
        size = float(np.exp(2 * start[4:7]).sum() ** 0.5)  # a length: radius of gyration
        place = np.where(values[1:4] != 0, np.abs(values[1:4]), size)
        scale = np.concatenate([[0.5], place, [0.5] * 3, [size / 2] * 3])
        dtype = jnp.result_type(float)
        return cls(jnp.asarray(start, dtype), jnp.asarray(scale, dtype), moves, wheel)

    @property
    def size(self) -> int:
        return len(self.moves)

    def __call__(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        values = self.all_values(self.factors(x))
        return jnp.stack([values[i] for i in self.moves])

    def factors(self, x: Float[Array, " n"]) -> Float[Array, " 10"]:
        """All ten factors, [a, t1, t2, t3, d1, d2, d3, s12, s13, s23]."""
        factors = [*self.start]
        for i, step in zip(self.moves, x, strict=True):
            factors[i] = factors[i] + self.scale[i] * step
        if self.wheel:
            a, b = self.wheel
            factors[4 + b] = factors[4 + a]
        return jnp.stack(factors)

    def inverse(self, values: Float[Array, " n"]) -> Float[Array, " n"]:
        full = self.all_values(self.start).at[np.array(self.moves)].set(values)
        if self.wheel:
            a, b = self.wheel
            full = full.at[4 + b].set(full[4 + a])
        return ((_factors(full) - self.start) / self.scale)[np.array(self.moves)]

    def log_prior_constants(self, mean: np.ndarray, deviation: np.ndarray) -> np.ndarray:
        """The constants as in `Interval`; NaN for a value without a prior.

        The Gaussians are truncated to physically possible bodies. The remaining probability is estimated from random
        samples, with an error of about one per cent.
        """
        if not np.all(np.isfinite(deviation)):
            return np.where(np.isfinite(deviation), 0.0, np.nan)
        # The same samples in every call: two models with the same prior must get the same constant.
        draws = np.random.default_rng(0).normal(mean, deviation, (10_000, len(mean)))
        x = jax.vmap(self.inverse)(jnp.asarray(draws, self.start.dtype))
        share = np.mean(np.all(np.isfinite(np.asarray(x)), axis=1))
        constants = _gaussian_constant(deviation)
        constants[0] -= np.log(share) if share > 0 else np.nan
        return constants

    @staticmethod
    def all_values(factors: Float[Array, " 10"]) -> Float[Array, " 10"]:
        """[m, c, Ixx, Iyy, Izz, Ixy, Ixz, Iyz] from all ten factors."""
        m = jnp.exp(2 * factors[0])
        d1, d2, d3 = jnp.exp(factors[4:7])
        s12, s13, s23 = factors[7:]
        xx, yy, zz = d1**2 + s12**2 + s13**2, d2**2 + s23**2, d3**2
        xy, xz, yz = s12 * d2 + s13 * s23, s13 * d3, s23 * d3
        return jnp.concatenate([m[None], factors[1:4], m * jnp.stack([yy + zz, xx + zz, xx + yy, -xy, -xz, -yz])])


def _matrix(six: Any) -> np.ndarray:
    xx, yy, zz, xy, xz, yz = (float(a) for a in six)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


@jax.jit
def _factors(values: Float[Array, " 10"]) -> Float[Array, " 10"]:
    """The inverse of `all_values`; NaN if the values are not physically possible."""
    m, (Ixx, Iyy, Izz, Ixy, Ixz, Iyz) = values[0], values[4:]
    half = 0.5 * (Ixx + Iyy + Izz)  # tr Sigma
    xx, yy, zz, xy, xz, yz = (x / m for x in (half - Ixx, half - Iyy, half - Izz, -Ixy, -Ixz, -Iyz))
    # Sigma / m = S S^T with S upper triangular, solved from the last row upwards.
    d3 = jnp.sqrt(zz)
    s13, s23 = xz / d3, yz / d3
    d2 = jnp.sqrt(yy - s23**2)
    s12 = (xy - s13 * s23) / d2
    d1 = jnp.sqrt(xx - s12**2 - s13**2)
    return jnp.stack([0.5 * jnp.log(m), *values[1:4], jnp.log(d1), jnp.log(d2), jnp.log(d3), s12, s13, s23])
