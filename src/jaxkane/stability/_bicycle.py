"""Riding straight ahead, and the canonical matrices of a bicycle."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._kane.api import equations_of_motion
from .._kane.arguments import is_concrete, is_one_number
from .._scalarjit.components import Component
from .._scalarjit.nan import nan_where
from .._system.parameters import text_of, wrapped
from .._system.system import State
from ..catalog import WhippleBicycle
from ._steady import SteadyMotion, jacobian, steady_turn


def straight_ahead(bicycle: WhippleBicycle, speed: Component) -> State | SteadyMotion:
    """The motion of a bicycle that rolls straight ahead and upright at `speed` [m/s], on a slope along x.

    If the bicycle `needs_trim` (drag, rolling resistance or a slope), this is a `steady_turn`. Its "drive_torque" keeps
    the rate of the rear wheel at -speed / rR.

    **Arguments:**

    - `bicycle`: the bicycle.
    - `speed`: the forward speed [m/s].

    **Returns:** a `State`, or a `SteadyMotion` if the bicycle `needs_trim`.

    **Raises:** `ValueError` for a speed that is not finite, a bicycle with a prescribed speed, a road of given height,
    and if the motion does not exist.
    """
    if getattr(getattr(bicycle, "road", None), "curved", False):
        raise ValueError(
            f"{type(bicycle).__name__}: a motion along a Road of given height is not steady, not even on a constant "
            "grade, because coordinates depend on the position. For a constant grade use Slope(angle). The linear "
            "model at one instant is linearize(bicycle, state, inputs, states=bicycle.lateral, steady=False)."
        )
    if "rear_wheel_rate" not in bicycle.speeds:
        raise ValueError(
            f"{type(bicycle).__name__}: riding straight ahead needs rear_wheel_rate as an independent speed; the "
            f"independent speeds are {', '.join(bicycle.speeds)}. If a part prescribes the speed, remove it with "
            "bicycle.with_parts(drive=None): the necessary drive torque is computed."
        )
    if not is_one_number(speed) or (is_concrete(speed) and not np.isfinite(speed)):
        raise ValueError(
            f"straight_ahead({type(bicycle).__name__}): the speed must be one finite number [m/s], got {speed!r}."
        )
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

    Attributes:

    - `M`, `C1`, `K0`, `K2` (2, 2): as in Meijaard et al. (2007), eq. (5.3).
    - `C0` (2, 2): the steer damper's matrix.
    """

    M: Float[Array, "2 2"]
    C1: Float[Array, "2 2"]
    K0: Float[Array, "2 2"]
    K2: Float[Array, "2 2"]
    C0: Float[Array, "2 2"]

    def __repr__(self) -> str:
        units = {"M": "kg m^2", "C1": "kg m", "K0": "kg m", "K2": "kg", "C0": "N m s/rad"}
        items = [f"{name}={text_of(getattr(self, name), unit, ndim=2)}" for name, unit in units.items()]
        return "\n".join(["Canonical", *map(wrapped, items)])


def canonical(bicycle: WhippleBicycle) -> Canonical:
    """The canonical matrices of a bicycle, from the derivatives of its nonlinear equations M u_dot = f.

    -df/dx_dot is linear and -df/dx is quadratic in the speed. Their values at -1, 0 and 1 m/s therefore give the
    matrices without a truncation error. At the upright state, pitch does not change with roll and steer to first order.

    **Raises:** `ValueError` for a bicycle with more speeds or with states, and for one whose equations have other
    terms, e.g. gains that depend on the speed. Under a trace the matrices are NaN instead.
    """
    name = type(bicycle).__name__
    if bicycle.states or bicycle.speeds != WhippleBicycle.speeds:
        raise ValueError(
            f"canonical: {name} has the speeds and states {', '.join((*bicycle.speeds, *bicycle.states))}, but the "
            "canonical equations contain only roll and steer. Use jaxkane.stability.linearize."
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
    # zero if the equations have only these terms
    off = jnp.stack([K[3] - K[1] - 4 * K2, C[3] - C[1] - 2 * C1, C[2] - C[1] - C1, K[2] - K[0]])
    has_other_terms = ~(
        jnp.max(jnp.abs(off)) < jnp.finfo(K.dtype).eps ** 0.5 * jnp.max(jnp.abs(jnp.stack([K[3], C[3]])))
    )
    if is_concrete(has_other_terms) and has_other_terms:
        raise ValueError(
            f"canonical: the equations of {name} contain terms of the speed other than C0 + v C1 and K0 + v^2 K2. Use "
            "jaxkane.stability.linearize at one speed."
        )
    matrices = (M[np.ix_(lateral, lateral)], C1, K[1] / bicycle.g, K2, C[1])
    return Canonical(*(nan_where(has_other_terms, each, bicycle) for each in matrices))
