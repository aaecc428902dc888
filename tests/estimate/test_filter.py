"""Filters of one time step: against filters that NumPy computes by covariances, and against chi squared."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from mechanisms import Crank, CrankAlone, OnACircle
from scipy import stats
from systems import Cart, Pendulum, transition

import jaxkane as jk
from jaxkane.estimate import Belief, Filter, begin, nees, predict, update

H, Q, SIGMA = 0.1, 0.2, {"x": 0.02, "x_dot": 0.1}
CART = Cart(mass=1.0, stiffness=4.0, damping=0.3)
START, DEVIATION = np.array([0.4, 0.1]), {"x": 0.1, "x_dot": 0.2}
METHODS = pytest.mark.parametrize("method", ["extended", "unscented"])


def kalman(ys):
    """Predicted and updated moments after each of the measurements (n, 2), and their normalized squares."""
    (Phi, more), m, P = transition(H, 4.0, 0.3, Q), START, np.diag([0.01, 0.04])
    for y in ys:
        before = Phi @ m, Phi @ P @ Phi.T + more
        seen = np.isfinite(y)
        C, R = np.eye(2)[seen], np.diag(np.array([*SIGMA.values()])[seen] ** 2)
        S, e = C @ before[1] @ C.T + R, y[seen] - C @ before[0]
        K = before[1] @ C.T @ np.linalg.inv(S)
        m, P = before[0] + K @ e, before[1] - K @ C @ before[1]
        yield before, (m, P), e @ np.linalg.solve(S, e)


def measured(n, seed=0):
    ys = START + np.random.default_rng(seed).normal(size=(n, 2)) * [*SIGMA.values()]
    ys[::3, 0], ys[4] = np.nan, np.nan
    return ys


def of_cart(method, **options):
    filter = Filter(CART, SIGMA, noise={"x_dot": Q}, method=method, substeps=20, **options)
    return filter, begin(filter, jk.State(jnp.asarray(START[:1]), jnp.asarray(START[1:])), DEVIATION)


@pytest.mark.weekly_cases("unscented")
@METHODS
def test_the_filter_of_a_linear_system_equals_the_kalman_filter(method):
    tolerance = 1e-8  # of the integration
    filter, belief = of_cart(method)
    ys = measured(8)
    for y, (_, (m, P), squares) in zip(ys, kalman(ys), strict=True):
        belief, innovation = update(filter, predict(filter, belief, H), y)
        np.testing.assert_allclose(belief.mean[0], m, atol=tolerance)
        np.testing.assert_allclose(belief.covariance(), P, atol=tolerance)
        np.testing.assert_allclose(innovation.nis, squares, atol=100 * tolerance)
        assert int(innovation.n) == np.isfinite(y).sum()
        np.testing.assert_allclose(belief.deviation(), np.sqrt(P.diagonal()), atol=tolerance)


@pytest.mark.slow
@pytest.mark.weekly_cases("unscented")
@METHODS
def test_fixed_lag_smoothing_and_late_measurements(method):
    """Rauch, Tung and Striebel, Maximum likelihood estimates of linear dynamic systems, 1965."""
    tolerance, lag = 1e-8, 3
    filter, first = of_cart(method, lag=lag)
    ys, belief = measured(7), first
    for y in ys:
        belief, _ = update(filter, predict(filter, belief, H), y)
    known, Phi = list(kalman(ys)), transition(H, 4.0, 0.3, Q)[0]
    m, P = known[-1][1]
    for k in range(1, lag + 1):
        (before, C), (at, D) = known[-k][0], known[-k - 1][1]
        G = D @ Phi.T @ np.linalg.inv(C)
        m, P = at + G @ (m - before), D + G @ (P - C) @ G.T
        np.testing.assert_allclose(belief.mean[k], m, atol=tolerance)
        np.testing.assert_allclose(belief.covariance(k), P, atol=tolerance)
    np.testing.assert_allclose(belief.t, H * np.arange(7, 3, -1), atol=1e-12)

    go = lambda belief, n: belief if n == 0 else go(predict(filter, belief, H), n - 1)  # noqa: E731
    prompt = go(update(filter, go(first, 1), {"x": 0.43})[0], 2)
    late = update(filter, go(first, 3), {"x": 0.43}, age=2)[0]
    np.testing.assert_allclose(late.mean, prompt.mean, atol=1e-14)
    np.testing.assert_allclose(late.covariance(), prompt.covariance(), atol=1e-14)


def stepped(v, xi, torque, h):
    """A step of the classical Runge-Kutta method, of v = [angle, rate, stiffness]; `xi` (3,): noise of the rate."""

    def rates(s, y):
        e = xi @ np.array([1.0, 3**0.5 * (2 * s - 1), 5**0.5 * (1.5 * (2 * s - 1) ** 2 - 0.5)]) / np.sqrt(h)
        return np.array([y[1], torque - v[2] * np.sin(y[0]) - 0.2 * y[1] + e])

    y = v[:2]
    k1 = rates(0.0, y)
    k2 = rates(0.5, y + h / 2 * k1)
    k3 = rates(0.5, y + h / 2 * k2)
    return np.append(y + h / 6 * (k1 + 2 * k2 + 2 * k3 + rates(1.0, y + h * k3)), v[2])


def jacobian(f, v, n_out):
    """By complex steps, exact to rounding."""
    return np.stack([np.imag(f(v + 1e-30j * e)) / 1e-30 for e in np.eye(len(v))], axis=1).reshape(n_out, -1)


def sensed(v):
    return np.array([v[1], 1.0 - np.cos(v[0])])


def symmetric(P):
    """The symmetric root of the correlation matrix, times the deviations."""
    size = np.sqrt(P.diagonal())
    return size[:, None] * scipy.linalg.sqrtm(P / np.outer(size, size)).real


def by_hand(method, m, P, torque, y, h, density, sigma, drift):
    """One step of a filter by covariances: extended, or cubature with additive noise."""
    flow = lambda z: stepped(z[:3], z[3:], torque, h)  # noqa: E731
    D = np.diag([0.0, 0.0, drift * h])
    if method == "extended":
        A = jacobian(flow, np.append(m, np.zeros(3)), 3)
        m, P = flow(np.append(m, np.zeros(3))), A[:, :3] @ P @ A[:, :3].T + density * A[:, 3:] @ A[:, 3:].T + D
        C, expected = jacobian(sensed, m, 2), sensed(m)
        across, own = P @ C.T, C @ P @ C.T
    else:
        ends = np.array([stepped(m + s * 3**0.5 * d, np.zeros(3), torque, h) for s in (1, -1) for d in symmetric(P).T])
        noise = [[stepped(m, s * density**0.5 * e, torque, h) for e in np.eye(3)] for s in (1, -1)]
        C = np.subtract(*noise).T / 2
        m, P = ends.mean(axis=0), np.cov(ends.T, bias=True) + C @ C.T + D
        points = np.array([m + s * 3**0.5 * d for s in (1, -1) for d in symmetric(P).T])
        ys = np.array([sensed(v) for v in points])
        expected, own = ys.mean(axis=0), np.cov(ys.T, bias=True)
        across = (points - m).T @ (ys - expected) / 6
    K = across @ np.linalg.inv(own + np.diag(sigma**2))
    return m + K @ (y - expected), P - K @ (own + np.diag(sigma**2)) @ K.T


@pytest.mark.weekly
@METHODS
def test_the_filter_of_a_pendulum_equals_a_reference_implementation(method):
    tolerance = 1e-10
    h, density, drift, sigma = 0.05, 0.01, 0.02, {"rate": 0.05, "height": 0.01}
    filter = Filter(Pendulum(), sigma, noise={"rate": density}, drift={"stiffness": drift}, method=method)
    deviation = {"angle": 0.02, "rate": 0.03, "stiffness": 0.05}
    belief = begin(filter, jk.State(jnp.array([0.8]), jnp.array([-0.3])), deviation)
    m, P = np.array([0.8, -0.3, 9.0]), np.diag([*deviation.values()]) ** 2
    for i, y in enumerate(np.array([[-0.6, 0.29], [-0.9, 0.27], [-1.2, 0.23], [-1.4, 0.19]])):
        torque = 0.3 * i
        m, P = by_hand(method, m, P, torque, y, h, density, np.array([*sigma.values()]), drift)
        belief, _ = update(filter, predict(filter, belief, h, {"torque": torque}), jnp.asarray(y))
        np.testing.assert_allclose(belief.mean[0], m, rtol=tolerance, atol=tolerance)
        np.testing.assert_allclose(belief.covariance(), P, rtol=1e3 * tolerance, atol=tolerance)


def of_pendulum(lag=0, noise=None, method="unscented", deviation=1.0, **options):
    """A filter that knows little, so that the motion is not linear within its deviations."""
    options = {"noise": {"rate": 0.01} | (noise or {}), "drift": {"stiffness": 1e-3}} | options
    filter = Filter(Pendulum(), {"height": 0.05}, method=method, lag=lag, **options)
    start = jk.State(jnp.array([0.8]), jnp.array([0.3]))
    return filter, begin(filter, start, {name: deviation for name in filter.names})


def last_of(filter, belief, n=12):
    """The belief after n steps."""

    def step(belief, y):
        return update(filter, predict(filter, belief, 0.1), y[None])[0], None

    ys = 1.0 - np.cos(0.8 * np.cos(0.3 * np.arange(n))) + np.random.default_rng(0).normal(0.0, 0.05, n)
    return jax.lax.scan(step, belief, jnp.asarray(ys))[0]


@pytest.mark.slow
def test_unscented_estimates_do_not_depend_on_the_covariance_root():
    """A covariance without full rank has no triangle of its own; its symmetric root does not depend on rounding."""
    filter, belief = of_pendulum(lag=1, drift={"stiffness": 0.0, "damping": 0.0})
    belief = dataclasses.replace(belief, root=belief.root.at[:, 2:].set(0.0))  # both parameters are known
    turned = np.linalg.qr(np.random.default_rng(0).normal(size=(8, 8)))[0]
    one, other = (last_of(filter, dataclasses.replace(belief, root=belief.root @ Q)) for Q in (jnp.eye(8), turned))
    np.testing.assert_allclose(other.mean, one.mean, atol=1e-10)
    for age in (0, 1):
        np.testing.assert_allclose(other.covariance(age), one.covariance(age), atol=1e-10)
    across = [np.einsum("ik,jk->ij", x.root[0], x.root[1]) for x in (one, other)]
    np.testing.assert_allclose(*across, atol=1e-10)
    assert one.deviation()[0] > 0.01
    assert one.deviation()[2] == 0.0


@pytest.mark.weekly
@METHODS
def test_derivatives_of_smoothed_and_late_states_are_exact(method):
    """Also where a parameter of the system is known, so that the covariance is singular."""

    def cost(x):
        filter, belief = of_pendulum(lag=2, method=method)
        filter = eqx.tree_at(lambda f: (f.system.damping, f.sigma), filter, (x[0], x[1:2]))
        belief = dataclasses.replace(belief, root=belief.root.at[:, 2].set(0.0) * x[2])
        belief = last_of(filter, belief, 4)
        belief, innovation = update(filter, belief, {"height": 0.3}, age=2)
        late = belief.mean[1] @ belief.root[2] @ belief.root[0].T @ jnp.ones(3)
        return jnp.sum(belief.mean[0] + belief.mean[2]) + innovation.nis + late

    at = jnp.array([0.2, 0.05, 0.4])
    slope = jax.jit(jax.grad(cost))(at)
    cost, d = jax.jit(cost), 1e-5
    numbers = [(cost(at + d * e) - cost(at - d * e)) / (2 * d) for e in jnp.eye(3)]
    np.testing.assert_allclose(slope, numbers, rtol=1e-6, atol=1e-7)


@pytest.mark.weekly
@METHODS
def test_filtering_of_a_closed_loop_does_not_depend_on_units(method):
    """The slider's place in metres, in units of 3.3 cm, and in metres where the crank is 30 m long."""
    truth = jk.simulate(CrankAlone(), jk.State(jnp.array([0.52]), jnp.array([0.4])), np.arange(0.0, 1.45, 0.05))
    ys = np.asarray(truth["ratio"])[1:] + np.random.default_rng(0).normal(0.0, 0.02, 28)

    def of(system, q):
        filter = Filter(system, {"ratio": 0.02}, noise={"rate": 0.05}, method=method)
        belief = begin(filter, jk.State(jnp.array(q), jnp.array([0.5])), {"angle": 0.1, "rate": 0.3})
        assert float(belief.deviation()[0]) == pytest.approx(0.1, rel=1e-12)  # the slider follows
        return [np.asarray(x) for x in run(filter, belief)]

    @jax.jit
    def run(filter, belief):
        def step(belief, y):
            belief, _ = update(filter, predict(filter, belief, 0.05), y[None])
            return belief, (belief.mean[0], belief.deviation()[0], belief.covariance())

        return jax.lax.scan(step, belief, jnp.asarray(ys))[1]

    mean, deviation, _ = of(CrankAlone(), [0.4])
    place, first = float(np.cos(0.4) + np.sqrt(9.0 - np.sin(0.4) ** 2)), None
    for radius, unit in ((1.0, 1.0), (1.0, 0.033), (30.0, 1.0)):
        other, error, P = of(Crank(radius=radius, unit=unit), [0.4, place * radius / unit])
        first = (other[:, 0], error) if first is None else first
        np.testing.assert_allclose((other[:, 0] - first[0]) / deviation, 0.0, atol=1e-9)
        np.testing.assert_allclose(error, first[1], rtol=1e-9)
        assert np.max(np.abs(other[:, 0] - mean[:, 0]) / deviation) < 0.25
        np.testing.assert_allclose(error, deviation, rtol=0.25)
        # Estimates and their errors satisfy the constraint.
        s, c, x = np.sin(other[:, 0]), np.cos(other[:, 0]), other[:, 1] * unit / radius
        np.testing.assert_allclose((x - c) ** 2 + s**2, 9.0, rtol=1e-10)
        slopes = np.stack([2 * x * s, 2 * (x - c) * unit / radius, 0 * x], axis=1)
        np.testing.assert_allclose(np.einsum("tij,tj->ti", P, slopes), 0.0, atol=1e-10 * np.abs(P).max())


