"""`python -m jaxkane` prints the environment and a self-test. Paste its output into a bug report."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import sys
import time
from collections.abc import Callable

import jax
import numpy as np

import jaxkane as jk

from ._scalarjit import native

PACKAGES = ("jaxkane", "jax", "jaxlib", "llvmlite", "diffrax", "equinox", "optimistix", "optax", "numpy", "scipy")
SETTINGS = ("JAX_", "JAXKANE_", "XLA_", "EQX_")
TS = np.linspace(0.0, 1.0, 11)


def version_of(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def swing(length: jax.typing.ArrayLike = 1.0) -> jk.Trajectory:
    state = jk.State(np.array([1.0, -0.5]), np.zeros(2))
    system = jk.catalog.DoublePendulum(length=length)  # pyright: ignore[reportCallIssue]
    return jk.simulate(system, state, TS, adjoint="forward")


def energy_is_kept() -> tuple[float, float]:
    """Conservation of the double pendulum's energy. **Returns:** the relative error and its tolerance."""
    ride = swing()
    a, b, a_dot, b_dot = (np.asarray(ride[name]) for name in ("theta1", "theta2", "theta1_dot", "theta2_dot"))
    kinetic = 2 / 3 * a_dot**2 + b_dot**2 / 6 + 0.5 * a_dot * b_dot * np.cos(a - b)
    energy = kinetic - 9.81 * (1.5 * np.cos(a) + 0.5 * np.cos(b))
    return float(np.max(np.abs(energy - energy[0])) / abs(energy[0])), 1e-7


def derivatives_are_slopes() -> tuple[float, float]:
    """The derivative of the last angle by the length, compared with central differences."""
    angle = jax.jit(lambda length: swing(length)["theta1"][-1])
    slope, d = float(jax.jit(jax.jacfwd(angle))(1.0)), 1e-4
    return abs(slope - float(angle(1.0 + d) - angle(1.0 - d)) / (2 * d)) / abs(slope), 1e-4


def eigenvalues_are_the_published_ones() -> tuple[float, float]:
    """Weave of the benchmark bicycle at 5 m/s: Meijaard et al. (2007), doi 10.1098/rspa.2007.1857, table 2."""
    bicycle = jk.catalog.WhippleBicycle.benchmark()
    computed = jk.stability.eigenvalues(bicycle, np.array([5.0])).eigenvalues[0]
    published = -0.77534188219585 + 4.46486771378823j
    return float(np.min(np.abs(np.asarray(computed) - published))), 1e-10


CHECKS: dict[str, Callable[[], tuple[float, float]]] = {
    "the energy of a double pendulum is constant": energy_is_kept,
    "derivatives of a trajectory agree with central differences": derivatives_are_slopes,
    "eigenvalues of the benchmark bicycle agree with the published ones": eigenvalues_are_the_published_ones,
}


def main() -> int:
    """Print the environment and the self-test. **Returns:** 0 if all checks pass, else 1."""
    print(f"Python {platform.python_version()}, {platform.platform()}, {os.cpu_count()} cores")
    print(", ".join(f"{package} {version_of(package)}" for package in PACKAGES))
    environment = sorted(f"{name}={value}" for name, value in os.environ.items() if name.startswith(SETTINGS))
    settings = jk.configure(verbose=False)
    reason = native.why_not()
    print(f"native kernels: {'yes' if settings.native else f'no, {reason}' if reason else 'switched off'}")
    print(f"compiled programs: {f'saved in {settings.cache}' if settings.cache else 'not saved'}")
    print(f"devices: {', '.join(f'{each} ({each.device_kind})' for each in jax.devices())}")
    print("environment:", ", ".join(environment) or "no variable of JAX, XLA or jaxkane is set")
    failed = 0
    for what, check in CHECKS.items():
        started = time.perf_counter()
        try:
            error, tolerance = check()
            passed, result = error <= tolerance, f"{error:.1e}, at most {tolerance:.0e}"
        except Exception as raised:
            passed, result = False, f"{type(raised).__name__}: {raised}"
        failed += not passed
        print(f"{'ok' if passed else 'FAILED'}: {what} ({result}; {time.perf_counter() - started:.1f} s)", flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
