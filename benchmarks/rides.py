"""Rides of the bicycle, 5 s each: a thousand in a sweep and one alone, against scipy around compiled right-hand sides.

Accuracy first: every end state must be within 1e-6 of the largest of a solution with a tolerance of 1e-12; how near
each comes is told, since the same tolerance means more to one solver than to another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import jax
import numpy as np

import jaxkane as jk

from . import _bicycle as bicycle
from ._figures import Figure
from ._process import Setting
from ._timing import in_turns

FEW = 10  # rides of a peer, one after the other, from which its rate is taken
TARGETS = {  # at least so many times a peer's rides a second, with XLA or native kernels, on one or two devices
    "odeint, PyDy's Cython": {("XLA", 1): 6, ("native", 1): 20, ("XLA", 2): 10},
    "odeint, SymPy's C": {("XLA", 1): 2.5, ("native", 1): 8, ("XLA", 2): 4},
}
Ride = Callable[[np.ndarray], np.ndarray]  # y at the start (14,) -> y at the end


def measure(setting: Setting) -> Iterator[Figure]:
    states = bicycle.starts(8 if setting.quick else 1000)
    n, few = len(states.q), min(FEW, len(states.q))
    y0 = bicycle.with_dependent_speeds(states)
    sweep = lambda: jk.sweep.sweep(bicycle.BICYCLE, states, bicycle.TIMES)  # noqa: E731
    simulate = jax.jit(lambda q, u: jk.simulate(bicycle.BICYCLE, jk.State(q, u), bicycle.TIMES).q)
    q, u = bicycle.on_cpu((states.q[0], states.u[0]))

    peers = rides_of_peers(setting)
    if setting.devices > 1:
        peers = {name: ride for name, ride in peers.items() if name in TARGETS}
    swept = sweep()
    assert np.all(swept.ok), swept.reason
    ends = np.concatenate([swept.q[:few, -1], swept.u[:few, -1]], axis=-1)
    bicycle.agree("one ride and the sweep", simulate(q, u)[-1], swept.q[0, -1], 1e-8)
    errors = {}
    if peers:
        end_states = lambda ride: np.stack([ride(y)[: ends.shape[1]] for y in y0[:few]])  # noqa: E731
        exact = end_states(next(iter(rides_of_peers(setting, 1e-12).values())))
        for name, found in {"jaxkane": ends, **{name: end_states(ride) for name, ride in peers.items()}}.items():
            bicycle.agree(f"end states, {name}", found, exact, 1e-6)
            errors[name] = bicycle.gap(found, exact)

    rivals = {name: lambda ride=ride: [ride(y) for y in y0[:few]] for name, ride in peers.items()}
    ours = {"sweep": sweep, "one": lambda: simulate(q, u).block_until_ready()}
    best = in_turns(ours | rivals, 0.1 if setting.quick else 20.0)
    column, devices = setting.column, "" if setting.devices == 1 else f", {setting.devices} devices"
    yield Figure("rides", f"{n} rides by `sweep`{devices}", n / best["sweep"], "rides/s", column)
    for name in rivals:
        yield Figure("rides", f"the peer: {name}{devices}", few / best[name], "rides/s", column)
    if setting.devices == 1:
        yield Figure("rides", "one ride, `simulate` under jit", 1e3 * best["one"], "ms", column)
    for name, error in errors.items() if setting.devices == 1 else ():
        yield Figure("rides", f"error of the end states: {name}", error, "", column)
    for name in rivals:
        faster = n / best["sweep"] * best[name] / few
        least = TARGETS.get(name, {}).get((column, setting.devices))
        what = f"{n} rides{devices}, rides a second against {name}"
        yield Figure("rides", what, faster, column=column, at_least=least)
    if setting.devices == 1 and "odeint, SymPy's C" in rivals:
        ratio = best["one"] / best["odeint, SymPy's C"] * few
        most = setting.pick(2.5, 1.5)
        yield Figure("rides", "one ride, time against odeint, SymPy's C", ratio, column=column, at_most=most)


def rides_of_peers(setting: Setting, tolerance: float = bicycle.TOLERANCE) -> dict[str, Ride]:
    """One ride from y at the start to y at the end, by each peer that is here.

    The C is called in three ways: by way of ctypes, as a script would do it; as a module of its own, which costs less;
    and by scipy's DOP853 in place of odeint.
    """
    from scipy.integrate import ode

    found: dict[str, Ride] = {}
    cython, c = bicycle.pydy_cython(setting.folder), bicycle.compiled_c(setting.folder)
    p, dy = bicycle.parameters() if c or cython else None, np.empty(14)
    if cython:
        found["odeint, PyDy's Cython"] = lambda y: bicycle.ride_by(cython, y, tolerance, p)[-1]
    if c:
        from .bicycle_in_c import by_ctypes

        called = by_ctypes(c)
        found["odeint, SymPy's C"] = lambda y: bicycle.ride_by(called, y, tolerance, p, dy)[-1]
        found["odeint, SymPy's C as a module"] = lambda y: bicycle.ride_by(c.rhs, y, tolerance, p, dy)[-1]

        def by_dop853(y):
            solver = ode(c.rhs_ty).set_integrator("dop853", rtol=tolerance, atol=tolerance, nsteps=5000)
            solver.set_f_params(p, dy).set_initial_value(y, bicycle.TIMES[0])
            for t in bicycle.TIMES[1:]:
                y = solver.integrate(t)
            return y

        found["DOP853, SymPy's C as a module"] = by_dop853
    return found
