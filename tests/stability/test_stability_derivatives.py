"""Equilibria, critical values and linear models that do not exist are NaN, and so are their derivatives."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import RodOnPin

import jaxkane as jk
from jaxkane.stability import critical_speeds, eigenvalues, equilibrium, family, linearize


class Pushed(jk.System):
    """A pendulum about a pin, pushed by a torque: it stands still at sin(angle) = torque / (m g l), if that is one."""

    length: jk.Scalar = jk.parameter(0.5, positive=True)  # [m]
    spring: jk.Scalar = jk.parameter(0.0)  # [N m/rad]
    damper: jk.Scalar = jk.parameter(1.0)  # [N m s/rad]
    coordinates = ("angle",)
    speeds = ("rate",)
    inputs = ("torque",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        rod = N.rotate(3, q["angle"], u["rate"])
        return jk.Motion([jk.Body(2.0, 0.0, O.fixed(-self.length * rod.y), rod)], frames={"rod": rod})

    def loads(self, t, q, u, motion, inputs):
        torque = inputs["torque"] - self.damper * u["rate"] - self.spring * q["angle"]
        return jk.weight(motion, -9.81 * motion.N.y), jk.Torque(torque * motion.N.z, motion["rod"])


def standing(length, torque):
    return equilibrium(Pushed(length=length), {"angle": 0.2}, {"torque": torque})["angle"]


LIMIT = 2.0 * 9.81 * 0.5  # [N m] that weight can balance at 0.5 m


@pytest.mark.weekly
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_an_equilibrium_that_is_not_found_has_no_derivative(derivative):
    value_and_slope = jax.jit(lambda *at: (standing(*at), derivative(standing, (0, 1))(*at)))
    value, slope = value_and_slope(0.5, 1.2 * LIMIT)
    assert np.isnan([value, *slope]).all()
    value, slope = value_and_slope(0.5, 0.3 * LIMIT)
    np.testing.assert_allclose(value, np.arcsin(0.3), rtol=1e-12)
    np.testing.assert_allclose(slope[1], 1 / (LIMIT * np.cos(value)), rtol=1e-10)


@pytest.mark.slow
def test_a_failed_batch_member_does_not_affect_the_derivatives_of_others():
    """Shared length, a batch of torques, of which the second is too large: nobody reads it, or everything is told."""
    torques = jnp.array([0.3, 1.2, 0.5]) * LIMIT

    @jax.jit
    def some(length, weights):
        angles = jax.vmap(lambda torque: standing(length, torque))(torques)
        return jnp.sum(jnp.where(weights > 0, weights * angles, 0.0))

    slope = jax.jit(jax.grad(some))
    s = np.array([0.3, 0.5])
    np.testing.assert_allclose(slope(0.5, jnp.array([1.0, 0.0, 1.0])), -np.sum(s / np.sqrt(1 - s**2)) / 0.5, rtol=1e-9)
    assert np.isnan(slope(0.5, jnp.ones(3)))


def sprung(system, spring):
    return dataclasses.replace(system, spring=spring), jk.State(jnp.zeros(1), jnp.zeros(1))


def softest(length, damper=1.0):
    """The critical stiffness, above which the hanging pendulum is stable."""
    system = Pushed(length=length, damper=damper)
    return critical_speeds(system, jnp.array([-20.0, -3.0, 5.0]), sprung)["mode 1"]


@pytest.mark.weekly
def test_a_missing_critical_value_has_nan_derivatives():
    """Hanging, a spring of -m g l makes it unstable; with a damper that drives it, nothing makes it stable."""
    both = jax.jit(jax.value_and_grad(softest))
    np.testing.assert_allclose(both(0.5, 1.0), [-LIMIT, -2 * 9.81], rtol=1e-11)
    assert np.isnan(both(0.5, -1.0)).all()


@pytest.mark.weekly
def test_critical_values_for_given_values_in_any_order():
    """Exactly at a given value the sign is that of rounding; next to a value without a motion nothing is known."""
    for values in ([-20.0, -3.0, 5.0], [5.0, -3.0, -20.0], [-3.0, 5.0, -20.0], [-20.0, -LIMIT, 0.0]):
        found = critical_speeds(Pushed(), jnp.array(values), sprung)
        np.testing.assert_allclose(found.values, [-LIMIT], rtol=1e-12)
        np.testing.assert_array_equal(found.direction, [-1])
    invalid = jnp.array([-20.0, jnp.nan, 0.0])
    with pytest.raises(ValueError, match="there is no steady motion at nan"):
        critical_speeds(Pushed(), invalid, sprung)
    assert np.isnan(jax.jit(lambda x: critical_speeds(Pushed(), x, sprung).values)(invalid)).all()
    assert critical_speeds(Pushed(), jnp.zeros(0), sprung).values.shape == (0,)
    # Without a damper it becomes neutral; with a spring that passes its limit flatly, the crossing is too flat.
    flat = lambda system, x: sprung(system, (x - 0.3) ** 3 - LIMIT)  # noqa: E731
    for system, values, at in ((Pushed(damper=0.0), [-20.0, -3.0, 5.0], sprung), (Pushed(), [-1.0, 0.0, 1.0], flat)):
        with pytest.warns(UserWarning, match="falls by 1 more than the detected"):
            critical_speeds(system, jnp.array(values), at)


@pytest.mark.weekly
def test_an_invalid_parameter_is_not_a_way_to_become_stable():
    """A length that passes zero."""
    at = lambda system, length: (dataclasses.replace(system, length=length), jk.State([0.0], [0.0]))  # noqa: E731
    found = eigenvalues(Pushed(), jnp.array([-0.5, 0.5]), at)
    np.testing.assert_array_equal(np.isnan(found.eigenvalues), [[True] * 2, [False] * 2])
    with pytest.raises(ValueError, match=r"there is no steady motion at -0\.5"):
        critical_speeds(Pushed(), jnp.array([-0.5, 0.5]), at)


def test_an_unsteady_motion_gives_a_nan_linear_model_under_jit():
    """In a batch, the row of an unsteady motion is NaN. A single unsteady motion raises an error."""
    tilts = jnp.array([0.0, 0.4, np.pi])
    found = eigenvalues(Pushed(), tilts, lambda system, angle: jk.State(angle[None], jnp.zeros(1)))
    np.testing.assert_array_equal(np.isnan(found.eigenvalues), [[False] * 2, [True] * 2, [False] * 2])
    assert "NaN at 0.4: no steady motion there" in repr(found)
    with pytest.raises(ValueError, match="because there is no steady motion"):
        jk.plot.mode_shapes(found, at=0.4)

    @jax.jit
    def stiffness(length, angle):
        state = jk.State(angle[None], jnp.zeros(1))
        return jnp.stack([linearize(Pushed(length=length), state, steady=s).A[1, 0] for s in (True, False)])

    values, slopes = (jax.jit(jax.vmap(f, (None, 0)))(0.5, tilts) for f in (stiffness, jax.jacrev(stiffness)))
    exact = -9.81 / 0.5 * np.cos(tilts)
    np.testing.assert_allclose(values[:, 1], exact, rtol=1e-12)
    np.testing.assert_allclose(slopes[:, 1], -exact / 0.5, rtol=1e-12)
    for x in (values, slopes):
        np.testing.assert_array_equal(np.isnan(x[:, 0]), [False, True, False])
    with pytest.raises(ValueError, match="angle is not finite, so the linear model does not exist"):
        linearize(Pushed(), jk.State(jnp.array([jnp.nan]), jnp.zeros(1)), steady=False)


@pytest.mark.slow
def test_linearize_rejects_states_that_violate_the_constraints():
    rod = RodOnPin(length=0.7)
    off = jk.State(jnp.array([0.1, 0.1]), jnp.zeros(1))
    with pytest.raises(ValueError, match="violate the configuration constraints"):
        linearize(rod, off, steady=False)
    assert np.isnan(jax.jit(lambda q: linearize(rod, jk.State(q, off.u), steady=False).A)(off.q)).all()


@pytest.mark.weekly
def test_a_family_of_steady_motions_that_solves_for_an_input():
    """The torque that holds a pendulum, as it is led aside: one equation fewer than unknowns."""
    found = family(Pushed(), equilibrium(Pushed()), towards={"angle": 1}, until={"angle": 1.0}, find=("torque",))
    np.testing.assert_allclose(found.q[-1], [1.0], rtol=1e-9)
    np.testing.assert_allclose(found.inputs["torque"][-1], LIMIT * np.sin(1.0), rtol=1e-8)
