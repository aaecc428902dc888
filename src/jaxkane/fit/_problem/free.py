"""What a fit may be asked to find: declarations, with what is known beforehand. Knows no system."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

Prior = tuple[float, float]
Where = Literal["input", "sensor", "start"]


@dataclasses.dataclass(frozen=True)
class Free:
    """A parameter to be found, with what is known about it.

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
class Shared:
    """What is the same in all trials, and no parameter of the system. See `Gain`."""

    what: str
    start: float = 0.0
    bounds: tuple[float | None, float | None] | None = None
    scale: float | None = None
    prior: Prior | None = None
    name: str | None = None
    unit: str = ""
    of: Where | None = None


@dataclasses.dataclass(frozen=True)
class Gain(Shared):
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
class Offset(Shared):
    """A constant common to all trials, that is added to an input, to what a sensor says, or to what is known of starts.

        Offset("roll", prior=(0.0, 0.02))                  # the zero of a sensor, the same in all rides

    `what`, `of` and the rest as in `Gain`. The scale is by default 1, in the unit of what it is added to: give another
    where one is much, since what is called undetermined is counted in it.
    """


@dataclasses.dataclass(frozen=True)
class Delay(Shared):
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
class Intensity:
    """The intensity of the process noise of a speed, a state or an input, common to all trials: see `noise` in `fit`.

    `of`: the name of an independent speed or a state, [unit^2/s], or of an input, [unit^2 s], that stands in `noise`.
    `start`: by default what stands there. It stays positive; the rest as in `Free`.
    """

    of: str
    start: float | None = None
    bounds: tuple[float | None, float | None] | None = None
    scale: float | None = None
    prior: Prior | None = None
    name: str | None = None
    unit: str = ""


@dataclasses.dataclass(frozen=True)
class Sigma:
    """The factor by which `Trial.sigma` of a channel is to be multiplied, common to all trials, in a fit with `noise`.

    `channel`: its name. Where `sigma` was given as 1, the factor is the standard deviation in the channel's unit. It
    stays positive; the rest as in `Free`.
    """

    channel: str
    start: float = 1.0
    bounds: tuple[float | None, float | None] | None = None
    scale: float | None = None
    prior: Prior | None = None
    name: str | None = None
    unit: str = ""


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
