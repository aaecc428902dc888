"""Eigenvalues of linear models along a parameter of their steady motions, and values at which stability changes."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from .._common.lookup import as_names, not_there
from .._kane.arguments import check_is_system, is_concrete, is_numeric
from .._scalarjit.cache_key import jit
from .._scalarjit.components import Numbers
from .._scalarjit.nan import constant, nan_where
from .._system.parameters import parameter_info, wrapped
from .._system.system import State, System, unit_of, units_of
from ..catalog import WhippleBicycle
from ._bicycle import LATERAL, Groups, mode_names, straight_ahead, track_modes
from ._linearize import linearize
from ._matrix_eigenvalues import MOST_CONDITION, Eig, eig, eigenvalues_text
from ._steady import SteadyMotion

Sample: TypeAlias = tuple[Float[Array, ""], Float[Array, "n n"], Complex[Array, " n"]]
"""A value of the parameter, the state matrix there, and its eigenvalues."""

MotionAt = Callable[[Any, Any], Any] | State | SteadyMotion | None


class Eigenvalues(eqx.Module):
    """Eigenvalues at m values of a parameter, one column for each mode.

    Attributes:

    - `values` (m,): of the parameter.
    - `eigenvalues` (m, n) [1/s].
    - `vectors` (m, n, n): right eigenvectors of unit length; their entries are along the second axis.
    - `condition` (m, n): of each eigenvalue, see `jaxkane.stability.linearize(...).eig`. Derivatives are NaN if it is
        above 1e6, where two modes coalesce.
    - `modes`: names of the columns; use `modes["weave"]` for those of a name.
    - `states`: names of the vectors' entries.
    - `parameter`: name and, if known, unit of the parameter, as the label of a plot.
    """

    values: Float[Array, " m"]
    eigenvalues: Complex[Array, "m n"]
    vectors: Complex[Array, "m n n"]
    condition: Float[Array, "m n"]
    modes: tuple[str, ...] = eqx.field(static=True)
    states: tuple[str, ...] = eqx.field(static=True)
    parameter: str = eqx.field(static=True, default="parameter")

    def __getitem__(self, mode: str) -> Complex[Array, "m n_mode"]:
        if mode not in self.modes:
            raise not_there(mode, self.modes, "these modes")
        places = np.array([i for i, name in enumerate(self.modes) if name == mode])
        return jnp.take(self.eigenvalues, places, axis=1)

    @property
    def stable(self) -> Numbers:
        """Where (m,) all modes decay."""
        return jnp.max(self.eigenvalues.real, axis=1) < 0

    @property
    def coalescing(self) -> Numbers:
        """Where (m, n) an eigenvalue is so close to another that it has no usable derivative."""
        return self.condition >= MOST_CONDITION

    def __repr__(self) -> str:
        if not is_concrete(self.eigenvalues):
            return f"Eigenvalues({', '.join(self.modes)})"
        text = f"{len(self.values)} values of {self.parameter}, {', '.join(dict.fromkeys(self.modes))}"
        at = np.asarray(self.values)[np.asarray(self.coalescing).any(axis=1)]
        if at.size:
            text += f"; modes coalesce at {', '.join(f'{x:.6g}' for x in at)}: no derivative there"
        none = np.asarray(self.values)[~np.isfinite(np.asarray(self.eigenvalues)).all(axis=1)]
        if none.size:
            text += f"; NaN at {', '.join(f'{x:.6g}' for x in none)}: no steady motion there"
        return "\n".join([f"Eigenvalues({text})", *map(self._at, sorted({0, len(self.values) - 1}))])

    def _at(self, i: int) -> str:
        modes = [f"{mode} {eigenvalues_text(self[mode][i])}" for mode in dict.fromkeys(self.modes)]
        return wrapped(f"[1/s] at {float(self.values[i]):.6g}: {'; '.join(modes)}")


def eigenvalues(
    system: System,
    values: Numbers = None,
    motion: MotionAt = None,
    *,
    states: Sequence[str] | None = None,
    modes: Sequence[str] | None = None,
) -> Eigenvalues:
    """Eigenvalues of the linear models about a family of steady motions.

    Modes are followed by an assignment with the least sum of changes. A change is measured between the extrapolated
    eigenvalues and the new ones, and between the eigenvectors.

    **Arguments:**

    - `system`: the system.
    - `values` (m,): of the parameter of the family, in steps that are small enough to follow each mode.
    - `motion`: (system, value) -> `State` or `SteadyMotion`; or a pair of another system and one of these, if the
        parameter belongs to the system. The name of its second argument is the label in plots. Default for a
        `WhippleBicycle`: riding straight ahead at speeds [m/s]. Or one motion without `values`: then m is 1.
    - `states`: as for `linearize`. Default for a bicycle that rides straight: roll, steer, roll_rate, steer_rate, and
        those of its parts.
    - `modes`: names of the modes, one for each column. By default those of a bicycle that rides straight: weave,
        capsize, castering, wobble, and those of its parts and tyres, identified by their participation factors. All
        other modes are numbered. A name that is not clear is replaced by a number, with a warning: less than half of
        the mode belongs to its states, a conjugate pair would have two names, or two modes may have been exchanged.

    **Returns:** `Eigenvalues`, differentiable in the system's parameters. Under a trace, names cannot depend on values:
    a mode whose name is not clear is NaN. Pass `modes` to get it.

    **Raises:** `ValueError` as `linearize`; without a default motion; if none of `values` has a steady motion; or if a
    single motion is not steady. With a function, values without a steady motion are NaN.
    """
    values, at, states, groups = motion_family(system, values, motion, states)
    if not values.size:
        raise ValueError(
            f"{type(system).__name__}: `values` is empty. Pass at least one value of the parameter, e.g. speeds "
            "jnp.linspace(0.0, 10.0, 201)."
        )
    spectra, state_names, clear, number = _eigenvalues_along(system, values, at, states, groups)
    if not callable(motion) and is_concrete(spectra.values) and not np.isfinite(np.asarray(spectra.values)).any():
        state_matrix(system, values[0], at, states)  # raises the exception with the reason
    names, unnamed = names_of_modes(state_names, groups, clear, number, modes)
    roots = spectra.values if is_concrete(unnamed) else nan_where(unnamed, spectra.values.T, (system, values)).T
    label = parameter_label(system, at)
    return Eigenvalues(values, roots, spectra.vectors, spectra.condition, names, state_names, label)


def names_of_modes(
    states: tuple[str, ...],
    groups: Groups | None,
    clear: Bool[Array, " n"],
    number: Int[Array, " n"],
    modes: Sequence[str] | None,
) -> tuple[tuple[str, ...], Any]:
    """Names of the columns, and which of them (n,) must be NaN: under a trace, those whose name is not clear.

    **Arguments:**

    - `states`: names of the states.
    - `groups`: names of states by group, or None.
    - `clear`, `number` (n,): as from `track_modes`.
    - `modes`: names given by the user, or None.
    """
    names = as_names(modes, "modes") if modes is not None else None if groups is None else mode_names(states, groups)
    # Under a trace a name cannot depend on values, so each column has its own number.
    numbered = [f"mode {int(i) + 1}" for i in (number if is_concrete(number) else range(len(states)))]
    if names is not None and len(names) != len(states):
        raise ValueError(f"eigenvalues: {len(states)} modes, but {len(names)} names: {', '.join(names)}.")
    if modes is not None or names is None:
        return names or tuple(numbered), np.zeros(len(states), bool)
    if not is_concrete(clear):
        return names, ~clear
    doubtful = dict.fromkeys(name for name, c in zip(names, clear, strict=True) if not c)
    if doubtful:
        warnings.warn(
            f"the modes {', '.join(doubtful)} cannot be identified and are numbered instead. Use values that are "
            "closer together or cover a wider range, or pass your own names as `modes`.",
            UserWarning,
            stacklevel=3,
        )
    recognized = (k if c else number for k, c, number in zip(names, clear, numbered, strict=True))
    return tuple(recognized), np.zeros(len(states), bool)


def motion_family(system: System, values: Numbers, motion: MotionAt, states: Sequence[str] | None):
    """Values, (system, value) -> motion, states, and the groups of states whose modes have names (None: no names)."""
    check_is_system(system)
    is_straight = False
    if motion is None and isinstance(system, WhippleBicycle):
        is_straight, motion = True, straight_ahead
        has_more = len(system.speeds) > len(WhippleBicycle.speeds) or system.states
        # this bicycle does not name the lateral states of its other parts
        if states is None and not (has_more and type(system).lateral is LATERAL):
            states = system.lateral
    if motion is None:
        raise ValueError(
            f"{type(system).__name__} has no default family of steady motions. Pass `motion`, a function (system, "
            "value) -> State or SteadyMotion, e.g. steady_turn(system, ..., hold={...: value})."
        )
    if callable(motion) is (values is None):
        raise ValueError(
            "A function `motion` needs `values` of the parameter, e.g. speeds jnp.linspace(0.0, 10.0, 201). A single "
            "motion needs none: omit `values`."
        )
    if not callable(motion):
        motion, values = _OneMotion(motion), jnp.zeros(1)
    if not is_numeric(values) or np.ndim(values) > 1:
        raise TypeError(f"The `values` of the parameter must be real numbers (m,), got {values!r}.")
    values = jnp.atleast_1d(jnp.asarray(values, dtype=float))
    groups = _Groups(getattr(system, "mode_groups", {})) if is_straight else None
    return values, motion, None if states is None else as_names(states, "states"), groups


def parameter_label(system: System, motion: Callable[..., Any]) -> str:
    """The label of a family's parameter: the name of the second argument of `motion`, and its unit."""
    if motion is straight_ahead:
        return "forward speed [m/s]"
    names = list(inspect.signature(motion).parameters)
    if isinstance(motion, _OneMotion) or len(names) < 2:
        return "parameter"
    unit = unit_of(names[1], {k: info.unit for k, info in parameter_info(system).items()} | units_of(system))
    return names[1].replace("_", " ") + (f" [{unit}]" if unit else "")


