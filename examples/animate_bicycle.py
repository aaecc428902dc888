"""How does a bicycle move after a sideways push at a stable speed?

The benchmark bicycle of Meijaard et al. (2007) rides without a rider for ten seconds, in the middle of its stable speed
range. It starts with a roll rate, as after a sideways push. The simulation is saved as an interactive HTML page and as
a GIF.

    variable   meaning                                                   unit
    speed      in the middle between the weave and the capsize speed     m/s
    roll_rate  at the start: the push                                    rad/s
    ride       roll, steer, yaw, place, ... over time                    rad, m

Run:      python examples/animate_bicycle.py [--out FOLDER]
Appears:  a summary of the simulation, the time to build the page, and the sizes of ride.html and ride.gif; and
          eigenvalues.png, which shows the stable speed range. In the page, drag to rotate, use the mouse wheel to
          zoom, and press space to pause; "?" lists the keys.
Takes:    about half a minute, most of it compilation.
"""

import argparse
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxkane as jk

jax.config.update("jax_enable_x64", True)


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    bicycle = jk.catalog.WhippleBicycle.benchmark()
    modes = jk.stability.eigenvalues(bicycle, jnp.linspace(0.0, 10.0, 201))
    stable = np.asarray(modes.values)[np.asarray(modes.stable)]
    speed = 0.5 * (stable[0] + stable[-1])
    ax = jk.plot.eigenvalues(modes)
    ax.axvline(speed, color="0.5", linestyle="--", linewidth=1.0)
    ax.figure.savefig(folder / "eigenvalues.png", dpi=110)
    print(f"Rights itself from {stable[0]:.2f} to {stable[-1]:.2f} m/s: it rides at {speed:.2f} m/s.")

    pushed = jk.assemble(bicycle, {}, {"roll_rate": 0.6, "rear_wheel_rate": -speed / bicycle.rR})
    ride = jk.simulate(bicycle, pushed, jnp.linspace(0.0, 10.0, 1001))
    largest = np.degrees(np.abs(np.asarray(ride["roll"])).max())
    print(f"{ride}\nIt leans up to {largest:.1f} deg, and at the end by {np.degrees(float(ride['roll'][-1])):.3f} deg;")
    print(f"it heads {np.degrees(float(ride['yaw'][-1])):.1f} deg away from where it went: nothing steers it back.")

    started = time.perf_counter()
    animation = jk.animate(bicycle, ride, title=f"Pushed at {speed:.2f} m/s")
    page = animation.save(folder / "ride.html")
    built = time.perf_counter() - started
    print(f"{page}: {page.stat().st_size / 1e3:.0f} kB, built in {built:.2f} s")
    started = time.perf_counter()
    picture = animation.save(folder / "ride.gif", size=(420, 260), fps=15, seconds=3.0, azimuth=-100.0, elevation=12.0)
    print(f"{picture}: {picture.stat().st_size / 1e3:.0f} kB, drawn in {time.perf_counter() - started:.2f} s")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the files (default: figures)")
    main(parser.parse_args().out)
