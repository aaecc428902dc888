"""A motion as rigid parts that move and lines that are fixed in them. Knows numbers; knows no system and no page.

Only the parts' places and orientations are kept over time; a vertex of a line is kept once, in the part that carries
it. That is what makes a page small.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from ._view import View

FIXED = -1  # the owner of what stands still


@dataclasses.dataclass(frozen=True)
class Shape:
    """A run of `count` vertices from the `first`, and how they are drawn (see `Element`)."""

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
    """All that a page or a GIF needs, z upwards.

    - `t` (F,) [s]; `rotation` (F, R, 4): unit quaternions, scalar last, of the first R parts; `position` (F, P, 3) [m]
        of all parts. The parts after R are points.
    - `vertex` (V, 3) [m] in the part `owner` (V,), or in N where that is -1.
    - `leader` (F, 3): the mass centre of the whole, which the camera may follow.
    - `ground`: height of the ground [m], or None.
    """

    t: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    vertex: np.ndarray
    owner: np.ndarray
    shapes: Sequence[Shape]
    leader: np.ndarray
    ground: float | None
    view: View
    title: str
    name: str

    def at(self, t: Any) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (n, V, 3) and the leader (n, 3) at times (n,), interpolated."""
        t = np.clip(np.atleast_1d(t), self.t[0], self.t[-1])
        i = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 2)
        s = ((t - self.t[i]) / (self.t[i + 1] - self.t[i]))[:, None, None]
        position = (1.0 - s) * self.position[i] + s * self.position[i + 1]
        leader = (1.0 - s[:, 0]) * self.leader[i] + s[:, 0] * self.leader[i + 1]
        x = np.broadcast_to(self.vertex, (len(t), *self.vertex.shape)).copy()
        for k in range(self.position.shape[1]):
            mine = self.owner == k
            if k < self.rotation.shape[1] and mine.any():
                R = Slerp(self.t, Rotation.from_quat(self.rotation[:, k]))(t).as_matrix()
                x[:, mine] = np.einsum("nij,vj->nvi", R, self.vertex[mine])
            x[:, mine] += position[:, k, None]
        return x, leader
