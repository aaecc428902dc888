"""Grids and tables: members by name, results with an axis for every name."""

import dataclasses

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from mechanisms import RodOnPin

import jaxkane as jk
from jaxkane.catalog import DoublePendulum, WhippleBicycle

PENDULUM = DoublePendulum(mass=1.0, length=1.0)
REST = jk.State(np.zeros(2), np.zeros(2))
TS = np.linspace(0.0, 1.0, 6)
STEPS = {"step": 0.05, "solver": diffrax.Midpoint()}  # enough to compare members
GRID = jk.sweep.grid(theta1=np.linspace(0.1, 1.0, 12), mass=[1.0, 2.0, 3.0], elbow_torque=[0.0, 0.5])


def largest(ride):
    return {"largest": jnp.max(jnp.abs(ride["theta2"])), "end": ride.q[-1]}


@pytest.fixture(scope="module")
def rides():
    return jk.sweep.sweep(PENDULUM, REST, TS, table=GRID, chunk=32, **STEPS)


def test_a_grid_has_an_axis_for_every_name(rides):
    assert GRID.dims == rides.dims == ("theta1", "mass", "elbow_torque")
    assert rides.shape == rides.status.shape == (12, 3, 2)
    assert rides["theta2"].shape == rides.t.shape == (12, 3, 2, 6)
    assert rides.names[0] == ("theta1", "theta2")
    np.testing.assert_array_equal(rides["mass"][0, :, 0], [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(rides["theta1"][..., 0], rides.table["theta1"].reshape(12, 3, 2))
    assert repr(rides) == "Sweep(72 members: theta1 (12) x mass (3) x elbow_torque (2); 72 completed)"


@pytest.mark.slow
def test_members_of_a_grid_equal_separate_simulations(rides):
    state = jk.State(np.array([GRID.axis("theta1")[7], 0.0]), np.zeros(2))
    alone = jk.simulate(DoublePendulum(mass=3.0, length=1.0), state, TS, {"elbow_torque": 0.5}, **STEPS)
    np.testing.assert_allclose(rides.member(7, 2, 1).q, alone.q, atol=1e-12)
    np.testing.assert_allclose(rides.member(7, 2, 1).end.q, alone.end.q, atol=1e-12)
    assert int(rides.stats["steps"][7, 2, 1]) == int(alone.stats["steps"])
    np.testing.assert_allclose(rides["elbow_torque"][7, 2, 1], 0.5)
    with pytest.raises(ValueError, match="3 indices"):
        rides.member(7)


@pytest.mark.slow
def test_reduced_values_equal_those_computed_from_trajectories(rides):
    kept = jk.sweep.sweep(PENDULUM, REST, TS, table=GRID, chunk=32, reduce=largest, **STEPS)
    np.testing.assert_array_equal(kept["largest"], np.abs(rides["theta2"]).max(axis=-1))
    np.testing.assert_array_equal(kept["end"], rides.q[..., -1, :])
    np.testing.assert_array_equal(kept.status, rides.status)
    with pytest.raises(AttributeError, match="no trajectories, because `reduce` was passed"):
        _ = kept.q
    with pytest.raises(KeyError, match=r"did you mean .theta1"):
        _ = kept["theta2"]


def test_xarray(rides):
    pytest.importorskip("xarray")
    data = rides.to_xarray()
    assert dict(data.sizes) == {"initial theta1": 12, "mass": 3, "elbow_torque": 2, "t": 6}
    np.testing.assert_array_equal(
        data["theta2"].sel(mass=2.0, elbow_torque=0.5).isel({"initial theta1": 4}), rides["theta2"][4, 1, 1]
    )
    np.testing.assert_array_equal(data["t"], TS)
    assert (data["status"] == jk.Status.COMPLETED).all()


@pytest.mark.weekly
def test_a_table_with_labels_and_an_initial_state_function():
    table = {"rider": ["a", "b", "c"], "push": [0.1, 0.2, 0.3], "length": [1, 2, 3]}

    def start(system, row):  # pushed the harder, the longer it is
        return jk.assemble(system, {"theta1": row["push"] * system.length})

    swept = jk.sweep.sweep(PENDULUM, start, TS, table=table)
    assert swept.dims == ("member",)
    assert list(swept["rider"]) == ["a", "b", "c"]
    np.testing.assert_allclose(swept["theta1"][:, 0], [0.1, 0.4, 0.9])
    alone = jk.simulate(dataclasses.replace(PENDULUM, length=3.0), jk.State(np.array([0.9, 0.0]), np.zeros(2)), TS)
    np.testing.assert_allclose(swept.q[2], alone.q, atol=1e-12)
    by_system = jk.sweep.sweep(lambda row: DoublePendulum(1.0, row["length"]), start, TS, table=table)
    np.testing.assert_allclose(by_system.q, swept.q, atol=1e-12)
    pandas = pytest.importorskip("pandas")
    np.testing.assert_array_equal(jk.sweep.sweep(PENDULUM, start, TS, table=pandas.DataFrame(table)).q, swept.q)


@pytest.mark.slow
def test_dependent_coordinates_are_assembled_for_each_parameter_value():
    start, lengths = jk.State([0.3, 0.95], [0.0]), np.array([1.0, 1.2])
    rides = jk.sweep.sweep(RodOnPin(1.0), start, [0.0, 0.05], table={"length": lengths}, **STEPS)
    np.testing.assert_allclose(rides.q[:, 0], np.stack([[0.3, 0.3], np.sqrt(lengths**2 - 0.3**2)], 1), rtol=1e-12)


@pytest.mark.weekly
def test_dependent_coordinates_are_recomputed_for_each_member():
    bicycle = WhippleBicycle.benchmark()
    upright = jk.State(np.zeros(8), np.array([0.0, -15.0, 0.0]))
    leant = jk.sweep.sweep(bicycle, upright, [0.0, 0.01], table=jk.sweep.grid(roll=[0.0, 0.2], steer=[0.1, 0.4]))
    assert leant.ok.all()
    right = jk.assemble(bicycle, {"roll": 0.2, "steer": 0.4}, {"rear_wheel_rate": -15.0})
    np.testing.assert_allclose(leant["pitch"][1, 1, 0], right.q[4], atol=1e-12)
    with pytest.raises(ValueError, match="WhippleBicycle: pitch is computed from the others"):
        jk.sweep.sweep(bicycle, upright, [0.0, 0.01], table={"pitch": [0.0, 0.1]})


@pytest.mark.weekly
def test_sweeps_have_derivatives():
    rtol = 1e-6

    def ends(length):
        state = jk.State(np.ones(2), np.zeros(2))
        return jk.sweep.sweep(DoublePendulum(1.0, length), state, TS, adjoint="forward", step=0.05).u[:, -1]

    length, step = jnp.array([1.0, 2.0]), 1e-5
    both = jax.jit(lambda x: jax.jvp(ends, (x,), (jnp.ones(2),)))
    numeric = (both(length + step)[0] - both(length - step)[0]) / (2 * step)
    np.testing.assert_allclose(both(length)[1], numeric, rtol=rtol)


@pytest.mark.parametrize(
    ("table", "error", "message"),
    [
        ({"speed": [1.0, 2.0]}, ValueError, r"DoublePendulum: speed has no effect: .* reads row\['speed'\]"),
        ({"mass": [1.0, 2.0], "length": [1.0]}, ValueError, r"differ in length: mass \(2\), length \(1\)"),
        ({"mass": [None, 2.0]}, ValueError, "'mass' must be a row of numbers"),
        ({"mass": 3.0}, ValueError, "'mass' must be a row of numbers"),
        ({"rider": ["a", "b"]}, ValueError, "are text. Text only labels a member"),
        ({"mass": ["1.0", "2.0"], "theta1": [0.1, 0.2]}, ValueError, "'mass' .parameter. is text, .* of that name"),
        ({"theta1": ["a", "b"], "mass": [1.0, 2.0]}, ValueError, "'theta1' .coordinate. is text, .* of that name"),
        ({"elbow_torque": ["1", "2"], "mass": [1.0, 2.0]}, ValueError, "'elbow_torque' .input. is text"),
        ({"mass": [1.0 + 2.0j, 2.0]}, ValueError, "'mass' must be a row of numbers"),
        ({"mass": np.array(["2020-01-01"] * 2, "datetime64[s]")}, ValueError, "'mass' must be a row of numbers"),
        ([1.0, 2.0], TypeError, "a dict of columns or a DataFrame; got list"),
        ({}, ValueError, "no columns"),
    ],
)
def test_tables_that_are_refused(table, error, message):
    with pytest.raises(error, match=message):
        jk.sweep.sweep(PENDULUM, REST, TS, table=table)


class Anchored(jk.System):
    """A particle at a vector (3,) from the origin of its line, on a spring."""

    mass: jk.Scalar = jk.parameter(1.0)
    x: jk.Scalar = jk.parameter(1.0)  # the spring's length, called as the coordinate
    anchor: Float[Array, " 3"] = jk.parameter((0.0, 0.0, 0.0), shape=(3,))
    coordinates, speeds = ("x",), ("v",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(self.mass, 0.0, O.moving(q[0] * N.x, u[0] * N.x))])

    def loads(self, t, q, u, motion, inputs):
        a, b, c = (self.anchor[i] for i in range(3))
        return [jk.Force((a + 2.0 * b + 3.0 * c - q[0]) * motion.N.x, motion.bodies[0])]


ANCHORED = jk.State(np.zeros(1), np.zeros(1))


@pytest.mark.slow
def test_one_array_as_a_batch_and_as_a_shared_vector():
    both = jnp.array([1.0, 2.0, 4.0])
    system = Anchored(mass=both, anchor=both)
    assert system.mass is system.anchor
    rides = jk.sweep.sweep(system, ANCHORED, [0.0, 0.05], step=0.05, solver=diffrax.Euler())
    np.testing.assert_allclose(rides["v"][:, -1], 0.05 * 17.0 / both, rtol=1e-12)


def test_an_ambiguous_column_is_rejected():
    with pytest.raises(
        ValueError, match=r"'x' \(parameter, coordinate\) is ambiguous: .* more than one number of that name"
    ):
        jk.sweep.sweep(Anchored(), ANCHORED, TS, table={"x": [1.0, 2.0]})


@pytest.mark.parametrize(
    "read",
    [
        lambda row: row.get("push"),
        lambda row: (lambda push: push)(**row),
        lambda row: {**row}["push"],
        lambda row: dict(row.items())["push"],
        lambda row: next(iter(row.values())),
    ],
)
def test_a_row_is_a_mapping(read):
    """A column that the function does not read would be refused."""

    def start(system, row):
        assert "push" in row
        return jk.State(jnp.stack([read(row), row.get("other", 0.0)]), jnp.zeros(2))

    none = jk.sweep.sweep(PENDULUM, start, TS, table={"push": []}, **STEPS)
    assert none.q.shape == (0, 6, 2)
    with pytest.raises(ValueError, match="push has no effect"):
        jk.sweep.sweep(PENDULUM, lambda system, row: REST, TS, table={"push": []}, **STEPS)


def test_grids_that_are_refused():
    with pytest.raises(ValueError, match="Pass values by name"):
        jk.sweep.grid()
    with pytest.raises(ValueError, match="lam must be a row of numbers"):
        jk.sweep.grid(lam=[[1.0], [2.0]])
    with pytest.raises(ValueError, match="elbow_torque is a column"):
        jk.sweep.sweep(PENDULUM, REST, TS, lambda t, state: {"elbow_torque": t}, table={"elbow_torque": [1.0, 2.0]})


@pytest.mark.slow
def test_a_column_read_by_a_function_is_not_assigned_by_name():
    table = {"theta1": [0.1, 0.2], "mass": [1.0, 2.0]}
    twice = jk.sweep.sweep(
        lambda row: dataclasses.replace(PENDULUM, mass=2.0 * row["mass"]),
        lambda system, row: jk.State(jnp.stack([2.0 * row["theta1"], jnp.zeros(())]), jnp.zeros(2)),
        TS,
        table=table,
        **STEPS,
    )
    state = jk.State(np.array([0.4, 0.0]), np.zeros(2))
    alone = jk.simulate(dataclasses.replace(PENDULUM, mass=4.0), state, TS, **STEPS)
    np.testing.assert_allclose(twice["theta1"][:, 0], [0.2, 0.4])
    np.testing.assert_allclose(twice.q[1], alone.q, atol=1e-12)


@pytest.mark.parametrize("values", [[True, False], np.array([True, False]), [True, 2.0]])
def test_boolean_columns_are_rejected(values):
    for make in (
        lambda: jk.sweep.grid(mass=values),
        lambda: jk.sweep.sweep(PENDULUM, REST, TS, table={"mass": values}),
    ):
        with pytest.raises(ValueError, match=r"'mass' must be a row of numbers.* Write booleans as numbers"):
            make()
