"""The machine in words: processor, cores, versions. No names and no places."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from pathlib import Path

_VERSIONS = "jax jaxkane diffrax llvmlite numpy scipy sympy pydy cython mujoco mujoco-mjx pin jaxsim BicycleParameters"


def machine() -> dict[str, str]:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    versions = {name: version for name in _VERSIONS.split() if (version := _version(name))}
    return {
        "processor": f"{_processor()}, {_vectors()}",
        "cores": str(cores),
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        "versions": ", ".join(f"{name} {version}" for name, version in versions.items()),
    }


def _processor() -> str:
    return _cpuinfo("model name") or platform.processor() or platform.machine()


def _vectors() -> str:
    flags = _cpuinfo("flags").split()
    return next((name for flag, name in _VECTORS.items() if flag in flags), "no vector set known")


_VECTORS = {"avx512f": "AVX-512", "avx2": "AVX2", "avx": "AVX", "sse2": "SSE2"}


def _cpuinfo(key: str) -> str:
    path = Path("/proc/cpuinfo")
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith(key)), "")


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return ""
