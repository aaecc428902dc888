"""Programs of JAX rewritten: common subexpressions once, small products as sums, derivatives as programs again."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .cache_key import Cache
from .compat import (
    ClosedJaxpr,
    Jaxpr,
    dce_jaxpr,
    interpret,
    is_literal,
    new_variable,
    settings,
    tangents_of,
    transposed,
    types_of,
)
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
LARGEST_SUM = 64  # XLA may hand larger ones to a library

# In the name of each call of the method itself into LAPACK.
BY_LAPACK = "by_lapack"
# The name of the primitive of JAX that stands for a program, with the parameters `program`, `sizes` and `where`.
PROGRAM = "scalar_program"


def cse(program: ClosedJaxpr, keeps_solutions: bool = False) -> ClosedJaxpr:
    """The same program with every common subexpression once, and without what no output needs; products of small
    matrices, which XLA would hand to a library, are sums of products.

    A description is read once for every speed, and much of it comes out the same. XLA would find that too, but only
    after JAX has differentiated every copy. `keeps_solutions`: a program within it that solves equations remains one
    equation, so that these are differentiated.
    """
    once = _Once(keeps_solutions)
    return once.program(program.jaxpr, program.jaxpr.invars, once.walk(program, program.jaxpr.invars))


class _Once:
    """Equations of programs in one list, each once. They are put down as they stand and not traced anew, which would
    take as long as all else that is done to a program."""

    def __init__(self, keeps_solutions: bool = False) -> None:
        self.keeps_solutions = keeps_solutions
        self.equations: list[Any] = []
        self.consts: dict[Any, Any] = {}  # by their variables
        self._known: dict[Any, Sequence[Any]] = {}  # the outputs of an equation, by its name

    def program(self, like: Jaxpr, inputs: Sequence[Any], outputs: Sequence[Any]) -> ClosedJaxpr:
        """What has been put down, as a program of these inputs, without what no output needs."""
        jaxpr = like.replace(constvars=[*self.consts], invars=[*inputs], eqns=self.equations, outvars=[*outputs])
        jaxpr, _ = dce_jaxpr(jaxpr, [True] * len(outputs), instantiate=True)
        return ClosedJaxpr(jaxpr, [*self.consts.values()])

    def walk(self, program: ClosedJaxpr, inputs: Sequence[Any]) -> list[Any]:
        """The variables of a program's outputs, where its inputs are these variables or literals."""
        return interpret(program, inputs, self.results, self.constant)

    def results(self, equation: Any, xs: list[Any]) -> Sequence[Any]:
        inner = None if self.keeps_solutions and is_solution(equation) else opened(equation)
        if inner is not None:
            return self.walk(inner, xs)
        # Numbers by their bits, all else by identity.
        key = (equation.primitive, *(_bits(x) if is_literal(x) else id(x) for x in xs), _parameters_of(equation))
        if key not in self._known:
            self._known[key] = self._put_down(equation, xs)
        return self._known[key]

    def constant(self, variable: Any, value: Any) -> Any:
        if is_literal(variable):
            return variable
        key = ("const", id(value))
        if key not in self._known:
            self._known[key] = [new_variable(variable)]
            self.consts[self._known[key][0]] = value  # which keeps it alive, and its id its own
        return self._known[key][0]

    def _put_down(self, equation: Any, xs: list[Any]) -> Sequence[Any]:
        if equation.primitive.name == "dot_general" and is_small(equation):
            specs = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in xs]
            product = jax.make_jaxpr(functools.partial(sum_of_products, equation))(*specs)
            return self.walk(product, xs)
        outputs = [*map(new_variable, equation.outvars)]  # a program may be opened twice
        self.equations.append(equation.replace(invars=xs, outvars=outputs))
        return outputs


def _bits(literal: Any) -> tuple[bytes, str]:
    return np.asarray(literal.val).tobytes(), str(literal.aval)  # -0.0 == 0.0, and an array's text is rounded


def _parameters_of(equation: Any) -> Any:
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


def is_solution(equation: Any) -> bool:
    """Whether an equation stands for a program whose last result solves linear equations."""
    name, parameters = equation.primitive.name, equation.params
    return name == PROGRAM and parameters["program"].is_solution and not parameters["sizes"]


