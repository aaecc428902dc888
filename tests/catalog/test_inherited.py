"""Classes that inherit from the catalogue's add bodies, loads, coordinates and parameters in a few lines."""

import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane.catalog import CATALOG, WhippleBicycle, read_bicycle_file

RTOL = 1e-11


def with_passengers(kind, count=1):
    """Particles on rails of their own that touch nothing. Their coordinates are behind the others, their speeds before
    those that are dependent or auxiliary."""
    names = [f"extra{i}" for i in range(count)]

    class Extended(kind):
        coordinates = (*kind.coordinates, *names)
        speeds = (*kind.speeds, *(f"{name}_speed" for name in names))

        def q_dot(self, t, q, u):
            own = kind.q_dot(self, t, q, u)
            return (*tuple(own)[: len(kind.coordinates)], *(u[f"{name}_speed"] for name in names))

        def motion(self, t, q, u):
            motion = kind.motion(self, t, q, u)
            rails = {n: jk.Point.at(u[f"{n}_speed"] * motion.N.x, q[n] * motion.N.x) for n in names}
            return motion.extended([jk.Body(0.7, 0.0, P, name=f"passenger {n}") for n, P in rails.items()])

        def loads(self, t, q, u, motion, inputs):
            own = kind.loads(self, t, q, u, motion, inputs)
            return own, [jk.Force(2.1 * motion.N.x, motion[f"passenger {n}"]) for n in names]

    return Extended


def copied(kind, system):
    return kind(**{field: getattr(system, field) for field in vars(system)})


def flat(loads):
    return [each for x in loads for each in flat(x)] if isinstance(loads, (tuple, list)) else [loads]


def numbers(vectors):
    return [np.array(v.to(v.frame.root), float) for v in vectors]


@pytest.mark.parametrize("name", CATALOG)
def test_every_entry_can_be_extended_by_inheritance(name):
    """The original bodies, rates and constraints equal those of the entry at the same coordinates and speeds."""
    entry, rng = CATALOG[name], np.random.default_rng(0)
    system = entry.example()
    kind = type(system)
    extended = copied(with_passengers(kind), system)
    n = len(kind.speeds)
    u = [*entry.u, *rng.uniform(0.5, 1.0, len(kind.dependent_speeds) + len(kind.auxiliary_speeds))]
    inputs = {name: 0.1 * (i + 1) for i, name in enumerate(kind.inputs)}
    at, beside = (0.3, entry.q, u), (0.3, (*entry.q, 5.0), [*u[:n], 0.25, *u[n:]])
    here, there = system.motion(*at), extended.motion(*beside)
    for part in ("center", "angular_velocity"):
        old, new = ([getattr(b, part) for b in bodies] for bodies in (here.bodies, there.bodies[: len(here.bodies)]))
        if part == "center":
            old, new = ([p.velocity for p in points] for points in (old, new))
        np.testing.assert_allclose(numbers(new), numbers(old), rtol=1e-13, atol=1e-14)
    old = [float(x) for x in system.q_dot(*at)][: len(kind.coordinates)]
    np.testing.assert_allclose([float(x) for x in extended.q_dot(*beside)], [*old, 0.25], rtol=1e-13)
    np.testing.assert_allclose(
        np.array(there.constraints, float), np.array(here.constraints, float), rtol=1e-13, atol=1e-14
    )
    old, new = [
        np.array(s.configuration_constraints(0.3, q), float) for s, q in ((system, entry.q), (extended, beside[1]))
    ]
    np.testing.assert_allclose(new, old, atol=1e-13)
    P = there["passenger extra0"].center
    old, (new, _) = system.loads(*at, here, inputs), extended.loads(*beside, there, inputs)
    new = [load for load in flat(new) if getattr(load, "point", None) is not P]  # not its weight
    active = [np.array(numbers([load.vector for load in flat(loads)])).reshape(-1, 3) for loads in (new, old)]
    np.testing.assert_allclose(*active, rtol=1e-13, atol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, pytest.param(12, marks=pytest.mark.weekly)])
@pytest.mark.parametrize("name", ["WhippleBicycle", "BarWithPiston", "DoublePendulum"])
def test_independent_added_bodies_do_not_change_the_other_accelerations(name, count):
    """With dependent, auxiliary and independent speeds. With more than 12 speeds, LAPACK solves for them."""
    entry = CATALOG[name]
    system, q, u = entry.example(), jnp.array(entry.q), jnp.array(entry.u)
    extended, more = copied(with_passengers(type(system), count), system), jnp.ones(count)

    @jax.jit
    def rates_and_slopes(system, q, u):
        rates = lambda q, u: jk.accelerations(system, 0.0, q, u)[: len(entry.u)]  # noqa: E731
        slopes = jax.jvp(rates, (q, u), (jnp.ones_like(q), jnp.ones_like(u)))
        return *slopes, *jax.grad(lambda q, u: rates(q, u)[-1], argnums=(0, 1))(q, u)

    found = rates_and_slopes(extended, jnp.append(q, 5.0 * more), jnp.append(u, 0.25 * more))
    for new, old in zip(found, rates_and_slopes(system, q, u), strict=True):
        np.testing.assert_allclose(new[: len(old)], old, rtol=1e-10, atol=1e-10)
    assert float(jk.accelerations(extended, 0.0, [*entry.q, *5.0 * more], [*entry.u, *0.25 * more])[-1]) == (
        pytest.approx(3.0, rel=RTOL)
    )


