"""Functions of scalars that solve linear equations, M x = b. Independent of mechanics.

`LinearSolution`: the solve is written out. `ScalarSolve`: a symmetric positive definite system whose matrix is never
formed, solved by Gaussian elimination along a graph of scalars.

The matrix belongs to a quadratic form, M = sum_i L_i^T D_i L_i, as the mass matrix belongs to the kinetic energy. A
graph computes z_i = L_i x from x, each node from few others. The elimination moves the form through the graph from the
z_i to x: a node is replaced by the nodes from which it is computed, and an unknown that no other node uses is
eliminated. Along a tree of bodies the form contains few nodes at a time. The work therefore grows linearly with the
number of bodies, as in the articulated-body method (Featherstone, Rigid Body Dynamics Algorithms, Section 7.3).
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

from .cache_key import CacheKey, version_of
from .compat import ClosedJaxpr, ShapedArray, settings, types_of
from .components import Numbers, rounding_of_pivots
from .graph import Graph, NotScalarError, graph_of
from .jaxpr import Solved, cse, is_fusable, specs_of
from .native import Scalars
from .program import ArgumentRoles, Derived, Program
from .scalar_function import ScalarFunction, jaxpr_at

_MOST_NODES = 1000  # for each unknown: a chain of bodies takes 300. If all bodies are connected, LAPACK is faster


Affine = tuple[int | None, list[tuple[int, int]]]
"""An optional constant, and pairs of a coefficient and its node."""


class LinearSolution(ScalarFunction):
    """A pure function at module level whose last result x solves linear equations, M x = b.

    `equations(*args, x, r)` returns the other results, b - M x, and the y of M y = r, at any x and r. Derivatives use
    these equations. Differentiating the solution of the solve would take 1.7 times as many operations for each
    direction.
    """

    def __init__(self, f: Callable[..., Any], equations: Callable[..., Any]):
        super().__init__(f)
        self.equations = equations

    def _solved(self, key: CacheKey, x: ShapedArray) -> Solved | None:
        args = jax.tree.unflatten(key.structure, specs_of(key.types))
        if (version_of(*args), settings()) != (key.version, key.settings):
            return None  # values that the code reads have changed: these are not the equations that were solved
        program, _ = jaxpr_at(key, self.equations, x, x)
        return Solved.of(cse(program)) if is_fusable(program.jaxpr) else None


class ScalarSolve(ScalarFunction):
    """The solution x of M x = b, for a pure function at module level that returns z (m, k) and D (m, k, k) of (*args,
    x).

        x^T M x = sum_i z_i^T D_i z_i,  z_i = L_i x

    `solve(*args, b)` is one native kernel. If native kernels are not possible, it is `by_lapack(*args, b)`.
    `jax.lax.custom_linear_solve` defines its derivatives.
    """

    def __init__(self, form: Callable[..., Any], by_lapack: Callable[..., Any]):
        super().__init__(form)
        self.by_lapack = by_lapack

    def __call__(self, *args: Any) -> Numbers:
        if not self.is_native(*args):
            return self.by_lapack(*args)
        numbers, program = self.program(*args)
        assert program is not None
        return program(*numbers)[0]

    def _traced(self, key: CacheKey, label: str) -> Program | None:
        form = super()._traced(key, label)
        return form and _Solve(form, lambda *leaves: [self.by_lapack(*jax.tree.unflatten(key.structure, leaves))])


class _Solve(Program):
    """The program of the solution, made from the program of a form. Its last argument is the right-hand side."""

    def __init__(self, form: Program, by_lapack: Callable[..., list[Any]]):
        self.label, self.program, self.compile_cheaply, self.derived = form.label, form.program, False, Derived()
        self.roles = ArgumentRoles(form.roles.loop_invariant)
        self.in_avals, self.out_avals = form.in_avals, form.in_avals[-1:]
        self.evaluate, self.is_fusable, self.reads = by_lapack, False, (*form.reads[:-1], True)
        self.dependencies = [frozenset(range(len(self.in_avals)))]
        self.batched, self.jitted = functools.cache(self._batched), functools.cache(self._jitted)

    @functools.cached_property
    def scalars(self) -> Scalars | None:
        try:
            return Scalars(self.program, as_graph=graph_of_solution)
        except NotScalarError:
            return None


def graph_of_solution(form: ClosedJaxpr) -> tuple[Graph, list[np.ndarray]]:
    """A graph, and the nodes of the solution x in it. The right-hand side b replaces the form's argument x."""
    graph, (z, D) = graph_of(form)
    *others, x = types_of(form)[0]
    unknowns = [graph.add("input", (len(others), i, x.size), str(x.dtype)) for i in range(x.size)]
    return graph, [np.array(_Elimination(graph, unknowns, z, D).solution())]


