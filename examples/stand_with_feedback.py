"""Which feedback gains does a person use who stands on a shaking platform?

A standing person is a double inverted pendulum with ankles and hips, which is unstable without feedback. Their torques
are feedback of both angles and rates, with eight unknown gains. The platform moves with a known acceleration, and the
two angles are measured with noise. The cost is the integral of the squared deviations from the measurements. There are
no controls: the gains are the free parameters. With the initial guess of the gains, the person would fall.

The model follows Park, Horak and Kuo (2004), *Postural feedback responses scale with biomechanical constraints in human
standing*, Experimental Brain Research 154. The measurements are simulated, so the true gains are known. They
are those of a linear-quadratic regulator. The segments have the sizes of an adult of 1.75 m and 75 kg.

    variable         meaning                                                                 unit
    ankle, hip       angle of the legs from the vertical; of the trunk from the legs         rad
    platform         acceleration of the ground                                              m/s^2
    gains            torques of ankle and hip by angles and rates                            N m/rad, N m s/rad

Run:      python examples/stand_with_feedback.py [--out FOLDER]
Appears:  the gains and their true values; stand_with_feedback.png: the disturbance, angles and torques.
Takes:    20 seconds.
"""

import argparse
import dataclasses
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import scipy.linalg

import jaxkane as jk
from jaxkane import collocation as col

jk.configure(verbose=False)


MEASURED = ("measured_ankle", "measured_hip")  # they only occur in the cost


class Person(jk.System):
    """Legs and trunk with feedback at the ankles and hips."""

    legs: jk.Scalar = jk.parameter(25.0, positive=True, unit="kg")
    trunk: jk.Scalar = jk.parameter(48.0, positive=True, unit="kg")
    ankle_angle: jk.Scalar = jk.parameter(500.0, unit="N m/rad")
    ankle_hip: jk.Scalar = jk.parameter(100.0, unit="N m/rad")
    ankle_rate: jk.Scalar = jk.parameter(100.0, unit="N m s/rad")
    ankle_hip_rate: jk.Scalar = jk.parameter(50.0, unit="N m s/rad")
    hip_ankle: jk.Scalar = jk.parameter(100.0, unit="N m/rad")
    hip_angle: jk.Scalar = jk.parameter(200.0, unit="N m/rad")
    hip_ankle_rate: jk.Scalar = jk.parameter(50.0, unit="N m s/rad")
    hip_rate: jk.Scalar = jk.parameter(50.0, unit="N m s/rad")

    coordinates, speeds, inputs = ("ankle", "hip"), ("ankle_speed", "hip_speed"), ("platform", *MEASURED)
    units = {"ankle": "rad", "hip": "rad"}

    def motion(self, t, q, u):
        N, O = jk.inertial()  # on the platform
        L = N.rotate(3, -q["ankle"], -u["ankle_speed"], "legs")
        T = L.rotate(3, -q["hip"], -u["hip_speed"], "trunk")
        ankle = O.fixed(0.0 * L.y)
        hip = ankle.fixed(0.9 * L.y)
        bodies = [
            jk.Body(self.legs, (0.0, 0.0, 1.4), ankle.fixed(0.55 * L.y), L, name="legs body"),
            jk.Body(self.trunk, (0.0, 0.0, 2.2), hip.fixed(0.32 * T.y), T, name="trunk body"),
        ]
        return jk.Motion(bodies, frames={"legs": L, "trunk": T})

    def torques(self, q, u):
        """Torques of the ankles and of the hips, forwards [N m]."""
        angles = (q["ankle"], q["hip"], u["ankle_speed"], u["hip_speed"])
        ankle = (self.ankle_angle, self.ankle_hip, self.ankle_rate, self.ankle_hip_rate)
        hip = (self.hip_ankle, self.hip_angle, self.hip_ankle_rate, self.hip_rate)
        return [-sum(k * x for k, x in zip(gains, angles, strict=True)) for gains in (ankle, hip)]

    def loads(self, t, q, u, motion, inputs):
        N, L, T = motion.N, motion["legs"], motion["trunk"]
        ankle, hip = self.torques(q, u)
        # The frame moves with the platform, so its acceleration acts like a gravity in the opposite direction.
        field = -9.81 * N.y - inputs["platform"] * N.x
        return jk.weight(motion, field), jk.Torque(-ankle * N.z, L), jk.Torque(-hip * N.z, T, reaction_on=L)

    def outputs(self, t, q, u, motion, now):
        ankle, hip = self.torques(q, u)
        return {"ankle_torque": ankle, "hip_torque": hip}


GAINS = (
    *("ankle_angle", "ankle_hip", "ankle_rate", "ankle_hip_rate"),
    *("hip_ankle", "hip_angle", "hip_ankle_rate", "hip_rate"),
)
TIMES = np.linspace(0.0, 10.0, 401)  # [s]
NOISE = np.deg2rad(0.02)  # [rad]


