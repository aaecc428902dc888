"""A function of components read once, and evaluated as often as it is asked. Knows programs; knows no mechanics.

A function that is written in Python costs as much every time it is read. Here it is traced once, with a tracer for
every component, and its equations are evaluated after that: only those that what is asked for needs, and with the exact
zeros and ones that are given instead of some components, as `components` would have it. What is evaluated is again a
function of JAX, which is differentiated and traced as the function itself would be.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from .components import add, is_exact, mul, sub
from .graph import OPERATORS
from .jax_internals import FUSES, ClosedJaxpr, Literal, bound
from .repetition import is_plain, without_repetition
from .versions import Key, key_of, naming_what_is_kept, on_forget, settling


def recorded(f: Callable[..., dict[str, Any]]) -> Callable[..., Any]:
    """`f(arrays, components)`, a pure function that gives parts by name, trees of components; called as
    `g(part, arrays, components, memory)`, which gives one part of it.

    It is read once for each structure of its arguments, and again where what their code reads has changed. In the
    `memory`, a dict, are equations that were evaluated: what does not depend on a direction is not evaluated anew for
    the next one. It belongs to one trace.
    """

    @functools.lru_cache(maxsize=256)
    def record_for(treedef: Any, key: Key, n: int, dtype: Any) -> _Record | None:
        arrays = [jax.ShapeDtypeStruct(a.shape, a.dtype, weak_type=a.weak_type) for a in key.types]
        record = _Record(settling(f), treedef, [*arrays, *[jax.ShapeDtypeStruct((), dtype)] * n])
        # What reads a value of the trace that is under way must not outlive that.
        return None if any(isinstance(c, Tracer) for c in record.program.consts) else record

    on_forget(record_for.cache_clear)

    @functools.wraps(f)
    def call(part: str, arrays: Any, components: Any, memory: dict[Any, Any]) -> Any:
        if FUSES is not None:
            return f(arrays, components)[part]
        (given, key), row = key_of(arrays), jax.tree.leaves(components)  # of components only numbers are read
        dtype = jnp.result_type(*([x for x in row if not is_exact(x)] or [float]))
        treedef = jax.tree.structure((arrays, components))
        with naming_what_is_kept(type(arrays).__name__):
            record = record_for(treedef, key, len(row), dtype)
            if record is None:
                return f(arrays, components)[part]
        row = [x if is_exact(x) or x.dtype == dtype else x.astype(dtype) for x in row]
        return record(part, [*given, *row], memory)

    return call


class _Record:
    """The equations of a function, and where its parts stand among their results."""

    def __init__(self, f: Callable[..., dict[str, Any]], treedef: Any, specs: Sequence[Any]):
        self.structures: dict[str, Any] = {}
        leaves: list[Any] = []

        def results(*xs: Any) -> list[Any]:
            found = f(*jax.tree.unflatten(treedef, xs))
            self.structures.update({part: jax.tree.structure(value) for part, value in found.items()})
            leaves[:] = [x for value in found.values() for x in jax.tree.leaves(value)]
            return [x for x in leaves if not is_exact(x)]

        program: ClosedJaxpr = jax.make_jaxpr(results)(*specs)
        captured = any(isinstance(c, Tracer) for c in program.consts)
        self.program = without_repetition(program) if is_plain(program.jaxpr) and not captured else program
        traced = iter(self.program.jaxpr.outvars)
        row = iter([x if is_exact(x) else next(traced) for x in leaves])
        self.results = {part: [next(row) for _ in range(s.num_leaves)] for part, s in self.structures.items()}
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

    def __call__(self, part: str, leaves: Sequence[Any], memory: dict[Any, Any]) -> Any:
        program = self.program.jaxpr
        values = dict(zip((*program.constvars, *program.invars), (*self.program.consts, *leaves), strict=True))
        for equation in self.needed(part):
            xs = [v.val if isinstance(v, Literal) else values[v] for v in equation.invars]
            key = (id(equation), *(x if is_exact(x) else id(x) for x in xs))
            if key not in memory:
                known = _with_exact(equation, xs)
                memory[key] = _evaluated(equation, xs) if known is None else [known], xs, self
            values.update(zip(equation.outvars, memory[key][0], strict=True))
        results = [v if is_exact(v) else v.val if isinstance(v, Literal) else values[v] for v in self.results[part]]
        return jax.tree.unflatten(self.structures[part], results)


def _is_variable(v: Any) -> bool:
    return not is_exact(v) and not isinstance(v, Literal)


def _evaluated(equation: Any, xs: Sequence[Any]) -> Sequence[Any]:
    xs = [np.asarray(x, v.aval.dtype) if is_exact(x) else x for x, v in zip(xs, equation.invars, strict=True)]
    found = bound(equation, xs)
    return found if equation.primitive.multiple_results else [found]


_OF_TWO = {"add": add, "sub": sub, "mul": mul}
_OF_EXACT: dict[str, Callable[..., Any]] = {**OPERATORS, "abs": abs, "square": lambda x: x * x}


def _with_exact(equation: Any, xs: Sequence[Any]) -> Any:
    """The result of an equation, of which some values are exact, where it is exact too or needs no equation."""
    # A number that is written in the function is as exact as Python finds it: only beside an exact value.
    exact = [is_exact(x) and not isinstance(v, Literal) for x, v in zip(xs, equation.invars, strict=True)]
    if not any(exact):
        return None
    name = equation.primitive.name
    if name in ("copy", "copy_p", "convert_element_type", "reshape", "broadcast_in_dim", "stop_gradient"):
        aval = equation.outvars[0].aval
        return xs[0] if aval.shape == () and jnp.issubdtype(aval.dtype, jnp.floating) else None
    numbers = [float(x) if isinstance(v, Literal) else x for x, v in zip(xs, equation.invars, strict=True)]
    if all(map(is_exact, numbers)):
        if name == "integer_pow" and (numbers[0] or equation.params["y"] > 0):
            return numbers[0] ** equation.params["y"]
        return _OF_EXACT[name](*numbers) if name in _OF_EXACT and not (name == "div" and numbers[1] == 0.0) else None
    if name == "div" and exact[1] and xs[1] == 1.0:
        return xs[0]
    if name not in _OF_TWO or not _is_trivial(name, *(x if e else None for x, e in zip(xs, exact, strict=True))):
        return None
    return _OF_TWO[name](*xs)


def _is_trivial(name: str, x: float | None, y: float | None) -> bool:
    """Whether an operation with one exact value is none, or a sign."""
    return (x if y is None else y) in ((0.0, 1.0, -1.0) if name == "mul" else (0.0,))
