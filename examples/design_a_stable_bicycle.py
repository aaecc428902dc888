"""Which small changes of geometry and mass maximize the stable speed range of a bicycle?

The benchmark bicycle of Meijaard et al. (2007) is stable from its weave speed to its capsize speed, 4.29 to 6.02 m/s.
`critical_speeds` computes both from the nonlinear model, with their gradients. Projected gradient ascent within bounds
maximizes

    capsize speed - weave speed

Steps that do not increase it are halved. A rider is not considered.

    variable    meaning                                             unit      bounds
    w           wheelbase                                           m         0.95 to 1.10
    c           trail                                               m         0.04 to 0.12
    lam         tilt of the steer axis                              rad       0.20 to 0.45
    xB, zB      mass centre of frame and rider, z down              m         0.25 to 0.40, -1.00 to -0.80
    xH, mH      mass centre and mass of handlebar and fork          m, kg     0.85 to 0.95, 3 to 6
    mF          mass of the front wheel (its inertia scales)        kg        2 to 4
    rF          radius of the front wheel                           m         0.25 to 0.37

Run:      python examples/design_a_stable_bicycle.py [--out FOLDER]
Appears:  the parameters before and after, the gradient at the start in m/s for one per cent of each, and
          design_a_stable_bicycle.png: eigenvalues against speed before and after, the two speeds on the way.
Takes:    about half a minute, most of it compilation.
"""

import argparse
import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxkane as jk
from jaxkane.stability import critical_speeds, eigenvalues

jax.config.update("jax_enable_x64", True)

BICYCLE = jk.catalog.WhippleBicycle.benchmark()
BOUNDS = {
    "w": (0.95, 1.10),
    "c": (0.04, 0.12),
    "lam": (0.20, 0.45),
    "xB": (0.25, 0.40),
    "zB": (-1.00, -0.80),
    "xH": (0.85, 0.95),
    "mH": (3.0, 6.0),
    "mF": (2.0, 4.0),
    "rF": (0.25, 0.37),
}
LOW, HIGH = np.array(list(BOUNDS.values())).T
SPEEDS = np.linspace(0.5, 25.0, 197)  # [m/s]


def main(folder: Path) -> None:
    start = np.array([float(getattr(BICYCLE, name)) for name in BOUNDS])
    way = [np.asarray(speeds_of(start))]
    _, slope = value_and_slope(start)
    print("one per cent of a parameter changes the range by [m/s]:")
    print("  " + "   ".join(f"{k} {0.01 * x * s:+.4f}" for k, x, s in zip(BOUNDS, np.abs(start), slope, strict=True)))

    z, value, step, tried = (start - LOW) / (HIGH - LOW), float(np.diff(way[0])[0]), 0.1, 1
    while step > 1e-3 and len(way) <= 40:  # z in the unit cube
        slope = np.asarray(slope) * (HIGH - LOW)
        free = np.where(((z <= 0) & (slope < 0)) | ((z >= 1) & (slope > 0)), 0.0, slope)
        trial = np.clip(z + step * free / max(np.linalg.norm(free), 1e-12), 0.0, 1.0)
        new, new_slope = value_and_slope(LOW + trial * (HIGH - LOW))
        tried += 1
        if float(new) > value:  # no speed, NaN, is not better either
            z, value, slope = trial, float(new), new_slope
            way.append(np.asarray(speeds_of(LOW + z * (HIGH - LOW))))
        else:
            slope, step = slope / (HIGH - LOW), step / 2
    end = LOW + z * (HIGH - LOW)
    print(f"\n{'':6s}{'before':>10s}{'after':>10s}{'bounds':>18s}")
    for name, a, b in zip(BOUNDS, start, end, strict=True):
        low, high = BOUNDS[name]
        print(f"{name:6s}{a:10.4f}{b:10.4f}{low:10.2f} to{high:5.2f}{'  (at the bound)' * (b in (low, high))}")
    for when, (weave, capsize) in (("before", way[0]), ("after", way[-1])):
        print(f"{when}: stable from {weave:.3f} to {capsize:.3f} m/s, a range of {capsize - weave:.3f} m/s")
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "design_a_stable_bicycle.png"
    draw(designed(start), designed(end), np.array(way), path)
    print(f"{len(way) - 1} steps, {tried} gradients; picture: {path}")


def designed(x) -> jk.System:
    """The bicycle with the parameters of `BOUNDS`; the front wheel keeps its shape."""
    values = dict(zip(BOUNDS, x, strict=True))
    size = (values["mF"] / BICYCLE.mF) * (values["rF"] / BICYCLE.rF) ** 2
    return dataclasses.replace(BICYCLE, **values, IFxx=BICYCLE.IFxx * size, IFyy=BICYCLE.IFyy * size)


@jax.jit
def speeds_of(x):
    critical = critical_speeds(designed(x), SPEEDS)
    return jnp.stack([critical["weave"], critical["capsize"]])


@jax.jit
def value_and_slope(x):
    return jax.value_and_grad(lambda x: jnp.diff(speeds_of(x))[0])(x)


def draw(before: jk.System, after: jk.System, way: np.ndarray, path: Path) -> None:
    plt.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False})
    figure, axes = plt.subplots(1, 3, figsize=(13, 4.2), layout="constrained")
    for ax, bicycle, name, (weave, capsize) in zip(
        axes, (before, after), ("benchmark", "designed"), way[[0, -1]], strict=False
    ):
        modes = eigenvalues(bicycle, np.linspace(0.0, 18.0, 361))
        ax.axvspan(weave, capsize, color="#2e8b57", alpha=0.15, lw=0)
        for i, mode in enumerate(dict.fromkeys(modes.modes)):
            ax.plot(modes.values, np.asarray(modes[mode].real), color=f"C{i}", label=mode)
        lines, labels = ax.get_legend_handles_labels()
        unique = dict(zip(labels, lines, strict=True))
        ax.legend(unique.values(), unique.keys(), frameon=False, loc="upper right")
        ax.axhline(0, color="gray", lw=0.8)
        ax.set(title=f"{name}: {weave:.2f} to {capsize:.2f} m/s", xlabel="speed [m/s]", ylim=(-10, 6))
    axes[0].set_ylabel("real parts of the eigenvalues [1/s]")
    steps = np.arange(len(way))
    axes[2].fill_between(steps, way[:, 0], way[:, 1], color="#2e8b57", alpha=0.15, lw=0)
    axes[2].plot(steps, way[:, 0], ".-", color="C0", label="weave speed")
    axes[2].plot(steps, way[:, 1], ".-", color="C1", label="capsize speed")
    axes[2].set(title="on the way", xlabel="step", ylabel="speed [m/s]")
    axes[2].legend(frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the picture (default: figures)")
    main(parser.parse_args().out)
