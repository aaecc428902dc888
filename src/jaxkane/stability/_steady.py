"""Equilibria and steady motions: their equations and solution, cyclic coordinates, checks of a motion."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from .._common.lookup import as_names, by_name, refuse_unknown
from .._integrate.inputs import Coordinates, Speeds
from .._kane.api import dependent_speeds, diagnosis
from .._kane.arguments import (
    as_array,
    check_is_system,
    check_time,
    checked_values,
    is_concrete,
    is_one_number,
    refuse_multipliers,
)
from .._kane.checks import check_system
from .._kane.constraint_residuals import configuration_residual
from .._kane.contact.forces import closed_contacts, refuse_closed_contacts
from .._kane.kanes_method import rates_and_forcing
from .._kane.right_hand_side import first_order_rates, rates, rates_by_numpy, values_of
from .._kane.scaling import least_norm, rank_tolerance, relative, singular_values, without_rounding
from .._scalarjit.cache import Cache
from .._scalarjit.cache_key import jit, version_of
from .._scalarjit.compat import concretely
from .._scalarjit.components import Component, Numbers
from .._scalarjit.nan import nan_where
from .._system.parameters import text_of, wrapped
from .._system.system import State, System, named_numbers, names_of, units_of
from ._sizes import coordinate_sizes, sizes_of

_MAX_STEPS = 80  # of the Levenberg-Marquardt method
_CYCLIC = Cache()  # names, by structure
_TRIALS = 3  # needed, with finite rates
_MOST_TRIALS = 12
_SHIFTS = (0.3, -7.0, 150.0)  # of a coordinate [rad, m]: large ones detect terms that begin far away
_INPUTS = (1.0, 30.0, 1000.0)  # sizes of trial inputs


Hold = Sequence[str] | Mapping[str, Any]

SteadyArguments: TypeAlias = tuple[System, Array, Coordinates, Speeds, dict[str, Array], Array]
"""System, time, coordinates, speeds, inputs with first-order states by name, and values of the held speeds."""


class SteadyMotion(eqx.Module):
    """A motion with constant speeds and constant non-cyclic coordinates.

    `motion["steer"]` is any of the values by its name. `motion.state` is the `State` to simulate from. Under a trace,
    the numbers are NaN if no steady motion was found.

    Attributes:

    - `q` (n_q,), `u` (n_u,), `u_dep` (k,): coordinates, independent and dependent speeds.
    - `x` (n_x,): states of the first order.
    - `inputs`: by name.
    - `t`: time [s].
    - `residual`: the largest acceleration, rate or constraint that should be zero, relative to the size of its own
        terms (no unit).
    - `units`: pairs of a name and its unit, as the system declares them.
    """

    q: Float[Array, "*batch n_q"]
    u: Float[Array, "*batch n_u"]
    u_dep: Float[Array, "*batch k"]
    x: Float[Array, "*batch n_x"]
    inputs: dict[str, Any]
    t: Any
    residual: Any
    names: tuple[tuple[str, ...], ...] = eqx.field(static=True)
    units: tuple[tuple[str, str], ...] = eqx.field(static=True, default=(), repr=False)

    @property
    def state(self) -> State:
        return State(self.q, self.u, self.x if self.names[3] else None)

    def __getitem__(self, name: str) -> Any:
        groups = zip(self.names, (self.q, self.u, self.u_dep, self.x), strict=True)
        return by_name(name, groups, self.inputs, "this motion")

    def __repr__(self) -> str:
        values = named_numbers(self.names, (self.q, self.u, self.u_dep, self.x), self.inputs, self.units)
        if not values:
            names = [*(name for group in self.names for name in group), *self.inputs]
            return f"SteadyMotion(shape={np.shape(self.q)[:-1]}: {', '.join(names)})"
        return wrapped(f"SteadyMotion({values}; t={text_of(self.t, 's')}, residual={text_of(self.residual)})")


def equilibrium(
    system: System,
    q: Numbers = None,
    inputs: Mapping[str, Component] | None = None,
    *,
    hold: Hold = (),
    find: Sequence[str] = (),
    t: Component = 0.0,
) -> SteadyMotion:
    """Coordinates at which the system remains at rest: all independent speeds and their rates are zero.

    **Arguments:** as `steady_turn`, with speeds of zero.

    **Returns:** a `SteadyMotion`.

    **Raises:** `ValueError` as `steady_turn`.
    """
    hold = hold if isinstance(hold, Mapping) else dict.fromkeys(as_names(hold, "hold"))
    check_is_system(system)
    refuse_multipliers(system)
    return steady_turn(system, q, None, inputs, hold={**dict.fromkeys(system.speeds, 0.0), **hold}, find=find, t=t)


def steady_turn(
    system: System,
    q: Numbers = None,
    u: Numbers = None,
    inputs: Mapping[str, Component] | None = None,
    *,
    hold: Hold = (),
    find: Sequence[str] = (),
    t: Component = 0.0,
) -> SteadyMotion:
    """A motion with constant speeds and constant non-cyclic coordinates: a turn of a bicycle, a top's precession.

        u_dot(q, u) = 0,   q_dot = 0 for coordinates that are not cyclic,   h(q) = 0,   and the held quantities

    States of the first order are solved for too, such that x_dot = 0.

    **Arguments:**

    - `q` (n_q,), `u` (n_u,): an initial guess, or dicts by name. Omitted values are zero.
    - `inputs`: numbers by name. Omitted inputs are zero. Initial guesses of states of the first order may be included.
    - `hold`: names of coordinates and speeds (also dependent ones) that keep the value of the guess; or a dict of
        names and values. Hold as many quantities as the family of steady motions has dimensions. Cyclic coordinates
        keep the value of the guess.
    - `find`: names of inputs to solve for (trim), with initial guesses in `inputs`. Hold one more quantity for each.
    - `t`: time [s], for systems that are prescribed in time.

    **Returns:** a `SteadyMotion`, differentiable any number of times in the parameters, in `inputs` and in the values
    of `hold`, by the implicit function theorem.

    **Raises:** `ValueError` if no steady motion is found, if too few quantities are held to determine one, or if a
    contact is closed in it. The message names the quantities that can change. Under a trace the motion is NaN instead.
    """
    name = type(system).__name__
    check_is_system(system)
    refuse_multipliers(system)
    values = dict(hold) if isinstance(hold, Mapping) else dict.fromkeys(as_names(hold, "hold"))
    texts = [k for k, x in values.items() if not (x is None or is_one_number(x))]
    if texts:
        raise TypeError(f"{name}: {', '.join(texts)} in `hold` must be a number or None, got {values[texts[0]]!r}.")
    q = as_array({} if q is None else q, system.coordinates, f"{name}: q")
    u = as_array({} if u is None else u, system.speeds, f"{name}: u").astype(q.dtype)
    known = {k: jnp.asarray(x, q.dtype) for k, x in checked_values(system, inputs).items()}
    find = as_names(find, "find")
    refuse_unknown(find, system.inputs, f"{name} has no input", "it has")
    equations = SteadyEquations(system, (*find, *system.states), tuple(values))
    given = {k: jnp.asarray(x, q.dtype) for k, x in values.items() if x is not None}
    for k, x in given.items():
        if k in system.coordinates:
            q = q.at[system.coordinates.index(k)].set(x)
        elif k in system.speeds:
            u = u.at[system.speeds.index(k)].set(x)
    check_time(name, t)
    t = jnp.asarray(t, q.dtype)
    numbers = dict(zip((*system.coordinates, *system.speeds), (*q, *u), strict=True)) | known | given
    wrong = [k for k, x in numbers.items() if is_concrete(x) and not np.isfinite(x)]
    if wrong:
        raise ValueError(
            f"{name}: {', '.join(wrong)} is not finite ({float(numbers[wrong[0]])}). Pass finite numbers "
            f"{'in `hold`' if values.keys() & {*wrong} else 'for the initial guess'}."
        )
    check_system(system, t, q)
    targets = [given[k] if k in given else quantity(system, t, q, u, k) for k in equations.hold]
    targets = jnp.stack(targets) if targets else jnp.zeros(0, q.dtype)
    motion, rank, closed = _solve(equations, (system, t, q, u, known, targets))
    if is_concrete(closed):
        refuse_closed_contacts(system, closed)
    if is_concrete(motion.q) and not bool(jnp.all(jnp.isfinite(motion.q))):
        raise ValueError(_no_steady_motion(name, equations, tuple(values), float(motion.residual), *rank))
    return motion


def quantity(system: System, t: Array, q: Coordinates, u: Speeds, name: str):
    if name in system.coordinates:
        return q[system.coordinates.index(name)]
    if name in system.speeds:
        return u[system.speeds.index(name)]
    return dependent_speeds(system, t, q, u)[system.dependent_speeds.index(name)]


class SteadyEquations(eqx.Module):
    """The unknowns z of a steady motion, and its equations F(z) = 0.

    z contains the non-cyclic coordinates, the independent speeds, the inputs to find and the states of the first order.
    Held coordinates and independent speeds are not unknowns. A held dependent speed adds an equation.

    Attributes:

    - `names`: of the unknowns.
    - `still`: indices of the coordinates that are not cyclic.
    - `q_free`, `u_free`: indices of the unknown coordinates and speeds.
    - `find`: names of the inputs to find and of the states.
    - `hold`: names of the dependent speeds that are held.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    still: tuple[int, ...] = eqx.field(static=True)
    q_free: tuple[int, ...] = eqx.field(static=True)
    u_free: tuple[int, ...] = eqx.field(static=True)
    find: tuple[str, ...] = eqx.field(static=True)
    hold: tuple[str, ...] = eqx.field(static=True)

    def __init__(self, system: System, find: tuple[str, ...], hold: tuple[str, ...]):
        # Parameters are always constant, and so are inputs that are not in `find`.
        known = (*system.coordinates, *system.speeds, *system.dependent_speeds)
        refuse_unknown(hold, known, f"{type(system).__name__} has no coordinate or speed", "it has")
        cyclic = cyclic_coordinates(system)
        self.still = tuple(i for i, c in enumerate(system.coordinates) if c not in cyclic)
        self.q_free = tuple(i for i in self.still if system.coordinates[i] not in hold)
        self.u_free = tuple(i for i, k in enumerate(system.speeds) if k not in hold)
        coordinates = (system.coordinates[i] for i in self.q_free)
        self.names = (*coordinates, *(system.speeds[i] for i in self.u_free), *find)
        self.find = find
        self.hold = tuple(k for k in hold if k in system.dependent_speeds)

    def unknowns(self, q: Coordinates, u: Speeds, inputs: dict[str, Array]) -> Array:
        trim = [jnp.reshape(inputs[k], (1,)) for k in self.find]
        return jnp.concatenate([q[np.array(self.q_free, int)], u[np.array(self.u_free, int)], *trim])

    def parts(self, z: Float[Array, " n_z"], q: Coordinates, u: Speeds, inputs: dict[str, Array]):
        n_q, n_u = len(self.q_free), len(self.u_free)
        trim = {k: z[n_q + n_u + i] for i, k in enumerate(self.find)}
        q = q.at[np.array(self.q_free, int)].set(z[:n_q])
        return q, u.at[np.array(self.u_free, int)].set(z[n_q : n_q + n_u]), {**inputs, **trim}

    def residual(self, z: Float[Array, " n_z"], args: SteadyArguments) -> Array:
        """F (m,): forces f = M u_dot, rates of the non-cyclic coordinates and of the states at u_dot = 0, constraints
        and held quantities."""
        system, t, q, u, inputs, targets = args
        q, u, inputs = self.parts(z, q, u, inputs)
        q_dot, f, x_dot, h = _imbalance(system, t, q, u, inputs)
        held = [quantity(system, t, q, u, k) - target for k, target in zip(self.hold, targets, strict=True)]
        return jnp.concatenate([f, q_dot[np.array(self.still, int)], x_dot, h, *(jnp.reshape(x, (1,)) for x in held)])

    def sizes(
        self, z: Float[Array, " n_z"], largest: Float[Array, " n_z"], args: SteadyArguments
    ) -> tuple[Array, Array]:
        """The sizes of the terms of each equation (m,) and of each unknown (n,), whose values were up to `largest`."""
        system, t, q, u, inputs, targets = args
        of_q, of_u, of_inputs = self.parts(largest, coordinate_sizes(system, q), abs(u), jax.tree.map(abs, inputs))
        q, u, inputs = self.parts(z, q, u, inputs)
        of_q = jnp.maximum(of_q, coordinate_sizes(system, q))
        still = np.array(self.still, int)
        found = sizes_of(system, t, q, u, inputs, (of_q, of_u, of_inputs), still)
        held = [found.u_dep[system.dependent_speeds.index(k)] for k in self.hold]
        held = [jnp.reshape(jnp.maximum(x, abs(target)), (1,)) for x, target in zip(held, targets, strict=True)]
        equations = jnp.concatenate([found.f, found.q_dot[still], found.x_dot, found.h, *held])
        return jax.lax.stop_gradient((equations, self.unknowns(of_q, found.u, of_inputs)))


