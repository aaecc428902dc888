"""Long scalar programs as one operation of JAX. Knows XLA's habits and nothing of mechanics.

A right-hand side written in scalars is thousands of tiny operations. XLA:CPU cuts such a program into many kernels and
computes shared intermediates again in each: a few times over in the value, and hundreds of times over in derivatives.
A call that carries the frontend attribute `xla_cpu_small_call` is instead compiled as one function, in which LLVM
sees every intermediate once; a very long program, as a few of them. Measured on the nonlinear bicycle (float64, one
thread, jax 0.10.2): 8.6 -> 0.9 us an evaluation inside a loop, its directional derivative 3000 -> 4.5 us, its reverse
derivative 2450 -> 17 us. Where there is LLVM at hand, `native` does better still.

The program is a primitive of its own, so that its derivatives, transposes and batches are such programs again: JAX
never opens it, each is traced once, and each is compiled as one function.
"""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.core import Tracer

from . import native
from .graph import CALLS, NotScalarError
from .jax_internals import (
    FUSES,
    ClosedJaxpr,
    Jaxpr,
    Literal,
    as_lowering,
    dce_jaxpr,
    instantiate_zeros,
    is_no_tangent,
    is_undefined_primal,
    jaxpr_as_fun,
    new_primitive,
    new_variable,
    one_function,
    settings,
)
from .native import Scalars
from .products import is_small, sum_of_products
from .reads import naming_what_is_kept, on_forget, settling, version_of

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
_MOST_LANES = 128  # in XLA's hands: with more, intermediates no longer stay in the cache
# XLA's time to compile a function grows faster than its length, above all where values of the beginning are needed at
# the end, as in a reverse derivative: 6000 equations take 17 s whole, and 2.5 s in pieces.
_WHOLE_UP_TO = 2500
_PIECE = 250

# In the name of each call of the method itself into LAPACK.
BY_LAPACK = "by_lapack"

Where = tuple[tuple[bool, ...], ...]


def fused(f: Callable[..., Any]) -> Callable[..., Any]:
    """`f`, a pure function at module level, as one operation; where it calls into libraries, `f` itself.

    It is traced once for each structure of its arguments, however often it is called, and again where what the code of
    its arguments reads has changed. What keeps it from being one operation is told, by the name of the first argument's
    type.
    """

    @functools.lru_cache(maxsize=256)
    def program_for(treedef, avals, version, label, _):
        traced = settling(f)
        program, out = jax.make_jaxpr(lambda *leaves: traced(*jax.tree.unflatten(treedef, leaves)), return_shape=True)(
            *_specs(avals)
        )
        if any(isinstance(c, Tracer) for c in program.consts):
            raise _CapturedError
        foreign = list(_foreign(program.jaxpr))
        if any(where for _, where in foreign):
            _tell_foreign(label, dict.fromkeys(name for name, where in foreign if where))
        return None if foreign else (_Program(program, label), jax.tree.structure(out))

    on_forget(program_for.cache_clear)

    def find(leaves, treedef, args):
        if FUSES is not None:
            return None
        label = _label(args[0])
        try:
            with naming_what_is_kept(label):
                return program_for(treedef, tuple(map(jax.typeof, leaves)), version_of(args), label, settings())
        except _CapturedError:
            return None

    @functools.wraps(f)
    def call(*args):
        leaves, treedef = jax.tree.flatten(args)
        found = find(leaves, treedef, args)
        if found is None:
            with naming_what_is_kept(_label(args[0])):
                return f(*args)
        program, structure = found
        return jax.tree.unflatten(structure, program(*leaves))

    vars(call)["find"] = find  # for `numbers` and `is_native`
    return call


def is_native(f: Callable[..., Any], *args: Any) -> bool:
    """Whether a fused function of these becomes a native kernel, a call of which costs nothing to compile."""
    if not native.is_on() or jax.default_backend() != "cpu":
        return False
    leaves, treedef = jax.tree.flatten(args)
    found = vars(f)["find"](leaves, treedef, args)
    return bool(found and found[0].scalars())


class _CapturedError(Exception):
    """The function reads a value of the trace that is under way, so that its program must not outlive that."""


def _label(system: Any) -> str:
    return "A function" if hasattr(system, "dtype") else type(system).__name__


_told: set[tuple[str, str]] = set()


