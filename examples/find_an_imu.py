"""Where on a bicycle does its IMU sit, and what do its gyroscopes and its accelerometer tell?

A riderless bicycle with a motor on its steering axis balances by itself (D. L. Peterson, UC Davis 2013; four runs, 2
and 3 m/s). Its IMU is rigid on the rear frame, at a place that is written nowhere; its roll angle was not measured. The
nonlinear Whipple bicycle carries an IMU at a free place with a free mounting, and the filters of its encoders' rates;
it is fitted in windows of a second that begin where they like, with offsets of torques and sensors in every run.

Then the steering alone: steered slowly, it is nearly damping against the motor's torque. With the motor's gain and the
fork's inertia free as well, all three run off together; what is left of them is a ratio.

    variable           meaning                                                        unit
    steer_damping      viscous torque between fork and frame                          N m s/rad
    place              of the IMU from the rear contact of the upright bicycle:       m
                       forward, to the right, downwards
    mounting           rotation vector of the IMU on the frame                        rad
    offset             of roll_torque: a mass centre that leans out of the frame's plane N m
    gain, IHzz         what the steer motor's torque is of its command; the fork's    1, kg m^2
                       inertia about the vertical
    steer_reading, wheel_reading   rates as the firmware reports them: they lag       rad/s
    imu.gx ... imu.az  gyroscopes, accelerometers along the IMU's axes                rad/s, m/s^2

Run:      python examples/find_an_imu.py [--out FOLDER]
          The runs are shipped with the library (`jaxkane.data.robot_bicycle`).
Appears:  both tables of estimates, the IMU's place with its deviation, the ratio of damping and gain with its own; and
          find_an_imu.png: the place on the bicycle, and a run.
Takes:    about two minutes, half of it compilation.
"""

import argparse
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle, Ellipse

import jaxkane as jk
from jaxkane.catalog import WhippleBicycle
from jaxkane.fit import Free, Gain, LeastSquares, Offset, Trial, fit_bicycle

GOLD, BLUE, INK = "#e8a33d", "#3d8fd1", "#2b2f36"
CHANNELS = {  # of the recording, and what they are called in the description
    "steer": "steer",
    "steer_rate": "steer_reading",
    "rear_wheel_rate": "wheel_reading",
    "roll_rate": "imu.gx",
    "gyro_y": "imu.gy",
    "gyro_z": "imu.gz",
    "acc_x": "imu.ax",
    "acc_y": "imu.ay",
    "acc_z": "imu.az",
}
# Three to five times what a bicycle of rigid bodies leaves unexplained, since that is no noise: neighbouring samples
# are alike, and each tells less than one of its own. Of the others it is nearly all: the frame's vibration.
SIGMA = {"steer": 0.03, "steer_reading": 0.1, "wheel_reading": 0.1, "imu.gx": 0.03, "imu.gz": 0.05}
# Offsets in every run: zeros of steering, motor and accelerometers; of gyroscopes about as large as what they read at
# rest, up to 0.004, 0.007 and 0.001 rad/s.
OFFSETS = {
    "sensor_bias": {"steer": 0.015, "imu.gx": 0.003, "imu.gy": 0.005, "imu.gz": 0.001, "imu.ax": 0.1, "imu.ay": 0.1},
    "input_bias": {"steer_torque": 0.5},
}
# And one that is the bicycle's: a mass centre that lies a degree outside the frame's plane turns with 5 N m.
LEAN = Offset("roll_torque", prior=(0.0, 5.0), scale=5.0)
STARTS = {"roll": 0.1, "steer": None, "roll_rate": None, "steer_rate": None, "rear_wheel_rate": 0.1}


