"""Everything that this library uses of JAX and equinox beyond their public API. Independent of programs and mechanics.

All of it exists in the versions of JAX that `pyproject.toml` admits. equinox has no upper bound there. Without its
private names, compiled programs are never freed, and are stored only if the environment sets `EQX_ON_ERROR=nan`.

Jaxprs are read in this folder only: by `interpret` equation by equation, and by `jaxpr`, `graph` and `digest`.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import os
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import numpy as np
import numpy.typing as npt
from jax._src.xla_bridge import backends_are_initialized
from jax.core import ShapedArray as ShapedArray
from jax.core import Tracer as Tracer
from jax.core import eval_context
from jax.experimental.compilation_cache.compilation_cache import reset_cache as reset_cache
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import ClosedJaxpr, Jaxpr, Primitive, Var
from jax.extend.core import jaxpr_as_fun as jaxpr_as_fun
from jax.interpreters import ad, batching, mlir
from jax.interpreters.ad import instantiate_zeros as instantiate_zeros
from jax.interpreters.ad import is_undefined_primal as is_undefined_primal
from jax.interpreters.partial_eval import custom_partial_eval_rules
from jax.interpreters.partial_eval import dce_jaxpr as dce_jaxpr

WRONG_FUSIONS = ((0, 10, 2), (0, 11, 0))
NO_FUSIONS = "--xla_cpu_experimental_ynn_fusion_type"


def switch_off_wrong_fusions() -> None:
    """Repair two releases of JAX by a flag of XLA, which is read when XLA starts.

    On a CPU, 0.10.2 (the last for Python 3.11) returns matrix products that are wrong by up to 0.8 % in batches of more
    than 16 384 (jax issue 39103). It and 0.11.0 terminate the process on some programs (39257).

    **Warns:** if JAX has started already.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if jax.__version_info__ not in WRONG_FUSIONS or NO_FUSIONS in flags:
        return
    if backends_are_initialized():
        warnings.warn(
            f"JAX {jax.__version__} has started. On a CPU, it may compute wrong matrix products in batches of more "
            "than 16 384 (jax issue 39103). Import jaxkane before anything is computed, or set XLA_FLAGS to "
            f'"{NO_FUSIONS}=" in the environment, or use JAX 0.12 on Python 3.12 or later.',
            stacklevel=3,
        )
    else:
        os.environ["XLA_FLAGS"] = f"{flags} {NO_FUSIONS}=".strip()


Variable: TypeAlias = Any
"""A variable of a jaxpr, or a literal, which has a number `val`."""

Equation: TypeAlias = Any
"""An equation of a jaxpr (`jax.extend.core.JaxprEqn`). JAX does not promise its attributes."""


def is_literal(v: Variable) -> bool:
    """Whether a variable of a jaxpr is a number, `v.val`."""
    return hasattr(v, "val")


def interpret(
    program: ClosedJaxpr,
    inputs: Sequence[Any],
    rule: Callable[[Any, list[Any]], Iterable[Any]],
    constant: Callable[[Any, Any], Any] = lambda v, x: x,
) -> list[Any]:
    """Evaluate a program with other rules.

    **Arguments:**

    - `program`: a closed jaxpr.
    - `inputs`: the values of its inputs.
    - `rule`: (equation, inputs) -> the results of an equation.
    - `constant`: (v, x) -> the value of an array x that the program contains, for the variable v; or of a number, for
        the literal v.

    **Returns:** the values of its outputs.
    """
    jaxpr = program.jaxpr
    values = dict(zip(jaxpr.invars, inputs, strict=True))
    values.update(zip(jaxpr.constvars, map(constant, jaxpr.constvars, program.consts), strict=True))

    def read(v: Variable) -> Any:
        return constant(v, v.val) if is_literal(v) else values[v]

    for equation in jaxpr.eqns:
        values.update(zip(equation.outvars, rule(equation, [*map(read, equation.invars)]), strict=True))
    return [*map(read, jaxpr.outvars)]


class Operation(NamedTuple):
    """The operation of an equation: the name of its primitive, the name of the function that it calls, the number of
    its results, and whether it is free of side effects."""

    name: str
    function: str
    results: int
    is_pure: bool


def operation_of(equation: Equation) -> Operation:
    name = str(equation.params.get("name", ""))
    return Operation(equation.primitive.name, name, len(equation.outvars), not equation.effects)


def evaluated(equation: Equation, inputs: Sequence[Any]) -> Sequence[Any]:
    """The results of an equation at other inputs, with its own rules for derivatives if it has any."""
    primitive = equation.primitive
    results = primitive.bind(*inputs, **primitive.get_bind_params(equation.params))
    return results if primitive.multiple_results else [results]


