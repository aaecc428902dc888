"""What do the systems of the catalogue look like, and how do they move when left to themselves?

Every entry of `jaxkane.catalog.CATALOG` is simulated from its own state, without inputs, and drawn as a stroboscopic
photograph: the mechanism as a stick figure at a few instants, the last one brightest, over the traces of mass centres
and of a few ends. Planar systems are seen from the front, spatial ones obliquely from above.

    variable            meaning                                                               unit
    seconds             how long the shutter is open, for each system its own                 s
    flashes             instants at which the figure is drawn
    azimuth, elevation  from where it is seen: about the vertical, above the horizon          rad (given in degrees)
    places, traces      points of the figure in the inertial frame, before the projection     m

Run:      python examples/draw_catalogue.py [--out FOLDER] [--each]
Appears:  a line for each simulation, and catalogue.png: a panel for each system with its name and its place in the
          book (Kamman, Volume II, Unit 5). With --each, also NAME.png for each system. The aircraft are drawn ten times
          too large for the way they fly; what a description leaves open (the length of a column, the rider's back) is
          the draughtsman's. Red, green and blue are a body's axes 1, 2 and 3; a system that is not in the table
          `PICTURES` shows those of every body.
Takes:    less than a minute, most of it compilation.
"""

import argparse
import dataclasses
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxkane as jk

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_disable_most_optimizations", True)  # compiles faster, and these runs are short

GOLD, BLUE, WHITE, GREY, INK, NIGHT = "#f0ab45", "#4fa3e3", "#f4f6fa", "#5d6880", "#2b2f36", "#0d1220"
AXES = ("#e8604c", "#58b368", "#4fa3e3")
AROUND = np.linspace(0.0, 2.0 * np.pi, 49)


class Sketch:
    """The stick figure of one instant: lines of places in N, and the places that leave a trace."""

    def __init__(self, motion: jk.Motion):
        self.N = motion.N
        self.lines: list[tuple[str, jax.Array]] = []  # colour, places (n, 3); grey is what stands still
        self.dots: list[tuple[str, jax.Array]] = []
        self.traces: list[tuple[str, jax.Array]] = []

    def line(self, color: str, *places: jk.Vector) -> None:
        self.lines.append((color, jnp.stack([place.to(self.N) for place in places])))

    def circle(self, color: str, center: jk.Vector, a: jk.Vector, b: jk.Vector, radius: jk.Scalar | float) -> None:
        """A circle in the plane of two unit vectors."""
        round_ = jnp.cos(AROUND)[:, None] * a.to(self.N) + jnp.sin(AROUND)[:, None] * b.to(self.N)
        self.lines.append((color, center.to(self.N) + radius * round_))

    def dot(self, color: str, place: jk.Vector) -> None:
        self.dots.append((color, place.to(self.N)))

    def trace(self, color: str, *places: jk.Vector) -> None:
        self.traces.extend((color, place.to(self.N)) for place in places)

    def axes(self, center: jk.Vector, frame: jk.Frame, length: jk.Scalar | float) -> None:
        for color, axis in zip(AXES, (frame.x, frame.y, frame.z)):
            self.line(color, center, center + length * axis)


def two_links(system, motion, s):
    O, A = motion["O"].position, motion["A"].position
    for color, start, link in ((GOLD, O, motion["link1"]), (BLUE, A, motion["link2"])):
        middle = link.center.position
        end = start + 2.0 * (middle - start)
        s.line(color, start, end)
        s.dot(color, middle)
        s.trace(color, middle)
    s.trace(BLUE, end)


def free_body(system, motion, s):
    body = motion["body"]
    B, G = body.frame, body.center.position
    trace = system.I11 + system.I22 + system.I33  # a uniform cuboid that has these moments
    x, y, z = (
        jnp.sqrt(3.0 * (0.5 * trace - I) * 2.0 / system.mass) / 2.0 for I in (system.I11, system.I22, system.I33)
    )
    corner = lambda i, j, k: G + B.vector(i * x, j * y, k * z)  # noqa: E731
    for i in (-1, 1):
        s.line(WHITE, *(corner(i, j, k) for j, k in ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))))
        for j in (-1, 1):
            s.line(WHITE, corner(-1, i, j), corner(1, i, j))
    s.axes(G, B, 1.2 * y)
    s.trace(GOLD, G)


