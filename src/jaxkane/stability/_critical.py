"""Values of a parameter at which stability is gained or lost. Knows eigenvalues along a parameter."""

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
from .._scalarjit.nan import constant, nan_where
from .._system.system import System
from ._eig_of_matrix import Eig, eig
from ._eigenvalues import MotionAt, eigenvalues, motion_family, names_of_modes, state_matrix, track_modes

_MOST = 8
_GRID = np.linspace(0.0, 20.0, 201)  # [m/s]
_HALVINGS = 32  # of a step between two values
_TRIALS = 200  # between two values
_NEUTRAL = 1e-10  # of the largest eigenvalue: what neither grows nor decays has a real part of rounding errors
_NOISE = 1e-13  # the same where they stand alone
_MOST_NEUTRAL = 1e-7  # the same where eigenvalues coalesce, which magnifies rounding errors


class CriticalSpeeds(eqx.Module):
    """Values of a parameter where the real part of a mode passes zero, in rising order.

    Attributes: `values` (m,); `frequency` (m,) [rad/s], zero where the mode does not oscillate; `direction` (m,): 1
    where the mode becomes unstable, -1 where it becomes stable; `mode` (m,): its place in `modes`, the names.
    `speeds["weave"]` is the first value of that mode; without one it is `none`, which is NaN with its derivatives.
    """

    values: Float[Array, " m"]
    frequency: Float[Array, " m"]
    direction: Int[Array, " m"]
    mode: Int[Array, " m"]
    none: Float[Array, ""]
    modes: tuple[str, ...] = eqx.field(static=True)

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
        return f"CriticalSpeeds({text or 'none'})"


def critical_speeds(
    system: System,
    values: Any = None,
    motion: MotionAt = None,
    *,
    states: Sequence[str] | None = None,
    modes: Sequence[str] | None = None,
    most: int = _MOST,
) -> CriticalSpeeds:
    """Values of a parameter at which a mode becomes stable or unstable: of a bicycle the weave and capsize speeds.

        Re lambda(p) = 0

    The steps between `values` are halved until no eigenvalue can reach the imaginary axis, or one alone (or a conjugate
    pair) passes it once, which is bisected to rounding. How far eigenvalues move while A changes by dA is told by
    Gershgorin's discs of X^-1 dA X about them, X being the eigenvectors.

    **Arguments:** as `eigenvalues`; the `values` in any order, and there must be a steady motion between them too; for
    the bicycle they are 0 to 20 m/s by 0.1 by default. `most`: how many are kept under a trace, where their number
    cannot be known; the rest are NaN.

    **Returns:** `CriticalSpeeds`. They are differentiable in the parameters of the system by the implicit function
    theorem,

        dp = -(d Re lambda / d parameters) / (d Re lambda / dp),

    with NaN where the mode has no derivative because it coalesces with another. Names are those of `eigenvalues`; under
    a trace a value is NaN where the name of its mode is not clear.

    **Warns:** where more eigenvalues come to grow, or cease to, than pass the axis: a motion without damping becomes
    neutral, and crosses nothing. Under a trace there is no warning.

    **Raises:** `ValueError` as `eigenvalues`, and where some of `values`, or something between them, has no steady
    motion; under a trace all are NaN then.
    """
    if isinstance(most, bool) or not isinstance(most, int) or most < 1:
        raise ValueError(f"critical_speeds: `most` is how many are kept, at least one; got {most!r}.")
    values, at, states, groups = motion_family(system, _GRID if values is motion is None else values, motion, states)
    values = jnp.sort(values)  # directions are those of a rising parameter
    if len(values) < 2:
        names = eigenvalues(system, values, motion, states=states, modes=modes).modes
        empty, none = jnp.zeros(0, values.dtype), jnp.full((), jnp.nan, values.dtype)
        return CriticalSpeeds(empty, empty, empty.astype(int), empty.astype(int), none, names)
    crossings, state_names = _crossings(system, values, at, states, groups, most)
    known = jax.lax.stop_gradient(crossings)
    origin = (system, values, crossings.values)  # which follow from what `motion` closes over, too
    names, unnamed = names_of_modes(state_names, groups, known.clear, modes)
    # What is decided by numbers that are known is left to NumPy: every operation would be a program of its own.
    as_array: Any = np.asarray if is_concrete(crossings, origin) else jnp.asarray
    columns = (crossings.values, crossings.frequency, known.direction, known.column)
    critical, frequency, direction, column = map(as_array, columns)
    if is_concrete(known):
        if known.is_missing:
            raise ValueError(
                f"critical_speeds({type(system).__name__}): there is no steady motion at {float(known.missing):.6g}, "
                "so that what becomes stable or unstable beside it would be missed. Give values at which, and between "
                "which, there is one."
            )
        if known.count > most:
            return critical_speeds(system, values, motion, states=states, modes=modes, most=2 * int(known.count))
        if known.unexplained:
            n = int(known.unexplained)
            warnings.warn(
                f"critical_speeds({type(system).__name__}): between {float(values[0]):.6g} and {float(values[-1]):.6g} "
                f"the number of eigenvalues that grow {'rises' if n > 0 else 'falls'} by {abs(n)} more than pass the "
                "imaginary axis: some only reach it, as where nothing damps, or at an end of the values, or pass it "
                "too flatly to be found. jaxkane.stability.eigenvalues shows where.",
                stacklevel=2,
            )
        rows = np.flatnonzero(known.counts)
        order: Any = rows[np.argsort(np.asarray(known.values)[rows])]
    else:
        counts = known.counts & ~jnp.asarray(unnamed)[column] & ~known.is_missing
        critical, frequency = nan_where(~counts, (critical, frequency), origin)
        order = jnp.argsort(jax.lax.stop_gradient(critical))
    none = np.full((), np.nan, values.dtype)
    if not is_concrete(crossings, origin):
        none = nan_where(jnp.array(True), jnp.zeros((), values.dtype), origin)
    critical, frequency, direction, column = (jnp.asarray(x[order]) for x in (critical, frequency, direction, column))
    return CriticalSpeeds(critical, frequency, direction, column, jnp.asarray(none), names)


