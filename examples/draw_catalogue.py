"""What do the systems of the catalogue look like, and how do they move without inputs?

Every entry of `jaxkane.catalog.CATALOG` is simulated from its own state, without inputs, and sketched as a stick
figure. The sketch is animated. It is also drawn as a stroboscopic photograph: the figure at a few instants, the last
one brightest, and the traces of mass centres and of a few ends. Planar systems are seen from the front, others
obliquely from above.

    variable            meaning                                                               unit
    seconds             how long the shutter is open, for each system its own                 s
    flashes             instants at which the figure is drawn
    azimuth, elevation  from where it is seen: about the vertical, above the horizon          rad (given in degrees)
    scene               the figure's vertices in the parts that carry them, z upwards          m

Run:      python examples/draw_catalogue.py [--out FOLDER] [--each]
Appears:  a line for each simulation; catalogue.png: a panel for each system with its name and its place in the book
          (Kamman, Volume II, Unit 5) or its source; and catalogue/NAME.html, an animation of each. With --each, also
          NAME.png for each system. The aircraft are drawn ten times too large for the way they fly; what a
          description leaves open (the length of a column, the rider's back) is drawn as seems likely. Red, green and
          blue are a body's axes 1, 2 and 3; a system that is not in the table `PICTURES` is drawn as `jaxkane.animate`
          draws it.
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

GOLD, BLUE, WHITE, GREY = "gold", "blue", "ink", "grey"  # names that a page reads according to its light
INK, NIGHT = "#2b2f36", "#0d1220"
AT_NIGHT = {"gold": "#f0ab45", "blue": "#4fa3e3", "ink": "#f4f6fa", "grey": "#5d6880"}
AT_NIGHT |= {"red": "#e8604c", "green": "#58b368"}
AROUND = np.linspace(0.0, 2.0 * np.pi, 49)


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


def ball(system, motion, s):
    N, G = motion.N, motion["ball"].center.position
    s.line(GREY, -0.4 * N.x, 0.4 * N.x)
    s.circle(GOLD, G + 0.06 * N.y, N.x, N.y, 0.06)
    s.trace(GOLD, G + 0.06 * N.y)


def wheel_without_a_rim(system, motion, s):
    S, hub, W = motion["S"], motion["hub"].position, motion["wheel"].frame
    s.line(GREY, -0.8 * S.x, 2.6 * S.x)
    s.line(GOLD, hub, motion["foot"])
    for i in range(-3, 5):
        if i:
            angle = 2.0 * i * system.half_angle
            s.line(BLUE, hub, hub + system.length * (jnp.sin(angle) * W.x - jnp.cos(angle) * W.y))
    s.dot(WHITE, hub)
    s.trace(WHITE, hub)


def two_legs(system, motion, s):
    S, hip = motion["S"], motion["hip"].center.position
    s.line(GREY, -0.6 * S.x, 1.7 * S.x)
    s.line(GOLD, motion["foot"], hip)
    s.line(BLUE, hip, motion["toe"])
    for body in motion.bodies:
        s.dot(WHITE, body)
    s.trace(WHITE, hip)


def stone(system, motion, s):
    O, B = motion["center"].position, motion["B"]
    a, b, c = (x * axis for x, axis in zip((system.a, system.b, system.c), (B.x, B.y, B.z), strict=True))
    s.line(GOLD, *(O + np.cos(angle) * a + np.sin(angle) * b for angle in AROUND), width=2.0)
    for half in (a, b):
        s.line(BLUE, *(O + np.cos(angle) * half - np.sin(angle) * c for angle in AROUND[:25]))
    s.trace(GOLD, O + a)


def block(system, motion, s):
    N, body, b, h = motion.N, motion["block"], system.half_width, system.half_height
    G, B = body.center.position, body.frame
    s.line(GREY, -1.0 * N.x, 1.2 * N.x)
    s.line(GOLD, *(G + i * b * B.x + j * h * B.y for i, j in ((1, 1), (-1, 1), (-1, -1), (1, -1), (1, 1))))
    s.dot(WHITE, G)
    s.trace(WHITE, G)
    s.trace(BLUE, motion["left"], motion["right"])


def block_on_a_belt(system, motion, s):
    N, G = motion.N, motion["block"].center.position
    for x in (-1.3, 1.3):
        s.circle(GREY, x * N.x - 0.32 * N.y, N.x, N.y, 0.2)
    for y in (-0.12, -0.52):
        s.line(GREY, -1.3 * N.x + y * N.y, 1.3 * N.x + y * N.y)
    s.line(GOLD, *(G + N.vector(0.12 * i, 0.12 * j, 0.0) for i, j in ((1, 1), (-1, 1), (-1, -1), (1, -1), (1, 1))))
    wall, end = -1.5 * N.x, G - 0.12 * N.x
    turns = [wall + i / 16 * (end - wall) + 0.05 * (-1) ** i * N.y for i in range(2, 15)]
    s.line(BLUE, wall, *turns, end)
    s.line(GREY, wall - 0.2 * N.y, wall + 0.2 * N.y)
    s.trace(GOLD, G)


def coupling_with_play(system, motion, s):
    N, M, L = motion.N, motion["motor"].frame, motion["load"].frame
    half = 0.5 * system.play
    s.circle(BLUE, 0.0 * N.x, L.x, L.y, 1.0)
    for sign in (-1.0, 1.0):
        side = jnp.cos(half) * L.x + sign * jnp.sin(half) * L.y
        s.line(BLUE, 0.75 * side, 1.0 * side)
    s.circle(GOLD, 0.0 * N.x, M.x, M.y, 0.45)
    s.line(GOLD, 0.0 * N.x, 0.9 * M.x)
    s.trace(GOLD, 0.9 * M.x)
    s.trace(BLUE, 1.0 * L.x)


def slider_crank(system, motion, s):
    N, A, B = motion.N, motion["A"].position, motion["slider"].center.position
    for sign in (-1.0, 1.0):
        y = sign * (system.half_height + system.clearance)
        s.line(GREY, 0.05 * N.x + y * N.y, 0.55 * N.x + y * N.y)
    s.line(GOLD, 0.0 * N.x, A)
    s.line(BLUE, A, B)
    corners = [motion[name].position for name in ("upper left", "upper right", "lower right", "lower left")]
    s.line(WHITE, *corners, corners[0])
    s.dot(GOLD, A)
    s.trace(GOLD, A)
    s.trace(WHITE, B)


def wheel_at_a_kerb(system, motion, s):
    N, wheel = motion.N, motion["wheel"]
    top, W = system.kerb * N.y, wheel.frame
    s.line(GREY, -1.0 * N.x + top, top, 0.0 * N.x, 1.6 * N.x)
    s.circle(GOLD, wheel, W.x, W.y, system.radius)
    for axis in (W.x, W.y):
        s.line(BLUE, wheel.center.position - system.radius * axis, wheel.center.position + system.radius * axis)
    s.trace(GOLD, wheel)
    s.trace(BLUE, wheel.center.position + system.radius * W.x)


def woodpecker(system, motion, s):
    N, sleeve, bird = motion.N, motion["sleeve"].frame, motion["bird"].frame
    G, r, h = motion["sleeve"].center.position, system.sleeve_radius, system.half_height
    for x in (-1.0, 1.0):
        s.line(GREY, x * system.pole_radius * N.x - 0.05 * N.y, x * system.pole_radius * N.x + 0.03 * N.y)
        s.line(GOLD, *(G + x * r * sleeve.x + y * h * sleeve.y for y in (-1.0, 1.0)))
    spring = G + system.sleeve_to_spring * sleeve.x
    center = spring + system.spring_to_bird * bird.x
    beak = center - system.beak_length * bird.x + system.beak_height * bird.y
    s.line(WHITE, G + r * sleeve.x, spring)
    s.line(BLUE, spring, center, beak, spring)
    s.trace(BLUE, beak)
    s.trace(GOLD, G)


@dataclasses.dataclass(frozen=True)
class Picture:
    """How a system is shown: figure, seconds, flashes, from where [degrees], the axis that points up; and the speed and
    the seconds of its animation."""

    figure: Callable[[jk.System, jk.Motion, jk.Sketch], None] | None = None
    seconds: float = 3.0
    flashes: int = 6
    azimuth: float = 35.0
    elevation: float = 22.0
    up: str | None = None
    speed: float = 1.0
    watched: float = 6.0


PLANAR = {"azimuth": -90.0, "elevation": 0.0}
PICTURES = {
    "DoublePendulum": Picture(two_links, 0.9, 7, **PLANAR),
    "RigidBody": Picture(free_body, 7.0, 4, azimuth=100.0, elevation=30.0, watched=10.0),
    "RotatingFrameAndBar": Picture(arm_and_bar, 2.4, 6),
    "RotatingFrameAndBarChosenSpeeds": Picture(arm_and_bar, 2.4, 6),
    "Aircraft": Picture(airliner, 2.2, 3, -10.0, 35.0, up="-z"),
    "AircraftEulerParameters": Picture(airliner, 2.2, 3, 60.0, 35.0, up="-z"),
    "SpatialDoublePendulum": Picture(two_links, 1.2, 7, -55.0),
    "WhippleBicycle": Picture(None, 1.2, 4, 55.0),
    "BarWithPiston": Picture(bar_with_piston, 0.1, 5, **PLANAR, speed=0.25, watched=2.0),
    "SliderWithPinnedBar": Picture(slider_and_bar, 0.9, 7, **PLANAR),
    "ShaftAndBar": Picture(shaft_and_bar, 2.0, 5),
    "LightShaftAndBar": Picture(shaft_and_bar, 2.4, 5, 75.0),
    "DiskAndBar": Picture(disk_and_bar, 2.0, 6),
    "SpinningTop": Picture(top, 0.2, 3, 60.0, speed=0.25, watched=1.5),
    "ColumnFrameAndDisk": Picture(column_frame_and_disk, 1.8, 4),
    "Bracket": Picture(bracket, 1.2, 6, -55.0),
    "SimplestWalker": Picture(two_legs, 2.5, 6, **PLANAR, speed=0.5),
    "CompassGait": Picture(two_legs, 1.47, 6, **PLANAR, speed=0.5),
    "Rattleback": Picture(stone, 0.5, 4, 20.0, 35.0, speed=0.5, watched=8.0),
    "RimlessWheel": Picture(wheel_without_a_rim, 2.4, 4, **PLANAR),
    "SliderCrankWithClearance": Picture(slider_crank, 0.02, 5, **PLANAR, speed=0.01, watched=0.04),
    "RockingBlock": Picture(block, 1.2, 5, **PLANAR, speed=0.5, watched=4.0),
    "KerbWheel": Picture(wheel_at_a_kerb, 1.1, 5, **PLANAR, speed=0.5, watched=2.0),
    "Backlash": Picture(coupling_with_play, 1.0, 4, **PLANAR, up="y"),
    "Belt": Picture(block_on_a_belt, 3.6, 4, **PLANAR, up="y", watched=9.0),
    "Woodpecker": Picture(woodpecker, 0.25, 5, **PLANAR, speed=0.1, watched=0.7),
    "BouncingBall": Picture(ball, 1.0, 10, **PLANAR, speed=0.5, watched=3.0),
}


def main(folder: Path, each: bool) -> None:
    pages = folder / "catalogue"
    pages.mkdir(parents=True, exist_ok=True)
    scenes = {}
    for name, entry in jk.catalog.CATALOG.items():
        started = time.perf_counter()
        picture = PICTURES.get(name, Picture())
        system, ts = (
            entry.example(),
            jnp.linspace(0.0, picture.watched, round(100 * picture.watched / picture.speed) + 1),
        )
        motion = jk.simulate(system, jk.State(jnp.array(entry.q), jnp.array(entry.u)), ts)
        angles = {"azimuth": picture.azimuth, "elevation": picture.elevation}
        animation = jk.animate(system, motion, picture.figure, speed=picture.speed, up=picture.up, **angles)
        page = animation.save(pages / f"{name}.html")
        scenes[name] = animation.scene
        size = f"{page.stat().st_size / 1e3:.0f} kB"
        print(f"{name + ':':33s}{motion}, {size}, {time.perf_counter() - started:.1f} s")

    if each:
        for name, scene in scenes.items():
            figure = plt.figure(figsize=(2.4, 2.4))
            draw(figure.add_axes((0.0, 0.0, 1.0, 1.0)), scene, PICTURES.get(name, Picture()))
            figure.savefig(folder / f"{name}.png", dpi=100, facecolor=NIGHT)
            plt.close(figure)
    draw_montage(scenes, folder / "catalogue.png")
    print(f"pictures: {folder / 'catalogue.png'}" + f" and {len(scenes)} more" * each + f"; animations: {pages}")


def view(picture: Picture) -> np.ndarray:
    """The projection (2, 3): to the right and upwards on the page, from a scene's components."""
    azimuth, elevation = np.deg2rad(picture.azimuth), np.deg2rad(picture.elevation)
    right = (-np.sin(azimuth), np.cos(azimuth), 0.0)
    above = (-np.sin(elevation) * np.cos(azimuth), -np.sin(elevation) * np.sin(azimuth), np.cos(elevation))
    return np.array((right, above))


