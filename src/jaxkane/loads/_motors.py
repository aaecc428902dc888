"""Motors and their rotors. Knows bodies and numbers; knows no mechanism."""

from __future__ import annotations

from .._description.bodies import Body
from .._description.frames import Frame
from .._description.points import Point
from .._description.vectors import Vector
from .._scalars.components import mul, positive
from .._scalars.types import Component


def rotor(
    inertia: Component,
    axis: Vector,
    rate: Component,
    carrier: Frame | Body,
    at: Point | Body,
    *,
    mass: Component = 0.0,
    name: str = "rotor",
) -> Body:
    """What spins in a carrier: a motor's rotor, a flywheel, a propeller; for the bodies of a `Motion`.

        omega = omega of the carrier + rate * a,   H = inertia * (omega . a) a,   a along the axis

    A geared rotor spins with rate = ratio * the joint's rate. Then the joint feels ratio^2 * inertia, the reflected
    inertia, and the carrier feels the rotor's gyroscopic moment and its reaction. (The `armature` of `jk.joints` adds
    the first alone.) Across its axis the rotor turns with its carrier: its mass and its moments there belong to
    the carrier, as when that is weighed with its motor; here they are zero.

    **Arguments:**

    - `inertia` about the axis [kg m^2].
    - `axis`: a Vector that is fixed in the carrier, of any length. `rate` [rad/s] about it, relative to the carrier.
    - `carrier`: the frame or the body that it spins in. `at`: where it is, a Point or a Body.
    - `mass` [kg], where the carrier is without it.

    **Raises:** `TypeError` for an axis that is no Vector, and a carrier that is no Frame or Body; `ValueError` for a
    particle, which has no frame that could turn.
    """
    if not isinstance(axis, Vector):
        raise TypeError(f"rotor(inertia, axis, ...): the axis is a Vector such as A.x, got {axis!r}.")
    if not isinstance(carrier, (Frame, Body)):
        raise TypeError(f"rotor(inertia, axis, rate, carrier, ...): the carrier is a Frame or a Body, got {carrier!r}.")
    if isinstance(carrier, Body) and carrier.is_particle:
        raise ValueError(
            f"rotor: {carrier.name!r} is a particle, which has no frame: give the one that carries {name!r}."
        )
    frame = carrier.frame if isinstance(carrier, Body) else carrier
    axis = axis.normalize()
    a = axis.components_in(frame)
    moments = tuple(tuple(mul(inertia, mul(x, y)) for y in a) for x in a)
    omega = frame.angular_velocity + rate * axis
    return Body(mass, moments, at.center if isinstance(at, Body) else at, frame, omega, name=name)


def dc_motor(voltage: Component, rate: Component, constant: Component, resistance: Component) -> Component:
    """The torque [N m] of a direct current motor whose current follows at once.

        constant * (voltage - constant * rate) / resistance

    Spong, Hutchinson and Vidyasagar (2006), *Robot Modeling and Control*, chapter 6. Behind a gear its rate is ratio
    times the joint's, and the joint feels ratio times its torque.

    **Arguments:** `voltage` [V]; `rate` of the rotor [rad/s]; `constant` [N m/A], which is that of its voltage too
    [V s/rad]; `resistance` [ohm].
    """
    positive(resistance, "dc_motor: the resistance")
    return constant * (voltage - constant * rate) / resistance
