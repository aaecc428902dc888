"""Imported SymPy models, compared with the accelerations of SymPy. Without SymPy, the tests are skipped.

Figures: tests/data/sympy_kane_systems.json, which SymPy 1.14's KanesMethod computed; the models are those of its tests.
"""

import dataclasses
import json
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk

sm = pytest.importorskip("sympy")
import sympy.physics.mechanics as me  # noqa: E402

RTOL = 1e-12
FIGURES = json.loads((Path(__file__).parents[1] / "data" / "sympy_kane_systems.json").read_text())["systems"]


def spring_mass_damper():
    (q, u), (m, c, k) = me.dynamicsymbols("q u"), sm.symbols("m c k")
    N, P = me.ReferenceFrame("N"), me.Point("P")
    P.set_vel(N, u * N.x)
    mass = me.Particle("mass", P, m)
    return me.KanesMethod(N, [q], [u], [q.diff() - u], bodies=[mass], forcelist=[(P, (-k * q - c * u) * N.x)])


def rolling_disc_dependent():
    q, u, ua = me.dynamicsymbols("q:4"), me.dynamicsymbols("u:6"), me.dynamicsymbols("ua:3")
    r, m, g, I, J = sm.symbols("r m g I J")
    N = me.ReferenceFrame("N")
    A = N.orientnew("A", "Axis", [q[0], N.z])
    B = A.orientnew("B", "Axis", [q[1], A.x])
    C = B.orientnew("C", "Axis", [q[2], B.y])
    C.set_ang_vel(N, u[0] * B.x + u[1] * B.y + u[2] * B.z)
    P = me.Point("P")
    P.set_vel(N, ua[0] * A.x + ua[1] * A.y + ua[2] * A.z)
    O = P.locatenew("O", q[3] * A.z + r * sm.sin(q[1]) * A.y)
    O.set_vel(N, u[3] * A.x + u[4] * A.y + u[5] * A.z)
    turning = q[0].diff() * A.z + q[1].diff() * B.x + q[2].diff() * B.y - C.ang_vel_in(N)
    rising = O.pos_from(P).diff(me.dynamicsymbols._t, A) + A.ang_vel_in(N).cross(O.pos_from(P))
    rates = [*(turning.dot(x) for x in B), (rising - O.vel(N)).dot(A.z)]
    slip = O.vel(N) - (P.vel(N) + C.ang_vel_in(N).cross(O.pos_from(P)))
    disc = me.RigidBody("disc", O, C, m, (me.inertia(B, I, J, I), O))
    return me.KanesMethod(
        N,
        q[:3],
        u[:3],
        rates,
        q_dependent=[q[3]],
        configuration_constraints=[(-r * B.z).dot(A.z) - q[3]],
        u_dependent=u[3:],
        velocity_constraints=[slip.dot(x) for x in A],
        u_auxiliary=ua,
        bodies=[disc],
        forcelist=[(O, m * g * A.z)],
    )


def four_bar_linkage():
    """A System of joints, whose loop is closed by constraints."""
    l1, l2, l3, l4, rho = sm.symbols("l1:5 rho")
    q, u = me.dynamicsymbols("q1:4"), me.dynamicsymbols("u1:4")
    ground = link = me.RigidBody("ground")
    system = me.System.from_newtonian(ground)
    end = l1 / 2 * ground.x
    for i, l in enumerate((l2, l3, l4)):
        rod = me.RigidBody(f"link{i + 2}", mass=rho * l)
        rod.central_inertia = me.inertia(rod.frame, 0, rho * l**3 / 12, rho * l**3 / 12)
        pin = {"parent_point": end, "child_point": -l / 2 * rod.x, "joint_axis": link.z}
        system.add_joints(me.PinJoint(f"J{i}", link, rod, q[i], u[i], **pin))
        link, end = rod, l / 2 * rod.x
    gap = link.masscenter.pos_from(ground.masscenter) + end + l1 / 2 * ground.x
    system.q_ind, system.q_dep, system.u_ind, system.u_dep = [q[0]], q[1:], [u[0]], u[1:]
    system.add_holonomic_constraints(gap.dot(ground.x), gap.dot(ground.y))
    return system


def pendulum_on_cart():
    from sympy.physics.mechanics.models import n_link_pendulum_on_cart

    return n_link_pendulum_on_cart(3, True, True)  # its equations are formed already


