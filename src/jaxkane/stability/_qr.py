"""Eigenvalues of many small real matrices at once, by the QR algorithm as a scalar program. Knows matrices only.

LAPACK takes one matrix after the other and branches at every turn. Here the lanes are the members of a batch, so nothing
branches: a step works on the last diagonal block of each matrix that is larger than two by two, and what it has to
leave alone is masked.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from .._fuse import fused

_SWEEPS = 3  # of balancing
_PATIENCE = 10  # steps until an exceptional shift, as in EISPACK and LAPACK
_MOST_STEPS = 30  # for each eigenvalue, as in LAPACK


def qr_eigenvalues(A: Float[Array, "b n n"]) -> Complex[Array, "b n"]:
    """Eigenvalues of a batch of small matrices, backward stable as LAPACK's; conjugate pairs stand side by side.

    Francis' QR algorithm on balanced Hessenberg matrices (Golub and Van Loan, Matrix Computations, 4th ed.,
    Algorithms 7.4.2 and 7.5.1; the shifts are those of EISPACK's hqr). NaN for a matrix that is not finite, and for one
    that has not converged after 30 n steps.
    """
    finite = jnp.all(jnp.isfinite(A), axis=(1, 2))
    H, unfinished = jax.vmap(_hessenberg)(jnp.where(finite[:, None, None], A, 0.0))

    def going(carry):
        return jnp.any(carry[1]) & (carry[2] < _MOST_STEPS * A.shape[-1])

    def step(carry):
        H, _, k = carry
        return *jax.vmap(_step, in_axes=(0, None))(H, k % _PATIENCE == _PATIENCE - 1), k + 1

    H, unfinished, _ = jax.lax.while_loop(going, step, (H, unfinished, jnp.zeros((), int)))
    real, imaginary = jax.vmap(_of_blocks)(H)
    good = (finite & ~unfinished)[:, None]
    return jax.lax.complex(jnp.where(good, real, jnp.nan), jnp.where(good, imaginary, jnp.nan))


@fused
def _hessenberg(A):
    """H (n, n), similar to A and zero below its subdiagonal; whether it has a block that is larger than two by two."""
    n, H = len(A), [list(row) for row in A]
    # Balancing: rows and columns of equal size, as far as a diagonal similarity can (Osborne 1960)
    for _ in range(_SWEEPS):
        for i in range(n):
            row = _norm([H[i][j] for j in range(n) if j != i])
            column = _norm([H[j][i] for j in range(n) if j != i])
            f = jnp.where((row > 0) & (column > 0), jnp.sqrt(row / column), 1.0)
            H[i] = [x / f if j != i else x for j, x in enumerate(H[i])]
            for j in range(n):
                H[j][i] = H[j][i] * f if j != i else H[j][i]
    for k in range(1, n - 1):
        x = [H[i][k - 1] for i in range(k, n)]
        length, v, w = _reflector(x, jnp.sum(jnp.abs(jnp.stack(x[1:]))) > 0)
        _reflect(H, k, v, w, columns=range(k, n), rows=range(n))
        H[k][k - 1] = length
        for i in range(k + 1, n):
            H[i][k - 1] = jnp.zeros_like(length)
    return _deflated(H)


@fused
def _step(H, exceptional):
    """One double-shift step on the last block that is larger than two by two; then what has become small is zero."""
    n, H = len(H), [list(row) for row in H]
    linked = [H[k + 1][k] != 0 for k in range(n - 1)]
    # inside[k]: rows k and k + 1 belong to the block; last[k]: they are its last two.
    inside, last, found = [None] * (n - 1), [jnp.asarray(False)] * (n - 1), jnp.asarray(False)
    below = found
    for k in reversed(range(n - 1)):
        if k > 0:
            last[k] = linked[k] & linked[k - 1] & ~found
        found = found | last[k]
        inside[k] = below = linked[k] & (below | last[k])
    first = [inside[0], *(inside[k] & ~inside[k - 1] for k in range(1, n - 1))]
    # The shifts are the eigenvalues of the last two rows [[a, b], [c, d]], of which bc is the product b c.
    zero = jnp.zeros_like(H[0][0])

    def at_end(entries):
        return sum((jnp.where(is_last, x, 0.0) for is_last, x in zip(last[1:], entries, strict=True)), zero)

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
    n, eps, tiny = len(H), float(jnp.finfo(H[0][0].dtype).eps), float(jnp.finfo(H[0][0].dtype).tiny)
    size = [abs(H[k + 1][k]) for k in range(n - 1)]
    for k in range(n - 1):
        a, b, c, d = H[k][k], H[k][k + 1], H[k + 1][k], H[k + 1][k + 1]
        near = abs(a) + abs(d)
        beside = [size[i] for i in (k - 1, k + 1) if 0 <= i < n - 1]
        near = jnp.where(near == 0, sum(beside, jnp.zeros_like(near)), near)
        larger, smaller = jnp.maximum(abs(b), abs(c)), jnp.minimum(abs(b), abs(c))
        e, f = jnp.maximum(abs(d), abs(a - d)), jnp.minimum(abs(d), abs(a - d))
        s = e + larger
        agree = smaller * (larger / s) <= jnp.maximum(tiny, eps * (f * (e / s)))
        small = (size[k] <= tiny / eps) | ((size[k] <= eps * near) & agree)
        H[k + 1][k] = jnp.where(small, 0.0, c)
    linked = [H[k + 1][k] != 0 for k in range(n - 1)]
    unfinished = jnp.asarray(False)
    for above, below in zip(linked, linked[1:]):
        unfinished = unfinished | (above & below)
    return jnp.stack([jnp.stack(row) for row in H]), unfinished


@fused
def _of_blocks(H):
    """Real and imaginary parts (n,) of the eigenvalues of a matrix with diagonal blocks of one and two rows."""
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
    return jnp.stack(real), jnp.stack(imaginary)


def _norm(x: Sequence[Any]) -> Any:
    total = abs(x[0])
    for x_i in x[1:]:
        total = total + abs(x_i)
    return total


def _reflector(x: Sequence[Any], active: Any) -> tuple[Any, list[Any], list[Any]]:
    """Householder's reflection 1 - w v^T that moves x to (length, 0, ..., 0), or the identity."""
    size = _norm(x)
    active = active & (size > 0)
    scale = 1.0 / jnp.where(active, size, 1.0)
    y = [x_i * scale for x_i in x]
    s = y[0] * y[0]
    for y_i in y[1:]:
        s = s + y_i * y_i
    s = jnp.sqrt(jnp.where(active, s, 1.0))
    s = jnp.where(y[0] < 0, -s, s)
    first = y[0] + s
    by_first, by_s = 1.0 / jnp.where(active, first, 1.0), jnp.where(active, 1.0 / s, 0.0)
    v = [jnp.ones_like(size), *(y_i * by_first for y_i in y[1:])]
    w = [first * by_s, *(y_i * by_s for y_i in y[1:])]
    return jnp.where(active, -s * size, x[0]), v, w


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
