"""Programs of JAX with every equation once, and what they may hold to be one compiled function. Knows jaxprs only."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np

from .graph import CALLS
from .jax_internals import ClosedJaxpr, Jaxpr, Literal, dce_jaxpr, new_variable
from .products import is_small, sum_of_products

# What one compiled function may hold: elementwise work and the moving of scalars. Calls into libraries (LAPACK) may not
# be compiled so, and loops would gain nothing.
_PLAIN = frozenset(
    "abs acos acosh add add_any and asin asinh atan atan2 atanh broadcast_in_dim cbrt ceil clamp concatenate "
    "convert_element_type copy copy_p cos cosh div eq erf exp exp2 expm1 floor ge gt integer_pow is_finite jit le "
    "log log1p logistic lt max min mul ne neg not one_minus_square or pad pjit pow reduce_and reduce_max reduce_min "
    "reduce_or reduce_prod reduce_sum rem reshape rev round rsqrt select_n sign sin sinh slice split sqrt square "
    "squeeze stack stop_gradient sub tan tanh transpose unstack xor".split()
)
_LARGEST_SUM = 64  # XLA may hand larger ones to a library

# In the name of each call of the method itself into LAPACK.
BY_LAPACK = "by_lapack"
# The name of the primitive of JAX that stands for a program, with the parameters `program`, `sizes` and `where`.
PROGRAM = "scalar_program"


def without_repetition(program: ClosedJaxpr) -> ClosedJaxpr:
    """The same program with every common subexpression once, and without what no output needs; products of small
    matrices, which XLA would hand to a library, are sums of products.

    A description is read once for every speed, and much of it comes out the same. XLA would find that too, but only
    after JAX has differentiated every copy.
    """
    once = _Once()
    outputs = once.walk(program.jaxpr, program.consts, program.jaxpr.invars)
    jaxpr = program.jaxpr.replace(constvars=[*once.consts], eqns=once.equations, outvars=outputs)
    jaxpr, _ = dce_jaxpr(jaxpr, [True] * len(outputs), instantiate=True)
    return ClosedJaxpr(jaxpr, [*once.consts.values()])


class _Once:
    """Equations of programs in one list, each once. They are put down as they stand and not traced anew, which would
    take as long as all else that is done to a program."""

    def __init__(self) -> None:
        self.equations: list[Any] = []
        self.consts: dict[Any, Any] = {}  # by their variables
        self._known: dict[Any, Sequence[Any]] = {}  # the outputs of an equation, by its name

    def walk(self, program: Jaxpr, consts: Sequence[Any], inputs: Sequence[Any]) -> list[Any]:
        """The variables of a program's outputs, where its inputs are these variables or literals."""
        values: dict[Any, Any] = dict(zip(program.invars, inputs, strict=True))
        values.update((v, self._const(v, x)) for v, x in zip(program.constvars, consts, strict=True))
        read = lambda v: v if isinstance(v, Literal) else values[v]  # noqa: E731
        for equation in program.eqns:
            xs = [read(v) for v in equation.invars]
            inner = opened(equation)
            if inner is not None:
                outputs = self.walk(inner.jaxpr, inner.consts, xs)
            else:
                # Numbers by their bits, all else by identity.
                names = [_bits(x) if isinstance(x, Literal) else id(x) for x in xs]
                key = (equation.primitive, *names, _name_of(equation))
                if key not in self._known:
                    self._known[key] = self._put_down(equation, xs)
                outputs = self._known[key]
            values.update(zip(equation.outvars, outputs, strict=True))
        return [read(v) for v in program.outvars]

    def _const(self, variable: Any, value: Any) -> Any:
        key = ("const", id(value))
        if key not in self._known:
            self._known[key] = [new_variable(variable)]
            self.consts[self._known[key][0]] = value  # which keeps it alive, and its id its own
        return self._known[key][0]

    def _put_down(self, equation: Any, xs: list[Any]) -> Sequence[Any]:
        if equation.primitive.name == "dot_general" and is_small(equation):
            specs = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in xs]
            product = jax.make_jaxpr(functools.partial(sum_of_products, equation))(*specs)
            return self.walk(product.jaxpr, product.consts, xs)
        outputs = [*map(new_variable, equation.outvars)]  # a program may be opened twice
        self.equations.append(equation.replace(invars=xs, outvars=outputs))
        return outputs


def _bits(literal: Any) -> tuple[bytes, str]:
    return np.asarray(literal.val).tobytes(), str(literal.aval)  # -0.0 == 0.0, and an array's text is rounded


def _name_of(equation: Any) -> Any:
    """What two equations that do the same have in common: their parameters; itself where these cannot be compared."""
    key = tuple(sorted(equation.params.items()))
    try:
        hash(key)
    except TypeError:
        return id(equation)
    return key


def opened(equation: Any) -> ClosedJaxpr | None:
    """What an equation stands for: a program within a program is opened, so that the whole is one."""
    if equation.primitive.name == PROGRAM:
        program, sizes, where = (equation.params[k] for k in ("program", "sizes", "where"))
        return (program.batched(sizes, where) if sizes else program).program
    return equation.params["jaxpr"] if equation.primitive.name in CALLS else None


def reads_of(program: Jaxpr) -> tuple[bool, ...]:
    """Which of its inputs a program reads at all; the first, if it reads none."""
    read = {v for e in program.eqns for v in e.invars if not isinstance(v, Literal)}
    read.update(v for v in program.outvars if not isinstance(v, Literal))
    found = tuple(v in read for v in program.invars)
    return found if any(found) else (True, *found[1:])


def is_plain(program: Jaxpr) -> bool:
    """Whether a program can be one compiled function."""
    return not any(foreign(program))


def foreign(program: Jaxpr, is_ours: bool = False) -> Iterator[tuple[str, bool]]:
    """The operations that cannot be part of one compiled function, and whether they are the description's own: the
    method itself has LAPACK solve what is too large to be written out (`_linear`)."""
    for equation in program.eqns:
        name, inner = equation.primitive.name, opened(equation)
        if inner is not None:
            yield from foreign(inner.jaxpr, is_ours or BY_LAPACK in equation.params.get("name", ""))
        elif name == "dot_general" and is_small(equation):
            continue  # see `without_repetition`
        elif name not in _PLAIN:
            yield name, not is_ours
        elif name.startswith("reduce_") and getattr(equation.invars[0].aval, "size", 0) > _LARGEST_SUM:
            yield f"{name} of more than {_LARGEST_SUM}", not is_ours
