"""Systems with multipliers instead of dependent speeds: singular dependent speeds and redundant constraints."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxkane as jk


class Links(jk.System):
    """Four links of length 1 between two fixed points. The last two determine the others except where they are in
    line."""

    coordinates, dependent_coordinates = ("q0", "q1", "q2", "q3"), ("q2", "q3")
    speeds, dependent_speeds = ("u0", "u1"), ("u2", "u3")

    def motion(self, t, q, u):
        N, P = jk.inertial()
        bodies = []
        for i in range(4):
            A = N.rotate(3, q[i], u[i])
            bodies.append(jk.Body(1.0, (0.0, 0.0, 1 / 12), P.fixed(0.5 * A.x), A, name=f"link {i}"))
            P = P.fixed(1.0 * A.x)
        return jk.Motion(bodies, points={"end": P})

    def configuration_constraints(self, t, q):
        return [sum(jnp.cos(x) for x in q) - 2.8, sum(jnp.sin(x) for x in q)]

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -9.81 * motion.N.y)

    def outputs(self, t, q, u, motion, now):
        return {"fall": now.acceleration(motion["end"]).dot(motion.N.y)}


@functools.cache
def at_rest():
    """Coordinates (4,) of `Links` that satisfy the constraints."""
    return np.asarray(jk.assemble(Links(), [0.9, 0.3, -0.3, -0.9], None).q)


def by_scipy(duration):
    """Angles and rates at the end, with multipliers (index reduction by two differentiations)."""
    i = np.arange(4)
    w = 3 - np.maximum.outer(i, i) + 0.5 * (i[:, None] != i) + (1 / 12 + 1 / 4) * (i[:, None] == i)

    def rates(t, y):
        q, v = y[:4], y[4:]
        c, s = np.cos(q), np.sin(q)
        M, h = w * np.cos(q[:, None] - q), w * np.sin(q[:, None] - q) @ v**2
        C, drift = np.stack([-s, c]), np.array([-(c * v) @ v, -(s * v) @ v])
        K = np.block([[M, -C.T], [C, np.zeros((2, 2))]])
        return np.r_[v, np.linalg.solve(K, np.r_[-h - 9.81 * (3.5 - i) * c, -drift])[:4]]

    return solve_ivp(rates, (0, duration), [*at_rest(), 0, 0, 0, 0], method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]


def swing(ts, **options):
    system = jk.with_multipliers(Links())
    state = jk.State(jnp.asarray(at_rest()), jnp.zeros(4))
    return jk.simulate(system, state, ts, rtol=1e-12, atol=1e-12, max_steps=100_000, **options)


@pytest.mark.weekly
def test_with_multipliers_passes_singular_dependent_speeds():
    ts = jnp.linspace(0.0, 2.0, 21)
    assert jk.simulate(Links(), jk.assemble(Links(), at_rest(), None), ts).reason == "singular speeds"
    ride = swing(ts)
    assert ride.ok
    np.testing.assert_allclose([*ride.q[-1], *ride.u[-1]], by_scipy(2.0), atol=1e-8)
    audit = jk.audit(jk.with_multipliers(Links()), ride)
    assert audit.energy_balance < 1e-9
    assert np.abs(audit.configuration_residuals).max() < 1e-9
    # the end point is fixed
    np.testing.assert_allclose(ride["fall"], 0.0, atol=1e-9)


@pytest.mark.weekly
def test_energy_and_constraints_hold_for_thirty_seconds():
    audit = jk.audit(jk.with_multipliers(Links()), swing(jnp.linspace(0.0, 30.0, 601), stabilize=10.0))
    assert audit.reason == "completed"
    assert audit.energy_balance < 1e-8
    assert np.abs(audit.configuration_residuals).max() < 1e-8


class Parallelogram(jk.System):
    """Three rockers that hang from points of the ground and carry one bar: four constraints, of which three are
    independent."""

    coordinates, speeds = ("a", "b", "c", "bar"), ("a_dot", "b_dot", "c_dot", "bar_dot")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(1.0, (0.0, 0.0, 1 / 12), O, N.rotate(3, q[i], u[i])) for i in range(4)])

    def configuration_constraints(self, t, q):
        residuals = []
        for name, x in (("b", 1.0), ("c", 2.0)):
            residuals += [
                jnp.sin(q["a"]) + x * jnp.cos(q["bar"]) - x - jnp.sin(q[name]),
                x * jnp.sin(q["bar"]) + jnp.cos(q[name]) - jnp.cos(q["a"]),
            ]
        return residuals


class Struck(Links):
    """Four links, of which the first is struck or slowed when it passes an angle."""

    kind: str = eqx.field(static=True, default="impact")

    def events(self, t, q, u):
        new = {"impact": jk.Impact(u["u0"] - 2.0 * u["u1"], restitution=0.5), "slower": {"u0": 0.5 * u["u0"]}}
        return {"strike": jk.falling(q["q0"] - 0.85, then=new[self.kind])}


def moving_links():
    """The system, and its state with and without multipliers."""
    state = jk.assemble(Struck(), at_rest(), {"u0": -0.5, "u1": 0.3})
    u_dep = jk.dependent_speeds(Struck(), 0.0, state.q, state.u)
    return state, jk.State(state.q, jnp.concatenate([state.u, u_dep]))


def test_an_impact_satisfies_the_constraints_of_a_system_with_multipliers():
    own, state = moving_links()

    def strike(t, q, u, motion):
        return u["u0"] - 2.0 * u["u1"]

    wanted = jk.impact(Struck(), 0.0, own.q, own.u, strike, 0.5)
    found = jk.impact(jk.with_multipliers(Struck()), 0.0, state.q, state.u, strike, 0.5)
    u_dep = jk.dependent_speeds(Struck(), 0.0, own.q, wanted.u)
    np.testing.assert_allclose(found.u, [*wanted.u, *u_dep], rtol=1e-10)
    np.testing.assert_allclose(found.impulses, wanted.impulses, rtol=1e-10)
    np.testing.assert_allclose(found.energy_lost, wanted.energy_lost, rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["impact", "slower"])
def test_jumps_with_multipliers_agree_with_those_of_dependent_speeds(kind):
    own, state = moving_links()
    ts = jnp.linspace(0.0, 0.2, 3)
    wanted = jk.simulate(Struck(kind=kind), own, ts, rtol=1e-10, atol=1e-10)
    found = jk.simulate(jk.with_multipliers(Struck(kind=kind)), state, ts, rtol=1e-10, atol=1e-10)
    assert int(wanted.jumps.count) == int(found.jumps.count) > 0
    np.testing.assert_allclose(found.q, wanted.q, atol=1e-8)
    np.testing.assert_allclose(found.jumps.energy[0], wanted.jumps.energy[0], rtol=1e-7)


def test_assemble_keeps_named_speeds_of_systems_with_multipliers():
    system, q = jk.with_multipliers(Links()), at_rest()
    C = np.stack([np.sin(q), np.cos(q)])
    u = np.asarray(jk.assemble(system, q, {"u1": 0.5}).u)
    assert u[1] == pytest.approx(0.5, rel=1e-14)
    np.testing.assert_allclose(C @ u, 0.0, atol=1e-14)
    u = jk.assemble(system, q, {"u0": 2.0, "u1": 0.5}).u
    np.testing.assert_allclose(u[2:], -np.linalg.solve(C[:, 2:], C[:, :2] @ [2.0, 0.5]), rtol=1e-12)
    with pytest.raises(ValueError, match=r"no speeds satisfy .* with u0 = 2, u1 = 0\.5, u2 = 9\. Omit the speeds"):
        jk.assemble(system, q, {"u0": 2.0, "u1": 0.5, "u2": 9.0})
    with pytest.raises(ValueError, match="u omits u1, u2, u3, which the others determine"):
        jk.simulate(system, jk.State(q, {"u0": 2.0}), [0.0, 1.0])


class WithMasslessPointer(jk.System):
    """A block moves a massless pointer, which a constraint turns by the same number."""

    coordinates, dependent_coordinates = ("x", "angle"), ("angle",)
    speeds, dependent_speeds = ("x_dot",), ("rate",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        block = O.moving(q["x"] * N.x, u["x_dot"] * N.x)
        pointer = N.rotate(3, q["angle"], u["rate"])
        return jk.Motion([jk.Body(2.0, (0.1, 0.1, 0.1), block, N), jk.Body(0.0, (0.0, 0.0, 0.0), block, pointer)])

    def configuration_constraints(self, t, q):
        return [q["angle"] - q["x"]]

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, 3.0 * motion.N.x)


@pytest.mark.slow
def test_massless_bodies_may_be_moved_by_constraints_with_multipliers():
    system = jk.with_multipliers(WithMasslessPointer())
    state = jk.assemble(system, {"x": 0.3}, {"x_dot": 2.0})
    np.testing.assert_allclose(state.u, [2.0, 2.0], rtol=1e-14)
    ride = jk.simulate(system, state, [0.0, 1.0])
    np.testing.assert_allclose(ride.q[-1], 0.3 + 2.0 + 0.5 * 3.0, rtol=1e-8)


@pytest.mark.slow
def test_assembled_configurations_with_multipliers_depend_on_named_coordinates():
    system = jk.with_multipliers(Parallelogram())
    q, slopes = jax.jvp(lambda a: jk.assemble(system, {"a": a}).q, (0.5,), (1.0,))
    np.testing.assert_allclose(q, [0.5, 0.5, 0.5, 0.0], atol=1e-12)
    np.testing.assert_allclose(slopes, [1.0, 1.0, 1.0, 0.0], atol=1e-10)
    with pytest.raises(ValueError, match="no coordinate may be changed"):
        jk.assemble(system, {"a": 0.5, "b": 0.4, "c": 0.5, "bar": 0.0})


def test_assemble_tries_other_guesses():
    """From q2 = q3 = 0.3, Newton's method diverges."""
    for system in (Links(), jk.with_multipliers(Links())):
        q = np.asarray(jk.assemble(system, [0.9, 0.3, 0.3, 0.3]).q)
        assert q[:2].tolist() == [0.9, 0.3]
        np.testing.assert_allclose([np.cos(q).sum(), np.sin(q).sum()], [2.8, 0.0], atol=1e-9)


