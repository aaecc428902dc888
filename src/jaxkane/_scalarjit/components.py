"""Arithmetic, small linear systems and programs with exact zeros and ones. Independent of mechanics.

Small systems are written out: by Cramer's rule up to three unknowns, by Gaussian elimination up to six, and by L D L^T
without pivoting if they are positive definite. This preserves exact zeros, and a batch stays component-major. Larger
systems are written out if their exact zeros split them into such blocks, e.g. closed loops on a bicycle. All other
systems use LAPACK.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, PyTree

from .compat import ClosedJaxpr, Equation, Tracer, Variable, evaluated, is_literal
from .graph import OPERATORS

if TYPE_CHECKING:
    Scalar: TypeAlias = Any  # users pass numbers, fields store arrays: a type checker cannot follow this conversion
else:
    Scalar = Float[Array, ""]
    """A physical parameter: one float array without axes."""

Component: TypeAlias = Any
"""One component of a vector: a float array without axes, or an exact Python float."""

Numbers: TypeAlias = Any
"""An array of numbers of JAX or NumPy, also traced. These have the same operators, but no common type to declare."""

ComponentsLike: TypeAlias = Sequence[Component] | np.ndarray | Array
"""Several numbers: a sequence of components, or an array."""

Bool: TypeAlias = Any
"""A bool, or an array of bools, also traced."""

Triple: TypeAlias = tuple[Component, Component, Component]

Inputs: TypeAlias = Mapping[str, Any] | Callable[..., Any] | None
"""Inputs by name; omitted ones are zero."""


ZERO3: Triple = (0.0, 0.0, 0.0)


def component(value: Component, what: str = "A component, an angle, a rate or a mass") -> Component:
    """`value` as a component: Python and NumPy numbers become exact floats, arrays do not change. `what` is the
    beginning of the message for other values."""
    if isinstance(value, float):
        return value
    if isinstance(value, (int, np.number)) and not isinstance(value, bool):
        return float(value)
    shape, kind = getattr(value, "shape", None), getattr(getattr(value, "dtype", None), "kind", "")
    if shape != () or kind in tuple("cUSOmM"):
        hint = f": by name it is q[{value!r}], u[{value!r}] or inputs[{value!r}]" if isinstance(value, str) else ""
        got = f"an array of shape {shape}: take one entry, as a[0]" if shape else f"{value!r}{hint}"
        raise TypeError(f"{what} must be one number, got {got}.")
    return jnp.asarray(value) if isinstance(value, np.ndarray) else value


def components(values: PyTree, n: int, what: str) -> tuple[Component, ...]:
    """`n` numbers in a sequence as components; `what` is the beginning of the message for other values."""
    return tuple(component(x) for x in several(values, n, what))


def several(values: PyTree, n: int, what: str) -> tuple[Any, ...]:
    """`n` items of a sequence; `what` is the beginning of the message for other values."""
    if isinstance(values, str) or not hasattr(values, "__iter__") or getattr(values, "shape", None) == ():
        raise TypeError(f"{what}, got {values!r}.")
    items = tuple(values)
    if len(items) != n:
        raise ValueError(f"{what}, got {len(items)}.")
    return items


def positive(value: Component, what: str) -> Component:
    """`value`. **Raises:** `ValueError` for a concrete number that is not positive."""
    if is_exact(component(value, what)) and not value > 0:
        raise ValueError(f"{what} must be positive, got {value}.")
    return value


def is_exact(a: Component) -> bool:
    return isinstance(a, float)


def is_zero(a: Component) -> bool:
    return isinstance(a, float) and a == 0.0


def add(a: Component, b: Component) -> Component:
    if is_zero(a):
        return b
    if is_zero(b):
        return a
    return jax.lax.add(a, b) if _are_alike(a, b) else a + b


def sub(a: Component, b: Component) -> Component:
    if is_zero(b):
        return a
    if is_zero(a):
        return -b
    return jax.lax.sub(a, b) if _are_alike(a, b) else a - b


def mul(a: Component, b: Component) -> Component:
    for x, y in ((a, b), (b, a)):
        if isinstance(x, float):
            if x == 0.0:  # a term that does not exist: zero also if the other factor is NaN or infinite
                return 0.0
            if x == 1.0:
                return y
            if x == -1.0:
                return -y
    return jax.lax.mul(a, b) if _are_alike(a, b) else a * b


def _are_alike(a: Component, b: Component) -> bool:
    """Whether two traced numbers need no conversion. Python's operators take twice as long to check this."""
    return isinstance(a, Tracer) and isinstance(b, Tracer) and a.dtype == b.dtype and a.shape == b.shape


