"""A chain hangs folded from both ends, and one end is released. Does this end fall faster than a stone?

The number of links of a planar chain of rods is a field: `Chain(links=21)`. The field is static, because it is used in
`range`. The names of coordinates and speeds are properties that depend on it. With many links, the chain approximates a
flexible chain, whose falling end has the following speed at the depth x (Calkin and March, American Journal of Physics
57, 154, 1989):

    v^2 = 2 g x (1 - x / 2 L) / (1 - x / L)

    variable               meaning                                                      unit
    angle1, angle2, ...    of each link from the downward vertical                      rad
    rate1, rate2, ...      their rates                                                  rad/s
    links                  number of links, odd: one lies at the bottom of the fold
    length, mass, gravity  of the whole chain; of the whole chain                       m, kg, m/s^2

Run:      python examples/simulate_a_chain.py [--out FOLDER]
Appears:  when the end of each chain, and when a stone, has fallen by nine tenths of the chain's length; the energy
          error; simulate_a_chain.png: 21 links at nine times, a stone beside them, and how far the ends have fallen.
Takes:    half a minute, most of it compilation.
"""

import argparse
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxkane as jk

jax.config.update("jax_enable_x64", True)

GOLD, BLUE, RED, INK = "#e8a33d", "#3d8fd1", "#c8553d", "#2b2f36"
LINKS = (5, 9, 21)


class Chain(jk.System):
    """Equal thin rods, the first on a pin at the origin. N.y is up; a link points along -R.y of its own frame."""

    links: int = eqx.field(static=True, default=21)
    length: jk.Scalar = jk.parameter(1.0, positive=True, unit="m")
    mass: jk.Scalar = jk.parameter(0.1, positive=True, unit="kg")
    gravity: jk.Scalar = jk.parameter(9.81, unit="m/s^2")

    @property
    def coordinates(self):
        return tuple(f"angle{i + 1}" for i in range(self.links))

    @property
    def speeds(self):
        return tuple(f"rate{i + 1}" for i in range(self.links))

    def motion(self, t, q, u):
        N, end = jk.inertial()
        m, l = self.mass / self.links, self.length / self.links
        I = m * l**2 / 12
        bodies, points = [], {}
        for i in range(self.links):
            R = N.rotate(3, q[i], u[i])
            bodies.append(jk.Body(m, (I, 0.0, I), end.fixed(-0.5 * l * R.y), R, name=f"link{i + 1}"))
            end = points[f"end{i + 1}"] = end.fixed(-l * R.y)
        return jk.Motion(bodies, points=points)

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -self.gravity * motion.N.y)


def folded(chain: Chain) -> jk.State:
    """Half of the links hang down, one lies across, half stand up again beside them; all at rest."""
    half = chain.links // 2
    angles = np.repeat([0.0, np.pi / 2, np.pi], [half, 1, half])
    return jk.State(dict(zip(chain.coordinates, angles, strict=True)), {})


def main(folder: Path) -> None:
    ts = jnp.linspace(0.0, 0.4, 161)  # [s]
    falls = {}
    for links in LINKS:
        chain = Chain(links=links)
        ride = jk.simulate(chain, folded(chain), ts)
        places = {name: np.asarray(x) for name, x in jk.positions(chain, ride).items()}
        falls[links] = -places[f"end{links}"][:, 1]
        error = jk.audit(chain, ride).energy_balance
        print(f"{links:3} links: {fall_time(ts, falls[links], chain)}; energy error {error:.0e}")
    stone = 0.5 * float(chain.gravity) * np.asarray(ts) ** 2
    print(f"a stone:   after {1e3 * np.sqrt(1.8 * float(chain.length / chain.gravity)):.0f} ms")

    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "simulate_a_chain.png"
    draw(chain, np.asarray(ts), places, falls, stone, path)
    print(f"picture: {path}")


def fall_time(ts: jax.Array, fallen: np.ndarray, chain: Chain) -> str:
    """When the end has fallen by nine tenths of the chain's length."""
    i = int(np.argmax(fallen > 0.9 * float(chain.length)))  # before it swings back
    return f"after {1e3 * np.interp(0.9 * float(chain.length), fallen[: i + 1], ts[: i + 1]):.0f} ms"


def flexible(chain: Chain) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] at which the end of a flexible chain has fallen by x [m], by integration of dx / v.

    With x = s^2, since the fall begins at rest: dt = 2 s ds / v.
    """
    L, g = float(chain.length), float(chain.gravity)
    s = np.sqrt(np.linspace(0.0, 0.995 * L, 4000))
    middle = 0.5 * (s[1:] + s[:-1])
    v_by_s = np.sqrt(2 * g * (1 - middle**2 / (2 * L)) / (1 - middle**2 / L))
    return np.concatenate([[0.0], np.cumsum(2 * np.diff(s) / v_by_s)]), s**2


def draw(chain: Chain, t, places, falls, stone, path: Path) -> None:
    plt.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False})
    figure, (strip, fall) = plt.subplots(1, 2, figsize=(10.5, 4.2), layout="constrained", width_ratios=[1.7, 1.0])
    joints = np.stack([np.zeros_like(places["end1"]), *(places[f"end{i + 1}"] for i in range(chain.links))])
    chosen = np.linspace(0, np.searchsorted(t, 0.38), 9).astype(int)
    for k, i in enumerate(chosen):
        x = 0.27 * k
        strip.plot(x + joints[:, i, 0], joints[:, i, 1], "-o", color=INK, linewidth=1.4, markersize=2.0)
        strip.plot(x + joints[-1, i, 0], joints[-1, i, 1], "o", color=GOLD, markersize=6)
        strip.plot(x + 0.13, -stone[i], "o", color=BLUE, markersize=6)
        strip.text(x, 0.06, f"{1e3 * t[i]:.0f} ms", ha="center", fontsize="small")
    strip.plot([], [], "o", color=GOLD, label="end of the chain")
    strip.plot([], [], "o", color=BLUE, label="a stone")
    strip.set(aspect="equal", ylim=(-1.05, 0.12))
    strip.axis("off")
    strip.legend(frameon=False, loc="lower left", title=f"{chain.links} links", alignment="left")

    fall.plot(1e3 * t, stone, color=BLUE, label="a stone")
    for links, shade in zip(falls, (0.35, 0.6, 1.0), strict=True):
        fall.plot(1e3 * t, falls[links], color=GOLD, alpha=shade, label=f"{links} links")
    times, fallen = flexible(chain)
    fall.plot(1e3 * times, fallen, "--", color=RED, linewidth=1.2, label="flexible (Calkin and March)")
    fall.set(xlabel="time [ms]", ylabel="fallen by [m]", xlim=(0, 1e3 * t[-1]), ylim=(1.05, 0))
    fall.grid(alpha=0.25)
    fall.legend(frameon=False, fontsize="small", loc="lower left")
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the picture (default: figures)")
    main(parser.parse_args().out)
