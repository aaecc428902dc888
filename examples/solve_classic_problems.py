"""Does direct collocation find the known solutions of classic optimal control problems?

Four problems are solved, and each cost is compared with a value from another source:

- brachistochrone: the curve of the fastest descent to a point 10 m ahead and 5 m below. The curve is a cycloid, whose
  time follows from one equation (`scipy.optimize.brentq`).
- quickest move: a block of 1 kg moves by 1 m with a force of at most 1 N and a speed of at most 0.5 m/s. The time is
  distance / speed + speed / acceleration = 2.5 s.
- crane: a load of a crane is moved by 2 m in 3 s and is at rest there, with the least integral of the squared
  acceleration. Pontryagin's equations are solved by `scipy.integrate.solve_bvp`.
- hypersensitive problem: x' = -x^3 + f in 10000 s, with the integral of x^2 + f^2 as the cost. Betts (2010), *Practical
  Methods for Optimal Control and Estimation Using Nonlinear Programming*, states the least cost 6.7241. The solution
  changes only near both ends, so the mesh must be refined there.

    variable               meaning                                              unit
    x, y, angle            place of the bead, slope of its path (downwards)     m, rad
    position, speed        of the block, or of the trolley of the crane         m, m/s
    sway                   angle of the load of the crane                       rad
    force, acceleration    the controls                                         N, m/s^2

Run:      python examples/solve_classic_problems.py [--out FOLDER]
Appears:  the cost of each problem beside its known value; solve_classic_problems.png.
Takes:    half a minute.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import scipy.integrate
import scipy.optimize

import jaxkane as jk
from jaxkane import collocation as col

jk.configure(verbose=False)

GRAVITY = 9.81  # [m/s^2]


class Bead(jk.System):
    """A bead without friction on a curve that is chosen while it slides: its slope is driven by a torque."""

    coordinates, speeds, inputs = ("x", "y", "angle"), ("speed", "angle_rate"), ("torque",)
    units = {"x": "m", "y": "m", "angle": "rad"}

    def q_dot(self, t, q, u):
        return u["speed"] * jnp.cos(q["angle"]), -u["speed"] * jnp.sin(q["angle"]), u["angle_rate"]

    def motion(self, t, q, u):
        N, O = jk.inertial()
        curve = N.rotate(3, -q["angle"], -u["angle_rate"])
        bead = O.moving(N.vector(q["x"], q["y"], 0.0), u["speed"] * curve.x)
        # The moment of inertia only makes the slope a smooth function of time.
        return jk.Motion([jk.Body(1.0, (0.0, 0.0, 1.0), bead, curve, name="bead")])

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -GRAVITY * motion.N.y), jk.Torque(inputs["torque"] * motion.N.z, motion["bead"])


class Block(jk.System):
    """A block on a smooth plane."""

    coordinates, speeds, inputs, units = ("position",), ("speed",), ("force",), {"position": "m"}

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(1.0, 0.0, O.moving(q["position"] * N.x, u["speed"] * N.x), name="block")])

    def loads(self, t, q, u, motion, inputs):
        return (jk.Force(inputs["force"] * motion.N.x, motion["block"]),)


class Crane(jk.System):
    """A trolley with a given acceleration, and a load on a rope of 1 m."""

    coordinates, speeds = ("position", "sway"), ("speed", "sway_rate")
    inputs, units = ("acceleration",), {"position": "m", "sway": "rad"}
    trolley: jk.Scalar = jk.parameter(1.0, unit="kg")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        hook = O.moving(q["position"] * N.x, u["speed"] * N.x)
        rope = N.rotate(3, q["sway"], u["sway_rate"])
        load = hook.fixed(-1.0 * rope.y)
        return jk.Motion([jk.Body(self.trolley, 0.0, hook, name="trolley"), jk.Body(1.0, 0.0, load, name="load")])

    def loads(self, t, q, u, motion, inputs):
        # Force on the trolley: its own mass, and the horizontal pull of the rope that belongs to this acceleration.
        sin, cos = jnp.sin(q["sway"]), jnp.cos(q["sway"])
        tension = u["sway_rate"] ** 2 + GRAVITY * cos - inputs["acceleration"] * sin
        force = self.trolley * inputs["acceleration"] - tension * sin
        return jk.weight(motion, -GRAVITY * motion.N.y), jk.Force(force * motion.N.x, motion["trolley"])


class Cubic(jk.System):
    """No mechanism, but one first-order state."""

    states, inputs = ("x",), ("f",)

    def state_rates(self, t, q, u, x, motion, now):
        return {"x": -(x["x"] ** 3) + now["f"]}


def brachistochrone() -> tuple[col.Plan, float]:
    problem = col.Problem(
        Bead(),
        (0.5, 5.0),
        controls=["torque"],
        # Along a cycloid the slope changes at a constant rate, so the torque is zero, and a small cost of the torque
        # does not change the solution. Without it, the torque oscillates from node to node: the mesh was refined to
        # 1280 intervals, and the local error remained 1e-3.
        cost=lambda t, now: 1e-4 * now["torque"] ** 2,
        final_cost=lambda t, now: t,
        start={"x": 0.0, "y": 0.0, "speed": 0.0},
        end={"x": 10.0, "y": -5.0},
        within={"angle": (-1.0, 1.6), "speed": (0.0, 30.0)},
    )
    guess = {"duration": 2.0, "angle": [1.4, -0.1], "speed": [0.0, 9.0]}
    # x = r (phi - sin phi), y = -r (1 - cos phi), time = sqrt(r / g) phi
    phi = scipy.optimize.brentq(lambda a: (a - np.sin(a)) / (1 - np.cos(a)) - 2.0, 0.1, 6.0)
    return col.solve(problem, guess, intervals=20), float(np.sqrt(5.0 / (1 - np.cos(phi)) / GRAVITY) * phi)


def quickest_move() -> tuple[col.Plan, float]:
    problem = col.Problem(
        Block(),
        (0.5, 10.0),
        controls={"force": (-1.0, 1.0)},
        final_cost=lambda t, now: t,
        path=lambda t, now: {"speed limit": 0.5 - now["speed"]},
        start={"position": 0.0, "speed": 0.0},
        end={"position": 1.0, "speed": 0.0},
    )
    # A control is continuous, so that each jump of the force takes one interval, which costs 0.00026 s here.
    return col.solve(problem, intervals=40, tolerance=None), 2.5


def crane() -> tuple[col.Plan, float]:
    start, end = (0.0, 0.0, 0.0, 0.0), (2.0, 0.0, 0.0, 0.0)
    names = (*Crane.coordinates, *Crane.speeds)
    problem = col.Problem(
        Crane(),
        3.0,
        controls=["acceleration"],
        cost=lambda t, now: now["acceleration"] ** 2,
        start=dict(zip(names, start, strict=True)),
        end=dict(zip(names, end, strict=True)),
    )

    # Hamiltonian a^2 + costate . rates; its minimum over a is at a = (costate_4 cos(sway) - costate_3) / 2.
    def rates(x, a):
        return jnp.array([x[2], x[3], a, -a * jnp.cos(x[1]) - GRAVITY * jnp.sin(x[1])])

    def both(z):
        x, costate = z[:4], z[4:8]
        a = (costate[3] * jnp.cos(x[1]) - costate[2]) / 2
        slope = jax.grad(lambda x: costate @ rates(x, a))(x)
        return jnp.concatenate([rates(x, a), -slope, a[None] ** 2])

    every = jax.jit(jax.vmap(both, in_axes=1, out_axes=1))
    times, guess = np.linspace(0.0, 3.0, 61), np.zeros((9, 61))
    guess[0] = np.linspace(0.0, 2.0, 61)
    exact = scipy.integrate.solve_bvp(
        lambda t, z: np.asarray(every(z)),
        lambda a, b: np.array([*(a[:4] - start), *(b[:4] - end), a[8]]),
        times, guess, tol=1e-8, max_nodes=20_000,
    )  # fmt: skip
    assert exact.success, exact.message
    return col.solve(problem, intervals=40), float(exact.y[8, -1])


def hypersensitive() -> tuple[col.Plan, float]:
    problem = col.Problem(
        Cubic(),
        10_000.0,
        controls=["f"],
        cost=lambda t, now: now["x"] ** 2 + now["f"] ** 2,
        start={"x": 1.0},
        end={"x": 1.5},
    )
    return col.solve(problem, intervals=40), 6.7241


def main(out: Path) -> None:
    problems = {
        "brachistochrone": (brachistochrone, 1e-5),
        "quickest move": (quickest_move, 2e-4),
        "crane": (crane, 1e-5),
        "hypersensitive problem": (hypersensitive, 5e-5),
    }
    plans = {}
    for name, (solved, most) in problems.items():
        plan, known = solved()
        print(f"{name}: cost {plan.cost:.6f}, known {known:.6f}, {len(plan.mesh) - 1} intervals; {plan.reason}")
        assert plan.ok, plan
        assert abs(plan.cost / known - 1) < most, (name, plan.cost, known)
        plans[name] = plan
    draw(plans, out / "solve_classic_problems.png")


def draw(plans: dict[str, col.Plan], path: Path) -> None:
    figure, axes = plt.subplots(2, 2, figsize=(10, 6.5), layout="constrained")
    for ax, (name, plan) in zip(axes.flat, plans.items(), strict=True):
        ax.set_title(f"{name}: {plan.cost:.5g}")
        ax.grid(color="0.9")
    bead, block, crane, cubic = plans.values()
    axes[0, 0].plot(bead["x"], bead["y"], ".-", markersize=3)
    axes[0, 0].set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    for ax, plan, names in (
        (axes[0, 1], block, ("position", "speed", "force")),
        (axes[1, 0], crane, ("position", "sway", "acceleration")),
    ):
        for name in names:
            ax.plot(plan.t, plan[name], label=f"{name} [{UNITS[name]}]")
        ax.set(xlabel="time [s]")
        ax.legend(frameon=False)
    ax = axes[1, 1]
    ax.plot(cubic.t, cubic["x"], ".-", label="x near the start")
    ax.plot(cubic.duration - cubic.t, cubic["x"], ".-", label="x near the end, backwards")
    ax.set(xlabel="time from the start, or to the end [s]", xlim=(0, 12))
    ax.legend(frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    plt.close(figure)
    print(f"picture: {path}")


UNITS = {"position": "m", "speed": "m/s", "force": "N", "sway": "rad", "acceleration": "m/s^2"}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the files (default: figures)")
    main(parser.parse_args().out)
