"""The probe: one tangent of the motion, in a generic direction, whose error the step control limits.

Steps that suit a motion may be far too long for its tangents: a motion that rests has no error at all. All tangents
obey the same equation, so one that moves in all directions shows how long their steps may be:

    y_dot = f(t, y, args),   d_dot = df/dy d + df/dargs args_dot

A first loop moves motion and probe, and records the errors of the probe. The loop that is differentiated reads them, so
that it takes the same steps.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._scalarjit.nan import constant
from .._scalarjit.scalar_function import Packed, tree_of
from .inputs import RateArguments, is_samples

RECORDED = 16384
"""The largest number of steps whose errors are recorded."""


class Probe(NamedTuple):
    """The largest size (n,) so far of each component of the tangent, and its errors (m,) in all steps."""

    size: Array
    errors: Array


class Probing(NamedTuple):
    """How a loop moves motion and tangent, (2, n), as one state: with these `rates` of the motion, from the direction
    `y` (n,), while the arguments of the rates move in the direction `args` (None where they do not). A component below
    the share `noise` of the largest one counts as rounding errors of others."""

    rates: Callable[..., Array]
    y: Array
    args: Any
    noise: Array

    def start(self, y: Array, most: int | None) -> tuple[Array, Probe]:
        """Motion and tangent at the start of a simulation of at most so many steps, and the probe."""
        errors = jnp.zeros(min(most or RECORDED, RECORDED), jnp.float32)
        return jnp.stack([y, self.y]), Probe(jnp.abs(self.y), errors)

    def again(self, y: Array, probe: Probe) -> Array:
        """Motion and tangent after a jump of the motion to y. The direction is generic again, and its components keep
        their size, because an event may reset a coordinate."""
        return jnp.stack([y, jnp.sign(generic(y, y.size)) * probe.size])

    def step(self, probe: Probe, both: Array, error: Array, i: Array) -> tuple[Array, Probe]:
        """The error of the tangent in the step i, which ends at these values, relative to its size; and the probe."""
        size = jnp.maximum(probe.size, jnp.abs(both[1]))
        least = jnp.maximum(size, self.noise * jnp.max(size))
        share = jnp.where(least > 0, error[1] / jnp.where(least > 0, least, 1.0), 0.0)
        # Both loops use the rounded number: one that differs in the last digit can decide about an additional step
        # before a discontinuity, and from then on each step would read the error of its neighbour.
        e = jnp.sqrt(jnp.mean(share * share)).astype(jnp.float32)
        return e.astype(both.dtype), Probe(size, probe.errors.at[i].set(e))

    def of_both(self, t: Array, both: Array, args: RateArguments) -> Array:
        """The rates of motion and tangent, (2, n), as one state: the solver has as many operations as for one."""
        direction = self._along(args)
        moved = jax.tree.map(lambda d, x: None if d is None else x, direction, args, is_leaf=_is_none)
        still = jax.tree.map(lambda d, x: x if d is None else None, direction, args, is_leaf=_is_none)
        of_motion = lambda y, moved: self.rates(t, y, eqx.combine(moved, still))  # noqa: E731
        return jnp.stack(jax.jvp(of_motion, (both[0], moved), (both[1], direction)))

    def _along(self, args: RateArguments) -> Any:
        """The direction of these arguments, in which a solver may have replaced samples by numbers."""
        if callable(args.signals):
            return self.args
        signals = {
            name: d
            if not is_samples(d) or is_samples(args.signals[name])
            else None
            if d.values is None
            else d.values[0]
            for name, d in self.args.signals.items()
        }
        return dataclasses.replace(self.args, signals=signals)


def as_integers(errors: Array) -> Array:
    """Recorded errors, bit by bit as integers. In reverse mode, a loop adds a cotangent of the size of each array of
    floats that it reads in every step, also of a constant one."""
    return jax.lax.bitcast_convert_type(errors, jnp.int32)


def read_errors(errors: Array, i: Array, dtype: Any) -> Array:
    """The error in the step i, from recorded errors as integers."""
    return jax.lax.bitcast_convert_type(errors[i], jnp.float32).astype(dtype)


def generic(like: Array, n: int) -> Array:
    """A direction of no special kind in which the first n numbers move."""
    numbers = _factors(n)
    return jnp.asarray(np.concatenate([numbers, np.zeros(like.size - n)]), like.dtype)


def _factors(n: int) -> np.ndarray:
    """Numbers between 0.5 and 1.5 of both signs."""
    random = np.random.default_rng(20)
    return random.uniform(0.5, 1.5, n) * random.choice([-1.0, 1.0], n)


def direction_of(args: RateArguments, moved: Any, signals_move: bool) -> Any:
    """A direction of no special kind in which the arguments of the rates move, None for those that do not.

    `moved`: the system with True for each number that moves. Numbers move in proportion to their size. All samples of a
    signal move by the same amount, because a rough signal would need short steps.
    """
    factors = iter(_factors(len(jax.tree.leaves(moved))))
    system_dot = jax.tree.map(
        lambda moves, x: None if moves is None else _along(moves, x, next(factors)),
        moved, tree_of(args.system), is_leaf=_is_none,
    )  # fmt: skip
    nowhere = jax.tree.map(lambda _: None, args)
    if not jax.tree.leaves(system_dot):
        system_dot = nowhere.system
    elif isinstance(args.system, Packed):
        everywhere = jax.tree.map(
            lambda d, x: jnp.zeros_like(x) if d is None and eqx.is_inexact_array(x) else d,
            system_dot, tree_of(args.system), is_leaf=_is_none,
        )  # fmt: skip
        system_dot = Packed.of(everywhere, args.system.numbers.dtype)

    def of_signal(x: Any) -> Any:
        if not is_samples(x):
            return _along(signals_move, x, 1.0)
        size = _along(signals_move, x.values, 1.0)
        size = None if size is None else jnp.full_like(x.values, jnp.max(size))
        return eqx.tree_at(lambda s: s.values, jax.tree.map(lambda _: None, x), size, is_leaf=_is_none)

    signals_dot = jax.tree.map(of_signal, args.signals, is_leaf=is_samples)
    return dataclasses.replace(nowhere, system=system_dot, signals=signals_dot)


def _along(moves: bool, x: Any, factor: Any) -> Array | None:
    if not moves or not eqx.is_inexact_array(x):
        return None
    size = constant(jnp.where(jnp.isfinite(x), jnp.abs(x), 0.0))
    return jnp.asarray(factor, x.dtype) * jnp.where(jnp.any(size > 0), size, 1.0)


def _is_none(x: Any) -> bool:
    return x is None
