"""What do gears cost? A double pendulum with two geared motors, identified from measured torques and angles.

Two arms of 0.2 and 0.3 m hang from each other, each driven by a motor with a gear of 6:1 (DFKI's double pendulum,
2022; five runs of ten seconds). The arms' inertia, that of the rotors and the friction of the gears are found in
windows of half a second, each of which begins where it likes: such motions forget their beginning soon. Twice: with
viscous and dry friction; and with what gears do besides, friction in proportion to the torque that they carry, zeros
of the angles that are off, and clocks that differ. No parameters explain the run sysid_00 with the others; its
deviations are taken as five times as large, so that the others are not bent to it.

    variable             meaning                                                              unit
    angle1, angle2       of the first arm from hanging, of the second relative to the first   rad
    torque1, torque2     after the gears, the drives' estimate from their currents            N m
    inertia1, inertia2   of the arms about their joints                                       kg m^2
    moment1, center2     mass times mass centre of the first arm; mass centre of the          kg m, m
                         second, whose mass is held: it sets the scale of all others
    rotor                inertia of a rotor, before the gear                                  kg m^2
    viscous, dry, gears  torque by rate, that which only turns its sign, and the share of     N m s/rad, N m, 1
                         the carried torque
    zero1, zero2         where the encoders read zero                                         rad

Run:      python examples/identify_geared_arms.py [--out FOLDER]
Appears:  both tables of estimates, the medians of the windows' rms errors, and identify_geared_arms.png: a run, and how
          many windows each model explains how well.
Takes:    about a minute and a half.
"""

import argparse
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np

import jaxkane as jk
from jaxkane.fit import Delay, Free, LeastSquares, Simulation, Trial

jax.config.update("jax_enable_x64", True)

GOLD, BLUE, INK = "#e8a33d", "#3d8fd1", "#2b2f36"
GEAR, LENGTH, WINDOW = 6.0, 0.2, 0.5  # [1], [m] of the first arm, [s]


class GearedArms(jk.System):
    inertia1: jk.Scalar = jk.parameter(0.025, positive=True, unit="kg m^2")
    moment1: jk.Scalar = jk.parameter(0.13, unit="kg m")
    mass2: jk.Scalar = jk.parameter(0.5, positive=True, unit="kg")
    center2: jk.Scalar = jk.parameter(0.37, unit="m")
    inertia2: jk.Scalar = jk.parameter(0.07, positive=True, unit="kg m^2")
    rotor: jk.Scalar = jk.parameter(1e-4, positive=True, unit="kg m^2")
    viscous1: jk.Scalar = jk.parameter(0.0, unit="N m s/rad")
    viscous2: jk.Scalar = jk.parameter(0.0, unit="N m s/rad")
    dry1: jk.Scalar = jk.parameter(0.1, unit="N m")
    dry2: jk.Scalar = jk.parameter(0.1, unit="N m")
    gears: jk.Scalar = jk.parameter(0.0)
    zero1: jk.Scalar = jk.parameter(0.0, unit="rad")
    zero2: jk.Scalar = jk.parameter(0.0, unit="rad")

    coordinates, speeds = ("angle1", "angle2"), ("rate1", "rate2")
    inputs = ("torque1", "torque2")
    units = {"angle1": "rad", "angle2": "rad", "torque1": "N m", "torque2": "N m"}

    def motion(self, t, q, u):
        N, O = jk.inertial()
        A = N.rotate(3, q["angle1"] - self.zero1, u["rate1"])
        B = A.rotate(3, q["angle2"] - self.zero2, u["rate2"])
        elbow = O.fixed(-LENGTH * A.y)
        slender = lambda inertia: (inertia, 0.0, inertia)  # noqa: E731
        # The first arm's mass is not felt beside its moment and its inertia: any will do.
        first = jk.Body(1.0, slender(self.inertia1), O.fixed(-self.moment1 * A.y), A, about=O, name="first")
        center = elbow.fixed(-self.center2 * B.y)
        second = jk.Body(self.mass2, slender(self.inertia2), center, B, about=elbow, name="second")
        shoulder_rotor = jk.loads.rotor(self.rotor, N.z, GEAR * u["rate1"], N, O, name="shoulder rotor")
        elbow_rotor = jk.loads.rotor(self.rotor, A.z, -GEAR * u["rate2"], A, elbow, name="elbow rotor")
        return jk.Motion([first, second, shoulder_rotor, elbow_rotor])

    def transmitted(self, torque, rate, dry, viscous):
        """What a gear leaves of a torque."""
        carried = self.gears * jk.loads.smooth_abs(torque, 0.01)
        return torque - jk.loads.coulomb(rate, dry + carried, width=0.1) - viscous * rate

    def loads(self, t, q, u, motion, inputs):
        first, second, z = motion["first"], motion["second"], motion.N.z
        shoulder = self.transmitted(inputs["torque1"], u["rate1"], self.dry1, self.viscous1)
        elbow = self.transmitted(inputs["torque2"], u["rate2"], self.dry2, self.viscous2)
        gravity = -9.81 * motion.N.y
        weights = jk.Force(1.0 * gravity, first.center), jk.Force(self.mass2 * gravity, second.center)
        return weights, jk.Torque(shoulder * z, first), jk.Torque(elbow * z, second, first)


