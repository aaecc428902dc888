"""Processes of their own: with as many threads as asked for, native kernels on or off, the rest as it is."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[1]
_THREADS = (
    "OMP_NUM_THREADS OPENBLAS_NUM_THREADS MKL_NUM_THREADS NUMEXPR_NUM_THREADS VECLIB_MAXIMUM_THREADS NPROC".split()
)


class Setting(NamedTuple):
    """How a part is to be measured: `native` kernels, on so many `devices` with a core each; `quick` for a look that
    only shows that everything runs; `folder` for what is generated."""

    native: bool = False
    devices: int = 1
    quick: bool = False
    folder: str = "figures"

    @property
    def column(self) -> str:
        return "native" if self.native else "XLA"

    def pick(self, xla: Any, native: Any) -> Any:
        """Of two targets that of this column."""
        return native if self.native else xla


def environment(cores: int | None = 1) -> dict[str, str]:
    """The environment of a child that may use so many threads; None for all."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "EQX_", "XLA_"))}
    kept["PYTHONPATH"] = os.pathsep.join([str(ROOT), *filter(None, [kept.get("PYTHONPATH")])])
    if cores is not None:
        kept |= dict.fromkeys(_THREADS, str(cores))
    if cores == 1:
        kept["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    return kept


def child(module: str, arguments: Sequence[str] = (), *, cores: int | None = 1) -> Iterator[Any]:
    """What `python -m module arguments`, bound to so many cores, prints as lines of JSON; other lines pass by.

    **Raises:** `RuntimeError` with what it said last, where it fails.
    """
    command = [sys.executable, "-m", module, *arguments]
    with tempfile.TemporaryFile("w+", encoding="utf-8") as said:
        with bound(cores):
            run = subprocess.Popen(
                command, env=environment(cores), cwd=ROOT, stdout=subprocess.PIPE, stderr=said, text=True
            )
        assert run.stdout is not None
        with run:
            for line in run.stdout:
                if line.startswith(("{", "[")):
                    yield json.loads(line)
        if run.returncode:
            said.seek(0)
            raise RuntimeError(f"{' '.join(command[1:])} failed:\n{said.read()[-2000:]}")


def answer(module: str, arguments: Sequence[str] = (), *, cores: int | None = 1) -> Any:
    """The last line of `child`; None where it has nothing to say."""
    *_, last = [None, *child(module, arguments, cores=cores)]
    return last


@contextlib.contextmanager
def bound(cores: int | None) -> Iterator[None]:
    """What is started meanwhile is bound to so many cores, where the system can do that."""
    if cores is None or not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(before)[-cores:])  # not the first, where the system's own work is done
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def configure(setting: Setting, cache: str | bool = False) -> None:
    """jaxkane's settings for a measurement."""
    import jax

    import jaxkane as jk

    jk.configure(cache=cache, devices=setting.devices, native=setting.native, verbose=False)
    # Without a thread in between, calls from Python are three to five times faster; sweeps do not care.
    jax.config.update("jax_cpu_enable_async_dispatch", setting.devices > 1)
