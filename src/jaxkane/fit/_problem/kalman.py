"""A Kalman filter and smoother in square-root form, for what is known to be linear. Knows matrices; knows no motion.

A state v is Gaussian with mean m and covariance S S^T. S may be singular: a start that is known, coordinates that
constraints bind, noise that reaches some speeds only. Nothing here divides by it.

Derivatives: everything that is returned and does not depend on which of the roots S Q of a covariance is taken has the
right first derivatives, in either mode; second ones are not right, since `root` takes its rotation for constant.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def root(A: Float[Array, "n k"]) -> tuple[Float[Array, "n n"], Float[Array, "k n"]]:
    """S (n, n) = A Q with S S^T = A A^T, k >= n, and Q (k, n), whose columns are orthonormal.

    Q is held when this is differentiated: dS = dA Q is one of the many dS with d(S S^T) = d(A A^T), since the rows of A
    are combinations of the columns of Q, and unlike that of a triangle it exists where A has no full rank.
    """
    Q = jax.lax.stop_gradient(jnp.linalg.qr(jax.lax.stop_gradient(A).T)[0])
    return A @ Q, Q


class Update(NamedTuple):
    """The update of a state m + S x, with x (n,) standard normal before, by the measurements of one instant.

    - `innovation`, `deviation` (n_c,): measured less predicted, each after those before it, and its standard deviation;
        zero and one where nothing was measured.
    - `known` (n_c,): by how much those before it raise what is predicted of a measurement.
    - `shift` (n,), `left` (n, n): x is Gaussian with this mean and the covariance left left^T after.
    """

    innovation: Float[Array, " n_c"]
    deviation: Float[Array, " n_c"]
    known: Float[Array, " n_c"]
    shift: Float[Array, " n"]
    left: Float[Array, "n n"]


def update(
    error: Float[Array, " n_c"], F: Float[Array, "n_c n"], sigma: Float[Array, " n_c"], seen: Bool[Array, " n_c"]
) -> Update:
    """Measurements with independent errors, one after the other.

    `error`: measured less predicted at m; `F`: its sensitivity to x; `sigma`: the measurements' standard deviations;
    `seen`: which there are.

        s^2 = f f^T + sigma^2,   S+ = S (1 - f f^T / (s (s + sigma)))

    (Potter's form of the update; Bierman, Factorization Methods for Discrete Sequential Estimation, 1977, Chapter V.)
    """
    n = F.shape[1]
    shift, left = jnp.zeros(n, F.dtype), jnp.eye(n, dtype=F.dtype)
    innovations, deviations, known = [], [], []
    for c in range(F.shape[0]):
        there = seen[c]
        f = jnp.where(there, left.T @ F[c], 0.0)
        r = jnp.where(there, sigma[c], 1.0)
        known.append(F[c] @ shift)
        e = jnp.where(there, error[c] - known[-1], 0.0)
        s = jnp.sqrt(f @ f + r**2)
        moved = left @ f
        shift = shift + moved * e / s**2
        left = left - jnp.outer(moved, f) / (s * (s + r))
        innovations.append(e)
        deviations.append(s)
    return Update(jnp.stack(innovations), jnp.stack(deviations), jnp.stack(known), shift, left)


class Step(NamedTuple):
    """What a smoother needs of one instant of a filter.

    `mean` (n,), `S` (n, n): before its measurements. `shift`, `left`: as of an `Update`. `back` (n, n): how the x after
    the measurements before enters that of here, less what the noise in between adds.
    """

    mean: Float[Array, " n"]
    S: Float[Array, "n n"]
    shift: Float[Array, " n"]
    left: Float[Array, "n n"]
    back: Float[Array, "n n"]


def smoothed(steps: Step) -> tuple[Float[Array, "n_t n"], Float[Array, "n_t n n"]]:
    """Mean and a root of the covariance of every instant, all measurements known; `steps` has a leading axis (n_t).

    The smoother of Bryson and Frazier in the coordinates x, where the adjoint variable a and 1 - its matrix, here G,
    are of order one, and no covariance is inverted or subtracted from another:

        a = left a+ - shift,   G = left G+ left^T,   m + S (-a),   S G S^T
    """
    n = steps.S.shape[-1]
    one = jnp.eye(n, dtype=steps.S.dtype)

    def go_back(after: Any, step: Step) -> tuple[Any, Any]:
        a, G = after
        a, G = step.left @ a - step.shift, step.left @ G @ step.left.T
        found = step.mean - step.S @ a, step.S @ _symmetric_root(G)
        return (step.back @ a, one - step.back @ (one - G) @ step.back.T), found

    _, found = jax.lax.scan(go_back, (jnp.zeros(n, one.dtype), one), steps, reverse=True)
    return found


def _symmetric_root(G: Array) -> Array:
    values, vectors = jnp.linalg.eigh((G + G.T) / 2)
    return vectors * jnp.sqrt(jnp.maximum(values, 0.0))[None, :]