class RobotBicycle(WhippleBicycle):
    """With an IMU on the rear frame, and rates that are filtered before they are reported."""

    place: jax.Array = jk.parameter((0.5, 0.0, -0.8), unit="m")
    mounting: jax.Array = jk.parameter((0.0, 0.0, 0.0), unit="rad")
    states = ("steer_reading", "wheel_reading")
    units = WhippleBicycle.units | dict.fromkeys(states, "rad/s")

    def state_rates(self, t, q, u, x, motion, now):
        # Poles at 20 pi rad/s; before it a mean over 0.1 s, whose lag of 0.05 s is added to that of the wheel's.
        (steer,), _ = jk.sensors.low_pass(u["steer_rate"], x["steer_reading"], 1 / (20 * np.pi))
        (wheel,), _ = jk.sensors.low_pass(u["rear_wheel_rate"], x["wheel_reading"], 0.05 + 1 / (20 * np.pi))
        return {"steer_reading": steer, "wheel_reading": wheel}

    def outputs(self, t, q, u, motion, now):
        B, (x, y, z) = motion["B"], (self.place[i] for i in range(3))
        place = motion["rear wheel"].center.fixed(x * B.x + y * B.y + (z + self.rR) * B.z)
        return {"imu": jk.sensors.imu(now, place, B.rotate_fixed(self.mounting), self.g * motion.N.z)}


def every_second(trial, names, sigma):
    """Every second sample, 100 Hz, of the channels named, by the description's names."""
    measured = {new: trial.measured[old][::2] for old, new in names.items()}
    return Trial(
        trial.t[::2],
        measured,
        {"steer_torque": trial.inputs["steer_torque"][::2]},
        sigma={name: sigma.get(name, 2.0 * float(np.std(y))) for name, y in measured.items()},
        initial={"speed": trial.initial["speed"][::2]},
        name=trial.name.removeprefix("runs, segment "),
    )


def windows_of(trial, seconds=1.0):
    """Trials of their own, whose torques may each have another offset."""
    count = int((trial.t[-1] + 1e-6) / seconds)
    return [trial.between(i * seconds - 1e-6, (i + 1) * seconds - 1e-3) for i in range(count)]


def imu_on_the_frame(recording):
    rides = [every_second(run, CHANNELS, SIGMA) for run in recording.trials]
    bicycle = RobotBicycle.from_parameters(recording.parameters)
    # The recording's columns were turned into the frame's axes already, by hand: within three degrees.
    free = ("steer_damping", Free("place", scale=0.1), Free("mounting", prior=(0.0, 0.05)), LEAN)
    options = {"window": 1.0, "unknown": STARTS, "zero_order_hold": ("steer_torque",), **OFFSETS}
    return fit_bicycle(rides, bicycle, free, optimizer=LeastSquares(rtol=1e-4), **options)


def motor_and_fork(recording):
    names = {"steer": "steer", "roll_rate": "roll_rate"}
    rides = [every_second(run, names, {"steer": 0.01, "roll_rate": 0.03}) for run in recording.trials]
    bicycle = WhippleBicycle.from_parameters(recording.parameters)
    return fit_bicycle(
        [window for ride in rides for window in windows_of(ride)],
        bicycle,
        ("steer_damping", Gain("steer_torque"), "IHzz"),
        input_bias=("roll_torque", "steer_torque"),
        zero_order_hold=("steer_torque",),
        optimizer=LeastSquares(rtol=1e-3),
        steps=20,
    )


def ratio(fit, first, second):
    """Of two estimates, and its standard deviation, to first order."""
    (a, b), (i, j) = ((fit.estimates[n] for n in (first, second)), (fit.names.index(n) for n in (first, second)))
    covariance = fit.clustered_covariance if fit.uses_clustered_errors else fit.covariance
    slopes = np.array([1 / b, -a / b**2])
    return a / b, float(slopes @ covariance[np.ix_([i, j], [i, j])] @ slopes) ** 0.5


