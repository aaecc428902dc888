"""The audit in proportion to the right-hand side, and what it says of loads that nothing feels."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from programs import operations

import jaxkane as jk

TILTS = ((0.3, 0.5, 0.81), (0.7, -0.2, 0.4), (-0.4, 0.6, 0.5))


class TiltedChain(jk.System):
    """Rods on hinges, each tilted by a fixed angle in a general direction; the tip may be held in a plane."""

    n: int = eqx.field(static=True, default=4)
    held: bool = eqx.field(static=True, default=False)
    length: jk.Scalar = jk.parameter(0.2)  # of each rod [m]

    @property
    def coordinates(self):
        return tuple(f"q{i + 1}" for i in range(self.n))

    @property
    def speeds(self):
        return tuple(f"u{i + 1}" for i in range(self.n - self.held))

    @property
    def dependent_speeds(self):
        return (f"u{self.n}",) * self.held

    def q_dot(self, t, q, u):
        return tuple(u)

    def motion(self, t, q, u):
        link, joint = jk.inertial()
        bodies = []
        for i in range(self.n):
            axis = np.array(TILTS[i % 3]) / np.linalg.norm(TILTS[i % 3])
            link = link.rotate(link.vector(*axis), 0.3 + 0.1 * i, 0.0).rotate(1 + i % 2, q[i], u[i])
            bodies.append(jk.Body(0.3, (1e-3, 1e-3, 1e-4), joint.fixed(-0.5 * self.length * link.z), link))
            joint = joint.fixed(-self.length * link.z)
        residuals = [joint.velocity.dot(link.root.x)] if self.held else []
        return jk.Motion(bodies, residuals, points={"tip": joint})

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -9.81 * motion.N.z)


@pytest.mark.weekly
@pytest.mark.parametrize("held", [False, True])
def test_the_audit_takes_no_more_operations_than_the_accelerations(held):
    """It is one plain program, so that nothing is computed twice; and no longer than a right-hand side."""

    def at(n):
        return TiltedChain(n=n, held=held), jnp.full(n, 0.3), jnp.full(n - held, 0.2)

    counts = {n: operations("audit", *at(n), jnp.ones(n - held)) for n in (4, 6, 8)}
    assert counts[6] < operations("rates", *at(6))
    # Linear but for the weights and the columns of the constraint, which pass all frames: less than quadratic
    assert counts[8] - counts[6] < 1.6 * (counts[6] - counts[4])


class Rod(jk.System):
    """A driven rod in a plane; where `anew`, its torque acts on a frame that `loads` makes itself."""

    anew: bool = eqx.field(static=True, default=False)
    coordinates = ("angle",)
    speeds = ("rate",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        rod = N.rotate(3, q["angle"], u["rate"])
        return jk.Motion([jk.Body(1.0, (0.1, 0.0, 0.1), O.fixed(0.5 * rod.x), rod)], frames={"rod": rod})

    def loads(self, t, q, u, motion, inputs):
        rod = motion.N.rotate(3, q["angle"], u["rate"]) if self.anew else motion["rod"]
        return (jk.Torque(0.2 * motion.N.z, rod),)


@pytest.mark.slow
def test_loads_on_frames_created_in_loads_do_work():
    """0.2 N m on a rod of 0.1 kg m^2 about its end, 1 kg at 0.5 m: 0.2 / 0.35 rad/s^2."""
    start, ts = jk.State(jnp.zeros(1), jnp.array([2.0])), jnp.linspace(0.0, 0.1, 6)
    for anew in (False, True):
        np.testing.assert_allclose(jk.accelerations(Rod(anew=anew), 0.0, [0.0], [2.0]), 0.2 / 0.35, rtol=1e-14)
    audit = jk.audit(Rod(anew=True), jk.simulate(Rod(anew=True), start, ts))
    assert audit.ok
    np.testing.assert_allclose(audit.work, 0.2 * (2.0 * ts + 0.5 * 0.2 / 0.35 * ts**2), rtol=1e-7)


class Geared(jk.System):
    """Two particles on rails, 1e-9 a + b = 0 of their speeds, solved for a."""

    coordinates = ("x", "y")
    speeds = ("b",)
    dependent_speeds = ("a",)

    def q_dot(self, t, q, u):
        return u["a"], u["b"]

    def motion(self, t, q, u):
        N, O = jk.inertial()
        P, Q = O.moving(q["x"] * N.x, u["a"] * N.x), O.moving(q["y"] * N.y, u["b"] * N.y)
        bodies = [jk.Body(1.0, 0.0, P, name="P"), jk.Body(1.0, 0.0, Q, name="Q")]
        return jk.Motion(bodies, [1e-9 * u["a"] + u["b"]])


@pytest.mark.weekly
def test_the_condition_of_a_single_residual_includes_the_other_speeds():
    """C_dep alone is (1 x 1) and has the condition number 1, whatever it is."""
    ride = jk.simulate(Geared(), jk.State(jnp.zeros(2), jnp.array([1e-9])), jnp.linspace(0.0, 0.1, 6))
    audit = jk.audit(Geared(), ride)
    np.testing.assert_allclose(audit.condition_C_dep, 1e9, rtol=1e-6)
    assert [verdict for what, _, verdict in audit.lines() if what == "condition of C_dep"] == ["look"]