def total(terms: Iterable[Component]) -> Component:
    return functools.reduce(add, terms, 0.0)


def dot(a: Sequence[Component], b: Sequence[Component]) -> Component:
    return total(mul(x, y) for x, y in zip(a, b, strict=True))


def cross(a: Triple, b: Triple) -> Triple:
    (a1, a2, a3), (b1, b2, b3) = a, b
    return (
        sub(mul(a2, b3), mul(a3, b2)),
        sub(mul(a3, b1), mul(a1, b3)),
        sub(mul(a1, b2), mul(a2, b1)),
    )


def add3(a: Triple, b: Triple) -> Triple:
    return (add(a[0], b[0]), add(a[1], b[1]), add(a[2], b[2]))


def scale3(s: Component, a: Triple) -> Triple:
    return (mul(s, a[0]), mul(s, a[1]), mul(s, a[2]))


def matvec(matrix: Sequence[Sequence[Component]], a: Sequence[Component]) -> tuple[Component, ...]:
    return tuple(dot(row, a) for row in matrix)


Rows = Sequence[Sequence[Component]]

_CRAMER_UP_TO = 3
ELIMINATE_UP_TO = 6  # without native kernels, the derivatives of eight take 14 s to compile
_UNROLL_UP_TO = 12


def solve(A: Rows, *rights: Sequence[Component]) -> list[tuple[Component, ...]]:
    """The solutions x of A x = b for several right-hand sides b."""
    if found := _written_out(A, rights):
        return found[0]
    solution = _solved_by_lapack(stack(A), jnp.stack([stack([b])[0] for b in rights], axis=-1))
    return [tuple(solution[i, j] for i in range(len(A))) for j in range(len(rights))]


def determinant(A: Rows) -> Component:
    """det A."""
    found = _written_out(A, ())
    return found[1] if found else _det_by_lapack(stack(A))


def _written_out(
    A: Rows, rights: Sequence[Sequence[Component]]
) -> tuple[list[tuple[Component, ...]], Component] | None:
    """Solutions and det A, or None if no diagonal blocks are small enough to be written out."""
    if len(A) <= _CRAMER_UP_TO:
        return _solutions_and_det(A, rights)
    blocks = _blocks(A)
    if blocks is None:
        return None
    orders = [[i for block in blocks for i in block[side]] for side in (0, 1)]
    det: Component = float(round(math.prod(np.linalg.det(np.eye(len(A))[order]) for order in orders)))
    solutions: list[dict[int, Component]] = [{} for _ in rights]
    for rows, columns in blocks:
        pairs = zip(rights, solutions, strict=True)
        remaining = [[functools.reduce(sub, (mul(A[i][j], x[j]) for j in x), b[i]) for i in rows] for b, x in pairs]
        solved, factor = _solutions_and_det([[A[i][j] for j in columns] for i in rows], remaining)
        det = mul(det, factor)
        for x, values in zip(solutions, solved, strict=True):
            x.update(zip(columns, values, strict=True))
    return [tuple(x[j] for j in range(len(A))) for x in solutions], det


# By these names `unsupported_primitives` distinguishes calls of the method itself from those of a system.


@jax.jit
def _solved_by_lapack(matrix: Float[Array, "n n"], rights: Float[Array, "n k"]):
    return jnp.linalg.solve(matrix, rights)


@jax.jit
def _det_by_lapack(matrix: Float[Array, "n n"]):
    return jnp.linalg.det(matrix)


