"""Loads between points and between frames: springs, dampers, actuators, friction, drag, rotors and motors."""

from __future__ import annotations

from collections.abc import Callable

from .._scalarjit.components import Component, component, is_zero, mul, positive
from .._system.kinematics import Frame, Point, Vector, check_vector
from .._system.motion import Body, Force, Torque, point_of
from ._laws import coulomb, smooth_abs

Law = Component | Callable[[Component], Component]


def spring(P: Point | Body, Q: Point | Body, stiffness: Law, length: Component = 0.0) -> tuple[Force, Force]:
    """A spring between two points, which pulls them together when it is longer than at rest.

        tension = stiffness * (|r| - length),   r from P to Q

    **Arguments:** `stiffness` [N/m], or a function extension [m] -> tension [N]; `length` at rest [m]. A linear spring
    of zero length may shrink to a point, any other may not: its direction is lost there.
    """
    P, Q, length = point_of(P), point_of(Q), component(length)
    r = Q.position_from(P)
    if is_zero(length) and not callable(stiffness):
        return _pair(stiffness * r, P, Q)
    return _pair(_law(stiffness, r.norm() - length) * r.normalize(), P, Q)


def damper(P: Point | Body, Q: Point | Body, damping: Law) -> tuple[Force, Force]:
    """A damper between two points, along the line that joins them.

        tension = damping * d|r|/dt

    **Arguments:** `damping` [N s/m], or a function rate [m/s] -> tension [N].
    """
    P, Q = point_of(P), point_of(Q)
    direction = Q.position_from(P).normalize()
    rate = (Q.velocity - P.velocity).dot(direction)
    return _pair(_law(damping, rate) * direction, P, Q)


def actuator(P: Point | Body, Q: Point | Body, force: Component) -> tuple[Force, Force]:
    """A strut that pushes two points apart with `force` [N], and pulls where it is negative."""
    P, Q = point_of(P), point_of(Q)
    return _pair(-component(force) * Q.position_from(P).normalize(), P, Q)


def torsional_spring(
    on: Frame | Body, reaction_on: Frame | Body | None, axis: Vector, angle: Component, stiffness: Law
) -> tuple[Torque]:
    """A spring in a hinge, which turns `on` back about `axis`.

        T = -stiffness * angle * axis

    **Arguments:** `axis`: a Vector along the hinge, of any length; `angle` of `on` about it from rest, relative to
    `reaction_on` (None: the ground) [rad]; `stiffness` [N m/rad], or a function angle -> torque [N m].
    """
    return (Torque(-_law(stiffness, angle) * _direction(axis), on, reaction_on),)


def torsional_damper(on: Frame | Body, reaction_on: Frame | Body | None, axis: Vector, damping: Law) -> tuple[Torque]:
    """A damper in a hinge along `axis`.

        T = -damping * (relative angular velocity . axis) * axis

    **Arguments:** as `torsional_spring`; `damping` [N m s/rad], or a function rate [rad/s] -> torque [N m].
    """
    axis = _direction(axis)
    return (Torque(-_law(damping, _rate(on, reaction_on).dot(axis)) * axis, on, reaction_on),)


def friction(
    P: Point | Body,
    Q: Point | Body | None,
    normal_force: Component,
    coefficient: Law,
    normal: Vector | None = None,
    *,
    speed: Component = 1e-2,
) -> tuple[Force, ...]:
    """Coulomb friction at P, smoothed where the sliding changes its direction.

        F = -coefficient * normal_force * v / |v|,   |v| = sqrt(v . v + speed^2),   v the velocity of P relative to Q

    **Arguments:**

    - `Q`: the point of the other body, None for the ground.
    - `normal_force` [N], not negative.
    - `coefficient`, or a function |v| [m/s] -> coefficient, as a Stribeck curve:
        `lambda v: 0.3 + 0.2 * jnp.exp(-((v / 0.05) ** 2))`.
    - `normal`: a Vector across the surface, of any length, of which v is cleared.
    - `speed` [m/s]: well above it friction is Coulomb's, from which it differs by speed^2 / (2 v^2) of itself; below it
        is viscous, so that nothing sticks: it creeps. The equations become stiff as it falls.
    """
    P = point_of(P)
    v = P.velocity if Q is None else P.velocity - point_of(Q).velocity
    if normal is not None:
        normal = normal.normalize()
        v = v - v.dot(normal) * normal
    sliding = smooth_abs(v, speed)
    mu = coefficient(sliding) if callable(coefficient) else coefficient
    F = -(mu * normal_force) * (v / sliding)
    return (Force(F, P),) if Q is None else (Force(F, P), Force(-F, point_of(Q)))


def torsional_friction(
    on: Frame | Body, reaction_on: Frame | Body | None, axis: Vector, torque: Component, *, rate: Component = 1e-2
) -> tuple[Torque]:
    """Dry friction in a hinge along `axis`, smoothed: T = -torque * w / sqrt(w^2 + rate^2) [N m], w [rad/s].

    Other laws of friction go into `torsional_damper`: `lambda w: jk.loads.stribeck(w, 0.3, 0.5, 0.1)`.
    """
    return torsional_damper(on, reaction_on, axis, lambda w: coulomb(w, torque, width=rate))


def drag(
    P: Point | Body,
    coefficient: Component,
    linear: Component = 0.0,
    *,
    wind: Vector | None = None,
    speed: Component = 1e-6,
) -> tuple[Force]:
    """The drag of a fluid at P: turbulent, and laminar.

        F = -(linear + coefficient |v|) v,   v the velocity of P relative to the fluid

    Turbulent drag is half of density * drag coefficient * frontal area [N s^2/m^2] (White, *Fluid Mechanics*, chapter
    7), which holds above a Reynolds number of about a thousand; `linear` [N s/m] is Stokes's, of slow motion.

    **Arguments:** `wind`: the fluid's velocity [m/s], a Vector, None for still air; `speed` [m/s]: |v| stands for
    sqrt(v . v + speed^2), whose derivative is finite at rest too: there it is linear + coefficient * speed.
    """
    P = point_of(P)
    v = P.velocity if wind is None else P.velocity - wind
    return (Force(-(linear + component(coefficient) * smooth_abs(v, speed)) * v, P),)


def _direction(axis: Vector) -> Vector:
    check_vector(axis, "The axis of a hinge")
    return axis.normalize()


def _law(law: Law, x: Component) -> Component:
    return law(x) if callable(law) else component(law) * x


def _pair(pull: Vector, P: Point, Q: Point) -> tuple[Force, Force]:
    """`pull` acts on P towards Q, and its reaction on Q."""
    return Force(pull, P), Force(-pull, Q)


def _rate(on: Frame | Body, reaction_on: Frame | Body | None) -> Vector:
    for part in (on, reaction_on):
        if not isinstance(part, (Frame, Body, type(None))) or on is None:
            raise TypeError(f"What turns in a hinge is a Frame or a Body, got {part!r}.")
    return on.angular_velocity if reaction_on is None else on.angular_velocity - reaction_on.angular_velocity


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
