"""Bicycles and motorcycles of the literature with more than Whipple's four bodies."""

from __future__ import annotations

import math

from ._bicycle import Bicycle
from ._files import as_meijaard
from ._rider import without
from ._tyre import LateralSlip, Tyre

# BicycleParameters 1.5.2, `parameter_dicts.mooreriderlean2012_browser_jason`, with the names of Moore (2012), *Human
# control of a bicycle*: the measured Batavus Browser, with the legs of a rider in its rear frame C. The upper body G is
# from a geometric model of the person. Its k9 and c9 are zero.
_BROWSER_JASON = {
    "d1": 0.9631492634872098, "d2": 0.4338396131640938, "d3": 0.0705000000001252, "d4": -0.6704626684911591,
    "g": 9.81, "rf": 0.34352982332, "rr": 0.340958858855,
    "ic11": 2.296859222953584, "ic22": 2.9922715238, "ic31": 0.01594448114273473, "ic33": 1.5101858377464155,
    "id11": 0.0904106601579, "id22": 0.152467620286,
    "ie11": 0.2811355367159554, "ie22": 0.246138810935, "ie31": 0.0063377219110826045, "ie33": 0.06782113764394461,
    "if11": 0.0883819364527, "if22": 0.149389340425,
    "ig11": 2.038073562525466, "ig22": 1.692108544034995, "ig31": 0.002113501449812, "ig33": 1.100753962972129,
    "l1": 0.47759794513190806, "l2": -0.1680324796714025, "l3": -0.07654646159268344, "l4": -0.47166687226492093,
    "l5": 0.231223496809401, "l6": -0.271613547251923,
    "mc": 33.044, "md": 3.11, "me": 3.22, "mf": 2.02, "mg": 48.816,
}  # fmt: skip


def browser_jason(stiffness: float = 0.0, damping: float = 0.0) -> Bicycle:
    """The measured city bicycle Batavus Browser with the rider Jason, whose upper body leans, of Moore (2012).

    **Arguments:**

    - `stiffness` [N m/rad], `damping` [N m s/rad]: of the rider's hinge; both are zero in the source.
    """
    values = {**_BROWSER_JASON, "k9": stiffness, "c9": damping}
    return Bicycle.from_parameters(as_meijaard("MooreRiderLean2012", values))


def toroidal(rear_crown: float = 0.02, front_crown: float = 0.02) -> Bicycle:
    """The benchmark bicycle with tyres of round cross section, which roll without slip.

    **Arguments:**

    - `rear_crown`, `front_crown` [m]: radii of the cross sections.
    """
    return Bicycle.benchmark().with_parts(rear_tyre=Tyre(crown=rear_crown), front_tyre=Tyre(crown=front_crown))


FOOT, SLUG, POUND = 0.3048, 14.59390294, 4.4482216152605  # [m], [kg], [N]
_INERTIA = SLUG * FOOT**2

# Sharp (1971), The stability and control of motorcycles, J. Mech. Eng. Sci. 13(5), appendix 3: slug, foot, pound.
_EPSILON = 0.4715  # steer axis from the vertical [rad]
_A, _B, _H = 3.112, 1.574, 2.02  # from below the rear mass centre: normal to the steer axis, to the rear axle, up
_E, _F, _TRAIL = 0.08, 0.093, 0.38  # front mass centre before the steer axis and up along it; trail normal to the axis
_REAR_MASS, _FRONT_MASS = 14.9, 2.1  # with their wheels
_REAR_ROLL, _REAR_YAW, _REAR_PRODUCT = 23.0, 15.54, 1.28
_FRONT_ACROSS, _FRONT_ALONG = 0.91, 0.326  # about axes normal to the steer axis and along it
_FRONT_POLAR, _REAR_POLAR = 0.53, 0.775  # of the wheels; the rear one includes the engine's flywheel


def sharp_motorcycle() -> Bicycle:
    """The motorcycle with rigid rider of Sharp (1971), hands off, in SI units.

    Its tyres: (0.8 ft / speed) dY/dt + Y = C1 slip angle + C2 camber. Gravity is 32.2 ft/s^2.

    Sharp's frames include their wheels, and he gives no pitch inertias. Here the wheels are bodies with assumed masses
    and diametral inertias, which are subtracted from the frames; pitch inertias are also assumed. The lateral linear
    model does not depend on these assumptions. His table of eigenvalues uses a front wheel load rounded to 226 lb. His
    parameters give 226.5 lb, so slow eigenvalues differ by some units of the last printed digit.
    """
    cos, sin = math.cos(_EPSILON), math.sin(_EPSILON)
    wheelbase = _B + (_A - _TRAIL) / cos
    # x forward, z down, from the rear contact; the axes of the front frame's inertias are rotated by epsilon
    rear = _REAR_MASS, _B, -_H, _REAR_ROLL, 21.0, _REAR_YAW, -_REAR_PRODUCT
    front_x = _B + (_A + _E) * cos - _F * sin
    front_z = -(_A + _E) * sin - _F * cos
    front_roll = _FRONT_ACROSS * cos**2 + _FRONT_ALONG * sin**2
    front_yaw = _FRONT_ACROSS * sin**2 + _FRONT_ALONG * cos**2
    front = _FRONT_MASS, front_x, front_z, front_roll, 0.65, front_yaw, (_FRONT_ALONG - _FRONT_ACROSS) * sin * cos
    rear_wheel = 1.0, 0.0, -1.0, 0.4, 0.0, 0.4, 0.0
    front_wheel = 0.5, wheelbase, -1.0, 0.5 * _FRONT_POLAR, 0.0, 0.5 * _FRONT_POLAR, 0.0
    parameters = {"w": wheelbase * FOOT, "c": _TRAIL / cos * FOOT, "lam": _EPSILON, "g": 32.2 * FOOT}
    parameters |= {"rR": FOOT, "rF": FOOT, "steer_damping": 5.0 * POUND * FOOT}
    for end, wheel, polar in (("R", rear_wheel, _REAR_POLAR), ("F", front_wheel, _FRONT_POLAR)):
        parameters |= {f"m{end}": wheel[0] * SLUG, f"I{end}xx": wheel[3] * _INERTIA, f"I{end}yy": polar * _INERTIA}
    units = SLUG, FOOT, FOOT, *[_INERTIA] * 4
    for end, body, wheel in (("B", rear, rear_wheel), ("H", front, front_wheel)):
        names = f"m{end}", f"x{end}", f"z{end}", f"I{end}xx", f"I{end}yy", f"I{end}zz", f"I{end}xz"
        values = without(body, wheel)
        parameters |= {name: value * unit for name, value, unit in zip(names, values, units, strict=True)}
    return Bicycle(**parameters).with_parts(rear_tyre=_tyre(3559.0, 298.0), front_tyre=_tyre(2512.0, 211.0))


def _tyre(cornering: float, camber: float) -> Tyre:
    """A tyre from stiffnesses in lb/rad."""
    stiffness = {"cornering_stiffness": cornering * POUND, "camber_stiffness": camber * POUND}
    return Tyre(lateral=LateralSlip(**stiffness, relaxation_length=0.8 * FOOT))
