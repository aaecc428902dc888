"""The equations of motion as a matrix times the parameters of bodies, in which they are linear. Uses no data."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from ..._kane.api import InputValues
from ..._kane.arguments import as_array, check_is_system, check_time, checked_values, refuse_incomplete
from ..._kane.checks import check_system
from ..._kane.description import at_random_point, structure_of
from ..._kane.regressor import (
    UNITS,
    Bodies,
    RegressorKinematics,
    RegressorModel,
    parameter_values,
    regressor_columns,
    regressor_kinematics,
    regressor_model,
    unbalanced,
)
from ..._scalarjit.cache import Cache
from ..._scalarjit.cache_key import jit
from ..._scalarjit.compat import Tracer, concretely
from ..._scalarjit.components import Numbers
from ..._system.parameters import declared, leaf_name
from ..._system.system import System
from ..problem.declarations import find_leaves

Names = str | Callable[[Any], Any] | Sequence[str | Callable[[Any], Any]]


class Regressor(eqx.Module):
    """Kane's equations as a matrix times parameters. For a trajectory of the system, matrix @ values = forces.

    - `matrix` (n, p): one row per independent speed, one column per parameter.
    - `values` (p,): the parameters of the system.
    - `forces` (n,): generalized forces of all terms that are not in the matrix [N or N m, depending on the speed].
    - `names` (p): names of the parameters, such as "link2.m", "link2.mx", "link2.Izz".
    - `units` (p): their units.
    - `about`: by body, the point to which its first moment and inertia refer.
    - `speeds` (n): names of the independent speeds.
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


def input_names(system: System) -> tuple[str, ...]:
    """Names that a system's loads can read: inputs, and first-order states."""
    return (*system.inputs, *system.states)


class RegressorSpec(eqx.Module):
    """The parameters that have columns: those of bodies of a system, and entries (leaf, place) of other parameters."""

    model: RegressorModel
    places: tuple[tuple[int, int], ...] = eqx.field(static=True)
    own_names: tuple[str, ...] = eqx.field(static=True)
    own_units: tuple[str, ...] = eqx.field(static=True)

    @property
    def system(self) -> System:
        return self.model.system

    @property
    def names(self) -> tuple[str, ...]:
        return (*(name for part in self.model.bodies for name in part.names), *self.own_names)

    @property
    def units(self) -> tuple[str, ...]:
        return (*(UNITS[i] for part in self.model.bodies for i in part.indices), *self.own_units)

    def of(self, system: System) -> RegressorSpec:
        """The same specification for a system with other values."""
        return eqx.tree_at(lambda spec: spec.model.system, self, system)

    def own(self, dtype: DTypeLike) -> Array:
        """The values of the parameters that belong to no body."""
        leaves = jax.tree.leaves(self.system)
        entries = [jnp.ravel(leaves[leaf])[place].astype(dtype) for leaf, place in self.places]
        return jnp.stack(entries) if entries else jnp.zeros(0, dtype)

    def values(self, t: Array, q: Array) -> Array:
        """The values of the parameters. They do not depend on time and coordinates."""
        n = len(self.system.speeds) + len(self.system.dependent_speeds)
        return jnp.concatenate([parameter_values(self.model, t, q, jnp.zeros(n, q.dtype)), self.own(q.dtype)])

    def at(
        self, t: Array, q: Array, u: Array, inputs: Mapping[str, Array], u_dot: Array
    ) -> tuple[Regressor, RegressorKinematics]:
        parts, leaves, structure = self.model.bodies, *jax.tree.flatten(self.system)
        kinematics, own = regressor_kinematics(self.model, t, q, u, inputs, u_dot), self.own(q.dtype)
        Y, values = regressor_columns(kinematics, parts), self.values(t, q)

        def along(own: Float[Array, " k"]):
            changed = list(leaves)
            for x, (leaf, place) in zip(own, self.places, strict=True):
                flat = jnp.ravel(changed[leaf]).at[place].set(x.astype(changed[leaf].dtype))
                changed[leaf] = flat.reshape(changed[leaf].shape)
            return unbalanced(jax.tree.unflatten(structure, changed), t, q, u, inputs, u_dot)

        if self.places:
            Y = jnp.concatenate([Y, jax.jacfwd(along)(own)], axis=1)
        # Y pi - tau = -(F_r + F*_r), for any accelerations
        forces = jnp.dot(Y, values, precision="highest") - along(own)
        about = tuple((part.name, part.about) for part in parts)
        return Regressor(Y, values, forces, self.names, self.units, about, self.system.speeds), kinematics


def regressor_spec(system: System, bodies: Bodies, parameters: Names) -> RegressorSpec:
    """The specification from names.

    **Raises:** `ValueError` for names that do not exist or are passed twice.
    """
    check_is_system(system)
    parameters = (parameters,) if isinstance(parameters, str) or callable(parameters) else tuple(parameters)
    places, names, units = [], [], []
    for where in parameters:
        indices, leaves = find_leaves(system, where)
        for i in indices:
            path, leaf = leaves[i]
            for place, index in enumerate(np.ndindex(leaf.shape)):
                places.append((i, place))
                names.append(leaf_name(path) + (str(list(index)) if leaf.ndim else ""))
                units.append(declared(system, path).unit)
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"`parameters` contains {', '.join(twice)} more than once. Name each parameter once.")
    spec = RegressorSpec(regressor_model(system, bodies), tuple(places), tuple(names), tuple(units))
    if not spec.names:
        raise ValueError(
            f"{type(system).__name__}: `bodies` contains no body with a mass, and `parameters` is empty. Name a body "
            "or a parameter."
        )
    return spec


