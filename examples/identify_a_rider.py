"""What does a bicycle with a rider on it lack, and is it the rider?

A rider in a harness that leaves him nothing but his arms steers a bicycle on a treadmill, and is pulled sideways five
times (J. K. Moore, UC Davis 2012; 40 s at 3.17 m/s). The torque of his hands and the force of the rope were measured:
what acts is known, he has no model of his own. The Whipple bicycle with the rider fixed to its frame, friction in the
steering and the height of the rope are fitted in 39 windows of a second, each with its own start and offsets of torque.
Then it is asked what is missing: clocks and gains of the instruments, dry friction, a spring of the arms, inertias.

    variable        meaning                                                                 unit
    steer_damping   viscous torque between fork and frame                                   N m s/rad
    rope_height     of the place where the rope pulls, above the ground; 0.943 was measured m
    dry_friction    of the steering                                                         N m
    arm_stiffness   of the rider's arms, between frame and fork                             N m/rad
    delay, gain     of an instrument; a negative delay is that of all others                s, 1

Run:      python examples/identify_a_rider.py [--out FOLDER]
          The ride is shipped with the library (`jaxkane.data.davis_rider`).
Appears:  the table of what is promised by what, both fits, and what says that the answer is right without any model:
          the steering rate is measured by gyroscopes too. identify_a_rider.png shows the rope's third pull.
Takes:    about a minute and a half, most of it compilation.
"""

import argparse
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy import signal

import jaxkane as jk
from jaxkane.catalog import WhippleBicycle
from jaxkane.fit import Delay, Free, Gain, LeastSquares, fit_bicycle, forward_selection

GOLD, BLUE, INK = "#e8a33d", "#3d8fd1", "#2b2f36"
CHANNELS = ("roll", "steer", "roll_rate", "steer_rate")


class PulledBicycle(WhippleBicycle):
    """Pulled by a rope behind the rider; zero friction and stiffness are the Whipple bicycle's."""

    rope_height: jk.Scalar = jk.parameter(0.943, unit="m")
    rope_place: jk.Scalar = jk.parameter(0.2, unit="m")  # before the rear contact
    dry_friction: jk.Scalar = jk.parameter(0.0, unit="N m")
    arm_stiffness: jk.Scalar = jk.parameter(0.0, unit="N m/rad")
    inputs = (*WhippleBicycle.inputs, "lateral_force")
    units = WhippleBicycle.units | {"lateral_force": "N"}

    def loads(self, t, q, u, motion, inputs):
        B, fork, frame = motion["B"], motion["fork"], motion["rear frame"]
        knot = motion["rear wheel"].center.fixed(self.rope_place * B.x + (self.rR - self.rope_height) * B.z)
        friction = self.dry_friction * jnp.tanh(u["steer_rate"] / 0.05)
        return (
            *super().loads(t, q, u, motion, inputs),
            jk.Force(inputs["lateral_force"] * motion["Y"].y, knot),
            jk.Torque(-(friction + self.arm_stiffness * q["steer"]) * motion["C"].z, fork, reaction_on=frame),
        )


CANDIDATES = (
    *(Delay(channel) for channel in CHANNELS),
    *(Gain(channel, prior=(1.0, 0.1)) for channel in CHANNELS),
    Gain("steer_torque", prior=(1.0, 0.05)),
    Free("dry_friction", bounds=(0.0, None)),
    Free("arm_stiffness", bounds=(0.0, None)),
    "IHzz",
    "c",
)
PLAUSIBLE = {"rope_height": 0.1, "c": 0.2, "IHzz": 0.5, **{f"delay of {c}": (-0.05, 0.05) for c in CHANNELS}}


def windows_of(ride, seconds=1.0):
    """Trials of their own, whose torques may each have another offset."""
    count, first = int((ride.t[-1] - ride.t[0]) / seconds), ride.t[0] - 1e-6
    return [ride.between(first + i * seconds, first + (i + 1) * seconds - 1e-3) for i in range(count)]


def lag(t, early, late, hertz=8.0):
    """By how much [s] one signal goes behind another, where they correlate best; both low-passed without lag."""
    step = float(np.median(np.diff(t)))
    early, late = (signal.filtfilt(*signal.butter(2, 2 * step * hertz), x) for x in (early, late))
    shifts, n = np.arange(-20, 21), len(t)
    found = [np.corrcoef(early[20 : n - 20], late[20 + k : n - 20 + k])[0, 1] for k in shifts]
    return shifts[int(np.argmax(found))] * step


def picture(fits, path):
    figure, axes = plt.subplots(len(CHANNELS), sharex=True, figsize=(8, 7), layout="constrained")
    shown = [i for i, trial in enumerate(next(iter(fits.values())).problem.trials) if 21.9 < trial.t[0] < 25]
    for axis, channel in zip(axes, CHANNELS, strict=True):
        for i in shown:
            first = i == shown[0]
            for color, (name, fit) in zip((GOLD, BLUE), fits.items(), strict=True):
                trial = fit.problem.trials[i]
                if color == GOLD:
                    axis.plot(trial.t, trial.measured[channel], color=INK, linewidth=1, label="measured" * first)
                axis.plot(trial.t, fit.fitted[fit.trial_names[i]][channel], color=color, label=name * first)
        axis.set(ylabel=f"{channel} [rad{'/s' if 'rate' in channel else ''}]")
    axes[0].legend(loc="upper right", fontsize="small")
    axes[-1].set(xlabel="time [s]: windows of a second around the third pull")
    figure.savefig(path, dpi=120)


def main(folder):
    folder.mkdir(parents=True, exist_ok=True)
    recording = jk.data.davis_rider()
    ride = recording.trials[0]
    windows = windows_of(ride)
    # An earlier measurement of the bicycle, which fits this ride better than the one that superseded it.
    bicycle = PulledBicycle.from_parameters(recording.parameters["as_stored_in_the_run_file"])
    options = {"input_bias": ("roll_torque", "steer_torque"), "optimizer": LeastSquares()}
    first = fit_bicycle(windows, bicycle, ("steer_damping", "rope_height"), **options)
    together = [list(range(i, min(i + 8, len(windows)))) for i in range(0, len(windows), 8)]  # a pull in each
    found = forward_selection(first, CANDIDATES, depth=1, refits=1, plausible=PLAUSIBLE, folds=together)
    print(f"{found}\n\n{found.fit}\n")
    fits = {"damping, rope": first, found.selected[0] if found.selected else "nothing taken": found.fit}
    slope = np.gradient(ride.measured["steer"], ride.t)
    late = 1e3 * lag(ride.t, slope, ride.measured["steer_rate"])
    print(f"\nWithout a model: the gyroscopes' steer rate goes {late:.0f} ms behind the slope of the steer angle.")
    picture(fits, folder / "identify_a_rider.png")
    print("picture:", folder / "identify_a_rider.png")


if __name__ == "__main__":
    jk.configure()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the picture (default: figures)")
    main(parser.parse_args().out)
