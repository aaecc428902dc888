"""Nonlinear programs: minimize a function of many variables with constraints.

Each function is a sum of blocks. A block is a small function that is evaluated at many places, such as the equations of
motion at the nodes of a mesh. Its Jacobian and its Hessian are therefore small matrices, evaluated in one batch, of
which only the entries that may differ from zero are kept.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jax.typing import DTypeLike
from jaxtyping import Array, PyTree

from .._scalarjit.cache import Cache
from .._scalarjit.cache_key import jit, kept
from .._scalarjit.compat import on_device
from .._scalarjit.components import Numbers
from .._scalarjit.jaxpr import patterns

BlockFunction = Callable[[Any, Array], Array]

Sparse: TypeAlias = Any
"""A sparse matrix of SciPy, for which its types are incomplete."""


class Block(NamedTuple):
    """A function that is evaluated at B places.

    - `function`: (data of a place, x (n,)) -> values (m,); an `eqx.Module`, whose arrays are not differentiated.
    - `data`: a tree of arrays with a leading axis B.
    - `columns` (B, n): the indices of the variables that are the `x` of each place.
    - `size`: the number m of values.
    """

    function: Any
    data: Any
    columns: np.ndarray
    size: int


@dataclasses.dataclass(frozen=True)
class Pattern:
    """Entries that may differ from zero: of the Jacobian (m, n), and of the lower triangle of the Hessian (n, n).

    A dataclass, because it is one static argument of a compiled program.
    """

    rows: tuple[int, ...]
    columns: tuple[int, ...]
    hessian_rows: tuple[int, ...]
    hessian_columns: tuple[int, ...]


_PATTERNS = Cache()


def _pattern(function: BlockFunction, data: PyTree[Array], x: Array) -> Pattern:
    leaves, structure = jax.tree.flatten(data)

    def f(x: Array, *leaves: Any) -> Array:
        return function(jax.tree.unflatten(structure, leaves), x)

    first, second = patterns(f, [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in (x, *leaves)], 0)
    places = (*np.nonzero(first), *np.nonzero(np.tril(second)))
    return Pattern(*(tuple(i.tolist()) for i in places))


def padded(x: Numbers) -> np.ndarray:
    """Rows up to the next power of two: the last one is repeated. Other sizes then use the same compiled program."""
    x = np.asarray(x)
    more = (1 << max(0, (len(x) - 1).bit_length())) - len(x)
    return np.concatenate([x, np.repeat(x[-1:], more, axis=0)]) if more else x


class EvaluatedBlock:
    """A block with its pattern, and its values and derivatives at all places."""

    def __init__(self, block: Block, dtype: DTypeLike = jnp.float64):
        self.block, (self.B, n) = block, block.columns.shape
        # `padded` would hide another number of places: 27 samples were compared with those of 20 others.
        assert all(len(x) == self.B for x in jax.tree.leaves(block.data)), "The data have another number of places."
        self.data = jax.tree.map(lambda x: on_device(padded(x)), block.data)
        self.columns = padded(block.columns)
        one = jax.tree.map(lambda x: on_device(np.asarray(x)[0]), block.data), on_device(np.zeros(n, dtype))
        self.pattern = kept(_PATTERNS, (block.function, *one), lambda: _pattern(block.function, *one))

    def values(self, x: np.ndarray) -> np.ndarray:
        """Values (B, m)."""
        return np.asarray(_values(self.block.function, self.data, x[self.columns]))[: self.B]

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """The entries (B, e) of the pattern of the Jacobian."""
        return np.asarray(_jacobian(self.block.function, self.pattern, self.data, x[self.columns]))[: self.B]

    def hessian(self, x: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """The entries (B, e) of the Hessian of the values weighted by `weights` (B, m)."""
        if not self.pattern.hessian_rows:
            return np.zeros((self.B, 0))
        rows = np.zeros((len(self.columns), self.block.size))
        rows[: self.B] = weights
        entries = _hessian(self.block.function, self.pattern, self.data, x[self.columns], rows)
        return np.asarray(entries)[: self.B]

    def along(self, x: np.ndarray, weights: np.ndarray, tangents: Any) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives along p changes of the arrays of the function: of the values (B, p, m), and of the gradient
        (B, p, n) of the values weighted by `weights` (B, m). `tangents`: the arrays with a leading axis p."""
        found = _along(self.block.function, tangents, self.data, x[self.columns], padded(weights))
        return tuple(np.asarray(a)[: self.B] for a in found)  # type: ignore[return-value]