class _Groups(dict):
    """Names of states by group, as a static argument."""

    def __hash__(self):  # type: ignore[override]
        return hash(tuple(self.items()))


class _OneMotion(eqx.Module):
    motion: Any

    def __call__(self, system: System, value: Array):
        return self.motion


def state_matrix(system: System, value: Array, motion: Callable[..., Any], states: tuple[str, ...] | None):
    """A (n, n) at one value of the parameter, and the names of its states."""
    at = motion(system, value)
    if isinstance(at, tuple):
        system, at = at
    model = linearize(system, at, states=states)
    return model.A, model.states


@jit
def _eigenvalues_along(
    system: System,
    values: Float[Array, " m"],
    motion: Callable[..., Any],
    states: tuple[str, ...] | None,
    groups: Groups | None,
):
    names: list[tuple[str, ...]] = []

    def one(value: Array):
        A, state_names = state_matrix(system, value, motion, states)
        names.append(state_names)
        return A

    spectra = eig(jax.vmap(one)(values))
    order, clear, number = track_modes(values, spectra, names[0], groups)
    tracked = (jnp.take_along_axis(x, order if x.ndim == 2 else order[:, None], axis=-1) for x in spectra)
    return Eig(*tracked), names[0], clear, number


_MOST = 8
_GRID = np.linspace(0.0, 20.0, 201)  # [m/s]
_HALVINGS = 32  # at most, of a step between two values
_TRIALS = 200  # at most, of intervals between two values
_NEUTRAL = 1e-10  # relative to the largest eigenvalue: the real part of a neutral mode is rounding errors of this size
_NOISE = 1e-13  # the same for a well-separated eigenvalue
_MOST_NEUTRAL = 1e-7  # the same where eigenvalues coalesce, which magnifies rounding errors


