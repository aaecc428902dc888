"""Eigenvalues of matrices, alone and with vectors: accurate, in a fixed order, and with derivatives of any order."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxkane.stability import LinearModel

MANY = 300  # matrices in a batch that is not solved by LAPACK, if there are native kernels
KINDS = "random scaled graded orthogonal cyclic defective stiff free symmetric tiny huge".split()


def model(A):
    return LinearModel(A, A, A, A, (), (), ())


def eig(A):
    return model(A).eig


def eigvals(A):
    return model(A).eigenvalues


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
def by_kind():
    found = np.asarray(jax.jit(jax.vmap(eigvals))(np.concatenate([*map(matrices, KINDS)])))
    return dict(zip(KINDS, np.split(found, len(KINDS)), strict=True))


@pytest.mark.parametrize("kind", KINDS)
def test_eigenvalues_are_backward_stable(native, kind, by_kind):
    """Backward stability: A + E has it, and the norm of E is the least singular value of A - lambda."""
    tolerance, A, found = 1e-14, matrices(kind), by_kind[kind]
    size = np.abs(A).max(axis=(1, 2))
    A, values = A / size[:, None, None], found / size[:, None]
    E = np.linalg.svd(A[:, None] - values[:, :, None, None] * np.eye(4), compute_uv=False)[..., -1]
    assert E.max() < tolerance
    np.testing.assert_allclose(values.sum(axis=1), np.trace(A, axis1=1, axis2=2), atol=1e-14)
    np.testing.assert_array_equal(np.sort_complex(found.conj()), np.sort_complex(found))  # in pairs


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["scaled", "stiff"])
def test_small_eigenvalues_next_to_large_ones_are_accurate(native, kind, by_kind):
    """Against forty digits, each to its own size; balancing sees to that. LAPACK is off by up to 1e-9 there."""
    rtol, mpmath = 1e-9, pytest.importorskip("mpmath")
    with mpmath.workdps(40):
        exact = [mpmath.eig(mpmath.matrix(A.tolist()), left=False, right=False) for A in matrices(kind)]
    reference = np.array([[complex(x) for x in values] for values in exact])
    far = np.abs(by_kind[kind][:, :, None] - reference[:, None, :]) / np.abs(reference)[:, None, :]
    assert far.min(axis=1).max() < rtol


@pytest.mark.slow
def test_non_finite_matrices_do_not_affect_other_batch_members(native):
    A = np.tile(np.eye(4), (MANY, 1, 1))
    A[1, 2, 0], A[2, 3, 3] = np.nan, np.inf
    A[3] = 0.0
    found = np.asarray(jax.jit(jax.vmap(eigvals))(A))
    np.testing.assert_array_equal(found[[0, 3]], [[1.0] * 4, [0.0] * 4])
    assert np.isnan(found[1:3]).all()


@pytest.mark.slow
@pytest.mark.parametrize("n", [3, 7])
def test_eigenvalues_of_a_batch_equal_those_of_its_members(n):
    """Whether by QR or by LAPACK, with one leading axis or two, in single precision too."""
    A = np.random.default_rng(n).standard_normal((2, MANY, n, n))
    single = np.stack([np.linalg.eigvals(a) for a in A[0, :10]])
    ways = [(jax.jit(eigvals)(A)[0], 1e-12), (jax.vmap(lambda a: eig(a).values)(A[0, :10]), 1e-12)]
    ways.append((eigvals(jnp.asarray(A[0], jnp.float32)), 1e-4))
    for found, tolerance in ways:
        far = np.abs(np.asarray(found)[:10, :, None] - single[:, None, :]).min(axis=1).max(axis=1)
        assert (far < tolerance * np.abs(single).max(axis=1)).all()


@pytest.mark.slow
@pytest.mark.parametrize("kernels", ["native", pytest.param("XLA", marks=pytest.mark.weekly)], indirect=True)
def test_eigenvalue_order_is_the_same_in_batches_members_and_derivatives(kernels):
    """Pendulums without and with damping, whose real parts are rounding errors or not."""
    atol, rng = 1e-12, np.random.default_rng(0)
    A = np.zeros((MANY, 4, 4))
    A[:, 2:, :2], A[:, :2, 2:] = -(np.eye(2) + (X := rng.standard_normal((len(A), 2, 2))) @ X.swapaxes(1, 2)), np.eye(2)
    A[::3, 2:, 2:] = -5.0 * rng.random((len(A[::3]), 1, 1)) * np.eye(2)
    batch = np.asarray(jax.jit(jax.vmap(eigvals))(A))
    values, slopes = jax.jit(jax.vmap(lambda a: jax.jvp(eigvals, (a,), (a,))))(A)
    np.testing.assert_array_equal(values, batch)
    np.testing.assert_allclose(slopes, batch, atol=atol)  # d lambda(s A) / ds at s = 1
    single = jax.jit(eigvals)
    np.testing.assert_allclose(np.stack([single(a) for a in A[:50]]), batch[:50], atol=atol)
    np.testing.assert_allclose(jax.jit(jax.vmap(lambda a: eig(a).values))(A), batch, atol=atol)
    np.testing.assert_allclose(eigvals(A[:50]), batch[:50], atol=atol)
    frequency = np.abs(batch.imag)
    assert np.all(np.diff(frequency, axis=1) >= 0)


THREADS = """
import sys, threading
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
from jaxkane.stability import LinearModel