MODELS = {
    "one_dof_spring_mass_damper": spring_mass_damper,
    "rolling_disc_dependent_q_u_aux": rolling_disc_dependent,
    "four_bar_linkage": four_bar_linkage,
    "n_link_pendulum_on_cart_n3": pendulum_on_cart,
}


def brought(model, **more):
    return jk.convert.from_sympy(MODELS[model](), FIGURES[model]["params"], **more)


@pytest.mark.slow_cases(all_but=["one_dof_spring_mass_damper"])
@pytest.mark.parametrize("name", MODELS)
def test_accelerations_of_an_imported_model_agree_with_sympy(name):
    system = brought(name)
    speeds = (*system.speeds, *system.dependent_speeds)
    for state in FIGURES[name]["states"]:
        at = [
            np.array([state[x][name] for name in names])
            for x, names in (("q", system.coordinates), ("u", system.speeds))
        ]
        found = jk.speed_rates(system, 0.0, *at, state["inputs"])
        expected = np.array([state["udot"][x] for x in speeds])
        np.testing.assert_allclose([found[x] for x in speeds], expected, rtol=RTOL, atol=RTOL * np.abs(expected).max())


@pytest.mark.slow
def test_an_imported_model_supports_the_functions_of_a_system():
    system = brought("n_link_pendulum_on_cart_n3", name="Cart")
    again = brought("n_link_pendulum_on_cart_n3", name="Cart")
    assert type(system) is type(again)  # one model, one class
    assert type(system).__name__ == "Cart"
    assert system.inputs == ("F", "T1", "T2", "T3")
    q, u = jnp.array([0.1, 0.2, 0.3, 0.4]), jnp.array([1.0, -1.0, 0.5, 0.2])
    alpha = lambda m: jk.accelerations(dataclasses.replace(system, m1=m), 0.0, q, u)[0]  # noqa: E731
    m = float(system.m1)
    slope = jax.jit(jax.grad(alpha))(m)
    np.testing.assert_allclose(slope, (alpha(m + 1e-5) - alpha(m - 1e-5)) / 2e-5, rtol=1e-6)


def double_pendulum():
    q1, q2, F = me.dynamicsymbols("q1 q2 F")
    m, l, g, k = sm.symbols("m l g k", positive=True)
    N, O = me.ReferenceFrame("N"), me.Point("O")
    O.set_vel(N, 0)
    A, B = (N.orientnew(name, "Axis", [q, N.z]) for name, q in (("A", q1), ("B", q2)))
    P, R = O.locatenew("P", l * A.x), None
    P.v2pt_theory(O, N, A)
    R = P.locatenew("R", l * B.x)
    R.v2pt_theory(P, N, B)
    bobs = [me.Particle("p", P, m), me.Particle("r", R, m)]
    bobs[0].potential_energy = -m * g * l * sm.cos(q1)
    bobs[1].potential_energy = -m * g * l * (sm.cos(q1) + sm.cos(q2)) + k * (q1 - q2) ** 2 / 2
    lagrangian = me.Lagrangian(N, *bobs)
    return me.LagrangesMethod(lagrangian, [q1, q2], forcelist=[(R, F * N.y)], bodies=bobs, frame=N), O


@pytest.mark.slow
def test_accelerations_of_a_lagrangian_with_bodies_agree_with_sympy():
    lagrange, O = double_pendulum()
    values = {"m": 1.2, "l": 0.7, "g": 9.81, "k": 2.0}
    system = jk.convert.from_sympy(lagrange, values, origin=O)
    assert system.speeds == ("q1_dot", "q2_dot")
    q, u = [0.3, 0.4], [0.5, 0.6]
    lagrange.form_lagranges_equations()
    at = dict(zip(lagrange._qdots, u)) | {me.dynamicsymbols("F"): 1.5}
    at |= {
        symbol: values[str(symbol)]
        for symbol in lagrange.mass_matrix.free_symbols | lagrange.forcing.free_symbols
        if str(symbol) in values
    }
    numbers = lambda x: np.array(me.msubs(x, at).subs(dict(zip(lagrange.q, q))), float)  # noqa: E731
    expected = np.linalg.solve(numbers(lagrange.mass_matrix), numbers(lagrange.forcing)[:, 0])
    np.testing.assert_allclose(jk.accelerations(system, 0.0, q, u, {"F": 1.5}), expected, rtol=RTOL)
    place = jk.positions(system, 0.0, q, u)["R"]
    np.testing.assert_allclose(place, [0.7 * (np.cos(0.3) + np.cos(0.4)), 0.7 * (np.sin(0.3) + np.sin(0.4)), 0.0])


