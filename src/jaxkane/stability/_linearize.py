"""Linear models about steady motions, on the constraint manifold; and systems with other independent speeds."""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._common.lookup import as_names, refuse_unknown
from .._integrate.inputs import Coordinates, Speeds
from .._integrate.trajectory import refuse_other_system
from .._kane.api import dependent_speeds, diagnosis
from .._kane.arguments import (
    as_array,
    check_is_system,
    checked_inputs,
    is_concrete,
    is_one_number,
    refuse_incomplete,
    refuse_multipliers,
)
from .._kane.checks import check_system
from .._kane.constraint_residuals import SINGULAR_ROUNDING, configuration_residual
from .._kane.contact.forces import has_contacts
from .._kane.right_hand_side import MeasurementContext, has_outputs, output_names, outputs_at, rates, values_of
from .._scalarjit.cache_key import jit
from .._scalarjit.components import Component, Numbers, as_vector, solve, stack
from .._scalarjit.nan import nan_where
from .._scalarjit.scalar_function import ScalarFunction
from .._system.motion import Motion
from .._system.parameters import concrete_numbers, parameters_in, text_of, wrapped
from .._system.system import NamedVector, State, System, call_with_states
from ._matrix_eigenvalues import Eig, eig, eigenvalues_text, eigvals
from ._steady import (
    SteadyMotion,
    check_dependent,
    check_steady,
    cyclic_coordinates,
    inputs_by_name,
    is_not_steady,
    jacobian,
)

Place: TypeAlias = tuple[System, Array, Coordinates, Speeds, Float[Array, " n_x"], Float[Array, " m"]]
"""System, time, coordinates, speeds, first-order states and inputs about which to linearize."""

Outputs = Sequence[str] | Mapping[str, Callable[..., Any]] | None


class LinearModel(eqx.Module):
    """x_dot = A x + B w, y = C x + D w for small deviations x, w, y from a motion.

    Attributes:

    - `A` (n, n), `B` (n, m), `C` (p, n), `D` (p, m): in SI units and radians. A batch has leading axes.
    - `states`, `inputs`, `outputs`: their names.

    `eigenvalues` (n,) of A are differentiable, see `jaxkane.stability.eigenvalues`.
    """

    A: Float[Array, "*batch n n"]
    B: Float[Array, "*batch n m"]
    C: Float[Array, "*batch p n"]
    D: Float[Array, "*batch p m"]
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)

    def __iter__(self):
        return iter((self.A, self.B, self.C, self.D))

    @property
    def eig(self) -> Eig:
        """Eigenvalues (n,), right eigenvectors (n, n) in columns, and the condition (n,) of each eigenvalue."""
        return eig(self.A)

    @property
    def eigenvalues(self) -> Array:
        """Eigenvalues (n,) without eigenvectors. For a large batch of small models this is ten times as fast as
        `eig`."""
        return eigvals(self.A)

    def __repr__(self) -> str:
        rows = [f"{kind}: {', '.join(getattr(self, kind)) or 'none'}" for kind in ("states", "inputs", "outputs")]
        text, A = wrapped(f"LinearModel({'; '.join(rows)})"), concrete_numbers(self.A)
        if A is None or A.ndim > 2:
            return f"{text}\nA: {text_of(self.A, ndim=2)}"
        # NumPy, because JAX would compile a program. NumPy refuses NaN, as in the model of an impossible motion.
        values = np.linalg.eigvals(A) if np.isfinite(A).all() else np.full(len(A), np.nan)
        return f"{text}\n{wrapped(f'Eigenvalues [1/s]: {eigenvalues_text(values)}')}"


