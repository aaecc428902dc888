"""Eigenvalues alone and with vectors: accurate, differentiable, and without a wait that never ends."""

import json
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane.stability import linearize, straight_ahead
from jaxkane.stability._matrix_eigenvalues import CHUNK, eig, eigvals, qr_eigenvalues

BIKE = jk.catalog.WhippleBicycle.benchmark()
LATERAL = ("roll", "steer", "roll_rate", "steer_rate")
PUBLISHED = json.loads((Path(__file__).parents[1] / "data" / "meijaard2007.json").read_text())
DOUBLE_ROOT = 0.68428307889246  # [m/s] Meijaard et al. (2007), section 5
KINDS = [
    "random",
    "scaled",
    "graded",
    "orthogonal",
    "cyclic",
    "defective",
    "stiff",
    "free",
    "symmetric",
    "tiny",
    "huge",
]


def matrices(kind):
    """Thirty matrices (30, 4, 4) of a kind that is difficult in its own way."""
    rng = np.random.default_rng(KINDS.index(kind))
    X = rng.standard_normal((30, 4, 4))
    D = np.array([1e-6, 1.0, 1e4, 1e8])
    Q = np.linalg.qr(X)[0]
    second_order = np.zeros_like(X)
    second_order[:, :2, 2:], second_order[:, 2:, 2:] = np.eye(2), -X[:, :2, :2]
    match kind:
        case "scaled":
            return D[:, None] * X / D
        case "graded":
            return np.sqrt(D[:, None] * D) * X
        case "orthogonal":
            return Q
        case "cyclic":  # unmoved by the usual shifts
            return np.stack([np.roll(np.eye(4), 1 + i % 3, axis=0) for i in range(30)])
        case "defective":
            return Q @ (2 * np.eye(4) + np.diag([1.0, 1.0, 0.0], 1)) @ Q.transpose(0, 2, 1)
        case "stiff":
            second_order[:, 2:, :2] = -1e6 * X[:, :2, :2] @ X[:, :2, :2].transpose(0, 2, 1)
            return second_order
        case "free":  # nothing pulls back: eigenvalues of zero
            return second_order
        case "symmetric":
            return X + X.transpose(0, 2, 1)
    return X * {"random": 1.0, "tiny": 1e-290, "huge": 1e290}[kind]


@pytest.fixture(scope="module")
def by_qr():
    return dict(
        zip(
            KINDS,
            np.split(
                np.asarray(jax.jit(jax.vmap(qr_eigenvalues))(np.concatenate([*map(matrices, KINDS)]))), len(KINDS)
            ),
        )
    )


@pytest.mark.parametrize("kind", KINDS)
def test_eigenvalues_are_backward_stable(kind, by_qr):
    """Backward stability: A + E has it, and the norm of E is the least singular value of A - lambda."""
    tolerance, A, found = 1e-14, matrices(kind), by_qr[kind]
    size = np.abs(A).max(axis=(1, 2))
    A, values = A / size[:, None, None], found / size[:, None]
    E = np.linalg.svd(A[:, None] - values[:, :, None, None] * np.eye(4), compute_uv=False)[..., -1]
    assert E.max() < tolerance
    np.testing.assert_allclose(values.sum(axis=1), np.trace(A, axis1=1, axis2=2), atol=1e-14)
    np.testing.assert_array_equal(np.sort_complex(found.conj()), np.sort_complex(found))  # in pairs


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["scaled", "stiff"])
def test_small_eigenvalues_next_to_large_ones_are_accurate(kind, by_qr):
    """Against forty digits, each to its own size; balancing sees to that. LAPACK is off by up to 1e-9 there."""
    rtol, mpmath = 1e-9, pytest.importorskip("mpmath")
    with mpmath.workdps(40):
        exact = [mpmath.eig(mpmath.matrix(A.tolist()), left=False, right=False) for A in matrices(kind)]
    reference = np.array([[complex(x) for x in values] for values in exact])
    far = np.abs(by_qr[kind][:, :, None] - reference[:, None, :]) / np.abs(reference)[:, None, :]
    assert far.min(axis=1).max() < rtol


@pytest.mark.slow
def test_non_finite_matrices_do_not_affect_other_batch_members():
    A = np.tile(np.eye(4), (4, 1, 1))
    A[1, 2, 0], A[2, 3, 3] = np.nan, np.inf
    A[3] = 0.0
    found = np.asarray(jax.jit(jax.vmap(qr_eigenvalues))(A))
    np.testing.assert_array_equal(found[[0, 3]], [[1.0] * 4, [0.0] * 4])
    assert np.isnan(found[1:3]).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "n", [pytest.param(1, marks=pytest.mark.weekly), 2, pytest.param(3, marks=pytest.mark.weekly), 7]
)
def test_eigenvalues_of_a_batch_equal_those_of_its_members(n):
    """Whether by QR or by LAPACK, with one leading axis or two, in single precision too."""
    A = np.random.default_rng(n).standard_normal((2, CHUNK + 4, n, n))
    single = np.stack([np.linalg.eigvals(a) for a in A[0, :10]])
    ways = [(jax.jit(eigvals)(A)[0], 1e-12), (jax.vmap(lambda a: eig(a).values)(A[0, :10]), 1e-12)]
    if n in (3, 7):  # one of each way
        ways.append((eigvals(jnp.asarray(A[0], jnp.float32)), 1e-4))
    for found, tolerance in ways:
        far = np.abs(np.asarray(found)[:10, :, None] - single[:, None, :]).min(axis=1).max(axis=1)
        assert (far < tolerance * np.abs(single).max(axis=1)).all()