@pytest.mark.slow
def test_initial_standard_deviations_satisfy_the_constraints():
    """Of a point on a circle: y follows from x; if both are given, both are known independently of each other."""
    x, y, a, b = 0.6, 0.8, 0.1, 0.05
    filter, state = Filter(OnACircle(), {"x": 0.1}), jk.State(jnp.array([x, y]), jnp.array([0.0]))
    follows = begin(filter, state, {"x": a})
    np.testing.assert_allclose(follows.deviation(), [a, a * x / y, 0.0], rtol=1e-12)
    both = begin(filter, state, {"x": a, "y": b})
    along = 1 / np.sqrt((y / a) ** 2 + (x / b) ** 2)  # of the angle on the circle
    np.testing.assert_allclose(both.deviation(), [y * along, x * along, 0.0], rtol=1e-12)


def test_the_clock_of_a_filter_does_not_accumulate_rounding_errors():
    filter = Filter(Pendulum(), {"rate": 0.05})
    start = begin(filter, jk.State(jnp.array([0.8]), jnp.array([-0.3])), {"angle": 0.1}, t=1.7e9)
    steps = lambda b: jax.lax.scan(lambda b, _: (predict(filter, b, 1e-3), None), b, None, length=2000)[0]  # noqa: E731
    assert abs(jax.jit(steps)(start).t[0] - 1.7e9 - 2.0) < 2.4e-7  # the distance of numbers near 1.7e9


