"""Equations as formulas: what the library computes, what the book prints, and what stays small."""

import sys

import equinox as eqx
import numpy as np
import pytest
from mechanisms import Bob, Odd, RodOnPin, case

import jaxkane as jk
from jaxkane.catalog import CATALOG

sp = pytest.importorskip("sympy")
pytestmark = pytest.mark.filterwarnings("ignore:.*its description uses")


def assert_close(found, expected, rtol):
    expected = np.asarray(expected)
    found = np.asarray(found, float).reshape(expected.shape)
    np.testing.assert_allclose(found, expected, rtol=0, atol=rtol * np.abs(expected).max(initial=1e-3))


def numbers_of(system):
    return [x for array in jk.export.parameters(system).values() for x in array.ravel()]


FAST = ["DoublePendulum", "SpinningTop", "Bob", "Odd"]
SLOW = [pytest.param(name, marks=pytest.mark.weekly) for name in CATALOG if name not in FAST]


@pytest.mark.slow_cases(all_but=["DoublePendulum", "Bob"])
@pytest.mark.parametrize("name", [*FAST, *SLOW])
def test_symbolic_equations_agree_with_the_numerical_ones(name):
    """At three random states about the case's own, off the constraints too: formulas know of all coordinates."""
    rtol = 1e-13
    system, t, q, u, w = case(name)
    found = jk.symbolic.equations(system)
    matrices = [found.M, found.f, found.q_dot, *found.V, *found.W, found.configuration_constraints]
    if system.dependent_speeds:
        matrices += [found.J, found.J_dot, sp.Matrix(found.u_dep), found.velocity_constraints]
    of_numbers = sp.lambdify(found.arguments, matrices, cse=found.cse)
    rng = np.random.default_rng(0)
    for _ in range(3):
        q, u, w = (x + rng.uniform(-0.1, 0.1, x.shape) for x in (q, u, w))
        if "e4" in system.coordinates:  # Euler parameters, which turn frames, come last
            q = np.concatenate([q[:-4], q[-4:] / np.linalg.norm(q[-4:])])
        M, f, q_dot, *rest = of_numbers(t, *q, *u, *w, *numbers_of(system))
        now = (system, t, q, u)
        inputs = dict(zip(system.inputs, w, strict=True))
        expected = jk.equations_of_motion(*now, inputs)
        assert_close(M, expected[0], rtol)
        assert_close(f, expected[1], rtol)
        assert_close(q_dot, jk.coordinate_rates(*now), rtol)
        b = len(found.V)
        V, W = jk.partial_velocities(*now, inputs)
        assert_close(np.array(rest[: 2 * b], float).reshape(2, *V.shape), [V, W], rtol)
        h = np.asarray(system.configuration_constraints(t, [*q]), float)
        assert_close(rest[2 * b], h, 1e-12)
        if system.dependent_speeds:
            J, J_dot, u_dep, c = rest[2 * b + 1 :]
            assert_close(J, jk.constraint_jacobian(system, t, q), rtol)
            assert_close(J_dot, jk.constraint_jacobian_rate(*now), rtol)
            assert_close(u_dep, jk.dependent_speeds(*now), rtol)
            np.testing.assert_allclose(np.ravel(c), 0.0, atol=1e-12)


@pytest.mark.slow
def test_simplified_equations_equal_those_of_the_book():
    m, l = (jk.symbolic.equations(CATALOG["DoublePendulum"].example()).symbols[name] for name in ("mass", "length"))
    found = jk.symbolic.equations(CATALOG["DoublePendulum"].example()).simplified()
    th1, th2 = found.q
    half = m * l**2 * sp.cos(th1 - th2) / 2
    assert found.M == sp.ImmutableMatrix([[4 * m * l**2 / 3, half], [half, m * l**2 / 3]])
    assert str(found) == "Equations of DoublePendulum: M (2, 2), f (2, 1); 106 operations"
    latex = found._repr_latex_()
    assert r"\frac{4 \mathit{length}^{2} \mathit{mass}}{3}" in latex
    assert r"\left[\begin{matrix}\ddot{\theta}_{1}\\\ddot{\theta}_{2}\end{matrix}\right]" in latex
    assert latex.startswith(r"$\displaystyle \begin{aligned}")


