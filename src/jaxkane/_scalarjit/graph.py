"""JAX programs as graphs of scalars, in which each node occurs once. Independent of machines and mechanics."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Iterable, Sequence, Set
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from jax.lax import RoundingMethod

from .compat import ClosedJaxpr, Equation, Variable, interpret, types_of

OPERATORS: dict[str, Callable[..., Any]] = {
    "add": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "div": operator.truediv,
    "neg": operator.neg,
}
"""Arithmetic by JAX's names, for all objects with Python's operators."""

# Nested programs, and the parameter that contains them. Their rules for derivatives have been used before, or are not
# needed.
_OPENED = {"jit": "jaxpr", "custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr"}

# Operations by the names of JAX's primitives.
FLOATS = ("float64", "float32")
DTYPES = (*FLOATS, "bool")
ARITHMETIC = frozenset("add sub mul div rem".split())
LOGIC = frozenset("and or xor".split())
COMPARISONS = frozenset("eq ne lt le gt ge".split())
SIMPLE = frozenset("sqrt abs floor max min".split())
# Operations that a mathematical library has, by the same names.
LIBRARY = frozenset(
    "sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh exp exp2 expm1 log log1p pow cbrt erf".split()
)
_OF_MANY = {"reduce_max": "max", "reduce_min": "min", "reduce_prod": "mul", "reduce_and": "and", "reduce_or": "or"}
_COMMUTES = frozenset("add mul max min and or xor".split())
_SAME = frozenset("copy copy_p stop_gradient optimization_barrier".split())


class NotScalarError(Exception):
    """The program contains an operation that is not an operation of scalars, or that a language lacks."""


class Node(NamedTuple):
    operation: str
    operands: tuple[Any, ...]
    dtype: str


def symbol(node: Node) -> str:
    """The name of a function in the C library."""
    return node.operation if node.dtype == "float64" else node.operation + "f"


class Graph:
    """Scalars, each stored once, with the simplifications that XLA makes: x + 0, x - 0, x * 1, x * -1, x / 1.

    Signs are exact, so -(-x) becomes x, and x + (-y) becomes x - y. The products x * 0 and 0 / x are not simplified,
    because they may be NaN. Nor is 0 - x, which differs from -x for x = 0. Zeros of systems and of derivatives have
    already been removed by `components` and by JAX, so more rules would not help.
    """

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self._numbers: dict[Node, int] = {}

    def add(self, operation: str, operands: tuple[Any, ...], dtype: str) -> int:
        if dtype not in DTYPES:
            raise NotScalarError(dtype)
        node = Node(operation, tuple(sorted(operands)) if operation in _COMMUTES else operands, dtype)
        if node not in self._numbers:
            self._numbers[node] = len(self.nodes)
            self.nodes.append(node)
        return self._numbers[node]

    def constant(self, value: float | bool, dtype: str) -> int:
        # by its digits, because -0.0 == 0.0 and nan != nan
        return self.add("constant", (float(value).hex() if dtype != "bool" else bool(value),), dtype)

    def value(self, number: int) -> float | bool | None:
        node = self.nodes[number]
        if node.operation != "constant":
            return None
        return float.fromhex(node.operands[0]) if node.dtype != "bool" else node.operands[0]

    def reading_groups(self, groups: Sequence[Sequence[int]]) -> Graph:
        """The same graph for grouped arguments: the numbers of a group are one array. Arguments without a group are not
        used."""
        place = {i: (g, e, len(group)) for g, group in enumerate(groups) for e, i in enumerate(group)}
        graph = Graph()
        for node in self.nodes:
            if node.operation == "input" and node.operands[0] in place:
                argument, element, size = node.operands
                g, e, n = place[argument]
                node = node._replace(operands=(g, e + element, n * size))
            graph.nodes.append(node)
        return graph

    def apply(self, operation: str, operands: tuple[int, ...], dtype: str) -> int:
        known = self._simplified(operation, operands, dtype) if operation in OPERATORS else None
        return self.add(operation, operands, dtype) if known is None else known

    def _simplified(self, operation: str, operands: tuple[int, ...], dtype: str) -> int | None:
        a, b = operands[0], operands[-1]
        x, y = self.value(a), self.value(b)
        match operation:
            case "add" if x == 0:
                return b
            case "add" | "sub" if y == 0:
                return a
            case "mul" if x in (1, -1) or y in (1, -1):
                other, unit = (b, x) if x in (1, -1) else (a, y)
                return other if unit == 1 else self.add("neg", (other,), dtype)
            case "div" if y == 1:
                return a
            case "neg" if y is not None:
                return self.constant(-y, dtype)
            case "neg" | "add" | "sub" if self.nodes[b].operation == "neg":
                (opposite,) = self.nodes[b].operands
                opposed = "sub" if operation == "add" else "add"
                return opposite if operation == "neg" else self.apply(opposed, (a, opposite), dtype)
            case "add" if self.nodes[a].operation == "neg":
                return self.apply("sub", (b, *self.nodes[a].operands), dtype)
        return None


def graph_of(program: ClosedJaxpr) -> tuple[Graph, list[np.ndarray]]:
    """A program as a graph, and its outputs as arrays of node numbers. Element e of argument i is an input (i, e, the
    argument's size)."""
    graph, inputs = Graph(), []
    given, results = types_of(program)
    for aval in results:
        if str(aval.dtype) not in DTYPES:  # integers are not nodes
            raise NotScalarError(f"a result of {aval.dtype}")
    for i, aval in enumerate(given):
        elements = [graph.add("input", (i, e, aval.size), str(aval.dtype)) for e in range(aval.size)]
        inputs.append(np.array(elements, np.int64).reshape(aval.shape))
    return graph, unrolled(program, inputs, graph)


def unrolled(program: ClosedJaxpr, inputs: Sequence[np.ndarray], graph: Graph) -> list[np.ndarray]:
    """The program's outputs as arrays of node numbers."""
    rule = functools.partial(applied, graph=graph)
    return interpret(program, inputs, rule, functools.partial(as_constants, graph=graph))


def as_constants(v: Variable, x: npt.ArrayLike, graph: Graph) -> np.ndarray:
    """The value x of the variable or literal v. A literal may be a Python float in a program of float32."""
    x = np.asarray(x)
    x = x.astype(v.aval.dtype) if x.dtype.kind == "f" else x
    dtype = _name_of(x.dtype)
    if dtype in DTYPES:
        return _each(lambda v: graph.constant(v, dtype), x)
    return x  # integers: exponents, indices


def applied(equation: Equation, xs: list[np.ndarray], graph: Graph) -> list[np.ndarray]:
    """The outputs of an equation whose inputs are these nodes."""
    if equation.primitive.name in _OPENED:
        inner = equation.params[_OPENED[equation.primitive.name]]
        return unrolled(inner, xs, graph)
    avals: list[Any] = [v.aval for v in equation.outvars]
    results = zip(_operation(equation, xs, graph), avals, strict=True)
    return [x if x.shape == aval.shape else np.broadcast_to(x, aval.shape) for x, aval in results]


def _each(f: Callable[..., int], *xs: np.ndarray) -> np.ndarray:
    if all(x.shape == () for x in xs):
        return np.array(f(*(x.item() for x in xs)), np.int64)
    if any(x.shape != xs[0].shape for x in xs):
        xs = np.broadcast_arrays(*xs)
    results = [f(*numbers) for numbers in zip(*(x.ravel().tolist() for x in xs), strict=True)]
    return np.array(results, np.int64).reshape(xs[0].shape)


_name_of = functools.cache(str)  # of a dtype; NumPy would build the name anew each time


Each = Callable[..., np.ndarray]
"""(operation, arrays of nodes, dtype of the result) -> nodes."""

Number = Callable[..., np.ndarray]
"""(value, dtype) -> the node of a constant."""

# Operations that consist of others.
_COMPOSED: dict[str, Callable[..., np.ndarray]] = {
    "neg": lambda each, number, x: each("neg", x),
    "ceil": lambda each, number, x: each("neg", each("floor", each("neg", x))),
    "sign": lambda each, number, x: each(
        "select",
        each("gt", x, number(0.0), dtype="bool"),
        number(1.0),
        each("select", each("lt", x, number(0.0), dtype="bool"), number(-1.0), x),
    ),
    "logistic": lambda each, number, x: each("div", number(1.0), each("add", number(1.0), each("exp", each("neg", x)))),
    "square": lambda each, number, x: each("mul", x, x),
    # in JAX 0.12, in the derivative of tanh
    "one_minus_square": lambda each, number, x: each("mul", each("sub", number(1.0), x), each("add", number(1.0), x)),
    # in JAX 0.12, in sinc: from the coefficient of lowest degree to that of highest degree
    "polynomial": lambda each, number, x, *cs: functools.reduce(
        lambda y, c: each("add", each("mul", y, x), c), reversed(cs)
    ),
    "rsqrt": lambda each, number, x: each("div", number(1.0), each("sqrt", x)),
    "clamp": lambda each, number, low, x, high: each("min", each("max", x, low), high),
}

# Operations that only move scalars: (parameters, shape of the result, inputs) -> results.
_MOVES: dict[str, Callable[..., Sequence[np.ndarray]]] = {
    **dict.fromkeys(_SAME, lambda params, shape, *xs: xs),
    **dict.fromkeys(("reshape", "squeeze"), lambda params, shape, x: [x.reshape(shape)]),
    "concatenate": lambda params, shape, *xs: [np.concatenate(xs, axis=params["dimension"])],
    "stack": lambda params, shape, *xs: [np.stack(xs, axis=params["axis"])],
    "unstack": lambda params, shape, x: [*np.moveaxis(x, params["axis"], 0)],
    "split": lambda params, shape, x: np.split(x, np.cumsum(params["sizes"])[:-1], axis=params["axis"]),
    "transpose": lambda params, shape, x: [np.transpose(x, params["permutation"])],
    "rev": lambda params, shape, x: [np.flip(x, params["dimensions"])],
    "slice": lambda params, shape, x: [
        x[tuple(map(slice, params["start_indices"], params["limit_indices"], params["strides"] or (1,) * x.ndim))]
    ],
    "broadcast_in_dim": lambda params, shape, x: [_broadcast(x, params["broadcast_dimensions"], shape)],
    "pad": lambda params, shape, x, value: [_padded(x, value, params["padding_config"], shape)],
}


def _operation(equation: Equation, xs: list[np.ndarray], graph: Graph) -> Sequence[np.ndarray]:
    name, params, aval = equation.primitive.name, equation.params, equation.outvars[0].aval
    name = "add" if name == "add_any" else name
    if name in _MOVES:
        return _MOVES[name](params, aval.shape, *xs)
    dtype = _name_of(aval.dtype)
    x_dtype = _name_of(equation.invars[0].aval.dtype) if equation.invars else dtype

    def each(operation: str, *ys: np.ndarray, dtype: str = dtype) -> np.ndarray:
        return _each(lambda *numbers: graph.apply(operation, numbers, dtype), *ys)

    def number(value: float | bool, dtype: str = dtype) -> np.ndarray:
        return np.array(graph.constant(value, dtype), np.int64)

    if name == "convert_element_type" and dtype in DTYPES and x_dtype not in DTYPES:
        return [_each(lambda v: graph.constant(v, dtype), xs[0])]  # integers are constants here
    if x_dtype not in DTYPES or dtype not in DTYPES:
        raise NotScalarError(f"{name} of {x_dtype}")
    if name in _COMPOSED:
        return [_COMPOSED[name](each, number, *xs)]
    match name:
        case "eq" | "ne" if x_dtype == "bool":  # as in jnp.mod, to check whether two signs differ
            differ = each("xor", *xs)
            return [differ if name == "ne" else each("xor", differ, number(True))]
        case "convert_element_type" if dtype in FLOATS or dtype == x_dtype:
            return [xs[0] if dtype == x_dtype else each("convert", xs[0])]
        case "round":
            return [_rounded(xs[0], params["rounding_method"] == RoundingMethod.TO_NEAREST_EVEN, each, number)]
        case "integer_pow":
            return [_power(xs[0], params["y"], each, number(1.0))]
        case "is_finite":
            return [each("lt", each("abs", xs[0], dtype=x_dtype), number(np.inf, x_dtype))]
        case "not" if dtype == "bool":
            return [each("xor", xs[0], number(True))]
        case "select_n" if len(xs) == 3 and x_dtype == "bool":
            return [each("select", xs[0], xs[2], xs[1])]
        case "reduce_sum":
            return [_reduced("add", xs[0], params["axes"], each, number(0.0))]
        case "reduce_max" | "reduce_min" | "reduce_prod" | "reduce_and" | "reduce_or" if xs[0].size:
            return [_reduced(_OF_MANY[name], xs[0], params["axes"], each)]
    is_float = dtype in FLOATS and all(_name_of(v.aval.dtype) == dtype for v in equation.invars)
    if (
        (name in LOGIC and dtype == "bool")
        or (name in COMPARISONS and x_dtype in FLOATS)
        or (name in ARITHMETIC | SIMPLE | LIBRARY and is_float)
    ):
        return [each(name, *xs)]
    raise NotScalarError(f"{name} of {x_dtype}")


def _broadcast(x: np.ndarray, dimensions: Sequence[int], shape: tuple[int, ...]) -> np.ndarray:
    sizes = dict(zip(dimensions, x.shape, strict=True))
    return np.broadcast_to(x.reshape([sizes.get(d, 1) for d in range(len(shape))]), shape)


def _padded(
    x: np.ndarray, value: np.ndarray, padding: Sequence[tuple[int, int, int]], shape: tuple[int, ...]
) -> np.ndarray:
    out = np.full(shape, value, dtype=x.dtype)
    places = [low + (1 + step) * np.arange(n) for n, (low, _, step) in zip(x.shape, padding)]
    kept = [(0 <= at) & (at < n) for at, n in zip(places, shape)]  # negative padding removes elements
    out[np.ix_(*(at[k] for at, k in zip(places, kept)))] = x[np.ix_(*kept)]
    return out


def _power(x: np.ndarray, y: int, each: Each, one: np.ndarray) -> np.ndarray:
    power, factor, n = one, x, abs(y)
    while n:
        if n & 1:
            power = each("mul", power, factor)
        factor, n = each("mul", factor, factor) if n > 1 else factor, n >> 1
    return power if y >= 0 else each("div", one, power)


def _rounded(x: np.ndarray, to_even: bool, each: Each, number: Number) -> np.ndarray:
    """The nearest integer; halves are rounded to even, or else away from zero."""
    below = each("floor", x)
    rest, halved = each("sub", x, below), each("mul", number(0.5), below)
    even = each("eq", halved, each("floor", halved), dtype="bool")
    down = even if to_even else each("lt", x, number(0.0), dtype="bool")
    down = each("and", each("eq", rest, number(0.5), dtype="bool"), down, dtype="bool")
    down = each("or", each("lt", rest, number(0.5), dtype="bool"), down, dtype="bool")
    return each("select", down, below, each("add", below, number(1.0)))


def _reduced(operation: str, x: np.ndarray, axes: Iterable[int], each: Each, *first: np.ndarray) -> np.ndarray:
    for axis in sorted(axes, reverse=True):
        x = functools.reduce(lambda a, b: each(operation, a, b), [*first, *np.moveaxis(x, axis, 0)])
    return x


def depth_first(nodes: Sequence[Node], within: Set[int], roots: Iterable[int]) -> list[int]:
    """The nodes of a set in an order in which each follows its operands closely, so that few values are alive at once.

    **Arguments:**

    - `nodes`: all nodes of the graph.
    - `within`: those to order.
    - `roots`: nodes that are computed first, with their operands.
    """
    ordered: dict[int, None] = {}
    waiting = [*sorted(within, reverse=True), *reversed([k for k in roots if k in within])]
    while waiting:
        k = waiting[-1]
        missing = [i for i in reads(nodes[k]) if i in within and i not in ordered]
        if missing and k not in ordered:
            waiting += reversed(missing)
        else:
            ordered.setdefault(waiting.pop())
    return list(ordered)


def needed(nodes: Sequence[Node], outputs: Iterable[np.ndarray]) -> list[int]:
    """The nodes from which the outputs are computed, each after the nodes that it uses."""
    is_needed = [False] * len(nodes)
    for array in outputs:
        for k in array.flat:
            is_needed[int(k)] = True
    for k in range(len(nodes) - 1, -1, -1):
        if is_needed[k]:
            for i in reads(nodes[k]):
                is_needed[i] = True
    return [k for k, needs in enumerate(is_needed) if needs]


def reads(node: Node) -> tuple[int, ...]:
    """The nodes from which a node is computed."""
    return () if node.operation in ("input", "constant") else node.operands
