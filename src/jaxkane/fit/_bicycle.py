"""Fits of the Whipple bicycle to rides with roll, steer and their rates."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ..catalog import WhippleBicycle, read_bicycle_file
from .problem.bodies import Inertia
from .problem.declarations import Items
from .problem.model import Unknowns
from .problem.parameters import Prior
from .problem.problem import Problem
from .problem.specification import parameters_of, with_options
from .problem.trial import Trial, as_trials
from .result.fit_result import Fit
from .solve.fit import solve
from .solve.optimizers import GradientDescent, Optimizer

WHEEL = "rear_wheel_rate"


@with_options
def fit_bicycle(
    rides: Sequence[Trial] | Trial,
    bicycle: WhippleBicycle,
    free: Items,
    *,
    optimizer: Optimizer | None = None,
    steps: int | None = None,
    start: Unknowns | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    callback: Callable[[Unknowns, float], None] | None = None,
    progress: bool = False,
    **options: Any,
) -> Fit:
    """Estimate the parameters of a bicycle from rides.

        fit_bicycle(rides, bicycle, free=("steer_damping", Offset("steer_torque", each="trial")), window=1.0)

    **Arguments:**

    - `rides`: one `Trial` or several, as in `bicycle_problem`.
    - `bicycle`: the bicycle, with initial guesses of its parameters.
    - `free`: the parameters to estimate, as in `fit`.
    - `optimizer`: by default `GradientDescent()`.
    - `steps`: the maximum number of steps, as in `fit`.
    - `start`: the `Unknowns` at which the search starts, as in `fit`.
    - `checkpoint`: a file from which an interrupted fit can be resumed, as in `fit`.
    - `callback`: a function of the unknowns and their cost, as in `fit`.
    - `progress`: whether to show a progress bar.
    - `options`: the options of `bicycle_problem`, such as `unknown`, `window`, `priors` and `zero_order_hold`.

    **Returns:** a `Fit`.

    **Raises:** `ValueError` for a ride without a speed, and the errors of `fit`.
    """
    problem = bicycle_problem(rides, bicycle, free, **options)
    optimizer = GradientDescent() if optimizer is None else optimizer
    run = {"steps": steps, "callback": callback, "progress": progress}
    return solve(problem, optimizer, start=start, checkpoint=checkpoint, **run)


@with_options
def bicycle_problem(
    rides: Sequence[Trial] | Trial,
    bicycle: WhippleBicycle,
    free: Items,
    *,
    unknown: Sequence[str] | Mapping[str, float | None] | None = None,
    window: float | None = None,
    priors: Mapping[str, Prior] | str | os.PathLike[str] | None = None,
    **options: Any,
) -> Problem:
    """The problem that `fit_bicycle` solves. Use it for `identifiability` before the rides, or to `load` a fit.

    **Arguments:**

    - `rides`: one `Trial` or several. Channels are for example roll, steer [rad], roll_rate and steer_rate [rad/s]. An
        input is for example steer_torque [N m]. The speed is `initial={"speed": v}` [m/s], a number or samples.
        Alternatively, pass or measure rear_wheel_rate [rad/s].
    - `bicycle`: the bicycle, with initial guesses of its parameters.
    - `free`: the parameters to estimate, as in `fit`.
    - `unknown`: the unknown initial values of every window, as in `fit`. The default is roll, steer and their rates.
        With `window`, the default also contains the rear wheel's rate, because the speed changes during a ride. Its
        prior has a standard deviation of 5 % of the largest given rate. Yaw and position start at zero, and pitch
        follows from the constraints.
    - `window`: the length of a window [s], as in `fit`.
    - `priors`: by name, (mean, standard deviation); or a text file of BicycleParameters, from which the values with a
        standard deviation are used.
    - `options`: other options of `fit`, such as `simulation`.

    **Returns:** a `Problem`.

    **Raises:** `ValueError` for a ride without a speed, and the errors of `fit`.
    """
    rides = as_trials(rides)
    if not isinstance(bicycle, WhippleBicycle):
        raise TypeError(
            f"`bicycle` must be a WhippleBicycle, got {type(bicycle).__name__}. For other systems, call "
            "`jaxkane.fit.fit`."
        )
    channels = tuple(dict.fromkeys(name for ride in rides for name in ride.measured))
    names = parameters_of(bicycle, free, options.get("noise"), channels, rides).names
    if isinstance(priors, (str, os.PathLike)):
        values, deviations = read_bicycle_file(priors)
        priors = {name: (values[name], deviation) for name, deviation in deviations.items() if deviation > 0}
    if "rR" in names and any("speed" in ride.initial for ride in rides):
        raise ValueError(
            "`free` contains rR, so the speed of a ride does not determine the rate of the rear wheel. Pass "
            "initial={'rear_wheel_rate': rate} instead of the speed."
        )
    rides = bicycle_rides(rides, bicycle)
    if unknown is None:
        unknown = dict.fromkeys(("roll", "steer", "roll_rate", "steer_rate"))
        if window is not None:
            known = [np.abs(ride.initial[WHEEL]).max() for ride in rides if WHEEL in ride.initial]
            unknown[WHEEL] = 0.05 * max(known) if known else None
    posed = {"unknown": unknown, "window": window, "priors": priors}
    return Problem.of(bicycle, rides, free, **posed, **options)


def bicycle_rides(rides: Sequence[Trial] | Trial, bicycle: WhippleBicycle) -> tuple[Trial, ...]:
    """Replace the speed of rides by the rear wheel's rate, as a fit of the bicycle requires.

        validate(fit, bicycle_rides(other_rides, bicycle))

    **Arguments:**

    - `rides`: one `Trial` or several, with `initial={"speed": v}` [m/s].
    - `bicycle`: the bicycle, whose rear wheel radius is used.

    **Returns:** a tuple of `Trial`s.

    **Raises:** `ValueError` for a ride without a speed.
    """
    converted = []
    for ride in as_trials(rides):
        initial: dict[str, Any] = dict(ride.initial)
        if "speed" in initial:
            initial[WHEEL] = -initial.pop("speed") / float(bicycle.rR)
        elif WHEEL not in initial and WHEEL not in ride.measured:
            raise ValueError(
                f"{ride.name}: the speed is missing. Pass Trial(..., initial={{'speed': v}}) [m/s], or measure {WHEEL}."
            )
        converted.append(ride.with_initial_state(initial))
    return tuple(converted)


def frame_inertia(part: str, **more: Any) -> Inertia:
    """The `Inertia` of a part of the bicycle, for `free` of a fit.

    The mass keeps its value, unless `fixed=()` is passed. The parts "B" and "H" are symmetric about the bicycle's
    plane.

    **Arguments:**

    - `part`: "B" (rear frame and rider), "H" (handlebar and fork), "R" (rear wheel) or "F" (front wheel).
    - `more`: the arguments `fixed`, `prior` and `unit` of `Inertia`.

    **Returns:** an `Inertia`. For "B" and "H" it contains the mass centre.
    """
    if part in ("R", "F"):
        moments = (f"I{part}xx", f"I{part}yy", f"I{part}xx")
        return Inertia(moments, mass=f"m{part}", **{"fixed": (f"m{part}",), **more})
    moments, center = (f"I{part}xx", f"I{part}yy", f"I{part}zz"), (f"x{part}", None, f"z{part}")
    products = (None, f"I{part}xz", None)
    return Inertia(moments, products, mass=f"m{part}", center=center, **{"fixed": (f"m{part}",), **more})
