"""Animations: a trajectory becomes a scene, and the scene a page for browsers or a GIF that pillow draws."""

from __future__ import annotations

import base64
import dataclasses
import functools
import html
import json
import os
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from .._common.files import atomic_write, write_file
from .._common.lookup import positive_number
from .._integrate.trajectory import Trajectory
from .._system.system import System
from ._figures import COLORS, Figure, Record, bodies_and_points, figure_of, record
from ._scene import FIXED, UPRIGHT, Builder, Scene, Shape, angles_of, project, turned_by, upward_axis, view_of

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw

_FRAMES_PER_SECOND = 50.0
_MOST_FRAMES = 3000
_THEMES = ("auto", "light", "dark")


def animate(
    system: System,
    trajectory: Trajectory,
    figure: Figure | None = None,
    *,
    speed: float = 1.0,
    up: str | None = None,
    follow: bool | None = None,
    azimuth: float | None = None,
    elevation: float | None = None,
    ground: bool | None = None,
    theme: str = "auto",
    title: str | None = None,
    height: int = 420,
) -> Animation:
    """An animation of a simulation: shown in a notebook, or saved as a page or a GIF.

        jk.animate(bicycle, trajectory)                      # the last line of a notebook's cell
        jk.animate(bicycle, trajectory).save("ride.html")    # a page that does not load anything
        jk.animate(bicycle, trajectory, speed=0.5).save("ride.gif")

    Bicycles have their own figure. In any other system, a body is drawn as its `shape`, or as the uniform solid with
    its mass and inertia, or as its frame if it has no mass. Points with constant distances are joined by lines. Springs
    of `jaxkane.loads` are zigzags, dampers and actuators are lines. Pass `figure` for another drawing. Orbit the view
    with the mouse or a finger, zoom with the wheel, and use keys to play, slow down and step; "?" lists them.

    **Arguments:**

    - `system`: the system.
    - `trajectory`: a `Trajectory` of this system; one member of a batch. It is drawn up to its end, at most 50 times a
        second; more samples are interpolated.
    - `figure`: a function (system, motion, sketch) that draws with a `Sketch`, between the points of a `Motion`.
    - `speed`: the initial playback speed; 0.1 is slow motion.
    - `up`: the axis of N that points up, "x", "-x", "y", "-y", "z" or "-z". Default: opposite to the weights.
    - `follow`: whether the camera follows the mass centre. Default: True if the system travels far.
    - `azimuth`, `elevation`: the viewing direction [degrees], about the vertical and above the horizon.
    - `ground`: whether a grid is drawn; for bicycles at the wheels' contacts, for others below the lowest point.
    - `theme`: "light", "dark", or "auto", the setting of the reader's system.
    - `title`: the system's name by default.
    - `height`: of the notebook's frame [pixels].

    **Returns:** an `Animation`.

    **Raises:** `ValueError` for a batch, for a trajectory of another system, and if no body has a position.
    """
    for label, value, allowed in (("up", "z" if up is None else up, UPRIGHT), ("theme", theme, _THEMES)):
        if value not in tuple(allowed):
            raise ValueError(f"animate: `{label}` must be one of {', '.join(allowed)}, got {value!r}.")
    positive_number(speed, "animate: `speed`")
    positive_number(height, "animate: `height`")
    angles, figure = angles_of(azimuth, elevation), figure or figure_of(system)
    scene = _scene(record(system, trajectory, figure), figure, speed, up, follow, ground, title, type(system).__name__)
    scene = dataclasses.replace(scene, view=dataclasses.replace(scene.view, **angles))
    return Animation(scene, speed, theme, height)


