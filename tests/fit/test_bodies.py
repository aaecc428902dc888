"""Parameters as bijections: intervals, bodies that stay possible, their inverses and determinants."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane.catalog import RigidBody, WhippleBicycle
from jaxkane.fit import Free, Inertia, LeastSquares, Problem, Trial, frame_inertia, minimize
from jaxkane.fit.problem.bodies import PossibleBody
from jaxkane.fit.problem.specification import parameters_of

BICYCLE = WhippleBicycle.benchmark()
MOMENTS = ("I11", "I22", "I33")


def is_possible(values):
    """Whether a mass distribution has [m, c, Ixx, Iyy, Izz, Ixy, Ixz, Iyz]: each moment below the sum of the others."""
    m, (xx, yy, zz, xy, xz, yz) = values[0], values[4:]
    moments = np.linalg.eigvalsh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
    return m > 0 and moments[0] > 0 and moments[2] < moments[0] + moments[1]


@pytest.mark.slow_cases(all_but=["moves3-wheel3"])
@pytest.mark.parametrize(
    ("moves", "wheel"),
    [
        (tuple(range(10)), None),
        ((1, 3, 4, 5, 6, 8), None),
        ((4, 5, 6), None),
        ((0, 4, 5), (0, 2)),
    ],
)
def test_every_parameter_vector_maps_to_a_possible_body_and_back(moves, wheel):
    tolerance = 1e-9
    values = [12.0, 0.3, 0.0, -0.6, 1.4, 2.0, 1.4, 0.0, 0.0, 0.0]
    body = PossibleBody.of(values, moves, wheel)
    np.testing.assert_allclose(
        body(jnp.zeros(len(moves))), np.array(values)[list(moves)], rtol=tolerance, atol=tolerance
    )
    everything, back = jax.jit(lambda x: body.all_values(body.factors(x))), jax.jit(lambda x: body.inverse(body(x)))
    for x in np.random.default_rng(0).normal(0.0, 1.5, (200, len(moves))):
        assert is_possible(np.asarray(everything(jnp.asarray(x))))
        np.testing.assert_allclose(back(jnp.asarray(x)), x, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
@pytest.mark.weekly_cases("jacrev")
@pytest.mark.parametrize("jacobian", [jax.jacfwd, jax.jacrev], ids=["jacfwd", "jacrev"])
def test_intervals_and_bodies_in_one_compiled_program(jacobian):
    """A warning ends the test where they are not."""
    intervals = Free("IBxx", bounds=(5.0, 20.0)), Free("zB", bounds=(None, -0.1))
    free = (*intervals, "mB", Free("c", scale=0.02), frame_inertia("H"), frame_inertia("F", fixed=()))
    parameters = parameters_of(BICYCLE, free)
    assert parameters.names[4:] == ("xH", "zH", "IHxx", "IHyy", "IHzz", "IHxz", "mF", "IFxx", "IFyy")
    x = jnp.asarray(np.random.default_rng(1).normal(0.0, 1.0, parameters.size))
    values, inverse = jax.jit(lambda x: parameters.values(x)), jax.jit(lambda v: parameters.inverse(v))
    np.testing.assert_allclose(values(x), parameters.values(x), rtol=1e-14)
    np.testing.assert_allclose(inverse(values(x)), x, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(values(jnp.zeros_like(x)), parameters.start, rtol=1e-12)
    system, _ = parameters.apply(BICYCLE, x)
    assert 5.0 < float(system.IBxx) < 20.0
    assert float(system.zB) < -0.1
    slopes = jax.jit(jacobian(values))(x)
    np.testing.assert_allclose(slopes, parameters.slopes(x), rtol=1e-12, atol=1e-13)
    h = 1e-6  # of central differences
    numbers = np.stack([(values(x + h * e) - values(x - h * e)) / (2 * h) for e in jnp.eye(len(x))], axis=1)
    np.testing.assert_allclose(slopes, numbers, rtol=1e-6, atol=1e-6)
    assert float(parameters.log_determinant(x)) == pytest.approx(np.linalg.slogdet(slopes)[1], abs=1e-9)


def test_impossible_inertias_and_invalid_names_are_rejected():
    with pytest.raises(ValueError, match=r"Inertia of I11, I22, I33: mass 2 kg .* is not physically possible"):
        parameters_of(RigidBody(2.0, I33=4.0), Inertia(MOMENTS, mass="mass"))
    with pytest.raises(ValueError, match="Name all three products"):
        parameters_of(BICYCLE, Inertia(("IBxx", "IByy", "IBzz"), ("IBxz", "IHxz", None)))
    with pytest.raises(ValueError, match="`fixed` contains mH; it may contain only mB"):
        parameters_of(BICYCLE, Inertia(("IBxx", "IByy", "IBzz"), mass="mB", fixed=("mH",)))
    with pytest.raises(ValueError, match="sets IBxx more than once"):
        parameters_of(BICYCLE, (frame_inertia("B"), "IBxx"))


@pytest.mark.weekly
def test_inertia_of_a_thin_plate_is_estimated_only_with_possible_bodies():
    # A thin plate turns freely under small known torques: its third moment is nearly the sum of the two others.
    truth, rng = RigidBody(1.0, I11=1.0, I22=2.0, I33=2.97), np.random.default_rng(2)
    guess, t, trials, seen = RigidBody(1.0, I11=2.0, I22=2.2, I33=2.4), np.arange(0.0, 3.0, 0.05), [], []
    for k in range(2):
        torque = {f"torque{i}": 0.5 * np.sin((i + k) * t) for i in (1, 2, 3)}
        spin = dict(zip(("omega1", "omega2", "omega3"), rng.uniform(-2.0, 2.0, 3), strict=True))
        motion = jk.simulate(truth, jk.assemble(truth, {"e4": 1.0}, spin), t, torque)
        measured = {name: np.asarray(motion[name]) + rng.normal(0.0, 0.3, t.size) for name in spin}
        trials.append(Trial(t, measured, torque, sigma=0.3, initial={"e4": 1.0}, name=f"throw {k}"))

    def fitted(free):
        seen.clear()
        problem = Problem.of(guess, trials, free, unknown=("omega1", "omega2", "omega3"))
        watch = lambda point, cost: seen.append(problem.parameters.apply(guess, point.parameters)[0])  # noqa: E731
        found = minimize(problem, LeastSquares(), callback=watch)
        return found, [is_possible([1.0, 0, 0, 0, s.I11, s.I22, s.I33, 0, 0, 0]) for s in seen]

    result, possible = fitted(Inertia(MOMENTS, mass="mass", fixed=("mass",)))
    assert result.status == "converged"
    assert len(possible) > 3
    assert all(possible)
    for name in MOMENTS:
        assert abs(result.estimates[name] - float(getattr(truth, name))) < 4.0 * result.standard_errors[name] + 0.02
    assert "body of I11, I22, I33: principal moments" in str(result)
    # Each moment by itself, positive as it is, leads to what no body can be.
    assert not all(fitted(MOMENTS)[1])
