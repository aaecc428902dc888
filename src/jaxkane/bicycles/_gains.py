"""Balance by feedback of the state: constant gains, and gains scheduled over speed. Knows names of states.

Every part here follows a roll angle, the input "desired_roll" [rad], which is zero by default: a path follower
sets it, or the inputs of a simulation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from .._common.lookup import as_names, refuse_unknown
from .._description.parameters import parameter, to_float
from .._method.checks import is_concrete
from .._scalars.components import mul, sub
from .._scalars.types import Component, Scalar
from ..loads import smooth_abs
from ..stability import linearize, straight_ahead
from ..stability import lqr as regulator
from ._bicycle import Bicycle
from ._part import Part

STEER = "steer_torque"


class LeanSteerGains(Part):
    """Steer torque in proportion to lean and steer and their rates.

        command = follow * desired_roll - sum of gain * state,   state = roll, steer, roll_rate, steer_rate

    At speeds where a bicycle weaves, a negative `roll_rate` alone can balance it:
    it turns the fork to the side to which the bicycle falls.

    **Arguments:** the gains `roll`, `steer` [N m/rad], `roll_rate`, `steer_rate` [N m s/rad]; `follow` [N m/rad], by
    default that of roll, see `follow_gain`; `command`: the input that is written to.
    """

    roll: Scalar = parameter(0.0, unit="N m/rad")
    steer: Scalar = parameter(0.0, unit="N m/rad")
    roll_rate: Scalar = parameter(0.0, unit="N m s/rad")
    steer_rate: Scalar = parameter(0.0, unit="N m s/rad")
    follow: Scalar | None = parameter(None, unit="N m/rad")
    command: str = eqx.field(static=True, default=STEER)

    inputs = ("desired_roll",)
    units = {"desired_roll": "rad"}

    def commands(self, bicycle, t, q, u, motion, values):
        follow = self.roll if self.follow is None else self.follow
        angles = self.roll * q["roll"] + self.steer * q["steer"]
        rates = self.roll_rate * u["roll_rate"] + self.steer_rate * u["steer_rate"]
        return {self.command: follow * values["desired_roll"] - angles - rates}


class ScheduledGains(Part):
    """Feedback of any states with gains that change with the forward speed v.

        command = follow(v) * desired_roll - sum of gains(v) * state

    Between the speeds of the schedule the gains are linear in v, with corners that are rounded over a twentieth of the
    smallest interval, so that every derivative is finite. Below the first speed and above the last the gains stay what
    they are there. `lqr` makes such a part.

    **Arguments:** `at` (n,) [m/s]: the speeds of the schedule, increasing; `measured`: m names of coordinates, speeds
    and states of the first order; `gains` (n, m), in N m for the unit of each; `follow` (n,) [N m/rad]; `command`: the
    input that is written to.

    **Raises:** `ValueError` for other shapes, speeds that do not increase, and numbers that are not finite.
    """

    at: tuple[float, ...] = eqx.field(static=True, converter=lambda at: tuple(np.asarray(at, dtype=float).tolist()))
    measured: tuple[str, ...] = eqx.field(static=True, converter=as_names)
    gains: Float[Array, "n m"] = eqx.field(converter=to_float)
    follow: Float[Array, " n"] = eqx.field(converter=to_float)
    command: str = eqx.field(static=True, default=STEER)

    inputs = ("desired_roll",)
    units = {"desired_roll": "rad"}

    def check(self, bicycle):
        known = (*bicycle.coordinates, *bicycle.speeds, *bicycle.dependent_speeds, *bicycle.states)
        refuse_unknown(self.measured, known, f"ScheduledGains: {type(bicycle).__name__} has no")

    def __check_init__(self) -> None:
        n, m = len(self.at), len(self.measured)
        if not (n and all(map(math.isfinite, self.at)) and all(np.diff(self.at) > 0)):
            raise ValueError(f"ScheduledGains: `at` are speeds [m/s] that increase, got {self.at}.")
        for name, shape in (("gains", (n, m)), ("follow", (n,))):
            value = getattr(self, name)
            if np.shape(value)[-len(shape) :] != shape:  # leading axes more are a batch
                raise ValueError(
                    f"ScheduledGains: `{name}` has the shape {shape}, for {n} speeds and the states "
                    f"{', '.join(self.measured)}; got {np.shape(value)}."
                )
            if is_concrete(value) and not np.all(np.isfinite(np.asarray(value))):
                raise ValueError(f"ScheduledGains: `{name}` are not all finite.")

    def commands(self, bicycle, t, q, u, motion, values):
        passed = self._passed(motion.rear.speed)
        command = mul(_at(passed, self.follow), values["desired_roll"])
        for i, name in enumerate(self.measured):
            gain = _at(passed, self.gains[:, i])
            command = sub(command, mul(gain, _state(name, bicycle, q, u, values)))
        return {self.command: command}

    def _passed(self, v: Component) -> list[Component]:
        """Of each interval of the schedule the share that lies below v: 0 before it and 1 behind it."""
        if len(self.at) == 1:
            return []
        lengths = np.diff(self.at)
        away = [smooth_abs(v - each, 0.05 * float(lengths.min())) for each in self.at]
        pairs = zip(away, away[1:], lengths, strict=False)
        return [0.5 + (low - high) / (2.0 * length) for low, high, length in pairs]


def _at(passed: list[Component], values: Any) -> Component:
    """x_0 + sum of passed_i (x_i+1 - x_i)."""
    found = values[0]
    for i, share in enumerate(passed):
        found = found + share * (values[i + 1] - values[i])
    return found


def _state(name: str, bicycle: Bicycle, q: Any, u: Any, values: Any) -> Component:
    if name in bicycle.coordinates:
        return q[name]
    return u[name] if name in (*bicycle.speeds, *bicycle.dependent_speeds) else values[name]


def follow_gain(bicycle: Bicycle, speed: float) -> float:
    """How much "desired_roll" [rad] a balanced bicycle needs for one radian of roll in a steady turn, at `speed` [m/s].

    Of the linear model about riding straight. A balance with this many times its gain of "desired_roll" leans as it is
    asked to: `LeanSteerGains(..., follow=...)`, or `PathFollower(path, gain=follow_gain(bicycle, speed))` before it.

    **Raises:** `ValueError` where the balance does not read "desired_roll".
    """
    if "desired_roll" not in bicycle.inputs:
        raise ValueError(f'{type(bicycle).__name__}: it has no balance that reads the input "desired_roll".')
    model = linearize(bicycle, straight_ahead(bicycle, speed), states=bicycle.lateral)
    turned = np.linalg.solve(model.A, -np.asarray(model.B)[:, model.inputs.index("desired_roll")])
    return float(1.0 / turned[model.states.index("roll")])


def lqr(
    bicycle: Bicycle,
    speeds: Sequence[float],
    Q: Any,
    R: Any,
    *,
    states: Sequence[str] | None = None,
    command: str = STEER,
) -> ScheduledGains:
    """Linear-quadratic regulators of riding straight at several speeds, as one part with scheduled gains.

        bicycle.with_parts(control=lqr(bicycle, jnp.linspace(2.0, 8.0, 7), Q=[10.0, 1.0, 1.0, 0.1], R=0.01))

    At each speed `jaxkane.stability.lqr` of `jaxkane.stability.linearize`. The gain of "desired_roll" is the one with
    which a steady turn of that linear model has this roll.

    **Arguments:** `bicycle`, without a balance of its own; `speeds` (n,) [m/s], increasing; `Q` (m, m) or its diagonal
    (m,), the weights of the states; `R`: of the command; `states`: names, by default `bicycle.lateral`, all that move
    to first order when it leaves the upright plane; `command`: the input by which it steers.

    **Raises:** `ValueError` as those two functions, as where no regulator exists, and for a bicycle with a balance.
    """
    if "desired_roll" in bicycle.inputs:
        raise ValueError(f"lqr: the {type(bicycle).__name__} has a balance already: bicycle.with_parts(control=None).")
    names = bicycle.lateral if states is None else as_names(states)
    gains, follow = [], []
    for v in np.asarray(speeds, dtype=float):
        model = linearize(bicycle, straight_ahead(bicycle, v), states=names)
        K, _, _ = regulator(model, Q, R, inputs=[command])
        A, B = np.asarray(model.A), np.asarray(model.B)[:, model.inputs.index(command)]
        turned = np.linalg.solve(A - B[:, None] @ K, -B)  # the steady states of a constant command beside the feedback
        gains.append(K[0])
        follow.append(1.0 / turned[names.index("roll")])
    return ScheduledGains(speeds, names, np.array(gains), np.array(follow), command)