def _scene(
    motion: Record,
    figure: Figure | None,
    speed: float,
    up: str | None,
    follow: bool | None,
    ground: bool | None,
    title: str | None,
    name: str,
) -> Scene:
    turned = turned_by(motion.t, motion.spin, motion.orientation)
    frames = _frames(motion.t, _FRAMES_PER_SECOND / speed)
    total = motion.mass.sum()
    center_of_mass = (motion.place * motion.mass[:, None]).sum(axis=1) / (total if total > 0 else 1.0)
    scale = float(np.linalg.norm(motion.place - center_of_mass[:, None], axis=-1).max())
    scale += float(np.sqrt(np.trace(motion.inertia.sum(axis=0)) / (total if total > 0 else 1.0)))
    upright = UPRIGHT[up or upward_axis(motion.forces)]

    sampled = dataclasses.replace(
        motion,
        orientation=motion.orientation[frames],
        place=motion.place[frames],
        points=motion.points[frames],
        frames=motion.frames[frames],
        ends=motion.ends[frames],
        shapes=[x[frames] for x in motion.shapes],
    )
    build = Builder(sampled.orientation, sampled.place, turned[frames], scale or 1.0)
    if figure is None:
        bodies_and_points(sampled, build)
    for e in motion.elements:
        body = None if e.body is None else motion.body_numbers.index(e.body)
        build.moving(np.asarray(e.places)[frames], body)
        style = {"width": e.width, "closed": e.closed, "fill": e.fill, "label": e.label}
        build.shape(e.kind, e.color, e.places.shape[1], **style)

    center_of_mass = center_of_mass[frames] @ upright.T
    scene = Scene(
        t=motion.t[frames],
        **build.arrays(upright),
        shapes=tuple(build.shapes),
        center_of_mass=center_of_mass,
        ground=None,
        view=None,  # type: ignore[arg-type]
        title=name if title is None else title,
        name=name,
    )
    times = np.linspace(scene.t[0], scene.t[-1], 200)
    x, followed = scene.at(times)
    view = view_of(x, scene.owner != FIXED, followed, follow)
    lowest = float(x[..., 2].min())
    flat = view.elevation == 0.0  # from the side a grid would be a line
    if ground if ground is not None else not flat:
        scene = dataclasses.replace(scene, ground=lowest - (0.0 if figure is not None else 0.03 * view.span))
    return dataclasses.replace(scene, view=view)


def _frames(t: np.ndarray, rate: float) -> np.ndarray:
    # The frames: the samples nearest to `rate` a second, or all samples if there are fewer.
    n = int(min(max(np.ceil((t[-1] - t[0]) * rate) + 1, 2), _MOST_FRAMES))
    if n >= len(t):
        return np.arange(len(t))
    uniform = np.linspace(t[0], t[-1], n)
    after = np.clip(np.searchsorted(t, uniform), 1, len(t) - 1)
    return np.unique(after - (uniform - t[after - 1] < t[after] - uniform))


class Animation:
    """An animation. `save` writes it to a file, a notebook shows it, `html()` returns the page.

    `scene` contains the drawn data as NumPy arrays.
    """

    def __init__(self, scene: Scene, speed: float, theme: str, height: int):
        self.scene, self.speed, self.theme, self.height = scene, speed, theme, height

    def html(self) -> str:
        """The page: one canvas and its script. It does not load anything."""
        page = resources.files("jaxkane._animate").joinpath("viewer.html").read_text(encoding="utf-8")
        scene = json.dumps(_compact(self.scene, self.speed), separators=(",", ":")).replace("<", "\\u003c")
        for mark, text in (("theme", self.theme), ("title", html.escape(self.scene.title)), ("scene", scene)):
            page = page.replace(f"%%{mark}%%", text)
        return page

    def _repr_html_(self) -> str:
        page = html.escape(self.html()).replace("\n", "&#10;")  # one line: Markdown would otherwise split it
        return (
            f'<iframe srcdoc="{page}" title="{html.escape(self.scene.title, quote=True)}" '
            f'style="width: 100%; height: {self.height}px; border: 0" loading="lazy" allowfullscreen></iframe>'
        )

    def save(self, path: str | os.PathLike[str], **options: Any) -> Path:
        """Write the animation to NAME.html or NAME.gif.

        **Arguments:**

        - `path`: the file.
        - `options`: for a GIF: `size` = (480, 300) [pixels], `fps` = 20, `seconds` (duration of the animated part),
            `azimuth` and `elevation` [degrees] as in `animate`.

        **Returns:** the path.

        **Raises:** `ValueError` for another suffix, and for impossible options.
        """
        path = Path(path)
        if path.suffix == ".html" and not options:
            write_file(path, self.html())
        elif path.suffix == ".gif":
            gif = functools.partial(_write_gif, self.scene, self.speed, dark=self.theme == "dark", **options)
            atomic_write(path, gif)
        else:
            raise ValueError(
                f"Animation.save: the name must end with .html (without options) or .gif, got {path.name!r}."
            )
        return path

    def __repr__(self) -> str:
        t = self.scene.t
        return f"Animation({self.scene.title}: {len(t)} frames from {t[0]:g} to {t[-1]:g} s)"


