"""One residual, several transcriptions: chained windows, delays, gains, rates, gaps; and what is kept in a file."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.signal
from systems import Cart, programs

import jaxkane as jk
from jaxkane.fit import (
    Delay,
    Free,
    Gain,
    GradientDescent,
    LeastSquares,
    Offset,
    Problem,
    Simulation,
    Trial,
    minimize,
)
from jaxkane.fit.solve.linearization import Blocks, eliminate
from jaxkane.fit.solve.optimizers import solve_nuisance

TRUTH = Cart(mass=1.3, stiffness=5.0, damping=0.4)
GUESS = Cart(mass=1.0, stiffness=4.0, damping=0.2)


def record(t, seed, late=0.0, noise=0.01, system=TRUTH, **changes):
    """A pushed cart: positions with noise; what was pushed acts `late` [s]."""
    rng = np.random.default_rng(seed)
    push = lambda t: np.sin(2.0 * t + seed) + 0.5 * np.sin(5.3 * t)  # noqa: E731
    x = moved(system, np.linspace(t[0], t[-1], 10 * t.size - 9), lambda t: push(t - late))[::10]
    x = x + rng.normal(0.0, noise, t.size)
    return Trial(t, {"x": x}, {"push": push(t)}, **{"sigma": 0.01, "name": f"run {seed}"} | changes)


def moved(cart, t, push):
    """Positions from 0.2 m and rest, of a push that is linear between these times."""
    m, k, c = (float(getattr(cart, name)) for name in ("mass", "stiffness", "damping"))
    motion = scipy.signal.lti([[0.0, 1.0], [-k / m, -c / m]], [[0.0], [1.0 / m]], [[1.0, 0.0]], [[0.0]])
    return scipy.signal.lsim(motion, push(t), t - t[0], [0.2, 0.0])[1]


def near(result, truth=TRUTH, names=("mass", "stiffness", "damping"), within=3.5):
    for name in names:
        error = result.estimates[name] - float(getattr(truth, name))
        assert abs(error) < within * result.standard_errors[name], (name, error, result.standard_errors[name])


def test_elimination_of_chained_windows_equals_the_dense_solution():
    tolerance = 1e-9
    rng = np.random.default_rng(4)
    W, n_z, n_b, n_x = 5, 2, 1, 2
    trial, windows = np.array([0, 0, 0, 1, 1]), jnp.array([[0, 1, 2], [3, 4, W]])
    k = 2 * n_z + n_b + n_x + 1
    A = rng.normal(size=(W, 20, k))
    A[[2, 4], :, n_z : 2 * n_z] = 0.0  # the last windows have no next
    blocks = Blocks(
        jnp.linalg.qr(jnp.asarray(A), mode="r"), jnp.zeros((0, A.shape[-1] - 2 * n_z - n_b)), windows, n_z, n_z, n_b
    )
    eliminated = eliminate(blocks, 0.0)
    x, least = eliminated.step(1e-14)
    z, b = eliminated.back_substitute(x)
    dense = np.zeros((W * 20, W * n_z + 2 * n_b + n_x))
    for w in range(W):
        rows = slice(20 * w, 20 * w + 20)
        dense[rows, n_z * w : n_z * w + n_z] = A[w, :, :n_z]
        if w not in (2, 4):
            dense[rows, n_z * w + n_z : n_z * w + 2 * n_z] = A[w, :, n_z : 2 * n_z]
        dense[rows, W * n_z + trial[w]] = A[w, :, 2 * n_z]
        dense[rows, -n_x:] = A[w, :, 2 * n_z + n_b : -1]
    r = A[:, :, -1].ravel()
    solution = np.linalg.lstsq(dense, -r, rcond=None)[0]
    np.testing.assert_allclose(np.concatenate([z.ravel(), b.ravel(), x]), solution, rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(least, np.sum((dense @ solution + r) ** 2), rtol=tolerance)
    gradient = np.concatenate([g.ravel() for g in blocks.gradient])
    np.testing.assert_allclose(gradient, dense.T @ r, rtol=tolerance, atol=tolerance)
    determinant = np.linalg.slogdet(dense[:, :-n_x].T @ dense[:, :-n_x])[1]
    np.testing.assert_allclose(eliminated.log_determinant, determinant, rtol=tolerance)


@pytest.mark.weekly
def test_short_chained_windows_equal_a_kalman_filter():
    tolerance = 1e-6
    t = np.arange(0.0, 2.0, 0.05)
    trial = record(t, 1)
    jump = {"x": 0.01, "x_dot": 0.05}
    start = {"x": 0.5, "x_dot": 1.0}
    problem = Problem.of(
        TRUTH,
        trial,
        "mass",
        unknown=start,
        window=0.05,
        defect_std=jump,
        simulation=Simulation(rtol=1e-10, atol=1e-10, solver=None),
    )
    least = solve_nuisance(problem, problem.start, rtol=1e-12)[1].cost  # over all starts, the mass held

    # The same motion by a Kalman filter: x_dot = F x + G push, push linear between samples.
    m, k, c = (float(getattr(TRUTH, name)) for name in ("mass", "stiffness", "damping"))
    F = np.array([[0.0, 1.0], [-k / m, -c / m]])
    push, y, h = trial.inputs["push"], trial.measured["x"], 0.05
    big = np.zeros((4, 4))
    big[:2, :2], big[1, 2], big[2, 3] = F, 1.0 / m, 1.0  # push, and its rate
    Phi = scipy.linalg.expm(big * h)
    x, P = np.array([y[0], 0.0]), np.diag([0.5**2, 1.0])
    Q, R, H = np.diag([jump["x"] ** 2, jump["x_dot"] ** 2]), 0.01**2, np.array([1.0, 0.0])
    squares = 0.0
    for i in range(len(t)):
        S, e = H @ P @ H + R, y[i] - H @ x
        squares += e**2 / S
        K = P @ H / S
        x, P = x + K * e, P - np.outer(K, H @ P)
        if i + 1 < len(t):
            x = (Phi @ np.append(x, [push[i], (push[i + 1] - push[i]) / h]))[:2]
            # The last two samples share a window: nothing jumps between them.
            P = Phi[:2, :2] @ P @ Phi[:2, :2].T + (Q if i + 2 < len(t) else 0.0)
    assert least == pytest.approx(squares, rel=tolerance)


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


def own(deviation):
    """Offset and gain of each trial."""
    return Offset("x", each="trial"), Gain("x", each="trial", prior=(1.0, deviation))


@pytest.fixture(scope="module")
def problem(runs):
    return Problem.of(GUESS, runs, (*FREE, *own(0.1)), **UNKNOWN)


@pytest.fixture(scope="module")
def result(problem):
    return minimize(problem, LeastSquares())


@pytest.mark.weekly
def test_delays_gains_rates_and_gaps(result):
    assert result.ok, result.message
    near(result)
    assert result.estimates["delay of push"] == pytest.approx(0.03, abs=0.005)
    gains = [result.nuisance[name]["gain of x"] for name in result.trial_names]
    assert gains[1] / gains[0] == pytest.approx(1.1, abs=0.03)
    steps = np.asarray(result.problem.windows.step)
    assert steps.max() < 0.051
    assert steps.min() < 0.021


@pytest.mark.weekly
def test_new_data_and_initial_guesses_do_not_recompile(result, runs, problem):
    before = programs()
    again = [Trial(r.t, r.measured, r.inputs, sigma=0.02, name="again") for r in runs]
    other = Problem.of(TRUTH, again, (*FREE, *own(0.2)), **UNKNOWN)
    near(minimize(other, LeastSquares()))
    assert programs() <= before


@pytest.mark.weekly
@pytest.mark.parametrize("method", [LeastSquares(damping=0.0), GradientDescent()], ids=lambda m: m.name)
def test_other_methods_converge_to_the_same_estimates(problem, result, method):
    found = minimize(problem, method)
    assert found.status == "converged"
    assert found.cost == pytest.approx(result.cost, rel=1e-4)
    for name, value in result.estimates.items():
        assert found.estimates[name] == pytest.approx(value, abs=0.3 * result.standard_errors[name])


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
def test_chained_windows_account_for_process_noise():
    # A hidden force shakes the cart: what it does in a window is what the motion may jump by at its end.
    t = np.arange(0.0, 8.0, 0.05)
    rng = np.random.default_rng(8)
    fine = np.arange(0.0, 8.0, 0.01)
    trials = []
    for seed in (1, 2, 3):
        push = np.sin(2.0 * fine + seed)
        shake = rng.normal(0.0, 1.0, fine.size)
        x = moved(TRUTH, fine, lambda _, force=push + shake: force)[::5] + rng.normal(0.0, 0.003, t.size)
        trials.append(Trial(t, {"x": x}, {"push": np.sin(2.0 * t + seed)}, sigma=0.003, name=f"run {seed}"))
    options = {"unknown": ("x", "x_dot"), "window": 0.25}
    jump = {"x": 0.005, "x_dot": 0.05}
    names = ("mass", "stiffness", "damping")
    chained = minimize(Problem.of(GUESS, trials, names, defect_std=jump, **options), LeastSquares())
    near(chained)
    assert 0.5 < chained.variance < 2.0


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


def late_push(delay):
    """Of a cart that is pushed late, by the model itself, and irregularly sampled."""
    t = np.sort(np.concatenate([np.arange(0.0, 8.0, 0.1), np.arange(3.0, 3.05, 0.002)[1:]]))
    push = 0.2 + np.sin(2.0 * t) + np.cos(5.0 * t)
    inputs = {"push": jk.Samples(jnp.asarray(t + delay), jnp.asarray(push))}
    ride = jk.simulate(TRUTH, jk.assemble(TRUTH, {"x": 0.2}), t, inputs)
    return Trial(t, {"x": ride["x"]}, {"push": push}, sigma=1e-3), np.asarray(ride.inputs["push"])


@pytest.mark.weekly
@pytest.mark.parametrize("free", [[Delay("push")], ["mass", Delay("push", each="trial")]])
@pytest.mark.parametrize("delay", [1.3, -0.7])
def test_windows_contain_the_delayed_part_of_an_input(free, delay):
    tolerance = 1e-12
    trial, acted = late_push(delay)
    problem = Problem.of(TRUTH, trial, free, unknown=("x", "x_dot"), window=1.0)
    point, more = problem.start, jnp.asarray(delay)
    point = jax.tree.map(lambda x: x + more, point) if len(free) > 1 else problem.at({"delay of push": delay})
    for (_, i, n), window in zip(problem.slices, _windows(problem), strict=True):
        roles = problem.parameters.apply(TRUTH, point.parameters)[1]
        roles = problem.model.nuisance.with_local(roles, point.trial_unknowns[0])
        push = problem.model.signals(window, roles)["push"]
        np.testing.assert_allclose(jax.vmap(push)(trial.t[i : i + n]), acted[i : i + n], atol=tolerance)


def _windows(problem):
    return [jax.tree.map(lambda x, i=i: x[i], problem.windows) for i in range(len(problem.slices))]


@pytest.mark.weekly
def test_windows_contain_the_inputs_required_by_the_bounds_of_a_delay():
    trial, acted = late_push(0.4)
    sizes = []
    for bounds in ((-0.1, 0.5), (0.0, 4.0), None):
        problem = Problem.of(TRUTH, trial, Delay("push", bounds=bounds, start=0.4), unknown="x", window=1.0)
        sizes.append(problem.windows.t_input.shape[1])
        roles = {("delay of input", "push"): 0.4}
        last = _windows(problem)[-1]
        push = problem.model.signals(last, roles)["push"]
        np.testing.assert_allclose(jax.vmap(push)(trial.t[-10:]), acted[-10:], atol=1e-12)
    assert sizes[0] < sizes[1] < sizes[2] == len(trial.t)
    assert problem.windows.n_acting < 50


def test_a_delay_longer_than_a_trial_is_refused():
    trial, _ = late_push(0.4)
    with pytest.raises(ValueError, match=r"The bounds of delay of push allow 20 s, but trial lasts only 7\.9 s"):
        Problem.of(TRUTH, trial, Delay("push", bounds=(0.0, 20.0), start=1.0), unknown="x")


@pytest.mark.weekly
def test_a_long_delay_is_estimated_with_windows():
    trial, _ = late_push(0.8)
    free = ("mass", "stiffness", "damping", Delay("push", bounds=(0.0, 2.0), start=0.6))
    found = minimize(Problem.of(GUESS, trial, free, unknown=("x", "x_dot"), window=2.0), LeastSquares())
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
        push = problem.model.signals(_windows(problem)[0], {("delay of input", "push"): 0.5})["push"]
        np.testing.assert_allclose([push(jnp.asarray(x)) for x in (0.0, 0.3, 0.7)][:2], 0.25, atol=1e-6)
        assert float(push(jnp.asarray(0.65))) == pytest.approx(1.1 if hold else 1.15, abs=1e-6)