class CriticalSpeeds(eqx.Module):
    """Values of a parameter where the real part of an eigenvalue crosses zero, in rising order.

    `speeds["weave"]` is the first value of that mode. If the mode does not cross, it is `none`: NaN with NaN
    derivatives.

    Attributes:

    - `values` (m,): of the parameter.
    - `frequency` (m,) [rad/s]: zero where the mode does not oscillate.
    - `direction` (m,): 1 where the mode becomes unstable, -1 where it becomes stable.
    - `mode` (m,): index of the mode in `modes`.
    - `none`: a NaN whose derivatives are NaN.
    - `modes`: the names of the modes.
    - `parameter`: name and, if known, unit of the parameter.
    """

    values: Float[Array, " m"]
    frequency: Float[Array, " m"]
    direction: Int[Array, " m"]
    mode: Int[Array, " m"]
    none: Float[Array, ""]
    modes: tuple[str, ...] = eqx.field(static=True)
    parameter: str = eqx.field(static=True, default="parameter")

    def __getitem__(self, name: str) -> Float[Array, ""]:
        if name not in self.modes:
            raise not_there(name, self.modes, "these modes")
        columns = np.array([i for i, mode in enumerate(self.modes) if mode == name])
        mine = jnp.any(self.mode[:, None] == columns[None, :], axis=1) & jnp.isfinite(self.values)
        if not mine.shape[0]:
            return self.none
        return jnp.where(jnp.any(mine), self.values[jnp.argmax(mine)], self.none)

    def __repr__(self) -> str:
        if not is_concrete(self.values):
            return f"CriticalSpeeds({', '.join(dict.fromkeys(self.modes))})"
        rows = zip(self.values, self.mode, self.direction, self.frequency, strict=True)
        text = ", ".join(
            f"{self.modes[int(i)]} {'un' * (int(d) > 0)}stable from {float(v):.10g} ({float(w):.4g} rad/s)"
            for v, i, d, w in rows
        )
        return f"CriticalSpeeds({self.parameter}: {text or 'none'})"