def _tell_foreign(label: str, names: Iterable[str]) -> None:
    _tell(
        label,
        " and ".join(f"`{name}`" for name in names),
        "cannot be part of one compiled function: evaluated operation by operation, these equations take about ten "
        "times as long, and their derivatives up to a thousand times. Functions of single numbers, jnp.where and "
        "entries at places known beforehand can be part of it",
    )


def _tell(label: str, what: str, why: str) -> None:
    """Warn of something in a description that costs time; once."""
    if (label, what) not in _told:
        _told.add((label, what))
        warnings.warn(f"{label}: its description uses {what}, which {why}.", UserWarning, stacklevel=2)


def _specs(avals: Sequence[Any]) -> list[jax.ShapeDtypeStruct]:
    return [jax.ShapeDtypeStruct(a.shape, a.dtype, weak_type=a.weak_type) for a in avals]


class _Program:
    """A traced program, and the programs that follow from it, each made once."""

    def __init__(self, program: ClosedJaxpr, label: str = "A function"):
        self.label = label
        self.program = without_repetition(program)
        self.evaluate = jaxpr_as_fun(self.program)
        self.in_avals, self.out_avals = self.program.in_avals, self.program.out_avals
        self.is_plain = is_plain(self.program.jaxpr)
        # A memory for each instance, since a cached method would keep the instance itself alive.
        self.tangent = functools.cache(self._tangent)
        self.transposed = functools.cache(self._transposed)
        self.batched = functools.cache(self._batched)
        self.scalars = functools.cache(self._scalars)
        self.compiled = functools.cache(self._compiled)

    def __call__(self, *leaves: Any) -> list[Any]:
        return _program_p.bind(*leaves, program=self, sizes=(), where=((),) * len(leaves))

    def _tangent(self, moving: tuple[bool, ...]) -> _Program:
        """(primals, tangents of those that move) -> tangents of the outputs."""

        def tangents(*args):
            n = len(moving)
            xs, dxs = list(args[:n]), list(args[n:])
            places = [i for i, m in enumerate(moving) if m]

            def of_moving(*ys):
                return self.evaluate(*[*_replaced(xs, places, ys)])

            return jax.jvp(of_moving, [xs[i] for i in places], dxs)[1]

        dx_avals = [a for a, m in zip(self.in_avals, moving, strict=True) if m]
        return _Program(jax.make_jaxpr(tangents)(*_specs([*self.in_avals, *dx_avals])), self.label)

    def _transposed(self, linear: tuple[bool, ...]) -> _Program:
        """(the other inputs, cotangents of the outputs) -> cotangents of the linear inputs."""
        places = [i for i, is_linear in enumerate(linear) if is_linear]
        others = [i for i, is_linear in enumerate(linear) if not is_linear]
        specs = _specs(self.in_avals)

        def cotangents(*args):
            known, cts = args[: len(others)], args[len(others) :]
            full = _replaced([None] * len(linear), others, known)
            of_linear = lambda *ys: self.evaluate(*_replaced(full, places, ys))  # noqa: E731
            return jax.linear_transpose(of_linear, *[specs[i] for i in places])(list(cts))

        return _Program(jax.make_jaxpr(cotangents)(*[specs[i] for i in others], *_specs(self.out_avals)), self.label)

    def _batched(self, sizes: tuple[int, ...], where: Where) -> _Program:
        """The program over leading axes of these sizes, of which input i has those in `where[i]`."""
        avals = [
            jax.ShapeDtypeStruct((*_chosen(sizes, has), *a.shape), a.dtype, weak_type=a.weak_type)
            for a, has in zip(_specs(self.in_avals), where, strict=True)
        ]
        f = lambda *xs: self.evaluate(*xs)  # noqa: E731
        for d in reversed(range(len(sizes))):
            f = jax.vmap(f, in_axes=tuple(0 if has[d] else None for has in where), axis_size=sizes[d])
        return _Program(jax.make_jaxpr(f)(*avals), self.label)

    def _compiled(self, sizes: tuple[int, ...], where: Where) -> Callable[..., list[Any]]:
        """The program over a batch, as a function that is compiled once for each kind of batch."""
        return jax.jit(functools.partial(_program_p.bind, program=self, sizes=sizes, where=where))

    def _scalars(self) -> Scalars | None:
        """The program as a graph of scalars for machine code, where it can be written so."""
        try:
            return Scalars(self.program)
        except NotScalarError as error:
            self._tell_not_scalar(error)
            return None

    def target(self, sizes: tuple[int, ...], where: Where) -> str | None:
        """The name of the native kernel for a batch, where there can be one."""
        scalars = self.scalars() if native.is_on() and 0 not in sizes else None
        try:
            return scalars.target(sizes, where) if scalars else None
        except NotScalarError as error:
            self._tell_not_scalar(error)
        except (RuntimeError, OSError, MemoryError) as error:  # LLVM's own are RuntimeError
            native.tell(f"LLVM fails at {self.label}: {type(error).__name__}: {str(error)[:300]}")
        return None

    def _tell_not_scalar(self, error: NotScalarError) -> None:
        _tell(self.label, f"{error}", "native kernels do not know: XLA does its work, three to ten times slower")


