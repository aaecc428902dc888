"""Eigenvalues along a parameter, each followed through crossings. Knows linear models; names the bicycle's modes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float
from scipy.optimize import linear_sum_assignment

from .._common.lookup import not_there
from .._description.system import State, System
from .._method.checks import is_concrete
from .._scalars.reads import compiled
from ..catalog import WhippleBicycle
from ._bicycle import LATERAL, MODES, mode_order, straight_ahead
from ._eig import MOST_CONDITION, Eig, eig
from ._linearize import linearize
from ._steady import SteadyMotion

MotionAt = Callable[[Any, Any], Any] | State | SteadyMotion | None


class Eigenvalues(eqx.Module):
    """Eigenvalues at m values of a parameter, one column for each mode.

    Attributes:

    - `values` (m,): of the parameter. `eigenvalues` (m, n) [1/s]; `vectors` (m, n, n): right eigenvectors in the last
        axis but one, of unit length.
    - `condition` (m, n): of each eigenvalue, see `jaxkane.stability.linearize(...).eig`. Derivatives are NaN where it
        is above 1e6: two modes coalesce there, and have none.
    - `modes`: names of the columns; `found["weave"]` gives those of a name. `states`: names of the vectors' entries.
    """

    values: Float[Array, " m"]
    eigenvalues: Complex[Array, "m n"]
    vectors: Complex[Array, "m n n"]
    condition: Float[Array, "m n"]
    modes: tuple[str, ...] = eqx.field(static=True)
    states: tuple[str, ...] = eqx.field(static=True)

    def __getitem__(self, mode: str) -> Complex[Array, "m n_mode"]:
        if mode not in self.modes:
            raise not_there(mode, self.modes, "these modes")
        return self.eigenvalues[:, np.array([i for i, name in enumerate(self.modes) if name == mode])]

    @property
    def stable(self) -> Any:
        """Where (m,) all modes decay."""
        return jnp.max(self.eigenvalues.real, axis=1) < 0

    @property
    def coalescing(self) -> Any:
        """Where (m, n) an eigenvalue is so close to another that it has no usable derivative."""
        return self.condition >= MOST_CONDITION

    def __repr__(self) -> str:
        if not is_concrete(self.eigenvalues):
            return f"Eigenvalues({', '.join(self.modes)})"
        text = f"{len(self.values)} values, {', '.join(dict.fromkeys(self.modes))}"
        at = np.asarray(self.values)[np.asarray(self.coalescing).any(axis=1)]
        if at.size:
            text += f"; modes coalesce at {', '.join(f'{x:.6g}' for x in at)}: no derivative there"
        none = np.asarray(self.values)[~np.isfinite(np.asarray(self.eigenvalues)).all(axis=1)]
        if none.size:
            text += f"; NaN at {', '.join(f'{x:.6g}' for x in none)}: no steady motion there"
        return f"Eigenvalues({text})"


def eigenvalues(
    system: System,
    values: Any = None,
    motion: MotionAt = None,
    *,
    states: Sequence[str] | None = None,
    modes: Sequence[str] | None = None,
) -> Eigenvalues:
    """Eigenvalues of the linear models about a family of steady motions.

    **Arguments:**

    - `values` (m,): of the parameter of the family, in small enough steps to follow a mode from one to the next.
    - `motion`: (system, value) -> `State`, `SteadyMotion`, or a pair of another system and one of these, where the
        parameter belongs to the system. For a `WhippleBicycle` it is riding straight ahead at speeds [m/s] by default.
        Or one motion, without `values`: then m is 1.
    - `states`: as for `linearize`; for the bicycle riding straight (roll, steer, roll_rate, steer_rate).
    - `modes`: names of the modes, one for each column.

    **Returns:** `Eigenvalues`, differentiable in the system's parameters. A mode is followed by its eigenvalue, that
    is extrapolated, and its eigenvector: the assignment with the least sum of both changes.

    **Raises:** `ValueError` as `linearize`, and where there is no default motion.
    """
    values, at, states, named = family_of(system, values, motion, states)
    found, kept = _along(system, values, at, states, named)
    if modes is None:
        modes = MODES if named else tuple(f"mode {i + 1}" for i in range(len(kept)))
    if len(modes) != len(kept):
        raise ValueError(f"eigenvalues: {len(kept)} modes, but {len(modes)} names: {', '.join(modes)}.")
    return Eigenvalues(values, found.values, found.vectors, found.condition, tuple(modes), kept)


def family_of(system: System, values: Any, motion: MotionAt, states: Sequence[str] | None):
    """Values, (system, value) -> motion, states, and whether the modes have the bicycle's names."""
    is_straight = False
    if motion is None and isinstance(system, WhippleBicycle):
        is_straight, motion = True, straight_ahead
        more = len(system.speeds) > len(WhippleBicycle.speeds) or system.states
        if states is None and not (more and system.lateral == LATERAL):  # what else moves, the system does not say
            states = system.lateral
    if motion is None:
        raise ValueError(
            f"{type(system).__name__} has no family of steady motions by default: give `motion`, a function "
            "(system, value) -> State or SteadyMotion, e.g. by steady_turn(system, ..., hold={...: value})."
        )
    if not callable(motion):
        if values is not None:
            raise ValueError("One motion has no values of a parameter: leave `values` out, or give a function.")
        fixed, values = motion, jnp.zeros(1)
        motion = _Fixed(fixed)
    if values is None:
        raise ValueError("Give the values of the parameter, e.g. speeds jnp.linspace(0.0, 10.0, 201).")
    values = jnp.atleast_1d(jnp.asarray(values, dtype=float))
    return values, motion, None if states is None else tuple(states), is_straight and states == LATERAL


