"""What is the effect of the choice of generalized speeds?

A spinning top on a ball joint is described twice: with body-fixed angular velocities as speeds and Euler parameters as
coordinates (Exercise 5.6, `jaxkane.catalog.SpinningTop`), and with 3-1-3 angles and their rates. The motion is the
same, but the equations, their cost and their singularities differ. Examples 3 and 4 of the book, which describe one
mechanism with two sets of speeds, are compared first.

    variable                     meaning                                             unit
    precession, nutation, spin   3-1-3 angles: about N.z, from N.z, about the axis   rad
    omega1, omega2, omega3       angular velocity along the top's own axes           rad/s

Run:      python examples/compare_generalized_speeds.py [--out FOLDER]
Appears:  a table: operations of one right-hand side, solver's steps, condition of the mass matrix, energy balance; and
          compare_generalized_speeds.png: the path of the axis, the difference between both descriptions, and the
          condition of both mass matrices as the axis passes near the vertical.
Takes:    half a minute.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxkane as jk
from jaxkane.catalog import CATALOG, SpinningTop

jax.config.update("jax_enable_x64", True)

GOLD, BLUE, INK = "#e8a33d", "#3d8fd1", "#2b2f36"


class TopWithAngles(SpinningTop):
    """The same top in other coordinates and speeds."""

    coordinates = ("precession", "nutation", "spin")
    speeds = ("precession_rate", "nutation_rate", "spin_rate")
    dependent_coordinates = ()
    units = dict.fromkeys(coordinates, "rad")

    def q_dot(self, t, q, u):
        return u

    def configuration_constraints(self, t, q):
        return ()

    def motion(self, t, q, u):
        N, O = jk.inertial()
        T = N.rotate_sequence("3-1-3", q, rates=u, name="T")
        G = O.fixed(self.distance * T.z)
        I = self.transverse_inertia
        return jk.Motion([jk.Body(self.mass, (I, I, self.axial_inertia), G, T, name="top")], frames={"T": T})


def main(folder: Path) -> None:
    compare_examples_3_and_4()

    # At a nutation of 0.5 rad, spinning, let go with a small precession: the axis draws loops. Both states are one.
    angles, rates = jnp.array([0.0, 0.5, 0.0]), jnp.array([-1.0, 0.0, 250.0])
    with_angles = TopWithAngles()
    T = frame(with_angles, angles, rates)
    half = 0.5 * angles[1]
    euler = jnp.stack([jnp.sin(half), 0.0 * half, 0.0 * half, jnp.cos(half)])
    omega = T.angular_velocity.to(T)
    tops = {
        "own axes, Euler parameters": (SpinningTop(), jk.State(euler, omega)),
        "3-1-3 angles and rates": (with_angles, jk.State(angles, rates)),
    }

    ts = jnp.linspace(0.0, 2.0, 2001)
    rows, paths, audits = [], {}, {}
    for name, (top, state) in tops.items():
        ride = jk.simulate(top, state, ts, rtol=1e-10, atol=1e-10)
        audits[name] = jk.audit(top, ride)
        paths[name] = np.asarray(jax.vmap(lambda q, u, top=top: axis(top, q, u))(ride.q, ride.u))
        condition = audits[name].condition_M
        rows.append(
            (name, operations(top, state), int(ride.stats["steps"]), condition.max(), audits[name].energy_balance)
        )
    print(f"{'the top':<28}{'operations':>12}{'steps':>8}{'condition of M':>16}{'energy balance':>16}")
    for name, n, steps, condition, balance in rows:
        print(f"{name:<28}{n:>12}{steps:>8}{condition:>16.1f}{balance:>16.1e}")
    print()
    print(audits["own axes, Euler parameters"])

    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "compare_generalized_speeds.png"
    draw(np.asarray(ts), paths, conditions_near_the_vertical(), path)
    print(f"picture: {path}")


def compare_examples_3_and_4() -> None:
    """One mechanism, two sets of speeds, one motion of its coordinates."""
    q, ts = jnp.array([0.5, 0.8]), jnp.linspace(0.0, 5.0, 51)
    rates, chosen = (CATALOG[name].example() for name in ("RotatingFrameAndBar", "RotatingFrameAndBarChosenSpeeds"))
    u = jnp.array([1.3, -0.9])
    v = jnp.array([rates.distance * u[0], u[1]])  # the mass centre's speed d phi_dot in the place of phi_dot
    one, two = (
        jk.simulate(system, jk.State(q, u), ts, rtol=1e-10, atol=1e-10) for system, u in ((rates, u), (chosen, v))
    )
    print(f"Examples 3 and 4: the angles differ by {np.abs(one.q - two.q).max():.0e} rad after 5 s")
    for label, system, speeds in (("3", rates, u), ("4", chosen, v)):
        M = np.asarray(jk.mass_matrix(system, 0.0, q, speeds))
        print(f"  Example {label}: {', '.join(system.speeds):<24} M = diag({M[0, 0]:.4f}, {M[1, 1]:.4f})")
    print()


def frame(top: SpinningTop, q: jax.Array, u: jax.Array) -> jk.Frame:
    return top.motion(0.0, q, u)["T"]


def axis(top: SpinningTop, q: jax.Array, u: jax.Array) -> jax.Array:
    """The top's axis (3,), a unit vector in N."""
    motion = top.motion(0.0, q, u)
    return motion["T"].z.to(motion.N)


