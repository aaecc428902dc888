"""Roots of more equations than unknowns that agree with each other. Knows Newton and the implicit function theorem.

Kane's equations of a steady motion repeat each other (the power balance is one of them), so the systems are not
square. The solver is written here for its derivatives: they are pushed one direction after the other, which compiles
an order of magnitude faster for a long scalar program than the batch of directions that a library would push.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array


def jacobian(f: Callable[[Array], Any], x: Array) -> Any:
    """df/dx (m, n) at x (n,), one column after the other."""
    columns = jax.lax.map(lambda dx: jax.jvp(f, (x,), (dx,))[1], jnp.eye(x.shape[0], dtype=x.dtype))
    return jax.tree.map(lambda y: jnp.moveaxis(y, 0, -1), columns)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def root(residual: Callable[[Array, Any], Array], guess: Array, args: Any) -> Array:
    """z (n,) with residual(z, args) = 0 (m >= n equations), by Levenberg and Marquardt's method from `guess`.

    Differentiable in `args`, any number of times, both modes:  dz = -F_z^+ F_args dargs. A solution is not promised:
    look at the residual and at the rank of its derivative.
    """
    return _levenberg_marquardt(lambda z: residual(z, args), guess)


@root.defjvp
def _root_jvp(residual, primals, tangents):
    guess, args = primals
    z = root(residual, guess, args)
    _, dF = jax.jvp(lambda args: residual(z, args), (args,), (tangents[1],))
    J = jacobian(lambda z: residual(z, args), z)
    J = jnp.where(jnp.all(jnp.isfinite(J)), J, 0.0)  # what was not found has no slope, and says so elsewhere
    return z, -jnp.linalg.pinv(J) @ dF


def _levenberg_marquardt(F: Callable[[Array], Array], z: Array, max_steps: int = 80) -> Array:
    # Steps are kept while the residual falls; the damping vanishes near a solution, where this is Gauss and Newton's.
    eps = float(jnp.finfo(z.dtype).eps)

    def cost(r):
        return jnp.where(jnp.all(jnp.isfinite(r)), jnp.sum(r**2), jnp.inf)

    def step(carry):
        z, r, damping, small, k = carry
        J = jacobian(F, z)
        safe = jnp.all(jnp.isfinite(J))
        J = jnp.where(safe, J, 0.0)
        size = jnp.linalg.norm(J, axis=0)
        size = jnp.where(size > 0, size, 1.0)  # of columns, so that units do not matter
        U, s, Vt = jnp.linalg.svd(J / size[None, :], full_matrices=False)
        filtered = jnp.where(s > 1e3 * eps * s[0], s / (s**2 + damping), 0.0)
        dz = -(Vt.T @ (filtered * (U.T @ r))) / size
        trial = F(z + dz)
        better = cost(trial) < cost(r)
        tiny = jnp.all(jnp.abs(dz) <= 4 * eps * (1 + jnp.abs(z)))
        z, r = jnp.where(better, z + dz, z), jnp.where(better, trial, r)
        small = jnp.where(tiny | ~safe | (~better & (damping < 1e-13)) | (damping > 1e8), 1, 0)
        damping = jnp.where(better, damping * jnp.where(damping < 1e-6, 0.0, 0.03), 10 * jnp.maximum(damping, 1e-14))
        return z, r, damping, small, k + 1

    def going(carry):
        return (carry[3] == 0) & (carry[4] < max_steps)

    r = F(z)
    start = (z, r, jnp.asarray(1e-2, z.dtype), jnp.zeros((), int), jnp.zeros((), int))
    return jax.lax.while_loop(going, step, start)[0]
