"""The right-hand side: rates of coordinates, speeds and first-order states; and the outputs.

Depends on Kane's equations, but not on integrators.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Self

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, PyTree

from .._common.lookup import checked, not_there, refuse_any, refuse_unknown
from .._scalarjit.components import Component, Numbers, add3, as_vector, component, cross, is_exact, is_written_out
from .._scalarjit.scalar_function import ScalarFunction, tree_of
from .._system.kinematics import Frame, Point, Vector
from .._system.motion import Motion
from .._system.system import Measurements, NamedVector, State, System, has_outputs, packed, unpacked
from .arguments import (
    Coordinates,
    InputArrays,
    Inputs,
    PackedState,
    Row,
    Speeds,
    Time,
    as_row,
    has_multipliers,
    inputs_of,
)
from .constraint_residuals import configuration_residual
from .contact.forces import forces_in_contact, layout_of
from .description import jvp
from .kanes_method import KaneEquations, motion_rates
from .multipliers import Reactions


class MeasurementContext(Inputs, Measurements):
    """The argument `now` of `state_rates` and `outputs`.

    `now["command"]` is the value of an input or a first-order state.

    Attributes:

    - `u_dot`: time derivatives of all speeds, including the dependent ones, by index or by name.
    """

    def __init__(self, kane: KaneEquations, N: Frame, u_dot: NamedVector, rates: Iterator[Row] | None):
        super().__init__(kane.inputs, inputs_of(kane.system))
        self.u_dot = u_dot
        self._kane, self._N, self._rates = kane, N, rates
        self._vectors: list[Vector] = []  # their rates are needed

    def with_values(self, values: Mapping[str, Component]) -> Self:
        """The same context with other values of inputs, for a part of a system."""
        context = copy.copy(self)
        context.update(values)
        return context

    def acceleration(self, point: Point) -> Vector:
        """Acceleration [m/s^2] of a Point in the inertial frame, as a Vector."""
        checked(point, Point, "now.acceleration(point) needs a Point", " For a body, pass its `center`.")
        return self._rate(point.velocity)

    def angular_acceleration(self, frame: Frame) -> Vector:
        """Angular acceleration [rad/s^2] of a Frame in the inertial frame, as a Vector."""
        checked(frame, Frame, "now.angular_acceleration(frame) needs a Frame")
        return self._rate(frame.angular_velocity)

    def force(self, name: str) -> Any:
        """Constraint force at a named point [N] or moment at a named frame [N m], as a Vector.

        For the name of an auxiliary speed, it is a number. The values are those of `jaxkane.constraint_forces`.
        """
        if name not in self._forces:
            raise not_there(name, self._forces, "the named points, frames and auxiliary speeds")
        force = self._forces[name]
        return self._N.vector(*force) if isinstance(force, tuple) else force

    @property
    def multipliers(self) -> Row:
        """Multipliers of the velocity residuals (k,), as in `jaxkane.constraint_multipliers`."""
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


def evaluate_with_accelerations(kane: KaneEquations, u_dot: Row, method: Method) -> PyTree:
    """Evaluate a method of the system that may read accelerations.

    The first evaluation finds the vectors whose rates the method needs. If there are any, the second evaluation uses
    these rates.

    **Arguments:**

    - `kane`: Kane's equations at a state.
    - `u_dot`: accelerations (n,) of the independent speeds.
    - `method`: the method of the system.

    **Returns:** the result of the method.
    """
    u_dot_all = (*u_dot, *kane.dependent_accelerations(u_dot))
    names = (*kane.system.speeds, *kane.system.dependent_speeds)

    def evaluate(t: Component, q: Row, u: Row, rates: Iterator[Row] | None = None) -> tuple[Any, list[Vector]]:
        motion = kane.motion(t, q, u)
        context = MeasurementContext(kane, motion.N, NamedVector(u_dot_all, names), rates)
        return method(kane.system, t, q, u, motion, context), context._vectors

    # The method may divide by a speed. An exact zero would raise ZeroDivisionError, so pass arrays.
    q, u = (tuple(jnp.asarray(x, kane.dtype) if is_exact(x) else x for x in row) for row in (kane.q, kane.u_all))
    result, vectors = evaluate(kane.t, q, u)
    if not vectors:
        return result
    n_q = len(q)
    values, rates = jvp(
        lambda t, *z: [vector.components for vector in evaluate(t, z[:n_q], z[n_q:])[1]],
        (kane.t, *q, *u),
        (1.0, *kane.q_dot, *u_dot_all),
    )
    omegas = [vector.frame.angular_velocity.components for vector in vectors]
    # dv/dt in N = derivative of the components + omega x v
    rates_in_N = [add3(rate, cross(w, v)) for rate, w, v in zip(rates, omegas, values, strict=True)]
    return evaluate(kane.t, q, u, iter(rates_in_N))[0]


def _outputs(system: System, t: Component, q: Row, u: Row, motion: Motion, now: MeasurementContext) -> dict[str, Any]:
    """Outputs by name. Names of nested dicts are joined by dots.

    **Raises:** `TypeError` for an output that is not a number, `ValueError` for a name that is already in use.
    """
    label = f"{type(system).__name__}.outputs"
    outputs = _flat(label, system.outputs(t, q, u, motion, now))
    reserved = (*system.coordinates, *system.speeds, *system.dependent_speeds, *system.inputs, *system.states)
    twice = [name for name in outputs if name in reserved]
    after = " is already the name of a coordinate, a speed, an input or a state. Choose another one, e.g. measured_..."
    refuse_any(twice, f"{label}:", after)
    return outputs


def _flat(label: str, outputs: object) -> dict[str, Component]:
    hint = " Does it end without a `return`?" if outputs is None else ""
    flat: dict[str, Component] = {}
    for name, value in checked(outputs, Mapping, f"{label} must return a dict of numbers by name", hint).items():
        checked(name or None, str, f"{label}: the name of an output must be a string")
        if isinstance(value, Vector):
            raise TypeError(f"{label}: {name!r} is a Vector. Return its components instead: `a, b, c = v.to(frame)`.")
        if isinstance(value, Mapping):
            items = {f"{name}.{key}": x for key, x in _flat(label, value).items()}
        else:
            items = {name: component(value, f"{label}: {name!r}")}
        refuse_any([key for key in items if key in flat], f"{label}: two outputs have the name", ". Rename one.")
        flat |= items
    return flat


def outputs_at(system: System, t: Time, q: Coordinates, u: Speeds, inputs: Mapping[str, Array]) -> dict[str, Array]:
    """Outputs by name, from checked arrays. `inputs` also contains the first-order states."""
    if not has_outputs(system):
        return {}
    inputs = dict(inputs)
    return _outputs_at(system, t, q, u, inputs, motion_rates(system, t, q, u, inputs)[1])


def outputs_in_contact(
    system: System, t: Time, y: PackedState, inputs: Mapping[str, Array]
) -> tuple[Array, dict[str, Array]]:
    """The projected speeds (n,), and outputs by name with the contact forces, at a state with contact states."""
    state = unpacked(system, y)
    values = dict(values_of(system, state.x, inputs))
    u, u_dot, forces = _contact_forces(system, t, y, values)
    outputs = _outputs_at(system, t, state.q, u, values, u_dot) if has_outputs(system) else {}
    return u, outputs | forces


@ScalarFunction.compile_cheaply
def _contact_forces(system: System, t: Time, y: PackedState, values: InputArrays):
    state, layout = unpacked(system, y), layout_of(system)
    u, (forces, u_dot), _ = forces_in_contact(system, t, state.q, state.u, state.contacts, values)
    named = {}
    for i, (name, has_friction, is_bearing) in enumerate(
        zip(layout.names, layout.has_friction, layout.is_bearing, strict=True)
    ):
        if not is_bearing:
            named[f"{name}.normal"] = forces[i, 0]
        if has_friction and (not layout.in_space or is_bearing or layout.planes[i] is not None):
            named[f"{name}.friction"] = forces[i, 1]
        elif has_friction:
            named |= {f"{name}.friction_{k}": forces[i, k] for k in (1, 2)}
    return u, u_dot, named


@ScalarFunction
def _outputs_at(system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays, u_dot: Speeds):
    kane = KaneEquations(system, t, q, u, inputs)
    outputs = evaluate_with_accelerations(kane, as_row(u_dot, system.speeds, "u_dot"), _outputs)
    return {name: as_vector([x], q)[0] for name, x in outputs.items()}


def output_names(system: System) -> tuple[str, ...]:
    """The names of a system's outputs, in alphabetical order."""
    if not has_outputs(system):
        return ()
    q, u = (jnp.zeros(len(names)) for names in (system.coordinates, system.speeds))
    return tuple(jax.eval_shape(lambda t, q, u: outputs_at(system, t, q, u, {}), jnp.zeros(()), q, u))