def arm_and_bar(system, motion, s):
    N, B, G = motion.N, motion["B"], motion["G"].position
    s.line(GREY, -0.45 * N.z, 0.45 * N.z)
    s.circle(GREY, 0.0 * N.z, N.x, N.y, system.distance)
    s.line(GOLD, 0.0 * N.x, G)
    s.line(BLUE, G - 0.5 * system.length * B.x, G + 0.5 * system.length * B.x)
    s.dot(BLUE, G)
    s.trace(BLUE, G + 0.5 * system.length * B.x)


def airliner(system, motion, s):
    A, G = motion["A"], motion["G"].position
    at = lambda *place: G + 10.0 * A.vector(*place)  # noqa: E731
    s.line(WHITE, at(7.0, 0.0, 0.0), at(-7.5, 0.0, 0.0), at(-8.5, 0.0, -2.6), at(-6.0, 0.0, 0.0))  # with the fin
    s.line(GOLD, at(-2.0, -8.0, 0.0), at(1.2, 0.0, 0.0), at(-2.0, 8.0, 0.0), at(-1.0, 0.0, 0.0), at(-2.0, -8.0, 0.0))
    s.line(GOLD, at(-8.2, -2.8, 0.0), at(-7.0, 0.0, 0.0), at(-8.2, 2.8, 0.0))
    for side in (-1.0, 1.0):
        x, y, z = system.engine_x, side * system.engine_y, system.engine_z
        s.line(BLUE, at(x + 1.2, y, z), at(x - 1.2, y, z))
    s.trace(WHITE, G)


def bicycle(system, motion, s):
    B, C = motion["B"], motion["C"]
    rear, front = motion["rear wheel"].center.position, motion["front wheel"].center.position
    at = lambda x, height: rear + B.vector(x, 0.0, system.rR - height)  # noqa: E731  of the upright bicycle, in metres
    S = motion["S"].position
    head = S - 0.3 * C.z
    s.circle(WHITE, rear, B.x, B.z, system.rR)
    s.circle(WHITE, front, C.x, C.z, system.rF)
    s.line(GOLD, rear, at(0.42, 0.28), S, at(0.26, 0.72), rear)
    s.line(GOLD, at(0.42, 0.28), at(0.22, 0.88), at(0.48, 1.45))  # to the rider's shoulders
    s.circle(GOLD, at(0.56, 1.62), B.x, B.z, 0.11)
    s.line(BLUE, front, S, head)
    s.line(BLUE, head - 0.28 * C.y, head + 0.28 * C.y)
    s.trace(WHITE, motion["P"].position)
    s.trace(BLUE, motion["Q"].position)
    s.trace(GOLD, motion["rear frame"].center.position)


def bar_with_piston(system, motion, s):
    N, A, B, l = motion.N, motion["piston"].center.position, motion["B"].position, system.length
    s.line(GREY, 0.0 * N.y, 1.15 * l * N.y)
    s.line(GREY, -0.75 * l * N.x, 0.75 * l * N.x)
    s.line(GOLD, A, B)
    for color, place in ((WHITE, A), (BLUE, B)):
        s.line(
            color, *(place + 0.045 * l * N.vector(i, j, 0.0) for i, j in ((1, 1), (-1, 1), (-1, -1), (1, -1), (1, 1)))
        )
    s.trace(GOLD, motion["bar"].center.position)


