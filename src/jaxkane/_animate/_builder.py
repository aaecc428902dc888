"""Gathers the parts, vertices and shapes of a scene over its instants. Knows numbers; knows no system and no page."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ._scene import FIXED, Shape

_SAME = 1e-6  # relative to the size of the scene: what moves less stands still


class Builder:
    """Gathers parts, vertices and shapes over F instants."""

    def __init__(self, orientation: np.ndarray, place: np.ndarray, turned: np.ndarray, scale: float):
        self.n_t = len(place)
        # Far from the origin, and in single precision above all, nothing stands perfectly still.
        self.tolerance = _SAME * scale + 16.0 * float(np.finfo(place.dtype).eps) * float(np.abs(place).max(initial=0.0))
        # Bodies whose frames do not spin with them come twice: as their frame, and turned.
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
        """A shape of the `count` vertices that were added last."""
        self.shapes.append(Shape(kind, color, len(self.vertices) - count, count, **style))

    def local(self, vertices: np.ndarray, body: int) -> None:
        """Vertices (n, 3) that are fixed in a body, and turn with it."""
        for x in vertices:
            self._keep(x, "part", self.turned[body])

    def moving(self, x: np.ndarray, body: int | None = None) -> None:
        """Vertices (F, n, 3) in N, kept in the part in which they do not move.

        `body` says which part they are to turn with; they are given as if it did not spin.
        """
        if body is not None:
            self.local(self._seen_from(self.rotations[body], self.origins[body], x).mean(axis=0), body)
            return
        if np.abs(x - x[:1]).max() <= self.tolerance:
            for vertex in x.mean(axis=0):
                self._keep(vertex, "fixed", FIXED)
            return
        for k, (R, origin) in enumerate(zip(self.rotations, self.origins, strict=True)):
            seen = self._seen_from(R, origin, x)
            if np.abs(seen - seen[:1]).max() <= self.tolerance:
                for vertex in seen.mean(axis=0):
                    self._keep(vertex, "part", k)
                return
        if x.shape[1] == 1:
            self._keep(np.zeros(3), "path", self._path(x[:, 0]))
        elif not self._turn_about_the_first(x):
            for i in range(x.shape[1]):
                self.moving(x[:, i : i + 1])

    def _turn_about_the_first(self, x: np.ndarray) -> bool:
        """Whether all vertices are fixed in a frame that turns as one of the bodies, or not at all, about the first."""
        still = np.broadcast_to(np.eye(3), (self.n_t, 3, 3))
        for R in (still, *self.rotations[: self.n_b]):
            seen = self._seen_from(R, x[:, 0], x)
            if np.abs(seen - seen[:1]).max() <= self.tolerance:
                self.rotations.append(R)
                self.origins.append(x[:, 0])
                for vertex in seen.mean(axis=0):
                    self._keep(vertex, "part", len(self.rotations) - 1)
                return True
        return False

    @staticmethod
    def _seen_from(R: np.ndarray, origin: np.ndarray, x: np.ndarray) -> np.ndarray:
        return np.einsum("tji,tnj->tni", R, x - origin[:, None])

    def _path(self, x: np.ndarray) -> int:
        for k, known in enumerate(self.paths):
            if np.abs(known - x).max() <= self.tolerance:
                return k
        self.paths.append(x)
        return len(self.paths) - 1

    def _keep(self, vertex: np.ndarray, kind: str, number: int) -> None:
        self.vertices.append(np.asarray(vertex, dtype=float))
        self.owners.append((kind, number))

    def arrays(self, upright: np.ndarray) -> dict[str, np.ndarray]:
        """Arrays of a `Scene`, turned by `upright` (3, 3), parts that own nothing left out."""
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
    """Of rotation matrices (F, 3, 3), the signs such that neighbours are close."""
    e = Rotation.from_matrix(R).as_quat()
    turned = np.sum(e[1:] * e[:-1], axis=1) < 0
    return e * np.concatenate([[1], np.where(np.cumsum(turned) % 2, -1, 1)])[:, None]


def turned_by(t: np.ndarray, spin: np.ndarray, orientation: np.ndarray) -> np.ndarray:
    """Orientations (n_t, b, 3, 3) of bodies that spin in them at `spin` (n_t, b, 3), each about a fixed axis."""
    steps = 0.5 * (spin[1:] + spin[:-1]) * np.diff(t)[:, None, None]
    angle = np.concatenate([np.zeros_like(spin[:1]), np.cumsum(steps, axis=0)])
    spun = Rotation.from_rotvec(angle.reshape(-1, 3)).as_matrix().reshape(orientation.shape)
    return orientation @ spun
