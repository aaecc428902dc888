"""Transformations of JAX programs: common subexpressions once, small products as sums, derivatives as programs, and
which derivatives are zero for all arguments (`patterns`)."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jaxtyping import Array, PyTree

from .cache import Cache
from .compat import (
    ClosedJaxpr,
    Equation,
    Jaxpr,
    ShapedArray,
    Variable,
    dce_jaxpr,
    evaluated,
    interpret,
    is_literal,
    jaxpr_as_fun,
    new_variable,
    settings,
    tangents_of,
    types_of,
)
from .graph import COMPARISONS, LOGIC, Graph, NotScalarError, applied, as_constants, graph_of, needed

_LONGEST, _LARGEST = 64, 16384  # of the sum; number of products


def is_small(equation: Equation) -> bool:
    """Whether a `dot_general` is small enough to be written out."""
    (contracted, _), _ = equation.params["dimension_numbers"]
    shape = equation.invars[0].aval.shape
    length = math.prod(shape[i] for i in contracted)
    return length <= _LONGEST and length * equation.outvars[0].aval.size <= _LARGEST


def sum_of_products(equation: Equation, *xs: Array) -> Array:
    """The result of a `dot_general` of two arrays, over (batch, free axes of the first, free axes of the second)."""
    factors = []
    for x, contracted, batch in zip(xs, *equation.params["dimension_numbers"], strict=True):
        free = [i for i in range(x.ndim) if i not in (*contracted, *batch)]
        sizes = [math.prod(x.shape[i] for i in axes) for axes in (batch, free, contracted)]
        factors.append(jnp.transpose(jnp.asarray(x), (*batch, *free, *contracted)).reshape(sizes))
    x, y = factors
    aval = equation.outvars[0].aval
    return jnp.sum(x[:, :, None, :] * y[:, None, :, :], axis=-1).reshape(aval.shape).astype(aval.dtype)


# Operations that one compiled function may contain: elementwise work and moving of scalars. Calls into libraries
# (LAPACK) cannot be compiled this way, and loops would not be faster.
_PLAIN = frozenset(
    "abs acos acosh add add_any and asin asinh atan atan2 atanh broadcast_in_dim cbrt ceil clamp concatenate "
    "convert_element_type copy copy_p cos cosh div eq erf exp exp2 expm1 floor ge gt integer_pow is_finite jit le log "
    "log1p logistic lt max min mul ne neg not one_minus_square or pad polynomial pow reduce_and reduce_max reduce_min "
    "reduce_or reduce_prod reduce_sum rem reshape rev round rsqrt select_n sign sin sinh slice split sqrt square "
    "squeeze stack stop_gradient sub tan tanh transpose unstack xor".split()
)
LARGEST_SUM = 64  # XLA may pass larger ones to a library

# The primitive of `jax.custom_jvp`. It stays one equation, so that derivatives use its own rule. The derivative of the
# value is another one for rules of users, and for `jnp.logaddexp` of equal arguments it is 0 instead of 1/2.
_CUSTOM_RULE = "custom_jvp_call"

# Part of the name of each call of LAPACK by the method itself.
BY_LAPACK = "by_lapack"
# The name of the JAX primitive for a program, with the parameters `program`, `sizes` and `batch_mask`.
PROGRAM = "scalar_program"


def cse(program: ClosedJaxpr, keeps_solutions: bool = False) -> ClosedJaxpr:
    """Remove repeated and unused operations of a program, and write out products of small matrices as sums, because XLA
    would pass these to a library.

    A system is evaluated once for each speed, and many results are the same. XLA would also find these, but only after
    JAX has differentiated every copy. `keeps_solutions`: keep a nested program that solves equations as one equation,
    so that derivatives use these equations.
    """
    unique = _UniqueEquations(keeps_solutions)
    return unique.program(program.jaxpr, program.jaxpr.invars, unique.walk(program, program.jaxpr.invars))


class _UniqueEquations:
    """Equations of programs in one list, each unique. Equations are copied and not traced again, because tracing would
    take as long as all other transformations together."""

    def __init__(self, keeps_solutions: bool = False) -> None:
        self.keeps_solutions = keeps_solutions
        self.equations: list[Any] = []
        self.consts: dict[Any, Any] = {}  # by their variables
        self._known: dict[Any, Sequence[Any]] = {}  # the outputs of an equation, by its key

    def program(self, like: Jaxpr, inputs: Sequence[Any], outputs: Sequence[Any]) -> ClosedJaxpr:
        """The collected equations as a program with these inputs, without unused equations."""
        jaxpr = like.replace(constvars=[*self.consts], invars=[*inputs], eqns=self.equations, outvars=[*outputs])
        jaxpr, _ = dce_jaxpr(jaxpr, [True] * len(outputs), instantiate=True)
        return ClosedJaxpr(jaxpr, [*self.consts.values()])

    def walk(self, program: ClosedJaxpr, inputs: Sequence[Any]) -> list[Any]:
        """The variables of a program's outputs, if its inputs are these variables or literals."""
        return interpret(program, inputs, self.results, self.constant)

    def results(self, equation: Equation, xs: list[Any]) -> Sequence[Any]:
        inner = None if self.keeps_solutions and is_solution(equation) else opened(equation)
        if inner is not None:
            return self.walk(inner, xs)
        # Numbers are compared by their bits (-0.0 == 0.0, and the text of an array is rounded), all else by identity.
        of_xs = [(np.asarray(x.val).tobytes(), str(x.aval)) if is_literal(x) else id(x) for x in xs]
        key = (equation.primitive, *of_xs, _parameters_of(equation))
        if key not in self._known:
            if equation.primitive.name == "dot_general" and is_small(equation):
                product = functools.partial(sum_of_products, equation)
                specs = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in xs]
                self._known[key] = self.walk(jax.make_jaxpr(product)(*specs), xs)
            else:
                outputs = [*map(new_variable, equation.outvars)]  # a program may be opened twice
                self.equations.append(equation.replace(invars=xs, outvars=outputs))
                self._known[key] = outputs
        return self._known[key]

    def constant(self, variable: Variable, value: npt.ArrayLike) -> Any:
        if is_literal(variable):
            return variable
        key = ("const", id(value))
        if key not in self._known:
            self._known[key] = [new_variable(variable)]
            self.consts[self._known[key][0]] = value  # keeps the value alive, so that its id stays unique
        return self._known[key][0]


