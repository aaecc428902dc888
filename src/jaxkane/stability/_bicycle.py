"""Riding straight ahead, and the canonical matrices of a bicycle."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._kane.arguments import is_concrete, is_one_number
from .._kane.equations import equations_of_motion
from .._scalarjit.components import Component
from .._scalarjit.nan import nan_where
from .._system.system import State
from ..catalog import WhippleBicycle
from ._steady import SteadyMotion, jacobian, steady_turn


def straight_ahead(bicycle: WhippleBicycle, speed: Component) -> State | SteadyMotion:
    """A bicycle that rolls straight ahead and upright at `speed` [m/s], on a slope along x.

    Where it `needs_trim`, as drag, rolling resistance or a slope take a drive, this is the `steady_turn` with the
    "drive_torque" that holds the rate of the rear wheel, -speed / rR.

    **Raises:** `ValueError` for a bicycle whose speed is prescribed, for one on a road of given height, and where there
    is no such motion.
    """
    if getattr(getattr(bicycle, "road", None), "curved", False):
        raise ValueError(
            f"{type(bicycle).__name__}: along a Road of given height no ride is steady, not even on one that rises "
            "evenly: coordinates follow its place. For an even grade give the bicycle a Slope(angle); the linear model "
            "at one instant of any ride is linearize(bicycle, state, inputs, states=bicycle.lateral, steady=False)."
        )
    if "rear_wheel_rate" not in bicycle.speeds:
        raise ValueError(
            f"{type(bicycle).__name__}: riding straight on at a speed needs rear_wheel_rate among the independent "
            f"speeds, which are {', '.join(bicycle.speeds)}. Where a part holds its speed, leave it out, as in "
            "bicycle.with_parts(drive=None): the torque that straight riding takes is found."
        )
    if not is_one_number(speed):
        raise TypeError(f"straight_ahead({type(bicycle).__name__}): the speed is one number [m/s], got {speed!r}.")
    v = jnp.asarray(speed, dtype=jnp.result_type(bicycle.rR))
    wheel = bicycle.speeds.index("rear_wheel_rate")
    u = jnp.zeros(len(bicycle.speeds), v.dtype).at[wheel].set(-v / bicycle.rR)
    q = jnp.zeros(len(bicycle.coordinates), v.dtype)
    if not bicycle.needs_trim:
        return State(q, u)
    upright = dict.fromkeys(("yaw", *(name for name in bicycle.lateral if name in bicycle.coordinates)), 0.0)
    return steady_turn(bicycle, q, u, hold={**upright, "rear_wheel_rate": u[wheel]}, find=("drive_torque",))


class Canonical(eqx.Module):
    """M x_ddot + (C0 + v C1) x_dot + (g K0 + v^2 K2) x = f for x = (roll, steer), f the roll and steer torques.

    Attributes: `M`, `C1`, `K0`, `K2` (2, 2) as in Meijaard et al. (2007), eq. (5.3); `C0` (2, 2): the steer damper's.
    """

    M: Float[Array, "2 2"]
    C1: Float[Array, "2 2"]
    K0: Float[Array, "2 2"]
    K2: Float[Array, "2 2"]
    C0: Float[Array, "2 2"]


def canonical(bicycle: WhippleBicycle) -> Canonical:
    """The canonical matrices of a bicycle, from the derivatives of its nonlinear equations M u_dot = f.

    -df/dx_dot is linear and -df/dx is quadratic in the speed, so that their values at speeds of -1, 0 and 1 m/s give
    their derivatives with respect to speed without an error. Pitch has no slope in roll and steer when upright.

    **Raises:** `ValueError` for a bicycle with more speeds or with states, whose equations are more than these two, and
    for one whose equations have other terms, as gains that are scheduled over speed; under a trace these are NaN.
    """
    name = type(bicycle).__name__
    if bicycle.states or bicycle.speeds != WhippleBicycle.speeds:
        raise ValueError(
            f"canonical: {name} moves by {', '.join((*bicycle.speeds, *bicycle.states))}, and has no equations in roll "
            "and steer alone; jaxkane.stability.linearize gives all of them."
        )
    lateral = np.array([0, 2])  # of (roll, rear wheel, steer), both coordinates and speeds

    def stiffness_and_damping(v):
        at = straight_ahead(bicycle, v)

        def f(x):
            q, u = at.q.at[lateral].add(x[:2]), at.u.at[lateral].add(x[2:])
            return equations_of_motion(bicycle, 0.0, q, u)[1][lateral]

        J = jacobian(f, jnp.zeros(4, at.q.dtype))
        return -J[:, :2], -J[:, 2:]

    still = straight_ahead(bicycle, 0.0)
    M, _ = equations_of_motion(bicycle, 0.0, still.q, still.u)
    K, C = jax.lax.map(stiffness_and_damping, jnp.array([-1.0, 0.0, 1.0, 2.0], still.q.dtype))
    C1, K2 = (C[2] - C[0]) / 2, (K[2] + K[0]) / 2 - K[1]
    off = jnp.stack([K[3] - K[1] - 4 * K2, C[3] - C[1] - 2 * C1, C[2] - C[1] - C1, K[2] - K[0]])  # zero of these terms
    has_other_terms = ~(
        jnp.max(jnp.abs(off)) < jnp.finfo(K.dtype).eps ** 0.5 * jnp.max(jnp.abs(jnp.stack([K[3], C[3]])))
    )
    if is_concrete(has_other_terms) and has_other_terms:
        raise ValueError(
            f"canonical: the equations of {name} hold other terms of the speed than C0 + v C1 and K0 + v^2 K2; "
            "jaxkane.stability.linearize gives them at one speed."
        )
    matrices = (M[np.ix_(lateral, lateral)], C1, K[1] / bicycle.g, K2, C[1])
    return Canonical(*(nan_where(has_other_terms, each, bicycle) for each in matrices))
