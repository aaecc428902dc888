"""The front door for bicycles: rides with roll, steer and their rates. Knows the Whipple bicycle."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ..catalog import WhippleBicycle
from ..catalog._entry import read_bicycle_file
from ._declarations import Inertia, Prior
from ._fit import solve
from ._model import Unknowns
from ._optimizers import GradientDescent, Optimizer
from ._parameters import parameters_of
from ._problem import Problem, with_options
from ._result import Fit
from ._trial import Trial, as_trials

WHEEL = "rear_wheel_rate"
SIGMA = {"roll": 0.01, "steer": 0.02, "roll_rate": 0.1, "steer_rate": 0.2}
"""Standard deviations of a ride's channels where nothing better is known [rad, rad/s]."""


@with_options
def fit_bicycle(
    rides: Sequence[Trial] | Trial,
    bicycle: WhippleBicycle,
    free: Any,
    *,
    optimizer: Optimizer | None = None,
    steps: int | None = None,
    start: Unknowns | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    callback: Callable[[Unknowns, float], None] | None = None,
    progress: bool = False,
    **options: Any,
) -> Fit:
    """The parameters of a bicycle from rides.

        fit_bicycle(rides, bicycle, free=("steer_damping",), input_bias=("roll_torque", "steer_torque"), window=1.0)

    **Arguments:** `rides`, `bicycle`, `free` and `options` as in `bicycle_problem`, of which the most used are
    `unknown`, `window`, `input_bias`, `sensor_bias`, `priors` and `zero_order_hold`; the rest as in `fit`, with
    `GradientDescent()` as the default `optimizer`.

    **Returns:** a `Fit`.

    **Raises:** `ValueError` for a ride without a speed, and what `fit` raises.
    """
    problem = bicycle_problem(rides, bicycle, free, **options)
    optimizer = GradientDescent() if optimizer is None else optimizer
    run = {"steps": steps, "callback": callback, "progress": progress}
    return solve(problem, optimizer, start=start, checkpoint=checkpoint, **run)


@with_options
def bicycle_problem(
    rides: Sequence[Trial] | Trial,
    bicycle: WhippleBicycle,
    free: Any,
    *,
    unknown: Sequence[str] | Mapping[str, float | None] | None = None,
    window: float | None = None,
    input_bias: Sequence[str] | Mapping[str, float | None] = (),
    priors: Mapping[str, Prior] | str | os.PathLike[str] | None = None,
    **options: Any,
) -> Problem:
    """What `fit_bicycle` solves: for `identifiability` before rides are measured, or to `load` what was found.

    **Arguments:**

    - `rides`: `Trial`s with channels such as roll, steer, roll_rate and steer_rate [rad, rad/s], inputs such as
        steer_torque [N m], and `initial={"speed": v}` [m/s] (a number or samples; rear_wheel_rate serves too).
    - `bicycle`: with initial guesses of its parameters. `free`: what to find, as in `fit`.
    - `unknown`: what every window starts with besides; by default roll, steer and their rates, and in a ride cut into
        windows the rear wheel's rate, near what is known of the speed (5 %): it changes as the bicycle rolls. Yaw and
        the place start at zero, pitch follows.
    - `input_bias`: inputs with a constant offset in every ride, as of a motor's calibration or a tilted road.
    - `priors`: (mean, standard deviation) by name, or a text file of BicycleParameters, of which those count that were
        measured with a deviation.
    - `window` and `options`: as in `fit`: `sensor_bias`, `simulation`, ...

    **Returns:** a `Problem`.

    **Raises:** `ValueError` for a ride without a speed, and what `fit` raises.
    """
    rides = as_trials(rides)
    if not isinstance(bicycle, WhippleBicycle):
        raise TypeError(f"`bicycle` is a WhippleBicycle, got {type(bicycle).__name__}: `fit` takes other systems.")
    channels = tuple(dict.fromkeys(name for ride in rides for name in ride.measured))
    names = parameters_of(bicycle, free, options.get("noise"), channels).names
    if isinstance(priors, (str, os.PathLike)):
        priors = bicycle_priors(priors)
    if "rR" in names and any("speed" in ride.initial for ride in rides):
        raise ValueError(
            "With rR free a speed does not give the rear wheel's rate: give that as initial={'rear_wheel_rate': rate}."
        )
    rides = bicycle_rides(rides, bicycle)
    if unknown is None:
        unknown = dict.fromkeys(("roll", "steer", "roll_rate", "steer_rate"))
        if window is not None:
            known = [np.abs(ride.initial[WHEEL]).max() for ride in rides if WHEEL in ride.initial]
            unknown[WHEEL] = 0.05 * max(known) if known else None
    posed = {"unknown": unknown, "input_bias": input_bias, "window": window, "priors": priors}
    return Problem.of(bicycle, rides, free, **posed, **options)


def bicycle_rides(rides: Sequence[Trial] | Trial, bicycle: WhippleBicycle) -> tuple[Trial, ...]:
    """Rides with the rear wheel's rate in the place of their speed, as a fit takes them.

    held_back = validate(fit, bicycle_rides(other_rides, bicycle))
    """
    rides = as_trials(rides)
    return tuple(_with_wheel_rate(ride, bicycle) for ride in rides)


def bicycle_priors(path: str | os.PathLike[str]) -> dict[str, Prior]:
    """What a text file of BicycleParameters says was measured: (value, standard deviation) by name.

    Entries without a deviation are not among them: how well they are known is not given.
    """
    values, deviations = read_bicycle_file(path)
    return {name: (values[name], deviation) for name, deviation in deviations.items() if deviation > 0}


def frame_inertia(part: str, **more: Any) -> Inertia:
    """Mass centre and inertia of a part of the bicycle, kept possible: "B" (rear frame and rider), "H" (handlebar and
    fork), both symmetric about the bicycle's plane, or the wheels "R" and "F". The mass stays, unless `fixed=()`."""
    if part in ("R", "F"):
        moments = (f"I{part}xx", f"I{part}yy", f"I{part}xx")
        return Inertia(moments, mass=f"m{part}", **{"fixed": (f"m{part}",), **more})
    moments, center = (f"I{part}xx", f"I{part}yy", f"I{part}zz"), (f"x{part}", None, f"z{part}")
    products = (None, f"I{part}xz", None)
    return Inertia(moments, products, mass=f"m{part}", center=center, **{"fixed": (f"m{part}",), **more})


def _with_wheel_rate(ride: Trial, bicycle: WhippleBicycle) -> Trial:
    initial: dict[str, Any] = dict(ride.initial)
    if "speed" in initial:
        initial["rear_wheel_rate"] = -initial.pop("speed") / float(bicycle.rR)
    elif "rear_wheel_rate" not in initial and "rear_wheel_rate" not in ride.measured:
        raise ValueError(f"{ride.name}: a ride needs its speed: Trial(..., initial={{'speed': v}}) [m/s].")
    return ride.with_initial_state(initial)
