"""Parameters of a leaning rider and of tyres are estimated from noisy simulations with control."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane.bicycles import Bicycle, LateralSlip, LeaningRider, LeanSteerGains, Tyre, separate_rider
from jaxkane.fit import Free, LeastSquares, Trial, fit

SPEED, T = 5.0, np.linspace(0.0, 3.0, 601)  # [m/s], [s]
NOISE = {"roll": 0.005, "steer": 0.005, "roll_rate": 0.02, "steer_rate": 0.02, "yaw_rate": 0.02, "rider_lean": 0.01}
STILL = dict.fromkeys(("roll", "steer", "roll_rate", "steer_rate", "rider_lean", "rider_lean_rate"), 0.0)
TRUTH = {"rider.stiffness": 250.0, "rider.damping": 30.0, "front_tyre.lateral.relaxation_length": 0.1}
FREE = (
    "rider.stiffness",
    "rider.damping",
    Free("front_tyre.lateral.relaxation_length", tied={"rear_tyre.lateral.relaxation_length": 1.0}),
)


def bicycle(stiffness=250.0, damping=30.0, relaxation_length=0.1):
    """The benchmark bicycle, of whose rider the upper body leans, on tyres that slip."""
    body = {"mass": 48.8, "x": 0.3, "z": -1.1, "Ixx": 2.04, "Iyy": 2.5, "Izz": 1.1, "Ixz": 1.0}
    rider = LeaningRider(**body, hinge_x=0.2, hinge_z=-0.85, stiffness=stiffness, damping=damping)
    laws = (LateralSlip(c, k, relaxation_length=relaxation_length) for c, k in ((4000.0, 340.0), (6500.0, 570.0)))
    front, rear = (Tyre(lateral=law) for law in laws)
    return separate_rider(Bicycle.benchmark(), rider).with_parts(front_tyre=front, rear_tyre=rear)


def simulated(seed):
    """Closed loop: a balance steers, on top of a known torque with many frequencies. No noise yet."""
    ridden = bicycle().with_parts(control=LeanSteerGains(roll=-45.0, steer=45.0, roll_rate=-11.0, steer_rate=4.0))
    start = jk.assemble(ridden, {}, {"rear_wheel_rate": -SPEED / ridden.rR})
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, 5)
    waves = [np.sin(2.0 * np.pi * f * T + phase) for f, phase in zip((0.5, 1.1, 1.7, 2.9, 4.1), phases)]
    ride = jk.simulate(ridden, start, jnp.asarray(T), {"steer_torque": 3.0 * sum(waves)})
    assert ride.ok
    return {name: np.asarray(ride[name]) for name in (*NOISE, "applied_steer_torque")}


@pytest.mark.weekly
def test_rider_and_relaxation_length_are_identified_within_standard_errors():
    """The input is the measured total torque, so the fitted model has no controller. The guess is 20 % off."""
    rides = [simulated(seed) for seed in (1, 2)]
    for seed in range(3):  # by one program
        rng, trials = np.random.default_rng(seed), []
        for ride in rides:
            measured = {name: ride[name] + rng.normal(0.0, s, T.size) for name, s in NOISE.items()}
            inputs = {"steer_torque": ride["applied_steer_torque"]}
            trials.append(Trial(T, measured, inputs, sigma=NOISE, initial={"rear_wheel_rate": -SPEED / 0.3} | STILL))
        found = fit(bicycle(300.0, 24.0, 0.12), trials, FREE, optimizer=LeastSquares())
        for name, value in TRUTH.items():
            assert abs(found.estimates[name] - value) < 3.0 * found.standard_errors[name], (seed, name)
            assert found.standard_errors[name] < 0.1 * found.estimates[name]
