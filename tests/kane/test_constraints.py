"""Drift of configuration constraints, how it is held, and constraints that cannot be solved."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane import best_dependent_speeds


def top(**options):
    entry = jk.catalog.CATALOG["SpinningTop"]
    system, state = entry.example(), jk.State(jnp.array(entry.q), jnp.array(entry.u))
    return system, jk.simulate(system, state, jnp.linspace(0.0, 5.0, 26), rtol=1e-5, atol=1e-5, **options)


@pytest.mark.weekly
def test_stabilized_and_projected_coordinates_do_not_drift():
    free, stabilized, projected = (jk.audit(*top(**how)) for how in ({}, {"stabilize": 10.0}, {"project": True}))
    assert stabilized.drift < 0.3 * free.drift  # what is left is the interpolation between steps
    assert projected.drift < 1e-14


@pytest.mark.weekly
def test_a_projected_simulation_has_gradients_after_an_early_end():
    entry = jk.catalog.CATALOG["SpinningTop"]
    top, state = jk.catalog.SpinningTop(), jk.State(jnp.array(entry.q), jnp.array(entry.u))

    def place(gravity, project, max_steps):
        system = jk.catalog.SpinningTop(gravity=gravity)
        options = {"project": project, "adjoint": "forward", "max_steps": max_steps}
        ride = jk.simulate(system, state, jnp.linspace(0.0, 0.3, 4), **options)
        return jnp.where(jnp.isfinite(ride.q), ride.q, 0.0)[1]

    free, held = (jax.jacfwd(place)(top.gravity, project, 4096) for project in (False, True))
    np.testing.assert_allclose(held, free, rtol=0, atol=1e-7)
    steps = int(jk.simulate(top, state, jnp.linspace(0.0, 0.3, 4)).stats["steps"])
    np.testing.assert_allclose(jax.jacfwd(place)(top.gravity, True, steps // 2), held, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_the_best_dependent_speeds_of_the_bicycle():
    bicycle = jk.catalog.WhippleBicycle.benchmark()
    upright = best_dependent_speeds(bicycle, 0.0, jk.assemble(bicycle, {}).q)
    assert upright.rank == 3
    assert "well chosen" in str(upright)
    # Steered across (91.77 deg for the upright benchmark bicycle), the front wheel has no grip on the yaw.
    steered = jk.assemble(bicycle, {"steer": np.deg2rad(91.77), "roll": 1e-3})
    across = best_dependent_speeds(bicycle, 0.0, steered.q)
    assert across.condition > 100 * across.choices[0][1]
    assert across.best != bicycle.dependent_speeds
    assert "would be" in str(across)
    # in the order of conditioning, and those of one's own among them
    conditions = [x for _, x in across.choices]
    assert conditions == sorted(conditions)
    assert len(conditions) == 10  # the best, and three for each of its three speeds


def test_the_best_of_many_choices_of_dependent_speeds_is_found():
    C = np.random.default_rng(5).normal(size=(5, 18)) * np.where(np.arange(18) < 12, 1e-4, 1.0)

    class Many(jk.System):
        """Particles on rails with 8568 choices, the first of which are bad."""

        coordinates, names = tuple(f"q{i}" for i in range(18)), tuple(f"u{i}" for i in range(18))
        dependent_speeds, speeds = names[:5], names[5:]

        def q_dot(self, t, q, u):
            return [u[name] for name in self.names]

        def motion(self, t, q, u):
            N, O = jk.inertial()
            bodies = [jk.Body(1.0, 0.0, O.moving(q[i] * N.x, u[f"u{i}"] * N.x)) for i in range(18)]
            return jk.Motion(bodies, [sum(c * u[f"u{i}"] for i, c in enumerate(row)) for row in C])

    chosen = best_dependent_speeds(Many(), 0.0, jnp.zeros(18))
    assert {int(name[1:]) for name in chosen.best} < set(range(12, 18))
    assert chosen.condition > 1e3 * chosen.choices[0][1]


class Twice(jk.System):
    """A point in space. The second residual repeats the first one, or contradicts it if there is a drift."""

    drift: jk.Scalar = jk.parameter(0.0)  # [m/s]
    coordinates, speeds, dependent_speeds = ("x", "y", "z"), ("vz",), ("vx", "vy")

    def q_dot(self, t, q, u):
        return u["vx"], u["vy"], u["vz"]

    def motion(self, t, q, u):
        N, O = jk.inertial()
        P = O.moving(N.vector(*q), N.vector(u["vx"], u["vy"], u["vz"]))
        slope = u["vx"] - 2.0 * u["vy"] - u["vz"]
        return jk.Motion([jk.Body(1.0, 0.0, P)], [slope, 3.0 * slope + self.drift])


def test_redundant_and_conflicting_residuals_are_distinguished():
    redundant = best_dependent_speeds(Twice(), 0.0, jnp.zeros(3))
    assert (redundant.rank, redundant.redundant, redundant.conflicting) == (1, (1,), ())
    assert "rank 1" in str(redundant)
    conflicting = best_dependent_speeds(Twice(drift=0.5), 0.0, jnp.zeros(3))
    assert conflicting.conflicting == (1,)
    assert "contradicts" in str(conflicting)


def test_redundant_residuals_are_refused_with_their_rank():
    with pytest.raises(ValueError, match="rank 1"):
        jk.accelerations(Twice(), 0.0, jnp.zeros(3), jnp.ones(1))


def spatial_pendulum(**parameters):
    entry = jk.catalog.CATALOG["SpatialDoublePendulum"]
    system = jk.catalog.SpatialDoublePendulum(**parameters)
    return system, jnp.array(entry.q), jnp.array(entry.u)


def test_best_dependent_speeds_rejects_non_finite_coordinates():
    """NaN in a residual's rows would pass for a good choice, or for singular values that do not converge."""
    bicycle = jk.catalog.WhippleBicycle.benchmark()
    with pytest.raises(ValueError, match="WhippleBicycle: q is not finite: steer"):
        jk.best_dependent_speeds(bicycle, 0.0, jnp.zeros(8).at[2].set(jnp.nan))


