"""Linear models about steady motions: against the literature, closed forms, and the motion itself."""

import dataclasses
import functools
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from mechanisms import RodOnPin

import jaxkane as jk
from jaxkane import stability
from jaxkane.joints import Link, ball, mechanism
from jaxkane.stability import linearize, straight_ahead

BIKE = jk.catalog.WhippleBicycle.benchmark()
PUBLISHED = json.loads((Path(__file__).parents[1] / "data" / "meijaard2007.json").read_text())["canonical"]
LATERAL = ("roll", "steer", "roll_rate", "steer_rate")


@pytest.fixture(scope="module")
def models():
    """Linear models riding straight at 0 ... 10 m/s."""
    return jax.jit(jax.vmap(lambda v: linearize(BIKE, straight_ahead(BIKE, v), states=LATERAL)))(jnp.arange(11.0))


@pytest.mark.slow
def test_linear_models_of_the_bicycle_agree_with_meijaard_at_eleven_speeds(models):
    atol = 1e-11
    M, C1, K0, K2 = (np.array(PUBLISHED[name]) for name in ("M", "C1", "K0", "K2"))
    for v, A, B in zip(range(11), models.A, models.B, strict=True):
        below = -np.linalg.solve(M, np.hstack([9.81 * K0 + v**2 * K2, v * C1]))
        np.testing.assert_allclose(A, np.vstack([np.eye(4)[2:], below]), atol=atol)
        np.testing.assert_allclose(B[2:, [0, 2]], np.linalg.inv(M), atol=atol)
        np.testing.assert_allclose(B[:, 1], 0.0, atol=atol)


def test_canonical_matrices():
    atol = 1e-12
    found = jax.jit(stability.canonical)(BIKE)
    for name in ("M", "C1", "K0", "K2"):
        np.testing.assert_allclose(getattr(found, name), PUBLISHED[name], atol=atol)
    np.testing.assert_allclose(found.C0, 0.0, atol=atol)
    damped = jax.jit(stability.canonical)(dataclasses.replace(BIKE, steer_damping=3))
    np.testing.assert_allclose(damped.C0, [[0.0, 0.0], [0.0, 3.0]], atol=atol)


@pytest.mark.slow
def test_default_states_and_outputs_of_dependent_speeds():
    """Without cyclic coordinates; yaw rate = (v steer + c steer_rate) cos(lam) / w to first order."""
    atol = 1e-12
    model = linearize(BIKE, straight_ahead(BIKE, 5.0), outputs=("yaw_rate", "steer"))
    assert model.states == ("roll", "steer", "roll_rate", "rear_wheel_rate", "steer_rate")
    assert model.inputs == BIKE.inputs
    steer, rate = np.cos(float(BIKE.lam)) / float(BIKE.w) * np.array([5.0, float(BIKE.c)])
    np.testing.assert_allclose(model.C, [[0, steer, 0, 0, rate], [0, 1, 0, 0, 0]], atol=atol)
    np.testing.assert_allclose(model.D, 0.0, atol=atol)
    assert repr(model).startswith("LinearModel(states: roll, steer, roll_rate")


@pytest.mark.weekly
def test_dependent_coordinates_follow_the_constraint():
    """Hanging: y_ddot = -(g / l) y - (d / m) y_dot + push / m; and a position that is curved, by a function."""
    atol = 1e-14
    rod = RodOnPin(length=0.7, damping=0.4)
    at = stability.equilibrium(rod, {"x": 0.6})
    A, B, _, _ = linearize(rod, at)
    np.testing.assert_allclose(A, [[0, 1], [-9.8 / 0.7, -0.2]], atol=atol)
    np.testing.assert_allclose(B, [[0], [0.5]], atol=atol)
    model = linearize(rod, at, outputs={"angle": lambda t, q, u: jnp.arctan2(q["y"], q["x"])})
    np.testing.assert_allclose(model.C, [[1 / 0.7, 0]], atol=atol)


@pytest.mark.slow
def test_about_a_displaced_equilibrium_against_differences():
    """Pushed aside by 5 N; differences of the rates along the circle."""
    atol = 1e-8
    rod = RodOnPin(length=0.7)
    at = stability.equilibrium(rod, {"y": 0.1, "x": 0.69}, {"push": 5.0})
    angle = np.arctan2(5.0, 2.0 * 9.8)
    np.testing.assert_allclose(at.q, [0.7 * np.sin(angle), 0.7 * np.cos(angle)], atol=1e-14)
    A = linearize(rod, at).A

    def rate(y):
        q = jnp.array([y, np.sqrt(0.7**2 - y**2)])
        return float(jk.accelerations(rod, 0.0, q, jnp.zeros(1), {"push": 5.0})[0])

    y, h = float(at["y"]), 1e-5
    np.testing.assert_allclose(A, [[0, 1], [(rate(y + h) - rate(y - h)) / (2 * h), 0]], atol=atol)
    other = linearize(rod, at, dependent=("y",), states=("x", "v"))  # the same motion in another coordinate
    np.testing.assert_allclose(np.linalg.eigvals(other.A), np.linalg.eigvals(A), rtol=1e-12)


