"""How does a double pendulum move if it is released from above, and how accurate is the simulation?

Two equal links hang from a fixed pin and from each other, in a vertical plane (`jaxkane.catalog.DoublePendulum`).

    variable                meaning                                       unit
    theta1, theta2          angle of each link from the downward vertical rad
    theta1_dot, theta2_dot  their rates                                   rad/s
    mass, length            of each link                                  kg, m
    gravity                                                               m/s^2

Run:      python examples/simulate_double_pendulum.py [--out FOLDER]
Appears:  the number of steps and the error of the energy, which is constant without friction and torques, and
          simulate_double_pendulum.png: the paths of both tips as a long exposure, the angles, the energy error
          (its spikes are due to the interpolation between steps, its drift is due to the steps).
Takes:    a few seconds.
"""

import argparse
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection

import jaxkane as jk

jax.config.update("jax_enable_x64", True)

GOLD, BLUE, INK, NIGHT = "#e8a33d", "#3d8fd1", "#2b2f36", "#0d1220"


def main(folder: Path) -> None:
    pendulum = jk.catalog.DoublePendulum(mass=1.0, length=1.0, gravity=9.81)
    state = jk.assemble(pendulum, {"theta1": 2.2, "theta2": 2.9})  # at rest, both links high up
    ts = jnp.linspace(0.0, 10.0, 2001)

    started = time.perf_counter()
    swing = jk.simulate(pendulum, state, ts, rtol=1e-10, atol=1e-10)
    print(f"{swing}, with compilation {time.perf_counter() - started:.1f} s")

    error = np.asarray(energy(pendulum, swing))
    error = error - error[0]
    scale = float(4 * pendulum.mass * pendulum.gravity * pendulum.length)
    print(f"energy: largest error {np.abs(error).max():.1e} J; to raise the hanging links upright takes {scale:.1f} J")

    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "simulate_double_pendulum.png"
    draw(pendulum, swing, error, path)
    print(f"picture: {path}")


def energy(pendulum: jk.System, swing: jk.Trajectory) -> jax.Array:
    """Kinetic and potential energy (n_t,) [J] along a motion."""
    kinetic = jax.vmap(lambda t, q, u: jk.kinetic_energy(pendulum, t, q, u))(swing.t, swing.q, swing.u)
    height = -pendulum.length * (1.5 * jnp.cos(swing["theta1"]) + 0.5 * jnp.cos(swing["theta2"]))
    return kinetic + pendulum.mass * pendulum.gravity * height


def tips(pendulum: jk.System, swing: jk.Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Where the ends of the first and of the second link are, each (n_t, 2) [m]."""
    a, b = (np.asarray(swing[name]) for name in ("theta1", "theta2"))
    l = float(pendulum.length)
    first = l * np.stack([np.sin(a), -np.cos(a)], axis=-1)
    return first, first + l * np.stack([np.sin(b), -np.cos(b)], axis=-1)


def draw(pendulum: jk.System, swing: jk.Trajectory, error: np.ndarray, path: Path) -> None:
    plt.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False})
    figure = plt.figure(figsize=(10.5, 5.0), layout="constrained")
    places = [["photograph", "angles"], ["photograph", "energy"]]
    photograph, angles, energies = figure.subplot_mosaic(places, width_ratios=[1, 1.1]).values()
    draw_exposure(photograph, pendulum, swing)

    t = np.asarray(swing.t)
    for name, color, label in (("theta1", GOLD, "first link"), ("theta2", BLUE, "second link")):
        angles.plot(t, np.asarray(swing[name]) / (2 * np.pi), color=color, label=label)
    angles.set(ylabel="turns from hanging", xlim=(0, t[-1]))
    angles.legend(frameon=False)
    angles.tick_params(labelbottom=False)
    angles.grid(alpha=0.25)

    energies.plot(t, error * 1e9, color=INK, lw=1.2)
    energies.set(xlabel="time [s]", ylabel="energy error [nJ]", xlim=(0, t[-1]))
    energies.grid(alpha=0.25)
    figure.align_ylabels([angles, energies])
    figure.savefig(path, dpi=110)
    plt.close(figure)


def draw_exposure(axes: plt.Axes, pendulum: jk.System, swing: jk.Trajectory) -> None:
    """A dark room, a lamp on either tip, the shutter open; the links in the flash of the last moment."""
    reach = 2.15 * float(pendulum.length)
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", facecolor=NIGHT, xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    paths = tips(pendulum, swing)
    fade = np.linspace(0.3, 1.0, len(swing.t) - 1) ** 1.5
    for points, color in zip(paths, (GOLD, BLUE)):
        segments = np.stack([points[:-1], points[1:]], axis=1)
        for width, strength in ((6.0, 0.07), (2.6, 0.18), (0.9, 1.0)):  # a glow around a bright core
            axes.add_collection(LineCollection(segments, colors=color, linewidths=width, alpha=strength * fade))
    links = np.stack([np.zeros(2), paths[0][-1], paths[1][-1]])
    axes.plot(*links.T, color="white", lw=2.2, solid_capstyle="round")
    axes.scatter(*links[1:].T, s=60, color=[GOLD, BLUE], edgecolors="white", linewidths=1.2, zorder=3)
    axes.scatter(0, 0, s=26, color="white", zorder=3)
    axes.set_title("Two tips, ten seconds", color=INK)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the picture (default: figures)")
    main(parser.parse_args().out)