def test_with_multipliers_rejects_unsupported_uses():
    system = jk.with_multipliers(Links())
    with pytest.raises(ValueError, match="`release` is not supported for a system with multipliers"):
        jk.impact(system, 0.0, at_rest(), np.zeros(4), lambda t, q, u, motion: u["u0"], release=("end",))
    assert jk.with_multipliers(system) is system
    with pytest.raises(TypeError, match="must be an instance of a System"):
        jk.with_multipliers(Links)
    with pytest.raises(ValueError, match="satisfies the configuration constraints"):
        jk.assemble(system, [0.1, 0.1, 0.1, 0.1], None, free=("q3",))
    with pytest.raises(ValueError, match="has multipliers"):
        jk.accelerations(system, 0.0, at_rest(), np.zeros(4))


@pytest.mark.weekly
def test_other_independent_speeds_preserve_contacts_and_state_events():
    class Crank(Links):
        states = ("turns",)

        def state_rates(self, t, q, u, x, motion, now):
            return u["u0"] / (2 * jnp.pi)

        def events(self, t, q, u, x):
            return {"turned": jk.falling(x["turns"] + 0.05)}

        def contacts(self, t, q, u, motion):
            return {"stop": jk.Contact(gap=q["q0"] - 0.8)}

    own = jk.assemble(Crank(), [*at_rest()[:2].tolist(), -0.3, -0.9], None)
    others = [jk.with_multipliers(Crank()), jk.stability.with_speeds(Crank(), ("u0", "u2"))]
    ts = jnp.linspace(0.0, 0.3, 4)
    wanted = jk.simulate(Crank(), own, ts)
    assert int(wanted.jumps.count) > 0
    for system in others:
        state = jk.State(own.q, jnp.zeros(len(system.speeds)), own.x)
        ride = jk.simulate(system, state, ts)
        np.testing.assert_allclose(ride.q, wanted.q, atol=1e-6)
        assert ride.contacts["stop"].tolist() == wanted.contacts["stop"].tolist()
        assert ride.reason == wanted.reason
