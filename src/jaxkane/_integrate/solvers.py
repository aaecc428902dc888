"""Solvers: explicit Runge-Kutta methods with unrolled stages, and one-sided look-up of inputs at the ends of steps."""

from __future__ import annotations

import dataclasses
import functools
import operator
from typing import Any, ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .inputs import RateArguments


def is_explicit(solver: Any) -> bool:
    """Whether this is an explicit Runge-Kutta method of diffrax. A `HalfSolver` passes `isinstance` but is not one."""
    return isinstance(solver, diffrax.AbstractERK) and not isinstance(solver, diffrax.HalfSolver)


def rates_at_ends(solver: Any) -> bool:
    """Whether the first and the last stage k_i = h f_i of a step are evaluated at its start and its end."""
    method = solver.method if isinstance(solver, UnrolledERK) else solver
    tableau: Any = method.tableau if is_explicit(method) else None
    return tableau is not None and tableau.fsal


def last_stage_is_spare(solver: Any) -> bool:
    """Whether the last stage of a step is only used as the first stage of the next step, as with Bosh3."""
    tableau: Any = solver.tableau if is_explicit(solver) else None
    return tableau is not None and tableau.fsal and not np.any((tableau.c == 1) & (tableau.b_sol[1:] != 0))


@functools.cache
def _stepwise(kind: Any) -> Any:
    class StepwiseInputs(kind):
        def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> Any:
            return super().init(terms, t0, t1, y0, args.in_step(t0, t1))

        def step(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any) -> Any:
            return super().step(terms, t0, t1, y0, args.in_step(t0, t1), solver_state, made_jump)

    return StepwiseInputs


def with_stepwise_inputs(solver: diffrax.AbstractSolver) -> Any:
    """The solver, whose stages use the piece of each input that lies inside the step (see `RateArguments.in_step`).

    A solver of diffrax passes only the time to the right-hand side. At the end of a step, the time does not determine
    the side of a discontinuity.
    """
    stepwise = object.__new__(_stepwise(type(solver)))
    for field in dataclasses.fields(solver):
        object.__setattr__(stepwise, field.name, getattr(solver, field.name))
    return stepwise


class UnrolledERK(diffrax.AbstractAdaptiveSolver[Any]):
    """An explicit Runge-Kutta method of diffrax with unrolled stages.

        y_i = y0 + sum_j a_ij k_j,   k_i = h f(t0 + c_i h, y_i),   y1 = y0 + sum_i b_i k_i

    diffrax evaluates the stages in a loop, so that the right-hand side is compiled once. A native kernel is already
    compiled, so unrolled stages take no longer to compile and are faster: the loop carries all stages in one array,
    which XLA transposes in every pass. Samples are looked up at the times of all stages together. The results are equal
    to those of `method` within rounding.
    """

    method: diffrax.AbstractERK
    term_structure = diffrax.AbstractTerm
    always_succeeds: ClassVar[bool] = True

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
        """The rates at the start if the last stage of a step is the first of the next, else None."""
        tableau: Any = self.method.tableau
        return terms.vf(t0, y0, _in_step(args, t0, t1)) if tableau.fsal else None

    def step(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any) -> Any:
        tableau: Any = self.method.tableau
        args = _in_step(args, t0, t1)
        h, times = terms.contr(t0, t1), [t0, *(t1 if c == 1 else t0 + float(c) * (t1 - t0) for c in tableau.c)]
        sampled = args.sampled(jnp.stack(times)) if isinstance(args, RateArguments) else {}

        @jax.jit
        def rates_at(t: Array, y: Array, numbers: dict[str, Array]) -> Array:
            return terms.vf(t, y, dataclasses.replace(args, signals=args.signals | numbers) if numbers else args)

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


def _in_step(args: Any, t0: Any, t1: Any) -> Any:
    return args.in_step(t0, t1) if isinstance(args, RateArguments) else args


def _weighted(weights: np.ndarray, values: list[Any]) -> Any:
    return functools.reduce(operator.add, [float(w) * x for w, x in zip(weights, values, strict=True) if w != 0])