def critical_speeds(
    system: System,
    values: Numbers = None,
    motion: MotionAt = None,
    *,
    states: Sequence[str] | None = None,
    modes: Sequence[str] | None = None,
    most: int = _MOST,
) -> CriticalSpeeds:
    """Values of a parameter at which a mode becomes stable or unstable, e.g. the weave and capsize speeds of a bicycle.

        Re lambda(p) = 0

    The search bisects intervals between `values` until each contains at most one crossing, which it bisects to
    rounding. An interval is decided if no eigenvalue can reach the imaginary axis, or if one eigenvalue or conjugate
    pair alone crosses it once. The change of the eigenvalues for a change dA of A is bounded by Gershgorin's discs of
    X^-1 dA X; X are the eigenvectors.

    **Arguments:**

    - `system`, `motion`, `states`, `modes`: as in `eigenvalues`.
    - `values`: as in `eigenvalues`, in any order. A steady motion must exist between them too. Default for a bicycle: 0
        to 20 m/s in steps of 0.1.
    - `most`: the length of the result under a trace, where the number of crossings cannot be known; unused entries are
        NaN.

    **Returns:** `CriticalSpeeds`. They are differentiable in the parameters of the system by the implicit function
    theorem,

        dp = -(d Re lambda / d parameters) / (d Re lambda / dp).

    The derivative is NaN where the mode coalesces with another. Names are those of `eigenvalues`. Under a trace a value
    is NaN if the name of its mode is not clear.

    **Warns:** if the number of growing eigenvalues changes by more than the crossings explain. Example: without damping
    a motion becomes neutral, and nothing crosses. Under a trace there is no warning.

    **Raises:** `ValueError` as `eigenvalues`, and if a steady motion does not exist at some of `values` or between
    them. Under a trace all values are NaN then.
    """
    if isinstance(most, bool) or not isinstance(most, int) or most < 1:
        raise ValueError(f"critical_speeds: `most` must be a positive number of values to keep; got {most!r}.")
    values, at, states, groups = motion_family(system, _GRID if values is motion is None else values, motion, states)
    values = jnp.sort(values)  # `direction` is defined for a rising parameter
    label = parameter_label(system, at)
    if len(values) < 2:
        names = eigenvalues(system, values, motion, states=states, modes=modes).modes if len(values) else ()
        empty, none = jnp.zeros(0, values.dtype), jnp.full((), jnp.nan, values.dtype)
        return CriticalSpeeds(empty, empty, empty.astype(int), empty.astype(int), none, names, label)
    crossings, found, state_names = _crossings(system, values, at, states, groups, most)
    known, found = jax.lax.stop_gradient((crossings[0], found))
    # `motion` may close over traced values: then `crossings` depends on them too
    origin = (system, values, crossings)
    names, unnamed = names_of_modes(state_names, groups, found["clear"], found["number"], modes)
    # Use NumPy for concrete values: with JAX every operation would be compiled as a program.
    as_array: Any = np.asarray if is_concrete(found, origin) else jnp.asarray
    critical, frequency, direction, column = map(as_array, (*crossings, found["direction"], found["column"]))
    if is_concrete(found):
        if found["is_missing"]:
            raise ValueError(
                f"critical_speeds({type(system).__name__}): there is no steady motion at {float(found['missing']):.6g}"
                ", so crossings near it would be missed. Choose `values` with steady motions at and between them."
            )
        if found["count"] > most:
            return critical_speeds(system, values, motion, states=states, modes=modes, most=2 * int(found["count"]))
        if n := int(found["unexplained"]):
            warnings.warn(
                f"critical_speeds({type(system).__name__}): between {float(values[0]):.6g} and {float(values[-1]):.6g} "
                f"the number of growing eigenvalues {'rises' if n > 0 else 'falls'} by {abs(n)} more than the detected "
                "crossings of the imaginary axis. Some eigenvalues only reach the axis (no damping, or at an end of "
                "the values), or cross it at too small an angle. Plot jaxkane.stability.eigenvalues to see where.",
                stacklevel=2,
            )
        rows = np.flatnonzero(found["counts"])
        order: Any = rows[np.argsort(np.asarray(known)[rows])]
    else:
        counts = found["counts"] & ~jnp.asarray(unnamed)[column] & ~found["is_missing"]
        critical, frequency = nan_where(~counts, (critical, frequency), origin)
        order = jnp.argsort(jax.lax.stop_gradient(critical))
    none = np.full((), np.nan, values.dtype)
    if not is_concrete(found, origin):
        none = nan_where(jnp.array(True), jnp.zeros((), values.dtype), origin)
    critical, frequency, direction, column = (jnp.asarray(x[order]) for x in (critical, frequency, direction, column))
    return CriticalSpeeds(critical, frequency, direction, column, jnp.asarray(none), names, label)


