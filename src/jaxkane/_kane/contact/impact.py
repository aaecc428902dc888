"""`impact`: the speeds after one impact, without a simulation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..._common.lookup import checked, refuse_if
from ..._scalarjit.cache_key import jit
from ..._scalarjit.components import Component, Numbers, is_written_out
from ..._scalarjit.nan import nan_where
from ..._system.system import NamedVector, State, System
from ..api import checked_arrays, finite_or_explained
from ..arguments import Coordinates, InputArrays, Row, Speeds, Time, is_concrete
from .forces import has_contacts, layout_of
from .impulses import (
    Coefficients,
    Impact,
    ImpactResult,
    ImpactSolution,
    checked_release,
    checked_restitution,
    impact_at,
)
from .states_after_jump import impact_of_contacts


class _OfFunction(eqx.Module):
    function: Callable[..., Any]
    restitution: Any
    release: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, system: System, t: Component, q: Row, u: Row) -> Impact:
        motion = system.motion(t, q, u)
        q_named = NamedVector(q, system.coordinates)
        u_named = NamedVector(u, (*system.speeds, *system.dependent_speeds))
        residuals = self.function(t, q_named, u_named, motion)
        residuals = residuals if isinstance(residuals, (tuple, list)) else (residuals,)
        return Impact(*residuals, restitution=self.restitution, release=self.release)


_compiled = jit(impact_at)


def impact(
    system: System,
    t: Component,
    q: Numbers,
    u: Numbers,
    residuals: Callable[..., Any] | None = None,
    restitution: Coefficients = 0.0,
    release: str | Sequence[str] = (),
) -> ImpactResult:
    """The speeds after an impact, by Kane's impulse equations. See `Impact` for the equations.

        def toe(t, q, u, motion):
            v = motion["toe"].velocity
            return v.dot(motion.N.x), v.dot(motion.N.y)

        after = jk.impact(walker, 0.0, q, u, toe, release=("foot",))

    Without `residuals`, it is the impact of all `System.contacts` that touch, by the contact laws:

        after = jk.impact(ball, 0.0, q, u)

    **Arguments:**

    - `system`: a `System`.
    - `t`: time [s].
    - `q`: coordinates (n_q,), or a dict by name.
    - `u`: independent speeds (n,) before the impact, or a dict by name.
    - `residuals`: a function (t, q, u, motion) -> the velocity residuals [m/s or rad/s]: a number, a Vector, or a tuple
        of these. They are affine in the speeds. `u` also contains the dependent speeds. None: the system's contacts.
    - `restitution`: one coefficient for all residuals, or one for each residual.
    - `release`: names of points and frames whose constraints transmit no impulse.

    **Returns:** an `ImpactResult`. If arguments are traced, errors that depend on values give NaN instead of an
    exception. Contacts are in alphabetical order, and the normal impulse of each precedes its friction impulses. The
    impulses of contacts that do not touch are zero.

    **Raises:** `ValueError` if the residuals contradict each other, if a residual does not depend on the speeds or is
    not affine in them, and if the mass matrix is singular. Without `residuals`: if the system has no contacts, if a
    contact penetrates, if none touches, if a coefficient is out of its range, and if the contact laws have no solution.
    """
    if residuals is None:
        has_more = not (isinstance(restitution, int | float) and restitution == 0.0) or len(release) > 0
        return _impact_of_contacts(system, t, q, u, has_more)
    what = "impact(system, t, q, u, residuals): pass a function (t, q, u, motion) -> velocity residuals"
    checked(residuals, Callable, what)
    arrays = checked_arrays(system, t, q, u)
    coefficients = jax.tree.map(lambda e: jnp.asarray(e, arrays[2].dtype), checked_restitution(restitution))
    if jax.tree_util.all_leaves([residuals]):  # a method of a Module is a tree, and its arrays are arguments
        residuals = jax.tree_util.Partial(residuals)
    read = _OfFunction(residuals, coefficients, checked_release(release))
    solution = (impact_at if is_written_out(len(system.speeds)) else _compiled)(*arrays, read)
    result = solution.result
    values = result.u, result.impulses, result.energy_lost
    if not is_concrete(values):
        is_solved = jnp.isfinite(result.energy_lost)
        u, impulses, energy_lost = nan_where(~is_solved, values, (arrays, coefficients))
        return ImpactResult(u, impulses, energy_lost, result.unique)
    _explain(solution, arrays)
    return result


def _explain(solution: ImpactSolution, arrays: tuple[System, Array, Array, Array, InputArrays]) -> None:
    if np.isfinite(solution.result.energy_lost):
        return
    name, C, is_affine = type(arrays[0]).__name__, np.asarray(solution.C), np.asarray(solution.is_affine)
    for i in range(len(C)):
        if not is_affine[i]:
            raise ValueError(f"{name}: the velocity residual {i} of the impact is not affine in the speeds.")
        if not C[i].any():
            raise ValueError(
                f"{name}: the velocity residual {i} of the impact is not zero and does not depend on the speeds, so no "
                "impulse can change it. Pass a velocity, such as motion['P'].velocity.dot(motion.N.y)."
            )
    refuse_if(
        not solution.is_determined,
        f"{name}: a released part can move without moving a mass, and a residual of the impact depends on this "
        "motion, so the speeds after the impact are undetermined. Give the bodies an inertia, or do not release "
        "the part.",
    )
    finite_or_explained(solution.result, arrays)
    refuse_if(
        not solution.is_consistent,
        f"{name}: the velocity residuals of the impact contradict each other. There are {len(C)} residuals, and no "
        "speeds after the impact satisfy all of them. Omit the dependent residuals, or give them the same "
        "coefficient of restitution.",
    )


def _impact_of_contacts(system: System, t: Component, q: Numbers, u: Numbers, has_more: bool) -> ImpactResult:
    arrays = checked_arrays(system, t, q, u)
    name = type(system).__name__
    refuse_if(
        not has_contacts(system),
        f"{name} has no contacts. Pass a function (t, q, u, motion) -> velocity residuals, or define System.contacts.",
    )
    refuse_if(
        has_more,
        f"{name}: restitution and release need residuals. Contacts have the coefficients that `contacts` returns.",
    )
    result, touches, penetrates, is_lawful, is_determined = _compiled_of_contacts(*arrays[:4])
    values, reasons = result[:3], (touches, penetrates, is_lawful, is_determined)
    possible = jnp.any(touches) & ~jnp.any(penetrates) & is_lawful & is_determined
    if is_concrete((values, reasons)):
        names = np.array(layout_of(system).names)
        refuse_if(
            np.any(penetrates),
            f"{name}: contacts penetrate: {', '.join(names[np.asarray(penetrates)])}. Find touching coordinates with "
            "jaxkane.assemble(system, q, touching=...).",
        )
        refuse_if(
            not np.any(touches),
            f"{name}: no contact touches. Find touching coordinates with jaxkane.assemble(system, q, touching=...).",
        )
        refuse_if(
            not is_lawful,
            f"{name}: a coefficient of a contact is not in its range: 0 <= restitution <= 1, 0 <= friction <= static.",
        )
        refuse_if(not is_determined, f"{name}: the contact laws have no solution here. Use a smaller friction.")
    u_after, impulses, energy_lost = nan_where(~possible, values, (arrays,))
    return ImpactResult(u_after, impulses, energy_lost, result[3])


@jit
def _compiled_of_contacts(system: System, t: Time, q: Coordinates, u: Speeds) -> tuple[Any, ...]:
    return impact_of_contacts(system, t, State(q, u))
