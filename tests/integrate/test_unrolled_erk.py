"""Stages that are written out give the numbers, and the derivatives, of diffrax's loop over them."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane._integrate.solvers import UnrolledERK
from jaxkane._kane.right_hand_side import rates_are_native
from jaxkane._scalarjit.backends import native as native_kernels
from jaxkane._system.system import packed


def motion(solver, jump, args):
    """A pendulum at eight times, whose length changes at a jump."""

    def rates(t, y, args):
        return jnp.stack([y[1], -args * jnp.where(t < 0.9, 1.0, 2.0 if jump else 1.0) * jnp.sin(y[0])])

    control = diffrax.PIDController(rtol=1e-7, atol=1e-7)
    if jump:
        control = diffrax.ClipStepSizeController(control, jump_ts=jnp.array([0.9]))
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(rates),
        solver,
        0.0,
        2.0,
        0.1,
        jnp.array([1.0, 0.3]),
        args,
        saveat=diffrax.SaveAt(ts=jnp.linspace(0.1, 2.0, 8)),
        stepsize_controller=control,
        adjoint=diffrax.ForwardMode(),
    )
    return solution.ys, solution.stats["num_steps"]


# FSAL with a jump, after which the first stage is made anew; one that is neither FSAL nor SSAL.
@pytest.mark.weekly
@pytest.mark.parametrize(
    ("method", "jump"), [(diffrax.Tsit5, True), pytest.param(diffrax.Dopri8, False, marks=pytest.mark.weekly)]
)
def test_unrolled_stages_give_the_same_steps_values_and_derivatives(method, jump):
    rtol = 1e-11
    found = []
    for solver in (method(), UnrolledERK(method())):
        of_gravity = jax.jit(lambda x, s=solver: jax.jvp(lambda x: motion(s, jump, x), (x,), (1.0,)))
        found.append(of_gravity(9.81))
    ((y, steps), (slope, _)), ((other, others), (other_slope, _)) = found
    assert steps == others
    np.testing.assert_allclose(other, y, rtol=rtol, atol=rtol)
    np.testing.assert_allclose(other_slope, slope, rtol=rtol, atol=rtol)


@pytest.mark.slow
def test_stages_are_unrolled_if_the_right_hand_side_is_a_native_kernel(native):
    system = jk.catalog.DoublePendulum(mass=1.0, length=0.7)
    y = packed(jk.State(jnp.zeros(2), jnp.zeros(2)))
    assert rates_are_native(system, jnp.zeros(()), y, {})
    native_kernels.use(False)
    try:
        assert not rates_are_native(system, jnp.zeros(()), y, {})
    finally:
        native_kernels.use(True)


class Rod(jk.System):
    mass: jk.Scalar = jk.parameter(1.0, positive=True)
    length: jk.Scalar = jk.parameter(0.5)
    coordinates, speeds = ("angle",), ("rate",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        A = N.rotate(3, q["angle"], u["rate"])
        return jk.Motion([jk.Body(self.mass, 0.0, O.fixed(-self.length * A.y))])

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -9.81 * motion.N.y)


@pytest.mark.weekly
def test_a_massless_batch_member_does_not_affect_the_gradients_of_others():
    def ends(length, masses):
        start, ts = jk.State({"angle": 0.3}, {}), jnp.linspace(0.0, 0.5, 3)
        return jax.vmap(lambda m: jk.simulate(Rod(m, length), start, ts, adjoint="reverse").q[-1, 0])(masses)

    slope = jax.jit(jax.grad(lambda length, masses: ends(length, masses)[0]))
    expected = slope(0.5, jnp.array([1.0, 2.0]))
    assert slope(0.5, jnp.array([1.0, 0.0])) == expected
    assert slope(0.5, jnp.array([1.0, jnp.nan])) == expected
