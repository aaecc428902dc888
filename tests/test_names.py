"""A name that is not there is answered with what was probably meant, wherever names are looked up."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane._lookup import hint

PENDULUM = jk.catalog.DoublePendulum()
TS = jnp.array([0.0, 0.1])


@pytest.fixture(scope="module")
def ride():
    return jk.simulate(PENDULUM, jk.State([0.1, 0.2], [0.0, 0.0]), TS)


def test_a_hint_is_short():
    many = [f"angle{i}" for i in range(49)]
    assert hint("wobble", many).endswith("... (49 in all).")
    assert len(hint("wobble", many)) < 150
    assert hint("angel7", many) == "did you mean 'angle7' or 'angle47'?"
    assert hint(["stear", "nothing"], ["steer", "roll"]) == "did you mean 'steer' for 'stear'?"
    assert hint("x", []) == "there are none."


def test_every_look_up_says_what_was_meant(ride):
    meant = "did you mean 'theta1'"
    state = jk.State([0.1, 0.2], [0.0, 0.0])
    lookups = [
        lambda: ride["thetta1"],
        lambda: jk.assemble(PENDULUM, {"thetta1": 0.1}),
        lambda: jk.accelerations(PENDULUM, 0.0, {"thetta1": 0.1}, {}),
        lambda: jk.stability.equilibrium(PENDULUM, hold=("thetta1",)),
        lambda: jk.stability.linearize(PENDULUM, jk.State([0.0, 0.0], [0.0, 0.0]), outputs=("thetta1",)),
        lambda: jk.stability.linearize(PENDULUM, jk.State([0.0, 0.0], [0.0, 0.0]), states=("thetta1",)),
        lambda: jk.plot.trajectories(ride, ["thetta1"]),
        lambda: jk.fit.fit(PENDULUM, [jk.fit.Trial(np.array(TS), {"thetta1": [0.0, 0.0]}, sigma=1.0)], ["length"]),
        lambda: jk.sweep.grid(theta1=[0.1, 0.2])["thetta1"],
    ]
    for look_up in lookups:
        with pytest.raises((KeyError, ValueError), match=meant):
            look_up()
    with pytest.raises(ValueError, match="did you mean 'shoulder_torque'"):
        jk.simulate(PENDULUM, state, TS, {"sholder_torque": 1.0})
    with pytest.raises(KeyError, match="did you mean 'theta2_dot'"):
        jk.simulate(PENDULUM, state, TS, {"elbow_torque": lambda t, state: state["theta2_dott"]})
