"""Laws of friction, drag, stops and backlash, as functions of numbers. Knows numbers; knows no frame and no load.

One smoothing is in all of them: |x| stands for sqrt(x^2 + width^2), and the sign of x for x / |x|. Both are analytic,
so that every derivative is finite. Against the sharp law they are off by width^2 / (2 |x|) and by width^2 / (2 x^2),
of the second order in `width`; at x = 0, where the sharp law has a corner or a jump, |x| by `width`. Andersson,
Soderberg and Bjorklund (2007), *Friction models for sliding dry, boundary and mixed lubricated contacts*, compare such
smoothings. What is smoothed so does not stick: under a load less than the static one it creeps, with a speed of the
order of `width`. What sticks is `lugre`, which has a state.
"""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp

from .._scalarjit.components import Component, positive
from .._system.kinematics import Vector


def smooth_abs(x: Component | Vector, width: Component) -> Component:
    """sqrt(x^2 + width^2), of a number or a Vector's length: |x| without its corner, too large by `width` at most."""
    positive(width, "The width of the smoothing")  # or there is no slope at rest
    square = x.dot(x) if isinstance(x, Vector) else x * x
    return jnp.sqrt(square + width * width)


def smooth_sign(x: Component, width: Component) -> Component:
    """x / sqrt(x^2 + width^2): the sign of x without its jump."""
    return x / smooth_abs(x, width)


def coulomb(v: Component, level: Component, *, width: Component = 1e-2) -> Component:
    """Dry friction: level * v / |v|.

    **Arguments:** `v`: the rate [m/s, rad/s]; `level` [N, N m], not negative; `width`: of the smoothing, in the unit of
    v. Well below it the law is viscous, level / width * v, and the equations become stiff as it falls.
    """
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
    """Dry friction that falls with the rate, from static to kinetic: the Stribeck curve.

        (kinetic + (static - kinetic) * exp(-(|v| / falloff)^exponent)) * v / |v|

    Stribeck (1902), *Die wesentlichen Eigenschaften der Gleit- und Rollenlager*; with this exponential Bo and Pavelescu
    (1982), *The friction-speed relation and its influence on the critical velocity of stick-slip motion*, who find
    exponents of 1/2 to 1, and Armstrong-Helouvry, Dupont and Canudas de Wit (1994), *A survey of models, analysis
    tools and compensation methods for the control of machines with friction*, who take 2. A viscous term is added by
    the user: `stribeck(...) + damping * v`.

    **Arguments:** `v`: the rate [m/s, rad/s]; `kinetic`, `static` [N, N m], not negative; `falloff`: the rate at which
    it falls, the unit of v; `exponent`; `width` of the smoothing, a tenth of `falloff` at most, since the peak is lost
    otherwise.
    """
    positive(falloff, "stribeck: the rate `falloff`")
    rate = smooth_abs(v, width)
    return (kinetic + (static - kinetic) * jnp.exp(-((rate / falloff) ** exponent))) * v / rate


def quadratic(v: Component, coefficient: Component) -> Component:
    """Turbulent drag of one rate: coefficient * v |v|. It is not smoothed: its first derivative is 2 coefficient |v|,
    zero at rest, and its second jumps there. `coefficient` [N s^2/m^2, N m s^2]."""
    return coefficient * v * jnp.abs(v)


def dead_zone(x: Component, lower: Component | None, upper: Component | None, *, width: Component = 1e-4) -> Component:
    """How far x is beyond the ends of an interval: zero within, x - upper above it, x - lower below.

        x - (lower + upper) / 2 - (|x - lower| - |x - upper|) / 2

    Times a stiffness it is a joint's stops, or the torque of a gear with play, whose two sides touch again after the
    gap: `k * dead_zone(motor / ratio - link, -0.5 * gap, 0.5 * gap)`. Between -width / 2 and width / 2 from each end
    both sides of it act a little; it is monotone, and off by at most width / 2 at an end and by the order of width^2
    elsewhere. A stop that takes energy has a damper that grows with the depth, as Hunt and Crossley (1975) say:
    `k * depth * (1.0 + c * rate)`.

    **Arguments:** `x` [m, rad]; `lower`, `upper` of which either may be None, where there is no end; `width` of the
    smoothing, in the unit of x.
    """
    if lower is None and upper is None:
        raise ValueError("dead_zone(x, lower, upper): give one end at least.")
    ends = [float(x) for x in (lower, upper) if isinstance(x, (int, float))]
    if not all(map(math.isfinite, ends)) or (len(ends) == 2 and ends[0] > ends[1]):
        raise ValueError(
            f"dead_zone(x, lower, upper): got {lower} and {upper}. The first end is below the second; None is no end."
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
    """Friction by bristles that bend, with a state: it sticks, creeps before it slides, and lags behind the rate.

        level = kinetic + (static - kinetic) * exp(-(v / falloff)^2)
        z_dot = v - stiffness * |v| / level * z
        force = stiffness * z + damping * z_dot + viscous * v

    Canudas de Wit, Olsson, Astrom and Lischinsky (1995), *A new model for control of systems with friction*. At a
    steady rate the force is level * sign(v) + viscous * v, the Stribeck curve; |z| stays below static / stiffness. It
    gives back no more than it has taken where damping * |v| <= 4 * level (Barabanov and Ortega, 2000, *Necessary and
    sufficient conditions for passivity of the LuGre friction model*).

    **Arguments:** `v`: the rate [m/s, rad/s]; `z`: how far the bristles are bent [m, rad]; `stiffness` [N/m, N m/rad],
    `damping` and `viscous` [N s/m, N m s/rad]; `kinetic`, `static` [N, N m], positive; `falloff`, the unit of v.

    **Returns:** the force, which resists v, and z_dot: the one for `loads`, the other for the state's rate.
    """
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
    """Hysteresis of a spring that yields, with a state: a rope, rubber, a wire, a bolted joint.

        z_dot = v (1 - (share sign(v z) + 1 - share) |z / z_y|^exponent),   z_y = yield_force / stiffness
        force = stiffness * z

    Bouc (1967) and Wen (1976), *Method for random vibration of hysteretic systems*, where it has beta = share / z_y^n
    and gamma = (1 - share) / z_y^n. Begun at |z| <= z_y it stays there, and never gives back more than it has taken,
    where `share` is 1/2 to 1. An elastic part beside it is a spring of its own.

    **Arguments:** `v`: the rate [m/s, rad/s]; `z`: the elastic extension [m, rad]; `stiffness` [N/m, N m/rad] before it
    yields; `yield_force` [N, N m], positive; `exponent`: how sharply it yields, 1 at least; `width` of |z / z_y|, of no
    unit.

    **Returns:** the force, which resists v, and z_dot.
    """
    bent = z * stiffness / yield_force
    along = share * jnp.sign(v * z) + 1.0 - share
    return stiffness * z, v * (1.0 - along * smooth_abs(bent, width) ** exponent)
