"""Coordinates, speeds and accelerations at instants, from a simulation or by splines from measurements.

All channels of a trial have the same spacing of knots, so that their derivatives have the same bandwidth. Within one
spacing of an end or a gap, the derivatives are not used. (`scipy.interpolate.make_splrep` chooses knots that differ
from channel to channel and accumulate near gaps.)
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.interpolate import make_interp_spline, make_lsq_spline

from ..._common.lookup import refuse_unknown
from ..._integrate.trajectory import Trajectory, as_trajectory, refuse_other_system
from ..._kane.api import coordinate_rates
from ..._scalarjit.cache_key import jit
from ..._system.system import System
from ..problem.trial import Trial

DEGREE = 5
_MIN_SAMPLES = 4.0  # smallest spacing of knots, in samples
_RATIO = 1.25  # ratio of successive spacings that are tried


@jit
def _speeds_and_rates(
    system: System,
    t: Float[Array, " n"],
    q: Float[Array, "n n_q"],
    q_dot: Float[Array, "n n_q"],
    q_ddot: Float[Array, "n n_q"],
):
    """Independent speeds and their rates (n, n_u) from the coordinate rates, which are affine in the speeds."""
    zero = jnp.zeros(len(system.speeds), q.dtype)

    def speeds(t: Float[Array, ""], q: Float[Array, " n_q"], q_dot: Float[Array, " n_q"]):
        slopes = jax.jacfwd(lambda u: coordinate_rates(system, t, q, u))(zero)
        return jnp.linalg.pinv(slopes) @ (q_dot - coordinate_rates(system, t, q, zero))

    one = jnp.ones_like(t)
    return jax.vmap(lambda x, x_dot: jax.jvp(speeds, x, x_dot))((t, q, q_dot), (one, q_dot, q_ddot))


def max_spacing(trial: Trial, channels: Mapping[str, np.ndarray]) -> float:
    """The largest spacing of knots [s] at which the spline fits every channel within its standard deviation."""
    span = trial.t[-1] - trial.t[0]
    spacing, smallest = span / 2, _MIN_SAMPLES * float(np.median(np.diff(trial.t)))
    for name, y in channels.items():
        finite = np.isfinite(y)
        while spacing > smallest:
            residuals = (spline(trial, name, y, spacing)(trial.t[finite]) - y[finite]) / trial.sigma[name][finite]
            if np.mean(residuals**2) <= 1.0:
                break
            spacing /= _RATIO
    return max(spacing, smallest)


def spline(trial: Trial, name: str, y: np.ndarray, spacing: float) -> Any:
    """The least-squares spline with knots of this spacing. Knots without measurements between them are left out."""
    finite = np.isfinite(y)
    t, y = trial.t[finite], y[finite]
    _refuse_few(f"{trial.name}: {name} has {len(t)} samples", len(t), "Omit this trial")
    weights = None if name not in trial.sigma else 1.0 / trial.sigma[name][finite]
    n = max(1, round((t[-1] - t[0]) / spacing))
    inner, last = [], 0
    for knot in np.linspace(t[0], t[-1], n + 1)[1:-1]:
        upto = int(np.searchsorted(t, knot))
        # Without samples between two knots, the least-squares problem is singular (condition of Schoenberg and
        # Whitney).
        if upto - last >= 2 and len(t) - upto >= 2:
            inner.append(knot)
            last = upto
    knots = np.r_[[t[0]] * (DEGREE + 1), inner, [t[-1]] * (DEGREE + 1)]
    return make_lsq_spline(t, y, knots, DEGREE, w=weights)


def _refuse_few(which: str, n: int, remedy: str) -> None:
    if n < 3 * (DEGREE + 1):
        raise ValueError(f"{which}. Accelerations need at least {3 * (DEGREE + 1)}. {remedy}.")


def covered(t: np.ndarray, channels: Mapping[str, np.ndarray], spacing: float) -> np.ndarray:
    """Where every channel is measured, at a distance of at least one spacing from its ends and from gaps longer than
    one spacing.
    """
    fine = np.ones(t.shape, bool)
    for y in channels.values():
        times = t[np.isfinite(y)]
        fine &= (t >= times[0] + spacing) & (t <= times[-1] - spacing)
        for i in np.flatnonzero(np.diff(times) > spacing):
            fine &= (t <= times[i] - spacing) | (t >= times[i + 1] + spacing)
    return fine


@dataclasses.dataclass(frozen=True)
class KinematicSamples:
    """Coordinates, speeds and accelerations at instants, for `base_parameters` and `first_estimate`.

        KinematicSamples(t, q, u, u_dot, {"torque": torque})

    Rows that contain NaN are left out.

    **Arguments:**

    - `t` (n,): times [s].
    - `q` (n, n_q): coordinates.
    - `u`, `u_dot` (n, n_u): independent speeds and their rates.
    - `inputs`: by name, inputs and first-order states, as numbers or arrays (n,). Inputs that are left out are zero.
    - `trial` (n,): index of the trajectory that each row belongs to. By default all rows belong to one.

    **Raises:** `ValueError` for inconsistent shapes, and if no row is finite.
    """

    t: np.ndarray
    q: np.ndarray
    u: np.ndarray
    u_dot: np.ndarray
    inputs: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    trial: np.ndarray = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        t, trial = np.asarray(self.t, float), self.trial
        trial = np.zeros(t.shape, int) if trial is None else np.asarray(trial)
        rows = {name: np.asarray(getattr(self, name), float) for name in ("q", "u", "u_dot")}
        inputs = {name: np.asarray(x, float) for name, x in self.inputs.items()}
        inputs = {name: np.full(t.shape, x) if x.ndim == 0 else x for name, x in inputs.items()}
        wrong = [f"`{k}` {x.shape}" for k, x in rows.items() if x.ndim != 2 or x.shape[:1] != t.shape]
        wrong += [f"`{k}` {x.shape}" for k, x in {"t": t, "trial": trial, **inputs}.items() if x.shape != (t.size,)]
        if wrong or rows["u"].shape != rows["u_dot"].shape:
            shapes = ", ".join(wrong or [f"`{k}` {rows[k].shape}" for k in ("u", "u_dot")])
            raise ValueError(
                f"KinematicSamples: with {t.size} times (n,), `q`, `u` and `u_dot` need a row for each time, and "
                f"`inputs` and `trial` a number for each time; got {shapes}."
            )
        columns = np.column_stack([t, *rows.values(), *inputs.values()])
        finite = np.all(np.isfinite(columns), axis=1)
        if not finite.any():
            raise ValueError(
                "KinematicSamples: every instant contains a number that is not finite. Pass at least one instant at "
                "which all numbers are finite."
            )
        for name, x in {"t": t, **rows, "trial": trial}.items():
            object.__setattr__(self, name, x[finite])
        object.__setattr__(self, "inputs", {name: x[finite] for name, x in inputs.items()})

    def __len__(self) -> int:
        return len(self.t)

    def __repr__(self) -> str:
        return f"KinematicSamples({len(self)} of {len(np.unique(self.trial))} motions)"


Motions = KinematicSamples | Trial | Trajectory | Sequence[Trial | Trajectory | KinematicSamples]


def kinematic_samples(system: System, motions: Motions, *, spacing: float | None = None) -> KinematicSamples:
    """Coordinates, speeds and accelerations of measured or simulated trajectories.

    **Arguments:**

    - `system`: a system.
    - `motions`: a `Trial`, a `Trajectory`, `KinematicSamples`, or a sequence of these. The accelerations of a
        trajectory are computed from splines through its speeds, so save enough times. The coordinates of a trial are
        approximated by splines, whose derivatives give speeds and accelerations. If a speed is measured, its own spline
        is used instead.
    - `spacing`: distance of the knots of the splines [s]. Oscillations with a period below two spacings are removed. By
        default the largest spacing at which the root mean square of the residuals of every channel is within its
        `sigma`.

    **Returns:** `KinematicSamples`. Samples within one spacing of the ends of a trial, and of gaps in a channel, are
    left out.

    **Raises:** `ValueError` for a coordinate or a first-order state that a trial does not measure, and for a trial or a
    trajectory that is too short.
    """
    motions = as_trajectory(motions)
    parts: list[KinematicSamples] = []
    for motion in [motions] if isinstance(motions, (KinematicSamples, Trial, Trajectory)) else motions:
        one = as_trajectory(motion)
        if not isinstance(one, (KinematicSamples, Trial, Trajectory)):
            found = type(motion).__name__
            raise TypeError(f"`motions` must contain only Trial, Trajectory or KinematicSamples, got {found}.")
        one = _of_trajectory(system, one) if isinstance(one, Trajectory) else one
        parts.append(_of_trial(system, one, spacing) if isinstance(one, Trial) else one)
    if not parts:
        raise ValueError("`motions` is empty. Pass a Trial, a Trajectory, or KinematicSamples.")
    n_q, n_u, known = len(system.coordinates), len(system.speeds), (*system.inputs, *system.states)
    for part in parts:
        if (part.q.shape[1], part.u.shape[1]) != (n_q, n_u):
            raise ValueError(
                f"{type(system).__name__} has {n_q} coordinates and {n_u} independent speeds, but the samples have "
                f"{part.q.shape[1]} and {part.u.shape[1]}. Pass samples of this system."
            )
        refuse_unknown(part.inputs, known, f"{type(system).__name__} has no input or state named", "it has")
        missing = [name for name in system.states if name not in part.inputs]
        if missing:
            raise ValueError(
                f"{type(system).__name__}: the loads may depend on {', '.join(missing)}, which the samples do not "
                "contain. Add it to `inputs` of KinematicSamples, or measure it."
            )
    if len(parts) == 1:
        return parts[0]
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in ("t", "q", "u", "u_dot")}
    inputs = {name: np.concatenate([part.inputs.get(name, 0.0 * part.t) for part in parts]) for name in known}
    pairs = np.concatenate([np.column_stack([np.full(len(part), i), part.trial]) for i, part in enumerate(parts)])
    return KinematicSamples(**joined, inputs=inputs, trial=np.unique(pairs, axis=0, return_inverse=True)[1].ravel())


def _of_trajectory(system: System, ride: Trajectory) -> KinematicSamples:
    """Samples of a trajectory, with accelerations from a spline through the speeds.

    Accelerations from the system would depend on the parameters to be estimated.
    """
    refuse_other_system("KinematicSamples", system, ride)
    if np.ndim(ride.status) > 0:
        raise ValueError("The trajectory is a batch. Pass its members one by one, or use KinematicSamples.")
    t, q, u = (np.asarray(x) for x in (ride.t, ride.q, ride.u))
    there = np.all(np.isfinite(np.column_stack([t, q, u])), axis=1)
    _refuse_few(f"The trajectory has {there.sum()} times", int(there.sum()), "Save more times")
    u_dot = np.full(u.shape, np.nan)
    u_dot[there] = make_interp_spline(t[there], u[there], DEGREE)(t[there], 1)
    u_dot[np.flatnonzero(there)[[*range(3), *range(-3, 0)]]] = np.nan  # splines are inaccurate at the ends
    return KinematicSamples(t, q, u, u_dot, {name: np.asarray(ride[name]) for name in (*system.inputs, *system.states)})


def _of_trial(system: System, trial: Trial, spacing: float | None) -> KinematicSamples:
    names = [*system.coordinates, *system.speeds, *system.states]
    channels = {name: y for name, y in trial.measured.items() if name in names}
    missing = [name for name in system.coordinates if name not in channels]
    if missing:
        raise ValueError(
            f"{trial.name}: the equations of motion need {', '.join(missing)}, which was not measured. Pass "
            "`jaxkane.fit.inverse.kinematics.KinematicSamples(t, q, u, u_dot, inputs)` instead of the trial."
        )
    refuse_unknown(trial.inputs, system.inputs, f"{trial.name}: {type(system).__name__} has no input named", "it has")
    for name in system.coordinates:
        # Only angular coordinates wrap. An impact may change a rate or a length by 2 pi between two samples.
        finite = np.isfinite(trial.measured[name]) & (system.units.get(name) in (None, "rad"))
        t, steps = trial.t[finite], np.abs(np.diff(trial.measured[name][finite]))
        usual = np.median(steps) if steps.size else np.inf
        if usual < 0.8 and np.any(np.abs(steps - 2 * np.pi) < 0.2 + 2 * usual):
            raise ValueError(
                f"{trial.name}: {name} jumps by a whole turn at t = {t[steps.argmax()]:g} s. Make the angle continuous "
                "with np.unwrap."
            )
    if spacing is None:
        spacing = max_spacing(trial, channels)
    splines = {name: spline(trial, name, y, spacing) for name, y in channels.items()}
    inputs = {name: spline(trial, name, y, spacing)(trial.t) for name, y in trial.inputs.items()}
    inputs |= {name: splines[name](trial.t) for name in system.states if name in splines}

    x = [np.column_stack([splines[name](trial.t, order) for name in system.coordinates]) for order in range(3)]
    u, u_dot = (np.array(y) for y in _speeds_and_rates(system, *map(jnp.asarray, (trial.t, *x))))
    for i, name in enumerate(system.speeds):
        if name in splines:
            u[:, i], u_dot[:, i] = splines[name](trial.t), splines[name](trial.t, 1)
    u_dot[~covered(trial.t, channels, spacing)] = np.nan
    return KinematicSamples(trial.t, x[0], u, u_dot, inputs)
