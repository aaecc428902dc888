"""Chunks on the workers of a Dask cluster. Knows Dask's client; schedules nothing itself.

A class or function of a module that can be imported travels by its name, and a worker that has imported it before has
the numbers and the code of that time. So each worker receives the digest of the program, and refuses to compute
another.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._scalars import native as kernels
from .._scalars.versions import on_forget, version_of
from ._fingerprint import traced, versions
from ._solve import Job, Part

_FLAGS = ("jax_enable_x64", "jax_numpy_dtype_promotion", "jax_numpy_rank_promotion")
_ANOTHER = (
    "sweep: this worker would compute another program than the one asked for. Functions and classes of a module that "
    "can be imported travel by name, and here the module has other numbers or other code: a global was changed after "
    "the import, or the file was. Make it a parameter of the system; or change it on the workers too, "
    "`client.run(...)`; or start them anew; or let the module travel whole: `cloudpickle.register_pickle_by_value`."
)


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
    sent = jax.tree.map(_as_numpy, dataclasses.replace(job, mesh=None))
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), members_at(0))
    common = cloudpickle.dumps((sent, like))
    program = _program(jax.tree.map(_as_jax, sent), like)
    flags = {name: getattr(jax.config, name) for name in _FLAGS}
    with_kernels = kernels.is_on()
    left, tasks = iter(starts), {}
    finished = as_completed()

    def submit() -> None:
        # Twice as many as there are threads keep all of them busy; a cluster may grow meanwhile.
        while len(tasks) < max(2 * sum(client.nthreads().values()), 2):
            start = next(left, None)
            if start is None:
                return
            own = cloudpickle.dumps(members_at(start))
            task = client.submit(solve_elsewhere, common, own, size, flags, with_kernels, program, pure=False)
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


def solve_elsewhere(
    common: bytes, own: bytes, size: int, flags: dict[str, Any], native: bool, program: tuple[str, str]
) -> Part:
    """A chunk, on a worker; arrays of numpy go there and come back.

    **Raises:** `RuntimeError` where this worker would compute something else than `program`.
    """
    import cloudpickle

    for name, value in flags.items():
        if getattr(jax.config, name) != value:
            jax.config.update(name, value)
    kernels.use(native)
    if native and not kernels.is_on():
        raise RuntimeError(
            f"This worker has no native kernels, and would round differently: {kernels.why_not()}. Or call "
            "jaxkane.configure(native=False) where the sweep is started."
        )
    job, _ = _received(common)
    libraries, computed = _program_here(common, version_of(job))
    if libraries == program[0] and computed != program[1]:  # what another JAX has traced cannot be compared
        raise RuntimeError(_ANOTHER)
    part = job.solve(cloudpickle.loads(own), size)
    return jax.tree.map(np.asarray, part)


def _program(job: Job, like: Any) -> tuple[str, str]:
    """The libraries with which a program is traced, and the digest of what it computes for one member."""
    return repr(versions()), traced(job, like)[0]


@functools.lru_cache(maxsize=8)
def _program_here(common: bytes, version: bytes) -> tuple[str, str]:
    """`_program` on a worker, once for all chunks; `version` is that of what its code reads now."""
    return _program(*_received(common))


@functools.lru_cache(maxsize=8)
def _received(common: bytes) -> tuple[Job, Any]:
    # Once for all chunks: functions that are unpickled anew would be compiled anew.
    import cloudpickle

    job, like = cloudpickle.loads(common)
    return jax.tree.map(_as_jax, job), like


for _memory in (_received, _program_here):
    on_forget(_memory.cache_clear)


def _as_numpy(x: Any) -> Any:
    return np.asarray(x) if isinstance(x, jax.Array) else x


def _as_jax(x: Any) -> Any:
    return jnp.asarray(x) if isinstance(x, np.ndarray) else x
