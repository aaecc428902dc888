"""Loads: springs, dampers, actuators, friction, compliant contacts, drag, stops, backlash and motors.

Loads between points or frames return a tuple of `Force`s or `Torque`s, including the reaction on the second point or
frame, for `System.loads`:

    def loads(self, t, q, u, motion, inputs):
        P, Q = motion["P"], motion["Q"]
        return jk.loads.spring(P, Q, self.stiffness, self.length), jk.weight(motion, -9.81 * motion.N.y)

A follower force is `jk.Force(10.0 * B.x, P)`, which rotates with the frame B. For a nonlinear law, pass a function of
the extension, the rate or the angle instead of the coefficient: `lambda x: k * x + k3 * x**3`.

`coulomb`, `stribeck`, `quadratic` and `dead_zone` are such functions. `lugre` and `bouc_wen` also have a first-order
state. They return the resistance, which has the sign of the rate; the load has the opposite sign. Laws can be added and
used with any speed:

    friction = lambda w: jk.loads.stribeck(w, 0.3, 0.5, 0.1) + 0.02 * w
    jk.loads.torsional_damper(arm, None, N.z, friction)

All laws use the same smoothing: |x| is replaced by sqrt(x^2 + width^2), and the sign of x by x / |x|. Both are
analytic, so all derivatives are finite. The errors are width^2 / (2 |x|) and width^2 / (2 x^2). At x = 0, the error of
|x| is `width`. Andersson, Soderberg and Bjorklund (2007), *Friction models for sliding dry, boundary and mixed
lubricated contacts*, compare such smoothings. Smoothed friction does not stick. Below the static friction a mass creeps
with a speed of the order of `width`. For sticking, use `lugre`, which has a state.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from ._common.lookup import checked, refuse_if
from ._scalarjit.components import Component, component, is_zero, mul, positive
from ._system.kinematics import Frame, Point, Vector, check_vector
from ._system.motion import Body, Force, Torque, point_of

__all__ = [
    "actuator", "bouc_wen", "coulomb", "damper", "dc_motor", "dead_zone", "drag", "friction", "hunt_crossley", "lugre",
    "plane_contact", "quadratic", "rotor", "smooth_abs", "smooth_sign", "sphere_contact", "spring", "stribeck",
    "torsional_damper", "torsional_friction", "torsional_spring",
]  # fmt: skip


def check_numbers(law: str, **values: Any) -> None:
    """Raise `TypeError` if an argument is not a number, an array or a Vector."""
    for name, value in values.items():
        dtype = getattr(value, "dtype", None)
        is_number = isinstance(value, (int, float, Vector)) and not isinstance(value, bool)
        is_array = (
            hasattr(value, "__jax_array__") or getattr(dtype, "kind", "V") in "iuf" or isinstance(value, jax.Array)
        )
        if not (is_number or is_array):
            hint = f" By name it is q[{value!r}], u[{value!r}] or inputs[{value!r}]." if isinstance(value, str) else ""
            raise TypeError(f"{law}: `{name}` must be one number, got {value!r}.{hint}")


def smooth_abs(x: Component | Vector, width: Component) -> Component:
    """sqrt(x^2 + width^2), a smooth |x|, of a number or the length of a Vector. It exceeds |x| by at most `width`."""
    positive(width, "The width of the smoothing")  # otherwise the derivative at rest is infinite
    square = x.dot(x) if isinstance(x, Vector) else x * x
    return jnp.sqrt(square + width * width)


def smooth_sign(x: Component, width: Component) -> Component:
    """x / sqrt(x^2 + width^2), a smooth sign of x."""
    return x / smooth_abs(x, width)


def coulomb(v: Component, level: Component, *, width: Component = 1e-2) -> Component:
    """Dry friction: level * v / |v|.

    **Arguments:**

    - `v`: the rate [m/s, rad/s].
    - `level`: friction force or torque [N, N m], not negative.
    - `width`: width of the smoothing, in the unit of v. Well below it, the law is viscous, level / width * v. A smaller
        value makes the equations stiffer.
    """
    check_numbers("coulomb", v=v, level=level, width=width)
    return level * smooth_sign(v, width)


def stribeck(
    v: Component,
    kinetic: Component,
    static: Component,
    falloff: Component,
    *,
    exponent: Component = 2.0,
    width: Component = 1e-2,
) -> Component:
    """Dry friction that decreases with the rate from static to kinetic friction: the Stribeck curve.

        (kinetic + (static - kinetic) * exp(-(|v| / falloff)^exponent)) * v / |v|

    Stribeck (1902), *Die wesentlichen Eigenschaften der Gleit- und Rollenlager*. Bo and Pavelescu (1982), *The
    friction-speed relation and its influence on the critical velocity of stick-slip motion*, use this exponential with
    exponents of 1/2 to 1. Armstrong-Helouvry, Dupont and Canudas de Wit (1994), *A survey of models, analysis tools and
    compensation methods for the control of machines with friction*, use the exponent 2. To add viscous friction, write
    `stribeck(...) + damping * v`.

    **Arguments:**

    - `v`: the rate [m/s, rad/s].
    - `kinetic`, `static`: kinetic and static friction [N, N m], not negative.
    - `falloff`: the rate at which the friction decreases, in the unit of v.
    - `exponent`: the exponent of the decrease.
    - `width`: width of the smoothing. Use at most a tenth of `falloff`, otherwise the peak is smoothed away.
    """
    check_numbers("stribeck", v=v, kinetic=kinetic, static=static, falloff=falloff, exponent=exponent, width=width)
    positive(falloff, "stribeck: the rate `falloff`")
    rate = smooth_abs(v, width)
    return (kinetic + (static - kinetic) * jnp.exp(-((rate / falloff) ** exponent))) * v / rate


def quadratic(v: Component, coefficient: Component) -> Component:
    """Turbulent drag: coefficient * v |v|.

    It is not smoothed. Its first derivative is continuous; its second derivative is discontinuous at rest.

    **Arguments:**

    - `v`: the rate [m/s, rad/s].
    - `coefficient`: [N s^2/m^2, N m s^2].
    """
    check_numbers("quadratic", v=v, coefficient=coefficient)
    return coefficient * v * jnp.abs(v)


def dead_zone(x: Component, lower: Component | None, upper: Component | None, *, width: Component = 1e-4) -> Component:
    """The distance of x from an interval: zero inside, x - upper above, x - lower below.

        x - (lower + upper) / 2 - (|x - lower| - |x - upper|) / 2

    Multiplied by a stiffness, it is the torque of stops or of a gear with backlash:
    `k * dead_zone(motor / ratio - link, -0.5 * gap, 0.5 * gap)`. The smoothed function is monotone. Its error is at
    most width / 2 at the ends, and of the order of width^2 elsewhere. For a stop that dissipates energy, add damping
    that grows with the depth (Hunt and Crossley, 1975): `k * depth * (1.0 + c * rate)`.

    **Arguments:**

    - `x`: the position [m, rad].
    - `lower`, `upper`: the ends of the interval. One of them may be None.
    - `width`: width of the smoothing, in the unit of x.
    """
    check_numbers(
        "dead_zone", x=x, width=width, **{k: e for k, e in (("lower", lower), ("upper", upper)) if e is not None}
    )
    refuse_if(lower is None and upper is None, "dead_zone(x, lower, upper): pass at least one of `lower` and `upper`.")
    ends = [float(x) for x in (lower, upper) if isinstance(x, (int, float))]
    if not all(map(math.isfinite, ends)) or (len(ends) == 2 and ends[0] > ends[1]):
        raise ValueError(
            f"dead_zone(x, lower, upper): got {lower} and {upper}. `lower` must be less than `upper`. Pass None for "
            "an end that does not exist."
        )
    if lower is None:
        return 0.5 * (x - upper + smooth_abs(x - upper, width))
    if upper is None:
        return 0.5 * (x - lower - smooth_abs(x - lower, width))
    return x - 0.5 * (lower + upper) - 0.5 * (smooth_abs(x - lower, width) - smooth_abs(x - upper, width))


def lugre(
    v: Component,
    z: Component,
    *,
    stiffness: Component,
    damping: Component,
    kinetic: Component,
    static: Component,
    falloff: Component,
    viscous: Component = 0.0,
) -> tuple[Any, Any]:
    """The LuGre friction model with the mean deflection z of bristles: sticking, presliding and frictional lag.

        level = kinetic + (static - kinetic) * exp(-(v / falloff)^2)
        z_dot = v - stiffness * |v| / level * z
        force = stiffness * z + damping * z_dot + viscous * v

    Canudas de Wit, Olsson, Astrom and Lischinsky (1995), *A new model for control of systems with friction*. At a
    steady rate the force is level * sign(v) + viscous * v, the Stribeck curve. |z| remains below static / stiffness.
    The model is passive if damping * |v| <= 4 * level (Barabanov and Ortega, 2000, *Necessary and sufficient conditions
    for passivity of the LuGre friction model*).

    **Arguments:**

    - `v`: the rate [m/s, rad/s].
    - `z`: the mean deflection of the bristles [m, rad], a first-order state.
    - `stiffness`: stiffness of the bristles [N/m, N m/rad].
    - `damping`, `viscous`: damping of the bristles and viscous friction [N s/m, N m s/rad].
    - `kinetic`, `static`: kinetic and static friction [N, N m], positive.
    - `falloff`: the rate at which the friction decreases, in the unit of v.

    **Returns:** the resisting force for `loads`, and z_dot for `state_rates`.
    """
    check_numbers("lugre", v=v, z=z, stiffness=stiffness, damping=damping, viscous=viscous)
    check_numbers("lugre", kinetic=kinetic, static=static, falloff=falloff)
    level = kinetic + (static - kinetic) * jnp.exp(-((v / falloff) ** 2))
    z_dot = v - stiffness * jnp.abs(v) / level * z
    return stiffness * z + damping * z_dot + viscous * v, z_dot


def bouc_wen(
    v: Component,
    z: Component,
    *,
    stiffness: Component,
    yield_force: Component,
    share: Component = 0.5,
    exponent: Component = 1.0,
    width: Component = 1e-9,
) -> tuple[Any, Any]:
    """The Bouc-Wen model of a spring with hysteresis, such as a rope, rubber or a bolted joint.

        z_dot = v (1 - (share sign(v z) + 1 - share) |z / z_y|^exponent),   z_y = yield_force / stiffness
        force = stiffness * z

    Bouc (1967) and Wen (1976), *Method for random vibration of hysteretic systems*, with beta = share / z_y^n and
    gamma = (1 - share) / z_y^n. If |z| <= z_y initially, this remains true. The model is passive if `share` is between
    1/2 and 1. Add an elastic spring separately.

    **Arguments:**

    - `v`: the rate [m/s, rad/s].
    - `z`: the elastic extension [m, rad], a first-order state.
    - `stiffness`: stiffness before yielding [N/m, N m/rad].
    - `yield_force`: [N, N m], positive.
    - `exponent`: sharpness of yielding, at least 1.
    - `share`: see the equation.
    - `width`: width of the smoothing of |z / z_y|, dimensionless.

    **Returns:** the resisting force for `loads`, and z_dot for `state_rates`.
    """
    check_numbers("bouc_wen", v=v, z=z, stiffness=stiffness, yield_force=yield_force, share=share, exponent=exponent)
    bent = z * stiffness / yield_force
    along = share * jnp.sign(v * z) + 1.0 - share
    return stiffness * z, v * (1.0 - along * smooth_abs(bent, width) ** exponent)


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
    if is_zero(length) and not callable(stiffness):  # |r| has no derivative where the points coincide
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


def hunt_crossley(
    depth: Component, rate: Component, stiffness: Component, dissipation: Component = 0.0, exponent: Component = 1.5
) -> Component:
    """The normal force of a compliant contact: stiffness * depth^exponent * (1 + 1.5 dissipation * rate).

    It is zero without contact, and never pulls. Hunt and Crossley (1975), *Coefficient of restitution interpreted as
    damping in vibroimpact*. For slow impacts, the coefficient of restitution is about
    1 - dissipation * (speed of approach).

    **Arguments:**

    - `depth`: how far the bodies overlap [m], negative without contact.
    - `rate`: d(depth)/dt [m/s].
    - `stiffness`: [N/m^exponent]. For two elastic spheres and the exponent 3/2 (Hertz), 4/3 E sqrt(R), with
        1/R = 1/R1 + 1/R2 and 1/E = (1 - nu1^2)/E1 + (1 - nu2^2)/E2.
    - `dissipation`: [s/m], not negative.
    - `exponent`: above 1, the slope of the force is zero at first contact. Then implicit solvers and direct collocation
        need no small steps at touch-down.
    """
    check_numbers("hunt_crossley", depth=depth, rate=rate, stiffness=stiffness, exponent=exponent)
    check_numbers("hunt_crossley", dissipation=dissipation)
    positive(exponent, "hunt_crossley: the exponent")
    touches = depth > 0
    size = jnp.where(touches, depth, 1.0)  # the derivative of a power of zero by its exponent is NaN
    force = stiffness * size**exponent * jnp.maximum(1.0 + 1.5 * dissipation * rate, 0.0)
    return jnp.where(touches, force, 0.0)


def plane_contact(
    P: Point | Body,
    normal: Vector,
    stiffness: Component,
    *,
    radius: Component = 0.0,
    surface: Point | None = None,
    on: Body | None = None,
    dissipation: Component = 0.0,
    exponent: Component = 1.5,
    friction: Law = 0.0,
    speed: Component = 1e-2,
) -> tuple[Force, ...]:
    """The compliant contact of a point or a sphere with a plane: `hunt_crossley` along the normal, smoothed `friction`.

        jk.loads.plane_contact(ball, N.y, 1e6, radius=0.1, dissipation=0.2, friction=0.5)

    Any number of such contacts is possible. For rigid contacts, which have impacts and stick, see `jaxkane.Contact`.

    **Arguments:**

    - `P`: a Point; or, with `radius`, a Body whose surface is a sphere around its mass centre.
    - `normal`: a Vector of any length that points out of the plane, towards P.
    - `stiffness`, `dissipation`, `exponent`: see `hunt_crossley`.
    - `radius`: of the sphere [m].
    - `surface`: a Point of the plane. None is the origin O of the ground.
    - `on`: the body to which the plane belongs. The reaction acts on it, below P. None is the ground, or a `surface`
        whose motion is prescribed.
    - `friction`: the coefficient of friction, or a function speed [m/s] -> coefficient. See `jaxkane.loads.friction`.
    - `speed`: the width of the smoothing of the friction [m/s].

    **Raises:** `TypeError` for a sphere that is not a Body. `ValueError` for `on` without `surface`.
    """
    refuse_if(on is not None and surface is None, "plane_contact: `on` needs `surface`, a Point of its plane.")
    normal = check_vector(normal, "plane_contact: the normal").normalize()
    mine = center = point_of(P)
    r, below = center.position if surface is None else center.position_from(surface), surface
    height, at = r.dot(normal), r
    if not is_zero(component(radius)):
        # Action and reaction at one point, on the plane. Otherwise angular momentum would change.
        at = r - height * normal
        mine = _material_point(P, center, -height * normal, "plane_contact: a sphere")
    if on is not None and surface is not None:
        below = _material_point(on, surface, at, "plane_contact: `on`")
    law = functools.partial(hunt_crossley, stiffness=stiffness, dissipation=dissipation, exponent=exponent)
    return _compliant(mine, below, normal, height - radius, law, friction, speed, has_reaction=on is not None)


def sphere_contact(
    P: Body,
    Q: Body,
    radii: tuple[Component, Component],
    stiffness: Component,
    *,
    dissipation: Component = 0.0,
    exponent: Component = 1.5,
    friction: Law = 0.0,
    speed: Component = 1e-2,
) -> tuple[Force, ...]:
    """The compliant contact of two spheres around the mass centres of two bodies, as `plane_contact`.

    **Arguments:**

    - `P`, `Q`: the bodies.
    - `radii`: of P and of Q [m].
    - `stiffness`, `dissipation`, `exponent`: see `hunt_crossley`.
    - `friction`, `speed`: as for `plane_contact`.

    The force is NaN where the centres coincide.

    **Raises:** `TypeError` if P or Q is not a Body.
    """
    r, total = point_of(P).position_from(point_of(Q)), radii[0] + radii[1]
    mine = _material_point(P, point_of(P), -(radii[0] / total) * r, "sphere_contact: `P`")
    theirs = _material_point(Q, point_of(Q), (radii[1] / total) * r, "sphere_contact: `Q`")
    law = functools.partial(hunt_crossley, stiffness=stiffness, dissipation=dissipation, exponent=exponent)
    return _compliant(mine, theirs, r.normalize(), r.norm() - total, law, friction, speed, has_reaction=True)


def _material_point(body: Any, base: Point, r: Vector, what: str) -> Point:
    """The point of a body that is at `r` from `base` now."""
    spin = checked(body, Body, f"{what} must be a Body").angular_velocity
    return Point(base.velocity + spin.cross(r), base, r, f"{base.name}'")


def _compliant(
    P: Point,
    Q: Point | None,
    normal: Vector,
    gap: Component,
    pressure: Callable[[Component, Component], Component],
    coefficient: Law,
    speed: Component,
    has_reaction: bool,
) -> tuple[Force, ...]:
    v = P.velocity if Q is None else P.velocity - Q.velocity
    push = pressure(-gap, -v.dot(normal))
    F = push * normal
    if callable(coefficient) or not is_zero(component(coefficient)):
        F = F + friction(P, Q, push, coefficient, normal, speed=speed)[0].vector
    return (Force(F, P), Force(-F, Q)) if has_reaction and Q is not None else (Force(F, P),)


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
