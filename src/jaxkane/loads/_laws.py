"""Laws of friction, drag, stops and backlash, as functions of numbers.

All laws use the same smoothing: |x| is replaced by sqrt(x^2 + width^2), and the sign of x by x / |x|. Both are
analytic, so all derivatives are finite. The errors are width^2 / (2 |x|) and width^2 / (2 x^2). At x = 0, the error of
|x| is `width`. Andersson, Soderberg and Bjorklund (2007), *Friction models for sliding dry, boundary and mixed
lubricated contacts*, compare such smoothings. Smoothed friction does not stick. Below the static friction a mass creeps
with a speed of the order of `width`. For sticking, use `lugre`, which has a state.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp

from .._common.lookup import refuse_if
from .._scalarjit.components import Component, positive
from .._system.kinematics import Vector


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