def _parameters_of(equation: Equation) -> Any:
    """The parameters that two equal equations have in common; the equation's id if they cannot be compared."""
    key = tuple(sorted(equation.params.items()))
    try:
        hash(key)
    except TypeError:
        return id(equation)
    return key


def opened(equation: Equation) -> ClosedJaxpr | None:
    """The nested program of an equation that can be inlined, so that the whole is one program; else None."""
    if equation.primitive.name == PROGRAM:
        program, sizes, batch_mask = (equation.params[k] for k in ("program", "sizes", "batch_mask"))
        return (program.batched(sizes, batch_mask) if sizes else program).program
    return equation.params["jaxpr"] if equation.primitive.name == "jit" else None


def is_solution(equation: Equation) -> bool:
    """Whether an equation is a program whose last result solves linear equations."""
    name, parameters = equation.primitive.name, equation.params
    return name == PROGRAM and parameters["program"].is_solution and not parameters["sizes"]


def reads_of(program: Jaxpr) -> tuple[bool, ...]:
    """Which of its inputs a program uses; the first one, if it uses none."""
    variables = {v for e in program.eqns for v in e.invars if not is_literal(v)}
    variables.update(v for v in program.outvars if not is_literal(v))
    is_read = tuple(v in variables for v in program.invars)
    return is_read if any(is_read) else (True, *is_read[1:])


def is_fusable(program: Jaxpr) -> bool:
    """Whether a program can be one compiled function."""
    return not any(unsupported_primitives(program))


def unsupported_primitives(program: Jaxpr, is_ours: bool = False) -> Iterator[tuple[str, bool]]:
    """The operations that cannot be part of one compiled function, and whether they belong to the system. The method
    itself calls LAPACK for systems that are too large to be written out (`linear`)."""
    for equation in program.eqns:
        name, inner = equation.primitive.name, opened(equation)
        if name == _CUSTOM_RULE:
            inner = equation.params["call_jaxpr"]
        if inner is not None:
            yield from unsupported_primitives(inner.jaxpr, is_ours or BY_LAPACK in equation.params.get("name", ""))
        elif name == "dot_general" and is_small(equation):
            continue  # see `cse`
        elif name not in _PLAIN:
            called = getattr(equation.params.get("call_jaxpr"), "jaxpr", None)  # hypot, not custom_jvp_call
            yield getattr(getattr(called, "debug_info", None), "func_name", name).strip("_"), not is_ours
        elif name.startswith("reduce_") and _summands(equation) > LARGEST_SUM:
            yield f"{name} of more than {LARGEST_SUM}", not is_ours


def _summands(equation: Equation) -> int:
    """Of each result of a sum."""
    return equation.invars[0].aval.size // max(equation.outvars[0].aval.size, 1)


