"""The front door for bicycles: rides with roll, steer and their rates. Knows the Whipple bicycle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..catalog import WhippleBicycle
from ._fit import fit
from ._parameters import parameters_of
from ._result import Fit
from ._trial import Trial

WHEEL = "rear_wheel_rate"
SIGMA = {"roll": 0.01, "steer": 0.02, "roll_rate": 0.1, "steer_rate": 0.2}
"""Standard deviations of a ride's channels where nothing better is known [rad, rad/s]."""


def fit_bicycle(
    rides: Sequence[Trial] | Trial,
    bicycle: WhippleBicycle,
    free: Any,
    *,
    unknown: Sequence[str] | Mapping[str, float | None] | None = None,
    window: float | None = None,
    input_bias: Sequence[str] | Mapping[str, float | None] = (),
    **options: Any,
) -> Fit:
    """The parameters of a bicycle from rides.

        fit_bicycle(rides, bicycle, free=("steer_damping",), input_bias=("roll_torque", "steer_torque"), window=1.0)

    **Arguments:**

    - `rides`: `Trial`s with channels such as roll, steer, roll_rate and steer_rate [rad, rad/s], inputs such as
        steer_torque [N m], and `initial={"speed": v}` [m/s] (a number or samples; rear_wheel_rate serves too).
    - `bicycle`: with first guesses of its parameters. `free`: what to find, as in `fit`.
    - `unknown`: what every window starts with besides; by default roll, steer and their rates, and in a ride cut into
        windows the rear wheel's rate, near what is known of the speed (5 %): it changes as the bicycle rolls. Yaw and
        the place start at zero, pitch follows.
    - `input_bias`: inputs with a constant offset in every ride, as of a motor's calibration or a tilted road.
    - `window` and `options`: as in `fit`: `method`, `sensor_bias`, `steps`, `progress`, ...

    **Returns:** a `Fit`.

    **Raises:** `ValueError` for a ride without a speed, and what `fit` raises.
    """
    rides = (rides,) if isinstance(rides, Trial) else tuple(rides)
    names = parameters_of(bicycle, free).names
    if "rR" in names and any("speed" in ride.initial for ride in rides):
        raise ValueError(
            "With rR free a speed does not give the rear wheel's rate: give that as initial={'rear_wheel_rate': rate}."
        )
    rides = tuple(_with_wheel_rate(ride, bicycle) for ride in rides)
    if unknown is None:
        unknown = dict.fromkeys(("roll", "steer", "roll_rate", "steer_rate"))
        if window is not None:
            known = [np.abs(ride.initial[WHEEL]).max() for ride in rides if WHEEL in ride.initial]
            unknown[WHEEL] = 0.05 * max(known) if known else None
    return fit(bicycle, rides, free, unknown=unknown, input_bias=input_bias, window=window, **options)


def _with_wheel_rate(ride: Trial, bicycle: WhippleBicycle) -> Trial:
    initial: dict[str, Any] = dict(ride.initial)
    if "speed" in initial:
        initial["rear_wheel_rate"] = -initial.pop("speed") / float(bicycle.rR)
    elif "rear_wheel_rate" not in initial and "rear_wheel_rate" not in ride.measured:
        raise ValueError(f"{ride.name}: a ride needs its speed: Trial(..., initial={{'speed': v}}) [m/s].")
    return Trial(ride.t, ride.measured, ride.inputs, sigma=ride.sigma, initial=initial, name=ride.name)