def test_a_model_with_explicit_time_dependence():
    q, u, t = *me.dynamicsymbols("q u"), me.dynamicsymbols._t
    a, w = sm.symbols("a w")
    N, O = me.ReferenceFrame("N"), me.Point("O")
    O.set_vel(N, 0)
    P = O.locatenew("P", (q + a * sm.sin(w * t)) * N.x)
    P.set_vel(N, (u + a * w * sm.cos(w * t)) * N.x)
    kane = me.KanesMethod(N, [q], [u], [q.diff() - u], bodies=[me.Particle("P", P, 2.0)])
    system = jk.convert.from_sympy(kane, {a: 0.3, "w": 2.0}, origin=O)
    np.testing.assert_allclose(jk.accelerations(system, 0.4, [0.1], [0.2]), [0.3 * 4 * np.sin(0.8)], rtol=1e-13)


def pendulum_on_a_shaker():
    """A bar with J about its mass centre, whose pivot moves along N.x by z(t)."""
    q, u, z = me.dynamicsymbols("q u z")
    m, l, g, I, J = sm.symbols("m l g I J")
    N, O = me.ReferenceFrame("N"), me.Point("O")
    O.set_vel(N, 0)
    pivot = O.locatenew("pivot", z * N.x)
    pivot.set_vel(N, z.diff() * N.x)
    A = N.orientnew("A", "Axis", [q, N.z])
    A.set_ang_vel(N, u * N.z)
    P = pivot.locatenew("P", l * A.x)
    P.v2pt_theory(pivot, N, A)
    bar = me.RigidBody("bar", P, A, m, (me.inertia(A, I, I, J), P))
    kane = me.KanesMethod(N, [q], [u], [q.diff() - u], bodies=[bar], forcelist=[(P, m * g * N.x)])
    return kane, z, O


@pytest.mark.slow
def test_a_prescribed_motion_is_an_expression_or_a_function():
    """(J + m l^2) u_dot = -m g l sin(q) + m l sin(q) z_dot_dot. The moments I are not read and need no value."""
    kane, z, O = pendulum_on_a_shaker()
    values, t = {"m": 1.2, "l": 0.5, "g": 9.81, "J": 0.02}, me.dynamicsymbols._t
    w = sm.symbols("w")
    systems = [
        jk.convert.from_sympy(kane, values | {w: 3.0}, origin=O, prescribed={z: 0.1 * sm.sin(w * t)}),
        jk.convert.from_sympy(kane, values, origin=O, prescribed={"z": lambda t: 0.1 * jnp.sin(3.0 * t)}),
    ]
    force = 1.2 * 0.5 * np.sin(0.3) * (-0.9 * np.sin(1.2) - 9.81)
    for system in systems:
        found = jk.accelerations(system, 0.4, [0.3], [0.2])
        np.testing.assert_allclose(found, [force / (0.02 + 1.2 * 0.25)], rtol=RTOL)
        assert float(system.I) == 0.0
    place = jk.positions(systems[1], 0.4, [0.3], [0.2])["P"]
    np.testing.assert_allclose(place, [0.1 * np.sin(1.2) + 0.5 * np.cos(0.3), 0.5 * np.sin(0.3), 0.0], rtol=RTOL)
    for prescribed, error, words in (
        ({"y": t, z: t}, ValueError, r"contains y\(t\), which is not part"),
        ({"q": t, z: t}, ValueError, r"contains q\(t\), a coordinate"),
        ({w: t}, TypeError, "must name functions of time"),
        ({z: kane.q[0]}, TypeError, "must depend on time and constants"),
    ):
        with pytest.raises(error, match=words):
            jk.convert.from_sympy(kane, values, prescribed=prescribed)
    with pytest.raises(ValueError, match="no value for J, m"):
        jk.convert.from_sympy(kane, {"l": 0.5, "g": 9.81}, prescribed={z: t})


