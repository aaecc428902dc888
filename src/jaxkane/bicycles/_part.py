"""A part of a bicycle, and what it sees of the bicycle's motion. A part of your own begins with `Part`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx

from .._scalarjit.components import Component
from .._system.kinematics import Point, Vector
from .._system.motion import Motion
from .._system.parameters import check_parameter, parameter_info

NAMES = ("coordinates", "speeds", "dependent_speeds", "dependent_coordinates", "inputs", "states")


def check_parameters(part: Any) -> None:
    """Refuse numbers that no parameter can be; None stands for one that may be left out by default."""
    factories = {field.name: field.default_factory for field in dataclasses.fields(part)}
    infos = parameter_info(part)
    for name in sorted(infos, key=lambda name: getattr(part, name) is not None):  # what is left out is told first
        default, info = factories[name], infos[name]
        if getattr(part, name) is None and default is not dataclasses.MISSING and default() is None:
            continue
        check_parameter(f"{type(part).__name__}.{name}", getattr(part, name), info)


def called(value: Any) -> str:
    """What was given, in the words of an error: a module by its class, which is shorter than its numbers."""
    return f"a {type(value).__name__}" if isinstance(value, eqx.Module) else repr(value)


class Contact(NamedTuple):
    """Where a wheel meets the ground at an instant.

    - `point`: of the tyre, at the contact; its velocity is that of slip.
    - `heading`, `across`, `normal`: unit vectors; along the wheel's plane and across it in the ground, and downwards.
        `down`: in the wheel's plane, from its centre towards the ground.
    - `camber` [rad]: the wheel's inclination, positive to the right. `speed` [m/s]: of the contact along `heading`.
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


class Part(eqx.Module):
    """A part of a `Bicycle`: its array leaves are parameters, its methods add to the bicycle's description.

        class Basket(Part):
            load: Scalar = parameter(5.0, positive=True, unit="kg")

            def motion(self, bicycle, motion, t, q, u):
                place = motion["S"].fixed(0.2 * motion["C"].x - 0.3 * motion["C"].z)
                return motion.extended([Body(self.load, 0.0, place, name="basket")])

        bicycle = Bicycle.benchmark().with_parts(extra=[Basket()])

    A subclass names what it adds: `coordinates`, `speeds`, `dependent_speeds`, `dependent_coordinates`, `inputs`,
    `states` and `units`, as a `System` does; and overrides those methods that it needs. `q`, `u` and `x` hold all
    values of the bicycle, read by name. `resists = True` says that riding straight on takes a drive because of it:
    linear models over speeds then have the "drive_torque" that this takes.
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
        check_parameters(self)
        for kind in NAMES:
            if isinstance(names := getattr(self, kind), str):
                raise TypeError(f"{type(self).__name__}.{kind} is a tuple of names, got {names!r}: ({names!r},).")

    def check(self, bicycle: Any) -> None:
        """Refuse, by an error, a bicycle that this part does not fit."""

    def q_dot(self, bicycle: Any, t: Component, q: Any, u: Any) -> Sequence[Component]:
        """Rates of the part's coordinates. By default those speeds that have the coordinates' names and "_rate"."""
        return [u[f"{name}_rate"] for name in self.coordinates]

    def motion(self, bicycle: Any, motion: BicycleMotion, t: Component, q: Any, u: Any) -> BicycleMotion:
        """The motion of the bicycle with what the part adds: bodies, velocity residuals, points and frames.

        `motion` is that of the bicycle and the parts before this one: `motion.extended([...])`.
        """
        return motion

    def commands(
        self, bicycle: Any, t: Component, q: Any, u: Any, motion: BicycleMotion, values: Mapping[str, Component]
    ) -> Mapping[str, Component]:
        """What the part adds to inputs of the bicycle, by name: `{"steer_torque": -self.gain * q["roll"]}`.

        `values` holds inputs and states by name, those with what the parts before this one have added. A part that
        adds to an input of another part, which has read it here, must stand before that part.
        """
        return {}

    def loads(
        self, bicycle: Any, t: Component, q: Any, u: Any, motion: BicycleMotion, values: Mapping[str, Component]
    ) -> Any:
        """Forces and torques; `values` holds inputs, with all that was added to them, and states by name."""
        return ()

    def state_rates(
        self, bicycle: Any, t: Component, q: Any, u: Any, x: Any, motion: BicycleMotion, now: Any
    ) -> Sequence[Component] | Mapping[str, Component]:
        """Rates of the part's states of the first order, in their order or by name; `now` as in `System.state_rates`,
        its inputs with all that was added to them."""
        return ()

    def outputs(self, bicycle: Any, t: Component, q: Any, u: Any, motion: BicycleMotion, now: Any) -> Mapping[str, Any]:
        """What the part's sensors say, by name."""
        return {}

    def configuration_constraints(
        self, bicycle: Any, t: Component, q: Any, motion: BicycleMotion
    ) -> Sequence[Component]:
        """Residuals that are zero in every possible configuration; `motion` is that of rest."""
        return ()

    def draw(self, bicycle: Any, motion: BicycleMotion, sketch: Any) -> None:
        """Add the part to the picture of the bicycle: `sketch.line("green", motion["O"], motion["A"])`, see
        `jaxkane.animate`."""

    def lateral(self) -> tuple[str, ...]:
        """Names of the part's coordinates, speeds and states that move when the bicycle leaves the upright plane: those
        of its linear models. By default all but the dependent ones."""
        coordinates = [name for name in self.coordinates if name not in self.dependent_coordinates]
        return (*coordinates, *self.speeds, *self.states)
