"""Does a tilted block come to rest by rocking or by sliding?

A block starts on its left corner, and this corner slides on the floor. The coefficient of friction decides how it loses
its energy: by impacts of the corners or by sliding.

    variable                    meaning                                            unit
    x, y                        place of the mass centre                           m
    angle                       of the block, counterclockwise                     rad
    x_dot, y_dot, rate          their rates                                        m/s, rad/s
    friction                    coefficient of friction of the corners             -

Run:      python examples/rock_and_slide.py [--out FOLDER]
Appears:  the first changes of the contact states for two coefficients of friction; and rock_and_slide.png: the angle,
          the contact states and the lost energy over time.
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

g = 9.81  # [m/s^2]
STATES = {0: "open", 1: "slides", 2: "sticks"}
COLOURS = {1: "C1", 2: "C0"}


class Block(jk.System):
    """A block of 1 kg on a floor. It touches the floor with its lower corners."""

    width: jk.Scalar = jk.parameter(0.6, positive=True, unit="m")
    height: jk.Scalar = jk.parameter(1.0, positive=True, unit="m")
    friction: jk.Scalar = jk.parameter(0.5, unit="-")

    coordinates, speeds = ("x", "y", "angle"), ("x_dot", "y_dot", "rate")
    units = {"angle": "rad"}

    def motion(self, t, q, u):
        N, O = jk.inertial()
        B = N.rotate(3, q["angle"], u["rate"], "B")
        center = O.moving(q["x"] * N.x + q["y"] * N.y, u["x_dot"] * N.x + u["y_dot"] * N.y)
        I = (self.width**2 + self.height**2) / 12
        bottom, side = -0.5 * self.height * B.y, 0.5 * self.width * B.x
        corners = {"left": center.fixed(bottom - side), "right": center.fixed(bottom + side)}
        return jk.Motion([jk.Body(1.0, (I, I, I), center, B, name="block")], points=corners)

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -g * motion.N.y)

    def contacts(self, t, q, u, motion):
        return {name: jk.Contact(motion[name], motion.N.y, friction=self.friction) for name in ("left", "right")}


def fall(friction: float) -> tuple[jk.Trajectory, jk.Audit]:
    """The motion after a start on the left corner, which slides to the right at 0.5 m/s."""
    block = Block(friction=friction)
    start = jk.assemble(block, {"x": 0.0, "angle": 0.4}, {"x_dot": 0.5}, touching=("left",))
    ride = jk.simulate(block, start, jnp.linspace(0.0, 1.6, 1601))
    return ride, jk.audit(block, ride)


def print_changes(friction: float, ride: jk.Trajectory) -> None:
    print(f"friction {friction}: {ride.reason}")
    jumps = ride.jumps
    width = jumps.after.contacts.shape[1] // 2
    for i in range(min(int(jumps.count), 8)):  # the block that rocks has thirty impacts
        left, right = (STATES[int(state)] for state in jumps.after.contacts[i, ::width])
        lost = float(jumps.energy[i])
        print(f"  {float(jumps.t[i]):.4f} s  left {left:<6}  right {right:<6}  loses {abs(lost):.4f} J")


def main(out: Path) -> None:
    motions = {friction: fall(friction) for friction in (0.3, 0.5)}
    for friction, (ride, _) in motions.items():
        print_changes(friction, ride)
        assert ride.ok

    # At the end, the block is at rest on both corners.
    slides, rocks = (ride for ride, _ in motions.values())
    for ride in (slides, rocks):
        assert ride.contacts["left"][-1] == ride.contacts["right"][-1] == 2
        np.testing.assert_allclose([ride["angle"][-1], ride["y"][-1] - 0.5, ride["rate"][-1]], 0.0, atol=1e-9)

    # With more friction, it rocks. Each impact multiplies its rate by 1 - 3/2 sin^2(alpha), tan(alpha) = width / height
    # (Housner 1963).
    jumps = rocks.jumps
    impacts = np.flatnonzero(np.asarray(jumps.energy[: int(jumps.count)]) > 1e-6)  # the last impacts are very small
    ratios = np.asarray(jumps.after.u[impacts, 2] / jumps.before.u[impacts, 2])
    print("rate after an impact / before:", ratios)
    np.testing.assert_allclose(ratios, 1.0 - 1.5 * 0.6**2 / (0.6**2 + 1.0**2), rtol=1e-9)

    out.mkdir(parents=True, exist_ok=True)
    draw(motions, out / "rock_and_slide.png")


def draw(motions: dict[float, tuple[jk.Trajectory, jk.Audit]], file: Path) -> None:
    figure, (top, middle, bottom) = plt.subplots(
        3, 1, figsize=(8, 7), sharex=True, height_ratios=(2, 1.2, 2), layout="constrained"
    )
    rows = [(friction, corner) for friction in motions for corner in ("left", "right")]
    for k, (friction, (ride, audit)) in enumerate(motions.items()):
        t = np.asarray(ride.t)
        top.plot(t, np.rad2deg(ride["angle"]), f"C{2 + k}", label=f"friction {friction}")
        energy = audit.kinetic_energy + g * np.asarray(ride["y"])  # mass 1 kg
        bottom.plot(t, energy[0] - energy, f"C{2 + k}", label=f"friction {friction}: in total")
        bottom.plot(t, audit.lost, f"C{2 + k}--", label=f"friction {friction}: by impacts")
        for corner in ("left", "right"):
            states, row = np.asarray(ride.contacts[corner]), rows.index((friction, corner))
            for state, colour in COLOURS.items():
                middle.fill_between(t, row - 0.4, row + 0.4, where=states == state, color=colour, linewidth=0)
    top.set(ylabel="angle [deg]")
    middle.set(yticks=range(len(rows)), yticklabels=[f"{friction}, {corner}" for friction, corner in rows])
    middle.set(title="contact states: slides (orange), sticks (blue), open (white)", ylim=(len(rows) - 0.5, -0.5))
    bottom.set(xlabel="time [s]", ylabel="lost energy [J]")
    top.legend(frameon=False)
    bottom.legend(frameon=False, loc="lower right")
    figure.savefig(file, dpi=120)
    print(f"picture: {file}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"))
    main(parser.parse_args().out)
