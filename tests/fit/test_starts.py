"""Initial states of windows: coordinates that a trial omits follow from the constraints, as for `assemble`."""

import equinox as eqx
import jax
import numpy as np
import pytest

import jaxkane as jk
from jaxkane.fit import LeastSquares, Problem, Simulation, Trial, minimize
from jaxkane.fit.result.diagnostics import wrong_sigma

t = np.linspace(0.0, 1.0, 3)
E = ("e1", "e2", "e3", "e4")


class Wire(jk.System):
    """A bead on the line x + y = 1."""

    mass: jk.Scalar = jk.parameter(1.0, positive=True)
    follows: tuple = eqx.field(static=True, default=())
    coordinates, speeds, dependent_speeds = ("x", "y"), ("x_dot",), ("y_dot",)

    @property
    def dependent_coordinates(self):
        return self.follows

    def motion(self, t, q, u):
        N, O = jk.inertial()
        bead = jk.Body(self.mass, 0.0, O.moving(q[0] * N.x + q[1] * N.y, u[0] * N.x + u[1] * N.y), name="bead")
        return jk.Motion([bead], [u["x_dot"] + u["y_dot"]])

    def configuration_constraints(self, t, q):
        return [q["x"] + q["y"] - 1.0]


class Spun(jk.System):
    """A free body, turned as Euler parameters say."""

    inertia: jk.Scalar = jk.parameter(0.2, positive=True)
    follows: tuple = eqx.field(static=True, default=())
    coordinates, speeds = E, ("w1", "w2", "w3")

    @property
    def dependent_coordinates(self):
        return self.follows

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(1.0, (self.inertia, 0.2, 0.2), O, N.rotate_euler(q, u, "B"))])

    def q_dot(self, t, q, u):
        return jk.rotations.euler_parameter_rates(q, u)

    def configuration_constraints(self, t, q):
        return [sum(e * e for e in q) - 1.0]


class Sliding(Spun):
    """It also slides along x, of which nothing is known."""

    coordinates, speeds = ("x", *E), ("x_dot", "w1", "w2", "w3")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        B = N.rotate_euler(q["e1":"e4"], u["w1":"w3"], "B")
        return jk.Motion([jk.Body(1.0, (self.inertia, 0.2, 0.2), O.moving(q["x"] * N.x, u["x_dot"] * N.x), B)])

    def q_dot(self, t, q, u):
        return u["x_dot"], *jk.rotations.euler_parameter_rates(q["e1":"e4"], u["w1":"w3"])

    def configuration_constraints(self, t, q):
        return [jk.rotations.euler_parameter_norm(q["e1":"e4"])]


def posed(system, free, *trials, **options):
    return Problem.of(system, trials, free, simulation=Simulation(step=0.5), **options)


@pytest.mark.slow
def test_an_initial_value_that_is_not_measured_at_the_start_is_rejected():
    wire = Wire(follows=("y",))
    gap = {"x": [np.nan, 0.3, 0.4]}
    late = Trial(np.arange(5.0), {"x": [0.1, 0.2, np.nan, 0.4, 0.5]}, sigma=0.1, name="late")
    for trials, options, where in (
        ([Trial(t, gap, sigma=0.1, initial={"x_dot": 0.6}, name="late")], {}, 0),
        ([late], {"window": 2.0}, 2),
        ([late.between(0.0, 1.0), late.between(2.0, 4.0)], {}, 2),
    ):
        message = rf"late: x is not measured at t = {where} s, where a window starts. Add it to `unknown`"
        with pytest.raises(ValueError, match=message):
            posed(wire, ["mass"], *trials, **options)
        posed(wire, ["mass"], *trials, **options, unknown=["x"])
    posed(wire, ["mass"], late)
    posed(wire, ["mass"], Trial(t, gap, sigma=0.1, initial={"x": 0.2}))
    posed(wire, ["mass"], Trial(t, {"x": [0.2, np.nan, 0.4], "y": [np.nan, 0.7, 0.6]}, sigma=0.1))
    posed(wire, ["mass"], Trial(t, gap | {"x_dot": [np.nan] * 3}, sigma=0.1), unknown=["x"])


def starts(problem):
    """The coordinates (W, n_q) where the windows start."""
    consistent = jax.jit(jax.vmap(lambda window, z: problem.model.consistent(window, z, problem.start.parameters)))
    return np.asarray(consistent(problem.windows, problem.start.window_starts))[:, : len(problem.system.coordinates)]


def bead(initial, **measured):
    return Trial(t, {"x_dot": np.zeros(3), **measured}, sigma=0.1, initial=initial, name=f"bead {sorted(initial)}")


@pytest.mark.weekly
@pytest.mark.parametrize("follows", [(), ("y",)])
def test_known_initial_coordinates_are_kept_in_assembly(follows):
    system, x = Wire(follows=follows), np.array([0.2, 0.3, 0.4])
    for trial, options, expected in (
        (bead({"x": 0.3}), {}, [0.3, 0.7]),
        (bead({}, x=x), {}, [0.2, 0.8]),
        (bead({}), {"unknown": ("x",)}, [0.0, 1.0]),
    ):
        np.testing.assert_allclose(starts(posed(system, "mass", trial, **options)), [expected], atol=1e-9)
    np.testing.assert_allclose(jk.assemble(system, {"x": 0.3}).q, [0.3, 0.7], atol=1e-9)
    if not follows:  # both are given, and are moved to the nearest that are consistent
        both = bead({"x": 0.3, "y": 0.5})
        np.testing.assert_allclose(starts(posed(system, "mass", both)), [[0.4, 0.6]], atol=1e-9)


