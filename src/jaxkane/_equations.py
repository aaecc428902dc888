"""The public functions of Kane's method, as arrays. Knows `Instant`, which holds the method itself."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from ._check import check_system
from ._components import add, dot, matvec, sub
from ._kane import Instant, as_row, jvp
from ._linear import stack
from ._system import System, kinetic_energy_of
from ._types import Component


def _instant(system: System, t: Component, q: Any, u: Any, inputs: Mapping[str, Component] | None = None) -> Instant:
    check_system(system, t, q, u)
    return Instant(system, t, q, u, inputs)


def equations_of_motion(
    system: System, t: Component, q: Any, u: Any, inputs: Mapping[str, Component] | None = None
) -> tuple[Float[Array, "n n"], Float[Array, " n"]]:
    """M and f of Kane's equations M u_dot = f.

    **Arguments:**

    - `system`: a `System`.
    - `t`: time [s].
    - `q` (n_q,): coordinates, consistent with the configuration constraints (see `assemble`).
    - `u` (n,): independent speeds.
    - `inputs`: numbers by name; those left out are zero.

    **Returns:** the generalized mass matrix M (n, n) and the right side f (n,).

    **Raises:** `ValueError` for wrong shapes, unknown inputs, or as many residuals as there are not dependent speeds.
    """
    M, f = _instant(system, t, q, u, inputs).equations()
    return stack(M), stack([f])[0]


def accelerations(
    system: System, t: Component, q: Any, u: Any, inputs: Mapping[str, Component] | None = None
) -> Float[Array, " n"]:
    """u_dot (n,): time derivatives of the independent speeds, M^-1 f. Arguments as `equations_of_motion`."""
    return stack([_instant(system, t, q, u, inputs).accelerations()])[0]


def mass_matrix(
    system: System, t: Component, q: Any, u: Any, inputs: Mapping[str, Component] | None = None
) -> Float[Array, "n n"]:
    """M (n, n), the generalized mass matrix of the independent speeds. Arguments as `equations_of_motion`."""
    return equations_of_motion(system, t, q, u, inputs)[0]


def forcing(
    system: System, t: Component, q: Any, u: Any, inputs: Mapping[str, Component] | None = None
) -> Float[Array, " n"]:
    """f (n,), the right side of M u_dot = f. Arguments as `equations_of_motion`."""
    return equations_of_motion(system, t, q, u, inputs)[1]


def partial_velocities(
    system: System, t: Component, q: Any, u: Any, inputs: Mapping[str, Component] | None = None
) -> tuple[Float[Array, "b 3 n"], Float[Array, "b 3 n"]]:
    """V and W, each (b, 3, n): partial velocities of the mass centres and partial angular velocities of the b bodies.

    Components are in N. The dependent speeds are eliminated: the columns belong to the n independent speeds.
    Arguments as `equations_of_motion`.
    """
    now = _instant(system, t, q, u, inputs)
    motion, partials = now.motion(now.t, now.q, now.u_all), now.partials()
    V, W = [], []
    for i, body in enumerate(motion.bodies):
        for columns, j, frame in ((V, 0, body.center.velocity.frame), (W, 1, body.frame)):
            vectors = [frame.vector(*bodies[i][j]).components_in(motion.N) for bodies, _ in partials]
            columns.append(stack(vectors).T)
    return jnp.stack(V), jnp.stack(W)


def generalized_active_forces(
    system: System, t: Component, q: Any, u: Any, inputs: Mapping[str, Component] | None = None
) -> Float[Array, " n"]:
    """F_r (n,) = sum of F . V_r + T . W_r over the loads. Arguments as `equations_of_motion`."""
    now = _instant(system, t, q, u, inputs)
    return stack([now.active_forces(now.motion(now.t, now.q, now.u_all), now.partials())])[0]


def generalized_inertia_forces(
    system: System,
    t: Component,
    q: Any,
    u: Any,
    inputs: Mapping[str, Component] | None = None,
    *,
    u_dot: Any = None,
) -> Float[Array, " n"]:
    """F*_r (n,) = -sum of V_r . dp/dt + W_r . dH/dt over the bodies, at accelerations `u_dot` (n,), by default zero.

    With `u_dot=accelerations(...)` the sum with `generalized_active_forces` vanishes: Kane's equations.
    Arguments as `equations_of_motion`.
    """
    now = _instant(system, t, q, u, inputs)
    motion, partials = now.motion(now.t, now.q, now.u_all), now.partials()
    Fr_star = now.inertia_forces(motion, partials)
    if u_dot is not None:
        u_dot = as_row(u_dot, system.speeds, f"{now.name}: u_dot")
        Fr_star = [sub(x, y) for x, y in zip(Fr_star, matvec(now.mass_matrix(motion, partials), u_dot), strict=True)]
    return stack([Fr_star])[0]


def dependent_speeds(system: System, t: Component, q: Any, u: Any) -> Float[Array, " k"]:
    """u_dep (k,), from the velocity residuals: C_dep u_dep = -(C_ind u + c0)."""
    return stack([_instant(system, t, q, u).u_dep])[0]


def dependent_accelerations(
    system: System, t: Component, q: Any, u: Any, inputs: Mapping[str, Component] | None = None
) -> Float[Array, " k"]:
    """u_dep_dot (k,) = J u_dot - C_dep^-1 (dc/dt at frozen speeds). Arguments as `equations_of_motion`."""
    now = _instant(system, t, q, u, inputs)
    u_dot = now.accelerations()
    return stack([[add(dot(row, u_dot), b) for row, b in zip(zip(*now.J, strict=True), now.bias(), strict=True)]])[0]


def constraint_jacobian(system: System, t: Component, q: Any) -> Float[Array, "k n"]:
    """J (k, n) = -C_dep^-1 C_ind: u_dep = J u for constraints without a term of their own in time."""
    now = _instant(system, t, q, (0.0,) * len(system.speeds))
    return stack(now.J).T


def constraint_jacobian_rate(system: System, t: Component, q: Any, u: Any) -> Float[Array, "k n"]:
    """J_dot (k, n), the time derivative of J along the motion.

        J_dot = -C_dep^-1 (C_ind_dot + C_dep_dot J)

    found by differentiating J(t, q) along (1, q_dot). The textbook prints a minus before C_dep_dot (Example 7).
    """
    now = _instant(system, t, q, u)
    zero = (0.0,) * now.n
    _, J_dot = jvp(lambda t, *q: Instant(system, t, q, zero).J, (now.t, *now.q), (1.0, *now.q_dot))
    return stack(J_dot).T


def kinetic_energy(system: System, t: Component, q: Any, u: Any) -> Float[Array, ""]:
    """Kinetic energy [J] of all bodies, dependent speeds included."""
    now = _instant(system, t, q, u)
    return jnp.asarray(kinetic_energy_of(now.motion(now.t, now.q, now.u_all)))
