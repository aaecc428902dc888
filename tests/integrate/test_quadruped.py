"""A robot with four legs from a URDF: 18 speeds, and four feet with friction."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk

LEGS = {
    f"{x}{y}": (0.2 * a, 0.1 * b) for x, a in (("front_", 1), ("hind_", -1)) for y, b in (("left", 1), ("right", -1))
}
STANCE = {
    f"{leg}_{joint}": angle * (1 if leg.startswith("front") else -1)
    for leg in LEGS
    for joint, angle in (("hip", 0.0), ("thigh", 0.7), ("knee", -1.4))
}


def link(name, mass, center, moments):
    ixx, iyy, izz = moments
    return f"""<link name="{name}"><inertial><origin xyz="{center}"/><mass value="{mass}"/>
        <inertia ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="0" ixz="0" iyz="0"/></inertial></link>"""


def joint(name, parent, child, origin, axis):
    return f"""<joint name="{name}" type="continuous"><parent link="{parent}"/><child link="{child}"/>
        <origin xyz="{origin}"/><axis xyz="{axis}"/></joint>"""


def urdf():
    parts = [link("trunk", 1.2, "0.01 0 0", (0.006, 0.02, 0.025))]
    for leg, (x, y) in LEGS.items():
        names, side = [f"{leg}_{part}" for part in ("hip", "thigh", "knee")], 0.014 if y > 0 else -0.014
        parts += [
            link(f"{leg}_bracket", 0.15, "0 0 0", (4e-5, 4e-4, 4e-4)),
            link(f"{leg}_upper", 0.15, "0 0 -0.08", (4e-4, 4e-4, 3e-5)),
            link(f"{leg}_lower", 0.04, "0 0 -0.1", (1.5e-4, 1.5e-4, 3e-6)),
            joint(names[0], "trunk", f"{leg}_bracket", f"{x} {y} 0", "1 0 0"),
            joint(names[1], f"{leg}_bracket", f"{leg}_upper", f"0 {side} 0", "0 1 0"),
            joint(names[2], f"{leg}_upper", f"{leg}_lower", "0 0 -0.16", "0 1 0"),
            f'<link name="{leg}"/>',
            joint(f"{leg}_foot", f"{leg}_lower", leg, "0 0 -0.16", "0 0 1").replace("continuous", "fixed"),
        ]
    return f'<robot name="robot">{"".join(parts)}</robot>'


ROBOT = jk.convert.from_urdf(urdf(), floating=True)


class Standing(type(ROBOT)):
    """The robot with springs and dampers in its joints, which return its legs to the stance."""

    spring: jk.Scalar = jk.parameter(5.0)
    damper: jk.Scalar = jk.parameter(0.2)
    rubber: jk.Scalar = jk.parameter(0.7)

    def loads(self, t, q, u, motion, inputs):
        loads = [*super().loads(t, q, u, motion, inputs)]
        for name, rest in STANCE.items():
            torque, at = self.spring * (rest - q[name]) - self.damper * u[f"{name}_rate"], motion.joints[name]
            axis = at.parent_frame.vector(*((1.0, 0.0, 0.0) if name.endswith("hip") else (0.0, 1.0, 0.0)))
            loads += [jk.Torque(torque * axis, at.child_frame), jk.Torque(-torque * axis, at.parent_frame)]
        return loads

    def contacts(self, t, q, u, motion):
        return {leg: jk.Contact(motion[leg], motion.N.z, friction=self.rubber) for leg in LEGS}


class Pushed(Standing):
    """The same robot without contacts. Given forces act on its feet."""

    pushes: jax.Array = eqx.field(default_factory=lambda: jnp.zeros((4, 3)))
    contacts = jk.System.contacts

    def loads(self, t, q, u, motion, inputs):
        forces = [jk.Force(motion.N.vector(*self.pushes[i]), motion[leg]) for i, leg in enumerate(sorted(LEGS))]
        return [*super().loads(t, q, u, motion, inputs), *forces]


def of(kind, **more):
    return kind(**{field.name: getattr(ROBOT, field.name) for field in dataclasses.fields(ROBOT)}, **more)


LEVEL = jk.State({**STANCE, "root_z": 0.345, "root_e4": 1.0}, {})
# Its feet slide: one that sticks starts to slip, turns the direction of its slip and sticks again.
TILTED = jk.State(
    {**STANCE, "root_z": 0.37, "root_e1": np.sin(0.1), "root_e4": np.cos(0.1)}, {"root_vx": 0.3, "root_vy": 0.2}
)


def dropped(system, duration=2.0, n=2001, start=LEVEL, **options):
    return jk.simulate(system, start, jnp.linspace(0.0, duration, n), **options)


@pytest.mark.slow
def test_a_quadruped_falls_on_its_feet_and_comes_to_rest():
    system = of(Standing)
    ride = dropped(system)
    assert ride.ok
    assert all(np.all(ride.contacts[leg][-100:] == 2) for leg in LEGS)
    assert np.max(np.abs(ride.u[-1])) < 1e-4
    components = ("friction_1", "friction_2", "normal")
    forces = np.array([[ride[f"{leg}.{x}"][-1] for x in components] for leg in sorted(LEGS)])
    np.testing.assert_allclose(np.sum(forces, axis=0), [0.0, 0.0, 9.81 * (1.2 + 4 * 0.34)], atol=1e-4)
    u_dot = jk.accelerations(of(Pushed, pushes=jnp.asarray(forces)), 0.0, ride.q[-1], jnp.zeros(18))
    assert np.max(np.abs(u_dot)) < 1e-2  # in rad/s^2; 1 N at a foot causes 1e3
    assert jk.audit(system, ride).energy_balance < 1e-3


@pytest.mark.weekly
@pytest.mark.parametrize("start", [LEVEL, TILTED], ids=["level", "tilted"])
def test_derivatives_of_a_quadruped_that_falls_on_its_feet(start):
    def height(p, rtol=1e-9):
        system = of(Standing, spring=p[0], rubber=p[1]).replace({"mass.trunk": p[2]})
        return dropped(system, 0.6, 41, start, rtol=rtol, atol=rtol)["root_z"][jnp.array([20, 40])]

    p, h = jnp.array([5.0, 0.7, 1.2]), 1e-5
    slopes = jax.jacfwd(height)(p)
    for i in range(3):
        step = jnp.zeros(3).at[i].set(h)
        differences = (height(p + step, 1e-12) - height(p - step, 1e-12)) / (2 * h)
        np.testing.assert_allclose(slopes[:, i], differences, rtol=1e-5, atol=2e-9)


@pytest.mark.weekly
def test_a_quadruped_ends_where_that_of_mujoco_ends():
    mujoco = pytest.importorskip("mujoco")
    radius, scene = 1e-3, mujoco.MjSpec.from_string(urdf())
    scene.compiler.fusestatic = False
    scene = mujoco.MjSpec.from_string(scene.to_xml())
    scene.body("trunk").add_freejoint()
    for joint in scene.joints:
        if joint.name in STANCE:
            joint.stiffness, joint.damping, joint.springref = [5.0, 0.0, 0.0], [0.2, 0.0, 0.0], STANCE[joint.name]
    stiff = {"condim": 3, "friction": [0.7, 0.0, 0.0], "solref": [1e-4, 1.0], "solimp": [0.999, 0.9999, 1e-4, 0.5, 2.0]}
    for leg in LEGS:
        ball = {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [radius, 0, 0], "mass": 0.0}
        scene.body(leg).add_geom(**ball, contype=1, conaffinity=0, **stiff)
    floor = {"type": mujoco.mjtGeom.mjGEOM_PLANE, "size": [5, 5, 1], "pos": [0, 0, -radius]}
    scene.worldbody.add_geom(**floor, contype=0, conaffinity=1, **stiff)
    scene.option.timestep, scene.option.impratio = 1e-4, 100
    scene.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    model = scene.compile()
    data = mujoco.MjData(model)
    data.qpos[:7] = [0, 0, 0.345, 1, 0, 0, 0]
    for name, angle in STANCE.items():
        data.joint(name).qpos = angle
    while data.time < 3.0:
        mujoco.mj_step(model, data)
    ride = dropped(of(Standing), 3.0, 2)
    np.testing.assert_allclose(data.qpos[2], ride["root_z"][-1], atol=1e-4)  # [m]
    np.testing.assert_allclose(
        [data.joint(name).qpos[0] for name in STANCE], [ride[name][-1] for name in STANCE], atol=1e-3
    )


def test_limit_of_speeds_is_named():
    class Many(jk.System):
        coordinates = tuple(f"x{i}" for i in range(19))
        speeds = tuple(f"v{i}" for i in range(19))

        def motion(self, t, q, u):
            N, O = jk.inertial()
            return jk.Motion([jk.Body(1.0, 0.0, O.moving(a * N.x, b * N.x)) for a, b in zip(q, u, strict=True)])

        def contacts(self, t, q, u, motion):
            return {"stop": jk.Contact(gap=q[0])}

    with pytest.raises(ValueError, match="at most 18 speeds, or 12 with multipliers, and this one has 19"):
        jk.simulate(Many(), jk.State({}, {}), jnp.linspace(0.0, 1.0, 3))
