"""Can identification be trusted? Figures on simulated and measured bicycles, with the time that they take.

    unstable   the benchmark bicycle at 3 m/s, which falls over by itself, kept up by a rider for 10 s; noise and
               offsets on roll rate, steer and steer rate; three parameters up to 30 % off, ten random initial guesses;
               by multiple shooting, and by a single shoot
    coverage   at 1, 3, 5 and 7 m/s jointly, eight parameters: how often 95 % intervals hold the truth in repetitions
    measured   31 rides of a steer-by-wire bicycle: damping alone, four parameters, trials left out

Run:      python benchmarks/identification.py [unstable] [coverage] [measured] [--repetitions 100]
Takes:    on two cores two minutes, two minutes, and one.
"""

import argparse
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxkane as jk
from jaxkane.catalog import WhippleBicycle
from jaxkane.fit import (
    Gain,
    LeastSquares,
    Offset,
    Problem,
    Trial,
    cross_validate,
    fit_bicycle,
    minimize,
    multi_start,
    report,
)

jax.config.update("jax_enable_x64", True)

NOISE = {"roll_rate": 0.01, "steer": 0.003, "steer_rate": 0.02}  # [rad/s], [rad], [rad/s]
OFFSETS = [Offset(channel, each="trial") for channel in NOISE]
OFFSET = {"roll_rate": 0.02, "steer": -0.01, "steer_rate": 0.03}
UNKNOWN = ("roll", "steer", "roll_rate", "steer_rate", "rear_wheel_rate")


def ride(bicycle, speed, seconds, seed):
    """A ride at 100 Hz in which a digital rider holds the roll angle near zero and pokes at the handlebar: times,
    true channels, and the torque, which is kept until the next sample."""
    rng = np.random.default_rng(seed)
    h = 0.01
    t = h * np.arange(round(seconds / h))
    frequencies, phases = np.array([0.35, 0.8, 1.3, 2.1, 3.1]), rng.uniform(0.0, 2.0 * np.pi, 5)
    pokes = jnp.asarray(min(1.5, 0.5 * speed) * np.sin(2 * np.pi * frequencies * t[:, None] + phases).sum(axis=1))
    gain, span = 25.0 + 60.0 / speed, jnp.linspace(0.0, h, 3)
    roll, steer = bicycle.coordinates.index("roll"), bicycle.coordinates.index("steer")

    def interval(state, poke):
        torque = gain * (state.q[roll] + 0.4 * state.u[0]) - 4.0 * state.u[2] + poke
        after = jk.simulate(bicycle, state, span, {"steer_torque": torque}, step=h / 2, adjoint="forward").state()
        return after, (state.q[roll], state.q[steer], state.u[0], state.u[2], torque)

    start = jk.assemble(bicycle, {"roll": 0.03}, {"rear_wheel_rate": -speed / bicycle.rR})
    _, rows = jax.jit(lambda start: jax.lax.scan(interval, start, pokes))(start)
    *channels, torque = (np.asarray(row) for row in rows)
    assert np.all(np.isfinite(torque))
    return t, dict(zip(("roll", "steer", "roll_rate", "steer_rate"), channels)), torque


def noisy(t, channels, torque, rng, name, speed, offset=OFFSET):
    measured = {c: channels[c] + offset.get(c, 0.0) + rng.normal(0.0, s, t.size) for c, s in NOISE.items()}
    wheel = {"rear_wheel_rate": -speed / float(WhippleBicycle.benchmark().rR)}
    return Trial(t, measured, {"steer_torque": torque}, sigma=NOISE, initial=wheel, name=name)


