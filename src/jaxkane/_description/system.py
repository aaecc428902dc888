"""A mechanism: its parameters, names, motion and loads. Describes; never differentiates or solves."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._common.lookup import refuse_unknown
from .._scalars.types import Component
from .motion import Motion
from .parameters import check_fields, check_parameter, parameter_info, to_float
from .prepared import METHODS, NAMES, Kind, checked_names, checked_units


class State(eqx.Module):
    """What is integrated: coordinates, independent speeds and, where a system has such, states of the first order.

    Attributes: `q` (n_q,) [rad, m], `u` (n_u,) [rad/s, m/s], `x` (n_x,) or None; a batch has leading axes. Or dicts by
    name, which are read where the state meets its system: `jk.State({"angle": 0.3}, {"rate": 1.0})`. Names left out are
    zero.
    """

    q: Float[Array, "*batch n_q"] = eqx.field(converter=to_float)
    u: Float[Array, "*batch n_u"] = eqx.field(converter=to_float)
    x: Float[Array, "*batch n_x"] | None = eqx.field(converter=lambda x: x if x is None else to_float(x), default=None)


def packed(state: State) -> Float[Array, "*batch n"]:
    """q, u and, where there are states of the first order, x in one array."""
    return jnp.concatenate([part for part in (state.q, state.u, state.x) if part is not None], axis=-1)


def unpacked(system: System, y: Float[Array, "*batch n"]) -> State:
    """The state of which `packed` makes y."""
    n_q = len(system.coordinates)
    q, u, x = jnp.split(y, [n_q, n_q + len(system.speeds)], axis=-1)
    return State(q, u, x if system.states else None)


class System(eqx.Module, metaclass=Kind):
    """A mechanism: its array leaves are its parameters, its methods describe it.

    A subclass names its coordinates and speeds, and writes `motion`; and, where it needs them, `loads`, `q_dot`,
    `configuration_constraints` and `events`; `state_rates` of what has states of the first order, and `outputs` of what
    carries sensors. The `u` that these receive holds all speeds: first the independent, then the dependent, then the
    auxiliary ones. `q`, `u` and `x` are read by place or by name: `q[0]`, `q["roll"]`.
    """

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for kind in (*NAMES, "units"):
            if kind in cls.__dict__:
                setattr(cls, kind, cls.__dict__[kind])
        for method in METHODS:
            owner = next(base for base in cls.__mro__ if method in base.__dict__)
            if owner is cls or not issubclass(owner, System):  # a class without a System that is mixed in
                setattr(cls, method, owner.__dict__[method])

    coordinates: ClassVar[tuple[str, ...]] = ()
    """Names of the generalized coordinates."""
    speeds: ClassVar[tuple[str, ...]] = ()
    """Names of the independent generalized speeds: one equation of motion for each."""
    dependent_speeds: ClassVar[tuple[str, ...]] = ()
    """Names of the speeds that the velocity residuals determine: as many as there are residuals."""
    auxiliary_speeds: ClassVar[tuple[str, ...]] = ()
    """Names of speeds that are zero in the motion, for the forces that do no work."""
    dependent_coordinates: ClassVar[tuple[str, ...]] = ()
    """Names of the coordinates that `assemble` finds from the configuration constraints; the others are held."""
    inputs: ClassVar[tuple[str, ...]] = ()
    """Names of the inputs that `loads` reads."""
    states: ClassVar[tuple[str, ...]] = ()
    """Names of states of the first order, which `state_rates` drives: motors that lag, bristles, filters."""
    units: ClassVar[Mapping[Any, str]] = {}
    """Units of coordinates, speeds, inputs, states and outputs by name, for tables and pictures: `{"q0": "rad", "push":
    "N"}`. Those of rates follow from what is declared; nothing is guessed from a name."""
    check_inertia: ClassVar[bool] = True
    """Whether bodies are refused whose principal moments of inertia break the triangle inequality by more than 5 %."""

    def __check_init__(self) -> None:
        _check_names(self)
        check_fields(self)
        for name, info in parameter_info(self).items():
            check_parameter(f"{type(self).__name__}.{name}", getattr(self, name), info)

    def motion(self, t: Component, q: Any, u: Any) -> Motion:
        """Bodies and velocity residuals at time `t` [s], coordinates `q` and speeds `u`."""
        raise NotImplementedError(f"{type(self).__name__} must define motion(self, t, q, u) and return a Motion.")

    def q_dot(self, t: Component, q: Any, u: Any) -> Sequence[Component]:
        """Rates of the coordinates. By default they are the speeds."""
        n_q, n = len(self.coordinates), len(self.speeds) + len(self.dependent_speeds)
        if n_q != n:
            raise ValueError(
                f"{type(self).__name__} has {n_q} coordinates and {n} speeds, so its speeds cannot be the rates of its "
                "coordinates: define q_dot(self, t, q, u), one rate for each coordinate."
            )
        return u[:n_q]

    def loads(self, t: Component, q: Any, u: Any, motion: Motion, inputs: Mapping[str, Component]) -> Any:
        """Active forces and torques: `Force`s and `Torque`s, nested in tuples as is convenient.

        `inputs` holds the values of the inputs, and of the states of the first order, by name.
        """
        return ()

    def why_not_finite(self, motion: Motion, inputs: Mapping[str, Component]) -> str:
        """Why loads are not finite at a state, in words: asked where they are not, for the error; "" if unknown."""
        return ""

    def state_rates(
        self, t: Component, q: Any, u: Any, x: Any, motion: Motion, now: Any
    ) -> Sequence[Component] | Mapping[str, Component]:
        """Rates of the states of the first order, in the order of `states`; or by name, in a dict.

            states = ("motor_torque",)

            def state_rates(self, t, q, u, x, motion, now):
                return ((now["command"] - x["motor_torque"]) / self.lag,)

        `now` is a `Now`: inputs and states by name, and accelerations, for the filter of an accelerometer. Of a class
        without states there are none: `super().state_rates(...)` gives an empty dict.
        """
        if inspect.unwrap(type(self).state_rates) is not System.state_rates or not self.states:
            return {}
        raise NotImplementedError(
            f"{type(self).__name__} has states ({', '.join(self.states)}): define state_rates(self, t, q, u, x, "
            "motion, now), one rate for each."
        )

    def outputs(self, t: Component, q: Any, u: Any, motion: Motion, now: Any) -> Mapping[str, Any]:
        """What the sensors say, by name: numbers, or dicts of such, whose names are joined by a dot.

            def outputs(self, t, q, u, motion, now):
                box = motion.frames["box"]
                return {"gyro": jk.sensors.gyroscope(box), "strain": self.stiffness * q["bend"]}

        `now` is a `Now`: inputs and states by name, accelerations, and the forces of constraints.
        """
        return {}

    def configuration_constraints(self, t: Component, q: Any) -> Sequence[Component]:
        """Residuals that are zero in every possible configuration."""
        return ()

    def implied_constraints(self, t: Component, q: Any) -> Sequence[Component]:
        """Residuals that are zero wherever the configuration constraints are: those of a closed loop that follow from
        the others. Nothing is solved for them; a state that does not meet them is refused."""
        return ()

    def events(self, t: Component, q: Any, u: Any) -> Mapping[str, Any]:
        """Signed, smooth quantities by name; a simulation ends, with that name as its status, when one passes zero.

        `jaxkane.rising` or `jaxkane.falling` of a quantity counts in that direction only. A motion that starts on zero
        ends at once only if it leaves in its named direction.
        """
        return {}


def names_of(system: System) -> tuple[tuple[str, ...], ...]:
    """Of coordinates, independent and dependent speeds, and states of the first order: what a motion is read by."""
    return tuple(map(tuple, (system.coordinates, system.speeds, system.dependent_speeds, system.states)))


_FOUND_BY_NAME = tuple(kind for kind in NAMES if kind != "dependent_coordinates")  # these are coordinates


def _check_names(system: System) -> None:
    """Refuse names that stand for two things."""
    name = type(system).__name__
    names = {kind: checked_names(name, kind, getattr(system, kind)) for kind in NAMES}
    units = checked_units(name, system.units)
    has_outputs = type(system).outputs is not System.outputs  # whose names are known when they are read
    if "units" in vars(type(system)) and not has_outputs:  # inherited units may name what this class lacks
        refuse_unknown(
            units,
            [each for named in names.values() for each in named],
            f"{name}.units names what is no coordinate, speed, input or state:",
        )
    owners: dict[str, str] = {}
    for kind in _FOUND_BY_NAME:
        for each in names[kind]:
            if each in owners:
                places = f"twice in `{kind}`" if owners[each] == kind else f"in `{owners[each]}` and in `{kind}`"
                raise ValueError(f"{name}: the name {each!r} stands {places}: q, u and trajectories are read by name.")
            owners[each] = kind
    dependent = names["dependent_coordinates"]
    strange = [each for i, each in enumerate(dependent) if each not in names["coordinates"] or each in dependent[:i]]
    if strange:
        have = ", ".join(names["coordinates"]) or "none"
        raise ValueError(
            f"{name}.dependent_coordinates names coordinates, each once: {', '.join(strange)} is none, or stands there "
            f"twice. The coordinates are: {have}."
        )
