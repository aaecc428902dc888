"""Walkers of 20 steps in a sweep, and the continuation of their gait, against SciPy around exported C.

The walker is the compass gait of Goswami et al. (1998). The peer uses the exported C between two steps, the impact
equations of the article, and solve_ivp with an event. End states, periods and multipliers are compared before they are
timed. The peer computes a subset of the walkers and orbits, and its time is scaled.
"""

from __future__ import annotations

import ctypes
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

import jaxkane as jk
from jaxkane.catalog import CompassGait

from . import _bicycle as bicycle
from ._figures import Figure
from ._peers import here
from ._process import Setting
from ._timing import in_turns

DURATION = 15.0  # [s], 20 steps of 0.734 s and the rest of one
TOLERANCE, OF_ORBITS = 1e-8, 1e-12
FEW = 10  # walkers and orbits of the peer
Rates = Callable[[float, np.ndarray, float], np.ndarray]  # t, (stance, swing, rates), slope [rad] -> their rates


def measure(setting: Setting) -> Iterator[Figure]:
    if not here("SymPy + C"):  # a compiler
        return
    rates = exported(Path(setting.folder) / "generated")
    n, few = (16, 2) if setting.quick else (10_000, FEW)
    gait = jk.stability.periodic(CompassGait(), jk.State([-0.22, 0.32, 0.0], [1.1, 0.4]), section="heel_strike")
    yield from walks(setting, rates, gait, n, few)
    yield from orbits(setting, rates, gait, few)


def walks(setting: Setting, rates: Rates, gait: Any, n: int, few: int) -> Iterator[Figure]:
    """`n` walkers with disturbed starts."""
    away = np.random.default_rng(0).uniform(-0.01, 0.01, (n, 2))
    away = np.stack([away[:, 0], -away[:, 0], 0.0 * away[:, 0]], axis=1), np.stack([away[:, 1]] * 2, axis=1)
    starts = jk.State(gait.state.q + away[0], gait.state.u + away[1])
    ts = jnp.array([0.0, DURATION])

    def sweep() -> Any:
        return jk.sweep.sweep(CompassGait(), starts, ts, rtol=TOLERANCE, atol=TOLERANCE)

    def by_scipy() -> np.ndarray:
        first = np.concatenate([np.asarray(starts.q)[:few, :2], np.asarray(starts.u)[:few]], axis=1)
        return np.stack([walk(rates, y, 3.0 * np.pi / 180, DURATION, TOLERANCE)[0] for y in first])

    swept = sweep()
    assert np.all(swept.ok), swept.reason
    assert int(np.min(swept.jumps.count)) >= 20
    ends = np.concatenate([swept.q[:few, -1, :2], swept.u[:few, -1]], axis=1)
    bicycle.agree("walkers, end states", ends, by_scipy(), 1e-5)
    best = in_turns({"sweep": sweep, "SciPy": by_scipy}, 0.1 if setting.quick else 10.0)
    ours, theirs = n / best["sweep"], few / best["SciPy"]
    yield Figure("walkers", f"{n} walkers of 20 steps by `sweep`", ours, "walks/s", setting.column)
    yield Figure("walkers", "the peer: solve_ivp with events, exported C", theirs, "walks/s", setting.column)
    yield Figure("walkers", "walks a second against solve_ivp", ours / theirs, column=setting.column, at_least=50)


def orbits(setting: Setting, rates: Rates, gait: Any, few: int) -> Iterator[Figure]:
    """Gaits with their multipliers, from 3 to 4.3 degrees."""
    last, step = np.deg2rad(3.1 if setting.quick else 4.3), 0.1 if setting.quick else 0.002

    def ours() -> Any:
        return jk.stability.family(
            CompassGait(), gait, towards={"slope": 1}, until={"slope": last}, step=step, max_step=step, steps=1000
        )

    found = ours()
    places = np.linspace(0, len(found) - 1, few).astype(int)
    slopes = np.asarray(found["slope"])[places]

    def by_scipy() -> list[tuple[float, np.ndarray]]:
        y, solved = np.asarray(jnp.concatenate([gait.state.q[:2], gait.state.u])), []
        for slope in slopes:
            y, period, multipliers = orbit(rates, y, slope)
            solved.append((period, multipliers))
        return solved

    theirs = by_scipy()
    bicycle.agree("gaits, periods", np.asarray(found.period)[places], np.array([T for T, _ in theirs]), 1e-8)
    largest = np.abs(np.array([values[0] for _, values in theirs]))
    bicycle.agree("gaits, largest multipliers", np.abs(np.asarray(found.multipliers)[places, 0]), largest, 1e-5)
    best = in_turns({"ours": ours, "SciPy": by_scipy}, 0.1 if setting.quick else 10.0)
    each, of_peer = best["ours"] / len(found), best["SciPy"] / few
    yield Figure("walkers", f"a gait of a family of {len(found)}", 1e3 * each, "ms", setting.column)
    yield Figure("walkers", "the peer: a gait by scipy.optimize.root", 1e3 * of_peer, "ms", setting.column)
    yield Figure("walkers", "gaits a second against SciPy", of_peer / each, column=setting.column, at_least=20)


