"""Steps that end where an input has a kink. Knows diffrax's step size controllers; knows no mechanics."""

from __future__ import annotations

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class ToKinks(diffrax.AbstractAdaptiveStepSizeController[Any, Any]):
    """A controller whose steps do not run over `times` (n,), in rising order.

    A step over a kink would be of first order, whatever the solver. What is left before a kink is gone in one step, or
    in two halves, so that no step is as short as a rounding error: after that, `dtmin` would end the solution.
    """

    controller: diffrax.AbstractAdaptiveStepSizeController[Any, Any]
    times: Float[Array, " n"]

    def __init__(self, controller: Any, times: Float[Array, " n"]):
        self.controller, self.times = controller, times

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
        return ToKinks(self.controller.wrap(direction), jnp.sort(self.times * direction))

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):  # type: ignore[override]
        end, state = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        return self._end(t0, end), state

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):  # type: ignore[override]
        keep, t0, t1, jumped, state, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state
        )
        return keep, t0, self._end(t0, t1), jumped, state, result

    def _end(self, t0: Any, t1: Any) -> Any:
        times = jax.lax.stop_gradient(self.times)
        # A kink as near as a rounding error is where the step starts.
        here = 64 * jnp.finfo(times.dtype).eps * jnp.max(jnp.abs(times))
        i = jnp.searchsorted(times, t0 + here, side="right")
        kink = jnp.where(i < len(times), times[jnp.minimum(i, len(times) - 1)], jnp.inf)
        halfway = t0 + 0.5 * (kink - t0)
        return jnp.where(t1 >= kink, kink, jnp.minimum(t1, halfway))
