"""Files of fits and trials, and Ctrl-C: what is refused is named, and the best so far is never lost."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from systems import POSED, PUSH, SEEN, TRIAL, Track
from systems import T as t

from jaxkane.fit import (
    GradientDescent,
    LeastSquares,
    Problem,
    Simulation,
    Trial,
    minimize,
    multi_start,
    profile,
)
from jaxkane.sweep import grid


def pose(**options):
    return Problem.of(Track(), TRIAL, ["gain", "drift"], **{"unknown": ("x",)} | options)


@pytest.fixture(scope="module")
def problem():
    return pose(**POSED)


def after(n):
    """A callback that is stopped by Ctrl-C after n calls."""
    calls = []

    def callback(point, cost):
        calls.append(cost)
        if len(calls) > n:
            raise KeyboardInterrupt

    return callback


def kept(problem, path, method=None):
    method = GradientDescent() if method is None else method
    assert minimize(problem, method, steps=5, checkpoint=path, callback=after(1)).status == "interrupted"
    return path


OPTIMIZERS = {
    "stateless": lambda rate=0.1: optax.sgd(rate),
    "momentum": lambda rate=0.1: optax.sgd(rate, momentum=0.5),
    "adam": lambda rate=0.1: optax.adam(rate),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", OPTIMIZERS)
def test_gradient_descent_is_resumed_only_with_the_same_optimizer(name, problem, tmp_path):
    path = kept(problem, tmp_path / "fit.npz", GradientDescent(OPTIMIZERS[name]()))
    for other in OPTIMIZERS.values():
        for optimizer in (other(0.2), *([other()] if other is not OPTIMIZERS[name] else [None])):
            with pytest.raises(
                ValueError, match=r"fit.npz contains the state of another fit, which differs in optimizer \("
            ):
                minimize(problem, GradientDescent(optimizer), steps=5, checkpoint=path)
    resumed = minimize(problem, GradientDescent(OPTIMIZERS[name]()), steps=5, checkpoint=path)
    whole = minimize(problem, GradientDescent(OPTIMIZERS[name]()), steps=5)
    assert resumed.history == pytest.approx(whole.history, rel=1e-12)


@pytest.mark.slow
def test_a_checkpoint_of_a_different_fit_is_rejected_with_the_differences(problem, tmp_path):
    path = kept(problem, tmp_path / "fit.npz")
    others = {
        r"method \(gradient descent there, Levenberg-Marquardt here\)": lambda: minimize(
            problem, LeastSquares(), checkpoint=path
        ),
        r"refresh \(10 there, 3 here\)": lambda: minimize(problem, GradientDescent(refresh=3), checkpoint=path),
        r"free parameters \(gain, drift there, gain here\)": lambda: minimize(
            Problem.of(Track(), problem.trials, ["gain"], simulation=Simulation(step=0.1)),
            GradientDescent(),
            checkpoint=path,
        ),
        r"rtol \(": lambda: minimize(pose(simulation=Simulation(rtol=1e-9)), GradientDescent(), checkpoint=path),
        r"initial guesses, priors \(": lambda: minimize(
            problem.with_priors({"gain": (1.0, 0.1)}), GradientDescent(), checkpoint=path
        ),
        r"unknown starts \(x there, none here\)": lambda: minimize(
            pose(**POSED | {"unknown": ()}), GradientDescent(), checkpoint=path
        ),
    }
    before = path.read_bytes()
    for message, run in others.items():
        with pytest.raises(
            ValueError, match=rf"fit.npz contains the state of another fit, which differs in .*{message}"
        ):
            run()
    assert path.read_bytes() == before


@pytest.mark.parametrize("how", ["empty", "zeros", "cut", "text", "older"])
def test_an_unreadable_checkpoint_is_rejected(how, problem, tmp_path):
    path = kept(problem, tmp_path / "fit.npz", LeastSquares())
    data = path.read_bytes()
    path.write_bytes({"empty": b"", "zeros": bytes(500), "cut": data[:-40], "text": b"thesis"}.get(how, data))
    if how == "older":
        np.savez(path, key=np.array("3f" * 32), damping=np.ones(()))
    with pytest.raises(
        ValueError, match=r"fit.npz cannot be read as the state of a fit .*Delete it, or choose another file"
    ):
        minimize(problem, LeastSquares(), checkpoint=path)
    assert [p.name for p in tmp_path.iterdir()] == ["fit.npz"]


def test_multi_start_stops_with_ctrl_c(problem):
    once = after(3)
    found = multi_start(problem, 4, callback=once, steps=20)
    assert [f.status for f in found.fits].count("interrupted") == 1
    assert len(found.fits) + found.untried == 4
    assert found.untried > 0
    assert f"Interrupted: {found.untried} more initial guesses were not tried" in str(found)


def test_a_profile_stops_with_ctrl_c(problem, monkeypatch):
    import jaxkane.fit.result.studies as module

    fit, search = minimize(problem, LeastSquares()), module.search
    stopped = lambda *args, **options: search(*args, **{**options, "callback": after(0)})  # noqa: E731
    monkeypatch.setattr(module, "search", stopped)
    with pytest.raises(KeyboardInterrupt):
        profile(fit, "gain")


def test_an_out_of_memory_error_is_raised(problem, monkeypatch):
    def exhausted(*_):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 1 bytes.")

    monkeypatch.setattr("jaxkane.fit.problem.problem.starts_of", exhausted)
    with pytest.raises(jax.errors.JaxRuntimeError, match="RESOURCE_EXHAUSTED"):
        problem.linearize(problem.start)


def masked(values, *places):
    mask = np.zeros(len(values), bool)
    mask[list(places)] = True
    return np.ma.array(values, mask=mask)


def test_masked_samples_are_missing_values():
    for values in (SEEN, SEEN.astype(np.float32), np.arange(11)):
        trial = Trial(t, {"x": masked(values, 2, 3)}, sigma=0.1)
        np.testing.assert_array_equal(np.isnan(trial.measured["x"]), np.isin(np.arange(11), (2, 3)))
        np.testing.assert_allclose(trial.measured["x"][4:], values[4:])
    for changes, message in (
        ({"t": masked(t, 3)}, r"t\[3\] is not finite"),
        ({"inputs": {"push": masked(PUSH, 3)}}, r"inputs\['push'\]\[3\] is NaN"),
        ({"initial": {"x": masked(PUSH, 0)}}, r"initial\['x'\]\[0\] is NaN"),
        ({"sigma": {"x": masked(PUSH + 2, 5)}}, r"sigma\['x'\]\[5\] is NaN"),
    ):
        with pytest.raises(ValueError, match=message):
            Trial(**{"t": t, "measured": {"x": SEEN}, "sigma": 0.1, **changes})
    with pytest.raises(ValueError, match="'mass' has masked entries"):
        grid(mass=masked(t, 1))


@pytest.mark.parametrize(
    "inputs",
    [{"push": lambda t, state: -state["x"]}, lambda t, state: {"push": 0.0}, {"push": jnp.sin}],
    ids=["function", "controller", "jax"],
)
def test_an_input_function_is_rejected_in_favour_of_loads(inputs):
    with pytest.raises(ValueError, match=r"got a function.*feedback.* into the system's `loads`"):
        Trial(t, {"x": SEEN}, inputs, sigma=0.1)


def test_parameter_entries_are_compared_without_python_code(problem):
    """Ctrl-C in an `__eq__` of Python comes out of JAX as a ValueError."""
    entry = problem.parameters.entries[0]
    assert type(entry).__eq__ is tuple.__eq__
    assert type(entry).__hash__ is tuple.__hash__