def row_sizes(J: Array, sizes: tuple[Array, Array]) -> Array:
    """The scale of each equation (m,): the size of its terms, or of its changes with the unknowns.

    All terms of one equation of a top contain the rate of the nutation, which is zero. Their size would be zero too. If
    an unknown is zero, e.g. a force to be found, its size is the change that balances another equation.
    """
    of_equations, of_unknowns = sizes
    J = jax.lax.stop_gradient(jnp.abs(J))
    size = jnp.maximum(of_equations, J @ of_unknowns)[:, None]
    balances = jnp.where((size > 0) & (J > 0), size / jnp.where(J > 0, J, 1.0), jnp.inf)
    balancing = jnp.min(balances, axis=0, initial=jnp.inf)[None, :]
    by_others = jnp.max(J * jnp.where(balancing < jnp.inf, balancing, 0.0), axis=1, initial=0.0)
    size = jnp.where(size[:, 0] > 0, size[:, 0], by_others)
    return jnp.where(size > 0, size, 1.0)


def _imbalance(system: System, t: Array, q: Coordinates, u: Speeds, values: dict[str, Array]):
    """The zeros of a steady motion: q_dot (n_q,), f = M u_dot (n,), x_dot (n_x,) at u_dot = 0, and h (h,)."""
    q_dot, f = rates_and_forcing(system, t, q, u, values)
    x_dot = first_order_rates(system, t, q, u, values, jnp.zeros_like(u)) if system.states else jnp.zeros(0, q.dtype)
    return q_dot, f, x_dot, configuration_residual(system, t, q)


