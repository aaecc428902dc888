"""An arm in a file of MuJoCo's: which of its link masses do its motors' torques and joint angles tell?

The arm stands in this file as MJCF text. It becomes a system in one line, whose parameters have the names of its
links; then it is shaken by its motors, its angles are "measured" with noise, and the masses of the links are sought.

    variable                    meaning                                              unit
    turn, shoulder, elbow       joint angles, as in the file                         rad
    torque1, torque2, torque3   torques of the motors, the inputs                    N m
    mass.LINK                   mass of a link; the capsules' inertias stay          kg

Run:      python examples/bring_an_arm.py [--out FOLDER]        needs MuJoCo: pip install mujoco
Appears:  how the accelerations compare with MuJoCo's own; the fit's table, beside the true masses; bring_an_arm.png:
          angles measured, and of the fitted arm.
Takes:    half a minute, most of it compilation.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxkane as jk

jax.config.update("jax_enable_x64", True)

ARM = """<mujoco model="Arm">
 <compiler angle="degree"/>
 <option gravity="0 0 -9.81"><flag contact="disable"/></option>
 <default><joint damping="0.4" armature="0.02"/><geom type="capsule" size="0.04" density="2700"/></default>
 <worldbody>
  <body name="column" pos="0 0 0.1"><joint name="turn" axis="0 0 1"/><geom fromto="0 0 0 0 0 0.3"/>
   <body name="upper" pos="0 0 0.3"><joint name="shoulder" axis="0 1 0"/><geom fromto="0 0 0 0.35 0 0"/>
    <body name="fore" pos="0.35 0 0"><joint name="elbow" axis="0 1 0"/><geom fromto="0 0 0 0.3 0 0" size="0.03"/>
     <site name="tip" pos="0.3 0 0"/></body></body></body>
 </worldbody>
 <actuator><motor name="torque1" joint="turn"/><motor name="torque2" joint="shoulder"/>
  <motor name="torque3" joint="elbow"/></actuator>
</mujoco>"""
NOISE = 2e-3  # [rad]
COLORS = ("#e8a33d", "#3d8fd1", "#c8553d")


def difference_from_mujoco(arm: jk.System) -> float:
    """The largest difference of accelerations at random states, over their size."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(ARM)
    data, rng, worst = mujoco.MjData(model), np.random.default_rng(1), 0.0
    for _ in range(5):
        q, u, torques = rng.normal(size=(3, 3))
        data.qpos[:], data.qvel[:], data.ctrl[:] = q, u, torques
        mujoco.mj_forward(model, data)
        found = jk.accelerations(arm, 0.0, q, u, dict(zip(arm.inputs, torques, strict=True)))
        worst = max(worst, float(np.abs(found - data.qacc).max() / np.abs(data.qacc).max()))
    return worst


def main(folder: Path) -> None:
    arm = jk.convert.from_mjcf(ARM)
    print("masses:", ", ".join(f"{name} {float(mass):.3f} kg" for name, mass in arm.mass.items()))
    print(f"accelerations differ from MuJoCo's by {difference_from_mujoco(arm):.0e} of their size")

    ts = jnp.linspace(0.0, 1.5, 76)  # [s]
    torques = {
        "torque1": 3.0 * jnp.sin(5.0 * ts),
        "torque2": -12.0 + 6.0 * jnp.sin(4.0 * ts),
        "torque3": -3.0 + 2.0 * jnp.cos(7.0 * ts),
    }
    truth = arm.replace({"mass.upper": 1.15 * arm.mass["upper"], "mass.fore": 0.8 * arm.mass["fore"]})
    start = {"turn": 0.0, "shoulder": 0.2, "elbow": 0.4}
    ride = jk.simulate(truth, jk.State(start, {}), ts, torques)
    rng = np.random.default_rng(0)
    measured = {name: ride.q[:, i] + NOISE * rng.normal(size=len(ts)) for i, name in enumerate(arm.coordinates)}
    trial = jk.fit.Trial(
        ts,
        measured,
        inputs=torques,
        initial=start | dict.fromkeys(arm.speeds, 0.0),
        sigma=dict.fromkeys(measured, NOISE),
    )
    result = jk.fit.fit(arm, [trial], free=["mass.upper", "mass.fore"])
    print(result)
    print("true:", ", ".join(f"mass.{link} {float(truth.mass[link]):.3f} kg" for link in ("upper", "fore")))

    fitted = jk.simulate(result.system, jk.State(start, {}), ts, torques)
    figure, axes = plt.subplots(figsize=(7.0, 3.6), layout="constrained")
    for i, (name, color) in enumerate(zip(arm.coordinates, COLORS, strict=True)):
        axes.plot(ts, measured[name], ".", color=color, markersize=3)
        axes.plot(ts, fitted.q[:, i], color=color, linewidth=1.2, label=name)
    axes.set(xlabel="time [s]", ylabel="angle [rad]")
    axes.grid(alpha=0.25)
    axes.legend(frameon=False)
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / "bring_an_arm.png", dpi=130)
    print(f"picture: {folder / 'bring_an_arm.png'}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the picture (default: figures)")
    main(parser.parse_args().out)
