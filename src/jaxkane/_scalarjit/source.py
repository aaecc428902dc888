"""Graphs of scalars in another language: as objects of a library, as lines of source, or as calls of NumPy.

A language is a table of the operations of graphs (`graph.py`): of functions, for objects; of `Form`s, for text. An
operation that a table lacks is refused by name.
"""

from __future__ import annotations

import dataclasses
import math
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from .compat import ClosedJaxpr, types_of
from .graph import LIBRARY, OPERATORS, Graph, Node, NotScalarError, graph_of, needed, reads

Table = Mapping[str, Callable[..., Any]]
Constant = Callable[[Any, str], Any]
"""(a number, its dtype) -> its representation."""


def as_objects(
    graph: Graph,
    nodes: Iterable[int],
    objects: Mapping[int, Any],
    table: Table,
    constant: Constant,
    language: str,
    named: Callable[[int, Any], Any] = lambda k, x: x,
) -> dict[int, Any]:
    """Nodes as objects of a library.

    **Arguments:**

    - `graph`, `nodes`: the graph, and nodes in an order in which each follows those that it uses.
    - `objects`: those of inputs, and of other nodes that should not be expanded.
    - `table`: functions by operation.
    - `constant`: (number, dtype) -> object.
    - `language`: its name, for messages.
    - `named`: (node, object) -> the object to use instead, e.g. a name.
    """
    made: dict[int, Any] = {}
    for k in nodes:
        node = graph.nodes[k]
        if k in objects:
            made[k] = objects[k]
        elif node.operation == "constant":
            made[k] = constant(graph.value(k), node.dtype)
        else:
            operands = [made[i] for i in node.operands]
            made[k] = named(k, operation_in(table, node, language)(*operands))
    return made


def operation_in(table: Mapping[str, Any], node: Node, language: str) -> Any:
    if node.operation not in table:
        raise NotScalarError(f"`{node.operation}` of {node.dtype}, which {language} does not have")
    return table[node.operation]


def uses(graph: Graph, nodes: Sequence[int], outputs: Iterable[np.ndarray]) -> dict[int, int]:
    """How often each node is used, by other nodes and by outputs."""
    count = dict.fromkeys(nodes, 0)
    for k in nodes:
        for i in reads(graph.nodes[k]):
            if i in count:
                count[i] += 1
    for array in outputs:
        for k in array.flat:
            count[int(k)] += 1
    return count


def count_operations(graph: Graph, outputs: Sequence[np.ndarray]) -> int:
    """The number of scalar operations; each counts once, however often its result is used."""
    return sum(graph.nodes[k].operation not in ("input", "constant") for k in needed(graph.nodes, outputs))


class Form(NamedTuple):
    """The form of an operation in a language.

    - `text`: with {0}, {1} for the operands, {s} for the suffix of the result's type and {type} for the type itself.
    - `binds`: how tightly it binds.
    - `operands`: how tightly each operand must bind to need no parentheses.
    """

    text: str
    binds: int
    operands: tuple[int, ...]


LOOSE, COMPARED, SUM, PRODUCT, SIGNED, TIGHT = range(6)
"""How tightly forms bind. Sums and products are grouped from the left, as in every language."""

