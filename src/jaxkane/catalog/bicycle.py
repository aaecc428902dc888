"""The Whipple bicycle of Example 7, after Meijaard, Papadopoulos, Ruina and Schwab (2007)."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

import jax.numpy as jnp

from .._common.lookup import decimal_number
from .._scalarjit.components import Component, Scalar
from .._system.kinematics import Frame, Point, Vector, inertial
from .._system.motion import Body, Motion, Torque, weight
from .._system.parameters import parameter, parameter_info
from .._system.system import NamedVector, System
from ._entry import Loads, Quantity, Values, entry

# Meijaard et al. (2007), Table 1: the benchmark bicycle.
_BENCHMARK = {
    "w": 1.02, "c": 0.08, "lam": 0.3141592653589793, "g": 9.81,
    "rR": 0.3, "mR": 2.0, "IRxx": 0.0603, "IRyy": 0.12,
    "xB": 0.3, "zB": -0.9, "mB": 85.0, "IBxx": 9.2, "IByy": 11.0, "IBzz": 2.8, "IBxz": 2.4,
    "xH": 0.9, "zH": -0.7, "mH": 4.0, "IHxx": 0.05892, "IHyy": 0.06, "IHzz": 0.00708, "IHxz": -0.00756,
    "rF": 0.35, "mF": 3.0, "IFxx": 0.1405, "IFyy": 0.28,
}  # fmt: skip

FAR = 20.0
"""An upper limit of the lengths and positions of a bicycle [m]."""
ABOVE_GROUND = (-FAR, 0.0)
"""Limits of z above the ground [m]. They are negative, because z points down."""
TILT = (-1.57, 1.57)
"""Limits of the tilt of the steer axis [rad], less than a right angle."""

# Parameters that other sources give although the model implies them: name, and the equal parameter (None: zero).
_IMPLIED = {"IRzz": "IRxx", "IFzz": "IFxx", "yB": None, "yH": None}

# BicycleParameters also splits the front assembly H into handlebar G and fork S. H contains both.
_PARTS_OF_H = frozenset(f"{what}{part}" for part in "GS" for what in ("m", "x", "z")) | frozenset(
    f"I{part}{axes}" for part in "GS" for axes in ("xx", "yy", "zz", "xz")
)


@entry(
    "Example 7",
    "ideal rolling: dependent speeds, a dependent coordinate",
    q=(0.2, 0.2, 0.15, -0.8, -0.0023122917367326048, -0.1, 0.3, -0.4),  # the pitch follows from roll and steer
    u=(0.3, -17.0, -0.4),  # about 5 m/s, where the benchmark bicycle is self-stable
    operations=2070,
    example=lambda: WhippleBicycle.benchmark(),
)
class WhippleBicycle(System):
    """A bicycle with four rigid bodies, knife-edge wheels and ideal rolling on level ground (Example 7).

    The parameters have Meijaard's names. Positions are relative to the rear contact P of the upright bicycle, with x
    forward and z down. Inertias are about the mass centres, along the same axes. Products are matrix entries.

    | name | meaning | unit |
    |---|---|---|
    | w, c | wheelbase, trail | m |
    | lam | tilt of the steer axis from the vertical | rad |
    | g | gravity | m/s^2 |
    | rR, mR, IRxx, IRyy | rear wheel: radius, mass, inertia about a diameter and about its axle | m, kg, kg m^2 |
    | xB, zB, mB, IBxx, IByy, IBzz, IBxz | rear frame and rider: mass centre, mass, inertia | m, kg, kg m^2 |
    | xH, zH, mH, IHxx, IHyy, IHzz, IHxz | handlebar and fork: the same | m, kg, kg m^2 |
    | rF, mF, IFxx, IFyy | front wheel: as the rear wheel | m, kg, kg m^2 |
    | steer_damping | viscous torque between fork and frame | N m s/rad |

    - Coordinates: yaw, roll and pitch of the rear frame (3-1-2), steer about the tilted axis, the angles of the wheels,
      and the position x, y of the rear contact. Pitch follows from roll and steer (`assemble`). The wheel angles
      decrease in forward motion: the speed is -rR * rear_wheel_rate.
    - Inputs: `roll_torque` on the frame about the heading, `drive_torque` on the rear wheel and `steer_torque` on the
      fork. The last two have a reaction on the frame.
    - Bodies in `motion`: "rear wheel", "rear frame", "fork" and "front wheel". The frame of "fork" is aligned with the
      rear frame at zero steer.
    - Frames in `motion`: "Y" (heading), "B" (rear frame) and "C" (fork, z along the steer axis).
    - Points in `motion`: "P" and "Q" (contacts) and "S" (on the steer axis).

    A subclass adds bodies with `super().motion(t, q, u).extended([...])`.
    """

    w: Scalar = parameter(positive=True, within=(0.0, FAR), unit="m")
    c: Scalar = parameter(within=(-FAR, FAR), unit="m")
    lam: Scalar = parameter(within=TILT, unit="rad")
    rR: Scalar = parameter(positive=True, within=(0.0, FAR), unit="m")
    mR: Scalar = parameter(positive=True, unit="kg")
    IRxx: Scalar = parameter(positive=True, unit="kg m^2")
    IRyy: Scalar = parameter(positive=True, unit="kg m^2")
    xB: Scalar = parameter(within=(-FAR, FAR), unit="m")
    zB: Scalar = parameter(within=ABOVE_GROUND, unit="m")
    mB: Scalar = parameter(positive=True, unit="kg")
    IBxx: Scalar = parameter(positive=True, unit="kg m^2")
    IByy: Scalar = parameter(positive=True, unit="kg m^2")
    IBzz: Scalar = parameter(positive=True, unit="kg m^2")
    IBxz: Scalar = parameter(unit="kg m^2")
    xH: Scalar = parameter(within=(-FAR, FAR), unit="m")
    zH: Scalar = parameter(within=ABOVE_GROUND, unit="m")
    mH: Scalar = parameter(positive=True, unit="kg")
    IHxx: Scalar = parameter(positive=True, unit="kg m^2")
    IHyy: Scalar = parameter(positive=True, unit="kg m^2")
    IHzz: Scalar = parameter(positive=True, unit="kg m^2")
    IHxz: Scalar = parameter(unit="kg m^2")
    rF: Scalar = parameter(positive=True, within=(0.0, FAR), unit="m")
    mF: Scalar = parameter(positive=True, unit="kg")
    IFxx: Scalar = parameter(positive=True, unit="kg m^2")
    IFyy: Scalar = parameter(positive=True, unit="kg m^2")
    g: Scalar = parameter(9.81, within=(0.0, 1000.0), unit="m/s^2")
    steer_damping: Scalar = parameter(0.0, unit="N m s/rad")

    coordinates = ("roll", "rear_wheel_angle", "steer", "yaw", "pitch", "front_wheel_angle", "x", "y")
    speeds = ("roll_rate", "rear_wheel_rate", "steer_rate")
    dependent_speeds = ("yaw_rate", "pitch_rate", "front_wheel_rate")
    dependent_coordinates = ("pitch",)
    inputs = ("roll_torque", "drive_torque", "steer_torque")
    lateral: ClassVar[tuple[str, ...]] = ("roll", "steer", "roll_rate", "steer_rate")
    """States of the lateral linear model about straight riding, as in Meijaard et al. (2007). They are the coordinates,
    speeds and first-order states that change to first order."""
    needs_trim: ClassVar[bool] = False
    """Whether straight riding needs a drive torque, or parts deflect under their weight. Then
    `stability.straight_ahead` computes a steady motion."""
    units = dict.fromkeys(coordinates[:6], "rad") | {"x": "m", "y": "m"}
    units |= dict.fromkeys((*speeds, *dependent_speeds), "rad/s") | dict.fromkeys(inputs, "N m")

    @classmethod
    def benchmark(cls) -> Self:
        """The benchmark bicycle of Meijaard et al. (2007), Table 1."""
        return cls(**_BENCHMARK)

    @classmethod
    def from_parameters(cls, parameters: Mapping[str, Any]) -> Self:
        """A bicycle from a dict of parameters.

        **Arguments:**

        - `parameters`: numbers by Meijaard's names, and by the names of a subclass. Parameters with a default, such as
            `g` and `steer_damping`, may be omitted. `IRzz`, `IFzz`, `yB` and `yH` may be given, although the model
            implies their values.

        **Raises:** `ValueError` with the names that are missing, unknown, or contradict the symmetry of the model.
        """
        values = dict(parameters)
        for name, twin in _IMPLIED.items():
            if name in values:
                given, implied = float(values.pop(name)), 0.0 if twin is None else float(values.get(twin, jnp.nan))
                if abs(given - implied) > 1e-9 * max(1.0, abs(implied)):
                    raise ValueError(
                        f"{cls.__name__}: {name} = {given:.6g}, but the model requires {name} = {twin or 0.0}. Correct "
                        "or omit it."
                    )
        fields = [field for field in dataclasses.fields(cls) if field.init]  # type: ignore[arg-type]
        unknown = sorted(set(values) - {field.name for field in fields})
        required = [field.name for field in fields if field.default is field.default_factory]  # both are MISSING
        missing = [name for name in required if name not in values]
        if unknown or missing:
            parts = [f"missing: {', '.join(missing)}"] * bool(missing) + [f"unknown: {', '.join(unknown)}"] * bool(
                unknown
            )
            raise ValueError(
                f"{cls.__name__}: wrong parameters; {'; '.join(parts)}. Pass the parameters by Meijaard's names."
            )
        return cls(**values)

    @classmethod
    def from_file(cls, path: str | os.PathLike[str]) -> Self:
        """A bicycle from a text file of BicycleParameters (`NAME = value+/-deviation`).

        The standard deviations are ignored. Read them with `jaxkane.catalog.read_bicycle_file`. The parameters of
        handlebar G and fork S, into which some files split the front assembly H, are ignored, and so is the speed `v`.

        **Arguments:**

        - `path`: path of the file.

        **Raises:** `ValueError` for lines that are unknown, repeated or malformed, for missing parameters, and for
        values that are not in metres or radians.
        """
        values, _ = read_bicycle_file(path, known=(*parameter_info(cls), *_IMPLIED, *_PARTS_OF_H, "v"))
        try:
            return cls.from_parameters({name: x for name, x in values.items() if name not in (*_PARTS_OF_H, "v")})
        except ValueError as error:
            raise ValueError(f"{os.fspath(path)}: {error}") from None

    def q_dot(self, t: Component, q: NamedVector, u: NamedVector) -> Sequence[Component]:
        # P moves with the wheel: v_P = v_A - omega_R x r_P_A. The frame R has the roll, but not the pitch.
        forward = -self.rR * (u["rear_wheel_rate"] + u["pitch_rate"])
        turning = [u[f"{part}_rate"] for part in ("roll", "rear_wheel", "steer", "yaw", "pitch", "front_wheel")]
        return (*turning, forward * jnp.cos(q["yaw"]), forward * jnp.sin(q["yaw"]))

    def motion(self, t: Component, q: NamedVector, u: NamedVector) -> Motion:
        N, O = inertial()
        Y = N.rotate(3, q["yaw"], u["yaw_rate"], "Y")
        R = Y.rotate(1, q["roll"], u["roll_rate"], "R")
        P = O.fixed(q["x"] * N.x + q["y"] * N.y, N)  # the ground under the rear wheel, at rest
        bodies, S, B, C, _ = self._linkage(R, P, -self.rR * R.z, q, u)
        front = bodies[-1]
        n1, _, n3 = N.z.components_in(C)  # downwards in the plane of the front wheel
        r_D_Q = self.rF * C.vector(n1, 0.0, n3).normalize()
        Q = Point(front.center.velocity + front.angular_velocity.cross(r_D_Q), front.center, r_D_Q)
        return Motion(bodies, [Q.velocity], points={"P": P, "Q": Q, "S": S}, frames={"Y": Y, "B": B, "C": C})

    def _steer_point(self) -> tuple[Component, Component]:
        """The point S on the steer axis that is nearest to the rear wheel's centre: how far before and above it [m]."""
        cos, sin = jnp.cos(self.lam), jnp.sin(self.lam)
        xS = (self.w + self.c) * cos * cos - self.rR * sin * cos
        return xS, xS * sin / cos

    def _linkage(
        self,
        R: Frame,
        P: Point,
        r_P_A: Vector,
        q: NamedVector,
        u: NamedVector,
        twisted: Callable[[Frame, Point], tuple[Frame, Point]] | None = None,
    ) -> tuple[tuple[Body, ...], Point, Frame, Frame, Frame]:
        """The four bodies, S, and the frames B, C and H. All points follow from the rear wheel's centre (Example 7).

        **Arguments:**

        - `R`: the frame with yaw and roll.
        - `P`, `r_P_A`: the point of the rear tyre at the contact, and the vector from it to the wheel's centre.
        - `twisted`: changes the frame along the steer axis and S, before the steer angle.
        """
        B = R.rotate(2, q["pitch"], u["pitch_rate"], "B")  # rear frame
        tilted = B.rotate(2, self.lam, 0.0, "tilt")
        xS, zS = self._steer_point()
        omega_A = B.angular_velocity + u["rear_wheel_rate"] * B.y
        G_A = Point(P.velocity + omega_A.cross(r_P_A), P, r_P_A)
        G_B = G_A.fixed(self.xB * B.x + (self.zB + self.rR) * B.z)
        S = G_A.fixed(xS * B.x - zS * B.z)
        if twisted is not None:
            tilted, S = twisted(tilted, S)
        C = tilted.rotate(3, q["steer"], u["steer_rate"], "C")  # fork, 3 along the steer axis
        H = C.rotate(2, -self.lam, 0.0, "H")  # fork, aligned with B at zero steer
        omega_D = C.angular_velocity + u["front_wheel_rate"] * C.y

        def from_S(x: Component, z: Component) -> Vector:  # from P of the upright bicycle
            return ((x - xS) * H.x + (z + self.rR + zS) * H.z).express(C)

        G_C, G_D = S.fixed(from_S(self.xH, self.zH)), S.fixed(from_S(self.w, -self.rF))
        return self.bodies((G_A, G_B, G_C, G_D), (R, B, H, C), omega_A, omega_D), S, B, C, H

    def bodies(
        self, centers: Sequence[Point], frames: Sequence[Frame], omega_A: Vector, omega_D: Vector
    ) -> tuple[Body, ...]:
        """Rear wheel, rear frame, fork and front wheel.

        **Arguments:**

        - `centers`: mass centres of the four bodies.
        - `frames`: frames in which the inertias of the bodies are constant.
        - `omega_A`: angular velocity of the rear wheel.
        - `omega_D`: angular velocity of the front wheel.
        """
        A_inertia = (self.IRxx, self.IRyy, self.IRxx)
        B_inertia = ((self.IBxx, 0.0, self.IBxz), (0.0, self.IByy, 0.0), (self.IBxz, 0.0, self.IBzz))
        H_inertia = ((self.IHxx, 0.0, self.IHxz), (0.0, self.IHyy, 0.0), (self.IHxz, 0.0, self.IHzz))
        D_inertia = (self.IFxx, self.IFyy, self.IFxx)
        (G_A, G_B, G_C, G_D), (R, B, H, C) = centers, frames
        return (
            Body(self.mR, A_inertia, G_A, R, omega_A, name="rear wheel"),
            Body(self.mB, B_inertia, G_B, B, name="rear frame"),
            Body(self.mH, H_inertia, G_C, H, name="fork"),
            Body(self.mF, D_inertia, G_D, C, omega_D, name="front wheel"),
        )

    def loads(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion, inputs: Values) -> Loads:
        wheel, frame, fork = (motion[name] for name in ("rear wheel", "rear frame", "fork"))
        steer_torque = inputs["steer_torque"] - self.steer_damping * u["steer_rate"]
        return (
            weight(motion, self.gravity(motion.N)),
            Torque(inputs["roll_torque"] * motion["Y"].x, frame),
            Torque(inputs["drive_torque"] * motion["B"].y, wheel, reaction_on=frame),
            Torque(steer_torque * motion["C"].z, fork, reaction_on=frame),
        )

    def gravity(self, N: Frame) -> Vector:
        """Gravitational acceleration [m/s^2]. `N` is the inertial frame, whose z is normal to the ground."""
        return self.g * N.z

    def _motion_at_rest(self, t: Component, q: NamedVector) -> Any:
        names = (*self.speeds, *self.dependent_speeds)
        return self.motion(t, q, NamedVector((0.0,) * len(names), names))

    def configuration_constraints(self, t: Component, q: NamedVector) -> Sequence[Component]:
        motion = self._motion_at_rest(t, q)
        return [motion["Q"].position.dot(motion.N.z)]  # height of the front contact, downwards

    def events(self, t: Component, q: NamedVector, u: NamedVector) -> Mapping[str, Quantity]:
        return {"fell_over": jnp.cos(q["roll"]) - 0.2}  # beyond 78 degrees


