"""What is the roll angle of a bicycle if only gyroscopes and the steering angle are measured?

A rider on a treadmill is pulled sideways five times (J. K. Moore, UC Davis, 2012). A Kalman filter estimates the motion
sample by sample. Its model is the Whipple bicycle with unmeasured torques and two gyroscopes whose offsets drift. The
roll angle was measured too, but the filter does not use it. The filter is then exported to C, compiled, and run with
the same samples.

    variable                 meaning                                                       unit
    roll, steer              angles; roll is estimated                                     rad
    gyro_roll, gyro_steer    readings of the gyroscopes: rates and an offset               rad/s
    roll_offset, steer_offset  the offsets, also estimated                                 rad/s
    rear_wheel_rate          from the treadmill's speed                                    rad/s

Run:      python examples/estimate_roll.py [--out FOLDER]
          The data are included in the library (`jaxkane.data.davis_rider`).
Appears:  estimate_roll.png: the roll angle, measured and estimated, and the offsets; roll_filter.h and its test, the
          filter in C; printed are the errors of the filter and of two methods without a model, and the time of a step.
Takes:    about ten seconds, most of it compilation.
"""

import argparse
import os
import shutil
import subprocess
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxkane as jk
from jaxkane.catalog import WhippleBicycle

jk.configure()

# Standard deviations of what is measured.
SENSORS = {"steer": 0.01, "gyro_roll": 0.03, "gyro_steer": 0.1, "rear_wheel_rate": 0.05}
NOISE = {"roll_torque": 1000.0, "steer_torque": 10.0, "rear_wheel_rate": 0.01}  # spectral densities [N^2 m^2 s, 1/s^3]
OFFSETS = {"roll_offset": 1e-7, "steer_offset": 1e-7}  # [rad^2/s^3]


class BicycleWithGyroscopes(WhippleBicycle):
    roll_offset: jk.Scalar = jk.parameter(0.0, unit="rad/s")
    steer_offset: jk.Scalar = jk.parameter(0.0, unit="rad/s")

    def outputs(self, t, q, u, motion, now):
        return {"gyro_roll": u["roll_rate"] + self.roll_offset, "gyro_steer": u["steer_rate"] + self.steer_offset}


MAIN = """
#include "roll_filter.h"

#include <stdio.h>

/* Reads the time step and the four measurements of each sample, and prints the roll angle. */
int main(void) {
    roll_filter_belief belief = roll_filter_start;
    roll_filter_innovation innovation;
    const double inputs[3] = {0.0, 0.0, 0.0};
    double dt, measured[4];
    while (scanf("%lf %lf %lf %lf %lf", &dt, measured, measured + 1, measured + 2, measured + 3) == 5) {
        roll_filter_predict(&belief, &roll_filter_default, dt, inputs);
        roll_filter_update(&belief, &roll_filter_default, measured, inputs, 0, &innovation);
        printf("%.17g\\n", belief.mean[0]);
    }
    return 0;
}
"""


def followed(filter, belief, dts, measured):
    """What is known after each sample: means and standard deviations (m, n), normalized innovations squared (m,)."""

    def step(belief, sample):
        dt, y = sample
        belief = jk.estimate.predict(filter, belief, dt)
        belief, innovation = jk.estimate.update(filter, belief, y)
        return belief, (belief.mean[0], belief.deviation(), innovation.nis)

    run = jax.jit(lambda belief, samples: jax.lax.scan(step, belief, samples)[1])
    samples = jnp.asarray(dts), jnp.asarray(measured)
    jax.block_until_ready(run(belief, samples))
    started = time.perf_counter()
    results = jax.block_until_ready(run(belief, samples))
    print(f"a step takes {1e6 * (time.perf_counter() - started) / len(dts):.0f} us")
    return [np.asarray(x) for x in results]


def in_c(files, folder, dts, measured):
    """The roll angle by the exported filter (m,), or None without a compiler."""
    compiler = shutil.which(os.environ.get("CC", "cc")) or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        print("There is no C compiler here.")
        return None
    source, program = folder / "roll_filter_main.c", folder / "roll_filter"
    source.write_text(MAIN)
    subprocess.run([compiler, "-std=c99", "-O2", str(source), "-lm", "-o", str(program)], check=True)
    samples = "\n".join(" ".join(f"{x:.17g}" for x in row) for row in np.column_stack([dts, measured]))
    started = time.perf_counter()
    ran = subprocess.run([program], input=samples, check=True, capture_output=True, text=True)
    print(f"a step in C takes {1e6 * (time.perf_counter() - started) / len(dts):.0f} us")
    return np.array(ran.stdout.split(), float)