class _Elimination:
    """The minimum of x^T M x / 2 - b^T x by elimination.

    - `Q`, `b`: the quadratic and the linear form, for the nodes that they contain now.
    - `size`: the diagonal of Q without any elimination, except for products of different nodes; the scale for
        `rounding_of_pivots`.
    - `terms`: for each node that is linear in the unknowns, pairs of a coefficient and a node, whose sum it is.
    - `readers`: for each node, how many remaining nodes use it.
    """

    def __init__(self, graph: Graph, unknowns: list[int], z: np.ndarray, D: np.ndarray):
        self.graph, self.unknowns, self.dtype = graph, unknowns, graph.nodes[unknowns[0]].dtype
        self.most = len(graph.nodes) + _MOST_NODES * len(unknowns)
        self.one, self.minus_one, self.nan = (graph.constant(x, self.dtype) for x in (1.0, -1.0, float("nan")))
        self.terms: dict[int, list[tuple[int, int]]] = {k: [] for k in unknowns}
        for k in range(len(graph.nodes)):
            node = graph.nodes[k]
            if node.operation not in ("input", "constant") and any(i in self.terms for i in node.operands):
                self.terms[k] = self._terms(*node[:2])
        self.Q: dict[int, dict[int, int]] = {}
        self.b = {k: k for k in unknowns}
        for z_i, D_i in zip(z.tolist(), D.tolist(), strict=True):
            for (r, i), (s, j) in itertools.combinations_with_replacement(enumerate(z_i), 2):
                if i in self.terms and j in self.terms and graph.value(D_i[r][s]) != 0:
                    self._add(i, j, D_i[r][s], twice=r != s)
        self.size = {k: row[k] for k, row in self.Q.items() if k in row}
        self.readers: dict[int, int] = dict.fromkeys(self.terms, 0)
        for k in self._needed():
            for _, i in self.terms[k]:
                self.readers[i] += 1

    def _terms(self, operation: str, operands: tuple[int, ...]) -> list[tuple[int, int]]:
        match operation, [i in self.terms for i in operands]:
            case "add", [True, True]:
                return [(self.one, operands[0]), (self.one, operands[1])]
            case "sub", [True, True]:
                return [(self.one, operands[0]), (self.minus_one, operands[1])]
            case "neg", _:
                return [(self.minus_one, operands[0])]
            case "mul", [False, True]:
                return [(operands[0], operands[1])]
            case "mul", [True, False]:
                return [(operands[1], operands[0])]
            case "div", [True, False]:
                return [(self._do("div", self.one, operands[1]), operands[0])]
        raise NotScalarError(f"{operation} of the unknowns of a linear system")

    def _needed(self) -> Iterator[int]:
        """The nodes that the form uses, directly or indirectly."""
        open_, reached = [*self.Q], set(self.Q)
        while open_:
            k = open_.pop()
            yield k
            new = {i for _, i in self.terms[k]} - reached
            open_.extend(new)
            reached |= new

    def _do(self, operation: str, *operands: int) -> int:
        if len(self.graph.nodes) > self.most:
            raise NotScalarError("too many operations")
        return self.graph.apply(operation, operands, self.dtype)

    def _sum(self, a: int | None, b: int) -> int:
        return b if a is None else self._do("add", a, b)

    def _add(self, i: int, j: int, value: int, twice: bool = False) -> None:
        """Q_ij = Q_ji += value. `twice`: count the product of two nodes twice if they are equal."""
        value = self._do("add", value, value) if twice and i == j else value
        row = self.Q.setdefault(i, {})
        row[j] = self.Q.setdefault(j, {})[i] = self._sum(row.get(j), value)

    def _add_along(self, i: int, c: int, b: int | None) -> None:
        """b_i += c b, unless b is None."""
        if b is not None:
            self.b[i] = self._sum(self.b.get(i), self._do("mul", c, b))

    def solution(self) -> list[int]:
        """The nodes of x."""
        values: dict[int, int] = {}
        steps = [(k, *(self._replaced(k) if self.terms[k] else self._eliminated(k))) for k in self._order()]
        for k, constant, terms in reversed(steps):
            products = [self._do("mul", c, values[i]) for c, i in terms]
            values[k] = functools.reduce(self._sum, products if constant is None else [constant, *products])
        if not values.keys() >= {*self.unknowns}:  # an unknown that is not used has no equation
            return [self.nan for _ in self.unknowns]
        return [values[k] for k in self.unknowns]

    def _order(self) -> Iterator[int]:
        """Nodes of the form that no remaining node uses, the one with the least work first. The form changes during the
        iteration."""
        while self.Q:
            ready = [k for k in self.Q if not self.readers[k]]
            k = min(ready, key=lambda k: (len(self.Q[k]) * max(1, len(self.terms[k])), -k))
            for _, i in self.terms[k]:
                self.readers[i] -= 1
            yield k

    def _removed(self, k: int) -> tuple[dict[int, int], int, int | None, int]:
        """Remove a node from the form. **Returns:** its row of Q without the diagonal, the diagonal, its b and its
        size."""
        row = self.Q.pop(k)
        if k not in row:
            raise NotScalarError("a form that is not positive definite")
        diagonal = row.pop(k)
        for j in row:
            del self.Q[j][k]
        return row, diagonal, self.b.pop(k, None), self.size.pop(k)

    def _replaced(self, k: int) -> Affine:
        """Substitute z_k = sum_i c_i z_i into the form."""
        terms = self.terms[k]
        row, diagonal, b, size = self._removed(k)
        for place, (c, i) in enumerate(terms):
            for j, q in row.items():
                self._add(i, j, self._do("mul", c, q), twice=True)
            product = self._do("mul", c, diagonal)
            self._add(i, i, self._do("mul", c, product))
            for d, j in terms[place + 1 :]:
                self._add(i, j, self._do("mul", d, product), twice=True)
            self.size[i] = self._sum(self.size.get(i), self._do("mul", self._do("mul", c, c), size))
            self._add_along(i, c, b)
        return None, terms

    def _eliminated(self, k: int) -> Affine:
        """Substitute z_k = (b_k - sum_j Q_kj z_j) / Q_kk into the form, where its derivative by z_k is zero."""
        row, pivot, b, size = self._removed(k)
        assert b is not None  # k is an unknown
        if pivot != size:
            threshold = self._do("mul", self.graph.constant(rounding_of_pivots(self.dtype), self.dtype), size)
            is_regular = self.graph.apply("gt", (pivot, threshold), "bool")
            pivot = self._do("select", is_regular, pivot, self.nan)
        reciprocal = self._do("div", self.one, pivot)
        terms = [(self._do("neg", self._do("mul", q, reciprocal)), j) for j, q in row.items()]
        for place, (c, i) in enumerate(terms):
            for _, j in terms[place:]:
                self._add(i, j, self._do("mul", c, row[j]))
            self._add_along(i, c, b)
        return self._do("mul", b, reciprocal), terms
