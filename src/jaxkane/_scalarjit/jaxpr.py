"""Products of small matrices as sums of products of numbers, as in a small neural network. Knows arrays only."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .compat import ClosedJaxpr, Jaxpr, Literal, dce_jaxpr, jaxpr_as_fun, new_variable, one_function, types_of
from .graph import CALLS, Graph, applied, as_constants

_LONGEST, _LARGEST = 64, 4096  # sum, number of products


def is_small(equation: Any) -> bool:
    """Whether a `dot_general` is one that is better written out."""
    (contracted, _), _ = equation.params["dimension_numbers"]
    shape = equation.invars[0].aval.shape
    length = math.prod(shape[i] for i in contracted)
    return length <= _LONGEST and length * equation.outvars[0].aval.size <= _LARGEST


def sum_of_products(equation: Any, x: Array, y: Array) -> Array:
    """What a `dot_general` gives: over (batch, free of x, free of y)."""
    contracted, batch = equation.params["dimension_numbers"]
    x, y = (_ordered(jnp.asarray(z), along, over) for z, along, over in zip((x, y), contracted, batch, strict=True))
    aval = equation.outvars[0].aval
    return jnp.sum(x[:, :, None, :] * y[:, None, :, :], axis=-1).reshape(aval.shape).astype(aval.dtype)


def _ordered(x: Array, contracted: tuple[int, ...], batch: tuple[int, ...]) -> Array:
    """As (batch, free, contracted)."""
    free = [i for i in range(x.ndim) if i not in (*contracted, *batch)]
    sizes = [math.prod(x.shape[i] for i in axes) for axes in (batch, free, contracted)]
    return jnp.transpose(x, (*batch, *free, *contracted)).reshape(sizes)


# What one compiled function may hold: elementwise work and the moving of scalars. Calls into libraries (LAPACK) may not
# be compiled so, and loops would gain nothing.
_PLAIN = frozenset(
    "abs acos acosh add add_any and asin asinh atan atan2 atanh broadcast_in_dim cbrt ceil clamp concatenate "
    "convert_element_type copy copy_p cos cosh div eq erf exp exp2 expm1 floor ge gt integer_pow is_finite jit le "
    "log log1p logistic lt max min mul ne neg not one_minus_square or pad pjit pow reduce_and reduce_max reduce_min "
    "reduce_or reduce_prod reduce_sum rem reshape rev round rsqrt select_n sign sin sinh slice split sqrt square "
    "squeeze stack stop_gradient sub tan tanh transpose unstack xor".split()
)
_LARGEST_SUM = 64  # XLA may hand larger ones to a library

# In the name of each call of the method itself into LAPACK.
BY_LAPACK = "by_lapack"
# The name of the primitive of JAX that stands for a program, with the parameters `program`, `sizes` and `where`.
PROGRAM = "scalar_program"


def cse(program: ClosedJaxpr) -> ClosedJaxpr:
    """The same program with every common subexpression once, and without what no output needs; products of small
    matrices, which XLA would hand to a library, are sums of products.

    A description is read once for every speed, and much of it comes out the same. XLA would find that too, but only
    after JAX has differentiated every copy.
    """
    once = _Once()
    outputs = once.walk(program.jaxpr, program.consts, program.jaxpr.invars)
    jaxpr = program.jaxpr.replace(constvars=[*once.consts], eqns=once.equations, outvars=outputs)
    jaxpr, _ = dce_jaxpr(jaxpr, [True] * len(outputs), instantiate=True)
    return ClosedJaxpr(jaxpr, [*once.consts.values()])


class _Once:
    """Equations of programs in one list, each once. They are put down as they stand and not traced anew, which would
    take as long as all else that is done to a program."""

    def __init__(self) -> None:
        self.equations: list[Any] = []
        self.consts: dict[Any, Any] = {}  # by their variables
        self._known: dict[Any, Sequence[Any]] = {}  # the outputs of an equation, by its name

    def walk(self, program: Jaxpr, consts: Sequence[Any], inputs: Sequence[Any]) -> list[Any]:
        """The variables of a program's outputs, where its inputs are these variables or literals."""
        values: dict[Any, Any] = dict(zip(program.invars, inputs, strict=True))
        values.update((v, self._const(v, x)) for v, x in zip(program.constvars, consts, strict=True))
        read = lambda v: v if isinstance(v, Literal) else values[v]  # noqa: E731
        for equation in program.eqns:
            xs = [read(v) for v in equation.invars]
            inner = opened(equation)
            if inner is not None:
                outputs = self.walk(inner.jaxpr, inner.consts, xs)
            else:
                # Numbers by their bits, all else by identity.
                names = [_bits(x) if isinstance(x, Literal) else id(x) for x in xs]
                key = (equation.primitive, *names, _name_of(equation))
                if key not in self._known:
                    self._known[key] = self._put_down(equation, xs)
                outputs = self._known[key]
            values.update(zip(equation.outvars, outputs, strict=True))
        return [read(v) for v in program.outvars]

    def _const(self, variable: Any, value: Any) -> Any:
        key = ("const", id(value))
        if key not in self._known:
            self._known[key] = [new_variable(variable)]
            self.consts[self._known[key][0]] = value  # which keeps it alive, and its id its own
        return self._known[key][0]

    def _put_down(self, equation: Any, xs: list[Any]) -> Sequence[Any]:
        if equation.primitive.name == "dot_general" and is_small(equation):
            specs = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in xs]
            product = jax.make_jaxpr(functools.partial(sum_of_products, equation))(*specs)
            return self.walk(product.jaxpr, product.consts, xs)
        outputs = [*map(new_variable, equation.outvars)]  # a program may be opened twice
        self.equations.append(equation.replace(invars=xs, outvars=outputs))
        return outputs


