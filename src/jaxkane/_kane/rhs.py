"""The right-hand side: rates of coordinates, speeds and states of the first order, and outputs beside them.

Knows Kane's equations; knows no integrator.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Self

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._common.lookup import not_there, refuse_unknown
from .._scalarjit.components import Component, add3, component, cross, is_exact
from .._scalarjit.function import ScalarFunction
from .._scalarjit.linear import as_vector, is_written_out
from .._system.kinematics import Frame, Point, Vector
from .._system.motion import Motion
from .._system.system import NamedVector, State, System, packed, unpacked
from .arguments import Inputs, Row, as_row, inputs_of
from .evaluate import jvp
from .kane import KaneEquations, motion_rates
from .reactions import Reactions


class Now(Inputs):
    """One instant, as `state_rates` and `outputs` receive it: `now["command"]` is an input or a state by name.

    Attributes: `u_dot`, the time derivatives of all speeds, dependent ones too, by place and by name.
    """

    def __init__(self, instant: KaneEquations, N: Frame, u_dot: NamedVector, answers: Iterator[Row] | None):
        super().__init__(instant.inputs, inputs_of(instant.system))
        self.u_dot = u_dot
        self._instant, self._N, self._answers = instant, N, answers
        self._asked: list[Vector] = []

    def with_values(self, values: Mapping[str, Component]) -> Self:
        """The same instant, for a part of a system that receives other inputs than the system does."""
        other = copy.copy(self)
        other.update(values)
        return other

    def acceleration(self, point: Point) -> Vector:
        """Of a Point in the inertial frame [m/s^2]."""
        if not isinstance(point, Point):
            raise TypeError(f"now.acceleration(point): a Point is asked for, got {point!r}. Of a body, its `center`.")
        return self._rate(point.velocity)

    def angular_acceleration(self, frame: Frame) -> Vector:
        """Of a Frame in the inertial frame [rad/s^2]."""
        if not isinstance(frame, Frame):
            raise TypeError(f"now.angular_acceleration(frame): a Frame is asked for, got {frame!r}.")
        return self._rate(frame.angular_velocity)

    def force(self, name: str) -> Any:
        """What constraints carry at a named point [N] or frame [N m], a Vector, or along an auxiliary speed, a number:
        as `jaxkane.constraint_forces` gives it by that name."""
        forces = self._forces
        if name not in forces:
            raise not_there(name, forces, "the named points, frames and auxiliary speeds")
        found = forces[name]
        return self._N.vector(*found) if isinstance(found, tuple) else found

    @property
    def multipliers(self) -> Row:
        """Of the velocity residuals (k,): as `jaxkane.constraint_multipliers` gives them."""
        return self._reactions.multipliers

    @functools.cached_property
    def _reactions(self) -> Reactions:
        now = self._instant
        return Reactions(now.system, now.t, now.q, now.u, dict(now.inputs), self.u_dot[: now.n])

    @functools.cached_property
    def _forces(self) -> dict[str, Any]:
        return dict([*self._reactions.forces_of_parts(), *self._reactions.forces_of_auxiliary_speeds()])

    def _rate(self, vector: Vector) -> Vector:
        self._asked.append(vector)
        if self._answers is None:
            one = jnp.ones((), self._instant.dtype)
            return Vector(vector.frame, (one, one, one))
        return Vector(vector.frame, next(self._answers))  # type: ignore[arg-type]


Read = Callable[[System, Component, Row, Row, Motion, Now], Any]


def read_at(now: KaneEquations, u_dot: Row, read: Read) -> Any:
    """What `read` finds in the description at an instant, whose independent speeds change with `u_dot` (n,)."""
    u_dot_all = (*u_dot, *now.dependent_accelerations(u_dot))
    names = (*now.system.speeds, *now.system.dependent_speeds)

    def reading(t: Component, q: Row, u: Row, answers: Iterator[Row] | None = None) -> tuple[Any, Now]:
        motion = now.motion(t, q, u)
        given = Now(now, motion.N, NamedVector(u_dot_all, names), answers)
        return read(now.system, t, q, u, motion, given), given

    # Points that are made while it is read divide by speeds, perhaps: by no exact zero.
    q, u = (tuple(jnp.asarray(x, now.dtype) if is_exact(x) else x for x in row) for row in (now.q, now.u_all))
    found, given = reading(now.t, q, u)
    if not given._asked:
        return found
    n_q = len(q)

    def asked(t: Component, *z: Component) -> list[Row]:
        return [vector.components for vector in reading(t, z[:n_q], z[n_q:])[1]._asked]

    values, rates = jvp(asked, (now.t, *q, *u), (1.0, *now.q_dot, *u_dot_all))
    turning = [vector.frame.angular_velocity.components for vector in given._asked]
    # dv/dt in N = derivative of the components + omega x v
    answers = [add3(rate, cross(w, v)) for rate, w, v in zip(rates, turning, values, strict=True)]
    return reading(now.t, q, u, iter(answers))[0]


def _outputs(system: System, t: Component, q: Row, u: Row, motion: Motion, now: Now) -> dict[str, Component]:
    return flatten_outputs(system, system.outputs(t, q, u, motion, now))


def flatten_outputs(system: System, given: Any) -> dict[str, Component]:
    """Outputs by name, those of nested dicts joined by dots.

    **Raises:** `TypeError` for what is no number; `ValueError` for a name that stands for something else already.
    """
    label = f"{type(system).__name__}.outputs"
    found = _flat(label, given)
    taken = (*system.coordinates, *system.speeds, *system.dependent_speeds, *system.inputs, *system.states)
    twice = [name for name in found if name in taken]
    if twice:
        raise ValueError(
            f"{label}: {', '.join(twice)} is the name of a coordinate, a speed, an input or a state already, and "
            f"trajectories are read by name. Call what a sensor says of it otherwise: {'measured_' + twice[0]!r}."
        )
    return found


def _flat(label: str, given: Any) -> dict[str, Component]:
    if not isinstance(given, Mapping):
        hint = " Does it end without a `return`?" if given is None else ""
        raise TypeError(f"{label} returns numbers by name, in a dict; got {given!r}.{hint}")
    found: dict[str, Component] = {}
    for name, value in given.items():
        if not isinstance(name, str) or not name:
            raise TypeError(f"{label}: the name of an output is a string, got {name!r}.")
        inner = {f"{name}.{k}": x for k, x in _flat(label, value).items()} if isinstance(value, Mapping) else None
        for key, x in ({name: value} if inner is None else inner).items():
            if key in found:
                raise ValueError(f"{label}: the name {key!r} stands for two outputs.")
            found[key] = x if inner is not None else _number(label, key, x)
    return found


def _number(label: str, name: str, value: Any) -> Component:
    if isinstance(value, Vector):
        raise TypeError(f"{label}: {name!r} is a Vector; give its components, as in `a, b, c = v.to(frame)`.")
    try:
        return component(value)
    except TypeError as error:
        raise TypeError(f"{label}: {name!r} is one number: {error}") from None


def has_outputs(system: System) -> bool:
    """Whether a system says anything beside its coordinates, speeds, inputs and states."""
    return type(system).outputs is not System.outputs


def outputs_at(system: System, t: Array, q: Array, u: Array, inputs: Mapping[str, Array]) -> dict[str, Array]:
    """Outputs by name, from arrays that are known to fit; `inputs` holds the states too."""
    if not has_outputs(system):
        return {}
    inputs = dict(inputs)
    return _outputs_now(system, t, q, u, inputs, motion_rates(system, t, q, u, inputs)[1])


@ScalarFunction
def _outputs_now(system, t, q, u, inputs, u_dot):
    now = KaneEquations(system, t, q, u, inputs)
    found = read_at(now, as_row(u_dot, system.speeds, "u_dot"), _outputs)
    return {name: as_vector([x], q)[0] for name, x in found.items()}


def output_names(system: System) -> tuple[str, ...]:
    """The names of a system's outputs, in the order of the alphabet."""
    if not has_outputs(system):
        return ()
    q, u = (jnp.zeros(len(names)) for names in (system.coordinates, system.speeds))
    return tuple(jax.eval_shape(lambda t, q, u: outputs_at(system, t, q, u, {}), jnp.zeros(()), q, u))


