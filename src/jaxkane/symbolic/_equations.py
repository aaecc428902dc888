"""Equations of motion, and linear models at a steady motion, as formulas of SymPy in the declared names."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from .._common.lookup import as_names, refuse_unknown
from .._kane.contact.forces import closed_contacts, refuse_closed_contacts
from .._kane.expression_graph import Formulas
from .._scalarjit.graph import needed, reads
from .._scalarjit.source import count_operations, uses
from .._system.system import System
from ..stability._steady import check_dependent, cyclic_coordinates
from ._sympy import (
    Expression,
    SymbolicModel,
    Symbols,
    aligned,
    exact,
    expressions_of,
    fresh_symbols,
    import_sympy,
    in_latex,
    matrix_of,
    name_in_latex,
    symbols_by_name,
    symbols_of,
    too_long,
)

WHOLE_UP_TO = 3000  # operations of all formulas, if each intermediate result is written out wherever it is used
_SHOWN_UP_TO = 500  # operations that a notebook shows

# Attribute of `Equations`: the function of formulas and its output.
_QUANTITIES = {
    "q_dot": ("coordinate_rates", "q_dot"),
    "configuration_constraints": ("configuration_residuals", "h"),
    "velocity_constraints": ("velocity_residuals", "c"),
    "J": ("constraint_jacobian", "J"),
    "J_dot": ("constraint_jacobian_rate", "J_dot"),
    "V": ("partial_velocities", "V"),
    "W": ("partial_velocities", "W"),
    "M": ("equations", "M"),
    "f": ("equations", "f"),
}


@dataclasses.dataclass(frozen=True, repr=False)
class Equations(SymbolicModel):
    """Kane's equations of a system, M u_dot = f, and their terms, as matrices of SymPy.

    Attributes:

    - `q_dot` (n_q, 1): rates of the coordinates, as functions of all speeds.
    - `velocity_constraints` (k, 1), `configuration_constraints` (h, 1): residuals, which are zero.
    - `J` (k, n), `J_dot` (k, n): u_dep = J u for constraints without an explicit term in time, and the rate of J.
    - `V`, `W`: partial velocities of the mass centres, and partial angular velocities, one (3, n) for each body, in N.
    - `M` (n, n), `f` (n, 1).
    - `replacements`: pairs (symbol, expression) in the order of evaluation, as from `sympy.cse`: the dependent speeds,
        which occur by name in formulas; and, for a large system, each intermediate result that is used more than once.
    - `symbols`: by their declared names.
    - `t`, `q`, `u`, `u_dep`, `inputs`, `parameters`: tuples of symbols. `inputs` ends with the states of the first
        order, which loads use like inputs.
    - `operations`: scalar operations by quantity, each intermediate result counted once; "all" is the total.

    Formulas hold for generic finite numbers: x / x is 1, and 0 x is 0.
    """

    q_dot: Any
    velocity_constraints: Any
    configuration_constraints: Any
    J: Any
    J_dot: Any
    V: tuple[Any, ...]
    W: tuple[Any, ...]
    M: Any
    f: Any
    t: Any
    q: tuple[Any, ...]
    u: tuple[Any, ...]
    u_dep: tuple[Any, ...]
    inputs: tuple[Any, ...]
    parameters: tuple[Any, ...]
    symbols: Mapping[str, Any]
    operations: Mapping[str, int]
    is_whole: bool

    @property
    def arguments(self) -> tuple[Any, ...]:
        """All symbols for numbers: time, coordinates, independent speeds, inputs, parameters."""
        return (self.t, *self.q, *self.u, *self.inputs, *self.parameters)

    def simplified(self) -> Equations:
        """The same equations, each formula simplified by `sympy.simplify`. This takes some seconds for textbook
        systems.

        **Raises:** `ValueError` for a system that is too large to be written out.
        """
        sp = import_sympy()
        if not self.is_whole:
            raise ValueError(
                f"{self.name}: {self.operations['all']} operations are too many for sympy.simplify, because each "
                "intermediate result would be written out wherever it is used. Evaluate `replacements` in their order, "
                "or use equations(system, whole=True), which may take minutes for a few hundred operations. "
                "jaxkane.symbolic.linearize has shorter formulas."
            )
        simplify = functools.cache(sp.simplify)
        matrices: dict[str, Any] = {name: getattr(self, name) for name in _QUANTITIES}
        for name, m in matrices.items():
            matrices[name] = tuple(x.applyfunc(simplify) for x in m) if isinstance(m, tuple) else m.applyfunc(simplify)
        pairs = tuple((symbol, simplify(x)) for symbol, x in self.replacements)
        return dataclasses.replace(self, **matrices, replacements=pairs)

    def __repr__(self) -> str:
        size = f"{self.operations['all']} operations" + ("" if self.is_whole else f", {len(self.replacements)} named")
        return f"Equations of {self.name}: M {self.M.shape}, f {self.f.shape}; {size}"

    def _repr_latex_(self) -> str:
        sp = import_sympy()
        if self.operations["all"] > _SHOWN_UP_TO or not self.is_whole:
            return too_long(self)
        names = {x: name_in_latex(_word(x)) for x in self.symbols.values() if x.is_Symbol}

        def dotted(xs: Expression) -> Expression:
            return sp.Matrix([sp.Symbol(name_in_latex(_word(x), 1)) for x in xs])

        def show(x: Expression) -> str:
            return in_latex(x, names)

        lines = [(show(dotted(self.q)), show(self.q_dot))]
        lines += [(show(h), "0") for h in self.configuration_constraints]
        lines += [(show(c), "0") for c in self.velocity_constraints]
        lines += [(show(symbol), show(x)) for symbol, x in self.replacements]
        lines.append((show(self.M) + show(dotted(self.u)), show(self.f)))
        return aligned(lines)


def _word(x: Expression) -> str:
    return x.name if x.is_Symbol else str(x.func)


def equations(system: System, *, of_time: bool = False, whole: bool | None = None) -> Equations:
    """The equations of a system as formulas.

        equations = jk.symbolic.equations(jk.catalog.DoublePendulum())
        equations.M[0, 0], equations.simplified().f

    The formulas are those that the library evaluates, from the same graph of scalar operations.

    **Arguments:**

    - `system`: the system.
    - `of_time`: write coordinates, speeds and inputs as functions of time, `theta(t)`, instead of symbols.
    - `whole`: write out every formula. With False, results that are used more than once are named in `replacements`.
        Default: True if this takes at most 3000 operations; the bicycle's equations would take too long.

    **Raises:** `ImportError` without sympy; `ValueError` for a batch of systems, a contradictory system, and operations
    that are not formulas of scalars.
    """
    formulas = Formulas(system)
    symbols = symbols_of(formulas, of_time)
    # First, so that they are the first replacements: other formulas use them by name.
    u_dep = formulas.nodes("dependent_speeds")["u_dep"] if symbols["u_dep"] else np.zeros(0, np.int64)
    quantities = _quantities(formulas)
    outputs = list(quantities.values())
    is_whole = _size_written_out(formulas, outputs, u_dep) <= WHOLE_UP_TO if whole is None else whole
    replacements, expressions = _expressions(formulas, symbols, u_dep, outputs, is_whole)
    matrices: dict[str, Any] = {name: matrix_of(nodes, expressions) for name, nodes in quantities.items()}
    operations = {name: count_operations(formulas.graph, [nodes]) for name, nodes in quantities.items()}
    return Equations(
        name=formulas.name,
        **matrices,
        replacements=tuple(replacements),
        t=symbols["t"]["t"],
        **{kind: tuple(symbols[kind].values()) for kind in ("q", "u", "u_dep", "inputs", "parameters")},
        symbols=symbols_by_name(symbols),
        operations={**operations, "all": count_operations(formulas.graph, outputs)},
        is_whole=is_whole,
    )


def _quantities(formulas: Formulas) -> dict[str, np.ndarray]:
    """Nodes by the names of `_QUANTITIES`; empty arrays for quantities that the system does not have."""
    n, k = len(formulas.system.speeds), len(formulas.system.dependent_speeds)
    empty = {"velocity_constraints": (0,), "J": (0, n), "J_dot": (0, n)}
    return {
        name: np.zeros(empty[name], np.int64) if name in empty and not k else formulas.nodes(function)[output]
        for name, (function, output) in _QUANTITIES.items()
    }


def _size_written_out(formulas: Formulas, outputs: list[np.ndarray], named: np.ndarray) -> int:
    """The number of operations if each is written out wherever it is used; those of named nodes count once."""
    nodes, stops = formulas.graph.nodes, {int(k) for k in named.flat}
    size: dict[int, int] = {}
    for k in needed(nodes, [*outputs, named]):
        size[k] = sum(0 if i in stops else size[i] for i in reads(nodes[k])) + bool(reads(nodes[k]))
    return sum(size[int(k)] for array in [*outputs, named] for k in array.flat)


def _expressions(
    formulas: Formulas, symbols: Symbols, u_dep: np.ndarray, outputs: list[np.ndarray], is_whole: bool
) -> tuple[list[tuple[Any, Any]], dict[int, Any]]:
    """Replacements, and nodes as expressions. Dependent speeds are symbols; unless everything is written out, so are
    results that are used more than once."""
    sp = import_sympy()
    outputs = [*outputs, u_dep]
    count = uses(formulas.graph, needed(formulas.graph.nodes, outputs), outputs)
    own = (x.name for of_kind in symbols.values() for x in of_kind.values() if x.is_Symbol)
    fresh = fresh_symbols([*symbols_by_name(symbols), *own])
    speeds = dict(zip((int(k) for k in u_dep), symbols["u_dep"].values(), strict=True))
    replacements: list[tuple[Any, Any]] = []

    def replaced(k: int, x: Expression) -> Expression:
        if k not in speeds and (is_whole or count[k] < 2 or x.is_Atom or isinstance(x, sp.logic.boolalg.Boolean)):
            return x
        symbol = speeds[k] if k in speeds else next(fresh)
        replacements.append((symbol, x))
        return symbol

    expressions = expressions_of(formulas, outputs, symbols, replaced)
    # A dependent speed that is itself a speed or a number has no replacement.
    named = {symbol for symbol, _ in replacements}
    for k, symbol in zip(u_dep, symbols["u_dep"].values(), strict=True):
        if symbol not in named:
            replacements.append((symbol, expressions[int(k)]))
    return replacements, expressions


_TOLERANCE = 1e-9  # of residuals and rates that should be zero, compared with numbers of order one


@dataclasses.dataclass(frozen=True, repr=False)
class LinearEquations(SymbolicModel):
    """x_dot = A x + B w for small deviations x, w from a motion, as matrices of SymPy.

    Attributes:

    - `A` (n, n), `B` (n, m).
    - `replacements`: pairs (symbol, expression) in the order of evaluation, for results that are used more than once in
        long matrices.
    - `states`, `inputs`: their names.
    - `symbols`: by name.
    """

    A: Any
    B: Any
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    symbols: Mapping[str, Any]

    @property
    def operations(self) -> int:
        """The number of operations of both matrices and the replacements."""
        sp = import_sympy()
        return int(sum(sp.count_ops(x) for x in (*(x for _, x in self.replacements), *self.A, *self.B)))

    def simplified(self) -> LinearEquations:
        """The same model, each entry simplified by `sympy.simplify`.

        **Raises:** `ValueError` for matrices that are too long to be written out.
        """
        sp = import_sympy()
        if self.replacements:
            raise ValueError(f"{self.name}: {self.operations} operations are too many for sympy.simplify.")
        return dataclasses.replace(self, A=self.A.applyfunc(sp.simplify), B=self.B.applyfunc(sp.simplify))

    def __repr__(self) -> str:
        return f"LinearEquations of {self.name}: states: {', '.join(self.states)}; inputs: {', '.join(self.inputs)}"

    def _repr_latex_(self) -> str:
        sp = import_sympy()
        if self.operations > _SHOWN_UP_TO:
            return too_long(self)
        names = {x: name_in_latex(x.name) for m in (self.A, self.B) for x in m.free_symbols}

        def column(words: Iterable[str], dots: int = 0) -> str:
            return sp.latex(sp.Matrix([sp.Symbol(name_in_latex(w, dots)) for w in words]))

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
        jk.symbolic.linearize(bicycle, {"rear_wheel_rate": "-v/rR"}).A  # with a symbol of your own, v

    The derivatives are those of `jaxkane.stability.linearize`. The motion is substituted before anything is written
    out, so that zero terms disappear at once.

    **Arguments:**

    - `system`: the system.
    - `at`: coordinates, speeds, inputs, the time and parameters by name, as numbers, expressions of SymPy, or strings.
        Omitted parameters remain symbols; everything else is zero by default.
    - `states`: names of coordinates and speeds to keep. Default: all independent ones without the cyclic coordinates.
    - `dependent`: names of the coordinates that the constraints determine. Default: `system.dependent_coordinates`.
    - `steady`: refuse a motion that is not steady or violates the constraints. This is checked with the system's own
        parameters, and with arbitrary values for your own symbols.

    **Raises:** `ImportError` without sympy; `ValueError` for unknown names, a motion that is not steady, a closed
    contact, or singular equations, and as `jaxkane.symbolic.equations`.
    """
    formulas = Formulas(system)
    if system.states:
        raise ValueError(
            f"{formulas.name} has states of the first order ({', '.join(system.states)}), which are not "
            "supported here. Use jaxkane.stability.linearize for a numerical linear model."
        )
    at_motion = _FormulasAtMotion(formulas, dict(at or {}))
    names = (*system.coordinates, *system.speeds)
    dependent = system.dependent_coordinates if dependent is None else as_names(dependent, "dependent")
    refuse_unknown(
        dependent, system.coordinates, f"{formulas.name}: `dependent` contains unknown names:", "the coordinates are"
    )
    free = [x for x in names if x not in dependent]
    cyclic = cyclic_coordinates(system) if states is None or steady else ()
    states = tuple(x for x in free if x not in cyclic) if states is None else as_names(states, "states")
    refuse_unknown(states, free, f"{formulas.name}: not a possible state:", "independent coordinates and speeds are")
    at_motion.refuse_closed_contacts()
    if steady:
        at_motion.check_steady(cyclic)
    T = at_motion.tangents(names, dependent)
    rows = [names.index(x) for x in states]
    columns = [free.index(x) for x in states]
    A = (at_motion.jacobian(("q", "u")) * T).extract(rows, columns)
    B = at_motion.jacobian(("inputs",)).extract(rows, list(range(len(system.inputs))))
    for matrix in (A, B):
        at_motion.refuse_singular(matrix)
    replacements, (A, B) = _with_replacements(A, B)
    return LinearEquations(formulas.name, replacements, A, B, states, tuple(system.inputs), at_motion.symbols)