@jit
def _solve(equations: SteadyEquations, args: SteadyArguments):
    system, t, q, u, known, _ = args
    guess = equations.unknowns(q, u, known)
    z = levenberg_marquardt(equations, guess, args)
    J = jacobian(lambda z: equations.residual(z, args), z)
    sizes = row_sizes(J, equations.sizes(z, jnp.maximum(abs(z), abs(guess)), args))
    r = jnp.max(jnp.abs(equations.residual(z, args)) / sizes)
    J = _by_columns(J / sizes[:, None])[0]
    slopes = singular_values(without_rounding(J, jnp.ones_like(J))) if len(guess) else jnp.ones(1, q.dtype)
    tolerance = rank_tolerance(z.dtype)
    is_root = (r <= tolerance) & (slopes[-1] > tolerance)
    parts = equations.parts(z, q, u, known)
    closed = is_root & closed_contacts(system, t, parts[0])
    return as_motion(system, t, *parts, r, ~is_root | jnp.any(closed), args), (slopes, J), closed


def _by_columns(J: Array) -> tuple[Array, Array]:
    """A matrix with columns of unit length, and their lengths (n,), 1 for columns of zeros."""
    size = jnp.linalg.norm(J, axis=0)
    size = jnp.where(size > 0, size, 1.0)
    return J / size[None, :], size


