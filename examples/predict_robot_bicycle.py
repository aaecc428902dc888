"""How well does a model with process noise predict a bicycle? It is fitted to three trials and tested with a fourth.

A riderless bicycle balances with a motor on its steering axis (D. L. Peterson, UC Davis, 2013). Seals, the headset and
the floor disturb it in ways that are not modelled. A fit without process noise would treat these disturbances as sensor
errors. In this example, white noise acts on roll and steer, and a Kalman filter predicts each sample from the previous
ones. The friction, the intensity of the noise and the errors of the sensors maximize the likelihood of these
predictions. The dry friction of the steering is the law that the search in
`notebooks/12_an_imu_on_a_robot_bicycle.ipynb` finds. Each ride is cut into pieces of 2.5 s, because the intervals
follow from the scatter between pieces and between rides. The fourth trial is held out. All samples are used, at 100 Hz.

    variable             meaning                                        unit
    steer, roll_rate     measured: an encoder and a gyroscope           rad, rad/s
    roll                 not measured                                   rad
    steer_torque         command to the motor                           N m

Run:      python examples/predict_robot_bicycle.py [--out FOLDER]
          The data are included in the library (`jaxkane.data.robot_bicycle`).
Appears:  predict_robot_bicycle.png: steer predicted 0.1 s ahead, its errors, and the roll angle with its band; printed
          are the fit, whether the innovations are white, and the prediction errors of the model and of two simple
          rules.
Takes:    a minute.
"""

import argparse
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxkane as jk
from jaxkane.catalog import WhippleBicycle
from jaxkane.fit import (
    Free,
    LeastSquares,
    NoiseScale,
    Offset,
    SpectralDensity,
    Trial,
    bicycle_rides,
    fit_bicycle,
    validate,
)

jk.configure()

SIGMA = {"steer": 0.0003, "roll_rate": 0.003}  # [rad, rad/s]: at rest; of steer a guess, since its factor is estimated
START = {"roll": 0.1, "steer": 0.1, "roll_rate": 0.3, "steer_rate": 1.0}  # standard deviations
FREE = (
    "steer_damping",
    Free("dry_friction", start=0.1, bounds=(0.0, None)),
    SpectralDensity("roll_rate"),
    SpectralDensity("steer_rate"),
    NoiseScale("steer"),
    Offset("steer", each="trial", prior=(0.0, 0.02)),
    Offset("steer_torque", each="trial", prior=(0.0, 0.5)),
)


class Bicycle(WhippleBicycle):
    dry_friction: jk.Scalar = jk.parameter(0.0, unit="N m")  # of the steering

    def loads(self, t, q, u, motion, inputs):
        friction = self.dry_friction * jnp.tanh(u["steer_rate"] / 0.05)
        torque = jk.Torque(-friction * motion["C"].z, motion["fork"], reaction_on=motion["rear frame"])
        return (*super().loads(t, q, u, motion, inputs), torque)


def at_100_hz(run, every=1):
    """A ride at 100 Hz; measured at `every` so many samples, with gaps in between."""
    measured = {}
    for name in SIGMA:
        measured[name] = np.full(len(run.t[::2]), np.nan)
        measured[name][::every] = run.measured[name][:: 2 * every]
    inputs, initial = {"steer_torque": run.inputs["steer_torque"][::2]}, {"speed": run.initial["speed"][::2]}
    return Trial(run.t[::2], measured, inputs, sigma=SIGMA, initial=initial, labels={"run": run.name})


def pieces(run, seconds=2.5):
    ride = at_100_hz(run)
    starts = ride.t[0] + seconds * np.arange(int((ride.t[-1] - ride.t[0]) / seconds))
    return [ride.between(a - 1e-6, a + seconds - 0.005) for a in starts]