Block = tuple[list[int], list[int]]


def _blocks(A: Rows) -> list[Block] | None:
    """Rows and columns of diagonal blocks, if rows and columns of A can be ordered so that all entries above the blocks
    are exact zeros. None if a block is too large to be written out, or if the zeros of A make it singular."""
    from scipy.sparse import csgraph, csr_array  # here, because the import of the library must not load SciPy

    reads = np.array([[not is_zero(a) for a in row] for row in A])
    # A different column with a nonzero entry for each row.
    column_of = csgraph.maximum_bipartite_matching(csr_array(reads), perm_type="column")
    if -1 in column_of:
        return None
    # Row i depends on row j if it uses the unknown of j. Rows that depend on each other form one block.
    follows = reads[:, column_of] | np.eye(len(A), dtype=bool)
    for _ in range(len(A).bit_length()):
        follows = (follows.astype(int) @ follows) > 0
    together = follows & follows.T
    order = sorted({tuple(np.flatnonzero(row)) for row in together}, key=lambda rows: (follows[rows[0]].sum(), rows))
    if max(map(len, order)) > ELIMINATE_UP_TO:
        return None
    return [([int(i) for i in rows], sorted(int(column_of[i]) for i in rows)) for rows in order]


def _solutions_and_det(
    A: Rows, rights: Sequence[Sequence[Component]] = ()
) -> tuple[list[tuple[Component, ...]], Component]:
    """Solutions and det A for a system that is small enough to be written out."""
    n = len(A)
    if n == 0:
        return [() for _ in rights], 1.0
    if n > _CRAMER_UP_TO:
        return _eliminated(A, rights)
    adjugate, det = _adjugate(A)
    if is_zero(det):  # an unknown that no equation contains: the result is undefined, and a zero must not hide this
        return [(math.nan,) * n for _ in rights], det
    reciprocal = 1.0 / det
    return [tuple(mul(dot(row, b), reciprocal) for row in adjugate) for b in rights], det


def _eliminated(A: Rows, rights: Sequence[Sequence[Component]]) -> tuple[list[tuple[Component, ...]], Component]:
    """The solutions and det A by Gaussian elimination with partial pivoting.

    The pivot row is found by exchanging rows in pairs, each by selecting numbers. Rows whose leading entry is an exact
    zero are skipped.
    """
    n, det = len(A), 1.0
    rows = [[*row, *(b[i] for b in rights)] for i, row in enumerate(A)]
    for k in range(n):
        first, *others = [i for i in range(k, n) if not is_zero(rows[i][k])] or [k]
        if first != k:
            rows[k], rows[first], det = rows[first], rows[k], mul(-1.0, det)
        for i in others:
            is_larger = abs(rows[i][k]) > abs(rows[k][k])
            pairs = list(zip(rows[k], rows[i], strict=True))
            rows[k] = [_chosen(is_larger, lower, upper) for upper, lower in pairs]
            rows[i] = [_chosen(is_larger, upper, lower) for upper, lower in pairs]
            det = _chosen(is_larger, mul(-1.0, det), det)
        pivot = rows[k]
        det = mul(det, pivot[k])
        for i in others:
            factor = rows[i][k] / pivot[k]
            rows[i] = [sub(a, mul(factor, b)) for a, b in zip(rows[i], pivot, strict=True)]
            rows[i][: k + 1] = [0.0] * (k + 1)
    solutions = []
    for j in range(n, n + len(rights)):
        x: list[Component] = [0.0] * n
        for i in reversed(range(n)):
            x[i] = _quotient(sub(rows[i][j], dot(rows[i][i + 1 : n], x[i + 1 :])), rows[i][i])
        solutions.append(tuple(x))
    return solutions, det


def _chosen(condition: Bool, a: Component, b: Component) -> Component:
    """`a` if the condition is true, else `b`."""
    if isinstance(condition, (bool, np.bool_)):
        return a if condition else b
    return a if is_exact(a) and is_exact(b) and a == b else jnp.where(condition, a, b)