def _chosen(sizes: Sequence[int], has: Sequence[bool]) -> tuple[int, ...]:
    return tuple(n for n, h in zip(sizes, has, strict=True) if h)


def _replaced(values: Sequence[Any], places: Sequence[int], new: Sequence[Any]) -> list[Any]:
    values = list(values)
    for i, x in zip(places, new, strict=True):
        values[i] = x
    return values


# A call stands for a batch over leading axes `sizes`; input i has those of them that `where[i]` says, outputs have all.


def _run(*args, program, sizes, where):
    return program.compiled(sizes, where)(*args)


def _abstract(*_, program, sizes, where):
    return [a.update(shape=(*sizes, *a.shape)) for a in program.out_avals]


def _jvp(primals, tangents, *, program, sizes, where):
    moving = tuple(not is_no_tangent(dx) for dx in tangents)
    moves = [(dx, w) for dx, m, w in zip(tangents, moving, where, strict=True) if m]
    outputs = _program_p.bind(*primals, program=program, sizes=sizes, where=where)
    return outputs, _program_p.bind(
        *primals,
        *(dx for dx, _ in moves),
        program=program.tangent(moving),
        sizes=sizes,
        where=(*where, *(w for _, w in moves)),
    )


def _transpose(cotangents, *args, program, sizes, where):
    linear = tuple(is_undefined_primal(x) for x in args)
    known = [(x, w) for x, w, is_linear in zip(args, where, linear, strict=True) if not is_linear]
    everywhere = ((True,) * len(sizes),) * len(cotangents)
    found = iter(
        _program_p.bind(
            *(x for x, _ in known),
            *map(instantiate_zeros, cotangents),
            program=program.transposed(linear),
            sizes=sizes,
            where=(*(w for _, w in known), *everywhere),
        )
    )

    def over_missing(ct, has):
        axes = tuple(d for d, h in enumerate(has) if not h)
        return ct.sum(axes) if axes else ct

    return [over_missing(next(found), w) if is_linear else None for is_linear, w in zip(linear, where, strict=True)]


def _batch(args, axes, *, program, sizes, where):
    size = next(x.shape[axis] for x, axis in zip(args, axes, strict=True) if axis is not None)
    args = [x if axis is None else jax.numpy.moveaxis(x, axis, 0) for x, axis in zip(args, axes, strict=True)]
    where = tuple((axis is not None, *w) for axis, w in zip(axes, where, strict=True))
    outputs = _program_p.bind(*args, program=program, sizes=(size, *sizes), where=where)
    return outputs, [0] * len(outputs)


def _inlined(*args, program, sizes, where):
    return (program.batched(sizes, where) if sizes else program).evaluate(*args)


def _as_one_function(*args, program, sizes, where):
    if math.prod(sizes) > _MOST_LANES and sizes[0] > 1:
        return _in_chunks(args, program, sizes, where)
    program = program.batched(sizes, where) if sizes else program
    if not program.is_plain or 0 in sizes:
        return program.evaluate(*args)

    if len(program.program.jaxpr.eqns) <= _WHOLE_UP_TO:
        return _one_function(program.evaluate, args)
    jaxpr = program.program.jaxpr
    values = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*program.program.consts, *args), strict=True))
    for piece in _pieces(jaxpr):
        values.update(zip(piece.outputs, _one_function(piece, [values[v] for v in piece.inputs]), strict=True))
    return [v.val if isinstance(v, Literal) else values[v] for v in jaxpr.outvars]