@jit
def regressor_at(
    spec: RegressorSpec,
    t: Float[Array, ""],
    q: Float[Array, " n_q"],
    u: Float[Array, " n_u"],
    inputs: Mapping[str, Array],
    u_dot: Float[Array, " n_u"],
):
    return spec.at(t, q, u, inputs, u_dot)


# ---- whether the equations are linear in the parameters that have columns


_CHECKED = Cache()  # structures and parameters with columns that have been checked


def check_linear(spec: RegressorSpec, t: Numbers, q: Numbers) -> None:
    """Reject systems where tau or Y depends on the parameters. Each structure and choice of parameters is checked only
    once.
    """
    key = (structure_of(spec.system), spec.model.bodies, spec.places)
    if _CHECKED.known(key, False):
        return

    # A value that is only differentiated can be made concrete with stop_gradient; a traced one cannot.
    at = jax.tree.map(lambda x: jax.lax.stop_gradient(x) if isinstance(x, Tracer) else x, (spec.system, t, q))
    with concretely():
        _CHECKED.keep(key, _is_checked(spec, *at))


def _is_checked(spec: RegressorSpec, system: System, t: Numbers, q: Numbers) -> bool:
    """Check all parameters at a random state by changing one number of the system after another.

    **Returns:** whether all numbers were finite, so that the check was possible.
    """
    rng = np.random.default_rng(0)
    system, t, q = at_random_point((system, t, q), rng)
    # Include all parameters of the named bodies, because the fixed ones may depend on the same numbers.
    every = eqx.tree_at(lambda s: s.model, spec, regressor_model(system, [part.name for part in spec.model.bodies]))
    has_column = np.array([name in spec.names for name in every.names], bool)
    of_bodies = np.arange(len(has_column)) < len(has_column) - len(spec.places)
    q = (np.nan_to_num(q) + rng.uniform(-0.1, 0.1, q.shape)).astype(q.dtype)  # avoid zero, a frequent special case
    n = len(system.speeds)
    u, u_dot = (jnp.asarray(rng.uniform(0.5, 1.5, n) * rng.choice((-1.0, 1.0), n), q.dtype) for _ in range(2))
    inputs = {name: jnp.asarray(0.7, q.dtype) for name in input_names(system)}
    state, tolerance = (jnp.asarray(t, q.dtype), jnp.asarray(q), u, inputs, u_dot), float(jnp.finfo(q.dtype).eps) ** 0.5

    def evaluate(system: System) -> tuple[dict[str, np.ndarray], np.ndarray]:
        equations, k = jax.device_get(regressor_at(every.of(system), *state))
        Y, values, tau = equations.matrix, equations.values, equations.forces
        pieces = {
            "Y": Y,
            "tau": tau,
            "pi": values[of_bodies],
            "own": values[has_column & of_bodies],
            "right": tau - Y[:, ~has_column] @ values[~has_column],
            "of bodies": Y[:, of_bodies],
            "moving": np.concatenate([x.ravel() for x in (k.V, k.W, k.a, k.alpha, k.omega)]),
        }
        return pieces, k.g

    def differs(x: np.ndarray, y: np.ndarray, size: float) -> bool:
        """Whether a number, or a column of a matrix, has changed by more than rounding errors."""
        own = np.abs(y).max(axis=0, initial=0.0) if y.ndim == 2 else np.abs(y)
        return bool(np.any(~(np.abs(x - y) <= tolerance * np.maximum(size, own + 1e-6 * np.abs(y).max(initial=0.0)))))

    pieces, g = evaluate(system)
    if not all(np.all(np.isfinite(x)) for x in pieces.values()):
        return False
    weightless = ~np.any(g != 0, axis=1)
    lone = [part.name for part, none in zip(spec.model.bodies, weightless, strict=True)
            if none and part.has_constant_mass]  # fmt: skip
    # The weight of a body whose mass is a plain number may also be one, like other loads.
    if lone and not weightless.all():
        raise ValueError(
            f"{type(system).__name__}: no weight was found for {', '.join(lone)}, whose mass is a constant in the "
            "code, although other bodies have a weight. Use jk.weight(motion, gravity), or omit the body from `bodies`."
        )
    with_path, structure = jax.tree_util.tree_flatten_with_path(system)
    leaves, size = [leaf for _, leaf in with_path], np.abs(pieces["Y"]).max() + np.abs(pieces["tau"]).max()
    places = [(i, place) for i, leaf in enumerate(leaves) for place in range(np.size(leaf))]
    for i, place in dict.fromkeys([*spec.places, *places]):  # numbers that belong to no body come first
        changed = np.array(leaves[i])
        changed.flat[place] = 1.3 * changed.flat[place] + (0.1 if changed.flat[place] >= 0 else -0.1)
        after, _ = evaluate(jax.tree.unflatten(structure, [*leaves[:i], jnp.asarray(changed), *leaves[i + 1 :]]))
        changes = {k for k, x in pieces.items() if differs(after[k], x, size * (k in ("tau", "right")))}
        parameter = leaf_name(with_path[i][0])
        refusals = iter(())
        if (i, place) in spec.places:
            refusals = _refusals_of_own(parameter, changes)
        elif "pi" in changes and "moving" not in changes:
            refusals = _refusals_of_body(parameter, changes, i in spec.model.leaves)
        for reason in refusals:
            raise ValueError(f"{type(system).__name__}: {reason}")
    return True