def check(alone):
    """All three run off together, and far less is known of each than of the ratio."""
    assert any(note.startswith("steer_damping and gain of steer_torque trade off") for note in alone.notes)
    assert np.abs(alone.correlation).min() > 0.8
    size = np.array([alone.estimates[name] for name in alone.names])
    apart = alone.covariance / np.outer(size, size)
    i, j = (alone.names.index(name) for name in ("steer_damping", "gain of steer_torque"))
    assert apart[i, i] + apart[j, j] - 2 * apart[i, j] < 0.1 * min(apart[i, i], apart[j, j])


def picture(fit, path):
    figure, axes = plt.subplot_mosaic([["bicycle", "steer"], ["bicycle", "imu.gx"]], figsize=(10, 4.5), layout="tight")
    draw_bicycle(axes["bicycle"], fit)
    name, run = next(zip(fit.trial_names, fit.problem.trials, strict=True))
    for channel, label in (("steer", "steer [rad]"), ("imu.gx", "gyroscope x [rad/s]")):
        axes[channel].plot(run.t, run.measured[channel], color=GOLD, linewidth=1.0, label=f"{name}, measured")
        axes[channel].plot(run.t, fit.fitted[name][channel], color=BLUE, linewidth=1.0, label="windows of 1 s, fitted")
        axes[channel].set(ylabel=label)
    axes["imu.gx"].set(xlabel="time [s]")
    axes["steer"].legend(loc="lower right", fontsize="small")
    figure.savefig(path, dpi=120)


def draw_bicycle(axis, fit):
    """From the right side: wheels, frame, and twice the standard deviation of the IMU's place."""
    b, names = fit.system, ("place[0]", "place[2]")
    ground = (b.w + b.c) * np.cos(b.lam) ** 2 - b.rR * np.sin(b.lam) * np.cos(b.lam)  # S, as in `WhippleBicycle`
    S = np.array([ground, b.rR + ground * np.tan(b.lam)])
    for x, r in ((0.0, b.rR), (b.w, b.rF)):
        axis.add_patch(Circle((x, r), r, fill=False, color=INK, linewidth=2))
    axis.plot([0, S[0], b.w], [b.rR, S[1], b.rF], color=INK, linewidth=2)
    axis.plot(b.xB, -b.zB, "o", color=INK, label="mass centre of the rear frame")
    C = fit.clustered_covariance if fit.uses_clustered_errors else fit.covariance
    i = [fit.names.index(name) for name in names]
    sizes, turned = np.linalg.eigh(C[np.ix_(i, i)])
    angle = np.degrees(np.arctan2(-turned[1, 1], turned[0, 1]))
    center = (fit.estimates[names[0]], -fit.estimates[names[1]])
    width, height = 4 * np.sqrt(sizes[::-1])
    axis.add_patch(Ellipse(center, width, height, angle=angle, color=BLUE, alpha=0.4))
    axis.plot(*center, "+", color=BLUE, label="IMU, two standard deviations")
    axis.set(xlabel="forward [m]", ylabel="upwards [m]", xlim=(-0.5, 1.5), ylim=(0, 1.35), aspect="equal")
    axis.legend(loc="upper center", fontsize="small")


def main(folder):
    folder.mkdir(parents=True, exist_ok=True)
    recording = jk.data.robot_bicycle(tuple(CHANNELS))
    found = imu_on_the_frame(recording)
    print(f"The IMU on the frame\n{found}\n")
    for name, (low, high) in found.intervals().items():
        print(f"{name:<24}{low:8.3f} to {high:6.3f}   95 %, errors by {found.clusters[0]}")
    alone = motor_and_fork(recording)
    print(f"\nThe motor's gain and the fork's inertia too\n{alone}")
    value, error = ratio(alone, "steer_damping", "gain of steer_torque")
    check(alone)
    print(f"\ndamping / gain: {value:.2f} with a standard deviation of {error:.2f} N m s/rad")
    picture(found, folder / "find_an_imu.png")
    print("picture:", folder / "find_an_imu.png")


if __name__ == "__main__":
    jk.configure()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the picture (default: figures)")
    main(parser.parse_args().out)
