"""A program as one function of XLA.

XLA splits a program of scalars into many kernels, and repeats in each kernel the operations that several kernels need:
two thousand operations become eight thousand. Two methods avoid this. XLA does not split the function by which
`reduce_window` combines the elements of a window. A program can be this function, with windows of one element, the
members of a batch (`Windows`). And a call with the frontend attribute `xla_cpu_small_call` is compiled as one function
(`as_one_function`).

Measured on the nonlinear bicycle (jax 0.12), as small calls and as windows: compilation 0.43 and 0.26 s; 0.35 and 0.22
us for an evaluation; in a batch of 128, 0.72 and 0.22 us. Its derivative along 27 directions, in a loop: 5.8 and 1.5 s;
6.5 and 12.7 us. An executed program with windows takes 0.1 us longer for each of their operations, once and not in each
step of a loop.

XLA:GPU compiles windows too (jax 0.11, H200): the first run of 65 536 simulations of the bicycle takes 4.8 s instead of
9.6, later runs 97 ms instead of 125. A derivative of 4700 operations did not compile within a minute.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .compat import ClosedJaxpr, jaxpr_as_fun, one_function
from .graph import ARITHMETIC, COMPARISONS, DTYPES, LIBRARY, LOGIC, SIMPLE, NotScalarError, graph_of, needed
from .jaxpr import replaced

_FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{name: getattr(jax.lax, name) for name in ARITHMETIC | COMPARISONS | LIBRARY | SIMPLE | {"neg", "select"}},
    **{name: getattr(jax.lax, f"bitwise_{name}") for name in LOGIC},
}


_SHORT = 1000  # equations: without a batch, the arrays of windows cost a shorter program more than XLA's splitting
_LONG = 3000  # nodes: outside of loops, XLA computes a longer program several times, unless it is one function
_MOST_LANES = 128  # with more, intermediate results no longer fit in the cache


class Windows:
    """A program of scalars as the function that combines windows. **Raises:** `NotScalarError` for other programs."""

    def __init__(self, program: ClosedJaxpr):
        self.graph, self.outputs = graph_of(program)
        if not all(array.size for array in self.outputs):
            raise NotScalarError("an empty result")
        nodes = self.graph.nodes
        self.order = needed(nodes, self.outputs)
        inputs = [k for k in self.order if nodes[k].operation == "input"]
        results = [*dict.fromkeys(int(k) for array in self.outputs for k in array.flat)]
        # Input, result and type of each element. Combined elements keep their type.
        self.elements: list[tuple[int | None, int | None, str]] = []
        for dtype in DTYPES:
            of_type = ([k for k in group if nodes[k].dtype == dtype] for group in (inputs, results))
            self.elements += [(k, result, dtype) for k, result in itertools.zip_longest(*of_type)]

    def __call__(
        self,
        args: Sequence[Any],
        sizes: tuple[int, ...],
        batch_mask: Sequence[Sequence[bool]],
        out_batch_mask: Sequence[Sequence[bool]],
    ) -> list[Any]:
        """The results over a batch.

        **Arguments:**

        - `args`: the arguments.
        - `sizes`: of the leading axes.
        - `batch_mask`, `out_batch_mask`: for each argument and each result, which of these axes it has.

        Values that all members share are computed for each member, because this compiles faster.
        """
        shape, rows = sizes or (1,), []
        # the barrier hides constants from XLA
        for x, mask in zip(jax.lax.optimization_barrier([*args]), batch_mask, strict=True):
            own = x.shape[sum(mask) :]
            x = x.reshape(*(n if is_there else 1 for n, is_there in zip(sizes, mask, strict=True)), *own)
            rows.append(jnp.broadcast_to(x, (*sizes, *own)).reshape(*shape, math.prod(own)))
        places = [None if k is None else self.graph.nodes[k].operands for k, *_ in self.elements]
        elements = [
            jnp.zeros(shape, dtype) if place is None else rows[place[0]][..., place[1]]
            for place, (*_, dtype) in zip(places, self.elements, strict=True)
        ]
        starts, ones = tuple(np.zeros((), dtype)[()] for *_, dtype in self.elements), (1,) * len(shape)

        def combine(*xs: Any) -> Sequence[Array]:
            return jax.lax.reduce_window(xs, starts, self._combined, ones, ones, "VALID")

        if self.is_long:
            with one_function():
                combined = jax.jit(combine)(*elements)
        else:
            combined = combine(*elements)
        results = {k: x for (_, k, _), x in zip(self.elements, combined, strict=True)}
        stacked = [jnp.stack([results[int(k)] for k in array.flat], axis=-1) for array in self.outputs]
        whole = [x.reshape(*sizes, *array.shape) for x, array in zip(stacked, self.outputs, strict=True)]
        return [
            x[tuple(slice(None) if is_there else 0 for is_there in mask)]
            for x, mask in zip(whole, out_batch_mask, strict=True)
        ]

    @property
    def is_long(self) -> bool:
        return len(self.order) > _LONG

    def _combined(self, _: object, elements: Sequence[Any]) -> tuple[Any, ...]:
        values = {k: x for (k, *_), x in zip(self.elements, elements, strict=True)}
        for k in self.order:
            operation, operands, dtype = self.graph.nodes[k]
            if operation == "constant":
                values[k] = np.asarray(self.graph.value(k), dtype)
            elif operation == "convert":
                values[k] = jax.lax.convert_element_type(values[operands[0]], dtype)
            elif operation != "input":
                values[k] = _FUNCTIONS[operation](*(values[i] for i in operands))
        return tuple(jnp.zeros((), dtype) if k is None else jnp.asarray(values[k]) for _, k, dtype in self.elements)


def pays_as_windows(program: ClosedJaxpr, sizes: tuple[int, ...]) -> bool:
    """Whether windows are faster."""
    return (0 if sizes else _SHORT) <= len(program.jaxpr.eqns) and 0 not in sizes


def chunks_of(sizes: tuple[int, ...]) -> tuple[int, ...]:
    """The sizes of the chunks along the first axis in which a large batch is evaluated; () if it is not split."""
    if math.prod(sizes) <= _MOST_LANES or sizes[0] == 1:
        return ()
    return (max(1, min(sizes[0], _MOST_LANES // math.prod(sizes[1:]))), *sizes[1:])


def one_chunk_at_a_time(
    f: Callable[..., list[Any]],
    args: Sequence[Any],
    outputs: Sequence[Any],
    size: int,
    in_batch: Sequence[bool],
    out_in_batch: Sequence[bool],
) -> list[Any]:
    """`f` over a batch, in chunks of this size. The last chunk begins earlier, so that all have the same size.

    **Arguments:**

    - `f`: the function.
    - `args`: the arguments.
    - `outputs`: types of the results.
    - `size`: of a chunk.
    - `in_batch`, `out_in_batch`: which arguments and results have the axis of the batch.
    """
    n = next(x.shape[0] for x, is_in in zip(args, in_batch, strict=True) if is_in)

    def chunk(i: Array, outputs: list[Any]) -> list[Any]:
        start = jnp.minimum(i * size, n - size)
        slices = [jax.lax.dynamic_slice_in_dim(x, start, size) if b else x for x, b in zip(args, in_batch, strict=True)]
        put = functools.partial(jax.lax.dynamic_update_slice_in_dim, start_index=start, axis=0)
        each = zip(outputs, f(*slices), out_in_batch, strict=True)
        return [put(whole, piece) if is_in else piece for whole, piece, is_in in each]

    return jax.lax.fori_loop(0, -(-n // size), chunk, [jnp.zeros(a.shape, a.dtype) for a in outputs])


def as_one_function(program: ClosedJaxpr, args: Sequence[Any]) -> list[Any]:
    """The results of a program that is compiled as one function."""
    # XLA aborts on a parameter that its simplified program no longer uses. The sum uses all of them. The barrier hides
    # constant arguments, which XLA would otherwise substitute for the parameter.
    places = [i for i, x in enumerate(args) if x.size]

    def values_and_sum(*some):
        return jaxpr_as_fun(program)(*replaced(args, places, some)), sum(x[(0,) * x.ndim].astype(float) for x in some)

    with one_function():
        values, _ = jax.jit(values_and_sum)(*jax.lax.optimization_barrier([args[i] for i in places]))
    return values