class _Brackets(NamedTuple):
    """Intervals from `lower` to `upper` (k,), in each of which one eigenvalue crosses the imaginary axis.

    - `near` (k,): an estimate of this eigenvalue.
    - `rises` (k,): whether its real part increases.
    - `count`: the number of intervals found, also above k.
    - `is_missing`, `missing`: whether some value has no steady motion, and the first such value.
    """

    lower: Float[Array, " k"]
    upper: Float[Array, " k"]
    near: Complex[Array, " k"]
    rises: Any
    count: Any
    is_missing: Any
    missing: Any

    def extended(
        self,
        lower: Array,
        upper: Array,
        near: Complex[Array, " n"],
        rises: Array,
        is_one: Array,
        p: Array,
        exists: Array,
    ) -> _Brackets:
        """Append the entries of `near` (n,) for which `is_one`. Those beyond the k-th are counted but not stored."""
        at = jnp.where(is_one, self.count + jnp.cumsum(is_one) - 1, len(self.lower))
        new = (lower, upper, near, rises)
        lower, upper, near, rises = (x.at[at].set(y, mode="drop") for x, y in zip(self[:4], new, strict=True))
        missing = jnp.where(self.is_missing | exists, self.missing, p)
        return _Brackets(lower, upper, near, rises, self.count + jnp.sum(is_one), self.is_missing | ~exists, missing)


