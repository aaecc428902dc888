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
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from .backends import native
from .backends.native import Scalars
from .cache_key import Key, explain_leaked_tracer, key_of, on_forget, settling
from .compat import (
    FUSES,
    ClosedJaxpr,
    Literal,
    as_lowering,
    bound,
    instantiate_zeros,
    is_no_tangent,
    is_undefined_primal,
    jaxpr_as_fun,
    new_primitive,
    no_tangent,
)
from .components import add, is_exact, mul, sub
from .graph import OPERATORS, NotScalarError
from .jaxpr import PROGRAM, cse, in_pieces, is_fusable, reads_of, replaced, unsupported_primitives

_MOST_LANES = 128  # in XLA's hands: with more, intermediates no longer stay in the cache

Where = tuple[tuple[bool, ...], ...]


def fused(f: Callable[..., Any]) -> Callable[..., Any]:
    """A pure function at module level, such that a call of it is one operation of JAX.

    It is traced once for each structure of its arguments, however often it is called, and again where what the code of
    its arguments reads has changed. A function that calls a library (LAPACK, a loop, a sort) cannot be one operation:
    it is called as it is, and a warning names the call and the type of the first argument.
    """

    @functools.lru_cache(maxsize=256)
    def program_for(key, label):
        traced, unflatten = settling(f), functools.partial(jax.tree.unflatten, key.structure)
        program, out = jax.make_jaxpr(lambda *leaves: traced(*unflatten(leaves)), return_shape=True)(*_specs(key.types))
        if any(isinstance(c, Tracer) for c in program.consts):
            raise _CapturedError
        inside = list(unsupported_primitives(program.jaxpr))
        if any(where for _, where in inside):
            _tell_foreign(label, dict.fromkeys(name for name, where in inside if where))
        steady = range(key.structure.children()[0].num_leaves)
        return None if inside else (_Program(program, label, frozenset(steady)), jax.tree.structure(out))

    on_forget(program_for.cache_clear)

    def find(*args):
        if FUSES is not None:
            return [], None
        label, (leaves, key) = _label(args[0]), key_of(*args)
        try:
            with explain_leaked_tracer(label):
                return leaves, program_for(key, label)
        except _CapturedError:
            return leaves, None

    @functools.wraps(f)
    def call(*args):
        leaves, found = find(*args)
        if found is None:
            with explain_leaked_tracer(_label(args[0])):
                return f(*args)
        program, structure = found
        return jax.tree.unflatten(structure, program(*leaves))

    vars(call)["find"] = find  # for `numbers` and `is_native`
    return call


