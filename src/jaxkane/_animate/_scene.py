"""A scene: moving rigid parts, their mesh vertices, and a camera. Independent of systems and of the page."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from .._common.lookup import real_number


@dataclasses.dataclass(frozen=True)
class View:
    """The camera. It looks at `center` (3,) [m], or follows the mass centre; z is up on the page.

    - angles in radians, about the vertical and above the horizon.
    - `span` [m]: the length that the shorter side of the page shows.
    """

    center: np.ndarray
    span: float
    azimuth: float
    elevation: float
    follow: bool
    span_following: float


def angles_of(azimuth: float | None, elevation: float | None) -> dict[str, float]:
    """The angles of a `View` from angles [degrees]; None keeps an angle.

    **Raises:** `ValueError` for an angle that is not finite.
    """
    angles = {"azimuth": azimuth, "elevation": elevation}
    angles = {key: float(np.deg2rad(real_number(x, f"`{key}`"))) for key, x in angles.items() if x is not None}
    wrong = [key for key, x in angles.items() if not np.isfinite(x)]
    if wrong:
        raise ValueError(f"`{wrong[0]}` must be finite, got {angles[wrong[0]]}.")
    return angles


UPRIGHT = {
    "x": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
    "-x": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "-y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "z": np.eye(3),
    "-z": np.diag([1.0, -1.0, -1.0]),
}
"""For each axis of N that may be up: the matrix from components in N to those on the page, where z is up."""


def upward_axis(forces: np.ndarray) -> str:
    """The axis of N that is nearest to the opposite of gravity, i.e. of the constant forces (n_t, l, 3) on mass
    centres."""
    constant = np.ptp(forces, axis=0).max(axis=1, initial=0.0) <= 1e-9 * (np.abs(forces).max(initial=0.0) + 1e-300)
    down = forces[0, constant].sum(axis=0)
    if not np.any(down):
        return "z"
    axis = int(np.argmax(np.abs(down)))
    return ("-" if down[axis] > 0 else "") + "xyz"[axis]


def view_of(x: np.ndarray, moves: np.ndarray, center_of_mass: np.ndarray, follow: bool | None) -> View:
    """A view of vertices (F, V, 3): from the front if all motion is in a plane, else obliquely from above.

    `moves` (V,): which vertices belong to moving parts.
    """
    low, high = x.min(axis=(0, 1)), x.max(axis=(0, 1))
    center = 0.5 * (low + high)
    reach = float(np.linalg.norm(x - center, axis=-1).max())
    vertices_of_parts = x[:, moves] if moves.any() else x
    size = float(np.linalg.norm(vertices_of_parts - center_of_mass[:, None], axis=-1).max())
    travel = float(np.linalg.norm(np.ptp(center_of_mass, axis=0)))
    if follow is None:
        follow = travel > 4.0 * size
    depth = np.abs(x - x[:1]).max(axis=(0, 1))  # the range of motion along each axis
    flat = depth <= 1e-5 * max(reach, 1e-12)
    azimuth, elevation = np.deg2rad([-62.0, 18.0])
    if flat.sum() == 1:
        azimuth, elevation = np.deg2rad([(0.0, 0.0), (-90.0, 0.0), (-90.0, 90.0)][int(np.argmax(flat))])
    return View(center, 2.15 * max(reach, 1e-9), float(azimuth), float(elevation), bool(follow), 2.2 * max(size, 1e-9))


def project(x: np.ndarray, target: np.ndarray, view: View, span: float) -> np.ndarray:
    """Coordinates to the right, upwards (in spans of the page's shorter side) and away from the eye (n, V, 3), with a
    mild perspective.

    The script of the page does the same.
    """
    c, s = np.cos([view.azimuth, view.elevation]), np.sin([view.azimuth, view.elevation])
    right = np.array([-s[0], c[0], 0.0])
    above = np.array([-s[1] * c[0], -s[1] * s[0], c[1]])
    away = -np.array([c[1] * c[0], c[1] * s[0], s[1]])
    r = (x - target) / span
    depth = r @ away
    scale = 1.0 / np.maximum(1.0 + depth / 3.0, 0.05)
    return np.stack([(r @ right) * scale, (r @ above) * scale, depth], axis=-1)


FIXED = -1  # the owner of fixed vertices


@dataclasses.dataclass(frozen=True)
class Shape:
    """A range of `count` vertices from the `first`, and how they are drawn (see `Element`)."""

    kind: str
    color: str
    first: int
    count: int
    width: float = 1.5
    closed: bool = False
    fill: float = 0.0
    label: str = ""


@dataclasses.dataclass(frozen=True)
class Scene:
    """The data for a page or a GIF; z is up.

    - `t` (F,) [s]: times.
    - `rotation` (F, R, 4): unit quaternions, scalar last, of the first R parts. The other parts are points.
    - `position` (F, P, 3) [m]: of all parts.
    - `vertex` (V, 3) [m]: in the part `owner` (V,), or in N if that is -1.
    - `center_of_mass` (F, 3): of the whole system, which the camera may follow.
    - `ground`: height of the ground [m], or None.
    """

    t: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    vertex: np.ndarray
    owner: np.ndarray
    shapes: Sequence[Shape]
    center_of_mass: np.ndarray
    ground: float | None
    view: View
    title: str
    name: str

    def at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (n, V, 3) and the center_of_mass (n, 3) at times (n,), interpolated."""
        t = np.clip(np.atleast_1d(t), self.t[0], self.t[-1])
        i = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 2)
        s = ((t - self.t[i]) / (self.t[i + 1] - self.t[i]))[:, None, None]
        position = (1.0 - s) * self.position[i] + s * self.position[i + 1]
        center_of_mass = (1.0 - s[:, 0]) * self.center_of_mass[i] + s[:, 0] * self.center_of_mass[i + 1]
        x = np.broadcast_to(self.vertex, (len(t), *self.vertex.shape)).copy()
        for k in range(self.position.shape[1]):
            own = self.owner == k
            if k < self.rotation.shape[1] and own.any():
                R = Slerp(self.t, Rotation.from_quat(self.rotation[:, k]))(t).as_matrix()
                x[:, own] = np.einsum("nij,vj->nvi", R, self.vertex[own])
            x[:, own] += position[:, k, None]
        return x, center_of_mass


