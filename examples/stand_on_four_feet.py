"""How does a robot with four legs fall on its feet and come to rest?

The robot is imported from a URDF: a trunk and four legs with three joints each, 18 speeds in all. Springs and dampers
in the joints return the legs to their stance. The four feet are contacts with friction and without restitution. The
robot is dropped from 0.1 m above the floor, tilted, while it moves forward and to the side.

    variable                      meaning                                              unit
    root_x, root_y, root_z        place of the trunk                                   m
    LEG_hip, LEG_thigh, LEG_knee  angles of the joints, for example front_left_knee    rad
    spring, damper                of each joint                                        N m/rad, N m s/rad
    rubber                        coefficient of friction of the feet                  1
    LEG.normal, LEG.friction_1    forces on a foot                                     N

Run:      python examples/stand_on_four_feet.py [--out FOLDER]
Appears:  the first impacts; stand_on_four_feet.png: the height of the trunk and the forces on the feet over time;
          stand_on_four_feet.gif: an animation.
Takes:    about a minute, most of it compilation.
"""

import argparse
import dataclasses
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxkane as jk

jk.configure(verbose=False)

HIPS = {"front_left": (0.2, 0.1), "front_right": (0.2, -0.1), "hind_left": (-0.2, 0.1), "hind_right": (-0.2, -0.1)}
STANCE = {"hip": 0.0, "thigh": 0.7, "knee": -1.4}  # [rad] of the front legs; the hind legs are mirrored
WEIGHT = 9.81 * (1.2 + 4 * (0.15 + 0.15 + 0.04))  # [N]
COLORS = dict(zip(HIPS, ("#14507a", "#4fa3e3", "#c8552b", "#f0ab45"), strict=True))


def link(name: str, mass: float, z: float, xx: float, yy: float, zz: float) -> str:
    return f"""<link name="{name}"><inertial><origin xyz="0 0 {z}"/><mass value="{mass}"/>
      <inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="0" ixz="0" iyz="0"/></inertial></link>"""


def joint(name: str, parent: str, child: str, place: str, axis: str, kind: str = "continuous") -> str:
    return f"""<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
      <origin xyz="{place}"/><axis xyz="{axis}"/></joint>"""


def urdf() -> str:
    """The robot as a URDF, with masses in kg, lengths in m and inertias in kg m^2."""
    parts = [link("trunk", 1.2, 0.0, 0.006, 0.02, 0.025)]
    for leg, (x, y) in HIPS.items():
        parts += [
            link(f"{leg}_bracket", 0.15, 0.0, 4e-5, 4e-4, 4e-4),
            link(f"{leg}_upper", 0.15, -0.08, 4e-4, 4e-4, 3e-5),
            link(f"{leg}_lower", 0.04, -0.1, 1.5e-4, 1.5e-4, 3e-6),
            f'<link name="{leg}"/>',
            joint(f"{leg}_hip", "trunk", f"{leg}_bracket", f"{x} {y} 0", "1 0 0"),
            joint(f"{leg}_thigh", f"{leg}_bracket", f"{leg}_upper", "0 0 0", "0 1 0"),
            joint(f"{leg}_knee", f"{leg}_upper", f"{leg}_lower", "0 0 -0.16", "0 1 0"),
            joint(f"{leg}_foot", f"{leg}_lower", leg, "0 0 -0.16", "0 0 1", kind="fixed"),
        ]
    return f'<robot name="robot">{"".join(parts)}</robot>'


ROBOT = jk.convert.from_urdf(urdf(), floating=True)
REST = {
    f"{leg}_{name}": angle * (1.0 if leg.startswith("front") else -1.0)
    for leg in HIPS
    for name, angle in STANCE.items()
}


