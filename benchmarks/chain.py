"""A three-dimensional chain of n equal links, described three times: for jaxkane, for MuJoCo and for Pinocchio.

The links hang along -z of their frames, one below the other, on revolute joints whose axes alternate between x and y:
n degrees of freedom. A link is a solid cylinder, so it has inertia about its own axis too.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import numpy as np

import jaxkane as jk

AXES = (1, 2)  # x, y, x, y ... from the ground down


class Chain(jk.System):
    """n cylinders on revolute joints, in gravity along -N.z.

    - Coordinates `q1` ... `qn`: angles of the joints; the chain hangs straight down at zero [rad].
    - Speeds `u1` ... `un`: their rates [rad/s].
    """

    n: int = eqx.field(static=True, default=5)
    mass: jk.Scalar = jk.parameter(0.3, positive=True)  # of each link [kg]
    length: jk.Scalar = jk.parameter(0.2, positive=True)  # of each link [m]
    radius: jk.Scalar = jk.parameter(0.02, positive=True)  # of each link [m]
    gravity: jk.Scalar = jk.parameter(9.81)  # [m/s^2]

    @property
    def coordinates(self):
        return tuple(f"q{i + 1}" for i in range(self.n))

    @property
    def speeds(self):
        return tuple(f"u{i + 1}" for i in range(self.n))

    @property
    def inertia(self):
        """Principal moments of a link about its mass centre [kg m^2]."""
        across = self.mass * (3 * self.radius**2 + self.length**2) / 12
        return across, across, self.mass * self.radius**2 / 2

    def motion(self, t, q, u):
        link, joint = jk.inertial()
        inertia, bodies = self.inertia, []
        for i in range(self.n):
            link = link.rotate(AXES[i % 2], q[i], u[i], f"L{i + 1}")
            center = joint.fixed(-0.5 * self.length * link.z)
            bodies.append(jk.Body(self.mass, inertia, center, link, name=f"link{i + 1}"))
            joint = joint.fixed(-self.length * link.z)
        return jk.Motion(bodies, points={"tip": joint})

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -self.gravity * motion.N.z)


def states(n: int, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Random q and u, each (count, n): angles of every joint up to half a turn, rates of some rad/s."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-np.pi, np.pi, (count, n)), rng.normal(0.0, 2.0, (count, n))


def mjcf(chain: Chain, timestep: float = 0.001) -> str:
    """The chain as MuJoCo's XML: no contacts, no damping, no limits, no armature.

    **Arguments:** `timestep` [s], of MuJoCo's own integrator.
    """
    length = float(chain.length)
    moments = " ".join(repr(float(I)) for I in chain.inertia)
    link = (
        '<body pos="0 0 {below!r}"><joint type="hinge" axis="{axis}"/>'
        '<inertial pos="0 0 {middle!r}" mass="{mass!r}" diaginertia="{moments}"/>'
    )
    bodies = "".join(
        link.format(
            below=-length if i else 0.0,
            axis=("1 0 0", "0 1 0")[i % 2],
            middle=-length / 2,
            mass=float(chain.mass),
            moments=moments,
        )
        for i in range(chain.n)
    )
    return (
        f'<mujoco><compiler angle="radian"/><option gravity="0 0 {-float(chain.gravity)!r}" timestep="{timestep!r}" '
        'integrator="Euler"><flag contact="disable" constraint="disable" eulerdamp="disable"/></option>'
        f"<worldbody>{bodies}{'</body>' * chain.n}</worldbody></mujoco>"
    )


def sdf(chain: Chain) -> str:
    """The chain as an SDF model, which JaxSim reads; its first link stands on the ground."""
    length, moments = float(chain.length), list(map(float, chain.inertia))
    inertial = (
        "<inertial><pose>0 0 {} 0 0 0</pose><mass>{!r}</mass><inertia><ixx>{!r}</ixx><iyy>{!r}</iyy><izz>{!r}</izz>"
        "<ixy>0</ixy><ixz>0</ixz><iyz>0</iyz></inertia></inertial>"
    )
    parts = [
        f'<link name="ground">{inertial.format(0.0, 1.0, 1.0, 1.0, 1.0)}</link>'
        '<joint name="fixed" type="fixed"><parent>world</parent><child>ground</child></joint>'
    ]
    for i in range(chain.n):
        parent, below = (f"link{i}", -length) if i else ("ground", 0.0)
        parts.append(
            f'<link name="link{i + 1}"><pose relative_to="{parent}">0 0 {below!r} 0 0 0</pose>'
            f"{inertial.format(-length / 2, float(chain.mass), *moments)}</link>"
            f'<joint name="q{i + 1}" type="revolute"><parent>{parent}</parent>'
            f"<child>link{i + 1}</child><axis><xyz>{('1 0 0', '0 1 0')[i % 2]}</xyz></axis></joint>"
        )
    return f'<sdf version="1.10"><model name="chain">{"".join(parts)}</model></sdf>'


def pinocchio_model(chain: Chain) -> Any:
    """The chain as a `pinocchio.Model`."""
    import pinocchio

    model = pinocchio.Model()
    model.gravity.linear = np.array([0.0, 0.0, -float(chain.gravity)])
    length = float(chain.length)
    link = pinocchio.Inertia(
        float(chain.mass), np.array([0.0, 0.0, -length / 2]), np.diag([float(I) for I in chain.inertia])
    )
    below = np.array([0.0, 0.0, -length])
    parent = 0
    for i in range(chain.n):
        joint = (pinocchio.JointModelRX, pinocchio.JointModelRY)[i % 2]()
        place = pinocchio.SE3(np.eye(3), below if i else np.zeros(3))
        parent = model.addJoint(parent, joint, place, f"q{i + 1}")
        model.appendBodyToJoint(parent, link, pinocchio.SE3.Identity())
    return model


def accelerations_by_jaxkane(chain: Chain, q: np.ndarray, u: np.ndarray) -> np.ndarray:
    """u_dot (b, n) of a batch of states."""
    return np.asarray(jax.jit(jax.vmap(lambda q, u: jk.accelerations(chain, 0.0, q, u)))(q, u))


def accelerations_by_mujoco(chain: Chain, q: np.ndarray, u: np.ndarray) -> np.ndarray:
    """u_dot (b, n) of a batch of states, one after the other."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(mjcf(chain))
    data = mujoco.MjData(model)
    out = np.empty_like(u)
    for i in range(len(q)):
        data.qpos[:], data.qvel[:] = q[i], u[i]
        mujoco.mj_forward(model, data)
        out[i] = data.qacc
    return out


def accelerations_by_pinocchio(chain: Chain, q: np.ndarray, u: np.ndarray) -> np.ndarray:
    """u_dot (b, n) of a batch of states by the articulated-body algorithm, one after the other."""
    import pinocchio

    model = pinocchio_model(chain)
    data, no_torque = model.createData(), np.zeros(chain.n)
    return np.stack([pinocchio.aba(model, data, *state, no_torque) for state in zip(q, u)])
