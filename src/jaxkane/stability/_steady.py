"""Equilibria and steady motions. Knows cyclic coordinates and roots; knows no mechanism."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._common.lookup import as_names, by_name, hint
from .._description.system import State, System, names_of
from .._method.checks import check_system, is_concrete
from .._method.description_facts import configuration_residual
from .._method.equations import dependent_speeds
from .._method.right_hand_side import rates
from .._method.values import as_array, check_is_system, check_time, checked_values, is_one_number
from .._scalars.nan import nan_where
from .._scalars.types import Component
from .._scalars.versions import compiled
from ._cyclic import cyclic_coordinates
from ._solve import jacobian, root

Held = Sequence[str] | Mapping[str, Any]


class SteadyMotion(eqx.Module):
    """A motion in which every speed and every coordinate that is not cyclic stays as it is.

    Attributes: `q` (n_q,), `u` (n_u,), `u_dep` (k,); `x` (n_x,) states of the first order; `inputs` by name; `t` [s];
    `residual`: the largest acceleration, rate or constraint that should be zero. NaN where none was found under a
    trace. `motion["steer"]` gives any of them by its name; `motion.state` is the `State` to simulate from.
    """

    q: Float[Array, "*batch n_q"]
    u: Float[Array, "*batch n_u"]
    u_dep: Float[Array, "*batch k"]
    x: Float[Array, "*batch n_x"]
    inputs: dict[str, Any]
    t: Any
    residual: Any
    names: tuple[tuple[str, ...], ...] = eqx.field(static=True)

    @property
    def state(self) -> State:
        return State(self.q, self.u, self.x if self.names[3] else None)

    def __getitem__(self, name: str) -> Any:
        groups = zip(self.names, (self.q, self.u, self.u_dep, self.x), strict=True)
        return by_name(name, groups, self.inputs, "this motion")


def equilibrium(
    system: System,
    q: Any = None,
    inputs: Mapping[str, Component] | None = None,
    *,
    hold: Held = (),
    find: Sequence[str] = (),
    t: Component = 0.0,
) -> SteadyMotion:
    """Coordinates at which the system stays at rest: all independent speeds and their rates are zero.

    **Arguments:** as `steady_turn`, with speeds of zero.

    **Returns:** a `SteadyMotion`.

    **Raises:** `ValueError` as `steady_turn`.
    """
    held = hold if isinstance(hold, Mapping) else dict.fromkeys(as_names(hold))
    check_is_system(system)
    at_rest = dict.fromkeys(system.speeds, 0.0)
    return steady_turn(system, q, None, inputs, hold={**at_rest, **held}, find=find, t=t)


def steady_turn(
    system: System,
    q: Any = None,
    u: Any = None,
    inputs: Mapping[str, Component] | None = None,
    *,
    hold: Held = (),
    find: Sequence[str] = (),
    t: Component = 0.0,
) -> SteadyMotion:
    """A motion with constant speeds and constant non-cyclic coordinates: a turn of a bicycle, a top's precession.

        u_dot(q, u) = 0,   q_dot = 0 for coordinates that are not cyclic,   h(q) = 0,   what is held as it is

    States of the first order are found too, so that they stand still: x_dot = 0.

    **Arguments:**

    - `q` (n_q,), `u` (n_u,): an initial guess, or dicts by name in which what is left out is zero.
    - `inputs`: numbers by name; those left out are zero. States of the first order may be given here: an
        initial guess.
    - `hold`: what is to have a given value: names of coordinates and speeds (dependent ones too), kept at the guess;
        or a dict of names and values. Steady motions come in families; hold as many quantities as the family has
        dimensions. Cyclic coordinates stay at the guess.
    - `find`: names of inputs to be found too (trim), from their values in `inputs`; hold one quantity more for each.
    - `t`: time [s], for systems that are prescribed in time.

    **Returns:** a `SteadyMotion`, differentiable any number of times in the parameters, in `inputs` and in the values
    of `hold`, by the implicit function theorem.

    **Raises:** `ValueError` where none is found, or where too little is held to single one out: it names what moves.
    Under a trace the motion is NaN instead.
    """
    name = type(system).__name__
    check_is_system(system)
    values = dict(hold) if isinstance(hold, Mapping) else dict.fromkeys(as_names(hold))
    texts = [k for k, x in values.items() if not (x is None or is_one_number(x))]
    if texts:
        raise TypeError(f"{name}: {', '.join(texts)} is to be held at a value that is no number: {values[texts[0]]!r}.")
    q = as_array({} if q is None else q, system.coordinates, f"{name}: q")
    u = as_array({} if u is None else u, system.speeds, f"{name}: u").astype(q.dtype)
    known = {k: jnp.asarray(x, q.dtype) for k, x in checked_values(system, inputs).items()}
    find = as_names(find)
    unknown = sorted(set(find) - set(system.inputs))
    if unknown:
        raise ValueError(f"{name} has no input {', '.join(unknown)} to find; {hint(unknown, system.inputs, 'it has')}")
    problem = Problem(system, (*find, *system.states), tuple(values))
    for k, x in values.items():
        if x is not None and k in system.coordinates:
            q = q.at[system.coordinates.index(k)].set(jnp.asarray(x, q.dtype))
        elif x is not None and k in system.speeds:
            u = u.at[system.speeds.index(k)].set(jnp.asarray(x, q.dtype))
    check_time(name, t)
    t = jnp.asarray(t, q.dtype)
    check_system(system, t, q)
    guess = problem.unknowns(q, u, known)
    kept = [(k, values[k]) for k in problem.held]  # a cyclic coordinate stays where it is by itself
    held = [problem.quantity(system, t, q, u, k) if x is None else x for k, x in kept]
    held = jnp.stack([jnp.asarray(x, q.dtype) for x in held]) if held else jnp.zeros(0, q.dtype)
    motion, slopes, J = _solve(problem, guess, (system, t, q, known, held))
    if is_concrete(motion.q) and not bool(jnp.all(jnp.isfinite(motion.q))):
        raise ValueError(_why_not(name, problem, motion, np.asarray(slopes), np.asarray(J)))
    return motion


class Problem(eqx.Module):
    """Which unknowns z = (non-cyclic q, u, inputs to find, states) a steady motion has, and its equations F(z) = 0.

    `inputs` are those and the states by name, as `loads` reads them.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    places: tuple[int, ...] = eqx.field(static=True)  # of the coordinates that are not cyclic
    found: tuple[str, ...] = eqx.field(static=True)
    held: tuple[str, ...] = eqx.field(static=True)

    def __init__(self, system: System, found: tuple[str, ...], held: tuple[str, ...]):
        cyclic = cyclic_coordinates(system)
        self.places = tuple(i for i, c in enumerate(system.coordinates) if c not in cyclic)
        self.names = (*(system.coordinates[i] for i in self.places), *system.speeds, *found)
        self.found = found
        self.held = tuple(k for k in held if k not in cyclic or k in system.speeds)
        known = (*system.coordinates, *system.speeds, *system.dependent_speeds)
        unknown = [k for k in held if k not in known]
        if unknown:
            raise ValueError(
                f"{type(system).__name__} has no {', '.join(unknown)} to hold; {hint(unknown, known, 'it has')} Inputs "
                "are held unless they are in `find`; parameters always."
            )

    def unknowns(self, q, u, inputs) -> Array:
        found = [jnp.reshape(inputs[k], (1,)) for k in self.found]
        return jnp.concatenate([q[np.array(self.places, int)], u, *found])

    def parts(self, z, q, inputs):
        """q, u and inputs of the unknowns z."""
        n_s, n_f = len(self.places), len(self.found)
        found = {k: z[len(z) - n_f + i] for i, k in enumerate(self.found)}
        return q.at[np.array(self.places, int)].set(z[:n_s]), z[n_s : len(z) - n_f], {**inputs, **found}

    def residual(self, z, args) -> Array:
        """F (m,): accelerations, rates of the non-cyclic coordinates and of the states, constraints, what is held."""
        system, t, q, inputs, held = args
        q, u, inputs = self.parts(z, q, inputs)
        rate = rates(system, t, q, u, inputs)
        free = [self.quantity(system, t, q, u, k) for k in self.held]
        fixed = jnp.stack(free) - held if free else jnp.zeros(0, q.dtype)
        of_states = [] if rate.x is None else [rate.x]
        still = [rate.u, rate.q[np.array(self.places, int)], *of_states]
        return jnp.concatenate([*still, configuration_residual(system, t, q), fixed])

    @staticmethod
    def quantity(system, t, q, u, name):
        if name in system.coordinates:
            return q[system.coordinates.index(name)]
        if name in system.speeds:
            return u[system.speeds.index(name)]
        return dependent_speeds(system, t, q, u)[system.dependent_speeds.index(name)]