@jit
def _crossings(
    system: System,
    values: Float[Array, " m"],
    motion: Callable[..., Any],
    states: tuple[str, ...] | None,
    groups: Groups | None,
    most: int,
):
    """At most k crossings.

    **Returns:** their values and frequencies (k,); a dict; and the names of the states. The dict contains:

    - "direction", "column", "counts" (k,): of each crossing, and which entries are crossings.
    - "count": the number of crossings found, also above k. "is_missing", "missing": as of `_Brackets`.
    - "clear", "number" (n,): as from `track_modes`. "unexplained": as from `_unexplained`.
    """
    fixed = constant((system, values))
    state_names: list[tuple[str, ...]] = []

    def at(p: Array):
        A, names = state_matrix(fixed[0], p, motion, states)
        state_names.append(names)
        return jax.lax.stop_gradient(A)

    p = fixed[1]
    A = jax.vmap(at)(p)
    spectra = eig(A)
    brackets = _bracket(at, p, A, spectra.values, most)
    is_one = jnp.arange(most) < brackets.count
    # Unused entries repeat the first one: a NaN there would spoil reverse-mode gradients.
    brackets = jax.tree.map(lambda x: jnp.where(is_one, x, x[0]) if x.ndim else x, brackets)
    roots = _bisect(at, brackets)
    roots, frequency, spectra_at_roots, place = jax.lax.map(
        lambda root: _differentiable(system, motion, states, *root), (roots, brackets.near)
    )
    rows = jnp.concatenate([p, jax.lax.stop_gradient(roots)])
    order = jnp.argsort(rows)
    all_of = jax.tree.map(lambda x, y: jnp.concatenate([x, y])[order], spectra, jax.lax.stop_gradient(spectra_at_roots))
    columns, clear, number = track_modes(rows[order], all_of, state_names[0], groups)
    columns = columns[jnp.argsort(order)][len(p) :]
    # An eigenvalue that is zero at the first or the last value has not crossed.
    ends, step = p[jnp.array([0, -1])], jnp.abs(p[jnp.array([1, -2])] - p[jnp.array([0, -1])])
    counts = is_one & jnp.all(jnp.abs(rows[len(p) :, None] - ends[None, :]) > 1e-9 * step[None, :], axis=1)
    direction = jnp.where(brackets.rises, 1, -1)
    passed = jnp.sum(jnp.where(counts, direction * jnp.where(frequency > 0, 2, 1), 0))
    found = {
        "direction": direction,
        "column": jnp.argmax(columns == place[:, None].astype(columns.dtype), axis=1),
        "counts": counts,
        "count": brackets.count,
        "is_missing": brackets.is_missing,
        "missing": brackets.missing,
        "clear": clear,
        "number": number,
        "unexplained": _unexplained(spectra.values[0], spectra.values[-1], passed),
    }
    return (roots, frequency), found, state_names[0]


def _unexplained(first: Complex[Array, " n"], last: Complex[Array, " n"], passed: Array):
    """The increase of the number of growing eigenvalues from the first to the last value, less the crossings."""

    def growing(x: Complex[Array, " n"]):
        size = x.real / jnp.max(jnp.abs(x))
        # real parts between these limits may be rounding errors
        return jnp.sum(size > _MOST_NEUTRAL), jnp.sum(size > _NOISE)

    (few, many), (few_last, many_last) = growing(first), growing(last)
    low, high = few_last - many, many_last - few
    return jnp.clip(0, low - passed, high - passed)