def as_motion(
    system: System,
    t: Array,
    q: Coordinates,
    u: Speeds,
    inputs: dict[str, Array],
    residual: Array,
    missing: Bool[Array, ""] | None = None,
    origin: PyTree = (),
) -> SteadyMotion:
    """A `SteadyMotion`, NaN with its derivatives by `origin` where it is `missing`."""
    u_dep = dependent_speeds(system, t, q, u) if system.dependent_speeds else jnp.zeros(0, q.dtype)
    if missing is not None:
        q, u, u_dep, inputs = nan_where(missing, (q, u, u_dep, inputs), origin)
    x = jnp.stack([inputs[k] for k in system.states]) if system.states else jnp.zeros(0, q.dtype)
    of_system = {k: value for k, value in inputs.items() if k not in system.states}
    units = tuple(units_of(system).items())
    return SteadyMotion(q, u, u_dep, x, of_system, t, residual, names_of(system), units)


def _no_steady_motion(
    name: str, equations: SteadyEquations, held: tuple[str, ...], r: float, slopes: Numbers, J: Numbers
) -> str:
    slopes, J = np.asarray(slopes), np.asarray(J)
    if r < 1e-6 and np.all(np.isfinite(J)):
        free = int((slopes <= 1e-9).sum())
        _, _, Vt = np.linalg.svd(J)
        moves = np.abs(Vt[len(Vt) - max(free, 1) :]).max(axis=0)
        which = ", ".join(k for k, x in zip(equations.names, moves, strict=True) if x > 1e-3)
        return (
            f"{name}: the steady motions here form a family of dimension {max(free, 1)}, along which {which} change. "
            f"Hold {max(free, 1)} more of these, e.g. hold=({which.split(', ')[0]!r},)."
        )
    return (
        f"{name}: no steady motion was found from this guess (the largest remaining acceleration, rate or constraint "
        f"is {r:.3g} of its own terms). Use a nearer guess, or hold other quantities "
        f"(held: {', '.join(held) or 'none'})."
    )


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def levenberg_marquardt(equations: SteadyEquations, guess: Array, args: SteadyArguments) -> Array:
    """z (n,) with equations.residual(z, args) = 0 (m >= n equations), by Levenberg and Marquardt's method from a guess.

    Differentiable in `args`, any number of times, both modes:  dz = -F_z^+ F_args dargs. The result need not be a
    solution: check the residual and the rank of its derivative.
    """
    # Steps are accepted if the residual decreases. Near a solution the damping vanishes, as in the Gauss-Newton method.
    # Equations are divided by the sizes of their terms, and unknowns by the columns of the derivative. The steps are
    # therefore equal in metres and in micrometres.
    if not guess.size:
        return guess
    eps = float(jnp.finfo(guess.dtype).eps)

    def F(z: Float[Array, " n_z"]):
        return equations.residual(z, args)

    def cost(r: Float[Array, " m"], sizes: Float[Array, " m"]):
        r = r / sizes
        return jnp.where(jnp.all(jnp.isfinite(r)), jnp.sum(r**2), jnp.inf)

    def step(carry: tuple[Any, ...]):
        z, r, largest, damping, small, k = carry
        J = jacobian(F, z)
        finite = jnp.all(jnp.isfinite(J))
        sizes = row_sizes(J, equations.sizes(z, largest, args))
        J, size = _by_columns(jnp.where(finite, J / sizes[:, None], 0.0))
        U, s, Vt = jnp.linalg.svd(J, full_matrices=False)
        filtered = jnp.where(s > 1e3 * eps * s[0], s / (s**2 + damping), 0.0)
        dz = -(Vt.T @ (filtered * (U.T @ (r / sizes)))) / size
        trial = F(z + dz)
        better = cost(trial, sizes) < cost(r, sizes)
        largest = jnp.where(better, jnp.maximum(largest, jnp.abs(z + dz)), largest)
        tiny = jnp.all(jnp.abs(dz) <= 4 * eps * largest)
        z, r = jnp.where(better, z + dz, z), jnp.where(better, trial, r)
        small = jnp.where(tiny | ~finite | (~better & (damping < 1e-13)) | (damping > 1e8), 1, 0)
        damping = jnp.where(better, damping * jnp.where(damping < 1e-6, 0.0, 0.03), 10 * jnp.maximum(damping, 1e-14))
        return z, r, largest, damping, small, k + 1

    def going(carry: tuple[Any, ...]):
        return (carry[4] == 0) & (carry[5] < _MAX_STEPS)

    def search(carry: tuple[Any, ...]):
        _, damping, _ = carry
        counters = jnp.zeros((), int), jnp.zeros((), int)
        z, r, largest, *_ = jax.lax.while_loop(going, step, (guess, F(guess), jnp.abs(guess), damping, *counters))
        # If the guess was 0.1 m, 1e-17 m is zero within rounding, and is replaced by 0. Otherwise a spring's force at
        # 1e-17 m would be as large as its own terms, and `linearize` would report that the motion is not steady.
        rounded = jnp.where(jnp.abs(z) <= eps**0.5 * largest, 0.0, z)
        sizes = row_sizes(jacobian(F, z), equations.sizes(z, largest, args))
        costs = cost(r, sizes), cost(F(rounded), sizes)
        z = jnp.where(costs[1] <= costs[0], rounded, z)
        return z, jnp.where(damping > 0, 0.0, -1.0), jnp.minimum(*costs) > len(sizes) * rank_tolerance(z.dtype) ** 2

    # The size of an equation whose terms are all zero at the guess is a guess too. If it is too small by powers of ten,
    # no damped step is better. The search is then repeated with a first step of Newton's method.
    start = guess, jnp.asarray(1e-2, guess.dtype), jnp.array(True)
    return jax.lax.while_loop(lambda carry: carry[2] & (carry[1] >= 0), search, start)[0]