@pytest.mark.weekly
def test_a_massless_speed_is_refused_by_name():
    # Kamman, Unit 5, Example 6, note 2: a line has no moment of inertia about itself
    system, q, u = spatial_pendulum(I22_1=0.0)
    with pytest.raises(ValueError, match="no mass moves with the speed omega12"):
        jk.accelerations(system, 0.0, q, u)
    with pytest.raises(ValueError, match="omega12"):
        jk.simulate(system, jk.State(q, u), jnp.linspace(0.0, 1.0, 3))
    both, _, _ = spatial_pendulum(I22_1=0.0, I22_2=0.0)
    with pytest.raises(ValueError, match="speeds omega12, omega22"):
        jk.accelerations(both, 0.0, q, u)
    # in a batch, the status of its member
    pendulums = jax.vmap(lambda I: spatial_pendulum(I22_1=I)[0])(jnp.array([0.0, 0.002]))
    rides = jax.vmap(lambda s: jk.simulate(s, jk.State(q, u), jnp.linspace(0.0, 0.1, 3)))(pendulums)
    assert rides.reason == ["no solution", "completed"]


@pytest.mark.weekly
def test_gimbal_lock_triggers_an_event_or_an_error_with_advice():
    system, q, u = spatial_pendulum()
    with pytest.raises(ValueError, match=r"theta11, theta12, theta13 are not finite.*Euler parameters"):
        jk.simulate(system, jk.State(q.at[1].set(0.0), u), jnp.linspace(0.0, 1.0, 3))
    # The first link swings through the vertical in its own plane: theta12 passes zero.
    falling = jk.State(jnp.array([0.0, 0.3, 0.0, 0.0, 0.5, 0.0]), jnp.array([-2.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    ride = jk.simulate(system, falling, jnp.linspace(0.0, 1.0, 11))
    assert ride.reason in ("gimbal lock 1", "gimbal lock 2")
    assert "Euler parameters" in repr(ride)


class Wedge(jk.System):
    """A particle in a plane whose residual is `small` * vx + vy, solved for vx."""

    small: jk.Scalar = jk.parameter(1e-9)
    coordinates, speeds, dependent_speeds = ("x", "y"), ("vy",), ("vx",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        P = O.moving(N.vector(q["x"], q["y"], 0.0), N.vector(u["vx"], u["vy"], 0.0))
        return jk.Motion([jk.Body(1.0, 0.0, P)], [self.small * u["vx"] + u["vy"]])

    def q_dot(self, t, q, u):
        return u["vx"], u["vy"]


def test_the_condition_of_a_single_residual_includes_the_other_speeds():
    q = jnp.array([0.1, 0.2])
    wedge = best_dependent_speeds(Wedge(), 0.0, q)
    np.testing.assert_allclose([x for _, x in wedge.choices], [1.0, 1e9], rtol=1e-9)  # sqrt(1 + 1e-18) / 1e-9
    assert wedge.best == ("vy",)
    assert "for vy it would be 1" in str(wedge)
    assert "well chosen" in str(best_dependent_speeds(Wedge(small=2.0), 0.0, q))


class Repeated(jk.System):
    """A point on a circle in a plane; its configuration constraint, twice that, and one that vanishes identically."""

    radius: jk.Scalar = jk.parameter(1.0)
    coordinates, speeds = ("x", "y", "z"), ("x_dot", "z_dot")
    dependent_speeds = ("y_dot",)

    def q_dot(self, t, q, u):
        return u["x_dot"], u["y_dot"], u["z_dot"]

    def motion(self, t, q, u):
        N, O = jk.inertial()
        P = O.moving(N.vector(*q), N.vector(u["x_dot"], u["y_dot"], u["z_dot"]))
        return jk.Motion([jk.Body(1.0, 0.0, P)], [q["x"] * u["x_dot"] + q["y"] * u["y_dot"]])

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -9.81 * motion.N.y)

    def configuration_constraints(self, t, q):
        h = q["x"] ** 2 + q["y"] ** 2 - self.radius**2
        return [h, 2.0 * h, 0.0 * q["z"]]


@pytest.mark.weekly
def test_stabilization_and_projection_work_with_redundant_residuals():
    state = jk.State(jnp.array([0.6, -0.8, 0.0]), jnp.array([1.0, 0.5]))
    ts = jnp.linspace(0.0, 1.0, 3)
    for options in ({"project": True}, {"stabilize": 5.0}):
        ride = jk.simulate(Repeated(), state, ts, step=0.01, **options)
        assert ride.ok
        np.testing.assert_allclose(jnp.sum(ride.q[:, :2] ** 2, axis=1), 1.0, atol=1e-6)

    def radius(r):
        start = jk.State(jnp.stack([0.6 * r, -0.8 * r, jnp.zeros_like(r)]), state.u)
        ride = jk.simulate(Repeated(r), start, ts, step=0.01, project=True, adjoint="forward")
        return jnp.linalg.norm(ride.q[-1, :2])

    assert jax.jacfwd(radius)(1.0) == pytest.approx(1.0, abs=1e-6)
