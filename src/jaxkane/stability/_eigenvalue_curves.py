"""Eigenvalues of linear models along a parameter of their steady motions."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from .._common.lookup import as_names, not_there
from .._kane.arguments import check_is_system, is_concrete, is_numeric
from .._scalarjit.cache_key import jit
from .._scalarjit.components import Numbers
from .._scalarjit.nan import nan_where
from .._system.parameters import parameter_info, wrapped
from .._system.system import State, System, unit_of, units_of
from ..catalog import WhippleBicycle
from ._bicycle import straight_ahead
from ._linearize import linearize
from ._matrix_eigenvalues import MOST_CONDITION, Eig, eig, eigenvalues_text
from ._modes import LATERAL, Groups, mode_names, track_modes
from ._steady import SteadyMotion

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
    states: tuple[str, ...], groups: Groups | None, clear: Any, number: Any, modes: Sequence[str] | None
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


def parameter_label(system: System, motion: Any) -> str:
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

    def __call__(self, system, value):
        return self.motion


def state_matrix(system: System, value: Any, motion: Any, states: tuple[str, ...] | None):
    """A (n, n) at one value of the parameter, and the names of its states."""
    at = motion(system, value)
    if isinstance(at, tuple):
        system, at = at
    model = linearize(system, at, states=states)
    return model.A, model.states


@jit
def _eigenvalues_along(system, values, motion, states, groups):
    names: list[tuple[str, ...]] = []

    def one(value):
        A, state_names = state_matrix(system, value, motion, states)
        names.append(state_names)
        return A

    spectra = eig(jax.vmap(one)(values))
    order, clear, number = track_modes(values, spectra, names[0], groups)
    tracked = (jnp.take_along_axis(x, order if x.ndim == 2 else order[:, None], axis=-1) for x in spectra)
    return Eig(*tracked), names[0], clear, number
