"""Inputs that are held from sample to sample: exact motions, and their derivatives by the times of the jumps."""

import diffrax
import jax
import numpy as np
import pytest

import jaxkane as jk

ts = np.linspace(0.0, 1.0, 6)
values = np.array([1.0, -2.0, 0.5, 3.0, -1.0, 4.0])


class Cart(jk.System):
    coordinates = ("place",)
    speeds = ("speed",)
    inputs = ("push",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(1.0, 0.0, O.moving(q[0] * N.x, u[0] * N.x, frame=N), name="cart")])

    def loads(self, t, q, u, motion, inputs):
        return jk.Force(inputs["push"] * motion.N.x, motion["cart"])


def place(t, delay):
    """Twice the integral of the held values."""
    jumps = np.concatenate([[values[0]], np.diff(values)])
    since = [t, *(np.maximum(t - ts[1:] - delay, 0.0))]
    return sum(jump * s**2 / 2 for jump, s in zip(jumps, since, strict=True))


def end(delay, adjoint="auto"):
    push = jk.Samples(ts + delay, values, hold=True)
    return jk.simulate(Cart(), jk.State([0.0], [0.0]), [0.0, 0.5, 1.0], {"push": push}, adjoint=adjoint)["place"]


@pytest.mark.slow
def test_the_exact_motion_and_its_derivative_by_a_delay():
    found, slope = jax.jit(lambda d: jax.jvp(lambda d: end(d, "forward"), (d,), (1.0,)))(0.03)
    exact = [place(t, 0.03) for t in (0.0, 0.5, 1.0)]
    np.testing.assert_allclose(found, exact, atol=1e-12)
    h = 1e-6
    np.testing.assert_allclose(slope, [(place(t, 0.03 + h) - place(t, 0.03 - h)) / (2 * h) for t in (0, 0.5, 1)], 1e-8)
    reverse = jax.jit(jax.grad(lambda d: end(d)[-1]))(0.03)
    assert float(reverse) == pytest.approx(float(slope[-1]), rel=1e-9)


def test_steps_of_one_length_that_end_at_the_samples():
    push = jk.Samples(ts, values, hold=True)
    ride = jk.simulate(Cart(), jk.State([0.0], [0.0]), ts, {"push": push}, step=0.1, solver=diffrax.Bosh3())
    np.testing.assert_allclose(ride["place"], [place(t, 0.0) for t in ts], atol=1e-13)
    np.testing.assert_array_equal(ride["push"], values)
    with pytest.raises(ValueError, match="Tsit5 reads the end of a step, where the next sample begins"):
        jk.simulate(Cart(), jk.State([0.0], [0.0]), ts, {"push": push}, step=0.1)


def test_what_is_no_hold_is_refused():
    with pytest.raises(TypeError, match="`hold` is True or False, got 'zero'"):
        jk.Samples(ts, values, hold="zero")