def _refusals_of_own(parameter: str, changes: set[str]) -> Iterator[str]:
    if "own" in changes:
        yield (
            f"{parameter} is a parameter of a body in `bodies`, for which there already are columns. Omit it from "
            "`parameters`, or omit the body from `bodies`."
        )
    if changes & {"Y", "right"}:
        yield (
            f"the equations of motion are not linear in {parameter}, because its column or the right-hand side changes "
            "with its value. If two parameters are multiplied, such as a stiffness and a rest angle, name only one of "
            "them."
        )


def _refusals_of_body(parameter: str, changes: set[str], changes_mass: bool) -> Iterator[str]:
    if "of bodies" in changes:
        yield (
            f"the weight per mass depends on {parameter}, a parameter of the position of a mass centre. If gravity is "
            "not uniform, the equations are not linear in the first moment of a body. Omit the body from `bodies`."
        )
    # The right side may depend on lengths, but not on masses.
    if changes_mass and changes & {"Y", "tau"}:
        yield (
            f"{parameter} changes the parameters of a body, and also loads other than its weight. The right-hand side "
            "would then depend on the unknown parameters. Write weights as jk.weight(motion, gravity). Use separate "
            "parameters for other loads, such as friction that is proportional to the mass, or omit the body from "
            "`bodies`."
        )


def regressor(
    system: System,
    t: ArrayLike,
    q: ArrayLike,
    u: ArrayLike,
    u_dot: ArrayLike,
    inputs: InputValues = None,
    *,
    bodies: Bodies = None,
    parameters: Names = (),
) -> Regressor:
    """The equations of motion as a matrix Y times the parameters pi of rigid bodies, in which they are linear.

        Y(t, q, u, u_dot) pi = tau

    A body has ten parameters: its mass `m`, its first moment `mx`, `my`, `mz` (mass times the position of the mass
    centre) and its inertia `Ixx`, `Iyy`, `Izz`, `Ixy`, `Ixz`, `Iyz` (products as matrix entries). They refer to the
    axes of its frame and to the point of its frame from which the mass centre was defined, such as a joint. Without
    such a point, they refer to the mass centre. Inertia and weight are in Y: Y pi = -F*_r - (weights). All other loads
    are in tau: torques, springs, friction, and the inertia and weight of bodies that are not named. (Atkeson, An and
    Hollerbach 1986; Khalil and Dombre 2002.)

    **Arguments:**

    - `system`, `t`, `q`, `u`, `inputs`: as in `equations_of_motion`.
    - `u_dot` (n,): rates of the independent speeds. They need not satisfy the equations of motion.
    - `bodies`: names of bodies whose parameters are columns, by default all bodies that have a mass. Or a dict with the
        parameters of each body that are columns, such as {"link2": ("m", "my", "Izz")}; its other parameters have the
        system's values. A particle has only its mass. An axisymmetric body that spins in its frame has its mass, the
        first moment along the axis, and two moments of inertia, along the axis and across it (`Iacross`).
    - `parameters`: names, paths or functions to leaves of other parameters in which the equations are linear, such as
        those of dampers, springs, dry friction and rotors. They also become columns, and their terms are not in tau.

    **Returns:** a `Regressor`, under `jax.vmap` with leading axes. It can be differentiated and traced. For a
    trajectory and the system's own values, Y pi - tau is zero. For other accelerations it is -(F_r + F*_r).

    **Raises:** `ValueError` in the cases of `equations_of_motion`; for names that do not exist; for a parameter in
    which the equations are not linear, or which belongs to a body that has columns; for loads that depend on the mass
    or inertia of a body and are not its weight at the mass centre, because tau would then depend on these parameters.
    """
    spec = regressor_spec(system, bodies, parameters)
    name = type(system).__name__
    refuse_incomplete(system, q, u)
    q = as_array(q, system.coordinates, f"{name}: q")
    u = as_array(u, system.speeds, f"{name}: u")
    u_dot = as_array(u_dot, system.speeds, f"{name}: u_dot").astype(q.dtype)
    check_time(name, t)
    t = jnp.asarray(t, q.dtype)
    checked_values(system, inputs)
    values = {name: jnp.asarray((inputs or {}).get(name, 0.0), q.dtype) for name in input_names(system)}
    check_system(system, t, q)
    check_linear(spec, t, q)
    return regressor_at(spec, t, q, u, values, u_dot)[0]
