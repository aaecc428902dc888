"""Equations of motion as formulas of SymPy, in the names that the system declares. Knows formulas and SymPy."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from .._kane.formulas import Formulas
from .._scalarjit.backends.source import as_objects, count_operations, uses
from .._scalarjit.graph import NotScalarError, needed, reads
from .._system.system import System
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

WHOLE_UP_TO = 3000  # operations of all formulas, each written out wherever it is read
_SHOWN_UP_TO = 400  # operations that a notebook shows

# Of `Equations`: the function of formulas and its output.
QUANTITIES = {
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
class Equations:
    """Kane's equations of a system, M u_dot = f, with all that they are made of, as matrices of SymPy.

    Attributes:

    - `q_dot` (n_q, 1): rates of the coordinates, by all speeds.
    - `velocity_constraints` (k, 1), `configuration_constraints` (h, 1): zero in the motion.
    - `J` (k, n), `J_dot` (k, n): u_dep = J u for constraints without a term of their own in time, and its rate.
    - `V`, `W`: partial velocities of the mass centres, and partial angular velocities, one (3, n) for each body, in N.
    - `M` (n, n), `f` (n, 1).
    - `replacements`: pairs (symbol, expression) in the order in which they can be evaluated, as `sympy.cse` gives them:
        the dependent speeds, which stand in formulas by their names; and, of a large system, every intermediate result
        that is read more than once.
    - `symbols`: by name, as they were declared; `t`, `q`, `u`, `u_dep`, `inputs`, `parameters`: tuples of them. Behind
        the inputs stand the states of the first order, which loads read as they do.
    - `operations`: scalar operations by quantity, each intermediate result counted once; "all" together.

    Formulas are those of generic finite numbers: x / x is 1, and 0 x is 0.
    """

    name: str
    q_dot: Any
    velocity_constraints: Any
    configuration_constraints: Any
    J: Any
    J_dot: Any
    V: tuple[Any, ...]
    W: tuple[Any, ...]
    M: Any
    f: Any
    replacements: tuple[tuple[Any, Any], ...]
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
        """All symbols that stand for numbers: time, coordinates, independent speeds, inputs, parameters."""
        return (self.t, *self.q, *self.u, *self.inputs, *self.parameters)

    def cse(self, expressions: Any) -> tuple[list[tuple[Any, Any]], Any]:
        """`replacements` and the expressions, as the argument `cse` of `sympy.lambdify` takes them:

        lambdify(equations.arguments, [equations.M, equations.f], cse=equations.cse)
        """
        return list(self.replacements), expressions

    def simplified(self) -> Equations:
        """The same, each formula simplified by `sympy.simplify`: some seconds for textbook systems.

        **Raises:** `ValueError` for a system that is too large to be written out.
        """
        sp = imported()
        if not self.is_whole:
            raise ValueError(
                f"{self.name}: {self.operations['all']} operations are too many for sympy.simplify, which would write "
                "out each intermediate result wherever it is read. The formulas are `replacements`, evaluated one "
                "after the other, and what is made of them. equations(system, whole=True) has them written out, which "
                "for a few hundred operations may take minutes; jaxkane.symbolic.linearize stays smaller."
            )
        simplified: dict[Any, Any] = {}

        def simpler(x: Any) -> Any:
            if x not in simplified:
                simplified[x] = sp.simplify(x)
            return simplified[x]

        matrix = lambda m: m.applyfunc(simpler)  # noqa: E731
        changed: dict[str, Any] = {
            name: tuple(map(matrix, x)) if isinstance(x, tuple) else matrix(x)
            for name, x in ((name, getattr(self, name)) for name in QUANTITIES)
        }
        pairs = tuple((symbol, simpler(x)) for symbol, x in self.replacements)
        return dataclasses.replace(self, **changed, replacements=pairs)

    def __repr__(self) -> str:
        many = f"{self.operations['all']} operations" + ("" if self.is_whole else f", {len(self.replacements)} named")
        return f"Equations of {self.name}: M {self.M.shape}, f {self.f.shape}; {many}"

    def _repr_latex_(self) -> str:
        sp = imported()
        if self.operations["all"] > _SHOWN_UP_TO or not self.is_whole:
            return f"$\\text{{{escaped(repr(self))}}}$"
        names = {x: name_in_latex(_word(x)) for x in self.symbols.values() if x.is_Symbol}
        dotted = lambda xs: sp.Matrix([sp.Symbol(name_in_latex(_word(x), 1)) for x in xs])  # noqa: E731
        show = lambda x: in_latex(x, names)  # noqa: E731
        lines = [(show(dotted(self.q)), show(self.q_dot))]
        lines += [(show(h), "0") for h in self.configuration_constraints]
        lines += [(show(c), "0") for c in self.velocity_constraints]
        lines += [(show(symbol), show(x)) for symbol, x in self.replacements]
        lines.append((show(self.M) + show(dotted(self.u)), show(self.f)))
        return aligned(lines)


def _word(x: Any) -> str:
    """What a symbol, or a function of time, is called."""
    return x.name if x.is_Symbol else str(x.func)


def equations(system: System, *, of_time: bool = False, whole: bool | None = None) -> Equations:
    """The equations of a system as formulas.

        equations = jk.symbolic.equations(jk.catalog.DoublePendulum())
        equations.M[0, 0], equations.simplified().f

    They are those that the library evaluates, taken from the same graph of scalar operations.

    **Arguments:**

    - `of_time`: coordinates, speeds and inputs are functions of the time, `theta(t)`, rather than symbols.
    - `whole`: write every formula out; with False what is read more than once is named in `replacements`. By default
        whole as long as that takes no more than 3000 operations: the bicycle's would never end.

    **Raises:** `ImportError` without sympy; `ValueError` for a batch of systems, a description that contradicts itself,
    and operations that cannot be written as formulas of single numbers.
    """
    formulas = Formulas(system)
    symbols = symbols_of(formulas, of_time)
    # First, so that they stand first among the replacements: others read them by their names.
    u_dep = formulas.nodes("dependent_speeds")["u_dep"] if symbols["u_dep"] else np.zeros(0, np.int64)
    quantities = _quantities(formulas)
    outputs = list(quantities.values())
    is_whole = _written_out(formulas, outputs, u_dep) <= WHOLE_UP_TO if whole is None else whole
    writer = _Writer(formulas, symbols, u_dep, outputs, is_whole)
    matrices: dict[str, Any] = {name: writer.matrices(nodes) for name, nodes in quantities.items()}
    operations = {name: count_operations(formulas.graph, [nodes]) for name, nodes in quantities.items()}
    return Equations(
        formulas.name,
        **matrices,
        replacements=tuple(writer.replacements),
        t=symbols["t"]["t"],
        **{kind: tuple(symbols[kind].values()) for kind in ("q", "u", "u_dep", "inputs", "parameters")},
        symbols=by_name(symbols),
        operations={**operations, "all": count_operations(formulas.graph, outputs)},
        is_whole=is_whole,
    )


def by_name(symbols: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Symbols by the names that they were declared with; a parameter that shares its name has an underscore more."""
    symbol_of: dict[str, Any] = {}
    for kind, of_kind in symbols.items():
        for name, symbol in of_kind.items():
            symbol_of[symbol.name if kind == "parameters" else name] = symbol
    return symbol_of


