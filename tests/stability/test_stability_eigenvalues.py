"""Eigenvalues along a parameter and critical speeds, against the literature, closed forms and perturbation theory."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanisms import Sled

import jaxkane as jk
from jaxkane import parameter
from jaxkane.bicycles import sharp_motorcycle
from jaxkane.stability import critical_speeds, eigenvalues, linearize, straight_ahead

BIKE = jk.catalog.WhippleBicycle.benchmark()
PUBLISHED = json.loads((Path(__file__).parents[1] / "data" / "meijaard2007.json").read_text())
MEIJAARD = "Meijaard, Papadopoulos, Ruina and Schwab (2007)"
WEAVE, CAPSIZE = 4.29238253634111, 6.02426201538837  # [m/s] Meijaard et al. (2007), section 5
DOUBLE_ROOT = 0.68428307889246  # [m/s] as above
LATERAL = ("roll", "steer", "roll_rate", "steer_rate")


# -- along the speed


@pytest.mark.weekly
@pytest.mark.optimized
@pytest.mark.published
def test_eigenvalues_of_the_benchmark_at_eleven_speeds(published):
    """Meijaard et al. (2007), Table 2."""
    found, theirs, ours = eigenvalues(BIKE, jnp.linspace(0.0, 10.0, 101)), [], []
    for row in PUBLISHED["table2"]:
        here = np.asarray(found.eigenvalues[int(10 * row["v"])])
        for real, imaginary in row["eig_published"]:
            nearest = here[np.argmin(np.abs(here - complex(real, imaginary)))]
            theirs += [real, imaginary]
            ours += [nearest.real, nearest.imag]
    published(MEIJAARD, "eigenvalues of the bicycle from 0 to 10 m/s, Table 2 [1/s]", theirs, ours, 1e-11)


@pytest.mark.weekly
@pytest.mark.optimized
@pytest.mark.published
def test_matrices_of_the_benchmark(published):
    found = jk.stability.canonical(BIKE)
    names = ("M", "C1", "K0", "K2")
    theirs = [PUBLISHED["canonical"][name] for name in names]
    published(MEIJAARD, "matrices of the linear bicycle", theirs, [getattr(found, name) for name in names], 1e-12)


@pytest.mark.weekly
def test_stability_and_vectors_of_the_benchmark():
    found = eigenvalues(BIKE, jnp.linspace(0.0, 10.0, 101))
    v = np.asarray(found.values)
    np.testing.assert_array_equal(found.stable, (v > WEAVE) & (v < CAPSIZE))
    A = linearize(BIKE, straight_ahead(BIKE, 5.0), states=LATERAL).A
    X, lam = found.vectors[50], found.eigenvalues[50]
    np.testing.assert_allclose(A.astype(complex) @ X, X * lam[None, :], atol=1e-12)
    with pytest.raises(KeyError, match="no 'wobble' in these modes; there are weave, capsize, castering"):
        found["wobble"]


@pytest.mark.weekly
def test_coalescing_modes_have_nan_derivatives():
    """Not a silent zero: NaN for the two that meet, numbers for the others, and words."""

    @jax.jit
    def value_and_slopes(v):
        def real(v):
            found = eigenvalues(BIKE, v[None])
            return found.eigenvalues[0].real, found

        return jax.jacrev(real, has_aux=True)(v)[::-1]

    found, slope = value_and_slopes(jnp.array(DOUBLE_ROOT))
    np.testing.assert_allclose(found["weave"].real, 3.7829040512932, atol=1e-6)
    np.testing.assert_array_equal(found.coalescing, [[True, True, False, False]])
    np.testing.assert_array_equal(np.isnan(slope), [True, True, False, False])
    assert "modes coalesce at 0.684283: no derivative there" in repr(found)
    found, slope = value_and_slopes(jnp.array(0.7))
    assert np.isfinite(slope).all()
    assert not np.asarray(found.coalescing).any()


# -- critical speeds


@pytest.mark.weekly
@pytest.mark.optimized
@pytest.mark.published
def test_weave_and_capsize_speeds(published, recwarn):
    found = critical_speeds(BIKE)
    published(MEIJAARD, "weave and capsize speed [m/s]", [WEAVE, CAPSIZE], found.values, 1e-11)
    np.testing.assert_allclose(found.frequency, [3.43503384866144, 0.0], atol=1e-10)
    np.testing.assert_array_equal(found.direction, [-1, 1])
    assert (found["weave"], found["capsize"]) == tuple(found.values)
    assert np.isnan(found["castering"])
    assert repr(found).startswith(
        "CriticalSpeeds(forward speed [m/s]: weave stable from 4.292382536 (3.435 rad/s), capsize unstable"
    )
    assert not recwarn  # as many eigenvalues come to grow as pass the axis


@pytest.mark.weekly
def test_eigenvalues_of_riding_backwards_are_those_of_reversed_time():
    """Each mode keeps its name: it was castering that capsized."""
    speeds = jnp.linspace(1.0, 10.0, 19)
    forwards, backwards = eigenvalues(BIKE, speeds), eigenvalues(BIKE, -speeds)
    assert forwards.modes == backwards.modes
    np.testing.assert_allclose(backwards.eigenvalues.real, -forwards.eigenvalues.real, rtol=1e-9)
    found = critical_speeds(BIKE, -speeds)
    assert [found.modes[i] for i in found.mode] == ["capsize", "weave"]
    np.testing.assert_allclose(found.values, [-CAPSIZE, -WEAVE], rtol=1e-12)


class Pencil(jk.System):
    """States that follow x_dot = A x, beside a point that comes to rest."""

    A: jax.Array = parameter(shape=(4, 4))

    coordinates = ("place",)
    speeds = ("speed",)
    states = ("x1", "x2", "x3", "x4")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        P = O.moving(q["place"] * N.x, u["speed"] * N.x)
        return jk.Motion([jk.Body(1.0, 0.0, P, name="point")])

    def loads(self, t, q, u, motion, inputs):
        return jk.Force(-(q["place"] + u["speed"]) * motion.N.x, motion["point"])

    def state_rates(self, t, q, u, x, motion, now):
        return [sum(self.A[i, j] * x[k] for j, k in enumerate(self.states)) for i in range(4)]


REST = jk.State(jnp.zeros(1), jnp.zeros(1), jnp.zeros(4))
STEPS = np.linspace(-1.0, 1.0, 5)


@jax.jit
def crossings_of(A, dA):
    """Where x_dot = (A + p dA) x becomes stable or unstable for p from -1 to 1, and the slopes along A."""

    def critical(s):
        at = lambda system, p: (Pencil(A=(1 + s) * A + p * dA), REST)  # noqa: E731
        found = critical_speeds(Pencil(A=A), STEPS, at, states=Pencil.states, most=24)
        return found.values, found

    slopes, found = jax.jacfwd(critical, has_aux=True)(0.0)
    return found, slopes


def pencil(seed):
    """A and dA of a random pencil: dense, of an oscillator, of parts that do not notice each other, of one that hardly
    decays, or of one of its own beside them that is a thousand times as fast."""
    rng = np.random.default_rng(seed)
    A, dA = rng.standard_normal((2, 4, 4))
    match seed % 5:
        case 1:
            A[:2], dA[:2] = np.eye(4)[2:], 0.0
        case 2:
            for x in (A, dA):
                x[:2, 2:] = x[2:, :2] = 0.0
        case 3:
            A, dA = A - A.T + 0.05 * dA, dA - dA.T + 0.05 * A
        case 4:
            for x, own in ((A, rng.standard_normal()), (dA, 1e3)):
                x[3], x[:, 3] = 0.0, 0.0
                x[3, 3] = own
    return A, dA


@pytest.mark.weekly
@settings(max_examples=500, deadline=None)
@given(st.integers(0, 2**32))
def test_every_crossing_of_many_random_pencils_is_found(seed):
    """The number of growing modes at 2001 values follows from the crossings, at which a real part is zero; and slopes
    are those of first-order perturbation: Re(y A x) + Re(y dA x) dp = 0."""
    atol, (A, dA) = 1e-9, pencil(seed)
    found, slopes = crossings_of(A, dA)
    some = np.isfinite(found.values)
    p, frequency, direction, slopes = (
        np.asarray(x)[some] for x in (found.values, found.frequency, found.direction, slopes)
    )
    fine = np.linspace(-1.0, 1.0, 2001)
    growing = (np.linalg.eigvals(A + fine[:, None, None] * dA).real > 0).sum(axis=1)
    changes = direction * np.where(frequency > 0, 2, 1)
    expected = growing[0] + (changes[None, :] * (p[None, :] < fine[:, None])).sum(axis=1)
    near = (np.abs(p[None, :] - fine[:, None]) < 1e-6).any(axis=1)
    np.testing.assert_array_equal(expected[~near], growing[~near])
    for value, w, slope in zip(p, frequency, slopes, strict=True):
        x, Y, X = scipy.linalg.eig(A + value * dA, left=True)
        i = np.argmin(np.abs(x - 1j * w))
        assert abs(x[i] - 1j * w) < atol * max(1.0, np.abs(x).max())
        y = Y[:, i].conj() / (Y[:, i].conj() @ X[:, i])
        by_hand = -(y @ A @ X[:, i]).real / (y @ dA @ X[:, i]).real
        assert abs(slope - by_hand) <= 1e-6 * abs(by_hand) or np.linalg.norm(y) > 1e6


def conjugate_pairs(values):
    """Which columns (n, n) of `values` (..., n) are a pair, the upper one first."""
    return (values[..., :, None] == values[..., None, :].conj()) & (values[..., :, None].imag > 0)


@jax.jit
def modes_of(A, dA):
    at = lambda system, p: (Pencil(A=A + p * dA), REST)  # noqa: E731
    return eigenvalues(Pencil(A=A), jnp.linspace(0.0, 1.0, 41), at, states=Pencil.states).eigenvalues


def test_crossing_modes_keep_their_columns():
    """Two straight lines and a pair cross each other."""
    p = np.linspace(0.0, 1.0, 41)
    X = np.eye(4) + 0.1 * np.random.default_rng(0).standard_normal((4, 4))
    A, dA = np.diag([-1.0, 0.5, -0.3, -0.3]), np.diag([2.0, -1.0, 0.0, 0.0])
    A[2, 3] = dA[2, 3] = 1.0
    A[3, 2] = dA[3, 2] = -1.0
    lines = np.stack([-1 + 2 * p, 0.5 - p, -0.3 + (1 + p) * 1j, -0.3 - (1 + p) * 1j], axis=1)
    found = np.asarray(modes_of(*(X @ x @ np.linalg.inv(X) for x in (A, dA))))
    columns = [int(np.abs(lines - found[:, [j]]).sum(axis=0).argmin()) for j in range(4)]
    assert sorted(columns) == [0, 1, 2, 3]
    np.testing.assert_allclose(found, lines[:, columns], atol=1e-12)


@pytest.mark.slow
@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.integers(0, 2**20))
def test_a_conjugate_pair_remains_in_its_columns(seed):
    """If it is a pair at both of two neighbouring values of the parameter."""
    A, dA = pencil(seed)
    together = conjugate_pairs(np.asarray(modes_of(A, 0.01 * dA)))
    together = together | together.swapaxes(1, 2)
    kept = (together.sum(axis=(1, 2))[1:] == 2) & (together.sum(axis=(1, 2))[:-1] == 2)
    np.testing.assert_array_equal(together[1:][kept], together[:-1][kept])


def test_a_pair_that_becomes_real_and_unstable_within_one_step_is_found():
    """x'' = (p - 0.1) x - 0.4 x' has a pair up to p = 0.06 and grows from 0.1 on; beside it one decays up to 0.07, and
    one exactly up to a value that is given."""
    A, dA = np.zeros((2, 4, 4))
    A[0, 1], A[1, :2], dA[1, 0] = 1.0, (-0.1, -0.4), 1.0
    A[2, 2], dA[2, 2], A[3, 3], dA[3, 3] = -0.7, 10.0, -0.5, 1.0
    found, slopes = crossings_of(A, dA)
    np.testing.assert_allclose(found.values[:3], [0.07, 0.1, 0.5], rtol=1e-12)
    np.testing.assert_allclose(slopes[:3], [0.07, 0.1, 0.5], rtol=1e-9)
    np.testing.assert_array_equal(found.direction[:3], 1)
    np.testing.assert_array_equal(found.frequency[:3], 0.0)
    assert np.isnan([*found.values[3:], *slopes[3:]]).all()


def closed_form(v):
    """Eigenvalues (m, 4) of the benchmark: weave, weave, capsize, castering. Meijaard et al. (2007), eq. (5.3)."""
    M, C1, K0, K2 = (np.array(PUBLISHED["canonical"][name]) for name in ("M", "C1", "K0", "K2"))
    below = [np.linalg.solve(M, np.hstack([-9.81 * K0 - x**2 * K2, -x * C1])) for x in v]
    values = np.linalg.eigvals([np.vstack([np.eye(4)[2:], x]) for x in below])
    decaying = np.where(values.imag == 0, values.real, np.inf)
    order = np.argsort(np.where(v[:, None] < DOUBLE_ROOT, -values.real, -decaying), axis=1)
    return np.take_along_axis(values, order, axis=1)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the modes .* cannot be identified")
@given(first=st.integers(0, 900), step=st.integers(1, 1000))
@settings(max_examples=100, deadline=None, derandomize=True)
def test_mode_names_are_correct_or_omitted(first, step):
    """From any speed on, in small or large steps. If steps are small, all modes are named."""
    v = (first + step * np.arange(101)) / 1000
    found, known = eigenvalues(BIKE, jnp.asarray(v)), closed_form(v)
    for name, columns in (("weave", slice(0, 2)), ("capsize", slice(2, 3)), ("castering", slice(3, 4))):
        if name in found.modes:
            as_set = (np.sort_complex(x) for x in (np.asarray(found[name]), known[:, columns]))
            np.testing.assert_allclose(*as_set, atol=1e-9)
        else:
            assert step > 50


def test_an_ambiguous_mode_name_is_omitted_with_a_warning():
    """Between 0.22 and 12 m/s, two of four real modes become the weave. One large step does not show which."""
    speeds = jnp.repeat(jnp.array([0.22, 12.0]), jnp.array([50, 51]), total_repeat_length=101)
    with pytest.warns(UserWarning, match="the modes weave, .*capsize.* cannot be identified and are numbered"):
        found = eigenvalues(BIKE, speeds)
    assert found.modes[0] == "mode 1"


@pytest.mark.weekly
@pytest.mark.filterwarnings("ignore:the modes .* cannot be identified")
def test_mode_names_of_a_motorcycle_at_one_speed_and_in_coarse_steps():
    """What is named weave, wobble or capsize is it, and no pair has two names."""
    motorcycle = sharp_motorcycle()
    found = eigenvalues(motorcycle, jnp.array([10.0, 20.0, 30.0]))
    pairs = np.argwhere(conjugate_pairs(np.asarray(found.eigenvalues)).all(axis=0))
    assert len(pairs) == 2  # the weave and the wobble at all speeds; the rear tyre is not a pair everywhere
    assert [found[found.modes[i]].shape for i, _ in pairs] == [(3, 2)] * 2
    assert len(set(found.modes)) == 6
    assert "mode 1" in found.modes
    for v in (20.0, 30.0, 40.0):
        found = eigenvalues(motorcycle, jnp.array([v]))
        names = np.array(found.modes)
        for i, j in np.argwhere(conjugate_pairs(np.asarray(found.eigenvalues[0]))):
            assert names[i] == names[j] or {*names[[i, j]]} <= {f"mode {k}" for k in range(1, 9)}
    for first in (1.0, 3.0, 5.0):
        found = critical_speeds(motorcycle, jnp.repeat(jnp.arange(first, 50.1, 5.0), 10, total_repeat_length=100))
        np.testing.assert_allclose(found.values, [5.934966209, 10.98552992], rtol=1e-9)
        for i, name in zip(found.mode, ("weave", "capsize"), strict=True):
            assert found.modes[i] in (name, f"mode {i + 1}")
    fine = critical_speeds(motorcycle, jnp.linspace(1.0, 50.0, 100))  # by the same program
    assert [fine.modes[i] for i in fine.mode] == ["weave", "capsize"]


def test_missing_arguments_raise_with_advice():
    system, rest = Sled(mass=2.0, drag=1.0, stiffness=20.0), jk.State([0.0], [0.0])
    with pytest.raises(ValueError, match=r"Sled has no default family of steady motions. Pass `motion`"):
        eigenvalues(system, jnp.linspace(0.0, 1.0, 3))
    with pytest.raises(ValueError, match=r"needs `values` of the parameter"):
        eigenvalues(BIKE)
    found = eigenvalues(system, motion=rest, modes=("fall", "recoil"))
    np.testing.assert_allclose(found.eigenvalues.sum(), -0.5, rtol=1e-12)
    assert found.modes == ("fall", "recoil")
    with pytest.raises(ValueError, match="this motion is not steady"):
        eigenvalues(system, motion=jk.State([0.1], [0.0]))
    with pytest.raises(ValueError, match="2 modes, but 1 names: fall"):
        eigenvalues(system, motion=rest, modes=("fall",))