def disturbance(t):
    """Acceleration of the platform (n,): four sines, which begin smoothly [m/s^2]."""
    rng = np.random.default_rng(1)
    frequencies, phases = (0.25, 0.6, 1.1, 1.9), rng.uniform(0.0, 2.0 * np.pi, 4)
    waves = sum(np.sin(2.0 * np.pi * f * t + phase) for f, phase in zip(frequencies, phases, strict=True))
    return 0.5 * waves * np.minimum(t, 1.0) ** 2 * (3.0 - 2.0 * np.minimum(t, 1.0))


PLATFORM = jk.Samples(jnp.asarray(TIMES), jnp.asarray(disturbance(TIMES)))
AT_REST = jk.State([0.0, 0.0], [0.0, 0.0])


def standing_person() -> Person:
    """The gains of a regulator, by the Riccati equation."""
    free = dataclasses.replace(Person(), **dict.fromkeys(GAINS, jnp.zeros(())))
    M = np.asarray(jk.equations_of_motion(free, 0.0, jnp.zeros(2), jnp.zeros(2))[0])
    A = np.asarray(jk.stability.linearize(free, jk.stability.equilibrium(free)).A)
    B = np.concatenate([np.zeros((2, 2)), np.linalg.inv(M)])  # the torques are the generalized forces
    P = scipy.linalg.solve_continuous_are(A, B, np.diag([1e5, 1e5, 0.0, 0.0]), np.eye(2))
    return dataclasses.replace(free, **{k: jnp.asarray(x) for k, x in zip(GAINS, (B.T @ P).ravel(), strict=True)})


def cost(t, now):
    """Squared deviations from the measurements, relative to the noise."""
    pairs = zip(Person.coordinates, MEASURED, strict=True)
    return sum(((now[name] - now[measured]) / NOISE) ** 2 for name, measured in pairs)


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    truth, rng = standing_person(), np.random.default_rng(0)
    ride = jk.simulate(truth, AT_REST, jnp.asarray(TIMES), {"platform": PLATFORM})
    noisy = {name: np.asarray(ride[name]) + NOISE * rng.normal(size=len(TIMES)) for name in Person.coordinates}
    measured = {f"measured_{name}": jk.Samples(jnp.asarray(TIMES), jnp.asarray(x)) for name, x in noisy.items()}
    problem = col.Problem(
        Person(), 10.0, controls=(), cost=cost, start=AT_REST, free=GAINS, inputs={"platform": PLATFORM, **measured}
    )  # fmt: skip
    # Measurements with noise are not smooth, so that no mesh would be fine enough: keep the nodes at the samples.
    guess = {name: np.append(0.0, x[1:]) for name, x in noisy.items()}
    plan = col.solve(problem, guess, intervals=200, tolerance=None)
    print(plan)
    assert plan.ok
    print(f"root mean square of the deviations / noise: {np.sqrt(plan.cost / 20.0):.3f}")
    for name in GAINS:
        true = float(getattr(truth, name))
        print(f"  {name:15s} {float(getattr(Person(), name)):8.1f}  ->  {plan.estimates[name]:8.1f}   true {true:8.1f}")
        assert abs(plan.estimates[name] / true - 1) < 0.2, name
    weak = jk.stability.linearize(Person(), jk.stability.equilibrium(Person()))
    found = jk.stability.linearize(plan.system, jk.stability.equilibrium(plan.system))
    slowest = [float(np.linalg.eigvals(np.asarray(model.A)).real.max()) for model in (weak, found)]
    print(f"slowest eigenvalue of the closed loop: guess {slowest[0]:.2f} 1/s, plan {slowest[1]:.2f} 1/s")
    assert slowest[1] < 0 < slowest[0]
    draw(noisy, plan, out / "stand_with_feedback.png")


def draw(noisy, plan: col.Plan, path: Path) -> None:
    figure, axes = plt.subplots(3, 1, figsize=(9, 7), sharex=True, layout="constrained")
    axes[0].plot(TIMES, disturbance(TIMES), color="0.4")
    axes[0].set(ylabel="platform [m/s$^2$]")
    for i, name in enumerate(Person.coordinates):
        axes[1].plot(TIMES, np.rad2deg(noisy[name]), ".", color=f"C{i}", markersize=2, label=f"{name}, measured")
        axes[1].plot(plan.t, np.rad2deg(plan[name]), color=f"C{i}", lw=1.2, label=f"{name}, plan")
        axes[2].plot(plan.t, plan[f"{name}_torque"], color=f"C{i}", lw=1.2, label=name)
    axes[1].set(ylabel="angle [deg]")
    axes[1].legend(frameon=False, ncols=4, loc="upper center", bbox_to_anchor=(0.5, 1.22))
    axes[2].set(ylabel="torque [N m]", xlabel="time [s]")
    figure.savefig(path, dpi=120)
    plt.close(figure)
    print(f"picture: {path}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the files (default: figures)")
    main(parser.parse_args().out)