def _state_rates(system: System, t: Component, q: Row, u: Row, motion: Motion, now: Now) -> Row:
    names, label = system.states, f"{type(system).__name__}.state_rates"
    return named_row(system.state_rates(t, q, u, [now[name] for name in names], motion, now), names, label)


def named_row(rates: Any, names: Sequence[str], label: str) -> Row:
    """Numbers in the order of `names`, or by name in a dict, as a row of components.

    **Raises:** `ValueError` or `TypeError` for what is not one number for each name.
    """
    if isinstance(rates, Mapping):
        refuse_unknown(rates, names, f"{label} names what is no state:")
        missing = [name for name in names if name not in rates]
        if missing:
            raise ValueError(f"{label} gives no rate of {', '.join(missing)}.")
        rates = [rates[name] for name in names]
    if isinstance(rates, (float, int)) or (hasattr(rates, "shape") and not rates.shape):
        rates = (rates,)  # the rate of a single state needs no tuple
    return as_row(rates, names, label)


def rates(system: System, t: Array, q: Array, u: Array, values: dict[str, Array]) -> State:
    """The right-hand side: the time derivatives of coordinates, independent speeds and states of the first order, from
    arrays that are known to fit; `values` of inputs and states by name."""
    if not system.states:
        return State(*motion_rates(system, t, q, u, values))
    x = as_vector([values[name] for name in system.states], q)
    return unpacked(system, vector_field(system, t, packed(State(q, u, x)), values))


