"""How does a rider change lanes on an unstable bicycle?

The benchmark bicycle of Meijaard et al. (2007) rides at 3 m/s, below its stable speed range, and changes to the left
lane. Two controllers steer it by a torque on the handlebar:

- the sequential-loop rider of Hess, Moore and Hubbard (2012), with the published gains and neuromuscular lag, which
    uses
  the path ahead of the front wheel;
- a linear-quadratic regulator scheduled over speed, with a path follower that commands the roll angle.

Both must steer to the right before they can turn left, because the bicycle must first lean into the turn.

    variable    meaning                                                              unit
    path        y(x) from lane to lane, positive to the right                        m
    preview     preview time of each controller                                      s
    roll, steer, x, y, yaw                                                           rad, m
    applied_steer_torque    on the fork, by the rider                                N m

Run:      python examples/ride_a_lane_change.py [--out FOLDER]
Appears:  the deviations from the path; ride_a_lane_change.png: the road from above, and steer, roll and torque;
          ride_a_lane_change.html: an interactive animation with the regulator.
Takes:    under a minute, nearly all of it compilation.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Ellipse

import jaxkane as jk
from jaxkane.bicycles import Bicycle, LaneChange, PathFollower, SequentialLoopRider, scheduled_lqr

jax.config.update("jax_enable_x64", True)

SPEED, TIMES = 3.0, np.linspace(0.0, 12.0, 601)  # [m/s], [s]
BICYCLE = Bicycle.benchmark()
PATH = LaneChange(width=-3.0, start=10.0, length=12.0)
LOOKS_AHEAD = {"sequential loops": 1.7, "regulator": 2.0}  # [s]
RIDERS = {
    "sequential loops": SequentialLoopRider.benchmark(SPEED, path=PATH, preview=LOOKS_AHEAD["sequential loops"]),
    "regulator": (
        PathFollower(PATH, preview=LOOKS_AHEAD["regulator"]),
        scheduled_lqr(BICYCLE, [2.0, 3.0, 4.0], Q=[10.0, 1.0, 1.0, 0.1], R=0.01),
    ),
}
COLORS = {"sequential loops": "#14507a", "regulator": "#c8552b"}
ROAD, PAINT, GRASS, AIM = "#dcdad5", "#ffffff", "#eef2ea", "#2f8f5b"
EVERY = 75  # of the times a bicycle is drawn: each 1.5 s
SCALE = 1.8  # of the bicycles that are drawn on the road


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    rides = {name: ride(control) for name, control in RIDERS.items()}
    for name, (_, ridden) in rides.items():
        off = np.asarray(ridden["y"]) - np.asarray(jax.vmap(PATH)(ridden["x"]))
        print(
            f"{name}: {ridden}\n  off the path by {np.abs(off).max():.2f} m at most, {abs(off[-1]):.2f} m at the end;"
        )
        torque = np.asarray(ridden["applied_steer_torque"])
        first = np.degrees(np.asarray(ridden["steer"]))[np.asarray(ridden["x"]) < PATH.start].max()
        print(f"  steers with {np.abs(torque).max():.2f} N m at most, leans by {largest(ridden['roll']):.1f} deg,")
        print(f"  and steers {first:.2f} deg to the right before it turns left.")
    draw({name: ridden for name, (_, ridden) in rides.items()}, folder / "ride_a_lane_change.png")
    bicycle, ridden = rides["regulator"]
    page = jk.animate(bicycle, ridden, title="A lane change at 3 m/s").save(folder / "ride_a_lane_change.html")
    print(f"Pictures: {folder / 'ride_a_lane_change.png'}, {page}")


def ride(control):
    bicycle = BICYCLE.with_parts(control=control)
    start = jk.assemble(bicycle, {}, {"rear_wheel_rate": -SPEED / BICYCLE.rR})
    return bicycle, jk.simulate(bicycle, start, jnp.asarray(TIMES))


def largest(angle) -> float:
    return float(np.degrees(np.abs(np.asarray(angle)).max()))


def draw(rides, path: Path) -> None:
    """The road from above, once for each rider, and what they do on the way."""
    plt.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False})
    figure, axes = plt.subplots(
        5, 1, figsize=(13, 10.5), sharex=True, height_ratios=(2.2, 2.2, 1, 1, 1), layout="constrained"
    )
    for ax, (name, ridden) in zip(axes, rides.items(), strict=False):
        draw_road(ax, name, ridden)
    rows = (
        ("steer", "steer [deg]", np.degrees),
        ("roll", "roll [deg]", np.degrees),
        ("applied_steer_torque", "torque [N m]", np.asarray),
    )
    for ax, (quantity, label, shown) in zip(axes[2:], rows, strict=True):
        ax.axvspan(PATH.start, PATH.start + PATH.length, color=AIM, alpha=0.07, lw=0)
        ax.axhline(0.0, color="0.6", lw=0.8)
        for name, ridden in rides.items():
            ax.plot(ridden["x"], shown(np.asarray(ridden[quantity])), color=COLORS[name], lw=2.0, label=name)
        ax.set_ylabel(label)
        ax.margins(y=0.12)
    axes[2].legend(loc="upper left", frameon=False)
    axes[2].set_title("to the right is positive; shaded: where the path changes lanes", fontsize=9, loc="right")
    axes[-1].set_xlabel("along the road [m]")
    figure.align_ylabels(axes)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def draw_road(ax, name, ridden) -> None:
    """Two lanes, the path, the track of the rear wheel, and every 1.5 s the bicycle and the point it looks at."""
    low, high = -1.5, 36.0
    ax.set_facecolor(GRASS)
    ax.axhspan(-4.5, 1.5, color=ROAD, lw=0)
    for edge in (-4.42, 1.42):
        ax.axhline(edge, color=PAINT, lw=2.5)
    ax.axhline(-1.5, color=PAINT, lw=2.5, dashes=(7, 6))
    x = np.linspace(low, high, 400)
    ax.plot(x, jax.vmap(PATH)(jnp.asarray(x)), color=AIM, lw=1.4, ls=(0, (5, 3)), label="path")
    ax.plot(ridden["x"], ridden["y"], color=COLORS[name], lw=1.6, alpha=0.8, label="rear wheel")
    for k in range(0, len(TIMES) - 25, EVERY):
        draw_look(ax, name, ridden, k)
        draw_bicycle(ax, ridden, k, COLORS[name])
    ax.plot([], [], "o-", color=AIM, lw=0.8, markersize=3, label=f"looks {LOOKS_AHEAD[name]:g} s ahead")
    ax.set(xlim=(low, high), ylim=(2.1, -5.1), aspect="equal", ylabel="to the right [m]")
    ax.set_title(f"{name}: every 1.5 s, bicycles {SCALE:g} times as large", loc="left", color=COLORS[name])
    ax.legend(loc="lower right", ncols=3, frameon=False, bbox_to_anchor=(1.0, 0.98), borderaxespad=0.2)


def draw_look(ax, name, ridden, k: int) -> None:
    """From the rider's eyes to the point of the path for which it steers."""
    x, y, yaw = (float(ridden[each][k]) for each in ("x", "y", "yaw"))
    reach = SPEED * LOOKS_AHEAD[name] + (float(BICYCLE.w) if name == "sequential loops" else 0.0)
    there = x + reach * np.cos(yaw)
    ax.plot([x, there], [y, float(PATH(there))], color=AIM, lw=1.2, alpha=0.9, zorder=3)
    ax.plot(there, float(PATH(there)), "o", color=AIM, markersize=4.5, zorder=6)


