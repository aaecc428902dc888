"""Writes mujoco_tree.json: accelerations by MuJoCo of a tree with every kind of joint, and of a hinge that is thrown.

    python tests/data/mujoco_tree.py        with MuJoCo installed (pip install mujoco)

Euler parameters are scalar last in the file, as in jaxkane; MuJoCo has them first.
"""

import json
from pathlib import Path

import mujoco
import numpy as np

TREE = """<mujoco model="tree">
<compiler angle="degree"/>
<option gravity="0.3 -0.5 -9.7"><flag contact="disable"/></option>
<worldbody>
 <body name="base" pos="0.1 0.2 0.9" euler="20 -30 40">
  <freejoint name="root"/>
  <inertial pos="0.02 0.01 0.03" mass="4.8" fullinertia="0.21 0.16 0.09 0.01 -0.02 0.015"/>
  <body name="arm" pos="0.2 0 0.1" quat="0.5 0.5 0.5 0.5">
   <joint name="shoulder" axis="1 2 0.5" pos="0.02 -0.01 0.04" damping="0.3" stiffness="2" springref="20"
          armature="0.05" ref="10"/>
   <joint name="extend" type="slide" axis="0 1 0.3" damping="0.7" stiffness="30" springref="0.1" armature="0.2"
          ref="0.05"/>
   <inertial pos="0 0 0.2" mass="3.6" diaginertia="0.08 0.07 0.02"/>
   <site name="tip" pos="0.1 0.2 0.3"/>
   <body name="hand" pos="0 0.1 0.4">
    <joint name="wrist" type="ball" pos="0.01 0.02 0.03" damping="0.2" stiffness="1.5" armature="0.03"/>
    <inertial pos="0.1 0 0" mass="1.4" diaginertia="0.004 0.006 0.005"/>
    <body name="plate" pos="0.1 0.1 0"><inertial pos="0 0 0" mass="0.2" diaginertia="1e-4 2e-4 2.5e-4"/></body>
   </body>
  </body>
  <body name="leg" pos="0 0 -0.3">
   <joint name="hip1" axis="1 0 0"/><joint name="hip2" axis="0 1 0" pos="0 0 0.1"/><joint name="hip3" axis="0 0 -1"/>
   <inertial pos="0 0 -0.1" mass="1.7" diaginertia="0.02 0.02 0.002"/>
  </body>
 </body>
</worldbody>
<actuator>
 <motor name="turn" joint="shoulder" gear="3"/>
 <position name="extend" joint="extend" kp="20" kv="1.5" gear="2"/>
 <general name="hip" joint="hip1" gainprm="2.5" biastype="affine" biasprm="0.3 -1 -2" gear="0.5"/>
 <motor name="twist" joint="wrist" gear="1 2 3"/>
</actuator>
</mujoco>"""


def scalar_last(model, qpos):
    q = np.array(qpos)
    for j in range(model.njnt):
        start = model.jnt_qposadr[j] + (3 if model.jnt_type[j] == 0 else 0)
        if model.jnt_type[j] in (0, 1):  # free, ball
            q[start : start + 4] = np.roll(q[start : start + 4], -1)
    return q.tolist()


def states(model, n, seed=0):
    """Random states, controls, and accelerations that no constraint touches."""
    rng, data, found = np.random.default_rng(seed), mujoco.MjData(model), []
    for _ in range(n):
        mujoco.mj_resetData(model, data)
        mujoco.mj_integratePos(model, data.qpos, rng.normal(size=model.nv), 1.0)
        data.qvel[:], data.ctrl[:] = rng.normal(size=model.nv), rng.normal(size=model.nu)
        mujoco.mj_forward(model, data)
        numbers = {"u": data.qvel, "inputs": data.ctrl, "u_dot": data.qacc_smooth}
        found.append({"q": scalar_last(model, data.qpos)} | {name: x.tolist() for name, x in numbers.items()})
    return found


if __name__ == "__main__":
    figures = {
        "source": f"MuJoCo {mujoco.__version__}, mj_forward: qacc_smooth; tests/data/mujoco_tree.py",
        "model": TREE,
        "states": states(mujoco.MjModel.from_xml_string(TREE), 2),
    }
    Path(__file__).with_suffix(".json").write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