def fitted(trials, extra):
    dry = [Free(name, bounds=(0.0, None)) for name in ("dry1", "dry2")]
    fit = jk.fit.fit(
        GearedArms(),
        trials,
        ["inertia1", "moment1", "center2", "inertia2", "rotor", *dry, *extra],
        unknown=("angle1", "angle2", "rate1", "rate2"),
        window=WINDOW,
        simulation=Simulation(step=0.004),  # every second sample: the torques change slowly
        optimizer=LeastSquares(),
        steps=12,
    )
    medians = [np.median(windows_rms(fit, channel)) for channel in ("angle1", "angle2")]
    print(f"{fit.table()}\nmedian of the windows' rms errors: {medians[0]:.4f}, {medians[1]:.4f} rad\n")
    return fit


def windows_rms(fit, channel):
    """Root mean square errors [rad] of all windows."""
    found = []
    for name, trial in zip(fit.trial_names, fit.problem.trials, strict=True):
        error = fit.residuals[name][channel] * trial.sigma[channel]
        number = ((trial.t - trial.t[0]) / WINDOW + 1e-9).astype(int)
        found += [
            np.sqrt(np.mean(error[number == k] ** 2)) for k in range(number.max() + 1) if (number == k).sum() > 20
        ]
    return found


def picture(fits, path):
    figure, axes = plt.subplot_mosaic([["run", "run"], ["angle1", "angle2"]], figsize=(9, 6), layout="constrained")
    trial = next(iter(fits.values())).problem.trials[2]
    for channel, color, label in (("angle1", INK, "first arm"), ("angle2", "#8a8f98", "second arm, relative to it")):
        axes["run"].plot(trial.t, trial.measured[channel], color=color, linewidth=1.0, label=label)
        for other, (name, fit) in zip((GOLD, BLUE), fits.items(), strict=True):
            errors = 1e3 * np.sort(windows_rms(fit, channel))
            axes[channel].step(errors, np.arange(1, errors.size + 1) / errors.size, color=other, label=name)
        axes[channel].set(xscale="log", xlabel=f"{label}: rms error [mrad]", ylabel="share of the windows")
        axes[channel].set_xticks([3, 10, 30, 100], ["3", "10", "30", "100"])
        axes[channel].minorticks_off()
        axes[channel].grid(alpha=0.3)
    axes["run"].set(xlabel=f"time [s] of {trial.name}", ylabel="angle [rad]")
    axes["run"].legend(loc="upper right", ncols=2)
    axes["angle1"].legend(loc="lower right")
    figure.savefig(path, dpi=120)


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    recording = jk.data.driven_double_pendulum()
    print(recording)
    trials = [
        Trial(
            run.t,
            run.measured,
            run.inputs,
            sigma=0.05 if "sysid_00" in run.name else 0.01,
            initial=run.initial,
            name=run.name,
        )
        for run in recording.trials
    ]
    delays = [Delay("torque1"), Delay("torque2")]
    viscous = [Free(name, start=0.005, bounds=(0.0, None)) for name in ("viscous1", "viscous2")]
    fits = {
        "viscous and dry friction": fitted(trials, viscous),
        "gears, zeros, clocks": fitted(trials, [Free("gears", scale=0.05), "zero1", "zero2", *delays]),
    }
    picture(fits, folder / "identify_geared_arms.png")
    print("picture:", folder / "identify_geared_arms.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the picture (default: figures)")
    main(parser.parse_args().out)
