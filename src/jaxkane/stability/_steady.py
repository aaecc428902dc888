"""Equilibria and steady motions: their equations and how these are solved, cyclic coordinates, checks of a motion."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._common.lookup import as_names, by_name, hint, refuse_unknown
from .._kane.arguments import as_array, check_is_system, check_time, checked_values, is_concrete, is_one_number
from .._kane.checks import check_system
from .._kane.constraints import configuration_residual
from .._kane.equations import dependent_speeds, diagnosis
from .._kane.rhs import rates, rates_by_numpy, values_of
from .._scalarjit.cache_key import Cache, jit, version_of
from .._scalarjit.compat import concretely
from .._scalarjit.components import Component
from .._scalarjit.nan import nan_where
from .._system.system import State, System, names_of

_MAX_STEPS = 80  # of the Levenberg-Marquardt method
_CYCLIC = Cache()  # names, by structure
_TRIALS = 3  # at which the rates are finite
_MOST_TRIALS = 12
_SHIFTS = (0.3, -7.0, 150.0)  # of a coordinate [rad, m]: what begins far away counts too
_INPUTS = (1.0, 30.0, 1000.0)  # sizes of trial inputs


Hold = Sequence[str] | Mapping[str, Any]


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
    hold: Hold = (),
    find: Sequence[str] = (),
    t: Component = 0.0,
) -> SteadyMotion:
    """Coordinates at which the system stays at rest: all independent speeds and their rates are zero.

    **Arguments:** as `steady_turn`, with speeds of zero.

    **Returns:** a `SteadyMotion`.

    **Raises:** `ValueError` as `steady_turn`.
    """
    hold = hold if isinstance(hold, Mapping) else dict.fromkeys(as_names(hold))
    check_is_system(system)
    return steady_turn(system, q, None, inputs, hold={**dict.fromkeys(system.speeds, 0.0), **hold}, find=find, t=t)


def steady_turn(
    system: System,
    q: Any = None,
    u: Any = None,
    inputs: Mapping[str, Component] | None = None,
    *,
    hold: Hold = (),
    find: Sequence[str] = (),
    t: Component = 0.0,
) -> SteadyMotion:
    """A motion with constant speeds and constant non-cyclic coordinates: a turn of a bicycle, a top's precession.

        u_dot(q, u) = 0,   q_dot = 0 for coordinates that are not cyclic,   h(q) = 0,   what is held as it is

    States of the first order are found too, so that they stand still: x_dot = 0.

    **Arguments:**

    - `q` (n_q,), `u` (n_u,): an initial guess, or dicts by name in which what is left out is zero.
    - `inputs`: numbers by name; those left out are zero. States of the first order may be given too, as an
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
    equations = SteadyEquations(system, (*find, *system.states), tuple(values))
    for k, x in values.items():
        if x is not None and k in system.coordinates:
            q = q.at[system.coordinates.index(k)].set(jnp.asarray(x, q.dtype))
        elif x is not None and k in system.speeds:
            u = u.at[system.speeds.index(k)].set(jnp.asarray(x, q.dtype))
    check_time(name, t)
    t = jnp.asarray(t, q.dtype)
    check_system(system, t, q)
    guess = equations.unknowns(q, u, known)
    targets = [(k, values[k]) for k in equations.hold]  # a cyclic coordinate stays where it is by itself
    targets = [equations.quantity(system, t, q, u, k) if x is None else x for k, x in targets]
    targets = jnp.stack([jnp.asarray(x, q.dtype) for x in targets]) if targets else jnp.zeros(0, q.dtype)
    motion, slopes, J = _solve(equations, guess, (system, t, q, known, targets))
    if is_concrete(motion.q) and not bool(jnp.all(jnp.isfinite(motion.q))):
        raise ValueError(_no_steady_motion(name, equations, float(motion.residual), np.asarray(slopes), np.asarray(J)))
    return motion


