"""The base class `Part` of a bicycle's parts, and the motion that parts receive. Derive your own parts from `Part`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, TypeAlias

import equinox as eqx

from .._kane.right_hand_side import MeasurementContext
from .._scalarjit.components import Component
from .._system.kinematics import Point, Vector
from .._system.motion import Motion
from .._system.parameters import check_parameter, module_text, parameter_info
from .._system.system import NamedVector
from ..catalog._entry import Loads, Values

BicycleLike: TypeAlias = Any
"""A `Bicycle`. Its file imports this one, so the class itself cannot be named here."""

NAMES = ("coordinates", "speeds", "dependent_speeds", "dependent_coordinates", "inputs", "states")


class ParametricModule(eqx.Module):
    """A module that refuses impossible parameters. None is allowed where it is the default."""

    __repr__ = module_text

    def __check_init__(self) -> None:
        defaults = {field.name: field.default_factory for field in dataclasses.fields(self)}
        infos = parameter_info(self)
        for name in sorted(infos, key=lambda name: getattr(self, name) is not None):  # report missing parameters first
            value, default = getattr(self, name), defaults[name]
            if value is not None or default is dataclasses.MISSING or default() is not None:
                check_parameter(f"{type(self).__name__}.{name}", value, infos[name])


def called(value: object) -> str:
    """A value as text for an error message: a module by its class, because its numbers would be long."""
    return f"a {type(value).__name__}" if isinstance(value, eqx.Module) else repr(value)


class Contact(NamedTuple):
    """The contact of a wheel with the ground at one instant.

    - `point`: the material point of the tyre at the contact; its velocity is the slip velocity.
    - `heading`, `across`: unit vectors in the ground, along the wheel's plane and across it.
    - `normal`: the unit normal of the ground, downwards.
    - `down`: the unit vector in the wheel's plane, from its centre towards the ground.
    - `camber` [rad]: the wheel's inclination, positive to the right.
    - `speed` [m/s]: of the contact along `heading`.
    - `slip` [m/s]: the velocity of `point` along `heading` and `across`.
    """

    point: Point
    heading: Vector
    across: Vector
    normal: Vector
    down: Vector
    camber: Component
    speed: Component
    slip: tuple[Component, Component]


class BicycleMotion(Motion):
    """The motion of a bicycle with its two contacts."""

    __slots__ = ("front", "rear")

    rear: Contact
    front: Contact


class Part(ParametricModule):
    """A part of a `Bicycle`: its arrays are parameters, its methods add to the bicycle's model.

        class Basket(Part):
            load: Scalar = parameter(5.0, positive=True, unit="kg")

            def motion(self, bicycle, motion, t, q, u):
                place = motion["S"].fixed(0.2 * motion["C"].x - 0.3 * motion["C"].z)
                return motion.extended([Body(self.load, 0.0, place, name="basket")])

        bicycle = Bicycle.benchmark().with_parts(extra=[Basket()])

    A subclass declares the names that it adds, as a `System` does: `coordinates`, `speeds`, `dependent_speeds`,
    `dependent_coordinates`, `inputs`, `states` and `units`. It overrides the methods that it needs. `q`, `u` and `x`
    contain all values of the bicycle by name. Set `resists = True` if the part makes straight riding need a drive
    torque. Linear models over speeds then include this "drive_torque".
    """

    coordinates: ClassVar[tuple[str, ...]] = ()
    speeds: ClassVar[tuple[str, ...]] = ()
    dependent_speeds: ClassVar[tuple[str, ...]] = ()
    dependent_coordinates: ClassVar[tuple[str, ...]] = ()
    inputs: ClassVar[tuple[str, ...]] = ()
    states: ClassVar[tuple[str, ...]] = ()
    units: ClassVar[Mapping[str, str]] = {}
    resists: ClassVar[bool] = False

    def __check_init__(self) -> None:
        for kind in NAMES:
            if isinstance(names := getattr(self, kind), str):
                raise TypeError(
                    f"{type(self).__name__}.{kind} must be a tuple of names, e.g. ({names!r},); got {names!r}."
                )

    def check(self, bicycle: BicycleLike) -> None:
        """Raise an exception if this part does not fit the bicycle."""

    def q_dot(self, bicycle: BicycleLike, t: Component, q: NamedVector, u: NamedVector) -> Sequence[Component]:
        """Rates of the part's coordinates. Default: the speeds with the coordinates' names and "_rate"."""
        return [u[f"{name}_rate"] for name in self.coordinates]

    def motion(
        self, bicycle: BicycleLike, motion: BicycleMotion, t: Component, q: NamedVector, u: NamedVector
    ) -> BicycleMotion:
        """The motion of the bicycle including this part: bodies, velocity residuals, points and frames.

        **Arguments:**

        - `motion`: of the bicycle and the parts before this one.

        **Returns:** `motion.extended([...])`.
        """
        return motion

    def commands(
        self,
        bicycle: BicycleLike,
        t: Component,
        q: NamedVector,
        u: NamedVector,
        motion: BicycleMotion,
        values: Values,
    ) -> Values:
        """Values that the part adds to inputs of the bicycle, by name: `{"steer_torque": -self.gain * q["roll"]}`.

        **Arguments:**

        - `values`: inputs and states by name, including what the parts before this one have added. A part that reads an
            input here must be placed after the parts that add to it.
        """
        return {}

    def loads(
        self,
        bicycle: BicycleLike,
        t: Component,
        q: NamedVector,
        u: NamedVector,
        motion: BicycleMotion,
        values: Values,
    ) -> Loads:
        """Forces and torques. `values` contains inputs, with all additions of parts, and states by name."""
        return ()

    def state_rates(
        self,
        bicycle: BicycleLike,
        t: Component,
        q: NamedVector,
        u: NamedVector,
        x: NamedVector,
        motion: BicycleMotion,
        now: MeasurementContext,
    ) -> Sequence[Component] | Values:
        """Rates of the part's states of the first order, in their order or by name. `now` as in `System.state_rates`;
        its inputs include all additions of parts."""
        return ()

    def outputs(
        self,
        bicycle: BicycleLike,
        t: Component,
        q: NamedVector,
        u: NamedVector,
        motion: BicycleMotion,
        now: MeasurementContext,
    ) -> Values:
        """The measurements of the part's sensors, by name."""
        return {}

    def configuration_constraints(
        self, bicycle: BicycleLike, t: Component, q: NamedVector, motion: BicycleMotion
    ) -> Sequence[Component]:
        """Residuals that are zero in every possible configuration. `motion` has zero speeds."""
        return ()

    def draw(self, bicycle: BicycleLike, motion: BicycleMotion, sketch: Any) -> None:
        """Add the part to the picture of the bicycle: `sketch.line("green", motion["O"], motion["A"])`, see
        `jaxkane.animate`."""

    def lateral(self) -> tuple[str, ...]:
        """Names of the part's coordinates, speeds and states that change when the bicycle leaves the upright plane. Its
        linear models contain these. Default: all except the dependent ones."""
        coordinates = [name for name in self.coordinates if name not in self.dependent_coordinates]
        return (*coordinates, *self.speeds, *self.states)
