"""At which speeds is a riderless bicycle stable after a push?

The benchmark bicycle of Meijaard et al. (2007), nonlinear (`jaxkane.catalog.WhippleBicycle`), rolls straight ahead and
upright at 200 speeds. The same sideways push, a roll rate, is applied at each speed. In linear theory the bicycle is
stable between the weave speed (4.292 m/s; below, oscillations grow) and the capsize speed (6.024 m/s; above, it slowly
falls over).

    variable    meaning                                                              unit
    speed       forward speed at the start, 1 to 10                                  m/s
    roll        lean of the rear frame, to the right positive                        rad (pictured in degrees)
    roll_rate   its rate, 0.5 at the start: the push                                 rad/s

Run:      python examples/sweep_bicycle_speed.py [--out FOLDER]
Appears:  simulations per second; a table of statuses ("singular speeds": the fork has turned by 90 degrees, where the
          rolling constraints no longer determine the dependent speeds); and sweep_bicycle_speed.png: roll over time,
          coloured by speed, and the roll angle of each bicycle in the last second. The bars in the colour scale and
          the green band are the speeds of linear theory.
Takes:    under half a minute, most of it compilation.
"""

import argparse
import time
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection

import jaxkane as jk

jax.config.update("jax_enable_x64", True)

WEAVE, CAPSIZE = 4.292382536, 6.024262015  # [m/s] Meijaard et al. (2007), section 5
PUSH = 0.5  # [rad/s]
MAP = plt.get_cmap("turbo")


def main(folder: Path) -> None:
    bicycle = jk.catalog.WhippleBicycle.benchmark()
    speed = np.linspace(1.0, 10.0, 200)

    def pushed(bicycle, row):  # the wheels' angles fall when riding forward
        return jk.assemble(bicycle, {}, {"roll_rate": PUSH, "rear_wheel_rate": -row["speed"] / bicycle.rR})

    ts = np.linspace(0.0, 10.0, 501)

    for attempt in ("first, with compilation", "again"):
        started = time.perf_counter()
        rides = jk.sweep.sweep(bicycle, pushed, ts, table={"speed": speed})
        seconds = time.perf_counter() - started
        print(
            f"{attempt + ':':25s}{len(speed)} rides of 10 s in {seconds:5.2f} s, {len(speed) / seconds:4.0f} a second"
        )

    print_endings(speed, rides)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "sweep_bicycle_speed.png"
    draw(speed, rides, path)
    print(f"picture: {path}")


def print_endings(speed: np.ndarray, rides: jk.sweep.Sweep) -> None:
    reasons, t_end = np.asarray(rides.reason), np.asarray(rides.t_end)
    print(f"\n{'the ride':18s}{'rides':>6s}{'speeds [m/s]':>16s}{'ended at [s]':>16s}")
    for reason in dict.fromkeys(reasons):
        these = reasons == reason
        v, t = speed[these], t_end[these]
        print(f"{reason:18s}{these.sum():6d}{v.min():9.2f} to{v.max():5.2f}{t.min():8.2f} to{t.max():6.2f}")
    print()


def draw(speed: np.ndarray, rides: jk.sweep.Sweep, path: Path) -> None:
    t, roll = np.asarray(rides.t[0]), np.rad2deg(np.asarray(rides["roll"]))  # (n_t,) (b,n_t) [deg]
    plt.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False})
    figure, (over_time, over_speed) = plt.subplots(
        1, 2, figsize=(11, 4.8), layout="constrained", width_ratios=[1.25, 1]
    )

    segments = [np.stack([t, y], axis=-1)[np.isfinite(y)] for y in roll]
    lines = LineCollection(segments, array=speed, cmap=MAP, linewidths=0.9, alpha=0.8)
    over_time.add_collection(lines)
    over_time.axhline(0, color="black", lw=0.6)
    over_time.set(xlim=(0, t[-1]), ylim=(-50, 50), xlabel="time [s]", ylabel="roll [deg]")
    bar = figure.colorbar(lines, ax=over_time, label="speed [m/s]", pad=0.02, aspect=30)
    for v in (WEAVE, CAPSIZE):
        bar.ax.axhline(v, color="black", lw=1.5)

    draw_last_second(over_speed, speed, t, roll, np.asarray(rides.ok))
    figure.savefig(path, dpi=110)
    plt.close(figure)


def draw_last_second(axes: plt.Axes, speed: np.ndarray, t: np.ndarray, roll: np.ndarray, ok: np.ndarray) -> None:
    """Largest roll in the last second; bicycles that did not get there stand at the top."""
    top = 90.0  # [deg]
    left = np.abs(roll[:, t >= t[-1] - 1]).max(axis=1)  # NaN where the ride ended early
    axes.axvspan(WEAVE, CAPSIZE, color="#2e8b57", alpha=0.12, lw=0)
    for v, name, side, shift in ((WEAVE, "weave", "right", -0.1), (CAPSIZE, "capsize", "left", 0.1)):
        axes.axvline(v, color="#2e8b57", lw=1.2)
        axes.text(v + shift, 0.013, f"{name}\n{v:.3f} m/s", ha=side, va="bottom", color="#1f6b42")
    axes.text((WEAVE + CAPSIZE) / 2, 28, "rights\nitself", ha="center", va="center", color="#1f6b42")
    style = {"c": speed, "cmap": MAP, "vmin": speed.min(), "vmax": speed.max(), "s": 14}
    axes.scatter(speed, left, **style)
    fallen = {"c": speed[~ok], "cmap": MAP, "vmin": speed.min(), "vmax": speed.max()}
    axes.scatter(speed[~ok], np.full((~ok).sum(), top), marker="x", s=18, linewidths=0.9, **fallen)
    axes.text(speed.min(), 135, "x: ended early, fell over or fork turned by 90 deg", va="bottom", fontsize=9)
    axes.set(yscale="log", ylim=(0.01, 120), xlim=(0.8, 10.2), xlabel="speed [m/s]")
    axes.set_ylabel("largest roll in the last second [deg]")
    axes.grid(alpha=0.25)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the picture (default: figures)")
    main(parser.parse_args().out)
