"""A function of scalars as one operation of JAX, traced once for each cache key. Knows nothing of mechanics.

A right-hand side written in scalars is thousands of tiny operations, which XLA cuts into many kernels, and computes
again in each: a few times over in the value, and hundreds of times over in derivatives. Here it is a primitive of its
own, whose derivatives, transposes and batches are such programs again. Each is traced once and compiled as one
function, by LLVM (`backends.native`) or by XLA (`backends.xla`). Measured with XLA on the nonlinear bicycle (float64,
one thread, jax 0.10.2): 8.6 -> 0.9 us an evaluation inside a loop, its directional derivative 3000 -> 4.5 us, its
reverse derivative 2450 -> 17 us.
"""

from __future__ import annotations

import copy
import functools
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .backends import native
from .backends.native import Scalars, Where
from .backends.numpy import NumPyProgram
from .backends.xla import Windows, as_one_function, chunks_of, one_chunk_at_a_time, pays_as_windows
from .cache_key import Cache, CacheKey, explain_leaked_tracer, key_of, trace_with_snapshot, with_room
from .compat import (
    MISSING,
    ClosedJaxpr,
    Tracer,
    as_lowering,
    depends_on,
    instantiate_zeros,
    is_no_tangent,
    is_undefined_primal,
    jaxpr_as_fun,
    new_primitive,
    no_tangent,
)
from .components import Replay, is_exact
from .graph import NotScalarError
from .jaxpr import (
    PROGRAM,
    Solved,
    cse,
    is_fusable,
    is_inexact,
    is_solution,
    program_of,
    reads_of,
    replaced,
    specs_of,
    tangent_program,
    transposed_program,
    unsupported_primitives,
)

_FEW = 8  # numbers, that take XLA as long by themselves as to make an array of them


class Packed(eqx.Module):
    """A tree whose single numbers are one array, which a loop carries, and whose cotangents it adds up, at once.

    A `ScalarFunction` takes it for the tree. `others`: the tree without these numbers.
    """

    numbers: jax.Array  # (n,)
    others: Any
    structure: Any = eqx.field(static=True)

    @classmethod
    def of(cls, tree: Any, dtype: Any) -> Any:
        """The tree itself where it has no such numbers."""
        single = lambda x: eqx.is_array(x) and x.shape == () and x.dtype == dtype  # noqa: E731
        numbers, others = eqx.partition(tree, single)
        leaves, structure = jax.tree.flatten(numbers)
        return cls(jnp.stack(leaves), others, structure) if leaves else tree


def tree_of(x: Any) -> Any:
    """The tree that is `Packed`; any other as it is."""
    if not isinstance(x, Packed):
        return x
    return eqx.combine(jax.tree.unflatten(x.structure, [*x.numbers]), x.others)