@jit
def _along(function: BlockFunction, tangents: Any, data: PyTree[Array], X: Array, weights: Array) -> Any:
    arrays, rest = eqx.partition(function, eqx.is_inexact_array)

    def entries(data: PyTree[Array], x: Array, w: Array) -> Any:
        def both(arrays: Any) -> tuple[Array, Array]:
            values, pullback = jax.vjp(lambda x: eqx.combine(arrays, rest)(data, x), x)
            return values, pullback(w)[0]

        return jax.vmap(lambda tangent: jax.jvp(both, (arrays,), (tangent,))[1])(tangents)

    return jax.vmap(entries)(data, X, weights)


@jit
def _values(function: BlockFunction, data: PyTree[Array], X: Array) -> Array:
    return jax.vmap(function)(data, X)


@jit
def _jacobian(function: BlockFunction, pattern: Pattern, data: PyTree[Array], X: Array) -> Array:
    along = sorted({*pattern.columns})  # other columns are zero
    place = np.array([along.index(c) for c in pattern.columns], int)
    directions = np.eye(X.shape[1])[along]

    def entries(data: PyTree[Array], x: Array) -> Array:
        columns = jax.vmap(lambda v: jax.jvp(lambda x: function(data, x), (x,), (v,))[1])(directions)
        return columns[place, np.array(pattern.rows, int)]

    return jax.vmap(entries)(data, X) if along else jnp.zeros((X.shape[0], 0))


@jit
def _hessian(function: BlockFunction, pattern: Pattern, data: PyTree[Array], X: Array, weights: Array) -> Array:
    along = sorted({*pattern.hessian_columns})
    place = np.array([along.index(c) for c in pattern.hessian_columns], int)
    directions = np.eye(X.shape[1])[along]

    def entries(data: PyTree[Array], x: Array, w: Array) -> Array:
        slope = jax.grad(lambda x: jnp.vdot(w, function(data, x)))
        columns = jax.vmap(lambda v: jax.jvp(slope, (x,), (v,))[1])(directions)
        return columns[place, np.array(pattern.hessian_rows, int)]

    return jax.vmap(entries)(data, X, weights)


class Bounds(NamedTuple):
    """Lower and upper bounds (n,), infinite without a bound."""

    lower: np.ndarray
    upper: np.ndarray


