"""One residual, several transcriptions: chained windows, delays, gains, rates, gaps; and what is kept in a file."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import Cart, pushed

import jaxkane as jk
from jaxkane.fit import (
    Delay,
    Free,
    Gain,
    GradientDescent,
    LeastSquares,
    Offset,
    Problem,
    Trial,
    minimize,
)
from jaxkane.fit.solve.linearization import Blocks, eliminate

TRUTH = Cart(mass=1.3, stiffness=5.0, damping=0.4)
GUESS = Cart(mass=1.0, stiffness=4.0, damping=0.2)


def record(t, seed, late=0.0, noise=0.01, system=TRUTH, **changes):
    """A pushed cart: positions with noise; what was pushed acts `late` [s]."""
    rng = np.random.default_rng(seed)
    push = lambda t: np.sin(2.0 * t + seed) + 0.5 * np.sin(5.3 * t)  # noqa: E731
    fine = np.linspace(t[0], t[-1], 10 * t.size - 9)
    x = pushed(system.mass, system.stiffness, system.damping, [0.2, 0.0], fine, push(fine - late))[::10]
    x = x + rng.normal(0.0, noise, t.size)
    return Trial(t, {"x": x}, {"push": push(t)}, **{"sigma": 0.01, "name": f"run {seed}"} | changes)


def near(result, truth=TRUTH, names=("mass", "stiffness", "damping"), within=3.5):
    for name in names:
        error = result.estimates[name] - float(getattr(truth, name))
        assert abs(error) < within * result.standard_errors[name], (name, error, result.standard_errors[name])


@pytest.mark.parametrize(
    ("linked", "damping", "units"), [(True, 0.0, (1.0, 1.0)), (False, 0.3, (1.0, 1.0)), (False, 0.3, (1e-6, 1e3))]
)
def test_elimination_equals_dense_least_squares(linked, damping, units):
    """Unknowns: n_z of each window, of which a linked one has the next window's, too, n_b of each trial, and n_x."""
    tolerance, rng = 1e-9, np.random.default_rng(4)
    W, n_z, n_b, n_x, trial, last = 5, 2, 1, 2, (0, 0, 0, 1, 1), [2, 4]
    links = n_z * linked
    A = rng.normal(size=(W, 20, n_z + links + n_b + n_x + 1))
    A[:, :, -n_x - 1 : -1] *= units
    A[last, :, n_z : n_z + links] = 0.0  # the last windows have no next
    R = jnp.linalg.qr(jnp.asarray(A), mode="r")
    blocks = Blocks(R, jnp.zeros((0, n_x + 1)), jnp.array([[0, 1, 2], [3, 4, W]]), n_z, links, n_b)
    dense = np.zeros((W, 20, W * n_z + 2 * n_b + n_x))
    for w in range(W):
        own = n_z + links * (w not in last)
        dense[w, :, n_z * w : n_z * w + own] = A[w, :, :own]
        dense[w, :, W * n_z + trial[w]] = A[w, :, n_z + links]
        dense[w, :, -n_x:] = A[w, :, -n_x - 1 : -1]
    dense, r = dense.reshape(W * 20, -1), A[:, :, -1].ravel()
    norms = np.linalg.norm(dense, axis=0)
    whole, rest = np.vstack([dense, damping * np.diag(norms)]), np.append(r, 0.0 * norms)
    solution = np.linalg.lstsq(whole / norms, -rest, rcond=None)[0] / norms
    eliminated = eliminate(blocks, damping)
    x, least = eliminated.step(max(damping, 1e-14))
    np.testing.assert_allclose(x, solution[-n_x:], rtol=tolerance)
    np.testing.assert_allclose(least, np.sum((whole @ solution + rest) ** 2), rtol=tolerance)
    gradient = np.concatenate([g.ravel() for g in blocks.gradient])
    np.testing.assert_allclose(gradient, dense.T @ r, rtol=tolerance, atol=tolerance * norms.max())
    if not damping:
        z, b = eliminated.back_substitute(x)
        np.testing.assert_allclose(np.append(z, b), solution[:-n_x], rtol=tolerance, atol=tolerance)
        determinant = np.linalg.slogdet(dense[:, :-n_x].T @ dense[:, :-n_x])[1]
        np.testing.assert_allclose(eliminated.log_determinant, determinant, rtol=tolerance)


