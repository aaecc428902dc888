"""A function of scalars as one compiled program, with the programs of its derivatives and batches.

A right-hand side written in scalars is thousands of tiny operations. XLA splits them into many kernels and repeats
operations in each kernel: a few times for the value, hundreds of times for derivatives. Here the function is one
primitive of JAX (`primitive`), whose derivatives, transposes and batches are also programs of this kind. Each is traced
once and compiled as one function, by LLVM (`backends.native`) or by XLA (`backends.xla`). Measured with XLA on the
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

from .backends import native
from .backends.native import BatchMask, Scalars
from .backends.numpy import NumPyProgram
from .backends.xla import Windows
from .compat import ClosedJaxpr, dependencies, jaxpr_as_fun
from .graph import NotScalarError
from .jaxpr import (
    Solved,
    cse,
    is_fusable,
    is_solution,
    program_of,
    reads_of,
    specs_of,
    tangent_program,
    transposed_program,
)
from .primitive import program_p

_FEW = 8  # numbers: for XLA, this many separate arguments cost as much as making an array of them

_warned: set[tuple[str, str]] = set()


def warn_once(label: str, what: str, why: str) -> None:
    """Warn once about a property of a system that costs time."""
    if (label, what) not in _warned:
        _warned.add((label, what))
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
        structure: Any = None,
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
        self.in_avals, self.out_avals = self.program.in_avals, self.program.out_avals
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
            native.tell(f"LLVM fails at {self.label}: {type(error).__name__}: {str(error)[:300]}")
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