def replaced(values: Sequence[Any], places: Sequence[int], new: Sequence[Any]) -> list[Any]:
    """The values, with new ones at some indices."""
    values = list(values)
    for i, x in zip(places, new, strict=True):
        values[i] = x
    return values


def specs_of(avals: Sequence[Any]) -> list[jax.ShapeDtypeStruct]:
    return [jax.ShapeDtypeStruct(a.shape, a.dtype, weak_type=a.weak_type) for a in avals]


def is_inexact(aval: Array | ShapedArray) -> bool:
    """Whether numbers of this kind can be differentiated."""
    return jnp.issubdtype(aval.dtype, jnp.inexact)


def program_of(f: Callable[..., Any], *specs: Any, return_shape: bool = False) -> Any:
    """`jax.make_jaxpr(f)(*specs)` without a device mesh. In `jax.shard_map`, JAX would place constants on devices,
    which is not an operation of scalars."""
    with jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), ())):
        return jax.make_jaxpr(f, return_shape=return_shape)(*specs)


class Solved(NamedTuple):
    """The equations M x = b that the last result x of a program solves.

    - `equations`: (inputs, x) -> the other results and b - M x.
    - `solve`: (inputs, r) -> the y of M y = r.
    """

    equations: ClosedJaxpr
    solve: ClosedJaxpr

    @classmethod
    def of(cls, both: ClosedJaxpr) -> Solved:
        """From a program (inputs, x, r) -> the other results, b - M x and y."""
        jaxpr, n = both.jaxpr, len(both.out_avals)
        *inputs, x, r = jaxpr.invars

        def only(outputs: Sequence[int], invars: Sequence[Any]) -> ClosedJaxpr:
            kept, _ = dce_jaxpr(jaxpr, [i in outputs for i in range(n)], instantiate=True)
            return ClosedJaxpr(kept.replace(invars=[*invars]), both.consts)

        return cls(only(range(n - 1), [*inputs, x]), only([n - 1], [*inputs, r]))


_rules = Cache(4096)


def _tangent_rule(equation: Equation, differentiated: tuple[bool, ...]) -> tuple[ClosedJaxpr, tuple[bool, ...]]:
    """JAX's rule for an equation with these differentiated inputs, traced once for all equal equations.

    **Returns:** a program (inputs, tangents of the differentiated ones) -> the nonzero tangents of the results, and
    which results have one.
    """
    types = tuple((v.aval.shape, v.aval.dtype, v.aval.weak_type) for v in equation.invars)
    parameters = _parameters_of(equation)
    key = (equation.primitive, parameters, differentiated, types, settings())

    def make() -> tuple[ClosedJaxpr, tuple[bool, ...]]:
        given: list[bool] = []

        def tangents(*values: Any) -> list[Any]:
            xs, dxs = values[: len(differentiated)], iter(values[len(differentiated) :])
            results = tangents_of(equation, xs, [next(dxs) if d else None for d in differentiated])
            given[:] = [dy is not None for dy in results]
            return [dy for dy in results if dy is not None]

        avals = [v.aval for v in equation.invars]
        of_tangents = [aval for aval, d in zip(avals, differentiated, strict=True) if d]
        return program_of(tangents, *specs_of([*avals, *of_tangents])), tuple(given)

    # A custom rule is not kept, because it may refer to large arrays of the user.
    is_kept = equation.primitive.name != _CUSTOM_RULE and not isinstance(parameters, int)
    return _rules.get(key, make) if is_kept else make()


def tangent_program(
    program: ClosedJaxpr, differentiated: Sequence[int], values: bool = False
) -> tuple[ClosedJaxpr, tuple[bool, ...]]:
    """The derivative of a program in forward mode.

    **Arguments:**

    - `program`: the program.
    - `differentiated`: indices of the inputs to differentiate.
    - `values`: whether the outputs precede their tangents.

    **Returns:** a program (inputs, tangents of the inputs `differentiated`) -> the nonzero tangents of the outputs, and
    which outputs have one.

    Each equation is replaced by JAX's rule, which is traced once for all equal equations. Tracing the whole derivative
    takes four times as long. If a program solves M x = b, these equations are differentiated at x, and not the solution
    of the solve:

        M dx = d(b - M x) at fixed x
    """
    jaxpr: Any = program.jaxpr
    unique, tangents = _UniqueEquations(), {jaxpr.invars[i]: new_variable(jaxpr.invars[i]) for i in differentiated}

    def constant(v: Variable, x: npt.ArrayLike) -> tuple[Any, None]:
        return unique.constant(v, x), None

    def rule(equation: Equation, pairs: list[Any]) -> Sequence[Any]:
        xs, dxs = [x for x, _ in pairs], [dx for _, dx in pairs if dx is not None]
        ys = unique.results(equation, xs)
        if not dxs:
            return [(y, None) for y in ys]
        solved = equation.params["program"].solved if is_solution(equation) else None
        if solved is not None:
            slopes = [dy for _, dy in interpret(solved.equations, [*pairs, (ys[-1], None)], rule, constant)]
            if slopes[-1] is not None:
                slopes[-1] = unique.walk(solved.solve, [*xs, slopes[-1]])[0]
            return [*zip(ys, slopes, strict=True)]
        inner = opened(equation)
        if inner is not None:
            return interpret(inner, pairs, rule, constant)
        program, given = _tangent_rule(equation, tuple(dx is not None for _, dx in pairs))
        dys = iter(unique.walk(program, [*xs, *dxs]))
        return [(y, next(dys) if is_given else None) for y, is_given in zip(ys, given, strict=True)]

    inputs = [(v, tangents.get(v)) for v in jaxpr.invars]
    pairs = interpret(program, inputs, rule, constant)
    results = [*(y for y, _ in pairs if values), *(dy for _, dy in pairs if dy is not None)]
    return unique.program(jaxpr, [*jaxpr.invars, *tangents.values()], results), tuple(dy is not None for _, dy in pairs)


