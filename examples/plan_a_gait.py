"""How does a walker with a motor at its hip walk on flat ground at the least cost of transport?

The walker is the compass gait of the catalogue on flat ground, with a torque between its legs. Each step loses energy
in the impact of the foot, and the motor must replace this energy. The step is one phase of the problem. Its end is
linked to its start by the impact and the exchange of the legs, so the gait is periodic. The time and the length of the
step are free. The cost of transport is the work of the motor (in both directions) divided by weight and distance. The
scuffing of the swing foot at mid-stance is ignored.

    variable                    meaning                                                        unit
    stance, swing               angle of each leg from the vertical, forwards                  rad
    hip_torque                  forwards on the swing leg, backwards on the stance leg         N m
    work                        of the motor since the start of the step                       J
    speed                       average of the gait                                            m/s

Run:      python examples/plan_a_gait.py [--out FOLDER]
Appears:  the cost of transport for several speeds; a simulation of a step with its impact; plan_a_gait.png.
Takes:    half a minute.
"""

import argparse
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxkane as jk
from jaxkane import collocation as col

jk.configure(verbose=False)

SPEEDS = (0.4, 0.45, 0.5, 0.55)  # [m/s]
SMALL = 1.0  # [W]: the size of the power is sqrt(power^2 + SMALL^2) - SMALL, which is smooth


class MotorWalker(jk.catalog.CompassGait):
    """The compass gait with a motor between its legs. The first-order state is the work of the motor."""

    inputs, states = ("hip_torque",), ("work",)

    def loads(self, t, q, u, motion, inputs):
        torque = jk.Torque(-inputs["hip_torque"] * motion.N.z, motion["swing leg"], reaction_on=motion["stance leg"])
        return super().loads(t, q, u, motion, inputs), torque

    def state_rates(self, t, q, u, x, motion, now):
        power = now["hip_torque"] * (u["swing_rate"] - u["stance_rate"])
        return {"work": jnp.sqrt(power**2 + SMALL**2) - SMALL}


WALKER = MotorWalker(slope=0.0)
WEIGHT = float((WALKER.hip_mass + 2 * WALKER.leg_mass) * WALKER.gravity)  # [N]
LEG = float(WALKER.shank + WALKER.thigh)  # [m]


def step_length(now):
    """The distance from the stance foot to the swing foot, if both are on the ground [m]."""
    return LEG * (jnp.sin(now["stance"]) - jnp.sin(now["swing"]))


def gait_at(speed: float) -> col.Phases:
    """The problem of one step at an average speed."""

    def next_step(last, first):
        after = last.after("heel_strike")
        names = ("stance", "swing", "stance_rate", "swing_rate")
        return {"heel_strike": last.event("heel_strike")} | {name: first[name] - after[name] for name in names}

    step = col.Problem(
        WALKER,
        (0.2, 1.5),
        controls={"hip_torque": (-60.0, 60.0)},
        # A small cost of the torque, because a cost of work alone leads to impulses.
        cost=lambda t, now: 1e-5 * now["hip_torque"] ** 2,
        final_cost=lambda t, now: now["work"] / (WEIGHT * step_length(now)),
        conditions=lambda first, last, duration: {"speed": step_length(last) / duration - speed},
        start={"foot": 0.0, "work": 0.0, "stance": (-0.6, -0.1)},
        end={"stance": (0.1, 0.6)},
        within={"swing": (-0.8, 0.8)},
    )
    return col.Phases([step], links=[next_step])


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    guess = {  # the shape of a passive step down a slope
        "duration": 0.7,
        "stance": [-0.2, -0.1, 0.0, 0.1, 0.2],
        "swing": [0.2, 0.1, -0.1, -0.25, -0.2],
        "stance_rate": [0.8, 0.6, 0.5, 0.6, 0.8],
        "swing_rate": [-0.3, -1.0, -1.0, -0.3, 0.3],
    }
    plans = col.continuation(gait_at, SPEEDS, [guess], intervals=40, tolerance=1e-4)
    for speed, plan in zip(SPEEDS, plans, strict=False):
        print(f"{speed:.2f} m/s: {described(plan)}")
        assert plan.ok, plan
    transports = [cost_of_transport(plan) for plan in plans]
    assert len(plans) == len(SPEEDS)
    assert np.all(np.diff(transports) > 0)  # faster gaits lose more energy in impacts

    # A simulation with the event and its impact: the state after the first step is that of its start.
    plan = plans[-1]
    step = plan.phases[0]
    ts = jnp.linspace(0.0, step.duration + 0.001, 101)
    ride = jk.simulate(step.system, step.state(0), ts, step.inputs, rtol=1e-9, atol=1e-9)
    print(ride)
    assert int(ride.jumps.count) == 1
    assert abs(float(ride.jumps.t[0]) - step.duration) < 1e-3
    np.testing.assert_allclose(ride.jumps.after.q[0, :2], step.q[0, :2], atol=1e-3)
    np.testing.assert_allclose(ride.jumps.after.u[0], step.u[0], atol=1e-2)
    draw(plans, out / "plan_a_gait.png")


def described(plan: col.Plan) -> str:
    step, transport = plan.phases[0], cost_of_transport(plan)
    length = 2 * LEG * np.sin(float(step["stance"][-1]))
    return f"cost of transport {transport:.4f}, step {length:.3f} m in {plan.duration:.3f} s; {plan.reason}"


def cost_of_transport(plan: col.Plan) -> float:
    return float(plan["work"][-1]) / (WEIGHT * 2 * LEG * float(np.sin(plan["stance"][-1])))


def draw(plans: list[col.Plan], path: Path) -> None:
    figure, (above, middle, right) = plt.subplots(1, 3, figsize=(13, 3.8), layout="constrained")
    step = plans[-1].phases[0]
    found = step.at(np.linspace(0.0, step.duration, 11))
    for k, (stance, swing) in enumerate(zip(found["stance"], found["swing"], strict=True)):
        hip = LEG * np.array([np.sin(stance), np.cos(stance)])
        toe = hip - LEG * np.array([np.sin(swing), np.cos(swing)])
        color = plt.get_cmap("viridis")(k / 10)
        above.plot([0.0, hip[0], toe[0]], [0.0, hip[1], toe[1]], "-", color=color, lw=1.2)
    above.axhline(0.0, color="0.6", lw=0.8, zorder=0)
    above.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=f"one step at {SPEEDS[-1]:g} m/s")
    for speed, plan in zip(SPEEDS, plans, strict=True):
        middle.plot(plan.t, plan["hip_torque"], label=f"{speed:g} m/s")
    middle.set(xlabel="time [s]", ylabel="hip torque [N m]")
    middle.legend(frameon=False)
    right.plot(SPEEDS, [cost_of_transport(plan) for plan in plans], "o-")
    right.set(xlabel="speed [m/s]", ylabel="cost of transport", ylim=(0, None))
    figure.savefig(path, dpi=120)
    plt.close(figure)
    print(f"picture: {path}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the files (default: figures)")
    main(parser.parse_args().out)
