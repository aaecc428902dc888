"""Riding straight ahead, the canonical matrices of a bicycle, and its modes.

Eigenvalues are followed through crossings and named by participation factors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import linear_sum_assignment

from .._kane.api import equations_of_motion
from .._kane.arguments import is_concrete, is_one_number
from .._scalarjit.components import Component, Numbers
from .._scalarjit.nan import nan_where
from .._system.parameters import text_of, wrapped
from .._system.system import State
from ..catalog import WhippleBicycle
from ._matrix_eigenvalues import Eig
from ._steady import SteadyMotion, jacobian, steady_turn


def straight_ahead(bicycle: WhippleBicycle, speed: Component) -> State | SteadyMotion:
    """The motion of a bicycle that rolls straight ahead and upright at `speed` [m/s], on a slope along x.

    If the bicycle `needs_trim` (drag, rolling resistance or a slope), this is a `steady_turn`. Its "drive_torque" keeps
    the rate of the rear wheel at -speed / rR.

    **Arguments:**

    - `bicycle`: the bicycle.
    - `speed`: the forward speed [m/s].

    **Returns:** a `State`, or a `SteadyMotion` if the bicycle `needs_trim`.

    **Raises:** `ValueError` for a speed that is not finite, a bicycle with a prescribed speed, a road of given height,
    and if the motion does not exist.
    """
    if getattr(getattr(bicycle, "road", None), "curved", False):
        raise ValueError(
            f"{type(bicycle).__name__}: a motion along a Road of given height is not steady, not even on a constant "
            "grade, because coordinates depend on the position. For a constant grade use Slope(angle). The linear "
            "model at one instant is linearize(bicycle, state, inputs, states=bicycle.lateral, steady=False)."
        )
    if "rear_wheel_rate" not in bicycle.speeds:
        raise ValueError(
            f"{type(bicycle).__name__}: riding straight ahead needs rear_wheel_rate as an independent speed; the "
            f"independent speeds are {', '.join(bicycle.speeds)}. If a part prescribes the speed, remove it with "
            "bicycle.with_parts(drive=None): the necessary drive torque is computed."
        )
    if not is_one_number(speed) or (is_concrete(speed) and not np.isfinite(speed)):
        raise ValueError(
            f"straight_ahead({type(bicycle).__name__}): the speed must be one finite number [m/s], got {speed!r}."
        )
    v = jnp.asarray(speed, dtype=jnp.result_type(bicycle.rR))
    wheel = bicycle.speeds.index("rear_wheel_rate")
    u = jnp.zeros(len(bicycle.speeds), v.dtype).at[wheel].set(-v / bicycle.rR)
    q = jnp.zeros(len(bicycle.coordinates), v.dtype)
    if not bicycle.needs_trim:
        return State(q, u)
    upright = dict.fromkeys(("yaw", *(name for name in bicycle.lateral if name in bicycle.coordinates)), 0.0)
    return steady_turn(bicycle, q, u, hold={**upright, "rear_wheel_rate": u[wheel]}, find=("drive_torque",))


class Canonical(eqx.Module):
    """M x_ddot + (C0 + v C1) x_dot + (g K0 + v^2 K2) x = f for x = (roll, steer), f the roll and steer torques.

    Attributes:

    - `M`, `C1`, `K0`, `K2` (2, 2): as in Meijaard et al. (2007), eq. (5.3).
    - `C0` (2, 2): the steer damper's matrix.
    """

    M: Float[Array, "2 2"]
    C1: Float[Array, "2 2"]
    K0: Float[Array, "2 2"]
    K2: Float[Array, "2 2"]
    C0: Float[Array, "2 2"]

    def __repr__(self) -> str:
        units = {"M": "kg m^2", "C1": "kg m", "K0": "kg m", "K2": "kg", "C0": "N m s/rad"}
        items = [f"{name}={text_of(getattr(self, name), unit, ndim=2)}" for name, unit in units.items()]
        return "\n".join(["Canonical", *map(wrapped, items)])


def canonical(bicycle: WhippleBicycle) -> Canonical:
    """The canonical matrices of a bicycle, from the derivatives of its nonlinear equations M u_dot = f.

    -df/dx_dot is linear and -df/dx is quadratic in the speed. Their values at -1, 0 and 1 m/s therefore give the
    matrices without a truncation error. At the upright state, pitch does not change with roll and steer to first order.

    **Raises:** `ValueError` for a bicycle with more speeds or with states, and for one whose equations have other
    terms, e.g. gains that depend on the speed. Under a trace the matrices are NaN instead.
    """
    name = type(bicycle).__name__
    if bicycle.states or bicycle.speeds != WhippleBicycle.speeds:
        raise ValueError(
            f"canonical: {name} has the speeds and states {', '.join((*bicycle.speeds, *bicycle.states))}, but the "
            "canonical equations contain only roll and steer. Use jaxkane.stability.linearize."
        )
    lateral = np.array([0, 2])  # of (roll, rear wheel, steer), both coordinates and speeds

    def stiffness_and_damping(v: Array):
        at = straight_ahead(bicycle, v)

        def f(x: Float[Array, " 4"]):
            q, u = at.q.at[lateral].add(x[:2]), at.u.at[lateral].add(x[2:])
            return equations_of_motion(bicycle, 0.0, q, u)[1][lateral]

        J = jacobian(f, jnp.zeros(4, at.q.dtype))
        return -J[:, :2], -J[:, 2:]

    still = straight_ahead(bicycle, 0.0)
    M, _ = equations_of_motion(bicycle, 0.0, still.q, still.u)
    K, C = jax.lax.map(stiffness_and_damping, jnp.array([-1.0, 0.0, 1.0, 2.0], still.q.dtype))
    C1, K2 = (C[2] - C[0]) / 2, (K[2] + K[0]) / 2 - K[1]
    # zero if the equations have only these terms
    off = jnp.stack([K[3] - K[1] - 4 * K2, C[3] - C[1] - 2 * C1, C[2] - C[1] - C1, K[2] - K[0]])
    has_other_terms = ~(
        jnp.max(jnp.abs(off)) < jnp.finfo(K.dtype).eps ** 0.5 * jnp.max(jnp.abs(jnp.stack([K[3], C[3]])))
    )
    if is_concrete(has_other_terms) and has_other_terms:
        raise ValueError(
            f"canonical: the equations of {name} contain terms of the speed other than C0 + v C1 and K0 + v^2 K2. Use "
            "jaxkane.stability.linearize at one speed."
        )
    matrices = (M[np.ix_(lateral, lateral)], C1, K[1] / bicycle.g, K2, C[1])
    return Canonical(*(nan_where(has_other_terms, each, bicycle) for each in matrices))


LATERAL = WhippleBicycle.lateral
"""The states of Meijaard et al. (2007); riding straight, they do not affect the speed to first order."""

MODES = ("weave", "weave", "capsize", "castering")
"""Names of the modes of `LATERAL`, in the order of `mode_order`."""

Groups = Mapping[str, Sequence[str]]
_CLEAR = 0.5  # the least share of a mode that must belong to its group
_MARGIN = 1.5  # two modes may have been exchanged if the exchange has less than this factor times the change


def track_modes(values: Numbers, spectra: Eig, states: tuple[str, ...], groups: Groups | None):
    """Columns of the modes along `values` (m,), for `eigenvalues` and `critical_speeds`.

    **Returns:**

    - `order` (m, n): the columns that follow each mode. Modes with names are in the order of `mode_names`.
    - `clear` (n,): whether the name of each mode is clear.
    - `number` (n,): the number of each mode, counted from 0. Both eigenvalues of a conjugate pair have the number of
      the upper one if they are a pair at all values.
    """
    n = spectra.values.shape[-1:]
    shapes = (spectra.values.shape, jnp.int32), (n, jnp.bool_), (n, jnp.int32)
    return jax.pure_callback(
        lambda *numbers: _track_and_name(numbers, states, groups),
        tuple(jax.ShapeDtypeStruct(*shape) for shape in shapes),
        *jax.lax.stop_gradient((values, spectra.values, spectra.left, spectra.vectors)),
        vmap_method="sequential",
    )


def _track_and_name(numbers: Sequence[Array], states: tuple[str, ...], groups: Groups | None):
    at, values, left, right = map(np.asarray, numbers)
    order, confused = track(at, values, right)
    clear = np.ones(order.shape[1], bool)
    rows = np.isfinite(values).all(axis=1)
    if groups is not None and rows.any() and mode_names(states, groups) is not None:
        tracked = np.take_along_axis(values, order, axis=1)[rows]
        factors = np.abs(np.conj(left) * right)  # participation factors, with a sum of one for each mode
        factors = factors / np.maximum(factors.sum(axis=-2, keepdims=True), 1e-300)
        shares = np.take_along_axis(factors, order[:, None, :], axis=2)[rows]
        columns, clear = _named_order(tracked, shares, confused, states, groups)
        order = order[:, columns]
    number = _numbers(np.take_along_axis(values, order, axis=1)[rows])
    return order.astype(np.int32), clear, number.astype(np.int32)


def _numbers(values: np.ndarray) -> np.ndarray:
    """The number (n,) of each mode. Two eigenvalues that are a pair in all rows (m, n) get the number of the upper
    one."""
    number = np.arange(values.shape[1])
    upper = conjugate_pairs(values)
    for i, j in zip(*np.nonzero((upper | upper.swapaxes(1, 2)).all(axis=0) & upper[:1].any(axis=0)), strict=True):
        number[j] = i
    return number


def track(at: Numbers, values: Numbers, vectors: Numbers) -> tuple[np.ndarray, np.ndarray]:
    """Continue eigenvalues and eigenvectors from row to row.

    **Arguments:**

    - `at` (m,): the values of the parameter.
    - `values` (m, n), `vectors` (m, n, n): eigenvalues and eigenvectors in each row.

    **Returns:** the order (m, n) in which each row continues the row above, and whether (n, n) two columns may have
    been exchanged somewhere.
    """
    at, values, vectors = map(np.asarray, (at, values, vectors))
    m, n = values.shape
    order = np.tile(np.arange(n), (m, 1))
    if m:
        order[0] = np.lexsort((-values[0].imag, -values[0].real))
    confused = np.zeros((n, n), bool)
    finite: list[int] = []  # rows without NaN
    for k in range(m):
        if not np.all(np.isfinite(values[k])):
            continue
        if finite:
            i = finite[-1]
            last, X = values[i, order[i]], vectors[i][:, order[i]]
            ahead = last
            # extrapolate from the last two rows, unless these are much closer together than the new one
            if len(finite) > 1:
                j = finite[-2]
                far, step = at[k] - at[i], at[i] - at[j]
                ahead = last + far / step * (last - values[j, order[j]]) if abs(far) <= 4 * abs(step) > 0 else last
            size = 1e-12 + np.abs(values[k]).max()
            near = np.abs(values[k][None, :] - ahead[:, None]) / size
            alike = np.abs(X.conj().T @ vectors[k])
            change = near + 0.1 * (1.0 - alike)
            columns = _assigned(change, last, values[k])
            change = change[:, columns]
            own = np.diag(change)
            confused |= change + change.T < _MARGIN * (own[:, None] + own)
            order[k] = _pairs_in_order(last, values[k], columns)
        finite.append(k)
    return order, confused


def _assigned(change: np.ndarray, last: np.ndarray, values: np.ndarray) -> np.ndarray:
    # The indices (n,) in `values` (n,) that continue those of `last` (n,), with the least sum of `change` (n, n).
    #
    # A pair is continued by a pair or by two real eigenvalues. If the least sum splits a pair, as in a coarse step, as
    # many pairs as possible are continued by pairs. Example: for Sharp's motorcycle from 10 to 20 m/s, the weave would
    # otherwise be continued by a real eigenvalue and by one of the next pair.
    columns = linear_sum_assignment(change)[1]
    old, new = conjugate_pairs(last), conjugate_pairs(values)

    def keeps(pairs: np.ndarray, x: Numbers) -> bool:
        """Whether each pair is continued by a pair or by two real eigenvalues, if x is in its order."""
        return all(not (x.imag[i] or x.imag[j]) or x[i] == x[j].conj() for i, j in np.argwhere(pairs))

    if keeps(old, values[columns]) and keeps(new, last[np.argsort(columns)]):
        return columns
    (upper, lower), (new_upper, new_lower) = np.nonzero(old), np.nonzero(new)
    of_pairs = change[np.ix_(upper, new_upper)] + change[np.ix_(lower, new_lower)]
    a, b = linear_sum_assignment(of_pairs)
    columns = np.full(len(last), -1)
    columns[upper[a]], columns[lower[a]] = new_upper[b], new_lower[b]
    others, free = np.flatnonzero(columns < 0), np.setdiff1d(np.arange(len(last)), columns)
    columns[others] = free[linear_sum_assignment(change[np.ix_(others, free)])[1]]
    return columns


def _pairs_in_order(last: Numbers, values: Numbers, order: np.ndarray) -> np.ndarray:
    # Order pairs by their upper eigenvalue. If a pair becomes real or conversely, the upper one continues the larger
    # one.
    either = conjugate_pairs(last) | conjugate_pairs(values[order])
    for i, j in zip(*np.nonzero(either), strict=True):
        new = values[order[[i, j]]]
        alike = [conjugate_pairs(both).any() or not both.imag.any() for both in (last[[i, j]], new)]
        above = [(x[0].imag, x[0].real) >= (x[1].imag, x[1].real) for x in (last[[i, j]], new)]
        if all(alike) and above[0] != above[1]:
            order[[i, j]] = order[[j, i]]
    return order


def mode_names(states: Sequence[str], groups: Groups) -> tuple[str, ...] | None:
    """Names of the modes of a bicycle that rides straight: those of the bicycle, then one for each state of a group.

    None if the states are not those of `LATERAL` and of the groups; modes are then numbered.
    """
    grouped = [k for members in groups.values() for k in members]
    if sorted((*LATERAL, *grouped)) != sorted(states):
        return None
    return (*MODES, *(name for name, members in groups.items() for _ in members))


def conjugate_pairs(values: Numbers) -> np.ndarray:
    """Whether (..., n, n) the i-th and j-th of eigenvalues (..., n) are a conjugate pair; the i-th has the positive
    imaginary part."""
    return (values.imag[..., :, None] > 0) & (values[..., :, None] == values[..., None, :].conj())


def _named_order(
    values: np.ndarray, shares: np.ndarray, confused: np.ndarray, states: Sequence[str], groups: Groups
) -> tuple[np.ndarray, np.ndarray]:
    """Assign names to tracked eigenvalues.

    Modes are assigned to groups at one value of the parameter: where the smallest share of a group in its own modes is
    largest. Two groups that vibrate with the steer, "wobble" and "front end", are distinguished by their frequencies:
    the slower one is the wobble. A name is clear if three conditions are met. At least half of each of its modes
    belongs to it. No pair has two names. None of its modes may have been exchanged with a mode of another name.

    **Arguments:**

    - `values` (m, n): tracked eigenvalues.
    - `shares` (m, states, modes): participation factors.
    - `confused` (n, n): columns that may have been exchanged.
    - `states`: names of the states.
    - `groups`: names of states by group.

    **Returns:** the columns (n,) in the order of `mode_names`, and whether (n,) each name is clear.
    """
    members = [[states.index(k) for k in group] for group in (LATERAL, *groups.values())]
    owner = np.repeat(np.arange(len(members)), [len(group) for group in members])  # of each slot
    of_groups = np.stack([shares[:, group].sum(axis=1) for group in members], axis=1)  # (m, groups, modes)
    assigned = [linear_sum_assignment(-row[owner])[1] for row in of_groups]
    own_share = np.stack([row[owner, slots] for row, slots in zip(of_groups, assigned, strict=True)])  # (m, n)
    best = int(np.argmax(own_share.min(axis=1)))
    order, sure = assigned[best], own_share[best] >= _CLEAR
    own = order[: len(LATERAL)]
    order[: len(LATERAL)] = own[mode_order(values[:, own])]
    names = np.array(mode_names(states, groups))
    wobble, front = (np.flatnonzero(names == each) for each in ("wobble", "front end"))
    slowest = [np.abs(values[best][order[place]]).min(initial=np.inf) for place in (wobble, front)]
    if len(wobble) == len(front) and slowest[1] < slowest[0]:
        order[np.append(wobble, front)] = order[np.append(front, wobble)]
    differ = names[:, None] != names
    split = conjugate_pairs(values[:, order]) & differ
    if split[best].any():  # keep the order of `track`, in which pairs are adjacent
        return np.arange(len(order)), np.zeros(len(order), bool)
    apart = split.any(axis=0)
    doubtful = ~sure | np.any((confused[np.ix_(order, order)] | apart | apart.T) & differ, axis=1)
    return order, ~np.isin(names, names[doubtful])


def mode_order(values: Numbers) -> np.ndarray:
    """Columns of tracked eigenvalues (m, 4) along the speed in the order of `MODES`.

    The pair that oscillates is the weave. Of the other two, castering decays faster. At the lowest speeds no mode
    oscillates. If no mode oscillates at any speed, the two largest are the weave. Riding backwards is riding forwards
    with time reversed: decay becomes growth, and castering grows fastest.
    """
    oscillating = np.abs(values.imag) > 1e-9
    pairs = oscillating.sum(axis=1)
    i = int(np.argmax(pairs == 2)) if (pairs == 2).any() else 0
    row = values[i]
    backwards = row.real.sum() > 1e-9 * np.abs(row).max()
    return np.lexsort((-row.imag, row.real if backwards else -row.real, ~oscillating[i]))