def unstable():
    truth, names = WhippleBicycle.benchmark(), ("IBxx", "zB", "c")
    trial = noisy(*ride(truth, 3.0, 10.0, 1), np.random.default_rng(0), "3 m/s", 3.0)
    options = {"unknown": UNKNOWN, "zero_order_hold": ("steer_torque",)}
    tight = {"roll": 1e-4, "steer": 1e-4, "roll_rate": 1e-3, "steer_rate": 1e-3, "rear_wheel_rate": 1e-4}
    for what, more in {
        "windows of 1 s with free starts": {"window": 1.0},
        "windows of 1 s, chained": {"window": 1.0, "defect_std": tight},
        "a single shoot": {},
    }.items():
        problem = Problem.of(truth, trial, (*names, *OFFSETS), **more, **options)
        began = time.perf_counter()
        try:
            found = multi_start(problem, 10, spread=0.3, seed=2)
        except ValueError as error:
            print(f"\n{what}: {error}")
            continue
        print(f"\n{what}: {time.perf_counter() - began:.1f} s with compilation\n{found}")
        right = [all(abs(f.estimates[n] / float(getattr(truth, n)) - 1) < 0.01 for n in names) for f in found.fits]
        print(f"all three within 1 %: {sum(right)} of 10\n{found.best.table(truth)}")


EIGHT = ("c", "lam", "IBxx", "IBxz", "IBzz", "zB", "IFyy", "steer_damping")


def coverage(repetitions):
    truth = eqx.tree_at(lambda b: b.steer_damping, WhippleBicycle.benchmark(), jnp.asarray(0.5))
    rides = [(ride(truth, speed, 8.0, seed), speed) for seed, speed in enumerate((1.0, 3.0, 5.0, 7.0))]
    guess = truth
    for i, name in enumerate(EIGHT):
        value = getattr(truth, name) * (1.05 if i % 2 else 0.95)
        guess = eqx.tree_at(lambda b, name=name: getattr(b, name), guess, value)
    options = {"unknown": UNKNOWN, "zero_order_hold": ("steer_torque",)}
    first = None
    hits, scores, began = np.zeros(len(EIGHT), int), [], time.perf_counter()
    for k in range(repetitions):
        rng = np.random.default_rng(100 + k)
        trials = [noisy(*r, rng, f"{speed:g} m/s", speed) for r, speed in rides]
        problem = Problem.of(guess, trials, (*EIGHT, *OFFSETS), window=1.0, **options)
        # What matters is where it ends: after the first time it starts there.
        result = first = minimize(problem, LeastSquares(), start=first.point if first else None)
        assert result.status == "converged", result
        intervals, errors = result.intervals(0.95), result.standard_errors
        hits += [low <= float(getattr(truth, n)) <= high for n, (low, high) in intervals.items()]
        scores.append([(result.estimates[n] - float(getattr(truth, n))) / errors[n] for n in EIGHT])
        if k == 0:
            print(f"{result}\n{result.table(truth)}\n{report(result)}", flush=True)
        if (k + 1) % 10 == 0:
            print(
                f"{k + 1} repetitions, {time.perf_counter() - began:.0f} s: {dict(zip(EIGHT, hits.tolist()))}",
                flush=True,
            )
    z = np.array(scores)
    for name, n, mean, std in zip(EIGHT, hits, z.mean(axis=0), z.std(axis=0)):
        print(f"{name:<16}{n:>4} of {repetitions} intervals hold the truth; z {mean:+.2f} ± {std:.2f}")


def measured():
    recording = jk.data.steer_by_wire()
    rides, bicycle = recording.trials, WhippleBicycle.from_parameters(recording.parameters)
    options = {"zero_order_hold": ("steer_torque",), "optimizer": LeastSquares()}
    offsets = [Offset(name, each="trial") for name in ("roll_torque", "steer_torque")]
    four = (Gain("steer_torque"), "steer_damping", "IHzz", "c")
    for free in (("steer_damping",), four, four, (*four, "IBxx")):
        began = time.perf_counter()
        result = fit_bicycle(rides, bicycle, (*free, *offsets), **options)
        print(f"\n{time.perf_counter() - began:.1f} s\n{result}")
        if free == ("steer_damping",):
            print(cross_validate(result))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", default=["unstable", "coverage"], help="unstable, coverage, measured")
    parser.add_argument("--repetitions", type=int, default=100)
    arguments = parser.parse_args()
    if "unstable" in arguments.what:
        unstable()
    if "coverage" in arguments.what:
        coverage(arguments.repetitions)
    if "measured" in arguments.what:
        measured()


if __name__ == "__main__":
    main()