def _bits(literal: Any) -> tuple[bytes, str]:
    return np.asarray(literal.val).tobytes(), str(literal.aval)  # -0.0 == 0.0, and an array's text is rounded


def _name_of(equation: Any) -> Any:
    """What two equations that do the same have in common: their parameters; itself where these cannot be compared."""
    key = tuple(sorted(equation.params.items()))
    try:
        hash(key)
    except TypeError:
        return id(equation)
    return key


def opened(equation: Any) -> ClosedJaxpr | None:
    """What an equation stands for: a program within a program is opened, so that the whole is one."""
    if equation.primitive.name == PROGRAM:
        program, sizes, where = (equation.params[k] for k in ("program", "sizes", "where"))
        return (program.batched(sizes, where) if sizes else program).program
    return equation.params["jaxpr"] if equation.primitive.name in CALLS else None


def reads_of(program: Jaxpr) -> tuple[bool, ...]:
    """Which of its inputs a program reads at all; the first, if it reads none."""
    read = {v for e in program.eqns for v in e.invars if not isinstance(v, Literal)}
    read.update(v for v in program.outvars if not isinstance(v, Literal))
    found = tuple(v in read for v in program.invars)
    return found if any(found) else (True, *found[1:])


def is_fusable(program: Jaxpr) -> bool:
    """Whether a program can be one compiled function."""
    return not any(unsupported_primitives(program))


def unsupported_primitives(program: Jaxpr, is_ours: bool = False) -> Iterator[tuple[str, bool]]:
    """The operations that cannot be part of one compiled function, and whether they are the description's own: the
    method itself has LAPACK solve what is too large to be written out (`_linear`)."""
    for equation in program.eqns:
        name, inner = equation.primitive.name, opened(equation)
        if inner is not None:
            yield from unsupported_primitives(inner.jaxpr, is_ours or BY_LAPACK in equation.params.get("name", ""))
        elif name == "dot_general" and is_small(equation):
            continue  # see `cse`
        elif name not in _PLAIN:
            yield name, not is_ours
        elif name.startswith("reduce_") and getattr(equation.invars[0].aval, "size", 0) > _LARGEST_SUM:
            yield f"{name} of more than {_LARGEST_SUM}", not is_ours


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


Direction = tuple[int, int]  # an argument and the place of the element in it