def _quantities(formulas: Formulas) -> dict[str, np.ndarray]:
    """Nodes by the names of `QUANTITIES`; empty arrays for what a system has not."""
    n, k = len(formulas.system.speeds), len(formulas.system.dependent_speeds)
    empty = {"velocity_constraints": (0,), "J": (0, n), "J_dot": (0, n)}
    return {
        name: np.zeros(empty[name], np.int64) if name in empty and not k else formulas.nodes(function)[output]
        for name, (function, output) in QUANTITIES.items()
    }


def _written_out(formulas: Formulas, outputs: list[np.ndarray], named: np.ndarray) -> int:
    """How many operations there are where each is written wherever it is read; those that are named count once."""
    nodes, stops = formulas.graph.nodes, {int(k) for k in named.flat}
    size: dict[int, int] = {}
    for k in needed(nodes, [*outputs, named]):
        size[k] = sum(0 if i in stops else size[i] for i in reads(nodes[k])) + bool(reads(nodes[k]))
    return sum(size[int(k)] for array in [*outputs, named] for k in array.flat)


class _Writer:
    """Nodes as expressions; dependent speeds, and what is read more than once in a large system, by symbols."""

    def __init__(
        self,
        formulas: Formulas,
        symbols: Mapping[str, Mapping[str, Any]],
        u_dep: np.ndarray,
        outputs: list[np.ndarray],
        is_whole: bool,
    ):
        sp = imported()
        graph = formulas.graph
        inputs = given_nodes(formulas, symbols)
        order = needed(graph.nodes, [*outputs, u_dep])
        count = uses(graph, order, [*outputs, u_dep])
        names = fresh_names([*by_name(symbols), *(x.name for x in inputs.values() if x.is_Symbol)])
        speeds = dict(zip((int(k) for k in u_dep), symbols["u_dep"].values(), strict=True))
        self.replacements: list[tuple[Any, Any]] = []

        def replaced(k: int, x: Any) -> Any:
            if k not in speeds and (is_whole or count[k] < 2 or x.is_Atom or isinstance(x, sp.logic.boolalg.Boolean)):
                return x
            symbol = speeds[k] if k in speeds else sp.Symbol(next(names), real=True)
            self.replacements.append((symbol, x))
            return symbol

        try:
            self.expressions = as_objects(graph, order, inputs, table(), exact, "SymPy", replaced)
        except NotScalarError as error:
            raise ValueError(f"{formulas.name}: its equations hold {error}.") from None
        # A dependent speed that is a speed, or a number, itself.
        named = {symbol for symbol, _ in self.replacements}
        for k, symbol in zip(u_dep, symbols["u_dep"].values(), strict=True):
            if symbol not in named:
                self.replacements.append((symbol, self.expressions[int(k)]))

    def matrices(self, nodes: np.ndarray) -> Any:
        """An array of nodes as a matrix, a column where it has one axis; where it has three, one for each body."""
        sp = imported()
        if nodes.ndim == 3:
            return tuple(self.matrices(x) for x in nodes)
        rows = nodes.reshape(-1, 1) if nodes.ndim == 1 else nodes
        return sp.ImmutableMatrix(*rows.shape, [self.expressions[int(k)] for k in rows.flat])
