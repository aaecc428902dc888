"""How do you describe a new mechanism, and which forces act in its bearing?

The mechanism is a rotary pendulum (Furuta pendulum): a motor turns a horizontal arm. At its end, a rod swings in the
plane normal to the arm. The class `RotaryPendulum` has about thirty lines.

    variable             meaning                                             unit
    arm, rod             angle of the arm about the vertical; of the rod     rad
                         from hanging, about the arm
    arm_rate, rod_rate   their rates                                         rad/s
    torque               of the motor, on the arm                            N m
    reach, length        of the arm, of the rod                              m
    mass, arm_inertia    of the rod; of the arm about its axle               kg, kg m^2
    damping              of the rod's bearing                                N m s/rad

Run:      python examples/describe_a_new_system.py [--out FOLDER]
Appears:  the audit of the motion (energy, momentum, conditioning), the largest force in the rod's bearing, and
          describe_a_new_system.png: the path of the rod's end from above, the angles, the force in the bearing.
Takes:    about ten seconds.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection

import jaxkane as jk

jax.config.update("jax_enable_x64", True)

GOLD, BLUE, INK = "#e8a33d", "#3d8fd1", "#2b2f36"


class RotaryPendulum(jk.System):
    """A rod on the end of a motor-driven level arm. N.z is up; the arm lies along A.x, the rod hangs along -R.z."""

    reach: jk.Scalar = jk.parameter(0.3, positive=True, unit="m")
    length: jk.Scalar = jk.parameter(0.4, positive=True, unit="m")
    mass: jk.Scalar = jk.parameter(0.2, positive=True, unit="kg")
    arm_inertia: jk.Scalar = jk.parameter(0.01, positive=True, unit="kg m^2")
    damping: jk.Scalar = jk.parameter(2e-4, unit="N m s/rad")

    coordinates = ("arm", "rod")
    speeds = ("arm_rate", "rod_rate")
    inputs = ("torque",)
    units = {"arm": "rad", "rod": "rad", "torque": "N m"}

    def motion(self, t, q, u):
        N, O = jk.inertial()
        A = N.rotate(3, q["arm"], u["arm_rate"], "A")
        R = A.rotate(1, q["rod"], u["rod_rate"], "R")
        bearing = O.fixed(self.reach * A.x)
        middle, end = (bearing.fixed(-part * self.length * R.z) for part in (0.5, 1.0))
        I = self.mass * self.length**2 / 12
        arm = jk.Body(0.0, (0.0, self.arm_inertia, self.arm_inertia), O, A, name="arm")
        rod = jk.Body(self.mass, (I, I, 0.0), middle, R, name="rod")
        return jk.Motion([arm, rod], points={"bearing": bearing, "end": end}, frames={"A": A, "R": R})

    def loads(self, t, q, u, motion, inputs):
        arm, rod, axle = motion["arm"], motion["rod"], motion["A"].x
        return (
            jk.weight(motion, -9.81 * motion.N.z),
            jk.Torque(inputs["torque"] * motion.N.z, arm),
            jk.loads.torsional_damper(rod, arm, axle, self.damping),
        )


def main(folder: Path) -> None:
    pendulum = RotaryPendulum()
    start = jk.assemble(pendulum, {"rod": 0.3})
    ts = jnp.linspace(0.0, 6.0, 1201)
    shake = {"torque": lambda t, state: 0.12 * jnp.sin(5.0 * t) * jnp.exp(-((t / 4.0) ** 6))}
    swing = jk.simulate(pendulum, start, ts, shake, rtol=1e-10, atol=1e-10)
    print(jk.audit(pendulum, swing))

    force = np.linalg.norm(jk.constraint_forces(pendulum, swing)["bearing"], axis=-1)
    weight = 9.81 * float(pendulum.mass)
    print(f"the bearing carries up to {force.max():.2f} N, {force.max() / weight:.1f} times the rod's weight")

    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "describe_a_new_system.png"
    draw(pendulum, swing, force / weight, path)
    print(f"picture: {path}")


def end_of_rod(pendulum: RotaryPendulum, swing: jk.Trajectory) -> np.ndarray:
    """Position (n_t, 3) of the rod's end [m], from the description."""

    def place(t, q, u):
        motion = pendulum.motion(t, q, u)
        return motion["end"].position.to(motion.N)

    return np.asarray(jax.vmap(place)(swing.t, swing.q, swing.u))


def draw(pendulum: RotaryPendulum, swing: jk.Trajectory, load: np.ndarray, path: Path) -> None:
    plt.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False})
    figure = plt.figure(figsize=(10.5, 5.0), layout="constrained")
    places = [["above", "angles"], ["above", "force"]]
    above, angles, forces = figure.subplot_mosaic(places, width_ratios=[1, 1.1]).values()

    x, y, z = end_of_rod(pendulum, swing).T
    points = np.stack([x, y], axis=-1)
    lines = LineCollection(np.stack([points[:-1], points[1:]], axis=1), array=z[1:], cmap="viridis", linewidths=1.4)
    above.add_collection(lines)
    reach = 1.05 * np.abs(points).max()
    above.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", xlabel="x [m]", ylabel="y [m]")
    above.add_patch(plt.Circle((0, 0), float(pendulum.reach), fill=False, color="0.75", ls="--"))
    above.scatter(0, 0, s=30, color=INK, zorder=3)
    above.set_title("The rod's end from above")
    figure.colorbar(lines, ax=above, label="height [m]", shrink=0.7)

    for name, color in (("arm", BLUE), ("rod", GOLD)):
        angles.plot(swing.t, np.rad2deg(swing[name]), color=color, label=name)
    angles.set(ylabel="angle [deg]", xlim=(0, swing.t[-1]))
    angles.tick_params(labelbottom=False)
    angles.legend(frameon=False)
    forces.plot(swing.t, load, color=INK)
    forces.set(xlabel="time [s]", ylabel="bearing force / weight", xlim=(0, swing.t[-1]))
    for axes in (angles, forces):
        axes.grid(alpha=0.25)
    figure.align_ylabels([angles, forces])
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the picture (default: figures)")
    main(parser.parse_args().out)