@levenberg_marquardt.defjvp
def _levenberg_marquardt_jvp(equations: SteadyEquations, primals: tuple[Any, ...], tangents: tuple[Any, ...]):
    guess, args = primals
    z = levenberg_marquardt(equations, guess, args)
    if not z.size:
        return z, jnp.zeros_like(z)
    _, dF = jax.jvp(lambda args: equations.residual(z, args), (args,), (tangents[1],))
    J = jacobian(lambda z: equations.residual(z, args), z)
    J = jnp.where(jnp.all(jnp.isfinite(J)), J, 0.0)  # without a solution the result is NaN already
    return z, least_norm(J, -dF, 10 * max(J.shape) * float(jnp.finfo(z.dtype).eps))


def jacobian(f: Callable[[Array], Any], x: Array) -> Numbers:
    """df/dx (m, n) at x (n,), one column after the other."""
    columns = jax.lax.map(lambda dx: jax.jvp(f, (x,), (dx,))[1], jnp.eye(x.shape[0], dtype=x.dtype))
    return jax.tree.map(lambda y: jnp.moveaxis(y, 0, -1), columns)


def cyclic_coordinates(system: System) -> tuple[str, ...]:
    """Names of the cyclic (ignorable) coordinates.

    The accelerations, the configuration constraints and the rates of the other coordinates do not depend on them.
    Examples are a bicycle's wheel angles, yaw and position. They may increase in a steady motion.

    They are detected by shifting each coordinate at trial states, times, inputs and parameters, once for each class and
    shape of the parameters. A dependence is therefore detected even if it vanishes for special parameters (a spring of
    zero stiffness) or for an input of zero (a force in the direction of a steer angle).

    **Raises:** `ValueError` if no trial has finite accelerations.
    """
    check_is_system(system)
    refuse_multipliers(system)
    leaves, treedef = jax.tree.flatten(jax.tree.map(jnp.asarray, system))
    shapes = tuple((jnp.shape(x), str(jnp.result_type(x))) for x in leaves)
    key = (type(system), str(treedef), shapes, version_of(system))
    with concretely():
        return _CYCLIC.get(key, lambda: _search_cyclic(system, leaves, treedef))