@pytest.mark.slow
def test_zero_time_steps_and_missing_measurements_change_nothing():
    filter = Filter(Pendulum(), {"rate": 0.05}, noise={"rate": 0.01}, lag=1)
    belief = begin(filter, jk.State(jnp.array([0.8]), jnp.array([-0.3])), {"angle": 0.1})
    still = predict(filter, belief, 0.0)
    jax.tree.map(np.testing.assert_array_equal, still, belief)
    slope = jax.grad(lambda x: jnp.sum(predict(filter, dataclasses.replace(belief, mean=x), 0.0).mean))(belief.mean)
    np.testing.assert_array_equal(slope, 1.0)
    for wrong in (-0.1, np.nan):
        assert np.isnan(predict(filter, belief, wrong).mean[0]).all()
    same, innovation = update(filter, belief, {})
    np.testing.assert_allclose(same.covariance(), belief.covariance(), atol=1e-16)
    assert (float(innovation.nis), int(innovation.n), float(innovation.deviation[0])) == (0.0, 0, 1.0)


@pytest.mark.weekly
@METHODS
def test_the_filter_is_consistent(method):
    """200 simulated motions, of which the truth is known: both squares are chi squared."""
    n, steps, h, density, sigma = 200, 40, 0.05, 0.05, 0.05
    rng = np.random.default_rng(3)
    filter = Filter(Pendulum(), {"rate": sigma}, noise={"rate": density}, method=method)
    belief = begin(filter, jk.State(jnp.array([0.5]), jnp.array([0.0])), {"angle": 0.1, "rate": 0.1})
    truth = np.zeros((n, steps, 2))
    for i in range(n):
        v = np.array([0.5, 0.0, 9.0]) + np.append(rng.normal(0.0, 0.1, 2), 0.0)
        for k in range(steps):
            v = stepped(v, rng.normal(0.0, density**0.5, 3), 0.0, h)
            truth[i, k] = v[:2]
    ys = truth[:, :, 1:] + rng.normal(0.0, sigma, (n, steps, 1))

    def step(belief, now):
        y, at = now
        belief, innovation = update(filter, predict(filter, belief, h), y)
        return belief, (innovation.nis, nees(belief, at))

    nis, errors = jax.jit(jax.vmap(lambda ys, truth: jax.lax.scan(step, belief, (ys, truth))[1]))(ys, truth)
    for squares, freedom in ((nis, 1), (errors, 2)):
        mean = float(np.mean(squares[:, -1]))
        low, high = stats.chi2.ppf([0.0005, 0.9995], freedom * n) / n
        assert low < mean < high
    # White innovations: neighbours do not correlate.
    e = np.sqrt(nis[:, 10:])
    assert abs(np.corrcoef(e[:, 1:].ravel(), e[:, :-1].ravel())[0, 1]) < 0.05


