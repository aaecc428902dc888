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

Run:      python examples/identify_measured_bicycle.py [--out FOLDER]
          The rides are shipped with the library (`jaxkane.data.steer_by_wire`).
Appears:  a table for each fit with what is suspicious about it, and identify_measured_bicycle.html: the full report
          of the first, with trials left out.
Takes:    a minute or two, half of it compilation.
"""

import argparse
from pathlib import Path

import jaxkane as jk
from jaxkane.catalog import WhippleBicycle
from jaxkane.fit import Gain, LeastSquares, cross_validate, fit_bicycle, frame_inertia, profile, save_report

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


def check(fits, left_out):
    """The errors and estimates that these rides give. No test repeats these fits."""
    first, four, five = (fits[what] for what in list(FREE)[:3])
    assert first.status == four.status == "converged"
    assert first.cost < 3920 < 20000 < first.history[0]
    assert abs(first.estimates["steer_damping"] - 0.545) < 0.01
    assert any("not noise" in note for note in first.notes)
    assert four.cost < 2730
    # What no fork can be is said, and what no such bicycle has.
    assert any("Not a possible body" in note and "fork" in note for note in four.notes)
    assert any(note.startswith("c went to 0.26 times") and "implausible" in note for note in four.notes)
    assert any(note.startswith("IBxx went to") and "implausible" in note for note in five.notes)
    assert left_out.score > 0.98


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the report (default: figures)")
    arguments = parser.parse_args()
    jk.configure()
    recording = jk.data.steer_by_wire()
    rides, bicycle = recording.trials, WhippleBicycle.from_parameters(recording.parameters)
    # The steering torque is a command, kept until the next.
    options = {"input_bias": ("roll_torque", "steer_torque"), "zero_order_hold": ("steer_torque",)}
    fits = {}
    for what, free in FREE.items():
        fits[what] = fit_bicycle(rides, bicycle, free, optimizer=LeastSquares(), **options)
        print(f"\n{what[0].upper()}{what[1:]}\n{fits[what]}")
    first = fits["the damping alone"]
    left_out = cross_validate(first)
    check(fits, cross_validate(fits["gain, damping, IHzz and trail"]))
    likelihood = profile(first, "steer_damping")
    low, high = likelihood.interval
    print(f"\nThe damping, by its profile likelihood: {low:.3f} to {high:.3f} N m s/rad")
    print(f"Trials left out in turn: {100 * left_out.score:.1f} % of their variance is accounted for all the same.")
    page = save_report(
        first, arguments.out / "identify_measured_bicycle.html", cross_validation=left_out, profiles=[likelihood]
    )
    print(f"The report: {page}")
    print(
        "\nWhat to believe: the damping. The other fits lower the sum of squares by moving the fork's inertia and\n"
        "the trail to where no such bicycle is: they make up for what the model lacks.\n"
        "What that is, notebooks/13_model_extensions.ipynb finds out."
    )


if __name__ == "__main__":
    main()
