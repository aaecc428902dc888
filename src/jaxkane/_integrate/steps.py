"""The steps of a motion: a loop around a Runge-Kutta method of diffrax, and explicit methods with unrolled stages."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._scalarjit.nan import constant
from .inputs import RateArguments
from .settings import with_scan_kind
from .step_control import Progress, StepSizeController


class Steps(NamedTuple):
    """The `motion` at the sample times (n_t, n), of which the first `count` were reached; the last time and packed
    state, and its rates, None where the solver leaves none; and the `progress` of the steps."""

    motion: Array
    count: Array
    t_end: Array
    end: Array
    rates: Array | None
    progress: Progress


class _Samples(NamedTuple):
    """The motion at the sample times (n_t, n), and how many of them have been reached."""

    motion: Array
    count: Array


class _Carry(NamedTuple):
    """What the loop carries: the two ends of the next step, and the state at its start; the rates there, None where the
    solver's stages do not tell them; whether the step begins behind a jump, None where there are no jumps; the
    `progress`, packed; and whether the motion goes on."""

    t0: Array
    t1: Array
    y: Array
    rates: Array | None
    solver_state: Any
    jumped: Array | None
    progress: Array
    is_running: Array
    samples: _Samples
    meter: Any


# How equinox's loop is differentiated, by the adjoint.
_KINDS: dict[type, str] = {
    diffrax.ForwardMode: "lax",
    diffrax.RecursiveCheckpointAdjoint: "checkpointed",
    diffrax.DirectAdjoint: "bounded",
}


def take_steps(
    rates: Callable[..., Array],
    solver: Any,
    control: StepSizeController,
    can_begin: Array,
    y0: Array,
    args: Any,
    ts: Array,
    adjoint: Any,
    meter: diffrax.AbstractProgressMeter,
) -> Steps:
    """The steps of a motion until the `control` ends them, and its states at rising times `ts`.

    It takes the steps of `diffrax.diffeqsolve`, and compiles twice as fast: the control makes all decisions of a step
    in one program, and nothing is there for what no motion needs.

    **Arguments:** `rates`: (t, y, args) -> y_dot. There are no steps unless the motion `can_begin`.
    """
    kind = _KINDS[type(adjoint)]
    if control.settings.max_steps is None and getattr(adjoint, "checkpoints", None) is None:
        kind = "lax"
    solver = solver if kind == "checkpointed" else with_scan_kind(solver, kind)
    term, loop = diffrax.ODETerm(rates), functools.partial(_loop, kind)  # pyright: ignore[reportArgumentType]
    start, (end, progress) = control.settings.times.start, control.first(y0, args)
    jumps = control.kinks is not None and control.kinks.restart
    zero = jnp.zeros((), int)
    carry = _Carry(
        t0=start,
        t1=end,
        y=y0,
        rates=jnp.zeros_like(y0) if _has_rates_at_ends(solver) else None,
        solver_state=solver.init(term, start, end, y0, args),
        jumped=jnp.array(False) if jumps else None,
        progress=progress,
        is_running=can_begin,
        samples=_Samples(jnp.zeros((len(ts), *y0.shape), y0.dtype), zero),
        meter=meter.init(),
    )

    def step(carry: _Carry) -> _Carry:
        jumped = False if carry.jumped is None else carry.jumped
        y, error, dense, solver_state, result = solver.step(
            term, carry.t0, carry.t1, carry.y, args, carry.solver_state, jumped
        )
        failed = None if isinstance(solver, UnrolledERK) else result != diffrax.RESULTS.successful
        decision = control.following(carry.progress, carry.t0, carry.t1, carry.y, y, error, failed, args)
        chosen = lambda new, old: jax.tree.map(functools.partial(jnp.where, decision.keep), new, old)  # noqa: E731
        rates = None
        if carry.rates is not None:
            k: Any = constant(dense["k"])
            rates = chosen(k[-1], k[0]) / (carry.t1 - carry.t0)
        interpolation = solver.interpolation_cls(t0=carry.t0, t1=carry.t1, **dense)

        def is_due(samples: _Samples) -> Array:
            return decision.keep & (samples.count < len(ts)) & (ts[samples.count] <= carry.t1)

        def sampled(samples: _Samples) -> _Samples:
            y = interpolation.evaluate(ts[samples.count])
            return _Samples(samples.motion.at[samples.count].set(y), samples.count + 1)

        done = (decision.t0 - start) / (control.settings.times.end - start)
        return _Carry(
            t0=decision.t0,
            t1=decision.t1,
            y=chosen(y, carry.y),
            rates=rates,
            solver_state=chosen(solver_state, carry.solver_state),
            jumped=None if carry.jumped is None else chosen(decision.jumped, carry.jumped),
            progress=decision.progress,
            is_running=decision.is_running,
            samples=loop(is_due, sampled, carry.samples, len(ts), len(ts), lambda s: s.motion),
            meter=meter.step(carry.meter, done),
        )

    last = loop(
        lambda carry: carry.is_running,
        step,
        carry,
        control.settings.max_steps,
        getattr(adjoint, "checkpoints", None),
        lambda carry: carry.samples.motion,
    )
    meter.close(last.meter)
    motion, count = last.samples
    return Steps(motion, count, last.t0, last.y, last.rates, Progress.unpacked(last.progress))


def _loop(
    kind: Any, condition: Any, body: Any, carry: Any, max_steps: int | None, checkpoints: int | None, buffers: Any
) -> Any:
    """The one of equinox that diffrax uses; it counts its steps where its derivative needs that."""
    more: dict[str, Any] = {} if kind == "lax" else {"max_steps": max_steps}
    more |= {"checkpoints": checkpoints} if kind == "checkpointed" else {}
    return eqxi.while_loop(condition, body, carry, buffers=buffers, kind=kind, **more)


def is_explicit(solver: Any) -> bool:
    """Whether it is an explicit Runge-Kutta method of diffrax, which a `HalfSolver` only seems to be."""
    return isinstance(solver, diffrax.AbstractERK) and not isinstance(solver, diffrax.HalfSolver)


def _has_rates_at_ends(solver: Any) -> bool:
    """Whether the first and the last of the stages k_i = h f_i of a step belong to its start and its end."""
    method = solver.method if isinstance(solver, UnrolledERK) else solver
    tableau: Any = method.tableau if is_explicit(method) else None
    return tableau is not None and tableau.fsal


class UnrolledERK(diffrax.AbstractAdaptiveSolver[Any]):
    """An explicit Runge-Kutta method of diffrax whose stages are written out, each a weighted sum and one call.

        y_i = y0 + sum_j a_ij k_j,   k_i = h f(t0 + c_i h, y_i),   y1 = y0 + sum_i b_i k_i

    diffrax makes one loop of the stages, so that the right-hand side is compiled once. Where that is a native kernel, a
    call of it costs nothing to compile, and the loop costs more than the stages: it carries all of them in one array,
    which XLA transposes in each. Samples are looked up at the times of all stages together. The numbers are those of
    `method`, to rounding errors.
    """

    method: diffrax.AbstractERK
    term_structure = diffrax.AbstractTerm

    @property
    def interpolation_cls(self) -> Any:  # type: ignore[override]
        return self.method.interpolation_cls

    def order(self, terms: Any) -> int | None:
        return self.method.order(terms)

    def error_order(self, terms: Any) -> Any:
        return self.method.error_order(terms)

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        return terms.vf(t0, y0, args)

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> Any:
        """The rates at the start, where the last stage of a step is the first of the next; else None."""
        tableau: Any = self.method.tableau
        return terms.vf(t0, y0, args) if tableau.fsal else None

    def step(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any) -> Any:
        tableau: Any = self.method.tableau
        h, times = terms.contr(t0, t1), [t0, *(t1 if c == 1 else t0 + float(c) * (t1 - t0) for c in tableau.c)]
        sampled = args.sampled(jnp.stack(times)) if isinstance(args, RateArguments) else {}
        rates_at = jax.jit(lambda t, y, numbers: terms.vf(t, y, args.with_numbers(numbers) if numbers else args))

        def rates(i: int, y: Array) -> Array:
            return rates_at(times[i], y, {name: x[i] for name, x in sampled.items()})

        if solver_state is None:
            f = rates(0, y0)
        elif made_jump is False:
            f = solver_state
        else:
            f = jax.lax.cond(made_jump, lambda: rates(0, y0), lambda: solver_state)
        k, y = [terms.prod(f, h)], y0
        for i, a in enumerate(tableau.a_lower, start=1):
            y = y0 + _weighted(a, k)
            f = rates(i, y)
            k.append(terms.prod(f, h))
        y1 = y if tableau.ssal else y0 + _weighted(tableau.b_sol, k)
        dense = {"y0": y0, "y1": y1, "k": jnp.stack(k)}
        return y1, _weighted(tableau.b_error, k), dense, f if tableau.fsal else None, diffrax.RESULTS.successful


def _weighted(weights: np.ndarray, values: list[Any]) -> Any:
    return functools.reduce(operator.add, [float(w) * x for w, x in zip(weights, values, strict=True) if w != 0])
