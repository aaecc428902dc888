"""Loads between points and between frames: springs, dampers, actuators, friction, drag, rotors and motors."""

from __future__ import annotations

from collections.abc import Callable

from .._common.lookup import checked
from .._scalarjit.components import Component, component, is_zero, mul, positive
from .._system.kinematics import Frame, Point, Vector, check_vector
from .._system.motion import Body, Force, Torque, point_of
from ._laws import check_numbers, coulomb, smooth_abs

Law = Component | Callable[[Component], Component]


def spring(P: Point | Body, Q: Point | Body, stiffness: Law, length: Component = 0.0) -> tuple[Force, Force]:
    """A spring between two points.

        tension = stiffness * (|r| - length),   r from P to Q

    **Arguments:**

    - `P`, `Q`: points or bodies (their mass centres).
    - `stiffness`: [N/m], or a function extension [m] -> tension [N].
    - `length`: length at rest [m].

    If the points coincide, the direction of the force is undefined and the force is NaN, except for a linear spring
    with the length zero.
    """
    P, Q, length = point_of(P), point_of(Q), component(length)
    r = Q.position_from(P)
    if is_zero(length) and not callable(stiffness):
        return _pair("spring", stiffness * r, P, Q)
    return _pair("spring", _law(stiffness, r.norm() - length) * r.normalize(), P, Q)


def damper(P: Point | Body, Q: Point | Body, damping: Law) -> tuple[Force, Force]:
    """A damper between two points, along the line between them.

        tension = damping * d|r|/dt

    **Arguments:**

    - `P`, `Q`: points or bodies (their mass centres).
    - `damping`: [N s/m], or a function rate [m/s] -> tension [N].
    """
    P, Q = point_of(P), point_of(Q)
    direction = Q.position_from(P).normalize()
    rate = (Q.velocity - P.velocity).dot(direction)
    return _pair("damper", _law(damping, rate) * direction, P, Q)


def actuator(P: Point | Body, Q: Point | Body, force: Component) -> tuple[Force, Force]:
    """An actuator between two points.

    **Arguments:**

    - `P`, `Q`: points or bodies (their mass centres).
    - `force`: [N], positive if it pushes the points apart.
    """
    P, Q = point_of(P), point_of(Q)
    return _pair("actuator", -component(force) * Q.position_from(P).normalize(), P, Q)


def torsional_spring(
    on: Frame | Body, reaction_on: Frame | Body | None, axis: Vector, angle: Component, stiffness: Law
) -> tuple[Torque]:
    """A torsional spring in a hinge.

        T = -stiffness * angle * axis

    **Arguments:**

    - `on`: the frame or body on which the torque acts.
    - `reaction_on`: the frame or body on which the reaction acts. None is the ground.
    - `axis`: a Vector along the hinge, of any length.
    - `angle`: angle of `on` relative to `reaction_on` about the axis, from rest [rad].
    - `stiffness`: [N m/rad], or a function angle [rad] -> torque [N m].
    """
    axis = check_vector(axis, "The axis of a hinge").normalize()
    return (Torque(-_law(stiffness, angle) * axis, on, reaction_on),)


def torsional_damper(on: Frame | Body, reaction_on: Frame | Body | None, axis: Vector, damping: Law) -> tuple[Torque]:
    """A torsional damper in a hinge.

        T = -damping * (relative angular velocity . axis) * axis

    **Arguments:**

    - `on`, `reaction_on`, `axis`: as `torsional_spring`.
    - `damping`: [N m s/rad], or a function rate [rad/s] -> torque [N m].
    """
    axis = check_vector(axis, "The axis of a hinge").normalize()
    for part, kind in ((on, Frame | Body), (reaction_on, Frame | Body | None)):
        checked(part, kind, "A hinge connects Frames or Bodies")
    rate = on.angular_velocity if reaction_on is None else on.angular_velocity - reaction_on.angular_velocity
    return (Torque(-_law(damping, rate.dot(axis)) * axis, on, reaction_on),)


def friction(
    P: Point | Body,
    Q: Point | Body | None,
    normal_force: Component,
    coefficient: Law,
    normal: Vector | None = None,
    *,
    speed: Component = 1e-2,
) -> tuple[Force, ...]:
    """Coulomb friction at P, smoothed at low sliding speeds.

        F = -coefficient * normal_force * v / |v|,   |v| = sqrt(v . v + speed^2),   v the velocity of P relative to Q

    **Arguments:**

    - `P`: the sliding point or body.
    - `Q`: the point of the other body. None is the ground.
    - `normal_force`: [N], not negative.
    - `coefficient`: the coefficient of friction, or a function |v| [m/s] -> coefficient, such as the Stribeck curve
        `lambda v: 0.3 + 0.2 * jnp.exp(-((v / 0.05) ** 2))`.
    - `normal`: a Vector normal to the surface, of any length. The normal component of v is ignored.
    - `speed`: the width of the smoothing [m/s]. Above it, the relative error of Coulomb's law is speed^2 / (2 v^2).
        Below it, friction is viscous, so the point creeps instead of sticking. A smaller value makes the equations
        stiffer.
    """
    P = point_of(P)
    v = P.velocity if Q is None else P.velocity - point_of(Q).velocity
    if normal is not None:
        normal = normal.normalize()
        v = v - v.dot(normal) * normal
    sliding = smooth_abs(v, speed)
    mu = coefficient(sliding) if callable(coefficient) else coefficient
    check_numbers("friction", normal_force=normal_force, coefficient=mu)
    F = -(mu * normal_force) * (v / sliding)
    return (Force(F, P),) if Q is None else (Force(F, P), Force(-F, point_of(Q)))


