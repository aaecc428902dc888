"""What do measured rides tell about a bicycle, and what can they not tell?

A riderless steer-by-wire bicycle of TU Delft is pushed on a treadmill and left to its controller: 31 rides of a second
at 2 to 5 m/s. The nonlinear Whipple bicycle is fitted to them four times: its steer damping alone; then the torque's
gain, the inertia of the fork and the trail with it; then the rear frame's roll inertia too; and at last the fork's
whole inertia as a body that can be. The sum of squares falls each time. What to believe is another question.

    variable         meaning                                                          unit
    steer_damping    viscous torque between fork and frame                            N m s/rad
    gain             of the steer motor's torque: what acts over what was commanded   1
    IHzz, c, IBxx    fork's inertia about its axis, trail, rear frame's roll inertia  kg m^2, m, kg m^2
    unknown too      each ride's start, an offset of its roll torque and steer torque rad, rad/s, N m

Run:      python examples/identify_measured_bicycle.py --data FOLDER [--out FOLDER]
          FOLDER holds `free_responses.csv` and `parameters.json` (the public repository mechmotum/sbw_bicycle_with_
          model_matching). Without `--data` the same is done with 12 simulated rides of the benchmark bicycle.
Appears:  a table for each fit with what is suspicious about it, and identify_measured_bicycle.html: the full report
          of the first, with trials left out.
Takes:    a minute or two, half of it compilation.
"""

import argparse
import json
from pathlib import Path

import equinox as eqx
import jax
import numpy as np

import jaxkane as jk
from jaxkane.catalog import WhippleBicycle
from jaxkane.fit import (
    Gain,
    LeastSquares,
    Trial,
    cross_validate,
    fit_bicycle,
    frame_inertia,
    profile,
    read_trials,
    save_report,
)

jax.config.update("jax_enable_x64", True)

SIGMA = {"roll": 0.01, "steer": 0.02, "roll_rate": 0.1, "steer_rate": 0.2}  # [rad, rad/s]
FREE = {
    "the damping alone": ("steer_damping",),
    "gain, damping, IHzz and trail": (Gain("steer_torque"), "steer_damping", "IHzz", "c"),
    "and IBxx": (Gain("steer_torque"), "steer_damping", "IHzz", "c", "IBxx"),
    "gain, damping and the fork as a possible body": (
        Gain("steer_torque"),
        "steer_damping",
        frame_inertia("H", fixed=("mH", "xH", "zH")),
    ),
}


def measured_rides(folder):
    """The first second of every ride, and the bicycle with its authors' parameters."""
    values = json.loads((folder / "parameters.json").read_text())
    values = {"IByy": 2.0, "IHyy": 0.01} | values  # hardly matter, and are not in the file
    rides = read_trials(
        folder / "free_responses.csv",
        {"roll": "roll_angle", "steer": "steer_angle", "roll_rate": "roll_rate", "steer_rate": "steer_rate"},
        inputs={"steer_torque": "steer_torque"},
        initial={"speed": "speed_treadmill"},
        sigma=SIGMA,
        by="segment",
    )
    return [ride.between(0.0, 0.995) for ride in rides], WhippleBicycle.from_parameters(values)


def simulated_rides():
    """Pushed rides of the benchmark bicycle with some steer damping, and that bicycle without."""
    bicycle = WhippleBicycle.benchmark()
    truth = eqx.tree_at(lambda b: b.steer_damping, bicycle, bicycle.steer_damping + 0.8)
    rng, t, rides = np.random.default_rng(5), np.arange(0.0, 1.0, 0.01), []
    for k in range(12):
        speed, push = (3.0, 4.0, 5.0)[k % 3], rng.uniform(-0.5, 0.5)
        torque = rng.uniform(-2.0, 2.0) * np.sin(2.0 * np.pi * rng.uniform(0.5, 2.0) * t)
        start = jk.assemble(truth, {"roll": 0.0}, {"rear_wheel_rate": -speed / truth.rR, "roll_rate": push})
        ride = jk.simulate(truth, start, t, {"steer_torque": torque})
        measured = {name: np.asarray(ride[name]) + rng.normal(0.0, s, t.size) for name, s in SIGMA.items()}
        rides.append(Trial(t, measured, {"steer_torque": torque}, sigma=SIGMA, initial={"speed": speed}, name=f"{k}"))
    return rides, bicycle


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with free_responses.csv and parameters.json")
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the report (default: figures)")
    arguments = parser.parse_args()
    rides, bicycle = measured_rides(arguments.data) if arguments.data else simulated_rides()
    biases = ("roll_torque", "steer_torque") if arguments.data else ()
    hold = ("steer_torque",) if arguments.data else ()  # a command, kept until the next
    fits = {}
    for what, free in FREE.items():
        fits[what] = fit_bicycle(rides, bicycle, free, input_bias=biases, hold=hold, optimizer=LeastSquares())
        print(f"\n{what[0].upper()}{what[1:]}\n{fits[what]}")
    first = fits["the damping alone"]
    left_out = cross_validate(first)
    likelihood = profile(first, "steer_damping")
    low, high = likelihood.interval
    print(f"\nThe damping, by its profile likelihood: {low:.3f} to {high:.3f} N m s/rad")
    print(f"Trials left out in turn: {100 * left_out.score:.1f} % of the sum of squares is taken away all the same.")
    page = save_report(
        first, arguments.out / "identify_measured_bicycle.html", cross_validation=left_out, profiles=[likelihood]
    )
    print(f"The report: {page}")
    if arguments.data:
        print(
            "\nWhat to believe: the damping. The other fits lower the sum of squares by moving the fork's inertia and\n"
            "the trail to where no such bicycle is: they make up for what the model lacks (the motor, the tyres)."
        )


if __name__ == "__main__":
    main()
