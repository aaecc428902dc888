"""The kinematics of a bicycle and of its contacts with the ground. Independent of loads."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp

from .._scalarjit.components import Component, add
from .._system.kinematics import Frame, Point, Vector, inertial
from .._system.motion import Body
from .._system.system import NamedVector
from ._part import BicycleLike, BicycleMotion, Contact
from ._tyre import Tyre, rolling_speed

REAR, FRONT = "rear", "front"


def bicycle_motion(bicycle: BicycleLike, q: NamedVector, u: NamedVector) -> BicycleMotion:
    """Bodies, contacts and velocity residuals of a `Bicycle`, without its parts."""
    N, O = inertial()
    forward, contact_aside = contact_rates(bicycle, q, u)
    T = bicycle.road.tangent(
        N, q["x"], q["y"], lambda: bicycle.road.rates(q["x"], q["y"], q["yaw"], forward, contact_aside)
    )
    Y = T.rotate(3, q["yaw"], u["yaw_rate"], "Y")
    R = Y.rotate(1, q["roll"], u["roll_rate"], "R")
    B = R.rotate(2, q["pitch"], u["pitch_rate"], "B")  # rear frame
    tilted = B.rotate(2, bicycle.lam, 0.0, "tilt")

    xS, zS = bicycle.steer_point
    omega_A = B.angular_velocity + u["rear_wheel_rate"] * B.y
    along, across = _slip(bicycle, REAR, u)
    place = q["x"] * N.x + q["y"] * N.y
    if bicycle.road.curved:
        place = place - q["rear_height"] * N.z
    r_P_A = -bicycle.rear_tyre.reach(R.z, T.z, bicycle.rR)
    P = Point(Y.vector(along, across, 0.0), O, place)  # point of the tyre
    G_A = Point(P.velocity + omega_A.cross(r_P_A), P, r_P_A)
    G_B = G_A.fixed(bicycle.xB * B.x + (bicycle.zB + bicycle.rR) * B.z)
    S = G_A.fixed(xS * B.x + (zS + bicycle.rR) * B.z)
    if bicycle.head is not None:
        tilted, S = bicycle.head.turned(tilted, S, q, u)
    C = tilted.rotate(3, q["steer"], u["steer_rate"], "C")  # fork, 3 along the steer axis
    H = C.rotate(2, -bicycle.lam, 0.0, "H")  # fork, aligned with B at zero steer

    def from_S(x, z):  # measured from P of the upright bicycle, as a vector fixed in the fork
        return ((x - xS) * H.x + (z - zS) * H.z).express(C)

    G_C = S.fixed(from_S(bicycle.xH, bicycle.zH))
    G_D = S.fixed(from_S(bicycle.w, -bicycle.rF))
    omega_D = C.angular_velocity + u["front_wheel_rate"] * C.y
    normal = bicycle.road.normal(N, *_front_place(bicycle, q))
    n1, _, n3 = normal.components_in(C)
    down = C.vector(n1, 0.0, n3).normalize()  # in the plane of the front wheel
    r_D_Q = bicycle.front_tyre.reach(down, normal, bicycle.rF)
    Q = Point(G_D.velocity + omega_D.cross(r_D_Q), G_D, r_D_Q)

    bodies = bicycle.bodies((G_A, G_B, G_C, G_D), (R, B, H, C), omega_A, omega_D)
    frames = {"Y": Y, "B": B, "C": C, "H": H}
    motion = BicycleMotion(bodies, points={"P": P, "Q": Q, "S": S}, frames=frames)
    motion.rear = Contact(P, Y.x, Y.y, T.z, R.z, q["roll"], forward, (along, across))
    motion.front, residuals = _front_contact(bicycle, Q, C, down, normal, q, u)
    return motion.extended((), residuals)


def _front_place(bicycle: BicycleLike, q: NamedVector) -> tuple[Component, Component]:
    return (q["front_x"], q["front_y"]) if bicycle.road.curved else (0.0, 0.0)


def _slip(bicycle: BicycleLike, end: str, u: NamedVector) -> tuple[Component, Component]:
    """Velocities of a tyre's contact, along the heading and across it [m/s]; exactly zero in rolling."""
    tyre = bicycle.rear_tyre if end == REAR else bicycle.front_tyre
    along = 0.0 if tyre.longitudinal is None else u[f"{end}_longitudinal_slip"]
    return along, 0.0 if tyre.lateral is None else u[f"{end}_lateral_slip"]


