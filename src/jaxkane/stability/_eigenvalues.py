"""Eigenvalues along a parameter, each followed through crossings, and names of modes."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float
from scipy.optimize import linear_sum_assignment

from .._common.lookup import as_names, not_there
from .._kane.arguments import check_is_system, is_concrete, is_numeric
from .._scalarjit.cache_key import jit
from .._scalarjit.nan import nan_where
from .._system.parameters import parameter_info
from .._system.system import State, System, unit_of, units_of
from ..catalog import WhippleBicycle
from ._bicycle import LATERAL, MODES, mode_order, straight_ahead
from ._eig import MOST_CONDITION, Eig, eig
from ._linearize import linearize
from ._steady import SteadyMotion

Groups = Mapping[str, Sequence[str]]
OTHER = "mode {}"
_CLEAR = 0.5


def mode_names(states: Sequence[str], groups: Groups) -> tuple[str, ...] | None:
    """Names of the modes of a bicycle that rides straight: those of the bicycle, then one for each state of a group.

    None where the states are not those of `LATERAL` and of the groups, so that nothing is named.
    """
    grouped = [k for members in groups.values() for k in members]
    if sorted((*LATERAL, *grouped)) != sorted(states):
        return None
    return (*MODES, *(name for name, members in groups.items() for _ in members))


def participation(left: Any, right: Any) -> np.ndarray:
    """How much each state takes part in each mode, (..., states, modes)."""
    each = np.abs(np.conj(left) * right)
    return each / np.maximum(each.sum(axis=-2, keepdims=True), 1e-300)


def pairs(values: Any) -> np.ndarray:
    """Whether (..., n, n) the i-th and the j-th of eigenvalues (..., n) are a conjugate pair, its upper one first."""
    return (values.imag[..., :, None] > 0) & (values[..., :, None] == values[..., None, :].conj())


def named_order(
    values: np.ndarray, shares: np.ndarray, confused: np.ndarray, states: Sequence[str], groups: Groups
) -> tuple[np.ndarray, np.ndarray]:
    """Columns (n,) of tracked eigenvalues (m, n) in the order of `mode_names`, and whether (n,) each name is clear.

    `shares` (m, states, modes): participations; `confused` (n, n): columns that may have changed places. Modes are
    dealt out to groups where they belong to them most clearly: at the value at which the smallest share of a group in a
    mode of its own is largest. Two groups that vibrate with the steer, "wobble" and "front end", are distinguished by
    their frequencies: the slower one is the wobble. A name is clear where at least half of each of its modes belongs
    to it, no pair has two names, and no mode of another name may have changed places with one of its own.
    """
    members = [[states.index(k) for k in group] for group in (LATERAL, *groups.values())]
    owner = np.repeat(np.arange(len(members)), [len(group) for group in members])  # of each slot
    of_groups = np.stack([shares[:, group].sum(axis=1) for group in members], axis=1)  # (m, groups, modes)
    dealt = [linear_sum_assignment(-row[owner])[1] for row in of_groups]
    own_share = np.stack([row[owner, slots] for row, slots in zip(of_groups, dealt, strict=True)])  # (m, n)
    best = int(np.argmax(own_share.min(axis=1)))
    order, sure = dealt[best], own_share[best] >= _CLEAR
    own = order[: len(LATERAL)]
    order[: len(LATERAL)] = own[mode_order(values[:, own])]
    order = _slower_first(order, values[best], groups)
    names = np.array(mode_names(states, groups))
    others = names[:, None] != names
    torn = pairs(values[:, order]) & others
    if torn[best].any():
        return order, np.zeros(len(order), bool)
    doubtful = ~sure | np.any((confused[np.ix_(order, order)] | torn.any(axis=0) | torn.any(axis=0).T) & others, axis=1)
    return order, ~np.isin(names, names[doubtful])


def _slower_first(order: np.ndarray, values: np.ndarray, groups: Groups) -> np.ndarray:
    """The same, the slower of the wobble and what else vibrates at the front end being the wobble."""
    names = mode_names([*LATERAL, *(k for group in groups.values() for k in group)], groups) or ()
    places = [[i for i, name in enumerate(names) if name == each] for each in ("wobble", "front end")]
    if len(places[0]) != len(places[1]):
        return order
    speed = [np.abs(values[order[place]]).min(initial=np.inf) for place in places]
    if speed[1] < speed[0]:
        order = order.copy()
        order[places[0] + places[1]] = order[places[1] + places[0]]
    return order


_MARGIN = 1.5  # by how much more the modes would have to change if two of them changed places

MotionAt = Callable[[Any, Any], Any] | State | SteadyMotion | None


class Eigenvalues(eqx.Module):
    """Eigenvalues at m values of a parameter, one column for each mode.

    Attributes:

    - `values` (m,): of the parameter. `eigenvalues` (m, n) [1/s]; `vectors` (m, n, n): right eigenvectors in the last
        axis but one, of unit length.
    - `condition` (m, n): of each eigenvalue, see `jaxkane.stability.linearize(...).eig`. Derivatives are NaN where it
        is above 1e6: two modes coalesce there, and have none.
    - `modes`: names of the columns; `found["weave"]` gives those of a name. `states`: names of the vectors' entries.
    - `parameter`: what the values are of, with its unit where that is known: the label of a plot's axis.
    """

    values: Float[Array, " m"]
    eigenvalues: Complex[Array, "m n"]
    vectors: Complex[Array, "m n n"]
    condition: Float[Array, "m n"]
    modes: tuple[str, ...] = eqx.field(static=True)
    states: tuple[str, ...] = eqx.field(static=True)
    parameter: str = eqx.field(static=True, default="parameter")

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
        parameter belongs to the system; how the function calls `value` is how plots call it. For a `WhippleBicycle` it
        is riding straight ahead at speeds [m/s] by default. Or one motion, without `values`: then m is 1.
    - `states`: as for `linearize`; for the bicycle riding straight (roll, steer, roll_rate, steer_rate), and those of
        its parts.
    - `modes`: names of the modes, one for each column. By default those of a bicycle that rides straight: weave,
        capsize, castering, wobble, and those of its parts and tyres, recognized by how much their states take part;
        "mode 5", with a warning, where that is not clear: less than half of a mode is theirs, a conjugate pair would
        have two names, or two modes may have changed places within a step. All others are numbered.

    **Returns:** `Eigenvalues`, differentiable in the system's parameters. A mode is followed by its eigenvalue, that
    is extrapolated, and its eigenvector: the assignment with the least sum of both changes. Under a trace, where names
    cannot depend on values, a mode whose name is not clear is NaN; give `modes` to have it.

    **Raises:** `ValueError` as `linearize`, and where there is no default motion, or none of `values` has a steady one.
    Of a motion that is given, values without a steady one are NaN.
    """
    values, at, states, groups = family_of(system, values, motion, states)
    found, kept, clear = _along(system, values, at, states, groups)
    if motion is None and is_concrete(found.values) and not np.isfinite(np.asarray(found.values)).any():
        matrix(system, values[0], at, states)  # which says why
    names, lost = names_of_modes(kept, groups, clear, modes)
    roots = found.values if is_concrete(lost) else nan_where(lost, found.values.T, (system, values)).T
    return Eigenvalues(values, roots, found.vectors, found.condition, names, kept, _parameter(system, at))


