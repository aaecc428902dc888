"""The parameters that are columns of a regressor, and the matrix at one state. Knows the method; knows no data."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._description.parameters import declared, leaf_name
from ..._description.system import System
from ..._method.body_parts import UNITS, Bodies, Described, described
from ..._method.newton_euler import Carried, carried, columns_of, unbalanced, values_of
from ..._method.values import check_is_system
from ..._scalars.versions import compiled
from .._problem.leaves import find_leaves

Names = str | Callable[[Any], Any] | Sequence[str | Callable[[Any], Any]]


class Regressor(eqx.Module):
    """Kane's equations as a matrix times parameters: matrix @ values = forces, in the motion.

    - `matrix` (n, p): a row for each independent speed, a column for each parameter.
    - `values` (p,): the parameters as the system has them, in `units` (p).
    - `forces` (n,): generalized forces of all that is not in the matrix [N or N m, as the speeds have it].
    - `names` (p): "link2.m", "link2.mx", "link2.Izz", ...; `about`: by body, the point that its first moment and
        inertia are about. `speeds` (n).
    """

    matrix: Float[Array, "*batch n p"]
    values: Float[Array, "*batch p"]
    forces: Float[Array, "*batch n"]
    names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    about: tuple[tuple[str, str], ...] = eqx.field(static=True)
    speeds: tuple[str, ...] = eqx.field(static=True)

    def __repr__(self) -> str:
        about = "".join(f"; {body} about {point}" for body, point in self.about)
        return f"Regressor(shape={self.matrix.shape}: {', '.join(self.names)}{about})"


def values_by_name(system: System) -> tuple[str, ...]:
    """What a system's loads read by name: inputs, and states of the first order."""
    return (*system.inputs, *system.states)


class Chosen(eqx.Module):
    """What has columns: bodies of a system, and entries (leaf, place) of other parameters."""

    described: Described
    places: tuple[tuple[int, int], ...] = eqx.field(static=True)
    own_names: tuple[str, ...] = eqx.field(static=True)
    own_units: tuple[str, ...] = eqx.field(static=True)

    @property
    def system(self) -> System:
        return self.described.system

    @property
    def names(self) -> tuple[str, ...]:
        return (*(name for part in self.described.parts for name in part.names), *self.own_names)

    @property
    def units(self) -> tuple[str, ...]:
        return (*(UNITS[i] for part in self.described.parts for i in part.kind), *self.own_units)

    def of(self, system: System) -> Chosen:
        """The same of a system with other values."""
        return eqx.tree_at(lambda c: c.described.system, self, system)

    def values(self, t: Array, q: Array) -> Array:
        """The parameters themselves, which are the same at all times and coordinates."""
        n = len(self.system.speeds) + len(self.system.dependent_speeds)
        of_bodies = values_of(self.described, t, q, jnp.zeros(n, q.dtype))
        return jnp.concatenate([of_bodies, self.own().astype(q.dtype)])

    def own(self) -> Array:
        """Of the other parameters."""
        leaves = jax.tree.leaves(self.system)
        entries = [jnp.ravel(leaves[leaf])[place] for leaf, place in self.places]
        return jnp.stack(entries) if entries else jnp.zeros(0, jnp.result_type(float))

    def with_values(self, values: Array) -> System:
        """The system with other values of the other parameters."""
        leaves, structure = jax.tree.flatten(self.system)
        for i, (leaf, place) in enumerate(self.places):
            flat = jnp.ravel(leaves[leaf]).at[place].set(values[i].astype(leaves[leaf].dtype))
            leaves[leaf] = flat.reshape(leaves[leaf].shape)
        return jax.tree.unflatten(structure, leaves)

    def at(self, t: Array, q: Array, u: Array, inputs: Mapping[str, Array], u_dot: Array) -> Regressor:
        return self.carried_at(t, q, u, inputs, u_dot)[0]

    def carried_at(
        self, t: Array, q: Array, u: Array, inputs: Mapping[str, Array], u_dot: Array
    ) -> tuple[Regressor, Carried]:
        parts = self.described.parts
        now, own = carried(self.described, t, q, u, inputs, u_dot), self.own().astype(q.dtype)
        Y, values = columns_of(now, parts), self.values(t, q)
        along = lambda own: unbalanced(self.with_values(own), t, q, u, inputs, u_dot)  # noqa: E731
        if self.places:
            Y = jnp.concatenate([Y, jax.jacfwd(along)(own)], axis=1)
        # Y pi - tau = -(F_r + F*_r), at any accelerations
        forces = Y @ values - along(own)
        about = tuple((part.name, part.about) for part in parts)
        return Regressor(Y, values, forces, self.names, self.units, about, self.system.speeds), now


def chosen_of(system: System, bodies: Bodies, parameters: Names) -> Chosen:
    """**Raises:** `ValueError` for names that are none, or given twice."""
    check_is_system(system)
    parameters = (parameters,) if isinstance(parameters, str) or callable(parameters) else tuple(parameters)
    places, names, units = [], [], []
    for where in parameters:
        chosen, leaves = find_leaves(system, where)
        for i in chosen:
            path, leaf = leaves[i]
            for place, index in enumerate(np.ndindex(leaf.shape)):
                places.append((i, place))
                names.append(leaf_name(path) + (str(list(index)) if leaf.ndim else ""))
                units.append(declared(system, path).unit)
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"`parameters` names {', '.join(twice)} twice.")
    found = Chosen(described(system, bodies), tuple(places), tuple(names), tuple(units))
    if not found.names:
        raise ValueError(f"{type(system).__name__}: no body with a mass is named in `bodies`, and no `parameters`.")
    return found


@compiled
def regressor_at(chosen: Chosen, t, q, u, inputs, u_dot):
    return chosen.carried_at(t, q, u, inputs, u_dot)
