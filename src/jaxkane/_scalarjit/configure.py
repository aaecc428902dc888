"""The settings of JAX for a process, by one explicit call. Does not depend on mechanics."""

from __future__ import annotations

import dataclasses
import functools
import os
import warnings
from pathlib import Path
from typing import Any

import jax
import numpy as np

from .._common.files import remove_broken_programs
from .._common.lookup import whole_number
from . import native as kernels
from .compat import backends_are_initialized, reset_cache


@dataclasses.dataclass(frozen=True)
class Configuration:
    """The settings that `configure` has made.

    - `float64`: whether double precision is enabled.
    - `cache`: the folder of compiled programs, or None.
    - `devices`: the number of CPU devices, or None if JAX chooses.
    - `native`: whether right-hand sides are native kernels.
    """

    float64: bool
    cache: Path | None
    devices: int | None
    native: bool


_last: Configuration | None = None
_jax: Any = jax.config  # JAX does not declare the attributes


def configure(
    *,
    float64: bool = True,
    cache: bool | str | os.PathLike[str] = True,
    devices: int | None = None,
    native: bool | None = None,
    verbose: bool = True,
) -> Configuration:
    """Set up this process: one call at the top of a script, before anything is computed.

        import jaxkane as jk
        jk.configure()

    With a cache, equinox's numerical checks return NaN instead of raising in programs that jaxkane compiles. A program
    that calls back into Python cannot be stored. jaxkane raises its own exceptions outside of programs, and its
    simulations have a status. A function that jaxkane calls in such a program, e.g. a controller, also gets NaN from
    `equinox.error_if`, diffrax, lineax and optimistix. Programs that you compile yourself still raise.

    No option of the compiler is set globally. Options that a program needs are set where it is compiled.

    **Arguments:**

    - `float64`: double precision (`jax_enable_x64`), which mechanics needs.
    - `cache`: store compiled programs on disk, so that the next process does not compile them again. True: JAX's folder
        if one is set, else `jaxkane` in the user's cache folder. Or a folder, or False.
    - `devices`: split the CPU into this many devices, which a sweep uses in parallel; at most one for each core is
        useful. Default: JAX's choice, which is one unless XLA_FLAGS sets another number.
    - `native`: compile right-hand sides and their derivatives to machine code by LLVM (llvmlite), called by XLA, on the
        CPU only. Default: True if llvmlite is installed, unless the environment has JAXKANE_NATIVE=0 (or false, no,
        off). With False XLA compiles everything. Both agree within rounding.
    - `verbose`: print a few lines about the settings; repeated calls print them once.

    **Returns:** a `Configuration`. Child processes, such as Dask's workers, inherit precision, cache and kernels by
    their environment.

    **Warns:** if the call comes too late (float32 arrays exist, or JAX has started with other devices), if
    `native=True` is not possible on this machine, and if the folder of the cache cannot be created or written. Programs
    are then not stored.
    """
    global _last
    flag = bool, np.bool_
    kinds = {"float64": flag, "native": (*flag, type(None)), "cache": (bool, str, os.PathLike)}
    for (name, kind), value in zip(kinds.items(), (float64, native, cache), strict=True):
        if not isinstance(value, kind):
            folder = "a folder, " * (name == "cache")
            raise TypeError(f"configure: `{name}` must be {folder}True or False, got {value!r}.")
    made = 0
    if float64 and not _jax.jax_enable_x64 and backends_are_initialized():  # `live_arrays` would start JAX
        made = sum(array.dtype == np.float32 for array in jax.live_arrays())
    jax.config.update("jax_enable_x64", bool(float64))
    os.environ["JAX_ENABLE_X64"] = str(int(float64))
    if made:
        warnings.warn(
            f"jaxkane.configure was called too late: {made} float32 array{'s exist' if made > 1 else ' exists'} and "
            "will not become float64. Call it right after the imports, before you make a system, a state or an array.",
            UserWarning,
            stacklevel=2,
        )
    folder = _made_folder(cache) if cache else None
    if folder is not None or _jax.jax_compilation_cache_dir:
        _store_programs(folder)
    if devices is not None:
        _split_cpu(devices)
    if native is not None:
        kernels.use(native)
    if native and (why := kernels.why_not()):
        kernels.warn_not_native(why)
    done = Configuration(bool(float64), folder, devices, kernels.is_on())
    if verbose and done != _last:
        print(_summary(done))
    _last = done
    return done


