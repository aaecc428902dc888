"""The mechanisms of `docs/constraints.md` satisfy the power balance."""

import re
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxkane as jk

PAGE = Path(__file__).parents[1] / "docs" / "constraints.md"


def assert_power_is_the_rate_of_energy(system, state):
    """dT/dt along the motion is the power of the loads, F_r u_r: nothing else does work in ideal joints and rolling."""
    rtol = 1e-10
    now = (0.0, state.q, state.u)
    along = (jk.coordinate_rates(system, *now), jk.accelerations(system, *now))
    rate = jax.jvp(lambda q, u: jk.kinetic_energy(system, 0.0, q, u), now[1:], along)[1]
    power = jk.generalized_active_forces(system, *now) @ state.u
    scale = float(jk.kinetic_energy(system, *now))  # [J], and a rate of 1/s
    assert scale > 0.1
    assert abs(float(rate - power)) < rtol * scale


@pytest.mark.weekly
def test_mechanisms_of_the_recipes_satisfy_the_power_balance():
    names = {}
    for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL):
        exec(block, names)
    disc = names["Disc"]()
    state = jk.assemble(disc, {"lean": 0.2}, {"lean_rate": 0.7, "yaw_rate": 0.5, "spin_rate": -8.0})
    assert_power_is_the_rate_of_energy(disc, state)
    balls = names["TwoBalls"]()
    state = jk.assemble(balls, {"a4": 1.0, "b1": 0.6, "b4": 0.8}, {"v1": 1.0, "wa2": 2.0, "wb3": 3.0})
    assert abs(float(np.sum(state.q[7:] ** 2)) - 1.0) < 1e-12
    assert_power_is_the_rate_of_energy(balls, state)
