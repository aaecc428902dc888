"""Control of a bicycle: state feedback, path following and a rider model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._common.lookup import as_names, refuse_unknown
from .._kane.arguments import is_concrete
from .._kane.right_hand_side import MeasurementContext
from .._scalarjit.components import Component, Scalar, mul, sub
from .._system.parameters import Learned, learned, parameter, to_float
from .._system.system import NamedVector
from ..catalog._entry import Values
from ..catalog.bicycle import TILT
from ..loads import smooth_abs
from ..stability import linearize, lqr, straight_ahead
from ._bicycle import Bicycle
from ._part import BicycleLike, BicycleMotion, ParametricModule, Part

STEER = "steer_torque"


class LeanSteerGains(Part):
    """A steer torque proportional to roll, steer and their rates.

        command = follow * desired_roll - sum of gain * state,   state = roll, steer, roll_rate, steer_rate

    At speeds where a bicycle weaves, a negative `roll_rate` gain alone can balance it: it turns the fork to the side to
    which the bicycle falls.

    **Arguments:**

    - `roll`, `steer` [N m/rad], `roll_rate`, `steer_rate` [N m s/rad]: the gains.
    - `follow` [N m/rad]: gain of "desired_roll"; `roll` by default, see `follow_gain`.
    - `command`: name of the input to which the torque is added.
    """

    roll: Scalar = parameter(0.0, unit="N m/rad")
    steer: Scalar = parameter(0.0, unit="N m/rad")
    roll_rate: Scalar = parameter(0.0, unit="N m s/rad")
    steer_rate: Scalar = parameter(0.0, unit="N m s/rad")
    follow: Scalar | None = parameter(None, unit="N m/rad")
    command: str = eqx.field(static=True, default=STEER)

    inputs = ("desired_roll",)
    units = {"desired_roll": "rad"}

    def commands(
        self, bicycle: BicycleLike, t: Component, q: NamedVector, u: NamedVector, motion: BicycleMotion, values: Values
    ) -> Values:
        follow = self.roll if self.follow is None else self.follow
        angles = self.roll * q["roll"] + self.steer * q["steer"]
        rates = self.roll_rate * u["roll_rate"] + self.steer_rate * u["steer_rate"]
        return {self.command: follow * values["desired_roll"] - angles - rates}


class ScheduledGains(Part):
    """State feedback with gains that depend on the forward speed v (gain scheduling).

        command = follow(v) * desired_roll - sum of gains(v) * state

    Between the scheduled speeds the gains are linear in v. The corners are rounded over a twentieth of the smallest
    interval, so that all derivatives are finite. The gains are constant below the first speed and above the last one.
    `scheduled_lqr` returns such a part.

    **Arguments:**

    - `at` (n,) [m/s]: the scheduled speeds, increasing.
    - `measured`: m names of coordinates, speeds and states of the first order.
    - `gains` (n, m): in N m divided by the unit of each state.
    - `follow` (n,) [N m/rad]: gain of "desired_roll".
    - `command`: name of the input to which the torque is added.

    **Raises:** `ValueError` for other shapes, speeds that do not increase, and numbers that are not finite.
    """

    at: tuple[float, ...] = eqx.field(static=True, converter=lambda at: tuple(np.asarray(at, dtype=float).tolist()))
    measured: tuple[str, ...] = eqx.field(static=True, converter=lambda names: as_names(names, "measured"))
    gains: Float[Array, "n m"] = eqx.field(converter=to_float)
    follow: Float[Array, " n"] = eqx.field(converter=to_float)
    command: str = eqx.field(static=True, default=STEER)

    inputs = ("desired_roll",)
    units = {"desired_roll": "rad"}

    def check(self, bicycle: BicycleLike) -> None:
        known = (*bicycle.coordinates, *bicycle.speeds, *bicycle.dependent_speeds, *bicycle.states)
        refuse_unknown(self.measured, known, f"ScheduledGains: {type(bicycle).__name__} has no")

    def __check_init__(self) -> None:
        n, m = len(self.at), len(self.measured)
        if not (n and all(map(math.isfinite, self.at)) and all(np.diff(self.at) > 0)):
            raise ValueError(f"ScheduledGains: `at` must be increasing, finite speeds [m/s], got {self.at}.")
        for name, shape in (("gains", (n, m)), ("follow", (n,))):
            value = getattr(self, name)
            if np.shape(value)[-len(shape) :] != shape:  # additional leading axes are a batch
                raise ValueError(
                    f"ScheduledGains: `{name}` must have the shape {shape}, for {n} speeds and the states "
                    f"{', '.join(self.measured)}; got {np.shape(value)}."
                )
            if is_concrete(value) and not np.all(np.isfinite(np.asarray(value))):
                raise ValueError(f"ScheduledGains: `{name}` contains a value that is not finite.")

    def commands(
        self, bicycle: BicycleLike, t: Component, q: NamedVector, u: NamedVector, motion: BicycleMotion, values: Values
    ) -> Values:
        passed = self._passed(motion.rear.speed)
        command = mul(_at(passed, self.follow), values["desired_roll"])
        for i, name in enumerate(self.measured):
            gain = _at(passed, self.gains[:, i])
            state = next((x[name] for x in (q, u) if name in x), None)
            command = sub(command, mul(gain, values[name] if state is None else state))
        return {self.command: command}

    def _passed(self, v: Component) -> list[Component]:
        """The share of each interval of the schedule that is below v: 0 before the interval and 1 after it."""
        if len(self.at) == 1:
            return []
        lengths = np.diff(self.at)
        away = [smooth_abs(v - each, 0.05 * float(lengths.min())) for each in self.at]
        pairs = zip(away, away[1:], lengths, strict=False)
        return [0.5 + (low - high) / (2.0 * length) for low, high, length in pairs]


def _at(passed: list[Component], values: Float[Array, " n"]) -> Component:
    """x_0 + sum of passed_i (x_i+1 - x_i)."""
    value = values[0]
    for i, share in enumerate(passed):
        value = value + share * (values[i + 1] - values[i])
    return value


def follow_gain(bicycle: Bicycle, speed: float) -> float:
    """The "desired_roll" [rad] per radian of roll in a steady turn at `speed` [m/s], by the linear model about straight
    riding.

    If a controller's gain of "desired_roll" is multiplied by this factor, the bicycle reaches the desired roll:
    `LeanSteerGains(..., follow=...)`, or `PathFollower(path, gain=follow_gain(bicycle, speed))` before it.

    **Raises:** `ValueError` if no controller reads "desired_roll".
    """
    if "desired_roll" not in bicycle.inputs:
        raise ValueError(
            f'{type(bicycle).__name__} has no controller with the input "desired_roll". Add one, e.g. '
            "bicycle.with_parts(control=LeanSteerGains(...))."
        )
    model = linearize(bicycle, straight_ahead(bicycle, speed), states=bicycle.lateral)
    turned = np.linalg.solve(model.A, -np.asarray(model.B)[:, model.inputs.index("desired_roll")])
    return float(1.0 / turned[model.states.index("roll")])


def scheduled_lqr(
    bicycle: Bicycle,
    speeds: Sequence[float],
    Q: ArrayLike,
    R: ArrayLike,
    *,
    states: Sequence[str] | None = None,
    command: str = STEER,
) -> ScheduledGains:
    """Linear-quadratic regulators of straight riding at several speeds, as one part with scheduled gains.

        bicycle.with_parts(control=scheduled_lqr(bicycle, jnp.linspace(2.0, 8.0, 7), Q=[10.0, 1.0, 1.0, 0.1], R=0.01))

    At each speed, `jaxkane.stability.lqr` uses the model of `jaxkane.stability.linearize`. The gain of "desired_roll"
    makes the roll of a steady turn of the linear model equal to "desired_roll".

    **Arguments:**

    - `bicycle`: without its own controller.
    - `speeds` (n,) [m/s]: increasing.
    - `Q`: (m, m) weights of the states, or their diagonal (m,).
    - `R`: weight of the command.
    - `states`: names of the states. Default: `bicycle.lateral`, all that change to first order when it leaves the
        upright plane.
    - `command`: name of the steering input.

    **Raises:** `ValueError` as those two functions, e.g. if no regulator exists, and for a bicycle with a controller.
    """
    if "desired_roll" in bicycle.inputs:
        raise ValueError(
            f"scheduled_lqr: the {type(bicycle).__name__} already has a controller. Remove it by "
            "bicycle.with_parts(control=None)."
        )
    names = bicycle.lateral if states is None else as_names(states, "states")
    gains, follow = [], []
    for v in np.asarray(speeds, dtype=float):
        model = linearize(bicycle, straight_ahead(bicycle, v), states=names)
        K, _, _ = lqr(model, Q, R, inputs=[command])
        A, B = np.asarray(model.A), np.asarray(model.B)[:, model.inputs.index(command)]
        # steady states for a constant command in addition to the feedback
        turned = np.linalg.solve(A - B[:, None] @ K, -B)
        gains.append(K[0])
        follow.append(1.0 / turned[names.index("roll")])
    return ScheduledGains(speeds, names, np.array(gains), np.array(follow), command)


class LaneChange(ParametricModule):
    """A path y(x) [m] from one lane to another, with continuous curvature.

        y = width * s^3 (10 - 15 s + 6 s^2),   s = (x - start) / length from 0 to 1

    **Arguments:**

    - `width` [m]: positive to the right (y of the bicycle).
    - `start`, `length` [m]: where the lane change begins, and its length.
    - `back` [m]: where it begins to return, over the same length. None: it does not return.
    """

    width: Scalar = parameter(3.0, unit="m")
    start: Scalar = parameter(10.0, unit="m")
    length: Scalar = parameter(20.0, positive=True, unit="m")
    back: Scalar | None = parameter(None, unit="m")

    def __call__(self, x: Component) -> Component:
        aside = self._passed(x - self.start)
        return self.width * (aside if self.back is None else aside - self._passed(x - self.back))

    def _passed(self, along: Component) -> Component:
        s = jnp.clip(along / self.length, 0.0, 1.0)
        return s**3 * (10.0 + s * (6.0 * s - 15.0))


class PathFollower(Part):
    """Looks ahead to a point of a path, and commands the roll of the turn that leads there.

        aside = (path(x + L cos(yaw)) - y - L sin(yaw)) cos(yaw),   L = speed * preview
        desired_roll = gain * limit * tanh(2 aside / (g preview^2) / limit)

    An arc that begins along the heading and meets the point `aside` needs the lateral acceleration 2 aside / preview^2.
    Divided by g, this is the roll of a steady turn. Small deviations from a straight path then follow y'' + 2 / preview
    y' + 2 / preview^2 y = 0, with a damping ratio of 0.71, if the roll controller is faster.

    It adds to "desired_roll". Place the controller that reads this input after it:
    `control=(PathFollower(LaneChange()), LeanSteerGains(...))`.

    **Arguments:**

    - `path`: a function y(x) [m] that JAX can trace, e.g. a `LaneChange`. Its arrays are parameters. It should be
        differentiable everywhere: a discontinuity of the path is a discontinuity of the desired roll.
    - `preview` [s]: the preview time. If it is too short, the commanded turns are faster than the controller can
        follow.
    - `gain`: multiplies the roll; use it if the controller does not reach the desired roll, see `follow_gain`.
    - `limit` [rad]: the largest roll before that gain.
    """

    path: Any = learned()
    preview: Scalar = parameter(2.0, positive=True, within=(0.0, 100.0), unit="s")
    gain: Scalar = parameter(1.0)
    limit: Scalar = parameter(0.3, positive=True, within=TILT, unit="rad")

    def commands(
        self, bicycle: BicycleLike, t: Component, q: NamedVector, u: NamedVector, motion: BicycleMotion, values: Values
    ) -> Values:
        cos, sin = jnp.cos(q["yaw"]), jnp.sin(q["yaw"])
        ahead = motion.rear.speed * self.preview
        aside = (self.path(q["x"] + ahead * cos) - q["y"] - ahead * sin) * cos
        roll = 2.0 * aside / (bicycle.g * self.preview**2)
        return {"desired_roll": self.gain * self.limit * jnp.tanh(roll / self.limit)}


# speed, steer, roll_rate, roll, heading, deviation of the benchmark bicycle: gains/BenchmarkSteerGains.txt of
# github.com/moorepants/HumanControl at 37107d22, the code of the paper; "chosen manually by Ron Hess" or by that code.
_OF_BENCHMARK = np.array([
    (2.5, 22.0, -0.09, 23.3, 0.058, 0.195),
    (3.2, 29.283, -0.049, 25.64, 0.087, 0.15),
    (3.6, 33.1311, -0.0535, 19.8266, 0.1056, 0.1338),
    (4.8, 44.6406, -0.0529, 13.2253, 0.172, 0.1001),
    (5.0, 46.5457, -0.0522, 12.6611, 0.1849, 0.0959),
    (8.0, 74.988, -0.04, 9.351, 0.434, 0.06),
    (8.34, 78.2238, -0.0388, 9.2493, 0.4676, 0.0571),
    (12.0, 115.379, -0.029, 9.28, 0.855, 0.04),
])  # fmt: skip


class SequentialLoopRider(Part):
    """A human rider as five nested feedback loops with a neuromuscular lag.

        wanted heading   = deviation * (path - y)                    y, x of the front contact
        wanted roll      = heading * (wanted heading - yaw) + desired_roll
        wanted roll rate = roll * (wanted roll - roll angle)
        wanted steer     = roll_rate * (wanted roll rate - roll rate)
        torque'' + 2 damping frequency torque' + frequency^2 torque = frequency^2 steer * (wanted steer - steer angle)

    The gains are `deviation`, `heading`, `roll`, `roll_rate` and `steer`. Hess, Moore and Hubbard (2012), *Modeling the
    manually controlled bicycle*, IEEE Transactions on Systems, Man, and Cybernetics A 42(3). The torque [N m] and its
    rate are the states "rider_torque" and "rider_torque_rate".

    **Arguments:**

    - `steer` [N m/rad], `roll_rate` [s], `roll` [1/s]: gains of the inner loops.
    - `heading`, `deviation` [rad/m]: gains of the outer loops, which are used if there is a `path`.
    - `path`: a function y(x) [m] as of `PathFollower`. Without it the rider follows "desired_roll" only.
    - `preview` [s]: the path is evaluated at the position of the front contact after this time.
    - `frequency` [rad/s], `damping`: of the neuromuscular lag.
    - `command`: name of the input to which the torque is added.
    """

    steer: Scalar = parameter(unit="N m/rad")
    roll_rate: Scalar = parameter(unit="s")
    roll: Scalar = parameter(unit="1/s")
    heading: Scalar = parameter(0.0)
    deviation: Scalar = parameter(0.0, unit="rad/m")
    path: Any = eqx.field(default=None, converter=lambda path: None if path is None else Learned(path))
    preview: Scalar = parameter(0.0, within=(0.0, 100.0), unit="s")
    frequency: Scalar = parameter(30.0, positive=True, unit="rad/s")
    damping: Scalar = parameter(0.707, positive=True)
    command: str = eqx.field(static=True, default=STEER)

    inputs = ("desired_roll",)
    states = ("rider_torque", "rider_torque_rate")
    units = {"desired_roll": "rad", "rider_torque": "N m", "rider_torque_rate": "N m/s"}

    @classmethod
    def benchmark(cls, speed: float, **fields: Any) -> Self:
        """A rider with the gains for the benchmark bicycle, interpolated between the authors' values.

        **Arguments:**

        - `speed` [m/s]: from 2.5 to 12.
        - `fields`: other fields of the rider, e.g. `path`.

        **Raises:** `ValueError` for another speed.
        """
        speeds, *columns = _OF_BENCHMARK.T
        speed = float(speed)
        if not speeds[0] <= speed <= speeds[-1]:
            known = f"{speeds[0]:g} to {speeds[-1]:g} m/s"
            raise ValueError(
                f"SequentialLoopRider.benchmark: the gains are defined from {known}, got {speed} m/s. Pass a speed in "
                "this range."
            )
        gains: list[Any] = [np.interp(speed, speeds, column) for column in columns]
        return cls(*gains, **fields)

    def commands(
        self, bicycle: BicycleLike, t: Component, q: NamedVector, u: NamedVector, motion: BicycleMotion, values: Values
    ) -> Values:
        return {self.command: values["rider_torque"]}

    def wanted_roll(self, q: NamedVector, motion: BicycleMotion, values: Values) -> Component:
        """[rad]: the command of the inner loops."""
        if self.path is None:
            return values["desired_roll"]
        x, y = (motion["Q"].position.dot(axis) for axis in (motion.N.x, motion.N.y))
        heading = self.deviation * (self.path(x + motion.rear.speed * self.preview) - y)
        return values["desired_roll"] + self.heading * (heading - q["yaw"])

    def state_rates(
        self,
        bicycle: BicycleLike,
        t: Component,
        q: NamedVector,
        u: NamedVector,
        x: NamedVector,
        motion: BicycleMotion,
        now: MeasurementContext,
    ) -> Sequence[Component]:
        roll_rate = self.roll * (self.wanted_roll(q, motion, now) - q["roll"])
        steer = self.roll_rate * (roll_rate - u["roll_rate"])
        commanded = self.steer * (steer - q["steer"])
        torque, slope = now["rider_torque"], now["rider_torque_rate"]
        return slope, self.frequency**2 * (commanded - torque) - 2.0 * self.damping * self.frequency * slope
