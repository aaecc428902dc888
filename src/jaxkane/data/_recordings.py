"""Measured data sets, one function each, with their units and licences.

Channels have the names of the coordinates and speeds of the corresponding system, so that a trial can be fitted
directly. Each function takes `file`: a CSV file with the same columns, plain or compressed by gzip, e.g. other runs of
the same machine. Default: the shipped file.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import numpy as np

from .._common.lookup import as_names, refuse_unknown
from ..fit import Trial

File = str | os.PathLike[str] | None


@dataclasses.dataclass(frozen=True)
class Recording:
    """Trials of a machine, in the order of the file.

    - `trials`: the measurements, with standard deviations as initial weights of a fit.
    - `parameters`: values that the authors report, by name [SI units]; empty if they report none.
    - `licence`: owner, source, changes and terms of use of the data.
    """

    trials: tuple[Trial, ...]
    parameters: Mapping[str, Any]
    licence: str

    def __repr__(self) -> str:
        names = (*self.trials[0].measured, *self.trials[0].inputs)
        seconds = sum(float(trial.t[-1] - trial.t[0]) for trial in self.trials)
        return f"Recording({len(self.trials)} trials, {seconds:.0f} s in all, of {', '.join(names)})"


def multi_arm_pendulum(arms: Literal[1, 2, 3] = 1, *, file: File = None) -> Recording:
    """Free oscillations of a pendulum with one, two or three arms on a fixed clamp (Kaheman et al. 2022, arXiv
    2205.06231).

    Channels `angle1`, ... [rad], each from the upright vertical (pi is hanging); 200 Hz, from encoders. `rate1`, ...
    [rad/s] are initial values of the trials. The authors computed them by filtering; they are not measured by separate
    sensors. The trials follow one another without a gap: the oscillation decays from each to the next.

    `parameters`: the authors' estimates: masses `m1`, ..., mass centres `a1`, ... from the upper joint, lengths `L1`,
    ..., central inertias `I1`, ..., viscous friction `k1`, ... [N m s/rad]. Those of the single arm do not reproduce
    its motion.

    **Arguments:**

    - `arms`: 1, 2 or 3.
    - `file`: another CSV file with the same columns.

    **Raises:** `ValueError` for another number of arms.
    """
    names = {1: "single", 2: "double", 3: "triple"}
    if arms not in names:
        raise ValueError(f"multi_arm_pendulum: `arms` must be 1, 2 or 3; got {arms}.")
    angles, rates = ([f"{what}{i + 1}" for i in range(arms)] for what in ("angle", "rate"))
    return _recording(
        "multi_arm_pendulum",
        f"{names[arms]}.csv.gz",
        file,
        measured=dict(zip(angles, angles, strict=True)),
        sigma=0.001,
        initial=dict(zip(rates, rates, strict=True)),
        parameters=_json("multi_arm_pendulum", "parameters_authors.json")[names[arms]],
    )


def driven_double_pendulum(torque: Literal["measured", "commanded"] = "measured", *, file: File = None) -> Recording:
    """A double pendulum with geared motors at shoulder and elbow, driven without feedback (DFKI, 2022); five runs.

    Channels `angle1` [rad] from hanging, `angle2` [rad] relative to the first link; their resolution is 3.8e-4 rad.
    Inputs `torque1`, `torque2` [N m] after the gear, along the angles. The initial rates [rad/s] of windows are slopes
    of cubics through 50 ms of the angles. Times are irregular, about 2 ms apart. No model explains the run sysid_00.

    `parameters`: two sets of the authors, by name. Their I1, I2 are about the joints, `Ir` is a rotor's inertia before
    the gear `gr`, friction is b rate + cf arctan(100 rate).

    **Arguments:**

    - `torque`: "measured" (the drive's estimate from its current) or "commanded".
    - `file`: another CSV file with the same columns.
    """
    columns = {"measured": "torque_measured", "commanded": "torque_command"}
    refuse_unknown([torque], list(columns), "driven_double_pendulum: no torque")
    recording = _recording(
        "driven_double_pendulum",
        "runs.csv.gz",
        file,
        measured={"angle1": "angle1", "angle2": "angle2"},
        inputs={f"torque{i}": f"{columns[torque]}{i}" for i in (1, 2)},
        sigma=0.01,
        parameters=_json("driven_double_pendulum", "parameters_authors.json"),
    )
    return dataclasses.replace(recording, trials=tuple(_with_rates(trial) for trial in recording.trials))


def steer_by_wire(*, seconds: float = 1.0, file: File = None) -> Recording:
    """A riderless steer-by-wire bicycle on a treadmill, pushed and then balanced by its controller (TU Delft); 31
    rides.

    Channels `roll`, `steer` [rad], `roll_rate`, `steer_rate` [rad/s], 100 Hz; the roll is estimated by a filter on the
    bicycle. Input `steer_torque` [N m]: the motor's command, a zero-order hold: `fit(...,
    zero_order_hold=("steer_torque",))`. `initial["speed"]`: the treadmill's [m/s].

    `parameters`: in Meijaard's names, for `WhippleBicycle.from_parameters`. Masses, lengths and the wheels' inertias
    were measured, the others are guesses. The authors do not report `IByy` and `IHyy`; these are 2.0 and 0.01 kg m^2
    here.

    **Arguments:**

    - `seconds`: the duration [s] that is used of each ride, from its start; the authors use one.
    - `file`: another CSV file with the same columns.
    """
    recording = _recording(
        "steer_by_wire",
        "free_responses.csv.gz",
        file,
        measured=_BICYCLE_COLUMNS,
        inputs={"steer_torque": "steer_torque"},
        initial={"speed": "speed_treadmill"},
        sigma=_BICYCLE_SIGMA,
        parameters={"IByy": 2.0, "IHyy": 0.01} | _json("steer_by_wire", "parameters.json"),
    )
    return dataclasses.replace(recording, trials=tuple(ride.between(0.0, seconds - 0.005) for ride in recording.trials))


def robot_bicycle(channels: Sequence[str] = ("steer", "roll_rate"), *, file: File = None) -> Recording:
    """A riderless bicycle that its own controller balances (D. L. Peterson, UC Davis, 2013); four runs, 200 Hz.

    The roll angle was not measured. Inputs `steer_torque`, `drive_torque` [N m]: commands.

    `parameters`: in Meijaard's names, from measured gyrostat parameters. The author considers the data unsuitable for
    parameter estimation.

    **Arguments:**

    - `channels`, of these: `steer` [rad], `steer_rate`, `rear_wheel_rate` [rad/s] (filtered, with a lag),
        `rear_wheel_angle` [rad]; `roll_rate` [rad/s], the gyroscope along the rear frame's horizontal axis; `gyro_y`,
        `gyro_z` [rad/s]; `acc_x`, `acc_y`, `acc_z` [m/s^2], specific force in axes that remain horizontal under pitch,
        at an undocumented position.
    - `file`: another CSV file with the same columns.
    """
    every = {
        "steer": ("steer_angle", 0.01),
        "steer_rate": ("steer_rate", 0.2),
        "rear_wheel_rate": ("rear_wheel_rate", 0.1),
        "rear_wheel_angle": ("rear_wheel_angle", 0.01),
        "roll_rate": ("gyro_x", 0.03),
        **{name: (name, 0.03) for name in ("gyro_y", "gyro_z")},
        **{name: (name, 0.5) for name in ("acc_x", "acc_y", "acc_z")},
    }
    channels = as_names(channels, "channels")
    refuse_unknown(channels, list(every), "robot_bicycle: no channel")
    return _recording(
        "robot_bicycle",
        "runs.csv.gz",
        file,
        measured={name: every[name][0] for name in channels},
        inputs={"steer_torque": "steer_torque", "drive_torque": "rear_wheel_torque"},
        initial={"speed": "speed"},
        sigma={name: every[name][1] for name in channels},
        parameters=_json("robot_bicycle", "parameters.json"),
    )


def davis_rider(*, file: File = None) -> Recording:
    """A rider who controls only the steering, pulled sideways five times, on a treadmill (J. K. Moore, UC Davis, 2012);
    40 s, 200 Hz.

    Channels `roll`, `steer` [rad], `roll_rate`, `steer_rate` [rad/s]. Input `steer_torque` [N m]: by the rider on the
    fork. Input `lateral_force` [N]: positive to the right, below the seat. It has a moment arm of 0.943 m about the
    line of contact, and of 0.011 m about the steering axis. `initial["speed"]`: the median [m/s], because the recorded
    speed has spikes. The bicycle is unstable without its rider: fit it in windows of a second.

    `parameters`: `rigid_rider_and_bicycle`, `bicycle_alone`, `rider_alone` and `as_stored_in_the_run_file`, each in
    Meijaard's names; `identified` are the coefficients that the author found from 57 runs.

    **Arguments:**

    - `file`: another CSV file with the same columns.
    """
    recording = _recording(
        "davis_rider",
        "run105.csv.gz",
        file,
        measured=_BICYCLE_COLUMNS,
        inputs={"steer_torque": "steer_torque", "lateral_force": "lateral_force"},
        initial={"speed": "speed"},
        sigma=_BICYCLE_SIGMA,
        by=None,
        parameters=_json("davis_rider", "parameters.json")
        | {"identified": _json("davis_rider", "reference_moore.json")},
    )
    return dataclasses.replace(recording, trials=tuple(_with_median_speed(trial) for trial in recording.trials))


def tossed_elbow(*, file: File = None) -> Recording:
    """Two cubes on a hinge, thrown and tracked by cameras (DAIRLab, 2021): the free flight of twenty tosses, 0.14 s
    each.

    Channels `x`, `y`, `z` [m], the first body's origin, z upwards; `e1`, ..., `e4`: its Euler parameters, scalar last,
    from the body to the room; `hinge` [rad]. The initial rates of trials are filtered differences: `omega1`, ...,
    `omega3` [rad/s] along the body's axes, `v1`, ..., `v3` [m/s] along the room's, `hinge_rate`.

    `parameters`: the nominal `mass` [kg] and `inertia` [kg m^2] of each cube, about every axis. The hinge is the first
    body's y axis through `hinge_place` [m]. From there the second body's mass centre is at `arm` [m] along its x axis.

    **Arguments:**

    - `file`: another CSV file with the same columns.
    """
    quaternion = {"e1": "qx", "e2": "qy", "e3": "qz", "e4": "qw"}
    rates = {"omega1": "wx", "omega2": "wy", "omega3": "wz", "v1": "vx", "v2": "vy", "v3": "vz"}
    return _recording(
        "tossed_elbow",
        "tosses.csv.gz",
        file,
        measured={"x": "x", "y": "y", "z": "z", **quaternion, "hinge": "hinge_angle"},
        initial={**rates, "hinge_rate": "hinge_rate"},
        sigma={**dict.fromkeys("xyz", 0.001), **dict.fromkeys(quaternion, 0.005), "hinge": 0.01},
        parameters={"mass": 0.37, "inertia": 0.0006167, "hinge_place": (-0.035, 0.06, 0.0), "arm": 0.035},
    )


_BICYCLE_COLUMNS = {"roll": "roll_angle", "steer": "steer_angle", "roll_rate": "roll_rate", "steer_rate": "steer_rate"}
_BICYCLE_SIGMA = {"roll": 0.01, "steer": 0.02, "roll_rate": 0.1, "steer_rate": 0.2}  # [rad], [rad/s]


def _recording(
    name: str, shipped: str, file: File, *, parameters: Mapping[str, Any], by: str | None = "segment", **columns: Any
) -> Recording:
    import pandas as pd  # takes half a second

    with resources.as_file(_folder(name) / shipped) as path:
        path = path if file is None else Path(file)
        frame = pd.read_csv(path, dtype={} if by is None else {by: str})
    stem = path.name.partition(".")[0]
    if by is not None:
        refuse_unknown([by], list(frame.columns), f"{path}: no column")
    runs = {stem: frame} if by is None else {f"{stem}, {by} {key}": run for key, run in frame.groupby(by, sort=False)}
    trials = [Trial.from_dataframe(run, name=title, **columns) for title, run in runs.items()]
    return Recording(tuple(trials), parameters, (_folder(name) / "LICENCE").read_text(encoding="utf-8"))


def _folder(name: str) -> Any:
    return resources.files("jaxkane.data") / "files" / name


def _json(name: str, file: str) -> dict[str, Any]:
    return json.loads((_folder(name) / file).read_text(encoding="utf-8"))


def _with_rates(trial: Trial, step: float = 0.002, window: int = 25) -> Trial:
    """The trial with initial rates: the slopes of cubics through `window` samples, `step` [s] apart."""
    from scipy.signal import savgol_filter  # which imports all of scipy.stats

    even = np.arange(trial.t[0], trial.t[-1] + step, step)
    rates = {}
    for name, y in trial.measured.items():
        slopes = np.asarray(savgol_filter(np.interp(even, trial.t, y), window, 3, deriv=1, delta=step))
        rates[name.replace("angle", "rate")] = np.interp(trial.t, even, slopes)
    return trial.with_initial_state(rates)


def _with_median_speed(trial: Trial) -> Trial:
    return trial.with_initial_state({"speed": float(np.median(trial.initial["speed"]))})