class ScalarFunction:
    """A pure function at module level, as a decorator. It is traced once for each `CacheKey`, and evaluated by

    - `f(*args)`: LLVM or XLA, as one operation of JAX, also under `jax.jit`, `jax.grad` and `jax.vmap`;
    - `f.in_forward_mode(*args)`: the same, which with its derivative by `jax.jvp` or `jax.jacfwd` is one operation;
    - `f.numpy(*args)` and `f.numpy_jvp(args, directions)`: NumPy, with numbers, and without compiling;
    - `f.replay(part, arrays, components, memory)`: the trace that is under way, equation by equation.

    A function that calls a library (LAPACK, a loop, a sort) cannot be one operation: it is called as it is, and a
    warning names the call and the type of the first argument.
    """

    _solved: Callable[[CacheKey, Any], Solved | None] | None = None  # what the last result x solves, if anything

    def __init__(self, f: Callable[..., Any]):
        functools.update_wrapper(self, f)
        self.__wrapped__ = f
        self._programs = Cache()
        self._once = False

    @classmethod
    def once(cls, f: Callable[..., Any]) -> ScalarFunction:
        """For what a program calls once: LLVM compiles it five times sooner, and it takes five times as long."""
        function = cls(f)
        function._once = True
        return function

    def __call__(self, *args: Any) -> Any:
        numbers, program = self.program(*args)
        if program is None:
            with explain_leaked_tracer(_label(args[0])):
                return self.__wrapped__(*map(tree_of, args))
        return jax.tree.unflatten(program.structure, program(*numbers))

    def in_forward_mode(self, *args: Any) -> Any:
        """`f(*args)`, which with its derivative in forward mode is one operation."""
        numbers, program = self.program(*args)
        return self(*args) if program is None else jax.tree.unflatten(program.structure, program.forward(*numbers))

    def program(self, *args: Any) -> tuple[list[Any], Program | None]:
        """The numbers of the arguments, and the program of them; None where it cannot be one operation."""
        if MISSING is not None:
            return [], None
        label, (numbers, key) = _label(args[0]), key_of(*args)
        try:
            with explain_leaked_tracer(label):
                return numbers, self._programs.get(key, lambda: with_room(self._traced, key, label))
        except _CapturedTracerError:
            return numbers, None

    def _traced(self, key: CacheKey, label: str) -> Program | None:
        program, out = jaxpr_at(key, self.__wrapped__)
        inside = list(unsupported_primitives(program.jaxpr))
        if any(where for _, where in inside):
            names = dict.fromkeys(name for name, where in inside if where)
            _tell(
                label,
                " and ".join(f"`{name}`" for name in names),
                "cannot be part of one compiled function: evaluated operation by operation, these equations take about "
                "ten times as long, and their derivatives up to a thousand times. Functions of single numbers, "
                "jnp.where and entries at places known beforehand can be part of it",
            )
        fixed = frozenset(range(key.structure.children()[0].num_leaves))
        solved = self._solved and functools.partial(self._solved, key)
        structure = jax.tree.structure(out)
        return None if inside else Program(program, label, fixed, structure, once=self._once, solved=solved)

    def is_native(self, *args: Any) -> bool:
        """Whether LLVM makes a kernel of it for these, a call of which costs nothing to compile."""
        if not native.is_on() or jax.default_backend() != "cpu":
            return False
        _, program = self.program(*args)
        return program is not None and program.scalars is not None

    def is_numpy(self, *args: Any) -> bool:
        """Whether `numpy` evaluates it itself."""
        _, program = self.program(*args)
        return program is not None and program.numpy is not None

    def numpy(self, *args: Any) -> Any:
        """`f(*args)` of numbers, as arrays of NumPy; evaluated by JAX where it is no program of scalars."""
        numbers, program = self.program(*args)
        if program is None or program.numpy is None:
            return jax.device_get(self(*jax.tree.map(jnp.asarray, args)))
        return jax.tree.unflatten(program.structure, program.numpy(numbers))

    def numpy_jvp(self, args: Sequence[Any], directions: Sequence[Any]) -> Any:
        """The derivatives (..., d) of `f.numpy(*args)` along d directions: None, or arrays (..., d), by argument."""
        along = [
            dx
            for x, dx in zip(args, directions, strict=True)
            for dx in ([None] * len(jax.tree.leaves(x)) if dx is None else jax.tree.leaves(dx))
        ]
        places = [i for i, dx in enumerate(along) if dx is not None]
        moving = [np.asarray(along[i]) for i in places]
        numbers, program = self.program(*args)
        tangent = program and program.tangent(tuple(dx is not None for dx in along))
        if program is not None and tangent and tangent.numpy is not None:
            size = moving[0].shape[-1:]
            slopes = iter(tangent.numpy([*numbers, *moving], size))
            results = zip(tangent.moves, specs_of(program.out_avals), strict=True)
            slopes = [next(slopes) if m else np.zeros((*aval.shape, *size), aval.dtype) for m, aval in results]
            return jax.tree.unflatten(program.structure, slopes)
        leaves, structure = jax.tree.flatten(jax.tree.map(jnp.asarray, tuple(args)))
        of_moving = lambda *xs: self(*jax.tree.unflatten(structure, replaced(leaves, places, xs)))  # noqa: E731
        slope = lambda *dxs: jax.jvp(of_moving, tuple(leaves[i] for i in places), dxs)[1]  # noqa: E731
        return jax.device_get(jax.vmap(slope, in_axes=-1, out_axes=-1)(*moving))

    def replay(self, part: str, arrays: Any, components: Any, memory: dict[Any, Any]) -> Any:
        """One part of `f(arrays, components)`, a dict of trees of components, with exact zeros where there are any.

        In the `memory`, a dict, are equations that were evaluated: what does not depend on a direction is not evaluated
        anew for the next one. It belongs to one trace.
        """
        if MISSING is not None:
            return self.__wrapped__(arrays, components)[part]
        (numbers, key), row = key_of(arrays), jax.tree.leaves(components)  # of components only numbers are read
        dtype = jnp.result_type(*([x for x in row if not is_exact(x)] or [float]))
        key = key._replace(structure=jax.tree.structure((arrays, components)), types=(key.types, len(row), dtype))
        try:
            with explain_leaked_tracer(type(arrays).__name__):
                replay = self._programs.get(key, lambda: self._replay(key))
        except _CapturedTracerError:
            return self.__wrapped__(arrays, components)[part]
        row = [x if is_exact(x) or x.dtype == dtype else x.astype(dtype) for x in row]
        return replay(part, [*numbers, *row], memory)

    def _replay(self, key: CacheKey) -> Replay:
        types, n, dtype = key.types
        f, parts, leaves = trace_with_snapshot(self.__wrapped__), {}, []

        def results(*xs: Any) -> list[Any]:
            parts.update(f(*jax.tree.unflatten(key.structure, xs)))
            leaves[:] = jax.tree.leaves([*parts.values()])
            return [x for x in leaves if not is_exact(x)]

        program, _ = _jaxpr_of(results, [*specs_of(types), *[jax.ShapeDtypeStruct((), dtype)] * n])
        structures = {part: jax.tree.structure(value) for part, value in parts.items()}
        kept = [x if is_exact(x) else None for x in leaves]  # no tracer
        return Replay(cse(program) if is_fusable(program.jaxpr) else program, structures, kept)