class Pulled(jk.System):
    """A particle that is pulled by constant numbers, with names of all kinds."""

    mB: jk.Scalar = jk.parameter(2.0)
    I33: jk.Scalar = jk.parameter(1.0)
    IBxx: jk.Scalar = jk.parameter(1.0)
    engine_mass: jk.Scalar = jk.parameter(1.0)
    numbers: tuple = eqx.field(static=True, default=(0.0,))
    coordinates, speeds = ("theta1", "x"), ("omega2", "roll_rate")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        P = O.moving(q["theta1"] * N.x + q["x"] * N.y, u["omega2"] * N.x + u["roll_rate"] * N.y)
        return jk.Motion([jk.Body(self.mB, 0.0, P, name="P")])

    def loads(self, t, q, u, motion, inputs):
        factor = self.I33 * self.IBxx * self.engine_mass
        return [jk.Force(number * factor * motion.N.x, motion["P"]) for number in self.numbers]


def test_names_in_latex():
    latex = jk.symbolic.equations(Pulled(numbers=(1.0,)))._repr_latex_()
    for name in ("m_{B}", "I_{33}", r"\mathit{IBxx}", r"\mathit{engine\_mass}", r"\dot{\omega}_{2}"):
        assert name in latex
    assert r"\dot{\mathit{roll\_rate}}" in latex


@pytest.mark.parametrize(
    ("number", "text"),
    {
        0.5: "1/2",
        1 / 12: "1/12",
        9.81: "981/100",
        0.1 + 0.2: "0.30000000000000004",
        1e-7: "1/10000000",
        np.pi: "pi",
        np.pi / 180: "pi/180",
    }.items(),
)
def test_numbers_become_small_fractions_if_these_round_to_them(number, text):
    found = jk.symbolic.equations(Pulled(numbers=(number,)))
    factor = found.symbols["I33"] * found.symbols["IBxx"] * found.symbols["engine_mass"]
    assert str(sp.expand(found.f[0] / factor)) == text


def test_a_parameter_named_like_a_coordinate_has_its_own_symbol():
    found = jk.symbolic.equations(Odd())
    assert found.symbols["angle"] in found.q
    assert found.symbols["angle_"] in found.parameters
    assert len({*found.arguments}) == len(found.arguments)
    assert found.symbols["register"].is_positive
    assert found.symbols["θ0"].is_positive is None
    assert {s.name for s in found.parameters} >= {"moments[0]", "moments[2]", "part.mass"}
    taken = {s.name for s in found.arguments}
    named = [s.name for s, _ in jk.symbolic.equations(Odd(), whole=False).replacements]
    assert named
    assert not taken & {*named}, "x0 is a coordinate"


def test_coordinates_as_functions_of_time_can_be_differentiated():
    found = jk.symbolic.equations(CATALOG["SliderWithPinnedBar"].example(), of_time=True)
    x, theta = found.q
    assert str(x.diff(found.t)) == "Derivative(x(t), t)"
    assert found.M[0, 1].diff(found.t).has(theta.diff(found.t))
    assert r"\dot{x}" in found._repr_latex_()


def test_dependent_speeds_are_symbols_and_the_first_replacements():
    found = jk.symbolic.equations(Bob())
    ((vy, formula),) = found.replacements
    x, y = found.q
    assert sp.simplify(formula + x * found.u[0] / y) == 0
    assert found.u_dep == (vy,)
    assert found.q_dot == sp.ImmutableMatrix([found.u[0], vy])
    assert found.velocity_constraints == sp.ImmutableMatrix([2 * x * found.u[0] + 2 * y * vy])
    assert sp.simplify(found.J[0] + x / y) == 0
    simple = found.simplified()
    # d/dt (-x / y) = -vx / y + x vy / y^2
    assert sp.simplify(simple.J_dot[0] - (x * vy - y * found.u[0]) / y**2) == 0
    assert found.operations["J"] <= 5 < found.operations["all"]


@pytest.mark.slow
def test_equations_of_a_large_system_use_common_subexpressions():
    """The bicycle's tree has more operations than could be counted one by one; its replacements no more than nodes."""
    bicycle = CATALOG["WhippleBicycle"].example()
    found = jk.symbolic.equations(bicycle)
    assert not found.is_whole
    assert [s.name for s, _ in found.replacements if s in found.u_dep] == [
        *sorted(bicycle.dependent_speeds, key=[s.name for s, _ in found.replacements].index)
    ]
    written = sum(sp.count_ops(x) for _, x in found.replacements) + sum(map(sp.count_ops, (*found.M, *found.f)))
    assert written < 2 * found.operations["all"] < 8000
    known = {*found.arguments}
    for symbol, x in found.replacements:
        assert x.free_symbols <= known
        known.add(symbol)
    with pytest.raises(ValueError, match=r"too many for sympy\.simplify"):
        found.simplified()
    assert len(found._repr_latex_()) < 200


# Linear models


