"""Eigenvalues of matrices. Their derivatives are NaN where they do not exist. Many small matrices use the QR
algorithm."""

from __future__ import annotations

import functools
import itertools
import operator
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from .._scalarjit import native
from .._scalarjit.components import Numbers
from .._scalarjit.nan import nan_if_moved
from .._scalarjit.scalar_function import ScalarFunction

SIZES = range(2, 7)  # of matrices; LAPACK is faster for larger ones
CHUNK = 256  # matrices at once: few others wait for a matrix that converges slowly
_SWEEPS = 3  # of balancing
_PATIENCE = 10  # steps until an exceptional shift, as in EISPACK and LAPACK
_MOST_STEPS = 30  # for each eigenvalue, as in LAPACK


def eigenvalues_text(values: Numbers) -> str:
    """Concrete eigenvalues as text, the least stable first: "-0.77 ± 4.46i, -14.1"."""
    left = sorted(np.asarray(values, complex).tolist(), key=lambda x: (-x.real, abs(x.imag), -x.imag))
    texts = []
    while left:
        x = left.pop(0)
        sign = "+" if x.imag > 0 else "-"
        if left and x.imag > 0 and abs(left[0] - x.conjugate()) <= 1e-9 * abs(x):
            left.pop(0)
            sign = "±"
        texts.append(f"{x.real:.4g}" + f" {sign} {abs(x.imag):.4g}i" * (x.imag != 0) if x == x else "NaN")
    return ", ".join(texts)


def qr_eigenvalues(A: Float[Array, "n n"]) -> Complex[Array, " n"]:
    """Eigenvalues of a small matrix, to be mapped over a batch. Backward stable as LAPACK's; pairs are adjacent.

    Francis' QR algorithm on a balanced Hessenberg matrix (Golub and Van Loan, Matrix Computations, 4th ed., Algorithms
    7.4.2 and 7.5.1; the shifts are those of EISPACK's hqr). NaN for a matrix that is not finite, and for one that has
    not converged after 30 n steps.
    """
    H, size, unfinished = _hessenberg(A)

    def going(carry: tuple[Array, Array, Array]):
        return carry[1] & (carry[2] < _MOST_STEPS * len(A))

    def steps(carry: tuple[Array, Array, Array]):
        H, _, k = carry
        return *_steps(H, k % _PATIENCE == _PATIENCE - _at_once(H)), k + _at_once(H)

    if len(A) > 2:
        H, unfinished, _ = jax.lax.while_loop(going, steps, (H, unfinished, jnp.zeros((), int)))
    return jax.lax.complex(*_of_blocks(H, jnp.where(unfinished, jnp.nan, size)))


@ScalarFunction
def _hessenberg(A: Float[Array, "n n"]):
    """Reduce A to Hessenberg form.

    **Returns:** H (n, n), similar to A / size and zero below its subdiagonal; size; whether a block is larger than 2 x
    2.
    """
    n, H = len(A), [list(row) for row in A]
    # Scale A to a largest entry of one: squares could otherwise overflow or underflow.
    size = functools.reduce(jnp.maximum, [abs(x) for row in H for x in row])
    size = jnp.where(size > 0, size, 1.0)
    finite = size < jnp.inf
    by_size = jnp.where(finite, 1.0 / size, 0.0)
    H = [[jnp.where(finite, x * by_size, 0.0) for x in row] for row in H]
    # Balancing by a diagonal similarity, so that rows and columns have nearly equal sizes (Osborne 1960)
    for _ in range(_SWEEPS):
        for i in range(n):
            row = _sum([abs(H[i][j]) for j in range(n) if j != i])
            column = _sum([abs(H[j][i]) for j in range(n) if j != i])
            f = jnp.where((row > 0) & (column > 0), jnp.sqrt(row / column), 1.0)
            by_f = 1.0 / f
            for j in range(n):
                if j != i:
                    H[i][j], H[j][i] = H[i][j] * by_f, H[j][i] * f
    for k in range(1, n - 1):
        x = [H[i][k - 1] for i in range(k, n)]
        length, v, w = _reflector(x, _sum([abs(x_i) for x_i in x[1:]]) > 0)
        _reflect(H, k, v, w, columns=range(k, n), rows=range(n))
        H[k][k - 1] = length
        for i in range(k + 1, n):
            H[i][k - 1] = jnp.zeros_like(length)
    H, unfinished = _deflated(H)
    return H, jnp.where(finite, size, jnp.nan), unfinished


def _at_once(H: Float[Array, "n n"]) -> int:
    # Loading and storing a small matrix costs as much as half a step. Two steps of a large one take seconds to compile.
    return 2 if len(H) <= 4 else 1


