"""Values of a parameter at which stability is gained or lost. Knows eigenvalues along a parameter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int

from .._common.lookup import not_there
from .._description.system import System
from .._method.checks import is_concrete
from .._scalars.nan import nan_where
from .._scalars.versions import compiled
from ._eig import eig
from ._eigenvalues import Eigenvalues, MotionAt, eigenvalues, family_of, matrix

_MOST = 8
_GRID = np.linspace(0.0, 20.0, 201)  # [m/s]


class CriticalSpeeds(eqx.Module):
    """Values of a parameter where the real part of a mode passes zero, in rising order.

    Attributes: `values` (m,); `frequency` (m,) [rad/s], zero where the mode does not oscillate; `direction` (m,): 1
    where the mode becomes unstable, -1 where it becomes stable; `mode` (m,): its place in `modes`, the names.
    `found["weave"]` is the first value of that mode; without one it is `none`, which is NaN with its derivatives.
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

    Modes are followed along `values`; where the real part of one changes sign it is bisected to rounding.

    **Arguments:** as `eigenvalues`. `values` must be close enough for no mode to pass zero twice between two of them;
    for the bicycle they are 0 to 20 m/s by 0.1 by default. `most`: how many are kept under a trace, where their number
    cannot be known; the rest are NaN.

    **Returns:** `CriticalSpeeds`. They are differentiable in the parameters of the system by the implicit function
    theorem,

        dp = -(d Re lambda / d parameters) / (d Re lambda / dp),

    with NaN where the mode has no derivative because it coalesces with another.

    **Raises:** `ValueError` as `eigenvalues`, and where some of `values` have no steady motion; under a trace all are
    NaN then.
    """
    values, at, states, _ = family_of(system, _default_grid(system, values, motion), motion, states)
    found = eigenvalues(system, values, motion, states=states, modes=modes)
    roots: Any = jax.lax.stop_gradient(found.eigenvalues)
    concrete = is_concrete(roots)
    if concrete:
        # What is decided by numbers that are known is left to NumPy: every operation would be a program of its own.
        roots = np.asarray(roots)
        if not np.all(np.isfinite(roots)):
            gone = np.asarray(found.values)[~np.isfinite(roots).all(axis=1)]
            places = ", ".join(f"{x:.6g}" for x in gone)
            raise ValueError(
                f"critical_speeds({type(system).__name__}): there is no steady motion at {places}, so that what "
                "becomes stable or unstable beside it would be missed. Give values at which there is one."
            )
    row, column, is_one = _sign_changes(roots, most)
    critical, frequency = _refine(system, found, at, states, row, column)
    xp = np if concrete else jnp
    direction = xp.sign(roots.real[row + 1, column] - roots.real[row, column]).astype(int)
    origin = (system, values)
    if not concrete:
        critical, frequency = nan_where(~(is_one & jnp.all(jnp.isfinite(roots))), (critical, frequency), origin)
    if is_concrete(critical, frequency, origin):
        critical, frequency, none = np.asarray(critical), np.asarray(frequency), np.full((), np.nan, values.dtype)
        order: Any = np.argsort(critical)
    else:
        none = nan_where(jnp.array(True), jnp.zeros((), values.dtype), origin)
        order = jnp.argsort(jax.lax.stop_gradient(critical))
    critical, frequency, direction, mode = (jnp.asarray(x[order]) for x in (critical, frequency, direction, column))
    return CriticalSpeeds(critical, frequency, direction, mode, jnp.asarray(none), found.modes)


def _default_grid(system: System, values: Any, motion: MotionAt) -> Any:
    return _GRID if values is None and motion is None else values


def _sign_changes(x: Any, most: int) -> tuple[Any, Any, Any]:
    """Rows after which, and columns in which, a real part of the eigenvalues (m, n) changes sign; of a conjugate pair
    only the upper one."""
    xp = np if isinstance(x, np.ndarray) else jnp
    upper = (x.imag[:-1] >= 0) & (x.imag[1:] >= 0)
    # What neither grows nor decays (an undamped oscillation) has a real part of rounding errors only.
    sign = xp.sign(xp.where(xp.abs(x.real) > 1e-10 * xp.max(xp.abs(x), initial=0.0), x.real, 0.0))
    # One that is zero at a value itself, between two signs, has passed it.
    before, after = xp.concatenate([sign[:1], sign[:-1]]), xp.concatenate([sign[1:], sign[-1:]])
    sign = xp.where((sign == 0) & (before * after < 0), after, sign)
    changes = (sign[:-1] * sign[1:] < 0) & upper
    if xp is np:
        row, column = np.nonzero(changes)
        return row, column, np.ones(row.shape, bool)
    row, column = jnp.nonzero(changes, size=most, fill_value=-1)
    is_one = row >= 0
    # Empty places repeat the first, so that nothing there can spoil a derivative.
    return jnp.where(is_one, row, row[0]), jnp.where(is_one, column, column[0]), is_one


@compiled
def _refine(system, found: Eigenvalues, motion, states, rows, columns):
    eps = float(jnp.finfo(found.values.dtype).eps)
    fixed = jax.lax.stop_gradient(found)

    def selected(p, args):
        system, near, vector = args
        A, _ = matrix(system, p, motion, states)
        decomposed = eig(A)
        x = jax.lax.stop_gradient(decomposed)
        far = jnp.abs(x.values - near) / (1.0 + jnp.abs(near)) + 1.0 - jnp.abs(vector.conj() @ x.vectors)
        return decomposed.values[jnp.argmin(far)]

    def one(place):
        row, column = place
        lower, upper = fixed.values[row], fixed.values[row + 1]
        beside = 1e-3 * (upper - lower)  # a zero at one of them has the sign of its rounding
        a, b = fixed.eigenvalues[row, column], fixed.eigenvalues[row + 1, column]
        s = a.real / (a.real - b.real)
        near = jax.lax.complex(jnp.zeros_like(s), a.imag + s * (b.imag - a.imag))
        nearest = jnp.where(s < 0.5, row, row + 1)
        args = (system, near, fixed.vectors[nearest, :, column])
        root = optx.root_find(
            lambda p, args: selected(p, args).real,
            optx.Bisection(rtol=eps, atol=eps, flip="detect"),
            lower + s * (upper - lower),
            args,
            options={"lower": lower - beside, "upper": upper + beside},
            max_steps=64,
            throw=False,
        )
        return root.value, jnp.abs(selected(root.value, args).imag)

    if rows.shape[0] == 0:
        return jnp.zeros(0, found.values.dtype), jnp.zeros(0, found.values.dtype)
    return jax.lax.map(one, (rows, columns))