def exported(folder: Path) -> Rates:
    """The exported C of the walker through ctypes."""
    from .bicycle_in_c import FLAGS, compiler

    folder.mkdir(parents=True, exist_ok=True)
    files = jk.export.c(CompassGait(), folder / "walker.c", ("rates",))
    library = folder / "walker.so"
    subprocess.run([str(compiler()), *FLAGS, str(files.source), "-o", str(library), "-lm"], check=True)
    f = ctypes.CDLL(str(library)).walker_rates
    f.argtypes = [ctypes.c_double, *[ctypes.c_void_p] * 6]
    names = list(jk.export.parameters(CompassGait()))
    p = np.array([float(x) for x in jk.export.parameters(CompassGait()).values()])
    q, u, q_dot, u_dot, none, place = (
        np.zeros(3),
        np.zeros(2),
        np.empty(3),
        np.empty(2),
        np.zeros(1),
        names.index("slope"),
    )
    pointers = [x.ctypes.data for x in (q, u, none, p, q_dot, u_dot)]

    def rates(t: float, y: np.ndarray, slope: float) -> np.ndarray:
        q[:2], u[:], p[place] = y[:2], y[2:], slope
        f(t, *pointers)
        return np.concatenate([q_dot[:2], u_dot])

    return rates


def landed(y: np.ndarray) -> np.ndarray:
    """The state after a heel strike: Goswami's impact equations, with a = b = 0.5 m, 10 kg at the hip, 5 kg a leg."""
    m, hip, a, b, cos = 5.0, 10.0, 0.5, 0.5, np.cos(y[0] - y[1])
    length = a + b
    # Angular momenta about the new stance foot and of the new swing leg about the hip; rates of stance and swing
    before = np.array([[-m * a * b + (hip * length**2 + 2 * m * a * length) * cos, -m * a * b], [-m * a * b, 0.0]])
    carried = m * length * (length - b * cos) + m * a**2 + hip * length**2
    after = np.array([[carried, m * b * (b - length * cos)], [-m * b * length * cos, m * b**2]])
    return np.concatenate([y[1::-1], np.linalg.solve(after, before @ y[2:])])


def walk(rates: Rates, y: np.ndarray, slope: float, duration: float, tolerance: float, steps: int = 10**6):
    """The state after a duration or a number of steps, and the time [s]."""
    from scipy.integrate import solve_ivp

    def heel(t: float, y: np.ndarray, slope: float) -> float:
        # The height of the swing foot is also zero while the legs pass each other.
        return max(2.0 * slope - y[0] - y[1], 10.0 * (y[1] - y[0]))

    heel.terminal, heel.direction = True, -1.0  # pyright: ignore[reportFunctionMemberAccess]
    t = 0.0
    for _ in range(steps):
        method = "RK45" if tolerance > 1e-10 else "DOP853"
        options = {"method": method, "rtol": tolerance, "atol": tolerance, "events": heel, "args": (slope,)}
        ride = solve_ivp(rates, (t, duration), y, **options)
        t, y = ride.t[-1], ride.y[:, -1]
        if ride.status == 0:
            break
        y = landed(y)
    return y, t


def orbit(rates: Rates, y: np.ndarray, slope: float) -> tuple[np.ndarray, float, np.ndarray]:
    """The start after a heel strike, the period [s] and the multipliers, the largest first."""
    from scipy.optimize import root

    def started(z: np.ndarray) -> np.ndarray:
        return np.array([z[0], 2.0 * slope - z[0], z[1], z[2]])

    def stepped(z: np.ndarray) -> tuple[np.ndarray, float]:
        y, t = walk(rates, started(z), slope, 2.0, OF_ORBITS, steps=1)
        return y[[0, 2, 3]], t

    z = root(lambda z: stepped(z)[0] - z, y[[0, 2, 3]], tol=1e-10).x
    h = 1e-6
    matrix = np.stack([(stepped(z + d)[0] - stepped(z - d)[0]) / (2 * h) for d in h * np.eye(3)], axis=1)
    values = np.linalg.eigvals(matrix)
    return started(z), stepped(z)[1], values[np.argsort(-np.abs(values))]
