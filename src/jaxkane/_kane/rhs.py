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
from .._scalarjit.components import Component, add3, as_vector, component, cross, is_exact, is_written_out
from .._scalarjit.function import ScalarFunction, tree_of
from .._system.kinematics import Frame, Point, Vector
from .._system.motion import Motion
from .._system.system import NamedVector, State, System, has_outputs, packed, unpacked
from .arguments import Inputs, Row, as_row, inputs_of
from .kanes_method import KaneEquations, jvp, motion_rates
from .reactions import Reactions


class MeasurementContext(Inputs):
    """What `state_rates` and `outputs` receive as `now`: `now["command"]` is an input or a state by name.

    Attributes: `u_dot`, the time derivatives of all speeds, dependent ones too, by place and by name.
    """

    def __init__(self, kane: KaneEquations, N: Frame, u_dot: NamedVector, rates: Iterator[Row] | None):
        super().__init__(kane.inputs, inputs_of(kane.system))
        self.u_dot = u_dot
        self._kane, self._N, self._rates = kane, N, rates
        self._vectors: list[Vector] = []  # whose rates are needed

    def with_values(self, values: Mapping[str, Component]) -> Self:
        """The same context, for a part of a system that receives other inputs than the system does."""
        context = copy.copy(self)
        context.update(values)
        return context

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
        if name not in self._forces:
            raise not_there(name, self._forces, "the named points, frames and auxiliary speeds")
        force = self._forces[name]
        return self._N.vector(*force) if isinstance(force, tuple) else force

    @property
    def multipliers(self) -> Row:
        """Of the velocity residuals (k,): as `jaxkane.constraint_multipliers` gives them."""
        return self._reactions.multipliers

    @functools.cached_property
    def _reactions(self) -> Reactions:
        kane = self._kane
        return Reactions(kane.system, kane.t, kane.q, kane.u, dict(kane.inputs), self.u_dot[: kane.n])

    @functools.cached_property
    def _forces(self) -> dict[str, Any]:
        return dict([*self._reactions.forces_of_parts(), *self._reactions.forces_of_auxiliary_speeds()])

    def _rate(self, vector: Vector) -> Vector:
        self._vectors.append(vector)
        if self._rates is None:
            one = jnp.ones((), self._kane.dtype)
            return Vector(vector.frame, (one, one, one))
        return Vector(vector.frame, next(self._rates))  # type: ignore[arg-type]


Method = Callable[[System, Component, Row, Row, Motion, MeasurementContext], Any]


def evaluate_with_accelerations(kane: KaneEquations, u_dot: Row, method: Method) -> Any:
    """`method` of the description at a state whose independent speeds change with `u_dot` (n,).

    It is evaluated once to learn which vectors' rates it needs, and once more with these, where there are any.
    """
    u_dot_all = (*u_dot, *kane.dependent_accelerations(u_dot))
    names = (*kane.system.speeds, *kane.system.dependent_speeds)

    def evaluate(t: Component, q: Row, u: Row, rates: Iterator[Row] | None = None) -> tuple[Any, list[Vector]]:
        motion = kane.motion(t, q, u)
        context = MeasurementContext(kane, motion.N, NamedVector(u_dot_all, names), rates)
        return method(kane.system, t, q, u, motion, context), context._vectors

    # Points that the method makes divide by speeds, perhaps: by no exact zero.
    q, u = (tuple(jnp.asarray(x, kane.dtype) if is_exact(x) else x for x in row) for row in (kane.q, kane.u_all))
    result, vectors = evaluate(kane.t, q, u)
    if not vectors:
        return result
    n_q = len(q)

    def components_of_vectors(t: Component, *z: Component) -> list[Row]:
        return [vector.components for vector in evaluate(t, z[:n_q], z[n_q:])[1]]

    values, rates = jvp(components_of_vectors, (kane.t, *q, *u), (1.0, *kane.q_dot, *u_dot_all))
    omegas = [vector.frame.angular_velocity.components for vector in vectors]
    # dv/dt in N = derivative of the components + omega x v
    rates_in_N = [add3(rate, cross(w, v)) for rate, w, v in zip(rates, omegas, values, strict=True)]
    return evaluate(kane.t, q, u, iter(rates_in_N))[0]


def _outputs(system: System, t: Component, q: Row, u: Row, motion: Motion, now: MeasurementContext) -> dict[str, Any]:
    """Outputs by name, those of nested dicts joined by dots.

    **Raises:** `TypeError` for what is no number; `ValueError` for a name that stands for something else already.
    """
    label = f"{type(system).__name__}.outputs"
    outputs = _flat(label, system.outputs(t, q, u, motion, now))
    reserved = (*system.coordinates, *system.speeds, *system.dependent_speeds, *system.inputs, *system.states)
    twice = [name for name in outputs if name in reserved]
    if twice:
        raise ValueError(
            f"{label}: {', '.join(twice)} is the name of a coordinate, a speed, an input or a state already, and "
            f"trajectories are read by name. Call what a sensor measures of it otherwise: {'measured_' + twice[0]!r}."
        )
    return outputs


