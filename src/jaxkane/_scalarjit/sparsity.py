"""Which first and second derivatives of a function are zero for all arguments."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .graph import COMPARISONS, LOGIC, Graph, NotScalarError, graph_of, needed
from .jaxpr import cse, program_of

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
