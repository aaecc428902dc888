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
from .._scalarjit.nan import nan_where
from .._system.parameters import parameter_info
from .._system.system import State, System, unit_of, units_of
from ..catalog import WhippleBicycle
from ._bicycle import straight_ahead
from ._eig_of_matrix import MOST_CONDITION, Eig, eig
from ._linearize import linearize
from ._modes import LATERAL, Groups, mode_names, track_modes
from ._steady import SteadyMotion

MotionAt = Callable[[Any, Any], Any] | State | SteadyMotion | None


class Eigenvalues(eqx.Module):
    """Eigenvalues at m values of a parameter, one column for each mode.

    Attributes:

    - `values` (m,): of the parameter. `eigenvalues` (m, n) [1/s]; `vectors` (m, n, n): right eigenvectors in the last
        axis but one, of unit length.
    - `condition` (m, n): of each eigenvalue, see `jaxkane.stability.linearize(...).eig`. Derivatives are NaN where it
        is above 1e6: two modes coalesce there, and have none.
    - `modes`: names of the columns; `modes["weave"]` gives those of a name. `states`: names of the vectors' entries.
    - `parameter`: what the values are of, with its unit where that is known: the label of a plot's axis.
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
    def stable(self) -> Any:
        """Where (m,) all modes decay."""
        return jnp.max(self.eigenvalues.real, axis=1) < 0

    @property
    def coalescing(self) -> Any:
        """Where (m, n) an eigenvalue is so close to another that it has no usable derivative."""
        return self.condition >= MOST_CONDITION

    def __repr__(self) -> str:
        if not is_concrete(self.eigenvalues):
            return f"Eigenvalues({', '.join(self.modes)})"
        text = f"{len(self.values)} values, {', '.join(dict.fromkeys(self.modes))}"
        at = np.asarray(self.values)[np.asarray(self.coalescing).any(axis=1)]
        if at.size:
            text += f"; modes coalesce at {', '.join(f'{x:.6g}' for x in at)}: no derivative there"
        none = np.asarray(self.values)[~np.isfinite(np.asarray(self.eigenvalues)).all(axis=1)]
        if none.size:
            text += f"; NaN at {', '.join(f'{x:.6g}' for x in none)}: no steady motion there"
        return f"Eigenvalues({text})"


def eigenvalues(
    system: System,
    values: Any = None,
    motion: MotionAt = None,
    *,
    states: Sequence[str] | None = None,
    modes: Sequence[str] | None = None,
) -> Eigenvalues:
    """Eigenvalues of the linear models about a family of steady motions.

    **Arguments:**

    - `values` (m,): of the parameter of the family, in small enough steps to follow a mode from one to the next.
    - `motion`: (system, value) -> `State`, `SteadyMotion`, or a pair of another system and one of these, where the
        parameter belongs to the system; how the function calls `value` is how plots call it. For a `WhippleBicycle` it
        is riding straight ahead at speeds [m/s] by default. Or one motion, without `values`: then m is 1.
    - `states`: as for `linearize`; for the bicycle riding straight (roll, steer, roll_rate, steer_rate), and those of
        its parts.
    - `modes`: names of the modes, one for each column. By default those of a bicycle that rides straight: weave,
        capsize, castering, wobble, and those of its parts and tyres, recognized by how much their states take part;
        "mode 5", with a warning, where that is not clear: less than half of a mode is theirs, a conjugate pair would
        have two names, or two modes may have changed places within a step. All others are numbered.

    **Returns:** `Eigenvalues`, differentiable in the system's parameters. A mode is followed by its eigenvalue, that
    is extrapolated, and its eigenvector: the assignment with the least sum of both changes. Under a trace, where names
    cannot depend on values, a mode whose name is not clear is NaN; give `modes` to have it.

    **Raises:** `ValueError` as `linearize`, and where there is no default motion, none of `values` has a steady one, or
    the one motion that is given is not steady. Of a function that is given, values without a steady one are NaN.
    """
    values, at, states, groups = motion_family(system, values, motion, states)
    spectra, state_names, clear = _eigenvalues_along(system, values, at, states, groups)
    if not callable(motion) and is_concrete(spectra.values) and not np.isfinite(np.asarray(spectra.values)).any():
        state_matrix(system, values[0], at, states)  # which says why
    names, unnamed = names_of_modes(state_names, groups, clear, modes)
    roots = spectra.values if is_concrete(unnamed) else nan_where(unnamed, spectra.values.T, (system, values)).T
    label = _parameter(system, at)
    return Eigenvalues(values, roots, spectra.vectors, spectra.condition, names, state_names, label)


def names_of_modes(
    states: tuple[str, ...], groups: Groups | None, clear: Any, modes: Sequence[str] | None
) -> tuple[tuple[str, ...], Any]:
    """Names of the columns, and those of them (n,) that must be NaN: under a trace, where its name is not clear."""
    names = as_names(modes) if modes is not None else None if groups is None else mode_names(states, groups)
    numbered = [f"mode {i + 1}" for i in range(len(states))]
    if names is not None and len(names) != len(states):
        raise ValueError(f"eigenvalues: {len(states)} modes, but {len(names)} names: {', '.join(names)}.")
    if modes is not None or names is None:
        return names or tuple(numbered), np.zeros(len(states), bool)
    if not is_concrete(clear):
        return names, ~clear
    doubtful = dict.fromkeys(name for name, c in zip(names, clear, strict=True) if not c)
    if doubtful:
        warnings.warn(
            f"which modes are {', '.join(doubtful)} is not clear: numbered instead. Values that lie closer, "
            "or over a wider range, may tell; or give `modes`, names of your own.",
            UserWarning,
            stacklevel=3,
        )
    recognized = (k if c else number for k, c, number in zip(names, clear, numbered, strict=True))
    return tuple(recognized), np.zeros(len(states), bool)


def motion_family(system: System, values: Any, motion: MotionAt, states: Sequence[str] | None):
    """Values, (system, value) -> motion, states, and the groups of states whose modes have names; None: none has."""
    is_straight = False
    check_is_system(system)
    if motion is None and isinstance(system, WhippleBicycle):
        is_straight, motion = True, straight_ahead
        has_more = len(system.speeds) > len(WhippleBicycle.speeds) or system.states
        if states is None and not (has_more and type(system).lateral is LATERAL):  # what else moves, it does not say
            states = system.lateral
    if motion is None:
        raise ValueError(
            f"{type(system).__name__} has no family of steady motions by default: give `motion`, a function "
            "(system, value) -> State or SteadyMotion, e.g. by steady_turn(system, ..., hold={...: value})."
        )
    if not callable(motion):
        if values is not None:
            raise ValueError("One motion has no values of a parameter: leave `values` out, or give a function.")
        motion, values = _OneMotion(motion), jnp.zeros(1)
    if values is None:
        raise ValueError("Give the values of the parameter, e.g. speeds jnp.linspace(0.0, 10.0, 201).")
    if not is_numeric(values):
        raise TypeError(f"The values of the parameter must be real numbers, got {values!r}.")
    values = jnp.atleast_1d(jnp.asarray(values, dtype=float))
    if values.ndim > 1:
        raise ValueError(f"The values of the parameter are a row (m,), got the shape {values.shape}.")
    groups = _Groups(getattr(system, "mode_groups", {})) if is_straight else None
    return values, motion, None if states is None else as_names(states), groups


def _parameter(system: System, motion: Any) -> str:
    """What varies along a family, as a label: the name of the second argument of `motion`, and its unit."""
    if motion is straight_ahead:
        return "forward speed [m/s]"
    names = [] if isinstance(motion, _OneMotion) else list(inspect.signature(motion).parameters)
    if len(names) < 2:
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
    order, clear = track_modes(values, spectra, names[0], groups)
    rows = jnp.arange(len(values))[:, None]
    tracked = Eig(
        spectra.values[rows, order],
        spectra.vectors[rows, :, order].swapaxes(1, 2),
        spectra.left[rows, :, order].swapaxes(1, 2),
        spectra.condition[rows, order],
    )
    return tracked, names[0], clear
