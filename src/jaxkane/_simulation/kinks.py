"""Steps that end where an input has a kink. Knows diffrax's step size controllers; knows no mechanics."""

from __future__ import annotations

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class ToKinks(diffrax.AbstractAdaptiveStepSizeController[Any, Any]):
    """A controller whose steps do not run over those of `times` (n,), in rising order, that come before `end`.

    A step over a kink would be of first order, whatever the solver. What is left before a kink is gone in one step, or
    in two halves, so that no step is as short as a rounding error: after that, `dtmin` would end the solution.

    The derivative of a signal by the time of its kink differs on the two sides, and so a step must belong to one of
    them. Steps therefore end and begin a rounding error beside a kink, and move with it; other ends do not move. With
    `anew` they begin with a right-hand side of their own: where two signals have a kink at one time, and only one of
    them moves, the derivative that came from the left would be wrong on the right.
    """

    controller: diffrax.AbstractAdaptiveStepSizeController[Any, Any]
    times: Float[Array, " n"]
    anew: bool = eqx.field(static=True)

    def __init__(self, controller: Any, times: Float[Array, " n"], anew: bool = False, end: Any = jnp.inf):
        self.controller, self.anew = controller, anew
        # A step that ends beside a kink at the end would leave the end out.
        self.times = jnp.where(times < end - _rounding(times), times, jnp.inf)

    @property
    def rtol(self) -> Any:  # type: ignore[override]
        return self.controller.rtol

    @property
    def atol(self) -> Any:  # type: ignore[override]
        return self.controller.atol

    @property
    def norm(self) -> Any:  # type: ignore[override]
        return self.controller.norm

    def wrap(self, direction: Any) -> ToKinks:
        return ToKinks(self.controller.wrap(direction), jnp.sort(self.times * direction), self.anew)

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):  # type: ignore[override]
        end, state = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        return self._end(t0, end), state

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):  # type: ignore[override]
        keep, next_t0, next_t1, jumped, state, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state
        )
        i = jnp.minimum(jnp.searchsorted(self.times, next_t0 - self._here), len(self.times) - 1)
        at_kink = keep & (jnp.abs(next_t0 - self.times[i]) <= self._here)
        next_t0 = jnp.where(at_kink, self.times[i] + 0.25 * self._here, next_t0)
        return keep, next_t0, self._end(next_t0, next_t1), jumped | at_kink if self.anew else jumped, state, result

    @property
    def _here(self) -> Array:
        """A kink as near as a rounding error is where a step starts."""
        return _rounding(self.times)

    def _end(self, t0: Any, t1: Any) -> Any:
        t1 = jax.lax.stop_gradient(t1)
        i = jnp.searchsorted(self.times, t0 + self._here, side="right")
        kink = jnp.where(i < len(self.times), self.times[jnp.minimum(i, len(self.times) - 1)], jnp.inf)
        halfway = jax.lax.stop_gradient(t0 + 0.5 * (kink - t0))
        return jnp.where(t1 >= kink, kink - 0.25 * self._here, jnp.minimum(t1, halfway))


def _rounding(times: Array) -> Array:
    """How near to one of these times rounding errors keep another."""
    times = jax.lax.stop_gradient(times)
    return 64 * jnp.finfo(times.dtype).eps * jnp.max(jnp.where(jnp.isfinite(times), jnp.abs(times), 0.0))
