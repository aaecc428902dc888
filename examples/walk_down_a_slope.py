"""How does a walker without motors walk down a slope, and where does its gait double its period?

The walker is the compass gait of the catalogue: two straight legs with a mass each, and a mass at the hip. The swing
foot lands without bouncing (Kane's impulse equations), and the legs exchange their roles. The scuffing of the swing
foot at mid-stance is ignored.

    variable                    meaning                                            unit
    stance, swing               angle of each leg from the vertical, downhill      rad
    foot                        of the stance leg, its distance down the slope     m
    stance_rate, swing_rate     their rates                                        rad/s
    slope                       of the ground                                      rad

Run:      python examples/walk_down_a_slope.py [--out FOLDER]
Appears:  the periodic gait on a slope of 3 degrees with its multipliers; the slope at which the period doubles; and
          walk_down_a_slope.png: the gait in the plane of angle and rate, the multipliers over the slope, and the
          durations of the steps over the slope, before and after the period doubling.
Takes:    one minute.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxkane as jk
from jaxkane.catalog import CompassGait

jax.config.update("jax_enable_x64", True)


def main(out: Path) -> None:
    guess = jk.State([-0.22, 0.32, 0.0], [1.1, 0.4])  # just after a heel strike
    gait = jk.stability.periodic(CompassGait(), guess, section="heel_strike")
    print(gait)
    assert gait.stable
    np.testing.assert_allclose(gait.period, 0.7343463911587195, rtol=1e-9)  # Goswami's walker, by mpmath

    # After ten steps from a disturbed start, the gait is the same again.
    disturbed = jk.State(gait.state.q + jnp.array([0.0, 0.01, 0.0]), gait.state.u)
    walk = jk.simulate(CompassGait(), disturbed, jnp.linspace(0.0, 20 * gait.period, 2001))
    steps = int(walk.jumps.count)
    print(f"{steps} steps; the last one takes {float(walk.jumps.t[steps - 1] - walk.jumps.t[steps - 2]):.6f} s")
    assert walk.ok

    family = jk.stability.family(CompassGait(), gait, towards={"slope": 1}, until={"slope": np.deg2rad(4.6)})
    doubling = next(point for point in family.bifurcations if point.kind == "period doubling")
    print(doubling)
    at = float(np.rad2deg(doubling.orbit.system.slope))
    assert abs(at - 4.3909) < 1e-3

    # On steeper slopes a stable gait of two unequal steps exists.
    limps = jk.stability.family(
        doubling.orbit.system, doubling.orbit, towards={"slope": 1}, until={"slope": np.deg2rad(4.6)}, switch="doubling"
    )
    print(limps)
    assert np.all(np.abs(limps.multipliers[1:]) < 1.0)

    figure, (left, right, last) = plt.subplots(1, 3, figsize=(14, 4), layout="constrained")
    ride = gait.ride
    left.plot(np.rad2deg(ride["stance"]), ride["stance_rate"], label="stance leg")
    left.plot(np.rad2deg(ride["swing"]), ride["swing_rate"], label="swing leg")
    left.set(xlabel="angle [deg]", ylabel="rate [rad/s]", title=f"one step, {float(gait.period):.4f} s")
    left.legend()
    slopes = np.append(np.rad2deg(np.asarray(family["slope"])), at)
    sizes = np.abs(np.vstack([family.multipliers, doubling.orbit.multipliers]))
    order = np.argsort(slopes)  # with the period doubling itself, where the largest size is 1
    right.plot(slopes[order], sizes[order], ".-", color="C0")
    right.axhline(1.0, color="0.5", linewidth=0.8)
    right.axvline(at, color="C3", linestyle="--", label=f"period doubling at {at:.3f} deg")
    right.set(xlabel="slope [deg]", ylabel="size of the multipliers")
    right.legend()
    draw_durations(last, family, limps)
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "walk_down_a_slope.png", dpi=120)
    print(f"picture: {out / 'walk_down_a_slope.png'}")


def draw_durations(ax, family, limps) -> None:
    """Durations of steps over the slope: of the gaits of one step, and of both steps of the gaits of two steps."""
    ax.plot(np.rad2deg(np.asarray(family["slope"])), family.period, color="C0", label="gait of one step")
    first = np.array([float(limps.orbit(i).ride.jumps.t[0]) for i in range(len(limps))])
    both = np.stack([first, np.asarray(limps.period) - first], axis=1)
    both.sort(axis=1)
    lines = ax.plot(np.rad2deg(np.asarray(limps["slope"])), both, color="C1")
    lines[0].set_label("gait of two steps")
    ax.set(xlabel="slope [deg]", ylabel="duration of a step [s]", title="period doubling")
    ax.legend(loc="upper left")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"))
    main(parser.parse_args().out)
