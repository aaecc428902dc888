"""Sensors (gyroscopes, accelerometers, encoders, markers, cameras, load cells) and filters.

For `System.outputs`, and the filters for `System.state_rates`:

    def outputs(self, t, q, u, motion, now):
        box, P = motion.frames["box"], motion["P"].fixed(motion.frames["box"].vector(*self.place))
        return {"imu": jk.sensors.imu(now, P, box.rotate_fixed(self.mounting), -9.81 * motion.N.z)}

    ride["imu.ay"], Trial(t, {"imu.gz": rate}, sigma=0.01)

The position, mounting, gain, offset and lag of a sensor are parameters that a fit can estimate. The outputs do not
contain noise; the noise of a measurement is `sigma` of a trial. Outputs are not rounded unless a resolution is given.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from ._common.lookup import checked, refuse_if
from ._scalarjit.components import Component, positive
from ._system.kinematics import Frame, Point, Vector
from ._system.motion import Body, point_of
from ._system.system import Measurements
from .loads import check_numbers

__all__ = [
    "accelerometer", "camera", "delayed", "encoder", "gyroscope", "imu", "load_cell", "low_pass",
    "low_pass_second_order", "marker",
]  # fmt: skip

Named = dict[str, Component]


def gyroscope(frame: Frame) -> Named:
    """Angular velocity [rad/s] of a frame, with components "x", "y", "z" in this frame.

    **Arguments:**

    - `frame`: the frame of the instrument, such as `body_frame.rotate_fixed(self.mounting)`.
    """
    return _along(_a_frame(frame).angular_velocity, frame)


def accelerometer(now: Measurements, point: Point | Body, frame: Frame, gravity: Vector) -> Named:
    """Specific force [m/s^2] at a point, with components "x", "y", "z" in a frame.

        f = a - g

    It is g upwards at rest and zero in free fall.

    **Arguments:**

    - `now`: the argument of `outputs`.
    - `point`: the position of the instrument, a Point that is fixed in its body.
    - `frame`: the frame of the instrument.
    - `gravity`: gravitational acceleration [m/s^2], the Vector that is passed to `weight`.
    """
    return _along(now.acceleration(point_of(point)) - gravity, frame)


def imu(now: Measurements, point: Point | Body, frame: Frame, gravity: Vector) -> Named:
    """An accelerometer and a gyroscope: "ax", "ay", "az" [m/s^2] and "gx", "gy", "gz" [rad/s].

    **Arguments:** as `accelerometer`.
    """
    f, w = accelerometer(now, point, frame, gravity), gyroscope(frame)
    return {**{f"a{k}": x for k, x in f.items()}, **{f"g{k}": x for k, x in w.items()}}


def encoder(
    angle: Component, *, zero: Component = 0.0, ratio: Component = 1.0, resolution: Component | None = None
) -> Component:
    """The reading of an encoder for an angle or the distance travelled by a wheel.

        reading = ratio * (angle - zero),  rounded to multiples of `resolution`

    **Arguments:**

    - `angle`: [rad].
    - `zero`: the angle at which the reading is zero [rad].
    - `ratio`: gear ratio with its sign, or radius of a wheel [m/rad].
    - `resolution`: in the unit of the reading, positive. None is an ideal encoder. The derivative ignores the rounding.
        In a fit, omit it and use resolution / sqrt(12) as `sigma`.
    """
    check_numbers("encoder", angle=angle, zero=zero, ratio=ratio)
    reading = ratio * (angle - zero)
    if resolution is None:
        return reading
    steps = reading / positive(resolution, "encoder: the resolution")
    return reading + resolution * jax.lax.stop_gradient(jnp.round(steps) - steps)


def marker(point: Point | Body, origin: Point, frame: Frame) -> Named:
    """The position of a point relative to a tracking system: "x", "y", "z" [m].

    **Arguments:**

    - `point`: the marker.
    - `origin`: the origin of the tracking system.
    - `frame`: the frame of the tracking system.
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
    """The position of a point in the image of a pinhole camera: "u", "v", in the unit of the focal length (pixels).

        u = u0 + focal_length * x / z,   v = v0 + focal_length * y / z

    Points behind the camera are NaN.

    **Arguments:**

    - `point`: the observed point.
    - `center`: the projection centre of the camera.
    - `frame`: the frame of the camera: z along the optical axis away from the camera, x to the right and y downwards in
        the image.
    - `focal_length`: in pixels.
    - `image_center`: the principal point (u0, v0) in pixels.
    """
    check_numbers("camera", focal_length=focal_length)
    x, y, z = point_of(point).position_from(center).components_in(frame)
    is_seen = jnp.asarray(z) > 0
    depth = jnp.where(is_seen, z, jnp.ones_like(z))
    lost = jnp.where(is_seen, jnp.zeros_like(depth), jnp.full_like(depth, jnp.nan))
    u0, v0 = image_center
    return {"u": u0 + focal_length * x / depth + lost, "v": v0 + focal_length * y / depth + lost}


