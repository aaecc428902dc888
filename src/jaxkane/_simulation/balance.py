"""Energy, work, momenta and residuals along a motion. Knows the method and trajectories; judges nothing."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._description.loads import Force
from .._description.motion import Motion, kinetic_energy_of
from .._description.points import Point
from .._description.vectors import Vector
from .._method.description_facts import configuration_residual
from .._method.rates import accelerations_and_mass_matrix
from .._method.reactions import Reactions
from .._scalars.components import ZERO3, add3, cross, dot, matvec
from .._scalars.fuse import fused
from .._scalars.linear import as_vector, stack
from .._scalars.types import Triple
from .._scalars.versions import compiled

ORDERS = (8, 6)  # points under the polynomials whose integrals are the work, and its estimated error


@compiled
def measured_along(system, t, q, u, inputs):
    def measured(t, q, u, inputs):
        u_dot, M = accelerations_and_mass_matrix(system, t, q, u, inputs)
        return {**_measured(system, t, q, u, inputs, u_dot), "M": M}

    return jax.vmap(measured)(t, q, u, inputs)


@fused
def _measured(system, t, q, u, inputs, u_dot):
    now = Reactions(system, t, q, u, inputs, u_dot)
    motion, places = now.description, _Places()
    loads = now.loads(motion)
    centers = [body.center for body in motion.bodies if body.center.has_position]
    at_centers = [load if isinstance(load, Force) and load.point in centers else None for load in loads]
    p, H = _momenta(motion, places)
    return {
        "T": as_vector([kinetic_energy_of(motion)], q)[0],
        "power": as_vector([load.vector.dot(load.velocity) for load in loads], q),
        "force": [load and as_vector(_in_N(load.vector), q) for load in at_centers],
        "place": [load and as_vector(places.of(load.point), q) for load in at_centers],
        "prescribed": as_vector([now.power_of_prescribed_motions()], q)[0],
        "p": as_vector(p, q),
        "H": as_vector(H, q),
        "h": configuration_residual(system, t, q),
        "c": as_vector(now.residuals(now.t, now.q, now.u_all), q),
        "C": stack([(*a, *b) for a, b in zip(now.C_ind, now.C_dep, strict=True)]).astype(q.dtype),
    }


def _in_N(vector: Vector) -> Triple:
    """Components in N, by those of N's unit vectors, which remember every frame that they were resolved in.

    A vector that is resolved itself passes all frames of its chain, and with all of them the work is of order n^2.
    """
    N, frame = vector.frame.root, vector.frame
    return tuple(dot(axis.components_in(frame), vector.components) for axis in (N.x, N.y, N.z))  # type: ignore[return-value]


class _Places:
    """Positions in N, each from that of the point it was made from."""

    def __init__(self) -> None:
        self._known: dict[Point, Triple] = {}

    def of(self, point: Point) -> Triple:
        chain = []
        while point is not None and point not in self._known:
            chain.append(point)
            point = point._base  # type: ignore[assignment]
        place = ZERO3 if point is None else self._known[point]
        for point in reversed(chain):
            place = self._known[point] = add3(place, _in_N(point._offset))  # type: ignore[arg-type]
        return place


def _momenta(motion: Motion, places: _Places) -> tuple[Triple, Triple]:
    """Linear momentum, and angular momentum about the origin, in N."""
    p, H = ZERO3, ZERO3
    for body in motion.bodies:
        mv = _in_N(body.mass * body.center.velocity)
        spin = body.frame.vector(*matvec(body.inertia, body.angular_velocity.components_in(body.frame)))
        orbital = cross(places.of(body.center), mv) if body.center.has_position else (jnp.nan, jnp.nan, jnp.nan)
        p, H = add3(p, mv), add3(H, add3(_in_N(spin), orbital))
    return p, H


def work_of(t: np.ndarray, now: dict[str, Any]) -> tuple[np.ndarray, float]:
    """Work (n_t,) of all loads and prescribed motions, and an estimate of its error."""
    work = np.zeros_like(t)
    power = now["prescribed"].copy()
    for i, (F, r) in enumerate(zip(now["force"], now["place"], strict=True)):
        if F is not None and np.ptp(F, axis=0).max() <= 1e-14 * np.abs(F).max():
            work += (r - r[0]) @ F[0]
        else:
            power += now["power"][:, i]
    fine, coarse = (_cumulative_integral(t, power, order) for order in ORDERS)
    return work + fine, float(np.abs(fine - coarse).max())


def _cumulative_integral(t: np.ndarray, x: np.ndarray, points: int) -> np.ndarray:
    """The integral (n,) of samples x (n,) from t[0], by a polynomial through the nearest `points` of each interval."""
    n = len(t)
    m = min(points, n)
    first = np.clip(np.arange(n - 1) - (m - 2) // 2, 0, n - m)
    places = first[:, None] + np.arange(m)  # (n-1, m)
    middle, half = 0.5 * (t[1:] + t[:-1]), 0.5 * np.diff(t)
    s = (t[places] - middle[:, None]) / half[:, None]  # the interval is -1 .. 1
    powers = s[:, None, :] ** np.arange(m)[:, None]  # (n-1, m, m)
    moments = np.array([2 / (j + 1) if j % 2 == 0 else 0.0 for j in range(m)])
    weights = np.linalg.solve(powers, np.broadcast_to(moments[:, None], (n - 1, m, 1)))[..., 0]
    return np.concatenate([[0.0], np.cumsum(half * np.sum(weights * x[places], axis=1))])


def condition_of_masses(M: np.ndarray) -> np.ndarray:
    """Condition numbers (n_t,) of mass matrices (n_t, n, n), each speed in units in which it moves a mass of one: that
    metres stand beside radians, as of a satellite, makes nothing badly conditioned."""
    diagonal = np.sqrt(np.diagonal(M, axis1=-2, axis2=-1))
    sizes = np.where(diagonal > 0, diagonal, 1.0)
    return np.linalg.cond(M / (sizes[:, :, None] * sizes[:, None, :]))
