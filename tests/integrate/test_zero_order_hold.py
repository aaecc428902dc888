"""Inputs that are held from sample to sample: exact motions, and their derivatives by the times of the jumps."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_clocks import Particle

import jaxkane as jk

ts = np.linspace(0.0, 1.0, 6)
values = np.array([1.0, -2.0, 0.5, 3.0, -1.0, 4.0])


def place(t, delay):
    """Twice the integral of the held values."""
    jumps = np.concatenate([[values[0]], np.diff(values)])
    since = [t, *(np.maximum(t - ts[1:] - delay, 0.0))]
    return sum(jump * s**2 / 2 for jump, s in zip(jumps, since, strict=True))


def test_fixed_steps_that_end_at_the_samples_are_exact():
    push = jk.Samples(ts, values, zero_order_hold=True)
    ride = jk.simulate(Particle(), jk.State([0.0], [0.0]), ts, {"push": push}, step=0.1, solver=diffrax.Bosh3())
    np.testing.assert_allclose(ride["x"], [place(t, 0.0) for t in ts], atol=1e-13)
    np.testing.assert_array_equal(ride["push"], values)
    ride = jk.simulate(
        Particle(), jk.State([0.0], [0.0]), ts, {"push": push}, step=0.1
    )  # Tsit5 reads both ends of a step
    np.testing.assert_allclose(ride["x"], [place(t, 0.0) for t in ts], atol=1e-13)


@pytest.mark.weekly
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_fixed_steps_have_derivatives_by_sample_values_and_nan_by_times(mode):
    def end(delay, factor):
        push = jk.Samples(ts + delay, factor * values, zero_order_hold=True)
        ride = jk.simulate(Particle(), jk.State([0.0], [0.0]), ts, {"push": push}, step=0.1, solver=diffrax.Bosh3())
        return ride["x"][-1]

    np.testing.assert_allclose(mode(end, argnums=1)(0.0, 1.0), place(ts[-1], 0.0), rtol=1e-12)
    assert np.isnan(mode(end)(0.0, 1.0))


@pytest.mark.slow
def test_a_rejected_step_after_a_jump_evaluates_its_first_stage_again():
    """Its first stage is not the last one before the jump, for the step that is repeated neither."""
    system, state = jk.catalog.DoublePendulum(), jk.State([0.5, -0.2], [0.7, 1.0])
    torque = jk.Samples(ts, values, zero_order_hold=True)
    ride, exact = (jk.simulate(system, state, ts, {"elbow_torque": torque}, rtol=x, atol=x) for x in (1e-8, 1e-12))
    assert ride.stats["rejected"] > 3
    np.testing.assert_allclose(ride.q, exact.q, atol=1e-8)


def test_an_input_of_the_time_alone_is_refused_by_name():
    with pytest.raises(TypeError, match=r"The input 'push' must be a function of \(t, state\)"):
        jk.simulate(Particle(), jk.State([0.0], [0.0]), ts, {"push": lambda t: 1.0})


def push_of(form, delay, hold):
    """An input that acts a delay later, in one of the ways in which a user may write it."""
    samples, late = jk.Samples(ts, values, zero_order_hold=hold), jk.Samples(ts + delay, values, zero_order_hold=hold)
    return {
        "direct": {"push": late},
        "moved": {"push": lambda t, s: 1.0 * late(t)},
        "made inside": {"push": lambda t, s: jk.Samples(ts + delay, values, zero_order_hold=hold)(t)},
        "asked earlier": {"push": lambda t, s: samples(t - delay)},
        "compiled": {"push": jax.jit(lambda t, s: samples(t - delay))},
        "module": {"push": Earlier(samples, delay)},
        "branch": {"push": lambda t, s: jax.lax.cond(s["x"] > -9.0, lambda t: samples(t - delay), lambda t: t, t)},
        "batch": {"push": lambda t, s: 0.5 * jnp.sum(jax.vmap(samples)(t - delay * jnp.ones(2)))},
        "controller": lambda t, s: {"push": samples(-delay + t) + 0.0 * s["v"]},
    }[form]


FORMS = ("direct", "moved", "made inside", "asked earlier", "compiled", "module", "branch", "batch", "controller")


class Earlier(eqx.Module):
    samples: jk.Samples
    delay: float

    def __call__(self, t, state):
        return self.samples(t - self.delay)


@pytest.mark.slow_cases(all_but=["asked earlier"])
@pytest.mark.parametrize("form", FORMS)
def test_discontinuities_of_samples_called_by_a_function_are_found(form):
    """Steps between jumps are exact, and none is rejected."""
    ride = jk.simulate(Particle(), jk.State([0.0], [0.0]), [0.0, 0.5, 1.0], push_of(form, 0.03, True))
    np.testing.assert_allclose(ride["x"][-1], place(1.0, 0.03), rtol=1e-12)
    assert ride.stats["rejected"] == 0


def by_delay(end):
    """A motion's end and its derivative by a delay of 0.03 s."""
    return jax.jit(lambda d: jax.jvp(end, (d,), (1.0,)))(0.03)