def reads_of(program: Jaxpr) -> tuple[bool, ...]:
    """Which of its inputs a program reads at all; the first, if it reads none."""
    variables = {v for e in program.eqns for v in e.invars if not is_literal(v)}
    variables.update(v for v in program.outvars if not is_literal(v))
    is_read = tuple(v in variables for v in program.invars)
    return is_read if any(is_read) else (True, *is_read[1:])


def is_fusable(program: Jaxpr) -> bool:
    """Whether a program can be one compiled function."""
    return not any(unsupported_primitives(program))


def unsupported_primitives(program: Jaxpr, is_ours: bool = False) -> Iterator[tuple[str, bool]]:
    """The operations that cannot be part of one compiled function, and whether they are the description's own: the
    method itself has LAPACK solve what is too large to be written out (`linear`)."""
    for equation in program.eqns:
        name, inner = equation.primitive.name, opened(equation)
        if inner is not None:
            yield from unsupported_primitives(inner.jaxpr, is_ours or BY_LAPACK in equation.params.get("name", ""))
        elif name == "dot_general" and is_small(equation):
            continue  # see `cse`
        elif name not in _PLAIN:
            yield name, not is_ours
        elif name.startswith("reduce_") and getattr(equation.invars[0].aval, "size", 0) > LARGEST_SUM:
            yield f"{name} of more than {LARGEST_SUM}", not is_ours


def replaced(values: Sequence[Any], places: Sequence[int], new: Sequence[Any]) -> list[Any]:
    """The values, with new ones in some places."""
    values = list(values)
    for i, x in zip(places, new, strict=True):
        values[i] = x
    return values


def specs_of(avals: Sequence[Any]) -> list[jax.ShapeDtypeStruct]:
    return [jax.ShapeDtypeStruct(a.shape, a.dtype, weak_type=a.weak_type) for a in avals]


def is_inexact(aval: Any) -> bool:
    """Whether there can be a derivative of this kind of number, or by it."""
    return jnp.issubdtype(aval.dtype, jnp.inexact)


def program_of(f: Callable[..., Any], *specs: Any, return_shape: bool = False) -> Any:
    """`jax.make_jaxpr(f)(*specs)` without devices that share the work: in `jax.shard_map` JAX places constants on them,
    which is no operation of scalars."""
    with jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), ())):
        return jax.make_jaxpr(f, return_shape=return_shape)(*specs)


class Solved(NamedTuple):
    """What the last result x of a program solves, M x = b.

    `equations`: (inputs, x) -> the other results and b - M x. `solve`: (inputs, r) -> the y of M y = r.
    """

    equations: ClosedJaxpr
    solve: ClosedJaxpr

    @classmethod
    def of(cls, both: ClosedJaxpr) -> Solved:
        """Of a program (inputs, x, r) -> the other results, b - M x and y."""
        jaxpr, n = both.jaxpr, len(both.out_avals)
        *inputs, x, r = jaxpr.invars

        def part(outputs: Sequence[int], invars: Sequence[Any]) -> ClosedJaxpr:
            kept, _ = dce_jaxpr(jaxpr, [i in outputs for i in range(n)], instantiate=True)
            return ClosedJaxpr(kept.replace(invars=[*invars]), both.consts)

        return cls(part(range(n - 1), [*inputs, x]), part([n - 1], [*inputs, r]))


class _Rule(NamedTuple):
    """What stands for an equation in a derivative: a program, and which of the derivatives it gives are not zero."""

    program: ClosedJaxpr
    given: tuple[bool, ...]

    def written(self, once: _Once, inputs: Sequence[Any]) -> list[Any]:
        """Its results, written into a program; None for those that are zero."""
        results = iter(once.walk(self.program, inputs))
        return [next(results) if is_given else None for is_given in self.given]


_rules = Cache(4096)


def _rule(f: Callable[..., Sequence[Any]], equation: Any, which: tuple[bool, ...], *inputs: Any) -> _Rule:
    """The rule of an equation, traced once for all equations alike, where `f` of its `inputs` gives derivatives or
    None. `which` of the derivatives it takes are not zero."""
    types = tuple((v.aval.shape, v.aval.dtype, v.aval.weak_type) for v in (*equation.invars, *inputs))
    parameters = _parameters_of(equation)
    key = (f.__name__, equation.primitive, parameters, which, types, settings())

    def make() -> _Rule:
        given: list[bool] = []

        def derivatives(*xs: Any) -> list[Any]:
            results = f(equation, which, *xs)
            given[:] = [x is not None for x in results]
            return [x for x in results if x is not None]

        return _Rule(program_of(derivatives, *specs_of([v.aval for v in inputs])), tuple(given))

    return make() if isinstance(parameters, int) else _rules.get(key, make)


