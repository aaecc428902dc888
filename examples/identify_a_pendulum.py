"""Which friction law does a real pendulum follow, as its encoder saw it swing down?

An arm on a clamp, of the multi-arm pendulum of Kaheman and co-workers (2022), swings freely for 37 seconds, recorded in
four trials. Its frequency and its friction are found from the measured angle, twice: with viscous friction alone; and
with dry friction, quadratic drag and a vertical that is off by an unknown angle. The residuals say which to believe.

    variable      meaning                                                                    unit
    angle1, rate1 angle of the arm from the upright vertical (hanging is pi), and its rate   rad, rad/s
    inertia       of the arm about its joint; mass and mass centre are held, since free      kg m^2
                  swings tell only their ratio
    viscous, dry  torque by rate, and that which only turns its sign with the rate           N m s/rad, N m
    drag          torque by the square of the rate                                           N m s^2/rad^2
    offset        of the encoder's zero from the vertical                                    rad

Run:      python examples/identify_a_pendulum.py [--out FOLDER]
Appears:  both tables of estimates with their errors, the median of the trials' rms errors, and identify_a_pendulum.png:
          the motion, and the residuals of both laws on one scale.
Takes:    about half a minute.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxkane as jk

jax.config.update("jax_enable_x64", True)

GOLD, BLUE, INK = "#e8a33d", "#3d8fd1", "#2b2f36"


class Arm(jk.System):
    inertia: jk.Scalar = jk.parameter(0.00335, positive=True, unit="kg m^2")
    viscous: jk.Scalar = jk.parameter(0.0, unit="N m s/rad")
    dry: jk.Scalar = jk.parameter(0.0, unit="N m")
    drag: jk.Scalar = jk.parameter(0.0, unit="N m s^2/rad^2")
    offset: jk.Scalar = jk.parameter(0.0, unit="rad")
    mass: jk.Scalar = jk.parameter(0.1476, positive=True, unit="kg")  # its makers' estimate, as the place of its centre
    center: jk.Scalar = jk.parameter(0.1478, unit="m")

    coordinates = ("angle1",)
    speeds = ("rate1",)
    units = {"angle1": "rad", "rate1": "rad/s"}

    def motion(self, t, q, u):
        N, O = jk.inertial()
        A = N.rotate(3, q["angle1"] - self.offset, u["rate1"])
        about_joint = (self.inertia, 0.0, self.inertia)  # a slender arm
        arm = jk.Body(self.mass, about_joint, O.fixed(self.center * A.y), A, about=O, name="arm")
        return jk.Motion([arm])

    def loads(self, t, q, u, motion, inputs):
        arm, axis = motion["arm"], motion.N.z
        return (
            jk.weight(motion, -9.81 * motion.N.y),
            jk.loads.torsional_damper(arm, None, axis, lambda w: self.viscous * w + self.drag * w * jnp.abs(w)),
            jk.loads.torsional_friction(arm, None, axis, self.dry, rate=0.05),
        )


def fitted(trials, free):
    """Parameters, and the angle and rate at the start of each trial."""
    positive = {name: jk.fit.Free(name, bounds=(0.0, None), start=1e-5) for name in ("viscous", "dry", "drag")}
    free = [positive.get(name, name) for name in free]
    fit = jk.fit.fit(Arm(), trials, free, unknown=("angle1", "rate1"), optimizer=jk.fit.LeastSquares())
    rms = [np.sqrt(np.mean((trial["angle1"] * 0.001) ** 2)) for trial in fit.residuals.values()]  # [rad]
    print(f"{fit.table()}\nmedian of the trials' rms errors: {1e3 * np.median(rms):.2f} mrad\n")
    return fit


def picture(fits, path):
    figure, (above, below) = plt.subplots(2, 1, figsize=(9, 5.5), sharex=True, height_ratios=[1, 1.2])
    for color, (label, fit) in zip((GOLD, BLUE), fits.items(), strict=True):
        for k, (trial, name) in enumerate(zip(fit.problem.trials, fit.trial_names, strict=True)):
            label_once = label if k == 0 else None
            below.plot(trial.t, fit.residuals[name]["angle1"], color=color, linewidth=0.8, label=label_once)
            if fit is list(fits.values())[-1]:
                above.plot(trial.t, trial.measured["angle1"] - np.pi, color=INK, linewidth=0.8)
    above.set_ylabel("angle from hanging [rad]")
    below.set(xlabel="time [s]", ylabel="simulated - measured [mrad]")
    below.legend(loc="upper right", ncols=2)
    figure.tight_layout()
    figure.savefig(path, dpi=120)


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    recording = jk.data.multi_arm_pendulum(1)
    print(recording)
    laws = {"viscous": ("inertia", "viscous"), "dry, drag, offset": ("inertia", "dry", "drag", "offset")}
    fits = {label: fitted(recording.trials, free) for label, free in laws.items()}
    picture(fits, folder / "identify_a_pendulum.png")
    print("picture:", folder / "identify_a_pendulum.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the picture (default: figures)")
    main(parser.parse_args().out)