def slider_and_bar(system, motion, s):
    N, A, G = motion.N, motion["A"].position, motion["bar"].center.position
    s.line(GREY, -0.6 * system.length * N.x, 0.6 * system.length * N.x)
    s.line(GOLD, *(A + N.vector(0.1 * i, 0.06 * j, 0.0) for i, j in ((1, 1), (-1, 1), (-1, -1), (1, -1), (1, 1))))
    end = A + 2.0 * (G - A)
    s.line(BLUE, A, end)
    s.dot(BLUE, G)
    s.trace(BLUE, G, end)


def shaft_and_bar(system, motion, s):
    N, B, l = motion.N, motion["bar"].frame, system.length
    s.line(GREY, -0.55 * l * N.z, 0.55 * l * N.z)
    if hasattr(system, "shaft_radius"):  # the other shaft is light: no more than an axis
        S, r = motion["shaft"].frame, system.shaft_radius
        for height in (-0.4 * l, 0.4 * l):
            s.circle(GREY, height * N.z, N.x, N.y, r)
            s.line(GOLD, height * N.z, height * N.z + r * S.x)  # shows how far it has turned
        for angle in AROUND[::8]:
            side = N.vector(r * np.cos(angle), r * np.sin(angle), 0.0)
            s.line(GREY, side - 0.4 * l * N.z, side + 0.4 * l * N.z)
    s.line(GOLD, -0.13 * l * motion["S"].y, 0.13 * l * motion["S"].y)  # the pin
    s.line(BLUE, -0.5 * l * B.z, 0.5 * l * B.z)
    s.dot(BLUE, 0.0 * N.z)
    s.trace(BLUE, 0.5 * l * B.z)


def disk_and_bar(system, motion, s):
    N, P, G = motion.N, motion["P"].position, motion["bar"].center.position
    D = motion["disk"].frame
    s.line(GREY, -0.7 * N.z, 0.25 * N.z)
    s.circle(GOLD, 0.0 * N.z, D.x, D.y, system.disk_radius)
    s.line(GOLD, 0.0 * N.z, P)
    end = P + 2.0 * (G - P)
    s.line(BLUE, P, end)
    s.dot(BLUE, G)
    s.trace(BLUE, G, end)


def top(system, motion, s):
    T, L, G = motion["T"], system.distance, motion["top"].center.position
    s.circle(GREY, 0.0 * motion.N.z, motion.N.x, motion.N.y, 0.5 * L)
    s.line(WHITE, 0.0 * T.z, 1.6 * L * T.z)
    s.circle(GOLD, G + 0.1 * L * T.z, T.x, T.y, 0.5 * L)
    for axis in (T.x, T.y):
        s.line(BLUE, G + 0.1 * L * T.z - 0.5 * L * axis, 0.0 * T.z, G + 0.1 * L * T.z + 0.5 * L * axis)
    s.trace(GOLD, G)
    s.trace(WHITE, 1.6 * L * T.z)


def column_frame_and_disk(system, motion, s):
    N, A, b = motion.N, motion["A"], system.distance
    s.line(GREY, -1.3 * b * N.z, 1.3 * b * N.z)
    frame, disk = motion["frame"].center.position, motion["disk"].center.position
    s.line(GOLD, 0.0 * N.x, disk)
    s.line(GOLD, frame - 0.8 * b * A.x, frame + 0.8 * b * A.x)
    s.circle(BLUE, disk, A.x, A.z, 0.5 * b)
    s.dot(GOLD, frame)
    s.trace(BLUE, disk)
    s.trace(GOLD, frame + 0.8 * b * A.x)


def bracket(system, motion, s):
    N, G = motion.N, motion["bracket"].center.position
    A, B = motion["A"].position, motion["B"].position
    s.line(GOLD, 0.0 * N.x, A)
    s.line(BLUE, G - (B - G), B)
    s.dot(WHITE, G)
    s.trace(WHITE, G)
    s.trace(GOLD, A)
    s.trace(BLUE, B)


def axes_of_bodies(system, motion, s):
    """For a system that nobody has drawn: every body's axes, as long as its radius of gyration."""
    for body in motion.bodies:
        G = body.center.position
        inertia = sum(body.inertia[i][i] for i in range(3))
        s.axes(G, body.frame, jnp.maximum(jnp.sqrt(inertia / 2.0 / body.mass), 0.05))
        s.trace(GOLD, G)