class _Crossings(NamedTuple):
    """Of `count` crossings the first k, of which some `counts`; `missing`: a value without a steady motion."""

    values: Float[Array, " k"]
    frequency: Float[Array, " k"]
    direction: Int[Array, " k"]
    column: Int[Array, " k"]
    counts: Any
    count: Any
    is_missing: Any
    missing: Any
    clear: Any
    unexplained: Any


class _Brackets(NamedTuple):
    """Between `lower` and `upper` (k,) an eigenvalue passes the imaginary axis: the one that is next to `near`."""

    lower: Float[Array, " k"]
    upper: Float[Array, " k"]
    near: Complex[Array, " k"]
    rises: Any
    count: Any
    is_missing: Any
    missing: Any

    def extended(self, lower, upper, near, rises, is_one) -> _Brackets:
        """Those of `near` (n,) that are one are added as far as there is room; all are counted."""
        at = jnp.where(is_one, self.count + jnp.cumsum(is_one) - 1, len(self.lower))
        old = (self.lower, self.upper, self.near, self.rises)
        rows = [x.at[at].set(y, mode="drop") for x, y in zip(old, (lower, upper, near, rises), strict=True)]
        lower, upper, near, rises = rows
        return self._replace(lower=lower, upper=upper, near=near, rises=rises, count=self.count + jnp.sum(is_one))


@jit
def _crossings(system, values, motion, states, groups, most: int):
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
    # Empty places repeat the first, so that nothing there can spoil a derivative.
    brackets = jax.tree.map(lambda x: jnp.where(is_one, x, x[0]) if x.ndim else x, brackets)
    roots = _bisect(at, brackets)
    roots, frequency, spectra_at_roots, place = jax.lax.map(
        lambda root: _differentiable(system, motion, states, *root), (roots, brackets.near)
    )
    rows = jnp.concatenate([p, jax.lax.stop_gradient(roots)])
    order = jnp.argsort(rows)
    all_of = jax.tree.map(lambda x, y: jnp.concatenate([x, y])[order], spectra, jax.lax.stop_gradient(spectra_at_roots))
    columns, clear = track_modes(rows[order], all_of, state_names[0], groups)
    columns = columns[jnp.argsort(order)][len(p) :]
    column = jnp.argmax(columns == place[:, None].astype(columns.dtype), axis=1)
    # What is zero at the first or the last value has not passed it.
    ends, step = p[jnp.array([0, -1])], jnp.abs(p[jnp.array([1, -2])] - p[jnp.array([0, -1])])
    inside = jnp.all(jnp.abs(rows[len(p) :, None] - ends[None, :]) > 1e-9 * step[None, :], axis=1)
    counts = is_one & inside
    direction = jnp.where(brackets.rises, 1, -1)
    counted = brackets.count, brackets.is_missing, brackets.missing
    passed = jnp.sum(jnp.where(counts, direction * jnp.where(frequency > 0, 2, 1), 0))
    unexplained = _unexplained(spectra.values[0], spectra.values[-1], passed)
    return _Crossings(roots, frequency, direction, column, counts, *counted, clear, unexplained), state_names[0]


