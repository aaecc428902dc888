"""Measured frequency responses: of a linear system they are its own, within the error that is reported."""

import types

import matplotlib

matplotlib.use("Agg")

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy.signal import lsim

import jaxkane as jk
from jaxkane.stability import LinearModel, frequency_response

DT = 0.02
NAMES = (("x", "v"), ("force", "wind"), ("x",))


def model_of(damping):
    """A mass of 1 kg on a spring of 25 N/m."""
    A, B = [[0.0, 1.0], [-25.0, -damping]], [[0.0, 0.0], [1.0, 1.0]]
    return LinearModel(*map(jnp.asarray, (A, B, [[1.0, 0.0]], [[0.0, 0.0]])), *NAMES)


def trials_of(model, number, seconds, noise, smooth=1, seed=0):
    rng, t = np.random.default_rng(seed), np.arange(0.0, seconds, DT)
    for k in range(number):
        w = np.zeros((t.size, 2))
        w[:, 0] = np.convolve(5.0 * rng.standard_normal(t.size), np.ones(smooth), "same")
        _, y, _ = lsim(tuple(map(np.asarray, model)), w, t)
        yield types.SimpleNamespace(
            name=f"trial {k}", t=t, inputs={"force": w[:, 0]}, measured={"x": y + noise * rng.standard_normal(t.size)}
        )


def test_the_frequency_response_agrees_within_the_reported_error():
    """The mean square of 100 complex deviations by their errors is two, 20 % is three of its standard deviations."""
    model = model_of(2.0)
    found = frequency_response(model, list(trials_of(model, 8, 80.0, 0.02)), "force", "x", segment=20.0)
    low = found.frequencies < 31.0  # far below the sampling frequency, for which samples of the input are lines
    deviation = np.abs(found.measured / found.model - 1)[low] / found.relative_error[low]
    assert low.sum() > 90
    assert np.mean(deviation**2) == pytest.approx(2.0, rel=0.2)
    assert np.median(found.coherence[found.frequencies < 6.0]) > 0.9 > np.median(found.coherence[low])
    assert found.averages == 8 * 7
    assert "force to x" in repr(found)
    wrong = frequency_response(model_of(4.0), list(trials_of(model, 8, 80.0, 0.02)), "force", "x", segment=20.0)
    near = np.abs(wrong.frequencies - 5.0) < 1.0
    assert np.min(np.abs(wrong.measured / wrong.model - 1)[near] / wrong.relative_error[near]) > 2
    axes = jk.plot.frequency_response(found)
    assert axes.shape == (3, 1)
    plt.close("all")


def test_irregular_and_unequal_sampling_is_interpolated():
    model = model_of(2.0)
    first, second = trials_of(model, 2, 80.0, 0.0, smooth=10)  # nothing to alias
    second.t = second.t + 0.2 * DT * np.sin(np.arange(second.t.size))
    third = types.SimpleNamespace(
        name="slow",
        t=first.t[::2],
        inputs={"force": first.inputs["force"][::2]},
        measured={"x": first.measured["x"][::2]},
    )
    found = frequency_response(model, [first, second, third], "force", "x", segment=10.0)
    low = found.frequencies < 5.0
    np.testing.assert_allclose(np.abs(found.measured / found.model)[low], 1.0, atol=0.1)


def test_invalid_arguments_raise():
    model = model_of(2.0)
    (trial,) = trials_of(model, 1, 10.0, 0.0)
    for names, message in ((("torque", "x"), "no input torque"), (("force", "y"), "no output y")):
        with pytest.raises(ValueError, match=message):
            frequency_response(model, trial, *names)
    with pytest.raises(ValueError, match=r"1 segment of 10 s; at least two are needed. Pass longer trials"):
        frequency_response(model, trial, "force", "x", segment=10.0)
    with pytest.raises(ValueError, match="a segment of 1000 samples"):
        frequency_response(model, trial, "force", "x", segment=20.0)
    with pytest.raises(ValueError, match="the input wind has no power"):
        frequency_response(model, trial, "wind", "x")
    trial.measured["x"][3] = np.nan
    with pytest.raises(ValueError, match="trial 0: x has gaps"):
        frequency_response(model, trial, "force", "x")
    trial.measured.clear()
    with pytest.raises(ValueError, match="trial 0 has no channel x"):
        frequency_response(model, trial, "force", "x")
