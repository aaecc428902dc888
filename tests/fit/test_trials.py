"""Trials and problems: their arguments, windows of trials, and error messages that name invalid data."""

import io

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

from jaxkane.catalog import DoublePendulum, WhippleBicycle
from jaxkane.fit import Free, Gain, Inertia, Offset, Problem, Trial, bicycle_problem, fit_bicycle
from jaxkane.sweep import grid

t = np.linspace(0.0, 1.0, 11)
good = np.sin(t)


def trial(**changes):
    arguments = {"t": t, "measured": {"theta1": good}, "sigma": 0.1, "name": "swing 3"} | changes
    return Trial(**arguments)


def masked(values, *places):
    return np.ma.array(values, mask=np.isin(np.arange(11), places))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"measured": {"theta1": good[:-1]}}, r"swing 3: measured\['theta1'\] has the shape \(10,\)"),
        ({"t": t[:, None]}, r"swing 3: `t` must be at least two times"),
        ({"t": t[::-1]}, "swing 3: the times are unsorted: t.0. = 1 "),
        ({"t": np.where(t == t[3], t[2], t)}, "swing 3: the times are repeated"),
        ({"t": np.where(t == t[3], np.nan, t)}, r"swing 3: t\[3\] is not finite"),
        ({"t": masked(t, 3)}, r"t\[3\] is not finite"),
        ({"measured": {"theta1": ["a"] * 11}}, r"swing 3: measured\['theta1'\] must be real numbers"),
        ({"measured": {"theta1": good + 1j}}, r"swing 3: measured\['theta1'\] must be real numbers"),
        ({"measured": {"theta1": np.where(t > 0.5, np.inf, good)}}, r"swing 3: measured\['theta1'\]\[6\] is infinite"),
        ({"measured": {"theta1": np.full(11, np.nan)}}, "swing 3: all measurements are NaN"),
        ({"measured": {}}, "swing 3: `measured` must be a nonempty dict"),
        ({"inputs": {"torque1": np.full(11, np.nan)}}, r"swing 3: inputs\['torque1'\]\[0\] is NaN"),
        ({"inputs": {"torque1": masked(t, 3)}}, r"inputs\['torque1'\]\[3\] is NaN"),
        ({"inputs": {"torque1": jnp.sin}}, r"got a function.*feedback.* into the system's `loads`"),
        ({"inputs": lambda t, state: {"torque1": 0.0}}, r"got a function.*feedback.* into the system's `loads`"),
        ({"initial": {"theta1": masked(t, 0)}}, r"initial\['theta1'\]\[0\] is NaN"),
        ({"sigma": {"theta2": 0.1}}, "swing 3: `sigma` has no value for theta1"),
        ({"sigma": {"theta1": masked(t + 2, 5)}}, r"sigma\['theta1'\]\[5\] is NaN"),
        ({"sigma": 0.0}, r"swing 3: sigma\['theta1'\] must be positive"),
        ({"labels": "anna"}, r"swing 3: `labels` must be a dict by name.*got str"),
        ({"labels": {"speed": (1.0, 2.0)}}, r"swing 3: labels\['speed'\] must be a real number"),
    ],
)
def test_an_invalid_trial_is_rejected(changes, message):
    with pytest.raises(ValueError, match=message):
        trial(**changes)


def test_masked_samples_are_missing_values():
    for values in (good, good.astype(np.float32), np.arange(11)):
        found = trial(measured={"theta1": masked(values, 2, 3)}).measured["theta1"]
        np.testing.assert_array_equal(np.isnan(found), np.isin(np.arange(11), (2, 3)))
        np.testing.assert_allclose(found[4:], values[4:])
    with pytest.raises(ValueError, match="'mass' has masked entries"):
        grid(mass=masked(t, 1))


def test_a_trial_is_cut_between_two_times_and_keeps_its_labels():
    whole = trial(inputs={"torque1": 2.0}, labels={"rider": "anna", "speed": np.float32(4)})
    cut = whole.between(0.25, 0.55)
    np.testing.assert_allclose(cut.t, [0.3, 0.4, 0.5])
    assert cut.inputs["torque1"].shape == (3,)
    assert cut.labels == whole.with_initial_state({"theta1": 0.0}).labels == {"rider": "anna", "speed": 4.0}
    with pytest.raises(ValueError, match="swing 3: fewer than two samples are between 5 and 6 s"):
        whole.between(5.0, 6.0)