@ScalarFunction
def _steps(H: Float[Array, "n n"], exceptional: Bool):
    for _ in range(_at_once(H) - 1):
        H, _ = _step(H, False)
    return _step(H, exceptional)


def _step(H: Numbers, exceptional: Bool):
    """One double-shift step on the last block that is larger than 2 x 2. Small subdiagonal entries are then set to
    zero."""
    n, H = len(H), [list(row) for row in H]
    linked = [H[k + 1][k] != 0 for k in range(n - 1)]
    # inside[k]: rows k and k + 1 belong to the block; last[k]: they are its last two.
    has_last = below = jnp.asarray(False)
    inside, last = [has_last] * (n - 1), [has_last] * (n - 1)
    for k in reversed(range(n - 1)):
        if k > 0:
            last[k] = linked[k] & linked[k - 1] & ~has_last
        has_last = has_last | last[k]
        inside[k] = below = linked[k] & (below | last[k])
    first = [inside[0], *(inside[k] & ~inside[k - 1] for k in range(1, n - 1))]
    # The shifts are the eigenvalues of the last two rows [[a, b], [c, d]]; `bc` is the product b c.
    zero = jnp.zeros_like(H[0][0])

    def at_end(entries: Sequence[Array]):
        return _sum([jnp.where(is_last, x, 0.0) for is_last, x in zip(last[1:], entries, strict=True)])

    ends = range(1, n - 1)
    a, d = at_end([H[k][k] for k in ends]), at_end([H[k + 1][k + 1] for k in ends])
    c = at_end([H[k + 1][k] for k in ends])
    bc = c * at_end([H[k][k + 1] for k in ends])
    s = jnp.abs(c) + at_end([jnp.abs(H[k][k - 1]) for k in ends])
    a, d, bc = (jnp.where(exceptional, x, y) for x, y in ((d + 0.75 * s, a), (d + 0.75 * s, d), (-0.4375 * s * s, bc)))
    for k in range(n - 1):
        width = min(3, n - k)
        x = [H[i][k - 1] for i in range(k, k + width)] if k > 0 else [zero] * width
        if width == 3:
            # First column of (H - shift 1) (H - shift 2), divided by its subdiagonal
            r, t, h = d - H[k][k], a - H[k][k], jnp.where(first[k], H[k + 1][k], 1.0)
            start = [(r * t - bc) / h + H[k][k + 1], H[k + 1][k + 1] - H[k][k] - r - t, H[k + 2][k + 1]]
            x = [jnp.where(first[k], y, x_i) for x_i, y in zip(x, start, strict=True)]
            x[2] = jnp.where(last[k], 0.0, x[2])
        length, v, w = _reflector(x, inside[k])
        _reflect(H, k, v, w, columns=range(k, n), rows=range(min(k + 4, n)))
        if k > 0:
            H[k][k - 1] = jnp.where(inside[k] & ~first[k], length, H[k][k - 1])
            for i in range(k + 1, k + width):
                H[i][k - 1] = zero
    return _deflated(H)


def _deflated(H: list[list[Array]]):
    """H without the subdiagonal entries that are rounding errors (Ahues and Tisseur 1997, as LAPACK's dlahqr)."""
    n, info = len(H), jnp.finfo(H[0][0].dtype)
    eps, tiny = float(info.eps), float(info.tiny) ** 0.5
    size = [abs(H[k + 1][k]) for k in range(n - 1)]
    for k in range(n - 1):
        a, b, c, d = H[k][k], H[k][k + 1], H[k + 1][k], H[k + 1][k + 1]
        near = abs(a) + abs(d)
        beside = [size[i] for i in (k - 1, k + 1) if 0 <= i < n - 1]
        near = jnp.where(near == 0, _sum([jnp.zeros_like(near), *beside]), near)
        larger, smaller = jnp.maximum(abs(b), abs(c)), jnp.minimum(abs(b), abs(c))
        e, f = jnp.maximum(abs(d), abs(a - d)), jnp.minimum(abs(d), abs(a - d))
        small = (size[k] <= tiny) | ((size[k] <= eps * near) & (smaller * larger <= eps * (e * f)))
        H[k + 1][k] = jnp.where(small, 0.0, c)
    linked = [H[k + 1][k] != 0 for k in range(n - 1)]
    unfinished = jnp.asarray(False)
    for above, below in itertools.pairwise(linked):
        unfinished = unfinished | (above & below)
    return jnp.stack([jnp.stack(row) for row in H]), unfinished