def _adjugate(A: Rows) -> tuple[Rows, Component]:
    if len(A) == 1:
        return ((1.0,),), A[0][0]
    if len(A) == 2:
        (a, b), (c, d) = A
        return ((d, mul(-1.0, b)), (mul(-1.0, c), a)), sub(mul(a, d), mul(b, c))
    r1, r2, r3 = (tuple(row) for row in A)
    columns = cross(r2, r3), cross(r3, r1), cross(r1, r2)  # type: ignore[arg-type]
    return tuple(zip(*columns, strict=True)), dot(r1, columns[0])


def is_written_out(n: int) -> bool:
    """Whether positive definite systems of n unknowns are written out in scalars."""
    return n <= _UNROLL_UP_TO


def solve_positive_array(M: Float[Array, "n n"], b: Float[Array, " n"]):
    """The solution x (n,) of M x = b for a symmetric positive definite array M (n, n), by LAPACK. NaN if M is singular
    within rounding."""
    factor = jsl.cho_factor(M)
    is_regular = jnp.all(jnp.diag(factor[0]) ** 2 > rounding_of_pivots(M.dtype) * jnp.diag(M))
    return jnp.where(is_regular, jsl.cho_solve(factor, b), jnp.nan)


def rounding_of_pivots(dtype: DTypeLike) -> float:
    """Pivots of L D L^T are regarded as zero if they are below this factor times the diagonal entry of M. The criterion
    does not depend on units or on the size of masses."""
    return 100 * float(jnp.finfo(dtype).eps)


def solve_positive(M: Rows, b: Sequence[Component]) -> tuple[Component, ...]:
    """The solution x of M x = b for a symmetric positive definite M, of which the upper triangle is used. NaN if M is
    singular within rounding."""
    n = len(M)
    # M = L D L^T, column by column; d holds the pivots, L the rows below the diagonal.
    L: list[list[Component]] = [[0.0] * n for _ in range(n)]
    d: list[Component] = []
    for j in range(n):
        pivot = M[j][j]
        for k in range(j):
            pivot = sub(pivot, mul(mul(L[j][k], L[j][k]), d[k]))
        if pivot is not M[j][j]:  # NaN if it is not larger than the rounding error of the diagonal entry
            exact = is_exact(pivot) and is_exact(M[j][j])
            threshold = rounding_of_pivots(float if exact else jnp.result_type(pivot, M[j][j])) * M[j][j]
            pivot = _chosen(pivot > threshold, pivot, math.nan)
        d.append(pivot)
        for i in range(j + 1, n):
            entry = M[j][i]
            for k in range(j):
                entry = sub(entry, mul(mul(L[i][k], L[j][k]), d[k]))
            L[i][j] = entry if is_zero(entry) else _quotient(entry, pivot)
    y = list(b)
    for i in range(n):
        for k in range(i):
            y[i] = sub(y[i], mul(L[i][k], y[k]))
    x = [_quotient(y_i, d_i) for y_i, d_i in zip(y, d, strict=True)]
    for i in reversed(range(n)):
        for k in range(i + 1, n):
            x[i] = sub(x[i], mul(L[k][i], x[k]))
    return tuple(x)


def _quotient(a: Component, b: Component) -> Component:
    if is_zero(b):
        return math.nan
    return a if is_zero(a) else a / b


def as_vector(row: Sequence[Component], like: Numbers) -> Numbers:
    """A row of components as an array (n,) with the dtype of `like`."""
    return stack([row])[0].astype(like.dtype)


def stack(rows: Rows):
    """Rows of components as an array (m, n)."""
    width = len(rows[0]) if rows else 0
    flat = [a for row in rows for a in row]
    if not flat:
        return jnp.zeros((len(rows), width))
    # Exact numbers do not count: as arrays of float64 they would promote a float32 model.
    dtype = jnp.result_type(*([a for a in flat if not is_exact(a)] or [float]))
    return jnp.stack([jnp.asarray(a, dtype=dtype) for a in flat]).reshape(len(rows), width)