def draw(axes, scene, picture: Picture) -> None:
    seen = scene.at(np.linspace(0.0, picture.seconds, 241))[0] @ view(picture).T  # (241, V, 2)
    places = lambda shape: seen[:, shape.first : shape.first + shape.count]  # noqa: E731
    traces = [(shape, places(shape)[:, 0]) for shape in scene.shapes if shape.kind == "trace"]
    figure = [(shape, places(shape)) for shape in scene.shapes if shape.kind != "trace"]
    flashes = np.linspace(0, 240, picture.flashes).round().astype(int)
    every = np.concatenate([x[flashes].reshape(-1, 2) for _, x in figure] + [x for _, x in traces])
    low, high = every.min(axis=0), every.max(axis=0)
    middle, reach = 0.5 * (low + high), 0.56 * float((high - low).max())
    axes.set(xlim=middle[0] + reach * np.array((-1, 1)), ylim=middle[1] + reach * np.array((-1, 1)))
    axes.set(aspect="equal", facecolor=NIGHT, xticks=[], yticks=[])
    axes.spines[:].set_visible(False)

    for shape, x in traces:
        axes.plot(*x.T, color=AT_NIGHT[shape.color], lw=1.0, alpha=0.55)
    for i, strength in zip(flashes, np.linspace(0.0, 1.0, picture.flashes) ** 1.6):
        alpha = 0.16 + 0.84 * strength
        for shape, x in figure:
            color, moves = AT_NIGHT[shape.color], scene.owner[shape.first] >= 0
            if not moves and i != flashes[-1]:
                continue
            if shape.kind == "line":
                lw = (1.3 + 0.9 * strength if moves else 1.2) * min(shape.width, 2.0) / 2.0
                closed = [*range(shape.count)] + [0] * shape.closed
                axes.plot(*x[i, closed].T, color=color, lw=lw, alpha=alpha, solid_capstyle="round")
            elif shape.kind == "pairs":
                axes.plot(*x[i].reshape(-1, 2, 2).transpose(2, 1, 0), color=color, lw=0.4, alpha=alpha)
            else:
                axes.plot(*x[i, 0], "o", color=color, ms=3.0 + 1.5 * strength, alpha=alpha, mew=0)


def draw_montage(scenes: dict, path: Path) -> None:
    columns = 4
    rows = -(-len(scenes) // columns)
    figure, panels = plt.subplots(
        rows, columns, figsize=(2.6 * columns, 2.95 * rows), layout="constrained", squeeze=False
    )
    for axes in panels.flat[len(scenes) :]:
        axes.set_axis_off()
    for axes, (name, scene) in zip(panels.flat, scenes.items()):
        draw(axes, scene, PICTURES.get(name, Picture()))
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