def _search_cyclic(system: System, leaves: list, treedef: Any) -> tuple[str, ...]:
    names, n_q = system.coordinates, len(system.coordinates)
    rng = np.random.default_rng(0)
    dtype = jnp.result_type(*leaves) if leaves else jnp.zeros(()).dtype

    @jax.jit
    def all_rates(trial: System, q: Coordinates, t: Array, u: Speeds, w: dict[str, Array]):
        rate = rates(trial, t, q, u, w)
        of_states = [] if rate.x is None else [rate.x]
        return rate.q, jnp.concatenate([rate.u, configuration_residual(trial, t, q), *of_states])

    # rows: the rates of the coordinates; the last row: speeds, constraints and states
    depends = np.zeros((n_q + 1, n_q), bool)
    compared = 0
    for k in range(_MOST_TRIALS):
        # Parameters near one; if the rates are not finite, the parameters of the system itself.
        trial = jax.tree.unflatten(treedef, [jnp.asarray(rng.uniform(0.5, 1.5, x.shape), x.dtype) for x in leaves])
        if k >= _MOST_TRIALS // 2 and is_concrete(leaves):
            trial = system
        q, u = rng.uniform(-0.4, 0.4, n_q), rng.uniform(-1.0, 1.0, len(system.speeds))
        size = _INPUTS[compared % len(_INPUTS)]
        names_of_inputs = (*system.inputs, *system.states)
        w = {name: size * rng.choice([-1, 1]) * rng.uniform(0.5, 1.5) for name in names_of_inputs}
        others = jax.tree.map(lambda x: jnp.asarray(x, dtype), (rng.uniform(0.0, 2.0), u, w))

        def rates_at(q: np.ndarray, trial: System = trial, others: tuple[Any, ...] = others):
            return [*map(np.asarray, all_rates(trial, jnp.asarray(q, dtype), *others))]

        before = rates_at(q)
        if not all(np.all(np.isfinite(x)) for x in before):
            continue
        for i, shift in itertools.product(range(n_q), _SHIFTS):
            depends[:, i] |= _changed_rates(before, rates_at(q + shift * np.eye(n_q)[i]), 1 + abs(shift))
        compared += 1
        if compared == _TRIALS:
            break
    if not compared:
        raise ValueError(
            f"{type(system).__name__}: the cyclic coordinates cannot be determined: the accelerations are not finite "
            f"at any of {_MOST_TRIALS} trial states, neither with parameters near one nor with those of the system."
        )
    non_cyclic = depends[-1].copy()  # coordinates on which the accelerations depend,
    while (extended := non_cyclic | depends[:-1][non_cyclic].any(axis=0)).sum() > non_cyclic.sum():
        non_cyclic = extended  # and those on which their rates depend
    return tuple(name for name, k in zip(names, non_cyclic, strict=True) if not k)


