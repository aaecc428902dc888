"""A change of units changes nothing but units: loops of rods and of a slider, from 1e-9 to 1e9."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sympy_systems import FourBarLinkage

import jaxkane as jk

FACTORS = [
    (1e-9, 1.0, 1.0),
    (1e9, 1e-9, 1e-6),
    (1e-6, 1e9, 1e9),
    (1e6, 1e-6, 1e-9),
    (1e3, 1e3, 1e3),
]  # length, mass, time
RTOL = 1e-9


class FourBar(FourBarLinkage):
    """Its configuration residual is a Vector whose third component vanishes."""

    def motion(self, t, q, u):
        motion = super().motion(t, q, u)
        end = motion["end"]
        return jk.Motion(motion.bodies, end.velocity.to(motion.N)[:2], points={"end": end})

    def configuration_constraints(self, t, q):
        return [self.motion(t, q, (0.0, 0.0, 0.0))["end"].position]


class SliderCrank(jk.System):
    """A crank, a rod and a slider: coordinates in rad and m, none of which declares its unit."""

    crank: jk.Scalar = jk.parameter(0.1)  # [m]
    rod: jk.Scalar = jk.parameter(0.3)  # [m]
    mass: jk.Scalar = jk.parameter(1.0)  # of each part [kg]
    gravity: jk.Scalar = jk.parameter(9.81)  # [m/s^2]
    coordinates, speeds = ("x", "a", "b"), ("a_rate",)
    dependent_speeds, dependent_coordinates = ("x_rate", "b_rate"), ("x", "b")

    def q_dot(self, t, q, u):
        return u["x_rate"], u["a_rate"], u["b_rate"]

    def motion(self, t, q, u):
        N, O = jk.inertial()
        A, B = N.rotate(3, q["a"], u["a_rate"]), N.rotate(3, q["b"], u["b_rate"])
        rod = lambda l, frame, P: jk.Body(self.mass, (0.0, self.mass * l**2 / 12, self.mass * l**2 / 12), P, frame)  # noqa: E731
        pin = O.fixed(self.crank * A.x)
        slider = O.moving(q["x"] * N.x, u["x_rate"] * N.x)
        bodies = [
            rod(self.crank, A, O.fixed(self.crank / 2 * A.x)),
            rod(self.rod, B, pin.fixed(self.rod / 2 * B.x)),
            jk.Body(self.mass, 0.0, slider),
        ]
        gap = slider.velocity - pin.fixed(self.rod * B.x).velocity
        return jk.Motion(bodies, gap.to(N)[:2])

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -self.gravity * motion.N.y)

    def configuration_constraints(self, t, q):
        x = q["x"] - self.crank * jnp.cos(q["a"]) - self.rod * jnp.cos(q["b"])
        return [x, self.crank * jnp.sin(q["a"]) + self.rod * jnp.sin(q["b"])]


def four_bar(L, M, T, dtype=jnp.float64):
    number = lambda x: jnp.asarray(x, dtype)  # noqa: E731
    system = FourBar(*(number(x * L) for x in (1.0, 0.3, 0.9, 0.7)), number(M / L))
    return system, {"q1": number(0.5), "q2": number(1.0), "q3": number(2.0)}, L ** np.zeros(3)


def slider_crank(L, M, T, dtype=jnp.float64):
    number = lambda x: jnp.asarray(x, dtype)  # noqa: E731
    system = SliderCrank(number(0.1 * L), number(0.3 * L), number(M), number(9.81 * L / T**2))
    return system, {"a": number(1.0)}, L ** np.array([1.0, 0.0, 0.0])


SYSTEMS = [four_bar, slider_crank]


@pytest.mark.slow_cases("four_bar")
@pytest.mark.parametrize("make", SYSTEMS)
def test_assembly_does_not_depend_on_the_units(make):
    system, named, _ = make(1.0, 1.0, 1.0)
    q = np.asarray(jk.assemble(system, named).q)
    for factors in FACTORS:
        scaled, named, units = make(*factors)
        found = jk.assemble(scaled, named)
        np.testing.assert_allclose(found.q / units, q, rtol=RTOL)
        open_loop = np.asarray(found.q) * (1 + np.array([0.0, 1e-3, 0.0]))
        with pytest.raises(ValueError, match="violate the configuration constraints"):
            jk.simulate(scaled, jk.State(open_loop, found.u), factors[2] * np.linspace(0.0, 1.0, 3))
        nine_digits = [float(f"{x:.9g}") for x in found.q]
        assert jk.simulate(scaled, jk.State(nine_digits, found.u), factors[2] * np.linspace(0.0, 1.0, 3)).ok
        rate = {scaled.speeds[0]: 1 / factors[2]}
        speeds = np.asarray(jk.dependent_speeds(scaled, 0.0, found.q, [*rate.values()]))
        given = dict(zip(scaled.dependent_speeds, speeds, strict=True))
        assert jk.assemble(scaled, named, rate | given).u == 1 / factors[2]
        with pytest.raises(ValueError, match="contradicts the velocity constraints"):
            jk.assemble(scaled, named, rate | {name: 2 * x for name, x in given.items()})


@pytest.mark.slow
@pytest.mark.parametrize("make", SYSTEMS)
def test_best_dependent_speeds_do_not_depend_on_the_units(make):
    system, named, _ = make(1.0, 1.0, 1.0)
    best = jk.best_dependent_speeds(system, 0.0, jk.assemble(system, named).q)
    assert best.rank == 2
    for factors in FACTORS:
        scaled, named, _ = make(*factors)
        found = jk.best_dependent_speeds(scaled, 0.0, jk.assemble(scaled, named).q)
        assert (found.rank, found.redundant, [x for x, _ in found.choices]) == (2, (), [x for x, _ in best.choices])
        np.testing.assert_allclose([x for _, x in found.choices], [x for _, x in best.choices], rtol=RTOL)


@pytest.mark.slow
@pytest.mark.parametrize("make", SYSTEMS)
def test_assembly_in_float32_does_not_depend_on_the_units(make):
    guess = {four_bar: [0.5, 1.0, 2.0], slider_crank: [0.0, 1.0, 0.0]}[make]
    first = None
    for L in (1.0, 1e-9, 1e9):
        system, _, units = make(L, 1.0, 1.0, jnp.float32)
        found = jk.assemble(system, jnp.asarray(guess * units, jnp.float32))
        assert found.q.dtype == jnp.float32
        q = np.asarray(found.q / units.astype(np.float32))
        first = q if first is None else first
        np.testing.assert_allclose(q, first, rtol=2e-6)
        best = jk.best_dependent_speeds(system, 0.0, found.q)
        assert (best.rank, best.current) == (2, system.dependent_speeds)


@pytest.mark.slow_cases(all_but=["slider_crank-options1"])
@pytest.mark.parametrize(
    ("make", "options"),
    [
        (four_bar, {"project": True}),
        (slider_crank, {"stabilize": 10.0}),
        pytest.param(four_bar, {"stabilize": 10.0}, marks=pytest.mark.weekly),
        pytest.param(slider_crank, {"project": True}, marks=pytest.mark.weekly),
    ],
)
def test_projection_and_stabilization_do_not_depend_on_the_units(make, options):
    """One program for all units: from a state that is off by 1e-7 of its terms. A gain [1/s] is static."""

    @jax.jit
    def simulate(factors):
        L, M, T = factors
        T = T if "project" in options else jnp.ones(())
        system, named, units = make(L, M, T)
        state = jk.assemble(system, named, {system.speeds[0]: 1.0 / T})
        state = jk.State(state.q * jnp.array([1.0 + 1e-7, 1.0, 1.0]), state.u)
        ts = T * jnp.linspace(0.0, 0.5, 3)
        return jk.simulate(system, state, ts, step=0.01 * T, adjoint="forward", **options).q / units[None]

    right = simulate(jnp.ones(3))
    assert np.isfinite(right).all()
    for factors in FACTORS:
        np.testing.assert_allclose(simulate(jnp.array(factors)), right, rtol=1e-9)


class Doubled(jk.System):
    """A point on a rod whose velocity is given, rightly or doubled."""

    length: jk.Scalar = jk.parameter(1.0)
    factor: jk.Scalar = jk.parameter(1.0)
    coordinates, speeds = ("a",), ("a_rate",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        r = self.length * (jnp.cos(q["a"]) * N.x + jnp.sin(q["a"]) * N.y)
        v = self.factor * self.length * u["a_rate"] * (jnp.cos(q["a"]) * N.y - jnp.sin(q["a"]) * N.x)
        return jk.Motion([jk.Body(1.0, 0.0, O.moving(r, v))])


@pytest.mark.parametrize("L", [1e-9, 1.0, 1e9])
def test_a_doubled_velocity_is_refused_in_any_unit(L):
    right, wrong = (type("Fresh", (Doubled,), {})(L, factor) for factor in (1.0, 2.0))  # checked once for each class
    assert np.isfinite(jk.accelerations(right, 0.0, [0.3], [0.5]))
    with pytest.raises(ValueError, match="moves with"):
        jk.accelerations(wrong, 0.0, [0.3], [0.5])