class _CapturedTracerError(Exception):
    """The function reads a value of the trace that is under way, so that its program must not outlive that."""


def jaxpr_at(key: CacheKey, f: Callable[..., Any], *more: Any) -> tuple[ClosedJaxpr, Any]:
    """`f` of the arguments that a key is of, and of arrays of the types `more`, as a program and what it returns."""
    f, n = trace_with_snapshot(f), len(key.types)
    at = lambda *xs: f(*map(tree_of, jax.tree.unflatten(key.structure, xs[:n])), *xs[n:])  # noqa: E731
    return _jaxpr_of(at, specs_of([*key.types, *more]))


def _jaxpr_of(f: Callable[..., Any], specs: Sequence[Any]) -> tuple[ClosedJaxpr, Any]:
    program, out = program_of(f, *specs, return_shape=True)
    if any(isinstance(c, Tracer) for c in program.consts):
        raise _CapturedTracerError
    return program, out


def _label(system: Any) -> str:
    if isinstance(system, Packed):
        system = system.others
    return "A function" if hasattr(system, "dtype") else type(system).__name__


_told: set[tuple[str, str]] = set()


def _tell(label: str, what: str, why: str) -> None:
    """Warn of something in a description that costs time; once."""
    if (label, what) not in _told:
        _told.add((label, what))
        warnings.warn(f"{label}: its description uses {what}, which {why}.", UserWarning, stacklevel=2)