def _state_rates(system: System, t: Component, q: Row, u: Row, motion: Motion, now: MeasurementContext) -> Row:
    names, label = system.states, f"{type(system).__name__}.state_rates"
    return named_row(system.state_rates(t, q, u, [now[name] for name in names], motion, now), names, label)


def named_row(rates: Numbers, names: Sequence[str], label: str) -> Row:
    """Numbers in the order of `names`, or by name in a dict, as a row of components.

    **Raises:** `ValueError` or `TypeError` if there is not one number for each name.
    """
    if isinstance(rates, Mapping):
        refuse_unknown(rates, names, f"{label}: not a first-order state:")
        # A state that is left out is constant between jumps.
        rates = [rates.get(name, 0.0) for name in names]
    if isinstance(rates, (float, int)) or (hasattr(rates, "shape") and not rates.shape):
        rates = (rates,)  # the rate of a single state needs no tuple
    return as_row(rates, names, label)


def rates(system: System, t: Time, q: Coordinates, u: Speeds, values: InputArrays) -> State:
    """The right-hand side: time derivatives of coordinates, independent speeds and first-order states.

    The arguments are checked arrays. `values` contains inputs and first-order states by name.
    """
    if not system.states:
        return State(*motion_rates(system, t, q, u, values))
    x = as_vector([values[name] for name in system.states], q)
    return unpacked(system, vector_field(system, t, packed(State(q, u, x)), values))


