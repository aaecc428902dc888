"""The equations of motion as a matrix times the bodies' parameters, in which they are linear. Knows no data."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from ..._description.system import System
from ..._method.body_parts import Bodies
from ..._method.checks import check_system
from ..._method.equations import InputValues
from ..._method.values import as_array, check_time, checked_values, refuse_incomplete
from .columns import Names, Regressor, chosen_of, regressor_at, values_by_name
from .linearity import check_linear


def regressor(
    system: System,
    t: Any,
    q: Any,
    u: Any,
    u_dot: Any,
    inputs: InputValues = None,
    *,
    bodies: Bodies = None,
    parameters: Names = (),
) -> Regressor:
    """The equations of motion as a matrix Y times the parameters pi of rigid bodies, in which they are linear.

        Y(t, q, u, u_dot) pi = tau

    A body has ten: its mass `m`, its first moment `mx`, `my`, `mz` (mass times the place of its centre) and its inertia
    `Ixx`, `Iyy`, `Izz`, `Ixy`, `Ixz`, `Iyz` (products as matrix entries), along the axes of its frame and about the
    point of its frame from which its mass centre was built, as a joint; where there is none, the mass centre. Inertia
    and weight are in Y: Y pi = -F*_r - (weights). All other loads are tau, on the right: torques, springs, friction,
    and the inertia and weight of bodies that are not named. (Atkeson, An and Hollerbach 1986; Khalil and Dombre 2002.)

    **Arguments:**

    - `system`, `t`, `q`, `u`, `inputs`: as of `equations_of_motion`. `u_dot` (n,): accelerations of the independent
        speeds, those of the motion or any others.
    - `bodies`: names of those whose parameters are columns; by default all that have a mass. Or a dict that says which
        of a body's parameters are: {"link2": ("m", "my", "Izz")}; the others have the system's values. A particle has
        its mass alone; an axisymmetric body that spins in its frame has its mass, the first moment along the axis, and
        two moments of inertia, along the axis and across it (`Iacross`).
    - `parameters`: names, paths or functions to leaves of other parameters in which the equations are linear, as those
        of dampers, springs, dry friction and rotors: columns too. What they do is not in tau any more.

    **Returns:** a `Regressor`, under `jax.vmap` with leading axes. It is differentiable, and traced where its arguments
    are. In the motion, and at the system's own values, Y pi - tau is zero; at other accelerations it is -(F_r + F*_r).

    **Raises:** `ValueError` as `equations_of_motion`; for names that are none; for a parameter in which the equations
    are not linear, or which belongs to a body of its own columns; where loads that are no weight at a body's mass
    centre depend on its mass or inertia, so that tau would too.
    """
    chosen = chosen_of(system, bodies, parameters)
    name = type(system).__name__
    refuse_incomplete(system, q, u)
    q = as_array(q, system.coordinates, f"{name}: q")
    u = as_array(u, system.speeds, f"{name}: u")
    u_dot = as_array(u_dot, system.speeds, f"{name}: u_dot").astype(q.dtype)
    check_time(name, t)
    t = jnp.asarray(t, q.dtype)
    checked_values(system, inputs)
    given = {name: jnp.asarray((inputs or {}).get(name, 0.0), q.dtype) for name in values_by_name(system)}
    check_system(system, t, q)
    check_linear(chosen, t, q)
    return regressor_at(chosen, t, q, u, given, u_dot)[0]
