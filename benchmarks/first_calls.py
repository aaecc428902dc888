"""What a fresh process waits for: the first call, and the first call of a second process that finds the cache filled.

Trace, compile and run, with one core; the imports are left out, but for the first trajectory, whose figure is the
processor's time from the start of Python on. Every call is made in a process of its own.

Run:      python -m benchmarks.first_calls [--calls CALL ...] [--repeats N] [--parts]
Appears:  a first call beside the floor, which is diffrax's own for the same kind of program: `diffeqsolve` of
          y' = -k y with eleven numbers, the same solver, tolerances, times and adjoint. Processes take turns; a figure
          is the least CPU seconds of the repeats. Nothing is read from a cache; imports, the system and its first
          state are left out.
Takes:    about five minutes for each repeat.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from ._figures import Figure, digits
from ._first import NAMES
from ._machine import machine
from ._process import Setting, answer, configure

MOST = {"start": 3.0, "simulate": 3.0, "batch": 5.0, "sensitivities": 8.0, "reverse": 15.0, "fit": 10.0}  # seconds
TOLD = {
    "start": "from the start of Python to a first trajectory",
    "simulate": "`simulate`, a ride of 5 s",
    "batch": "`sweep`, 256 rides",
    "sensitivities": "26 sensitivities",
    "reverse": "reverse gradient",
    "fit": "one optimizer step of `fit_bicycle`",
}


def measure(setting: Setting) -> Iterator[Figure]:
    column, chosen = setting.column, NAMES[:1] if setting.quick else NAMES
    with tempfile.TemporaryDirectory() as scratch:
        ride = Path(scratch) / "ride.npz"
        if "fit" in chosen:
            answer("benchmarks._first", ["prepare", "--rides", str(ride)])
        for name in chosen:
            tries = []
            for k in range(1 if setting.quick else 2):  # the better of two: what else the machine does slows one
                cache = Path(scratch) / f"{name}{k}"
                arguments = [name, "--cache", str(cache), "--rides", str(ride), *["--native"] * setting.native]
                tries.append([answer("benchmarks._first", arguments)["seconds"] for _ in range(2)])
            first, second = map(min, zip(*tries))
            most = MOST[name]
            yield Figure("first_calls", f"first call: {TOLD[name]}", first, "s", column, at_most=most)
            yield Figure("first_calls", f"second process: {TOLD[name]}", second, "s", column, at_most=most / 2)


CALLS = ("simulate", "sensitivities", "gradient", "sweep")
AT_MOST = {"native": 2.0, "XLA alone": 3.0}  # times the floor
BY = ("floor", *AT_MOST)
MEMBERS = 256


def floor(call: str, samples: int = 251, parameters: int = 27) -> Callable[[], Any]:
    """The first call of diffrax alone; k is the mean of the parameters."""
    import diffrax
    import jax
    import jax.numpy as jnp

    ts = jnp.linspace(0.0, 5.0, samples)
    adjoint = diffrax.RecursiveCheckpointAdjoint() if call == "gradient" else diffrax.ForwardMode()

    def solve(y0, values) -> Any:
        return diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, values: -jnp.mean(values) * y),
            diffrax.Tsit5(),
            ts[0],
            ts[-1],
            None,
            y0,
            values,
            saveat=diffrax.SaveAt(ts=ts),
            stepsize_controller=diffrax.PIDController(rtol=1e-8, atol=1e-8),
            adjoint=adjoint,
            max_steps=16384,
            throw=False,
        ).ys

    y0, values = jnp.ones(11), jnp.linspace(0.5, 1.5, parameters)
    many = jnp.ones((MEMBERS, 11))
    last = lambda values: solve(y0, values)[-1, 0]  # noqa: E731
    jax.block_until_ready(jax.jit(jnp.sin)(values))  # JAX has started, as it has where a state is assembled
    return {
        "simulate": lambda: jax.jit(solve)(y0, values),
        "sensitivities": lambda: jax.jit(jax.jacfwd(last))(values),
        "gradient": lambda: jax.jit(jax.grad(last))(values),
        "sweep": lambda: jax.jit(jax.vmap(solve, (0, None)))(many, values),
    }[call]


def ours(call: str) -> Callable[[], Any]:
    """The first call of jaxkane: a ride of 5 s, its last roll angle by all parameters, or many rides."""
    import dataclasses

    import jax
    import jax.numpy as jnp
    import numpy as np

    import jaxkane as jk

    from . import _bicycle as bicycle

    ts, names = np.linspace(0.0, 5.0, 251), tuple(vars(bicycle.BICYCLE))
    values = jnp.stack([*vars(bicycle.BICYCLE).values()])  # one array, as the floor has
    state = jk.assemble(bicycle.BICYCLE, {}, {"roll_rate": 0.5, "rear_wheel_rate": -4.6 / 0.3})
    states, sweep = bicycle.starts(MEMBERS), jk.sweep.sweep
    tolerances: dict[str, Any] = {"rtol": 1e-8, "atol": 1e-8}

    def last(values):
        system = dataclasses.replace(bicycle.BICYCLE, **dict(zip(names, values, strict=True)))
        return jk.simulate(system, state, ts, **tolerances)["roll"][-1]

    return {
        "simulate": lambda: jk.simulate(bicycle.BICYCLE, state, ts, **tolerances).q,
        "sensitivities": lambda: jax.jit(jax.jacfwd(last))(values),
        "gradient": lambda: jax.jit(jax.grad(last))(values),
        "sweep": lambda: sweep(bicycle.BICYCLE, states, ts, **tolerances)["roll"],
    }[call]


def first_call(call: str, by: str) -> dict[str, Any]:
    """CPU and wall seconds of one first call in this process, and its `parts` in wall seconds."""
    import jax

    if by == "floor":
        jax.config.update("jax_enable_x64", True)
        jax.config.update("jax_cpu_enable_async_dispatch", False)
    else:
        configure(Setting(native=by == "native"))
    function, parts = (floor if by == "floor" else ours)(call), recorded_parts()
    cpu, wall = time.process_time(), time.perf_counter()
    jax.block_until_ready(function())
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return {"cpu": cpu, "wall": wall, "parts": {name: (len(each), union(each)) for name, each in parts.items()}}


def recorded_parts() -> dict[str, list[tuple[float, float]]]:
    """From now on the beginning and the end of each tracing, lowering and compilation. Parts may contain one another:
    kernels are compiled while a program is lowered."""
    import jax

    events = {"jaxpr_trace": "tracing", "jaxpr_to_mlir_module": "lowering", "backend_compile": "XLA's backend"}
    parts: dict[str, list[tuple[float, float]]] = {name: [] for name in (*events.values(), "native kernels")}

    def listen(event: str, duration_secs: float, **kwargs: str | int) -> None:
        if name := events.get(event.removeprefix("/jax/core/compile/").removesuffix("_duration")):
            end = time.perf_counter()
            parts[name].append((end - duration_secs, end))

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        from llvmlite.binding import ExecutionEngine
    except (ImportError, OSError):
        return parts
    finalize = ExecutionEngine.finalize_object

    def finalize_object(self: Any) -> None:
        began = time.perf_counter()
        finalize(self)
        parts["native kernels"].append((began, time.perf_counter()))

    ExecutionEngine.finalize_object = finalize_object
    return parts


def union(intervals: list[tuple[float, float]]) -> float:
    """The length that intervals cover together."""
    length, covered = 0.0, float("-inf")
    for start, end in sorted(intervals):
        length += max(0.0, end - max(start, covered))
        covered = max(covered, end)
    return length


def row(call: str, seconds: Mapping[str, float]) -> str:
    cells = [f"{digits(seconds['floor'])} s"]
    for by in AT_MOST:
        cells += [f"{digits(seconds[by])} s", digits(seconds[by] / seconds["floor"])]
    return f"| {' | '.join((call, *cells))} |"


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        "python -m benchmarks.first_calls", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--calls", nargs="+", choices=CALLS, default=CALLS)
    parser.add_argument("--repeats", type=int, default=3, help="processes for each figure (default: 3)")
    parser.add_argument("--parts", action="store_true", help="how many seconds of the wall which part takes")
    parser.add_argument("--child", choices=BY, help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.child:
        print(json.dumps(first_call(given.calls[0], given.child)))
        return
    for what, words in machine().items():
        print(f"{what}: {words}")
    rows = []
    for call in given.calls:
        seconds: dict[str, list[float]] = {by: [] for by in BY}
        for by in BY * given.repeats:
            result = answer("benchmarks.first_calls", ["--calls", call, "--child", by])
            seconds[by].append(result["cpu"])
            print(f"{call}, {by}: {digits(result['cpu'])} s of CPU, {digits(result['wall'])} s", flush=True)
            for name, (times, length) in result["parts"].items() if given.parts else ():
                print(f"    {name}: {digits(length)} s, {times} times")
        rows.append(row(call, {by: min(each) for by, each in seconds.items()}))
    bounds = [f"{by} | ratio, at most {most:g}" for by, most in AT_MOST.items()]
    print("", f"| first call, CPU | floor | {' | '.join(bounds)} |", "|---" * 6 + "|", *rows, sep="\n")


if __name__ == "__main__":
    main()