@pytest.fixture(scope="module")
def runs():
    """Of two rates and lengths, one with an offset, a gap, and a delay of 30 ms in what was pushed."""
    first = record(np.arange(0.0, 6.0, 0.02), 1, late=0.03)
    second = record(np.arange(0.0, 4.0, 0.05), 2, late=0.03)
    second.measured["x"][20:30] = np.nan
    second.measured["x"] = 1.1 * second.measured["x"] + 0.05
    return [first, second]


FREE = ("mass", "stiffness", "damping", Delay("push"))
UNKNOWN = {"unknown": ("x", "x_dot"), "window": 2.0}


@pytest.fixture(scope="module")
def problem(runs):
    own = Offset("x", each="trial"), Gain("x", each="trial", prior=(1.0, 0.1))
    return Problem.of(GUESS, runs, (*FREE, *own), **UNKNOWN)


@pytest.mark.weekly
def test_delays_gains_rates_and_gaps(problem):
    result = minimize(problem, LeastSquares())
    assert result.ok, result.message
    near(result)
    assert result.estimates["delay of push"] == pytest.approx(0.03, abs=0.005)
    gains = [result.nuisance[name]["gain of x"] for name in result.trial_names]
    assert gains[1] / gains[0] == pytest.approx(1.1, abs=0.03)
    steps = np.asarray(result.problem.windows.step)
    assert steps.max() < 0.051
    assert steps.min() < 0.021


@pytest.mark.parametrize("method", [LeastSquares(), GradientDescent()], ids=lambda m: m.name)
def test_an_interrupted_fit_is_resumed_from_its_file(problem, method, tmp_path):
    whole = minimize(problem, method, steps=6)
    calls = []

    def interrupt(point, cost):
        calls.append(cost)
        if len(calls) == 4:
            raise KeyboardInterrupt

    path = tmp_path / "fit.npz"
    assert minimize(problem, method, steps=6, checkpoint=path, callback=interrupt).status == "interrupted"
    resumed = minimize(problem, method, steps=6, checkpoint=path)
    assert resumed.history == pytest.approx(whole.history, rel=1e-12)
    np.testing.assert_allclose(resumed.point.parameters, whole.point.parameters, rtol=1e-12)
    with pytest.raises(ValueError, match="contains the state of another fit"):
        minimize(problem.only([0]), method, checkpoint=path)


@pytest.mark.weekly
def test_growing_horizons_converge_from_a_distant_initial_guess():
    # With a stiffness sixteen times too large a single shoot ends in another minimum; growing horizons do not.
    t = np.arange(0.0, 8.0, 0.05)
    far = Cart(mass=1.3, stiffness=80.0, damping=0.4)
    problem = Problem.of(far, record(t, 3), ("stiffness", "damping"), unknown=("x", "x_dot"))
    grown = minimize(problem, LeastSquares(horizons=(0.1, 0.3)))
    near(grown, names=("stiffness", "damping"))
    assert grown.cost < 1.3 * t.size
    assert minimize(problem, LeastSquares(horizons=())).cost > 10 * grown.cost


@pytest.mark.weekly
def test_the_delay_of_a_zero_order_hold_input_is_estimated():
    t = np.arange(0.0, 4.0, 0.1)
    push = {"push": np.round(np.sin(2.0 * t))}
    held = {"push": jk.Samples(t + 0.033, push["push"], zero_order_hold=True)}
    ride = jk.simulate(TRUTH, jk.assemble(TRUTH, {"x": 0.2}), t, held)
    noise = np.random.default_rng(3).normal(0.0, 1e-3, t.size)
    trial = Trial(t, {"x": ride["x"] + noise}, push, sigma=1e-3, initial={"x": 0.2})
    problem = Problem.of(TRUTH, trial, Delay("push"), zero_order_hold=("push",))
    found = minimize(problem, LeastSquares())
    error = found.standard_errors["delay of push"]
    assert abs(found.estimates["delay of push"] - 0.033) < 3 * error < 0.01


