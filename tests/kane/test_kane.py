"""The method on systems that are not in the book: rheonomic terms, loops, chains; and every kind of derivative."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from mechanisms import OnACircle

import jaxkane as jk
from jaxkane.catalog import WhippleBicycle


class BeadOnTurningRod(jk.System):
    """A bead on a rod that is turned at a prescribed, growing rate: x_ddot = (rate * t)^2 x - (k / m) x + F / m."""

    mass: jk.Scalar = jk.parameter(positive=True)
    stiffness: jk.Scalar = jk.parameter(0.0)
    rate: jk.Scalar = jk.parameter(1.0)  # [rad/s^2]
    coordinates = ("x",)
    speeds = ("x_dot",)
    inputs = ("push",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        rod = N.rotate(3, 0.5 * self.rate * t * t, self.rate * t, "rod")
        bead = O.moving(q[0] * rod.x, u[0] * rod.x)
        return jk.Motion([jk.Body(self.mass, 0.0, bead, name="bead")], frames={"rod": rod})

    def loads(self, t, q, u, motion, inputs):
        return jk.Force((inputs["push"] - self.stiffness * q["x"]) * motion["rod"].x, motion["bead"])


@pytest.mark.slow
def test_prescribed_motion():
    bead = BeadOnTurningRod(mass=2.0, stiffness=3.0, rate=0.7)
    t, x = 1.3, 0.4
    u_dot = jk.accelerations(bead, t, [x], [0.9], {"push": 5.0})
    np.testing.assert_allclose(u_dot, [(0.7 * t) ** 2 * x - 1.5 * x + 2.5], rtol=1e-14)
    energy = jk.kinetic_energy(bead, t, [x], [0.9])
    np.testing.assert_allclose(energy, 0.9**2 + (0.7 * t * x) ** 2, rtol=1e-14)  # the bead is carried round


@pytest.mark.slow
def test_a_constrained_cartesian_pendulum_equals_a_pendulum_in_its_angle():
    loop = OnACircle()
    state = jk.assemble(loop, {"x": 0.5, "y": -1.0}, {"x_dot": 0.8})
    x, y = np.asarray(state.q)
    np.testing.assert_allclose(np.hypot(x, y), 1.0, rtol=1e-15)
    np.testing.assert_allclose(jk.dependent_speeds(loop, 0.0, state.q, state.u), [-x * 0.8 / y], rtol=1e-14)
    # theta from the downward vertical: x = sin, theta_ddot = -g sin
    theta_dot = 0.8 / -y
    x_ddot = 9.81 * x * y - x * theta_dot**2
    np.testing.assert_allclose(jk.accelerations(loop, 0.0, state.q, state.u), [x_ddot], rtol=1e-13)
    y_ddot = -9.81 * x * x - y * theta_dot**2
    np.testing.assert_allclose(jk.dependent_accelerations(loop, 0.0, state.q, state.u), [y_ddot], rtol=1e-12)


class RollingCoin(jk.System):
    """A thin disc that rolls upright on a line: a velocity residual that holds a term in time (a moving belt)."""

    radius: jk.Scalar = jk.parameter(0.5)
    belt: jk.Scalar = jk.parameter(0.0)  # [m/s^2]
    coordinates = ("angle", "x")
    speeds = ("spin",)
    dependent_speeds = ("x_dot",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        disc = N.rotate(2, q["angle"], u["spin"], "disc")
        center = O.moving(q["x"] * N.x, u["x_dot"] * N.x)
        contact = center.velocity + disc.angular_velocity.cross(-self.radius * N.z)
        body = jk.Body(2.0, (0.1, 0.2, 0.1), center, disc, name="disc")
        return jk.Motion([body], [contact.dot(N.x) - self.belt * t])


@pytest.mark.slow
def test_residuals_may_be_affine_in_the_speeds():
    coin = RollingCoin(belt=3.0)
    at = (coin, 2.0, [0.3, 0.1], [1.5])
    np.testing.assert_allclose(jk.dependent_speeds(*at), [0.5 * 1.5 + 6.0], rtol=1e-15)
    # I spin_dot + m r (r spin_dot + belt) = 0
    spin_dot = -2.0 * 0.5 * 3.0 / (0.2 + 2.0 * 0.25)
    np.testing.assert_allclose(jk.accelerations(*at), [spin_dot], rtol=1e-14)
    np.testing.assert_allclose(jk.dependent_accelerations(*at), [0.5 * spin_dot + 3.0], rtol=1e-14)


@pytest.mark.slow
def test_results_satisfy_kanes_equations():
    bike = WhippleBicycle.benchmark()
    state = jk.assemble(bike, {"roll": 0.1, "steer": 0.2}, {"rear_wheel_rate": -10.0, "roll_rate": 0.3})
    at, inputs = (bike, 0.0, state.q, state.u), {"steer_torque": 2.0}
    M, f = jk.equations_of_motion(*at, inputs)
    np.testing.assert_array_equal(M, jk.mass_matrix(*at, inputs))
    np.testing.assert_array_equal(f, jk.forcing(*at, inputs))
    u_dot = jk.accelerations(*at, inputs)
    np.testing.assert_allclose(M @ u_dot, f, atol=1e-11)
    Fr = jk.generalized_active_forces(*at, inputs)
    np.testing.assert_allclose(Fr + jk.generalized_inertia_forces(*at), f, atol=1e-12)
    np.testing.assert_allclose(Fr + jk.generalized_inertia_forces(*at, u_dot=u_dot), 0.0, atol=1e-10)
    J = jk.constraint_jacobian(bike, 0.0, state.q)
    np.testing.assert_allclose(J @ state.u, jk.dependent_speeds(*at), atol=1e-14)


@pytest.mark.weekly
@pytest.mark.parametrize(
    ("system", "q", "u"),
    [(BeadOnTurningRod(mass=2.0, stiffness=3.0, rate=0.7), [0.4], [0.9]), (RollingCoin(belt=3.0), [0.3, 0.1], [1.5])],
    ids=["bead", "coin"],
)
def test_derivatives_by_every_argument_agree_with_differences(system, q, u):
    """Parameters, time, state and inputs, against central differences."""
    rtol = 1e-6
    inputs = {name: 0.7 for name in system.inputs}
    flat, unflatten = ravel_pytree(
        (system, jnp.array(0.8), jnp.array(q), jnp.array(u), jax.tree.map(jnp.array, inputs))
    )
    weights = jnp.linspace(0.5, 1.5, len(u))

    def f(x):
        return weights @ jk.accelerations(*unflatten(x))

    d = jnp.cos(jnp.arange(flat.size))

    @jax.jit
    def derivatives(x):
        """Forward and reverse; and twice, along one direction: forward over reverse, reverse over forward."""
        reverse, second = jax.jvp(jax.grad(f), (x,), (d,))
        return jax.jacfwd(f)(x), reverse, second, jax.grad(lambda x: jax.jvp(f, (x,), (d,))[1])(x)

    forward, reverse, second, other = derivatives(flat)
    h = 1e-5
    values = jax.jit(jax.vmap(lambda step: f(flat + step)))
    steps = h * np.eye(flat.size)
    differences = (np.asarray(values(steps)) - values(-steps)) / (2 * h)
    scale = np.abs(differences).max()
    np.testing.assert_allclose(forward, differences, atol=rtol * scale)
    np.testing.assert_allclose(reverse, forward, atol=1e-12 * scale)
    np.testing.assert_allclose(second, other, atol=1e-11 * float(jnp.abs(second).max()))
    numeric = (derivatives(flat + h * d)[1] - derivatives(flat - h * d)[1]) / (2 * h)
    np.testing.assert_allclose(second, numeric, atol=1e-5 * float(jnp.abs(second).max()))


@pytest.mark.slow
def test_float32_stays_float32():
    bike = jax.tree.map(lambda x: x.astype(jnp.float32), WhippleBicycle.benchmark())
    q, u = jnp.zeros(8, jnp.float32), jnp.array([0.5, -15.0, 0.0], jnp.float32)
    u_dot = jk.accelerations(bike, 0.0, q, u)
    assert u_dot.dtype == jnp.float32
    reference = jk.accelerations(WhippleBicycle.benchmark(), 0.0, [0.0] * 8, [0.5, -15.0, 0.0])
    np.testing.assert_allclose(u_dot, np.asarray(reference), rtol=1e-4, atol=1e-4)
    assert jax.grad(lambda u: jk.accelerations(bike, 0.0, q, u).sum())(u).dtype == jnp.float32
