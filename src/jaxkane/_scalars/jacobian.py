"""Derivatives of programs as graphs of scalars, one direction after the other. Knows jaxprs; knows no mechanics.

The derivative is JAX's own: `jax.jvp` is traced once, for all directions. What a direction does not move has no
derivative at all, rather than one that is zero, so that a direction costs what it moves; and what does not depend on
the direction is computed once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from .graph import Graph, applied, as_constants
from .jax_internals import ClosedJaxpr, Literal, jaxpr_as_fun, types_of
from .repetition import without_repetition

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
    return without_repetition(jax.make_jaxpr(tangents)(specs, avals)), avals


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
