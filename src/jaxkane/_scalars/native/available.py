"""Whether programs become native kernels: what is wanted, and what this machine can do. Knows no programs."""

from __future__ import annotations

import functools
import os
import threading
import warnings

import jax

from . import probe
from .machine import Machine, without_llvm

_wanted = os.environ.get("JAXKANE_NATIVE", "1") != "0"
_lock = threading.RLock()
_told: set[str] = set()


def machine() -> Machine:
    with _lock:
        return _machine()


@functools.cache
def _machine() -> Machine:
    return Machine()


def use(native: bool) -> None:
    """Whether programs that are compiled from now on become machine code through LLVM, or XLA's."""
    global _wanted
    if native != _wanted:
        _wanted = native
        jax.clear_caches()
    os.environ["JAXKANE_NATIVE"] = str(int(native))


def is_wanted() -> bool:
    return _wanted


def is_on() -> bool:
    """Whether programs become native kernels. A machine that has LLVM but fails the probe is told of, once."""
    if not _wanted or _without_llvm():
        return False
    why = why_not()
    if why:
        tell(why)
    return why is None


def why_not() -> str | None:
    """Why this process cannot have native kernels; None where it can."""
    return _without_llvm() or _refused()


def tell(why: str) -> None:
    """Warn that XLA does the work of native kernels; once for each reason."""
    with _lock:
        is_new = why not in _told
        _told.add(why)
    if is_new:
        warnings.warn(f"jaxkane: no native kernels, XLA does their work: {why}.", UserWarning, stacklevel=3)


@functools.cache
def _without_llvm() -> str | None:
    return without_llvm()


def _refused() -> str | None:
    with _lock:
        return _verdict()


@functools.cache
def _verdict() -> str | None:
    try:
        return probe.verdict(machine())
    except RuntimeError as error:  # as llvmlite says that LLVM does not know this processor
        return f"LLVM does not work here: {error}"