def linearize(
    system: System,
    motion: State | SteadyMotion,
    inputs: Mapping[str, Component] | None = None,
    *,
    t: Component | None = None,
    states: Sequence[str] | None = None,
    outputs: Outputs = None,
    dependent: Sequence[str] | None = None,
    steady: bool = True,
) -> LinearModel:
    """The linear model of a system about an equilibrium or a steady motion, exact to rounding.

        x = (independent coordinates, independent speeds, states of the first order)
        h(q) = 0:  dq_dep = -(dh/dq_dep)^-1 dh/dq_ind dq_ind

    Dependent coordinates satisfy the constraints to first order; dependent speeds are computed by Kane's method. The
    derivatives of the equations of motion are those of `jax.jvp`. The model is differentiable and can be used under jit
    and vmap.

    **Arguments:**

    - `system`: the system.
    - `motion`: a `SteadyMotion`, or a `State` as from `assemble`.
    - `inputs`: values by name about which to linearize. Default: those of the `SteadyMotion`, or zero.
    - `t`: time [s].
    - `states`: names of coordinates, speeds and states of the first order to keep. Default: all independent ones
        without the cyclic coordinates. The deviations of omitted ones are zero.
    - `outputs`: names of coordinates, speeds (also dependent ones), states of the first order and outputs of the
        system. Default: the states. Or functions by name, `{"lean_rate": lambda t, q, u: ...}`, which read coordinates
        and speeds by name.
    - `dependent`: names of the coordinates that the constraints determine. Default: `system.dependent_coordinates`.
    - `steady`: refuse a state that is not steady. Pass False to linearize at one instant of any motion.

    **Returns:** a `LinearModel`. It can be unpacked: `A, B, C, D = linearize(...)`.

    **Raises:** `ValueError` for unknown names, a motion that is not steady, a closed contact, coordinates that violate
    the constraints, dependent coordinates that the constraints do not determine, an impossible parameter, or singular
    equations. Under a trace the matrices and their derivatives are NaN instead.
    """
    name = type(system).__name__
    check_is_system(system)
    refuse_multipliers(system)
    if isinstance(motion, SteadyMotion):
        refuse_other_system(f"linearize({name})", system, motion)
        inputs = motion.inputs if inputs is None else inputs
        t = motion.t if t is None else t
    elif not isinstance(motion, State):
        raise TypeError(
            f"linearize({name}): `motion` must be a State (see assemble) or a SteadyMotion; got {motion!r}."
        )
    refuse_incomplete(system, motion.q, motion.u)
    q = as_array(motion.q, system.coordinates, f"{name}: q")
    u = as_array(motion.u, system.speeds, f"{name}: u")
    t = jnp.asarray(0.0 if t is None else t, q.dtype)
    x = as_array({} if motion.x is None else motion.x, system.states, f"{name}: x").astype(q.dtype)
    w = checked_inputs(system, inputs)
    w = jnp.stack([jnp.asarray(w[k], q.dtype) for k in system.inputs]) if w else jnp.zeros(0, q.dtype)
    check_system(system, t, q)
    origin = (system, t, q, u, x, w)
    n_h = jax.eval_shape(lambda q: configuration_residual(system, t, q), q).shape[0]
    dependent = system.dependent_coordinates if dependent is None else as_names(dependent, "dependent")
    check_dependent(system, dependent, n_h)
    if is_concrete(*origin):
        check_steady(*origin, steady)
    states = _state_names(system, states, dependent)
    rows = states if outputs is None else as_names(outputs, "outputs")
    functions = dict(outputs) if isinstance(outputs, Mapping) else {}
    own = output_names(system) if outputs is not None else ()
    known = (*system.coordinates, *system.speeds, *system.dependent_speeds, *system.states, *own)
    refuse_unknown(
        rows, (*known, *functions), f"{name}: `outputs` must be names or a dict of functions; unknown:", "there are"
    )
    wrong = jnp.array(False)
    if not is_concrete(*origin):  # for concrete numbers an exception reports it instead
        allowed = [jnp.all(info.allows(value)) for _, value, info in parameters_in(system) if info.is_limited]
        wrong = is_not_steady(*origin, steady) | ~jnp.all(jnp.stack([jnp.array(True), *allowed]))
    (A, B, C, D), follows = _derivatives(origin, wrong, _ModelNames(dependent, states, rows), functions)
    if is_concrete(*origin, A) and not (follows and all(np.isfinite(M).all() for M in (A, B, C, D))):
        raise ValueError(_no_linear_model(origin, dependent, bool(follows)))
    return LinearModel(A, B, C, D, states, tuple(system.inputs), rows)


def _no_linear_model(origin: Place, dependent: tuple[str, ...], follows: bool) -> str:
    system, t, q, u, x, w = origin
    name = type(system).__name__
    if not follows:
        place = ", ".join(f"{k} = {float(x):.4g}" for k, x in zip(system.coordinates, q, strict=True))
        return (
            f"{name}: the configuration constraints do not determine {', '.join(dependent)} to first order at {place}. "
            f"Pass other coordinates as linearize(..., dependent=(...)): {', '.join(system.coordinates)}."
        )
    return diagnosis(system, t, q, u, values_of(system, x, inputs_by_name(system, w))) or (
        f"{name}: the linear model does not exist: derivatives of the equations or outputs are not finite there."
    )


