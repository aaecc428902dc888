"""Loops of diffrax that are compiled in less time. Knows diffrax, and what of its insides is used here."""

from __future__ import annotations

import dataclasses
from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array


class _Known(diffrax.AbstractAdjoint):
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


class _Forward(_Known, diffrax.ForwardMode):
    pass


class _Reverse(_Known, diffrax.RecursiveCheckpointAdjoint):
    pass


class _Both(_Known, diffrax.DirectAdjoint):
    pass


_KNOWN = {
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


def keeping(ts: Array, adjoint: diffrax.AbstractAdjoint, anew: bool = False) -> dict[str, Any]:
    """What `diffeqsolve` is asked for that is to keep the states at rising times (n_t,), and the last one: `adjoint`
    and `saveat`. `anew`: as diffrax does it, for an adjoint of the user, or a progress meter that asks for the end.
    """
    known = None if anew or not _AS_EXPECTED else _KNOWN.get(type(adjoint))
    end = diffrax.SubSaveAt(t1=True)
    samples = diffrax.SubSaveAt(ts=ts) if known is None else end
    return {
        "adjoint": adjoint if known is None else known(**vars(adjoint), ts=ts),
        "saveat": diffrax.SaveAt(subs=(samples, end), controller_state=True),
    }


_AS_EXPECTED = _is_as_expected()
