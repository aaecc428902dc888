"""In which mode a motion is differentiated: found out where JAX lets it be seen, and said where it comes too late.

Knows JAX; knows no motions.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import equinox as eqx
import jax

from .._scalars.jax_internals import (
    FUSES,
    as_lowering,
    is_moved_forward,
    is_moved_forward_below,
    is_no_tangent,
    new_primitive,
    nothing_is_traced,
)
from .settings import ADJOINTS, Settings


def goes_forward(values: Any) -> bool:
    """Whether a derivative in forward mode is under way by any of the arrays in `values`."""
    return any(map(is_moved_forward, jax.tree.leaves(values)))


def in_its_mode(settings: Settings, adjoint: Any, given: Any) -> tuple[Settings, Any]:
    """The settings for a derivative in forward mode that is under way, where `adjoint` leaves the choice; and what is
    given to a motion, guarded where that is for reverse mode."""
    if adjoint == "auto" and goes_forward(given):
        settings = dataclasses.replace(settings, adjoint=ADJOINTS["forward"]())
    if isinstance(settings.adjoint, ADJOINTS["reverse"]) and not nothing_is_traced():
        given = for_reverse_mode(given)
    return settings, given


def for_reverse_mode(values: Any) -> Any:
    """`values`, whose derivative in forward mode is an error that says what to do; in reverse mode it is untouched.

    A motion whose steps are taken back (`adjoint="reverse"`) can be differentiated in reverse mode alone. A program
    that was traced before, as by `jax.jit`, meets forward mode when JAX comes to compile its derivative.

    **Raises:** `TypeError`, there.
    """
    if any(map(is_moved_forward_below, jax.tree.leaves(values))):
        _refuse()
    if FUSES:
        return values
    return jax.tree.map(lambda x: _guarded(x) if eqx.is_inexact_array(x) else x, values)


@jax.custom_jvp
def _guarded(x: Any) -> Any:
    return x


@_guarded.defjvp
def _(primals: Any, tangents: Any) -> Any:
    return primals[0], _reverse_only.bind(tangents[0], primals[0])[0]


def _refuse(*_: Any) -> Any:
    raise TypeError(
        "A derivative in forward mode (jax.jvp, jax.jacfwd, jax.linearize, jax.hessian) of a motion that was simulated "
        'for reverse mode. Say simulate(..., adjoint="forward"): where a function was compiled or linearized before, '
        'as in jax.jacfwd(jax.jit(f)), "auto" cannot see what is to come. A second derivative is jacfwd(jacfwd(f)).'
    )


def _jvp(primals: Any, tangents: Any) -> Any:
    (x_dot, x), (x_ddot, _) = primals, tangents
    return _reverse_only.bind(x_dot, x), [x_ddot] if is_no_tangent(x_ddot) else _reverse_only.bind(x_ddot, x)


def _batch(values: Any, dims: Any) -> Any:
    if dims[0] is not None and dims[1] is None:  # many directions at one point: jax.jacfwd
        _refuse()
    return _reverse_only.bind(*values), [dims[0]]


# Linear in the first of its arguments, the tangent; the second is the point.
_reverse_only: Any = None if FUSES else new_primitive(
    "reverse_mode_only",
    evaluate=_refuse,
    shapes=lambda x_dot, x: [x_dot],
    jvp=_jvp,
    transpose=lambda cotangents, x_dot, x: [cotangents[0], None],
    batch=_batch,
    traced=_refuse,
    lower_on_cpu=as_lowering(_refuse),
)  # fmt: skip