class SteadyEquations(eqx.Module):
    """Which unknowns z = (non-cyclic q, u, inputs to find, states) a steady motion has, and its equations F(z) = 0.

    `inputs` are those and the states by name, as `loads` reads them.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    places: tuple[int, ...] = eqx.field(static=True)  # of the coordinates that are not cyclic
    find: tuple[str, ...] = eqx.field(static=True)
    hold: tuple[str, ...] = eqx.field(static=True)

    def __init__(self, system: System, find: tuple[str, ...], hold: tuple[str, ...]):
        cyclic = cyclic_coordinates(system)
        self.places = tuple(i for i, c in enumerate(system.coordinates) if c not in cyclic)
        self.names = (*(system.coordinates[i] for i in self.places), *system.speeds, *find)
        self.find = find
        self.hold = tuple(k for k in hold if k not in cyclic or k in system.speeds)
        known = (*system.coordinates, *system.speeds, *system.dependent_speeds)
        unknown = [k for k in hold if k not in known]
        if unknown:
            raise ValueError(
                f"{type(system).__name__} has no {', '.join(unknown)} to hold; {hint(unknown, known, 'it has')} Inputs "
                "are held unless they are in `find`; parameters always."
            )

    def unknowns(self, q, u, inputs) -> Array:
        trim = [jnp.reshape(inputs[k], (1,)) for k in self.find]
        return jnp.concatenate([q[np.array(self.places, int)], u, *trim])

    def parts(self, z, q, inputs):
        """q, u and inputs of the unknowns z."""
        n_s, n_f = len(self.places), len(self.find)
        trim = {k: z[len(z) - n_f + i] for i, k in enumerate(self.find)}
        return q.at[np.array(self.places, int)].set(z[:n_s]), z[n_s : len(z) - n_f], {**inputs, **trim}

    def residual(self, z, args) -> Array:
        """F (m,): accelerations, rates of the non-cyclic coordinates and of the states, constraints, what is held."""
        system, t, q, inputs, targets = args
        q, u, inputs = self.parts(z, q, inputs)
        rate = rates(system, t, q, u, inputs)
        holding = [self.quantity(system, t, q, u, k) for k in self.hold]
        fixed = jnp.stack(holding) - targets if holding else jnp.zeros(0, q.dtype)
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


@jit
def _solve(equations: SteadyEquations, guess, args):
    system, t, q, known, _ = args
    z = levenberg_marquardt(equations.residual, guess, args)
    r = jnp.max(jnp.abs(equations.residual(z, args)))
    J = jacobian(lambda z: equations.residual(z, args), z)
    slopes = jnp.linalg.svd(J / jnp.maximum(jnp.linalg.norm(J, axis=0), 1e-300)[None, :], compute_uv=False)
    eps = float(jnp.finfo(z.dtype).eps)
    scale = 1.0 + jnp.max(jnp.abs(J)) * 1e-2
    good = (r <= eps**0.6 * scale) & (slopes[-1] > eps**0.6)
    q, u, inputs = equations.parts(z, q, known)
    return as_motion(system, t, q, u, inputs, r, ~good, (guess, args)), slopes, J


def as_motion(system, t, q, u, inputs, residual, missing=None, origin=()) -> SteadyMotion:
    """A `SteadyMotion`, NaN with its derivatives by `origin` where it is `missing`."""
    u_dep = dependent_speeds(system, t, q, u) if system.dependent_speeds else jnp.zeros(0, q.dtype)
    if missing is not None:
        q, u, u_dep, inputs = nan_where(missing, (q, u, u_dep, inputs), origin)
    x = jnp.stack([inputs[k] for k in system.states]) if system.states else jnp.zeros(0, q.dtype)
    of_system = {k: value for k, value in inputs.items() if k not in system.states}
    return SteadyMotion(q, u, u_dep, x, of_system, t, residual, names_of(system))


def _no_steady_motion(name: str, equations: SteadyEquations, r: float, slopes: np.ndarray, J: np.ndarray) -> str:
    if r < 1e-6 and np.all(np.isfinite(J)):
        free = int((slopes <= 1e-9).sum())
        _, _, Vt = np.linalg.svd(J)
        moves = np.abs(Vt[len(Vt) - max(free, 1) :]).max(axis=0)
        which = ", ".join(k for k, x in zip(equations.names, moves, strict=True) if x > 1e-3)
        return (
            f"{name}: the steady motions here form a family of dimension {max(free, 1)}, along which {which} change. "
            f"Hold {max(free, 1)} more of them, e.g. hold=({which.split(', ')[0]!r},)."
        )
    return (
        f"{name}: no steady motion was found from this guess (the largest remaining acceleration, rate or constraint "
        f"is {r:.3g}). Start nearer, or hold other quantities; held: {', '.join(equations.hold) or 'none'}."
    )


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def levenberg_marquardt(residual: Callable[[Array, Any], Array], z: Array, args: Any) -> Array:
    """z (n,) with residual(z, args) = 0 (m >= n equations), by Levenberg and Marquardt's method from a guess.

    Differentiable in `args`, any number of times, both modes:  dz = -F_z^+ F_args dargs. A solution is not promised:
    look at the residual and at the rank of its derivative.
    """
    # Steps are kept while the residual falls; the damping vanishes near a solution, where this is Gauss and Newton's.
    eps = float(jnp.finfo(z.dtype).eps)

    def F(z):
        return residual(z, args)

    def cost(r):
        return jnp.where(jnp.all(jnp.isfinite(r)), jnp.sum(r**2), jnp.inf)

    def step(carry):
        z, r, damping, small, k = carry
        J = jacobian(F, z)
        finite = jnp.all(jnp.isfinite(J))
        J = jnp.where(finite, J, 0.0)
        size = jnp.linalg.norm(J, axis=0)
        size = jnp.where(size > 0, size, 1.0)  # of columns, so that units do not matter
        U, s, Vt = jnp.linalg.svd(J / size[None, :], full_matrices=False)
        filtered = jnp.where(s > 1e3 * eps * s[0], s / (s**2 + damping), 0.0)
        dz = -(Vt.T @ (filtered * (U.T @ r))) / size
        trial = F(z + dz)
        better = cost(trial) < cost(r)
        tiny = jnp.all(jnp.abs(dz) <= 4 * eps * (1 + jnp.abs(z)))
        z, r = jnp.where(better, z + dz, z), jnp.where(better, trial, r)
        small = jnp.where(tiny | ~finite | (~better & (damping < 1e-13)) | (damping > 1e8), 1, 0)
        damping = jnp.where(better, damping * jnp.where(damping < 1e-6, 0.0, 0.03), 10 * jnp.maximum(damping, 1e-14))
        return z, r, damping, small, k + 1

    def going(carry):
        return (carry[3] == 0) & (carry[4] < _MAX_STEPS)

    r = F(z)
    start = (z, r, jnp.asarray(1e-2, z.dtype), jnp.zeros((), int), jnp.zeros((), int))
    return jax.lax.while_loop(going, step, start)[0]


@levenberg_marquardt.defjvp
def _levenberg_marquardt_jvp(residual, primals, tangents):
    guess, args = primals
    z = levenberg_marquardt(residual, guess, args)
    _, dF = jax.jvp(lambda args: residual(z, args), (args,), (tangents[1],))
    J = jacobian(lambda z: residual(z, args), z)
    J = jnp.where(jnp.all(jnp.isfinite(J)), J, 0.0)  # without a solution there is no slope: NaN stands elsewhere
    return z, -jnp.linalg.pinv(J) @ dF


def jacobian(f: Callable[[Array], Any], x: Array) -> Any:
    """df/dx (m, n) at x (n,), one column after the other."""
    columns = jax.lax.map(lambda dx: jax.jvp(f, (x,), (dx,))[1], jnp.eye(x.shape[0], dtype=x.dtype))
    return jax.tree.map(lambda y: jnp.moveaxis(y, 0, -1), columns)


def cyclic_coordinates(system: System) -> tuple[str, ...]:
    """Names of the cyclic (ignorable) coordinates: those that may be shifted without a change of any other rate.

    Neither the accelerations, nor the configuration constraints, nor the rates of the other coordinates depend on
    them: a bicycle's wheel angles, yaw and place. They may grow in a steady motion, in which the others stand still.

    Found by shifting each coordinate at trial states, times, inputs and parameters, once for each class and shape of
    the parameters: a dependence that vanishes for special parameters (a spring of zero stiffness), or as long as an
    input is zero (a force that follows a steer angle), counts as one.

    **Raises:** `ValueError` where no trial has finite accelerations.
    """
    check_is_system(system)
    leaves, treedef = jax.tree.flatten(system)
    shapes = tuple((jnp.shape(x), str(jnp.result_type(x))) for x in leaves)
    key = (type(system), str(treedef), shapes, version_of(system))
    with concretely():
        return _CYCLIC.get(key, lambda: _search_cyclic(system, leaves, treedef))


def _search_cyclic(system: System, leaves: list, treedef) -> tuple[str, ...]:
    names, n_q = system.coordinates, len(system.coordinates)
    rng = np.random.default_rng(0)
    dtype = jnp.result_type(*leaves) if leaves else jnp.zeros(()).dtype
    as_floats = lambda x: jnp.asarray(x, dtype)  # noqa: E731

    @jax.jit
    def all_rates(trial, t, q, u, w):
        rate = rates(trial, t, q, u, w)
        of_states = [] if rate.x is None else [rate.x]
        return rate.q, jnp.concatenate([rate.u, configuration_residual(trial, t, q), *of_states])

    depends = np.zeros((n_q + 1, n_q), bool)  # row: a rate, the last those of the speeds and the constraints
    compared = 0
    for k in range(_MOST_TRIALS):
        # Parameters are about one; where these cannot be, those of the system itself.
        trial = jax.tree.unflatten(treedef, [jnp.asarray(rng.uniform(0.5, 1.5, x.shape), x.dtype) for x in leaves])
        if k >= _MOST_TRIALS // 2 and is_concrete(leaves):
            trial = system
        q, u = rng.uniform(-0.4, 0.4, n_q), rng.uniform(-1.0, 1.0, len(system.speeds))
        size = _INPUTS[compared % len(_INPUTS)]
        w = {
            name: as_floats(size * rng.choice([-1, 1]) * rng.uniform(0.5, 1.5))
            for name in (*system.inputs, *system.states)
        }
        t, u = as_floats(rng.uniform(0.0, 2.0)), as_floats(u)
        at = lambda q, trial=trial, t=t, u=u, w=w: tuple(map(np.asarray, all_rates(trial, t, as_floats(q), u, w)))  # noqa: E731
        before = at(q)
        if not all(np.all(np.isfinite(x)) for x in before):
            continue
        for i in range(n_q):
            for shift in _SHIFTS:
                depends[:, i] |= _changed_rates(before, at(q + shift * np.eye(n_q)[i]), 1 + abs(shift))
        compared += 1
        if compared == _TRIALS:
            break
    if not compared:
        raise ValueError(
            f"{type(system).__name__}: which coordinates are cyclic cannot be found: at none of {_MOST_TRIALS} trial "
            "states, with parameters of about one and with its own, are its accelerations finite."
        )
    non_cyclic = depends[-1].copy()  # the accelerations depend on them,
    while (extended := non_cyclic | depends[:-1][non_cyclic].any(axis=0)).sum() > non_cyclic.sum():
        non_cyclic = extended  # or the rate of one that is not cyclic does
    return tuple(name for name, k in zip(names, non_cyclic, strict=True) if not k)


def _changed_rates(before: tuple[np.ndarray, ...], after: tuple[np.ndarray, ...], rounding: float) -> np.ndarray:
    """Which rates of the coordinates, and last whether any of the others, differ beyond rounding."""
    eps = float(np.finfo(before[0].dtype).eps)
    rows = []
    for a, b in (*zip(before[0], after[0], strict=True), (before[1], after[1])):
        a, b = np.atleast_1d(a), np.atleast_1d(b)
        size = rounding * (1.0 + np.abs(a).max(initial=0.0))
        # What is not finite after a shift of a cyclic coordinate was not finite before.
        rows.append(not np.all(np.abs(b - a) <= eps**0.6 * size))
    return np.array(rows)


def inputs_by_name(system: System, w) -> dict[str, Any]:
    return {k: w[i] for i, k in enumerate(system.inputs)}


@jit
def _all_rates(system, t, q, u, x, w):
    rate = rates(system, t, q, u, values_of(system, x, inputs_by_name(system, w)))
    return rate.q, rate.u, x if rate.x is None else rate.x, configuration_residual(system, t, q)


def _tolerances(system: System, u) -> tuple[float, Any]:
    """How far coordinates may be off the constraints, and rates from zero."""
    tol = float(jnp.finfo(u.dtype).eps) ** 0.4
    return tol, tol * (1.0 + jnp.max(jnp.abs(u), initial=0.0))


def _non_cyclic(system: System) -> np.ndarray:
    """Places of the coordinates that stand still in a steady motion."""
    cyclic = cyclic_coordinates(system)
    return np.array([i for i, k in enumerate(system.coordinates) if k not in cyclic], int)


def check_dependent(system: System, dependent: Sequence[str], n_h: int) -> None:
    """**Raises:** `ValueError` where not as many coordinates are named as `n_h` configuration constraints determine."""
    name = type(system).__name__
    refuse_unknown(dependent, system.coordinates, f"{name}: `dependent` names coordinates; it has no", "it has")
    if len(set(dependent)) != n_h:
        raise ValueError(
            f"{name}: {n_h} configuration constraints determine as many coordinates, but "
            f"{len(set(dependent))} are named ({', '.join(dependent) or 'none'}). Give linearize(..., dependent=(...)) "
            f"{n_h} of {', '.join(system.coordinates)}."
        )


def is_not_steady(system: System, t, q, u, x, w, steady: bool):
    """Whether a state is off the constraints, not finite or, with `steady`, not steady."""
    q_dot, u_dot, x_dot, h = _all_rates(system, t, q, u, x, w)
    tol, slack = _tolerances(system, u)
    moving = jnp.concatenate([u_dot, q_dot[_non_cyclic(system)], x_dot]) if steady else jnp.zeros(0, q.dtype)
    fine = jnp.all(jnp.abs(h) <= tol) & jnp.all(jnp.abs(moving) <= slack)
    return jax.lax.stop_gradient(~(fine & jnp.all(jnp.isfinite(jnp.concatenate([q, u, x, w, t[None]])))))


def check_steady(system: System, t, q, u, x, w, steady: bool) -> None:
    name = type(system).__name__
    rate = rates_by_numpy(system, t, q, u, x, inputs_by_name(system, w))
    if rate is None:
        found = _all_rates(system, t, q, u, x, w)
    else:
        found = rate.q, rate.u, x if rate.x is None else rate.x, configuration_residual.numpy(system, t, q)
    q_dot, u_dot, x_dot, h = map(np.asarray, found)
    tol, slack = _tolerances(system, u)
    names = (*system.coordinates, *system.speeds, *system.states, *system.inputs, "t")
    values = np.concatenate([np.asarray(y) for y in (q, u, x, w, t[None])])
    bad = [k for k, value in zip(names, values, strict=True) if not np.isfinite(value)]
    if bad:
        raise ValueError(f"{name}: {', '.join(bad)} is not finite: there is no linear model there.")
    if h.size and not np.abs(h).max() <= tol:
        raise ValueError(f"{name}: the coordinates violate the configuration constraints by {h}. Use assemble.")
    if not np.all(np.isfinite(np.concatenate([q_dot, u_dot]))):
        wrong = diagnosis(system, t, q, u, values_of(system, x, inputs_by_name(system, w)))
        raise ValueError(wrong or f"{name}: rates are not finite there: there is no linear model.")
    if not steady:
        return
    changes = {f"{k} is accelerated by": y for k, y in zip(system.speeds, u_dot, strict=True)}
    changes |= {f"{system.coordinates[i]} changes with": q_dot[i] for i in _non_cyclic(system)}
    changes |= {f"{k} changes with": y for k, y in zip(system.states, x_dot, strict=True)}
    moving = [f"{k} {float(x):.3g}" for k, x in changes.items() if not abs(x) <= float(slack)]
    if moving:
        raise ValueError(
            f"{name}: this motion is not steady: {', '.join(moving)}. Find one with equilibrium or steady_turn; or ask "
            "for the linear model of an instant with linearize(..., steady=False)."
        )