@pytest.mark.slow
@pytest.mark.parametrize("kernels", ["native", pytest.param("XLA", marks=pytest.mark.weekly)], indirect=True)
def test_eigenvalue_order_is_the_same_in_batches_members_and_derivatives(kernels):
    """Pendulums without and with damping, whose real parts are rounding errors or not: the values of a batch are those
    of its members and those beside a derivative, each in its place, and so are those of `eig`."""
    atol, rng = 1e-12, np.random.default_rng(0)
    A = np.zeros((CHUNK + 44, 4, 4))
    A[:, 2:, :2], A[:, :2, 2:] = -(np.eye(2) + (X := rng.standard_normal((len(A), 2, 2))) @ X.swapaxes(1, 2)), np.eye(2)
    A[::3, 2:, 2:] = -5.0 * rng.random((len(A[::3]), 1, 1)) * np.eye(2)
    batch = np.asarray(jax.jit(jax.vmap(eigvals))(A))
    beside, slopes = jax.jit(jax.vmap(lambda a: jax.jvp(eigvals, (a,), (a,))))(A)
    np.testing.assert_array_equal(beside, batch)
    np.testing.assert_allclose(slopes, batch, atol=atol)  # d lambda(s A) / ds at s = 1
    single = jax.jit(eigvals)
    np.testing.assert_allclose(np.stack([single(a) for a in A[:50]]), batch[:50], atol=atol)
    np.testing.assert_allclose(jax.jit(jax.vmap(lambda a: eig(a).values))(A), batch, atol=atol)
    np.testing.assert_allclose(eigvals(A[:50]), batch[:50], atol=atol)
    frequency = np.abs(batch.imag)
    assert np.all(np.diff(frequency, axis=1) >= 0)


@pytest.fixture(scope="module")
def bicycles():
    """The benchmark bicycle at 301 speeds, and at 21 beside its double root."""
    speeds = jnp.concatenate([jnp.linspace(0.0, 10.0, 301), DOUBLE_ROOT + jnp.linspace(-1e-6, 1e-6, 21)])
    return jax.jit(jax.vmap(lambda v: linearize(BIKE, straight_ahead(BIKE, v), states=LATERAL).A))(speeds)


@pytest.mark.weekly
def test_eigenvalues_of_a_batch_of_bicycles_agree_with_the_literature(bicycles, kernels):
    """Meijaard et al. (2007), Table 2, among three hundred others; and beside the double root, as LAPACK's."""
    atol, A = 1e-11, bicycles
    found = np.asarray(jax.jit(jax.vmap(eigvals))(A))
    for row in PUBLISHED["table2"]:
        for real, imaginary in row["eig_published"]:
            assert np.abs(found[int(30 * row["v"])] - complex(real, imaginary)).min() < atol
    # The mean of the two that meet is as good as any; their distance is the root of a rounding error
    lapack = np.linalg.eigvals(np.asarray(A[301:]))
    for x, y in zip(found[301:], lapack, strict=True):
        pair, other = (np.sort_complex(z[np.argsort(-z.real)][:2]) for z in (x, y))
        np.testing.assert_allclose(pair.mean(), other.mean(), atol=1e-12)
        np.testing.assert_allclose((pair[1] - pair[0]) ** 2, (other[1] - other[0]) ** 2, atol=1e-13)


@pytest.mark.weekly
@pytest.mark.parametrize("kernels", ["native", pytest.param("XLA", marks=pytest.mark.weekly)], indirect=True)
def test_derivatives_of_eigvals_and_eig_agree(kernels):
    rtol = 1e-12
    A = np.random.default_rng(0).standard_normal((CHUNK, 3, 3))
    of_each = lambda f: jax.jit(jax.vmap(jax.jacrev(lambda a: jnp.sum(f(a).real ** 2))))(A)  # noqa: E731
    np.testing.assert_allclose(of_each(eigvals), of_each(lambda a: eig(a).values), rtol=rtol)
    slopes = jax.jacfwd(lambda a: eigvals(a).real)(jnp.array([[1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 2.0]]))
    np.testing.assert_array_equal(np.isnan(slopes).any(axis=(1, 2)), [False, True, True])


THREADS = """
import sys, threading
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
from jaxkane._scalarjit import native
from jaxkane.stability._matrix_eigenvalues import eig, eigvals
native.use(sys.argv[1] == "native")

@jax.jit
def both(A):
    A = jax.lax.fori_loop(0, 5, lambda i, X: jnp.sin(X @ A) + X, A)  # leaves the program to XLA's threads
    return eigvals(A), eig(A)

A = np.random.default_rng(0).standard_normal((4000, 4, 4))
jax.block_until_ready(both(A))
work = lambda: [jax.block_until_ready(both(A)) for _ in range(40)]
threads = [threading.Thread(target=work) for _ in range(3)]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
print("done")
"""


@pytest.mark.weekly
@pytest.mark.parametrize("way", ["native", "LAPACK"])
def test_programs_in_several_threads_do_not_deadlock(way):
    """jaxlib's batched LAPACK waits in XLA's threads for XLA's threads: each of these programs once hung for ever."""
    run = subprocess.run([sys.executable, "-c", THREADS, way], capture_output=True, text=True, timeout=240, check=False)
    assert run.stdout == "done\n", run.stderr
