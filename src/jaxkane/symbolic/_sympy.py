"""Nodes of graphs as expressions of SymPy, and expressions as LaTeX."""

from __future__ import annotations

import dataclasses
import fractions
import functools
import itertools
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from types import ModuleType
from typing import Any, TypeAlias

import numpy as np

from .._kane.expression_graph import Formulas
from .._scalarjit.graph import OPERATORS, NotScalarError, needed
from .._scalarjit.source import as_objects

Expression: TypeAlias = Any
"""An expression or a matrix of SymPy, which is an optional dependency."""

Symbols = Mapping[str, Mapping[str, Any]]
"""Symbols, or their replacements, by kind ("t", "q", "u", "u_dep", "inputs", "parameters") and name."""


def import_sympy() -> ModuleType:
    try:
        import sympy
    except ImportError as error:
        raise ImportError('jaxkane.symbolic needs SymPy: pip install "jaxkane[symbolic]".') from error
    return sympy


def symbols_of(formulas: Formulas, of_time: bool) -> dict[str, dict[str, Any]]:
    """Symbols by kind and name: real numbers, positive if a parameter is declared so; or functions of time.

    A parameter with the name of a coordinate, a speed, an input, or the time gets an underscore at the end.
    """
    sp = import_sympy()
    t = sp.Symbol("t", real=True)
    symbols: dict[str, dict[str, Any]] = {"t": {"t": t}}
    reserved = {"t"}
    for kind in ("q", "u", "u_dep", "inputs"):
        names = formulas.names(kind)
        reserved |= {*names}
        make = (lambda name: sp.Function(name, real=True)(t)) if of_time else (lambda name: sp.Symbol(name, real=True))
        symbols[kind] = {name: make(name) for name in names}
    symbols["parameters"] = {}
    for a in formulas.of_kind("parameters"):
        for name in a.elements:
            assumed = {"positive": True} if a.info.positive else {"real": True}
            word = name
            while word in reserved:
                word += "_"
            reserved.add(word)
            symbols["parameters"][name] = sp.Symbol(word, **assumed)
    return symbols


def symbols_by_name(symbols: Symbols) -> dict[str, Any]:
    """Symbols by their declared names. A parameter that shares its name with a variable has an underscore at the
    end."""
    return {
        symbol.name if kind == "parameters" else name: symbol
        for kind, of_kind in symbols.items()
        for name, symbol in of_kind.items()
    }


def expressions_of(
    formulas: Formulas,
    outputs: Sequence[np.ndarray],
    symbols: Symbols,
    replaced: Callable[[int, Any], Any] = lambda k, x: x,
) -> dict[int, Any]:
    """Nodes, and all nodes that they use, as expressions. `replaced` may replace a node's expression by a symbol.

    **Raises:** `ValueError` for operations that are not formulas of scalars.
    """
    inputs = {
        int(k): symbols[a.kind][element]
        for a, nodes in zip(formulas.arguments, formulas.inputs, strict=True)
        for element, k in zip(a.elements, nodes.flat, strict=True)
    }
    graph = formulas.graph
    try:
        return as_objects(graph, needed(graph.nodes, outputs), inputs, _operations(), exact, "SymPy", replaced)
    except NotScalarError as error:
        raise ValueError(f"{formulas.name}: its equations contain {error}.") from None


def matrix_of(nodes: np.ndarray, expressions: Mapping[int, Any]) -> Expression:
    """An array of nodes as a matrix: a column for one axis, a tuple of matrices for three axes."""
    if nodes.ndim == 3:
        return tuple(matrix_of(x, expressions) for x in nodes)
    rows = nodes.reshape(-1, 1) if nodes.ndim == 1 else nodes
    return import_sympy().ImmutableMatrix(*rows.shape, [expressions[int(k)] for k in rows.flat])


def fresh_symbols(reserved: Iterable[str]) -> Iterator[Any]:
    """x0, x1, ... without reserved names."""
    names, sp = {*reserved}, import_sympy()
    return (sp.Symbol(f"x{i}", real=True) for i in itertools.count() if f"x{i}" not in names)


@dataclasses.dataclass(frozen=True, repr=False)
class SymbolicModel:
    """Formulas of the system `name`, with `replacements`: pairs (symbol, expression)."""

    name: str
    replacements: tuple[tuple[Any, Any], ...]

    def cse(self, expressions: Expression) -> tuple[list[tuple[Any, Any]], Any]:
        """`replacements` and the expressions, in the form of the argument `cse` of `sympy.lambdify`:

        lambdify(equations.arguments, [equations.M, equations.f], cse=equations.cse)
        lambdify([*model.symbols.values()], model.A, cse=model.cse)
        """
        return list(self.replacements), expressions