def tangents_of(equation: Equation, inputs: Sequence[Any], tangents: Sequence[Any]) -> Sequence[Any]:
    """The tangents of the results of an equation, from those of its inputs. None means zero."""
    primitive = equation.primitive
    if primitive in ad.primitive_jvps:
        dxs = [no_tangent(v.aval) if dx is None else dx for v, dx in zip(equation.invars, tangents, strict=True)]
        dys = ad.primitive_jvps[primitive](inputs, dxs, **equation.params)[1]
        return [None if is_no_tangent(dy) else dy for dy in (dys if primitive.multiple_results else [dys])]
    places = [i for i, dx in enumerate(tangents) if dx is not None]

    def of_differentiated(*ys: Any) -> Sequence[Any]:
        values = dict(zip(places, ys, strict=True))
        return evaluated(equation, [values.get(i, x) for i, x in enumerate(inputs)])

    dys = jax.jvp(of_differentiated, [inputs[i] for i in places], [tangents[i] for i in places])[1]
    return [dy if jax.numpy.issubdtype(v.aval.dtype, np.inexact) else None for v, dy in zip(equation.outvars, dys)]


def programs_in(equation: Equation) -> list[Any]:
    """The programs that an equation runs."""
    values = [x for p in equation.params.values() for x in (p if isinstance(p, (tuple, list)) else [p])]
    programs = [x for x in values if isinstance(x, (ClosedJaxpr, Jaxpr))]
    return [x if isinstance(x, ClosedJaxpr) else ClosedJaxpr(x, ()) for x in programs]


def dependencies(program: ClosedJaxpr) -> list[frozenset[int]]:
    """For each output of a program, the indices of the inputs on which it depends."""
    none = frozenset[int]()
    inputs = [frozenset([i]) for i in range(len(program.in_avals))]
    return interpret(program, inputs, lambda e, places: [none.union(*places)] * len(e.outvars), lambda v, x: none)


def depends_on(program: ClosedJaxpr, inputs: Iterable[int]) -> list[bool]:
    """Which outputs of a program depend on any of the inputs with these indices."""
    return [not places.isdisjoint(inputs) for places in dependencies(program)]


def types_of(program: ClosedJaxpr) -> tuple[list[Any], list[Any]]:
    """Shapes and dtypes of a program's inputs and outputs. JAX 0.12 declares some types without either."""
    return [*program.in_avals], [*program.out_avals]


def new_primitive(
    name: str,
    *,
    evaluate: Callable[..., Any],
    shapes: Callable[..., Any],
    jvp: Callable[..., Any],
    transpose: Callable[..., Any],
    batch: Callable[..., Any],
    traced: Callable[..., Any],
    lower_on_cpu: Callable[..., Any],
    traced_on_gpu: Callable[..., Any] | None = None,
    separate_calls: Callable[..., Any] | None = None,
) -> Any:
    """A primitive of JAX with several results and these rules.

    - `traced`: the function that the primitive represents.
    - `lower_on_cpu`: makes its text for XLA on a CPU.
    - `traced_on_gpu`: the function that it represents under CUDA.
    - `separate_calls`: see `_partially_evaluated`.
    """
    primitive = Primitive(name)
    primitive.multiple_results = True
    primitive.def_impl(evaluate)
    primitive.def_abstract_eval(shapes)
    ad.primitive_jvps[primitive] = jvp
    ad.primitive_transposes[primitive] = transpose
    batching.primitive_batchers[primitive] = batch
    mlir.register_lowering(primitive, mlir.lower_fun(traced, multiple_results=True))
    mlir.register_lowering(primitive, lower_on_cpu, platform="cpu")
    if traced_on_gpu is not None:
        mlir.register_lowering(primitive, mlir.lower_fun(traced_on_gpu, multiple_results=True), platform="cuda")
    if separate_calls is not None:
        custom_partial_eval_rules[primitive] = functools.partial(_partially_evaluated, primitive, separate_calls)
    return primitive


def _partially_evaluated(
    primitive: Primitive, separate_calls: Callable[..., Any], trace: Any, *inputs: Any, **params: Any
) -> Sequence[Any]:
    """The rule of JAX's partial evaluation, which computes known values at once and keeps the others for later.

    `separate_calls` maps the parameters of a call to the calls of which it consists: for each, the number of its inputs
    and its parameters. Each is bound separately, because its inputs may all be known.
    """
    calls = separate_calls(**params)
    each = [trace.default_process_primitive(primitive, inputs[:n], parameters) for n, parameters in calls]
    return [x for results in each for x in results]


