"""From where a scene is seen, and how it is projected. Knows numbers; knows no system and no page."""

from __future__ import annotations

import dataclasses

import numpy as np

from .._common.real_numbers import real_number


@dataclasses.dataclass(frozen=True)
class View:
    """From where it is seen: towards `center` (3,) [m], or along with the motion; z is up on the page.

    Angles in radians, about the vertical and above the horizon; `span` [m] is what the shorter side of the page shows.
    """

    center: np.ndarray
    span: float
    azimuth: float
    elevation: float
    follow: bool
    span_following: float

    def seen_from(self, azimuth: float | None, elevation: float | None) -> View:
        """The view from other angles [degrees], where these are given.

        **Raises:** `ValueError` for what is no finite number.
        """
        angles = {"azimuth": azimuth, "elevation": elevation}
        angles = {key: real_number(x, f"`{key}`") for key, x in angles.items() if x is not None}
        wrong = [key for key, x in angles.items() if not np.isfinite(x)]
        if wrong:
            raise ValueError(f"`{wrong[0]}` must be finite, got {angles[wrong[0]]}.")
        return dataclasses.replace(self, **{key: float(np.deg2rad(x)) for key, x in angles.items()})


UPRIGHT = {
    "x": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
    "-x": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "-y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "z": np.eye(3),
    "-z": np.diag([1.0, -1.0, -1.0]),
}
"""By the axis of N that is up: components in N -> on the page, where z is up."""


def which_way_is_up(forces: np.ndarray) -> str:
    """The axis of N that is nearest to the opposite of gravity: of the constant forces (n_t, l, 3) on mass centres."""
    constant = np.ptp(forces, axis=0).max(axis=1, initial=0.0) <= 1e-9 * (np.abs(forces).max(initial=0.0) + 1e-300)
    down = forces[0, constant].sum(axis=0)
    if not np.any(down):
        return "z"
    axis = int(np.argmax(np.abs(down)))
    return ("-" if down[axis] > 0 else "") + "xyz"[axis]


def view_of(x: np.ndarray, moves: np.ndarray, leader: np.ndarray, follow: bool | None) -> View:
    """A view of vertices (F, V, 3): from the front of what moves in a plane, else obliquely from above.

    `moves` (V,): which vertices belong to parts; the others stand still.
    """
    low, high = x.min(axis=(0, 1)), x.max(axis=(0, 1))
    center = 0.5 * (low + high)
    reach = float(np.linalg.norm(x - center, axis=-1).max())
    carried = x[:, moves] if moves.any() else x
    size = float(np.linalg.norm(carried - leader[:, None], axis=-1).max())
    travel = float(np.linalg.norm(np.ptp(leader, axis=0)))
    if follow is None:
        follow = travel > 4.0 * size
    depth = np.abs(x - x[:1]).max(axis=(0, 1))  # how far anything moves along each axis
    flat = depth <= 1e-5 * max(reach, 1e-12)
    azimuth, elevation = np.deg2rad([-62.0, 18.0])
    if flat.sum() == 1:
        azimuth, elevation = np.deg2rad([(0.0, 0.0), (-90.0, 0.0), (-90.0, 90.0)][int(np.argmax(flat))])
    return View(center, 2.15 * max(reach, 1e-9), float(azimuth), float(elevation), bool(follow), 2.2 * max(size, 1e-9))


def project(x: np.ndarray, target: np.ndarray, view: View, span: float) -> np.ndarray:
    """To the right, upwards (in spans of the page's shorter side) and away from the eye (n, V, 3): a mild perspective.

    The viewer's script does the same.
    """
    c, s = np.cos([view.azimuth, view.elevation]), np.sin([view.azimuth, view.elevation])
    right = np.array([-s[0], c[0], 0.0])
    above = np.array([-s[1] * c[0], -s[1] * s[0], c[1]])
    away = -np.array([c[1] * c[0], c[1] * s[0], s[1]])
    r = (x - target) / span
    depth = r @ away
    scale = 1.0 / np.maximum(1.0 + depth / 3.0, 0.05)
    return np.stack([(r @ right) * scale, (r @ above) * scale, depth], axis=-1)