@pytest.mark.weekly
@pytest.mark.parametrize("follows", [(), ("e4",)])
def test_missing_euler_parameters_default_to_no_rotation(follows):
    for initial, expected in (({}, [0, 0, 0, 1]), ({"e1": 0.6, "e2": 0.0, "e3": 0.0}, [0.6, 0, 0, 0.8])):
        turned = Trial(t, {"w1": np.zeros(3)}, sigma=0.1, initial=initial)
        found = starts(posed(Spun(follows=follows), "inertia", turned))
        np.testing.assert_allclose(found, [expected], atol=1e-9)


@pytest.mark.slow
def test_a_trial_without_the_initial_values_of_the_others_is_reported():
    reason = r"bead \['x'\]: there are no data for y, whose initial value .* Add it to `initial`"
    with pytest.raises(ValueError, match=reason):
        posed(Wire(), "mass", bead({"x": 0.3}), bead({"y": 0.3}))
    of_each = posed(Wire(follows=("y",)), "mass", bead({"x": 0.3}), bead({}))
    np.testing.assert_allclose(starts(of_each), [[0.3, 0.7], [0.0, 1.0]], atol=1e-9)


@pytest.mark.slow_cases("all", "sliding")
@pytest.mark.parametrize("system", [Spun(), Spun(follows=("e4",)), Sliding()], ids=["all", "dependent", "sliding"])
def test_four_measured_euler_parameters_are_brought_to_unit_norm(system):
    raw = np.array([0.1, -0.5, 0.7, 1e-3])
    measured = Trial(t, {name: np.full(3, x) for name, x in zip(E, raw, strict=True)}, sigma=0.1)
    for unknown in ((), E, E[:3]):
        problem = posed(system, "inertia", measured, unknown=unknown)
        np.testing.assert_allclose(starts(problem)[0][-4:], raw / np.linalg.norm(raw), atol=1e-12)
        # The fourth follows from the norm of three: to estimate it, too, is no remedy for large residuals.
        (note,) = wrong_sigma(problem, 4.0, 100.0)
        fixed = ", ".join(name for name in E if name not in system.dependent_coordinates)
        assert ("start at measured samples" in note) == (not unknown)
        assert (f"samples of {fixed}," in note) == (not unknown)


def turning(sigma=0.01):
    """A body that tumbles, and noise in what is measured of its orientation."""
    t, rng = np.linspace(0.0, 2.0, 41), np.random.default_rng(0)
    start = jk.assemble(Spun(inertia=0.3), {"e1": 0.2, "e2": -0.4, "e3": 0.1}, {"w1": 1.0, "w2": 2.0, "w3": -0.5})
    ride = jk.simulate(Spun(inertia=0.3), start, t)
    measured = {name: np.asarray(ride[name]) + rng.normal(0.0, sigma, t.size) for name in E}
    return Trial(t, measured, sigma=sigma, initial={"w1": 1.0, "w2": 2.0, "w3": -0.5})


@pytest.mark.weekly
@pytest.mark.parametrize(("follows", "window"), [((), None), (("e4",), 1.0)])
def test_four_unknown_euler_parameters_are_three_degrees_of_freedom(follows, window):
    system, unknown = Spun(inertia=0.25, follows=follows), (*E, "w1", "w2", "w3")
    options = {"unknown": unknown, "window": window, "simulation": Simulation(step=0.05)}
    problem = Problem.of(system, turning(), "inertia", **options)
    found = minimize(problem, LeastSquares())
    assert found.status == "converged"
    assert not any("body" in note for note in found.notes)
    assert abs(found.estimates["inertia"] - 0.3) < 3 * found.standard_errors["inertia"]
    begun = np.array([found.nuisance["trial"][f"start of {name}"] for name in E])
    np.testing.assert_allclose(np.sum(begun**2, axis=0), 1.0, atol=1e-5)
    # Of the unknowns of a window the norm alone is not measured, and is counted among what is given.
    windows = len(problem.slices)
    assert problem.size == (4 * 41 + windows, 1 + 7 * windows)


@pytest.mark.weekly
def test_an_initial_speed_that_is_not_given_is_reported():
    def notes_of(*trials, **options):
        problem = posed(Wire(follows=("y",)), "mass", *trials, **options)
        return [note for note in minimize(problem, LeastSquares(), steps=0).notes if "starts at zero" in note]

    x = {"x": [0.1, 0.2, 0.3]}
    silent, still = Trial(t, x, sigma=0.1, name="a"), Trial(t, x, sigma=0.1, initial={"x_dot": 0.0}, name="b")
    gap = Trial(t, x | {"x_dot": [np.nan] * 3}, sigma=0.1, name="c")
    (note,) = notes_of(silent)
    assert note.startswith("x_dot starts at zero in all trials: not measured, not in `initial` and not in `unknown`.")
    assert "`unknown=('x_dot',)`" in note
    assert "`initial={'x_dot': 0.0}`" in note
    (note,) = notes_of(silent, still, gap)
    assert note.startswith("x_dot starts at zero in a, c:")
    assert not notes_of(silent, unknown=["x_dot"])
    assert not notes_of(Trial(t, x | {"x_dot": [0.1, 0.1, np.nan]}, sigma=0.1))