def new_variable(like: Variable) -> Variable:
    """A variable of a jaxpr with the type of another one. Variables are distinguished by identity."""
    return Var(like.aval)


def is_under_way(x: Tracer) -> bool:
    """Whether the trace of a tracer is not finished. After its end every operation raises an exception."""
    try:
        jax.numpy.isfinite(x)
    except jax.errors.UnexpectedTracerError:
        return False
    return True


def as_lowering(f: Callable[..., Any]) -> Callable[..., Any]:
    """A JAX function with several results as a lowering rule."""
    return mlir.lower_fun(f, multiple_results=True)


def is_no_tangent(tangent: object) -> bool:
    """Whether a tangent is JAX's symbolic zero, which is stronger than an array of zeros."""
    return type(tangent) is ad.Zero


def no_tangent(x: ShapedArray) -> Any:
    """JAX's symbolic zero tangent for an abstract value; booleans and integers have this tangent."""
    return ad.Zero(x.to_tangent_aval())


def one_function() -> contextlib.AbstractContextManager[Any]:
    """A context in which XLA:CPU compiles each call of a jitted function as one LLVM function."""
    return set_xla_metadata(xla_cpu_small_call="true", inlineable="false")


def concretely() -> contextlib.AbstractContextManager[Any]:
    """A context in which concrete numbers are evaluated at once, also inside a trace.

    Programs that are traced in it are the same as elsewhere. `jax.ensure_compile_time_eval` does not guarantee this.
    """
    return eval_context()


def on_device(x: npt.ArrayLike, dtype: npt.DTypeLike | None = None) -> jax.Array:
    """A NumPy array as an array of JAX. `jax.numpy.asarray` would compile a program for each shape (JAX 0.12)."""
    return jax.device_put(np.asarray(x, dtype))


def settings() -> Any:
    """The settings of JAX on which a traced program depends, in addition to its arguments."""
    return tuple(getattr(jax.config, name) for name in _SETTINGS)


_SETTINGS = (
    "jax_enable_x64",
    "jax_numpy_dtype_promotion",
    "jax_numpy_rank_promotion",
    "jax_default_matmul_precision",
    "jax_debug_nans",
)
_lock = threading.Lock()
_before: list[str] = []  # equinox's setting before the first of the present traces, once for each of them


@contextlib.contextmanager
def storable_checks() -> Iterator[None]:
    """Make equinox's checks return NaN in programs traced in this context, if JAX keeps compiled programs on disk.

    equinox's checks call back into Python to raise exceptions, and JAX does not store programs with callbacks. Without
    this context, no program with a diffrax solve would be stored. equinox reads its setting when a check is traced.
    Therefore only programs traced in this context are affected, and code outside of jaxkane still raises.
    """
    config: Any = jax.config
    equinox: Any = sys.modules.get("equinox._errors")
    keeps = config.jax_compilation_cache_dir and config.jax_enable_compilation_cache
    if not keeps or not hasattr(equinox, "EQX_ON_ERROR"):
        yield
        return
    with _lock:  # other threads may trace at the same time: the first sets it, and the last restores it
        _before.append(_before[0] if _before else equinox.EQX_ON_ERROR)
        equinox.EQX_ON_ERROR = "nan"
    try:
        yield
    finally:
        with _lock:
            before = _before.pop()
            if not _before:
                equinox.EQX_ON_ERROR = before


def filter_jit_uncached(f: Callable[..., Any]) -> Callable[..., Any]:
    """`equinox.filter_jit(f)`, whose programs are freed with it.

    equinox 0.13 keeps them in a dictionary by weak references to f. Its values refer to f themselves, so that they are
    never freed: each cell that defined a class again and simulated it kept 90 memory mappings.
    """
    jitted = eqx.filter_jit(f)
    with contextlib.suppress(ImportError, AttributeError):
        importlib.import_module("equinox._jit")._filter_jit_cache.delete(f)
    return jitted


def without_tangents(tree: Any) -> Any:
    """The arrays of a tree without the tangents of `jax.jvp`, `jacfwd` and `grad`. Tracers of `jit`, `vmap` remain."""
    found: list[Any] = []

    def keep(x: Any) -> Any:
        found.append(x)
        return x

    seen = jax.custom_jvp(keep)
    seen.defjvp(lambda primals, tangents: (seen(*primals), *tangents))  # called with the numbers below a derivative
    leaves, structure = jax.tree.flatten(tree)
    for leaf in leaves:
        seen(leaf)
    return jax.tree.unflatten(structure, found)