@functools.cache
def warn_of_float32() -> None:
    """Warn once if float64 is not enabled, and neither `configure` nor the environment has chosen this."""
    if _last or _jax.jax_enable_x64 or "JAX_ENABLE_X64" in os.environ:
        return
    warnings.warn(
        "This simulation is in float32, because float64 is not enabled. Call jaxkane.configure() right after the "
        "imports, or jaxkane.configure(float64=False) to use float32 without this warning.",
        UserWarning,
        stacklevel=3,
    )


def _split_cpu(devices: int) -> None:
    devices = whole_number(devices, 1, "configure: `devices`")
    if not backends_are_initialized():
        jax.config.update("jax_num_cpu_devices", devices)
        return
    there = len(jax.local_devices(backend="cpu"))
    if there != devices:
        warnings.warn(
            f"jaxkane.configure was called too late for devices={devices}: JAX has started with {there}. Call it "
            "before JAX computes anything. In a notebook, restart the kernel first.",
            UserWarning,
            stacklevel=3,
        )


def _made_folder(cache: bool | str | os.PathLike[str]) -> Path | None:
    """The folder of the cache; None, with a warning, if it cannot be created, e.g. in a read-only home."""
    home = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA") or "~/.cache"
    folder = Path(_jax.jax_compilation_cache_dir or Path(home, "jaxkane") if isinstance(cache, bool) else cache)
    try:
        folder = folder.expanduser().absolute()
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            remove_broken_programs(folder)
            return folder
        why = "it cannot be written"
    except (FileExistsError, NotADirectoryError):
        raise ValueError(
            f"configure: cache={str(folder)!r} is a file, or is inside one. Pass the name of a folder."
        ) from None
    except (OSError, RuntimeError) as error:  # RuntimeError: there is no home
        why = str(error)
    warnings.warn(
        f"jaxkane.configure: compiled programs cannot be stored in {folder} ({why}). Each process compiles them again. "
        "Pass a folder with write permission as configure(cache=...), or pass cache=False.",
        UserWarning,
        stacklevel=3,
    )
    return None


def _store_programs(folder: Path | None) -> None:
    """Keep every compiled program in a folder, also in child processes. None: keep no programs."""
    _jax.update("jax_compilation_cache_dir", folder and str(folder))
    os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)
    if folder is not None:
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
        for name, value in _KEPT.items():
            _jax.update(name, value)
            os.environ[name.upper()] = str(value)
    reset_cache()  # JAX looks for a folder once, at its first compilation


_KEPT = {
    "jax_enable_compilation_cache": True,
    # Also small programs: reading one takes a fifth of its compilation time.
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": 0,
}


def _summary(done: Configuration) -> str:
    text = f"jaxkane: {'float64' if done.float64 else 'float32'}"
    if done.devices is not None:
        text += f", {done.devices} CPU device{'s' if done.devices > 1 else ''}"
    why = kernels.why_not() if kernels.is_wanted() else "switched off"
    text += ", native kernels" if done.native else f", no native kernels ({why})"
    if done.cache is None:
        return f"{text}; compiled programs are not stored."
    sizes = [entry.stat().st_size for entry in os.scandir(done.cache) if entry.name.endswith("-cache")]
    there = f"{len(sizes)} now, {sum(sizes) / 2**20:.1f} MB" if sizes else "none yet"
    return (
        f"{text}\n  Compiled programs are stored in {done.cache} ({there}). You may delete this folder at any time.\n"
        "  Stored programs return NaN instead of raising an exception. The `status` of a simulation states the reason."
    )
