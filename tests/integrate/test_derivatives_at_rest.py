"""Derivatives where the motion, or a part of it, rests: its own error says nothing about their steps."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from mechanisms import Sled

import jaxkane as jk

A = np.array([[0.0, 1.0], [-1.0, -0.2]])  # of the oscillator below


class Oscillator(jk.System):
    """A block of 1 kg on a spring, beside a second block on a stiff spring."""

    damping: jk.Scalar = jk.parameter(0.2)
    force: jk.Scalar = jk.parameter(0.0)
    stiffness: jk.Scalar = jk.parameter(400.0)
    amplitude: jk.Scalar = jk.parameter(0.0)
    inputs = ("push",)
    coordinates, speeds = ("x", "y"), ("v", "w")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        x, y = O.moving(q["x"] * N.x, u["v"] * N.x), O.moving(q["y"] * N.y, u["w"] * N.y)
        return jk.Motion([jk.Body(1.0, 0.0, x, name="slow"), jk.Body(1.0, 0.0, y, name="fast")])

    def loads(self, t, q, u, motion, inputs):
        slow = self.force + inputs["push"] - q["x"] - self.damping * u["v"]
        fast = self.amplitude * jnp.sin(30.0 * t) - self.stiffness * q["y"]
        return [jk.Force(slow * motion.N.x, motion["slow"]), jk.Force(fast * motion.N.y, motion["fast"])]


def end(p, scale=1.0, tolerance=None, **options):
    """x(10) and y(10), from the start, the force, the amplitude and the size of an input that is zero."""
    state = jk.State(p[:2], jnp.zeros(2))
    wave = lambda t, state: p[4] * jnp.sin(30.0 * t)  # noqa: E731
    options |= {} if tolerance is None else {"rtol": tolerance, "atol": tolerance}
    ride = jk.simulate(Oscillator(force=p[2], amplitude=p[3]), state, [0.0, 10.0], {"push": wave}, **options)
    return jnp.stack([ride["x"][-1], ride["y"][-1]])


def right():
    """The matrix of derivatives of `end` at any point, because the equations are linear."""
    w = 30.0
    forced = scipy.integrate.solve_ivp(
        lambda t, z: A @ z + [0.0, np.sin(w * t)], (0, 10), [0.0, 0.0], rtol=1e-12, atol=1e-14, method="DOP853"
    )
    fast = (np.sin(w * 10) - w / 20 * np.sin(200.0)) / (400 - w * w)
    x0 = scipy.linalg.expm(10 * A)[0, 0]
    return np.array([[x0, 0.0, 1 - x0, 0.0, forced.y[0, -1]], [0.0, np.cos(200.0), 0.0, fast, 0.0]])


class Plain(Oscillator):
    """A parameter without `jk.parameter` is a float of Python, not an array."""

    mass: float = 1.0


def test_derivatives_by_a_number_in_an_input_function_of_a_system_with_plain_floats():
    def x(amplitude):
        push = {"push": lambda t, state: amplitude * state.system.mass}
        return jk.simulate(Plain(), jk.State([0.0, 0.0], [0.0, 0.0]), [0.0, 10.0], push)["x"][-1]

    slope = 1 - scipy.linalg.expm(10 * A)[0, 0]
    np.testing.assert_allclose([jax.grad(x)(0.0), jax.jacfwd(x)(0.0)], slope, rtol=1e-5)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("start", [0.0, 1e-9])
def test_derivatives_at_rest_are_those_of_the_closed_form(mode, start):
    """Also of a fast part beside a slow one, and by amplitudes of forces that are zero."""
    for place in ([start, start], [1.0, start]):
        found = jax.jit(mode(end))(jnp.array([*place, 0.0, 0.0, 0.0]))
        np.testing.assert_allclose(found, right(), atol=1e-5)


def test_steps_that_end_at_discontinuities_are_as_fine_at_rest():
    """A step more or less before one of them must not shift the errors that later steps read."""

    def last(y, times):
        return end(jnp.stack([0.0 * y, y, *jnp.zeros(3)]), discontinuities=times)[1]

    for n in (11, 51):
        found = jax.jacfwd(last)(0.0, np.linspace(0, 10, n)[1:-1])
        assert float(found) == pytest.approx(np.cos(200.0), abs=1e-5)


def test_a_small_derivative_of_a_parameter_is_as_accurate_as_a_large_one():
    """For example that of a heavy body by a force that is zero."""
    rest = jk.State([0.0, 0.0], [0.0, 0.0])
    small = lambda p: jk.simulate(Oscillator(amplitude=1e-9 * p), rest, [0.0, 10.0])["y"][-1]  # noqa: E731
    assert 1e9 * float(jax.jacfwd(small)(0.0)) == pytest.approx(right()[1, 3], rel=1e-5)


class Kicked(Oscillator):
    """After one second, the second block is moved to a place."""

    place: jk.Scalar = jk.parameter(0.0)

    def events(self, t, q, u):
        return {"kick": jk.rising(t - 1.0, then={"y": self.place})}


def test_a_parameter_of_a_jump_moves_nothing_before_the_jump():
    rest = jk.State([0.0, 0.0], [0.0, 0.0])
    last = lambda p: jk.simulate(Kicked(place=p), rest, [0.0, 11.0])["y"][-1]  # noqa: E731
    assert float(jax.jacfwd(last)(0.0)) == pytest.approx(np.cos(200.0), abs=1e-5)


@pytest.mark.slow
def test_derivatives_at_rest_become_as_accurate_as_their_tolerance():
    p = jnp.zeros(5)
    np.testing.assert_allclose(jax.jacfwd(lambda p: end(p, tolerance=1e-10))(p), right(), atol=1e-7)


@pytest.mark.slow
def test_one_member_at_rest_beside_one_that_moves():
    p = jnp.array([[0.0, 0.0, 0.0, 0.0, 0.0], [1.0, 0.5, 0.0, 0.2, 0.0]])
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.vmap(mode(end))(p), np.stack([right()] * 2), atol=1e-5)


@pytest.mark.slow
def test_a_value_is_the_same_with_and_without_its_derivative():
    p = jnp.array([0.3, 0.2, 0.1, 0.4, 0.5])
    value = jax.jit(end)(p)
    both = jax.jit(lambda p: jax.jvp(end, (p,), (p,)))(p)
    np.testing.assert_allclose(both[0], value, rtol=1e-14)


@pytest.mark.slow
def test_a_stiff_part_that_has_decayed_does_not_shorten_the_steps():
    """u1' = -1e4 u1, as a first-order state beside a slow one."""

    class Stiff(Sled):
        states = ("z",)

        def state_rates(self, t, q, u, x, motion, now):
            return {"z": -1e4 * (x[0] - q["x"])}

    def last(x):
        state = jk.State(jnp.stack([x]), jnp.zeros(1), jnp.zeros(1))
        return jk.simulate(Stiff(stiffness=1.0), state, [0.0, 10.0], solver=diffrax.Kvaerno5())["z"][-1]

    np.testing.assert_allclose(jax.jit(jax.jacfwd(last))(1.0), np.cos(10.0), atol=1e-3)


