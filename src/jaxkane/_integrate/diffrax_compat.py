"""Loops of diffrax that know their times, and its Runge-Kutta methods with unrolled stages: both compile faster."""

from __future__ import annotations

import dataclasses
import functools
import operator
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array


class _KnownTimes(diffrax.AbstractAdjoint):
    """A loop that knows its sample times to rise, and that the step size controller ends it.

    diffrax checks the times while it runs, and finds by a hundred operations which time is a hundred rounding errors
    before the last one. XLA takes a third of its time for that. So `diffeqsolve` is asked for two last states; the loop
    is given memory for the states at `ts` (n_t,) instead of the first of them, and no last time (nor a first, which the
    progress meter alone would read). Nor does time go backwards here, which is what terms are wrapped for.
    """

    ts: Array = eqx.field(kw_only=True)

    def loop(self, *, terms, t0, t1, saveat, init_state, **rest):  # type: ignore[override]
        first, last = init_state.save_state
        room = [jnp.full((len(self.ts), *x.shape[1:]), jnp.inf, x.dtype) for x in (first.ts, first.ys)]
        first = eqx.tree_at(lambda s: [s.ts, s.ys], first, room)
        init_state = eqx.tree_at(lambda s: s.save_state, init_state, (first, last))
        saveat = eqx.tree_at(lambda s: s.subs, saveat, (diffrax.SubSaveAt(ts=self.ts), saveat.subs[1]))
        always = {"t0": jnp.zeros_like(t0), "t1": jnp.full_like(t1, jnp.inf)}
        return super().loop(**always, terms=terms.term, saveat=saveat, init_state=init_state, **rest)  # type: ignore[safe-super]


class _Forward(_KnownTimes, diffrax.ForwardMode):
    pass


class _Reverse(_KnownTimes, diffrax.RecursiveCheckpointAdjoint):
    pass


class _Both(_KnownTimes, diffrax.DirectAdjoint):
    pass


_WITH_KNOWN_TIMES = {
    diffrax.ForwardMode: _Forward,
    diffrax.RecursiveCheckpointAdjoint: _Reverse,
    diffrax.DirectAdjoint: _Both,
}


def _is_as_expected() -> bool:
    """Whether the state of diffrax's loop has the parts that are replaced here."""
    try:
        from diffrax._integrate import SaveState, State
        from diffrax._term import WrapTerm
    except ImportError:
        return False
    state, saved, term = ({f.name for f in dataclasses.fields(kind)} for kind in (State, SaveState, WrapTerm))
    return "save_state" in state and saved == {"saveat_ts_index", "ts", "ys", "save_index"} and "term" in term


_AS_EXPECTED = _is_as_expected()


def saveat_and_adjoint(ts: Array, adjoint: diffrax.AbstractAdjoint, as_given: bool = False) -> dict[str, Any]:
    """Arguments of `diffeqsolve` that keep the states at rising times (n_t,), and the last one.

    `as_given`: the adjoint as it is, as one of the user is, too: for a progress meter, which asks for the last time.
    """
    known = None if as_given or not _AS_EXPECTED else _WITH_KNOWN_TIMES.get(type(adjoint))
    last = diffrax.SubSaveAt(t1=True)
    samples = diffrax.SubSaveAt(ts=ts) if known is None else last
    return {
        "adjoint": adjoint if known is None else known(**vars(adjoint), ts=ts),
        "saveat": diffrax.SaveAt(subs=(samples, last), controller_state=True),
    }


class UnrolledERK(diffrax.AbstractAdaptiveSolver[Any]):
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
