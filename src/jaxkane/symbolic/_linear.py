"""Linear models as matrices of formulas of the parameters, at a steady motion."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .._common.lookup import as_names, refuse_unknown
from .._kane.formulas import Formulas
from .._scalarjit.backends.source import as_objects
from .._scalarjit.graph import NotScalarError, needed
from .._system.system import System
from ..stability._steady import check_dependent, cyclic_coordinates
from ._equations import WHOLE_UP_TO, by_name
from ._sympy import (
    aligned,
    escaped,
    exact,
    fresh_names,
    given_nodes,
    imported,
    in_latex,
    name_in_latex,
    symbols_of,
    table,
)

_TOLERANCE = 1e-9  # of residuals and rates that are to be zero, beside numbers of order one


def sizes_of(*matrices: Any) -> dict[Any, int]:
    """The number of operations of every expression in matrices, each looked at once however often it stands there."""
    sizes: dict[Any, int] = {}

    def size(x: Any) -> int:
        if x not in sizes:
            sizes[x] = max(len(x.args) - 1, 0) + sum(map(size, x.args))
        return sizes[x]

    for m in matrices:
        for x in m:
            size(x)
    return sizes


class AtMotion:
    """Functions of a system at a motion whose numbers and expressions are put in."""

    def __init__(self, formulas: Formulas, at: dict[str, Any]):
        sp = imported()
        self.formulas = formulas
        kinds = symbols_of(formulas, of_time=False)
        self.symbols = by_name(kinds)
        moving = {"t": kinds["t"], **{kind: kinds[kind] for kind in ("q", "u", "inputs")}}
        names = [*(name for of in moving.values() for name in of), *kinds["parameters"]]
        refuse_unknown(at, names, f"{formulas.name} has no", "it has")
        values = {name: self._value(name, x) for name, x in at.items()}
        symbols = {symbol: name for of in moving.values() for name, symbol in of.items()}
        for name, x in values.items():
            read = sorted(symbols[s] for s in x.free_symbols if s in symbols)
            if read:
                raise ValueError(
                    f"{formulas.name}: `at` says {name} = {x}, but {', '.join(read)} has a value of its own there. "
                    "Expressions are of parameters and of symbols that the system does not have."
                )
        put = {kind: {name: values.get(name, sp.Integer(0)) for name in of} for kind, of in moving.items()}
        variables = [name for of in put.values() for name in of]
        put["u_dep"] = kinds["u_dep"]
        put["parameters"] = {
            name: values[name] if name in values and name not in variables else symbol
            for name, symbol in kinds["parameters"].items()
        }
        self.inputs = given_nodes(formulas, put)
        self.parameters = kinds["parameters"]

    def _value(self, name: str, x: Any) -> Any:
        """A number, an expression, or a string in which the declared names are the declared symbols."""
        sp = imported()
        try:
            value = exact(x, "float64") if isinstance(x, float) else sp.sympify(x, locals=dict(self.symbols))
        except (
            sp.SympifyError,
            TypeError,
            AttributeError,
        ) as error:  # SymPy raises the others for "f(", "1.x" and such
            raise ValueError(self._no_value(name, x)) from error
        if not isinstance(value, sp.Expr):
            raise ValueError(self._no_value(name, x))
        own = {s: sp.Symbol(s.name, real=True) for s in value.free_symbols if s not in self.symbols.values()}
        value = value.xreplace({s: new for s, new in own.items() if not s.is_real})
        if value.has(sp.I, sp.nan, sp.oo, -sp.oo, sp.zoo) or value.is_real is False:
            raise ValueError(self._no_value(name, x))
        return value

    def _no_value(self, name: str, x: Any) -> str:
        return (
            f"{self.formulas.name}: `at` says {name} = {x!r}, which is neither a finite number nor an expression of "
            'SymPy; one is {"%s": "-v/radius"}.' % name
        )

    def expressions(self, nodes: np.ndarray) -> Any:
        """An array of nodes (m,) or (m, n) as a matrix."""
        sp = imported()
        graph = self.formulas.graph
        try:
            objects = as_objects(graph, needed(graph.nodes, [nodes]), self.inputs, table(), exact, "SymPy")
        except NotScalarError as error:
            raise ValueError(f"{self.formulas.name}: its equations hold {error}.") from None
        shape = nodes.shape if nodes.ndim == 2 else (nodes.size, 1)
        return sp.Matrix(*shape, [objects[int(k)] for k in nodes.flat])

    def jacobian(self, kinds: tuple[str, ...]) -> Any:
        """The derivatives of (q_dot, u_dot)."""
        return self.expressions(np.concatenate([*self.formulas.derivatives("rates", kinds).values()]))

    def tangents(self, names: tuple[str, ...], dependent: tuple[str, ...]) -> Any:
        """T (n_q + n, n_free): how all coordinates and speeds move with the free ones, on the constraints."""
        sp = imported()
        free = [x for x in names if x not in dependent]
        T = sp.Matrix(len(names), len(free), lambda i, j: int(names[i] == free[j]))
        (h,) = self.formulas.derivatives("configuration_residuals", ("q",)).values()
        check_dependent(self.formulas.system, dependent, len(h))
        if dependent:
            G = self.expressions(h)  # dh/dq
            by = [names.index(x) for x in dependent]
            rest = [j for j in range(G.cols) if j not in by]
            everywhere = list(range(G.rows))
            moves = -G.extract(everywhere, by).LUsolve(G.extract(everywhere, rest))
            for i, row in enumerate(by):
                for j, column in enumerate(rest):
                    T[row, free.index(names[column])] = moves[i, j]
        return T

    def check(self, cyclic: Sequence[str]) -> None:
        """Refuse what is not steady, or off the constraints, as numbers say."""
        rates, system = self.formulas.nodes("rates"), self.formulas.system
        (h,) = self.formulas.nodes("configuration_residuals").values()
        still = [i for i, name in enumerate(system.coordinates) if name not in cyclic]
        residuals = [f"{system.coordinates[i]} changes with" for i in still]
        residuals += [f"{name} is accelerated by" for name in system.speeds]
        residuals += [f"configuration constraint {i} is violated by" for i in range(len(h))]
        values = self.expressions(np.concatenate([rates["q_dot"][still], rates["u_dot"], h]))
        self.refuse_singular(values)
        wrong = [
            f"{residual} {x:.3g}"
            for residual, x in zip(residuals, self._numbers(values), strict=True)
            if not abs(x) < _TOLERANCE
        ]
        if wrong:
            raise ValueError(
                f"{self.formulas.name}: this motion is not steady: {', '.join(wrong)}, with the system's own "
                "parameters. Name other values in `at`; or ask for the linear model of an instant with steady=False."
            )

    def _numbers(self, expressions: Any) -> list[float]:
        """Values at the system's own parameters, and at some number for every other symbol."""
        values = {
            self.parameters[name]: float(x)
            for a, array in self.formulas.values().items()
            for name, x in zip(self._elements(a), array.flat, strict=True)
        }
        unset = sorted((x for x in sizes_of(expressions) if x.is_Symbol and x not in values), key=str)
        numbers = values | {s: 0.3 + 0.1 * i for i, s in enumerate(unset)}
        f = imported().lambdify([*numbers], [*expressions], "numpy", cse=True)
        return [float(x) for x in f(*numbers.values())]

    def _elements(self, parameter: str) -> tuple[str, ...]:
        return next(a.elements for a in self.formulas.of_kind("parameters") if a.name == parameter)

    def refuse_singular(self, matrix: Any) -> None:
        sp = imported()
        if {sp.nan, sp.zoo, sp.oo, -sp.oo} & sizes_of(matrix).keys():
            raise ValueError(
                f"{self.formulas.name}: its equations are singular at this motion, where something is divided by zero; "
                "name other coordinates or speeds in `at`."
            )