class _FormulasAtMotion:
    """Functions of a system, in which numbers and expressions of a motion replace the variables."""

    def __init__(self, formulas: Formulas, at: dict[str, Any]):
        zero = import_sympy().Integer(0)
        self.formulas = formulas
        symbols = symbols_of(formulas, of_time=False)
        self.symbols = symbols_by_name(symbols)
        self.parameters = symbols["parameters"]
        variables = {name: symbol for kind in ("t", "q", "u", "inputs") for name, symbol in symbols[kind].items()}
        refuse_unknown(at, [*variables, *self.parameters], f"{formulas.name} has no", "it has")
        values = {name: self._value(name, x) for name, x in at.items()}
        for name, x in values.items():
            read = sorted(variable for variable, symbol in variables.items() if symbol in x.free_symbols)
            if read:
                raise ValueError(
                    f"{formulas.name}: `at` defines {name} = {x}, but {', '.join(read)} has its own value there. "
                    "Expressions may contain parameters, and symbols that the system does not have."
                )
        self.values = {kind: {name: values.get(name, zero) for name in of_kind} for kind, of_kind in symbols.items()}
        self.values["u_dep"] = symbols["u_dep"]
        self.values["parameters"] = {
            name: symbol if name in variables else values.get(name, symbol) for name, symbol in self.parameters.items()
        }

    def _value(self, name: str, x: Expression) -> Expression:
        """A number, an expression, or a string in which declared names are the declared symbols."""
        sp = import_sympy()
        value: Any = None
        # the last two for "f(", "1.x" and such
        with contextlib.suppress(sp.SympifyError, TypeError, AttributeError):
            value = exact(x, "float64") if isinstance(x, float) else sp.sympify(x, locals=dict(self.symbols))
        if isinstance(value, sp.Expr):
            own = {s: sp.Symbol(s.name, real=True) for s in value.free_symbols if s not in self.symbols.values()}
            value = value.xreplace({s: new for s, new in own.items() if not s.is_real})
            if not value.has(sp.I, sp.nan, sp.oo, -sp.oo, sp.zoo) and value.is_real is not False:
                return value
        raise ValueError(
            f"{self.formulas.name}: `at` has {name} = {x!r}, which is neither a finite number nor an expression of "
            'SymPy. Example: {"%s": "-v/radius"}.' % name
        )

    def expressions(self, nodes: np.ndarray) -> Expression:
        return matrix_of(nodes, expressions_of(self.formulas, [nodes], self.values))

    def jacobian(self, kinds: tuple[str, ...]) -> Expression:
        """The derivatives of (q_dot, u_dot)."""
        blocks = self.formulas.derivatives("rates", self.formulas.directions(*kinds))
        return self.expressions(np.concatenate([*blocks.values()]))

    def tangents(self, names: tuple[str, ...], dependent: tuple[str, ...]) -> Any:
        """T (n_q + n, n_free): derivatives of all coordinates and speeds with respect to the free ones, on the
        constraints."""
        sp = import_sympy()
        free = [x for x in names if x not in dependent]
        T = sp.Matrix(len(names), len(free), lambda i, j: int(names[i] == free[j]))
        (h,) = self.formulas.derivatives("configuration_residuals", self.formulas.directions("q")).values()
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

    def check_steady(self, cyclic: Sequence[str]) -> None:
        """Refuse a motion that is not steady or violates the constraints, by its numerical values."""
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
                "parameters. Pass other values as `at`, or linearize at one instant with steady=False."
            )

    def refuse_closed_contacts(self) -> None:
        q: Any = np.array(self._numbers([*self.values["q"].values()]), self.formulas.dtype)
        t = self._numbers([*self.values["t"].values()])[0]
        refuse_closed_contacts(self.formulas.system, closed_contacts(self.formulas.system, t, q))

    def _numbers(self, expressions: Iterable[Expression]) -> list[float]:
        """Values for the system's own parameters, and for an arbitrary number for each other symbol."""
        arrays = self.formulas.values().values()
        own = np.concatenate([np.ravel(x) for x in arrays]) if self.parameters else []
        values = dict(zip(self.parameters.values(), map(float, own), strict=True))
        unset = sorted((x for x in _sizes(expressions) if x.is_Symbol and x not in values), key=str)
        numbers = values | {symbol: 0.3 + 0.1 * i for i, symbol in enumerate(unset)}
        f = import_sympy().lambdify([*numbers], [*expressions], "numpy", cse=True)
        return [float(x) for x in f(*numbers.values())]

    def refuse_singular(self, matrix: Expression) -> None:
        sp = import_sympy()
        if {sp.nan, sp.zoo, sp.oo, -sp.oo} & _sizes(matrix).keys():
            raise ValueError(
                f"{self.formulas.name}: the equations are singular at this motion (division by zero). Pass other "
                "coordinates or speeds as `at`."
            )


def _with_replacements(*matrices: Any) -> tuple[tuple[tuple[Any, Any], ...], list[Any]]:
    """Matrices unchanged, or with replacements if they would be long."""
    sp = import_sympy()
    pairs, sizes = [], _sizes(*matrices)
    if sum(sizes[x] for m in matrices for x in m) > WHOLE_UP_TO:
        symbols = fresh_symbols(x.name for x in sizes if x.is_Symbol)
        pairs, matrices = sp.cse([sp.ImmutableMatrix(m) for m in matrices], symbols, order="none")
    return tuple(pairs), [sp.ImmutableMatrix(m) for m in matrices]


def _sizes(*matrices: Any) -> dict[Any, int]:
    """The number of operations of each expression in matrices. An expression that occurs several times is counted
    once."""
    sizes: dict[Any, int] = {}

    def size(x: Expression) -> int:
        if x not in sizes:
            sizes[x] = max(len(x.args) - 1, 0) + sum(map(size, x.args))
        return sizes[x]

    for m in matrices:
        for x in m:
            size(x)
    return sizes
