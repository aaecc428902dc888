"""Which mode is which: by how much the states of each group take part in it. Knows eigenvectors; knows no mechanism.

The participation of a state k in a mode is |y_k x_k| of its left and right eigenvectors y and x, over the sum of all
states. It does not depend on units, and sums to one (Perez-Arriaga, Verghese and Schweppe 1982).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from ._bicycle import LATERAL, MODES, mode_order

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
