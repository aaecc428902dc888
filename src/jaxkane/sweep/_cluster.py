"""Chunks on the workers of a Dask cluster. Knows Dask's client; schedules nothing itself."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import _native
from .._reads import on_forget
from ._solve import Job, Part

_FLAGS = ("jax_enable_x64", "jax_numpy_dtype_promotion", "jax_numpy_rank_promotion")


def on_cluster(
    job: Job, starts: list[int], members_at: Callable[[int], Any], size: int, client: Any
) -> Iterator[tuple[int, Part]]:
    """(start, part) of every chunk, as they are finished. A task whose worker dies is given to another by Dask."""
    try:
        import cloudpickle
        from distributed import as_completed
    except ImportError as error:
        raise ImportError("sweep(..., client=...) needs Dask: pip install 'jaxkane[cluster]'") from error

    # Arrays travel as numpy's: JAX's would be read before the worker knows their precision.
    common = cloudpickle.dumps(jax.tree.map(_as_numpy, dataclasses.replace(job, mesh=None)))
    flags = {name: getattr(jax.config, name) for name in _FLAGS}
    kernels = _native.is_on()
    left, tasks = iter(starts), {}
    finished = as_completed()

    def submit() -> None:
        # Twice as many as there are threads keep all of them busy; a cluster may grow meanwhile.
        while len(tasks) < max(2 * sum(client.nthreads().values()), 2):
            start = next(left, None)
            if start is None:
                return
            own = cloudpickle.dumps(members_at(start))
            task = client.submit(solve_elsewhere, common, own, size, flags, kernels, pure=False)
            tasks[task.key] = start
            finished.add(task)

    try:
        submit()
        while tasks:
            task = next(finished)
            yield tasks[task.key], task.result()
            del tasks[task.key]
            task.release()
            submit()
    finally:
        client.cancel([task for task in finished.futures if task.key in tasks])


def solve_elsewhere(common: bytes, own: bytes, size: int, flags: dict[str, Any], native: bool) -> Part:
    """A chunk, on a worker; arrays of numpy go there and come back."""
    import cloudpickle

    for name, value in flags.items():
        if getattr(jax.config, name) != value:
            jax.config.update(name, value)
    _native.use(native)
    if native and not _native.is_on():
        raise RuntimeError(
            f"This worker has no native kernels, and would round differently: {_native.why_not()}. Or call "
            "jaxkane.configure(native=False) where the sweep is started."
        )
    part = _job(common).solve(cloudpickle.loads(own), size)
    return jax.tree.map(np.asarray, part)


@functools.lru_cache(maxsize=8)
def _job(common: bytes) -> Job:
    # Once for all chunks: functions that are unpickled anew would be compiled anew.
    import cloudpickle

    return jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, np.ndarray) else x, cloudpickle.loads(common))


on_forget(_job.cache_clear)


def _as_numpy(x: Any) -> Any:
    return np.asarray(x) if isinstance(x, jax.Array) else x
