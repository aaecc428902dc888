"""Links, sites, actuators and what closes loops, as users write them, and exact numbers of a structure."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from .. import rotations
from ..rotations import Matrix
from ._joints import Joint, exact, exact_numbers


@dataclasses.dataclass(frozen=True, eq=False)
class Link:
    """A rigid link, its place in the tree, and the joints by which its parent carries it.

        Link("forearm", parent="upper arm", joints=hinge("elbow", (0, 1, 0)), position=(0, 0, -0.3), mass=1.2,
             center=(0, 0, -0.12), inertia=(0.01, 0.01, 0.001))

    **Arguments:**

    - `parent`: the name of another link; None for the ground.
    - `joints`: one, or several that follow each other, all written in the link's frame; none for a rigid connection.
    - `position` [m] and `orientation`: the link's frame in its parent's, where all joint coordinates are zero. The
        orientation is four Euler parameters (scalar last), a sequence and its angles as ("3-1-2", (a, b, c)) [rad], or
        a (3, 3) matrix whose columns are the link's axes in the parent.
    - `mass` [kg], `center` [m] of mass, `inertia` [kg m^2] about it along the link's axes: three principal moments, or
        a (3, 3) matrix. Without a mass the link is a frame that carries others.

    Numbers become parameters: `mass.forearm`, `center.forearm.z`, `inertia.forearm.xx`, `position.forearm.z`. A zero
    that is written as a number is part of the structure, costs nothing and is no parameter; `jnp.zeros(())` is one.
    """

    name: str
    parent: str | None = None
    joints: Joint | Sequence[Joint] = ()
    position: Any = (0.0, 0.0, 0.0)
    orientation: Any = None
    mass: Any = None
    center: Any = (0.0, 0.0, 0.0)
    inertia: Any = (0.0, 0.0, 0.0)


@dataclasses.dataclass(frozen=True, eq=False)
class Site:
    """A named point of a link (None: of the ground), for pictures, sensors and loops: `motion["name"]`.

    `position` [m] in the link's frame, parameters `site.name.x`; `orientation` as of `Link`, for a rigid `Loop`.
    """

    name: str
    link: str | None
    position: Any = (0.0, 0.0, 0.0)
    orientation: Any = None


@dataclasses.dataclass(frozen=True, eq=False)
class Actuator:
    """An input, `name`, that drives a joint.

        force along the joint's speeds = gear * (gain * input + offset - position_gain * length - velocity_gain * rate)

    **Arguments:** `joint`: its name; `gear`: one number for a hinge or a slider, three for a ball joint, six for a free
    one; length = gear * coordinate, of hinges and sliders; rate = gear . speeds. The other four are parameters, as
    `gain.name`; a servo of stiffness k has `gain=k, position_gain=k`.
    """

    name: str
    joint: str
    gear: Any = 1.0
    gain: Any = 1.0
    offset: Any = 0.0
    position_gain: Any = 0.0
    velocity_gain: Any = 0.0


@dataclasses.dataclass(frozen=True, eq=False)
class Loop:
    """Two sites that are in one place: what closes a loop; `rigid`, with one orientation too, and not half a turn away.

    Those of the three (six) residuals count that are independent of each other at trial coordinates; of a loop in a
    plane two (three).
    """

    first: str
    second: str
    rigid: bool = False


@dataclasses.dataclass(frozen=True, eq=False)
class Coupling:
    """A joint that follows another, as gears do: first = c0 + c1 * second + c2 * second^2 + ...

    Names of hinges or sliders, and exact numbers; without `second` the joint is held at c0.
    """

    first: str
    second: str | None = None
    coefficients: Sequence[float] = (0.0, 1.0)


def matrix_of(orientation: Any, name: str) -> Matrix | None:
    """[R] (components in the parent -> components here) as exact floats; None for no rotation.

    **Raises:** `ValueError` for what is no rotation.
    """
    if orientation is None:
        return None
    exact_numbers([x for x in jax.tree.leaves(orientation) if not isinstance(x, str)], f"The orientation of {name!r}")
    try:
        if len(orientation) == 2 and isinstance(orientation[0], str):
            R = np.array(_numpy_sequence(*orientation))
        elif np.shape(orientation) == (4,):
            e = np.asarray(orientation, float)
            R = np.array(rotations.euler_parameters_matrix([float(x) for x in e / np.linalg.norm(e)]))
        else:
            R = np.asarray(orientation, float).T  # columns are the axes
    except (TypeError, ValueError) as error:
        raise ValueError(_no_rotation(orientation, name)) from error
    if R.shape != (3, 3) or not (np.abs(R @ R.T - np.eye(3)).max() < 1e-6 and np.linalg.det(R) > 0):
        raise ValueError(_no_rotation(orientation, name))
    R = np.array([[exact(x) for x in row] for row in _nearest_rotation(R)])
    return None if np.array_equal(R, np.eye(3)) else tuple(tuple(float(x) for x in row) for row in R)  # type: ignore


def _numpy_sequence(sequence: str, angles: Sequence[float]) -> np.ndarray:
    R = np.eye(3)
    for axis, angle in zip(rotations.axes_of(sequence), angles, strict=True):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turn = np.eye(3)
        turn[i, i] = turn[j, j] = np.cos(angle)
        turn[i, j], turn[j, i] = np.sin(angle), -np.sin(angle)
        R = turn @ R
    return R


def _nearest_rotation(R: np.ndarray) -> np.ndarray:
    U, _, Vt = np.linalg.svd(R)
    nearest = U @ Vt
    return R if np.abs(nearest - R).max() < 1e-15 else nearest


def _no_rotation(given: Any, name: str) -> str:
    return (
        f"{name!r}: the orientation is four Euler parameters (scalar last), a sequence with its angles as "
        f'("3-1-2", (a, b, c)), or a (3, 3) rotation matrix; got {given!r}.'
    )
