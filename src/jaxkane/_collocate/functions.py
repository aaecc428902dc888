"""The functions of a nonlinear program, each at one place: equations of motion, cost, constraints, ends and links."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from .._common.lookup import not_there, real_number
from .._integrate.events import Crossing, crossings, events_of
from .._integrate.inputs import inputs_at
from .._integrate.jumps import StagesOf, after_jump
from .._kane.api import _dependent_speeds
from .._kane.arguments import is_one_number
from .._kane.constraint_residuals import configuration_residual, correction, has_configuration_constraints
from .._kane.kanes_method import KaneEquations
from .._kane.right_hand_side import outputs_at, values_of, vector_field
from .._scalarjit.components import Component
from .._system.system import System, explain_value_of_traced, has_outputs, names_of, unpacked

Bound = tuple[float, float]
Node = dict[str, Any]
"""The fraction "s" of the duration at a node, and the values of sampled inputs there by name, "inputs"."""

Condition = float | tuple[float | None, float | None]


class Now:
    """The argument `now` of costs and constraints: values at one time, by name.

        now["roll"], now["yaw_rate"], now["steer_torque"], now["imu.ay"], now.system.mass

    The names are those of coordinates, speeds, dependent speeds, first-order states, inputs and outputs.

    Attributes:

    - `t`: time [s].
    - `system`: the system, with the current values of free parameters.
    - `state`: the `State`.
    """

    def __init__(self, system: System, t: Component, y: Array, inputs: Mapping[str, Array]):
        self.system, self.t, self.state = system, t, unpacked(system, y)
        self._y, self._inputs = y, dict(inputs)
        self._outputs: dict[str, Array] | None = None

    def __getitem__(self, name: str) -> Array:
        system, state = self.system, self.state
        if name in self._inputs:
            return self._inputs[name]
        entries = (*system.coordinates, *system.speeds, *system.states)
        if name in entries:
            return self._y[entries.index(name)]
        if name in system.dependent_speeds:
            u_dep = _dependent_speeds(system, self.t, state.q, state.u, {})
            return u_dep[system.dependent_speeds.index(name)]
        if has_outputs(system) and self._outputs is None:
            values = values_of(system, state.x, self._inputs)
            self._outputs = outputs_at(system, self.t, state.q, state.u, values)
        if name in (self._outputs or {}):
            return self._outputs[name]  # type: ignore[index]
        known = [each for names in names_of(system) for each in names]
        raise not_there(name, [*known, *self._inputs, *(self._outputs or {})], "`now`")

    def events(self) -> dict[str, Crossing]:
        """The events of the system by name."""
        state = self.state
        kane = KaneEquations(self.system, self.t, state.q, state.u)
        x = () if state.x is None else tuple(state.x)
        return crossings(self.system, kane.t, kane.q, kane.u_all, x, state.q.dtype)

    def event(self, name: str) -> Array:
        """The event function of an event of the system."""
        events = self.events()
        if name not in events:
            raise not_there(name, events, "the events of the system")
        return jnp.asarray(events[name].value, self.state.q.dtype)

    def after(self, name: str) -> Now:
        """The values after the jump of an event of the system, with the same inputs."""
        events = events_of(self.system, self.t, self.state)
        if name not in events.names:
            raise not_there(name, events.names, "the events of the system")
        place = jnp.asarray(events.names.index(name), self._y.dtype)
        y, _ = after_jump(self.system, self.t, self._y, place, StagesOf.of(events))
        return Now(self.system, self.t, y, self._inputs)

    def __contains__(self, name: object) -> bool:
        try:
            self[name]  # type: ignore[index]
        except KeyError:
            return False
        return True


class Variables(eqx.Module):
    """How the variables of a node become a time, a state and inputs.

    The variables x are [state, controls, duration, parameters]. The last two are shared by all nodes and may be absent.

    Attributes:

    - `system`: the system. `signals`: its inputs other than the controls.
    - `parameters`: the maps of the free parameters, or None.
    - `duration`: the fixed duration [s], or None if it is a variable. `origin`: the time of the first node [s].
    - `controls`: the names of the controls. `n_y`: the number of states.
    """

    system: System
    signals: Any
    parameters: Any
    duration: Array | None
    origin: Array
    controls: tuple[str, ...] = eqx.field(static=True)
    n_y: int = eqx.field(static=True)

    @property
    def n_z(self) -> int:
        """The number of variables of one node."""
        return self.n_y + len(self.controls)

    def shared(self, x: Array) -> tuple[System, Array]:
        """The system and the duration, from the shared variables."""
        duration, rest = (x[0], x[1:]) if self.duration is None else (self.duration, x)
        system = self.system if self.parameters is None else self.parameters.apply(self.system, rest)[0]
        return system, duration

    def at(self, node: Node, x: Array) -> tuple[System, Array, Array, Array, dict[str, Array]]:
        """System, duration, time, packed state and inputs by name, at a node.

        `node`: the fraction of the duration "s", and the values of sampled inputs by name.
        """
        y, w = x[: self.n_y], x[self.n_y : self.n_z]
        system, duration = self.shared(x[self.n_z :])
        t = self.origin + node["s"] * duration
        inputs = {name: w[i] for i, name in enumerate(self.controls)} | node["inputs"]
        if callable(self.signals) or self.signals:
            others = inputs_at(system, self.signals, t, unpacked(system, y))
            both = [name for name in others if name in self.controls]
            if both:  # only a function of all inputs reaches this place
                raise ValueError(f"Problem: {both[0]!r} is in `controls`, and the function `inputs` returns it.")
            inputs = others | inputs
        inputs |= {name: jnp.zeros_like(t) for name in system.inputs if name not in inputs}
        return system, duration, t, y, inputs

    def now(self, node: Node, x: Array) -> Now:
        system, _, t, y, inputs = self.at(node, x)
        return Now(system, t, y, inputs)


STABILIZE = 50.0
"""The rate at which residuals of configuration constraints decay, with respect to the fraction of the duration."""


class Dynamics(eqx.Module):
    """duration * y_dot (n_y,): the rates with respect to the fraction of the duration.

    Without stabilization (Baumgarte), an optimal motion makes use of the drift: the squared norm of Euler parameters
    was 0.56, and the thrust of a drone could be smaller than its weight. IPOPT did not converge.
    """

    variables: Variables

    def __call__(self, node: Node, x: Array) -> Float[Array, " n_y"]:
        system, duration, t, y, inputs = self.variables.at(node, x)
        rates, q = duration * vector_field(system, t, y, inputs), y[: len(system.coordinates)]
        if has_configuration_constraints(system, t, q):
            back = STABILIZE * correction(system, t, q)
            rates += jnp.concatenate([back, jnp.zeros_like(rates[back.size :])])
        return rates


class Integrand(eqx.Module):
    """duration * cost (1,)."""

    variables: Variables
    cost: Callable[[Any, Now], Any]

    def __call__(self, node: Node, x: Array) -> Float[Array, " 1"]:
        _, duration = self.variables.shared(x[self.variables.n_z :])
        now = self.variables.now(node, x)
        return jnp.reshape(duration * number("cost", called("cost", self.cost, now.t, now), x.dtype), (1,))


class Path(eqx.Module):
    """The constraints along the motion (m,): values by name, then those of the function `path`."""

    variables: Variables
    names: tuple[str, ...] = eqx.field(static=True)
    path: Callable[[Any, Now], Any] | None

    def __call__(self, node: Node, x: Array) -> Float[Array, " m"]:
        now = self.variables.now(node, x)
        values = [now[name] for name in self.names]
        if self.path is not None:
            values += numbers("path", called("path", self.path, now.t, now), x.dtype).values()
        return jnp.stack(values)


class Ends(eqx.Module):
    """Values at both ends of a phase, from x = [first node, last node, shared variables].

    The order is: final cost, conditions, values by name at the start, values by name at the end, h(q) at the start.
    """

    variables: Variables
    final_cost: Callable[[Any, Now], Any] | None
    conditions: Callable[[Now, Now, Any], Any] | None
    start: tuple[str, ...] = eqx.field(static=True)
    end: tuple[str, ...] = eqx.field(static=True)
    has_constraints: bool = eqx.field(static=True)

    def __call__(self, nodes: tuple[Node, Node], x: Array) -> Float[Array, " m"]:
        n, shared = self.variables.n_z, x[2 * self.variables.n_z :]
        first = self.variables.now(nodes[0], jnp.concatenate([x[:n], shared]))
        last = self.variables.now(nodes[1], jnp.concatenate([x[n : 2 * n], shared]))
        _, duration = self.variables.shared(shared)
        values = []
        if self.final_cost is not None:
            values.append(number("final_cost", called("final_cost", self.final_cost, last.t, last), x.dtype))
        if self.conditions is not None:
            found = called("conditions", self.conditions, first, last, duration)
            values += numbers("conditions", found, x.dtype).values()
        values += [first[name] for name in self.start] + [last[name] for name in self.end]
        if self.has_constraints:
            values += [*configuration_residual(first.system, first.t, first.state.q)]
        return jnp.stack(values)


class Link(eqx.Module):
    """What is zero between the end of one phase and the start of the next, from x = [last node, first node, shared].

    `how` is None for a continuous state; the name of an event, whose function must be zero at the end, and whose jump
    gives the next state; or a function (last, first) -> residuals by name. `linked` are the names of the states that
    are linked in the first two cases. `shared` are the variables of both phases: [duration of the one, duration of the
    other, parameters]; if both are the same phase, the first two are one.
    """

    before: Variables
    after: Variables
    how: Any
    linked: tuple[str, ...] = eqx.field(static=True)
    is_one_phase: bool = eqx.field(static=True)

    def __call__(self, nodes: tuple[Node, Node], x: Array) -> Float[Array, " m"]:
        a, b = self.before.n_z, self.after.n_z
        shared = x[a + b :]
        one = int(self.before.duration is None)
        skipped = 0 if self.is_one_phase else one
        other = skipped + int(self.after.duration is None)
        x0 = jnp.concatenate([x[:a], shared[:one], shared[other:]])
        x1 = jnp.concatenate([x[a : a + b], shared[skipped:other], shared[other:]])
        last, first = self.before.now(nodes[0], x0), self.after.now(nodes[1], x1)
        if callable(self.how):
            values = [*numbers("links", called("links", self.how, last, first), x.dtype).values()]
        elif self.how is None:
            values = [first[name] - last[name] for name in self.linked]
        else:
            after = last.after(self.how)
            values = [last.event(self.how), *(first[name] - after[name] for name in self.linked)]
        return jnp.stack(values)


def called(label: str, f: Callable[..., Any], *args: Any) -> Any:
    with explain_value_of_traced(f"The function `{label}`"):
        return f(*args)


def named(label: str, values: object) -> Mapping[str, Any]:
    """**Raises:** `TypeError` unless the values are by name."""
    if not isinstance(values, Mapping) or not all(isinstance(name, str) for name in values):
        raise TypeError(f"The function `{label}` must return a dict of numbers by name, got {values!r}.")
    return values


def number(label: str, value: object, dtype: DTypeLike) -> Array:
    """The number that a function of the user returned.

    **Raises:** `TypeError` for truth values, which have no derivative, and for anything else that is not one number.
    """
    if not is_one_number(value):
        got = f"the shape {value.shape} and the type {value.dtype}" if isinstance(value, jax.Array) else repr(value)
        raise TypeError(
            f"The function `{label}` must return one real number, got {got}. For a truth value, return a smooth signed "
            "number, such as `x - 1` instead of `x > 1`."
        )
    return jnp.asarray(value, dtype)


def numbers(label: str, values: object, dtype: DTypeLike) -> dict[str, Array]:
    """The values by name that a function of constraints returned, as numbers or as (number, lower, upper)."""
    items = {name: x[0] if isinstance(x, tuple) and x else x for name, x in named(label, values).items()}
    return {name: number(f"{label}` of `{name}", x, dtype) for name, x in items.items()}


def bounds_of(label: str, value: Component | Sequence[float | None]) -> Bound:
    """Lower and upper bound, equal for a number.

    **Raises:** `ValueError` if the lower bound is greater than the upper one, or not a number.
    """
    label, is_pair = f"Problem: {label}", isinstance(value, (tuple, list))
    if is_pair and len(value) == 2:
        pairs = zip(value, (-math.inf, math.inf), strict=True)
        low, high = (none if x is None else real_number(x, label) for x, none in pairs)
    else:
        low = high = real_number(value, label)
    if not low <= high or (not is_pair and math.isinf(low)):
        raise ValueError(
            f"{label} is {value!r}: the lower bound is greater than the upper one, or a number is not finite. "
            "Leave the name out if there is no bound."
        )
    return low, high


def constraints_of(label: str, values: object, is_equality: bool) -> dict[str, Bound]:
    """The bounds of constraints by name, from what the user's function returned.

    **Raises:** `ValueError` or `TypeError` for bounds that are not concrete numbers.
    """
    default = (0.0, 0.0 if is_equality else math.inf)
    return {
        name: bounds_of(f"`{label}` of {name!r}, as (number, lower, upper),", item[1:])
        if isinstance(item, tuple)
        else default
        for name, item in named(label, values).items()
    }
