"""How fast are rides of the nonlinear bicycle, and their derivatives, on this machine?

The benchmark bicycle of Meijaard et al. (2007) rides for 5 s at 4.3 to 6 m/s after a push of 0.1 to 0.5 rad/s, in
float64. The answers are checked first (end states to 1e-4 against scipy's odeint with a tolerance of 1e-11, forward
against reverse derivatives), then timed: the best of several runs, and the first call, which traces and compiles.

Run:      python benchmarks/bicycle.py
Appears:  a description of the machine and one line for every figure.
Takes:    about a minute or two. Needs scipy (the extra `test`).
"""

import os
import platform
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import odeint

import jaxkane as jk

jax.config.update("jax_enable_x64", True)
# A call from Python for every evaluation is three to five times faster without a thread in between; sweeps do not care.
jax.config.update("jax_cpu_enable_async_dispatch", False)

BICYCLE = jk.catalog.WhippleBicycle.benchmark()
TIMES = jnp.linspace(0.0, 5.0, 51)  # [s]
TOLERANCE = {"rtol": 1e-6, "atol": 1e-6}
N_Q = len(BICYCLE.coordinates)


def main() -> None:
    print(machine(), end="\n\n")
    rides, few = initial_states(1000), 10
    report("first `simulate` in a fresh process: trace and compile", f"{in_a_fresh_process():.2f} s")
    by_scipy = rides_by_scipy(rides, few)
    by_sweep = rides_by_sweep(rides, few)
    report("ratio: sweep against odeint", f"{by_sweep / by_scipy:.1f}")
    one_ride(rides)
    derivatives(rides)


def initial_states(n: int) -> jk.State:
    """n upright bicycles with a speed and a push each."""
    rng = np.random.default_rng(0)
    speed, push = rng.uniform(4.3, 6.0, n), rng.uniform(0.1, 0.5, n)  # [m/s] [rad/s]
    u = np.stack([push, -speed / float(BICYCLE.rR), np.zeros(n)], axis=-1)
    return jk.State(jnp.zeros((n, N_Q)), jnp.asarray(u))


def member(rides: jk.State, i: int) -> jk.State:
    return jk.State(rides.q[i], rides.u[i])


def rides_by_scipy(rides: jk.State, n: int) -> float:
    """Rides a second of odeint around the vector field, which JAX has compiled."""
    rates = jax.jit(rates_of)
    solve = lambda i, tolerance: odeint(  # noqa: E731
        lambda y, t: np.asarray(rates(y)), start(rides, i), np.asarray(TIMES), rtol=tolerance, atol=tolerance
    )
    y = start(rides, 0)
    seconds = best(lambda: rates(y).block_until_ready(), runs=2000)
    report("one evaluation of the vector field, called from Python", f"{1e6 * seconds:.0f} us")
    per_ride = np.mean([best(lambda: solve(i, 1e-6), runs=20) for i in range(n)])  # noqa: B023
    report("scipy's odeint around it, rtol = atol = 1e-6", f"{1 / per_ride:.0f} rides a second")
    return 1 / per_ride


def rates_of(y: jax.Array) -> jax.Array:
    q, u = y[:N_Q], y[N_Q:]
    return jnp.concatenate([jk.coordinate_rates(BICYCLE, 0.0, q, u), jk.accelerations(BICYCLE, 0.0, q, u)])


def start(rides: jk.State, i: int) -> np.ndarray:
    return np.concatenate([rides.q[i], rides.u[i]])


def rides_by_sweep(rides: jk.State, n_checked: int) -> float:
    """Rides a second of `sweep`, after the first few end states have been compared with a tight solution."""
    run = lambda: jax.block_until_ready(jk.sweep.sweep(BICYCLE, rides, TIMES, **TOLERANCE))  # noqa: E731
    result, first = timed(run)
    assert bool(jnp.all(result.ok)), result.reason
    rates = jax.jit(rates_of)
    for i in range(n_checked):
        exact = odeint(lambda y, t: np.asarray(rates(y)), start(rides, i), np.asarray(TIMES), rtol=1e-11, atol=1e-11)
        here = np.concatenate([result.q[i, -1], result.u[i, -1]])
        error = np.abs(here - exact[-1]).max()
        assert error < 1e-4, f"ride {i} ends {error:.1e} away from the tight solution"
    seconds = best(run, runs=8)
    n = rides.q.shape[0]
    report(f"sweep of {n} bicycles, rtol = atol = 1e-6", f"{n / seconds:.0f} rides a second (first call {first:.1f} s)")
    return n / seconds