class Replay:
    """The equations of a function, and the positions of its quantities among their results."""

    def __init__(self, program: ClosedJaxpr, structures: dict[str, Any], leaves: Sequence[Any]):
        """- `program`: the traced function.
        - `structures`: the tree of each quantity, by name.
        - `leaves`: of all quantities. Exact leaves are not results of the program.
        """
        self.program, self.structures = program, structures
        outputs = iter(program.jaxpr.outvars)
        row = iter([x if is_exact(x) else next(outputs) for x in leaves])
        self.results: dict[str, list[Any]] = {
            name: [next(row) for _ in range(s.num_leaves)] for name, s in structures.items()
        }
        self.needed = functools.cache(self._needed)  # a cached method would keep the instance alive

    def _needed(self, quantity: str) -> list[Any]:
        """The equations that a quantity needs, and those with side effects."""
        read = {v for v in self.results[quantity] if _is_variable(v)}
        equations = []
        for equation in reversed(self.program.jaxpr.eqns):
            if equation.effects or any(v in read for v in equation.outvars):
                equations.append(equation)
                read.update(v for v in equation.invars if _is_variable(v))
        return equations[::-1]

    def __call__(self, quantity: str, numbers: Sequence[Any], memory: dict[Any, Any]) -> PyTree:
        jaxpr: Any = self.program.jaxpr
        values = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*self.program.consts, *numbers), strict=True))
        for equation in self.needed(quantity):
            xs = [v.val if is_literal(v) else values[v] for v in equation.invars]
            key = (id(equation), *(x if is_exact(x) else id(x) for x in xs))
            if key not in memory:
                known = _with_exact(equation, xs)
                pairs = zip(xs, equation.invars, strict=True)
                arrays = [np.asarray(x, v.aval.dtype) if is_exact(x) else x for x, v in pairs]
                memory[key] = evaluated(equation, arrays) if known is None else [known], xs, self
            values.update(zip(equation.outvars, memory[key][0], strict=True))
        results = [values[v] if _is_variable(v) else v if is_exact(v) else v.val for v in self.results[quantity]]
        return jax.tree.unflatten(self.structures[quantity], results)


def _is_variable(v: Variable) -> bool:
    return not is_exact(v) and not is_literal(v)


# Rules for equations with exact values: (parameters, values) -> the exact result, or None.
_OF_EXACT: dict[str, Callable[..., float | None]] = {
    **{name: lambda params, *xs, f=f: f(*xs) for name, f in OPERATORS.items()},
    "div": lambda params, x, y: x / y if y else None,
    "abs": lambda params, x: abs(x),
    "square": lambda params, x: x * x,
    "integer_pow": lambda params, x: x ** params["y"] if x or params["y"] > 0 else None,
}
# Operations that one exact value makes trivial, with these values.
_TRIVIAL = {"add": (add, (0.0,)), "sub": (sub, (0.0,)), "mul": (mul, (0.0, 1.0, -1.0))}


def _with_exact(equation: Equation, xs: Sequence[Any]) -> Component | None:
    """The result of an equation with some exact values, if it is exact too or needs no equation; else None."""
    # A literal in the function counts as exact only together with another exact value.
    exact = [is_exact(x) and not is_literal(v) for x, v in zip(xs, equation.invars, strict=True)]
    if not any(exact):
        return None
    name = equation.primitive.name
    if name in ("copy", "copy_p", "convert_element_type", "reshape", "broadcast_in_dim", "stop_gradient"):
        aval = equation.outvars[0].aval
        return xs[0] if aval.shape == () and jnp.issubdtype(aval.dtype, jnp.floating) else None
    numbers = [float(x) if is_literal(v) else x for x, v in zip(xs, equation.invars, strict=True)]
    if all(map(is_exact, numbers)):
        return _OF_EXACT[name](equation.params, *numbers) if name in _OF_EXACT else None
    if name == "div" and exact[1]:
        return xs[0] if xs[1] == 1.0 else None
    f, trivial = _TRIVIAL.get(name, (None, ()))
    return f(*xs) if f and next(x for x, e in zip(xs, exact, strict=True) if e) in trivial else None
