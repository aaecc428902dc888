"""Rigid bodies with a positive-definite pseudo-inertia: the declaration `Inertia`, and its bijection."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from ..._common.lookup import as_names, not_there, refuse_unknown
from ..._kane.description import DescriptionEvaluator
from ..._kane.regressor import origin_of
from ..._scalarjit.cache_key import jit
from ..._system.parameters import leaf_name
from ..._system.system import System
from .declarations import Declaration, Part, one_leaf
from .parameters import Bijection, Entry, Prior, checked_prior, gaussian_constant


class PossibleBody(Bijection):
    """Mass, mass centre and central inertia of a rigid body with a positive-definite pseudo-inertia.

        m = exp(2 a),   c = t,   Sigma = m S S^T,   I = tr(Sigma) 1 - Sigma

    with S upper triangular and a positive diagonal exp(d): the logarithmic Cholesky factors of the pseudo-inertia
    (Rucker and Wensing, Smooth parameterization of rigid-body inertia, IEEE Robotics and Automation Letters, 2022).
    Sigma is the matrix of central second moments. It is positive definite if every principal moment of inertia is less
    than the sum of the two others. Factors that are zero or equal by symmetry are not variables.

    The values are the free entries of [m, cx, cy, cz, Ixx, Iyy, Izz, Ixy, Ixz, Iyz], with products as matrix entries.
    For a wheel with equal moments about x and z, Izz is not a value.
    """

    start: Float[Array, " 10"]  # [a, t1, t2, t3, d1, d2, d3, s12, s13, s23]
    scale: Float[Array, " 10"]
    moves: tuple[int, ...] = eqx.field(static=True)  # indices of the free values
    wheel: tuple[int, int] | None = eqx.field(static=True)  # the two axes that are equal

    @classmethod
    def of(cls, values: ArrayLike, moves: tuple[int, ...], wheel: tuple[int, int] | None = None) -> PossibleBody:
        """The bijection for all ten values. **Raises:** `ValueError` if they are not physically possible."""
        values = np.asarray(values, float)
        start = np.asarray(_factors(jnp.asarray(values)))
        if not np.all(np.isfinite(start)):
            xx, yy, zz, xy, xz, yz = values[4:]
            I = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            moments = ", ".join(f"{x:.5g}" for x in np.linalg.eigvalsh(I)) if np.all(np.isfinite(I)) else "not finite"
            raise ValueError(
                f"mass {values[0]:.5g} kg with principal moments of inertia {moments} kg m^2 is not physically "
                "possible. Each moment must be less than the sum of the other two. Change the values so that this "
                "holds with a margin of about one per cent."
            )
        size = float(np.exp(2 * start[4:7]).sum() ** 0.5)  # a length: radius of gyration
        place = np.where(values[1:4] != 0, np.abs(values[1:4]), size)
        scale = np.concatenate([[0.5], place, [0.5] * 3, [size / 2] * 3])
        dtype = jnp.result_type(float)
        return cls(jnp.asarray(start, dtype), jnp.asarray(scale, dtype), moves, wheel)

    @property
    def size(self) -> int:
        return len(self.moves)

    def __call__(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        values = self.all_values(self.factors(x))
        return jnp.stack([values[i] for i in self.moves])

    def factors(self, x: Float[Array, " n"]) -> Float[Array, " 10"]:
        """All ten factors, [a, t1, t2, t3, d1, d2, d3, s12, s13, s23]."""
        factors = [*self.start]
        for i, step in zip(self.moves, x, strict=True):
            factors[i] = factors[i] + self.scale[i] * step
        if self.wheel:
            a, b = self.wheel
            factors[4 + b] = factors[4 + a]
        return jnp.stack(factors)

    def inverse(self, values: Float[Array, " n"]) -> Float[Array, " n"]:
        full = self.all_values(self.start).at[np.array(self.moves)].set(values)
        if self.wheel:
            a, b = self.wheel
            full = full.at[4 + b].set(full[4 + a])
        return ((_factors(full) - self.start) / self.scale)[np.array(self.moves)]

    def log_prior_constants(self, mean: np.ndarray, deviation: np.ndarray) -> np.ndarray:
        """The constants as in `Interval`; NaN for a value without a prior.

        The Gaussians are truncated to physically possible bodies. The remaining probability is estimated from random
        samples, with an error of about one per cent.
        """
        if not np.all(np.isfinite(deviation)):
            return np.where(np.isfinite(deviation), 0.0, np.nan)
        # The same samples in every call: two models with the same prior must get the same constant.
        draws = np.random.default_rng(0).normal(mean, deviation, (10_000, len(mean)))
        x = jax.vmap(self.inverse)(jnp.asarray(draws, self.start.dtype))
        share = np.mean(np.all(np.isfinite(np.asarray(x)), axis=1))
        constants = gaussian_constant(deviation)
        constants[0] -= np.log(share) if share > 0 else np.nan
        return constants

    @staticmethod
    def all_values(factors: Float[Array, " 10"]) -> Float[Array, " 10"]:
        """[m, c, Ixx, Iyy, Izz, Ixy, Ixz, Iyz] from all ten factors."""
        m = jnp.exp(2 * factors[0])
        d1, d2, d3 = jnp.exp(factors[4:7])
        s12, s13, s23 = factors[7:]
        xx, yy, zz = d1**2 + s12**2 + s13**2, d2**2 + s23**2, d3**2
        xy, xz, yz = s12 * d2 + s13 * s23, s13 * d3, s23 * d3
        return jnp.concatenate([m[None], factors[1:4], m * jnp.stack([yy + zz, xx + zz, xx + yy, -xy, -xz, -yz])])


@jax.jit
def _factors(values: Float[Array, " 10"]) -> Float[Array, " 10"]:
    """The inverse of `all_values`; NaN if the values are not physically possible."""
    m, (Ixx, Iyy, Izz, Ixy, Ixz, Iyz) = values[0], values[4:]
    half = 0.5 * (Ixx + Iyy + Izz)  # tr Sigma
    xx, yy, zz, xy, xz, yz = (x / m for x in (half - Ixx, half - Iyy, half - Izz, -Ixy, -Ixz, -Iyz))
    # Sigma / m = S S^T with S upper triangular, solved from the last row upwards.
    d3 = jnp.sqrt(zz)
    s13, s23 = xz / d3, yz / d3
    d2 = jnp.sqrt(yy - s23**2)
    s12 = (xy - s13 * s23) / d2
    d1 = jnp.sqrt(xx - s12**2 - s13**2)
    return jnp.stack([0.5 * jnp.log(m), *values[1:4], jnp.log(d1), jnp.log(d2), jnp.log(d3), s12, s13, s23])


@dataclasses.dataclass(frozen=True)
class Inertia(Declaration):
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
        inertias, slopes = jax.device_get(_inertias_and_slopes(system))
        if body not in inertias:
            raise not_there(body, inertias, f"the bodies of {type(system).__name__} that have a mass and a frame")
        with_path, _ = jax.tree_util.tree_flatten_with_path(system)
        values, slopes = inertias[body], jax.tree.leaves(slopes[body])
        owners = [_owner(values[i], slopes, i, with_path) for i in range(10)]
        parameters = [None if owner is None or owner[1] else owner[0] for owner in owners]
        kept: dict[str, Any] = {"mass": parameters[0], "center": tuple(parameters[1:4])}
        matrices = {owner[0] if owner and owner[1] == (3, 3) else "" for owner in owners[4:]}
        if len(matrices) == 1 and "" not in matrices:
            return cls(matrix=matrices.pop(), **kept, **more)
        missing = [n for i, n in enumerate(_NAMES) if i > 3 and parameters[i] is None and (i < 7 or values[i] != 0.0)]
        if missing:
            raise ValueError(
                f"{type(system).__name__}: {', '.join(missing)} of {body!r} are not separate parameters of the system. "
                "Free the parameters on which they depend by name."
            )
        moments, products = tuple(parameters[4:7]), tuple(parameters[7:])
        return cls(moments, products, **kept, **more)  # type: ignore[arg-type]

    def parts(
        self, system: System, noise: Mapping[str, float] | None = None, channels: Sequence[str] = ()
    ) -> list[Part]:
        if (self.matrix is None) == (self.moments is None):
            raise ValueError("Inertia: pass `moments` (and `products`) or `matrix`, but not both.")
        for what in ("center", "moments", "products"):
            three = getattr(self, what)
            if three is not None and (isinstance(three, str) or len(three) != 3):
                raise ValueError(f"Inertia: `{what}` must be three names, got {three!r}.")
        moments, wheel, pairs = self.moments or (), None, ((0, 1), (0, 2), (1, 2))
        names = [self.mass, *self.center, *moments, *(self.products if moments else ())]
        spots: list[Any] = [None if name is None else (one_leaf(system, name), (0,)) for name in names]
        if self.matrix is not None:
            leaf = one_leaf(system, self.matrix, (3, 3))
            for a, b in ((0, 0), (1, 1), (2, 2), *pairs):
                names.append(f"{self.matrix}[{a}, {b}]")
                spots.append((leaf, tuple({3 * a + b, 3 * b + a})))
        elif len(set(moments)) < 3:
            wheel = next((a, b) for a, b in pairs if moments[a] == moments[b])
        number = sum(name is not None for name in self.products)
        if moments and (number == 2 or (number and wheel)):
            raise ValueError(
                f"Inertia: `products` = {self.products} does not match `moments` = {moments}. Name all three products, "
                "or one for a body with a plane of symmetry, or none for principal axes, such as those of a wheel."
            )
        fixed = as_names(self.fixed, "fixed")
        refuse_unknown(self.prior, filter(None, names), "Inertia: `prior` contains unknown names:", "the names are")
        refuse_unknown(fixed, filter(None, names[:4]), "Inertia: `fixed` contains", "it may contain only")
        leaves = jax.tree.leaves(system)
        values = [0.0 if s is None else float(np.ravel(leaves[s[0]])[s[1][0]]) for s in spots]
        values[0] = values[0] if spots[0] is not None else 1.0
        still = {i for i in range(4) if names[i] is None or names[i] in fixed} | ({4 + wheel[1]} if wheel else set())
        moves = tuple(i for i in range(10) if spots[i] is not None and i not in still)
        try:
            body = PossibleBody.of(values, moves, wheel)
        except ValueError as error:
            raise ValueError(f"Inertia of {', '.join(n for n in names[4:7] if n)}: {error}") from None
        units, largest = ["kg", "m", "m", "m", *[self.unit] * 6], max(values[4:7])
        part = Part([], body, [], [], [])
        for i in moves:
            name, (leaf, places) = str(names[i]), spots[i]
            part.entries.append(Entry(name, units[i], tuple((leaf, place, 1.0) for place in places)))
            part.start.append(values[i])
            part.scale.append(abs(values[i]) or (float(body.scale[i]) if i < 4 else largest))
            part.priors.append(checked_prior(name, self.prior[name]) if name in self.prior else None)
        return [part]


_NAMES = ("m", "cx", "cy", "cz", "Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz")


@jit
def _inertias_and_slopes(system: System) -> tuple[dict[str, Array], dict[str, Any]]:
    """By body, ten numbers: mass, components of the last offset to the mass centre, and central inertia; and their
    derivatives with respect to the parameters of the system."""

    def read(system: System):
        zero = jnp.zeros((), jnp.result_type(float))
        n_u = len(system.speeds) + len(system.dependent_speeds)
        q = tuple(zero + 0.3 for _ in system.coordinates)
        inertias = {}
        for body in DescriptionEvaluator(system).motion(zero + 0.2, q, (zero,) * n_u).bodies:
            if not body.is_particle:
                step = body.center._offset if origin_of(body)[1] else None
                r = (0.0, 0.0, 0.0) if step is None else step.components_in(body.frame)
                I = body.inertia
                row = [body.mass, *r, I[0][0], I[1][1], I[2][2], I[0][1], I[0][2], I[1][2]]
                inertias[body.name] = jnp.stack([jnp.asarray(x, zero.dtype) for x in row])
        return inertias

    return read(system), jax.jacfwd(read)(system)


def _owner(
    value: float, slopes: list[np.ndarray], i: int, with_path: Sequence[tuple[Any, Array]]
) -> tuple[str, tuple[int, ...]] | None:
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