def _compact(scene: Scene, speed: float) -> dict[str, Any]:
    """The scene for the page: orientations in 16 bits, positions in 32."""

    def encode(x: np.ndarray, dtype: str) -> str:
        return base64.b64encode(np.ascontiguousarray(x, dtype=np.dtype(dtype).newbyteorder("<")).tobytes()).decode()

    return {
        "title": scene.title,
        "speed": speed,
        "parts": scene.position.shape[1],
        "turning": scene.rotation.shape[1],
        "t": encode(scene.t - scene.t[0], "f4"),
        "start": float(scene.t[0]),
        **{name: encode(getattr(scene, name), "f4") for name in ("position", "center_of_mass", "vertex")},
        "rotation": encode(np.round(scene.rotation * 32767), "i2"),
        "owner": encode(scene.owner, "i2"),
        "shapes": [dataclasses.asdict(shape) for shape in scene.shapes],
        "ground": scene.ground,
        "view": dataclasses.asdict(scene.view) | {"center": scene.view.center.tolist()},
        "colors": COLORS,
    }


_FINE = 2  # draw larger by this factor and reduce: smooth lines


def _write_gif(
    scene: Scene,
    speed: float,
    file: BinaryIO,
    *,
    dark: bool = False,
    size: tuple[int, int] = (480, 300),
    fps: float = 20.0,
    seconds: float | None = None,
    azimuth: float | None = None,
    elevation: float | None = None,
) -> None:
    from PIL import Image, ImageDraw

    view = dataclasses.replace(scene.view, **angles_of(azimuth, elevation))
    seconds = None if seconds is None else positive_number(seconds, "Animation.save: `seconds`")
    # A GIF has delays in hundredths of a second; browsers need at least two.
    hundredths = max(2, round(100.0 / positive_number(fps, "Animation.save: `fps`")))
    start = scene.t[0]
    length = scene.t[-1] - start if seconds is None else min(seconds, scene.t[-1] - start)
    times = start + np.arange(0.0, length, 0.01 * hundredths * speed)
    x, center_of_mass = scene.at(times)
    painter = _Painter(scene, size, dark)
    images = []
    for i in range(len(times)):
        target, span = (center_of_mass[i], view.span_following) if view.follow else (view.center, view.span)
        image = Image.new("RGB", (size[0] * _FINE, size[1] * _FINE), painter.color("paper"))
        to_page = functools.partial(project, target=target, view=view, span=span)
        # Centre, step [m] and number of lines to each side of the grid, which does not move with the view
        step = 10.0 ** np.floor(np.log10(0.3 * span))
        step *= max(k for k in (1, 2, 5) if k * step <= 0.3 * span)
        grid = np.round(target[:2] / step) * step, step, 8
        painter.paint(ImageDraw.Draw(image, "RGBA"), i, x, to_page, grid)
        images.append(image.resize(size, Image.Resampling.LANCZOS))
    # One palette for all frames, because changing palettes flicker: every colour, blended in steps with the background.
    palette = Image.new("P", (1, 1))
    palette.putpalette(painter.palette())
    frames = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    options = {"append_images": frames[1:], "duration": 10 * hundredths, "loop": 0, "optimize": True}
    frames[0].save(file, "GIF", save_all=True, **options)


