"""Equations of motion as formulas of SymPy, in the names that the system declares."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import numpy as np

from .._kane.expression_graph import Formulas
from .._scalarjit.graph import needed, reads
from .._scalarjit.source import count_operations, uses
from .._system.system import System
from ._sympy import (
    Expression,
    SymbolicModel,
    Symbols,
    aligned,
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
_SHOWN_UP_TO = 400  # operations that a notebook shows

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
    """The name of a symbol, or of a function of time."""
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
