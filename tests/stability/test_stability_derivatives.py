"""Derivatives of eigenvalues of any order, and where there are none; derivatives of what was not found."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import RodOnPin

import jaxkane as jk
from jaxkane.stability import critical_speeds, eigenvalues, equilibrium, family, linearize
from jaxkane.stability._matrix_eigenvalues import eig, eigvals


def pair(p):
    """Coefficients of x^2 + 2 d x + k: eigenvalues -d +- sqrt(d^2 - k), closed to any order."""
    d, k = p
    return jnp.stack([jnp.stack([jnp.zeros_like(d), jnp.ones_like(d)]), jnp.stack([-k, -2 * d])])


def largest(values):
    return jnp.max(values.real), jnp.max(values.imag)


MODES = {
    "forward over forward": lambda f: jax.jacfwd(jax.jacfwd(f)),
    "forward over reverse": lambda f: jax.jacfwd(jax.jacrev(f)),
    "reverse over forward": lambda f: jax.jacrev(jax.jacfwd(f)),
    "reverse over reverse": lambda f: jax.jacrev(jax.jacrev(f)),
}


WAYS = {"eig": lambda A: eig(A).values, "eigvals": eigvals}
QUICK = {("eig", "reverse over reverse"), ("eigvals", "forward over reverse")}


@pytest.mark.weekly
@pytest.mark.parametrize(
    ("way", "mode"),
    [
        pytest.param(way, mode, marks=[] if (way, mode) in QUICK else pytest.mark.weekly, id=f"{way}-{mode}")
        for way in WAYS
        for mode in MODES
    ],
)
def test_second_derivatives_of_eigenvalues_agree_with_closed_forms(way, mode):
    rtol = 1e-11
    second = jax.jit(MODES[mode](lambda p: largest(WAYS[way](pair(p)))))
    oscillating = jax.hessian(lambda p: (-p[0], jnp.sqrt(p[1] - p[0] ** 2)))
    decaying = jax.hessian(lambda p: (-p[0] + jnp.sqrt(p[0] ** 2 - p[1]), 0.0 * p[0]))
    for p, exact in ((jnp.array([0.3, 2.0]), oscillating), (jnp.array([1.5, 0.7]), decaying)):
        for x, y in zip(second(p), exact(p), strict=True):
            np.testing.assert_allclose(x, y, rtol=rtol, atol=1e-12)


@pytest.mark.weekly
def test_third_derivatives_and_eigenvectors_agree_with_differences():
    """Of a general matrix: a parameter moves all of it; vectors as LAPACK scales them."""
    rtol = 1e-7
    rng = np.random.default_rng(3)
    A, B, C = rng.standard_normal((3, 3, 3))

    def along(p):
        found = eig(A + p * B + p**2 * C)
        return found.values, found.vectors, found.left, found.condition

    @jax.jit
    def found(p):
        """Of all of them the values and slopes; of the eigenvalues the second and the third derivatives."""
        second = jax.jacfwd(jax.jacfwd(lambda p: along(p)[0]))
        twice = lambda f: lambda p: (value := f(p), value)  # noqa: E731
        return *jax.jacfwd(twice(along), has_aux=True)(p)[::-1], *jax.jacfwd(twice(second), has_aux=True)(p)[::-1]

    h = 1e-4
    _, slopes, _, third = found(0.0)
    by_differences = jax.tree.map(
        lambda a, b, c, d: (8 * (a - b) - (c - d)) / (12 * h), *(found(k * h) for k in (1, -1, 2, -2))
    )
    for x, y in zip(slopes, by_differences[0], strict=True):
        np.testing.assert_allclose(x, y, rtol=rtol, atol=1e-9)
    y = by_differences[2]
    np.testing.assert_allclose(third, y, rtol=rtol, atol=rtol * np.abs(y).max())


# 3, 1 and 1, of which the last two are one defective, or one semisimple double root
COALESCING = [jnp.array([[1.0, coupled, 0.2], [0.0, 1.0, 0.3], [0.0, 0.0, 3.0]]) for coupled in (1.0, 0.0)]


@pytest.mark.slow
@pytest.mark.parametrize(
    "mode", [m if m == "reverse over reverse" else pytest.param(m, marks=pytest.mark.weekly) for m in MODES]
)
def test_a_separate_eigenvalue_is_differentiable_while_others_coalesce(mode):
    rtol = 1e-11
    B = jnp.array([[0.1, 0.4, 0.2], [0.3, 0.2, -0.5], [0.7, 0.6, 0.5]])
    second = jax.jit(MODES[mode](lambda p, A: eigvals(A + p * B).real))
    for A in COALESCING:
        found = second(0.0, A)
        np.testing.assert_array_equal(np.isnan(found), [False, True, True])
        # lambda'' = 2 y B (lambda - A)^+ B x, the pseudoinverse clear of x and y: by the projection off x y^T
        values, left, right = map(np.asarray, (eig(A).values.real, eig(A).left.real, eig(A).vectors.real))
        x, y = right[:, 0], left[:, 0] / (left[:, 0] @ right[:, 0])
        P = np.eye(3) - np.outer(x, y)
        S = P @ np.linalg.inv(values[0] * np.eye(3) - np.asarray(A) + np.outer(x, y)) @ P
        np.testing.assert_allclose(found[0], 2 * y @ B @ S @ B @ x, rtol=rtol)
        assert np.isinf(eig(A).condition[1:]).all()
        assert np.isfinite(eig(A).condition[0])


@pytest.mark.weekly
def test_unread_coalescing_eigenvalues_add_no_nan_in_reverse_mode():
    hessian_of_first = jax.jit(jax.hessian(lambda A: eigvals(A).real[0]))
    assert all(np.isfinite(hessian_of_first(A)).all() for A in COALESCING)


def test_eigenvalues_in_single_precision_and_of_empty_batches():
    slope = jax.jit(jax.jacfwd(lambda p: eigvals(pair(p)).real))(jnp.array([1.5, 0.7], jnp.float32))
    assert slope.dtype == jnp.float32
    assert np.isfinite(slope).all()
    none = jax.eval_shape(jax.vmap(jax.hessian(lambda p: eigvals(pair(p)).real)), jnp.zeros((0, 2)))
    assert none.shape == (0, 2, 2, 2)
    assert eigvals(jnp.zeros((0, 3, 3))).shape == (0, 3)
    found = jax.jit(eig)(jnp.full((3, 3), jnp.nan))
    assert np.isnan(found.values).all()
    assert np.isnan(found.condition).all()


# -- what was not found has no derivative


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


def softest(length, damper=1.0):
    """The spring from which on it hangs still."""
    hanging = jk.State(jnp.zeros(1), jnp.zeros(1))
    at = lambda system, spring: (dataclasses.replace(system, spring=spring), hanging)  # noqa: E731
    return critical_speeds(Pushed(length=length, damper=damper), jnp.linspace(-20.0, 5.0, 6), at)["mode 1"]


@pytest.mark.weekly
def test_a_missing_critical_value_has_nan_derivatives():
    """Hanging, a spring of -m g l makes it unstable; with a damper that drives it, nothing makes it stable."""
    both = jax.jit(jax.value_and_grad(softest))
    np.testing.assert_allclose(both(0.5, 1.0), [-LIMIT, -2 * 9.81], rtol=1e-11)
    assert np.isnan(both(0.5, -1.0)).all()


@pytest.mark.weekly
def test_a_critical_value_at_a_given_value_and_next_to_an_invalid_value():
    """Exactly at a given value the sign is that of rounding; beside a value without a motion nothing can be told."""
    hanging = jk.State(jnp.zeros(1), jnp.zeros(1))
    at = lambda system, spring: (dataclasses.replace(system, spring=spring), hanging)  # noqa: E731
    found = critical_speeds(Pushed(), jnp.array([-20.0, -LIMIT, 0.0]), at)
    np.testing.assert_allclose(found.values, [-LIMIT], rtol=1e-12)
    with pytest.raises(ValueError, match="there is no steady motion at nan"):
        critical_speeds(Pushed(), jnp.array([-20.0, jnp.nan, 0.0]), at)
    hidden = jax.jit(lambda x: critical_speeds(Pushed(), x, at).values)
    assert np.isnan(hidden(jnp.array([-20.0, jnp.nan, 0.0]))).all()
    assert critical_speeds(Pushed(), jnp.zeros(0), at).values.shape == (0,)


def sprung(system, spring):
    return dataclasses.replace(system, spring=spring), jk.State(jnp.zeros(1), jnp.zeros(1))


@pytest.mark.weekly
def test_critical_values_do_not_depend_on_the_order_of_the_given_values():
    up = critical_speeds(Pushed(), jnp.array([-20.0, -3.0, 5.0]), sprung)
    np.testing.assert_allclose(up.values, [-LIMIT], rtol=1e-12)
    for values in ([5.0, -3.0, -20.0], [-3.0, 5.0, -20.0]):
        found = critical_speeds(Pushed(), jnp.array(values), sprung)
        np.testing.assert_array_equal(found.values, up.values)
        np.testing.assert_array_equal(found.direction, [-1])
    for function in (critical_speeds, eigenvalues):
        with pytest.raises(TypeError, match="must be real numbers, got 'fast'"):
            function(Pushed(), "fast", sprung)
        with pytest.raises(ValueError, match=r"must have the shape \(m,\), got \(1, 3\)"):
            function(Pushed(), jnp.zeros((1, 3)), sprung)


@pytest.mark.weekly
def test_a_stability_change_without_axis_crossing_causes_a_warning():
    """Without a damper it becomes neutral; with a spring that passes its limit flatly, the crossing is too flat."""
    with pytest.warns(UserWarning, match="falls by 1 more than the detected"):
        found = critical_speeds(Pushed(damper=0.0), jnp.array([-20.0, -3.0, 5.0]), sprung)
    assert not found.values.size
    flat = lambda system, x: sprung(system, (x - 0.3) ** 3 - LIMIT)  # noqa: E731
    with pytest.warns(UserWarning, match="falls by 1 more than the detected"):
        critical_speeds(Pushed(), jnp.array([-1.0, 0.0, 1.0]), flat)


@pytest.mark.weekly
def test_an_invalid_parameter_gives_a_nan_linear_model_under_jit():
    """A length that passes zero is no way to become stable: alone that is an error."""
    hanging = jk.State(jnp.zeros(1), jnp.zeros(1))
    at = lambda system, length: (dataclasses.replace(system, length=length), hanging)  # noqa: E731
    found = eigenvalues(Pushed(), jnp.array([-0.5, 0.5]), at)
    np.testing.assert_array_equal(np.isnan(found.eigenvalues), [[True] * 2, [False] * 2])
    with pytest.raises(ValueError, match=r"there is no steady motion at -0\.5"):
        critical_speeds(Pushed(), jnp.array([-0.5, 0.5]), at)


def test_an_unsteady_motion_gives_a_nan_linear_model_under_jit():
    """It was the model of an instant, without a word: now NaN in its row, as it is an error alone."""
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
