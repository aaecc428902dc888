"""Intervals of a measured pendulum cover the truth as often as they say.

That two and three arms are explained as well as elsewhere, and what cannot be told of them, is asserted by
`examples/identify_pendulums.py`.
"""

import jax.numpy as jnp
import numpy as np
import pytest
from systems import coverage_band

import jaxkane as jk
from jaxkane.fit import Free, LeastSquares, Problem, Simulation, Trial, minimize


class Arm(jk.System):
    inertia: jk.Scalar = jk.parameter(0.00335, positive=True, unit="kg m^2")
    viscous: jk.Scalar = jk.parameter(0.0, unit="N m s/rad")
    dry: jk.Scalar = jk.parameter(0.0, unit="N m")
    drag: jk.Scalar = jk.parameter(0.0, unit="N m s^2/rad^2")
    offset: jk.Scalar = jk.parameter(0.0, unit="rad")
    mass: jk.Scalar = jk.parameter(0.1476, positive=True, unit="kg")  # its makers' estimate, as the place of its centre
    center: jk.Scalar = jk.parameter(0.1478, unit="m")

    coordinates = ("angle1",)
    speeds = ("rate1",)
    units = {"angle1": "rad", "rate1": "rad/s"}

    def motion(self, t, q, u):
        N, O = jk.inertial()
        A = N.rotate(3, q["angle1"] - self.offset, u["rate1"])
        about_joint = (self.inertia, 0.0, self.inertia)  # a slender arm
        arm = jk.Body(self.mass, about_joint, O.fixed(self.center * A.y), A, about=O, name="arm")
        return jk.Motion([arm])

    def loads(self, t, q, u, motion, inputs):
        arm, axis = motion["arm"], motion.N.z
        return (
            jk.weight(motion, -9.81 * motion.N.y),
            jk.loads.torsional_damper(arm, None, axis, lambda w: self.viscous * w + self.drag * w * jnp.abs(w)),
            jk.loads.torsional_friction(arm, None, axis, self.dry, rate=0.05),
        )


@pytest.mark.weekly
def test_intervals_of_the_single_arm_cover():
    """Ten simulated versions of the measured swings, of which every tenth sample is taken."""
    sigma, rng = 0.0009, np.random.default_rng(7)  # [rad], what the residuals are; another seed, another few per cent
    true = {"inertia": 0.0033414, "dry": 0.0005, "drag": 1.47e-5, "offset": 0.00085}
    truth = Arm(**true)
    free = ["inertia", Free("dry", scale=1e-4), Free("drag", scale=1e-5), Free("offset", scale=0.01)]
    clean = []
    for swing in jk.data.multi_arm_pendulum(1).trials:
        start = {"angle1": float(swing.measured["angle1"][0]), "rate1": float(swing.initial["rate1"][0])}
        ride = jk.simulate(truth, jk.State([start["angle1"]], [start["rate1"]]), swing.t[::10], rtol=1e-9, atol=1e-11)
        clean.append((swing.t[::10], np.asarray(ride["angle1"]), start))
    problem, covered = None, []
    for _ in range(10):
        noisy = [
            Trial(t, {"angle1": angle + rng.normal(0.0, sigma, t.size)}, sigma=sigma, initial=start)
            for t, angle, start in clean
        ]
        # At 1e-8 the errors of the steps are a noise of the cost, in which a fit may get stuck beside its minimum.
        posed = {"unknown": ("angle1", "rate1"), "simulation": Simulation(rtol=1e-10)}
        problem = Problem.of(truth, noisy, free, **posed) if problem is None else problem.with_trials(noisy)
        found = minimize(problem, LeastSquares())
        assert found.ok
        covered += [low <= true[name] <= high for name, (low, high) in found.intervals().items()]
    low, high = coverage_band(len(covered))
    assert low <= np.mean(covered) <= high