def load_cell(now: Measurements, name: str, frame: Frame) -> Named:
    """The constraint force [N] at a named point, or the constraint moment [N m] at a named frame: "x", "y", "z".

    Forces of `loads` are not included.

    **Arguments:**

    - `now`: the argument of `outputs`.
    - `name`: a name of `Motion(points=..., frames=...)`. `constraint_forces` explains on which part the force acts.
    - `frame`: the frame of the components.

    **Raises:** `KeyError` for an unknown name. `TypeError` for the name of an auxiliary speed, whose force is the
    number `now.force(name)`.
    """
    what = f"load_cell: {name!r} is an auxiliary speed. Its force is a number, not a Vector"
    return _along(checked(now.force(name), Vector, what, f" Use now.force({name!r})."), frame)


# -- filters: (rates of their states, output)


def low_pass(
    signal: Component, x: Component | Sequence[Component], time_constant: Component
) -> tuple[tuple[Component], Component]:
    """A first-order low-pass filter, for the lag of a sensor or an actuator.

        time_constant * x_dot = signal - x,   output x

    **Arguments:**

    - `signal`: the input of the filter.
    - `x`: the state of the filter, or a sequence that contains it.
    - `time_constant`: [s], positive.

    **Returns:** the rates of the states for `state_rates`, and the output for `outputs` or `loads`.
    """
    (x,) = _states(x, (1,), "low_pass")
    check_numbers("low_pass", signal=signal, x=x)
    positive(time_constant, "low_pass: the time constant")
    return ((signal - x) / time_constant,), x


def low_pass_second_order(
    signal: Component, x: Sequence[Component], frequency: Component, damping: Component = 0.5**0.5
) -> tuple[tuple[Component, Component], Component]:
    """A second-order low-pass filter. The damping ratio 1/sqrt(2) gives a Butterworth filter.

        x1_dot = x2,   x2_dot = w^2 (signal - x1) - 2 damping w x2,   w = 2 pi frequency,   output x1

    **Arguments:**

    - `signal`: the input of the filter.
    - `x`: the two states of the filter.
    - `frequency`: the cut-off frequency [Hz]; with the damping ratio 1/sqrt(2), half of the power passes.
    - `damping`: the damping ratio.

    **Returns:** as `low_pass`.
    """
    x1, x2 = _states(x, (2,), "low_pass_second_order")
    check_numbers("low_pass_second_order", signal=signal, x=x1, damping=damping)
    w = 2.0 * jnp.pi * positive(frequency, "low_pass_second_order: the frequency")
    return (x2, w * w * (signal - x1) - 2.0 * damping * w * x2), x1


def delayed(
    signal: Component, x: Component | Sequence[Component], delay: Component
) -> tuple[tuple[Component, ...], Component]:
    """A delay, by Pade's approximation with one or two states. It is accurate for signals much slower than the delay.

        exp(-d s) = (1 - d s / 2) / (1 + d s / 2)                                   one state
        exp(-d s) = (1 - d s / 2 + d^2 s^2 / 12) / (1 + d s / 2 + d^2 s^2 / 12)     two

    The error of the phase is (w d)^3 / 12 or (w d)^5 / 720 at the frequency w [rad/s]. The response to a step has a
    wrong initial jump, because the approximation has a direct feedthrough.

    **Arguments:**

    - `signal`: the input.
    - `x`: the state or the two states.
    - `delay`: [s], positive.

    **Returns:** as `low_pass`.
    """
    x = _states(x, (1, 2), "delayed")
    check_numbers("delayed", signal=signal, x=x[0])
    positive(delay, "delayed: the delay")
    if len(x) == 1:
        return (2.0 / delay * (signal - x[0]),), 2.0 * x[0] - signal
    rate = 12.0 / delay**2 * (signal - x[0] - 0.5 * delay * x[1])
    return (x[1], rate), signal - delay * x[1]


def _states(x: Component | Sequence[Component], sizes: tuple[int, ...], name: str) -> tuple[Component, ...]:
    states = tuple(x) if not hasattr(x, "shape") and hasattr(x, "__iter__") else (x,)
    refuse_if(
        len(states) not in sizes,
        f"sensors.{name}: the number of states must be {' or '.join(map(str, sizes))}, got {len(states)}.",
    )
    return states


def _along(vector: Vector, frame: Frame) -> Named:
    return dict(zip("xyz", vector.components_in(_a_frame(frame)), strict=True))


def _a_frame(frame: Frame) -> Frame:
    return checked(frame, Frame, "The frame of a sensor must be a Frame")
