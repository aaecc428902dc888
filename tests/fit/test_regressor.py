"""The equations of motion as a matrix times the bodies' parameters."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from swings import (
    FRICTION,
    Sledge,
    Sprung,
    Swing,
    SwingByHand,
    SwingElsewhere,
    SwingInAField,
    SwingOfNumbers,
    random_samples,
    swings,
)

import jaxkane as jk
from jaxkane.catalog import CATALOG
from jaxkane.fit import base_parameters, regressor


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["DoublePendulum", "SliderWithPinnedBar", pytest.param("ColumnFrameAndDisk", marks=pytest.mark.weekly)]
)
def test_matrix_times_parameters_equals_kanes_equations(name):
    """At any accelerations; `ColumnFrameAndDisk` has a body that spins in its frame."""
    tolerance = 1e-12
    entry = CATALOG[name]
    system, rng = entry.example(), np.random.default_rng(0)
    u_dot = rng.normal(size=len(system.speeds))
    at = (0.0, jnp.array(entry.q), jnp.array(entry.u))
    inputs = {name: 0.3 + 0.1 * i for i, name in enumerate(system.inputs)}
    found = regressor(system, *at, u_dot, inputs)
    F = jk.generalized_active_forces(system, *at, inputs)
    F_star = jk.generalized_inertia_forces(system, *at, inputs, u_dot=u_dot)
    np.testing.assert_allclose(found.matrix @ found.values - found.forces, -(F + F_star), atol=tolerance)


@pytest.mark.slow_cases("XLA")
def test_the_matrix_does_not_depend_on_unknown_parameters(kernels):
    """Y of a guess, times the true parameters, gives the forces that act on the true system."""
    tolerance = 1e-12
    truth, at = swings()
    i = (0.0, at.q[3], at.u[3], at.u_dot[3], {"torque1": at.inputs["torque1"][3]})
    true, guessed = (regressor(system, *i, parameters=FRICTION) for system in (truth, Swing()))
    np.testing.assert_allclose(guessed.matrix, true.matrix, atol=tolerance)
    np.testing.assert_allclose(guessed.matrix @ true.values, [at.inputs["torque1"][3], 0.0], atol=tolerance)
    np.testing.assert_allclose(guessed.forces, true.forces, atol=tolerance)
    assert guessed.names[0] == "link1.m"
    assert guessed.names[-2:] == FRICTION
    assert guessed.matrix.shape == (2, 22)
    assert dict(guessed.about) == {"link1": "O", "link2": "P"}
    assert guessed.units[:5] == ("kg", "kg m", "kg m", "kg m", "kg m^2")
    assert guessed.units[-1] == "N m s/rad"


@pytest.mark.weekly
def test_weights_coded_by_hand_are_detected_or_rejected():
    _truth, at = swings()
    i = (0.0, at.q[3], at.u[3], at.u_dot[3])
    same = [regressor(kind(), *i).matrix for kind in (Swing, SwingByHand)]
    np.testing.assert_allclose(*same, atol=1e-14)
    with pytest.raises(ValueError, match=r"m2 changes the parameters of a body.*jk\.weight"):
        regressor(SwingElsewhere(), *i)
    with pytest.raises(ValueError, match=r"no weight was found for link2, whose mass is a constant in the code"):
        regressor(SwingOfNumbers(), *i)
    regressor(SwingElsewhere(), *i, bodies="link1")  # then the other's weight is known, as it is


@pytest.mark.slow
def test_dependent_speeds():
    """Of a knife edge: Izz, the first moment along the edge, and the mass; none of what is across."""
    tolerance = 1e-11
    truth = Sledge(m=3.0, a=-0.2, I=0.7)
    at = random_samples(truth, 20)
    found = base_parameters(Sledge(), at, sigma={"x_dot": 1e-9, "yaw_rate": 1e-9})
    assert {"sledge.mz", "sledge.Ixx"} <= set(found.without_influence)
    named = dict(zip([found.names[i] for i in found.places], found.estimates, strict=True))
    assert set(named) == {"sledge.m", "sledge.mx", "sledge.my", "sledge.Izz"}
    expected = {"sledge.m": 3.0, "sledge.mx": -0.6, "sledge.my": 0.0, "sledge.Izz": 0.7 + 3.0 * 0.04}
    assert named == pytest.approx(expected, abs=tolerance)


@pytest.mark.weekly
def test_regressor_in_batches_derivatives_and_jit():
    tolerance = 1e-10
    truth, at = swings()
    here = lambda q, u, u_dot: regressor(truth, 0.0, q, u, u_dot, parameters=FRICTION)  # noqa: E731
    rows = jax.jit(jax.vmap(here))(*(jnp.asarray(x[:3]) for x in (at.q, at.u, at.u_dot)))
    assert rows.matrix.shape == (3, 2, 22)
    assert rows.values.shape == (3, 22)
    np.testing.assert_allclose(rows.matrix[1], here(at.q[1], at.u[1], at.u_dot[1]).matrix, atol=1e-13)
    along = lambda q: here(q, at.u[0], at.u_dot[0]).matrix  # noqa: E731
    q, e = jnp.asarray(at.q[0]), jnp.array([1e-6, 0.0])
    forward, reverse = jax.jit(jax.jacfwd(along))(q), jax.jit(jax.jacrev(along))(q)
    np.testing.assert_allclose(forward, reverse, atol=tolerance)
    np.testing.assert_allclose((along(q + e) - along(q - e)) / 2e-6, forward[..., 0], atol=1e-7)
    # of a length of the system, with nothing known outside
    length = jax.jit(jax.grad(lambda L: regressor(dataclasses.replace(truth, L1=L), 0.0, q, q, q).matrix[1, 13]))
    assert np.isfinite(length(0.2))


@pytest.mark.weekly
def test_nonlinear_and_invalid_parameters_are_rejected():
    _truth, at = swings()
    i = (0.0, at.q[3], at.u[3], at.u_dot[3])
    for kwargs, said in (
        ({"parameters": "L1"}, "not linear in L1"),
        ({"parameters": "m1"}, "m1 is a parameter of a body in `bodies`"),
        ({"parameters": ("k1", "k1")}, "contains k1 more than once"),
        ({"parameters": "k3"}, "no parameter 'k3'"),
        ({"bodies": ("link1", "link1")}, "contains link1 twice"),
        ({"bodies": "link3"}, "did you mean 'link2'"),
        ({"bodies": {"link1": ("Iww",)}}, "link1 has no parameter Iww"),
        ({"bodies": ()}, "contains no body with a mass"),
    ):
        with pytest.raises(ValueError, match=said):
            regressor(Swing(), *i, **kwargs)
    with pytest.raises(ValueError, match="gravity is not uniform"):
        regressor(SwingInAField(), *i)
    with pytest.raises(ValueError, match="not linear in stiffness"):
        regressor(Sprung(), *i, parameters=("stiffness", "rest"))
    with pytest.raises(ValueError, match="not linear in power"):
        regressor(Sprung(), *i, parameters="power")
    spring = regressor(Sprung(), *i, parameters="stiffness")
    assert spring.names[-2:] == ("stiffness[0]", "stiffness[1]")
    np.testing.assert_allclose(spring.matrix[0, -2:], [at.q[3, 0] - 0.2, at.q[3, 0] ** 3], rtol=1e-12)
    with pytest.raises(ValueError, match="m1 has more axes than declared"):
        base_parameters(dataclasses.replace(Swing(), m1=jnp.ones(2)))
    with pytest.raises(ValueError, match="no input named tau"):
        regressor(Swing(), *i, {"tau": 1.0})
    with pytest.raises(ValueError, match="u_dot must have the shape"):
        regressor(Swing(), *i[:3], np.zeros(3))
    with pytest.raises(TypeError, match="instance of a System"):
        regressor(Swing, *i)


@pytest.mark.slow
def test_known_bodies_are_included_in_the_forces():
    tolerance = 1e-12
    truth, at = swings()
    i = (0.0, at.q[3], at.u[3], at.u_dot[3], {"torque1": at.inputs["torque1"][3]})
    part = regressor(truth, *i, bodies={"link2": ("m", "my")})
    assert part.names == ("link2.m", "link2.my")
    np.testing.assert_allclose(part.matrix @ part.values, part.forces, atol=tolerance)
    none = regressor(truth, *i, bodies=(), parameters="k2")
    assert none.matrix.shape == (2, 1)
    np.testing.assert_allclose(none.matrix[:, 0], [at.u[3, 0] - at.u[3, 1], at.u[3, 1] - at.u[3, 0]], atol=tolerance)


def test_products_in_single_precision_have_all_digits():
    """With the default precision of JAX, float32 products on NVIDIA GPUs have three digits. A CPU computes all."""
    truth, at = swings()
    small = jax.tree.map(lambda x: x.astype(jnp.float32), truth)
    t, q, *rest = (jnp.asarray(x[3], jnp.float32) for x in (at.t, at.q, at.u, at.u_dot))
    program = jax.make_jaxpr(lambda q: regressor(small, t, q, *rest, parameters=FRICTION).forces)(q)
    assert program.out_avals[0].dtype == jnp.float32
    assert "Precision.HIGHEST" in str(program)
    assert "precision=None" not in str(program)