_SAME = 1e-6  # relative to the size of the scene: smaller motions are neglected


class Builder:
    """Collects parts, vertices and shapes over F times."""

    def __init__(self, orientation: np.ndarray, place: np.ndarray, turned: np.ndarray, scale: float):
        self.n_t, self.scale = len(place), scale
        # Far from the origin, above all in single precision, fixed points move by rounding errors.
        self.tolerance = _SAME * scale + 16.0 * float(np.finfo(place.dtype).eps) * float(np.abs(place).max(initial=0.0))
        # A body whose frame does not rotate with it occurs twice: as its frame, and rotated.
        self.rotations = [*np.moveaxis(orientation, 1, 0), *np.moveaxis(turned, 1, 0)]
        self.origins = [*np.moveaxis(place, 1, 0)] * 2
        self.n_b = place.shape[1]
        spins = np.abs(turned - orientation).max(axis=(0, 2, 3)) > 1e-12
        self.turned = [k + self.n_b * bool(spins[k]) for k in range(self.n_b)]
        self.paths: list[np.ndarray] = []
        self.vertices: list[np.ndarray] = []
        self.owners: list[tuple[str, int]] = []
        self.shapes: list[Shape] = []

    def shape(self, kind: str, color: str, count: int, **style: Any) -> None:
        """A shape of the last `count` vertices."""
        self.shapes.append(Shape(kind, color, len(self.vertices) - count, count, **style))

    def local(self, vertices: np.ndarray, body: int) -> None:
        """Vertices (n, 3) that are fixed in a body and rotate with it."""
        self._add_vertices(vertices, "part", self.turned[body])

    def moving(self, x: np.ndarray, body: int | None = None) -> None:
        """Add vertices (F, n, 3) in N; they are stored in the part in which they are fixed.

        `body`: the part with which they rotate. Pass the vertices as if it did not rotate relative to its frame.
        """
        if body is not None:
            self.local(self._components(self.rotations[body], self.origins[body], x).mean(axis=0), body)
            return
        if np.abs(x - x[:1]).max() <= self.tolerance:
            self._add_vertices(x.mean(axis=0), "fixed", FIXED)
            return
        for k, (R, origin) in enumerate(zip(self.rotations, self.origins, strict=True)):
            local = self._components(R, origin, x)
            if np.abs(local - local[:1]).max() <= self.tolerance:
                self._add_vertices(local.mean(axis=0), "part", k)
                return
        if x.shape[1] == 1:
            same = [k for k, path in enumerate(self.paths) if np.abs(path - x[:, 0]).max() <= self.tolerance]
            if not same:
                self.paths.append(x[:, 0])
            self._add_vertices(np.zeros((1, 3)), "path", same[0] if same else len(self.paths) - 1)
        elif not self._turn_about_the_first(x):
            for i in range(x.shape[1]):
                self.moving(x[:, i : i + 1])

    def _turn_about_the_first(self, x: np.ndarray) -> bool:
        """Whether all vertices are fixed in a frame about the first vertex, which rotates as one of the bodies or not
        at all."""
        still = np.broadcast_to(np.eye(3), (self.n_t, 3, 3))
        for R in (still, *self.rotations[: self.n_b]):
            local = self._components(R, x[:, 0], x)
            if np.abs(local - local[:1]).max() <= self.tolerance:
                self.rotations.append(R)
                self.origins.append(x[:, 0])
                self._add_vertices(local.mean(axis=0), "part", len(self.rotations) - 1)
                return True
        return False

    @staticmethod
    def _components(R: np.ndarray, origin: np.ndarray, x: np.ndarray) -> np.ndarray:
        return np.einsum("tji,tnj->tni", R, x - origin[:, None])

    def _add_vertices(self, vertices: np.ndarray, kind: str, number: int) -> None:
        self.vertices.extend(np.asarray(vertices, dtype=float))
        self.owners.extend([(kind, number)] * len(vertices))

    def arrays(self, upright: np.ndarray) -> dict[str, np.ndarray]:
        """Arrays of a `Scene`, rotated by `upright` (3, 3), without unused parts."""
        used = sorted({number for kind, number in self.owners if kind == "part"})
        parts = {k: i for i, k in enumerate(used)}
        number = {"part": parts.__getitem__, "path": lambda k: len(used) + k, "fixed": lambda k: FIXED}
        owner = np.array([number[kind](k) for kind, k in self.owners], dtype=np.int16)
        vertex = np.array(self.vertices).reshape(-1, 3)
        vertex[owner == FIXED] = vertex[owner == FIXED] @ upright.T
        quaternions = [_quaternions(upright @ self.rotations[k]) for k in used]
        origins = [self.origins[k] @ upright.T for k in used] + [x @ upright.T for x in self.paths]
        empty = np.zeros((self.n_t, 0, 3))
        return {
            "rotation": np.stack(quaternions, axis=1) if used else np.zeros((self.n_t, 0, 4)),
            "position": np.stack(origins, axis=1) if origins else empty,
            "vertex": vertex,
            "owner": owner,
        }


def _quaternions(R: np.ndarray) -> np.ndarray:
    # Quaternions of rotation matrices (F, 3, 3), with signs such that consecutive ones are close.
    e = Rotation.from_matrix(R).as_quat()
    turned = np.sum(e[1:] * e[:-1], axis=1) < 0
    return e * np.concatenate([[1], np.where(np.cumsum(turned) % 2, -1, 1)])[:, None]


def turned_by(t: np.ndarray, spin: np.ndarray, orientation: np.ndarray) -> np.ndarray:
    """Orientations (n_t, b, 3, 3) of bodies that rotate relative to their frames at `spin` (n_t, b, 3), each about a
    fixed axis."""
    steps = 0.5 * (spin[1:] + spin[:-1]) * np.diff(t)[:, None, None]
    angle = np.concatenate([np.zeros_like(spin[:1]), np.cumsum(steps, axis=0)])
    spun = Rotation.from_rotvec(angle.reshape(-1, 3)).as_matrix().reshape(orientation.shape)
    return orientation @ spun