@pytest.fixture(scope="module")
def late_push():
    """Of a cart that is pushed late, by the model itself, and irregularly sampled."""
    t = np.sort(np.concatenate([np.arange(0.0, 8.0, 0.1), np.arange(3.0, 3.05, 0.002)[1:]]))
    push = 0.2 + np.sin(2.0 * t) + np.cos(5.0 * t)
    inputs = {"push": jk.Samples(jnp.asarray(t + 0.8), jnp.asarray(push))}
    ride = jk.simulate(TRUTH, jk.assemble(TRUTH, {"x": 0.2}), t, inputs)
    return Trial(t, {"x": ride["x"]}, {"push": push}, sigma=1e-3)


def test_a_delay_longer_than_a_trial_is_refused(late_push):
    with pytest.raises(ValueError, match=r"The bounds of delay of push allow 20 s, but trial lasts only 7\.9 s"):
        Problem.of(TRUTH, late_push, Delay("push", bounds=(0.0, 20.0), start=1.0), unknown="x")


@pytest.mark.weekly
@pytest.mark.parametrize("more", [{}, {"bounds": (0.0, 2.0)}], ids=["unbounded", "bounds"])
def test_a_long_delay_is_estimated_with_windows(late_push, more):
    """Windows contain the inputs before them that act in them."""
    free = ("mass", "stiffness", "damping", Delay("push", start=0.6, **more))
    found = minimize(Problem.of(GUESS, late_push, free, unknown=("x", "x_dot"), window=2.0), LeastSquares())
    assert [found.estimates[n] for n in found.names] == pytest.approx([1.3, 5.0, 0.4, 0.8], abs=1e-3)


@pytest.mark.weekly
def test_tied_parameters_and_gains():
    trial = record(np.arange(0.0, 4.0, 0.05), 4)
    twice = Trial(trial.t, trial.measured, {"push": 0.5 * trial.inputs["push"]}, sigma=0.01)
    free = (Free("stiffness", tied={"damping": 0.08}), Gain("push"))
    problem = Problem.of(TRUTH, twice, free, unknown=("x", "x_dot"))
    system, _ = problem.parameters.apply(TRUTH, jnp.array([0.1, 0.0]))
    assert float(system.damping) == pytest.approx(0.08 * float(system.stiffness))
    result = minimize(problem, LeastSquares())
    assert result.estimates["gain of push"] == pytest.approx(2.0, abs=0.05)
    assert float(result.system.damping) == pytest.approx(0.4, abs=0.02)


class Pulled(jk.System):
    """Two forces on one mass."""

    mass: jk.Scalar = jk.parameter(1.0, positive=True)
    coordinates = ("x",)
    speeds = ("x_dot",)
    inputs = ("left", "right")

    def motion(self, t, q, u):
        N, _ = jk.inertial()
        P = jk.Point.at(u[0] * N.x, q[0] * N.x, "P")
        return jk.Motion([jk.Body(self.mass, 0.0, P, name="cart")], frames={"N": N})

    def loads(self, t, q, u, motion, inputs):
        return (jk.Force((inputs["right"] - inputs["left"]) * motion.N.x, motion["cart"]),)


