"""The settings of a process, by one explicit call. Knows JAX's and equinox's settings; knows no mechanics."""

from __future__ import annotations

import dataclasses
import os
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from . import compat as internals
from .backends import native as kernels


@dataclasses.dataclass(frozen=True)
class Configuration:
    """What `configure` has set: `float64`; the folder of the `cache`, or None; the number of CPU `devices`, or None
    where JAX was left to choose; whether right-hand sides are `native` kernels."""

    float64: bool
    cache: Path | None
    devices: int | None
    native: bool


_last: Configuration | None = None
_before: _Before | None = None  # while programs are kept in a folder


class _Before(NamedTuple):
    """What was set before programs were kept: settings of JAX, variables of the environment, equinox's checks."""

    settings: dict[str, Any]
    environment: dict[str, str | None]
    checks: str | None


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

    **Arguments:**

    - `float64`: double precision, which mechanics needs (`jax_enable_x64`).
    - `cache`: keep compiled programs on disk, so that the next process need not compile them again: True for JAX's
        own folder where one is set, else `jaxkane` in the user's folder of caches; or a folder; or False, which also
        takes back what an earlier call with a cache has set.
    - `devices`: split the CPU into this many devices, which a sweep then uses side by side; one for each core is
        plenty. By default JAX decides: one, unless XLA_FLAGS says otherwise.
    - `native`: right-hand sides and their derivatives as machine code through LLVM (llvmlite), called by XLA;
        on the CPU only. By default where llvmlite is installed, unless the environment has JAXKANE_NATIVE=0 (or
        false, no, off). False
        leaves all work to XLA. Both agree to rounding errors. On a machine that has called none yet, a first one is
        tried in another process, which takes a second; the verdict is kept beside the programs, or else in the
        user's folder of caches.
    - `verbose`: print in a few lines what was done; once, if it is called again.

    **Returns:** a `Configuration`. Processes that are started from this one, such as Dask's workers, inherit precision,
    cache and kernels by their environment.

    **Warns:** when it comes too late: arrays have been made in float32, or JAX has started with other devices; and
    where `native=True` is asked of a machine that cannot; and where the folder of the cache cannot be made or written:
    then programs are not kept.

    With a cache, a numerical check *inside* compiled programs can no longer raise (a program that may call back into
    Python cannot be stored): equinox's `EQX_ON_ERROR` becomes "nan". jaxkane's own errors are raised outside of
    programs, and its simulations carry a status, so nothing changes for them. Code of yours that has diffrax, lineax or
    optimistix raise (`throw=True`) gets NaN instead. `cache=False` leaves all that as it is.

    No option of the compiler is set: what helps a program is set by the library where that program is compiled.
    """
    global _last
    for what, flag in (("float64", float64), ("native", False if native is None else native)):
        if not isinstance(flag, (bool, np.bool_)):
            raise TypeError(f"configure: `{what}` is True or False, got {flag!r}.")
    if not isinstance(cache, (bool, str, os.PathLike)):
        raise TypeError(f"configure: `cache` is a folder, True or False, got {cache!r}.")
    made = _float32_arrays() if float64 and not jax.config.jax_enable_x64 else 0  # pyright: ignore[reportAttributeAccessIssue]
    jax.config.update("jax_enable_x64", bool(float64))
    os.environ["JAX_ENABLE_X64"] = str(int(float64))
    if made:
        warnings.warn(
            f"jaxkane.configure came late: {made} float32 array{'s' if made > 1 else ''} had been made before, and "
            "stay float32. Call it right after the imports, before any system, state or array is made.",
            UserWarning,
            stacklevel=2,
        )
    folder = _made_folder(cache) if cache else None
    if folder is not None:
        _store_programs(folder)
    elif jax.config.jax_compilation_cache_dir:  # pyright: ignore[reportAttributeAccessIssue]
        _store_nothing()
    if devices is not None:
        _split_cpu(devices)
    if native is not None:
        kernels.use(native)
    if native and (why := kernels.why_not()):
        kernels.tell(why)
    done = Configuration(bool(float64), folder, devices, kernels.is_on())
    if verbose and done != _last:
        print(_told(done))
    _last = done
    return done


def _float32_arrays() -> int:
    """How many arrays of single precision are alive; looking for them must not start JAX."""
    return sum(array.dtype == np.float32 for array in jax.live_arrays()) if _has_started() else 0


def _has_started() -> bool:
    # JAX has no public question for this, but refuses a new number of CPU devices once it has started.
    number = jax.config.jax_num_cpu_devices  # pyright: ignore[reportAttributeAccessIssue]
    try:
        jax.config.update("jax_num_cpu_devices", number + 1)
    except RuntimeError:  # raised for nothing else: the setting is only written down
        return True
    jax.config.update("jax_num_cpu_devices", number)
    return False


def _split_cpu(devices: int) -> None:
    if not isinstance(devices, (int, np.integer)) or isinstance(devices, bool) or devices < 1:
        raise ValueError(f"`devices` is a number of CPU devices, 1 or more; got {devices!r}.")
    if not _has_started():
        jax.config.update("jax_num_cpu_devices", int(devices))
        return
    there = len(jax.local_devices(backend="cpu"))
    if there != devices:
        warnings.warn(
            f"jaxkane.configure came too late for devices={devices}: JAX has started with {there}. Call it before "
            "anything is computed; in a notebook, restart the kernel.",
            UserWarning,
            stacklevel=3,
        )


def _folder(cache: bool | str | os.PathLike[str]) -> Path:
    if not isinstance(cache, bool):
        return Path(cache).expanduser().absolute()
    folder: Any = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if folder:
        return Path(folder)
    home = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA") or "~/.cache"
    return Path(home).expanduser() / "jaxkane"


def _made_folder(cache: bool | str | os.PathLike[str]) -> Path | None:
    """The folder of the cache; None, with a warning, where there can be none, as with a home that is read only."""
    folder = why = None
    try:
        folder = _folder(cache)
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            why = "it cannot be written"
    except (FileExistsError, NotADirectoryError):
        raise ValueError(f"{folder} is a file, or lies in one: `cache` is the name of a folder.") from None
    except (OSError, RuntimeError) as error:  # the latter where there is no home
        why = str(error)
    if why is None:
        return folder
    where = "" if folder is None else f" {folder}"
    warnings.warn(
        f"jaxkane.configure: there can be no folder of compiled programs{where} ({why}): each process compiles anew. "
        "Give configure(cache=...) a folder that can be written, or say cache=False.",
        UserWarning,
        stacklevel=3,
    )
    return None


def _store_programs(folder: Path) -> None:
    """Have every compiled program kept in a folder."""
    global _before
    settings = {
        "jax_compilation_cache_dir": str(folder),
        "jax_enable_compilation_cache": True,
        # Small programs too: read, they take a fifth of their compilation.
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        "jax_persistent_cache_min_entry_size_bytes": 0,
    }
    names = {"EQX_ON_ERROR": "nan"} | {name.upper(): str(value) for name, value in settings.items()}
    there = {name: getattr(jax.config, name) for name in settings}
    environment = {name: os.environ.get(name) for name in names}
    for name, value in settings.items():
        jax.config.update(name, value)
    os.environ.update(names)
    internals.look_for_cache_again()  # JAX looks for a folder once, when it first compiles
    # JAX stores no program that may call back into Python, as equinox's checks do in order to raise.
    checks = internals.on_failed_checks("nan")
    if _before is None:
        _before = _Before(there, environment, checks)
    if checks is None:
        warnings.warn(
            "jaxkane.configure: this equinox cannot be told at run time how to treat errors, so simulations will not "
            "be stored. Set EQX_ON_ERROR=nan in the environment before Python starts.",
            UserWarning,
            stacklevel=3,
        )


def _store_nothing() -> None:
    """Keep no programs, and take back what keeping them has set."""
    global _before
    if _before is not None:
        for name, value in _before.settings.items():
            jax.config.update(name, value)
        for name, word in _before.environment.items():
            os.environ.pop(name, None)
            if word is not None:
                os.environ[name] = word
        if _before.checks is not None:
            internals.on_failed_checks(_before.checks)
        _before = None
        jax.clear_caches()  # programs whose checks give NaN
    jax.config.update("jax_compilation_cache_dir", None)
    os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)
    internals.look_for_cache_again()


def _why_off() -> str | None:
    return kernels.why_not() if kernels.is_wanted() else "switched off"


def _told(done: Configuration) -> str:
    lines = [f"jaxkane: {'float64' if done.float64 else 'float32'}"]
    if done.devices is not None:
        lines[0] += f", {done.devices} CPU device{'s' if done.devices > 1 else ''}"
    lines[0] += ", native kernels" if done.native else f", no native kernels ({_why_off()})"
    if done.cache is None:
        return f"{lines[0]}; compiled programs are not kept."
    sizes = [entry.stat().st_size for entry in os.scandir(done.cache) if entry.name.endswith("-cache")]
    there = f"{len(sizes)} there, {sum(sizes) / 2**20:.1f} MB" if sizes else "none there yet"
    lines += [
        f"  compiled programs are kept in {done.cache} ({there}; delete the folder whenever you like)",
        "  numerical checks inside programs give NaN instead of raising (see jaxkane.configure)",
    ]
    return "\n".join(lines)