def text_of(path: str | os.PathLike[str]) -> str:
    """The text of a file, without the byte-order mark that some editors write.

    **Raises:** `ValueError` for a file that does not contain UTF-8 text.
    """
    try:
        return Path(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError(f"{os.fspath(path)} is not a text file in UTF-8. Save it with this encoding.") from None


def checked_entries(
    path: str | os.PathLike[str],
    entries: Iterable[tuple[int, str, str, Sequence[Any]]],
    form: str,
    known: Sequence[str] | None = None,
) -> dict[str, tuple[float, ...]]:
    """Numbers by name from the entries of a file.

    **Arguments:**

    - `entries`: line number, text for messages, name, and the texts of a value and of numbers that are not negative.
    - `form`: of a correct line.
    - `known`: names to accept. The default is all names.

    **Raises:** `ValueError` that lists every malformed, unknown or repeated entry with its line number.
    """
    values: dict[str, tuple[float, ...]] = {}
    lines: dict[str, int] = {}
    faults: list[str] = []
    for number, text, name, texts in entries:
        try:
            numbers = tuple(map(decimal_number, texts))
        except (ValueError, TypeError):
            numbers = (math.nan, math.nan)
        if not name or not all(number >= 0 for number in numbers[1:]):
            faults.append(f"line {number}: {text} is not of the form {form}")
        elif name in lines:
            faults.append(f"line {number}: {name} was given before, on line {lines[name]}")
        elif known is not None and name not in known:
            faults.append(f"line {number}: {name} is not a parameter of this model")
        else:
            lines[name], values[name] = number, numbers
    if faults:
        raise ValueError(f"{os.fspath(path)}: " + "; ".join(faults) + ".")
    return values


def read_bicycle_file(
    path: str | os.PathLike[str], known: Sequence[str] | None = None
) -> tuple[dict[str, float], dict[str, float]]:
    """Read values and standard deviations from a text file of BicycleParameters.

    **Arguments:**

    - `path`: path of the file.
    - `known`: names to accept. The default is all names.

    **Returns:** two dicts by name: the values, and their standard deviations (zero if not given).

    **Raises:** `ValueError` that lists every malformed, unknown or repeated entry with its line number.
    """
    entries = []
    for number, line in enumerate(map(str.strip, text_of(path).splitlines()), start=1):
        if line and not line.startswith("#"):
            name, equals, entry = (part.strip() for part in line.partition("="))
            value, _, deviation = (part.strip() for part in entry.partition("+/-"))
            entries.append((number, repr(line), name if equals else "", (value, deviation or "0")))
    pairs = checked_entries(path, entries, "NAME = value+/-deviation", known)
    return {name: pair[0] for name, pair in pairs.items()}, {name: pair[1] for name, pair in pairs.items()}