@compiled
def _solve(problem: Problem, guess, args):
    system, t, q, known, _ = args
    z = root(problem.residual, guess, args)
    r = jnp.max(jnp.abs(problem.residual(z, args)))
    J = jacobian(lambda z: problem.residual(z, args), z)
    slopes = jnp.linalg.svd(J / jnp.maximum(jnp.linalg.norm(J, axis=0), 1e-300)[None, :], compute_uv=False)
    eps = float(jnp.finfo(z.dtype).eps)
    scale = 1.0 + jnp.max(jnp.abs(J)) * 1e-2
    good = (r <= eps**0.6 * scale) & (slopes[-1] > eps**0.6)
    q, u, inputs = problem.parts(z, q, known)
    return as_motion(system, t, q, u, inputs, r, ~good, (guess, args)), slopes, J


def as_motion(system, t, q, u, inputs, residual, missing=None, origin=()) -> SteadyMotion:
    """A `SteadyMotion`, NaN with its derivatives by `origin` where it is `missing`."""
    u_dep = dependent_speeds(system, t, q, u) if system.dependent_speeds else jnp.zeros(0, q.dtype)
    if missing is not None:
        q, u, u_dep, inputs = nan_where(missing, (q, u, u_dep, inputs), origin)
    x = jnp.stack([inputs[k] for k in system.states]) if system.states else jnp.zeros(0, q.dtype)
    given = {k: value for k, value in inputs.items() if k not in system.states}
    return SteadyMotion(q, u, u_dep, x, given, t, residual, names_of(system))


def _why_not(name: str, problem: Problem, motion: SteadyMotion, slopes: np.ndarray, J: np.ndarray) -> str:
    r = float(motion.residual)
    if r < 1e-6 and np.all(np.isfinite(J)):
        free = int((slopes <= 1e-9).sum())
        _, _, Vt = np.linalg.svd(J)
        moves = np.abs(Vt[len(Vt) - max(free, 1) :]).max(axis=0)
        which = ", ".join(k for k, x in zip(problem.names, moves, strict=True) if x > 1e-3)
        return (
            f"{name}: the steady motions here form a family of dimension {max(free, 1)}, along which {which} change. "
            f"Hold {max(free, 1)} more of them, e.g. hold=({which.split(', ')[0]!r},)."
        )
    return (
        f"{name}: no steady motion was found from this guess (the largest remaining acceleration, rate or constraint "
        f"is {r:.3g}). Start nearer, or hold other quantities; held: {', '.join(problem.held) or 'none'}."
    )