def contact_rates(bicycle: BicycleLike, q: NamedVector, u: NamedVector) -> tuple[Component, Component]:
    """Velocities of the position of the rear contact on the ground, forward and to the right [m/s].

    For a torus with the crown radius c that rolls without slip: -(spin) (r - c + c cos(roll)) and c * roll_rate.
    """
    tyre, (along, across) = bicycle.rear_tyre, _slip(bicycle, REAR, u)
    spin = u["rear_wheel_rate"] + u["pitch_rate"]
    forward = rolling_speed(tyre, spin, jnp.cos(q["roll"]), bicycle.rR, along)
    return forward, across if tyre.crown is None else add(across, tyre.crown * u["roll_rate"])


def _front_contact(
    bicycle: BicycleLike, Q: Point, C: Frame, down: Vector, normal: Vector, q: NamedVector, u: NamedVector
) -> tuple[Contact, list[Any]]:
    """The front contact and its velocity residuals [m/s].

    The heading is the intersection of the wheel's plane and the ground. The normal n changes, and the fork has the
    angular velocity omega. The wheel's spin relative to its contact is then front_wheel_rate + (omega . across -
    heading . n_dot) / cos(camber). The rate of the camber is omega . heading + (axle . n_dot) / cos(camber).
    """
    tyre, slip = bicycle.front_tyre, _slip(bicycle, FRONT, u)
    heading = C.y.cross(normal).normalize()
    across = normal.cross(heading)
    sin_camber, cos_camber = C.y.dot(normal), down.dot(normal)
    spin = u["front_wheel_rate"] + C.angular_velocity.dot(across) / cos_camber
    if not bicycle.road.curved:
        speed = rolling_speed(tyre, spin, cos_camber, bicycle.rF, slip[0])
        contact = Contact(Q, heading, across, normal, down, jnp.arctan2(sin_camber, cos_camber), speed, slip)
        return contact, tyre.residuals(contact)
    at = (u["front_x_rate"], u["front_y_rate"])
    turning = bicycle.road.normal_rate(C.root, q["front_x"], q["front_y"], at)
    speed = rolling_speed(tyre, spin - turning.dot(heading) / cos_camber, cos_camber, bicycle.rF, slip[0])
    aside = slip[1]
    if tyre.crown is not None:
        aside = aside + tyre.crown * (C.angular_velocity.dot(heading) + turning.dot(C.y) / cos_camber)
    contact = Contact(Q, heading, across, normal, down, jnp.arctan2(sin_camber, cos_camber), speed, slip)
    moved = bicycle.road.velocity(C.root, q["front_x"], q["front_y"], at)
    return contact, [*tyre.residuals(contact), moved.dot(heading) - speed, moved.dot(across) - aside]


def wheels(bicycle: BicycleLike, motion: BicycleMotion) -> Iterator[tuple[str, Tyre, Contact, Body, Component]]:
    yield REAR, bicycle.rear_tyre, motion.rear, motion["rear wheel"], bicycle.rR
    yield FRONT, bicycle.front_tyre, motion.front, motion["front wheel"], bicycle.rF


def off_road(bicycle: BicycleLike, motion: BicycleMotion, q: NamedVector) -> list[Component]:
    """The distances of the contacts from the ground [m]."""
    Q, N = motion["Q"].position, motion.N
    if not bicycle.road.curved:
        return [Q.dot(N.z)]
    front = Q - bicycle.road.place(N, *_front_place(bicycle, q))
    return [*(front.dot(axis) for axis in (N.x, N.y, N.z)), q["rear_height"] - bicycle.road.at(q["x"], q["y"])]


def clearance(bicycle: BicycleLike, motion: BicycleMotion) -> Component:
    """The smaller clearance of both wheels, see `Road.clearance`."""
    room = [
        bicycle.road.clearance(motion.N, contact, wheel.center, radius, tyre.crown)
        for _, tyre, contact, wheel, radius in wheels(bicycle, motion)
    ]
    return jnp.minimum(*room)
