"""A program as one function of XLA, or as few, each short enough to be compiled soon. Knows XLA's habits only."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax

from .jax_internals import ClosedJaxpr, Jaxpr, Literal, jaxpr_as_fun, one_function

# XLA's time to compile a function grows faster than its length, above all where values of the beginning are needed at
# the end, as in a reverse derivative: 6000 equations take 17 s whole, and 2.5 s in pieces.
_WHOLE_UP_TO = 2500
_PIECE = 250


def in_pieces(program: ClosedJaxpr, args: Sequence[Any]) -> list[Any]:
    """What a program gives, compiled as one function, or as several one after the other."""
    jaxpr = program.jaxpr
    if len(jaxpr.eqns) <= _WHOLE_UP_TO:
        return _one_function(jaxpr_as_fun(program), args)
    values = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*program.consts, *args), strict=True))
    for piece in _pieces(jaxpr):
        values.update(zip(piece.outputs, _one_function(piece, [values[v] for v in piece.inputs]), strict=True))
    return [v.val if isinstance(v, Literal) else values[v] for v in jaxpr.outvars]


def _one_function(f: Callable[..., Any], args: Sequence[Any]) -> Any:
    # XLA aborts on a parameter that its simplified program no longer reads. The sum reads them all, and the barrier
    # hides constant arguments, which XLA would write into the program in the parameter's stead.
    places = [i for i, x in enumerate(args) if x.size]

    def values_and_sum(*some):
        return f(*replaced(args, places, some)), sum(x[(0,) * x.ndim].astype(float) for x in some)

    with one_function():
        values, _ = jax.jit(values_and_sum)(*jax.lax.optimization_barrier([args[i] for i in places]))
    return values


class _Piece(NamedTuple):
    """Some equations of a program, one after the other: a function of the variables `inputs`."""

    inputs: list[Any]
    outputs: list[Any]
    equations: Sequence[Any]

    def __call__(self, *args: Any) -> list[Any]:
        values = dict(zip(self.inputs, args, strict=True))
        for equation in self.equations:
            inputs = [v.val if isinstance(v, Literal) else values[v] for v in equation.invars]
            outputs = equation.primitive.bind(*inputs, **equation.params)
            values.update(zip(equation.outvars, outputs if equation.primitive.multiple_results else [outputs]))
        return [values[v] for v in self.outputs]


def _pieces(program: Jaxpr) -> list[_Piece]:
    read_later = {v for v in program.outvars if not isinstance(v, Literal)}
    pieces = []
    for start in reversed(range(0, len(program.eqns), _PIECE)):
        equations = program.eqns[start : start + _PIECE]
        made = {v for e in equations for v in e.outvars}
        read = dict.fromkeys(v for e in equations for v in e.invars if not isinstance(v, Literal) and v not in made)
        pieces.append(_Piece(list(read), [v for e in equations for v in e.outvars if v in read_later], equations))
        read_later |= set(read)
    return pieces[::-1]


def replaced(values: Sequence[Any], places: Sequence[int], new: Sequence[Any]) -> list[Any]:
    """The values, with new ones in some places."""
    values = list(values)
    for i, x in zip(places, new, strict=True):
        values[i] = x
    return values
