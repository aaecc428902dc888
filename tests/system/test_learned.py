"""Learned functions as parts of a system: evaluated as scalars, differentiated, fitted, and told apart from physics."""

import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from programs import operations

import jaxkane as jk
from jaxkane.fit import Free, LeastSquares, Trial, fit

ts = np.linspace(0.0, 3.0, 61)


def network(seed=2):
    """With the same numbers in every version of JAX."""
    rng = np.random.default_rng(seed)
    law = eqx.nn.MLP("scalar", "scalar", 4, 1, jnp.tanh, key=jax.random.key(0))
    arrays, rest = eqx.partition(law, eqx.is_inexact_array)
    return eqx.combine(jax.tree.map(lambda x: jnp.asarray(rng.uniform(-0.5, 0.5, x.shape)), arrays), rest)


class Pendulum(jk.System):
    law: Any = jk.learned()
    mass: jk.Scalar = jk.parameter(0.4, positive=True)
    coordinates, speeds = ("angle",), ("rate",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        rod = N.rotate(3, q["angle"], u["rate"])
        G = O.fixed(-0.15 * rod.y)
        return jk.Motion([jk.Body(self.mass, (0.003, 0.0, 0.003), G, rod, name="rod")])

    def friction(self, rate):
        return 0.01 * rate * self.law(rate * rate)

    def loads(self, t, q, u, motion, inputs):
        torque = jk.Torque(-self.friction(jnp.asarray(u["rate"])) * motion.N.z, motion["rod"])
        return jk.weight(motion, -9.81 * motion.N.y), torque


class Rough(Pendulum):
    def friction(self, rate):
        return 0.004 * rate / jnp.sqrt(rate * rate + 0.05) + 0.001 * rate


START = jk.State([1.0], [0.5])


@pytest.fixture(scope="module")
def pendulum():
    return Pendulum(network())


def by_hand(pendulum, angle, rate):
    first, last = pendulum.law.function.layers
    hidden = np.tanh(np.asarray(first.weight)[:, 0] * rate**2 + np.asarray(first.bias))
    torque = 0.01 * rate * float((np.asarray(last.weight)[0] @ hidden + np.asarray(last.bias)).item())
    return (-0.4 * 9.81 * 0.15 * np.sin(angle) - torque) / (0.003 + 0.4 * 0.15**2)


@pytest.mark.slow
def test_a_system_with_a_learned_law_is_one_program_of_scalars(pendulum):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = jk.accelerations(pendulum, 0.0, [0.3], [2.0])
    assert float(found[0]) == pytest.approx(by_hand(pendulum, 0.3, 2.0), rel=1e-13)
    assert operations("rates", pendulum, [0.3], [2.0])


@pytest.mark.weekly
def test_a_learned_law_and_the_mass_are_identified_together(pendulum):
    true = jk.simulate(Rough(network(), mass=0.4), START, ts)
    noise = np.random.default_rng(0).normal(0.0, 1e-3, ts.size)
    trial = Trial(ts, {"angle": true["angle"] + noise}, sigma=1e-3, initial={"angle": 1.0, "rate": 0.5})
    free = ["mass", Free("law", prior=(0.0, 1.0))]
    found = fit(Pendulum(network(), mass=0.45), trial, free, optimizer=LeastSquares(), steps=60)
    assert found.cost < 60
    elsewhere = jk.State([0.95], [0.0])
    rough, learned = (jk.simulate(p, elsewhere, ts)["angle"] for p in (Rough(network(), mass=0.4), found.system))
    assert np.abs(rough - learned).max() < 0.02  # of 0.95; without friction they are 0.3 apart
    assert abs(found.estimates["mass"] - 0.4) < 4 * found.standard_errors["mass"]
    text = str(found)
    assert "rms of 13 learned numbers" in text
    assert "weight" not in text


def test_an_invalid_learned_function_raises_by_name():
    bare = type("Bare", (Pendulum,), {"__annotations__": {"law": Any}, "law": None})
    with pytest.raises(TypeError, match=r"law is a function.*such as a neural network, as `law: Any = jk.learned\(\)`"):
        bare(jnp.tanh)
    with pytest.raises(TypeError, match="needs a function with parameters"):
        Pendulum(3.0)