def draw_bicycle(ax, ridden, k: int, color: str) -> None:
    """From above: wheels, frame and handlebar, and the rider, who leans with the frame."""
    x, y, yaw, roll, steer = (float(ridden[name][k]) for name in ("x", "y", "yaw", "roll", "steer"))
    forward, right = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    turned, across = (np.cos(steer) * forward + np.sin(steer) * right, np.cos(steer) * right - np.sin(steer) * forward)
    w, rR, rF = float(BICYCLE.w), float(BICYCLE.rR), float(BICYCLE.rF)

    def at(ahead, height):
        return np.array([x, y]) + SCALE * (ahead * forward + height * np.sin(roll) * right)

    def line(middle, half, width, shade):
        ends = np.stack([middle - SCALE * half, middle + SCALE * half])
        ax.plot(*ends.T, color=shade, lw=width, solid_capstyle="round", zorder=4)

    line(at(0.0, rR), rR * forward, 4.0, "#2b2b2b")
    line(at(w, rF), rF * turned, 4.0, "#2b2b2b")
    line(at(0.5 * w, 0.7), 0.45 * w * forward, 2.0, color)
    line(at(w - 0.15, 1.0), 0.3 * across, 2.4, "#2b2b2b")
    body = {"angle": np.degrees(yaw), "facecolor": color, "zorder": 5}
    ax.add_patch(Ellipse(at(0.40, 1.25), SCALE * 0.26, SCALE * 0.46, alpha=0.85, edgecolor="none", **body))
    ax.add_patch(Ellipse(at(0.50, 1.5), SCALE * 0.22, SCALE * 0.18, edgecolor="white", lw=1.0, **body))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the files (default: figures)")
    main(parser.parse_args().out)