@dataclasses.dataclass(frozen=True)
class Picture:
    """How a system is photographed: figure, seconds, flashes, the axis that points up, and from where [degrees]."""

    figure: Callable[[jk.System, jk.Motion, Sketch], None] = axes_of_bodies
    seconds: float = 3.0
    flashes: int = 6
    up: str = "z"
    azimuth: float = 35.0
    elevation: float = 22.0


PLANAR = {"up": "y", "azimuth": 0.0, "elevation": 0.0}
PICTURES = {
    "DoublePendulum": Picture(two_links, 0.9, 7, **PLANAR),
    "RigidBody": Picture(free_body, 7.0, 4, azimuth=100.0, elevation=30.0),
    "RotatingFrameAndBar": Picture(arm_and_bar, 2.4, 6),
    "RotatingFrameAndBarChosenSpeeds": Picture(arm_and_bar, 2.4, 6),
    "Aircraft": Picture(airliner, 2.2, 3, up="-z", azimuth=-10.0, elevation=35.0),
    "AircraftEulerParameters": Picture(airliner, 2.2, 3, up="-z", azimuth=60.0, elevation=35.0),
    "SpatialDoublePendulum": Picture(two_links, 1.2, 7, up="y"),
    "WhippleBicycle": Picture(bicycle, 1.2, 4, up="-z", azimuth=55.0),
    "BarWithPiston": Picture(bar_with_piston, 0.1, 5, **PLANAR),
    "SliderWithPinnedBar": Picture(slider_and_bar, 0.9, 7, **PLANAR),
    "ShaftAndBar": Picture(shaft_and_bar, 2.0, 5),
    "LightShaftAndBar": Picture(shaft_and_bar, 2.4, 5, azimuth=75.0),
    "DiskAndBar": Picture(disk_and_bar, 2.0, 6),
    "SpinningTop": Picture(top, 0.2, 3, azimuth=60.0),
    "ColumnFrameAndDisk": Picture(column_frame_and_disk, 1.8, 4),
    "Bracket": Picture(bracket, 1.2, 6, up="y"),
}


@dataclasses.dataclass(frozen=True)
class Photograph:
    """A figure for each flash and the traces, projected: colour and places (n, 2) [m]."""

    flashes: list[tuple[list[tuple[str, np.ndarray]], list[tuple[str, np.ndarray]]]]
    traces: list[tuple[str, np.ndarray]]


def main(folder: Path, each: bool) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    photographs = {}
    for name, entry in jk.catalog.CATALOG.items():
        started = time.perf_counter()
        photographs[name], motion = photograph(entry, PICTURES.get(name, Picture()))
        print(f"{name + ':':33s}{motion}, {time.perf_counter() - started:.1f} s")

    if each:
        for name, taken in photographs.items():
            figure = plt.figure(figsize=(2.4, 2.4))
            draw(figure.add_axes((0.0, 0.0, 1.0, 1.0)), taken)
            figure.savefig(folder / f"{name}.png", dpi=100, facecolor=NIGHT)
            plt.close(figure)
    draw_montage(photographs, folder / "catalogue.png")
    print(f"pictures: {folder / 'catalogue.png'}" + f" and {len(photographs)} more" * each)


