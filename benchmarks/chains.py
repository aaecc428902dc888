"""Three-dimensional chains of n links: microseconds for each state of a batch, against engines made for such chains.

MuJoCo's rollout takes one step of its Euler integrator, Pinocchio's articulated-body algorithm is called from Python
for every state; MJX and JaxSim are batches of JAX's. Accelerations must agree to 1e-9 of the largest first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxkane as jk

from . import chain as chains
from ._bicycle import agree
from ._figures import Figure
from ._peers import here
from ._process import Setting
from ._timing import in_turns

# The time against an engine's: at most so many times, by XLA and by native kernels.
LINKS = {2: (1, 1), 5: (1, 1), 10: (1, 1), 20: (2, 1), 40: (3, 1)}
BATCH, CHECKED = 4096, 64
LARGEST_IN_JAX = 5  # with ten links a single batch of MJX's takes twenty seconds on a CPU


def measure(setting: Setting) -> Iterator[Figure]:
    for n, most in LINKS.items():
        if not setting.quick or n == 2:
            yield from measured(n, setting.pick(*most), setting)


def measured(n: int, most: float, setting: Setting) -> Iterator[Figure]:
    chain = chains.Chain(n=n)
    q, u = chains.states(n, CHECKED if setting.quick else BATCH)
    found, ours = by_jax(lambda q, u: jk.accelerations(chain, 0.0, q, u), q, u)
    rivals, counts = {"ours": ours}, {"ours": len(q)}
    few = slice(0, CHECKED)
    for name, start in _ENGINES.items():
        if here(name) and (n <= LARGEST_IN_JAX or name not in ("MJX", "JaxSim")):
            their, run, count = start(chain, q, u)
            agree(f"{name}, {n} links", found[few], their[few], 1e-9)
            rivals[name], counts[name] = run, count
    best = in_turns(rivals, 0.1 if setting.quick else 4.0)
    each = {name: 1e6 * best[name] / counts[name] for name in rivals}
    for name, microseconds in each.items():
        told = "jaxkane" if name == "ours" else name
        yield Figure("chains", f"{n} links, a state: {told}", microseconds, "us", setting.column)
    for name in ("MuJoCo", "Pinocchio"):
        if name in each:
            what = f"{n} links, batch of {len(q)}, time against {name}"
            yield Figure("chains", what, each["ours"] / each[name], column=setting.column, at_most=most)


Started = tuple[np.ndarray, Callable[[], Any], int]  # accelerations (b, n), what to time, its number of states


def by_jax(accelerations: Callable, q: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, Callable[[], Any]]:
    batch, q, u = jax.jit(jax.vmap(accelerations)), jnp.asarray(q), jnp.asarray(u)
    return np.asarray(batch(q, u)), lambda: batch(q, u).block_until_ready()


def mujoco(chain: chains.Chain, q: np.ndarray, u: np.ndarray) -> Started:
    import mujoco
    from mujoco import rollout

    model = mujoco.MjModel.from_xml_string(chains.mjcf(chain))
    data = mujoco.MjData(model)
    size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    states = np.zeros((len(q), size))
    states[:, 1 : 1 + 2 * chain.n] = np.concatenate([q, u], axis=-1)  # time first
    # What is compared is the accelerations of single states, as the rollout gives back positions and velocities only.
    few = slice(0, CHECKED)
    out = np.empty((len(q), 1, size))
    run = lambda: rollout.rollout(model, data, states, nstep=1, state=out)  # noqa: E731
    run()
    found = chains.accelerations_by_mujoco(chain, q[few], u[few])
    stepped = u[few] + model.opt.timestep * found
    agree("MuJoCo's rollout", out[few, 0, 1 + chain.n : 1 + 2 * chain.n], stepped, 1e-9)
    return found, run, len(q)


def pinocchio(chain: chains.Chain, q: np.ndarray, u: np.ndarray) -> Started:
    import pinocchio

    model = chains.pinocchio_model(chain)
    data, no_torque, aba = model.createData(), np.zeros(chain.n), pinocchio.aba
    pairs = list(zip(q, u))[:1024]

    def run():
        for q, u in pairs:
            aba(model, data, q, u, no_torque)

    return chains.accelerations_by_pinocchio(chain, q[:CHECKED], u[:CHECKED]), run, len(pairs)


def mjx(chain: chains.Chain, q: np.ndarray, u: np.ndarray) -> Started:
    import mujoco
    from mujoco import mjx

    model = mjx.put_model(mujoco.MjModel.from_xml_string(chains.mjcf(chain)))
    data = mjx.make_data(model)
    found, run = by_jax(lambda q, u: mjx.forward(model, data.replace(qpos=q, qvel=u)).qacc, q, u)
    return found, run, len(q)


def jaxsim(chain: chains.Chain, q: np.ndarray, u: np.ndarray) -> Started:
    import jaxsim.api as js

    model = js.model.JaxSimModel.build_from_model_description(chains.sdf(chain))
    data = js.data.JaxSimModelData.zero(model)
    order = [model.joint_names().index(name) for name in chain.coordinates]

    def accelerations(q, u):
        at = lambda x: jnp.zeros_like(x).at[jnp.asarray(order)].set(x)  # noqa: E731
        now = data.replace(model=model, joint_positions=at(q), joint_velocities=at(u))
        _, u_dot = js.model.forward_dynamics_aba(model, now)
        return u_dot[jnp.asarray(order)]

    found, run = by_jax(accelerations, q, u)
    return found, run, len(q)


_ENGINES = {"MuJoCo": mujoco, "Pinocchio": pinocchio, "MJX": mjx, "JaxSim": jaxsim}