def is_native(f: Callable[..., Any], *args: Any) -> bool:
    """Whether a fused function of these becomes a native kernel, a call of which costs nothing to compile."""
    if not native.is_on() or jax.default_backend() != "cpu":
        return False
    _, found = vars(f)["find"](*args)
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
    """A traced program, and the programs that follow from it, each made once.

    `steady`: places of the arguments that stay what they are while the program is called again and again, as the
    parameters of a system.
    """

    def __init__(self, program: ClosedJaxpr, label: str = "A function", steady: frozenset[int] = frozenset()):
        self.label, self.steady = label, steady
        self.program = cse(program)
        self.evaluate = jaxpr_as_fun(self.program)
        self.in_avals, self.out_avals = self.program.in_avals, self.program.out_avals
        self.is_fusable = is_fusable(self.program.jaxpr)
        self.reads = reads_of(self.program.jaxpr)
        # A memory for each instance, since a cached method would keep the instance itself alive.
        self.tangent = functools.cache(self._tangent)
        self.transposed = functools.cache(self._transposed)
        self.batched = functools.cache(self._batched)
        self.part = functools.cache(self._part)
        self.scalars = functools.cache(self._scalars)
        self.compiled = functools.cache(self._compiled)

    def __call__(self, *leaves: Any) -> list[Any]:
        return _program_p.bind(*leaves, program=self, sizes=(), where=((),) * len(leaves))

    def _tangent(self, moving: tuple[bool, ...]) -> _Program:
        """(primals, tangents of those that move) -> tangents of the outputs that have any."""

        def tangents(*args):
            n = len(moving)
            xs, dxs = list(args[:n]), list(args[n:])

            def of_moving(*ys):
                return self.evaluate(*[*replaced(xs, places, ys)])

            found = jax.jvp(of_moving, [xs[i] for i in places], dxs)[1]
            return [dy for dy, aval in zip(found, self.out_avals, strict=True) if _moves(aval)]

        places = [i for i, m in enumerate(moving) if m]
        dx_avals = [self.in_avals[i] for i in places]
        steady = self.steady | {len(moving) + j for j, i in enumerate(places) if i in self.steady}
        return _Program(jax.make_jaxpr(tangents)(*_specs([*self.in_avals, *dx_avals])), self.label, steady)

    def _transposed(self, linear: tuple[bool, ...]) -> _Program:
        """(the other inputs, cotangents of the outputs) -> cotangents of the linear inputs."""
        places = [i for i, is_linear in enumerate(linear) if is_linear]
        others = [i for i, is_linear in enumerate(linear) if not is_linear]
        specs = _specs(self.in_avals)

        def cotangents(*args):
            known, cts = args[: len(others)], args[len(others) :]
            full = replaced([None] * len(linear), others, known)
            of_linear = lambda *ys: self.evaluate(*replaced(full, places, ys))  # noqa: E731
            return jax.linear_transpose(of_linear, *[specs[i] for i in places])(list(cts))

        program = jax.make_jaxpr(cotangents)(*[specs[i] for i in others], *_specs(self.out_avals))
        return _Program(program, self.label, frozenset(j for j, i in enumerate(others) if i in self.steady))

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

    def moved(self, moving: tuple[bool, ...]) -> tuple[bool, ...]:
        """Which outputs follow from any of the inputs that move."""
        program = self.program.jaxpr
        moved = {v for v, m in zip(program.invars, moving, strict=True) if m}
        for equation in program.eqns:
            if any(not isinstance(v, Literal) and v in moved for v in equation.invars):
                moved.update(equation.outvars)
        return tuple(not isinstance(v, Literal) and v in moved for v in program.outvars)

    def _part(self, inputs: tuple[bool, ...], outputs: tuple[bool, ...]) -> _Program:
        """The program of some outputs, which follow from these inputs alone."""
        specs, places = _specs(self.in_avals), [i for i, is_one in enumerate(inputs) if is_one]
        others = [np.zeros(a.shape, a.dtype) for a in specs]

        def part(*xs):
            return [
                y for y, is_one in zip(self.evaluate(*replaced(others, places, xs)), outputs, strict=True) if is_one
            ]

        steady = frozenset(j for j, i in enumerate(places) if i in self.steady)
        return _Program(jax.make_jaxpr(part)(*[specs[i] for i in places]), self.label, steady)

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

    def groups(self, where: Where) -> tuple[tuple[int, ...], ...]:
        """The arguments as a native kernel takes them: steady numbers that all lanes share are one array, since each
        argument takes XLA as long as some forty operations of a kernel, and a loop makes the array once. What is not
        read is not passed, so that XLA need not compute it either."""
        groups: dict[Any, list[int]] = {}
        for i, (aval, has) in enumerate(zip(_specs(self.in_avals), where, strict=True)):
            if not self.reads[i]:
                continue
            together = i in self.steady and aval.shape == () and not any(has)
            groups.setdefault(aval.dtype if together else i, []).append(i)
        return tuple(map(tuple, groups.values()))

    def target(self, sizes: tuple[int, ...], where: Where) -> str | None:
        """The name of the native kernel for a batch, where there can be one."""
        scalars = self.scalars() if native.is_on() and 0 not in sizes else None
        try:
            return scalars.target(sizes, where, self.groups(where)) if scalars else None
        except NotScalarError as error:
            self._tell_not_scalar(error)
        except (RuntimeError, OSError, MemoryError) as error:  # LLVM's own are RuntimeError
            native.tell(f"LLVM fails at {self.label}: {type(error).__name__}: {str(error)[:300]}")
        return None

    def _tell_not_scalar(self, error: NotScalarError) -> None:
        _tell(self.label, f"{error}", "native kernels do not know: XLA does its work, three to ten times slower")