def one_ride(rides: jk.State) -> None:
    simulate = jax.jit(lambda state: jk.simulate(BICYCLE, state, TIMES, **TOLERANCE).q)
    state = member(rides, 0)
    _, first = timed(lambda: simulate(state).block_until_ready())
    seconds = best(lambda: simulate(state).block_until_ready(), runs=50)
    report("one ride, `simulate` under jit", f"{1e3 * seconds:.2f} ms (first call {first:.1f} s)")


def derivatives(rides: jk.State) -> None:
    """Of the end state with respect to every parameter of the bicycle."""
    state = member(rides, 0)

    def end(system, adjoint):
        ride = jk.simulate(system, state, TIMES, **TOLERANCE, adjoint=adjoint)
        return jnp.concatenate([ride.q[-1], ride.u[-1]])

    def loss(system):
        return jnp.sum(end(system, "reverse") ** 2)

    forward, reverse = jax.jit(jax.jacfwd(lambda system: end(system, "forward"))), jax.jit(jax.grad(loss))
    jacobian, first = timed(lambda: jax.block_until_ready(forward(BICYCLE)))
    n = len(jax.tree.leaves(jacobian))
    gradient, first_reverse = timed(lambda: jax.block_until_ready(reverse(BICYCLE)))

    by_forward = jax.tree.map(lambda column: 2 * column @ end(BICYCLE, "forward"), jacobian)
    for a, b in zip(jax.tree.leaves(by_forward), jax.tree.leaves(gradient)):
        assert abs(a - b) <= 1e-6 * max(1.0, abs(b)), f"forward {a}, reverse {b}"

    seconds = best(lambda: jax.block_until_ready(forward(BICYCLE)), runs=10)
    report(f"{n} sensitivities, jacfwd", f"{1e3 * seconds:.1f} ms (first call {first:.1f} s)")
    seconds = best(lambda: jax.block_until_ready(reverse(BICYCLE)), runs=10)
    report("gradient of a scalar, grad", f"{1e3 * seconds:.1f} ms (first call {first_reverse:.1f} s)")


FRESH = """
import time
import jax
import jax.numpy as jnp
import jaxkane as jk
jax.config.update("jax_enable_x64", True)
bicycle = jk.catalog.WhippleBicycle.benchmark()
state = jk.assemble(bicycle, {}, {"roll_rate": 0.5, "rear_wheel_rate": -4.6 / bicycle.rR})
ts = jnp.linspace(0.0, 5.0, 51)
for _ in range(2):
    started = time.perf_counter()
    jax.block_until_ready(jk.simulate(bicycle, state, ts, rtol=1e-6, atol=1e-6).q)
    print(time.perf_counter() - started)
"""


def in_a_fresh_process() -> float:
    """Seconds of the first `simulate` beyond those of the second."""
    done = subprocess.run([sys.executable, "-c", FRESH], check=True, capture_output=True, text=True)
    first, second = map(float, done.stdout.split())
    return first - second


def timed(f):
    started = time.perf_counter()
    result = f()
    return result, time.perf_counter() - started


def best(f, runs: int) -> float:
    f()
    return min(timed(f)[1] for _ in range(runs))


def machine() -> str:
    model = platform.processor() or platform.machine()
    if os.path.exists("/proc/cpuinfo"):
        with open("/proc/cpuinfo") as lines:
            model = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), model)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{model}, {cores} cores; Python {platform.python_version()}, jax {jax.__version__}, {jax.default_backend()}"


def report(what: str, figure: str) -> None:
    print(f"{what:58s}{figure}", flush=True)


if __name__ == "__main__":
    main()
