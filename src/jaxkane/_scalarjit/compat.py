"""All that this library uses of JAX and equinox beyond what they promise. Knows no programs and no mechanics.

Each has a way back, so that where a release takes it away, results stay right and only speed, or a convenience, goes:

| what | without it |
|---|---|
| jaxprs and primitives (`jax.extend`, `jax.interpreters`) | `MISSING` says why; right-hand sides are plain JAX |
| the frontend attribute that makes one function of a program | XLA cuts the program as it does any other |
| tracers of a derivative in forward mode | such a derivative must be announced by `adjoint="forward"` |
| the state of traces | motions are compiled for derivatives that nobody can take, a tenth slower at first |
| `reset_cache`, equinox's switch of its checks | programs are kept only where the environment says so from the start |
| `eval_context` | a sweep on a cluster may be refused, since programs that were first traced in a check differ |
| whether JAX has started | a flag that repairs two releases may come too late, and nobody is told |
| `process_allgather` | none: a fit by several processes raises ImportError |

Jaxprs are read in this room alone: equation by equation by `interpret`, and by `jaxpr`, `graph` and `digest`.
`tests/scalarjit/test_compat.py` names what has gone.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import os
import warnings
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.core import Tracer as Tracer

MISSING: str | None = None  # what this JAX lacks, without which there are no scalar programs
try:
    from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Primitive, Var, jaxpr_as_fun
    from jax.interpreters import ad, batching, mlir
    from jax.interpreters.ad import instantiate_zeros, is_undefined_primal
    from jax.interpreters.partial_eval import custom_partial_eval_rules, dce_jaxpr

    _ = Jaxpr.replace, Jaxpr.eqns, Jaxpr.invars, Jaxpr.constvars, Jaxpr.outvars
    _ = JaxprEqn.replace, JaxprEqn.primitive, JaxprEqn.params, JaxprEqn.invars, JaxprEqn.outvars, JaxprEqn.effects
    _ = ad.primitive_jvps, ad.primitive_transposes, ad.UndefinedPrimal, ad.Zero
    _ = ClosedJaxpr.jaxpr, ClosedJaxpr.consts, ClosedJaxpr.in_avals, ClosedJaxpr.out_avals, Primitive.get_bind_params
except (ImportError, AttributeError) as error:
    MISSING = f"this JAX lacks what that needs ({error})"
    missing: Any = None
    ClosedJaxpr = Jaxpr = Primitive = Var = missing
    custom_partial_eval_rules = jaxpr_as_fun = dce_jaxpr = missing
    instantiate_zeros = is_undefined_primal = ad = batching = mlir = missing


WRONG_FUSIONS = ((0, 10, 2), (0, 11, 0))
NO_FUSIONS = "--xla_cpu_experimental_ynn_fusion_type"


def switch_off_wrong_fusions() -> None:
    """Repair two releases of JAX by a flag of XLA, which it reads when it starts.

    On a CPU 0.10.2, the last for Python 3.11, gives products of matrices that are wrong by up to 0.8 % in batches of
    more than 16 384 (jax issue 39103); it and 0.11.0 end the process on some programs (39257).

    **Warns:** where JAX has started already.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if jax.__version_info__ not in WRONG_FUSIONS or NO_FUSIONS in flags:
        return
    try:
        from jax._src.xla_bridge import backends_are_initialized

        has_started = backends_are_initialized()
    except ImportError:
        has_started = False
    if has_started:
        warnings.warn(
            f"JAX {jax.__version__} has started, which may give wrong products of matrices in batches of more than "
            "16 384 on a CPU (jax issue 39103). Import jaxkane before anything is computed, or set XLA_FLAGS to "
            f'"{NO_FUSIONS}=" in the environment; or use JAX 0.12, on Python 3.12 or later.',
            stacklevel=3,
        )
    else:
        os.environ["XLA_FLAGS"] = f"{flags} {NO_FUSIONS}=".strip()


def is_literal(v: Any) -> bool:
    """Whether a variable of a jaxpr is a number, `v.val`."""
    return hasattr(v, "val")


def interpret(
    program: Any,
    inputs: Sequence[Any],
    rule: Callable[[Any, list[Any]], Iterable[Any]],
    constant: Callable[[Any, Any], Any] = lambda v, x: x,
) -> list[Any]:
    """The outputs of a program whose equations have the results `rule(equation, inputs)`. `constant(v, x)` stands for
    an array x that it holds, of the variable v, and for a number that is written in it, of the literal v."""
    jaxpr = program.jaxpr
    values = dict(zip(jaxpr.invars, inputs, strict=True))
    values.update(zip(jaxpr.constvars, map(constant, jaxpr.constvars, program.consts), strict=True))
    read = lambda v: constant(v, v.val) if is_literal(v) else values[v]  # noqa: E731
    for equation in jaxpr.eqns:
        values.update(zip(equation.outvars, rule(equation, [*map(read, equation.invars)]), strict=True))
    return [*map(read, jaxpr.outvars)]


