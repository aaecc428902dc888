"""Sensors: gyroscopes, accelerometers, encoders, markers, cameras, load cells; and their filters.

For `System.outputs`, and the filters for `System.state_rates`:

    def outputs(self, t, q, u, motion, now):
        box, P = motion.frames["box"], motion["P"].fixed(motion.frames["box"].vector(*self.place))
        return {"imu": jk.sensors.imu(now, P, box.rotate_fixed(self.mounting), -9.81 * motion.N.z)}

    ride["imu.ay"], Trial(t, {"imu.gz": rate}, sigma=0.01)

A sensor's place, mounting, gain, offset and lag are parameters of the system like any other, which a fit can free.
Noise is the trial's `sigma`. Values are those of the ideal instrument; nothing is rounded unless a resolution is given.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from ._scalarjit.components import Component, positive
from ._system.kinematics import Frame, Point, Vector
from ._system.motion import Body, point_of

Named = dict[str, Component]


def gyroscope(frame: Frame) -> Named:
    """Angular velocity [rad/s] of a frame, along its own axes: "x", "y", "z".

    **Arguments:** `frame`: the instrument's, such as `body_frame.rotate_fixed(self.mounting)`.
    """
    return _along(_checked(frame).angular_velocity, frame)


def accelerometer(now: Any, point: Point | Body, frame: Frame, gravity: Vector) -> Named:
    """Specific force [m/s^2] at a point, along the axes of a frame: "x", "y", "z".

        f = a - g

    At rest it is g upwards, in free fall zero.

    **Arguments:** `now`, as `outputs` receives it; `point`: where the instrument sits, a Point that is fixed in the
    body that carries it; `frame`: the instrument's; `gravity` [m/s^2]: the Vector that `weight` is given.
    """
    return _along(now.acceleration(point_of(point)) - gravity, frame)


def imu(now: Any, point: Point | Body, frame: Frame, gravity: Vector) -> Named:
    """An accelerometer and a gyroscope in one box: "ax", "ay", "az" [m/s^2], "gx", "gy", "gz" [rad/s].

    Arguments as `accelerometer`.
    """
    f, w = accelerometer(now, point, frame, gravity), gyroscope(frame)
    return {**{f"a{k}": x for k, x in f.items()}, **{f"g{k}": x for k, x in w.items()}}


def encoder(
    angle: Component, *, zero: Component = 0.0, ratio: Component = 1.0, resolution: Component | None = None
) -> Component:
    """An angle, or the way of a wheel, as an encoder counts it.

        reading = ratio * (angle - zero),  rounded to whole multiples of `resolution`

    **Arguments:** `angle` [rad]; `zero`: where it reads zero; `ratio`: of a gear between, or a wheel's radius [m/rad],
    or its sign; `resolution`, in the unit of the reading, positive: None for an ideal one. Derivatives pass through
    the rounding as if there were none. In a fit leave it out, and take resolution / sqrt(12) as `sigma`.
    """
    reading = ratio * (angle - zero)
    if resolution is None:
        return reading
    steps = reading / positive(resolution, "encoder: the resolution")
    return reading + resolution * jax.lax.stop_gradient(jnp.round(steps) - steps)


def marker(point: Point | Body, origin: Point, frame: Frame) -> Named:
    """Where a point is, as a tracking system reports it: "x", "y", "z" [m].

    **Arguments:** `origin`, `frame`: of the tracking system, from which and along whose axes the place is measured.
    """
    return _along(point_of(point).position_from(origin), frame)


def camera(
    point: Point | Body,
    center: Point,
    frame: Frame,
    *,
    focal_length: Component,
    image_center: Sequence[Component] = (0.0, 0.0),
) -> Named:
    """Where a point is in the picture of a pinhole camera: "u", "v", in the unit of the focal length (pixels).

        u = u0 + focal_length * x / z,   v = v0 + focal_length * y / z

    **Arguments:** `center`: the camera's projection centre; `frame`: the camera's, z along the optical axis away from
    it, x to the right and y downwards in the picture. What is behind the camera is NaN.
    """
    x, y, z = point_of(point).position_from(center).components_in(frame)
    is_seen = jnp.asarray(z) > 0
    depth = jnp.where(is_seen, z, jnp.ones_like(z))
    lost = jnp.where(is_seen, jnp.zeros_like(depth), jnp.full_like(depth, jnp.nan))
    u0, v0 = image_center
    return {"u": u0 + focal_length * x / depth + lost, "v": v0 + focal_length * y / depth + lost}


def load_cell(now: Any, name: str, frame: Frame) -> Named:
    """The force [N] that a constraint carries at a named point, or the moment [N m] at a named frame: "x", "y", "z".

    **Arguments:** `now`, as `outputs` receives it; `name`: in `Motion(points=..., frames=...)`, see `constraint_forces`
    for what it acts on; `frame`: along whose axes the instrument measures. Forces from `loads` are not in it.

    **Raises:** `KeyError` for a name that is none of these; `TypeError` for that of an auxiliary speed, along which
    the force is a number: `now.force(name)`.
    """
    force = now.force(name)
    if not isinstance(force, Vector):
        raise TypeError(f"load_cell: {name!r} is an auxiliary speed, its force a number: take now.force({name!r}).")
    return _along(force, frame)


# -- filters: (rates of their states, output)


def low_pass(signal: Component, x: Any, time_constant: Component) -> tuple[tuple[Component], Component]:
    """A filter of the first order: a sensor, a motor or an actuator that lags behind.

        time_constant * x_dot = signal - x,   output x

    **Arguments:** `x`: its state, or a sequence that holds it; `time_constant` [s], positive.

    **Returns:** the rates of its states, for `state_rates`, and its output, for `outputs` or `loads`.
    """
    (x,) = _states(x, (1,), "low_pass")
    positive(time_constant, "low_pass: the time constant")
    return ((signal - x) / time_constant,), x


def low_pass_second_order(
    signal: Component, x: Sequence[Component], frequency: Component, damping: Component = 0.5**0.5
) -> tuple[tuple[Component, Component], Component]:
    """A filter of the second order; with the damping ratio 1/sqrt(2) that of Butterworth.

        x1_dot = x2,   x2_dot = w^2 (signal - x1) - 2 damping w x2,   w = 2 pi frequency,   output x1

    **Arguments:** `x`: its two states; `frequency` [Hz], where it takes away half of the power. **Returns:** as
    `low_pass`.
    """
    x1, x2 = _states(x, (2,), "low_pass_second_order")
    w = 2.0 * jnp.pi * positive(frequency, "low_pass_second_order: the frequency")
    return (x2, w * w * (signal - x1) - 2.0 * damping * w * x2), x1


def delayed(signal: Component, x: Any, delay: Component) -> tuple[tuple[Component, ...], Component]:
    """A dead time by Pade's approximation with one state or two: right for signals much slower than the delay.

        exp(-d s) = (1 - d s / 2) / (1 + d s / 2)                                   one state
        exp(-d s) = (1 - d s / 2 + d^2 s^2 / 12) / (1 + d s / 2 + d^2 s^2 / 12)     two

    The error of the phase is (w d)^3 / 12 or (w d)^5 / 720 at the frequency w [rad/s]. A step comes with a wrong jump
    at first, since the signal passes through.

    **Arguments:** `x`: its state or states; `delay` [s], positive. **Returns:** as `low_pass`.
    """
    x = _states(x, (1, 2), "delayed")
    positive(delay, "delayed: the delay")
    if len(x) == 1:
        return (2.0 / delay * (signal - x[0]),), 2.0 * x[0] - signal
    rate = 12.0 / delay**2 * (signal - x[0] - 0.5 * delay * x[1])
    return (x[1], rate), signal - delay * x[1]


def _states(x: Any, sizes: tuple[int, ...], name: str) -> tuple[Component, ...]:
    states = tuple(x) if not hasattr(x, "shape") and hasattr(x, "__iter__") else (x,)
    if len(states) not in sizes:
        raise ValueError(f"sensors.{name} has {' or '.join(map(str, sizes))} states, got {len(states)}.")
    return states


def _along(vector: Vector, frame: Frame) -> Named:
    return dict(zip("xyz", vector.components_in(_checked(frame)), strict=True))


def _checked(frame: Frame) -> Frame:
    if not isinstance(frame, Frame):
        raise TypeError(f"A sensor measures along the axes of a Frame, got {frame!r}.")
    return frame
