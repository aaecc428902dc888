"""Linear models as matrices of formulas of the parameters. Knows SymPy; knows a motion by its formulas."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from .._common.lookup import as_names, refuse_unknown
from .._description.system import System
from .._method.formulas import Formulas
from ..stability._cyclic import cyclic_coordinates
from ._at_motion import AtMotion, sizes_of
from ._equations import WHOLE_UP_TO
from ._latex import aligned, escaped, in_latex, name_in_latex
from ._sympy import fresh_names, imported

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
    kept = tuple(x for x in free if x not in cyclic) if states is None else as_names(states)
    refuse_unknown(kept, free, f"{formulas.name}: no state can be", "independent coordinates and speeds are")
    if steady:
        model.check(cyclic)
    T = model.tangents(names, dependent)
    rows = [names.index(x) for x in kept]
    columns = [free.index(x) for x in kept]
    A = (model.jacobian(("q", "u")) * T).extract(rows, columns)
    B = model.jacobian(("inputs",)).extract(rows, list(range(len(system.inputs))))
    for matrix in (A, B):
        model.refuse_singular(matrix)
    replacements, (A, B) = _shared(A, B)
    return LinearEquations(formulas.name, A, B, replacements, kept, tuple(system.inputs), model.symbols)


def _shared(*matrices: Any) -> tuple[tuple[tuple[Any, Any], ...], list[Any]]:
    """Matrices as they are, or with replacements where they would be long."""
    sp = imported()
    sizes = sizes_of(*matrices)
    if sum(sizes[x] for m in matrices for x in m) <= WHOLE_UP_TO:
        return (), [sp.ImmutableMatrix(m) for m in matrices]
    names = (sp.Symbol(name, real=True) for name in fresh_names(x.name for x in sizes if x.is_Symbol))
    pairs, found = sp.cse([sp.ImmutableMatrix(m) for m in matrices], names, order="none")
    return tuple(pairs), [sp.ImmutableMatrix(m) for m in found]
