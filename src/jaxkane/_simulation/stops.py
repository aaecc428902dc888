"""Steps that end where the motion does. Knows diffrax's step size controllers; knows no mechanics."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .crossings import first_crossing


class Quantities(NamedTuple):
    """What may end a motion, at one time: `values` (n,) and their `rates` (n,), and a `bound` that nothing may pass."""

    values: Array
    rates: Array
    bound: Array


class Stopping(NamedTuple):
    """The state of a controller that stops: that of its inner controller; the quantities at the step's start; which one
    ended the motion, -1 for none and n for the bound; the end of a step that was taken back, else -infinity; and the
    end of the first step over the bound, else infinity."""

    inner: Any
    start: Quantities
    which: Array
    until: Array
    last: Array


class ToStops(diffrax.AbstractStepSizeController[Any, Any]):
    """A controller whose last step ends where a quantity vanishes.

    The motion is watched through the cubic between both ends of a step: their values and rates. Where that passes zero
    the step is taken back, and made anew to just beyond that time; so long, until the step that ends there is one that
    is right by the inner controller's measure. Two crossings within one step are seen where the cubic sees them.

    A step over the bound is halved; where it is as short as `shortest`, the motion ends before it. It also ends where
    the first step over the bound did, if shorter ones do not pass it: so near to it, what is found is by chance.

    `watch`: (t, y, args) -> `Quantities`; `direction` (n,): see `first_crossing`; `resolution` [s]: how far behind a
    crossing the last step may end; `rounding` [s]: what is no time.
    """

    controller: diffrax.AbstractStepSizeController[Any, Any]
    watch: Callable[..., Quantities]
    direction: Array
    resolution: Array
    rounding: Array
    shortest: Array

    def wrap(self, direction: Any) -> ToStops:
        return eqx.tree_at(lambda c: c.controller, self, self.controller.wrap(direction))

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):  # type: ignore[override]
        end, inner = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        start = self._watched(t0, y0, args)
        # What would have vanished within a rounding error of the start is on zero there.
        on_zero = jnp.abs(start.values) <= jnp.abs(start.rates) * self.rounding
        start = start._replace(values=jnp.where(on_zero, jnp.zeros_like(start.values), start.values))
        return end, Stopping(inner, start, jnp.array(-1), jnp.full_like(t0, -jnp.inf), jnp.full_like(t0, jnp.inf))

    def adapt_step_size(self, t0: Any, t1: Any, y0, y1_candidate, args, y_error, error_order, controller_state):  # type: ignore[override]
        state: Stopping = controller_state
        keep, next_t0, next_t1, jumped, inner, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, state.inner
        )
        # What is left of a step that was taken back is gone at once: a fixed step stays on its grid.
        going_on = keep & (t1 < state.until)
        next_t1 = jnp.where(going_on, state.until, next_t1)
        inner = _where(going_on, state.inner, inner)

        now, h = self._watched(t1, y1_candidate, args), jax.lax.stop_gradient(t1 - t0)
        which, x = self._first(state.start, now, h)
        crossed = keep & (x <= 1)
        over = keep & (state.start.bound * now.bound < 0)
        at_bound = (over & (h <= self.shortest)) | (keep & ~over & (t1 >= state.last))
        at_start = crossed & (x == 0) & ~over
        there = crossed & ((1 - x) * h <= self.resolution) & ~over & ~at_start & ~at_bound
        at_start &= ~at_bound
        again = (crossed | over) & ~there & ~at_start & ~at_bound
        beyond = jnp.where(over, 0.5 * h, jnp.minimum(x, 1.0) * h + 0.5 * self.resolution)

        taken_back = again | at_start | at_bound
        state = Stopping(
            inner=_where(taken_back, state.inner, inner),
            start=_where(keep & ~taken_back, now, state.start),
            which=jnp.where(there | at_start, which, jnp.where(at_bound, len(self.direction), state.which)),
            until=jnp.where(again & ~over, jnp.maximum(state.until, t1), state.until),
            last=jnp.where(over, jnp.minimum(state.last, jax.lax.stop_gradient(t1)), state.last),
        )
        result = diffrax.RESULTS.where(again, diffrax.RESULTS.successful, result)
        result = diffrax.RESULTS.where(there | at_start | at_bound, diffrax.RESULTS.event_occurred, result)
        next_t0 = jnp.where(taken_back, t0, next_t0)
        next_t1 = jnp.where(again, jax.lax.stop_gradient(t0 + beyond), next_t1)
        return keep & ~taken_back, next_t0, next_t1, jumped, state, result

    def _watched(self, t: Any, y: Any, args: Any) -> Quantities:
        # Where steps end has no derivative, and compiling one would take its time.
        still = lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x  # noqa: E731
        return self.watch(*jax.tree.map(still, (t, y, args)))

    def _first(self, start: Quantities, now: Quantities, h: Array) -> tuple[Array, Array]:
        """Which quantity passes zero first in a step, and where in [0, 1]; infinite if none does."""
        if not len(self.direction):
            return jnp.array(-1), jnp.asarray(jnp.inf, h.dtype)
        x = first_crossing(start.values, h * start.rates, now.values, h * now.rates, self.direction)
        # What is to vanish within a rounding error behind the step vanishes at its end.
        coming = (now.values * now.rates < 0) & (self.direction * now.rates >= 0)
        coming &= jnp.abs(now.values) <= jnp.abs(now.rates) * self.rounding
        x = jnp.where(coming, jnp.minimum(x, 1.0), x)
        which = jnp.argmin(x)
        return which, x[which]


class AdaptiveToStops(ToStops, diffrax.AbstractAdaptiveStepSizeController[Any, Any]):
    """`ToStops` around a controller with tolerances, which implicit solvers ask for."""

    @property
    def rtol(self) -> Any:  # type: ignore[override]
        return self.controller.rtol  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def atol(self) -> Any:  # type: ignore[override]
        return self.controller.atol  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def norm(self) -> Any:  # type: ignore[override]
        return self.controller.norm  # pyright: ignore[reportAttributeAccessIssue]


def _where(condition: Any, x: Any, y: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), x, y)