def _unexplained(first, last, passed):
    """How many more eigenvalues grow at the last value than at the first one, less those that passed the axis."""

    def growing(x):
        size = x.real / jnp.max(jnp.abs(x))
        return jnp.sum(size > _MOST_NEUTRAL), jnp.sum(size > _NOISE)  # between them, it may be rounding errors

    (few, many), (few_last, many_last) = growing(first), growing(last)
    low, high = few_last - many, many_last - few
    return jnp.clip(0, low - passed, high - passed)


def _bracket(at, p, A, x, most: int) -> _Brackets:
    """Where eigenvalues of A = at(p) pass the imaginary axis between the values p (m,), where A is (m, n, n) and has
    the eigenvalues x (m, n)."""
    depth = _HALVINGS + 2
    missing = ~jnp.all(jnp.isfinite(A), axis=(1, 2))
    zeros = jnp.zeros(most, p.dtype)
    empty = (zeros, zeros, zeros.astype(x.dtype), jnp.zeros(most, bool), jnp.zeros((), int))
    brackets = _Brackets(*empty, jnp.any(missing), p[jnp.argmax(missing)])

    def within(brackets, step):
        """The halves of a step that are still to be looked at lie on a stack."""
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
            brackets = brackets.extended(lower[0], upper[0], near, rises, is_one & (clear | last) & exists)
            missing = jnp.where(brackets.is_missing | exists, brackets.missing, p)
            brackets = brackets._replace(is_missing=brackets.is_missing | ~exists, missing=missing)
            for i, half in enumerate(((middle, upper), (lower, middle))):
                stack = jax.tree.map(lambda x, y, i=i: x.at[height - 1 + i].set(y), stack, half)
            return brackets, stack, jnp.where(clear | last | ~exists, height - 1, height + 1), trial + 1

        carry = (brackets, stack, jnp.ones((), int), jnp.zeros((), int))
        return jax.lax.while_loop(lambda carry: carry[2] > 0, look, carry)[0], None

    lower, upper = (p[:-1], A[:-1], x[:-1]), (p[1:], A[1:], x[1:])
    return jax.lax.scan(within, brackets, (lower, upper))[0]


def _crossing_modes(spectrum: Eig, lower, middle, upper):
    """Whether it is clear what passes the imaginary axis about A; and the eigenvalues (n,), which of them pass it
    towards the right, and which pass it at all (of a conjugate pair the upper one)."""
    (_, A_lower, before), (_, A, x), (_, A_upper, after) = lower, middle, upper
    s = jnp.abs(jnp.sum(spectrum.left.conj() * spectrum.vectors, axis=0))
    # Both vectors of one length: discs then do not depend on how LAPACK scales them.
    by = (1 / jnp.sqrt(s)).astype(x.dtype)
    Y, X = spectrum.left.conj().T * by[:, None], spectrum.vectors * by[None, :]
    changes = (A_lower - A, A_upper - A, A_lower - 2 * A + A_upper)  # the last where A is not linear in p
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
    """The same where it is not clear: by the order of the real parts, which change continuously."""
    before, after = (x[jnp.lexsort((-x.imag, -x.real))] for x in (before, after))
    rounding = 1e3 * jnp.finfo(before.dtype).eps * jnp.max(jnp.abs(before))
    rises = before.real < after.real
    changed = (before.real * after.real < 0) & (jnp.abs(after.real - before.real) > rounding)
    return (before + after) / 2, rises, changed & ((before.imag >= 0) | (after.imag >= 0))


def _bisect(at, brackets: _Brackets):
    """The critical values (k,), to rounding."""

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
    """A critical value with its derivatives, its frequency, the eigenvalues there and the place of the critical one."""

    def spectrum_at(p):
        spectrum = eig(state_matrix(system, p, motion, states)[0])
        return *_nearest(spectrum, near), spectrum

    root = jax.lax.custom_root(
        lambda p: spectrum_at(p)[0].real, root, lambda _, root: root, lambda f, y: y / f(jnp.ones_like(y))
    )
    x, place, spectrum = spectrum_at(root)
    return root, jnp.abs(x.imag), spectrum, place