def rates_by_numpy(
    system: System, t: Component, q: Numbers, u: Numbers, x: Numbers, inputs: dict[str, Any]
) -> State | None:
    """`rates` of concrete numbers without compilation, or None if NumPy cannot evaluate them."""
    args = system, t, packed(State(q, u, x if system.states else None)), inputs
    if not is_written_out(len(system.speeds)) or not _vector_field.is_numpy(*args):
        return None
    return unpacked(system, _vector_field.numpy(*args))


def vector_field(
    system: System, t: Time, y: PackedState, inputs: Mapping[str, Any], forward: bool = False
) -> PackedState:
    """The right-hand side for a solver: the packed rates (n_q + n_u + n_x,) of a packed state, so a step uses one
    array.

    **Arguments:**

    - `system`: the system, which may be packed (see `tree_of`).
    - `t`: time [s].
    - `y`: packed state (n_q + n_u + n_x,).
    - `inputs`: values by name.
    - `forward`: whether the value and its forward-mode derivative are one operation.
    """
    packed_system, system = system, tree_of(system)
    if _is_one_program(system, y):
        written_out = _vector_field.in_forward_mode if forward else _vector_field
        return written_out(packed_system, t, y, dict(inputs))
    state = unpacked(system, y)
    values = values_of(system, state.x, inputs)
    q_dot, u_dot = motion_rates(system, t, state.q, state.u, values)
    x_dot = first_order_rates(system, t, state.q, state.u, values, u_dot) if system.states else None
    return packed(State(q_dot, u_dot, x_dot))


