"""Eigenvalues of many small real matrices at once, by the QR algorithm as a scalar program. Knows matrices only.

LAPACK takes one matrix after the other and branches at every turn. Here the lanes are the members of a batch, so
nothing branches: a step works on the last diagonal block of each matrix that is larger than two by two, and what it has
to leave alone is masked.
"""

from __future__ import annotations

import functools
import itertools
import operator
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from .._scalars.fuse import fused

SIZES = range(2, 7)  # of matrices; larger ones are better off with LAPACK
CHUNK = 256  # matrices at once: one that is slow holds up few others
_SWEEPS = 3  # of balancing
_PATIENCE = 10  # steps until an exceptional shift, as in EISPACK and LAPACK
_MOST_STEPS = 30  # for each eigenvalue, as in LAPACK


def qr_eigenvalues(A: Float[Array, "n n"]) -> Complex[Array, " n"]:
    """Eigenvalues of a small matrix, backward stable as LAPACK's, to be mapped over a batch; pairs side by side.

    Francis' QR algorithm on a balanced Hessenberg matrix (Golub and Van Loan, Matrix Computations, 4th ed., Algorithms
    7.4.2 and 7.5.1; the shifts are those of EISPACK's hqr). NaN for a matrix that is not finite, and for one that has
    not converged after 30 n steps.
    """
    H, size, unfinished = _hessenberg(A)

    def going(carry):
        return carry[1] & (carry[2] < _MOST_STEPS * len(A))

    def steps(carry):
        H, _, k = carry
        return *_steps(H, k % _PATIENCE == _PATIENCE - _at_once(H)), k + _at_once(H)

    if len(A) > 2:
        H, unfinished, _ = jax.lax.while_loop(going, steps, (H, unfinished, jnp.zeros((), int)))
    return jax.lax.complex(*_of_blocks(H, jnp.where(unfinished, jnp.nan, size)))


@fused
def _hessenberg(A):
    """H (n, n) similar to A / size and zero below its subdiagonal; size; whether a block is larger than two by two."""
    n, H = len(A), [list(row) for row in A]
    # With a size of one, squares neither overflow nor vanish where they matter.
    size = functools.reduce(jnp.maximum, [abs(x) for row in H for x in row])
    size = jnp.where(size > 0, size, 1.0)
    finite = size < jnp.inf
    by_size = jnp.where(finite, 1.0 / size, 0.0)
    H = [[jnp.where(finite, x * by_size, 0.0) for x in row] for row in H]
    # Balancing: rows and columns of equal size, as far as a diagonal similarity can (Osborne 1960)
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


def _at_once(H) -> int:
    # To load and store a small matrix costs as much as half a step; to compile a large one's costs seconds.
    return 2 if len(H) <= 4 else 1


@fused
def _steps(H, exceptional):
    for _ in range(_at_once(H) - 1):
        H, _ = _step(H, False)
    return _step(H, exceptional)


def _step(H, exceptional):
    """One double-shift step on the last block that is larger than two by two; then what has become small is zero."""
    n, H = len(H), [list(row) for row in H]
    linked = [H[k + 1][k] != 0 for k in range(n - 1)]
    # inside[k]: rows k and k + 1 belong to the block; last[k]: they are its last two.
    found = below = jnp.asarray(False)
    inside, last = [found] * (n - 1), [found] * (n - 1)
    for k in reversed(range(n - 1)):
        if k > 0:
            last[k] = linked[k] & linked[k - 1] & ~found
        found = found | last[k]
        inside[k] = below = linked[k] & (below | last[k])
    first = [inside[0], *(inside[k] & ~inside[k - 1] for k in range(1, n - 1))]
    # The shifts are the eigenvalues of the last two rows [[a, b], [c, d]], of which bc is the product b c.
    zero = jnp.zeros_like(H[0][0])

    def at_end(entries):
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


def _deflated(H):
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


@fused
def _of_blocks(H, size):
    """Real and imaginary parts (n,) of the eigenvalues of `size` H, which has blocks of one and two rows."""
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


def _sum(x: Sequence[Any]) -> Any:
    return functools.reduce(operator.add, x)


def _reflector(x: Sequence[Any], active: Any) -> tuple[Any, list[Any], list[Any]]:
    """Householder's reflection 1 - w v^T that moves x to (length, 0, ..., 0), or the identity."""
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