@pytest.mark.slow
def test_a_lagrangian_with_a_prescribed_motion():
    q, z = me.dynamicsymbols("q z")
    m, l, g = sm.symbols("m l g")
    velocity = z.diff() - l * sm.sin(q) * q.diff(), l * sm.cos(q) * q.diff()
    L = m * (velocity[0] ** 2 + velocity[1] ** 2) / 2 + m * g * (z + l * sm.cos(q))
    given = {"z": lambda t: 0.1 * jnp.sin(3.0 * t)}
    system = jk.convert.from_sympy(me.LagrangesMethod(L, [q]), {m: 1.2, l: 0.5, g: 9.81}, prescribed=given)
    expected = np.sin(0.3) / 0.5 * (-0.9 * np.sin(1.2) - 9.81)
    np.testing.assert_allclose(jk.accelerations(system, 0.4, [0.3], [0.2]), [expected], rtol=RTOL)


def test_missing_values_and_unknown_symbols_are_rejected():
    params = FIGURES["one_dof_spring_mass_damper"]["params"]
    kane = spring_mass_damper()
    for given, words in (({}, "no value for c, k, m"), (params | {"mass": 1.0}, "no symbol mass")):
        with pytest.raises(ValueError, match=words):
            jk.convert.from_sympy(kane, given)
    (q, u, f), m = me.dynamicsymbols("q u f"), sm.symbols("m")
    N, P = me.ReferenceFrame("N"), me.Point("P")
    bob = me.Particle("bob", P, m)
    make = lambda **more: me.KanesMethod(N, [q], [u], [q.diff() - u], **more)  # noqa: E731
    with pytest.raises(ValueError, match="has no bodies"):
        jk.convert.from_sympy(make(), {})
    with pytest.raises(ValueError, match="P has no velocity"):
        jk.convert.from_sympy(make(bodies=[bob]), {m: 1.0})
    P.set_vel(N, (u + f) * N.x)
    with pytest.raises(ValueError, match=r"f\(t\) in the motion"):
        jk.convert.from_sympy(make(bodies=[bob]), {m: 1.0})
    P.set_vel(N, (u + f.diff()) * N.x)
    with pytest.raises(ValueError, match=r"no kinematic equation of the model determines Derivative\(f\(t\), t\)"):
        jk.convert.from_sympy(make(bodies=[bob]), {m: 1.0})
    P.set_vel(N, u * N.x)
    taken = me.Particle("bob", P, sm.Symbol("speeds"))
    with pytest.raises(ValueError, match="speeds cannot be the name of a parameter"):
        jk.convert.from_sympy(make(bodies=[taken]), {"speeds": 1.0})
    with pytest.raises(TypeError, match="needs a KanesMethod"):
        jk.convert.from_sympy(q.diff() - u, {})


@pytest.mark.slow
def test_unsupported_sympy_functions_are_rejected():
    q, u, m = *me.dynamicsymbols("q u"), sm.symbols("m")
    N, P = me.ReferenceFrame("N"), me.Point("P")
    P.set_vel(N, u * N.x)
    make = lambda force: me.KanesMethod(  # noqa: E731
        N, [q], [u], [q.diff() - u], bodies=[me.Particle("p", P, m)], forcelist=[(P, force * N.x)]
    )
    force = sm.Piecewise((-q, sm.And(q > 1, u > 0)), (2 * q, sm.Or(q > 0, u > 5)), (0, True)) + sm.Max(q, u, 0)
    force += sm.Abs(-q) * sm.sign(u) + sm.atan2(q, u) / sm.sqrt(q) + q ** sm.Rational(3, 2) + 10**20 * q / u**2 + sm.pi
    system = jk.convert.from_sympy(make(force), {m: sm.Rational(3, 2)})
    expected = float(force.subs({q: 0.3, u: 0.2})) / 1.5
    np.testing.assert_allclose(jk.accelerations(system, 0.0, [0.3], [0.2]), [expected], rtol=1e-14)
    for bad, words in (
        (sm.gamma(q), "gamma is not supported"),
        (sm.Heaviside(q), "Heaviside is not supported"),
        (sm.Symbol("m", positive=True) * q, "two symbols named m"),
    ):
        with pytest.raises(ValueError, match=words):
            jk.convert.from_sympy(make(bad), {m: 1.0})


def test_the_error_without_sympy_states_the_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "sympy", None)
    with pytest.raises(ImportError, match="pip install sympy"):
        jk.convert.from_sympy(None, {})
