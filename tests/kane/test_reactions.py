"""Constraint forces against statics, Newton's second law by hand, and SymPy's auxiliary speeds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sympy_systems import FIGURES, FourBarLinkage, RollingDiscDependent

import jaxkane as jk
from jaxkane import constraint_forces, constraint_multipliers
from jaxkane.catalog import CATALOG

RTOL = 1e-12


def momentum_rate(system, q, u, inputs=None, bodies=slice(None)):
    """d/dt of the linear momentum (3,) of some bodies, in N, by differentiation along the motion."""

    def momentum(t, q, u):
        motion = system.motion(t, q, jnp.concatenate([u, jk.dependent_speeds(system, t, q, u)]))
        return sum(jnp.asarray(b.mass, float) * b.center.velocity.to(motion.N) for b in motion.bodies[bodies])

    u_dot = jk.accelerations(system, 0.0, q, u, inputs)
    rates = (jnp.array(1.0), jk.coordinate_rates(system, 0.0, q, u), u_dot)
    return jax.jvp(momentum, (jnp.array(0.0), q, u), rates)[1]


def moving(name):
    entry = CATALOG[name]
    return entry.example(), jnp.array(entry.q), jnp.array(entry.u)


@pytest.mark.slow
def test_wheel_loads_of_the_benchmark_bicycle_at_rest():
    # Meijaard et al. (2007), Table 1, by the lever rule; N.z points down, and the ground pushes up
    bicycle = jk.catalog.WhippleBicycle.benchmark()
    state = jk.assemble(bicycle, {})
    forces = constraint_forces(bicycle, 0.0, state.q, state.u)
    np.testing.assert_allclose(forces["P"], [0.0, 0.0, -612.836470588236], rtol=1e-13, atol=1e-10)
    np.testing.assert_allclose(forces["Q"], [0.0, 0.0, -309.303529411765], rtol=1e-13, atol=1e-10)


@pytest.mark.slow
def test_wheel_forces_of_the_moving_bicycle_balance_its_momentum():
    bicycle, q, u = moving("WhippleBicycle")
    inputs = {"roll_torque": 2.0, "drive_torque": -5.0, "steer_torque": 1.5}
    forces = constraint_forces(bicycle, 0.0, q, u, inputs)
    weight = 94.0 * 9.81 * np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(
        forces["P"] + forces["Q"] + weight, momentum_rate(bicycle, q, u, inputs), rtol=0, atol=RTOL * 900
    )
    # What turns with Y is everything, and contact points carry no moment.
    np.testing.assert_allclose(forces["Y"], 0.0, atol=RTOL * 900)
    # fork and front wheel hang on the frame at S
    front = momentum_rate(bicycle, q, u, inputs, slice(2, 4))
    np.testing.assert_allclose(forces["S"] + forces["Q"] + 7 / 94 * weight, front, rtol=0, atol=RTOL * 900)


class Disc(jk.System):
    """A rolling disc whose centre is built from the ground below it, as in `docs/constraints.md`."""

    coordinates, speeds = ("yaw", "lean", "spin", "x", "y"), ("yaw_rate", "lean_rate", "spin_rate")
    dependent_speeds = ("x_dot", "y_dot")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        L = N.rotate(3, q["yaw"], u["yaw_rate"]).rotate(1, q["lean"], u["lean_rate"])
        D = L.rotate(2, q["spin"], u["spin_rate"])
        ground = O.moving(q["x"] * N.x + q["y"] * N.y, u["x_dot"] * N.x + u["y_dot"] * N.y)
        center = ground.fixed(-0.3 * L.z)
        contact = center.fixed(0.3 * L.z, D)
        disc = jk.Body(1.0, (0.02, 0.04, 0.02), center, L, D.angular_velocity)
        slip = [contact.velocity.dot(N.x), contact.velocity.dot(N.y)]
        return jk.Motion([disc], slip, points={"contact": contact, "ground": ground})

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, 9.81 * motion.N.z)


@pytest.mark.slow
def test_contact_force_of_a_disc_is_divided_between_contact_and_ground():
    disc, q, u = Disc(), jnp.array([0.2, 0.1, 0.0, 0.0, 0.0]), jnp.array([0.5, -0.4, 2.0])
    forces = constraint_forces(disc, 0.0, q, u)
    whole = momentum_rate(disc, q, u) - np.array([0.0, 0.0, 9.81])
    np.testing.assert_allclose(forces["contact"] + forces["ground"], whole, rtol=RTOL, atol=10 * RTOL)
    np.testing.assert_allclose(forces["contact"], [*whole[:2], 0.0], rtol=RTOL, atol=10 * RTOL)


@pytest.mark.slow
def test_joint_forces_of_a_pendulum_satisfy_newtons_law():
    # By hand: link 2 is carried at A, both at O; the acceleration of a mass centre from angles, rates and their rates.
    system, q, u = moving("DoublePendulum")
    inputs = {"shoulder_torque": 0.7, "elbow_torque": -1.3}
    forces = constraint_forces(system, 0.0, q, u, inputs)
    u_dot = jk.accelerations(system, 0.0, q, u, inputs)

    def swing(r, i):  # of a point at r on a link, from its upper end; at zero it hangs along -y
        s, c = np.sin(q[i]), np.cos(q[i])
        return r * (u_dot[i] * np.array([c, s, 0.0]) + u[i] ** 2 * np.array([-s, c, 0.0]))

    m, l, g = 1.0, 1.0, np.array([0.0, -9.81, 0.0])
    a1, a2 = swing(0.5 * l, 0), swing(l, 0) + swing(0.5 * l, 1)
    np.testing.assert_allclose(forces["A"], m * (a2 - g), rtol=RTOL, atol=RTOL)
    np.testing.assert_allclose(forces["O"], m * (a1 + a2 - 2 * g), rtol=RTOL, atol=RTOL)


def test_guide_forces_of_piston_and_slider_agree_with_newton_euler():
    # Exercise 5.1, by Newton and Euler on the bar: the wall of A pushes along x, the guide of B along y.
    system, q, u = moving("BarWithPiston")
    F = 4.0
    forces = constraint_forces(system, 0.0, q, u, {"force": F})
    p_dot = momentum_rate(system, q, u, {"force": F})
    x, v = 0.5 * np.sin(q[0]), 0.5 * np.cos(q[0]) * u[0]
    np.testing.assert_allclose(forces["piston_guide"], p_dot[0] + 200.0 * x + 5.0 * v, rtol=RTOL)
    np.testing.assert_allclose(forces["slider_guide"], p_dot[1] + 3.0 * 9.81 + F, rtol=RTOL)


@pytest.mark.slow
def test_a_declared_auxiliary_speed_agrees_with_sympy():
    figures = FIGURES["rolling_disc_dependent_q_u_aux"]
    system = RollingDiscDependent(**figures["params"])
    for state in figures["states"]:
        q, u = (
            np.array([state[x][n] for n in names]) for x, names in (("q", system.coordinates), ("u", system.speeds))
        )
        forces = constraint_forces(system, 0.0, q, u)
        np.testing.assert_allclose(list(forces.values()), list(state["aux_forces"].values()), rtol=1e-11, atol=1e-11)
        # The multipliers are the same force, along the residual's frame B: A turned by the lean.
        x, y, z = forces.values()
        c, s = np.cos(q[1]), np.sin(q[1])
        multipliers = constraint_multipliers(system, 0.0, q, u)
        np.testing.assert_allclose(multipliers, [x, c * y + s * z, c * z - s * y], rtol=1e-11, atol=1e-11)


@pytest.mark.slow
def test_joint_forces_of_a_closed_loop_balance_its_momentum():
    figures = FIGURES["four_bar_linkage"]
    system = FourBarLinkage(**figures["params"])
    state = figures["states"][0]
    q = jnp.array([state["q"][x] for x in system.coordinates])
    u = jnp.array([state["u"]["u1"]])
    forces = constraint_forces(system, 0.0, q, u)
    # Nothing but the pins at the end of the ground link and of the chain touches the three links.
    multipliers = constraint_multipliers(system, 0.0, q, u)
    np.testing.assert_allclose(forces["end"], [*multipliers, 0.0], rtol=RTOL)
    np.testing.assert_allclose(forces["pin"] + forces["end"], momentum_rate(system, q, u), rtol=1e-11, atol=1e-11)


class Bracketed(jk.System):
    """A beam built into a shaft that is driven about N.z: its root carries a force and a moment."""

    coordinates = ("angle",)
    speeds = ("rate",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        B = N.rotate(3, q[0], u[0], "B")
        center = O.fixed(0.5 * B.x)
        beam = jk.Body(2.0, (0.0, 1 / 6, 1 / 6), center, B, name="beam")
        return jk.Motion([beam], points={"O": O}, frames={"B": B})

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -10.0 * motion.N.z), jk.Torque(3.0 * motion.N.z, motion["beam"])


def test_constraint_moments_of_a_frame():
    forces = constraint_forces(Bracketed(), 0.0, jnp.array([0.0]), jnp.array([3.0]))
    # a = (-0.5 * 3^2, 0.5 * 3 / (2/3), 0); the weight of 20 N at 0.5 m bends the root, the driving torque is a load
    np.testing.assert_allclose(forces["O"], [-9.0, 4.5, 20.0], rtol=RTOL)
    np.testing.assert_allclose(forces["B"], [0.0, -10.0, 0.0], rtol=RTOL, atol=RTOL)


class Lift(jk.System):
    """A particle that slides on a platform, which rises with the velocity t^2."""

    coordinates, speeds, dependent_speeds = ("x", "y"), ("vx",), ("vy",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        P = O.moving(N.vector(q["x"], q["y"], 0.0), N.vector(u["vx"], u["vy"], 0.0))
        return jk.Motion([jk.Body(2.0, 0.0, P, N)], [u["vy"] - t**2])

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -9.81 * motion.N.y)


@pytest.mark.slow
def test_the_work_of_a_moving_constraint():
    ts = jnp.linspace(0.0, 0.5, 6)
    ride = jk.simulate(Lift(), jk.State([0.3, 0.1], [0.7]), ts, step=0.1)
    np.testing.assert_allclose(jk.constraint_multipliers(Lift(), ride)[:, 0], 2.0 * (9.81 + 2 * ts), rtol=RTOL)
    assert jk.audit(Lift(), ride).energy_balance < 1e-9


@pytest.mark.weekly
def test_constraint_forces_along_a_trajectory_under_jit_and_in_gradients():
    system, q, u = moving("DoublePendulum")
    inputs = {"elbow_torque": 0.4}
    swing = jk.simulate(system, jk.State(q, u), jnp.linspace(0.0, 0.5, 6), inputs)
    along = jax.jit(constraint_forces)(system, swing)
    assert along["A"].shape == (6, 3)
    one = constraint_forces(system, swing.t[3], swing.q[3], swing.u[3], inputs)
    np.testing.assert_allclose(along["O"][3], one["O"], rtol=RTOL, atol=RTOL)

    def tension(mass):
        return constraint_forces(jk.catalog.DoublePendulum(mass=mass), 0.0, q, u)["O"][1]

    np.testing.assert_allclose(jax.grad(tension)(2.0), tension(1.0), rtol=RTOL)  # proportional to the mass
    with pytest.raises(TypeError, match="already contains coordinates"):
        constraint_forces(system, swing, q, u)
