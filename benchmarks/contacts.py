"""First calls with contacts: how often longer than the first call of the bicycle, which has none.

Each call is the first one of a process, without a cache, and includes tracing and compilation. Figures are ratios of
CPU seconds, without imports. Systems of the catalogue start in their example states.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

import jaxkane as jk

from ._figures import Figure
from ._process import Setting, answer, configure

MOST = {  # `simulate` and `jacfwd`, in first calls of the bicycle
    "BouncingBall": (1.6, 3.0),
    "RockingBlock": (2.2, 4.0),
    "Woodpecker": (3.0, 5.0),
    "box on one corner": (3.0, 6.0),
    "box on four corners": (6.0, 10.0),
}


def measure(setting: Setting) -> Iterator[Figure]:
    chosen = dict([*MOST.items()][:1]) if setting.quick else MOST
    one = seconds("WhippleBicycle", "simulate")
    yield Figure("contacts", "first `simulate` of the bicycle, without contacts", one, "s", setting.column)
    for name, most in chosen.items():
        for call, at_most in zip(("simulate", "jacfwd"), most, strict=True):
            yield Figure("contacts", f"{name}: `{call}`", seconds(name, call) / one, "x", setting.column, at_most)


def seconds(name: str, call: str) -> float:
    """CPU seconds; the better of two."""
    return min(answer("benchmarks.contacts", [name, call])["seconds"] for _ in range(2))


class Box(jk.System):
    """A box of 1 kg. One or more of its corners have a contact with the floor, the lower ones first."""

    corners: int = eqx.field(static=True, default=1)
    coordinates, speeds = ("x", "y", "z", "a", "b", "c"), ("vx", "vy", "vz", "wx", "wy", "wz")

    def q_dot(self, t, q, u):
        return (*u["vx":"vz"], *jk.rotations.angle_rates("3-1-2", q["a":"c"], u["wx":"wz"]))

    def motion(self, t, q, u):
        N, O = jk.inertial()
        B = N.rotate_sequence("3-1-2", q["a":"c"], angular_velocity=u["wx":"wz"], name="B")
        G = O.moving(N.vector(*q["x":"z"]), N.vector(*u["vx":"vz"]))
        places = [(x, y, z) for z in (-0.1, 0.1) for x in (0.3, -0.3) for y in (0.2, -0.2)][: self.corners]
        points = {f"{i}": G.fixed(x * B.x + y * B.y + z * B.z) for i, (x, y, z) in enumerate(places)}
        return jk.Motion([jk.Body(1.0, (0.02, 0.03, 0.04), G, B, name="box")], points=points)

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -9.81 * motion.N.z)

    def contacts(self, t, q, u, motion):
        law = {"friction": 0.4, "restitution": 0.2}
        return {f"{i}": jk.Contact(motion[f"{i}"], motion.N.z, **law) for i in range(self.corners)}


def system_of(name: str) -> tuple[Any, Any]:
    """A system and its state at the start."""
    if name in jk.catalog.CATALOG:
        entry = jk.catalog.CATALOG[name]
        return entry.example(), jk.State(list(entry.q), list(entry.u))

    return Box(1 if "one" in name else 4), jk.State({"z": 0.2, "a": 0.2, "b": 0.1}, {"vx": 0.5})


def child(name: str, call: str) -> float:
    configure(Setting(native=True))
    system, state = system_of(name)
    state, ts = jk.assemble(system, state.q, state.u), jnp.linspace(0.0, 0.1 if name == "Woodpecker" else 1.0, 11)

    def end(q: Any) -> Any:
        return jk.simulate(system, jk.State(q, state.u), ts).end.q

    started = time.process_time()
    jax.block_until_ready((jax.jacfwd(end) if call == "jacfwd" else end)(state.q))
    return time.process_time() - started


if __name__ == "__main__":
    print(json.dumps({"seconds": child(*sys.argv[1:])}))