_SHOWN_UP_TO = 500  # operations that a notebook shows


@dataclasses.dataclass(frozen=True, repr=False)
class LinearEquations:
    """x_dot = A x + B w for small deviations x, w from a motion, as matrices of SymPy.

    Attributes: `A` (n, n), `B` (n, m); `replacements`: pairs (symbol, expression) that stand for what is read more than
    once where the matrices would be long, in the order in which they can be evaluated; `states`, `inputs`: their names;
    `symbols`: by name.
    """

    name: str
    A: Any
    B: Any
    replacements: tuple[tuple[Any, Any], ...]
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    symbols: Mapping[str, Any]

    @property
    def operations(self) -> int:
        """Of both matrices and the replacements."""
        sp = imported()
        return int(sum(sp.count_ops(x) for x in (*(x for _, x in self.replacements), *self.A, *self.B)))

    def cse(self, expressions: Any) -> tuple[list[tuple[Any, Any]], Any]:
        """`replacements` and the expressions, as in `Equations.cse`: lambdify([*symbols], model.A, cse=model.cse)."""
        return list(self.replacements), expressions

    def simplified(self) -> LinearEquations:
        """The same, each entry by `sympy.simplify`.

        **Raises:** `ValueError` for matrices that are too long to be written out.
        """
        sp = imported()
        if self.replacements:
            raise ValueError(f"{self.name}: {self.operations} operations are too many for sympy.simplify.")
        return dataclasses.replace(self, A=self.A.applyfunc(sp.simplify), B=self.B.applyfunc(sp.simplify))

    def __repr__(self) -> str:
        return f"LinearEquations of {self.name}: states: {', '.join(self.states)}; inputs: {', '.join(self.inputs)}"

    def _repr_latex_(self) -> str:
        sp = imported()
        if self.operations > _SHOWN_UP_TO:
            return f"$\\text{{{escaped(repr(self))}}}$"
        names = {x: name_in_latex(x.name) for m in (self.A, self.B) for x in m.free_symbols}
        column = lambda words, dots=0: sp.latex(sp.Matrix([sp.Symbol(name_in_latex(w, dots)) for w in words]))  # noqa: E731
        right = in_latex(self.A, names) + column(self.states)
        if self.inputs:
            right += "+" + in_latex(self.B, names) + column(self.inputs)
        return aligned([(column(self.states, 1), right)])


