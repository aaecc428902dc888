"""How does a car park between two others in the shortest time?

The car drives along a row of parked cars and must stop in a gap that is 1.35 times as long as itself. Its wheels roll
without slipping sideways, so it cannot move sideways. The duration is minimized. Acceleration, speed and steering are
bounded, and points along the outline of the car must stay outside the parked cars and the kerb.

    variable             meaning                                                   unit
    x, y, heading        of the middle of the rear axle                            m, m, rad
    steer                angle of the front wheels                                 rad
    speed, steer_rate    of the rear axle (negative: backwards), of the wheels     m/s, rad/s
    drive, servo         force of the motor, torque on the front wheels            N, N m

Run:      python examples/park_a_car.py [--out FOLDER]
Appears:  the report of the plan; park_a_car.png: the path of the car, its speed and steering.
Takes:    20 seconds.
"""

import argparse
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxkane as jk
from jaxkane import collocation as col

jk.configure(verbose=False)

AXLES, FRONT, REAR, HALF_WIDTH = 2.6, 0.8, 0.8, 0.9  # wheelbase, overhangs, half of the width [m]
LENGTH = AXLES + FRONT + REAR
GAP, DEPTH = 1.35 * LENGTH, 2.2  # [m]; the gap begins at x = 0, and the parked cars reach y = 0
BLUR = 0.05  # of the edges of the gap [m], so that the height of the ground is smooth


class Car(jk.System):
    """Two axles. The rear one does not slip because of the generalized speeds, the front one by a constraint."""

    mass: jk.Scalar = jk.parameter(1000.0, positive=True, unit="kg")
    inertia: jk.Scalar = jk.parameter(1500.0, positive=True, unit="kg m^2")

    coordinates = ("x", "y", "heading", "steer")
    speeds, dependent_speeds = ("speed", "steer_rate"), ("yaw_rate",)
    inputs = ("drive", "servo")
    units = {"x": "m", "y": "m", "heading": "rad", "steer": "rad"}

    def q_dot(self, t, q, u):
        heading = q["heading"]
        return u["speed"] * jnp.cos(heading), u["speed"] * jnp.sin(heading), u["yaw_rate"], u["steer_rate"]

    def motion(self, t, q, u):
        N, O = jk.inertial()
        A = N.rotate(3, q["heading"], u["yaw_rate"], "car")
        F = A.rotate(3, q["steer"], u["steer_rate"], "wheels")
        rear = O.moving(N.vector(q["x"], q["y"], 0.0), u["speed"] * A.x)
        front = rear.fixed(AXLES * A.x)
        bodies = [
            jk.Body(self.mass, (0.0, 0.0, self.inertia), rear.fixed(0.5 * AXLES * A.x), A, name="body"),
            jk.Body(20.0, (0.0, 0.0, 1.0), front, F, name="front axle"),
        ]
        return jk.Motion(bodies, [front.velocity.dot(F.y)], points={"rear": rear}, frames={"car": A, "wheels": F})

    def loads(self, t, q, u, motion, inputs):
        A, F = motion["car"], motion["wheels"]
        drive = jk.Force(inputs["drive"] * A.x, motion["rear"])
        return drive, jk.Torque(inputs["servo"] * F.z, F, reaction_on=A)


def outline(x, y, heading, sides=(-1.0, 1.0), n=9):
    """Points along the sides of the car, as two lists."""
    along, side = np.linspace(-REAR, AXLES + FRONT, n), np.array(sides) * HALF_WIDTH
    places = [(a, b) for b in side for a in along]
    return (
        [x + a * jnp.cos(heading) - b * jnp.sin(heading) for a, b in places],
        [y + a * jnp.sin(heading) + b * jnp.cos(heading) for a, b in places],
    )


def ground(x):
    """The y [m] from which on the road is free: 0 beside the parked cars, -DEPTH in the gap."""
    return -0.5 * DEPTH * (jnp.tanh(x / BLUR) - jnp.tanh((x - GAP) / BLUR))