def operations(top: SpinningTop, state: jk.State) -> int:
    """Scalar operations of one right-hand side, as XLA counts them."""
    f = jax.jit(lambda q, u: (jk.coordinate_rates(top, 0.0, q, u), jk.accelerations(top, 0.0, q, u)))
    return int(f.lower(state.q, state.u).compile().cost_analysis()["flops"])


def conditions_near_the_vertical() -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Condition of both mass matrices over the nutation angle [rad]."""
    nutation = np.logspace(-3, 0, 61)
    angles = jnp.stack([jnp.zeros(61), jnp.array(nutation), jnp.zeros(61)], axis=1)
    euler = jnp.stack([jnp.sin(angles[:, 1] / 2), angles[:, 0], angles[:, 0], jnp.cos(angles[:, 1] / 2)], axis=1)
    tops = {"own axes, Euler parameters": (SpinningTop(), euler), "3-1-3 angles and rates": (TopWithAngles(), angles)}
    M = {
        name: jax.vmap(lambda q, top=top: jk.mass_matrix(top, 0.0, q, jnp.zeros(3)))(q)
        for name, (top, q) in tops.items()
    }
    return nutation, {name: np.linalg.cond(np.asarray(m)) for name, m in M.items()}


def draw(t: np.ndarray, paths: dict[str, np.ndarray], conditions: tuple, path: Path) -> None:
    plt.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False})
    figure = plt.figure(figsize=(10.5, 5.0), layout="constrained")
    places = [["tip", "difference"], ["tip", "condition"]]
    tip, difference, condition = figure.subplot_mosaic(places, width_ratios=[1, 1.1]).values()
    one, two = paths.values()
    for name, points, style in zip(
        paths, (one, two), (dict(color=GOLD, lw=3.5), dict(color=BLUE, lw=1.0)), strict=True
    ):
        tip.plot(*points[:, :2].T, **style, label=name)
    tip.scatter(0, 0, s=30, color=INK)
    tip.set(aspect="equal", xlabel="x", ylabel="y", title="The tip of the axis, from above (unit sphere)")
    tip.legend(frameon=False, loc="upper left", bbox_to_anchor=(0.0, -0.12))
    difference.semilogy(t, np.maximum(np.linalg.norm(one - two, axis=1), 1e-17), color=INK, lw=1)
    difference.set(xlabel="time [s]", ylabel="difference of the axis", xlim=(0, t[-1]))
    nutation, values = conditions
    for (name, x), color in zip(values.items(), (GOLD, BLUE), strict=True):
        condition.loglog(np.rad2deg(nutation), x, color=color, label=name)
    condition.set(xlabel="angle from the vertical [deg]", ylabel="condition of M")
    condition.legend(frameon=False)
    for axes in (difference, condition):
        axes.grid(alpha=0.25)
    figure.align_ylabels([difference, condition])
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the picture (default: figures)")
    main(parser.parse_args().out)