class Operation(NamedTuple):
    """What an equation does: the name of its primitive, that of the function it calls, the number of its results, and
    whether it does nothing besides."""

    name: str
    function: str
    results: int
    is_pure: bool


def operation_of(equation: Any) -> Operation:
    name = str(equation.params.get("name", ""))
    return Operation(equation.primitive.name, name, len(equation.outvars), not equation.effects)


def evaluated(equation: Any, inputs: Sequence[Any]) -> Sequence[Any]:
    """The results of an equation at other inputs; with its own rules for derivatives, where it has some."""
    primitive = equation.primitive
    results = primitive.bind(*inputs, **primitive.get_bind_params(equation.params))
    return results if primitive.multiple_results else [results]


def tangents_of(equation: Any, inputs: Sequence[Any], tangents: Sequence[Any]) -> Sequence[Any]:
    """The tangents of the results of an equation, of those of its inputs. What is None is zero."""
    primitive = equation.primitive
    if primitive in ad.primitive_jvps:
        dxs = [no_tangent(v.aval) if dx is None else dx for v, dx in zip(equation.invars, tangents, strict=True)]
        dys = ad.primitive_jvps[primitive](inputs, dxs, **equation.params)[1]
        return [None if is_no_tangent(dy) else dy for dy in (dys if primitive.multiple_results else [dys])]
    places = [i for i, dx in enumerate(tangents) if dx is not None]

    def of_moving(*ys: Any) -> Sequence[Any]:
        values = dict(zip(places, ys, strict=True))
        return evaluated(equation, [values.get(i, x) for i, x in enumerate(inputs)])

    dys = jax.jvp(of_moving, [inputs[i] for i in places], [tangents[i] for i in places])[1]
    return [dy if jax.numpy.issubdtype(v.aval.dtype, np.inexact) else None for v, dy in zip(equation.outvars, dys)]


def transposed(equation: Any, inputs: Sequence[Any], moves: Sequence[bool], cotangents: Sequence[Any]) -> Sequence[Any]:
    """The cotangents, by input, of an equation that is linear in those of its inputs that move, of the cotangents of
    its results. What is None is zero. Inputs that move have no values."""
    primitive, xs = equation.primitive, list(inputs)
    cts = [ad.Zero(v.aval) if ct is None else ct for v, ct in zip(equation.outvars, cotangents, strict=True)]
    if primitive in ad.primitive_transposes:
        for i, v in enumerate(equation.invars):
            xs[i] = ad.UndefinedPrimal(v.aval) if moves[i] else xs[i]
        rule, of_results = ad.primitive_transposes[primitive], cts if primitive.multiple_results else cts[0]
        results = rule(of_results, *xs, **equation.params)
        return [None if is_no_tangent(ct) else ct for ct in results]
    places = [i for i, is_one in enumerate(moves) if is_one]

    def linear(*ys: Any) -> Sequence[Any]:
        values = dict(zip(places, ys, strict=True))
        return evaluated(equation, [values.get(i, x) for i, x in enumerate(xs)])

    specs = [jax.ShapeDtypeStruct(equation.invars[i].aval.shape, equation.invars[i].aval.dtype) for i in places]
    of_places = jax.linear_transpose(linear, *specs)([*map(instantiate_zeros, cts)])
    by_place = dict(zip(places, of_places, strict=True))
    return [by_place.get(i) for i in range(len(xs))]


def programs_in(equation: Any) -> list[Any]:
    """The programs that an equation runs."""
    values = [x for p in equation.params.values() for x in (p if isinstance(p, (tuple, list)) else [p])]
    programs = [x for x in values if isinstance(x, (ClosedJaxpr, Jaxpr))]
    return [x if isinstance(x, ClosedJaxpr) else ClosedJaxpr(x, ()) for x in programs]


def depends_on(program: Any, inputs: Iterable[int]) -> list[bool]:
    """Which outputs of a program follow from any of the inputs at these places."""
    jaxpr = program.jaxpr
    moved = {jaxpr.invars[i] for i in inputs}
    for equation in jaxpr.eqns:
        if any(not is_literal(v) and v in moved for v in equation.invars):
            moved.update(equation.outvars)
    return [not is_literal(v) and v in moved for v in jaxpr.outvars]


def types_of(program: Any) -> tuple[list[Any], list[Any]]:
    """Shapes and dtypes of what a program takes and gives; JAX 0.12 declares them as types without either."""
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
    parts: Callable[..., Any] | None = None,
) -> Any:
    """An operation of JAX with several results and these rules; `traced` is what it stands for, `lower_on_cpu` makes
    its text for XLA there. `traced_on_gpu`: what it stands for under CUDA; `parts`: see `_partially_evaluated`."""
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
    if parts is not None:
        custom_partial_eval_rules[primitive] = functools.partial(_partially_evaluated, primitive, parts)
    return primitive