def _flat(label: str, outputs: Any) -> dict[str, Component]:
    if not isinstance(outputs, Mapping):
        hint = " Does it end without a `return`?" if outputs is None else ""
        raise TypeError(f"{label} returns numbers by name, in a dict; got {outputs!r}.{hint}")
    flat: dict[str, Component] = {}
    for name, value in outputs.items():
        if not isinstance(name, str) or not name:
            raise TypeError(f"{label}: the name of an output is a string, got {name!r}.")
        if isinstance(value, Mapping):
            items = {f"{name}.{key}": x for key, x in _flat(label, value).items()}
        else:
            items = {name: _number(label, name, value)}
        for key, x in items.items():
            if key in flat:
                raise ValueError(f"{label}: the name {key!r} stands for two outputs.")
            flat[key] = x
    return flat


def _number(label: str, name: str, value: Any) -> Component:
    if isinstance(value, Vector):
        raise TypeError(f"{label}: {name!r} is a Vector; give its components, as in `a, b, c = v.to(frame)`.")
    try:
        return component(value)
    except TypeError as error:
        raise TypeError(f"{label}: {name!r} is one number: {error}") from None


def outputs_at(system: System, t: Array, q: Array, u: Array, inputs: Mapping[str, Array]) -> dict[str, Array]:
    """Outputs by name, from arrays that were checked; `inputs` holds the states too."""
    if not has_outputs(system):
        return {}
    inputs = dict(inputs)
    return _outputs_at(system, t, q, u, inputs, motion_rates(system, t, q, u, inputs)[1])


@ScalarFunction
def _outputs_at(system, t, q, u, inputs, u_dot):
    kane = KaneEquations(system, t, q, u, inputs)
    outputs = evaluate_with_accelerations(kane, as_row(u_dot, system.speeds, "u_dot"), _outputs)
    return {name: as_vector([x], q)[0] for name, x in outputs.items()}


def output_names(system: System) -> tuple[str, ...]:
    """The names of a system's outputs, in the order of the alphabet."""
    if not has_outputs(system):
        return ()
    q, u = (jnp.zeros(len(names)) for names in (system.coordinates, system.speeds))
    return tuple(jax.eval_shape(lambda t, q, u: outputs_at(system, t, q, u, {}), jnp.zeros(()), q, u))


def _state_rates(system: System, t: Component, q: Row, u: Row, motion: Motion, now: MeasurementContext) -> Row:
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
    arrays that were checked; `values` of inputs and states by name."""
    if not system.states:
        return State(*motion_rates(system, t, q, u, values))
    x = as_vector([values[name] for name in system.states], q)
    return unpacked(system, vector_field(system, t, packed(State(q, u, x)), values))


def rates_by_numpy(system: System, t: Any, q: Any, u: Any, x: Any, inputs: dict[str, Any]) -> State | None:
    """`rates` of numbers without compiling; None where NumPy cannot evaluate them."""
    args = system, t, packed(State(q, u, x if system.states else None)), inputs
    if not is_written_out(len(system.speeds)) or not _vector_field.is_numpy(*args):
        return None
    return unpacked(system, _vector_field.numpy(*args))


def vector_field(system: System, t: Array, y: Array, inputs: Mapping[str, Any], forward: bool = False) -> Array:
    """The right-hand side as a solver asks for it: of a packed state (n_q + n_u + n_x,), packed, so that one array goes
    through the steps. `forward`: with its derivative in forward mode as one operation."""
    packed_system, system = system, tree_of(system)
    if is_written_out(len(system.speeds)):
        written_out = _vector_field.in_forward_mode if forward else _vector_field
        return written_out(packed_system, t, y, dict(inputs))
    state = unpacked(system, y)
    values = values_of(system, state.x, inputs)
    q_dot, u_dot = motion_rates(system, t, state.q, state.u, values)
    x_dot = _first_order_rates(system, t, state.q, state.u, values, u_dot) if system.states else None
    return packed(State(q_dot, u_dot, x_dot))


def rates_are_native(system: System, t: Array, y: Array, inputs: Mapping[str, Any]) -> bool:
    """Whether `vector_field` of these is one native kernel."""
    return is_written_out(len(tree_of(system).speeds)) and _vector_field.is_native(system, t, y, dict(inputs))


def values_of(system: System, x: Array | None, inputs: Mapping[str, Any]) -> dict[str, Any]:
    """Inputs and states by name, as `loads` reads them; `x` (..., n_x)."""
    return {**inputs, **{name: x[..., i] for i, name in enumerate(system.states)}} if x is not None else dict(inputs)


@ScalarFunction
def _vector_field(system, t, y, inputs):
    state = unpacked(system, y)
    values = values_of(system, state.x, inputs)
    q_dot, u_dot = motion_rates(system, t, state.q, state.u, values)
    x_dot = None
    if system.states:
        kane = KaneEquations(system, t, state.q, state.u, values)
        x_dot = as_vector(evaluate_with_accelerations(kane, as_row(u_dot, system.speeds, "u_dot"), _state_rates), y)
    return packed(State(q_dot, u_dot, x_dot))


@ScalarFunction
def _first_order_rates(system, t, q, u, inputs, u_dot):
    """x_dot (n_x,) at the accelerations u_dot (n,)."""
    kane = KaneEquations(system, t, q, u, inputs)
    return as_vector(evaluate_with_accelerations(kane, as_row(u_dot, system.speeds, "u_dot"), _state_rates), q)