def _state_names(system: System, states: Sequence[str] | None, dependent: tuple[str, ...]) -> tuple[str, ...]:
    free = tuple(c for c in system.coordinates if c not in dependent)
    if states is None:
        cyclic = cyclic_coordinates(system)
        return (*(c for c in free if c not in cyclic), *system.speeds, *system.states)
    name, known, states = type(system).__name__, (*free, *system.speeds, *system.states), as_names(states, "states")
    have = "independent coordinates, speeds and states of the first order are"
    refuse_unknown(states, known, f"{name}: these cannot be in `states`:", have)
    if len(set(states)) < len(states):
        raise ValueError(f"{name}: {', '.join(k for k in known if states.count(k) > 1)} is named twice in `states`.")
    return states


class _ModelNames(eqx.Module):
    dependent: tuple[str, ...] = eqx.field(static=True)
    states: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)


@jit
def _derivatives(
    origin: Place, wrong: Bool[Array, ""], model_names: _ModelNames, functions: dict[str, Callable[..., Any]]
):
    # Replace NaN by numbers: NaN would reach the gradients of callers who do not use the result (0 * NaN).
    at: Any = (origin[0], *(jnp.where(jnp.all(jnp.isfinite(y)), y, 0.1) for y in origin[1:]))
    q, w = at[2], at[5]
    T = _tangents(*at[:3], model_names)
    x = jnp.zeros(len(model_names.states), q.dtype)
    # Two loops: XLA removes the second one if only A is used.
    A, C = jacobian(lambda x: _at_deviation(x, w, at, T, model_names, functions), x)
    B, D = jacobian(lambda w: _at_deviation(x, w, at, T, model_names, functions), w)
    # If entries of T are larger than this, rounding errors are as large as the result.
    follows = jnp.max(jnp.abs(jax.lax.stop_gradient(T)), initial=0.0) < 1 / SINGULAR_ROUNDING
    return nan_where(wrong | ~follows, (A, B, C, D), origin), follows


def _at_deviation(
    x: Float[Array, " n"],
    w: Float[Array, " m"],
    at: Place,
    T: Float[Array, "n_q n_q"],
    model_names: _ModelNames,
    functions: dict[str, Callable[..., Any]],
):
    """Rates of the states (n,) and the outputs (p,), for deviations x (n,) of the states and inputs w (m,)."""
    system, t, q, u, x1, _ = at
    names, speeds = system.coordinates, (*system.speeds, *system.dependent_speeds)
    moved = dict(zip(model_names.states, x, strict=True))
    q = q + sum((moved[k] * T[:, i] for i, k in enumerate(names) if k in moved), jnp.zeros_like(q))
    u = as_vector([u[i] + moved[k] if k in moved else u[i] for i, k in enumerate(system.speeds)], q)
    x1 = [x1[i] + moved[k] if k in moved else x1[i] for i, k in enumerate(system.states)]
    values = inputs_by_name(system, w) | dict(zip(system.states, x1, strict=True))
    rate = rates(system, t, q, u, values)
    of_states = () if rate.x is None else rate.x
    all_names = (*names, *system.speeds, *system.states)
    x_dot = dict(zip(all_names, (*rate.q, *rate.u, *of_states), strict=True))
    known = dict(zip(all_names, (*q, *u, *x1), strict=True))
    if not {*functions, *known, *system.dependent_speeds} >= {*model_names.outputs}:
        known |= outputs_at(system, t, q, u, values)
    if functions or not known.keys() >= {*model_names.outputs}:
        known |= zip(system.dependent_speeds, dependent_speeds(system, t, q, u), strict=True)
    y = []
    for k in model_names.outputs:
        if k in functions:
            value = functions[k](t, NamedVector(q, names), NamedVector([known[s] for s in speeds], speeds))
            if not is_one_number(value):
                raise TypeError(f"{type(system).__name__}: the output {k!r} must be one number, got {value!r}.")
            y.append(jnp.asarray(value, q.dtype))
        else:
            y.append(known[k])
    return tuple(jnp.stack(z) if z else jnp.zeros(0, q.dtype) for z in ([x_dot[k] for k in model_names.states], y))


@ScalarFunction
def _tangents(system: System, t: Array, q: Coordinates, model_names: _ModelNames):
    """T (n_q, n_q): column i contains the changes of all coordinates with the i-th one; zero for dependent ones."""
    names = system.coordinates
    d = [names.index(k) for k in model_names.dependent]
    T = [[float(i == j and i not in d) for j in range(len(names))] for i in range(len(names))]
    if d:
        _, along = jax.linearize(lambda q: configuration_residual(system, t, q), q)
        G = [along(jnp.asarray(dq)) for dq in np.eye(len(names), dtype=q.dtype)]  # columns of dh/dq (h, n_q)
        free = [j for j in range(len(names)) if j not in d]
        moves = solve([[G[j][i] for j in d] for i in range(len(d))], *([-x for x in G[j]] for j in free))
        for j, move in zip(free, moves, strict=True):
            for i, x in zip(d, move, strict=True):
                T[i][j] = x
    return stack(T).astype(q.dtype)


