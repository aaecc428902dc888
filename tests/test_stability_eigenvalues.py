"""Eigenvalues along a parameter, critical speeds and their derivatives: against the literature and differences."""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane import Scalar, parameter
from jaxkane.stability import critical_speeds, eigenvalues, linearize, straight_ahead
from jaxkane.stability._eigenvalues import track

BIKE = jk.catalog.WhippleBicycle.benchmark()
PUBLISHED = json.loads((Path(__file__).parent / "data" / "meijaard2007.json").read_text())
WEAVE, CAPSIZE = 4.29238253634111, 6.02426201538837  # [m/s] Meijaard et al. (2007), section 5
DOUBLE_ROOT = 0.68428307889246  # [m/s] as above
NAMES = [f.name for f in dataclasses.fields(BIKE)]
LATERAL = ("roll", "steer", "roll_rate", "steer_rate")


def differences(f, h):
    """df/dparameters of a function of the bicycle, by central differences of the fourth order with relative steps h."""
    found = {}
    for name in NAMES:
        x = float(getattr(BIKE, name))
        step = h * max(abs(x), 0.1)
        at = lambda k: f(dataclasses.replace(BIKE, **{name: x + k * step}))  # noqa: B023, E731
        found[name] = (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * step)
    return found


def agree(derivative, by_differences, rtol):
    """To `rtol`, or to the rounding of the differences where a derivative is next to nothing."""
    for name in NAMES:
        x, y = np.asarray(getattr(derivative, name)), np.asarray(by_differences[name])
        size = max(abs(float(getattr(BIKE, name))), 0.1)
        np.testing.assert_allclose(x, y, rtol=rtol, atol=1e-10 / size, err_msg=name)


# -- along the speed


@pytest.fixture(scope="module")
def found():
    return eigenvalues(BIKE, jnp.linspace(0.0, 10.0, 101))


def test_eigenvalues_of_the_benchmark_at_eleven_speeds(found):
    """Meijaard et al. (2007), Table 2."""
    atol = 1e-11
    for row in PUBLISHED["table2"]:
        here = np.asarray(found.eigenvalues[int(10 * row["v"])])
        for real, imaginary in row["eig_published"]:
            assert np.abs(here - complex(real, imaginary)).min() < atol


def test_modes_are_followed_and_named(found):
    """Capsize and castering decay, castering ever faster; the weave swings from 0.68 m/s on."""
    assert found.modes == ("weave", "weave", "capsize", "castering")
    v = np.asarray(found.values)
    castering, weave = np.asarray(found["castering"])[:, 0], np.asarray(found["weave"])
    assert np.all(np.diff(castering.real) < 0)
    np.testing.assert_array_equal(np.abs(weave.imag).min(axis=1) > 0, v > DOUBLE_ROOT)
    assert np.abs(np.diff(np.asarray(found.eigenvalues)[v > 0.75], axis=0)).max() < 0.4
    assert np.abs(np.asarray(found["capsize"]).imag).max() == 0
    np.testing.assert_array_equal(found.stable, (v > WEAVE) & (v < CAPSIZE))
    A = linearize(BIKE, straight_ahead(BIKE, 5.0), states=LATERAL).A
    X, lam = found.vectors[50], found.eigenvalues[50]
    np.testing.assert_allclose(A.astype(complex) @ X, X * lam[None, :], atol=1e-12)
    with pytest.raises(KeyError, match="no 'wobble' in these modes; there are weave, capsize, castering"):
        found["wobble"]


def test_crossing_modes_keep_their_columns():
    """Three straight lines and a pair, shuffled: all cross; the vectors tell them apart."""
    rng = np.random.default_rng(0)
    p = np.linspace(0.0, 1.0, 41)
    lam = np.stack([-1 + 2 * p, 0.5 - p, 0.1 + 0 * p, -0.3 + 3j * p, -0.3 - 3j * p], axis=1).astype(complex)
    X = np.eye(5) + 0.1 * rng.standard_normal((5, 5))
    X = X / np.linalg.norm(X, axis=0)
    shuffles = np.stack([rng.permutation(5) for _ in p])
    shuffled = np.take_along_axis(lam, shuffles, axis=1)
    order = track(shuffled, np.stack([X[:, s] for s in shuffles]))
    tracked = np.take_along_axis(shuffled, order, axis=1)
    columns = [int(np.abs(lam - tracked[:, [j]]).sum(axis=0).argmin()) for j in range(5)]
    assert sorted(columns) == [0, 1, 2, 3, 4]
    np.testing.assert_array_equal(tracked, lam[:, columns])


@pytest.mark.slow
def test_derivatives_of_eigenvalues_with_respect_to_all_parameters():
    rtol = 1e-7

    @jax.jit
    def parts(bicycle):
        x = eigenvalues(bicycle, jnp.array([5.0])).eigenvalues[0]
        return jnp.stack([x[0].real, jnp.abs(x[0].imag), x[2].real, x[3].real])

    agree(jax.jit(jax.jacrev(parts))(BIKE), differences(parts, 4e-4), rtol)


