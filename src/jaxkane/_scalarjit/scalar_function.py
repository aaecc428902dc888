"""A decorator that makes a function of scalars one operation of JAX. Independent of mechanics.

The function is traced once for each `CacheKey` and kept as a `Program`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import PyTree

from . import native
from .cache import Cache
from .cache_key import CacheKey, explain_leaked_tracer, key_of, trace_with_snapshot
from .compat import ClosedJaxpr, Tracer
from .components import Replay, is_exact
from .jaxpr import Solved, cse, is_fusable, program_of, replaced, specs_of, unsupported_primitives
from .program import ArgumentRoles, Program, warn_once


class Packed(eqx.Module):
    """A tree whose scalars are packed in one array, which a loop carries as one value. Its cotangents are also summed
    as one array.

    - `numbers` (n,): the scalars.
    - `others`: the tree without them.

    A `ScalarFunction` unpacks it.
    """

    numbers: jax.Array  # (n,)
    others: Any
    structure: Any = eqx.field(static=True)

    @classmethod
    def of(cls, tree: PyTree, dtype: DTypeLike) -> PyTree:
        """The packed tree, or the tree itself if it has no such scalars."""

        def is_scalar(x: PyTree) -> bool:
            return eqx.is_array(x) and x.shape == () and x.dtype == dtype

        numbers, others = eqx.partition(tree, is_scalar)
        leaves, structure = jax.tree.flatten(numbers)
        return cls(jnp.stack(leaves), others, structure) if leaves else tree


def tree_of(x: PyTree) -> PyTree:
    """The tree of a `Packed`; any other value unchanged."""
    if not isinstance(x, Packed):
        return x
    return eqx.combine(jax.tree.unflatten(x.structure, [*x.numbers]), x.others)


class ScalarFunction:
    """A pure function at module level, used as a decorator. It is traced once for each `CacheKey` and evaluated by

    - `f(*args)`: LLVM or XLA, as one operation of JAX, also under `jax.jit`, `jax.grad` and `jax.vmap`;
    - `f.in_forward_mode(*args)`: the same; value and derivative by `jax.jvp` or `jax.jacfwd` are one operation;
    - `f.numpy(*args)` and `f.numpy_jvp(args, directions)`: NumPy, for concrete numbers, without compiling;
    - `f.replay(quantity, arrays, components, memory)`: the current trace, equation by equation.

    A function that calls a library (LAPACK, a loop, a sort) cannot be one operation. It is then called unchanged, and a
    warning names the call and the type of the first argument.
    """

    # the equations that the last result x solves, or None
    _solved: Callable[[CacheKey, Any], Solved | None] | None = None

    def __init__(self, f: Callable[..., Any]):
        functools.update_wrapper(self, f)
        self.__wrapped__ = f
        self._programs = Cache(programs=True)
        self._compile_cheaply = False

    @classmethod
    def compile_cheaply(cls, f: Callable[..., Any]) -> ScalarFunction:
        """For a function that a program calls once, and not in a loop: LLVM compiles it five times faster, but it runs
        five times slower."""
        function = cls(f)
        function._compile_cheaply = True
        return function

    def __call__(self, *args: PyTree) -> PyTree:
        numbers, program = self.program(*args)
        if program is None:
            with explain_leaked_tracer(_label(args[0])):
                return self.__wrapped__(*map(tree_of, args))
        return jax.tree.unflatten(program.structure, program(*numbers))

    def in_forward_mode(self, *args: PyTree) -> PyTree:
        """`f(*args)`; the value and its derivative in forward mode are one operation."""
        numbers, program = self.program(*args)
        return self(*args) if program is None else jax.tree.unflatten(program.structure, program.forward(*numbers))

    def program(self, *args: PyTree) -> tuple[list[Any], Program | None]:
        """The numbers of the arguments, and their program; None if it cannot be one operation."""
        label, (numbers, key) = _label(args[0]), key_of(*args)
        try:
            with explain_leaked_tracer(label):
                return numbers, self._programs.get(key, lambda: self._traced(key, label))
        except _CapturedTracerError:
            return numbers, None

    def _traced(self, key: CacheKey, label: str) -> Program | None:
        program, out = jaxpr_at(key, self.__wrapped__)
        inside = list(unsupported_primitives(program.jaxpr))
        if any(is_of_system for _, is_of_system in inside):
            names = dict.fromkeys(name for name, is_of_system in inside if is_of_system)
            warn_once(
                label,
                " and ".join(f"`{name}`" for name in names),
                "cannot be part of one compiled function. The equations are evaluated operation by operation, which "
                "takes about ten times as long, and up to a thousand times for derivatives. Use functions of single "
                "numbers, jnp.where and constant indices instead",
            )
        if inside:
            return None
        return Program(
            program,
            ArgumentRoles(loop_invariant=frozenset(range(key.structure.children()[0].num_leaves))),
            label=label,
            structure=jax.tree.structure(out),
            compile_cheaply=self._compile_cheaply,
            solved=self._solved and functools.partial(self._solved, key),
        )

    def is_native(self, *args: PyTree) -> bool:
        """Whether LLVM makes a kernel for these arguments, so that an additional call needs no compilation."""
        if not native.is_on() or jax.default_backend() != "cpu":
            return False
        _, program = self.program(*args)
        return program is not None and program.scalars is not None

    def is_numpy(self, *args: PyTree) -> bool:
        """Whether `numpy` evaluates the program itself."""
        _, program = self.program(*args)
        return program is not None and program.numpy is not None

    def numpy(self, *args: PyTree) -> PyTree:
        """`f(*args)` for concrete numbers, as NumPy arrays. JAX evaluates it if it is not a program of scalars."""
        numbers, program = self.program(*args)
        if program is None or program.numpy is None:
            return jax.device_get(self(*jax.tree.map(jnp.asarray, args)))
        return jax.tree.unflatten(program.structure, program.numpy(numbers))

    def numpy_jvp(self, args: Sequence[Any], directions: Sequence[Any]) -> PyTree:
        """The derivatives (..., d) of `f.numpy(*args)` along d directions.

        **Arguments:**

        - `args`: the arguments of `f`.
        - `directions`: for each argument, arrays (..., d) or None for no change.
        """
        tangents = [
            dx
            for x, dx in zip(args, directions, strict=True)
            for dx in ([None] * len(jax.tree.leaves(x)) if dx is None else jax.tree.leaves(dx))
        ]
        differentiated = tuple(dx is not None for dx in tangents)
        places = [i for i, d in enumerate(differentiated) if d]
        given = [np.asarray(tangents[i]) for i in places]
        numbers, program = self.program(*args)
        derivative = program and program.tangent(differentiated)
        if program is not None and derivative and derivative.numpy is not None:
            size = given[0].shape[-1:]
            slopes = iter(derivative.numpy([*numbers, *given], size))
            results = zip(derivative.derived.has_tangent, specs_of(program.out_avals), strict=True)
            slopes = [next(slopes) if has else np.zeros((*aval.shape, *size), aval.dtype) for has, aval in results]
            return jax.tree.unflatten(program.structure, slopes)
        leaves, structure = jax.tree.flatten(jax.tree.map(jnp.asarray, tuple(args)))

        def of_differentiated(*xs: PyTree) -> PyTree:
            return self(*jax.tree.unflatten(structure, replaced(leaves, places, xs)))

        def slope(*dxs: PyTree) -> PyTree:
            return jax.jvp(of_differentiated, tuple(leaves[i] for i in places), dxs)[1]

        return jax.device_get(jax.vmap(slope, in_axes=-1, out_axes=-1)(*given))

    def replay(self, quantity: str, arrays: PyTree, components: PyTree, memory: dict[Any, Any]) -> PyTree:
        """One of the named quantities that `f(arrays, components)` returns, a dict of trees of components. Exact zeros
        are preserved.

        `memory`: a dict of evaluated equations. Equations that do not depend on a direction are then evaluated only
        once. It belongs to one trace.
        """
        (numbers, key), row = key_of(arrays), jax.tree.leaves(components)  # only the numbers of components are read
        dtype = jnp.result_type(*([x for x in row if not is_exact(x)] or [float]))
        key = key._replace(structure=jax.tree.structure((arrays, components)), types=(key.types, len(row), dtype))
        try:
            with explain_leaked_tracer(type(arrays).__name__):
                replay = self._programs.get(key, lambda: self._replay(key))
        except _CapturedTracerError:
            return self.__wrapped__(arrays, components)[quantity]
        row = [x if is_exact(x) or x.dtype == dtype else x.astype(dtype) for x in row]
        return replay(quantity, [*numbers, *row], memory)

    def _replay(self, key: CacheKey) -> Replay:
        types, n, dtype = key.types
        f, quantities, leaves = trace_with_snapshot(self.__wrapped__), {}, []

        def results(*xs: PyTree) -> list[Any]:
            quantities.update(f(*jax.tree.unflatten(key.structure, xs)))
            leaves[:] = jax.tree.leaves([*quantities.values()])
            return [x for x in leaves if not is_exact(x)]

        program, _ = _jaxpr_of(results, [*specs_of(types), *[jax.ShapeDtypeStruct((), dtype)] * n])
        structures = {name: jax.tree.structure(value) for name, value in quantities.items()}
        kept = [x if is_exact(x) else None for x in leaves]  # without tracers
        return Replay(cse(program) if is_fusable(program.jaxpr) else program, structures, kept)


class _CapturedTracerError(Exception):
    """The function reads a value of the current trace, so its program must not be kept after this trace."""


def jaxpr_at(key: CacheKey, f: Callable[..., Any], *more: Any) -> tuple[ClosedJaxpr, Any]:
    """Trace `f` with the arguments of a key, and arrays with the types `more`. **Returns:** the program and its output
    tree."""
    f, n = trace_with_snapshot(f), len(key.types)

    def of_leaves(*xs: PyTree) -> PyTree:
        return f(*map(tree_of, jax.tree.unflatten(key.structure, xs[:n])), *xs[n:])

    return _jaxpr_of(of_leaves, specs_of([*key.types, *more]))


def _jaxpr_of(f: Callable[..., Any], specs: Sequence[Any]) -> tuple[ClosedJaxpr, Any]:
    program, out = program_of(f, *specs, return_shape=True)
    if any(isinstance(c, Tracer) for c in program.consts):
        raise _CapturedTracerError
    return program, out


def _label(system: object) -> str:
    if isinstance(system, Packed):
        system = system.others
    return "A function" if hasattr(system, "dtype") else type(system).__name__
