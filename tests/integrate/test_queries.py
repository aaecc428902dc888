"""Places, velocities, orientations and rates of speeds by name, along trajectories, batches and early ends."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from slopes import slopes

import jaxkane as jk
from jaxkane import fit
from jaxkane.catalog import DoublePendulum
from jaxkane.joints import Link, hinge, mechanism

TS = jnp.linspace(0.0, 2.0, 5)


class Disc(jk.System):
    """A disc that rolls along N.x; it ends where it has rolled 0.6 m."""

    radius: jk.Scalar = jk.parameter(0.5)
    push: jk.Scalar = jk.parameter(0.3)  # [N m]
    coordinates, speeds, dependent_speeds = ("x", "spin"), ("spin_rate",), ("x_dot",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        B = N.rotate(2, q["spin"], u["spin_rate"], "B")
        G = O.moving(q["x"] * N.x, u["x_dot"] * N.x)
        rim = G.fixed(self.radius * B.x)
        return jk.Motion(
            [jk.Body(1.0, (0.1, 0.2, 0.1), G, B, name="disc")],
            [u["x_dot"] - self.radius * u["spin_rate"]],
            points={"rim": rim, "contact": jk.Point.at(0.0 * N.x)},
            frames={"B": B},
        )

    def q_dot(self, t, q, u):
        return u["x_dot"], u["spin_rate"]

    def loads(self, t, q, u, motion, inputs):
        return jk.Torque(self.push * motion.N.y, motion["disc"])

    def events(self, t, q, u):
        return {"far": 0.6 - q["x"]}


START = jk.State({"spin": 0.2}, {"spin_rate": 1.5})


@pytest.fixture(scope="module")
def ride():
    return jk.simulate(Disc(), START, TS, step=0.1)


@pytest.mark.slow
def test_functions_evaluated_along_a_trajectory_by_name(ride):
    n, r = int(np.isfinite(ride["x"]).sum()), 0.5
    assert 1 < n < 5  # it ended early
    x, spin, rate = (np.asarray(ride[name]) for name in ("x", "spin", "spin_rate"))
    zero = np.where(np.isfinite(x), 0.0, np.nan)
    where, how_fast, turned = (f(Disc(), ride) for f in (jk.positions, jk.velocities, jk.orientations))
    assert set(where) == {"disc", "rim"}  # a contact has no place
    np.testing.assert_allclose(where["disc"], np.stack([x, zero, zero], 1), atol=1e-14)
    np.testing.assert_allclose(where["rim"], np.stack([x + r * np.cos(spin), zero, -r * np.sin(spin)], 1), atol=1e-14)
    rim = np.stack([rate * (r - r * np.sin(spin)), zero, -r * rate * np.cos(spin)], 1)
    np.testing.assert_allclose(how_fast["rim"], rim, atol=1e-14)
    np.testing.assert_allclose(how_fast["contact"][:n], 0.0, atol=0)
    rows = [[np.cos(spin), zero, -np.sin(spin)], [zero, 1 + zero, zero], [np.sin(spin), zero, np.cos(spin)]]
    np.testing.assert_allclose(turned["B"], np.moveaxis(np.array(rows), 2, 0), atol=1e-14)
    np.testing.assert_array_equal(turned["disc"], turned["B"])
    rates = jk.speed_rates(Disc(), ride)  # (I + m r^2) w_dot = T
    np.testing.assert_allclose(rates["spin_rate"], 0.3 / 0.45 + zero, rtol=1e-14)
    np.testing.assert_allclose(rates["x_dot"], 0.15 / 0.45 + zero, rtol=1e-14)


def test_an_empty_trajectory_is_rejected(ride):
    none = jax.tree.map(lambda x: x[:0] if np.shape(x)[:1] == TS.shape else x, ride)
    for f in (jk.positions, jk.constraint_forces):
        with pytest.raises(ValueError, match="Disc: the trajectory contains no times"):
            f(Disc(), none)


@pytest.mark.slow
def test_functions_evaluated_at_one_time_and_for_a_batch(ride):
    where = jk.positions(Disc(), 0.0, {"x": 1.0}, {})["rim"]
    np.testing.assert_allclose(where, [1.5, 0.0, 0.0], atol=1e-15)
    two = jax.tree.map(lambda x: jnp.stack([x, x]), ride)
    for f in (jk.positions, jk.speed_rates):
        one, both = f(Disc(), ride), f(Disc(), two)
        for name, x in one.items():
            np.testing.assert_array_equal(both[name], np.stack([x, x]))
    with pytest.raises(TypeError, match="already contains coordinates, speeds and inputs"):
        jk.positions(Disc(), ride, [0.0, 0.0], [1.0])


@pytest.mark.weekly
def test_derivatives_along_a_trajectory_that_ended_early():
    def last(push, adjoint):  # the rim where it was last
        system = dataclasses.replace(Disc(), push=push)
        ride = jk.simulate(system, START, TS, adjoint=adjoint, step=0.1)
        return jk.positions(system, ride)["rim"][1, 0]

    def exact(push):
        spin = 0.2 + 1.5 * 0.5 + 0.5 * push / 0.45 * 0.5**2
        return 0.5 * (spin - 0.2) + 0.5 * np.cos(spin)

    numeric = (exact(0.3 + 1e-6) - exact(0.3 - 1e-6)) / 2e-6
    for mode in ("reverse", "forward"):
        found, value = slopes(last, mode)(jnp.array(0.3))
        np.testing.assert_allclose(value, exact(0.3), rtol=1e-9)
        np.testing.assert_allclose(found, numeric, rtol=1e-7)


@pytest.mark.slow
def test_constraint_forces_along_a_trajectory_that_ended_early():
    """The reverse derivative of what was reached sees nothing of what was not."""
    system = DoublePendulum()
    ride = jk.simulate(system, jk.State([0.3, 0.2], [0.0, 0.0]), TS)
    cut = dataclasses.replace(ride, q=ride.q.at[3:].set(jnp.nan), u=ride.u.at[3:].set(jnp.nan))

    def first(mass, ride):
        forces = jk.constraint_forces(dataclasses.replace(system, mass=mass), ride)
        return sum(jnp.sum(x[0]) for x in forces.values())

    slope = jax.jit(jax.grad(first))
    np.testing.assert_allclose(slope(1.0, cut), slope(1.0, ride), rtol=1e-13)
    assert np.isfinite(slope(1.0, cut))


@pytest.mark.slow
def test_singular_equations_raise_at_one_time():
    """Three hinges that lock: every function that solves for accelerations says so, and is NaN under a trace."""
    hinges = [hinge("x", (1.0, 0.0, 0.0)), hinge("y", (0.0, 1.0, 0.0)), hinge("z")]
    system = mechanism([Link("a", None, hinges, mass=1.0, inertia=(0.1, 0.1, 0.1))], name="Gimbals")
    locked, still = [0.0, 0.5 * np.pi, 0.0], [0.0, 0.0, 0.0]
    for f in (jk.accelerations, jk.speed_rates, jk.constraint_forces):
        with pytest.raises(ValueError, match="the speeds x_rate, z_rate can change together without moving any body"):
            f(system, 0.0, locked, still)
    under_jit = jax.jit(lambda q: jk.speed_rates(system, 0.0, q, still)["x_rate"])
    assert np.isnan(under_jit(jnp.array(locked)))
    with pytest.raises(ValueError, match="the speeds x_rate, z_rate can change together without moving any body"):
        jk.stability.linearize(system, jk.State(jnp.array(locked), jnp.array(still)))


class Coupled(jk.System):
    """Two carts on one line, coupled where their ends meet. `twice` is another point at that place."""

    coordinates, speeds, dependent_speeds = ("x", "y"), ("x_dot",), ("y_dot",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        one = O.moving(q["x"] * N.x, u["x_dot"] * N.x)
        two = O.moving(q["y"] * N.x, u["y_dot"] * N.x)
        A, B, twice = one.fixed(0.5 * N.x), two.fixed(-0.5 * N.x), two.fixed(-0.5 * N.x)
        bodies = [jk.Body(1.0, 0.0, one, name="one"), jk.Body(2.0, 0.0, two, name="two")]
        return jk.Motion(bodies, [(A.velocity - B.velocity).dot(N.x)], points={"A": A, "B": B, "twice": twice})

    def q_dot(self, t, q, u):
        return u["x_dot"], u["y_dot"]

    def loads(self, t, q, u, motion, inputs):
        return jk.Force(6.0 * motion.N.x, motion["one"])


@pytest.mark.slow
def test_the_point_of_application_of_a_residual_force():
    forces = jk.constraint_forces(Coupled(), 0.0, {"y": 1.0}, {})  # 6 N move 3 kg: 2 kg of them by 4 N
    for name, force in {"A": -4.0, "B": 4.0, "twice": 0.0}.items():
        np.testing.assert_allclose(forces[name], [force, 0.0, 0.0], atol=1e-14)


ALONG = (
    "constraint_forces constraint_multipliers orientations outputs positions speed_rates state_rates velocities".split()
)
OF_A_TRAJECTORY = {
    **{f"jaxkane.{name}": lambda system, ride, name=name: getattr(jk, name)(system, ride) for name in ALONG},
    "jaxkane.audit": jk.audit,
    "jaxkane.animate": jk.animate,
    "jaxkane.fit.base_parameters": fit.base_parameters,
    "jaxkane.fit.first_estimate": lambda system, ride: fit.first_estimate(system, ride, "push"),
}
OTHERS = {
    "coordinates": {"coordinates": ("x", "angle")},
    "speeds": {"speeds": ("angle_rate",)},
    "dependent speeds": {"dependent_speeds": ("forward_speed",)},
    "states": {"states": ("wear",)},
    "inputs": {"inputs": ("torque",)},
}


@pytest.mark.parametrize("kind", OTHERS)
def test_the_trajectory_of_another_system_is_recognized_by_its_names(ride, kind):
    other = type("Other", (Disc,), OTHERS[kind])()
    with pytest.raises(ValueError, match=f"^Other: the trajectory belongs to another system. Its {kind}: "):
        jk.positions(other, ride)


def test_trajectories_with_the_same_names_are_accepted(ride):
    assert jk.positions(Disc(radius=0.1), ride)["disc"].shape == (5, 3)


@pytest.mark.slow_cases("jaxkane.speed_rates", "jaxkane.fit.base_parameters")
@pytest.mark.parametrize("name", OF_A_TRAJECTORY)
def test_every_public_function_refuses_the_motion_of_another_system(ride, name):
    f, other = OF_A_TRAJECTORY[name], type("Other", (Disc,), OTHERS["inputs"])()
    with pytest.raises(ValueError, match="belongs to another system"):
        f(other, ride)