def test_trials_from_a_data_frame_with_gaps():
    frame = pd.DataFrame(
        {"run": list("aabbb"), "t": [0, 0.1, 0, 0.1, 0.2], "angle": [1, np.nan, np.nan, 4, 5], "T": range(5), "w": 0.5}
    )
    a, b = (
        Trial.from_dataframe(run, {"theta1": "angle"}, {"torque1": "T"}, initial={"rate1": "w"}, sigma=0.1, name=key)
        for key, run in frame.groupby("run")
    )
    assert (a.name, b.name) == ("a", "b")
    np.testing.assert_array_equal(a.measured["theta1"], [1.0, np.nan])
    np.testing.assert_array_equal(b.inputs["torque1"], [2.0, 3.0, 4.0])
    np.testing.assert_array_equal(b.initial["rate1"], [0.5] * 3)
    nullable = frame[2:].convert_dtypes().set_index("t")  # Float64 and Int64, with pandas.NA
    b = Trial.from_dataframe(nullable, ["angle"], ["T"], sigma=0.1)
    np.testing.assert_array_equal(b.t, [0.0, 0.1, 0.2])
    np.testing.assert_array_equal(b.measured["angle"], [np.nan, 4.0, 5.0])
    dates = frame[:2].assign(t=pd.to_datetime(["2024-01-01", "2024-01-02"]))
    with pytest.raises(ValueError, match=r"column 't' must be real numbers. It has the type datetime64"):
        Trial.from_dataframe(dates, ["angle"], sigma=0.1)
    twice = pd.DataFrame([[0.0, 1.0, 2.0]], columns=["t", "angle", "angle"])
    with pytest.raises(ValueError, match="more than one column has the name 'angle'"):
        Trial.from_dataframe(twice, ["angle"], sigma=0.1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,angle\n0,1\n0.1,x\n", "trial: column 'angle' must be real numbers.* contains 'x'.*pandas.to_numeric"),
        ("t,angle\n0,1_000\n", "contains '1_000'"),
        ('t,angle\n0,"1,5"\n', "contains '1,5'"),
        ("t,angle\n0,0x10\n", "contains '0x10'"),
        ("t,angle\n0,True\n", "column 'angle' must be real numbers. It has the type bool"),
        ("t,angle\n0,1+2j\n", r"contains '1\+2j'"),
        ("t,angle\n0,infinity\n0.1,1\n", r"measured\['theta1'\]\[0\] is infinite"),
        ("t,corner\n0,1\n", "trial: no column angle; the columns are t, corner"),
        ("t,angle\n0,1\n0,2\n", "the times are repeated"),
    ],
)
def test_an_invalid_column_is_rejected(text, message):
    with pytest.raises(ValueError, match=message):
        Trial.from_dataframe(pd.read_csv(io.StringIO(text)), {"theta1": "angle"}, sigma=0.1)


pendulum = DoublePendulum(mass=1.0, length=0.5)
OF_SECOND = ("mass", Offset("theta2", each="trial"))


@pytest.mark.parametrize(
    ("trials", "free", "options", "message"),
    [
        ([trial(measured={"roll": good})], "mass", {}, "swing 3: DoublePendulum has no channel roll"),
        ([trial(inputs={"wind": 1.0})], "mass", {}, "swing 3: DoublePendulum has no input wind"),
        ([trial(initial={"wind": 1.0})], "mass", {}, "has no coordinate, independent speed or state wind"),
        ([], "mass", {}, "`trials` is empty"),
        ([trial()], "weight", {}, "DoublePendulum has no parameter 'weight'; it has mass"),
        ([trial()], (), {}, "`free` contains no parameter"),
        ([trial()], Offset("theta1", each="trial"), {}, "`free` contains no parameter"),
        ([trial()], ("mass", lambda s: s.mass), {}, "sets mass more than once"),
        ([trial()], (Gain("theta1"), Gain("theta1", of="sensor", name="g")), {}, "`free` sets .* more than once"),
        ([trial()], Gain("wind"), {}, "has no input or channel wind"),
        ([trial()], OF_SECOND, {}, "offset of sensor with `each` needs samples of theta2"),
        ([trial()], "mass", {"unknown": ("roll",)}, "`unknown` contains unknown names: roll"),
        ([trial()], "mass", {"unknown": {"theta1": 0.0}}, "the standard deviation of theta1 must be positive"),
        ([trial()], "mass", {"window": 0.0}, "`window` must be a positive duration"),
        ([trial()], "mass", {"unknown": "theta1", "window": 0.5, "defect_std": {"theta1": -1.0}}, "`defect_std`: .*"),
        ([trial()], "mass", {"priors": {"mass": (1.0, -1.0)}}, "mass: `prior` must be"),
        ([trial()], "mass", {"window": 0.0999}, r"swing 3: the sample interval is 0\.1 s, so a `window` of 0\.0"),
    ],
)
def test_an_invalid_problem_is_rejected(trials, free, options, message):
    with pytest.raises(ValueError, match=message):
        Problem.of(pendulum, trials, free, **options)


