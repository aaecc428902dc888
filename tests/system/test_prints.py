"""Public objects print their numbers by name with units, and the shapes of batched and traced arrays."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane import bicycles, estimate, stability, sweep


class Cart(jk.System):
    """A cart on a spring and a damper, pulled by a force."""

    mass: jk.Scalar = jk.parameter(2.0, positive=True, unit="kg")
    rates: jax.Array = jk.parameter([8.0, 0.5], unit="N/m")  # stiffness, and damping with another unit
    coordinates, speeds, inputs = ("x",), ("x_dot",), ("pull",)
    units = {"x": "m", "pull": "N"}

    def motion(self, t, q, u):
        N, O = jk.inertial()
        box = jk.Body(self.mass, (0.1, 0.2, 0.2), O.moving(q["x"] * N.x, u["x_dot"] * N.x), N, name="box")
        return jk.Motion([box], points={"wall": O})

    def loads(self, t, q, u, motion, inputs):
        force = inputs["pull"] - self.rates[0] * q["x"] - self.rates[1] * u["x_dot"]
        return jk.Force(force * motion.N.x, motion["box"])


CART = Cart()
STATE = jk.State([0.25], [-1.5])


def test_systems_print_their_parameters_with_units():
    assert repr(CART) == "Cart(mass=2 kg, rates=[8, 0.5] N/m)"
    assert repr(Cart(mass=jnp.ones(3), rates=jnp.ones((3, 2)))) == "Cart(mass=f64[3], rates=f64[3,2])"
    text = repr(bicycles.Bicycle.benchmark())
    assert "mB=85 kg, IBxx=9.2 kg m^2," in text
    assert "f64" not in text
    assert max(map(len, text.splitlines())) <= 100


def test_parts_print_their_parameters_and_omit_empty_fields():
    tyre = bicycles.Tyre(crown=0.02, lateral=bicycles.LateralSlip(9000.0))
    assert repr(tyre) == "Tyre(crown=0.02 m, lateral=LateralSlip(cornering_stiffness=9000 N/rad))"
    path = bicycles.PathFollower(bicycles.LaneChange())
    assert repr(path).startswith("PathFollower(path=LaneChange(width=3 m, start=10 m, length=20 m), preview=2 s")

    class Learning(jk.System):
        friction: object = jk.learned(eqx.nn.Linear(2, 3, key=jax.random.key(0)))

    assert repr(Learning()) == "Learning(friction=Linear with 9 numbers)"


@pytest.mark.slow
def test_traced_values_print_their_shapes():
    found = []

    @jax.jit
    def traced(system, state, motion):
        found.extend(map(repr, (system, state, motion)))
        return state.q

    motion = stability.equilibrium(CART)
    traced(CART, STATE, motion)
    assert found[:2] == ["Cart(mass=f64[], rates=f64[2])", "State(q=f64[1], u=f64[1])"]
    assert found[2] == "SteadyMotion(shape=(): x, x_dot, pull)"
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), (STATE, motion))
    assert list(map(repr, batch)) == ["State(q=f64[2,1], u=f64[2,1])", "SteadyMotion(shape=(2,): x, x_dot, pull)"]


@pytest.mark.slow
def test_states_and_trajectories_print_their_numbers():
    assert repr(STATE) == "State(q=[0.25], u=[-1.5])"
    assert repr(jk.State({"x": 0.25}, {"x_dot": -0.0})) == "State(q={x: 0.25}, u={x_dot: 0})"
    still = jk.simulate(Cart(rates=jnp.zeros(2)), STATE, jnp.linspace(0.0, 1.0, 3))
    assert repr(still).splitlines()[1] == "At 1 s: x=-1.25 m, x_dot=-1.5 m/s"
    assert repr(jk.Samples([0.0, 2.0], [3.0, -1.0])) == "Samples(2 values from -1 to 3, at 0 to 2 s, linear)"


def test_motions_and_loads_print_vectors():
    motion = CART.motion(0.0, np.array([0.25]), np.array([-1.5]))
    assert repr(motion) == "Motion(bodies: box; points: wall; 0 velocity residuals)"
    assert repr(motion["box"]) == "Body(box, mass=2 kg, inertia=[0.1, 0.2, 0.2] kg m^2)"
    assert repr(CART.loads(0.0, [1.0], [0.0], motion, {"pull": 3.0})) == "Force(-5*N.x [N] at O')"
    assert repr(jk.Torque(0.5 * motion.N.z - 2.0 * motion.N.x, motion["box"])) == "Torque(-2*N.x + 0.5*N.z [N m])"
    assert repr(0.0 * motion.N.x) == "0"


def test_steady_motions_and_linear_models_print_values_and_eigenvalues():
    motion = stability.equilibrium(CART, {"x": 0.1}, {"pull": 4.0})
    assert repr(motion).startswith("SteadyMotion(x=0.5 m, x_dot=0 m/s, pull=4 N; t=0 s, residual=")
    model = stability.linearize(CART, motion)
    # x_ddot = -(8 x + 0.5 x_dot) / 2: -0.125 +- (4 - 0.125^2)^1/2 i
    assert repr(model).splitlines()[1] == "Eigenvalues [1/s]: -0.125 ± 1.996i"
    critical = eqx.tree_at(lambda m: m.A, model, jnp.array([[0.0, 1.0], [0.0, 0.0]]))
    assert repr(critical).endswith("[1/s]: 0, 0")  # a double eigenvalue is printed twice
    lost = eqx.tree_at(lambda m: m.A, model, jnp.full((2, 2), jnp.nan))
    assert repr(lost).endswith("[1/s]: NaN, NaN")
    batch = eqx.tree_at(lambda m: m.A, model, jnp.zeros((3, 2, 2)))
    assert repr(batch).endswith("A: f64[3,2,2]")


@pytest.mark.weekly
def test_eigenvalues_of_a_bicycle_print_the_first_and_the_last():
    bicycle = bicycles.Bicycle.benchmark()
    lines = repr(stability.eigenvalues(bicycle, np.linspace(0.0, 10.0, 41))).splitlines()
    # Meijaard et al. (2007), Table 2 and eq. (5.8): 5.53094371765393 and 3.13164324790656 at rest, signs +-
    assert lines[0] == "Eigenvalues(41 values of forward speed [m/s], weave, capsize, castering)"
    assert lines[1] == "[1/s] at 0: weave 5.531, 3.132; capsize -3.132; castering -5.531"
    canonical = stability.canonical(bicycle)
    assert repr(canonical).splitlines()[4] == "K2=[[0, 76.5973], [0, 2.65432]] kg"


def test_filters_print_their_sensors_and_beliefs():
    filter = estimate.Filter(CART, {"x": 0.01}, noise={"x_dot": 0.1}, drift={"mass": 0.0})
    text = "Filter(Cart; extended; lag=0, substeps=1; sensors: x=0.01 m; noise: x_dot=0.1; drift: mass=0)"
    assert repr(filter) == text
    belief = estimate.begin(filter, STATE, {"x": 0.1, "x_dot": 0.2, "mass": 0.5})
    assert repr(belief) == "Belief(t=0 s, mean=[0.25, -1.5, 2], deviation=[0.1, 0.2, 0.5])"
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), belief)
    assert repr(batch) == "Belief(t=f64[2,1], mean=f64[2,1,3], root=f64[2,1,3,3], rounding=f64[2])"


def test_tables_print_the_range_of_each_column():
    table = sweep.grid(mass=[1.0, 2.0], x=[0.5, 0.1, 0.3])
    assert repr(table) == "Table(6 members: mass 1 to 2 (2) x x 0.1 to 0.5 (3))"