ARITHMETIC = {
    "add": Form("{0} + {1}", SUM, (SUM, PRODUCT)),
    "sub": Form("{0} - {1}", SUM, (SUM, PRODUCT)),
    "mul": Form("{0} * {1}", PRODUCT, (PRODUCT, SIGNED)),
    "div": Form("{0} / {1}", PRODUCT, (PRODUCT, SIGNED)),
    "neg": Form("-{0}", SIGNED, (TIGHT,)),
}
COMPARISONS = {
    name: Form(f"{{0}} {sign} {{1}}", COMPARED, (SUM, SUM))
    for name, sign in {"eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">="}.items()
}


def call(function: str, n: int = 1) -> Form:
    """A function of n operands."""
    return Form(f"{function}({', '.join(f'{{{i}}}' for i in range(n))})", TIGHT, (LOOSE,) * n)


@dataclasses.dataclass(frozen=True)
class Language:
    """A language.

    - `forms`: by operation.
    - `constant`: (number, dtype) -> text.
    - `declared`: (name, text, dtype) -> a line that names an expression.
    - `suffix`, `types`: the texts for {s} and {type} in forms, by dtype.
    """

    name: str
    forms: Mapping[str, Form]
    constant: Constant
    declared: Callable[[str, str, str], str]
    types: Mapping[str, str]
    suffix: Mapping[str, str] = dataclasses.field(default_factory=lambda: {"float64": "", "float32": "", "bool": ""})


_WIDE = 70  # characters; longer expressions get a line of their own


def as_source(
    graph: Graph, outputs: Sequence[np.ndarray], names: Mapping[int, str], language: Language, temporary: str = "x{}"
) -> tuple[list[str], list[list[str]]]:
    """The lines before the outputs, and the outputs' elements as expressions.

    An expression that is used more than once, or is long, has its own line and name. `names` are those of inputs.
    """
    nodes = needed(graph.nodes, outputs)
    count = uses(graph, nodes, outputs)
    lines: list[str] = []
    texts: dict[int, tuple[str, int]] = {}
    for k in nodes:
        node = graph.nodes[k]
        if node.operation == "input":
            texts[k] = names[k], TIGHT
        elif node.operation == "constant":
            text = language.constant(graph.value(k), node.dtype)
            texts[k] = text, SIGNED if text.startswith("-") else TIGHT
        else:
            form = operation_in(language.forms, node, language.name)
            operands = [
                text if binds >= needs else f"({text})"
                for (text, binds), needs in zip((texts[i] for i in node.operands), form.operands, strict=True)
            ]
            text = form.text.format(*operands, s=language.suffix[node.dtype], type=language.types[node.dtype])
            texts[k] = text, form.binds
            if count[k] > 1 or len(text) > _WIDE:
                name = temporary.format(len(lines))
                lines.append(language.declared(name, text, node.dtype))
                texts[k] = name, TIGHT
    return lines, [[texts[int(k)][0] for k in array.flat] for array in outputs]


NUMPY_NAMES = {name: name for name in LIBRARY} | {
    "asin": "arcsin", "acos": "arccos", "atan": "arctan", "atan2": "arctan2", "asinh": "arcsinh", "acosh": "arccosh",
    "atanh": "arctanh", "pow": "power", "abs": "abs", "sqrt": "sqrt", "floor": "floor", "rem": "fmod",
    "max": "maximum", "min": "minimum",
}  # fmt: skip
"""NumPy's functions by JAX's names. NumPy has no erf."""

_FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{name: getattr(np, word) for name, word in NUMPY_NAMES.items() if name != "erf"},
    **OPERATORS,
    **{name: getattr(operator, name) for name in ("eq", "ne", "lt", "le", "gt", "ge")},
    **{name: getattr(np, f"logical_{name}") for name in ("and", "or", "xor")},
    "erf": lambda x: np.vectorize(math.erf, otypes=[x.dtype])(x)[()],
    "select": np.where,
}


class NumPyProgram:
    """A program of scalars, ready to be evaluated. **Raises:** `NotScalarError` for other programs."""

    def __init__(self, program: ClosedJaxpr):
        graph, self.outputs = graph_of(program)
        self.types = [a.dtype for a in types_of(program)[1]]
        self.start: list[Any] = [None] * len(graph.nodes)  # contains the constants
        self.inputs: list[tuple[int, int, int, int]] = []  # node; argument, element, number of elements of the argument
        self.steps: list[tuple[int, Callable[..., Any], tuple[int, ...]]] = []
        for k in needed(graph.nodes, self.outputs):
            operation, operands, dtype = graph.nodes[k]
            if operation == "constant":
                self.start[k] = np.dtype(dtype).type(graph.value(k))
            elif operation == "input":
                self.inputs.append((k, *operands))
            else:
                function = np.dtype(dtype).type if operation == "convert" else _FUNCTIONS[operation]
                self.steps.append((k, function, operands))
        self.reads = sorted({argument for _, argument, *_ in self.inputs})

    def __call__(self, args: Sequence[Any], lanes: tuple[int, ...] = ()) -> list[np.ndarray]:
        """The outputs. `lanes`: the last axis that some of the arguments have."""
        values = self.start.copy()
        rows = {i: np.asarray(args[i]) for i in self.reads}  # a model has hundreds of parameters, and each takes 1 us
        for k, argument, element, size in self.inputs:
            row = rows[argument]
            values[k] = row.flat[element] if row.size == size else row.reshape((size, *lanes))[element]
        with np.errstate(all="ignore"):
            for k, function, operands in self.steps:
                values[k] = function(*[values[i] for i in operands])
        outputs = []
        for nodes, dtype in zip(self.outputs, self.types, strict=True):
            array = np.empty((nodes.size, *lanes), dtype)
            for place, k in enumerate(nodes.flat):
                array[place] = values[k]
            outputs.append(array.reshape((*nodes.shape, *lanes)))
        return outputs