def test_invalid_problems_of_bicycles_are_rejected():
    bicycle, ride = WhippleBicycle.benchmark(), Trial(t, {"roll": good}, sigma=0.1, initial={"speed": 5.0})
    with pytest.raises(ValueError, match="`trials` is empty"):
        fit_bicycle([], bicycle, "c")
    with pytest.raises(ValueError, match="WhippleBicycle has no channel theta1"):
        fit_bicycle(trial(initial={"speed": 5.0}), bicycle, "c")
    with pytest.raises(ValueError, match="ride: the speed is missing"):
        fit_bicycle(Trial(t, {"roll": good}, sigma=0.1, name="ride"), bicycle, "c")
    with pytest.raises(ValueError, match="`free` contains rR"):
        fit_bicycle(ride, bicycle, ("c", "rR"))
    with pytest.raises(ValueError, match="`moments` must be three names, got 'IBxx'"):
        bicycle_problem(ride, bicycle, Inertia("IBxx"))
    with pytest.raises(ValueError, match="Inertia: `prior` contains unknown names: IHxx; did you mean"):
        bicycle_problem(ride, bicycle, Inertia(("IBxx", "IByy", "IBzz"), prior={"IHxx": (1.0, 0.1)}))


@pytest.mark.slow
def test_parameters_by_name_path_and_leaf():
    free = ("mass", lambda s: s.length, Free("gravity", bounds=(9.0, 10.0), start=9.5))
    parameters = Problem.of(pendulum, trial(), free).parameters
    assert parameters.names == ("mass", "length", "gravity")
    np.testing.assert_allclose(parameters.values(jnp.zeros(3)), [1.0, 0.5, 9.5], rtol=1e-14)
    far = parameters.values(jnp.array([-20.0, 30.0, 50.0]))
    assert far[0] > 0
    assert far[2] <= 10.0
    system, gains = parameters.apply(pendulum, jnp.array([1.0, 0.0, 0.0]))
    assert float(system.mass) == pytest.approx(np.e)
    assert not gains


GAP = np.concatenate([np.arange(0.0, 1.0, 0.1), [3.1], np.arange(5.0, 6.0, 0.1)])


@pytest.mark.parametrize("times", [t, np.append(-1.0, t), GAP, t**2], ids=["even", "first alone", "gap", "uneven"])
@pytest.mark.parametrize("window", [0.1, 0.12, 0.25, 0.95, 3.0])
def test_no_window_loses_a_sample(times, window):
    places = Problem.of(pendulum, trial(t=times, measured={"theta1": np.sin(times)}), "mass", window=window).slices
    assert [i for _, first, n in places for i in range(first, first + n)] == [*range(len(times))]
    assert all(n > 1 for *_, n in places)


@pytest.mark.slow
def test_windows_cover_every_sample_once():
    problem = Problem.of(pendulum, [trial(), trial(t=2 * t)], "mass", window=0.4)
    assert problem.slices == ((0, 0, 4), (0, 4, 7), (1, 0, 2), (1, 2, 2), (1, 4, 2), (1, 6, 2), (1, 8, 3))
    times = 5.0 + 0.1 * np.arange(13)  # of which 5.3 - 5.0 is less than 0.3 by rounding
    problem = Problem.of(pendulum, trial(t=times, measured={"theta1": np.sin(times)}), "mass", window=0.3)
    assert problem.slices == ((0, 0, 3), (0, 3, 3), (0, 6, 3), (0, 9, 4))
    chained = {"window": 0.0999, "unknown": "theta1", "defect_std": {}}
    assert len(Problem.of(pendulum, trial(), "mass", **chained).slices) == 10