def _bracket(
    at: Callable[[Array], Array], p: Float[Array, " m"], A: Float[Array, "m n n"], x: Complex[Array, "m n"], most: int
) -> _Brackets:
    """Intervals of p in which eigenvalues of A = at(p) cross the imaginary axis.

    **Arguments:**

    - `at`: p -> A (n, n).
    - `p` (m,): values of the parameter, rising.
    - `A` (m, n, n), `x` (m, n): the matrices at `p`, and their eigenvalues.
    - `most`: the largest number of intervals.
    """
    depth, zeros = _HALVINGS + 2, jnp.zeros(most, p.dtype)
    missing = ~jnp.all(jnp.isfinite(A), axis=(1, 2))
    none = jnp.zeros(most, bool), jnp.zeros((), int), jnp.any(missing), p[jnp.argmax(missing)]
    brackets = _Brackets(zeros, zeros, zeros.astype(x.dtype), *none)

    def within(brackets: _Brackets, step: tuple[Sample, Sample]):
        # Bisect one interval. The undecided halves are on a stack, because a while_loop cannot recurse.
        stack = jax.tree.map(lambda x: jnp.zeros((depth, *x.shape), x.dtype).at[0].set(x), step)

        def look(carry: tuple[Any, ...]):
            brackets, stack, height, trial = carry
            lower, upper = jax.tree.map(lambda x: x[height - 1], stack)
            p = 0.5 * (lower[0] + upper[0])
            A = at(p)
            spectrum = eig(A)
            middle = p, A, spectrum.values
            exists = jnp.all(jnp.isfinite(lower[1] + A + upper[1]))
            clear, *passing = _crossing_modes(spectrum, lower, middle, upper)
            last = (jnp.abs(upper[0] - lower[0]) <= 0.5**_HALVINGS * jnp.abs(step[1][0] - step[0][0])) | (
                trial >= _TRIALS
            )
            near, rises, is_one = (
                jnp.where(clear, x, y) for x, y in zip(passing, _crossings_by_order(lower[2], upper[2]), strict=True)
            )
            is_one = is_one & (clear | last) & exists
            brackets = brackets.extended(lower[0], upper[0], near, rises, is_one, p, exists)
            for i, half in enumerate(((middle, upper), (lower, middle))):
                stack = jax.tree.map(lambda x, y, i=i: x.at[height - 1 + i].set(y), stack, half)
            return brackets, stack, jnp.where(clear | last | ~exists, height - 1, height + 1), trial + 1

        carry = (brackets, stack, jnp.ones((), int), jnp.zeros((), int))
        return jax.lax.while_loop(lambda carry: carry[2] > 0, look, carry)[0], None

    lower, upper = (p[:-1], A[:-1], x[:-1]), (p[1:], A[1:], x[1:])
    return jax.lax.scan(within, brackets, (lower, upper))[0]