@pytest.mark.weekly
def test_gradients_by_a_delay_with_shared_and_separate_sample_times():
    # x(1) = int (1 - t) f(t - s) dt for a delay s; by parts, its slope at s = 0 is -int (1 - t) f'(t) dt.
    t = np.linspace(0.0, 1.0, 5)
    left, right = np.sin(5.0 * t), np.cos(3.0 * t)

    def end(delay, apart):
        times = jnp.asarray(t) + delay
        inputs = {"left": jk.Samples(times, left), "right": jk.Samples(times + 0.0 if apart else times, right)}
        return jk.simulate(Pulled(), jk.State(jnp.zeros(1), jnp.zeros(1)), t, inputs)["x"][-1]

    slopes, middles = np.diff(right - left), 1.0 - (t[1:] + t[:-1]) / 2
    for apart in (False, True):
        found = jax.jit(jax.jacfwd(lambda s, apart=apart: end(s, apart)))(0.0)
        assert float(found) == pytest.approx(-float(slopes @ middles), rel=1e-8)


def late_records(delay, n=3):
    """Carts that were pushed before they are recorded, too."""
    t, trials = np.arange(0.0, 6.0, 0.1), []
    for seed in range(n):
        whole = np.arange(-2.0, 6.0, 0.1)
        push = np.cos(2.3 * whole + seed) + 0.5 * np.sin(0.9 * whole * (seed + 1))
        inputs = {"push": jk.Samples(jnp.asarray(whole + delay), jnp.asarray(push))}
        ride = jk.simulate(TRUTH, jk.assemble(TRUTH, {"x": 0.2}), t, inputs)
        x = np.asarray(ride["x"]) + np.random.default_rng(seed).normal(0.0, 1e-3, t.size)
        trials.append(Trial(t, {"x": x}, {"push": push[20:]}, sigma=1e-3, name=f"run {seed}"))
    return trials


@pytest.mark.weekly
def test_samples_without_recorded_delayed_inputs_are_excluded_or_reported():
    """The input is delayed by 0.8 s; its first sample is a wrong guess of what it was before."""
    trials, options = late_records(0.8), {"unknown": ("x", "x_dot")}
    guess = lambda **more: ["stiffness", "damping", Delay("push", start=0.7, **more)]  # noqa: E731
    of = lambda **more: minimize(Problem.of(TRUTH, trials, guess(**more), **options), LeastSquares())  # noqa: E731
    found = of(bounds=(0.0, 1.2))
    assert [i for _, i, _ in found.problem.slices] == [12] * 3
    assert found.ok
    assert abs(found.estimates["stiffness"] - TRUTH.stiffness) < 4 * found.standard_errors["stiffness"]
    assert any(note.startswith("The first 1.2 s of run 0, run 1, run 2 are left out") for note in found.notes)
    assert np.isnan(found.residuals["run 1"]["x"][:12]).all()
    assert np.isfinite(found.residuals["run 1"]["x"][12:]).all()
    wrong = of()
    assert not wrong.ok
    assert any("is not recorded. Its first sample was used" in note for note in wrong.notes)
    with pytest.raises(ValueError, match=r"run 0: its inputs may be delayed by 5\.9 s, and fewer than two samples"):
        Problem.of(TRUTH, trials, guess(bounds=(0.0, 5.9)), **options)


@pytest.mark.weekly
def test_a_delayed_input_has_the_given_value_before_its_first_sample():
    t = np.arange(0.0, 3.0, 0.1)
    trial = Trial(t, {"x": np.cos(t)}, {"push": 1.0 + t}, sigma=0.1)
    for more, hold in (({"each": "trial"}, ()), ({"bounds": (0.0, 1.0)}, ()), ({}, ("push",))):
        free = ["mass", Delay("push", before=0.25, start=0.5, **more)]
        problem = Problem.of(TRUTH, trial, free, unknown=("x", "x_dot"), window=1.0, zero_order_hold=hold)
        assert problem.slices[0][1] == 0  # nothing is left out
        first = jax.tree.map(lambda x: x[0], problem.windows)
        push = problem.model.signals(first, {("delay of input", "push"): 0.5})["push"]
        np.testing.assert_allclose([push(jnp.asarray(x)) for x in (0.0, 0.3)], 0.25, atol=1e-6)
        assert float(push(jnp.asarray(0.65))) == pytest.approx(1.1 if hold else 1.15, abs=1e-6)
