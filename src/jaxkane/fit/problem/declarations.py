"""Declarations of free parameters, gains, offsets, delays, noise and inertias, with bounds and priors."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, Union

import jax
import jax.numpy as jnp
import numpy as np

from ..._common.lookup import as_names, not_there, real_number
from ..._kane.description import DescriptionEvaluator
from ..._kane.regressor import origin_of
from ..._scalarjit.cache_key import jit
from ..._system.parameters import leaf_name
from ..._system.system import System

Prior = tuple[float, float] | tuple[str, float, float] | Literal["normal", "lognormal"]
Where = Literal["input", "sensor", "start"]
Item = Union[str, Callable[[System], object], "Free", "Named", "Inertia"]
"""One element of the argument `free` of a fit."""

Items = Item | Sequence[Item]
"""The argument `free` of a fit."""


@dataclasses.dataclass(frozen=True)
class Free:
    """A parameter to estimate, with its bounds, scale and prior.

        Free("IBxx", bounds=(0.5, 20.0)), Free(lambda system: system.body.mass, prior=(12.0, 0.5))

    **Arguments:**

    - `where`: a name ("IBxx"), a path ("body.mass"), or a function from the system to a leaf as in `eqx.tree_at`. Each
        entry of an array is estimated separately.
    - `start`: the initial guess, in the parameter's unit; by default the value of the system.
    - `bounds`: (lower, upper), in the parameter's unit; either may be None. The declarations `positive` (on a
        logarithmic scale) and `within`, of this parameter and of those tied to it, are bounds too. With (None, None),
        the search is not bounded. If the initial guess is at a bound, the search starts a tenth of the scale inside:
        `Free("dry", bounds=(0.0, None), scale=0.5)` starts at 0.05.
    - `scale`: a typical change of the parameter, in its unit. The default is the magnitude of `start`. If `start` is
        zero, the default is the standard deviation of the prior, or 1. Pass a scale in this case, because it is the
        unit in which a parameter is judged to be undetermined.
    - `prior`: (mean, standard deviation) from an independent measurement, or ("lognormal", median, standard deviation
        of the logarithm) for a positive parameter. With `each`, "normal" or "lognormal" is a distribution over the
        groups. Its mean and standard deviation are estimated too (mixed effects; `Fit.deviations`).
    - `tied`: by name, the factors of other parameters that are set to factor times this one, for example
        `Free("rR", tied={"rF": 1.0})`. For an array, this applies to all its entries.
    - `name`: the name in tables; by default that of the parameter.
    - `unit`: the unit in tables; by default that of the parameter.
    - `each`: None for one value in all trials, "trial" for one value per trial, or a label of the trials
        (`Trial.labels`) for one value per group: `Free("friction", each="rider")`.
    """

    where: str | Callable[[Any], Any]
    start: float | None = None
    bounds: tuple[float | None, float | None] | None = None
    scale: float | None = None
    prior: Prior | None = None
    # A frozen dataclass hashes all its fields, and a dict has no hash.
    tied: Mapping[str, float] = dataclasses.field(default_factory=dict, hash=False)
    name: str | None = None
    unit: str = ""
    each: str | None = None


@dataclasses.dataclass(frozen=True)
class Named:
    """A parameter of the sensors, inputs or noise, not of the system. The options are as in `Free`."""

    what: str
    start: float | None = None
    bounds: tuple[float | None, float | None] | None = None
    scale: float | None = None
    prior: Prior | None = None
    name: str | None = None
    unit: str = ""


@dataclasses.dataclass(frozen=True)
class CalibrationTerm(Named):
    """A calibration parameter of an input, a sensor or the initial states. See `Gain`."""

    what: str | Sequence[str]
    start: float = 0.0
    of: Where | None = None
    each: str | None = None

    @property
    def channels(self) -> tuple[str, ...]:
        """The names of the inputs, channels or states."""
        try:
            return as_names(self.what, "what")
        except TypeError:
            raise TypeError(
                f"{type(self).__name__}({self.what!r}): the first argument must be the name of a channel, an input, a "
                "coordinate, a speed or a state, or a list of such names."
            ) from None

    @property
    def is_eliminated(self) -> bool:
        """Whether each trial or window has its own value, which is eliminated in every step and reported in
        `Fit.nuisance`.

        A term with bounds, with a distribution as its prior or with `of="start"` is a parameter with an interval
        instead.
        """
        simple = self.bounds in (None, (None, None)) and not isinstance(self.prior, str) and self.of != "start"
        return simple and (self.each == "trial" or (self.each == "window" and isinstance(self, (Gain, Offset))))


@dataclasses.dataclass(frozen=True)
class Gain(CalibrationTerm):
    """A factor of an input, of a sensor, or of the given initial values.

        Gain("steer_torque"), Gain("roll_rate", prior=(1.0, 0.02)), Gain("rear_wheel_rate", of="start")

    **Arguments:** those of `Free`, and:

    - `what`: the name of an input, a channel, a coordinate, a speed or a state. Several names share one factor. For an
        input, the system receives gain * samples + offset. For a channel, gain * simulated + offset is compared with
        the measurement.
    - `of`: "input", "sensor" or "start". With "start", every window starts at gain * (initial value from its trial) +
        offset. An example is a speedometer with the same factor in all rides. By default, an input if the system has
        one of this name, else a sensor.
    - `each`: None for one factor in all trials, "trial" for one per trial, "window" for one per window of a fit with
        `window`, or a label of the trials (`Trial.labels`) for one per group. With "trial" and "window",
        `Fit.nuisance` contains the factors, and `prior` applies to each of them.
    """

    start: float = 1.0


@dataclasses.dataclass(frozen=True)
class Offset(CalibrationTerm):
    """A constant that is added to an input, to the reading of a sensor, or to the given initial values.

        Offset("roll", prior=(0.0, 0.02))                  # the zero of a sensor, the same in all rides
        Offset("roll", each="trial")                       # the sensor is calibrated before every ride
        Offset("roll", each="window", prior=(0.0, 0.01))   # the zero of the sensor drifts

    **Arguments:** those of `Gain`.

    - `scale`: by default 1, in the unit of the input, channel or state. Pass another scale if 1 is a large value,
        because the scale is the unit in which the offset is judged to be undetermined.
    """


@dataclasses.dataclass(frozen=True)
class Delay(CalibrationTerm):
    """The delay [s] of an input or a sensor. `Delay(("roll", "steer"))` is one delay of two channels.

    The system receives samples(t - delay) of a delayed input. An input is not recorded before its first sample:

    - With `before`, the input has this value before its first sample, and all measurements are used.
    - With an upper bound but without `before`, measurements are not used until this time after the first sample, and
        each trial starts there.
    - Without either, the input has the value of its first sample before it. The fit is then not `ok` if the estimated
        delay is longer than two sample intervals.

    With a zero-order hold, the delay shifts the discontinuities. With fixed integration steps, each discontinuity is
    replaced by a ramp of two steps.

    A delayed sensor reports simulated(t - delay). The simulation is interpolated by cubics between the samples and
    extrapolated linearly before a window, so the delay should be short compared with a window.

    **Arguments:** those of `Gain`, without `of="start"`.

    - `bounds`: (lower, upper) [s]. They also determine how many samples of the inputs outside a window are kept.
    - `scale`: by default two sample intervals [s].
    - `before`: the value of the input before its first sample, in its unit.
    """

    unit: str = "s"
    before: float | None = None


@dataclasses.dataclass(frozen=True)
class LowPass(CalibrationTerm):
    """The time constant [s] of a low-pass filter of a sensor, in its electronics or in the data logger.

        time_constant dx/dt = simulated - x

    The simulated signal is linear between the samples. The filter of each window starts as if the signal had always had
    its initial slope. The estimated time constant is therefore too small if windows are shorter than about twenty time
    constants and their initial states are free. Fit whole trials in this case. A time constant of 0 does not change the
    signal. To use a filter with its own parameters, add a state to the system: `jaxkane.sensors.low_pass_second_order`.

    **Arguments:** those of `Free`, and:

    - `what`: the name of the channel.
    - `order`: 1, or 2 for the same filter applied twice, which is critically damped.
    - `scale`: by default two sample intervals [s].
    """

    bounds: tuple[float | None, float | None] | None = (0.0, None)
    unit: str = "s"
    order: Literal[1, 2] = 1


def with_time_scales(items: Sequence[Item], interval: float) -> list[Item]:
    """Set missing scales of delays and time constants to two sample intervals [s], because the time scales of data
    range from microseconds to hours."""

    def scaled(item: Item) -> Item:
        if isinstance(item, (Delay, LowPass)) and item.scale is None:
            return dataclasses.replace(item, scale=2.0 * interval)
        return item

    return [scaled(item) for item in items]


@dataclasses.dataclass(frozen=True)
class SpectralDensity(Named):
    """The spectral density of the process noise of a speed, a state or an input: see `noise` in `fit`.

    The spectral density is always positive.

    **Arguments:** those of `Free`, and:

    - `what`: the name of an independent speed or state [unit^2/s], or of an input [unit^2 s]. `noise` must contain it.
    - `start`: the initial guess; by default the value in `noise`.
    """


@dataclasses.dataclass(frozen=True)
class NoiseScale(Named):
    """A factor of `Trial.sigma` of a channel, the same in all trials, in a fit with `noise`.

    The factor is always positive. If `sigma` is 1, the factor is the standard deviation in the channel's unit.

    **Arguments:** those of `Free`, and:

    - `what`: the name of the channel.
    """

    start: float = 1.0


@dataclasses.dataclass(frozen=True)
class Inertia:
    """The inertia of a rigid body, with its mass and mass centre, kept physically consistent.

        Inertia(mass="mB", center=("xB", None, "zB"), moments=("IBxx", "IByy", "IBzz"), products=(None, "IBxz", None))

    The pseudo-inertia remains positive definite, because the search uses its log-Cholesky factors (see `PossibleBody`).

    **Arguments:** names or paths of the system's parameters, as in `Free`.

    - `moments`: names of Ixx, Iyy, Izz about the mass centre. Two equal names describe a wheel.
    - `products`: names of the matrix entries Ixy, Ixz, Iyz; None for those that are zero by symmetry. A body with a
        plane of symmetry has one product of inertia. A body with principal axes has none.
    - `mass`: the name of the mass; None if it is not a parameter to be estimated.
    - `center`: names of the coordinates of the mass centre; None for those that are not parameters to be estimated.
    - `matrix`: the name of an inertia matrix (3, 3), instead of `moments` and `products`.
    - `fixed`: names from `mass` and `center` that keep their values.
    - `prior`: by name, (mean, standard deviation).
    - `unit`: the unit of the moments of inertia in tables.
    """

    moments: tuple[str, str, str] | None = None
    products: tuple[str | None, str | None, str | None] = (None, None, None)
    mass: str | None = None
    center: tuple[str | None, str | None, str | None] = (None, None, None)
    matrix: str | None = None
    fixed: Sequence[str] = ()
    prior: Mapping[str, Prior] = dataclasses.field(default_factory=dict, hash=False)
    unit: str = "kg m^2"

    @classmethod
    def of(cls, system: System, body: str, **more: Any) -> Inertia:
        """The `Inertia` of a body by its name, for `free` of a fit: the parameters that the system uses for it.

            fit(arm, trials, free=(Inertia.of(arm, "forearm"), "damping.elbow"))

        The mass and the mass centre are included if they are separate parameters.

        **Arguments:**

        - `system`: the `System`.
        - `body`: the name of the body, as in `motion["forearm"]`.
        - `more`: the arguments `fixed` and `prior` of `Inertia`.

        **Returns:** an `Inertia`.

        **Raises:** `KeyError` for an unknown name; `ValueError` if a moment of inertia is not a separate parameter. An
        example is a rod, whose moment of inertia depends on its mass and length. Pass such parameters by name.
        """
        bodies = _bodies(system)
        if body not in bodies:
            raise not_there(body, bodies, f"the bodies of {type(system).__name__} that have a mass and a frame")
        with_path, _ = jax.tree_util.tree_flatten_with_path(system)
        values, slopes = _values_and_slopes(system, bodies.index(body))
        owners = [_owner(values[i], slopes, i, with_path) for i in range(10)]
        parameters = [None if owner is None or owner[1] else owner[0] for owner in owners]
        kept: dict[str, Any] = {"mass": parameters[0], "center": tuple(parameters[1:4])}
        matrices = {owner[0] if owner and owner[1] == (3, 3) else "" for owner in owners[4:]}
        if len(matrices) == 1 and "" not in matrices:
            return cls(matrix=matrices.pop(), **kept, **more)
        missing = [name for name, owner in zip(_NAMES[4:7], parameters[4:7], strict=True) if owner is None]
        lost = [name for i, name in enumerate(_NAMES) if i > 6 and parameters[i] is None and values[i] != 0.0]
        if missing or lost:
            raise ValueError(
                f"{type(system).__name__}: {', '.join(missing + lost)} of {body!r} are not separate parameters of the "
                "system. Free the parameters on which they depend by name."
            )
        moments, products = tuple(parameters[4:7]), tuple(parameters[7:])
        return cls(moments, products, **kept, **more)  # type: ignore[arg-type]


@dataclasses.dataclass(frozen=True)
class Linear:
    """A constraint on a sum of free parameters: sum of factor * parameter.

        Linear({"mass of frame": 1.0, "mass of rider": 1.0}, equals=92.0)             # exactly
        Linear({"mass of frame": 1.0, "mass of rider": 1.0}, equals=92.0, std=0.5)    # weighed on a scale
        Linear({"mass of frame": -0.2, "mass of rider": 1.0}, at_least=0.0)

    **Arguments:**

    - `factors`: by name of a free parameter, its factor in the sum.
    - `equals`: the value of the sum, in its unit. Without `std`, the value is exact, and one parameter follows from the
        others: `Fit.dependent` reports this parameter.
    - `std`: the standard deviation of `equals`, if the sum was measured.
    - `at_least`: the lower bound of the sum, in its unit.
    - `at_most`: the upper bound of the sum, in its unit. If the optimum is at a bound, the result is that of an exact
        sum with this value.
    """

    factors: Mapping[str, float] = dataclasses.field(hash=False)
    equals: float | None = None
    std: float | None = None
    at_least: float | None = None
    at_most: float | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.factors, Mapping) or not self.factors:
            raise TypeError(
                f"Linear: `factors` must be a dict from names of parameters to factors, got {self.factors!r}."
            )
        numbers = {f"the factor of {name}": factor for name, factor in self.factors.items()}
        numbers |= {f"`{name}`": getattr(self, name) for name in ("equals", "std", "at_least", "at_most")}
        for name, value in numbers.items():
            number = 1.0 if value is None else real_number(value, f"Linear: {name}")
            if not np.isfinite(number) or (name == "`std`" and number <= 0) or (name.startswith("the") and not number):
                raise ValueError(
                    f"Linear: {name} must be "
                    f"finite{', and not zero' * name.startswith('the')}{' and positive' * (name == '`std`')}, got "
                    f"{value}."
                )
        bounded = self.at_least is not None or self.at_most is not None
        if (self.equals is None) != bounded or (self.std is not None and bounded):
            raise ValueError(
                f"Linear({self.text}): pass either `equals` (with or without `std`), or `at_least` or `at_most` or "
                "both."
            )

    @property
    def text(self) -> str:
        """The sum as text."""
        parts = [name if c == 1 else f"{c:g} {name}" for name, c in self.factors.items()]
        return " + ".join(parts)


@dataclasses.dataclass(frozen=True, eq=False)
class JointPrior:
    """A Gaussian prior of several free parameters whose errors are correlated.

        JointPrior({"IBxx": 11.3, "zB": -1.0}, [[0.04, -0.002], [-0.002, 0.0004]])

    **Arguments:**

    - `mean`: by name of a free parameter, its mean.
    - `covariance`: the covariance matrix (n, n), in the order of `mean`. An example is
        `uncertainties.covariance_matrix` for bicycle parameters from BicycleParameters.

    **Raises:** `ValueError` if `covariance` is not symmetric and positive definite.
    """

    mean: Mapping[str, float]
    covariance: Any

    def __post_init__(self) -> None:
        C = np.asarray(self.covariance, float)
        n = len(self.mean)
        if C.shape != (n, n) or not np.allclose(C, C.T) or not np.all(np.linalg.eigvalsh(C) > 0):
            raise ValueError(
                f"JointPrior of {', '.join(self.mean)}: `covariance` must be a symmetric matrix ({n}, {n}) with "
                f"positive eigenvalues, got {self.covariance!r}."
            )


_NAMES = ("m", "cx", "cy", "cz", "Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz")


def _numbers(system: System) -> list[tuple[str, Any]]:
    """By body, ten numbers: mass, components of the last offset to the mass centre, and central inertia."""
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

    def read(s):
        return jnp.stack([row for _, row in _numbers(s)])

    return read(system), jax.jacfwd(read)(system)


def _values_and_slopes(system: System, i: int) -> tuple[np.ndarray, list[np.ndarray]]:
    values, slopes = jax.device_get(_all_slopes(system))
    return np.asarray(values[i]), [np.asarray(x)[i] for x in jax.tree.leaves(slopes)]


def _owner(value: float, slopes: list[np.ndarray], i: int, with_path: Any) -> tuple[str, tuple[int, ...]] | None:
    """The parameter that equals this number or has it as an entry, and its shape; None if it is not unique."""
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