def _crossing_modes(spectrum: Eig, lower: Sample, middle: Sample, upper: Sample):
    """Crossings of the imaginary axis between `lower` and `upper`, by Gershgorin's discs.

    **Returns:** whether the interval is decided; the eigenvalues (n,) of A; which of them cross towards the right; and
    which cross at all (of a conjugate pair the upper one).
    """
    (_, A_lower, before), (_, A, x), (_, A_upper, after) = lower, middle, upper
    s = jnp.abs(jnp.sum(spectrum.left.conj() * spectrum.vectors, axis=0))
    # Scale both vectors to one length: the discs would otherwise depend on LAPACK's scaling.
    by = (1 / jnp.sqrt(s)).astype(x.dtype)
    Y, X = spectrum.left.conj().T * by[:, None], spectrum.vectors * by[None, :]
    # the last one is nonzero where A is not linear in p
    changes = (A_lower - A, A_upper - A, A_lower - 2 * A + A_upper)
    M = jnp.max(jnp.stack([jnp.abs(Y @ dA.astype(X.dtype) @ X) for dA in changes]), axis=0)
    radius = jnp.sum(M, axis=1)
    before, after = (y[jnp.argmin(jnp.abs(x[:, None] - y[None, :]), axis=1)] for y in (before, after))
    real = jnp.stack([before.real, x.real, after.real])
    rounding = jnp.clip(10 * jnp.finfo(A.dtype).eps / s, _NEUTRAL, _MOST_NEUTRAL) * jnp.max(jnp.abs(x))
    neutral = jnp.all(jnp.abs(real) <= rounding[None, :], axis=0)
    radius = jnp.where(neutral, 0.0, radius)
    within_reach = ~(jnp.abs(x.real) > radius) & ~neutral
    apart = jnp.abs(x[:, None] - x[None, :]) > radius[:, None] + radius[None, :]
    alone = jnp.all(apart | jnp.eye(len(x), dtype=bool), axis=1)
    bend, rise = jnp.abs(real[0] - 2 * real[1] + real[2]), jnp.abs(real[2] - real[0])
    negative = real < 0
    never = jnp.all(negative == negative[:1], axis=0) & (jnp.min(jnp.abs(real), axis=0) > 2 * bend)
    once = 4 * bend <= rise
    clear = jnp.all(~within_reach | (alone & (never | once)))
    rises = negative[0] & ~negative[2]
    return clear, x, rises, within_reach & (negative[0] != negative[2]) & (x.imag >= 0)


def _crossings_by_order(before: Complex[Array, " n"], after: Complex[Array, " n"]):
    # The same for an undecided interval, by the order of the real parts, which change continuously.
    before, after = (x[jnp.lexsort((-x.imag, -x.real))] for x in (before, after))
    rounding = 1e3 * jnp.finfo(before.dtype).eps * jnp.max(jnp.abs(before))
    rises = before.real < after.real
    changed = (before.real * after.real < 0) & (jnp.abs(after.real - before.real) > rounding)
    return (before + after) / 2, rises, changed & ((before.imag >= 0) | (after.imag >= 0))


def _bisect(at: Callable[[Array], Array], brackets: _Brackets):

    def half(ends: tuple[Array, Array], _: None):
        lower, upper = ends
        middle = 0.5 * (lower + upper)
        x = jax.lax.map(lambda row: _nearest(eig(at(row[0])), row[1])[0], (middle, brackets.near))
        is_below = (x.real < 0) == brackets.rises
        return (jnp.where(is_below, middle, lower), jnp.where(is_below, upper, middle)), None

    bits = -int(np.log2(jnp.finfo(brackets.lower.dtype).eps))
    lower, upper = jax.lax.scan(half, (brackets.lower, brackets.upper), length=bits)[0]
    return 0.5 * (lower + upper)


def _nearest(spectrum: Eig, near: Complex[Array, ""]):
    place = jnp.argmin(jnp.abs(jax.lax.stop_gradient(spectrum.values) - near))
    return spectrum.values[place], place


def _differentiable(
    system: System, motion: Callable[..., Any], states: tuple[str, ...] | None, root: Array, near: Complex[Array, ""]
):
    """A critical value with its derivatives.

    **Returns:** the value, the frequency, all eigenvalues there, and the index of the critical one.
    """

    def spectrum_at(p: Array):
        spectrum = eig(state_matrix(system, p, motion, states)[0])
        return *_nearest(spectrum, near), spectrum

    root = jax.lax.custom_root(
        lambda p: spectrum_at(p)[0].real, root, lambda _, root: root, lambda f, y: y / f(jnp.ones_like(y))
    )
    x, place, spectrum = spectrum_at(root)
    return root, jnp.abs(x.imag), spectrum, place