def photograph(entry: jk.catalog.Entry, picture: Picture) -> tuple[Photograph, jk.Trajectory]:
    """Simulates an entry from its state and sketches it."""
    system = entry.example()
    ts = jnp.linspace(0.0, picture.seconds, 241)
    motion = jk.simulate(system, jk.State(jnp.array(entry.q), jnp.array(entry.u)), ts)
    at_rest = (0.0,) * (len(system.speeds) + len(system.dependent_speeds) + len(system.auxiliary_speeds))

    def sketch(t, q):  # places do not depend on speeds
        described = system.motion(t, q, at_rest)
        drawn = Sketch(described)
        picture.figure(system, described, drawn)
        return drawn

    # Compiled once for all instants; the colours are noted while it is traced.
    colors: list[list[str]] = []

    def places(t, q):
        drawn = sketch(t, q)
        parts = (drawn.lines, drawn.dots, drawn.traces)
        colors[:] = [[color for color, _ in part] for part in parts]
        return [[place for _, place in part] for part in parts]

    seen = jax.tree.map(lambda x: np.asarray(x) @ view(picture).T, jax.jit(jax.vmap(places))(motion.t, motion.q))
    lines, dots, traces = (list(zip(c, part)) for c, part in zip(colors, seen))
    flashes = np.linspace(0, len(ts) - 1, picture.flashes).round().astype(int)
    figures = [([(c, x[i]) for c, x in lines], [(c, x[i]) for c, x in dots]) for i in flashes]
    return Photograph(figures, traces), motion


def view(picture: Picture) -> np.ndarray:
    """The projection (2, 3): to the right and upwards on the page, from components in N."""
    azimuth, elevation = np.deg2rad(picture.azimuth), np.deg2rad(picture.elevation)
    right = (-np.sin(azimuth), np.cos(azimuth), 0.0)
    above = (-np.sin(elevation) * np.cos(azimuth), -np.sin(elevation) * np.sin(azimuth), np.cos(elevation))
    stand_up = {"z": np.eye(3), "-z": np.diag((1.0, -1.0, -1.0)), "y": np.roll(np.eye(3), 1, axis=0)}
    return np.array((right, above)) @ stand_up[picture.up]


def draw(axes: plt.Axes, taken: Photograph) -> None:
    every = np.concatenate([x for lines, _ in taken.flashes for _, x in lines] + [x for _, x in taken.traces])
    low, high = every.min(axis=0), every.max(axis=0)
    middle, reach = 0.5 * (low + high), 0.56 * float((high - low).max())
    axes.set(xlim=middle[0] + reach * np.array((-1, 1)), ylim=middle[1] + reach * np.array((-1, 1)))
    axes.set(aspect="equal", facecolor=NIGHT, xticks=[], yticks=[])
    axes.spines[:].set_visible(False)

    still = [(color, x) for color, x in taken.flashes[-1][0] if color == GREY]
    for color, x in still:
        axes.plot(*x.T, color=color, lw=1.2, solid_capstyle="round")
    for color, x in taken.traces:
        axes.plot(*x.T, color=color, lw=1.0, alpha=0.55)
    strengths = np.linspace(0.0, 1.0, len(taken.flashes)) ** 1.6
    for strength, (lines, dots) in zip(strengths, taken.flashes):
        alpha = 0.16 + 0.84 * strength
        for color, x in lines:
            if color != GREY:
                axes.plot(*x.T, color=color, lw=1.3 + 0.9 * strength, alpha=alpha, solid_capstyle="round")
        for color, x in dots:
            axes.plot(*x, "o", color=color, ms=3.0 + 1.5 * strength, alpha=alpha, mew=0)


def draw_montage(photographs: dict[str, Photograph], path: Path) -> None:
    columns = 4
    rows = -(-len(photographs) // columns)
    figure, panels = plt.subplots(
        rows, columns, figsize=(2.6 * columns, 2.95 * rows), layout="constrained", squeeze=False
    )
    for axes in panels.flat[len(photographs) :]:
        axes.set_axis_off()
    for axes, (name, taken) in zip(panels.flat, photographs.items()):
        draw(axes, taken)
        title = f"{jk.catalog.CATALOG[name].book}\n{name}"
        axes.set_title(title, fontsize=8.5, color=INK)
    figure.get_layout_engine().set(w_pad=0.08, h_pad=0.08)
    figure.savefig(path, dpi=100)
    plt.close(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the picture (default: figures)")
    parser.add_argument("--each", action="store_true", help="also one small picture for each system")
    options = parser.parse_args()
    main(options.out, options.each)