def test_the_linear_model_of_a_pendulum_equals_that_of_the_book():
    model = jk.symbolic.linearize(CATALOG["DoublePendulum"].example(), {"theta1": 0.0}).simplified()
    g, l = model.symbols["gravity"], model.symbols["length"]
    assert model.states == ("theta1", "theta2", "theta1_dot", "theta2_dot")
    assert model.A[2:, :2] == sp.ImmutableMatrix([[-18, 9], [27, -24]]) * g / (7 * l)
    m = model.symbols["mass"]
    # M^-1 (M1 - M2, M2) with M = m l^2 [[4/3, 1/2], [1/2, 1/3]]
    assert model.B[2:, :] == sp.ImmutableMatrix([[12, -30], [-18, 66]]) / (7 * m * l**2)
    assert r"\ddot{\theta}_{1}" in model._repr_latex_()


def at_numbers(model, system, **more):
    values = {model.symbols[name]: x for name, x in jk.export.parameters(system).items()}
    values |= {sp.Symbol(name, real=True): x for name, x in more.items()}
    f = sp.lambdify([*values], [model.A, model.B], cse=model.cse)
    return [np.asarray(x, float) for x in f(*values.values())]


def test_a_linear_model_with_a_constraint():
    model = jk.symbolic.linearize(Bob(), {"y": "-length"}, states=("x", "vx"))
    assert str(sp.simplify(model.A)) == "Matrix([[0, 1], [-981/(100*length), 0]])"


def test_a_linear_model_with_dependent_coordinates():
    """A rod of 5 m, pushed aside by 3 m: (y', v') = (v, -g / x y), the mass along y is m l^2 / x^2."""
    rod = RodOnPin(5.0)
    at = {"y": 3, "x": 4, "push": "147/10", "length": 5}
    A, B = at_numbers(jk.symbolic.linearize(rod, at, states=("y", "v")), rod)
    assert_close(A, [[0.0, 1.0], [-9.8 / 4.0, 0.0]], 1e-12)
    assert_close(B, [[0.0], [0.5 * 16.0 / 25.0]], 1e-12)


@pytest.mark.weekly
def test_the_linear_model_of_the_bicycle_in_its_speed():
    rtol = 1e-12
    bicycle = CATALOG["WhippleBicycle"].example()
    model = jk.symbolic.linearize(bicycle, {"rear_wheel_rate": "-v/rR"})
    assert model.operations < 1000
    assert not model.A.has(sp.Piecewise, sp.nan)
    state = jk.assemble(bicycle, {}, {"rear_wheel_rate": -4.6 / bicycle.rR})
    expected = jk.stability.linearize(bicycle, state)
    assert model.states == expected.states
    A, B = at_numbers(model, bicycle, v=4.6)
    assert_close(A, expected.A, rtol)
    assert_close(B, expected.B, rtol)
    with pytest.raises(ValueError, match=r"too many for sympy\.simplify"):
        model.simplified()


def test_linearization_at_an_invalid_state_is_rejected():
    pendulum = CATALOG["DoublePendulum"].example()
    with pytest.raises(ValueError, match=r"not steady: theta1_dot is accelerated by .*steady=False"):
        jk.symbolic.linearize(pendulum, {"theta1": 1})
    jk.symbolic.linearize(pendulum, {"theta1": 1}, steady=False)
    with pytest.raises(ValueError, match=r"not steady: configuration constraint 0 is violated by 1\.25"):
        jk.symbolic.linearize(Bob(), {"y": 1.5})
    with pytest.raises(ValueError, match="division by zero"):
        jk.symbolic.linearize(CATALOG["LightShaftAndBar"].example())
    with pytest.raises(ValueError, match="has no theta3; did you mean"):
        jk.symbolic.linearize(pendulum, {"theta3": 1})
    with pytest.raises(ValueError, match="at` defines theta2 = theta1, but theta1 has its own value"):
        jk.symbolic.linearize(pendulum, {"theta2": "theta1"})
    for strange in ("1 +", "theta1 > 1", "I*v", None, float("nan"), "1/0"):
        with pytest.raises(ValueError, match=r"DoublePendulum: `at` has theta2 = .* neither a finite number nor"):
            jk.symbolic.linearize(pendulum, {"theta2": strange})
    with pytest.raises(ValueError, match="not a possible state: mass"):
        jk.symbolic.linearize(pendulum, states=("mass",))
    with pytest.raises(ValueError, match=r"1 configuration constraints .* 0 are named"):
        jk.symbolic.linearize(Bob(), {"y": -1}, dependent=())


def test_the_error_without_sympy_states_the_package_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "sympy", None)
    with pytest.raises(ImportError, match=r'pip install "jaxkane\[symbolic\]"'):
        jk.symbolic.equations(Bob())