class _Painter:
    """Draws one frame: the ground, the traces, then the shapes from the farthest to the nearest."""

    def __init__(self, scene: Scene, size: tuple[int, int], dark: bool):
        self.scene, self.dark = scene, dark
        self.middle = np.array(size) * _FINE / 2
        self.scale = min(size) * _FINE

    def color(self, name: str, alpha: float = 1.0) -> Any:
        from PIL import ImageColor

        pair = COLORS.get(name)
        color = ImageColor.getrgb(pair[self.dark] if pair else name)[:3]
        return color if alpha == 1.0 else (*color, round(255 * alpha))

    def palette(self) -> list[int]:
        names = [*{"grid": 0, "ink": 0} | dict.fromkeys(shape.color for shape in self.scene.shapes)][:50]
        paper = np.array(self.color("paper"))
        steps = [paper + (np.array(self.color(name)) - paper) * k / 5 for name in names for k in range(1, 6)]
        return np.round([paper, *steps]).astype(int).ravel().tolist()

    def pixels(self, p: np.ndarray) -> list[tuple[float, float]]:
        return [tuple(row) for row in (self.middle + p[:, :2] * (self.scale, -self.scale)).tolist()]

    def paint(
        self,
        draw: ImageDraw,
        i: int,
        x: np.ndarray,
        to_page: Callable[[np.ndarray], np.ndarray],
        lines: tuple[np.ndarray, float, int],
    ) -> None:
        shapes = self.scene.shapes
        if self.scene.ground is not None:
            self._ground(draw, to_page, *lines)
        for shape in shapes:
            if shape.kind == "trace" and i:
                draw.line(self.pixels(to_page(x[: i + 1, shape.first])), self.color(shape.color, 0.7), width=_FINE)
        projected = to_page(x[i])
        solid = [shape for shape in shapes if shape.kind != "trace"]
        pairs = [(shape, projected[shape.first : shape.first + shape.count]) for shape in solid]
        for shape, p in sorted(pairs, key=lambda pair: -pair[1][:, 2].mean()):
            self._shape(draw, shape, self.pixels(p))

    def _shape(self, draw: ImageDraw, shape: Shape, at: list[tuple[float, float]]) -> None:
        color, width = self.color(shape.color), max(1, round(shape.width * _FINE * 0.8))
        if shape.kind == "line":
            if shape.fill:
                draw.polygon(at, fill=self.color(shape.color, shape.fill))
            draw.line([*at, at[0]] if shape.closed else at, color, width=width, joint="curve")
        elif shape.kind == "spring":
            draw.line(zigzag(at), color, width=width, joint="curve")
        elif shape.kind == "pairs":
            for pair in zip(at[::2], at[1::2]):
                draw.line(pair, color, width=width)
        elif shape.kind == "ball":
            (a, b), r = at[0], np.linalg.norm(np.subtract(at[1:], at[0])) / np.sqrt(2.0)
            draw.ellipse((a - r, b - r, a + r, b + r), self.color(shape.color, shape.fill), color, width=width)
        else:
            (a, b), r = at[0], shape.width * _FINE * 0.8
            box = (a - r, b - r, a + r, b + r)
            if shape.kind == "center":
                draw.ellipse(box, fill=self.color("paper"))
                draw.pieslice(box, 0, 90, fill=color)
                draw.pieslice(box, 180, 270, fill=color)
                draw.ellipse(box, outline=color, width=_FINE)
            else:
                draw.ellipse(box, fill=color)

    def _ground(
        self, draw: ImageDraw, to_page: Callable[[np.ndarray], np.ndarray], middle: np.ndarray, step: float, n: int
    ) -> None:
        for k in range(-n, n + 1):
            for axis in (0, 1):
                ends = np.full((2, 3), self.scene.ground)
                ends[:, axis] = middle[axis] + k * step
                ends[:, 1 - axis] = middle[1 - axis] + np.array([-n * step, n * step])
                draw.line(self.pixels(to_page(ends)), self.color("grid"), width=_FINE // 2)


_SPRING = [(0.0, 0.0), (0.2, 0.0), *((0.225 + 0.05 * k, 5.0 * (-1) ** k) for k in range(12)), (0.8, 0.0), (1.0, 0.0)]
"""The corners of a zigzag: the fraction of its length, and the distance from its axis [pixels]. The script of the page
has the same."""


def zigzag(ends: list[tuple[float, float]]) -> list[Any]:
    """The corners of a spring between two points of the enlarged page."""
    start, axis = np.array(ends[0]), np.subtract(ends[1], ends[0])
    across = _FINE * np.array([-axis[1], axis[0]]) / (np.linalg.norm(axis) or 1.0)
    return [tuple(start + s * axis + a * across) for s, a in _SPRING]