@pytest.mark.parametrize("begin", [3.0, 3.07, 7.13])
def test_a_smooth_force_that_begins_after_a_rest_is_not_passed_over(begin):
    """A force that acts on the slow block for about a tenth of a second."""
    pulse = lambda t, state: 2.0 * jnp.exp(-(((t - begin) / 0.05) ** 2))  # noqa: E731
    ride = jk.simulate(Oscillator(), jk.State(jnp.zeros(2), jnp.zeros(2)), np.linspace(0.0, 10.0, 501), {"push": pulse})
    rates = lambda t, z: A @ z + [0.0, 2.0 * np.exp(-(((t - begin) / 0.05) ** 2))]  # noqa: E731
    exact = scipy.integrate.solve_ivp(rates, (0.0, 10.0), [0.0, 0.0], rtol=1e-11, atol=1e-13, max_step=0.01).y[0, -1]
    np.testing.assert_allclose(ride["x"][-1], exact, atol=1e-6)


class Tilted(jk.System):
    """A disk that falls against a wall in a frame whose angle changes nothing but roundings."""

    tilt: jk.Scalar = jk.parameter(0.3)
    wall: jk.Scalar = jk.parameter(0.1)
    coordinates, speeds = ("angle",), ("rate",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        P = O.fixed(2.0 * N.rotate(3, self.tilt, 0.0).x)
        rod = N.rotate(3, q["angle"], u["rate"])
        return jk.Motion([jk.Body(1.0, (0.0, 0.0, 0.0), P.fixed(rod.x), rod)])

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, 9.81 * motion.N.x)

    def events(self, t, q, u):
        return {"wall": jk.falling(q["angle"] - self.wall)}


def test_a_parameter_that_changes_only_roundings_does_not_shorten_the_steps():
    def t_end(tilt, wall):
        return jk.simulate(Tilted(tilt, wall), jk.State([1.0], [0.0]), [0.0, 2.0]).t_end

    slopes = jax.jit(jax.jacfwd(t_end, argnums=(0, 1)))(0.3, 0.1)
    # Energy: rate^2 / 2 = 9.81 (cos 0.1 - cos 1), and the wall is passed earlier by 1 / rate
    rate = np.sqrt(2 * 9.81 * (np.cos(0.1) - np.cos(1.0)))
    np.testing.assert_allclose(slopes, [0.0, -1.0 / rate], rtol=1e-6, atol=1e-12)
