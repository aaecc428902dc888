"""One first call in a fresh process: `python -m benchmarks._first simulate --cache FOLDER`, its seconds as JSON."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

from ._process import Setting, configure
from ._timing import timed

NAMES = ("start", "simulate", "batch", "sensitivities", "reverse", "fit")
OFF = {"IBxx": 1.2, "zB": 0.8, "c": 1.2, "IFyy": 0.8}  # the initial guess of a fit, as a part of the truth


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=(*NAMES, "prepare"))
    parser.add_argument("--native", action="store_true")
    parser.add_argument("--cache", default=None)
    parser.add_argument("--rides", type=Path, default=None)
    given = parser.parse_args()
    configure(Setting(native=given.native), cache=given.cache or False)
    if given.what == "prepare":
        prepare(given.rides)
        return
    if given.what == "start":
        start()
        print(json.dumps({"seconds": time.process_time()}))  # of this process since it was started
        return
    call = {"simulate": simulate, "batch": batch, "sensitivities": sensitivities, "reverse": reverse}.get(given.what)
    call = call() if call else fit(given.rides)
    print(json.dumps({"seconds": timed(call)[1]}))


def start() -> None:
    """The first trajectory that somebody sees: imports, `assemble`, `simulate`."""
    import jax
    import numpy as np

    import jaxkane as jk

    bicycle = jk.catalog.WhippleBicycle.benchmark()
    state = jk.assemble(bicycle, {}, {"roll_rate": 0.5, "rear_wheel_rate": -4.6 / 0.3})
    jax.block_until_ready(jk.simulate(bicycle, state, np.linspace(0.0, 5.0, 501)).q)


# Each returns the call to be timed; nothing like it has been compiled before. The imports are not part of it.


def simulate():
    import jax

    import jaxkane as jk

    from . import _bicycle as bicycle

    start = bicycle.member(bicycle.starts(1), 0)
    return lambda: jax.block_until_ready(jk.simulate(bicycle.BICYCLE, start, bicycle.TIMES).q)


def batch():
    import jaxkane as jk

    from . import _bicycle as bicycle

    starts = bicycle.starts(256)
    return lambda: jk.sweep.sweep(bicycle.BICYCLE, starts, bicycle.TIMES)


def sensitivities():
    import jax

    from .sensitivities import problem

    ride, values = problem()
    return lambda: jax.block_until_ready(jax.jit(jax.jacfwd(ride))(values))


def reverse():
    import jax
    import jax.numpy as jnp

    from .sensitivities import problem

    ride, values = problem()
    return lambda: jax.block_until_ready(jax.jit(jax.grad(lambda values: jnp.sum(ride(values) ** 2)))(values))


def fit(path: Path):
    import dataclasses

    import numpy as np

    from jaxkane.fit import Trial, fit_bicycle

    from . import _bicycle as bicycle

    kept = np.load(path)
    measured = {name: kept[name] for name in ("roll", "steer", "roll_rate", "steer_rate")}
    sigma = dict.fromkeys(measured, 0.01)
    torque = {"steer_torque": kept["steer_torque"]}
    trial = Trial(kept["t"], measured, torque, sigma=sigma, initial={"speed": float(kept["speed"])})
    changed = {name: factor * getattr(bicycle.BICYCLE, name) for name, factor in OFF.items()}
    guess = dataclasses.replace(bicycle.BICYCLE, **changed)
    return lambda: fit_bicycle([trial], guess, tuple(OFF), window=2.5, steps=1)


def prepare(path: Path) -> None:
    """A ride of 5 s with a known steer torque and noise, for `fit`."""
    import numpy as np

    import jaxkane as jk

    from . import _bicycle as bicycle

    rng, t, speed = np.random.default_rng(7), np.linspace(0.0, 5.0, 501), 5.2
    torque = sum(np.sin(2.0 * np.pi * f * t + rng.uniform(0.0, 6.0)) for f in (0.4, 0.9, 1.7, 2.9))
    start = jk.assemble(bicycle.BICYCLE, {"roll": 0.02}, {"rear_wheel_rate": -speed / bicycle.BICYCLE.rR})
    ride = jk.simulate(bicycle.BICYCLE, start, t, {"steer_torque": torque})
    names = ("roll", "steer", "roll_rate", "steer_rate")
    noisy = {name: np.asarray(ride[name]) + rng.normal(0.0, 0.01, t.size) for name in names}
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, t=t, speed=speed, steer_torque=torque, **noisy)


if __name__ == "__main__":
    main()
