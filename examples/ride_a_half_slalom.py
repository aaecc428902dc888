"""How does a bicycle ride a slalom with the least steer torque, and how fast can it change lanes?

The rider of the benchmark bicycle does not lean. Two problems are solved:

- Half slalom: the bicycle passes a row of cones alternately on the left and on the right, at a distance of 0.4 m. The
  motion from one cone to the next is the mirror image of the following one, so the slalom is periodic. The cost is the
  integral of the squared steer torque. A small drive torque keeps the speed.
- Quickest lane change: the bicycle moves by 1.5 m to the side and rides straight ahead again, in the shortest time. The
  steer torque is bounded, and the result is compared for several bounds.

    variable                      meaning                                       unit
    x, y                          of the rear contact, y to the right           m
    roll, steer, yaw              angles                                        rad
    steer_torque, drive_torque    the controls; the second one on the rear wheel    N m

Run:      python examples/ride_a_half_slalom.py [--out FOLDER]
Appears:  the costs; a simulation of each plan; ride_a_half_slalom.png; ride_a_half_slalom.html: an animation.
Takes:    half a minute.
"""

import argparse
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxkane as jk
from jaxkane import collocation as col

jk.configure(verbose=False)

BICYCLE = jk.catalog.WhippleBicycle.benchmark()
SPEED = 5.0  # [m/s], in the stable range
SPACING, ASIDE = 10.0, 0.4  # of the cones, and the distance of the rear wheel from their line [m]
WHEEL_RATE = -SPEED / float(BICYCLE.rR)  # negative when riding forwards [rad/s]
STRAIGHT = jk.assemble(BICYCLE, {}, {"rear_wheel_rate": WHEEL_RATE})
BOUNDS = (2.0, 4.0, 8.0)  # of the steer torque [N m]


def mirrored(first, last, duration):
    """The end of a half slalom is the mirror image of its start."""
    odd = ("yaw", "roll", "steer", "roll_rate", "steer_rate")
    same = {"rear_wheel_rate": last["rear_wheel_rate"] - first["rear_wheel_rate"]}
    return same | {name: last[name] + first[name] for name in odd}


def half_slalom() -> col.Plan:
    problem = col.Problem(
        BICYCLE,
        SPACING / SPEED,
        controls=["steer_torque", "drive_torque"],
        # Without a drive, the steer torque alone would have to keep the speed.
        cost=lambda t, now: now["steer_torque"] ** 2 + 1e-2 * now["drive_torque"] ** 2,
        start={"x": 0.0, "y": ASIDE, "rear_wheel_angle": 0.0, "front_wheel_angle": 0.0},
        end={"x": SPACING, "y": -ASIDE},
        conditions=mirrored,
    )
    s = np.linspace(0.0, np.pi, 51)  # a sine, which is the mirror image of its continuation
    guess = {"y": ASIDE * np.cos(s), "x": SPACING * s / np.pi, "yaw": -0.12 * np.sin(s), "rear_wheel_rate": WHEEL_RATE}
    guess |= {"roll": -0.1 * np.cos(s), "steer": -0.05 * np.cos(s), "rear_wheel_angle": WHEEL_RATE * s / np.pi * 2.0}
    return col.solve(problem, guess)


def lane_change(bound: float, guess) -> col.Plan:
    problem = col.Problem(
        BICYCLE,
        (0.5, 4.0),
        controls={"steer_torque": (-bound, bound)},
        # A small cost of the torque, which makes its steps from one bound to the other unique.
        cost=lambda t, now: 1e-4 * now["steer_torque"] ** 2,
        final_cost=lambda t, now: t,
        start=STRAIGHT,
        end={"y": 1.5, "yaw": 0.0, "roll": 0.0, "steer": 0.0, "roll_rate": 0.0, "steer_rate": 0.0},
        within={"roll": (-0.8, 0.8), "steer": (-0.8, 0.8)},
    )
    return col.solve(problem, guess, tolerance=1e-4)


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    slalom = half_slalom()
    print(slalom)
    print(
        f"  roll up to {degrees(slalom['roll']):.1f} deg, steer up to {degrees(slalom['steer']):.1f} deg, "
        f"drive torque up to {np.max(np.abs(slalom['drive_torque'])):.2f} N m"
    )
    assert slalom.ok
    ride = slalom.replay()
    assert slalom.deviation(ride) < 1e-3
    for name in ("yaw", "roll", "steer"):
        assert abs(float(ride[name][-1] + ride[name][0])) < 1e-4, name

    changes, guess = {}, {"duration": 2.0, "x": [0.0, 2.0 * SPEED], "rear_wheel_angle": [0.0, 2.0 * WHEEL_RATE]}
    for bound in BOUNDS:
        plan = changes[bound] = lane_change(bound, guess)
        guess = plan
        share = float(np.mean(np.abs(np.asarray(plan["steer_torque"])) > 0.99 * bound))
        print(f"torque up to {bound:g} N m: {plan.duration:.3f} s, at a bound at {100 * share:.0f} % of the nodes;")
        print(f"  the first torque is {float(plan['steer_torque'][0]):.2f} N m; {plan.reason}")
        assert plan.ok
        # Countersteering: to lean to the right, the bicycle first steers to the left.
        assert float(plan["steer_torque"][0]) < 0 < 1.5 - float(plan["y"][len(plan.t) // 2])
    durations = [plan.duration for plan in changes.values()]
    assert np.all(np.diff(durations) < 0)
    draw(slalom, changes, out / "ride_a_half_slalom.png")
    page = jk.animate(BICYCLE, slalom.replay(jnp.linspace(0.0, slalom.duration, 121)), title="Half slalom")
    print(f"pictures: {out / 'ride_a_half_slalom.png'}, {page.save(out / 'ride_a_half_slalom.html')}")


def degrees(angle) -> float:
    return float(np.rad2deg(np.max(np.abs(np.asarray(angle)))))


def draw(slalom: col.Plan, changes: dict[float, col.Plan], path: Path) -> None:
    figure, axes = plt.subplots(2, 2, figsize=(11, 6), layout="constrained")
    x, y = np.asarray(slalom["x"]), np.asarray(slalom["y"])
    for k in range(4):
        axes[0, 0].plot(x + k * SPACING, y * (-1) ** k, color="C0")
        axes[0, 0].plot(k * SPACING, 0.0, "^", color="C1")
    axes[0, 0].set(xlabel="x [m]", ylabel="y, to the right [m]", title="slalom: rear wheel and cones")
    for name in ("roll", "steer", "yaw"):
        axes[0, 1].plot(slalom.t, np.rad2deg(slalom[name]), label=f"{name} [deg]")
    axes[0, 1].plot(slalom.t, 10.0 * slalom["steer_torque"], "k--", lw=1, label="steer torque [0.1 N m]")
    axes[0, 1].set(xlabel="time [s]", title="half slalom")
    for bound, plan in changes.items():
        axes[1, 0].plot(plan["x"], plan["y"], label=f"{bound:g} N m: {plan.duration:.2f} s")
        axes[1, 1].plot(plan.t, plan["steer_torque"])
    axes[1, 0].set(xlabel="x [m]", ylabel="y, to the right [m]", title="quickest lane change")
    axes[1, 1].set(xlabel="time [s]", ylabel="steer torque [N m]")
    for ax in (axes[0, 1], axes[1, 0]):
        ax.legend(frameon=False)
    figure.savefig(path, dpi=120)
    plt.close(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the files (default: figures)")
    main(parser.parse_args().out)
