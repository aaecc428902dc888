"""Values of a parameter at which a system becomes stable or unstable. Uses eigenvalues along a parameter."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from .._common.lookup import not_there
from .._kane.arguments import is_concrete
from .._scalarjit.cache_key import jit
from .._scalarjit.components import Numbers
from .._scalarjit.nan import constant, nan_where
from .._system.system import System
from ._eigenvalue_curves import (
    MotionAt,
    eigenvalues,
    motion_family,
    names_of_modes,
    parameter_label,
    state_matrix,
    track_modes,
)
from ._matrix_eigenvalues import Eig, eig

_MOST = 8
_GRID = np.linspace(0.0, 20.0, 201)  # [m/s]
_HALVINGS = 32  # at most, of a step between two values
_TRIALS = 200  # at most, of intervals between two values
_NEUTRAL = 1e-10  # relative to the largest eigenvalue: the real part of a neutral mode is rounding errors of this size
_NOISE = 1e-13  # the same for a well-separated eigenvalue
_MOST_NEUTRAL = 1e-7  # the same where eigenvalues coalesce, which magnifies rounding errors


class CriticalSpeeds(eqx.Module):
    """Values of a parameter where the real part of an eigenvalue crosses zero, in rising order.

    `speeds["weave"]` is the first value of that mode. If the mode does not cross, it is `none`: NaN with NaN
    derivatives.

    Attributes:

    - `values` (m,): of the parameter.
    - `frequency` (m,) [rad/s]: zero where the mode does not oscillate.
    - `direction` (m,): 1 where the mode becomes unstable, -1 where it becomes stable.
    - `mode` (m,): index of the mode in `modes`.
    - `none`: a NaN whose derivatives are NaN.
    - `modes`: the names of the modes.
    - `parameter`: name and, if known, unit of the parameter.
    """

    values: Float[Array, " m"]
    frequency: Float[Array, " m"]
    direction: Int[Array, " m"]
    mode: Int[Array, " m"]
    none: Float[Array, ""]
    modes: tuple[str, ...] = eqx.field(static=True)
    parameter: str = eqx.field(static=True, default="parameter")

    def __getitem__(self, name: str) -> Float[Array, ""]:
        if name not in self.modes:
            raise not_there(name, self.modes, "these modes")
        columns = np.array([i for i, mode in enumerate(self.modes) if mode == name])
        mine = jnp.any(self.mode[:, None] == columns[None, :], axis=1) & jnp.isfinite(self.values)
        if not mine.shape[0]:
            return self.none
        return jnp.where(jnp.any(mine), self.values[jnp.argmax(mine)], self.none)

    def __repr__(self) -> str:
        if not is_concrete(self.values):
            return f"CriticalSpeeds({', '.join(dict.fromkeys(self.modes))})"
        rows = zip(self.values, self.mode, self.direction, self.frequency, strict=True)
        text = ", ".join(
            f"{self.modes[int(i)]} {'un' * (int(d) > 0)}stable from {float(v):.10g} ({float(w):.4g} rad/s)"
            for v, i, d, w in rows
        )
        return f"CriticalSpeeds({self.parameter}: {text or 'none'})"


def critical_speeds(
    system: System,
    values: Numbers = None,
    motion: MotionAt = None,
    *,
    states: Sequence[str] | None = None,
    modes: Sequence[str] | None = None,
    most: int = _MOST,
) -> CriticalSpeeds:
    """Values of a parameter at which a mode becomes stable or unstable, e.g. the weave and capsize speeds of a bicycle.

        Re lambda(p) = 0

    The search bisects intervals between `values` until each contains at most one crossing, which it bisects to
    rounding. An interval is decided if no eigenvalue can reach the imaginary axis, or if one eigenvalue or conjugate
    pair alone crosses it once. The change of the eigenvalues for a change dA of A is bounded by Gershgorin's discs of
    X^-1 dA X; X are the eigenvectors.

    **Arguments:**

    - `system`, `motion`, `states`, `modes`: as in `eigenvalues`.
    - `values`: as in `eigenvalues`, in any order. A steady motion must exist between them too. Default for a bicycle: 0
        to 20 m/s in steps of 0.1.
    - `most`: the length of the result under a trace, where the number of crossings cannot be known; unused entries are
        NaN.

    **Returns:** `CriticalSpeeds`. They are differentiable in the parameters of the system by the implicit function
    theorem,

        dp = -(d Re lambda / d parameters) / (d Re lambda / dp).

    The derivative is NaN where the mode coalesces with another. Names are those of `eigenvalues`. Under a trace a value
    is NaN if the name of its mode is not clear.

    **Warns:** if the number of growing eigenvalues changes by more than the crossings explain. Example: without damping
    a motion becomes neutral, and nothing crosses. Under a trace there is no warning.

    **Raises:** `ValueError` as `eigenvalues`, and if a steady motion does not exist at some of `values` or between
    them. Under a trace all values are NaN then.
    """
    if isinstance(most, bool) or not isinstance(most, int) or most < 1:
        raise ValueError(f"critical_speeds: `most` must be a positive number of values to keep; got {most!r}.")
    values, at, states, groups = motion_family(system, _GRID if values is motion is None else values, motion, states)
    values = jnp.sort(values)  # `direction` is defined for a rising parameter
    label = parameter_label(system, at)
    if len(values) < 2:
        names = eigenvalues(system, values, motion, states=states, modes=modes).modes if len(values) else ()
        empty, none = jnp.zeros(0, values.dtype), jnp.full((), jnp.nan, values.dtype)
        return CriticalSpeeds(empty, empty, empty.astype(int), empty.astype(int), none, names, label)
    crossings, found, state_names = _crossings(system, values, at, states, groups, most)
    known, found = jax.lax.stop_gradient((crossings[0], found))
    # `motion` may close over traced values: then `crossings` depends on them too
    origin = (system, values, crossings)
    names, unnamed = names_of_modes(state_names, groups, found["clear"], found["number"], modes)
    # Use NumPy for concrete values: with JAX every operation would be compiled as a program.
    as_array: Any = np.asarray if is_concrete(found, origin) else jnp.asarray
    critical, frequency, direction, column = map(as_array, (*crossings, found["direction"], found["column"]))
    if is_concrete(found):
        if found["is_missing"]:
            raise ValueError(
                f"critical_speeds({type(system).__name__}): there is no steady motion at {float(found['missing']):.6g}"
                ", so crossings near it would be missed. Choose `values` with steady motions at and between them."
            )
        if found["count"] > most:
            return critical_speeds(system, values, motion, states=states, modes=modes, most=2 * int(found["count"]))
        if n := int(found["unexplained"]):
            warnings.warn(
                f"critical_speeds({type(system).__name__}): between {float(values[0]):.6g} and {float(values[-1]):.6g} "
                f"the number of growing eigenvalues {'rises' if n > 0 else 'falls'} by {abs(n)} more than the detected "
                "crossings of the imaginary axis. Some eigenvalues only reach the axis (no damping, or at an end of "
                "the values), or cross it at too small an angle. Plot jaxkane.stability.eigenvalues to see where.",
                stacklevel=2,
            )
        rows = np.flatnonzero(found["counts"])
        order: Any = rows[np.argsort(np.asarray(known)[rows])]
    else:
        counts = found["counts"] & ~jnp.asarray(unnamed)[column] & ~found["is_missing"]
        critical, frequency = nan_where(~counts, (critical, frequency), origin)
        order = jnp.argsort(jax.lax.stop_gradient(critical))
    none = np.full((), np.nan, values.dtype)
    if not is_concrete(found, origin):
        none = nan_where(jnp.array(True), jnp.zeros((), values.dtype), origin)
    critical, frequency, direction, column = (jnp.asarray(x[order]) for x in (critical, frequency, direction, column))
    return CriticalSpeeds(critical, frequency, direction, column, jnp.asarray(none), names, label)


class _Brackets(NamedTuple):
    """Intervals from `lower` to `upper` (k,), in each of which one eigenvalue crosses the imaginary axis.

    - `near` (k,): an estimate of this eigenvalue.
    - `rises` (k,): whether its real part increases.
    - `count`: the number of intervals found, also above k.
    - `is_missing`, `missing`: whether some value has no steady motion, and the first such value.
    """

    lower: Float[Array, " k"]
    upper: Float[Array, " k"]
    near: Complex[Array, " k"]
    rises: Any
    count: Any
    is_missing: Any
    missing: Any

    def extended(self, lower, upper, near, rises, is_one, p, exists) -> _Brackets:
        """Append the entries of `near` (n,) for which `is_one`. Those beyond the k-th are counted but not stored."""
        at = jnp.where(is_one, self.count + jnp.cumsum(is_one) - 1, len(self.lower))
        new = (lower, upper, near, rises)
        lower, upper, near, rises = (x.at[at].set(y, mode="drop") for x, y in zip(self[:4], new, strict=True))
        missing = jnp.where(self.is_missing | exists, self.missing, p)
        return _Brackets(lower, upper, near, rises, self.count + jnp.sum(is_one), self.is_missing | ~exists, missing)


@jit
def _crossings(system, values, motion, states, groups, most: int):
    """At most k crossings.

    **Returns:** their values and frequencies (k,); a dict; and the names of the states. The dict contains:

    - "direction", "column", "counts" (k,): of each crossing, and which entries are crossings.
    - "count": the number of crossings found, also above k. "is_missing", "missing": as of `_Brackets`.
    - "clear", "number" (n,): as from `track_modes`. "unexplained": as from `_unexplained`.
    """
    fixed = constant((system, values))
    state_names: list[tuple[str, ...]] = []

    def at(p):
        A, names = state_matrix(fixed[0], p, motion, states)
        state_names.append(names)
        return jax.lax.stop_gradient(A)

    p = fixed[1]
    A = jax.vmap(at)(p)
    spectra = eig(A)
    brackets = _bracket(at, p, A, spectra.values, most)
    is_one = jnp.arange(most) < brackets.count
    # Unused entries repeat the first one: a NaN there would spoil reverse-mode gradients.
    brackets = jax.tree.map(lambda x: jnp.where(is_one, x, x[0]) if x.ndim else x, brackets)
    roots = _bisect(at, brackets)
    roots, frequency, spectra_at_roots, place = jax.lax.map(
        lambda root: _differentiable(system, motion, states, *root), (roots, brackets.near)
    )
    rows = jnp.concatenate([p, jax.lax.stop_gradient(roots)])
    order = jnp.argsort(rows)
    all_of = jax.tree.map(lambda x, y: jnp.concatenate([x, y])[order], spectra, jax.lax.stop_gradient(spectra_at_roots))
    columns, clear, number = track_modes(rows[order], all_of, state_names[0], groups)
    columns = columns[jnp.argsort(order)][len(p) :]
    # An eigenvalue that is zero at the first or the last value has not crossed.
    ends, step = p[jnp.array([0, -1])], jnp.abs(p[jnp.array([1, -2])] - p[jnp.array([0, -1])])
    counts = is_one & jnp.all(jnp.abs(rows[len(p) :, None] - ends[None, :]) > 1e-9 * step[None, :], axis=1)
    direction = jnp.where(brackets.rises, 1, -1)
    passed = jnp.sum(jnp.where(counts, direction * jnp.where(frequency > 0, 2, 1), 0))
    found = {
        "direction": direction,
        "column": jnp.argmax(columns == place[:, None].astype(columns.dtype), axis=1),
        "counts": counts,
        "count": brackets.count,
        "is_missing": brackets.is_missing,
        "missing": brackets.missing,
        "clear": clear,
        "number": number,
        "unexplained": _unexplained(spectra.values[0], spectra.values[-1], passed),
    }
    return (roots, frequency), found, state_names[0]


def _unexplained(first, last, passed):
    """The increase of the number of growing eigenvalues from the first to the last value, less the crossings."""

    def growing(x):
        size = x.real / jnp.max(jnp.abs(x))
        # real parts between these limits may be rounding errors
        return jnp.sum(size > _MOST_NEUTRAL), jnp.sum(size > _NOISE)

    (few, many), (few_last, many_last) = growing(first), growing(last)
    low, high = few_last - many, many_last - few
    return jnp.clip(0, low - passed, high - passed)


def _bracket(at, p, A, x, most: int) -> _Brackets:
    """Intervals of p in which eigenvalues of A = at(p) cross the imaginary axis.

    **Arguments:**

    - `at`: p -> A (n, n).
    - `p` (m,): values of the parameter, rising.
    - `A` (m, n, n), `x` (m, n): the matrices at `p`, and their eigenvalues.
    - `most`: the largest number of intervals.
    """
    depth, zeros = _HALVINGS + 2, jnp.zeros(most, p.dtype)
    missing = ~jnp.all(jnp.isfinite(A), axis=(1, 2))
    none = jnp.zeros(most, bool), jnp.zeros((), int), jnp.any(missing), p[jnp.argmax(missing)]
    brackets = _Brackets(zeros, zeros, zeros.astype(x.dtype), *none)

    def within(brackets, step):
        """Bisect one interval. The undecided halves are on a stack, because a while_loop cannot recurse."""
        stack = jax.tree.map(lambda x: jnp.zeros((depth, *x.shape), x.dtype).at[0].set(x), step)

        def look(carry):
            brackets, stack, height, trial = carry
            lower, upper = jax.tree.map(lambda x: x[height - 1], stack)
            p = 0.5 * (lower[0] + upper[0])
            A = at(p)
            spectrum = eig(A)
            middle = p, A, spectrum.values
            exists = jnp.all(jnp.isfinite(lower[1] + A + upper[1]))
            clear, *passing = _crossing_modes(spectrum, lower, middle, upper)
            last = (jnp.abs(upper[0] - lower[0]) <= 0.5**_HALVINGS * jnp.abs(step[1][0] - step[0][0])) | (
                trial >= _TRIALS
            )
            near, rises, is_one = (
                jnp.where(clear, x, y) for x, y in zip(passing, _crossings_by_order(lower[2], upper[2]), strict=True)
            )
            is_one = is_one & (clear | last) & exists
            brackets = brackets.extended(lower[0], upper[0], near, rises, is_one, p, exists)
            for i, half in enumerate(((middle, upper), (lower, middle))):
                stack = jax.tree.map(lambda x, y, i=i: x.at[height - 1 + i].set(y), stack, half)
            return brackets, stack, jnp.where(clear | last | ~exists, height - 1, height + 1), trial + 1

        carry = (brackets, stack, jnp.ones((), int), jnp.zeros((), int))
        return jax.lax.while_loop(lambda carry: carry[2] > 0, look, carry)[0], None

    lower, upper = (p[:-1], A[:-1], x[:-1]), (p[1:], A[1:], x[1:])
    return jax.lax.scan(within, brackets, (lower, upper))[0]


def _crossing_modes(spectrum: Eig, lower, middle, upper):
    """Crossings of the imaginary axis between `lower` and `upper`, by Gershgorin's discs.

    **Returns:** whether the interval is decided; the eigenvalues (n,) of A; which of them cross towards the right; and
    which cross at all (of a conjugate pair the upper one).
    """
    (_, A_lower, before), (_, A, x), (_, A_upper, after) = lower, middle, upper
    s = jnp.abs(jnp.sum(spectrum.left.conj() * spectrum.vectors, axis=0))
    # Scale both vectors to one length: the discs would otherwise depend on LAPACK's scaling.
    by = (1 / jnp.sqrt(s)).astype(x.dtype)
    Y, X = spectrum.left.conj().T * by[:, None], spectrum.vectors * by[None, :]
    # the last one is nonzero where A is not linear in p
    changes = (A_lower - A, A_upper - A, A_lower - 2 * A + A_upper)
    M = jnp.max(jnp.stack([jnp.abs(Y @ dA.astype(X.dtype) @ X) for dA in changes]), axis=0)
    radius = jnp.sum(M, axis=1)
    before, after = (y[jnp.argmin(jnp.abs(x[:, None] - y[None, :]), axis=1)] for y in (before, after))
    real = jnp.stack([before.real, x.real, after.real])
    rounding = jnp.clip(10 * jnp.finfo(A.dtype).eps / s, _NEUTRAL, _MOST_NEUTRAL) * jnp.max(jnp.abs(x))
    neutral = jnp.all(jnp.abs(real) <= rounding[None, :], axis=0)
    radius = jnp.where(neutral, 0.0, radius)
    within_reach = ~(jnp.abs(x.real) > radius) & ~neutral
    apart = jnp.abs(x[:, None] - x[None, :]) > radius[:, None] + radius[None, :]
    alone = jnp.all(apart | jnp.eye(len(x), dtype=bool), axis=1)
    bend, rise = jnp.abs(real[0] - 2 * real[1] + real[2]), jnp.abs(real[2] - real[0])
    negative = real < 0
    never = jnp.all(negative == negative[:1], axis=0) & (jnp.min(jnp.abs(real), axis=0) > 2 * bend)
    once = 4 * bend <= rise
    clear = jnp.all(~within_reach | (alone & (never | once)))
    rises = negative[0] & ~negative[2]
    return clear, x, rises, within_reach & (negative[0] != negative[2]) & (x.imag >= 0)


def _crossings_by_order(before, after):
    """The same for an undecided interval, by the order of the real parts, which change continuously."""
    before, after = (x[jnp.lexsort((-x.imag, -x.real))] for x in (before, after))
    rounding = 1e3 * jnp.finfo(before.dtype).eps * jnp.max(jnp.abs(before))
    rises = before.real < after.real
    changed = (before.real * after.real < 0) & (jnp.abs(after.real - before.real) > rounding)
    return (before + after) / 2, rises, changed & ((before.imag >= 0) | (after.imag >= 0))


def _bisect(at, brackets: _Brackets):

    def half(ends, _):
        lower, upper = ends
        middle = 0.5 * (lower + upper)
        x = jax.lax.map(lambda row: _nearest(eig(at(row[0])), row[1])[0], (middle, brackets.near))
        is_below = (x.real < 0) == brackets.rises
        return (jnp.where(is_below, middle, lower), jnp.where(is_below, upper, middle)), None

    bits = -int(np.log2(jnp.finfo(brackets.lower.dtype).eps))
    lower, upper = jax.lax.scan(half, (brackets.lower, brackets.upper), length=bits)[0]
    return 0.5 * (lower + upper)


def _nearest(spectrum: Eig, near):
    place = jnp.argmin(jnp.abs(jax.lax.stop_gradient(spectrum.values) - near))
    return spectrum.values[place], place


def _differentiable(system, motion, states, root, near):
    """A critical value with its derivatives.

    **Returns:** the value, the frequency, all eigenvalues there, and the index of the critical one.
    """

    def spectrum_at(p):
        spectrum = eig(state_matrix(system, p, motion, states)[0])
        return *_nearest(spectrum, near), spectrum

    root = jax.lax.custom_root(
        lambda p: spectrum_at(p)[0].real, root, lambda _, root: root, lambda f, y: y / f(jnp.ones_like(y))
    )
    x, place, spectrum = spectrum_at(root)
    return root, jnp.abs(x.imag), spectrum, place