@pytest.mark.slow
def test_linear_models_are_differentiable():
    rtol = 1e-12
    frequency_squared = lambda length: -linearize(rod := RodOnPin(length=length), _hanging(rod)).A[1, 0]  # noqa: E731
    value, slope = jax.jit(jax.value_and_grad(frequency_squared))(0.7)
    np.testing.assert_allclose([value, slope], [9.8 / 0.7, -9.8 / 0.49], rtol=rtol)


def _hanging(rod):
    return jk.State(jnp.stack([jnp.zeros_like(rod.length), rod.length]), jnp.zeros(1))


@pytest.mark.slow
def test_invalid_linearizations_raise_by_name():
    moving = jk.State(jnp.zeros(8).at[0].set(0.1), jnp.array([0.0, -10.0, 0.0]))
    with pytest.raises(ValueError, match=r"this motion is not steady: roll_rate is accelerated by .*equilibrium or"):
        linearize(BIKE, jk.assemble(BIKE, moving.q, moving.u))
    assert np.isfinite(linearize(BIKE, moving, steady=False).A).all()
    at = straight_ahead(BIKE, 5.0)
    with pytest.raises(ValueError, match="cannot be in `states`: pitch, speed"):
        linearize(BIKE, at, states=("roll", "pitch", "speed"))
    with pytest.raises(ValueError, match="unknown: lean; there are roll"):
        linearize(BIKE, at, outputs=("lean",))
    with pytest.raises(ValueError, match=r"1 configuration constraints .* but 0 are named"):
        linearize(BIKE, at, dependent=())
    with pytest.raises(ValueError, match="violate the configuration constraints"):
        linearize(BIKE, jk.State(at.q.at[4].set(0.1), at.u))


# -- control


@pytest.fixture(scope="module")
def at_four(models):
    return jax.tree.map(lambda x: x[4], models)


@pytest.mark.parametrize("y", [0.0, 1e-14])
def test_linearize_rejects_undetermined_dependent_coordinates(y):
    """A ring at the height of its centre, and a wrong choice of `dependent` below it: an error, NaN under a trace."""
    ring = RodOnPin(length=0.6)
    model = lambda q, dependent: linearize(ring, jk.State(q, jnp.zeros(1)), dependent=dependent, steady=False)  # noqa: E731
    for q, dependent in (([0.6, y], "x"), ([y, 0.6], "y")):
        with pytest.raises(ValueError, match=f"do not determine {dependent} to|cannot be solved for {dependent}_dot"):
            model(jnp.array(q), (dependent,))
        assert np.isnan(jax.jit(lambda q: model(q, (dependent,)).A)(jnp.array(q))).all()  # noqa: B023


@pytest.mark.slow
def test_singular_equations_and_derivatives_raise():
    """A ball joint at half a turn, where its norm does not give the last Euler parameter; a speed that is not
    determined; an output without a slope."""
    link = Link("a", None, ball("s", stiffness=2.0), mass=1.0, inertia=(0.5, 0.5, 0.5))
    body = mechanism([link], gravity=(0, 0, 0))
    half_a_turn = jk.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3))
    with pytest.raises(
        ValueError,
        match=r"do not determine s_e4 to first order at .*Pass other coordinates as .*: s_e1, s_e2, s_e3, s_e4",
    ):
        linearize(body, half_a_turn, steady=False)
    assert np.isfinite(linearize(body, half_a_turn, steady=False, dependent=("s_e1",), states=body.speeds).A).all()
    ring, aside = RodOnPin(length=0.6), jk.State(jnp.array([0.6, 0.0]), jnp.zeros(1))
    with pytest.raises(ValueError, match="RodOnPin: the constraints cannot be solved for x_dot"):
        linearize(ring, aside, dependent=("y",), steady=False)
    below = jk.State(jnp.array([0.0, 0.6]), jnp.zeros(1))
    with pytest.raises(ValueError, match="derivatives of the equations or outputs are not finite"):
        linearize(ring, below, outputs={"distance": lambda t, q, u: jnp.sqrt(q["y"])})


def test_unknown_and_repeated_names_of_a_linear_model_raise():
    ring, below = RodOnPin(length=0.6), jk.State(jnp.array([0.0, 0.6]), jnp.zeros(1))
    with pytest.raises(ValueError, match="`dependent` contains unknown names: z; the coordinates are y, x"):
        linearize(ring, below, dependent=("z",))
    speed = ring.speeds[0]
    with pytest.raises(ValueError, match=f"{speed} is named twice in `states`"):
        linearize(ring, below, states=(speed, speed))