def _partially_evaluated(
    primitive: Any, parts: Callable[..., Any], trace: Any, *inputs: Any, **params: Any
) -> Sequence[Any]:
    """Where JAX computes what is known and keeps the rest for later: each of the `parts` of an operation by itself, of
    which one may be known. Of the parameters, `parts` gives how many of the inputs each has, and its parameters."""
    each = [trace.default_process_primitive(primitive, inputs[:n], part) for n, part in parts(**params)]
    return [x for results in each for x in results]


def new_variable(like: Any) -> Any:
    """A variable of a jaxpr, of the same type as another; they are told apart by identity."""
    return Var(like.aval)


def is_moved_forward(x: Any) -> bool:
    """Whether a derivative in forward mode (`jax.jvp`, `jax.jacfwd`) is under way by `x` that nobody will transpose."""
    try:
        from jax.interpreters.ad import JVPTracer
        from jax.interpreters.partial_eval import JaxprTracer
    except ImportError:
        return False
    while isinstance(x, Tracer) and not isinstance(x, JVPTracer) and hasattr(x, "val"):
        x = x.val  # of a batch
    return isinstance(x, JVPTracer) and not isinstance(x.tangent, JaxprTracer)


def is_moved_forward_below(x: Any) -> bool:
    """Whether a derivative of `x` is under way, and one in forward mode of that: `jax.hessian`."""
    return is_moved_forward(getattr(x, "primal", None))


def is_under_way(x: Tracer) -> bool:
    """Whether the trace of a number has not ended yet: one that has ended refuses every operation."""
    try:
        jax.numpy.isfinite(x)
    except jax.errors.UnexpectedTracerError:
        return False
    return True


def as_lowering(f: Callable[..., Any]) -> Callable[..., Any]:
    """A function of JAX, with several results, as a rule that makes text for XLA."""
    return mlir.lower_fun(f, multiple_results=True)


def is_no_tangent(tangent: Any) -> bool:
    """Whether a tangent is JAX's sign for none at all, which is more than zero."""
    return type(tangent) is ad.Zero


def no_tangent(x: Any) -> Any:
    """JAX's sign for it, of an abstract value: what truth values and whole numbers have."""
    return ad.Zero(x.to_tangent_aval())


def one_function() -> contextlib.AbstractContextManager[Any]:
    """Under it, each call of a jitted function is compiled by XLA:CPU as one function of LLVM."""
    try:
        from jax.experimental.xla_metadata import set_xla_metadata

        return set_xla_metadata(xla_cpu_small_call="true", inlineable="false")
    except (ImportError, TypeError):
        return contextlib.nullcontext()


def concretely() -> contextlib.AbstractContextManager[Any]:
    """Under it numbers that are at hand are computed with at once, inside a trace too; what is traced under it is the
    same program as elsewhere, which `jax.ensure_compile_time_eval` does not promise."""
    try:
        from jax.core import eval_context
    except ImportError:
        return jax.ensure_compile_time_eval()
    return eval_context()


def nothing_is_traced() -> bool:
    """Whether no trace is under way at all, so that nobody can differentiate what is computed now."""
    try:
        from jax.core import eval_context
        from jax.extend.core import get_opaque_trace_state
    except ImportError:
        return False
    with eval_context():
        plain = get_opaque_trace_state()
    return get_opaque_trace_state() == plain


def on_device(x: Any, dtype: Any = None) -> jax.Array:
    """NumPy's numbers as an array of JAX. `jax.numpy.asarray` compiles a program for each shape (JAX 0.12)."""
    return jax.device_put(np.asarray(x, dtype))


def settings() -> Any:
    """JAX's settings on which a traced program depends beside its arguments."""
    return tuple(getattr(jax.config, name, None) for name in _SETTINGS)


_SETTINGS = (
    "jax_enable_x64",
    "jax_numpy_dtype_promotion",
    "jax_numpy_rank_promotion",
    "jax_default_matmul_precision",
    "jax_default_dtype_bits",
    "jax_debug_nans",
)


def look_for_cache_again() -> None:
    """Have JAX look again where programs are kept: it does so once, when it first compiles."""
    try:
        from jax.experimental.compilation_cache.compilation_cache import reset_cache
    except ImportError:
        return
    reset_cache()


def on_failed_checks(how: str) -> str | None:
    """Have equinox's checks "raise", or give "nan". **Returns:** what they did before; None where that is not known.

    equinox reads the environment's EQX_ON_ERROR when it is imported; its checks look at the name in their own module
    when they are traced.
    """
    try:
        checks: Any = importlib.import_module("equinox._errors")
    except ImportError:
        return None
    before = getattr(checks, "EQX_ON_ERROR", None)
    checks.EQX_ON_ERROR = how
    return before


def process_allgather(x: Any, *, tiled: bool = False) -> Any:
    """The arrays of all processes, stacked or, if `tiled`, one after the other."""
    from jax.experimental.multihost_utils import process_allgather

    return process_allgather(x, tiled=tiled)