def _tangents(equation: Any, moves: tuple[bool, ...], *values: Any) -> Sequence[Any]:
    """Of the inputs of an equation, and the tangents of those that move."""
    xs, dxs = values[: len(moves)], iter(values[len(moves) :])
    return tangents_of(equation, xs, [next(dxs) if m else None for m in moves])


def _cotangents(equation: Any, moves_and_given: tuple[bool, ...], *values: Any) -> Sequence[Any]:
    """Of the inputs of an equation that do not move, and the cotangents of its results that are given."""
    n, values_left = len(equation.invars), iter(values)
    moves, given = moves_and_given[:n], moves_and_given[n:]
    xs = [None if m else next(values_left) for m in moves]
    return transposed(equation, xs, moves, [next(values_left) if is_one else None for is_one in given])


def tangent_program(
    program: ClosedJaxpr, moving: Sequence[int], values: bool = False
) -> tuple[ClosedJaxpr, tuple[bool, ...]]:
    """(inputs, tangents of those at the places `moving`) -> tangents of the outputs that move; and which these are.
    With `values`, all outputs come before these.

    Equation by equation, by JAX's rule of each, traced once for all alike. To trace the whole takes four times as long.
    Where a program solves M x = b, these equations are differentiated at x, and never the solution of the solve:

        M dx = d(b - M x) at fixed x
    """
    jaxpr: Any = program.jaxpr
    once, tangents = _Once(), {jaxpr.invars[i]: new_variable(jaxpr.invars[i]) for i in moving}

    constant = lambda v, x: (once.constant(v, x), None)  # noqa: E731

    def rule(equation: Any, pairs: list[Any]) -> Sequence[Any]:
        xs, dxs = [x for x, _ in pairs], [dx for _, dx in pairs if dx is not None]
        ys = once.results(equation, xs)
        if not dxs:
            return [(y, None) for y in ys]
        solved = equation.params["program"].solved if is_solution(equation) else None
        if solved is not None:
            slopes = [dy for _, dy in interpret(solved.equations, [*pairs, (ys[-1], None)], rule, constant)]
            if slopes[-1] is not None:
                slopes[-1] = once.walk(solved.solve, [*xs, slopes[-1]])[0]
            return [*zip(ys, slopes, strict=True)]
        inner = opened(equation)
        if inner is not None:
            return interpret(inner, pairs, rule, constant)
        moves = tuple(dx is not None for _, dx in pairs)
        moved = [v for v, m in zip(equation.invars, moves, strict=True) if m]
        dys = _rule(_tangents, equation, moves, *equation.invars, *moved).written(once, [*xs, *dxs])
        return [*zip(ys, dys, strict=True)]

    inputs = [(v, tangents.get(v)) for v in jaxpr.invars]
    pairs = interpret(program, inputs, rule, constant)
    results = [*(y for y, _ in pairs if values), *(dy for _, dy in pairs if dy is not None)]
    return once.program(jaxpr, [*jaxpr.invars, *tangents.values()], results), tuple(dy is not None for _, dy in pairs)


