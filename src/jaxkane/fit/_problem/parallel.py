"""One fit by several processes: each simulates a share of the windows, all take the same steps.

What a process has found out about its windows, their triangles (which say what J^T J and J^T r say, see `_blocks`), is
handed to all others. From there on every process does the same with the same numbers: there is no main process, and the
result is that of one process alone.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..._scalars.jax_internals import process_allgather
from .._data.windows import Windows
from .blocks import Blocks
from .model import Model, Seen, Unknowns
from .programs import blocks_of, costs_of


def blocks_of_all(
    model: Model, windows: Windows, by_trial: Array, point: Unknowns, starts: Array, starts_dot: Array
) -> tuple[Blocks, Seen]:
    """`blocks_of`, by all processes together."""

    def own(windows, point, starts, starts_dot):
        blocks, seen = blocks_of(model, windows, by_trial, point, starts, starts_dot)
        return blocks.R, seen

    R, seen = _by_all(own, windows, point, starts, starts_dot)
    n_z, n_b = point.z.shape[1], point.b.shape[1]
    return Blocks(R, by_trial, n_z, n_z if model.nuisance.chained else 0, n_b), seen


def costs_of_all(model: Model, windows: Windows, point: Unknowns, starts: Array) -> tuple[Array, Seen]:
    """`costs_of`, by all processes together."""
    return _by_all(lambda *share: costs_of(model, *share), windows, point, starts)


def check_same(model: Model, windows: Windows) -> None:
    """Refuse processes that pose different problems.

    **Raises:** `ValueError`, in all of them.
    """
    sha = hashlib.sha256()
    for leaf in jax.tree.leaves((model, windows)):
        if isinstance(leaf, (jax.Array, np.ndarray)):
            sha.update(str(leaf.shape).encode() + np.ascontiguousarray(leaf).tobytes())
    own = np.frombuffer(sha.digest(), dtype=np.uint32)
    if not np.all(np.asarray(process_allgather(own)) == own):
        raise ValueError(
            "fit(..., processes=True): the processes pose different problems. Give every process the same system, the "
            "same initial guesses and all trials, in the same order; each takes its share of them."
        )


def _by_all(evaluate: Callable[..., Any], windows: Windows, point: Unknowns, *more: Array) -> Any:
    """evaluate(windows, point, *more) -> arrays (W, ...), each process for a share of the windows."""
    W = windows.trial.shape[0]
    m = -(-W // jax.process_count())
    # One more than its share, since a window is compared with the start of the next.
    share = (jax.process_index() * m + np.arange(m + 1)) % W
    windows, z, more = jax.tree.map(lambda x: x[share], (windows, point.z, more))
    found = evaluate(windows, Unknowns(point.x, point.b, z), *more)
    found = process_allgather(jax.tree.map(lambda x: np.asarray(x)[:m], found), tiled=True)
    return jax.tree.map(lambda x: jnp.asarray(x[:W]), found)