class Loaded(WhippleBicycle):
    """A bicycle with a basket on its fork, and a parameter that has a default."""

    load: jk.Scalar = jk.parameter(3.0, positive=True, unit="kg")
    x_load: jk.Scalar = jk.parameter(0.8, unit="m")
    z_load: jk.Scalar = jk.parameter(-0.9, unit="m")

    def motion(self, t, q, u):
        motion = super().motion(t, q, u)
        fork = motion["fork"]
        H = fork.frame
        place = fork.center.fixed((self.x_load - self.xH) * H.x + (self.z_load - self.zH) * H.z)
        return motion.extended([jk.Body(self.load, 0.0, place, name="basket")])


def test_parameters_with_defaults_may_be_left_out(tmp_path):
    values = {name: float(x) for name, x in vars(WhippleBicycle.benchmark()).items()}
    del values["g"], values["steer_damping"]
    assert float(Loaded.from_parameters(values).load) == 3.0
    assert float(Loaded.from_parameters(values | {"load": 2.0, "IFzz": values["IFxx"]}).load) == 2.0
    path = tmp_path / "loaded.txt"
    path.write_text("\n".join(f"{name} = {x!r}" for name, x in (values | {"load": 1.5}).items()))
    assert float(Loaded.from_file(path).load) == 1.5
    assert read_bicycle_file(path)[0]["load"] == 1.5
    with pytest.raises(ValueError, match=r"Loaded: wrong parameters; missing: mB; unknown: ballast"):
        Loaded.from_parameters({name: x for name, x in values.items() if name != "mB"} | {"ballast": 1.0})


# What is added to a motion.


def test_a_motion_can_be_extended_by_parts_with_new_names():
    N, O = jk.inertial()
    A = N.rotate(3, 0.1, 0.2, "A")
    one = jk.Body(1.0, 0.0, O.fixed(1.0 * A.x), name="one")
    motion = jk.Motion([one], [0.5], points={"P": one.center}, frames={"A": A})
    B = A.rotate(1, 0.3, 0.4, "B")
    more = motion.extended(jk.Body(2.0, 0.0, O.fixed(2.0 * B.y), name="two"), 0.25, points={"Q": O}, frames={"B": B})
    assert [body.name for body in more.bodies] == ["one", "two"]
    assert more.constraints == (0.5, 0.25)
    assert (more["P"], more["Q"], more["A"], more["B"]) == (one.center, O, A, B)
    assert motion.constraints == (0.5,)
    assert len(motion.bodies) == 1
    with pytest.raises(ValueError, match="two parts have the name 'one'"):
        motion.extended([one])
    with pytest.raises(ValueError, match="a point with the name 'P' already exists"):
        motion.extended(points={"P": O})


ARM = jk.joints.mechanism(
    [jk.joints.Link("a", joints=jk.joints.hinge("q"), mass=2.0, center=(0.5, 0, 0))], gravity=(0, -10, 0)
)


class Rubbed(type(ARM)):
    """The arm with dry friction in its hinge, and a load at its end; a parameter of its own."""

    dry: jk.Scalar = jk.parameter(0.7, positive=True)

    def motion(self, t, q, u):
        motion = super().motion(t, q, u)
        arm = motion["a"]
        return motion.extended([jk.Body(3.0, 0.0, arm.center.fixed(0.5 * arm.frame.x), name="load")])

    def loads(self, t, q, u, motion, inputs):
        joint = motion.joints["q"].child_frame
        rubs = jk.loads.torsional_friction(joint, None, motion.N.z, self.dry, rate=1e-6)
        return super().loads(t, q, u, motion, inputs), rubs


@pytest.mark.parametrize(
    "copied", [lambda x: x, lambda x: pickle.loads(pickle.dumps(x)), lambda x: x.replace({"dry": 0.7})]
)
def test_a_mechanism_of_joints_can_be_inherited_from(copied):
    """About the hinge: 0.5 + 3 kg m^2; weights 2 * 0.5 + 3 kg m at 10 m/s^2, and 0.7 N m of friction."""
    rubbed = copied(Rubbed(**{name: getattr(ARM, name) for name in vars(ARM)}))
    assert type(rubbed) is Rubbed
    found = jk.accelerations(rubbed, 0.0, jnp.zeros(1), jnp.array([2.0]))
    assert float(found[0]) == pytest.approx(-(40.0 + 0.7) / 3.5, rel=1e-10)


def test_a_mechanism_parameter_without_default_is_required():
    with pytest.raises(TypeError, match=r"Mechanism: the parameter gravity.y is missing and has no default"):
        type(ARM)()


def test_extending_the_motion_of_a_mechanism_preserves_its_type_and_joints():
    arm = jk.joints.mechanism([jk.joints.Link("a", joints=jk.joints.hinge("q"), mass=1.0, center=(1, 0, 0))])
    motion = arm.motion(0.0, [0.3], [0.1])
    more = motion.extended([jk.Body(1.0, 0.0, motion["a"].center, name="two")])
    assert type(more) is type(motion)
    assert more.joints is motion.joints
