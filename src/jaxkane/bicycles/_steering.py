"""What acts on the steer axis: dry friction, and a motor with its gear, rotor, lag and delay. Knows one joint."""

from __future__ import annotations

import jax.numpy as jnp

from .._description.loads import Torque
from .._description.parameters import parameter
from .._scalars.components import mul
from .._scalars.types import Component, Scalar
from ..loads import coulomb, rotor
from ._part import Part


class SteeringFriction(Part):
    """Dry friction of the steering head, by `jaxkane.loads.coulomb`; viscous is the bicycle's own `steer_damping`.

    **Arguments:** `level` [N m]; `width` [rad/s] of the smoothing: at slower rates the friction is viscous, level /
    width times the rate, so that a steady torque below `level` makes the fork creep.
    """

    level: Scalar = parameter(positive=True, unit="N m")
    width: Scalar = parameter(0.02, positive=True, unit="rad/s")

    def loads(self, bicycle, t, q, u, motion, values):
        torque = coulomb(u["steer_rate"], self.level, width=self.width)
        return Torque(-torque * motion["C"].z, motion["fork"], reaction_on=motion["rear frame"])


class SteeringMotor(Part):
    """A geared motor between frame and fork: what is commanded comes later, slower, and no larger than it can.

        command -> delay -> limit -> lag -> torque on the fork, with its reaction on the frame

    It has the input "steer_command" [N m], of the torque at the steer axis; a controller writes to it with
    `command="steer_command"`. What the motor gives is added to "steer_torque".

    **Arguments**, None for what is not there:

    - `lag` [s] of the first order: d(torque)/dt = (limited command - torque) / lag, the state "steer_motor_torque".
    - `delay` [s], by the Pade approximation (1 - s T / 3) / (1 + 2 s T / 3 + (s T)^2 / 6), which is right to the third
        order in s T and gives nothing at once: the states "steer_delayed" and "steer_delayed_slope" [N m]. A delay of
        torques that do not depend on the motion is exact as moved times of their samples, `jk.Samples(t + delay, ...)`.
    - `limit` [N m]: the largest torque, by limit * tanh(command / limit).
    - `rotor_inertia` [kg m^2] and `ratio`, the rotor's rate over that of the steer: a body of its own, of which the
        steer feels ratio^2 * rotor_inertia, and the frame the gyroscopic moment.
    """

    lag: Scalar | None = parameter(None, positive=True, within=(0.0, 5.0), unit="s")
    delay: Scalar | None = parameter(None, positive=True, within=(0.0, 5.0), unit="s")
    limit: Scalar | None = parameter(None, positive=True, unit="N m")
    rotor_inertia: Scalar | None = parameter(None, positive=True, unit="kg m^2")
    ratio: Scalar = parameter(1.0)

    inputs = ("steer_command",)

    @property
    def states(self) -> tuple[str, ...]:
        delayed = ("steer_delayed", "steer_delayed_slope") if self.delay is not None else ()
        return (*delayed, "steer_motor_torque") if self.lag is not None else delayed

    @property
    def units(self) -> dict[str, str]:
        return dict.fromkeys((*self.inputs, *self.states), "N m")

    def motion(self, bicycle, motion, t, q, u):
        if self.rotor_inertia is None:
            return motion
        head = motion["C"].parent
        spinning = mul(self.ratio, u["steer_rate"])
        return motion.extended([rotor(self.rotor_inertia, head.z, spinning, head, motion["S"], name="steering motor")])

    def commands(self, bicycle, t, q, u, motion, values):
        return {"steer_torque": self._asked(values) if self.lag is None else values["steer_motor_torque"]}

    def _asked(self, values) -> Component:
        """The command [N m], delayed and limited."""
        asked = values["steer_command"]
        if self.delay is not None:
            asked = values["steer_delayed"] - values["steer_delayed_slope"] / 3.0
        return asked if self.limit is None else self.limit * jnp.tanh(asked / self.limit)

    def state_rates(self, bicycle, t, q, u, x, motion, now):
        rates = []
        if self.delay is not None:  # of w in w + 2/3 T w' + T^2 w'' / 6 = command, and of T w'
            w, slope = now["steer_delayed"], now["steer_delayed_slope"]
            rates += [slope / self.delay, (6.0 * (now["steer_command"] - w) - 4.0 * slope) / self.delay]
        if self.lag is not None:
            rates.append((self._asked(now) - now["steer_motor_torque"]) / self.lag)
        return rates