def clearances(t, now):
    """Distances of the points of the right side from the parked cars and the kerb, along y."""
    xs, ys = outline(now["x"], now["y"], now["heading"], sides=(-1.0,))
    return {f"clearance {i}": y - ground(x) for i, (x, y) in enumerate(zip(xs, ys, strict=True))}


MIDDLE = 0.5 * (GAP - LENGTH) + REAR  # the rear axle of the parked car, in the middle of the gap [m]
PROBLEM = col.Problem(
    Car(),
    (4.0, 30.0),
    controls={"drive": (-1500.0, 1500.0), "servo": (-3.0, 3.0)},
    # A small cost of the controls, because a shortest time alone leaves some of them undetermined.
    cost=lambda t, now: 1.0 + 1e-2 * ((now["drive"] / 1500.0) ** 2 + (now["servo"] / 3.0) ** 2),
    start={"x": -1.0, "y": 1.5, "heading": 0.0, "steer": 0.0, "speed": 0.0, "steer_rate": 0.0},
    end={"y": (-DEPTH, -HALF_WIDTH - 0.1), "heading": 0.0, "speed": 0.0, "steer_rate": 0.0},
    within={"speed": (-2.0, 2.0), "steer": (-0.6, 0.6), "heading": (-1.5, 1.5), "x": (-5.0, 12.0), "y": (-3.0, 4.0)},
    path=clearances,
)


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    guess = {
        "duration": 12.0,
        "x": [-1.0, GAP + 1.0, MIDDLE + 2.0, MIDDLE],
        "y": [1.5, 1.5, 0.0, -HALF_WIDTH - 0.2],
        "heading": [0.0, 0.0, 0.5, 0.0],
    }
    plan = col.solve(PROBLEM, guess, intervals=60, tolerance=1e-4)
    print(plan.report())
    assert plan.ok
    # The constraints hold at the nodes. Between them, and where the edges are blurred, they are violated a little.
    fine = plan.at(np.linspace(0.0, plan.duration, 2001))
    xs, ys = (np.array(each) for each in outline(fine["x"], fine["y"], fine["heading"], n=9))
    inside = np.asarray(ground(xs)) - ys
    print(f"{plan.duration:.3f} s; between the nodes the outline enters the other cars by at most {inside.max():.3f} m")
    assert inside.max() < 0.1
    turns = int(np.sum(np.diff(np.sign(fine["speed"][np.abs(fine["speed"]) > 0.02])) != 0))
    print(f"the car reverses its direction {turns} times")
    assert turns == 3
    draw(plan, fine, out / "park_a_car.png")


def draw(plan: col.Plan, fine, path: Path) -> None:
    figure, (above, below) = plt.subplots(2, 1, figsize=(9, 7.5), height_ratios=(2, 1), layout="constrained")
    for x0, x1 in ((-6.5, 0.0), (GAP, GAP + 6.5)):
        above.fill_between([x0, x1], -DEPTH, 0.0, color="0.8", lw=0)
    above.axhline(-DEPTH, color="0.4", lw=2)
    for k, i in enumerate(np.linspace(0, len(fine["x"]) - 1, 13).astype(int)):
        corners = outline(fine["x"][i], fine["y"][i], fine["heading"][i], n=2)
        order = [0, 1, 3, 2, 0]
        above.plot(*(np.array(c)[order] for c in corners), color=plt.get_cmap("viridis")(k / 12), lw=1.3)
    above.plot(fine["x"], fine["y"], "k--", lw=0.8, label="middle of the rear axle")
    above.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", xlim=(-5, 12), title=f"{plan.duration:.2f} s")
    above.legend(frameon=False)
    for name, unit in (("speed", "m/s"), ("steer", "rad"), ("heading", "rad")):
        below.plot(plan.t, plan[name], label=f"{name} [{unit}]")
    below.set(xlabel="time [s]")
    below.legend(frameon=False, ncols=3)
    figure.savefig(path, dpi=120)
    plt.close(figure)
    print(f"picture: {path}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the files (default: figures)")
    main(parser.parse_args().out)