def _moves(aval: Any) -> bool:
    """Whether there can be a derivative of this kind of number, or by it."""
    return jax.numpy.issubdtype(aval.dtype, jax.numpy.inexact)


def _chosen(sizes: Sequence[int], has: Sequence[bool]) -> tuple[int, ...]:
    return tuple(n for n, h in zip(sizes, has, strict=True) if h)


# A call stands for a batch over leading axes `sizes`; input i has those of them that `where[i]` says, outputs have all.


def _run(*args, program, sizes, where):
    return program.compiled(sizes, where)(*args)


def _abstract(*_, program, sizes, where):
    return [a.update(shape=(*sizes, *a.shape)) for a in program.out_avals]


def _jvp(primals, tangents, *, program, sizes, where):
    moving = tuple(not is_no_tangent(dx) and _moves(x) for x, dx in zip(program.in_avals, tangents, strict=True))
    moves = [(dx, w) for dx, m, w in zip(tangents, moving, where, strict=True) if m]
    outputs = _program_p.bind(*primals, program=program, sizes=sizes, where=where)
    found = iter(
        _program_p.bind(
            *primals,
            *(dx for dx, _ in moves),
            program=program.tangent(moving),
            sizes=sizes,
            where=(*where, *(w for _, w in moves)),
        )
    )
    shapes = _abstract(program=program, sizes=sizes, where=where)
    return outputs, [next(found) if _moves(aval) else no_tangent(aval) for aval in shapes]


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
    moving = tuple(axis is not None for axis in axes)
    moves = program.moved(moving)
    if any(moves) and not all(moves) and not all(moving):  # what follows from shared inputs alone remains shared
        found = {}
        for is_moved in (False, True):
            inputs = tuple(is_moved or not m for m in moving)
            part = program.part(inputs, tuple(m == is_moved for m in moves))
            each = zip(args, moving, where, inputs, strict=True)
            args_of_part, in_batch = zip(*[(x, (m, *w) if is_moved else w) for x, m, w, is_one in each if is_one])
            shape = (size, *sizes) if is_moved else sizes
            found[is_moved] = iter(_program_p.bind(*args_of_part, program=part, sizes=shape, where=in_batch))
        return [next(found[m]) for m in moves], [0 if m else None for m in moves]
    where = tuple((m, *w) for m, w in zip(moving, where, strict=True))
    outputs = _program_p.bind(*args, program=program, sizes=(size, *sizes), where=where)
    return outputs, [0] * len(outputs)


def _inlined(*args, program, sizes, where):
    return (program.batched(sizes, where) if sizes else program).evaluate(*args)


def _as_one_function(*args, program, sizes, where):
    if math.prod(sizes) > _MOST_LANES and sizes[0] > 1:
        return _in_chunks(args, program, sizes, where)
    program = program.batched(sizes, where) if sizes else program
    if not program.is_fusable or 0 in sizes:
        return program.evaluate(*args)
    return in_pieces(program.program, args)


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


def _lower_on_cpu(context, *args, program, sizes, where):
    target = program.target(sizes, where)
    rule = _as_one_function if target is None else functools.partial(_by_kernel, target=target)
    return as_lowering(rule)(context, *args, program=program, sizes=sizes, where=where)


def _by_kernel(*args, program, sizes, where, target):
    groups = [[args[i] for i in group] for group in program.groups(where)]
    outputs = [jax.ShapeDtypeStruct((*sizes, *a.shape), a.dtype) for a in program.out_avals]
    return jax.ffi.ffi_call(target, outputs)(*(jax.numpy.stack(xs) if len(xs) > 1 else xs[0] for xs in groups))


if FUSES is None:
    _program_p = new_primitive(
        PROGRAM,
        evaluate=_run,
        shapes=_abstract,
        jvp=_jvp,
        transpose=_transpose,
        batch=_batch,
        traced=_inlined,
        lower_on_cpu=_lower_on_cpu,
    )


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
        with explain_leaked_tracer(type(arrays).__name__):
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
        self.program = cse(program) if is_fusable(program.jaxpr) and not captured else program
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