def linearize(
    system: System,
    at: Mapping[str, Any] | None = None,
    *,
    states: Sequence[str] | None = None,
    dependent: Sequence[str] | None = None,
    steady: bool = True,
) -> LinearEquations:
    """The linear model of a system about a steady motion, as formulas of its parameters.

        jk.symbolic.linearize(pendulum, {"theta1": 0, "theta2": 0}).simplified().A
        jk.symbolic.linearize(bicycle, {"rear_wheel_rate": "-v/rR"}).A  # with a symbol of one's own, v

    The derivatives are those of `jaxkane.stability.linearize`; the motion is put in before anything is written out, so
    that what is zero there goes at once.

    **Arguments:**

    - `at`: coordinates, speeds, inputs, the time and parameters by name, as numbers, expressions of SymPy, or strings.
        Coordinates, speeds, inputs and the time that are left out are zero, parameters stay symbols.
    - `states`: names of coordinates and speeds to keep; by default all independent ones without the cyclic coordinates.
    - `dependent`: names of the coordinates that the constraints determine, by default `system.dependent_coordinates`.
    - `steady`: refuse a motion that is not steady, or off the constraints, as its numbers say with the system's own
        parameters and, for symbols of one's own, any values.

    **Raises:** `ImportError` without sympy; `ValueError` for unknown names, a motion that is not steady or where the
    equations are singular, and as `jaxkane.symbolic.equations`.
    """
    formulas = Formulas(system)
    if system.states:
        raise ValueError(
            f"{formulas.name} has states of the first order ({', '.join(system.states)}), which no linear model in "
            "symbols holds: jaxkane.stability.linearize gives its numbers."
        )
    model = AtMotion(formulas, dict(at or {}))
    names = (*system.coordinates, *system.speeds)
    dependent = system.dependent_coordinates if dependent is None else as_names(dependent)
    refuse_unknown(dependent, system.coordinates, f"{formulas.name}: `dependent` names", "the coordinates are")
    free = [x for x in names if x not in dependent]
    cyclic = cyclic_coordinates(system) if states is None or steady else ()
    states = tuple(x for x in free if x not in cyclic) if states is None else as_names(states)
    refuse_unknown(states, free, f"{formulas.name}: no state can be", "independent coordinates and speeds are")
    if steady:
        model.check(cyclic)
    T = model.tangents(names, dependent)
    rows = [names.index(x) for x in states]
    columns = [free.index(x) for x in states]
    A = (model.jacobian(("q", "u")) * T).extract(rows, columns)
    B = model.jacobian(("inputs",)).extract(rows, list(range(len(system.inputs))))
    for matrix in (A, B):
        model.refuse_singular(matrix)
    replacements, (A, B) = _shared(A, B)
    return LinearEquations(formulas.name, A, B, replacements, states, tuple(system.inputs), model.symbols)


def _shared(*matrices: Any) -> tuple[tuple[tuple[Any, Any], ...], list[Any]]:
    """Matrices as they are, or with replacements where they would be long."""
    sp = imported()
    sizes = sizes_of(*matrices)
    if sum(sizes[x] for m in matrices for x in m) <= WHOLE_UP_TO:
        return (), [sp.ImmutableMatrix(m) for m in matrices]
    names = (sp.Symbol(name, real=True) for name in fresh_names(x.name for x in sizes if x.is_Symbol))
    pairs, reduced = sp.cse([sp.ImmutableMatrix(m) for m in matrices], names, order="none")
    return tuple(pairs), [sp.ImmutableMatrix(m) for m in reduced]