@jax.jit
def both(A):
    A = jax.lax.fori_loop(0, 5, lambda i, X: jnp.sin(X @ A) + X, A)  # leaves the program to XLA's threads
    model = LinearModel(A, A, A, A, (), (), ())
    return model.eigenvalues, tuple(model.eig)

n = int(sys.argv[1])
A = np.random.default_rng(0).standard_normal((4000, n, n))
jax.block_until_ready(both(A))
work = lambda: [jax.block_until_ready(both(A)) for _ in range(40)]
threads = [threading.Thread(target=work) for _ in range(3)]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
print("done")
"""


@pytest.mark.weekly
@pytest.mark.parametrize("n", [4, 7])
def test_programs_in_several_threads_do_not_deadlock(n):
    """jaxlib's batched LAPACK waits in XLA's threads for XLA's threads. Matrices of 7 rows use LAPACK alone."""
    run = subprocess.run([sys.executable, "-c", THREADS, str(n)], capture_output=True, text=True, timeout=580)
    assert run.stdout == "done\n", run.stderr


# -- derivatives


def pair(p):
    """Coefficients of x^2 + 2 d x + k: eigenvalues -d +- sqrt(d^2 - k), closed to any order."""
    d, k = p
    return jnp.stack([jnp.stack([jnp.zeros_like(d), jnp.ones_like(d)]), jnp.stack([-k, -2 * d])])


REVERSE_TWICE = lambda f: jax.jacrev(jax.jacrev(f))  # noqa: E731


@pytest.mark.weekly
def test_second_derivatives_of_eigenvalues_agree_with_closed_forms():
    rtol = 1e-11
    oscillating = jax.hessian(lambda p: (-p[0], jnp.sqrt(p[1] - p[0] ** 2)))
    decaying = jax.hessian(lambda p: (-p[0] + jnp.sqrt(p[0] ** 2 - p[1]), 0.0 * p[0]))
    for way, mode in ((lambda A: eig(A).values, REVERSE_TWICE), (eigvals, jax.hessian)):

        def largest(p, way=way):
            values = way(pair(p))
            return jnp.max(values.real), jnp.max(values.imag)

        second = jax.jit(mode(largest))
        for p, exact in ((jnp.array([0.3, 2.0]), oscillating), (jnp.array([1.5, 0.7]), decaying)):
            for x, y in zip(second(p), exact(p), strict=True):
                np.testing.assert_allclose(x, y, rtol=rtol, atol=1e-12)


