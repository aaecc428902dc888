"""The primitive of JAX that calls a `Program`: its rules for derivatives and batches, and what XLA executes.

A call represents a batch over leading axes of the given `sizes`. Input i has the axes that `batch_mask[i]` marks, the
outputs those of `Program.out_batch_mask`. The parameter `program` of each rule is the `Program`.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp

from .backends.xla import as_one_function, chunks_of, one_chunk_at_a_time, pays_as_windows
from .compat import (
    MISSING,
    as_lowering,
    instantiate_zeros,
    is_no_tangent,
    is_undefined_primal,
    new_primitive,
    no_tangent,
)
from .jaxpr import PROGRAM, is_inexact, specs_of


def _run(*args, program, sizes, batch_mask):
    return program.jitted(sizes, batch_mask)(*args)


def _abstract(*_, program, sizes, batch_mask):
    masks = zip(program.out_avals, program.out_batch_mask(batch_mask), strict=True)
    return [a.update(shape=(*_present(sizes, mask), *a.shape)) for a, mask in masks]


def _present(sizes, mask):
    return tuple(n for n, is_there in zip(sizes, mask, strict=True) if is_there)


def _separate_calls(*, program, sizes, batch_mask):
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


def _jvp(primals, tangents, *, program, sizes, batch_mask):
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


def _transpose(cotangents, *args, program, sizes, batch_mask):
    asked = linear = tuple(map(is_undefined_primal, args))
    if all(i in program.roles.linear for i, is_asked in enumerate(asked) if is_asked):
        # Use one transpose, whichever tangents are constant: a loop first needs some of the cotangents, later all.
        linear = tuple(i in program.roles.linear for i in range(len(args)))

    def at_one_place(ct, mask):
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

    def over_missing(ct, mask):
        axes = tuple(d for d, is_there in enumerate(mask) if not is_there)
        return ct.sum(axes) if axes else ct

    cts = [next(results) if is_linear else None for is_linear in linear]
    each = zip(cts, batch_mask, asked, strict=True)
    return [over_missing(ct, mask) if is_asked else None for ct, mask, is_asked in each]


def _batch(args, axes, *, program, sizes, batch_mask):
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


def _inlined(*args, program, sizes, batch_mask):
    return (program.batched(sizes, batch_mask) if sizes else program).evaluate(*args)


def _on_gpu(*args, program, sizes, batch_mask):
    if program.is_fusable and 0 not in sizes and program.windows and not program.windows.is_long:
        return program.windows(args, sizes, batch_mask, program.out_batch_mask(batch_mask))
    return _inlined(*args, program=program, sizes=sizes, batch_mask=batch_mask)


def _by_xla(*args, program, sizes, batch_mask):
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


def _by_kernel(*args, program, sizes, batch_mask, target):
    # The kernel reads its arguments in this order (`Program.target` passes the same groups), so both must use `groups`.
    groups = [[args[i] for i in group] for group in program.groups(batch_mask)]
    outputs = specs_of(_abstract(program=program, sizes=sizes, batch_mask=batch_mask))
    return jax.ffi.ffi_call(target, outputs)(*(jnp.stack(xs, axis=-1) if len(xs) > 1 else xs[0] for xs in groups))


def _lower_on_cpu(context, *args, program, sizes, batch_mask):
    target = program.target(sizes, batch_mask)
    rule = _by_xla if target is None else functools.partial(_by_kernel, target=target)
    return as_lowering(rule)(context, *args, program=program, sizes=sizes, batch_mask=batch_mask)


program_p: Any = None  # without the parts of JAX that `compat` needs
if MISSING is None:
    program_p = new_primitive(
        PROGRAM,
        evaluate=_run,
        shapes=_abstract,
        jvp=_jvp,
        transpose=_transpose,
        batch=_batch,
        traced=_inlined,
        lower_on_cpu=_lower_on_cpu,
        traced_on_gpu=_on_gpu,
        separate_calls=_separate_calls,
    )
