"""Programs that solve linear equations: derivatives are those of the equations, in every transformation."""

import functools
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxkane import catalog
from jaxkane._kane.right_hand_side import _vector_field
from jaxkane._scalarjit.compat import jaxpr_as_fun
from jaxkane._scalarjit.components import as_vector, solve_positive
from jaxkane._scalarjit.elimination import LinearSolution
from jaxkane._scalarjit.scalar_function import ScalarFunction


def matrix_and_forces(a, z):
    M = [[2.0 + a * a, jnp.sin(z[0])], [jnp.sin(z[0]), 3.0 + z[1] ** 2]]
    return M, [1.5 * jnp.cos(z[1]) - a, a * z[0] * z[2]]


def plain(a, z):
    return z[:2] * a, as_vector(solve_positive(*matrix_and_forces(a, z)), z)


def equations(a, z, x, r):
    M, b = matrix_and_forces(a, z)
    residual = [b_i - row[0] * x[0] - row[1] * x[1] for row, b_i in zip(M, b)]
    return z[:2] * a, as_vector(residual, z), as_vector(solve_positive(M, (r[0], r[1])), z)


def doubled_equations(a, z, x, r):
    others, residual, solution = equations(a, z, x, r)
    return others, 2.0 * residual, solution


solution = LinearSolution(plain, equations)
doubled = LinearSolution(plain, doubled_equations)
ARGUMENTS = (jnp.array(0.7), jnp.array([0.3, 0.9, -0.4]))


@ScalarFunction
def around_solution(a, z):
    others, x = solution(a * z[0], z)
    return jnp.stack([others[0] * x[1], x[0] ** 2 + a])


def around_batch_of(f):
    def around(a, z):
        _, x = jax.vmap(f, (0, None))(jnp.stack([a, 2.0 * a]), z)
        return jnp.stack([x[0, 0] * x[1, 1], x[1, 0]])

    return around


around_batch, around_plain_batch = ScalarFunction(around_batch_of(solution)), around_batch_of(plain)


@ScalarFunction
def around_doubled(a, z):
    return doubled(a, z)[1] * 3.0


def around_plain(a, z):
    others, x = plain(a * z[0], z)
    return jnp.stack([others[0] * x[1], x[0] ** 2 + a])


def total(f):
    return lambda a, z: sum(jnp.sum(jnp.sin(y)) for y in jax.tree.leaves(f(a, z)))


TRANSFORMATIONS = {
    "itself": lambda f: f,
    "forward": lambda f: jax.jacfwd(f, (0, 1)),
    "reverse": lambda f: jax.jacrev(f, (0, 1)),
    "along one argument": lambda f: jax.jacfwd(f, 1),
    "hessian": lambda f: jax.hessian(total(f), (0, 1)),
    "reverse of reverse": lambda f: jax.jacrev(jax.grad(total(f)), 1),
    "linearize": lambda f: lambda *args: jax.linearize(f, *args)[1](*args),
    "batch of gradients": lambda f: lambda a, z: jax.vmap(jax.grad(total(f), (0, 1)), (None, 0))(a, jnp.stack([z, -z])),
    "gradient of a batch": lambda f: jax.grad(
        lambda a, z: jax.vmap(total(f), (0, None))(jnp.stack([a, 2 * a]), z).sum(), (0, 1)
    ),
    "gradient of a loop": lambda f: jax.grad(
        lambda a, z: jax.lax.scan(lambda c, _: (jax.tree.leaves(f(c, z))[-1][0], c), a, length=4)[0], (0, 1)
    ),
}


@functools.cache
def by_plain_jax(name, f):
    return jax.jit(TRANSFORMATIONS[name](f))(*ARGUMENTS)


@pytest.mark.weekly_cases(all_but=["native-a batch in another-*", "native-alone-linearize"])
@pytest.mark.parametrize("name", TRANSFORMATIONS)
@pytest.mark.parametrize(
    ("f", "g"),
    [(solution, plain), (around_solution, around_plain), (around_batch, around_plain_batch)],
    ids=["alone", "in another", "a batch in another"],
)
def test_results_agree_with_plain_jax(name, f, g, kernels):
    """Operation by operation too, but for what XLA alone would compile hundreds of."""
    ours, expected = TRANSFORMATIONS[name](f), by_plain_jax(name, g)
    for one in (jax.jit(ours), ours)[: 2 if kernels == "native" or name in ("itself", "forward", "reverse") else 1]:
        found = one(*ARGUMENTS)
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-13, atol=1e-13), found, expected)