class Program:
    """A traced program, and the programs that follow from it, each made once.

    `loop_invariant`: places of the arguments that stay what they are while the program is called again and again, as
    the parameters of a system. `tangents`: places of those that are tangents; `linear`: of those in which all of it is
    linear; `moves`: which results of the program that it is a derivative of move. `structure`: of the results. `once`:
    whether it is called once. `is_reduced`: whether `cse` would find nothing in it. `values`: of one that gives values
    and then their tangents, the program of the values, and which of its inputs move. `axes_of`: of each output, the
    inputs whose leading axes it has in a batch; None for all. `solved(x)`: of one whose last result x, of this type,
    solves equations, what these are; None where they are not known any more.

    `source` is the program that is differentiated: in it what solves equations is still one equation.
    """

    _solved: Callable[[Any], Solved | None] | None = None

    def __init__(
        self,
        program: ClosedJaxpr,
        label: str = "A function",
        loop_invariant: frozenset[int] = frozenset(),
        structure: Any = None,
        tangents: frozenset[int] = frozenset(),
        linear: frozenset[int] = frozenset(),
        moves: tuple[bool, ...] = (),
        once: bool = False,
        is_reduced: bool = False,
        values: tuple[Program, tuple[bool, ...]] | None = None,
        axes_of: tuple[frozenset[int] | None, ...] = (),
        solved: Callable[[Any], Solved | None] | None = None,
    ):
        self.label, self.loop_invariant, self.structure, self.once = label, loop_invariant, structure, once
        self.tangents, self.linear, self.moves = tangents, linear, moves
        self.values, self.is_forward = values, values is not None
        self.source = self.program = program if is_reduced else cse(program, keeps_solutions=True)
        if any(map(is_solution, self.source.jaxpr.eqns)):
            self.program = cse(self.source)
        self.evaluate = jaxpr_as_fun(self.program)
        self.in_avals, self.out_avals = self.program.in_avals, self.program.out_avals
        self._solved = solved
        self.axes_of = axes_of or (None,) * len(self.out_avals)
        self.is_fusable = is_fusable(self.program.jaxpr)
        self.reads = reads_of(self.program.jaxpr)
        # Caches of each instance, since a cached method would keep the instance itself alive.
        cached = functools.lru_cache(maxsize=256)
        self.tangent, self.transposed = cached(self._tangent), cached(self._transposed)
        self.with_tangent = cached(self._with_tangent)
        self.batched, self.part, self.jitted = cached(self._batched), cached(self._part), cached(self._jitted)
        if self.is_solution:
            self.source = program_of(self, *specs_of(self.in_avals))

    @property
    def is_solution(self) -> bool:
        return self._solved is not None

    @functools.cached_property
    def solved(self) -> Solved | None:
        return self._solved and self._solved(self.out_avals[-1])

    def __call__(self, *leaves: Any) -> list[Any]:
        return _program_p.bind(*leaves, program=self, sizes=(), where=((),) * len(leaves))

    @functools.cached_property
    def forward(self) -> Program:
        """The same, whose derivatives are `with_tangent`."""
        program = copy.copy(self)
        program.is_forward = True
        return program

    def _tangent(self, moving: tuple[bool, ...]) -> Program:
        """(primals, tangents of those that move) -> tangents of the outputs that move."""
        return self._derivative(moving, with_values=False)

    def _with_tangent(self, moving: tuple[bool, ...]) -> Program:
        """The same, with the outputs before their tangents."""
        return self._derivative(moving, with_values=True)

    def _derivative(self, moving: tuple[bool, ...], with_values: bool) -> Program:
        n, places = len(moving), [i for i, m in enumerate(moving) if m]
        along = {i: n + j for j, i in enumerate(places)}
        program, moves = with_room(tangent_program, self.source, places, with_values)
        axes_of = [x and x | {along[i] for i in x if i in along} for x, m in zip(self.axes_of, moves, strict=True) if m]
        if with_values:
            axes_of = [*(frozenset(range(n)) if x is None else x for x in self.axes_of), *axes_of]
        linear = frozenset(along.values())
        return Program(
            program,
            self.label,
            self.loop_invariant | {along[i] for i in places if i in self.loop_invariant},
            tangents=linear if with_values else self.tangents | linear,
            linear=frozenset() if with_values else linear,
            moves=moves,
            once=self.once,
            is_reduced=True,
            values=(self, moving) if with_values else None,
            axes_of=tuple(axes_of),
        )

    def _transposed(self, linear: tuple[bool, ...]) -> Program:
        """(the other inputs, cotangents of the outputs) -> cotangents of the linear inputs."""
        places = [i for i, is_linear in enumerate(linear) if is_linear]
        fixed = [i for i, is_linear in enumerate(linear) if not is_linear]
        program = with_room(transposed_program, self.program, places)
        invariant = frozenset(j for j, i in enumerate(fixed) if i in self.loop_invariant)
        return Program(program, self.label, invariant, once=self.once, is_reduced=True)

    def _batched(self, sizes: tuple[int, ...], where: Where) -> Program:
        """The program over leading axes of these sizes, of which input i has those in `where[i]`."""
        avals = [
            a.update(shape=(*(n for n, h in zip(sizes, has, strict=True) if h), *a.shape))
            for a, has in zip(specs_of(self.in_avals), where, strict=True)
        ]
        f, out_where = lambda *xs: self.evaluate(*xs), self.out_where(where)
        axes = lambda d, where: [0 if has[d] else None for has in where]  # noqa: E731
        for d in reversed(range(len(sizes))):
            f = jax.vmap(f, tuple(axes(d, where)), axes(d, out_where), axis_size=sizes[d])
        return Program(program_of(f, *avals), self.label, once=self.once)

    def out_where(self, where: Where) -> Where:
        """Which of the leading axes each output has."""
        everywhere = (True,) * len(where[0]) if where else ()
        of_inputs = lambda places: tuple(any(where[i][d] for i in places) for d in range(len(everywhere)))  # noqa: E731
        return tuple(everywhere if places is None else of_inputs(places) for places in self.axes_of)

    def moved(self, moving: tuple[bool, ...]) -> tuple[bool, ...]:
        """Which outputs follow from any of the inputs that move."""
        return tuple(depends_on(self.program, [i for i, m in enumerate(moving) if m]))

    def _part(self, inputs: tuple[bool, ...], outputs: tuple[bool, ...]) -> Program:
        """The program of some outputs, which follow from these inputs alone."""
        specs, places = specs_of(self.in_avals), [i for i, is_one in enumerate(inputs) if is_one]
        zeros = [np.zeros(a.shape, a.dtype) for a in specs]

        def part(*xs):
            results = zip(self.evaluate(*replaced(zeros, places, xs)), outputs, strict=True)
            return [y for y, is_one in results if is_one]

        fixed = frozenset(j for j, i in enumerate(places) if i in self.loop_invariant)
        return Program(program_of(part, *[specs[i] for i in places]), self.label, fixed, once=self.once)

    def _jitted(self, sizes: tuple[int, ...], where: Where) -> Callable[..., list[Any]]:
        """The program over a batch, as a function that is compiled once for each kind of batch."""
        return jax.jit(functools.partial(_program_p.bind, program=self, sizes=sizes, where=where))

    @functools.cached_property
    def numpy(self) -> NumPyProgram | None:
        """The program for NumPy, where it can be written so."""
        return _if_scalar(NumPyProgram, self.program)

    @functools.cached_property
    def scalars(self) -> Scalars | None:
        """The program as a graph of scalars for machine code, where it can be written so."""
        try:
            return Scalars(self.program, self.once, bool(self.tangents))
        except NotScalarError as error:
            self._tell_not_scalar(error)
            return None

    @functools.cached_property
    def windows(self) -> Windows | None:
        """The program as windows of XLA, where it can be written so."""
        return _if_scalar(Windows, self.program)

    def groups(self, where: Where) -> tuple[tuple[int, ...], ...]:
        """The arguments as a native kernel takes them: many numbers of the same lanes are one array, since each
        argument takes XLA as long as some forty operations of a kernel; unless a loop had to make the array in each of
        its steps. What is not read is not passed, so that XLA need not compute it either."""
        groups: dict[Any, list[int]] = {}
        for i, (aval, has) in enumerate(zip(specs_of(self.in_avals), where, strict=True)):
            if self.reads[i]:
                together = aval.shape == () and (self.once or i in self.loop_invariant)
                groups.setdefault((aval.dtype, has) if together else i, []).append(i)
        apart = [[(i,) for i in group] if len(group) <= _FEW else [tuple(group)] for group in groups.values()]
        return tuple(group for each in apart for group in each)

    def target(self, sizes: tuple[int, ...], where: Where) -> str | None:
        """The name of the native kernel for a batch, where there can be one."""
        scalars = self.scalars if native.is_on() and 0 not in sizes else None
        try:
            return scalars.target(sizes, where, self.groups(where), self.out_where(where)) if scalars else None
        except NotScalarError as error:
            self._tell_not_scalar(error)
        except (RuntimeError, OSError, MemoryError) as error:  # LLVM's own are RuntimeError
            native.tell(f"LLVM fails at {self.label}: {type(error).__name__}: {str(error)[:300]}")
        return None

    def _tell_not_scalar(self, error: NotScalarError) -> None:
        _tell(self.label, f"{error}", "native kernels do not know: XLA does its work, three to ten times slower")


