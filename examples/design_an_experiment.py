"""Which experiment distinguishes two parameters of a bicycle?

The roll inertia of the rear frame with its rider and the height of their mass centre are difficult to distinguish,
because both slow down the roll. The example first computes the standard errors for several speeds and sensors. The
experiment takes two seconds, and the torque at the handlebar is a sum of five sines. Gradient descent then optimizes
the amplitudes and phases of the sines (D-optimality: the smallest determinant of the covariance), for the same root
mean square of the torque and with limits on roll rate and steer.

    variable        meaning                                                        unit
    IBxx, zB, IBzz  roll and yaw inertia of the rear frame, height (down)          kg m^2, m, kg m^2
    steer_torque    the designed input, with a root mean square of 1               N m
    roll_rate, steer, steer_rate, yaw_rate      possible measurements              rad, rad/s
    also unknown    the initial state, an offset of each sensor                    rad, rad/s

Run:      python examples/design_an_experiment.py [--out FOLDER]
Appears:  standard errors by speed and sensors, then before and after the design, and design_an_experiment.png.
Takes:    half a minute, most of it compilation.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from jaxkane.catalog import WhippleBicycle
from jaxkane.fit import Offset, Problem, Simulation, Trial, design, identifiability

jax.config.update("jax_enable_x64", True)

NAMES = ("IBxx", "zB", "IBzz")
SIGMA = {"roll_rate": 0.01, "steer": 0.003, "steer_rate": 0.02, "yaw_rate": 0.01}  # [rad, rad/s]
FREQUENCIES = jnp.array([0.5, 1.0, 1.5, 2.0, 3.0])  # [Hz]
TIMES = np.arange(0.0, 2.0, 0.02)  # [s]
SPEEDS = (4.5, 5.0, 6.0, 7.0)  # [m/s]
SENSORS = {
    "steer": ("steer",),
    "steer, steer rate": ("steer", "steer_rate"),
    "roll rate": ("roll_rate",),
    "roll rate, steer": ("roll_rate", "steer"),
    "all, and yaw rate": tuple(SIGMA),
}
UNKNOWN = ("roll", "steer", "roll_rate", "steer_rate")
OFFSETS = {channel: Offset(channel, each="trial") for channel in SIGMA}


def torque(coefficients, t):
    """Five sines with five cosines, scaled to a root mean square of 1 N m."""
    phases = 2.0 * jnp.pi * FREQUENCIES * t[:, None]
    a, b = coefficients
    sum_of_waves = jnp.sin(phases) @ a + jnp.cos(phases) @ b
    return {"steer_torque": sum_of_waves / jnp.sqrt(jnp.mean(sum_of_waves**2))}


def errors_by_speed_and_sensors(bicycle, coefficients):
    """Standard error of each parameter, as a part of its value: (speeds, sensors, names)."""
    deviations = np.zeros((len(SPEEDS), len(SENSORS), len(NAMES)))
    samples = {name: np.asarray(x) for name, x in torque(coefficients, jnp.asarray(TIMES)).items()}
    free, options = (*NAMES, *OFFSETS.values()), {"unknown": UNKNOWN, "simulation": Simulation(step=0.02)}
    for i, speed in enumerate(SPEEDS):
        for j, sensors in enumerate(SENSORS.values()):
            # A sensor that is not there is one that says nothing; so every case runs the same program.
            sigma = {c: s if c in sensors else 1e6 for c, s in SIGMA.items()}
            rest = {c: np.zeros(TIMES.shape) for c in SIGMA}
            wheel = {"rear_wheel_rate": -speed / float(bicycle.rR)}
            plan = Trial(TIMES, rest, samples, sigma=sigma, initial=wheel)
            problem = Problem.of(bicycle, plan, free, **options)
            ride = problem.trajectories(problem.start)[0]
            plan = Trial(TIMES, {c: np.asarray(ride[c]) for c in SIGMA}, samples, sigma=sigma, initial=wheel)
            seen = identifiability(Problem.of(bicycle, plan, free, **options))
            C = np.linalg.pinv(seen.information)
            deviations[i, j] = np.sqrt(C.diagonal())
    return deviations


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the picture (default: figures)")
    arguments = parser.parse_args()
    bicycle = WhippleBicycle.benchmark()
    start = (jnp.ones(5), jnp.zeros(5))
    print("Standard errors of IBxx, zB, IBzz [%], by speed and sensors, for five equal sines:")
    errors = 100.0 * errors_by_speed_and_sensors(bicycle, start)
    print(f"{'':<20}" + "".join(f"{speed:>20g} m/s" for speed in SPEEDS))
    for j, sensors in enumerate(SENSORS):
        cells = (" ".join(f"{e:7.2g}" for e in errors[i, j]) for i in range(len(SPEEDS)))
        print(f"{sensors:<20}" + "".join(f"{cell:>24}" for cell in cells))
    speed = SPEEDS[int(np.argmin(np.prod(errors[:, 3], axis=1)))]
    print(f"\nWith roll rate and steer measured {speed:g} m/s tells most; the torque for it:")
    plan = design(
        bicycle,
        TIMES,
        torque,
        start,
        (*NAMES, OFFSETS["roll_rate"], OFFSETS["steer"]),
        sigma={c: SIGMA[c] for c in ("roll_rate", "steer")},
        initial={"rear_wheel_rate": -speed / float(bicycle.rR)},
        limits={"roll_rate": 1.5, "steer": 0.6},
        unknown=UNKNOWN,
        steps=30,
        progress=True,
    )
    print(plan)
    arguments.out.mkdir(parents=True, exist_ok=True)
    draw(plan, start, errors, arguments.out / "design_an_experiment.png")


def draw(plan, start, errors, path):
    """The table, the torque before and after, and the ride."""
    figure, axes = plt.subplots(2, 2, figsize=(11, 6.5), layout="constrained")
    table, way, before, ride = axes.ravel()
    for j, sensors in enumerate(SENSORS):
        table.semilogy(SPEEDS, errors[:, j, 0], "o-", label=sensors)
    table.set(xlabel="speed [m/s]", ylabel="standard error of IBxx [%]", title="which speed, which sensors")
    table.set_ylim(top=30.0)
    table.legend(frameon=False, fontsize="small", ncols=2)
    way.plot(plan.history, ".-")
    way.set(xlabel="step", ylabel="log det of the covariance", title="gradient descent on the torque")
    t = plan.trial.t
    before.plot(t, torque(start, jnp.asarray(t))["steer_torque"], color="0.6", label="five equal sines")
    before.plot(t, plan.inputs["steer_torque"], label="designed")
    before.set(xlabel="time [s]", ylabel="steer torque [N m]", title="the same root mean square")
    before.legend(frameon=False, fontsize="small")
    for channel, values in plan.trial.measured.items():
        ride.plot(t, values, label=channel.replace("_", " "))
    ride.set(xlabel="time [s]", ylabel="[rad, rad/s]", title="what the designed ride does")
    ride.legend(frameon=False, fontsize="small")
    for ax in axes.ravel():
        ax.grid(alpha=0.25)
    figure.savefig(path, dpi=150)
    print(f"The picture: {path}")


if __name__ == "__main__":
    main()
