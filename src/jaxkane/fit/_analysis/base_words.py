"""Base parameters in the words of the system: factors that are products of its lengths. Knows regressors."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from ..._description.parameters import leaf_name
from .._result.base_parameters import BaseParameters, sum_in_words
from .base_structure import equations_at
from .columns import Chosen
from .instants import Instants


def with_lengths(found: BaseParameters, chosen: Chosen, states: Instants) -> tuple[str, ...]:
    """The texts, with factors that are products of powers of the system's parameters written as these: `length^2`."""
    others = [i for i in range(len(found.names)) if i not in found.places and np.any(found.matrix[:, i])]
    if not others:
        return found.texts
    B = found.matrix[:, others]
    numbered = B != 0.0
    numbers: list[tuple[str, float, np.ndarray]] = []
    with_path, structure = jax.tree_util.tree_flatten_with_path(chosen.system)
    leaves = [leaf for _, leaf in with_path]
    for k, (path, leaf) in enumerate(with_path):
        if np.ndim(leaf) or not jnp.issubdtype(leaf.dtype, jnp.floating) or not float(leaf):
            continue
        other = [*leaves[:k], leaf * 1.1, *leaves[k + 1 :]]
        _, Y, _, _ = equations_at(chosen.of(jax.tree.unflatten(structure, other)), states)
        W = Y.reshape(-1, len(found.names))
        now = np.linalg.lstsq(W[:, found.places], W[:, others], rcond=None)[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            powers = np.where(numbered, np.log(now / B) / np.log(1.1), 0.0)
        if np.any(np.abs(powers) > 1e-5) or not np.all(np.isfinite(powers)):
            numbers.append((leaf_name(path), float(leaf), powers))
    texts = []
    for j, place in enumerate(found.places):
        sizes = [f"{abs(x):.4g}" for x in found.matrix[j]]
        for c, i in enumerate(others):
            if numbered[j, c]:
                of_this = [(name, value, powers[j, c]) for name, value, powers in numbers]
                sizes[i] = _product(abs(B[j, c]), of_this) or sizes[i]
        texts.append(sum_in_words(found.names, found.matrix[j], place, sizes))
    return tuple(texts)


def _product(size: float, powers: Sequence[tuple[str, float, float]]) -> str:
    """`2 L1^2 L2`; nothing where a power is not whole, or the number before it is none of a few."""
    words = []
    for name, value, power in powers:
        whole = round(power) if np.isfinite(power) else 0
        if not np.isfinite(power) or abs(power - whole) > 1e-4:
            return ""
        if whole:
            words.append(name if whole == 1 else f"{name}^{whole}")
            size /= abs(value) ** whole
    near = [number for number in (1.0, 2.0, 0.5, 0.25, 4.0) if abs(size - number) < 1e-6 * number]
    if not words or not near:
        return ""
    return " ".join([f"{near[0]:g}"] * (near[0] != 1.0) + words)
