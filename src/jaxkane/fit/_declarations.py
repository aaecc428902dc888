"""What a fit can estimate: parameters, gains, offsets, delays, noise, inertias; each with bounds and a prior."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from .._common.lookup import not_there
from .._kane.kanes_method import DescriptionEvaluator
from .._kane.regressor import origin_of
from .._scalarjit.cache_key import jit
from .._system.parameters import leaf_name
from .._system.system import System

Prior = tuple[float, float]
Where = Literal["input", "sensor", "start"]


@dataclasses.dataclass(frozen=True)
class Free:
    """A parameter to estimate, with what is known about it.

        Free("IBxx", bounds=(0.5, 20.0)), Free(lambda system: system.body.mass, prior=(12.0, 0.5))

    **Arguments:**

    - `where`: a name ("IBxx"), a path ("body.mass"), or a function from the system to a leaf as in `eqx.tree_at`. A
        leaf with axes counts as its entries.
    - `start`: the initial guess; by default the system's value.
    - `bounds`: (lower, upper) of which either may be None; it never leaves them, nor what it and those tied to it were
        declared to be, `positive` (on a logarithmic scale) and `within`. (None, None) searches without any bounds. A
        start on one of them is where the search begins a tenth of the scale inside: `Free("dry", bounds=(0.0, None),
        scale=0.5)` at 0.05.
    - `scale`: how much is a lot, in the parameter's unit; by default the start's magnitude; for a start at
        zero the prior's deviation, or 1: give it there, since what is called undetermined is counted in it.
    - `prior`: (mean, standard deviation) of what was measured elsewhere.
    - `tied`: other parameters that follow it: their name and factor, `Free("rR", tied={"rF": 1.0})`. All entries of
        one with axes follow.
    - `name`, `unit`: for tables; by default those of the parameter.
    """

    where: str | Callable[[Any], Any]
    start: float | None = None
    bounds: tuple[float | None, float | None] | None = None
    scale: float | None = None
    prior: Prior | None = None
    tied: Mapping[str, float] = dataclasses.field(default_factory=dict, hash=False)
    name: str | None = None
    unit: str = ""


@dataclasses.dataclass(frozen=True)
class Named:
    """A number that is no parameter of the system and the same in all trials. The options are as in `Free`."""

    what: str
    start: float | None = None
    bounds: tuple[float | None, float | None] | None = None
    scale: float | None = None
    prior: Prior | None = None
    name: str | None = None
    unit: str = ""


@dataclasses.dataclass(frozen=True)
class CalibrationTerm(Named):
    """Of an input, a sensor or the starts. See `Gain`."""

    start: float = 0.0
    of: Where | None = None


@dataclasses.dataclass(frozen=True)
class Gain(CalibrationTerm):
    """A factor common to all trials: of an input, of a sensor, or of what is known of the starts.

        Gain("steer_torque"), Gain("roll_rate", prior=(1.0, 0.02)), Gain("rear_wheel_rate", of="start")

    - `what`: the name of an input (the system receives gain * samples + offset), of a channel (gain * simulated +
        offset is compared with the measurement), or of a coordinate, speed or state.
    - `of`: "input", "sensor" or "start", where every window begins with gain * (what its trial knows) + offset, as of a
        speedometer that is wrong by a factor in all rides. By default an input where there is one of this name, else a
        sensor.

    The rest as in `Free`.
    """

    start: float = 1.0


@dataclasses.dataclass(frozen=True)
class Offset(CalibrationTerm):
    """A constant common to all trials, that is added to an input, to what a sensor says, or to what is known of starts.

        Offset("roll", prior=(0.0, 0.02))                  # the zero of a sensor, the same in all rides

    `what`, `of` and the rest as in `Gain`. The scale is by default 1, in the unit of what it is added to: give another
    where one is much, since what is called undetermined is counted in it.
    """


@dataclasses.dataclass(frozen=True)
class Delay(CalibrationTerm):
    """A delay [s] common to all trials, with which an input acts or a sensor reports.

    - Of an input: the system receives samples(t - delay); before a trial's first sample that one stands. Windows keep
        the samples that `bounds` ask for, without bounds the whole trial's. Under a zero-order hold the jumps move;
        where the steps of integration have one length, each is a ramp of two steps.
    - Of a sensor: simulated(t - delay) is compared with the measurement, by cubics through what is simulated at the
        samples; the motion before a window is continued as it begins, so a delay should be short beside a window.

    `what`, `of` and the rest as in `Gain`.
    """

    scale: float | None = 0.02
    unit: str = "s"


@dataclasses.dataclass(frozen=True)
class LowPass(CalibrationTerm):
    """A low-pass filter of a sensor, in its electronics or in what logs it, with one time constant [s] in all trials.

        time_constant dx/dt = simulated - x

    `what`: the channel. `order`: 1, or 2 for the same filter twice, which is critically damped. What is simulated is
    taken as linear between the samples. Each window begins as if its first slope had lasted. So the time constant is
    found too small where windows are shorter than some twenty of it and their starts are free: fit whole trials. Time
    constant 0 changes nothing; the rest as in `Free`. A filter with parameters of its own is a state of the system:
    `jaxkane.sensors.low_pass_second_order`.
    """

    bounds: tuple[float | None, float | None] | None = (0.0, None)
    scale: float | None = 0.02
    unit: str = "s"
    order: Literal[1, 2] = 1


@dataclasses.dataclass(frozen=True)
class SpectralDensity(Named):
    """The spectral density of the process noise of a speed, a state or an input: see `noise` in `fit`.

    `what`: the name of an independent speed or a state, [unit^2/s], or of an input, [unit^2 s], that stands in `noise`.
    `start`: by default what stands there. It stays positive; the rest as in `Free`.
    """


@dataclasses.dataclass(frozen=True)
class NoiseScale(Named):
    """The factor of `Trial.sigma` of a channel, the same in all trials, in a fit with `noise`.

    `what`: the channel. Where `sigma` was given as 1, the factor is the standard deviation in the channel's unit. It
    stays positive; the rest as in `Free`.
    """

    start: float = 1.0


@dataclasses.dataclass(frozen=True)
class Inertia:
    """A rigid body's inertia, and with it mass and mass centre, that stays what a body can have.

        Inertia(mass="mB", center=("xB", None, "zB"), moments=("IBxx", "IByy", "IBzz"), products=(None, "IBxz", None))

    **Arguments:** names or paths of the system's parameters, as in `Free`.

    - `moments`: Ixx, Iyy, Izz about the mass centre. Two equal names are a wheel's.
    - `products`: Ixy, Ixz, Iyz as matrix entries; None for what symmetry makes zero: one alone is a body with a plane
        of symmetry, none at all a body with principal axes.
    - `matrix`: instead of these, a parameter of the shape (3, 3).
    - `mass`, `center`: parameters, or None where the system has none that moves. `fixed`: those of them that stay.
    - `prior`: (mean, standard deviation) by name.

    The free numbers are logarithmic Cholesky factors of the pseudo-inertia (see `PossibleBody`).
    """

    moments: tuple[str, str, str] | None = None
    products: tuple[str | None, str | None, str | None] = (None, None, None)
    mass: str | None = None
    center: tuple[str | None, str | None, str | None] = (None, None, None)
    matrix: str | None = None
    fixed: Sequence[str] = ()
    prior: Mapping[str, Prior] = dataclasses.field(default_factory=dict, hash=False)
    unit: str = "kg m^2"


_NAMES = ("m", "cx", "cy", "cz", "Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz")


def inertia_of(system: System, body: str, **more: Any) -> Inertia:
    """The `Inertia` of a body by its name, for `free` of a fit: which parameters its description takes for it.

        fit(arm, trials, free=(inertia_of(arm, "forearm"), "damping.elbow"))

    Mass and the place of its centre are in it where they are parameters of their own, and no others move with them.

    **Arguments:** `system`; `body`: its name, as in `motion["forearm"]`; `more`: `fixed` and `prior` of `Inertia`.

    **Raises:** `KeyError` for a name that is no body's; `ValueError` for moments of inertia that are no parameters of
    their own, as those of a rod by its mass and length, or of a body in a plane, which has one: free these by name.
    """
    bodies = _bodies(system)
    if body not in bodies:
        raise not_there(body, bodies, f"{type(system).__name__}, among its bodies with a mass and a frame")
    with_path, _ = jax.tree_util.tree_flatten_with_path(system)
    values, slopes = _values_and_slopes(system, bodies.index(body))
    owners = [_owner(values[i], slopes, i, with_path) for i in range(10)]
    parameters = [None if owner is None or owner[1] else owner[0] for owner in owners]
    kept: dict[str, Any] = {"mass": parameters[0], "center": tuple(parameters[1:4])}
    matrices = {owner[0] if owner and owner[1] == (3, 3) else "" for owner in owners[4:]}
    if len(matrices) == 1 and "" not in matrices:
        return Inertia(matrix=matrices.pop(), **kept, **more)
    missing = [name for name, owner in zip(_NAMES[4:7], parameters[4:7], strict=True) if owner is None]
    lost = [name for i, name in enumerate(_NAMES) if i > 6 and parameters[i] is None and values[i] != 0.0]
    if missing or lost:
        raise ValueError(
            f"{type(system).__name__}: {', '.join(missing + lost)} of {body!r} are no parameters of their own, each of "
            "one component, so that they cannot move as those of a body. Free what they follow from by name."
        )
    return Inertia(moments=tuple(parameters[4:7]), products=tuple(parameters[7:]), **kept, **more)  # type: ignore[arg-type]


def _numbers(system: System) -> list[tuple[str, Any]]:
    """By body: its mass, the last step to its centre, and its central inertia (10,)."""
    zero = jnp.zeros((), jnp.result_type(float))
    n_u = len(system.speeds) + len(system.dependent_speeds)
    q = tuple(zero + 0.3 for _ in system.coordinates)
    motion = DescriptionEvaluator(system).motion(zero + 0.2, q, (zero,) * n_u)
    rows = []
    for body in motion.bodies:
        if body.is_particle:
            continue
        step = body.center._offset if origin_of(body)[1] else None
        r = (0.0, 0.0, 0.0) if step is None else step.components_in(body.frame)
        I = body.inertia
        row = [body.mass, *r, I[0][0], I[1][1], I[2][2], I[0][1], I[0][2], I[1][2]]
        rows.append((body.name, jnp.stack([jnp.asarray(x, zero.dtype) for x in row])))
    return rows


def _bodies(system: System) -> list[str]:
    names: list[str] = []
    jax.eval_shape(lambda s: names.extend(name for name, _ in _numbers(s)), system)
    return names


@jit
def _all_slopes(system):
    read = lambda s: jnp.stack([row for _, row in _numbers(s)])  # noqa: E731
    return read(system), jax.jacfwd(read)(system)


def _values_and_slopes(system: System, i: int) -> tuple[np.ndarray, list[np.ndarray]]:
    values, slopes = jax.device_get(_all_slopes(system))
    return np.asarray(values[i]), [np.asarray(x)[i] for x in jax.tree.leaves(slopes)]


def _owner(value: float, slopes: list[np.ndarray], i: int, with_path: Any) -> tuple[str, tuple[int, ...]] | None:
    """The one parameter that this number is, or is an entry of, and the shape of that."""
    moved = [(k, place) for k, slope in enumerate(slopes) for place in np.flatnonzero(slope[i])]
    if len(moved) != 1:
        return None
    k, place = moved[0]
    path, leaf = with_path[k]
    also = [row for row in range(10) if row != i and slopes[k][row].ravel()[place]]
    is_wheel = all(row in (4, 5, 6) for row in (i, *also))
    if slopes[k][i].ravel()[place] != 1.0 or float(np.ravel(leaf)[place]) != value or (also and not is_wheel):
        return None
    return leaf_name(path), np.shape(leaf)
