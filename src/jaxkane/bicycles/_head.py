"""A frame that gives way in torsion at the steering head. Knows one joint."""

from __future__ import annotations

from typing import Any

from .._description.frames import Frame
from .._description.loads import Torque
from .._description.parameters import parameter
from .._description.points import Point
from .._scalars.types import Scalar
from ..catalog.bicycle import FAR
from ._part import Part


class HeadTwist(Part):
    """Torsion of the frame at the steering head: one joint with a spring and a damper, before the steer axis.

    The front assembly turns by "head_twist" [rad] about an axis through the steer axis, across it and in the plane of
    the frame, as in Sharp and Alstead (1980), *The influence of structural flexibilities on the straight-running
    stability of motorcycles*.

    **Arguments:** `stiffness` [N m/rad], `damping` [N m s/rad]; `height` [m] of the axis of torsion, upwards along the
    steer axis from its point that is nearest to the rear wheel's centre.
    """

    stiffness: Scalar = parameter(positive=True, unit="N m/rad")
    damping: Scalar = parameter(0.0, unit="N m s/rad")
    height: Scalar = parameter(0.0, within=(-FAR, FAR), unit="m")

    coordinates = ("head_twist",)
    speeds = ("head_twist_rate",)
    units = {"head_twist": "rad", "head_twist_rate": "rad/s"}

    def check(self, bicycle):
        if bicycle.head is not self:
            raise ValueError("A HeadTwist stands between frame and fork: with_parts(head=HeadTwist(...)).")

    def turned(self, tilted: Frame, S: Point, q: Any, u: Any) -> tuple[Frame, Point]:
        """The frame along the steer axis and the point on it, as they carry the front assembly."""
        axis = S.fixed(-self.height * tilted.z)
        twisted = tilted.rotate(1, q["head_twist"], u["head_twist_rate"], "head")
        return twisted, axis.fixed(self.height * twisted.z)

    def motion(self, bicycle, motion, t, q, u):
        return motion.extended(frames={"head": motion["C"].parent})

    def loads(self, bicycle, t, q, u, motion, values):
        torque = -self.stiffness * q["head_twist"] - self.damping * u["head_twist_rate"]
        head = motion["head"]
        return Torque(torque * head.x, head, reaction_on=motion["B"])
