"""Scale-free criteria: residuals relative to the size of their own terms, and ranks after equilibration.

A change of units multiplies residuals, coordinates and matrix entries by factors of 1e-9 to 1e9. An absolute tolerance
then accepts an open loop at micrometres and rejects a closed loop at kilometres. Depends on arrays only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, PyTree

from .._scalarjit.compat import Equation, Variable, evaluated, interpret, operation_of
from .._scalarjit.components import Numbers
from .._scalarjit.jaxpr import is_inexact, opened, program_of

SMALLEST_SIZE = 1e-9
"""The smallest size of a coordinate where a state is checked, in its unit. The terms of x = r y are zero at
x = y = 0, and rounding errors of 1e-16 there must not be reported as violations."""

# The size of the result is that of the largest operand.
_SUMS = frozenset("add add_any sub max min abs neg reduce_max reduce_min".split())
# The size of the result is the operation applied to the sizes of the operands. Booleans and indices are not replaced.
_SAME = frozenset(
    "mul sqrt square cbrt dot_general reduce_sum reduce_prod broadcast_in_dim concatenate convert_element_type copy "
    "copy_p dynamic_slice expand_dims gather pad reduce_precision reshape rev select_n slice split squeeze stack "
    "stop_gradient transpose unstack".split()
)
# The argument or the result has no unit, so that its size is 1: a direction cosine of zero has the rounding error of 1.
_OF_PURE_NUMBERS = frozenset(
    "sin cos tan sinh cosh tanh asin acos atan atan2 asinh acosh atanh exp exp2 expm1 log log1p logistic erf".split()
)


def term_sizes(f: Callable[..., Any], *args: Any, sizes: Sequence[Any] | None = None) -> PyTree:
    """The sizes of the terms that `f(*args)` adds, before they cancel: a tree of arrays, like the result.

    Each operation of f is evaluated with magnitudes: |x + y| becomes max(|x|, |y|), |x y| the product of both, sin and
    cos have at least the size 1. A change of units multiplies the size by the same factor as the terms. A sum of
    n terms can be n times its size.

    **Arguments:**

    - `f`: a JAX function of arrays and trees of arrays. Each call traces it once. For repeated calls, use a
        `ScalarFunction` or `jax.jit`.
    - `args`: its arguments.
    - `sizes`: a tree of sizes for each argument, or None for the absolute values. Pass a lower limit if an argument may
        be zero, e.g. 1 for an angle.

    The size of the result of a loop, a condition or a LAPACK call is its absolute value: cancellation inside it is not
    detected. Sizes are not differentiated.
    """
    leaves, structure = jax.tree.flatten(jax.lax.stop_gradient(args))
    leaves = [jnp.asarray(x) for x in leaves]
    given = [None] * len(args) if sizes is None else sizes
    own = [jax.tree.map(jnp.abs, x) if size is None else size for x, size in zip(args, given, strict=True)]
    largest = [jnp.maximum(m, jnp.abs(x)) for x, m in zip(leaves, jax.tree.leaves(own), strict=True)]
    specs = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves]
    program, shape = program_of(lambda *xs: f(*jax.tree.unflatten(structure, xs)), *specs, return_shape=True)
    results = interpret(program, [*zip(leaves, jax.lax.stop_gradient(largest), strict=True)], _sized, _sized_constant)
    return jax.tree.unflatten(jax.tree.structure(shape), [size for _, size in results])


def _sized_constant(_: Variable, x: Numbers) -> tuple[Any, Any]:
    return x, jnp.abs(x)


def _sized(equation: Equation, operands: list[tuple[Any, Any]]) -> list[tuple[Any, Any]]:
    """The results of an equation and their sizes, from its operands and their sizes."""
    inner = opened(equation)
    if inner is not None:
        return interpret(inner, operands, _sized, _sized_constant)
    values = [x for x, _ in operands]
    results, name = evaluated(equation, values), operation_of(equation).name
    if not all(is_inexact(y) for y in results):
        return [(y, y) for y in results]
    sizes = [size if is_inexact(x) else x for x, size in operands]
    if name in _SAME or (name == "integer_pow" and equation.params["y"] > 0):
        largest = evaluated(equation, sizes)
    elif name in _SUMS:
        largest = [jax.lax.max(*sizes)] if len(sizes) == 2 else sizes if name == "neg" else evaluated(equation, sizes)
    elif name == "div":
        largest = [jax.lax.div(sizes[0], jax.lax.abs(values[1]))]
    elif name in _OF_PURE_NUMBERS:
        largest = [jax.lax.max(jax.lax.abs(y), jnp.ones_like(y)) for y in results]
    else:
        largest = [jax.lax.abs(y) for y in results]
    return [*zip(results, largest, strict=True)]


def inside_pure_functions(f: Callable[..., Any], n: int) -> set[int]:
    """Which of the n scalar arguments of a function are used in sin, cos and similar functions. Most are angles."""
    program = program_of(f, *[jax.ShapeDtypeStruct((), jnp.result_type(float))] * n)
    found: set[int] = set()

    def depends_on(equation: Equation, operands: list[frozenset[int]]) -> list[frozenset[int]]:
        inner = opened(equation)
        if inner is not None:
            return interpret(inner, operands, depends_on, lambda *_: frozenset())
        operation, places = operation_of(equation), frozenset().union(*operands)
        if operation.name in _OF_PURE_NUMBERS:
            found.update(places)
        return [places] * operation.results

    interpret(program, [frozenset([i]) for i in range(n)], depends_on, lambda *_: frozenset())
    return found


def relative(h: Numbers, sizes: Numbers) -> Numbers:
    """Residuals relative to the sizes of their terms; 0 where both are zero."""
    xp: Any = np if isinstance(h, np.ndarray) and isinstance(sizes, np.ndarray) else jnp
    return xp.abs(h) / xp.where(sizes > 0, sizes, 1.0)


def equilibrated(A: Numbers) -> tuple[Any, Any, Any]:
    """A matrix without its units: B (m, n), rows r (m,) and columns c (n,), where A = r[:, None] * B * c.

    Scaling by geometric means (Curtis and Reid 1972): the logarithms of the nonzero entries of B have the smallest sum
    of squares. B does not depend on factors of the rows and columns of A. Scaling by the largest entries does not have
    this property. NumPy for an array of NumPy, otherwise JAX.
    """
    xp: Any = np if isinstance(A, np.ndarray) else jnp
    m = len(A)
    nonzero = xp.where(A != 0, 1.0, 0.0).astype(A.dtype)  # (m,n)
    logs = xp.log(xp.where(A != 0, xp.abs(A), 1.0)) * nonzero
    # Normal equations of  log|a_ij| = r_i + c_j.  Their null vectors move factors between rows and columns only.
    normal = xp.concatenate(
        [
            xp.concatenate([xp.diag(nonzero.sum(1)), nonzero], axis=1),
            xp.concatenate([nonzero.T, xp.diag(nonzero.sum(0))], axis=1),
        ]
    )
    right = xp.concatenate([logs.sum(1), logs.sum(0)])
    solution = xp.linalg.pinv(normal, hermitian=True) @ right
    rows, columns = xp.exp(solution[:m]), xp.exp(solution[m:])
    return A / rows[:, None] / columns[None], rows, columns


def nearest_root(
    f: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], q: np.ndarray, scales: Numbers = 1.0
) -> np.ndarray:
    """The nearest q (n,) with f = 0, by the Gauss-Newton method with NumPy; NaN if it does not converge.

    **Arguments:**

    - `f`: q -> values (m,) and their derivatives by q / scales (m, n). Both are divided by the sizes of the rows.
    - `q`: initial guess.
    - `scales`: of q.
    """
    for _ in range(20):
        values, slopes = f(q)
        if not np.all(np.isfinite(slopes)) or not np.all(np.isfinite(values)):
            break
        step = np.linalg.pinv(slopes, rcond=1e-6) @ values
        q = (q - scales * step).astype(q.dtype)
        if np.max(np.abs(step)) <= np.finfo(q.dtype).eps ** 0.5 * np.max(np.abs(q / scales)):
            return q
    return np.full_like(q, np.nan)


def without_rounding(A: Numbers, sizes: Numbers) -> Numbers:
    """A matrix in which entries are zero if their terms, of these sizes (m, n), cancel within rounding."""
    xp: Any = np if isinstance(A, np.ndarray) else jnp
    return xp.where(xp.abs(A) > 100 * float(jnp.finfo(A.dtype).eps) * sizes, A, 0.0).astype(A.dtype)


def singular_values(A: Numbers) -> Numbers:
    """The singular values of a matrix after equilibration, relative to the largest; the largest first."""
    xp: Any = np if isinstance(A, np.ndarray) else jnp
    s = xp.linalg.svd(equilibrated(A)[0], compute_uv=False)
    return s / xp.where(s[:1] > 0, s[:1], 1.0)


def rank_tolerance(dtype: DTypeLike) -> float:
    return float(jnp.finfo(dtype).eps) ** 0.6


def least_norm(A: Numbers, b: Numbers, tolerance: float | None = None) -> Numbers:
    """The solution x (n,) of A x = b of least norm, in the units of the columns; least squares for contradictory rows.

    Redundant rows have no effect. The derivatives are exact as long as the rank does not change.
    """
    xp: Any = np if isinstance(A, np.ndarray) else jnp
    _, rows, columns = equilibrated(A if xp is np else jax.lax.stop_gradient(A))
    tolerance = rank_tolerance(A.dtype) if tolerance is None else tolerance
    return xp.linalg.pinv(A / rows[:, None] / columns[None], tolerance) @ (b / rows) / columns


class RowBasis(NamedTuple):
    """A = T Q with orthonormal rows of Q, for A (m, n). Its operations can be part of a program of scalars.

    A row that is zero or depends linearly on the previous ones is omitted, because it would be divided by a rounding
    error: its row of Q (m, n) and its column of T (m, m) are zero. `is_new` (m,): whether each row is used. Derivatives
    are those of the used rows.
    """

    Q: Array
    T: Array
    is_new: Array

    @classmethod
    def of(cls, A: Array, redundant: float = 0.0) -> RowBasis:
        """`redundant`: the largest part of a row, relative to the row, that is regarded as dependent."""
        m = len(A)
        # 1.8e-12 of a row; a Gram matrix would square it
        threshold = max(redundant, float(jnp.finfo(A.dtype).eps) ** 0.75)
        Q, T, is_new = jnp.zeros((0, A.shape[1]), A.dtype), [], []
        for i in range(m):
            rest, row = A[i], jnp.zeros(i, A.dtype)
            for _ in range(2 if i else 0):  # Gram-Schmidt twice: after one pass, it is not orthogonal within rounding
                along = Q @ rest
                rest, row = rest - along @ Q, row + along
            is_used = jax.lax.stop_gradient(jnp.max(jnp.abs(rest)) > threshold * jnp.max(jnp.abs(A[i])))
            norm = jnp.sqrt(jnp.sum(jnp.where(is_used, rest, 1.0) ** 2))  # the derivative of a norm of zero is NaN
            Q = jnp.concatenate([Q, jnp.where(is_used, rest / norm, 0.0)[None]])
            T.append(jnp.concatenate([row, jnp.where(is_used, norm, 0.0)[None], jnp.zeros(m - i - 1, A.dtype)]))
            is_new.append(is_used)
        return cls(Q, jnp.stack(T), jnp.stack(is_new))

    def solve(self, b: Array) -> tuple[Array, Array]:
        """y of T y = b, for b (m,) or (m, k), and the part of b that omitted rows do not satisfy. Then w = Q^T y."""
        y, missing = jnp.zeros((0, *b.shape[1:]), b.dtype), []
        for i in range(len(b)):
            remainder, is_used = b[i] - self.T[i, :i] @ y if i else b[i], self.is_new[i]
            y = jnp.concatenate([y, jnp.where(is_used, remainder / jnp.where(is_used, self.T[i, i], 1.0), 0.0)[None]])
            missing.append(jnp.where(is_used, 0.0, remainder))
        return y, jnp.stack(missing)

    def least_norm(self, b: Array) -> Array:
        """The smallest solution w (n,) or (n, k) of A w = b, without the omitted rows."""
        return (self.solve(b)[0].T @ self.Q).T