@pytest.mark.weekly
def test_third_derivatives_and_eigenvectors_agree_with_differences():
    """Of a general matrix: a parameter moves all of it; vectors as LAPACK scales them."""
    rtol, h = 1e-7, 1e-4
    A, B, C = np.random.default_rng(3).standard_normal((3, 3, 3))

    def along(p):
        return tuple(eig(A + p * B + p**2 * C))

    @jax.jit
    def found(p):
        """Of all of them the values and slopes; of the eigenvalues the second and the third derivatives."""
        second = jax.jacfwd(jax.jacfwd(lambda p: along(p)[0]))
        twice = lambda f: lambda p: (value := f(p), value)  # noqa: E731
        return *jax.jacfwd(twice(along), has_aux=True)(p)[::-1], *jax.jacfwd(twice(second), has_aux=True)(p)[::-1]

    _, slopes, _, third = found(0.0)
    by_differences = jax.tree.map(
        lambda a, b, c, d: (8 * (a - b) - (c - d)) / (12 * h), *(found(k * h) for k in (1, -1, 2, -2))
    )
    for x, y in zip(slopes, by_differences[0], strict=True):
        np.testing.assert_allclose(x, y, rtol=rtol, atol=1e-9)
    y = by_differences[2]
    np.testing.assert_allclose(third, y, rtol=rtol, atol=rtol * np.abs(y).max())


# 3, 1 and 1, of which the last two are one defective, or one semisimple double root
COALESCING = [jnp.array([[1.0, coupled, 0.2], [0.0, 1.0, 0.3], [0.0, 0.0, 3.0]]) for coupled in (1.0, 0.0)]


@pytest.mark.slow
@pytest.mark.parametrize("mode", [REVERSE_TWICE, pytest.param(jax.hessian, marks=pytest.mark.weekly)])
def test_a_separate_eigenvalue_is_differentiable_while_others_coalesce(mode):
    rtol = 1e-11
    B = jnp.array([[0.1, 0.4, 0.2], [0.3, 0.2, -0.5], [0.7, 0.6, 0.5]])
    second = jax.jit(mode(lambda p, A: eigvals(A + p * B).real))
    for A in COALESCING:
        found = second(0.0, A)
        np.testing.assert_array_equal(np.isnan(found), [False, True, True])
        # lambda'' = 2 y B (lambda - A)^+ B x, the pseudoinverse clear of x and y: by the projection off x y^T
        values, left, right = map(np.asarray, (eig(A).values.real, eig(A).left.real, eig(A).vectors.real))
        x, y = right[:, 0], left[:, 0] / (left[:, 0] @ right[:, 0])
        P = np.eye(3) - np.outer(x, y)
        S = P @ np.linalg.inv(values[0] * np.eye(3) - np.asarray(A) + np.outer(x, y)) @ P
        np.testing.assert_allclose(found[0], 2 * y @ B @ S @ B @ x, rtol=rtol)
        np.testing.assert_array_equal(np.isinf(eig(A).condition), [False, True, True])


@pytest.mark.weekly
def test_unread_coalescing_eigenvalues_add_no_nan_in_reverse_mode():
    hessian_of_first = jax.jit(jax.hessian(lambda A: eigvals(A).real[0]))
    assert all(np.isfinite(hessian_of_first(A)).all() for A in COALESCING)


def test_eigenvalues_in_single_precision_and_of_empty_batches():
    slope = jax.jit(jax.jacfwd(lambda p: eigvals(pair(p)).real))(jnp.array([1.5, 0.7], jnp.float32))
    assert slope.dtype == jnp.float32
    assert np.isfinite(slope).all()
    none = jax.eval_shape(jax.vmap(jax.hessian(lambda p: eigvals(pair(p)).real)), jnp.zeros((0, 2)))
    assert none.shape == (0, 2, 2, 2)
    assert eigvals(jnp.zeros((0, 3, 3))).shape == (0, 3)
    found = jax.jit(lambda A: tuple(eig(A)))(jnp.full((3, 3), jnp.nan))
    assert all(np.isnan(x).all() for x in (found[0], found[-1]))