def drawn(path, t, roll, mean, deviation, offset, names):
    figure, (above, below) = plt.subplots(2, 1, figsize=(8, 5), sharex=True, layout="constrained")
    i = names.index("roll")
    above.plot(t, roll, color="0.6", lw=0.8, label="measured, not given to the filter")
    above.plot(t, mean[:, i], lw=1.0, label="estimated, with two standard deviations")
    above.fill_between(t, mean[:, i] - 2 * deviation[:, i], mean[:, i] + 2 * deviation[:, i], alpha=0.25, lw=0)
    above.set(ylabel="roll angle [rad]")
    above.legend(frameon=False, loc="upper right")
    for name in OFFSETS:
        below.plot(t, mean[:, names.index(name)], label=name.replace("_", " "))
    below.axhline(offset, color="0.6", ls="--", lw=0.8, label="mean of the roll gyroscope")
    below.set(xlabel="time [s]", ylabel="offset [rad/s]")
    below.legend(frameon=False, loc="upper right")
    figure.savefig(path, dpi=150)


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    recording = jk.data.davis_rider()
    ride = recording.trials[0]
    bicycle = BicycleWithGyroscopes.from_parameters(recording.parameters["rigid_rider_and_bicycle"])
    t, roll = np.asarray(ride.t), np.asarray(ride.measured["roll"])
    wheel_rate = -float(np.median(ride.initial["speed"])) / float(bicycle.rR)
    columns = [ride.measured[name] for name in ("steer", "roll_rate", "steer_rate")]
    measured = np.column_stack([*columns, np.full(len(t), wheel_rate)])[1:]
    dts = np.diff(t)

    filter = jk.estimate.Filter(bicycle, SENSORS, noise=NOISE, drift=OFFSETS)
    start = jk.assemble(bicycle, {"steer": float(ride.measured["steer"][0])}, {"rear_wheel_rate": wheel_rate})
    unknown = {
        "roll": 0.1,
        "steer": 0.05,
        "roll_rate": 0.3,
        "steer_rate": 0.3,
        "roll_offset": 0.05,
        "steer_offset": 0.05,
    }
    belief = jk.estimate.begin(filter, start, unknown)
    mean, deviation, nis = followed(filter, belief, dts, measured)

    i, gyroscope = filter.names.index("roll"), measured[:, 1]
    summed = np.cumsum(gyroscope * dts)
    rms = lambda x: float(np.sqrt(np.mean(x**2)))  # noqa: E731
    error = mean[:, i] - roll[1:]
    print("\nroll angle, rms of the difference from what was measured [rad]")
    print(f"  gyroscope summed               {rms(summed - roll[1:]):.4f}")
    print(f"  upright always                 {rms(roll):.4f}")
    print(f"  the filter                     {rms(error):.4f}")
    print(f"  its own standard deviation     {np.median(deviation[:, i]):.4f} (median)")
    offset = mean[-1, filter.names.index("roll_offset")]
    print(f"offset of the roll gyroscope: {offset:.4f} rad/s, mean of its reading {gyroscope.mean():.4f} rad/s")
    print(f"normalized innovation squared: {nis.mean():.2f} of {len(SENSORS)} measurements")

    files = jk.export.c_filter(filter, folder / "roll_filter.h", belief)
    print(f"\n{files.header}: {len(files.header.read_text().splitlines())} lines")
    by_c = in_c(files, folder, dts, measured)
    drawn(folder / "estimate_roll.png", t[1:], roll[1:], mean, deviation, gyroscope.mean(), filter.names)

    assert rms(error) < 0.0095 < 0.4 < rms(summed - roll[1:])
    assert abs(offset - gyroscope.mean()) < 0.005
    if by_c is not None:
        difference = np.abs(by_c - mean[:, i]).max()
        print(f"after {len(t)} samples C and Python differ by at most {difference:.1e} rad")
        assert difference < 1e-9


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder (default: figures)")
    main(parser.parse_args().out)
