"""A function of scalars as one compiled program, with the programs of its derivatives and batches.

A right-hand side written in scalars is thousands of tiny operations. XLA splits them into many kernels and repeats
operations in each kernel: a few times for the value, hundreds of times for derivatives. Here the function is one
primitive of JAX (`program_p`), whose derivatives, transposes and batches are also programs of this kind. Each is traced
once and compiled as one function, by LLVM (`native`) or by XLA (`xla`). Measured with XLA on the
nonlinear bicycle (float64, one thread, jax 0.10.2): 8.6 -> 0.9 us for an evaluation inside a loop, 3000 -> 4.5 us for
its directional derivative, 2450 -> 17 us for its reverse derivative.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from . import native
from .compat import (
    ClosedJaxpr,
    as_lowering,
    dependencies,
    instantiate_zeros,
    is_no_tangent,
    is_undefined_primal,
    jaxpr_as_fun,
    new_primitive,
    no_tangent,
    types_of,
)
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
    specs_of,
    tangent_program,
    transposed_program,
)
from .native import BatchMask, Scalars, Sizes
from .source import NumPyProgram
from .xla import Windows, as_one_function, chunks_of, one_chunk_at_a_time, pays_as_windows

_FEW = 8  # numbers: for XLA, this many separate arguments cost as much as making an array of them


@functools.cache
def warn_once(label: str, what: str, why: str) -> None:
    """Warn once about a property of a system that costs time."""
    warnings.warn(f"{label}: its description uses {what}, which {why}.", UserWarning, stacklevel=2)


@dataclasses.dataclass(frozen=True)
class ArgumentRoles:
    """Indices of the arguments of a program that have a special role.

    - `loop_invariant`: they do not change between calls in a loop, such as the parameters of a system.
    - `tangents`: they are tangents.
    - `linear`: the whole program is linear in them.
    """

    loop_invariant: frozenset[int] = frozenset()
    tangents: frozenset[int] = frozenset()
    linear: frozenset[int] = frozenset()


@dataclasses.dataclass(frozen=True)
class Derived:
    """How a program is derived from an original program by differentiation in forward mode.

    - `differentiated`: for each argument of the original program, whether it is differentiated.
    - `has_tangent`: for each result of the original program, whether it has a tangent.
    - `values`: the original program, if its results precede their tangents; else None.
    """

    differentiated: tuple[bool, ...] = ()
    has_tangent: tuple[bool, ...] = ()
    values: Program | None = None


class Program:
    """A traced program, and the programs that are derived from it, each made once.

    - `program`, `source`: the jaxpr, and the one that is differentiated. In `source`, a solve of linear equations is
        still one equation.
    - `roles`: of its arguments.
    - `label`: the system's name, for warnings.
    - `structure`: the tree of the results.
    - `compile_cheaply`: whether it is called only once, so that fast compilation matters more than speed.
    - `is_reduced`: whether `cse` has nothing to remove.
    - `derived`: how it was derived, if it is a derivative.
    - `solved`: x -> the equations that the last result x of this type solves, or None if they are not known.
    """

    _solved: Callable[[Any], Solved | None] | None = None

    def __init__(
        self,
        program: ClosedJaxpr,
        roles: ArgumentRoles = ArgumentRoles(),
        *,
        label: str = "A function",
        structure: PyTree = None,
        compile_cheaply: bool = False,
        is_reduced: bool = False,
        derived: Derived = Derived(),
        solved: Callable[[Any], Solved | None] | None = None,
    ):
        self.roles, self.label, self.structure = roles, label, structure
        self.compile_cheaply, self.derived = compile_cheaply, derived
        self.is_forward = derived.values is not None
        # A solve stays one equation in `source`. Differentiating its written-out steps would take 1.7 times as many
        # operations for each direction (`LinearSolution`).
        self.source = self.program = program if is_reduced else cse(program, keeps_solutions=True)
        if any(map(is_solution, self.source.jaxpr.eqns)):
            self.program = cse(self.source)
        self.evaluate = jaxpr_as_fun(self.program)
        self.in_avals, self.out_avals = types_of(self.program)
        self._solved = solved
        self.dependencies = dependencies(self.program)
        self.is_fusable = is_fusable(self.program.jaxpr)
        self.reads = reads_of(self.program.jaxpr)
        # Caches for each instance: a cached method would keep the instance alive.
        cached = functools.lru_cache(maxsize=256)
        self.transposed = cached(self._transposed)
        self.tangent, self.with_tangent = (cached(functools.partial(self._derivative, x)) for x in (False, True))
        self.batched, self.jitted = cached(self._batched), cached(self._jitted)
        if self.is_solution:
            self.source = program_of(self, *specs_of(self.in_avals))

    @property
    def is_solution(self) -> bool:
        return self._solved is not None

    @functools.cached_property
    def solved(self) -> Solved | None:
        return self._solved and self._solved(self.out_avals[-1])

    def __call__(self, *leaves: Any) -> list[Any]:
        return program_p.bind(*leaves, program=self, sizes=(), batch_mask=((),) * len(leaves))

    @functools.cached_property
    def forward(self) -> Program:
        """The same program, whose derivatives are `with_tangent`."""
        # The shallow copy shares the caches of derivatives and batches, so nothing is traced twice.
        program = copy.copy(self)
        program.is_forward = True
        return program

    def _derivative(self, with_values: bool, differentiated: tuple[bool, ...]) -> Program:
        """(primals, tangents of the differentiated inputs) -> tangents of the outputs that have one. `with_values`:
        preceded by all outputs."""
        n, places = len(differentiated), [i for i, d in enumerate(differentiated) if d]
        tangent_of = {i: n + j for j, i in enumerate(places)}
        program, has_tangent = tangent_program(self.source, places, with_values)
        tangents, invariant = frozenset(tangent_of.values()), self.roles.loop_invariant
        roles = ArgumentRoles(
            # The tangent of a parameter does not change in a loop either.
            loop_invariant=invariant | {tangent_of[i] for i in places if i in invariant},
            tangents=tangents if with_values else self.roles.tangents | tangents,
            # With values, the results are not linear: the values do not scale with the tangents.
            linear=frozenset() if with_values else tangents,
        )
        return Program(
            program,
            roles,
            label=self.label,
            compile_cheaply=self.compile_cheaply,
            is_reduced=True,
            derived=Derived(differentiated, has_tangent, self if with_values else None),
        )

    def _transposed(self, linear: tuple[bool, ...]) -> Program:
        """(the other inputs, cotangents of the outputs) -> cotangents of the linear inputs."""
        places = [i for i, is_linear in enumerate(linear) if is_linear]
        fixed = [i for i, is_linear in enumerate(linear) if not is_linear]
        program = transposed_program(self.program, places)
        invariant = frozenset(j for j, i in enumerate(fixed) if i in self.roles.loop_invariant)
        roles = ArgumentRoles(loop_invariant=invariant)
        return Program(program, roles, label=self.label, compile_cheaply=self.compile_cheaply, is_reduced=True)

    def _batched(self, sizes: tuple[int, ...], batch_mask: BatchMask) -> Program:
        """The program over leading axes of these sizes. Input i has the axes that `batch_mask[i]` marks."""
        avals = [
            a.update(shape=(*(n for n, is_in in zip(sizes, mask, strict=True) if is_in), *a.shape))
            for a, mask in zip(specs_of(self.in_avals), batch_mask, strict=True)
        ]
        out_batch_mask = self.out_batch_mask(batch_mask)

        def evaluate(*xs: Any) -> list[Any]:
            return self.evaluate(*xs)

        def axes(d: int, masks: BatchMask) -> Sequence[int | None]:
            return [0 if mask[d] else None for mask in masks]

        f = evaluate
        for d in reversed(range(len(sizes))):
            f = jax.vmap(f, tuple(axes(d, batch_mask)), axes(d, out_batch_mask), axis_size=sizes[d])
        return Program(program_of(f, *avals), label=self.label, compile_cheaply=self.compile_cheaply)

    def out_batch_mask(self, batch_mask: BatchMask) -> BatchMask:
        """Which of the leading axes each output has: those of the inputs on which it depends."""
        axes = range(len(batch_mask[0]) if batch_mask else 0)
        return tuple(tuple(any(batch_mask[i][d] for i in places) for d in axes) for places in self.dependencies)

    def _jitted(self, sizes: tuple[int, ...], batch_mask: BatchMask) -> Callable[..., list[Any]]:
        """The program over a batch, as a function that is compiled once for each kind of batch."""
        return jax.jit(functools.partial(program_p.bind, program=self, sizes=sizes, batch_mask=batch_mask))

    @functools.cached_property
    def numpy(self) -> NumPyProgram | None:
        """The program for NumPy, or None if NumPy cannot evaluate it."""
        return _if_scalar(NumPyProgram, self.program)

    @functools.cached_property
    def scalars(self) -> Scalars | None:
        """The program as a graph of scalars for machine code, or None if this is not possible."""
        try:
            return Scalars(self.program, self.compile_cheaply, bool(self.roles.tangents))
        except NotScalarError as error:
            self._warn_not_scalar(error)
            return None

    @functools.cached_property
    def windows(self) -> Windows | None:
        """The program as windows of XLA, or None if this is not possible."""
        return _if_scalar(Windows, self.program)

    def groups(self, batch_mask: BatchMask) -> tuple[tuple[int, ...], ...]:
        """Groups of arguments for a native kernel. Many scalars with the same batch axes are passed as one array,
        because XLA needs as long for one argument as for about forty operations of a kernel. Scalars that a loop
        changes are not grouped, because the array would be made in every step. Unused arguments are not passed, so XLA
        does not compute them."""
        groups: dict[Any, list[int]] = {}
        for i, (aval, mask) in enumerate(zip(specs_of(self.in_avals), batch_mask, strict=True)):
            if self.reads[i]:
                together = aval.shape == () and (self.compile_cheaply or i in self.roles.loop_invariant)
                groups.setdefault((aval.dtype, mask) if together else i, []).append(i)
        apart = [[(i,) for i in group] if len(group) <= _FEW else [tuple(group)] for group in groups.values()]
        return tuple(group for each in apart for group in each)

    def target(self, sizes: tuple[int, ...], batch_mask: BatchMask) -> str | None:
        """The name of the native kernel for a batch, or None if there is none."""
        scalars = self.scalars if native.is_on() and 0 not in sizes else None
        try:
            if scalars is None:
                return None
            return scalars.target(sizes, batch_mask, self.groups(batch_mask), self.out_batch_mask(batch_mask))
        except NotScalarError as error:
            self._warn_not_scalar(error)
        except (RuntimeError, OSError, MemoryError) as error:  # LLVM raises RuntimeError
            native.warn_not_native(f"LLVM fails at {self.label}: {type(error).__name__}: {str(error)[:300]}")
        return None

    def _warn_not_scalar(self, error: NotScalarError) -> None:
        warn_once(
            self.label, f"{error}", "native kernels do not support. XLA compiles it instead, three to ten times slower"
        )


def _if_scalar(kind: Callable[[ClosedJaxpr], Any], program: ClosedJaxpr) -> Any:
    try:
        return kind(program)
    except NotScalarError:
        return None


# The primitive of JAX that calls a `Program`: its rules for derivatives and batches, and what XLA executes. A call
# represents a batch over leading axes of the given `sizes`. Input i has the axes that `batch_mask[i]` marks, and the
# outputs have those of `Program.out_batch_mask`.


def _abstract(*_, program: Program, sizes: Sizes, batch_mask: BatchMask):
    masks = zip(program.out_avals, program.out_batch_mask(batch_mask), strict=True)
    return [a.update(shape=(*_present(sizes, mask), *a.shape)) for a, mask in masks]


def _present(sizes: Sizes, mask: tuple[bool, ...]):
    return tuple(n for n, is_there in zip(sizes, mask, strict=True) if is_there)


def _separate_calls(*, program: Program, sizes: Sizes, batch_mask: BatchMask):
    """The calls of which a call consists: for each, the number of its inputs, and its parameters. A program of values
    and tangents consists of the program of the values and the one of the tangents."""
    whole = {"program": program, "sizes": sizes, "batch_mask": batch_mask}
    values, differentiated = program.derived.values, program.derived.differentiated
    if not values:
        return [(len(batch_mask), whole)]
    n = len(differentiated)
    present = tuple(any(mask[d] for mask in batch_mask[:n]) for d in range(len(sizes)))
    mask_of_values = tuple(_present(mask, present) for mask in batch_mask[:n])
    of_values = {"program": values, "sizes": _present(sizes, present), "batch_mask": mask_of_values}
    return [(n, of_values), (len(batch_mask), whole | {"program": values.tangent(differentiated)})]


def _jvp(primals: Sequence[Array], tangents: Sequence[Array], *, program: Program, sizes: Sizes, batch_mask: BatchMask):
    # The tangent of an argument that is not read has no effect. Without it, fewer different derivatives are compiled.
    differentiated = tuple(
        reads and is_inexact(x) and not is_no_tangent(dx)
        for reads, x, dx in zip(program.reads, program.in_avals, tangents, strict=True)
    )
    shapes = _abstract(program=program, sizes=sizes, batch_mask=batch_mask)
    n, has_tangent, outputs, slopes = len(shapes), (False,) * len(shapes), [], []
    if any(differentiated):
        derivative = (program.with_tangent if program.is_forward else program.tangent)(differentiated)
        has_tangent = derivative.derived.has_tangent
        if any(has_tangent):
            pairs = zip(tangents, differentiated, batch_mask, strict=True)
            given, masks = zip(*[(dx, mask) for dx, d, mask in pairs if d], strict=True)
            masks = (*batch_mask, *masks)
            slopes = program_p.bind(*primals, *given, program=derivative, sizes=sizes, batch_mask=masks)
            outputs, slopes = (slopes[:n], slopes[n:]) if derivative.derived.values else ([], slopes)
    outputs = outputs or program_p.bind(*primals, program=program, sizes=sizes, batch_mask=batch_mask)
    each = iter(slopes)
    return outputs, [next(each) if has else no_tangent(aval) for has, aval in zip(has_tangent, shapes, strict=True)]


def _transpose(cotangents: Sequence[Array], *args, program: Program, sizes: Sizes, batch_mask: BatchMask):
    asked = linear = tuple(map(is_undefined_primal, args))
    if all(i in program.roles.linear for i, is_asked in enumerate(asked) if is_asked):
        # Use one transpose, whichever tangents are constant: a loop first needs some of the cotangents, later all.
        linear = tuple(i in program.roles.linear for i in range(len(args)))

    def at_one_place(ct: Array, mask: tuple[bool, ...]):
        for d, (n, is_there) in enumerate(zip(sizes, mask, strict=True)):
            if not is_there:  # the cotangent of a value that all members share counts once
                ct = jnp.expand_dims(ct, d)
                ct = jnp.pad(ct, [(0, n - 1 if axis == d else 0) for axis in range(ct.ndim)])
        return ct

    known = [(x, mask) for x, mask, is_linear in zip(args, batch_mask, linear, strict=True) if not is_linear]
    results = iter(
        program_p.bind(
            *(x for x, _ in known),
            *map(at_one_place, map(instantiate_zeros, cotangents), program.out_batch_mask(batch_mask)),
            program=program.transposed(linear),
            sizes=sizes,
            batch_mask=(*(mask for _, mask in known), *((True,) * len(sizes),) * len(cotangents)),
        )
    )

    def over_missing(ct: Array, mask: tuple[bool, ...]):
        axes = tuple(d for d, is_there in enumerate(mask) if not is_there)
        return ct.sum(axes) if axes else ct

    cts: list[Any] = [next(results) if is_linear else None for is_linear in linear]
    each = zip(cts, batch_mask, asked, strict=True)
    return [over_missing(ct, mask) if is_asked else None for ct, mask, is_asked in each]


def _batch(args: Sequence[Array], axes: Sequence[int | None], *, program: Program, sizes: Sizes, batch_mask: BatchMask):
    size = next(x.shape[axis] for x, axis in zip(args, axes, strict=True) if axis is not None)
    args = [x if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(args, axes, strict=True)]
    is_batched, tangents = tuple(axis is not None for axis in axes), program.roles.tangents
    if any(is_batched[i] for i in tangents):
        # Batch all tangents together: the kernel in a loop can then be used before the loop too, where fewer tangents
        # are batched.
        args = [
            jnp.broadcast_to(x, (size, *x.shape)) if i in tangents and not is_batched[i] else x
            for i, x in enumerate(args)
        ]
        is_batched = tuple(b or i in tangents for i, b in enumerate(is_batched))
    batch_mask = tuple((b, *mask) for b, mask in zip(is_batched, batch_mask, strict=True))
    outputs = program_p.bind(*args, program=program, sizes=(size, *sizes), batch_mask=batch_mask)
    return outputs, [0 if mask[0] else None for mask in program.out_batch_mask(batch_mask)]


def _inlined(*args, program: Program, sizes: Sizes, batch_mask: BatchMask):
    return (program.batched(sizes, batch_mask) if sizes else program).evaluate(*args)


def _on_gpu(*args, program: Program, sizes: Sizes, batch_mask: BatchMask):
    if program.is_fusable and 0 not in sizes and program.windows and not program.windows.is_long:
        return program.windows(args, sizes, batch_mask, program.out_batch_mask(batch_mask))
    return _inlined(*args, program=program, sizes=sizes, batch_mask=batch_mask)


def _by_xla(*args, program: Program, sizes: Sizes, batch_mask: BatchMask):
    out_batch_mask = program.out_batch_mask(batch_mask)
    if in_chunks := chunks_of(sizes):
        bind = functools.partial(program_p.bind, program=program, sizes=in_chunks, batch_mask=batch_mask)
        outputs = _abstract(program=program, sizes=sizes, batch_mask=batch_mask)
        in_batch, out_in_batch = [mask[0] for mask in batch_mask], [mask[0] for mask in out_batch_mask]
        return one_chunk_at_a_time(bind, args, outputs, in_chunks[0], in_batch, out_in_batch)
    if program.is_fusable and pays_as_windows(program.program, sizes) and program.windows:
        return program.windows(args, sizes, batch_mask, out_batch_mask)
    program = program.batched(sizes, batch_mask) if sizes else program
    if not program.is_fusable or 0 in sizes:
        return program.evaluate(*args)
    return as_one_function(program.program, args)


def _lower_on_cpu(context: object, *args, program: Program, sizes: Sizes, batch_mask: BatchMask):
    target: Any = program.target(sizes, batch_mask)

    def by_kernel(*args, **_):
        # The kernel reads its arguments in this order: `Program.target` passes the same groups.
        groups = [[args[i] for i in group] for group in program.groups(batch_mask)]
        outputs = specs_of(_abstract(program=program, sizes=sizes, batch_mask=batch_mask))
        return jax.ffi.ffi_call(target, outputs)(*(jnp.stack(xs, axis=-1) if len(xs) > 1 else xs[0] for xs in groups))

    rule = _by_xla if target is None else by_kernel
    return as_lowering(rule)(context, *args, program=program, sizes=sizes, batch_mask=batch_mask)


program_p: Any = new_primitive(
    PROGRAM,
    evaluate=lambda *args, program, sizes, batch_mask: program.jitted(sizes, batch_mask)(*args),
    shapes=_abstract,
    jvp=_jvp,
    transpose=_transpose,
    batch=_batch,
    traced=_inlined,
    lower_on_cpu=_lower_on_cpu,
    traced_on_gpu=_on_gpu,
    separate_calls=_separate_calls,
)