class _WithSpeeds(System):
    inner: System
    independent: tuple[str, ...] = eqx.field(static=True)
    dependent: tuple[str, ...] = eqx.field(static=True)

    def _in_order(self, u: Numbers) -> NamedVector:
        names = (*self.inner.speeds, *self.inner.dependent_speeds, *self.inner.auxiliary_speeds)
        return NamedVector([u[name] for name in names], names)

    def _of_inner(self, now: MeasurementContext) -> Any:
        """`now` with the accelerations in the order of the inner system's speeds."""
        names = (*self.inner.speeds, *self.inner.dependent_speeds)
        now, u_dot = copy.copy(now), now.u_dot
        now.u_dot = NamedVector([u_dot[name] for name in names], names)
        return now

    def q_dot(self, t: Component, q: NamedVector, u: NamedVector):
        return self.inner.q_dot(t, q, self._in_order(u))

    def motion(self, t: Component, q: NamedVector, u: NamedVector):
        return self.inner.motion(t, q, self._in_order(u))

    def loads(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion, inputs: Mapping[str, Component]):
        return self.inner.loads(t, q, self._in_order(u), motion, inputs)

    def state_rates(
        self,
        t: Component,
        q: NamedVector,
        u: NamedVector,
        x: NamedVector | tuple[()],
        motion: Motion,
        now: MeasurementContext,
    ):
        return self.inner.state_rates(t, q, self._in_order(u), x, motion, self._of_inner(now))

    def configuration_constraints(self, t: Component, q: NamedVector):
        return self.inner.configuration_constraints(t, q)

    def implied_constraints(self, t: Component, q: NamedVector):
        return self.inner.implied_constraints(t, q)

    def events(self, t: Component, q: NamedVector, u: NamedVector, x: NamedVector | tuple[()] = ()):
        return call_with_states(self.inner.events, t, q, self._in_order(u), x)


for _name in ("coordinates", "auxiliary_speeds", "dependent_coordinates", "inputs", "states", "units", "check_inertia"):
    setattr(_WithSpeeds, _name, property(lambda self, name=_name: getattr(self.inner, name)))
setattr(_WithSpeeds, "speeds", property(lambda self: self.independent))  # noqa: B010
setattr(_WithSpeeds, "dependent_speeds", property(lambda self: self.dependent))  # noqa: B010


class _WithSpeedsAndOutputs(_WithSpeeds):
    def outputs(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion, now: MeasurementContext):
        return self.inner.outputs(t, q, self._in_order(u), motion, self._of_inner(now))


def with_speeds(system: System, speeds: Sequence[str]) -> System:
    """The same system with other independent speeds, for motions in which its own do not determine the others.

    Example: a bicycle pivots about its rear wheel's contact. It has a yaw rate, although the rear wheel, roll and steer
    do not move: `with_speeds(bicycle, ("roll_rate", "yaw_rate", "steer_rate"))`. `jaxkane.best_dependent_speeds` finds
    a well-conditioned choice.

    **Arguments:**

    - `system`: the system.
    - `speeds`: names of the new independent speeds, as many as before. They may be independent or dependent speeds of
        `system`.

    **Returns:** a system whose parameters are those of `.inner`. Everything else is unchanged.

    **Raises:** `ValueError` for other names, or another number of them.
    """
    everything = (*system.speeds, *system.dependent_speeds)
    speeds = as_names(speeds, "speeds")
    if len(set(speeds)) != len(system.speeds) or not set(speeds) <= set(everything) or len(speeds) != len(set(speeds)):
        raise ValueError(
            f"{type(system).__name__}: `speeds` must name {len(system.speeds)} different speeds of "
            f"{', '.join(everything)}; got {', '.join(speeds)}."
        )
    inner: Any = type(system)
    base: Any = _WithSpeedsAndOutputs if has_outputs(system) else _WithSpeeds
    return _class_with(inner, base, has_contacts(system))(
        system, speeds, tuple(name for name in everything if name not in speeds)
    )


@functools.lru_cache(maxsize=1000)
def _class_with(inner: Any, base: Any, contacts: bool) -> Any:
    # A subclass with the name of the inner class, which messages show.

    def contacts_of_inner(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion):
        return self.inner.contacts(t, q, self._in_order(u), motion)

    own = {"contacts": contacts_of_inner} if contacts else {}
    return type(base)(inner.__name__, (base,), {"__doc__": inner.__doc__, **own})