def transposed_program(program: ClosedJaxpr, linear: Sequence[int]) -> ClosedJaxpr:
    """(the other inputs, cotangents of the outputs) -> cotangents of the inputs with the indices `linear`."""
    specs, f = specs_of(program.in_avals), jaxpr_as_fun(program)
    others = [i for i in range(len(specs)) if i not in linear]

    def transpose(*values: Any) -> PyTree:
        fixed = replaced([None] * len(specs), others, values[: len(others)])

        def of_linear(*xs: Any) -> PyTree:
            return f(*replaced(fixed, linear, xs))

        return jax.linear_transpose(of_linear, *[specs[i] for i in linear])([*values[len(others) :]])

    return cse(program_of(transpose, *[specs[i] for i in others], *specs_of(program.out_avals)))


Direction = tuple[int, int]  # an argument, and the index of an element in it


def jacobian(
    program: ClosedJaxpr, inputs: Sequence[np.ndarray], directions: Sequence[Direction], graph: Graph
) -> list[np.ndarray]:
    """The derivatives (..., d) of each output with respect to d elements of the inputs, as nodes of the graph."""
    differentiated = sorted({i for i, _ in directions})
    tangents, has_tangent = tangent_program(program, differentiated)
    jaxpr: Any = tangents.jaxpr
    avals = types_of(program)
    values = dict(zip(jaxpr.invars, inputs, strict=False)) | {
        v: as_constants(v, x, graph) for v, x in zip(jaxpr.constvars, tangents.consts, strict=True)
    }
    of_direction = set(jaxpr.invars[len(inputs) :])
    later = []
    for equation in jaxpr.eqns:  # equations that depend on the direction are evaluated later, for each direction
        if of_direction.isdisjoint(v for v in equation.invars if not is_literal(v)):
            values.update(zip(equation.outvars, _outputs(equation, values, graph), strict=True))
        else:
            of_direction.update(equation.outvars)
            later.append(equation)
    sparse = _SparseGraph(graph)
    columns = []
    for argument, element in directions:
        along = dict(values)
        for v, i in zip(jaxpr.invars[len(inputs) :], differentiated, strict=True):
            along[v] = np.full(v.aval.shape, NOTHING, np.int64)
            if i == argument:
                along[v].flat[element] = graph.constant(1.0, str(v.aval.dtype))
        for equation in later:
            along.update(zip(equation.outvars, _outputs(equation, along, sparse), strict=True))
        slopes = iter([_read(v, along, sparse) for v in jaxpr.outvars])
        pairs = zip(has_tangent, avals[1], strict=True)
        outputs = [(next(slopes) if has else np.full(aval.shape, NOTHING), aval) for has, aval in pairs]
        zeros = [graph.constant(0.0, str(aval.dtype)) for _, aval in outputs]
        columns.append([np.where(x == NOTHING, zero, x) for zero, (x, _) in zip(zeros, outputs, strict=True)])
    return [
        np.stack([column[i] for column in columns], axis=-1) if columns else np.zeros((*aval.shape, 0), np.int64)
        for i, aval in enumerate(avals[1])
    ]


def _outputs(equation: Equation, values: dict[Any, np.ndarray], graph: Graph) -> list[np.ndarray]:
    return applied(equation, [_read(v, values, graph) for v in equation.invars], graph)


def _read(v: Variable, values: dict[Any, np.ndarray], graph: Graph) -> np.ndarray:
    return as_constants(v, v.val, graph) if is_literal(v) else values[v]


