"""The posterior density of a fit's unknowns, for samplers such as NumPyro's and BlackJAX's. Knows no sampler."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ._linearize import blocks_of, starts_of
from ._model import Model, Unknowns
from ._problem import Problem, refuse_other
from ._windows import Windows


def half_cost(model: Model, windows: Windows, by_trial: Array) -> Callable[[Unknowns], Array]:
    """Half a problem's cost as a function of `Unknowns` that JAX can differentiate, once, in either mode.

    The derivatives are those of `linearize`: forward through the simulation, a few directions a window, which is
    cheaper than one reverse pass and needs none of its memory.
    """

    @jax.custom_jvp
    def f(point: Unknowns) -> Array:
        return linearized(point)[1] / 2

    def linearized(point: Unknowns):
        blocks, seen = blocks_of(model, windows, by_trial, point, *starts_of(model, windows, point))
        return blocks, blocks.cost if seen.value is None else jnp.sum(seen.value)

    @f.defjvp
    def f_jvp(primals, tangents):
        (blocks, cost), (direction,) = linearized(*primals), tangents
        z, b, x = blocks.gradient
        slope = jnp.sum(z * direction.z) + jnp.sum(b * direction.b) + jnp.sum(x * direction.x)
        return cost / 2, slope

    return f


def log_density(problem: Problem, *, over: str = "values") -> Callable[[Unknowns], Array]:
    """The logarithm of the posterior density, up to a constant, as a function of `Unknowns`.

        log p = -1/2 cost + log |det d values / d x|

    `Unknowns` are unconstrained numbers only, so a sampler may go anywhere: parameters stay inside their bounds, and
    bodies possible. Priors are part of the cost; `sigma` is taken as it was given, unless a factor of it is free. It
    may be differentiated once, in either mode (`jax.grad`, `jax.jvp`).

        density = log_density(fit.problem)
        blackjax.nuts(density, ...)                                       # starts from fit.point
        numpyro.infer.NUTS(potential_fn=lambda point: -density(point))    # init_params=fit.point

    **Arguments:**

    - `problem`: a `Problem`, such as `fit.problem`.
    - `over`: "values": where there is no prior, all values of a parameter are as likely; "x": all its free numbers are,
        as all orders of magnitude of a positive one.

    **Returns:** a function of `Unknowns`; minus infinity where nothing can be simulated.
    """
    if over not in ("values", "x"):
        raise ValueError(f"`over` is 'values' or 'x', got {over!r}.")
    refuse_other(problem, Problem, "log_density", "log_density(fit.problem)")
    cost = half_cost(problem.model, problem.windows, problem.by_trial)

    def density(point: Unknowns) -> Array:
        log_p = -cost(point)
        if over == "values":
            log_p = log_p + problem.parameters.log_determinant(point.x)
        return jnp.where(jnp.isfinite(log_p), log_p, -jnp.inf)

    return density