def test_lqr_balances_the_bicycle_by_steering(at_four):
    atol = 1e-8
    K, P, poles = stability.lqr(at_four, [1.0, 1.0, 0.1, 0.1], 0.01, inputs=("steer_torque",))
    assert np.linalg.eigvals(at_four.A).real.max() > 0 > poles.real.max()
    A, B = np.asarray(at_four.A), np.asarray(at_four.B)[:, [2]]
    riccati = A.T @ P + P @ A - P @ B @ B.T @ P / 0.01 + np.diag([1.0, 1.0, 0.1, 0.1])
    np.testing.assert_allclose(riccati / np.abs(P).max(), 0.0, atol=atol)
    np.testing.assert_allclose(K, B.T @ P / 0.01)
    with pytest.raises(ValueError, match=r"no regulator of roll, .* by drive_torque"):
        stability.lqr(at_four, np.ones(4), 1.0, inputs=("drive_torque",))
    with pytest.raises(ValueError, match=r"Q must be \(4, 4\)"):
        stability.lqr(at_four, np.ones(3), 1.0)
    for Q, R in ((np.ones(4), 0.0), (-np.ones(4), 1.0), (np.full(4, np.nan), 1.0)):
        with pytest.raises(ValueError, match=r"positive semidefinite|one finite weight"):
            stability.lqr(at_four, Q, R, inputs=("steer_torque",))


def test_to_control_preserves_names_and_requires_python_control(at_four, monkeypatch):
    with monkeypatch.context() as without:
        without.setitem(__import__("sys").modules, "control", None)
        with pytest.raises(ImportError, match=r"jaxkane\[control\]"):
            stability.to_control(at_four)
    pytest.importorskip("control")
    space = stability.to_control(at_four)
    assert space.state_labels == list(LATERAL)
    np.testing.assert_allclose(space.A, at_four.A)


# -- a turn


@pytest.mark.weekly
def test_linear_model_of_a_steady_turn_is_the_return_map():
    """Deviations after 0.5 s on a hands-free turn: expm(A t) against central differences of simulated rides."""
    atol = 1e-6
    turn = stability.steady_turn(BIKE, {"steer": 0.3}, {"rear_wheel_rate": -12.0}, hold={"roll": 0.4})
    model = linearize(BIKE, turn)
    assert abs(float(turn["yaw_rate"])) > 1.0
    ts = jnp.array([0.0, 0.5])
    kept = [BIKE.coordinates.index("roll"), BIKE.coordinates.index("steer")]

    @jax.jit
    def after(x):
        state = jk.assemble(BIKE, turn.q.at[np.array(kept)].add(x[:2]), turn.u + x[2:])
        ride = jk.simulate(BIKE, state, ts, rtol=1e-12, atol=1e-12)
        return jnp.concatenate([ride.q[-1][np.array(kept)], ride.u[-1]])

    h = 1e-4
    columns = [(after(h * e) - after(-h * e)) / (2 * h) for e in np.eye(5)]
    exact = scipy.linalg.expm(np.asarray(model.A) * 0.5)
    np.testing.assert_allclose(np.stack(columns, axis=1), exact, atol=atol * np.abs(exact).max())


@functools.cache
def ahead():
    """The bicycle at 4 m/s."""
    return straight_ahead(BIKE, 4.0)


CASES = {
    "a class for a system": (lambda: linearize(type(BIKE), ahead()), TypeError, "instance of a System"),
    "another system's steady motion": (lambda: linearize(BIKE, AT_REST), ValueError, "belongs to another system"),
    "an output that is two numbers": (
        lambda: linearize(BIKE, ahead(), outputs={"both": lambda t, q, u: jnp.stack([q["roll"], q["steer"]])}),
        TypeError,
        "output 'both' must be one number",
    ),
    "text for a speed": (lambda: straight_ahead(BIKE, "4"), ValueError, "speed must be one finite number"),
    "values in two axes": (lambda: stability.eigenvalues(BIKE, np.ones((2, 2))), TypeError, "must be real numbers"),
    "none are kept": (lambda: stability.critical_speeds(BIKE, most=0), ValueError, "positive number.*got 0"),
    "a state for a steady motion": (
        lambda: stability.family(BIKE, ahead(), towards={}),
        TypeError,
        "must be a SteadyMotion",
    ),
    "a family of another system": (
        lambda: stability.family(BIKE, AT_REST, towards={"roll": 1.0}),
        ValueError,
        "belongs to another system",
    ),
}
AT_REST = stability.SteadyMotion(
    *(jnp.zeros(n) for n in (2, 2, 0, 0)), {}, 0.0, 0.0, (("theta1", "theta2"), ("theta1_dot", "theta2_dot"), (), ())
)


@pytest.mark.parametrize("case", CASES)
def test_invalid_arguments_raise_an_explained_error(case):
    call, error, words = CASES[case]
    with pytest.raises(error, match=words):
        call()