NOTHING = -1  # instead of a node number: the derivative is zero


class _SparseGraph(Graph):
    """A graph for operations on derivatives, of which some are `NOTHING`. It adds its nodes to another graph."""

    def __init__(self, graph: Graph):
        self.nodes, self._numbers = graph.nodes, graph._numbers

    def apply(self, operation: str, operands: tuple[int, ...], dtype: str) -> int:
        if NOTHING in operands:
            match operation, operands:
                case ("add", (a, b)):
                    return b if a == NOTHING else a
                case ("sub", (a, b)):
                    return a if b == NOTHING else super().apply("neg", (b,), dtype)
                case (("mul" | "neg" | "convert"), _) | ("div", (-1, _)) | ("select", (_, -1, -1)):
                    return NOTHING
            operands = tuple(self.constant(0.0, dtype) if i == NOTHING else i for i in operands)
        return super().apply(operation, operands, dtype)


_PIECEWISE_LINEAR = frozenset("add sub neg select max min abs convert rem".split())
_PIECEWISE_CONSTANT = COMPARISONS | LOGIC | {"floor", "constant"}


def patterns(f: Callable[..., Any], specs: Sequence[Any], place: int) -> tuple[np.ndarray, np.ndarray]:
    """The entries of the Jacobian and of the Hessian that may differ from zero.

    They are read from the graph of scalars, not from values: a branch that is not taken at some point may be taken at
    another. A function that is not a graph of scalars has full patterns.

    **Arguments:**

    - `f`: a function of arrays that returns an array (m,).
    - `specs`: shapes and dtypes of its arguments.
    - `place`: the index of the argument (n,) by which it is differentiated.

    **Returns:** booleans (m, n), and (n, n) for the Hessian of any weighted sum of the results.
    """
    program = cse(program_of(f, *specs))
    if any(equation.primitive.name == _CUSTOM_RULE for equation in program.jaxpr.eqns):
        program = cse(program_of(_with_full_patterns(program), *specs))
    n = specs[place].shape[0]
    try:
        graph, (outputs,) = graph_of(program)
    except NotScalarError:
        results: Any = program.out_avals
        return np.ones((results[0].size, n), bool), np.ones((n, n), bool)
    reads, second = _propagated(graph, outputs, place)
    first = np.array([[bool(reads[int(k)] >> i & 1) for i in range(n)] for k in outputs], bool).reshape(-1, n)
    both = np.array([[bool(second.get(i, 0) >> j & 1) for j in range(n)] for i in range(n)], bool).reshape(n, n)
    return first, both | both.T


def _with_full_patterns(program: ClosedJaxpr) -> Callable[..., Any]:
    """The program, whose functions with custom rules depend on all of their arguments. Such a rule may have derivatives
    that the value does not have, for example those of a rounded number."""

    def rule(equation: Equation, xs: list[Any]) -> Sequence[Any]:
        ys = evaluated(equation, xs)
        if equation.primitive.name != _CUSTOM_RULE:
            return ys
        every = jnp.exp(sum(jnp.sum(x) for x in xs if is_inexact(x)))
        return [y * every.astype(y.dtype) if is_inexact(y) else y for y in ys]

    return lambda *inputs: interpret(program, inputs, rule)


def _propagated(graph: Graph, outputs: np.ndarray, place: int) -> tuple[dict[int, int], dict[int, int]]:
    """The numbers on which each node depends, and the pairs that occur together in a nonlinear operation.

    Sets of numbers are the bits of an integer: a graph has thousands of nodes, and Python's integers are the fastest
    sets for that.
    """
    reads: dict[int, int] = {}
    pairs: dict[int, int] = {}

    def together(a: int, b: int) -> None:
        for one, other in ((a, b), (b, a)):
            while one:
                lowest = one & -one
                one ^= lowest
                i = lowest.bit_length() - 1
                pairs[i] = pairs.get(i, 0) | other

    for k in needed(graph.nodes, [outputs]):
        operation, operands, _ = graph.nodes[k]
        if operation == "input":
            reads[k] = 1 << operands[1] if operands[0] == place else 0
            continue
        if operation in _PIECEWISE_CONSTANT:
            reads[k] = 0
            continue
        sets = [reads[i] for i in operands]
        reads[k] = 0
        for each in sets:
            reads[k] |= each
        if operation == "mul":
            together(*sets)
        elif operation == "div":
            together(sets[0], sets[1])
            together(sets[1], sets[1])
        elif operation not in _PIECEWISE_LINEAR:
            together(reads[k], reads[k])
    return reads, pairs
