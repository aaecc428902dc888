"""Expressions of SymPy as functions of components. Knows SymPy's printer and exact zeros; knows no mechanics."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp

from .._scalars.components import add, mul
from .._scalars.types import Component


def imported() -> Any:
    try:
        import sympy  # pyright: ignore[reportMissingImports]
        import sympy.physics.mechanics  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError(
            "Models of SymPy need SymPy: `pip install sympy`, or `pip install 'jaxkane[symbolic]'`."
        ) from error
    return sympy


FUNCTIONS = {
    "Abs": jnp.abs,
    "Max": lambda *xs: functools.reduce(jnp.maximum, xs),
    "Min": lambda *xs: functools.reduce(jnp.minimum, xs),
    "acos": jnp.arccos,
    "acosh": jnp.arccosh,
    "asin": jnp.arcsin,
    "asinh": jnp.arcsinh,
    "atan": jnp.arctan,
    "atan2": jnp.arctan2,
    "atanh": jnp.arctanh,
    "cos": jnp.cos,
    "cosh": jnp.cosh,
    "exp": jnp.exp,
    "log": jnp.log,
    "sign": jnp.sign,
    "sin": jnp.sin,
    "sinh": jnp.sinh,
    "sqrt": jnp.sqrt,
    "tan": jnp.tan,
    "tanh": jnp.tanh,
}


def function(arguments: Sequence[Any], expressions: Sequence[Any]) -> Any:
    """The expressions as one function of components, with common subexpressions."""
    modules = [FUNCTIONS | _ARITHMETIC, "math"]
    return imported().lambdify(arguments, list(expressions), modules=modules, printer=_printer(), cse=True)


@functools.cache
def _printer() -> Any:
    """Expressions as Python. Sums and products are functions that drop exact zeros: the method asks for velocities
    along one speed, where all others are exactly zero. Integer powers stay integer."""
    from sympy.printing.pycode import PythonCodePrinter  # pyright: ignore[reportMissingImports]

    class Printer(PythonCodePrinter):
        def call(self, name: str, expr: Any) -> str:
            return f"{name}({', '.join(self._print(x) for x in expr.args)})"

        def _print_Add(self, expr: Any, order: Any = None) -> str:
            return self.call("_sum", expr)

        def _print_Mul(self, expr: Any) -> str:
            return self.call("_product", expr)

        def _print_Integer(self, expr: Any) -> str:
            return repr(float(expr))  # exact ones and zeros are dropped where they are floats

        _print_One = _print_Zero = _print_NegativeOne = _print_Integer

        def _print_Pow(self, expr: Any, rational: bool = False) -> str:
            base, exponent = (self._print(x) for x in expr.args)
            if expr.exp.is_Integer:
                return f"({base})**({int(expr.exp)})"
            return f"sqrt({base})" if expr.exp == imported().S.Half else f"({base})**({exponent})"

        def _print_And(self, expr: Any) -> str:
            return self.call("_both", expr)

        def _print_Or(self, expr: Any) -> str:
            return self.call("_either", expr)

        def _print_Not(self, expr: Any) -> str:
            return self.call("_not", expr)

        def _print_Piecewise(self, expr: Any) -> str:
            value = "nan"
            for x, condition in reversed(expr.args):
                if condition is imported().true:
                    value = self._print(x)
                else:
                    value = f"_where({self._print(condition)}, {self._print(x)}, {value})"
            return value

        def _print_known(self, expr: Any) -> str:
            return self.call(expr.func.__name__, expr)

    for name in FUNCTIONS:
        setattr(Printer, f"_print_{name}", Printer._print_known)
    return Printer({"fully_qualified_modules": False, "inline": True, "allow_unknown_functions": True})


def _sum(*terms: Component) -> Component:
    return functools.reduce(add, terms)


def _product(*factors: Component) -> Component:
    return functools.reduce(mul, factors)


_ARITHMETIC = {
    "_sum": _sum,
    "_product": _product,
    "_where": jnp.where,
    "_both": lambda *conditions: functools.reduce(jnp.logical_and, conditions),
    "_either": lambda *conditions: functools.reduce(jnp.logical_or, conditions),
    "_not": jnp.logical_not,
    "nan": float("nan"),
}
