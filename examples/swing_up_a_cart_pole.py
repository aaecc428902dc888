"""With which force does a cart swing up its pole?

A pole hangs from a cart on a rail. After 2 s the cart must be 1 m ahead, with the pole upright and both at rest. The
force on the cart is at most 20 N, and the rail ends 2 m from the start. The cost is the integral of the squared force.
The numbers are those of Kelly (2017), *An introduction to trajectory optimization*, SIAM Review 59(4), section 6.

    variable           meaning                                                     unit
    position, speed    of the cart                                                 m, m/s
    angle, rate        of the pole, 0 if it hangs                                  rad, rad/s
    force              on the cart                                                 N

Run:      python examples/swing_up_a_cart_pole.py [--out FOLDER]
Appears:  the report of the plan; its simulation without and with feedback, with a pole that is 5 % longer than planned;
          swing_up_a_cart_pole.png: the motion and the force; swing_up_a_cart_pole.html: an animation.
Takes:    15 seconds.
"""

import argparse
import dataclasses
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxkane as jk
from jaxkane import collocation as col

jk.configure(verbose=False)


class CartPole(jk.System):
    """A cart on a rail, and a pole with a point mass at its end."""

    cart: jk.Scalar = jk.parameter(1.0, positive=True, unit="kg")
    bob: jk.Scalar = jk.parameter(0.3, positive=True, unit="kg")
    length: jk.Scalar = jk.parameter(0.5, positive=True, unit="m")

    coordinates, speeds, inputs = ("position", "angle"), ("speed", "rate"), ("force",)
    units = {"position": "m", "angle": "rad"}

    def motion(self, t, q, u):
        N, O = jk.inertial()
        pole = N.rotate(3, q["angle"], u["rate"], "pole")
        cart = O.moving(q["position"] * N.x, u["speed"] * N.x)
        bob = cart.fixed(-self.length * pole.y)
        return jk.Motion([jk.Body(self.cart, 0.0, cart, name="cart"), jk.Body(self.bob, 0.0, bob, pole, name="bob")])

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -9.81 * motion.N.y), jk.Force(inputs["force"] * motion.N.x, motion["cart"])


PROBLEM = col.Problem(
    CartPole(),
    2.0,
    controls={"force": (-20.0, 20.0)},
    cost=lambda t, now: now["force"] ** 2,
    start={"position": 0.0, "angle": 0.0, "speed": 0.0, "rate": 0.0},
    end={"position": 1.0, "angle": jnp.pi, "speed": 0.0, "rate": 0.0},
    within={"position": (-2.0, 2.0)},
)


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    plan = col.solve(PROBLEM, intervals=40)
    print(plan.report())
    assert plan.ok
    assert plan.deviation(plan.replay()) < 1e-3

    # The same force, if the pole is 5 % longer than planned. The feedback of the plan corrects the motion.
    longer = dataclasses.replace(plan, system=dataclasses.replace(plan.system, length=0.525))
    open_loop, closed_loop = longer.replay(), longer.replay(feedback=True)
    for name, found in (("without feedback", open_loop), ("with feedback", closed_loop)):
        print(f"pole 5 % longer, {name}: ends at {np.rad2deg(float(found['angle'][-1])):.1f} deg of 180")
    assert abs(float(closed_loop["angle"][-1]) - np.pi) < 0.1 < abs(float(open_loop["angle"][-1]) - np.pi)
    draw(plan, open_loop, closed_loop, out / "swing_up_a_cart_pole.png")
    ts = jnp.linspace(0.0, plan.duration, 101)
    page = jk.animate(plan.system, plan.replay(ts), title="Swing-up of a cart and its pole")
    print(f"pictures: {out / 'swing_up_a_cart_pole.png'}, {page.save(out / 'swing_up_a_cart_pole.html')}")


def draw(plan: col.Plan, open_loop, closed_loop, path: Path) -> None:
    figure, (above, left, right) = plt.subplots(1, 3, figsize=(13, 3.8), layout="constrained")
    found = plan.at(np.linspace(0.0, plan.duration, 21))
    length = float(plan.system.length)
    for k, (x, angle) in enumerate(zip(found["position"], found["angle"], strict=True)):
        color = plt.get_cmap("viridis")(k / 20)
        above.plot([x, x + length * np.sin(angle)], [0, -length * np.cos(angle)], "-", color=color, lw=1.2)
        above.plot(x + length * np.sin(angle), -length * np.cos(angle), "o", color=color, markersize=5)
    above.axhline(0.0, color="0.6", lw=0.8, zorder=0)
    above.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title="every 0.1 s, from dark to light")
    left.plot(plan.t, plan["force"], color="C1")
    left.set(xlabel="time [s]", ylabel="force [N]", title=f"cost {plan.cost:.3f} N$^2$ s")
    for ride, label in ((open_loop, "without feedback"), (closed_loop, "with feedback")):
        right.plot(ride.t, np.rad2deg(ride["angle"]), label=f"5 % longer, {label}")
    right.plot(plan.t, np.rad2deg(plan["angle"]), "k--", lw=1, label="plan")
    right.set(xlabel="time [s]", ylabel="angle [deg]", ylim=(-150.0, None))
    right.legend(frameon=False, loc="lower right")
    figure.savefig(path, dpi=120)
    plt.close(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the files (default: figures)")
    main(parser.parse_args().out)