class _Fixed(eqx.Module):
    motion: Any

    def __call__(self, system, value):
        return self.motion


def matrix(system: System, value: Any, motion: Any, states: tuple[str, ...] | None):
    """A (n, n) at one value of the parameter, and the names of its states."""
    at = motion(system, value)
    if isinstance(at, tuple):
        system, at = at
    model = linearize(system, at, states=states)
    return model.A, model.states


@compiled
def _along(system, values, motion, states, named):
    names: list[tuple[str, ...]] = []

    def one(value):
        A, kept = matrix(system, value, motion, states)
        names.append(kept)
        return A

    found = eig(jax.vmap(one)(values))
    order = jax.pure_callback(
        lambda x, X: track(x, X, named).astype(np.int32),
        jax.ShapeDtypeStruct(found.values.shape, jnp.int32),
        jax.lax.stop_gradient(found.values),
        jax.lax.stop_gradient(found.vectors),
        vmap_method="sequential",
    )
    rows = jnp.arange(len(values))[:, None]
    picked = Eig(
        found.values[rows, order],
        found.vectors[rows, :, order].swapaxes(1, 2),
        found.left[rows, :, order].swapaxes(1, 2),
        found.condition[rows, order],
    )
    return picked, names[0]


def track(values: Any, vectors: Any, named: bool = False) -> np.ndarray:
    """The order (m, n) in which each row's eigenvalues (m, n) and vectors (m, n, n) continue those of the row above."""
    values, vectors = np.asarray(values), np.asarray(vectors)
    m, n = values.shape
    order = np.tile(np.arange(n), (m, 1))
    if m:
        order[0] = np.lexsort((-values[0].imag, -values[0].real))
    followed: list[int] = []  # rows without NaN so far
    for k in range(m):
        if not np.all(np.isfinite(values[k])):
            continue
        if followed:
            i = followed[-1]
            last, X = values[i, order[i]], vectors[i][:, order[i]]
            # One step further along the line through the last two, where that is a small change
            ahead = last + (last - values[i - 1, order[i - 1]] if len(followed) > 1 and followed[-2] == i - 1 else 0.0)
            size = 1e-12 + np.abs(values[k]).max()
            near = np.abs(values[k][None, :] - ahead[:, None]) / size
            alike = np.abs(X.conj().T @ vectors[k])
            order[k] = linear_sum_assignment(near + 0.1 * (1.0 - alike))[1]
        followed.append(k)
    if named and followed:
        tracked = np.take_along_axis(values[followed], order[followed], axis=1)
        order = order[:, mode_order(tracked)]
    return order