def transposed_program(program: ClosedJaxpr, linear: Sequence[int]) -> ClosedJaxpr:
    """(the other inputs, cotangents of the outputs) -> cotangents of the inputs at the places `linear`.

    Equations that do not depend on these are put down as they stand, the others by JAX's rule of each, from the last to
    the first. `jax.linear_transpose` traces the whole program twice, which takes longer than all that JAX does besides.
    """
    jaxpr: Any = program.jaxpr
    once, inputs = _Once(), [v for i, v in enumerate(jaxpr.invars) if i not in linear]
    moved: set[Any] = {jaxpr.invars[i] for i in linear}
    moves = lambda v: not is_literal(v) and v in moved  # noqa: E731
    values: dict[Any, Any] = dict(zip(inputs, inputs, strict=True))
    values.update(zip(jaxpr.constvars, map(once.constant, jaxpr.constvars, program.consts), strict=True))
    read = lambda v: v if is_literal(v) else values[v]  # noqa: E731
    moving = []
    for equation in jaxpr.eqns:
        if any(map(moves, equation.invars)):
            moving.append(equation)
            moved.update(equation.outvars)
        else:
            values.update(zip(equation.outvars, once.results(equation, [*map(read, equation.invars)]), strict=True))
    sums: dict[Any, Any] = {}

    def add(variables: Sequence[Any], cts: Sequence[Any]) -> None:
        for v, ct in zip(variables, cts, strict=True):
            if ct is not None and moves(v):
                sums[v] = once.walk(_sum_of(v.aval), [sums[v], ct])[0] if v in sums else ct

    cotangents = [*map(new_variable, jaxpr.outvars)]
    add(jaxpr.outvars, cotangents)
    for equation in reversed(moving):
        cts = [sums.pop(v, None) for v in equation.outvars]
        given = [(v, ct) for v, ct in zip(equation.outvars, cts, strict=True) if ct is not None]
        if given:
            which = (*map(moves, equation.invars), *(ct is not None for ct in cts))
            fixed = [v for v in equation.invars if not moves(v)]
            rule = _rule(_cotangents, equation, which, *fixed, *(v for v, _ in given))
            add(equation.invars, rule.written(once, [*map(read, fixed), *(ct for _, ct in given)]))
    zeros = lambda aval: once.walk(program_of(lambda: jnp.zeros(aval.shape, aval.dtype)), [])[0]  # noqa: E731
    results = [sums[v] if v in sums else zeros(v.aval) for v in (jaxpr.invars[i] for i in linear)]
    return once.program(jaxpr, [*inputs, *cotangents], results)


def _sum_of(aval: Any) -> ClosedJaxpr:
    specs = specs_of([aval, aval])
    return _rules.get(("sum", aval.shape, aval.dtype, aval.weak_type), lambda: program_of(jax.lax.add, *specs))


Direction = tuple[int, int]  # an argument and the place of the element in it


def jacobian(
    program: ClosedJaxpr, inputs: Sequence[np.ndarray], directions: Sequence[Direction], graph: Graph
) -> list[np.ndarray]:
    """The derivatives (..., d) of each output by d elements of the inputs, as nodes of the graph."""
    moving = sorted({i for i, _ in directions})
    tangents, moved = tangent_program(program, moving)
    jaxpr: Any = tangents.jaxpr
    avals = types_of(program)
    values = dict(zip(jaxpr.invars, inputs, strict=False)) | {
        v: as_constants(v, x, graph) for v, x in zip(jaxpr.constvars, tangents.consts, strict=True)
    }
    of_direction = set(jaxpr.invars[len(inputs) :])
    later = []
    for equation in jaxpr.eqns:  # what depends on the direction waits
        if of_direction.isdisjoint(v for v in equation.invars if not is_literal(v)):
            values.update(zip(equation.outvars, _outputs(equation, values, graph), strict=True))
        else:
            of_direction.update(equation.outvars)
            later.append(equation)
    moves = _Moves(graph)
    columns = []
    for argument, element in directions:
        along = dict(values)
        for v, i in zip(jaxpr.invars[len(inputs) :], moving, strict=True):
            along[v] = np.full(v.aval.shape, NOTHING, np.int64)
            if i == argument:
                along[v].flat[element] = graph.constant(1.0, str(v.aval.dtype))
        for equation in later:
            along.update(zip(equation.outvars, _outputs(equation, along, moves), strict=True))
        slopes = iter([_read(v, along, moves) for v in jaxpr.outvars])
        outputs = [(next(slopes) if m else np.full(aval.shape, NOTHING), aval) for m, aval in zip(moved, avals[1])]
        columns.append([moves.instantiated(x, str(aval.dtype)) for x, aval in outputs])
    return [
        np.stack([column[i] for column in columns], axis=-1) if columns else np.zeros((*aval.shape, 0), np.int64)
        for i, aval in enumerate(avals[1])
    ]


def _outputs(equation: Any, values: dict[Any, np.ndarray], graph: Any) -> list[np.ndarray]:
    return applied(equation, [_read(v, values, graph) for v in equation.invars], graph)


def _read(v: Any, values: dict[Any, np.ndarray], graph: Any) -> np.ndarray:
    return as_constants(v, v.val, graph) if is_literal(v) else values[v]


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