@pytest.mark.slow
@pytest.mark.parametrize("jacobian", [jax.jacfwd, jax.jacrev])
def test_derivatives_are_computed_from_the_linear_equations(jacobian):
    """Told that the residual is twice what it is, the derivative of the solution is twice what it was, and nothing
    else."""
    others, x = jacobian(solution, 1)(*ARGUMENTS)
    np.testing.assert_allclose(jacobian(doubled, 1)(*ARGUMENTS)[0], others, rtol=1e-14)
    np.testing.assert_allclose(jacobian(doubled, 1)(*ARGUMENTS)[1], 2.0 * x, rtol=1e-14)
    np.testing.assert_allclose(jacobian(around_doubled, 1)(*ARGUMENTS), 6.0 * x, rtol=1e-14)
    numbers = solution.numpy_jvp([np.asarray(a) for a in ARGUMENTS], (None, np.eye(3)))
    np.testing.assert_allclose(numbers[1], x, rtol=1e-14)


STIFFNESS = 1.5


class Spring(eqx.Module):
    def force(self, x):
        return STIFFNESS * x**2


def at_rest(spring, a, z):
    return as_vector([spring.force(z[0]) / a], z)


def equation_at_rest(spring, a, z, x, r):
    return as_vector([spring.force(z[0]) - a * x[0]], z), as_vector([r[0] / a], z)


at_rest_solution = LinearSolution(at_rest, equation_at_rest)


@ScalarFunction
def around_at_rest(spring, a, z):
    return at_rest_solution(spring, a, z) - 1.0


@pytest.mark.parametrize("f", [at_rest_solution, around_at_rest], ids=["alone", "in another"])
def test_a_stored_program_differentiates_the_equations_that_it_solved(f, monkeypatch):
    """Its equations are traced when the first derivative is asked for, when what they read may have changed."""
    of_z = lambda z: f(Spring(), jnp.array(0.5), z)  # noqa: E731
    kept = jaxpr_as_fun(jax.make_jaxpr(of_z)(ARGUMENTS[1]))
    slope = np.array([[2.0 * ARGUMENTS[1][0] / 0.5, 0.0, 0.0]])
    with monkeypatch.context() as changed:
        changed.setattr(sys.modules[__name__], "STIFFNESS", 4.0)
        np.testing.assert_allclose(jax.jacfwd(kept)(ARGUMENTS[1])[0], 1.5 * slope, rtol=1e-13)
        np.testing.assert_allclose(jax.jacfwd(of_z)(ARGUMENTS[1]), 4.0 * slope, rtol=1e-13)
    np.testing.assert_allclose(jax.jacfwd(of_z)(ARGUMENTS[1]), 1.5 * slope, rtol=1e-13)


def test_singular_equations_have_nan_derivatives(kernels):
    """Not 0."""
    singular = LinearSolution(singular_solution, singular_equations)
    for jacobian in (jax.jacfwd, jax.jacrev):
        assert np.isnan(jacobian(singular, 1)(*ARGUMENTS)[:, :2]).all()


def singular_solution(a, z):
    return as_vector(solve_positive([[a, a], [a, a]], (z[0], z[1])), z)


def singular_equations(a, z, x, r):
    residual = (z[0] - a * (x[0] + x[1]), z[1] - a * (x[0] + x[1]))
    return as_vector(residual, z), as_vector(solve_positive([[a, a], [a, a]], (r[0], r[1])), z)


@pytest.mark.slow
def test_a_derivative_takes_one_and_a_half_times_the_operations_of_the_rates():
    """For the bicycle. The factor was 2.1 when the solution algorithm itself was differentiated."""
    bicycle = catalog.WhippleBicycle.benchmark()
    y = jnp.zeros(len(bicycle.coordinates) + len(bicycle.speeds))
    _, program = _vector_field.program(bicycle, jnp.zeros(()), y, {})
    derivative = program.with_tangent(program.reads)
    assert len(derivative.program.jaxpr.eqns) < 2.6 * len(program.program.jaxpr.eqns)