def names_of_modes(
    states: tuple[str, ...], groups: Groups | None, clear: Any, modes: Sequence[str] | None
) -> tuple[tuple[str, ...], Any]:
    """Names of the columns, and those of them (n,) that must be NaN: under a trace, where its name is not clear."""
    names = as_names(modes) if modes is not None else None if groups is None else mode_names(states, groups)
    others = [OTHER.format(i + 1) for i in range(len(states))]
    if names is not None and len(names) != len(states):
        raise ValueError(f"eigenvalues: {len(states)} modes, but {len(names)} names: {', '.join(names)}.")
    if modes is not None or names is None:
        return names or tuple(others), np.zeros(len(states), bool)
    if not is_concrete(clear):
        return names, ~clear
    doubtful = dict.fromkeys(name for name, c in zip(names, clear, strict=True) if not c)
    if doubtful:
        warnings.warn(
            f"which modes are {', '.join(doubtful)} is not clear: numbered instead. Values that lie closer, "
            "or over a wider range, may tell; or give `modes`, names of your own.",
            UserWarning,
            stacklevel=3,
        )
    named = (k if c else other for k, c, other in zip(names, clear, others, strict=True))
    return tuple(named), np.zeros(len(states), bool)


def family_of(system: System, values: Any, motion: MotionAt, states: Sequence[str] | None):
    """Values, (system, value) -> motion, states, and the groups of states whose modes have names; None: none has."""
    is_straight = False
    check_is_system(system)
    if motion is None and isinstance(system, WhippleBicycle):
        is_straight, motion = True, straight_ahead
        more = len(system.speeds) > len(WhippleBicycle.speeds) or system.states
        if states is None and not (more and type(system).lateral is LATERAL):  # what else moves, it does not say
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
    if not is_numeric(values):
        raise TypeError(f"The values of the parameter must be real numbers, got {values!r}.")
    values = jnp.atleast_1d(jnp.asarray(values, dtype=float))
    if values.ndim > 1:
        raise ValueError(f"The values of the parameter are a row (m,), got the shape {values.shape}.")
    groups = _Groups(getattr(system, "mode_groups", {})) if is_straight else None
    return values, motion, None if states is None else as_names(states), groups


