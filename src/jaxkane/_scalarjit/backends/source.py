"""Graphs of scalars in another language: as objects of a library, or as lines of source. Independent of the language.

A language is a table of the operations of graphs (`graph.py`): of functions, for objects; of `Form`s, for text. An
operation that a table lacks is refused by name.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..graph import Graph, Node, NotScalarError, needed, reads

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
