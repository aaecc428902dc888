"""What do measured rides tell about a bicycle, and what can they not tell?

A riderless steer-by-wire bicycle of TU Delft is pushed on a treadmill and left to its controller: 31 rides of a second
at 2 to 5 m/s. The nonlinear Whipple bicycle is fitted four times to those at 2 to 4 m/s: its steer damping alone; then
the torque's gain, the inertia of the fork and the trail with it; then the rear frame's roll inertia too; and at last
the fork's whole inertia as a body that can be. Each fit then predicts the rides at 5 m/s, which it has not seen. The
sum of squares falls with each number that is freed; whether the prediction gets better is another question.

    variable         meaning                                                          unit
    steer_damping    viscous torque between fork and frame                            N m s/rad
    gain             of the steer motor's torque: what acts over what was commanded   1
    IHzz, c, IBxx    fork's inertia about its axis, trail, rear frame's roll inertia  kg m^2, m, kg m^2
    unknown too      each ride's start, an offset of its roll torque and steer torque rad, rad/s, N m

Run:      python examples/identify_measured_bicycle.py [--out FOLDER]
          The rides are shipped with the library (`jaxkane.data.steer_by_wire`).
Appears:  a table for each fit with what is suspicious about it; the fits beside each other, with the rides held out;
          and identify_measured_bicycle.html: the full report of the first, with trials left out.
Takes:    about a minute, half of it compilation.
"""

import argparse
from pathlib import Path

import jaxkane as jk
from jaxkane.catalog import WhippleBicycle
from jaxkane.fit import (
    Gain,
    LeastSquares,
    bicycle_rides,
    compare,
    cross_validate,
    fit_bicycle,
    frame_inertia,
    profile,
    save_report,
)

HELD_OUT = 5.0  # [m/s]
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


def check(comparison):
    """The errors and estimates that these rides give. No test repeats these fits."""
    fits = first, four, five, _ = list(comparison.fits.values())
    assert all(fit.status == "converged" for fit in fits)
    assert first.cost < 3000 < 15000 < first.history[0]
    assert abs(first.estimates["steer_damping"] - 0.535) < 0.01
    assert any("not noise" in note for note in first.notes)
    # What no fork can be is said, and what no such bicycle has.
    assert any("Not a possible body" in note and "fork" in note for note in four.notes)
    assert any(note.startswith("c went to") and "implausible" in note for note in four.notes)
    assert any("Not a possible body" in note and "rear frame" in note for note in five.notes)
    # All fit better than the damping alone; two predict worse.
    assert all(fit.cost < first.cost for fit in fits[1:])
    damping, *richer = (fit.cost for fit in comparison.held_out.values())
    assert [cost < damping for cost in richer] == [True, False, False]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the report (default: figures)")
    arguments = parser.parse_args()
    jk.configure()
    recording = jk.data.steer_by_wire()
    bicycle = WhippleBicycle.from_parameters(recording.parameters)
    rides = [ride for ride in recording.trials if ride.initial["speed"][0] != HELD_OUT]
    unseen = [ride for ride in recording.trials if ride.initial["speed"][0] == HELD_OUT]
    # The steering torque is a command, kept until the next.
    options = {"input_bias": ("roll_torque", "steer_torque"), "zero_order_hold": ("steer_torque",)}
    fits = {}
    for what, free in FREE.items():
        fits[what] = fit_bicycle(rides, bicycle, free, optimizer=LeastSquares(), **options)
        print(f"\n{what[0].upper()}{what[1:]}\n{fits[what]}")
    comparison = compare(fits, held_out=bicycle_rides(unseen, bicycle))
    print(f"\n{comparison}")
    check(comparison)
    first = fits["the damping alone"]
    left_out, likelihood = cross_validate(first), profile(first, "steer_damping")
    low, high = likelihood.interval
    print(f"\nThe damping, by its profile likelihood: {low:.3f} to {high:.3f} N m s/rad")
    page = save_report(
        first, arguments.out / "identify_measured_bicycle.html", cross_validation=left_out, profiles=[likelihood]
    )
    print(f"The report: {page}")
    print(
        "\nWhat to believe: the damping. The other fits lower the sum of squares by moving the fork's inertia and\n"
        "the trail to where no such bicycle is: they make up for what the model lacks. Two of them predict another\n"
        "speed worse than the damping alone does.\n"
        "What the model lacks, notebooks/13_model_extensions.ipynb finds out."
    )


if __name__ == "__main__":
    main()