def _if_scalar(kind: Callable[[ClosedJaxpr], Any], program: ClosedJaxpr) -> Any:
    try:
        return kind(program)
    except NotScalarError:
        return None


# A call stands for a batch over leading axes `sizes`; input i has those of them that `where[i]` says, the outputs those
# of `Program.out_where`.


def _run(*args, program, sizes, where):
    return program.jitted(sizes, where)(*args)


def _abstract(*_, program, sizes, where):
    each = zip(program.out_avals, program.out_where(where), strict=True)
    return [a.update(shape=(*_present(sizes, has), *a.shape)) for a, has in each]


def _present(sizes, has):
    return tuple(n for n, is_there in zip(sizes, has, strict=True) if is_there)


def _parts(*, program, sizes, where):
    """For each program that it consists of: how many of the inputs it has, and its parameters."""
    whole = {"program": program, "sizes": sizes, "where": where}
    if not program.values:
        return [(len(where), whole)]
    values, moving = program.values
    n = len(moving)
    has = tuple(any(w[d] for w in where[:n]) for d in range(len(sizes)))
    of_values = {"sizes": _present(sizes, has), "where": tuple(_present(w, has) for w in where[:n])}
    return [(n, {"program": values} | of_values), (len(where), whole | {"program": values.tangent(moving)})]


