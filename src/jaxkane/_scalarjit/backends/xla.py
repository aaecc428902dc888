"""A program as one function of XLA:CPU, by its small call; a very long one outlined into a few.

XLA cuts a program of scalars into many kernels and computes shared intermediates again in each. A call that carries the
frontend attribute `xla_cpu_small_call` is compiled as one function, in which LLVM sees every intermediate once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax

from ..compat import ClosedJaxpr, Jaxpr, evaluated, interpret, is_literal, jaxpr_as_fun, one_function
from ..jaxpr import replaced

# XLA's time to compile a function grows faster than its length, above all where values of the beginning are needed at
# the end, as in a reverse derivative: 6000 equations take 17 s whole, and 2.5 s in pieces.
_WHOLE_UP_TO = 2500
_PIECE = 250


def as_one_function(program: ClosedJaxpr, args: Sequence[Any]) -> list[Any]:
    """The results of a program, compiled as one function, or as several one after the other."""
    jaxpr: Any = program.jaxpr
    if len(jaxpr.eqns) <= _WHOLE_UP_TO:
        return _called(jaxpr_as_fun(program), args)
    values = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*program.consts, *args), strict=True))
    for piece in _outlined(jaxpr):
        f = lambda *xs, piece=piece: interpret(piece, xs, evaluated)  # noqa: E731
        values.update(zip(piece.outvars, _called(f, [values[v] for v in piece.invars]), strict=True))
    return [v.val if is_literal(v) else values[v] for v in jaxpr.outvars]


def _called(f: Callable[..., Any], args: Sequence[Any]) -> Any:
    # XLA aborts on a parameter that its simplified program no longer reads. The sum reads them all, and the barrier
    # hides constant arguments, which XLA would write into the program in the parameter's stead.
    places = [i for i, x in enumerate(args) if x.size]

    def values_and_sum(*some):
        return f(*replaced(args, places, some)), sum(x[(0,) * x.ndim].astype(float) for x in some)

    with one_function():
        values, _ = jax.jit(values_and_sum)(*jax.lax.optimization_barrier([args[i] for i in places]))
    return values


class _Piece(NamedTuple):
    """Some equations of a program, one after the other, with the fields of a program."""

    invars: list[Any]
    outvars: list[Any]
    eqns: Sequence[Any]
    constvars: tuple[()] = ()
    consts: tuple[()] = ()

    @property
    def jaxpr(self) -> _Piece:
        return self


def _outlined(program: Jaxpr) -> list[_Piece]:
    read_later = {v for v in program.outvars if not is_literal(v)}
    pieces = []
    for start in reversed(range(0, len(program.eqns), _PIECE)):
        equations = program.eqns[start : start + _PIECE]
        made = {v for e in equations for v in e.outvars}
        read = dict.fromkeys(v for e in equations for v in e.invars if not is_literal(v) and v not in made)
        pieces.append(_Piece(list(read), [v for e in equations for v in e.outvars if v in read_later], equations))
        read_later |= set(read)
    return pieces[::-1]