@pytest.mark.weekly
@METHODS
def test_a_parameter_is_estimated_by_the_filter(method):
    system, ts = jk.catalog.DoublePendulum(mass=1.0, length=1.0), np.arange(0.0, 10.0, 0.02)
    start = jk.State(jnp.array([1.0, -0.5]), jnp.zeros(2))
    ride = jk.simulate(system, start, ts)
    ys = np.asarray(ride.q) + np.random.default_rng(1).normal(0.0, 0.01, (len(ts), 2))
    wrong = dataclasses.replace(system, length=1.2)
    noise = {"theta1_dot": 1e-6, "theta2_dot": 1e-6}
    filter = Filter(wrong, {"theta1": 0.01, "theta2": 0.01}, noise=noise, drift={"length": 0.0}, method=method)
    belief = begin(filter, start, {"theta1": 0.05, "theta2": 0.05, "length": 0.3})
    step = lambda belief, y: update(filter, predict(filter, belief, 0.02), y)  # noqa: E731
    belief, innovation = jax.jit(lambda b, ys: jax.lax.scan(step, b, ys))(update(filter, belief, ys[0])[0], ys[1:])
    assert filter.names[-1] == "length"
    assert abs(float(belief.mean[0, -1]) - 1.0) < 2e-3
    assert 1.8 < float(jnp.mean(innovation.nis)) < 2.3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sensors": {"rat": 0.1}}, "`sensors` contains unknown names: rat; did you mean 'rate'"),
        ({"sensors": {"rate": 0.0}}, "`sensors` of rate must be positive and finite, got 0.0"),
        ({"noise": {"angle": 0.1}}, "`noise` contains angle. .* Name independent speeds"),
        ({"noise": {"rate": float("nan")}}, "`noise` of rate must be finite and not negative, got nan"),
        ({"drift": {"dampin": 0.1}}, "`drift` contains unknown names: dampin; did you mean 'damping'"),
        ({"lag": -1}, "`lag` must be an integer of at least 0"),
        ({"substeps": 0}, "`substeps` must be an integer of at least 1"),
    ],
)
def test_invalid_filter_options_are_rejected(options, message):
    with pytest.raises(ValueError, match=message):
        Filter(Pendulum(), **{"sensors": {"rate": 0.1}} | options)


