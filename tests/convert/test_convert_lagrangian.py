"""Lagrangians without bodies, compared with the accelerations from SymPy's mass matrix and forcing."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk

sm = pytest.importorskip("sympy")
import sympy.physics.mechanics as me  # noqa: E402

RTOL = 1e-12
VALUES = {"m": 1.2, "M": 2.3, "l": 0.7, "g": 9.81, "k": 40.0}
m, M, l, g, k = sm.symbols("m M l g k", positive=True)
x, y, r, a, b, F = me.dynamicsymbols("x y r a b F")
T = me.dynamicsymbols._t


def cart_with_pendulum():
    N, P = me.ReferenceFrame("N"), me.Point("P")
    P.set_vel(N, x.diff() * N.x)
    L = M * x.diff() ** 2 / 2 + m * (x.diff() ** 2 + 2 * l * sm.cos(a) * x.diff() * a.diff() + l**2 * a.diff() ** 2) / 2
    return me.LagrangesMethod(L + m * g * l * sm.cos(a), [x, a], forcelist=[(P, F * N.x)], frame=N)


def elastic_pendulum():
    L = m * (r.diff() ** 2 + r**2 * a.diff() ** 2) / 2 + m * g * r * sm.cos(a) - k * (r - l) ** 2 / 2
    return me.LagrangesMethod(L, [r, a])


def polar():
    """A particle in polar coordinates, from cartesian velocities, in a frame that turns at a rate that grows."""
    turned = a + T**2
    place = sm.Matrix([r * sm.cos(turned), r * sm.sin(turned)])
    return me.LagrangesMethod(m * place.diff(T).dot(place.diff(T)) / 2 - k * r**2 / 2, [r, a])


def double_pendulum():
    L = m * l**2 * (2 * a.diff() ** 2 + b.diff() ** 2 + 2 * sm.cos(a - b) * a.diff() * b.diff()) / 2
    return me.LagrangesMethod(L + m * g * l * (2 * sm.cos(a) + sm.cos(b)), [a, b])


def skate():
    """A knife edge: a holonomic and a nonholonomic constraint, and a coordinate that has no mass."""
    L = m * (x.diff() ** 2 + y.diff() ** 2) / 2 + m * l**2 * a.diff() ** 2 / 2 - m * g * y
    along = sm.sin(a) * x.diff() - sm.cos(a) * y.diff()
    return me.LagrangesMethod(L, [x, y, a, b], hol_coneqs=[b - a - x**2], nonhol_coneqs=[along])


MODELS = {
    "cart_with_pendulum": (cart_with_pendulum, ()),
    "elastic_pendulum": (elastic_pendulum, ()),
    "polar": (polar, ()),
    "double_pendulum": (double_pendulum, ()),
    "skate": (skate, ("b", "y")),
}


def brought(name):
    make, dependent = MODELS[name]
    lagrange = make()
    lagrange.form_lagranges_equations()
    symbols = {str(s) for s in (lagrange._L.free_symbols | lagrange.coneqs.free_symbols) - {T}}
    values = {s: value for s, value in VALUES.items() if s in symbols}
    return lagrange, values, jk.convert.from_sympy(lagrange, values, dependent=dependent, name="".join(name.title()))


def by_sympy(lagrange, values, t, q, u, inputs):
    """Accelerations of all coordinates and multipliers, of SymPy's full mass matrix and forcing."""
    at = dict(zip(lagrange._qdots, u)) | {me.dynamicsymbols(s): value for s, value in inputs.items()}
    numbers = dict(zip(lagrange.q, q)) | {s: values[str(s)] for s in (m, M, l, g, k) if str(s) in values} | {T: t}
    of = lambda e: np.array(me.msubs(e, at).subs(numbers).evalf(30), float)  # noqa: E731
    n = len(lagrange.q)
    found = np.linalg.solve(of(lagrange.mass_matrix_full), of(lagrange.forcing_full)[:, 0])
    return found[n : 2 * n], found[2 * n :]


def rates_of(lagrange, values, system, q, u):
    """All rates of the coordinates, in the model's order: the dependent ones meet SymPy's constraints."""
    names = [f"{c.func}_dot" for c in lagrange.q]
    given = [names.index(s) for s in system.speeds]
    every = np.zeros(len(names))
    every[given] = u
    if system.dependent_speeds:
        at = dict(zip(lagrange.q, q)) | {s: values[str(s)] for s in (m, M, l, g, k) if str(s) in values}
        A = np.array(me.msubs(lagrange.coneqs.jacobian(lagrange._qdots), at), float)
        free = [names.index(s) for s in system.dependent_speeds]
        every[free] = np.linalg.solve(A[:, free], -A[:, given] @ u)
    return every


@pytest.mark.weekly
@pytest.mark.parametrize("name", MODELS)
def test_accelerations_of_a_lagrangian_without_bodies_agree_with_sympy(name):
    lagrange, values, system = brought(name)
    q = np.linspace(0.4, 0.9, len(lagrange.q))
    u = np.linspace(0.5, -0.8, len(system.speeds))
    inputs = dict.fromkeys(system.inputs, 1.5)
    rates = rates_of(lagrange, values, system, q, u)
    expected, multipliers = by_sympy(lagrange, values, 0.3, q, rates, inputs)
    found = jk.speed_rates(system, 0.3, q, u, inputs)
    found = [found[f"{c.func}_dot"] for c in lagrange.q]
    np.testing.assert_allclose(found, expected, rtol=RTOL, atol=RTOL * np.abs(expected).max())
    if system.dependent_speeds:
        found = jk.constraint_multipliers(system, 0.3, q, u, inputs)
        np.testing.assert_allclose(found, multipliers, rtol=RTOL, atol=RTOL * np.abs(multipliers).max())
    with pytest.raises(ValueError, match="no constraint force has a name"):
        jk.constraint_forces(system, 0.3, q, u)
    assert jk.positions(system, 0.3, q, u) == {}  # a Lagrangian contains no positions