def _jvp(primals, tangents, *, program, sizes, where):
    moving = tuple(
        reads and is_inexact(x) and not is_no_tangent(dx)
        for reads, x, dx in zip(program.reads, program.in_avals, tangents, strict=True)
    )
    shapes = _abstract(program=program, sizes=sizes, where=where)
    n, moved, outputs, slopes = len(shapes), (False,) * len(shapes), [], []
    if any(moving):
        tangent = (program.with_tangent if program.is_forward else program.tangent)(moving)
        moved = tangent.moves
        if any(moved):
            along, places = zip(*[(dx, w) for dx, m, w in zip(tangents, moving, where, strict=True) if m], strict=True)
            slopes = _program_p.bind(*primals, *along, program=tangent, sizes=sizes, where=(*where, *places))
            outputs, slopes = (slopes[:n], slopes[n:]) if tangent.values else ([], slopes)
    outputs = outputs or _program_p.bind(*primals, program=program, sizes=sizes, where=where)
    each = iter(slopes)
    return outputs, [next(each) if m else no_tangent(aval) for m, aval in zip(moved, shapes, strict=True)]


def _transpose(cotangents, *args, program, sizes, where):
    asked = linear = tuple(map(is_undefined_primal, args))
    if all(i in program.linear for i, is_asked in enumerate(asked) if is_asked):
        # One transpose for whichever of the tangents are constant: a loop asks for some before it asks for all.
        linear = tuple(i in program.linear for i in range(len(args)))

    def at_one_place(ct, has):
        for d, (n, is_there) in enumerate(zip(sizes, has, strict=True)):
            if not is_there:  # of what all members share, the cotangent counts once
                ct = jnp.expand_dims(ct, d)
                ct = jnp.pad(ct, [(0, n - 1 if axis == d else 0) for axis in range(ct.ndim)])
        return ct

    known = [(x, w) for x, w, is_linear in zip(args, where, linear, strict=True) if not is_linear]
    results = iter(
        _program_p.bind(
            *(x for x, _ in known),
            *map(at_one_place, map(instantiate_zeros, cotangents), program.out_where(where)),
            program=program.transposed(linear),
            sizes=sizes,
            where=(*(w for _, w in known), *((True,) * len(sizes),) * len(cotangents)),
        )
    )

    def over_missing(ct, has):
        axes = tuple(d for d, h in enumerate(has) if not h)
        return ct.sum(axes) if axes else ct

    cts = [next(results) if is_linear else None for is_linear in linear]
    return [over_missing(ct, w) if is_asked else None for ct, w, is_asked in zip(cts, where, asked, strict=True)]


