"""The contact of one wheel with the ground: the tyre's shape, rolling with or without slip, and its forces."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from .._scalarjit.components import Component, Scalar, is_zero, mul, sub
from .._system.kinematics import Vector
from .._system.motion import Body, Force, Torque
from .._system.parameters import parameter
from .._system.prints import module_text
from ._part import Contact, called, check_parameters
from ._tyre_laws import LongitudinalSlip, TyreForceLaw


class Tyre(eqx.Module):
    """A tyre; by default a knife edge that rolls without slip, as in the Whipple bicycle.

        Tyre(crown=0.02, lateral=LateralSlip(9000.0, relaxation_length=0.15))

    **Arguments:**

    - `crown` [m]: radius of the cross section of a torus, whose outer radius is the wheel's. None: a knife edge.
    - `lateral`: law of the lateral force. None: the tyre does not slip sideways.
    - `longitudinal`: law of the longitudinal force. None: it rolls without slip.
    - `rolling_resistance`: resisting torque over load times radius; 0.003 to 0.01 for a bicycle. Without slip the force
        follows from the constraint.
    - `load_lag` [s]: time constant of a first-order lag. Laws and rolling resistance then use the ground's normal force
        with this lag. The state, e.g. "front_load_transfer", is its deviation from the static load, over the bicycle's
        weight. None: the static load is used.
    """

    crown: Scalar | None = parameter(None, positive=True, unit="m")
    lateral: TyreForceLaw | None = None
    longitudinal: LongitudinalSlip | None = None
    rolling_resistance: Scalar | None = parameter(None, within=(0.0, 1.0))
    load_lag: Scalar | None = parameter(None, positive=True, within=(0.0, 5.0), unit="s")

    __repr__ = module_text

    def __check_init__(self) -> None:
        check_parameters(self)
        along, across = self.longitudinal, self.lateral
        if not (along is None or isinstance(along, LongitudinalSlip)):
            raise TypeError(f"Tyre: `longitudinal` must be a LongitudinalSlip or None, got {called(along)}.")
        if isinstance(across, LongitudinalSlip) or not (across is None or isinstance(across, TyreForceLaw)):
            raise TypeError(f"Tyre: `lateral` must be a law of lateral slip or None, got {called(across)}.")

    @property
    def rolls(self) -> bool:
        """Whether the tyre rolls without any slip."""
        return self.lateral is None and self.longitudinal is None

    @property
    def laws(self) -> tuple[tuple[str, TyreForceLaw], ...]:
        """The directions in which it slips, with their laws."""
        laws = (("longitudinal", self.longitudinal), ("lateral", self.lateral))
        return tuple((name, law) for name, law in laws if law is not None)

    @property
    def deflects(self) -> tuple[str, ...]:
        """The directions in which its slip has a relaxation length."""
        return tuple(name for name, law in self.laws if law.relaxation_length is not None)

    def reach(self, down: Vector, normal: Vector, radius: Component) -> Vector:
        """The vector from the wheel's centre to the contact. `down` is the unit vector in the wheel's plane towards the
        ground."""
        if self.crown is None:
            return radius * down
        return (radius - self.crown) * down + self.crown * normal

    def rolled(self, cos_camber: Component, radius: Component) -> Component:
        """The rolled length per angle [m]; smaller for an inclined wheel."""
        return radius if self.crown is None else radius - self.crown + self.crown * cos_camber

    def residuals(self, contact: Contact) -> list[Any]:
        """Velocity residuals [m/s]: the velocity of the contact minus its slip."""
        v, (along, across) = contact.point.velocity, contact.slip
        if self.rolls:
            return [v]
        return [v.dot(contact.heading) - along, v.dot(contact.across) - across, v.dot(contact.normal)]

    def forces(self, contact: Contact, load: Component, deflection: dict[str, Component]) -> dict[str, Component]:
        """Forces of the ground on the tyre [N], by direction. `load` is in N; `deflection` in m, by direction."""
        return {name: law.force(slip, load, contact.camber) for name, law, slip in self._slips(contact, deflection)}

    def _slips(
        self, contact: Contact, deflection: dict[str, Component]
    ) -> Iterator[tuple[str, TyreForceLaw, Component]]:
        for name, law in self.laws:
            yield name, law, law.slip(*_moving(name, contact), deflection.get(name))

    def deflection_rates(self, contact: Contact, deflection: dict[str, Component]) -> Iterator[Component]:
        for name, law in self.laws:
            if name in deflection:
                yield law.deflection_rate(*_moving(name, contact), deflection[name])

    def loads(
        self, contact: Contact, wheel: Body, radius: Component, load: Component, deflection: dict[str, Component]
    ) -> Iterator[Force | Torque]:
        """Loads of the ground on the wheel, without the constraint force of ideal rolling."""
        for name, law, slip in self._slips(contact, deflection):
            force = law.force(slip, load, contact.camber)
            yield Force(force * _direction(name, contact), contact.point)
            moment = law.moment(force, slip, load, contact.camber)
            if not is_zero(moment):
                yield Torque(moment * contact.normal, wheel)
        if self.rolling_resistance is not None:
            # Smoothed over 0.1 m/s: a wheel at rest then remains at rest.
            size = self.rolling_resistance * jnp.maximum(load, 0.0) * radius * jnp.tanh(contact.speed / 0.1)
            yield Torque(size * contact.across, wheel)


def _direction(name: str, contact: Contact) -> Vector:
    return contact.across if name == "lateral" else contact.heading


def _moving(name: str, contact: Contact) -> tuple[Component, Component, Component]:
    """Slip velocity [m/s], speed and camber: the arguments of a law."""
    return contact.slip[name == "lateral"], contact.speed, contact.camber


def rolling_speed(tyre: Tyre, spin: Component, cos_camber: Component, radius: Component, slip: Component) -> Component:
    """The speed of a contact along the wheel's heading [m/s]: -spin r + slip, for a wheel whose axle points right."""
    return sub(slip, mul(spin, tyre.rolled(cos_camber, radius)))