@ScalarFunction
def _of_blocks(H: Float[Array, "n n"], size: Array):
    """Real and imaginary parts (n,) of the eigenvalues of `size` H, whose blocks have one or two rows."""
    n = len(H)
    real, imaginary = [H[k][k] for k in range(n)], [jnp.zeros_like(H[0][0])] * n
    for k in range(n - 1):
        a, bc, d = H[k][k], H[k][k + 1] * H[k + 1][k], H[k + 1][k + 1]
        p = (a - d) / 2
        q = p * p + bc
        root = jnp.sqrt(abs(q))
        far = jnp.where(p < 0, p - root, p + root)
        near = jnp.where(far == 0, d, d - bc / far)
        is_block, is_pair = H[k + 1][k] != 0, q < 0
        for i, x, y in ((k, d + far, root), (k + 1, near, -root)):
            real[i] = jnp.where(is_block, jnp.where(is_pair, d + p, x), real[i])
            imaginary[i] = jnp.where(is_block & is_pair, y, imaginary[i])
    return jnp.stack(real) * size, jnp.stack(imaginary) * size


def _sum(x: Sequence[Any]) -> Numbers:
    return functools.reduce(operator.add, x)


def _reflector(x: Sequence[Any], active: Bool) -> tuple[Any, list[Any], list[Any]]:
    """Householder's reflection 1 - w v^T that maps x to (length, 0, ..., 0), or the identity."""
    square = _sum([x_i * x_i for x_i in x])
    active = active & (square > 0)
    s = jnp.sqrt(jnp.where(active, square, 1.0))
    s = jnp.where(x[0] < 0, -s, s)
    first = x[0] + s
    both = jnp.where(active, 1.0 / (first * s), 0.0)
    v = [jnp.ones_like(s), *(x_i * (both * s) for x_i in x[1:])]
    w = [jnp.where(active, first * (both * first), 0.0), *(x_i * (both * first) for x_i in x[1:])]
    return jnp.where(active, -s, x[0]), v, w


def _reflect(H: list[list[Any]], k: int, v: Sequence[Any], w: Sequence[Any], columns: range, rows: range) -> None:
    """H -> (1 - w v^T) H (1 - v w^T) on the rows and columns from k on, in place."""
    places = range(k, k + len(v))
    for j in columns:
        s = H[k][j]
        for i, v_i in zip(places[1:], v[1:], strict=True):
            s = s + v_i * H[i][j]
        for i, w_i in zip(places, w, strict=True):
            H[i][j] = H[i][j] - s * w_i
    for i in rows:
        s = H[i][k] * w[0]
        for j, w_j in zip(places[1:], w[1:], strict=True):
            s = s + H[i][j] * w_j
        for j, v_j in zip(places, v, strict=True):
            H[i][j] = H[i][j] - s * v_j


MOST_CONDITION = 1e6
# times the rounding error of the largest eigenvalue: nearer ones are equal, and their eigenvectors are arbitrary
_APART = 1e4


class Eig(NamedTuple):
    """Eigenvalues and eigenvectors.

    - `values` (n,) [1/s]: first the real ones, the largest first, then the pairs by rising frequency.
    - `vectors` (n, n): right eigenvectors of unit length in the columns.
    - `left` (n, n): left eigenvectors of unit length in the columns.
    - `condition` (n,): 1 / |y^H x|, the factor by which an error of A is magnified in the eigenvalue; infinite where
        two coalesce.
    """

    values: Complex[Array, "*batch n"]
    vectors: Complex[Array, "*batch n n"]
    left: Complex[Array, "*batch n n"]
    condition: Float[Array, "*batch n"]


def eig(A: Float[Array, "*batch n n"]) -> Eig:
    """Eigenvalues and eigenvectors of A by LAPACK.

        d lambda = y^H dA x / (y^H x)

    The eigenvectors are differentiable too, any number of times. The derivatives do not exist where two eigenvalues
    coalesce, and are inaccurate nearby. They are NaN where `condition` is above 1e6.
    """
    values, left, vectors = jnp.vectorize(_decomposed, signature="(n,n)->(n),(n,n),(n,n)")(A)
    return Eig(values, vectors, left, _condition(values, left, vectors))


def eigvals(A: Float[Array, "*batch n n"]) -> Complex[Array, "*batch n"]:
    """Eigenvalues of A without eigenvectors. Their derivatives are those of `eig`, which computes vectors only then."""
    return jnp.vectorize(_values, signature="(n,n)->(n)")(A)


@jax.jit
def _condition(values: Complex[Array, " n"], left: Complex[Array, "n n"], right: Complex[Array, "n n"]):
    s = jnp.abs(jnp.sum(left.conj() * right, axis=-2))
    far = jax.lax.stop_gradient(jnp.abs(values[..., :, None] - values[..., None, :]))
    far = jnp.where(jnp.eye(values.shape[-1], dtype=bool), jnp.inf, far)
    size = jnp.max(jnp.abs(jax.lax.stop_gradient(values)), axis=-1, keepdims=True)
    apart = jnp.min(far, axis=-1) > _APART * jnp.finfo(s.dtype).eps * size
    return jnp.where((apart & (s > 0)) | jnp.isnan(s), 1.0 / jnp.where(s == 0, 1.0, s), jnp.inf)


