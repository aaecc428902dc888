"""Stages of fixed steps give the numbers, and the derivatives, of diffrax's loop over them."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk


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


@pytest.mark.weekly
@pytest.mark.parametrize("method", [diffrax.Tsit5(), diffrax.Dopri8()], ids=["FSAL", "neither FSAL nor SSAL"])
def test_steps_and_derivatives_equal_those_of_diffrax(method):
    rtol, start, ts = 1e-11, jk.State({"angle": 1.0}, {"rate": 0.3}), jnp.linspace(0.0, 0.5, 6)

    def ours(length):
        ride = jk.simulate(Rod(1.0, length), start, ts, solver=method, step=0.05, adjoint="forward")
        return jnp.stack([ride["angle"], ride["rate"]])

    def theirs(length):
        term, args = jk.ode_term(Rod(1.0, length))
        y0 = jk.State(jnp.array([1.0]), jnp.array([0.3]))
        saveat, adjoint = diffrax.SaveAt(ts=ts), diffrax.ForwardMode()
        control = diffrax.StepTo(jnp.linspace(0.0, 0.5, 11))
        found = diffrax.diffeqsolve(
            term, method, 0.0, 0.5, None, y0, args, saveat=saveat, stepsize_controller=control, adjoint=adjoint
        )
        return jnp.stack([found.ys.q[:, 0], found.ys.u[:, 0]])

    (value, slope), expected = (jax.jit(lambda x, f=f: jax.jvp(f, (x,), (1.0,)))(0.7) for f in (ours, theirs))
    np.testing.assert_allclose(value, expected[0], rtol=rtol, atol=rtol)
    np.testing.assert_allclose(slope, expected[1], rtol=rtol, atol=rtol)