def _in_chunks(args, program, sizes, where):
    """A large batch, some of its first axis at a time; the last chunk begins earlier, so that all are alike."""
    n, others = sizes[0], sizes[1:]
    size = max(1, min(n, _MOST_LANES // math.prod(others)))
    bind = functools.partial(_program_p.bind, program=program, sizes=(size, *others), where=where)

    def chunk(i, outputs):
        start = jax.numpy.minimum(i * size, n - size)
        part = [jax.lax.dynamic_slice_in_dim(x, start, size) if w[0] else x for x, w in zip(args, where, strict=True)]
        put = functools.partial(jax.lax.dynamic_update_slice_in_dim, start_index=start, axis=0)
        return [put(whole, found) for whole, found in zip(outputs, bind(*part), strict=True)]

    empty = [jax.numpy.zeros((*sizes, *a.shape), a.dtype) for a in program.out_avals]
    return jax.lax.fori_loop(0, -(-n // size), chunk, empty)


def _one_function(f: Callable[..., Any], args: Sequence[Any]) -> Any:
    # XLA aborts on a parameter that its simplified program no longer reads. The sum reads them all, and the barrier
    # hides constant arguments, which XLA would write into the program in the parameter's stead.
    places = [i for i, x in enumerate(args) if x.size]

    def values_and_sum(*some):
        return f(*_replaced(args, places, some)), sum(x[(0,) * x.ndim].astype(float) for x in some)

    with one_function():
        values, _ = jax.jit(values_and_sum)(*jax.lax.optimization_barrier([args[i] for i in places]))
    return values


class _Piece(NamedTuple):
    """Some equations of a program, one after the other: a function of the variables `inputs`."""

    inputs: list[Any]
    outputs: list[Any]
    equations: Sequence[Any]

    def __call__(self, *args: Any) -> list[Any]:
        values = dict(zip(self.inputs, args, strict=True))
        for equation in self.equations:
            inputs = [v.val if isinstance(v, Literal) else values[v] for v in equation.invars]
            outputs = equation.primitive.bind(*inputs, **equation.params)
            values.update(zip(equation.outvars, outputs if equation.primitive.multiple_results else [outputs]))
        return [values[v] for v in self.outputs]


def _pieces(program: Jaxpr) -> list[_Piece]:
    read_later = {v for v in program.outvars if not isinstance(v, Literal)}
    pieces = []
    for start in reversed(range(0, len(program.eqns), _PIECE)):
        equations = program.eqns[start : start + _PIECE]
        made = {v for e in equations for v in e.outvars}
        read = dict.fromkeys(v for e in equations for v in e.invars if not isinstance(v, Literal) and v not in made)
        pieces.append(_Piece(list(read), [v for e in equations for v in e.outvars if v in read_later], equations))
        read_later |= set(read)
    return pieces[::-1]


def _lower_on_cpu(context, *args, program, sizes, where):
    target = program.target(sizes, where)
    if target is None:
        return as_lowering(_as_one_function)(context, *args, program=program, sizes=sizes, where=where)
    return jax.ffi.ffi_lowering(target)(context, *args)


if FUSES is None:
    _program_p = new_primitive(
        "scalar_program",
        evaluate=_run,
        shapes=_abstract,
        jvp=_jvp,
        transpose=_transpose,
        batch=_batch,
        traced=_inlined,
        lower_on_cpu=_lower_on_cpu,
    )


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
            inner = _called(equation)
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


def _called(equation: Any) -> ClosedJaxpr | None:
    """What an equation stands for: a program within a program is opened, so that the whole is one."""
    if equation.primitive is _program_p:
        program, sizes, where = (equation.params[k] for k in ("program", "sizes", "where"))
        return (program.batched(sizes, where) if sizes else program).program
    return equation.params["jaxpr"] if equation.primitive.name in CALLS else None


def is_plain(program: Jaxpr) -> bool:
    """Whether a program can be one compiled function."""
    return not any(_foreign(program))


def _foreign(program: Jaxpr, is_ours: bool = False) -> Iterator[tuple[str, bool]]:
    """The operations that cannot be part of one compiled function, and whether they are the description's own: the
    method itself has LAPACK solve what is too large to be written out (`_linear`)."""
    for equation in program.eqns:
        name, inner = equation.primitive.name, _called(equation)
        if inner is not None:
            yield from _foreign(inner.jaxpr, is_ours or BY_LAPACK in equation.params.get("name", ""))
        elif name == "dot_general" and is_small(equation):
            continue  # see `without_repetition`
        elif name not in _PLAIN:
            yield name, not is_ours
        elif name.startswith("reduce_") and getattr(equation.invars[0].aval, "size", 0) > _LARGEST_SUM:
            yield f"{name} of more than {_LARGEST_SUM}", not is_ours