@pytest.fixture(scope="module")
def rejecting():
    """A filter, its state and belief, and the belief of a filter with a lag."""
    filter, lagged = (Filter(Pendulum(), {"rate": 0.1}, lag=lag) for lag in (0, 2))
    state = jk.State(jnp.array([0.8]), jnp.array([-0.3]))
    return filter, state, *(begin(one, state, {"angle": 0.1}) for one in (filter, lagged))


NOT_FINITE = r"update: a measurement is infinite: rate = -?inf\. If it is missing, pass NaN"
OTHER = r"the belief belongs to another filter: its mean has the shape \(3, 2\), but this"
LAG = "from 0 to the filter's lag 0, got"


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda f, s, b, o: begin(f, s, {"torque": 0.1}), "`deviation` contains unknown names: torque"),
        (lambda f, s, b, o: begin(f, s, {"angle": -0.1}), r"`deviation` of angle must be .*, got -0\.1"),
        (lambda f, s, b, o: begin(f, jk.State(s.q, s.u * np.nan), {}), r"state.u: rate = nan is not finite\. Pass"),
        (lambda f, s, b, o: begin(f, s, {}, t=np.inf), "begin: the time t = inf is not finite"),
        (lambda f, s, b, o: update(f, b, {"rat": 0.1}), "unknown names: rat; did you mean 'rate'"),
        (lambda f, s, b, o: update(f, b, jnp.zeros(2)), r"must have the shape \(1,\), got \(2,\)"),
        (lambda f, s, b, o: update(f, b, {"rate": np.inf}), NOT_FINITE),
        (lambda f, s, b, o: update(f, b, [-np.inf]), NOT_FINITE),
        (lambda f, s, b, o: update(f, b, {"rate": 0.1}, age=1), LAG),
        (lambda f, s, b, o: update(f, o, {"rate": 0.1}), OTHER),
        (lambda f, s, b, o: predict(f, o, 0.1), OTHER),
        (lambda f, s, b, o: nees(b, s), r"`truth` must be an array \(2,\) in the order of `filter.names`, got State"),
        (lambda f, s, b, o: nees(b, jnp.zeros(3)), r"got the shape \(3,\)"),
        (lambda f, s, b, o: nees(b, jnp.zeros(2), age=1), LAG),
        (lambda f, s, b, o: b.covariance(1), LAG),
        (lambda f, s, b, o: b.deviation(-1), LAG),
    ],
)
def test_invalid_beliefs_and_measurements_are_rejected(rejecting, ask, message):
    with pytest.raises(ValueError, match=message):
        ask(*rejecting)


