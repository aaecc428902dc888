"""What the pages say can be typed in as it stands."""

import re
from pathlib import Path

import numpy as np

import jaxkane as jk

PAGE = Path(__file__).parents[1] / "docs" / "describing.md"


def test_the_recipes_describe_mechanisms():
    names = {}
    for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL):
        exec(block, names)
    disc = names["Disc"]()
    state = jk.assemble(disc, {"lean": 0.2}, {"yaw_rate": 0.5, "spin_rate": -8.0})
    assert np.isfinite(jk.accelerations(disc, 0.0, state.q, state.u)).all()
    balls = names["TwoBalls"]()
    state = jk.assemble(balls, {"a4": 1.0, "b1": 0.6, "b4": 0.8}, {"v1": 1.0, "wa2": 2.0, "wb3": 3.0})
    assert abs(float(np.sum(state.q[7:] ** 2)) - 1.0) < 1e-12
    assert np.isfinite(jk.accelerations(balls, 0.0, state.q, state.u)).all()