def _changed_rates(before: list[np.ndarray], after: list[np.ndarray], rounding: float) -> np.ndarray:
    """Which rates of the coordinates (n_q,) differ beyond rounding; the last entry is for all other rates."""
    tolerance = float(np.finfo(before[0].dtype).eps) ** 0.6 * rounding

    def changed(a: np.ndarray, b: np.ndarray):
        # If a rate is not finite after the shift of a cyclic coordinate, it was not finite before.
        return not np.all(np.abs(b - a) <= tolerance * (1.0 + np.abs(a).max(initial=0.0)))

    return np.array([*map(changed, before[0], after[0]), changed(before[1], after[1])])


def inputs_by_name(system: System, w: Float[Array, " n_w"]) -> dict[str, Any]:
    return {k: w[i] for i, k in enumerate(system.inputs)}


def _non_cyclic(system: System) -> np.ndarray:
    cyclic = cyclic_coordinates(system)
    return np.array([i for i, k in enumerate(system.coordinates) if k not in cyclic], int)


def check_dependent(system: System, dependent: Sequence[str], n_h: int) -> None:
    """**Raises:** `ValueError` if the number of named coordinates is not the number `n_h` of configuration
    constraints."""
    name, n, known = type(system).__name__, len(set(dependent)), system.coordinates
    refuse_unknown(dependent, known, f"{name}: `dependent` contains unknown names:", "the coordinates are")
    if n != n_h:
        raise ValueError(
            f"{name}: {n_h} configuration constraints determine {n_h} coordinates, but {n} are named "
            f"({', '.join(dependent) or 'none'}). Pass {n_h} of {', '.join(known)} as linearize(..., dependent=(...))."
        )


_STEADY = 0.4
"""A force or a rate is regarded as zero if it is below eps**0.4 = 5e-7 times the size of its own terms."""


