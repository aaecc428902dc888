"""Where windows start: what a trial does not say of coordinates follows from the constraints, as for `assemble`."""

import equinox as eqx
import jax
import numpy as np
import pytest

import jaxkane as jk
from jaxkane.fit import Problem, Simulation, Trial

t = np.linspace(0.0, 1.0, 3)


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
    coordinates, speeds = ("e1", "e2", "e3", "e4"), ("w1", "w2", "w3")

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


def posed(system, free, *trials, **options):
    return Problem.of(system, trials, free, simulation=Simulation(step=0.5), **options)


def starts(problem):
    """The coordinates (W, n_q) where the windows start."""
    consistent = jax.jit(jax.vmap(lambda window, z: problem.model.consistent(window, z, problem.start.x)))
    return np.asarray(consistent(problem.windows, problem.start.z))[:, : len(problem.system.coordinates)]


def bead(initial, **measured):
    return Trial(t, {"x_dot": np.zeros(3), **measured}, sigma=0.1, initial=initial, name=f"bead {sorted(initial)}")


@pytest.mark.parametrize("follows", [(), ("y",)])
def test_what_a_trial_says_is_held(follows):
    system = Wire(follows=follows)
    np.testing.assert_allclose(starts(posed(system, "mass", bead({"x": 0.3}))), [[0.3, 0.7]], atol=1e-9)
    np.testing.assert_allclose(jk.assemble(system, {"x": 0.3}).q, [0.3, 0.7], atol=1e-9)
    measured = posed(system, "mass", bead({}, x=np.array([0.2, 0.3, 0.4])))
    np.testing.assert_allclose(starts(measured), [[0.2, 0.8]], atol=1e-9)
    unknown = posed(system, "mass", bead({}), unknown=("x",))
    np.testing.assert_allclose(starts(unknown), [[0.0, 1.0]], atol=1e-9)


def test_what_contradicts_itself_is_moved_to_the_nearest():
    both = {"x": 0.3, "y": 0.5}
    np.testing.assert_allclose(starts(posed(Wire(), "mass", bead(both))), [[0.4, 0.6]], atol=1e-9)


def test_a_trial_that_does_not_say_what_others_do_is_named():
    with pytest.raises(ValueError, match=r"bead \['x'\] says nothing of y, which is held .* name it in `initial`"):
        posed(Wire(), "mass", bead({"x": 0.3}), bead({"y": 0.3}))
    of_each = posed(Wire(follows=("y",)), "mass", bead({"x": 0.3}), bead({}))
    np.testing.assert_allclose(starts(of_each), [[0.3, 0.7], [0.0, 1.0]], atol=1e-9)


@pytest.mark.parametrize("follows", [(), ("e4",)])
def test_euler_parameters_that_nobody_names_are_no_rotation(follows):
    turned = Trial(t, {"w1": np.zeros(3)}, sigma=0.1)
    np.testing.assert_allclose(starts(posed(Spun(follows=follows), "inertia", turned)), [[0, 0, 0, 1]], atol=1e-9)
    axis = {"e1": 0.6, "e2": 0.0, "e3": 0.0}
    turned = Trial(t, {"w1": np.zeros(3)}, sigma=0.1, initial=axis)
    np.testing.assert_allclose(starts(posed(Spun(follows=follows), "inertia", turned)), [[0.6, 0, 0, 0.8]], atol=1e-9)
