"""Modes of a bicycle along a parameter: eigenvalues followed through crossings, and named by participation factors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import linear_sum_assignment

from ..catalog import WhippleBicycle
from ._eig_of_matrix import Eig

LATERAL = WhippleBicycle.lateral
"""The states of Meijaard et al. (2007); riding straight, the speed does not notice them to first order."""

MODES = ("weave", "weave", "capsize", "castering")
"""Names of the modes of `LATERAL`, in the order of `mode_order`."""

Groups = Mapping[str, Sequence[str]]
_CLEAR = 0.5  # of a mode belongs to its group at least
_MARGIN = 1.5  # by how much more the modes would have to change if two of them changed places


def track_modes(values: Any, spectra: Eig, states: tuple[str, ...], groups: Groups | None):
    """Columns (m, n) that follow each mode along `values` (m,), those with names in their order, and whether (n,) these
    names are clear."""
    shapes = (spectra.values.shape, jnp.int32), (spectra.values.shape[-1:], jnp.bool_)
    return jax.pure_callback(
        lambda *numbers: _track_and_name(numbers, states, groups),
        tuple(jax.ShapeDtypeStruct(*shape) for shape in shapes),
        *jax.lax.stop_gradient((values, spectra.values, spectra.left, spectra.vectors)),
        vmap_method="sequential",
    )


def _track_and_name(numbers: Any, states: tuple[str, ...], groups: Groups | None):
    at, values, left, right = map(np.asarray, numbers)
    order, confused = track(at, values, right)
    clear = np.ones(order.shape[1], bool)
    rows = np.isfinite(values).all(axis=1)
    if groups is not None and rows.any() and mode_names(states, groups) is not None:
        tracked = np.take_along_axis(values, order, axis=1)[rows]
        shares = np.take_along_axis(participation_factors(left, right), order[:, None, :], axis=2)[rows]
        columns, clear = _named_order(tracked, shares, confused, states, groups)
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
    finite: list[int] = []  # rows without NaN so far
    for k in range(m):
        if not np.all(np.isfinite(values[k])):
            continue
        if finite:
            i = finite[-1]
            last, X = values[i, order[i]], vectors[i][:, order[i]]
            ahead = last
            if len(finite) > 1:  # along the line through the last two, where these are not much closer
                j = finite[-2]
                far, step = at[k] - at[i], at[i] - at[j]
                ahead = last + far / step * (last - values[j, order[j]]) if abs(far) <= 4 * abs(step) > 0 else last
            size = 1e-12 + np.abs(values[k]).max()
            near = np.abs(values[k][None, :] - ahead[:, None]) / size
            alike = np.abs(X.conj().T @ vectors[k])
            change = near + 0.1 * (1.0 - alike)
            columns = linear_sum_assignment(change)[1]
            change = change[:, columns]
            own = np.diag(change)
            confused |= change + change.T < _MARGIN * (own[:, None] + own)
            order[k] = _pairs_in_order(last, values[k], columns)
        finite.append(k)
    return order, confused


def _pairs_in_order(last: Any, values: Any, order: Any) -> np.ndarray:
    """Where a pair becomes real, or real ones a pair, its upper one and the larger one are of one column."""
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

    None where the states are not those of `LATERAL` and of the groups, so that nothing is named.
    """
    grouped = [k for members in groups.values() for k in members]
    if sorted((*LATERAL, *grouped)) != sorted(states):
        return None
    return (*MODES, *(name for name, members in groups.items() for _ in members))


def participation_factors(left: Any, right: Any) -> np.ndarray:
    """|conj(left) right|, with a sum of one for each mode: (..., states, modes)."""
    factors = np.abs(np.conj(left) * right)
    return factors / np.maximum(factors.sum(axis=-2, keepdims=True), 1e-300)


def conjugate_pairs(values: Any) -> np.ndarray:
    """Whether (..., n, n) the i-th and the j-th of eigenvalues (..., n) are a conjugate pair, its upper one first."""
    return (values.imag[..., :, None] > 0) & (values[..., :, None] == values[..., None, :].conj())


def _named_order(
    values: np.ndarray, shares: np.ndarray, confused: np.ndarray, states: Sequence[str], groups: Groups
) -> tuple[np.ndarray, np.ndarray]:
    """Columns (n,) of tracked eigenvalues (m, n) in the order of `mode_names`, and whether (n,) each name is clear.

    `shares` (m, states, modes): participation factors; `confused` (n, n): columns that may have changed places. Groups
    get their modes at the value at which the smallest share of a group in a mode of its own is largest. Two groups that
    vibrate with the steer, "wobble" and "front end", are distinguished by their frequencies: the slower one is the
    wobble. A name is clear where at least half of each of its modes belongs to it, no pair has two names, and no mode
    of another name may have changed places with one of its own.
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
    order = _slower_first(order, values[best], groups)
    names = np.array(mode_names(states, groups))
    differ = names[:, None] != names
    split = conjugate_pairs(values[:, order]) & differ
    if split[best].any():
        return order, np.zeros(len(order), bool)
    apart = split.any(axis=0)
    doubtful = ~sure | np.any((confused[np.ix_(order, order)] | apart | apart.T) & differ, axis=1)
    return order, ~np.isin(names, names[doubtful])


def _slower_first(order: np.ndarray, values: np.ndarray, groups: Groups) -> np.ndarray:
    names = mode_names([*LATERAL, *(k for group in groups.values() for k in group)], groups) or ()
    places = [[i for i, name in enumerate(names) if name == each] for each in ("wobble", "front end")]
    if len(places[0]) != len(places[1]):
        return order
    speed = [np.abs(values[order[place]]).min(initial=np.inf) for place in places]
    if speed[1] < speed[0]:
        order = order.copy()
        order[places[0] + places[1]] = order[places[1] + places[0]]
    return order


def mode_order(values: Any) -> np.ndarray:
    """Columns of tracked eigenvalues (m, 4) along the speed in the order of `MODES`.

    The pair that oscillates is the weave, and of the others castering decays faster. At the lowest speeds nothing
    oscillates: where nothing ever does, the two largest are those that would become the weave. Riding backwards is
    riding forwards with time reversed: all decay is growth, that of castering the fastest.
    """
    oscillating = np.abs(values.imag) > 1e-9
    pairs = oscillating.sum(axis=1)
    i = int(np.argmax(pairs == 2)) if (pairs == 2).any() else 0
    row = values[i]
    backwards = row.real.sum() > 1e-9 * np.abs(row).max()
    return np.lexsort((-row.imag, row.real if backwards else -row.real, ~oscillating[i]))