def _batch(args, axes, *, program, sizes, where):
    size = next(x.shape[axis] for x, axis in zip(args, axes, strict=True) if axis is not None)
    args = [x if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(args, axes, strict=True)]
    moving = tuple(axis is not None for axis in axes)
    if any(moving[i] for i in program.tangents):
        # Tangents are a batch together: the kernel of a loop serves what is before it too, where fewer of them move.
        args = [
            jnp.broadcast_to(x, (size, *x.shape)) if i in program.tangents and not m else x
            for i, (x, m) in enumerate(zip(args, moving, strict=True))
        ]
        moving = tuple(m or i in program.tangents for i, m in enumerate(moving))
    moves = program.moved(moving)
    if any(program.axes_of):  # values beside tangents remain shared unless any of what they follow from is not
        where = tuple((m, *w) for m, w in zip(moving, where, strict=True))
        outputs = _program_p.bind(*args, program=program, sizes=(size, *sizes), where=where)
        return outputs, [0 if has[0] else None for has in program.out_where(where)]
    if any(moves) and not all(moves) and not all(moving):  # what follows from shared inputs alone remains shared
        results = {}
        for is_moved in (False, True):
            inputs = tuple(is_moved or not m for m in moving)
            part = program.part(inputs, tuple(m == is_moved for m in moves))
            each = zip(args, moving, where, inputs, strict=True)
            args_of_part, in_batch = zip(*[(x, (m, *w) if is_moved else w) for x, m, w, is_one in each if is_one])
            shape = (size, *sizes) if is_moved else sizes
            results[is_moved] = iter(_program_p.bind(*args_of_part, program=part, sizes=shape, where=in_batch))
        return [next(results[m]) for m in moves], [0 if m else None for m in moves]
    where = tuple((m, *w) for m, w in zip(moving, where, strict=True))
    outputs = _program_p.bind(*args, program=program, sizes=(size, *sizes), where=where)
    return outputs, [0] * len(outputs)


def _inlined(*args, program, sizes, where):
    return (program.batched(sizes, where) if sizes else program).evaluate(*args)


def _on_gpu(*args, program, sizes, where):
    if program.is_fusable and 0 not in sizes and program.windows and not program.windows.is_long:
        return program.windows(args, sizes, where, program.out_where(where))
    return _inlined(*args, program=program, sizes=sizes, where=where)


def _by_xla(*args, program, sizes, where):
    out_where = program.out_where(where)
    if in_chunks := chunks_of(sizes):
        bind = functools.partial(_program_p.bind, program=program, sizes=in_chunks, where=where)
        outputs = _abstract(program=program, sizes=sizes, where=where)
        return one_chunk_at_a_time(bind, args, outputs, in_chunks[0], [w[0] for w in where], [w[0] for w in out_where])
    if program.is_fusable and pays_as_windows(program.program, sizes) and program.windows:
        return program.windows(args, sizes, where, out_where)
    program = program.batched(sizes, where) if sizes else program
    if not program.is_fusable or 0 in sizes:
        return program.evaluate(*args)
    return as_one_function(program.program, args)


def _by_kernel(*args, program, sizes, where, target):
    groups = [[args[i] for i in group] for group in program.groups(where)]
    outputs = specs_of(_abstract(program=program, sizes=sizes, where=where))
    return jax.ffi.ffi_call(target, outputs)(*(jnp.stack(xs, axis=-1) if len(xs) > 1 else xs[0] for xs in groups))


def _lower_on_cpu(context, *args, program, sizes, where):
    target = with_room(program.target, sizes, where)
    rule = _by_xla if target is None else functools.partial(_by_kernel, target=target)
    return as_lowering(rule)(context, *args, program=program, sizes=sizes, where=where)


if MISSING is None:
    _program_p = new_primitive(
        PROGRAM,
        evaluate=_run,
        shapes=_abstract,
        jvp=_jvp,
        transpose=_transpose,
        batch=_batch,
        traced=_inlined,
        lower_on_cpu=_lower_on_cpu,
        traced_on_gpu=_on_gpu,
        parts=_parts,
    )
