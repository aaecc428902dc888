"""Whether programs become native kernels: what is wanted, and what this machine can do. Knows no programs."""

from __future__ import annotations

import functools
import os
import threading
import warnings

import jax

from . import probe
from .machine import Machine, without_llvm

_ON, _OFF = ("", "1", "true", "yes", "on"), ("0", "false", "no", "off")


def switched_on(word: str) -> bool:
    """What JAXKANE_NATIVE says in the environment; where it is empty, it is as if it were not set."""
    if word.strip().lower() not in (*_ON, *_OFF):
        raise ValueError(f"JAXKANE_NATIVE={word!r} in the environment: it is one of {', '.join((*_ON[1:], *_OFF))}.")
    return word.strip().lower() in _ON


_wanted = switched_on(os.environ.get("JAXKANE_NATIVE", ""))
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