def errors_of_predictions(result, run, every):
    """Of a held-out ride, rms by channel: predicted by the filter, by the last value, and by the last two; at samples
    `every` so many apart, the first second left out."""
    table = {}
    for name in SIGMA:
        y = run.measured[name][:: 2 * every]
        predicted = result.fitted[result.trial_names[0]][name][::every]
        rules = y - predicted, np.diff(y, prepend=y[0]), np.concatenate([[0.0, 0.0], np.diff(y, 2)])
        table[name] = [float(np.sqrt(np.mean(e[100 // every :] ** 2))) for e in rules]
    return table


def drawn(path, held_out, run, motion):
    figure, (above, middle, below) = plt.subplots(3, 1, figsize=(8, 6.5), sharex=True, layout="constrained")
    t, y = run.t[::2], run.measured["steer"][::2]
    predicted = held_out.fitted[held_out.trial_names[0]]["steer"]
    above.plot(t, y, color="0.6", lw=2.5, label="measured")
    above.plot(t[::10], predicted[::10], "o", ms=3, label="predicted 0.1 s ahead")
    above.set(ylabel="steering angle [rad]")
    above.legend(frameon=False, ncols=2)
    middle.plot(t[::10], 1e3 * (y - predicted)[::10], lw=1.0, label="filter")
    middle.plot(t[10::10], 1e3 * (y[10::10] - y[:-10:10]), color="0.6", lw=0.8, label="last value")
    middle.set(ylabel="error [mrad]")
    middle.legend(frameon=False, ncols=2)
    low, high = motion.band("roll")
    below.plot(t, motion["roll"], lw=1.0, label="estimated from all measurements, never measured")
    below.fill_between(t, low, high, alpha=0.25, lw=0)
    below.set(xlabel="time [s]", ylabel="roll angle [rad]")
    below.legend(frameon=False)
    figure.savefig(path, dpi=150)


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    recording = jk.data.robot_bicycle()
    bicycle = Bicycle.from_parameters(recording.parameters)
    *fitted, unseen = recording.trials
    result = fit_bicycle(
        [piece for run in fitted for piece in pieces(run)],
        bicycle,
        FREE,
        noise={"roll_rate": 0.01, "steer_rate": 0.1},
        unknown=START,
        zero_order_hold=("steer_torque",),
        optimizer=LeastSquares(rtol=1e-6),
    )
    print(result)
    held_out = validate(result, bicycle_rides(at_100_hz(unseen), bicycle))
    print("\ninnovations              rms, which is 1 where the noise is right    correlation of neighbours")
    for of, name in ((result, "fitted"), (held_out, "held out")):
        for channel in SIGMA:
            rms, neighbours = (
                [getattr(tests[channel], what) for tests in of.tests.values()] for what in ("rms", "autocorrelation")
            )
            print(f"{name:<17} {channel:<20}{np.mean(rms):.2f}{np.mean(neighbours):36.2f}")

    print(f"\nrms errors of predictions of the held-out ride, {unseen.name[-6:]}")
    print("                      filter   last value   line through the last two")
    sparse = validate(result, bicycle_rides(at_100_hz(unseen, every=10), bicycle))
    for ahead, prediction, every in (("0.01 s", held_out, 1), ("0.1 s", sparse, 10)):
        for name, numbers in errors_of_predictions(prediction, unseen, every).items():
            print(f"{ahead:<8}{name:<12}" + "".join(f"{x:10.5f}" for x in numbers))
            assert numbers[0] < min(numbers[1:]) or name == "roll_rate"
    drawn(folder / "predict_robot_bicycle.png", sparse, unseen, next(iter(held_out.smoothed().values())))
    print("What the gyroscope reads is mostly vibration, which nothing predicts.")
    assert result.status == "converged"
    assert all(abs(test.autocorrelation) < 0.2 for tests in held_out.tests.values() for test in tests.values())
    low, high = result.intervals()["dry_friction"]
    assert 0.1 < low < high < 0.2


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder (default: figures)")
    main(parser.parse_args().out)