def rates_are_native(system: System, t: Time, y: PackedState, inputs: Mapping[str, Any]) -> bool:
    """Whether `vector_field` runs as one native kernel for these arguments."""
    return _is_one_program(tree_of(system), y) and _vector_field.is_native(system, t, y, dict(inputs))


def _is_one_program(system: System, y: PackedState) -> bool:
    """Whether the right-hand side is one program of scalars: for few speeds, and for contacts."""
    return is_written_out(len(system.speeds)) or unpacked(system, y).contacts is not None


def reads_time(system: System, dtype: DTypeLike) -> bool:
    """Whether the right-hand side or the outputs depend on time. True if they are not programs of scalars."""
    q, u, x = (jnp.zeros(len(names), dtype) for names in (system.coordinates, system.speeds, system.states))
    t, place = jnp.zeros((), dtype), len(jax.tree.leaves(system))
    programs = [_vector_field.program(system, t, packed(State(q, u, x)), {})[1]]
    if has_outputs(system):
        programs.append(_outputs_at.program(system, t, q, u, values_of(system, x, {}), u)[1])
    return any(program is None or program.reads[place] for program in programs)


def parameters_read(system: System) -> list[bool]:
    """For each leaf of a system, whether the right-hand side or the configuration constraints depend on it. True if
    they are not programs of scalars."""
    q, u, x = (jnp.zeros(len(names)) for names in (system.coordinates, system.speeds, system.states))
    t, n = jnp.zeros(()), len(jax.tree.leaves(system))
    programs = [_vector_field.program(system, t, packed(State(q, u, x)), {})[1]]
    if jax.eval_shape(configuration_residual, system, t, q).size:  # a program without numbers seems to read the first
        programs.append(configuration_residual.program(system, t, q)[1])
    return [any(program is None or program.reads[i] for program in programs) for i in range(n)]


def values_of(system: System, x: Array | None, inputs: Mapping[str, Any]) -> dict[str, Any]:
    """Inputs and first-order states by name, as passed to `loads`. `x` has shape (..., n_x)."""
    return {**inputs, **{name: x[..., i] for i, name in enumerate(system.states)}} if x is not None else dict(inputs)


@ScalarFunction
def _vector_field(system: System, t: Time, y: PackedState, inputs: InputArrays):
    state = unpacked(system, y)
    values = values_of(system, state.x, inputs)
    memory, x_dot, still = state.contacts, None, None
    if memory is not None or has_multipliers(system):
        u, forces, _ = forces_in_contact(system, t, state.q, state.u, memory, values)
        kane = KaneEquations(system, t, state.q, u, values)
        q_dot, u_dot = as_vector(kane.q_dot, y), forces.u_dot
        still = None if memory is None else jnp.zeros_like(memory)  # contact states change at jumps only
    else:
        q_dot, u_dot = motion_rates(system, t, state.q, state.u, values)
        kane = KaneEquations(system, t, state.q, state.u, values) if system.states else None
    if kane is not None and system.states:
        x_dot = as_vector(evaluate_with_accelerations(kane, as_row(u_dot, system.speeds, "u_dot"), _state_rates), y)
    return packed(State(q_dot, u_dot, x_dot, still))


@ScalarFunction
def first_order_rates(system: System, t: Time, q: Coordinates, u: Speeds, inputs: InputArrays, u_dot: Speeds):
    """Rates x_dot (n_x,) of the first-order states, at the accelerations u_dot (n,)."""
    kane = KaneEquations(system, t, q, u, inputs)
    return as_vector(evaluate_with_accelerations(kane, as_row(u_dot, system.speeds, "u_dot"), _state_rates), q)