def end_with(system, push):
    ride = jk.simulate(system, jk.State([0.0], [0.0]), [0.0, 0.5, 1.0], push, adjoint="forward")
    return ride["x"][-1]


@pytest.mark.weekly
@pytest.mark.parametrize("form", ["branch", "controller"])
def test_samples_called_by_a_function_equal_samples_passed_directly(form):
    rtol = 1e-11
    found, given = (
        by_delay(lambda d, form=form: end_with(Particle(), push_of(form, d, False))) for form in (form, "direct")
    )
    np.testing.assert_allclose(found, given, rtol=rtol)


class Blown(Particle):
    wind: jk.Samples

    def loads(self, t, q, u, motion, inputs):
        return jk.Force(self.wind(t) * motion.N.x, motion["mass"])


class Late(Particle):
    delay: jk.Scalar = jk.parameter(0.0)  # [s]

    def loads(self, t, q, u, motion, inputs):
        return jk.Force(samples_held(t - self.delay) * motion.N.x, motion["mass"])


DELAYED = {
    "input": lambda d: (Particle(), push_of("asked earlier", d, True)),
    "stored": lambda d: (Blown(jk.Samples(ts + d, values, zero_order_hold=True)), None),
    "captured": lambda d: (Late(d), None),
}


@pytest.mark.slow
@pytest.mark.weekly_cases("stored", "captured")
@pytest.mark.filterwarnings("ignore:Blown", "ignore:Late")
@pytest.mark.parametrize("kind", DELAYED)
def test_a_delay_in_a_function_or_a_system_is_differentiable(kind):
    rtol, h = 1e-8, 1e-6
    slope = (place(1.0, 0.03 + h) - place(1.0, 0.03 - h)) / (2 * h)
    found = by_delay(lambda d: end_with(*DELAYED[kind](d)))
    np.testing.assert_allclose(found, (place(1.0, 0.03), slope), rtol=rtol)


@pytest.mark.parametrize(
    ("push", "options", "message"),
    [
        (lambda t, s: samples_held(0.5 * t), {}, "'push' calls Samples at a time other than t or t - delay"),
        (lambda t, s: samples_held(s["x"]), {}, "For a table over another quantity, use jnp.interp"),
        (lambda t, s: jk.Samples(ts + s["x"], values)(t), {}, "cannot end at their discontinuities"),
        (
            lambda t, s: samples_held(t),
            {"step": 0.1, "solver": diffrax.Bosh3()},
            "Pass the Samples as the input itself",
        ),
    ],
)
def test_unsupported_calls_of_samples_in_input_functions_raise(push, options, message):
    with pytest.raises(ValueError, match=message):
        jk.simulate(Particle(), jk.State([0.0], [0.0]), [0.0, 0.5, 1.0], {"push": push}, **options)


samples_held = jk.Samples(ts, values, zero_order_hold=True)


@pytest.mark.parametrize("f", ["linear", "held", pytest.param("motion", marks=pytest.mark.weekly)])
def test_memory_is_proportional_to_the_number_of_samples(f):
    """A table of samples by times of 20 000 would take 3.2 GB."""
    n, per_sample = 20_000, 1000

    def values_at(t, y):
        samples = jk.Samples(t, y, zero_order_hold=f == "held")
        if f != "motion":
            return jax.vmap(samples)(t)
        return jk.simulate(Particle(), jk.State([0.0], [0.0]), t, {"push": samples})

    times = jax.ShapeDtypeStruct((n,), float)
    memory = jax.jit(values_at).lower(times, times).compile().memory_analysis()
    assert memory.temp_size_in_bytes < per_sample * n


class Two(Particle):
    inputs = ("push", "pull")

    def loads(self, t, q, u, motion, inputs):
        return jk.Force((inputs["push"] - 2.0 * inputs["pull"]) * motion.N.x, motion["mass"])


@pytest.mark.weekly
@pytest.mark.parametrize(("shift", "slope"), [(0.0, np.nan), (0.05, values[0] - values[4])], ids=["same", "other"])
@pytest.mark.parametrize("mode", ["forward", pytest.param("reverse", marks=pytest.mark.weekly)])
def test_simultaneous_jumps_of_two_signals_have_nan_derivatives_by_delay(mode, shift, slope):
    """By the delay of one of them. A step that ends at both jumps has one derivative with respect to its end."""

    def end(delay):
        push = jk.Samples(ts[:-1] + 0.01 + delay, values[:-1], zero_order_hold=True)
        pull = jk.Samples(ts[:-1] + 0.01 + shift, values[1:], zero_order_hold=True)
        ride = jk.simulate(Two(), jk.State([0.0], [0.0]), [0.0, 1.0], {"push": push, "pull": pull}, adjoint=mode)
        return ride["v"][-1]

    # Of the integral of a signal that is held, by its delay: minus its last value plus its first.
    derivative = jax.jacfwd if mode == "forward" else jax.grad
    np.testing.assert_allclose(jax.jit(derivative(end))(0.0), slope, rtol=1e-10)
