"""A program of scalars evaluated by NumPy, node by node.

A few evaluations take less time than XLA needs to begin its compilation: a node costs a tenth of a microsecond. The
results agree with those of compiled programs within rounding.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..compat import ClosedJaxpr, types_of
from ..graph import LIBRARY, OPERATORS, graph_of, needed

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