_LARGEST_DENOMINATOR = 10_000


def exact(value: float | bool, dtype: str) -> Expression:
    """The rational number with small numerator and denominator, or the multiple of pi, that rounds to a float; else the
    float."""
    sp = import_sympy()
    if dtype == "bool":
        return sp.true if value else sp.false
    if not math.isfinite(value):
        return sp.nan if math.isnan(value) else sp.oo * (1 if value > 0 else -1)
    ratio = fractions.Fraction(value).limit_denominator(_LARGEST_DENOMINATOR)
    if float(ratio) == value:
        return sp.Rational(ratio.numerator, ratio.denominator)
    ratio = fractions.Fraction(value / math.pi).limit_denominator(360)
    multiple = sp.Rational(ratio.numerator, ratio.denominator) * sp.pi
    if float(multiple) == value:
        return multiple
    decimal = fractions.Fraction(repr(float(value)))  # 1e-05 as 1/100000
    if decimal.denominator <= 10**12:
        return sp.Rational(decimal.numerator, decimal.denominator)
    return sp.Float(value, 17)


@functools.cache
def _operations() -> dict[str, Any]:
    sp = import_sympy()
    # SymPy raises if it compares a result of a division by zero.

    def ordered(f: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        return lambda x, y: sp.false if sp.nan in (x, y) else f(x, y)

    own = "sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh exp log erf sqrt floor".split()
    return {name: getattr(sp, name) for name in own} | {
        **OPERATORS,
        "rem": lambda x, y: sp.sign(x) * sp.Mod(sp.Abs(x), sp.Abs(y)),  # with the sign of x
        "pow": lambda x, y: x**y,
        "exp2": lambda x: 2**x,
        "expm1": lambda x: sp.exp(x) - 1,
        "log1p": lambda x: sp.log(1 + x),
        "cbrt": lambda x: sp.sign(x) * sp.Abs(x) ** sp.Rational(1, 3),
        "abs": sp.Abs,
        "max": sp.Max,
        "min": sp.Min,
        "eq": sp.Eq,
        "ne": sp.Ne,
        "lt": ordered(sp.Lt),
        "le": ordered(sp.Le),
        "gt": ordered(sp.Gt),
        "ge": ordered(sp.Ge),
        "and": sp.And,
        "or": sp.Or,
        "xor": sp.Xor,
        # A branch that is NaN marks a missing value; a formula can omit it.
        "select": lambda c, x, y: x if y is sp.nan else y if x is sp.nan else sp.Piecewise((x, c), (y, True)),
        "convert": lambda x: sp.Piecewise((1, x), (0, True)) if isinstance(x, sp.logic.boolalg.Boolean) else x,
    }


_GREEK = frozenset(
    """alpha beta gamma delta epsilon zeta eta theta iota kappa lambda mu nu xi pi rho sigma tau upsilon phi chi psi
    omega Gamma Delta Theta Lambda Xi Pi Sigma Upsilon Phi Psi Omega""".split()
)


def name_in_latex(name: str, dots: int = 0) -> str:
    r"""theta1 as \theta_{1}, theta1_dot as \dot{\theta}_{1}, mB as m_{B}, engine_mass as \mathit{engine\_mass}. `dots`:
    the number of additional time derivatives."""
    dotted = re.fullmatch(r"(.+)_dot", name)
    base = dotted[1] if dotted else name
    parts = re.fullmatch(r"([A-Za-z]+?)_?(\d*)", base)
    word, index = (parts[1], parts[2]) if parts else (base, "")
    if word in _GREEK:
        letter = f"\\{word}"
    elif len(word) == 1:
        letter = word
    elif len(word) == 2 and word.isalpha() and word.isascii():
        letter, index = word[0], word[1] + index
    else:
        letter = f"\\mathit{{{escaped(word)}}}"
    dots += dotted is not None
    letter = f"\\{'d' * dots}ot{{{letter}}}" if dots else letter
    return f"{letter}_{{{index}}}" if index else letter


def too_long(model: SymbolicModel) -> str:
    return f"$\\text{{{escaped(repr(model))}}}$"


def escaped(word: str) -> str:
    return re.sub(r"([_#$%&{}])", r"\\\1", word)


def in_latex(expression: Expression, names: dict[Any, str]) -> str:
    return import_sympy().latex(expression, symbol_names=names)


def aligned(lines: Iterable[tuple[str, str]]) -> str:
    """Equations in a column."""
    return "$\\displaystyle \\begin{aligned}" + r"\\ ".join(f"{a} &= {b}" for a, b in lines) + "\\end{aligned}$"
