"""Laws of a tyre that slips: forces from slip. Knows numbers; knows no wheel.

Slip is a velocity of the contact over the speed at which the wheel runs along: the tangent of the slip angle across the
wheel, the slip ratio along it. With a relaxation length it follows through the tyre's deflection v (Pacejka 2012, *Tire
and Vehicle Dynamics*, section 7.2.1), which is finite and right at rest, where the tyre is a spring:

    dv/dt = -(slip velocity) - |speed| (v / relaxation_length - camber's equivalent),   slip = v / relaxation_length
"""

from __future__ import annotations

import abc
import math
from typing import TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp

from .._description.parameters import parameter
from .._scalars.types import Component, Scalar
from ..catalog.bicycle import FAR
from ._part import check_parameters

CREEPING = 0.01
"""[m/s]: below this speed the law of a tyre without relaxation length is smoothed, so that it stays finite."""


class Slip(eqx.Module):
    """How a tyre's slip gives a force. A law of your own gives `force`; and `equivalent`, where camber counts."""

    if TYPE_CHECKING:
        relaxation_length: Scalar | None
        largest_load: float
    else:
        largest_load = math.inf  # [N], beyond which `force` is NaN

    def __check_init__(self) -> None:
        check_parameters(self)

    @abc.abstractmethod
    def force(self, slip: Component, load: Component, camber: Component) -> Component:
        """[N] of the ground on the tyre; `slip`: positive where the contact moves to the negative side; `load` [N];
        `camber` [rad], of which `slip` has the `equivalent`."""

    def equivalent(self, camber: Component) -> Component:
        """The slip that would give the force of a camber angle [rad]."""
        return 0.0

    def moment(self, force: Component, slip: Component, load: Component, camber: Component) -> Component:
        """[N m] about the ground's normal, downwards; `force` [N] is that of these arguments."""
        return 0.0

    def slip(self, velocity: Component, speed: Component, camber: Component, deflection: Component | None) -> Component:
        if deflection is not None:
            return deflection / self.relaxation_length
        return self.equivalent(camber) - velocity / jnp.sqrt(speed * speed + CREEPING**2)

    def deflection_rate(
        self, velocity: Component, speed: Component, camber: Component, deflection: Component
    ) -> Component:
        """[m/s], see above."""
        lag = deflection / self.relaxation_length - self.equivalent(camber)
        return -velocity - jnp.abs(speed) * lag


class _Aligning(Slip):
    """A law whose lateral force acts behind the contact, and whose camber twists the tyre."""

    if TYPE_CHECKING:
        pneumatic_trail: Scalar | None
        twisting_stiffness: Scalar | None

    def moment(self, force, slip, load, camber):
        moment: Component = 0.0
        if self.pneumatic_trail is not None:
            moment = moment - self.pneumatic_trail * force
        if self.twisting_stiffness is not None:
            moment = moment + self.twisting_stiffness * camber
        return moment


class LateralSlip(_Aligning):
    """Lateral force in proportion to slip and camber, as in Sharp (1971).

        sigma / |V| dF/dt + F = cornering_stiffness * slip + camber_stiffness * camber

    **Arguments:** `cornering_stiffness` [N/rad]; `camber_stiffness` [N/rad]; `relaxation_length` sigma [m], None for
    a force that follows at once; `pneumatic_trail` [m] behind the contact at which the force acts; `twisting_stiffness`
    [N m/rad], the moment of camber.
    """

    cornering_stiffness: Scalar = parameter(positive=True, unit="N/rad")
    camber_stiffness: Scalar | None = parameter(None, unit="N/rad")
    relaxation_length: Scalar | None = parameter(None, positive=True, within=(0.0, FAR), unit="m")
    pneumatic_trail: Scalar | None = parameter(None, within=(-FAR, FAR), unit="m")
    twisting_stiffness: Scalar | None = parameter(None, unit="N m/rad")

    def force(self, slip, load, camber):
        return self.cornering_stiffness * slip

    def equivalent(self, camber):
        if self.camber_stiffness is None:
            return 0.0
        return self.camber_stiffness / self.cornering_stiffness * camber


class MagicFormula(_Aligning):
    """Lateral force by the Magic Formula, in proportion to the load (Pacejka 2012, eq. 4.1 to 4.6).

        F = load * friction * sin(shape * atan(b - curvature * (b - atan(b)))),
        b = stiffness / (shape * friction) * (slip + camber_ratio * camber)

    **Arguments:** `stiffness` [1/rad]: cornering stiffness over load; `friction`: largest force over load; `shape` and
    `curvature`: C and E of the formula; `camber_ratio`: stiffness by camber over that by slip; the rest as in
    `LateralSlip`.
    """

    stiffness: Scalar = parameter(positive=True, unit="1/rad")
    friction: Scalar = parameter(1.0, positive=True, within=(0.0, 10.0))
    shape: Scalar = parameter(1.3, positive=True, within=(0.0, 3.0))
    curvature: Scalar = parameter(0.0)
    camber_ratio: Scalar | None = parameter(None)
    relaxation_length: Scalar | None = parameter(None, positive=True, within=(0.0, FAR), unit="m")
    pneumatic_trail: Scalar | None = parameter(None, within=(-FAR, FAR), unit="m")
    twisting_stiffness: Scalar | None = parameter(None, unit="N m/rad")

    def force(self, slip, load, camber):
        b = self.stiffness / (self.shape * self.friction) * slip
        b = b - self.curvature * (b - jnp.arctan(b))
        carried = jnp.maximum(load, 0.0)  # a wheel that would lift does not pull
        return carried * self.friction * jnp.sin(self.shape * jnp.arctan(b))

    def equivalent(self, camber):
        return 0.0 if self.camber_ratio is None else self.camber_ratio * camber


class LongitudinalSlip(Slip):
    """Longitudinal force in proportion to the slip ratio.

    **Arguments:** `stiffness` [N]: force over slip ratio; `relaxation_length` [m] as in `LateralSlip`.
    """

    stiffness: Scalar = parameter(positive=True, unit="N")
    relaxation_length: Scalar | None = parameter(None, positive=True, within=(0.0, FAR), unit="m")

    def force(self, slip, load, camber):
        return self.stiffness * slip
