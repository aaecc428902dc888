"""Whether the equations of motion are linear in parameters, found at a trial state. Knows no data."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from ..._common.memory import Memory
from ..._description.parameters import leaf_name
from ..._description.system import System
from ..._method.body_parts import described
from ..._method.trial_numbers import structure_of, with_trial_numbers
from ..._scalars.jax_internals import concretely
from .columns import Chosen, regressor_at, values_by_name

# ---- whether the equations are linear in what was chosen


_CHECKED = Memory()  # structures, with what is chosen


def check_linear(chosen: Chosen, t: Any, q: Any) -> None:
    """Refuse what would make tau or Y depend on the parameters themselves; once for each structure and choice."""
    key = (structure_of(chosen.system), chosen.described.parts, chosen.places)
    if key in _CHECKED:
        return
    # What is differentiated alone has a value; what is traced has none.
    value = lambda x: jax.lax.stop_gradient(x) if isinstance(x, Tracer) else x  # noqa: E731
    system, t, q = jax.tree.map(value, (chosen.system, t, q))
    with concretely():
        if _Linearity(chosen, system, t, q).check():
            _CHECKED[key] = None


class _Linearity:
    """The equations at a trial state, with other values of one parameter after another."""

    def __init__(self, chosen: Chosen, system: System, t: Any, q: Any):
        rng = np.random.default_rng(0)
        self.system, t, q = with_trial_numbers((system, t, q), rng)
        self.name = type(system).__name__
        # Of the bodies that are named every parameter: what is known of them moves with the others.
        every = described(system, [part.name for part in chosen.described.parts])
        self.chosen = eqx.tree_at(lambda c: c.described, chosen, every)
        self.chosen_columns = np.array([name in chosen.names for name in self.chosen.names], bool)
        self.of_bodies = np.arange(len(self.chosen_columns)) < len(self.chosen_columns) - len(chosen.places)
        dtype = q.dtype
        q = (np.nan_to_num(q) + rng.uniform(-0.1, 0.1, q.shape)).astype(dtype)  # beside what is often zero
        n = len(system.speeds)
        rows = [jnp.asarray(rng.uniform(0.5, 1.5, n) * rng.choice((-1.0, 1.0), n), dtype) for _ in range(2)]
        inputs = {name: jnp.asarray(0.7, dtype) for name in values_by_name(system)}
        self.state = jnp.asarray(t, dtype), jnp.asarray(q), rows[0], inputs, rows[1]
        self.tolerance = float(jnp.finfo(dtype).eps) ** 0.5

    def read(self, system: System) -> tuple[dict[str, np.ndarray], np.ndarray]:
        found, now = jax.device_get(regressor_at(self.chosen.of(system), *self.state))
        Y, values = found.matrix, found.values
        known = ~self.chosen_columns
        pieces = {
            "Y": Y,
            "tau": found.forces,
            "pi": values[self.of_bodies],
            "own": values[self.chosen_columns & self.of_bodies],
            "right": found.forces - Y[:, known] @ values[known],
            "of bodies": Y[:, self.of_bodies],
            "moving": np.concatenate([x.ravel() for x in (now.V, now.W, now.a, now.alpha, now.omega)]),
        }
        return pieces, now.g

    def check(self) -> bool:
        """**Returns:** whether there were finite numbers to judge by."""
        now, g = self.read(self.system)
        if not all(np.all(np.isfinite(x)) for x in now.values()):
            return False
        self._check_weights(g)
        for path, is_own, changes in self._changes(now):
            if is_own:
                self._judge_own(leaf_name(path), changes)
            elif "pi" in changes and "moving" not in changes:
                self._judge_of_body(leaf_name(path), changes)
        return True

    def _changes(self, now: Mapping[str, np.ndarray]) -> Iterator[tuple[Any, bool, set[str]]]:
        """What changes with each number of the system; those of the other parameters first."""
        with_path, structure = jax.tree_util.tree_flatten_with_path(self.system)
        leaves = [leaf for _, leaf in with_path]
        size = np.abs(now["Y"]).max() + np.abs(now["tau"]).max()
        own = list(self.chosen.places)
        others = [(i, place) for i, leaf in enumerate(leaves) for place in range(np.size(leaf))]
        for i, place in [*own, *(each for each in others if each not in own)]:
            path, leaf = with_path[i]
            moved = np.array(leaf)
            moved.flat[place] = 1.3 * moved.flat[place] + (0.1 if moved.flat[place] >= 0 else -0.1)
            other = [*leaves[:i], jnp.asarray(moved), *leaves[i + 1 :]]
            then, _ = self.read(jax.tree.unflatten(structure, other))
            changes = {k for k in now if self._differs(then[k], now[k], size if k in ("tau", "right") else 0.0)}
            yield path, (i, place) in own, changes | ({"mass"} if i in self.chosen.described.leaves else set())

    def _differs(self, x: np.ndarray, y: np.ndarray, size: float) -> bool:
        """Whether a number, or a column of a matrix, has changed by more than rounding."""
        if not x.size:
            return False
        own = np.abs(y).max(axis=0) if y.ndim == 2 else np.abs(y)
        size = np.maximum(size, own + 1e-6 * np.abs(y).max())
        return not bool(np.all(np.abs(x - y) <= self.tolerance * size))

    def _judge_own(self, parameter: str, changes: set[str]) -> None:
        if "own" in changes:
            raise ValueError(
                f"{self.name}: {parameter} belongs to a body that has columns of its own: leave it out of "
                "`parameters`, or the body out of `bodies`."
            )
        if changes & {"Y", "right"}:
            raise ValueError(
                f"{self.name}: the equations of motion are not linear in {parameter} (beside the other columns): with "
                "another value its column, or what is left on the right side, changes. A product of two parameters, as "
                "of a stiffness and the angle at rest, is linear in one of them alone."
            )

    def _judge_of_body(self, parameter: str, changes: set[str]) -> None:
        if "of bodies" in changes:
            raise ValueError(
                f"{self.name}: with another {parameter}, which moves no point but a mass centre, the weight by mass "
                "changes: a gravity that is not uniform is not linear in a body's first moment. Leave the body out of "
                "`bodies`."
            )
        # The right side may depend on lengths as it may, but on no mass.
        if "mass" not in changes or not changes & {"Y", "tau"}:
            return
        raise ValueError(
            f"{self.name}: {parameter} changes the parameters of a body, and loads beside them that are no weight at "
            "the body's mass centre: the right side would depend on what is to be found. Write weights as "
            "jk.weight(motion, gravity), give other loads, as friction that grows with the mass, parameters of their "
            "own, or leave the body out of `bodies`."
        )

    def _check_weights(self, g: np.ndarray) -> None:
        """A weight that is written as a number, of a mass that is one too, cannot be distinguished from other loads."""
        weightless = ~np.any(g != 0, axis=1)
        lone = [part.name for part, none in zip(self.chosen.described.parts, weightless, strict=True)
                if none and part.has_number]  # fmt: skip
        if lone and not weightless.all():
            raise ValueError(
                f"{self.name}: other bodies have a weight, and for {', '.join(lone)}, whose mass is a number in the "
                "description, none is found: write jk.weight(motion, gravity), or leave it out of `bodies`."
            )
