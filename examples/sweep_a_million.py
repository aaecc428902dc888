"""What is the largest roll angle of a bicycle in the second after a push? A sweep of up to a million bicycles.

The parameters of riders and frames and the speeds are random. Each bicycle (`jaxkane.catalog.WhippleBicycle`,
nonlinear) rolls straight ahead, is pushed sideways and rides without a rider. Only a few numbers of each simulation are
kept, so the memory hardly depends on the number of members. With `--folder`, every finished chunk is saved. An
interrupted sweep can be resumed by the same command. `--devices` selects the number of cores.

    variable     meaning                                              range             unit
    speed        forward speed at the start                           2 to 8            m/s
    roll_rate    the push: rate of the rear frame's roll              0.5               rad/s
    mB           mass of frame and rider                              50 to 110         kg
    lam          tilt of the steer axis                               0.2 to 0.5        rad
    largest      largest roll in the first second                                       rad (pictured in degrees)
    gained       roll at the end over the largest: below 1 it stabilizes                1

Run:      python examples/sweep_a_million.py [--members N] [--folder FOLDER] [--devices N] [--out FOLDER]
Appears:  simulations per second, the memory of the process, the statuses; and sweep_a_million.png: the largest roll
          over the speed, coloured by the number of bicycles, and the share that is returning to upright.
Takes:    ten to thirty seconds for the 20 000 of the default, most of it compilation; two or three minutes for a
          million.
"""

import argparse
import sys
import time
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxkane as jk

PUSH = 0.5  # [rad/s]


def main(n: int, chunk: int, kept: Path | None, folder: Path) -> None:
    rng = np.random.default_rng(0)
    bicycles = {
        "speed": rng.uniform(2.0, 8.0, n),
        "mB": rng.uniform(50.0, 110.0, n),
        "lam": rng.uniform(0.2, 0.5, n),
    }
    ts = np.linspace(0.0, 1.0, 51)
    started = time.perf_counter()
    rides = jk.sweep.sweep(
        jk.catalog.WhippleBicycle.benchmark(),
        pushed,
        ts,
        table=bicycles,
        reduce=lean,
        chunk=chunk,
        folder=kept,
        progress=sys.stderr.isatty(),
    )
    seconds = time.perf_counter() - started
    print(rides)
    print(f"{n} rides of 1 s in {seconds:.1f} s, {n / seconds:.0f} a second with compilation{memory()}")
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "sweep_a_million.png"
    draw(rides, path)
    print(f"picture: {path}")


def pushed(bicycle: jk.System, row) -> jk.State:
    return jk.assemble(bicycle, {}, {"roll_rate": PUSH, "rear_wheel_rate": -row["speed"] / bicycle.rR})


def lean(ride: jk.Trajectory) -> dict:
    largest = jnp.max(jnp.abs(ride["roll"]))
    return {"largest": largest, "gained": ride["roll"][-1] / largest}


def memory() -> str:
    """The largest memory of this process so far, where the system tells."""
    try:
        import resource
    except ImportError:
        return ""
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return f"; {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit:.0f} MB of memory at most"


def draw(rides: jk.sweep.Sweep, path: Path) -> None:
    speed, largest, gained = rides["speed"], np.rad2deg(rides["largest"]), rides["gained"]
    seen = np.isfinite(largest) & rides.ok
    plt.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False})
    figure, (counts, share) = plt.subplots(1, 2, figsize=(11, 4.6), layout="constrained", width_ratios=[1.3, 1])

    top = np.ceil(np.quantile(largest[seen], 0.999))
    bins = 150 if seen.sum() > 2e5 else 60
    _, _, _, image = counts.hist2d(
        speed[seen], largest[seen], bins=bins, range=((2, 8), (0, top)), cmin=1, cmap="viridis"
    )
    figure.colorbar(image, ax=counts, label="bicycles", pad=0.02, aspect=30)
    counts.set(xlabel="speed [m/s]", ylabel="largest roll in the first second [deg]")
    counts.set_title(f"{seen.sum():,} bicycles after a push of {PUSH} rad/s".replace(",", " "), fontsize=10, loc="left")

    edges = np.linspace(2.0, 8.0, 25)
    at = np.digitize(speed, edges) - 1
    upright = [np.mean(np.abs(gained[seen & (at == i)]) < 0.9) for i in range(24)]
    ended = [np.mean(~rides.ok[at == i]) for i in range(24)]
    middle = (edges[1:] + edges[:-1]) / 2
    share.plot(middle, 100 * np.array(upright), color="#2e8b57", lw=2)
    share.plot(middle, 100 * np.array(ended), color="#b0413e", lw=2)
    share.text(middle[-1], 100 * upright[-1] - 3, "rolls less again", color="#2e8b57", ha="right", va="top")
    share.text(middle[-1], 100 * ended[-1] + 2, "ended early", color="#b0413e", ha="right", va="bottom")
    share.set(xlim=(2, 8), ylim=(-2, 105), xlabel="speed [m/s]", ylabel="share of the bicycles [%]")
    share.grid(alpha=0.25)
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--members", type=int, default=20_000, help="how many bicycles (default: 20000)")
    parser.add_argument("--chunk", type=int, default=4096, help="bicycles in one call (default: 4096)")
    parser.add_argument("--folder", type=Path, help="keep finished chunks there, and go on from them")
    parser.add_argument("--devices", type=int, help="split the CPU into so many devices")
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the picture (default: figures)")
    arguments = parser.parse_args()
    jk.configure(cache=False, devices=arguments.devices, verbose=False)
    main(arguments.members, arguments.chunk, arguments.folder, arguments.out)