def torsional_friction(
    on: Frame | Body, reaction_on: Frame | Body | None, axis: Vector, torque: Component, *, rate: Component = 1e-2
) -> tuple[Torque]:
    """Smoothed dry friction in a hinge: T = -torque * w / sqrt(w^2 + rate^2) [N m], with the relative rate w [rad/s].

    For other laws of friction, use `torsional_damper` with a function: `lambda w: jk.loads.stribeck(w, 0.3, 0.5, 0.1)`.

    **Arguments:**

    - `on`, `reaction_on`, `axis`: as `torsional_spring`.
    - `torque`: the friction torque [N m], not negative.
    - `rate`: the width of the smoothing [rad/s].
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
    """Turbulent and laminar drag of a fluid at P.

        F = -(linear + coefficient |v|) v,   v the velocity of P relative to the fluid

    White, *Fluid Mechanics*, chapter 7. The turbulent law holds for Reynolds numbers above about a thousand.

    **Arguments:**

    - `P`: a point or body.
    - `coefficient`: half of density * drag coefficient * frontal area [N s^2/m^2].
    - `linear`: laminar (Stokes) drag [N s/m].
    - `wind`: velocity of the fluid [m/s], a Vector. None is still air.
    - `speed`: smoothing [m/s]. |v| is replaced by sqrt(v . v + speed^2), so that derivatives are finite at rest.
    """
    check_numbers("drag", coefficient=coefficient, linear=linear)
    P = point_of(P)
    v = P.velocity if wind is None else P.velocity - wind
    return (Force(-(linear + component(coefficient) * smooth_abs(v, speed)) * v, P),)


def _law(law: Law, x: Component) -> Component:
    return law(x) if callable(law) else component(law) * x


class ElementForce(Force):
    """The force of a spring, damper or actuator on one of its ends. Animations draw a line to the `other` end."""

    __slots__ = ("kind", "other")

    def __init__(self, kind: str, vector: Vector, point: Point, other: Point):
        super().__init__(vector, point)
        self.kind, self.other = kind, other


def _pair(kind: str, pull: Vector, P: Point, Q: Point) -> tuple[Force, Force]:
    """`pull` acts on P towards Q, and its reaction on Q."""
    return ElementForce(kind, pull, P, Q), Force(-pull, Q)


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
    """A body that spins in a carrier, such as the rotor of a motor or a flywheel, for the bodies of a `Motion`.

        omega = omega of the carrier + rate * a,   H = inertia * (omega . a) a,   a along the axis

    A geared rotor spins with the gear ratio times the rate of the joint. It adds ratio^2 * inertia at the joint, and
    its gyroscopic moment and its reaction torque act on the carrier. (The `armature` of `jk.joints` adds the inertia
    only.) The mass of the rotor and its moments of inertia normal to the axis belong to the carrier.

    **Arguments:**

    - `inertia`: moment of inertia about the axis [kg m^2].
    - `axis`: a Vector of any length that is fixed in the carrier.
    - `rate`: angular rate about the axis, relative to the carrier [rad/s].
    - `carrier`: the frame or body in which the rotor spins.
    - `at`: its position, a Point or a Body.
    - `mass`: [kg], if the mass of the carrier does not include it.

    **Raises:** `TypeError` for arguments of a wrong type. `ValueError` for a particle as carrier.
    """
    checked(axis, Vector, "rotor(inertia, axis, ...): the axis is a Vector such as A.x")
    checked(carrier, (Frame, Body), "rotor(inertia, axis, rate, carrier, ...): the carrier is a Frame or a Body")
    if isinstance(carrier, Body) and carrier.is_particle:
        raise ValueError(
            f"rotor: {carrier.name!r} is a particle, which has no frame. Pass the frame that carries {name!r}."
        )
    frame = carrier.frame if isinstance(carrier, Body) else carrier
    axis = axis.normalize()
    a = axis.components_in(frame)
    moments = tuple(tuple(mul(inertia, mul(x, y)) for y in a) for x in a)
    return Body(
        mass, moments, at.center if isinstance(at, Body) else at, frame, frame.angular_velocity + rate * axis, name=name
    )


def dc_motor(voltage: Component, rate: Component, constant: Component, resistance: Component) -> Component:
    """The torque [N m] of a direct current motor without inductance.

        constant * (voltage - constant * rate) / resistance

    Spong, Hutchinson and Vidyasagar (2006), *Robot Modeling and Control*, chapter 6. With a gear, multiply the rate of
    the joint by the gear ratio, and the torque at the joint by the gear ratio.

    **Arguments:**

    - `voltage`: [V].
    - `rate`: rate of the rotor [rad/s].
    - `constant`: torque constant [N m/A], equal to the back-EMF constant [V s/rad].
    - `resistance`: [ohm].
    """
    check_numbers("dc_motor", voltage=voltage, rate=rate, constant=constant, resistance=resistance)
    positive(resistance, "dc_motor: the resistance")
    return constant * (voltage - constant * rate) / resistance
