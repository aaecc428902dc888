"""Which forces act in a closed loop, and does it remain closed for a minute?

The mechanism is a crank-rocker: four bars in a loop, one of which is the ground. A weight hangs on the coupler. The
loop is opened at the pin of the rocker, described as a chain, and closed by two configuration constraints.

    variable                    meaning                                            unit
    crank, coupler, rocker      angle of each bar from the one before it           rad
    crank_rate                  independent speed; the other two follow            rad/s
    ground, l_crank, l_coupler, lengths of the bars                                m
    l_rocker
    torque                      on the crank                                       N m

Run:      python examples/closed_loop.py [--out FOLDER]
Appears:  the best choice of dependent speeds; the audit of one minute with and without projection; and
          closed_loop.png: the coupler's path, the forces in both ground pins, the gap at the pin over a minute.
Takes:    half a minute.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxkane as jk

jax.config.update("jax_enable_x64", True)

GOLD, BLUE, INK = "#e8a33d", "#3d8fd1", "#2b2f36"


class CrankRocker(jk.System):
    """Three slender bars in a chain from the pin A to the pin D, both on the ground. N.y is up."""

    ground: jk.Scalar = jk.parameter(1.0, positive=True, unit="m")  # from A to D
    l_crank: jk.Scalar = jk.parameter(0.3, positive=True, unit="m")
    l_coupler: jk.Scalar = jk.parameter(0.9, positive=True, unit="m")
    l_rocker: jk.Scalar = jk.parameter(0.7, positive=True, unit="m")
    density: jk.Scalar = jk.parameter(2.0, positive=True, unit="kg/m")
    load: jk.Scalar = jk.parameter(1.5, positive=True, unit="kg")  # on the coupler

    coordinates = ("crank", "coupler", "rocker")
    speeds = ("crank_rate",)
    dependent_speeds = ("coupler_rate", "rocker_rate")
    dependent_coordinates = ("coupler", "rocker")
    inputs = ("torque",)
    units = dict.fromkeys(coordinates, "rad") | {"torque": "N m"}

    def motion(self, t, q, u):
        N, A = jk.inertial()
        frame, pin, bars, points = N, A, [], {}
        lengths = (self.l_crank, self.l_coupler, self.l_rocker)
        for joint, name, l, angle, rate in zip("ABC", self.coordinates, lengths, q, u, strict=True):
            points[joint] = pin
            frame = frame.rotate(3, angle, rate, name)
            I = self.density * l**3 / 12
            bars.append(jk.Body(self.density * l, (0.0, I, I), pin.fixed(0.5 * l * frame.x), frame, name=name))
            if name == "coupler":
                points["weight"] = pin.fixed(0.5 * l * frame.x + 0.3 * l * frame.y)
            pin = pin.fixed(l * frame.x)
        points["D"] = pin
        bars.append(jk.Body(self.load, 0.0, points["weight"], name="load"))
        return jk.Motion(bars, points=points)

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -9.81 * motion.N.y), jk.Torque(inputs["torque"] * motion.N.z, motion["crank"])

    def configuration_constraints(self, t, q):
        motion = self.motion(t, q, (0.0, 0.0, 0.0))
        gap = motion["D"].position - self.ground * motion.N.x
        return gap.to(motion.N)[:2]


def main(folder: Path) -> None:
    linkage = CrankRocker()
    start = jk.assemble(linkage, {"crank": 1.0, "coupler": -0.5, "rocker": -1.5}, {"crank_rate": 9.0})
    print(jk.best_dependent_speeds(linkage, 0.0, start.q), end="\n\n")

    ts = jnp.linspace(0.0, 60.0, 6001)
    rides = {
        "left to itself": jk.simulate(linkage, start, ts),
        "stabilized": jk.simulate(linkage, start, ts, stabilize=10.0),
        "projected": jk.simulate(linkage, start, ts, project=True),
    }
    audits = {name: jk.audit(linkage, ride) for name, ride in rides.items()}
    print(audits["projected"], end="\n\n")
    for name, audit in audits.items():
        print(f"largest gap in a minute, {name:<15} {audit.drift:.1e} m")

    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "closed_loop.png"
    draw(linkage, rides["projected"], audits, path)
    print(f"picture: {path}")


def draw(linkage: CrankRocker, ride: jk.Trajectory, audits: dict[str, jk.Audit], path: Path) -> None:
    plt.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False})
    figure = plt.figure(figsize=(10.5, 5.0), layout="constrained")
    places = [["mechanism", "forces"], ["mechanism", "gap"]]
    mechanism, forces, gap = figure.subplot_mosaic(places, width_ratios=[1, 1.1]).values()

    def places_of(t, q, u):  # of A, B, C, D and the weight
        motion = linkage.motion(t, q, u)
        return jnp.stack([motion[P].position.to(motion.N) for P in ("A", "B", "C", "D", "weight")])

    short = 400  # four seconds
    all_u = jnp.concatenate([ride.u, ride.u_dep], axis=1)
    r = np.asarray(jax.vmap(places_of)(ride.t[:short], ride.q[:short], all_u[:short]))[..., :2]
    for i in range(0, 75, 5):
        mechanism.plot(*r[i, :4].T, color=BLUE, alpha=0.18, lw=2)
    mechanism.plot(*r[0, :4].T, color=BLUE, lw=3, marker="o", ms=7, mec="white")
    mechanism.fill(*r[0, [1, 2, 4]].T, color=BLUE, alpha=0.15)
    mechanism.plot(*r[:, 4].T, color=GOLD, lw=1.6)
    mechanism.scatter(*r[0, 4], s=90, color=GOLD, zorder=3, ec="white")
    mechanism.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title="The weight's path on the coupler")

    carried = jk.constraint_forces(linkage, ride)
    t = np.asarray(ride.t[:short])
    for pin, color in (("A", BLUE), ("D", GOLD)):
        forces.plot(t, np.linalg.norm(carried[pin], axis=-1)[:short], color=color, label=f"pin {pin}")
    forces.set(ylabel="force in the pin [N]", xlim=(0, t[-1]), ylim=(0, 600), xlabel="time [s]")
    forces.legend(frameon=False, ncols=2)
    for (name, audit), color in zip(audits.items(), (INK, BLUE, GOLD), strict=True):
        size = np.abs(audit.configuration_residuals).max(axis=1)
        gap.semilogy(audit.t, np.maximum(size, 1e-17), color=color, lw=0.8, label=name)
    gap.set(xlabel="time [s]", ylabel="gap at D [m]", xlim=(0, 60))
    gap.legend(frameon=False, loc=(0.08, 0.4), ncols=3)
    for axes in (forces, gap):
        axes.grid(alpha=0.25)
    figure.align_ylabels([forces, gap])
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the picture (default: figures)")
    main(parser.parse_args().out)