@pytest.mark.weekly
def test_the_kinetic_energy_is_half_u_M_u_and_energy_is_conserved():
    _, values, system = brought("elastic_pendulum")
    kinetic = values["m"] * (0.3**2 + 0.8**2 * 0.5**2) / 2
    np.testing.assert_allclose(jk.kinetic_energy(system, 0.0, [0.8, 0.4], [0.3, 0.5]), kinetic, rtol=1e-14)
    ride = jk.simulate(system, jk.State([0.8, 0.4], [0.3, 0.5]), jnp.linspace(0.0, 1.0, 101))
    audit = jk.audit(system, ride)
    assert np.abs(audit.energy_error).max() < 1e-6
    height = -ride.q[:, 0] * np.cos(ride.q[:, 1])
    total = np.array([jk.kinetic_energy(system, 0.0, q, u) for q, u in zip(ride.q[::50], ride.u[::50])])
    total += values["m"] * values["g"] * height[::50] + values["k"] * (ride.q[::50, 0] - values["l"]) ** 2 / 2
    np.testing.assert_allclose(total, total[0], rtol=1e-6)


@pytest.mark.slow
def test_an_imported_lagrangian_is_differentiable():
    _, _, system = brought("double_pendulum")
    q, u = jnp.array([0.3, -0.5]), jnp.array([0.6, 0.2])
    of = lambda l: jk.accelerations(dataclasses.replace(system, l=l), 0.0, q, u)  # noqa: E731
    slopes = [jax.jit(derivative(of))(0.7) for derivative in (jax.jacfwd, jax.jacrev)]
    step = 1e-5
    expected = (of(0.7 + step) - of(0.7 - step)) / (2 * step)
    for slope in slopes:
        np.testing.assert_allclose(slope, expected, rtol=1e-8)
    text = str(jax.make_jaxpr(lambda q, u: jk.accelerations(system, 0.0, q, u))(q, u))
    assert "dot_general" not in text  # scalars all the way, for the fused kernels
    assert "cholesky" not in text
    batch = jax.vmap(lambda q: jk.accelerations(system, 0.0, q, u))(jnp.zeros((0, 2)))
    assert batch.shape == (0, 2)


@pytest.mark.slow
def test_accelerations_are_nan_if_the_mass_matrix_is_not_positive_definite():
    L = m * x.diff() ** 2 / 2 + k * x.diff() * a.diff() + m * a.diff() ** 2 / 2 - g * x
    system = jk.convert.from_sympy(me.LagrangesMethod(L, [x, a]), {"m": 1.0, "k": 2.0, "g": 9.81})
    at = jnp.array([0.1, 0.2])
    assert np.isnan(jax.jit(lambda q: jk.accelerations(system, 0.0, q, 0.0 * q))(at)).all()
    with pytest.raises(ValueError, match="the mass matrix is not finite"):
        jk.accelerations(system, 0.0, at, 0.0 * at)


def test_incomplete_or_unsupported_lagrangians_are_rejected():
    kinetic = m * x.diff() ** 2 / 2
    N, P, f = me.ReferenceFrame("N"), me.Point("P"), me.dynamicsymbols("f")
    bring = lambda L, origin=None, **more: jk.convert.from_sympy(  # noqa: E731
        me.LagrangesMethod(L, [x], **more), {"m": 1.0}, origin=origin
    )
    with pytest.raises(ValueError, match="not a quadratic function of the rates"):
        bring(m * x.diff() ** 4)
    with pytest.raises(ValueError, match="positions from O are not available"):
        bring(kinetic, origin=me.Point("O"))
    loads = [(P, F * N.x)]
    with pytest.raises(ValueError, match=r"frame=N"):
        bring(kinetic, forcelist=loads)
    with pytest.raises(ValueError, match="P, at which a load acts, has no velocity"):
        bring(kinetic, forcelist=loads, frame=N)
    P.set_vel(N, me.dynamicsymbols("u") * N.x)
    with pytest.raises(ValueError, match=r"contains u\(t\), which is neither"):
        bring(kinetic, forcelist=loads, frame=N)
    with pytest.raises(TypeError, match="at a Point or on a ReferenceFrame"):
        bring(kinetic, forcelist=[(me.Particle("p", P, m), F * N.x)], frame=N)
    with pytest.raises(ValueError, match=r"no kinematic equation of the model determines Derivative\(f\(t\), t\)"):
        bring(kinetic * (2 + sm.sin(f)))
    with pytest.raises(ValueError, match=r"the Lagrangian contains Derivative\(x\(t\), \(t, 2\)\)"):
        bring(kinetic + x * x.diff(T, 2))
    with pytest.raises(ValueError, match="inertial frame of the bodies"):
        bring(kinetic, bodies=[me.Particle("p", P, m)])