def test_invalid_numbers_in_a_traced_program(rejecting):
    filter, _, belief, _ = rejecting
    assert not np.isfinite(jax.jit(lambda y: update(filter, belief, y)[0].mean)(jnp.array([jnp.inf]))).any()
    traced = r"`noise` of rate must be a concrete number, not one that is traced by jax\.jit"
    with pytest.raises(TypeError, match=traced):
        jax.grad(lambda x: Filter(Pendulum(), {"rate": 0.1}, noise={"rate": x}).density[0])(1.0)
    with pytest.raises(TypeError, match=r"`sensors` of rate must be a concrete number"):
        jax.jit(lambda x: Filter(Pendulum(), {"rate": x}).sigma)(1.0)


def test_nees_does_not_depend_on_units():
    """Among metres and nanometres: five deviations of the small one are 25, and a combination without variance is 0."""
    S = jnp.array([[1.0, 0.0], [0.0, 1e-9]])
    of = lambda S, error: float(nees(Belief(jnp.zeros(1), jnp.zeros((1, 2)), S[None], jnp.zeros(())), jnp.array(error)))  # noqa: E731
    assert of(S, [0.0, 5e-9]) == pytest.approx(25.0)
    assert of(jnp.array([[1.0, 0.0], [1e-9, 0.0]]), [2.0, 2e-9]) == pytest.approx(4.0)
    assert of(jnp.zeros((2, 2)), [1.0, 1.0]) == 0.0