def jacobian(
    program: ClosedJaxpr, inputs: Sequence[np.ndarray], directions: Sequence[Direction], graph: Graph
) -> list[np.ndarray]:
    """The derivatives (..., d) of each output by d elements of the inputs, as nodes of the graph."""
    moving = sorted({i for i, _ in directions})
    tangents, avals = _tangents(program, moving)
    jaxpr = tangents.jaxpr
    values = dict(zip(jaxpr.invars, inputs, strict=False)) | {
        v: as_constants(x, graph) for v, x in zip(jaxpr.constvars, tangents.consts, strict=True)
    }
    of_direction = set(jaxpr.invars[len(inputs) :])
    later = []
    for equation in jaxpr.eqns:  # what depends on the direction waits
        if of_direction.isdisjoint(v for v in equation.invars if not isinstance(v, Literal)):
            values.update(zip(equation.outvars, _outputs(equation, values, graph), strict=True))
        else:
            of_direction.update(equation.outvars)
            later.append(equation)
    moves = _Moves(graph)
    columns = []
    for argument, element in directions:
        along = dict(values)
        for v, i, aval in zip(jaxpr.invars[len(inputs) :], moving, avals, strict=True):
            along[v] = np.full(aval.shape, NOTHING, np.int64)
            if i == argument:
                along[v].flat[element] = graph.constant(1.0, str(aval.dtype))
        for equation in later:
            along.update(zip(equation.outvars, _outputs(equation, along, moves), strict=True))
        read = [_read(v, along, moves) for v in jaxpr.outvars]
        columns.append([moves.instantiated(x, str(a.dtype)) for x, a in zip(read, types_of(program)[1], strict=True)])
    return [
        np.stack([column[i] for column in columns], axis=-1) if columns else np.zeros((*aval.shape, 0), np.int64)
        for i, aval in enumerate(types_of(program)[1])
    ]


def _tangents(program: ClosedJaxpr, moving: Sequence[int]) -> tuple[ClosedJaxpr, list[Any]]:
    """(inputs, tangents of those that move) -> tangents of the outputs."""
    specs = [jax.ShapeDtypeStruct(a.shape, a.dtype, weak_type=a.weak_type) for a in types_of(program)[0]]
    evaluate = jaxpr_as_fun(program)

    def tangents(xs, dxs):
        def of_moving(*ys):
            full = list(xs)
            for i, y in zip(moving, ys, strict=True):
                full[i] = y
            return evaluate(*full)

        return jax.jvp(of_moving, [xs[i] for i in moving], dxs)[1]

    avals = [specs[i] for i in moving]
    return cse(jax.make_jaxpr(tangents)(specs, avals)), avals


def _outputs(equation: Any, values: dict[Any, np.ndarray], graph: Any) -> list[np.ndarray]:
    return applied(equation, [_read(v, values, graph) for v in equation.invars], graph)


def _read(v: Any, values: dict[Any, np.ndarray], graph: Any) -> np.ndarray:
    return as_constants(v.val, graph) if isinstance(v, Literal) else values[v]


NOTHING = -1  # in the place of a node: no derivative at all


class _Moves:
    """A graph, for operations on derivatives of which some are `NOTHING`."""

    def __init__(self, graph: Graph):
        self.graph = graph

    def constant(self, value: Any, dtype: str) -> int:
        return self.graph.constant(value, dtype)

    def apply(self, operation: str, operands: tuple[int, ...], dtype: str) -> int:
        if NOTHING in operands:
            match operation, operands:
                case ("add", (a, b)):
                    return b if a == NOTHING else a
                case ("sub", (a, b)):
                    return a if b == NOTHING else self.graph.apply("neg", (b,), dtype)
                case (("mul" | "neg" | "convert"), _) | ("div", (-1, _)) | ("select", (_, -1, -1)):
                    return NOTHING
            operands = tuple(self.graph.constant(0.0, dtype) if i == NOTHING else i for i in operands)
        return self.graph.apply(operation, operands, dtype)

    def instantiated(self, nodes: np.ndarray, dtype: str) -> np.ndarray:
        return np.where(nodes == NOTHING, self.graph.constant(0.0, dtype), nodes)
