"""Explicit Runge-Kutta methods, stage by stage. Knows diffrax's solvers; knows no mechanics."""

from __future__ import annotations

import functools
import operator
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np


class WrittenOut(diffrax.AbstractAdaptiveSolver[Any]):
    """An explicit Runge-Kutta method of diffrax whose stages are written out, each a weighted sum and one call.

        y_i = y0 + sum_j a_ij k_j,   k_i = h f(t0 + c_i h, y_i),   y1 = y0 + sum_i b_i k_i

    diffrax makes one loop of the stages, so that the right-hand side is compiled once. Where that is a native kernel, a
    call of it costs nothing to compile, and the loop costs more than the stages: it carries all of them in one array,
    which XLA transposes in each. The numbers are those of `method`, to rounding errors.
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
        h, rates = terms.contr(t0, t1), jax.jit(lambda t, y: terms.vf(t, y, args))
        if solver_state is None:
            f = rates(t0, y0)
        elif made_jump is False:
            f = solver_state
        else:
            f = jax.lax.cond(made_jump, lambda: rates(t0, y0), lambda: solver_state)
        k, y = [terms.prod(f, h)], y0
        for a, c in zip(tableau.a_lower, map(float, tableau.c), strict=True):
            y = y0 + _weighted(a, k)
            f = rates(t1 if c == 1 else t0 + c * (t1 - t0), y)
            k.append(terms.prod(f, h))
        y1 = y if tableau.ssal else y0 + _weighted(tableau.b_sol, k)
        dense = {"y0": y0, "y1": y1, "k": jnp.stack(k)}
        return y1, _weighted(tableau.b_error, k), dense, f if tableau.fsal else None, diffrax.RESULTS.successful


def _weighted(weights: np.ndarray, values: list[Any]) -> Any:
    return functools.reduce(operator.add, [float(w) * x for w, x in zip(weights, values, strict=True) if w != 0])