# LAPACK gets one matrix at a time. jaxlib 0.10 splits a batch into tasks for XLA's thread pool and waits for them. If
# several programs run at once, the waiting threads are those of the pool, which is a deadlock.


@jax.custom_jvp
@jax.custom_batching.sequential_vmap
def _decomposed(A: Float[Array, "n n"]):
    values, Y, X = jax.lax.linalg.eig(A, compute_left_eigenvectors=True, compute_right_eigenvectors=True)
    order = jnp.lexsort(_keys(values))
    return values[order], Y[:, order], X[:, order]


@jax.custom_batching.custom_vmap
def _values_alone(A: Float[Array, "n n"]):
    return _in_order(jax.lax.linalg.eig(A, compute_left_eigenvectors=False, compute_right_eigenvectors=False)[0])


@_values_alone.def_vmap
def _(axis_size: int, is_batched: Sequence[bool], A: Float[Array, "n n"]):
    if native.is_on() and axis_size >= CHUNK and A.shape[-1] in SIZES:  # compiling takes a second
        return jax.lax.map(lambda A: _in_order(qr_eigenvalues(A)), A, batch_size=CHUNK), True
    return jax.lax.map(_values_alone, A), True


def _keys(values: Complex[Array, " n"]):
    # Sort by frequency first: the real part of a neutral mode is a rounding error, which differs between algorithms.
    return -values.imag, -values.real, jnp.abs(values.imag)


@jax.jit
def _in_order(values: Complex[Array, " n"]):
    return values[jnp.lexsort(_keys(values))]


_values = jax.custom_jvp(_values_alone)


@_decomposed.defjvp
def _(primals: tuple[Any, ...], tangents: tuple[Any, ...]):
    (A,), (dA,) = primals, tangents
    values, Y, X = _decomposed(A)
    lost = ~(jax.lax.stop_gradient(_condition(values, Y, X)) < MOST_CONDITION)
    A_c, dA_c = A.astype(X.dtype), dA.astype(X.dtype)
    # Replace values without derivatives by 1: NaN would reach the gradients of callers who do not use them (0 * NaN).
    still, y, x = (jnp.where(lost, 1.0, z) for z in (values, Y, X))
    # The diagonal of Y^H dA X, divided by y^H x
    d_values = jnp.einsum("ji,jk,ki->i", y.conj(), dA_c, x) / jnp.where(lost, 1.0, jnp.sum(y.conj() * x, axis=0))
    dX = _turned(A_c, dA_c, still, x, lost)
    dY = _turned(A_c.conj().T, dA_c.conj().T, still.conj(), y, lost)
    none = nan_if_moved([dA], [A], jnp.zeros_like(lost, A.dtype))
    none = jax.lax.complex(none, none)
    return (values, Y, X), tuple(jnp.where(lost, none, d) for d in (d_values, dY, dX))


@_values.defjvp
def _(primals: tuple[Any, ...], tangents: tuple[Any, ...]):
    values = _values(*primals)
    decomposed, slopes = jax.jvp(lambda A: _decomposed(A)[0], primals, tangents)
    same = jnp.argmin(jnp.abs(values[:, None] - decomposed[None, :]), axis=1)
    return values, slopes[same]


def _turned(
    A: Float[Array, "n n"],
    dA: Complex[Array, "n n"],
    values: Complex[Array, " n"],
    X: Complex[Array, "n n"],
    lost: Bool[Array, " n"],
):
    # dX (n, n) of the eigenvectors in the columns of X, of unit length and with a real largest entry, as LAPACK's.
    #
    #     (lambda - A) dx + d lambda x = dA x,   x^H dx = 0,   and a rotation i x that keeps the largest entry real
    #
    # A sum over the other eigenvectors would fail where some of these coalesce. This form needs only that x is
    # separated.

    def one(value: Array, x: Complex[Array, " n"], lost: Array):
        bordered = jnp.block([[value * jnp.eye(len(A), dtype=x.dtype) - A, x[:, None]], [x.conj()[None], 0j]])
        bordered = jnp.where(lost, jnp.eye(len(A) + 1, dtype=x.dtype), bordered)
        dx = jnp.linalg.solve(bordered, jnp.append(dA @ x, jnp.zeros(1, x.dtype)))[:-1]
        k = jnp.argmax(jnp.abs(jax.lax.stop_gradient(x)))
        turn = (dx[k] / x[k]).imag
        return dx - jax.lax.complex(jnp.zeros_like(turn), turn) * x

    return jax.vmap(one, in_axes=(0, 1, 0), out_axes=1)(values, X, lost)
