"""The posterior density of a fit's unknowns, for samplers such as NumPyro's and BlackJAX's. Knows no sampler."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .model import Point, blocks_of, starts_of
from .problem import Problem


def half_cost(problem: Problem) -> Callable[[Point], Array]:
    """Half the sum of squares as a function of a `Point` that JAX can differentiate, once, in either mode.

    The derivatives are those of `linearize`: forward through the simulation, a few directions a window, which is
    cheaper than one reverse pass and needs none of its memory.
    """
    model, windows, by_trial = problem.model, problem.windows, problem.by_trial

    @jax.custom_jvp
    def f(point: Point) -> Array:
        return linearized(point).cost / 2

    def linearized(point: Point):
        return blocks_of(model, windows, by_trial, point, *starts_of(model, windows, point))[0]

    @f.defjvp
    def f_jvp(primals, tangents):
        blocks, (direction,) = linearized(*primals), tangents
        z, b, x = blocks.gradient
        slope = jnp.sum(z * direction.z) + jnp.sum(b * direction.b) + jnp.sum(x * direction.x)
        return blocks.cost / 2, slope

    return f


def log_density(problem: Any, *, over: str = "values") -> Callable[[Point], Array]:
    """The logarithm of the posterior density, up to a constant, as a function of a `Point`.

        log p = -1/2 sum of squares + log |det d values / d x|

    A `Point` holds unconstrained numbers only, so a sampler may go anywhere: parameters stay inside their bounds, and
    bodies possible. Priors are among the residuals; `sigma` is taken as it was given. It may be differentiated once, in
    either mode (`jax.grad`, `jax.jvp`).

        density = log_density(fit)
        blackjax.nuts(density, ...)                                       # starts from fit.point
        numpyro.infer.NUTS(potential_fn=lambda point: -density(point))    # init_params=fit.point

    **Arguments:**

    - `problem`: a `Fit` or a `Problem`.
    - `over`: "values": where there is no prior, all values of a parameter are as likely; "x": all its free numbers are,
        as all orders of magnitude of a positive one.

    **Returns:** a function of a `Point`; minus infinity where nothing can be simulated.
    """
    if over not in ("values", "x"):
        raise ValueError(f"`over` is 'values' or 'x', got {over!r}.")
    problem = getattr(problem, "problem", problem)
    cost = half_cost(problem)

    def density(point: Point) -> Array:
        log_p = -cost(point)
        if over == "values":
            log_p = log_p + problem.parameters.log_determinant(point.x)
        return jnp.where(jnp.isfinite(log_p), log_p, -jnp.inf)

    return density