def vector_field(system: System, t: Array, y: Array, inputs: Mapping[str, Any]) -> Array:
    """The right-hand side as a solver asks for it: of a packed state (n_q + n_u + n_x,), packed, so that one array goes
    through the steps."""
    if is_written_out(len(system.speeds)):
        return _vector_field(system, t, y, dict(inputs))
    state = unpacked(system, y)
    values = values_of(system, state.x, inputs)
    q_dot, u_dot = motion_rates(system, t, state.q, state.u, values)
    x_dot = first_order_rates(system, t, state.q, state.u, values, u_dot) if system.states else None
    return packed(State(q_dot, u_dot, x_dot))


def rates_are_native(system: System, t: Array, y: Array, inputs: Mapping[str, Any]) -> bool:
    """Whether `vector_field` of these is one native kernel."""
    return is_written_out(len(system.speeds)) and _vector_field.is_native(system, t, y, dict(inputs))


def values_of(system: System, x: Array | None, inputs: Mapping[str, Any]) -> dict[str, Any]:
    """Inputs and states by name, as `loads` reads them; `x` (..., n_x)."""
    return {**inputs, **{name: x[..., i] for i, name in enumerate(system.states)}} if x is not None else dict(inputs)


@ScalarFunction
def _vector_field(system, t, y, inputs):
    state = unpacked(system, y)
    now = KaneEquations(system, t, state.q, state.u, values_of(system, state.x, inputs))
    u_dot = now.accelerations()
    x_dot = read_at(now, u_dot, _state_rates) if system.states else ()
    return as_vector((*now.q_dot, *u_dot, *x_dot), y)


@ScalarFunction
def first_order_rates(system, t, q, u, inputs, u_dot):
    """x_dot (n_x,) at the accelerations u_dot (n,)."""
    now = KaneEquations(system, t, q, u, inputs)
    return as_vector(read_at(now, as_row(u_dot, system.speeds, "u_dot"), _state_rates), q)