def _parameter(system: System, motion: Any) -> str:
    """What varies along a family, as a label: the name of the second argument of `motion`, and its unit."""
    if motion is straight_ahead:
        return "forward speed [m/s]"
    names = [] if isinstance(motion, _Fixed) else list(inspect.signature(motion).parameters)
    if len(names) < 2:
        return "parameter"
    unit = unit_of(names[1], {k: info.unit for k, info in parameter_info(system).items()} | units_of(system))
    return names[1].replace("_", " ") + (f" [{unit}]" if unit else "")


class _Groups(dict):
    """Names of states by group, as a static argument."""

    def __hash__(self):  # type: ignore[override]
        return hash(tuple(self.items()))


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


@jit
def _along(system, values, motion, states, groups):
    names: list[tuple[str, ...]] = []

    def one(value):
        A, kept = matrix(system, value, motion, states)
        names.append(kept)
        return A

    found = eig(jax.vmap(one)(values))
    order, clear = followed(values, found, names[0], groups)
    rows = jnp.arange(len(values))[:, None]
    picked = Eig(
        found.values[rows, order],
        found.vectors[rows, :, order].swapaxes(1, 2),
        found.left[rows, :, order].swapaxes(1, 2),
        found.condition[rows, order],
    )
    return picked, names[0], clear


def followed(values: Any, found: Eig, states: tuple[str, ...], groups: Groups | None):
    """Columns (m, n) that follow each mode along `values` (m,), and whether (n,) the names that they have are clear."""
    shapes = (found.values.shape, jnp.int32), (found.values.shape[-1:], jnp.bool_)
    return jax.pure_callback(
        lambda *numbers: _tracked(numbers, states, groups),
        tuple(jax.ShapeDtypeStruct(*shape) for shape in shapes),
        *jax.lax.stop_gradient((values, found.values, found.left, found.vectors)),
        vmap_method="sequential",
    )


def _tracked(numbers: Any, states: tuple[str, ...], groups: Groups | None):
    """Columns (m, n) that follow each mode, those with names in their order, and whether (n,) these are clear."""
    at, values, left, right = map(np.asarray, numbers)
    order, confused = track(at, values, right)
    clear = np.ones(order.shape[1], bool)
    rows = np.isfinite(values).all(axis=1)
    if groups is not None and rows.any() and mode_names(states, groups) is not None:
        followed = np.take_along_axis(values, order, axis=1)[rows]
        shares = np.take_along_axis(participation(left, right), order[:, None, :], axis=2)[rows]
        columns, clear = named_order(followed, shares, confused, states, groups)
        order = order[:, columns]
    return order.astype(np.int32), clear


def track(at: Any, values: Any, vectors: Any) -> tuple[np.ndarray, np.ndarray]:
    """The order (m, n) in which each row's eigenvalues (m, n) and vectors (m, n, n) continue those of the row above, at
    `at` (m,); and whether (n, n) the i-th and the j-th column could as well have changed places somewhere."""
    at, values, vectors = map(np.asarray, (at, values, vectors))
    m, n = values.shape
    order = np.tile(np.arange(n), (m, 1))
    if m:
        order[0] = np.lexsort((-values[0].imag, -values[0].real))
    confused = np.zeros((n, n), bool)
    known: list[int] = []  # rows without NaN so far
    for k in range(m):
        if not np.all(np.isfinite(values[k])):
            continue
        if known:
            i = known[-1]
            last, X = values[i, order[i]], vectors[i][:, order[i]]
            ahead = last
            if len(known) > 1:  # along the line through the last two, where these are not much closer
                j = known[-2]
                far, step = at[k] - at[i], at[i] - at[j]
                ahead = last + far / step * (last - values[j, order[j]]) if abs(far) <= 4 * abs(step) > 0 else last
            size = 1e-12 + np.abs(values[k]).max()
            near = np.abs(values[k][None, :] - ahead[:, None]) / size
            alike = np.abs(X.conj().T @ vectors[k])
            change = near + 0.1 * (1.0 - alike)
            columns = linear_sum_assignment(change)[1]
            change = change[:, columns]
            kept = np.diag(change)
            confused |= change + change.T < _MARGIN * (kept[:, None] + kept)
            order[k] = _pairs_in_order(last, values[k], columns)
        known.append(k)
    return order, confused


def _pairs_in_order(last: Any, values: Any, order: Any) -> np.ndarray:
    """The same, where a pair becomes real, or real ones a pair: its upper one and the larger one are of one column."""
    either = pairs(last) | pairs(values[order])
    for i, j in zip(*np.nonzero(either), strict=True):
        new = values[order[[i, j]]]
        alike = [pairs(both).any() or not both.imag.any() for both in (last[[i, j]], new)]
        above = [(x[0].imag, x[0].real) >= (x[1].imag, x[1].real) for x in (last[[i, j]], new)]
        if all(alike) and above[0] != above[1]:
            order[[i, j]] = order[[j, i]]
    return order
