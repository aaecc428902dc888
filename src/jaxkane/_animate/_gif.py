"""A scene as a GIF, drawn with pillow. Knows scenes; knows no browser."""

from __future__ import annotations

import functools
import os
from typing import Any

import numpy as np

from .._common.real_numbers import positive_number
from ._scene import Scene
from ._sketch import COLORS
from ._view import project

_FINE = 2  # drawn so many times larger, then reduced: smooth lines


def write_gif(
    path: str | os.PathLike[str],
    scene: Scene,
    speed: float,
    *,
    dark: bool = False,
    size: tuple[int, int] = (480, 300),
    fps: float = 20.0,
    seconds: float | None = None,
    azimuth: float | None = None,
    elevation: float | None = None,
) -> None:
    """Writes the file; see `Animation.save`."""
    from PIL import Image, ImageDraw

    view = scene.view.seen_from(azimuth, elevation)
    seconds = None if seconds is None else positive_number(seconds, "Animation.save: `seconds`")
    hundredths = max(
        2, round(100.0 / positive_number(fps, "Animation.save: `fps`"))
    )  # a GIF counts hundredths of a second, and browsers no fewer than two
    start = scene.t[0]
    length = scene.t[-1] - start if seconds is None else min(seconds, scene.t[-1] - start)
    times = start + np.arange(0.0, length, 0.01 * hundredths * speed)
    x, leader = scene.at(times)
    painter = _Painter(scene, size, dark)
    images = []
    for i in range(len(times)):
        target, span = (leader[i], view.span_following) if view.follow else (view.center, view.span)
        image = Image.new("RGB", (size[0] * _FINE, size[1] * _FINE), painter.color("paper"))
        see = functools.partial(project, target=target, view=view, span=span)
        painter.paint(ImageDraw.Draw(image, "RGBA"), i, x, see, grid(target, span))
        images.append(image.resize(size, Image.Resampling.LANCZOS))
    # One palette for all frames, so that nothing flickers: every colour, and its steps to the paper's.
    palette = Image.new("P", (1, 1))
    palette.putpalette(painter.palette())
    frames = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=10 * hundredths, loop=0, optimize=True)


class _Painter:
    """Paints one instant: the ground, the tracks, then the shapes from the farthest to the nearest."""

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

    def paint(self, draw: Any, i: int, x: np.ndarray, see: Any, lines: Any) -> None:
        shapes = self.scene.shapes
        if self.scene.ground is not None:
            self._ground(draw, see, *lines)
        for shape in shapes:
            if shape.kind == "trace" and i:
                draw.line(self.pixels(see(x[: i + 1, shape.first])), self.color(shape.color, 0.7), width=_FINE)
        seen = see(x[i])
        parts = [(shape, seen[shape.first : shape.first + shape.count]) for shape in shapes if shape.kind != "trace"]
        for shape, p in sorted(parts, key=lambda part: -part[1][:, 2].mean()):
            self._shape(draw, shape, self.pixels(p))

    def _shape(self, draw: Any, shape: Any, at: list[tuple[float, float]]) -> None:
        color, width = self.color(shape.color), max(1, round(shape.width * _FINE * 0.8))
        if shape.kind == "line":
            if shape.fill:
                draw.polygon(at, fill=self.color(shape.color, shape.fill))
            draw.line([*at, at[0]] if shape.closed else at, color, width=width, joint="curve")
        elif shape.kind == "pairs":
            for pair in zip(at[::2], at[1::2]):
                draw.line(pair, color, width=width)
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

    def _ground(self, draw: Any, see: Any, middle: np.ndarray, step: float, n: int) -> None:
        for k in range(-n, n + 1):
            for axis in (0, 1):
                ends = np.full((2, 3), self.scene.ground)
                ends[:, axis] = middle[axis] + k * step
                ends[:, 1 - axis] = middle[1 - axis] + np.array([-n * step, n * step])
                draw.line(self.pixels(see(ends)), self.color("grid"), width=_FINE // 2)


def grid(target: np.ndarray, span: float) -> tuple[np.ndarray, float, int]:
    """Middle (2,), step [m] and number of lines to each side of the grid on the ground; it stays where it is."""
    step = 10.0 ** np.floor(np.log10(0.3 * span))
    step *= max(k for k in (1, 2, 5) if k * step <= 0.3 * span)
    return np.round(target[:2] / step) * step, step, 8
