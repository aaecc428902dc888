"""A function that is traced once and replayed, equation by equation, in the trace that is under way.

What is exactly zero or one stays so: its operations are none. What was computed already is not computed again.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..compat import ClosedJaxpr, evaluated, is_literal
from ..components import add, is_exact, mul, sub
from ..graph import OPERATORS


class Replay:
    """The equations of a function, and where its parts stand among their results."""

    def __init__(self, program: ClosedJaxpr, structures: dict[str, Any], leaves: Sequence[Any]):
        """`structures` of the parts by name; `leaves` of all parts, of which those that are exact are no results."""
        self.program, self.structures = program, structures
        outputs = iter(program.jaxpr.outvars)
        row = iter([x if is_exact(x) else next(outputs) for x in leaves])
        self.results: dict[str, list[Any]] = {
            part: [next(row) for _ in range(s.num_leaves)] for part, s in structures.items()
        }
        self.needed = functools.cache(self._needed)  # a cached method would keep the instance alive

    def _needed(self, part: str) -> list[Any]:
        """The equations that a part needs, and those that do something."""
        read = {v for v in self.results[part] if _is_variable(v)}
        equations = []
        for equation in reversed(self.program.jaxpr.eqns):
            if equation.effects or any(v in read for v in equation.outvars):
                equations.append(equation)
                read.update(v for v in equation.invars if _is_variable(v))
        return equations[::-1]

    def __call__(self, part: str, numbers: Sequence[Any], memory: dict[Any, Any]) -> Any:
        jaxpr: Any = self.program.jaxpr
        values = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*self.program.consts, *numbers), strict=True))
        for equation in self.needed(part):
            xs = [v.val if is_literal(v) else values[v] for v in equation.invars]
            key = (id(equation), *(x if is_exact(x) else id(x) for x in xs))
            if key not in memory:
                known = _with_exact(equation, xs)
                memory[key] = _results(equation, xs) if known is None else [known], xs, self
            values.update(zip(equation.outvars, memory[key][0], strict=True))
        results = [values[v] if _is_variable(v) else v if is_exact(v) else v.val for v in self.results[part]]
        return jax.tree.unflatten(self.structures[part], results)


def _is_variable(v: Any) -> bool:
    return not is_exact(v) and not is_literal(v)


def _results(equation: Any, xs: Sequence[Any]) -> Sequence[Any]:
    xs = [np.asarray(x, v.aval.dtype) if is_exact(x) else x for x, v in zip(xs, equation.invars, strict=True)]
    return evaluated(equation, xs)


_OF_TWO = {"add": add, "sub": sub, "mul": mul}
_OF_EXACT: dict[str, Callable[..., Any]] = {**OPERATORS, "abs": abs, "square": lambda x: x * x}


def _with_exact(equation: Any, xs: Sequence[Any]) -> Any:
    """The result of an equation, of which some values are exact, where it is exact too or needs no equation."""
    # A number that is written in the function is as exact as Python finds it: only beside an exact value.
    exact = [is_exact(x) and not is_literal(v) for x, v in zip(xs, equation.invars, strict=True)]
    if not any(exact):
        return None
    name = equation.primitive.name
    if name in ("copy", "copy_p", "convert_element_type", "reshape", "broadcast_in_dim", "stop_gradient"):
        aval = equation.outvars[0].aval
        return xs[0] if aval.shape == () and jnp.issubdtype(aval.dtype, jnp.floating) else None
    numbers = [float(x) if is_literal(v) else x for x, v in zip(xs, equation.invars, strict=True)]
    if all(map(is_exact, numbers)):
        if name == "integer_pow" and (numbers[0] or equation.params["y"] > 0):
            return numbers[0] ** equation.params["y"]
        return _OF_EXACT[name](*numbers) if name in _OF_EXACT and not (name == "div" and numbers[1] == 0.0) else None
    if name == "div" and exact[1] and xs[1] == 1.0:
        return xs[0]
    trivial = (0.0, 1.0, -1.0) if name == "mul" else (0.0,)
    is_trivial = next(x for x, e in zip(xs, exact, strict=True) if e) in trivial
    return _OF_TWO[name](*xs) if name in _OF_TWO and is_trivial else None