class NonlinearProgram:
    """Minimize f(x) with bounds on x and on g(x):

        f = sum_b w_b . G_b(x),  g = A x + sum_b S_b G_b(x)

    G_b are the values of block b at all its places. Solvers see scaled numbers: x / x_scale, g / g_scale, f / f_scale.

    **Arguments:**

    - `blocks`: the blocks.
    - `weights`: for each block, the factors w_b (B m,) of its values in the cost, or None.
    - `constraints`: for each block, the sparse matrix S_b (n_g, B m) of its values in the constraints, or None.
    - `linear`: the sparse matrix A (n_g, n).
    - `x_bounds`, `g_bounds`: bounds of the variables (n,) and of the constraints (n_g,).
    - `x_scale` (n,), `g_scale` (n_g,), `f_scale`: typical sizes.
    """

    def __init__(
        self,
        blocks: Sequence[EvaluatedBlock],
        weights: Sequence[np.ndarray | None],
        constraints: Sequence[Any],
        linear: Sparse,
        x_bounds: Bounds,
        g_bounds: Bounds,
        x_scale: np.ndarray,
        g_scale: np.ndarray,
        f_scale: float = 1.0,
    ):
        self.m, self.n = linear.shape
        self.x_scale, self.g_scale, self.f_scale = x_scale, g_scale, f_scale
        # bounds (n,) and (n_g,) of the scaled variables and constraints
        self.lower, self.upper = x_bounds.lower / x_scale, x_bounds.upper / x_scale
        self.g_lower, self.g_upper = g_bounds.lower / g_scale, g_bounds.upper / g_scale
        self.is_implied = np.zeros(self.m, bool)  # constraints that follow from the others: IPOPT does not get them
        self.places = np.zeros(self.n)  # of the variables in time, to order matrices
        self.slope = np.zeros(self.n)  # a linear part of the scaled cost
        self._blocks = list(blocks)
        sizes = [b.B * b.block.size for b in self._blocks]
        for k, w, S in zip(sizes, weights, constraints, strict=True):
            assert w is None or len(w) == k, "The weights have another number of values than their block."
            assert S is None or S.shape == (self.m, k), "The constraints have another shape than their block."
        self._weights = [np.zeros(k) if w is None else w for k, w in zip(sizes, weights, strict=True)]
        of_blocks = zip(sizes, constraints, strict=True)
        self._S = [scipy.sparse.csr_matrix((self.m, k) if S is None else S) for k, S in of_blocks]
        self._A: Any = scipy.sparse.csr_matrix(linear)
        self._memory: dict[Callable[..., Any], tuple[bytes, list[np.ndarray]]] = {}
        self._map_jacobian()
        self._map_hessian()

    def _map_jacobian(self) -> None:
        """Each entry of the Jacobian of g, and of the gradient of f, is a sum of entries of the blocks."""
        A, total = scipy.sparse.coo_matrix(self._A), 0
        rows, columns, sources, factors = [A.row], [A.col], [], []
        self._gradient_maps = []
        for b, S, w in zip(self._blocks, self._S, self._weights, strict=True):
            n = b.B * len(b.pattern.rows)
            entry_rows = (np.arange(b.B)[:, None] * b.block.size + np.array(b.pattern.rows, int)).ravel()
            entry_columns = b.columns[: b.B][:, np.array(b.pattern.columns, int)].ravel()
            picks = scipy.sparse.csr_matrix((np.ones(n), (entry_rows, np.arange(n))), (b.B * b.block.size, n))
            used = scipy.sparse.coo_matrix(S @ picks)
            rows.append(used.row)
            columns.append(entry_columns[used.col])
            sources.append(used.col + total)
            factors.append(used.data)
            gradient = scipy.sparse.csr_matrix((w[entry_rows], (entry_columns, np.arange(n))), (self.n, n))
            self._gradient_maps.append(gradient)
            total += n
        row, column = np.concatenate(rows).astype(np.int64), np.concatenate(columns).astype(np.int64)
        keys, inverse = np.unique(column * self.m + row, return_inverse=True)
        self.jacobian_structure = (keys % self.m if self.m else keys), (keys // self.m if self.m else keys)
        scale = self.x_scale[self.jacobian_structure[1]] / self.g_scale[self.jacobian_structure[0]]
        k = len(A.row)
        self._jacobian_constant = np.bincount(inverse[:k], A.data, minlength=len(keys)) * scale
        self._jacobian_map = scipy.sparse.csr_matrix(
            (np.concatenate([*factors, []]) * scale[inverse[k:]], (inverse[k:], np.concatenate([*sources, []]))),
            (len(keys), total),
        )

    def _map_hessian(self) -> None:
        """Each entry of the lower triangle of the Hessian is a sum of entries of the blocks."""
        triangles = [np.array([b.pattern.hessian_rows, b.pattern.hessian_columns], int) for b in self._blocks]
        pairs = [b.columns[: b.B][:, x] for b, x in zip(self._blocks, triangles, strict=True)]  # (B, 2, entries)
        row, column = (
            np.concatenate([*(f(p, axis=1).ravel() for p in pairs), []]).astype(np.int64) for f in (np.max, np.min)
        )
        keys, inverse = np.unique(column * self.n + row, return_inverse=True)
        self.hessian_structure = keys % self.n, keys // self.n
        scale = self.x_scale[self.hessian_structure[0]] * self.x_scale[self.hessian_structure[1]]
        self._hessian_map = scipy.sparse.csr_matrix(
            (scale[inverse], (inverse, np.arange(len(row)))), (len(keys), len(row))
        )

    def objective(self, z: np.ndarray) -> float:
        """The scaled cost at scaled variables."""
        values = self._remembered(EvaluatedBlock.values, z)
        with np.errstate(invalid="ignore"):  # the solver tries shorter steps if the cost is infinite
            f = sum(w @ v.ravel() for w, v in zip(self._weights, values, strict=True)) / self.f_scale
        return float(f + np.sum(self.slope * z))  # `@` would start the threads of BLAS, for 0.2 of 0.5 s

    def gradient(self, z: np.ndarray, blocks: Sequence[int] | None = None) -> np.ndarray:
        """The derivatives (n,) of `objective`, or of the part of it that some blocks have."""
        entries = self._remembered(EvaluatedBlock.jacobian, z)
        total = np.zeros(self.n)
        for i in range(len(self._blocks)) if blocks is None else blocks:
            total += self._gradient_maps[i] @ entries[i].ravel()
        return total * self.x_scale / self.f_scale + self.slope

    def elastic(self, weights: np.ndarray) -> NonlinearProgram:
        """The program of the least violation: minimize weights . (a + b), with g + a - b instead of g, a >= 0, b >= 0.

        The variables are those of this program, then a (n_g,) and b (n_g,). The bounds of the variables hold.
        """
        D, none = scipy.sparse.diags_array(self.g_scale), np.zeros(2 * self.m)
        new = NonlinearProgram(
            self._blocks,
            [None] * len(self._blocks),
            self._S,
            scipy.sparse.hstack([self._A, D, -D]),
            Bounds(np.append(self.lower * self.x_scale, none), np.append(self.upper * self.x_scale, none + np.inf)),
            Bounds(self.g_lower * self.g_scale, self.g_upper * self.g_scale),
            np.append(self.x_scale, none + 1.0),
            self.g_scale,
        )
        new.slope, new.is_implied = np.concatenate([np.zeros(self.n), weights, weights]), self.is_implied
        return new

    def constraints(self, z: np.ndarray) -> np.ndarray:
        """The scaled constraints (n_g,)."""
        g = self._A @ (z * self.x_scale)
        for S, v in zip(self._S, self._remembered(EvaluatedBlock.values, z), strict=True):
            g = g + S @ v.ravel()
        return g / self.g_scale

    def jacobian(self, z: np.ndarray) -> np.ndarray:
        """The derivatives of `constraints`: the entries of `jacobian_structure`, by columns."""
        entries = self._remembered(EvaluatedBlock.jacobian, z)
        return self._jacobian_constant + self._jacobian_map @ np.concatenate([*(e.ravel() for e in entries), []])

    def hessian(self, z: np.ndarray, multipliers: np.ndarray, objective_factor: float = 1.0) -> np.ndarray:
        """The second derivatives of objective_factor * objective + multipliers . constraints: the entries of
        `hessian_structure`, in the lower triangle, by columns."""
        x, factors = z * self.x_scale, multipliers / self.g_scale
        parts = []
        for b, S, w in zip(self._blocks, self._S, self._weights, strict=True):
            weights = S.T @ factors + (objective_factor / self.f_scale) * w
            parts.append(b.hessian(x, weights.reshape(b.B, b.block.size)).ravel())
        return self._hessian_map @ np.concatenate([*parts, []])

    def jacobian_matrix(self, z: np.ndarray) -> Sparse:
        """The derivatives (n_g, n) of `constraints`."""
        return scipy.sparse.csr_matrix((self.jacobian(z), self.jacobian_structure), (self.m, self.n))

    def hessian_matrix(self, z: np.ndarray, multipliers: np.ndarray) -> Sparse:
        """The second derivatives (n, n) of objective + multipliers . constraints."""
        lower = scipy.sparse.csr_matrix((self.hessian(z, multipliers), self.hessian_structure), (self.n, self.n))
        return (lower + scipy.sparse.tril(lower, -1).T).tocsr()

    def along(self, z: np.ndarray, multipliers: np.ndarray, tangents_of: Callable[[Any], Any]) -> list[Any]:
        """Derivatives along p changes of the arrays of the functions, with the tangents `tangents_of(function)`: of the
        Lagrangian, objective + multipliers . constraints, (p,), of its gradient (p, n), and of the constraints (p, m).
        """
        x, factors, parts = z * self.x_scale, multipliers / self.g_scale, []
        for b, S, w in zip(self._blocks, self._S, self._weights, strict=True):
            weights, columns = S.T @ factors + w / self.f_scale, b.columns[: b.B].ravel()
            values, slopes = b.along(x, weights.reshape(b.B, b.block.size), tangents_of(b.block.function))
            rows = np.moveaxis(values, 1, 0).reshape(values.shape[1], -1)
            gradient = [np.bincount(columns, s.ravel(), minlength=self.n) for s in np.moveaxis(slopes, 1, 0)]
            parts.append((rows @ weights, np.array(gradient) * self.x_scale, (S @ rows.T).T / self.g_scale))
        return [sum(part) for part in zip(*parts, strict=True)]

    def in_jax(self, z: Array) -> tuple[Array, Array]:
        """The scaled cost and constraints as one function of JAX, for tests of the derivatives."""
        x = z * self.x_scale
        cost, g = jnp.zeros(()), jnp.asarray(self._A.toarray()) @ x
        for b, S, w in zip(self._blocks, self._S, self._weights, strict=True):
            data = jax.tree.map(lambda a, n=b.B: a[:n], b.data)
            values = jax.vmap(b.block.function)(data, x[b.columns[: b.B]]).ravel()
            cost, g = cost + jnp.asarray(w) @ values, g + jnp.asarray(S.toarray()) @ values
        return cost / self.f_scale, g / self.g_scale

    def violation(self, z: np.ndarray) -> float:
        """The largest scaled violation of constraints and bounds."""
        g = self.constraints(z)
        pairs = ((self.g_lower - g, g - self.g_upper), (self.lower - z, z - self.upper))
        return max(float(np.max(x, initial=0.0)) for pair in pairs for x in pair)

    def _remembered(self, evaluate: Callable[[Any, np.ndarray], np.ndarray], z: np.ndarray) -> list[np.ndarray]:
        # The results of all blocks. Solvers ask for the cost and for the constraints at the same point.
        key, known = z.tobytes(), self._memory.get(evaluate)
        if known is None or known[0] != key:
            x = z * self.x_scale
            known = self._memory[evaluate] = key, [evaluate(b, x) for b in self._blocks]
        return known[1]