def _relative_imbalance(
    system: System, t: Array, q: Coordinates, u: Speeds, values: dict[str, Array], still: Sequence[int] | np.ndarray
):
    """|f| (n,), |q_dot| (n_q,), |x_dot| (n_x,) and |h| (h,) relative to the sizes of their terms."""
    sizes = coordinate_sizes(system, q), abs(u), jax.tree.map(abs, values)
    size = sizes_of(system, t, q, u, values, sizes, np.array(still, int))
    if isinstance(q, np.ndarray):
        q_dot, f = rates_and_forcing.numpy(system, t, q, u, values)
        x_dot = first_order_rates.numpy(system, t, q, u, values, np.zeros_like(u)) if system.states else size.x_dot
        h = configuration_residual.numpy(system, t, q)
    else:
        q_dot, f, x_dot, h = _imbalance(system, t, q, u, values)
    pairs = ((f, size.f), (q_dot, size.q_dot), (x_dot, size.x_dot), (h, size.h))
    return tuple(relative(y, of_terms) for y, of_terms in pairs)


_relative_imbalance_by_jax = jit(_relative_imbalance)


def is_not_steady(
    system: System, t: Array, q: Coordinates, u: Speeds, x: Float[Array, " n_x"], w: Float[Array, " n_w"], steady: bool
):
    """Whether a state violates the constraints, is not finite, has closed contacts or, with `steady`, is not
    steady."""
    values, still = values_of(system, x, inputs_by_name(system, w)), _non_cyclic(system)
    f, q_dot, x_dot, h = _relative_imbalance(system, t, q, u, values, still)
    zero = jnp.concatenate([f, q_dot[still], x_dot, h] if steady else [h])
    fine = jnp.all(zero <= float(jnp.finfo(q.dtype).eps) ** _STEADY) & ~jnp.any(closed_contacts(system, t, q))
    return jax.lax.stop_gradient(~(fine & jnp.all(jnp.isfinite(jnp.concatenate([q, u, x, w, t[None]])))))


def check_steady(
    system: System, t: Array, q: Coordinates, u: Speeds, x: Float[Array, " n_x"], w: Float[Array, " n_w"], steady: bool
) -> None:
    """Raise the exception that belongs to `is_not_steady`, for concrete numbers."""
    name, inputs, still = type(system).__name__, inputs_by_name(system, w), _non_cyclic(system)
    names = (*system.coordinates, *system.speeds, *system.states, *system.inputs, "t")
    numbers = np.concatenate([np.asarray(y) for y in (q, u, x, w, t[None])])
    bad = [k for k, value in zip(names, numbers, strict=True) if not np.isfinite(value)]
    if bad:
        raise ValueError(f"{name}: {', '.join(bad)} is not finite, so the linear model does not exist.")
    refuse_closed_contacts(system, closed_contacts(system, t, q))
    values = values_of(system, x, inputs)
    rate = rates_by_numpy(system, t, q, u, x, inputs)
    if rate is None:
        rate = _rates(system, t, q, u, values)
        found = _relative_imbalance_by_jax(system, t, q, u, values, tuple(still.tolist()))
    else:
        system_now, *at = jax.device_get((system, t, q, u, values))
        found = _relative_imbalance(system_now, at[0], at[1], at[2], at[3], still)
    f, q_dot, x_dot, h = map(np.asarray, found)
    tolerance = float(np.finfo(q.dtype).eps) ** _STEADY
    if not np.all(h <= tolerance):
        h = np.asarray(configuration_residual(system, t, q))
        raise ValueError(
            f"{name}: the coordinates violate the configuration constraints by {h}. Find consistent coordinates with "
            "jaxkane.assemble(system, q, u)."
        )
    if not np.all(np.isfinite(np.concatenate([rate.q, rate.u]))):
        wrong = diagnosis(system, t, q, u, values)
        raise ValueError(wrong or f"{name}: rates are not finite there, so the linear model does not exist.")
    if not steady:
        return
    changes = [(f"{k} is accelerated by", *y) for k, *y in zip(system.speeds, rate.u, f, strict=True)]
    changes += [(f"{system.coordinates[i]} changes with", rate.q[i], q_dot[i]) for i in still]
    of_states = x if rate.x is None else rate.x
    changes += [(f"{k} changes with", of_states[i], x_dot[i]) for i, k in enumerate(system.states)]
    moving = [f"{k} {float(y):.3g}" for k, y, imbalance in changes if not imbalance <= tolerance]
    if moving:
        raise ValueError(
            f"{name}: this motion is not steady: {', '.join(moving)}. Find a steady motion with equilibrium or "
            "steady_turn, or linearize at one instant with linearize(..., steady=False)."
        )


_rates = jit(rates)