class Standing(type(ROBOT)):
    """The robot with springs and dampers in its joints, on a floor."""

    spring: jk.Scalar = jk.parameter(5.0, unit="N m/rad")
    damper: jk.Scalar = jk.parameter(0.2, unit="N m s/rad")
    rubber: jk.Scalar = jk.parameter(0.7, unit="1")

    def loads(self, t, q, u, motion, inputs):
        loads = [*super().loads(t, q, u, motion, inputs)]
        for name, rest in REST.items():
            torque, at = self.spring * (rest - q[name]) - self.damper * u[f"{name}_rate"], motion.joints[name]
            axis = at.parent_frame.x if name.endswith("hip") else at.parent_frame.y
            loads += [jk.Torque(torque * axis, at.child_frame), jk.Torque(-torque * axis, at.parent_frame)]
        return loads

    def contacts(self, t, q, u, motion):
        return {leg: jk.Contact(motion[leg], motion.N.z, friction=self.rubber) for leg in HIPS}


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    robot = Standing(**{field.name: getattr(ROBOT, field.name) for field in dataclasses.fields(ROBOT)})
    pose = {**REST, "root_z": 0.37, "root_e1": np.sin(0.1), "root_e4": np.cos(0.1)}  # 0.2 rad to the right
    start = jk.State(pose, {"root_vx": 0.3, "root_vy": 0.2})
    ride = jk.simulate(robot, start, jnp.linspace(0.0, 1.5, 601))
    assert ride.ok, ride
    for i in range(4):
        print(f"{float(ride.jumps.t[i]):.4f} s: {ride.jumps.name(i)}")
    normal = {leg: np.asarray(ride[f"{leg}.normal"]) for leg in HIPS}
    print("at rest:", ", ".join(f"{leg} {force[-1]:.2f} N" for leg, force in normal.items()))
    assert all(np.all(ride.contacts[leg][-40:] == 2) for leg in HIPS)  # all feet stick
    assert abs(sum(force[-1] for force in normal.values()) - WEIGHT) < 0.05
    draw(ride, normal, out / "stand_on_four_feet.png")
    view = {"azimuth": -60.0, "elevation": 12.0}
    page = jk.animate(robot, ride, figure, speed=0.5, follow=False, ground=True, title="on four feet")
    page.save(out / "stand_on_four_feet.gif", size=(420, 280), fps=15, seconds=1.2, **view)
    print(f"pictures: {out / 'stand_on_four_feet.png'}, {out / 'stand_on_four_feet.gif'}")


def figure(system, motion, sketch) -> None:
    """The trunk as a plate, and each leg as a line from hip to foot."""
    trunk, center = motion["trunk"].frame, motion["trunk"].center.position
    corners = [center + trunk.vector(x, y, 0.0) for x, y in ((0.2, 0.1), (0.2, -0.1), (-0.2, -0.1), (-0.2, 0.1))]
    sketch.line("ink", *corners, corners[0], width=3.0)
    for leg, (x, y) in HIPS.items():
        hip, knee = center + trunk.vector(x, y, 0.0), motion.joints[f"{leg}_knee"].parent_point.position
        sketch.line(COLORS[leg], hip, knee, motion[leg].position, width=4.0)
        sketch.dot("ink", motion[leg], 3.0)


def draw(ride: jk.Trajectory, normal: dict, path: Path) -> None:
    picture, (above, below) = plt.subplots(2, 1, figsize=(8, 5), sharex=True, layout="constrained")
    above.plot(ride.t, 1e3 * np.asarray(ride["root_z"]), color="0.2")
    above.set(ylabel="height of the trunk [mm]", title="a robot is dropped on four feet")
    for leg, force in normal.items():
        below.plot(ride.t, force, color=COLORS[leg], label=leg.replace("_", " "), linewidth=1.2)
    below.axhline(WEIGHT / 4, color="0.5", linewidth=0.8, linestyle="--", label="weight / 4")
    below.set(xlabel="time [s]", ylabel="normal force [N]")
    below.legend(frameon=False, ncols=3)
    picture.savefig(path, dpi=120)
    plt.close(picture)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the pictures (default: figures)")
    main(parser.parse_args().out)