@pytest.mark.slow
def test_where_modes_coalesce_there_is_no_derivative():
    """Not a silent zero: NaN for the two that meet, numbers for the others, and words."""

    def at(v):
        return eigenvalues(BIKE, v[None])

    @jax.jit
    def value_and_slopes(v):
        def real(v):
            found = at(v)
            return found.eigenvalues[0].real, found

        slope, found = jax.jacrev(real, has_aux=True)(v)
        return found, slope

    found, slope = value_and_slopes(jnp.array(DOUBLE_ROOT))
    np.testing.assert_allclose(found["weave"].real, 3.7829040512932, atol=1e-6)
    np.testing.assert_array_equal(found.coalescing, [[True, True, False, False]])
    np.testing.assert_array_equal(np.isnan(slope), [True, True, False, False])
    assert "modes coalesce at 0.684283: no derivative there" in repr(found)
    found, slope = value_and_slopes(jnp.array(0.7))
    assert np.isfinite(slope).all()
    assert not np.asarray(found.coalescing).any()


# -- critical speeds


def test_weave_and_capsize_speeds():
    atol = 1e-11
    found = critical_speeds(BIKE)
    np.testing.assert_allclose(found.values, [WEAVE, CAPSIZE], atol=atol)
    np.testing.assert_allclose(found.frequency, [3.43503384866144, 0.0], atol=1e-10)
    np.testing.assert_array_equal(found.direction, [-1, 1])
    assert (found["weave"], found["capsize"]) == tuple(found.values)
    assert np.isnan(found["castering"])
    assert repr(found).startswith("CriticalSpeeds(weave stable from 4.292382536 (3.435 rad/s), capsize unstable")


@pytest.mark.slow
def test_derivatives_of_critical_speeds_with_respect_to_all_parameters():
    rtol = 1e-7

    @jax.jit
    def both(bicycle):
        found = critical_speeds(bicycle, jnp.linspace(2.0, 9.0, 36))
        return jnp.stack([found["weave"], found["capsize"]])

    np.testing.assert_allclose(both(BIKE), [WEAVE, CAPSIZE], atol=1e-11)
    agree(jax.jit(jax.jacrev(both))(BIKE), differences(both, 4e-4), rtol)


class Inverted(jk.System):
    """An inverted pendulum with a spring and a damper at its pin."""

    mass: Scalar = parameter(positive=True)  # [kg]
    length: Scalar = parameter(positive=True)  # [m]
    spring: Scalar = parameter()  # [N m/rad]
    damper: Scalar = parameter()  # [N m s/rad]

    coordinates = ("angle",)
    speeds = ("rate",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        rod = N.rotate(3, q["angle"], u["rate"])
        return jk.Motion([jk.Body(self.mass, 0.0, O.fixed(self.length * rod.y), rod, name="ball")], frames={"rod": rod})

    def loads(self, t, q, u, motion, inputs):
        torque = -self.spring * q["angle"] - self.damper * u["rate"]
        return jk.weight(motion, -9.81 * motion.N.y), jk.Torque(torque * motion.N.z, motion["rod"])


@pytest.mark.slow
def test_any_parameter_of_any_system():
    """It stands from a spring of m g l on; d/dlength is m g."""
    rtol = 1e-12

    def softest(system):
        upright = jk.State(jnp.zeros(1), jnp.zeros(1))
        at = lambda system, k: (dataclasses.replace(system, spring=k), upright)  # noqa: E731
        return critical_speeds(system, jnp.linspace(0.0, 40.0, 17), at)

    system = Inverted(mass=2.0, length=0.6, spring=0.0, damper=1.0)

    def value_and_found(length):
        found = softest(dataclasses.replace(system, length=length))
        return found.values[0], found

    slope, found = jax.grad(value_and_found, has_aux=True)(0.6)
    np.testing.assert_allclose(found.values, [2 * 9.81 * 0.6], rtol=rtol)
    assert list(found.direction) == [-1]
    np.testing.assert_allclose(slope, 2 * 9.81, rtol=rtol)
    # Without a damper it never decays: nothing to find, and rounding errors are no crossings.
    assert softest(dataclasses.replace(system, damper=0.0)).values.size == 0


def test_what_is_missing_is_asked_for():
    system = Inverted(mass=2.0, length=0.6, spring=20.0, damper=1.0)
    with pytest.raises(ValueError, match=r"Inverted has no family of steady motions by default: give `motion`"):
        eigenvalues(system, jnp.linspace(0.0, 1.0, 3))
    with pytest.raises(ValueError, match="Give the values of the parameter"):
        eigenvalues(BIKE)
    found = eigenvalues(system, motion=jk.State(jnp.zeros(1), jnp.zeros(1)), modes=("fall", "recoil"))
    np.testing.assert_allclose(found.eigenvalues.sum(), -1 / 0.72, rtol=1e-12)
    assert found.modes == ("fall", "recoil")
    with pytest.raises(ValueError, match="2 modes, but 1 names: fall"):
        eigenvalues(system, motion=jk.State(jnp.zeros(1), jnp.zeros(1)), modes=("fall",))
