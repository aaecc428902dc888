"""Where a wheel meets the ground: the tyre's shape, rolling with or without slip, and its forces. Knows one wheel."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from .._scalarjit.components import Component, Scalar, is_zero, mul, sub
from .._system.kinematics import Vector
from .._system.motion import Body, Force, Torque
from .._system.parameters import parameter
from ._part import Contact, called, check_parameters
from ._tyre_laws import LongitudinalSlip, TyreForceLaw


class Tyre(eqx.Module):
    """A tyre; by default a knife edge that rolls without slip, as in the Whipple bicycle.

        Tyre(crown=0.02, lateral=LateralSlip(9000.0, relaxation_length=0.15))

    **Arguments:**

    - `crown` [m]: radius of the cross section of a torus, whose outer radius is the wheel's. None: a knife edge.
    - `lateral`: law of the lateral force. None: the tyre does not slip sideways.
    - `longitudinal`: law of the longitudinal force. None: it rolls without slip.
    - `rolling_resistance`: resisting torque over load times radius, of a bicycle 0.003 to 0.01. Without slip the
        force follows from the constraint.
    - `load_lag` [s]: the load that laws and rolling resistance feel is the one that the ground carries, with a lag of
        the first order: a state "front_load_transfer", by which it differs from the load at rest, over the bicycle's
        weight. None: the load at rest.
    """

    crown: Scalar | None = parameter(None, positive=True, unit="m")
    lateral: TyreForceLaw | None = None
    longitudinal: LongitudinalSlip | None = None
    rolling_resistance: Scalar | None = parameter(None, within=(0.0, 1.0))
    load_lag: Scalar | None = parameter(None, positive=True, within=(0.0, 5.0), unit="s")

    def __check_init__(self) -> None:
        check_parameters(self)
        along, across = self.longitudinal, self.lateral
        if not (along is None or isinstance(along, LongitudinalSlip)):
            raise TypeError(f"Tyre: `longitudinal` is a LongitudinalSlip or None, got {called(along)}.")
        if isinstance(across, LongitudinalSlip) or not (across is None or isinstance(across, TyreForceLaw)):
            raise TypeError(f"Tyre: `lateral` is a law of lateral slip or None, got {called(across)}.")

    @property
    def rolls(self) -> bool:
        """Whether it does not slip at all."""
        return self.lateral is None and self.longitudinal is None

    @property
    def laws(self) -> tuple[tuple[str, TyreForceLaw], ...]:
        """Those directions in which it slips."""
        laws = (("longitudinal", self.longitudinal), ("lateral", self.lateral))
        return tuple((name, law) for name, law in laws if law is not None)

    @property
    def deflects(self) -> tuple[str, ...]:
        """Those directions in which its slip follows with a relaxation length."""
        return tuple(name for name, law in self.laws if law.relaxation_length is not None)

    def reach(self, down: Vector, normal: Vector, radius: Component) -> Vector:
        """From the wheel's centre to the contact; `down` is the unit vector in the wheel's plane towards the ground."""
        if self.crown is None:
            return radius * down
        return (radius - self.crown) * down + self.crown * normal

    def rolled(self, cos_camber: Component, radius: Component) -> Component:
        """What a wheel rolls over its angle [m]: smaller where it is inclined."""
        return radius if self.crown is None else radius - self.crown + self.crown * cos_camber

    def residuals(self, contact: Contact) -> list[Any]:
        """What is zero [m/s]: the velocity of the contact, less its slip."""
        v, (along, across) = contact.point.velocity, contact.slip
        if self.rolls:
            return [v]
        return [v.dot(contact.heading) - along, v.dot(contact.across) - across, v.dot(contact.normal)]

    def forces(self, contact: Contact, load: Component, deflection: dict[str, Component]) -> dict[str, Component]:
        """Of the ground on the tyre [N], by direction. `load` [N]; `deflection` [m] by direction."""
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
        """What the ground does to the wheel, the force of ideal rolling apart."""
        for name, law, slip in self._slips(contact, deflection):
            force = law.force(slip, load, contact.camber)
            yield Force(force * _direction(name, contact), contact.point)
            moment = law.moment(force, slip, load, contact.camber)
            if not is_zero(moment):
                yield Torque(moment * contact.normal, wheel)
        if self.rolling_resistance is not None:
            # Over a tenth of a metre a second, so that a wheel at rest stays there.
            size = self.rolling_resistance * jnp.maximum(load, 0.0) * radius * jnp.tanh(contact.speed / 0.1)
            yield Torque(size * contact.across, wheel)


def _direction(name: str, contact: Contact) -> Vector:
    return contact.across if name == "lateral" else contact.heading


def _moving(name: str, contact: Contact) -> tuple[Component, Component, Component]:
    """Slip velocity [m/s], speed and camber, as a law asks for them."""
    return contact.slip[name == "lateral"], contact.speed, contact.camber


def rolling_speed(tyre: Tyre, spin: Component, cos_camber: Component, radius: Component, slip: Component) -> Component:
    """The speed of a contact along the wheel's heading [m/s]: -spin r + slip, of a wheel whose axle points right."""
    return sub(slip, mul(spin, tyre.rolled(cos_camber, radius)))
