"""Bad input to trials, files and problems: one clear error each, which names the place."""

import io

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

from jaxkane.catalog import DoublePendulum, WhippleBicycle
from jaxkane.fit import (
    Delay,
    Free,
    Gain,
    GradientDescent,
    Inertia,
    LeastSquares,
    NoiseScale,
    Offset,
    Problem,
    Simulation,
    SpectralDensity,
    Trial,
    bicycle_problem,
    cross_validate,
    fit_bicycle,
    identifiability,
)
from jaxkane.fit.result.statistics import check_level

t = np.linspace(0.0, 1.0, 11)
good = np.sin(t)


def trial(**changes):
    arguments = {"t": t, "measured": {"theta1": good}, "sigma": 0.1, "name": "swing 3"} | changes
    return Trial(**arguments)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"measured": {"theta1": good[:-1]}}, r"swing 3: measured\['theta1'\] has the shape \(10,\)"),
        ({"t": t[:, None]}, r"swing 3: `t` must be at least two times"),
        ({"t": t[::-1]}, "swing 3: the times are unsorted: t.0. = 1 "),
        ({"t": np.where(t == t[3], t[2], t)}, "swing 3: the times are repeated"),
        ({"t": np.where(t == t[3], np.nan, t)}, r"swing 3: t\[3\] is not finite"),
        ({"measured": {"theta1": ["a"] * 11}}, r"swing 3: measured\['theta1'\] must be real numbers"),
        ({"measured": {"theta1": good + 1j}}, r"swing 3: measured\['theta1'\] must be real numbers"),
        ({"measured": {"theta1": np.where(t > 0.5, np.inf, good)}}, r"swing 3: measured\['theta1'\]\[6\] is infinite"),
        ({"measured": {"theta1": np.full(11, np.nan)}}, "swing 3: all measurements are NaN"),
        ({"measured": {}}, "swing 3: `measured` must be a nonempty dict"),
        ({"inputs": {"torque1": np.full(11, np.nan)}}, r"swing 3: inputs\['torque1'\]\[0\] is NaN"),
        ({"sigma": {"theta2": 0.1}}, "swing 3: `sigma` has no value for theta1"),
        ({"sigma": 0.0}, r"swing 3: sigma\['theta1'\] must be positive"),
    ],
)
def test_an_invalid_trial_is_rejected(changes, message):
    with pytest.raises(ValueError, match=message):
        trial(**changes)


def test_a_trial_is_cut_between_two_times():
    cut = trial(inputs={"torque1": 2.0}).between(0.25, 0.55)
    np.testing.assert_allclose(cut.t, [0.3, 0.4, 0.5])
    assert cut.inputs["torque1"].shape == (3,)
    with pytest.raises(ValueError, match="swing 3: fewer than two samples are between 5 and 6 s"):
        trial().between(5.0, 6.0)


FRAME = pd.DataFrame(
    {"run": list("aabbb"), "t": [0, 0.1, 0, 0.1, 0.2], "angle": [1, np.nan, np.nan, 4, 5], "T": range(5), "w": 0.5}
)


def test_trials_from_a_data_frame_with_gaps():
    a, b = (
        Trial.from_dataframe(run, {"theta1": "angle"}, {"torque1": "T"}, initial={"rate1": "w"}, sigma=0.1, name=key)
        for key, run in FRAME.groupby("run")
    )
    assert (a.name, b.name) == ("a", "b")
    np.testing.assert_array_equal(a.measured["theta1"], [1.0, np.nan])
    np.testing.assert_array_equal(b.inputs["torque1"], [2.0, 3.0, 4.0])
    np.testing.assert_array_equal(b.initial["rate1"], [0.5] * 3)


def test_data_frame_with_time_index_and_nullable_dtypes():
    frame = FRAME[2:].convert_dtypes().set_index("t")  # Float64 and Int64, with pandas.NA
    trial = Trial.from_dataframe(frame, ["angle"], ["T"], sigma=0.1)
    np.testing.assert_array_equal(trial.t, [0.0, 0.1, 0.2])
    np.testing.assert_array_equal(trial.measured["angle"], [np.nan, 4.0, 5.0])


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


def test_duplicate_column_names_and_dates_are_rejected():
    twice = pd.DataFrame([[0.0, 1.0, 2.0]], columns=["t", "angle", "angle"])
    with pytest.raises(ValueError, match="more than one column has the name 'angle'"):
        Trial.from_dataframe(twice, ["angle"], sigma=0.1)
    dates = FRAME[:2].assign(t=pd.to_datetime(["2024-01-01", "2024-01-02"]))
    with pytest.raises(ValueError, match=r"column 't' must be real numbers. It has the type datetime64"):
        Trial.from_dataframe(dates, ["angle"], sigma=0.1)


pendulum = DoublePendulum(mass=1.0, length=0.5)


@pytest.mark.parametrize(
    ("trials", "free", "options", "message"),
    [
        ([trial(measured={"roll": good})], "mass", {}, "swing 3: DoublePendulum has no channel roll"),
        ([trial(inputs={"wind": 1.0})], "mass", {}, "swing 3: DoublePendulum has no input wind"),
        ([trial(initial={"wind": 1.0})], "mass", {}, "has no coordinate, independent speed or state wind"),
        ([], "mass", {}, "`trials` is empty"),
        ([trial()], "weight", {}, "DoublePendulum has no parameter 'weight'; it has mass"),
        ([trial()], (), {}, "`free` contains no parameter"),
        ([trial()], ("mass", lambda s: s.mass), {}, "sets mass more than once"),
        ([trial()], Free("mass", bounds=(2.0, 3.0)), {}, "mass: the initial guess 1 is not inside its bounds"),
        ([trial()], Free("mass", prior=(1.0, 0.0)), {}, "mass: `prior` must be"),
        ([trial()], Gain("wind"), {}, "has no input or channel wind"),
        ([trial()], "mass", {"unknown": ("roll",)}, "`unknown` contains unknown names: roll"),
        (
            [trial()],
            ("mass", Offset("theta2", each="trial")),
            {},
            "offset of sensor with `each` needs samples of theta2",
        ),
        ([trial()], "mass", {"unknown": {"theta1": 0.0}}, "the standard deviation of theta1 must be positive"),
        ([trial()], "mass", {"window": 0.0}, "`window` must be a positive duration"),
    ],
)
def test_an_invalid_problem_is_rejected(trials, free, options, message):
    with pytest.raises(ValueError, match=message):
        Problem.of(pendulum, trials, free, **options)


def test_offsets_of_trials_alone_are_not_fitted():
    with pytest.raises(ValueError, match="`free` contains no parameter"):
        Problem.of(pendulum, trial(), Offset("theta1", each="trial"))


@pytest.mark.slow
def test_parameters_by_name_path_and_leaf():
    free = ("mass", lambda s: s.length, Free("gravity", bounds=(9.0, 10.0), start=9.5))
    parameters = Problem.of(pendulum, trial(), free).parameters
    assert parameters.names == ("mass", "length", "gravity")
    x = jnp.array([0.0, 0.0, 0.0])
    np.testing.assert_allclose(parameters.values(x), [1.0, 0.5, 9.5], rtol=1e-14)
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


@pytest.mark.parametrize("window", [0.05, 0.0999])
def test_a_window_shorter_than_the_samples_is_refused(window):
    with pytest.raises(
        ValueError, match=r"swing 3: the sample interval is 0\.1 s, so a `window` of 0\.0.* contains one sample"
    ):
        Problem.of(pendulum, trial(), "mass", window=window)
    assert len(Problem.of(pendulum, trial(), "mass", unknown="theta1", window=window, defect_std={}).slices) == 10


@pytest.mark.slow
def test_windows_cover_every_sample_once():
    problem = Problem.of(pendulum, [trial(), trial(t=2 * t)], "mass", window=0.4)
    assert problem.slices == ((0, 0, 4), (0, 4, 7), (1, 0, 2), (1, 2, 2), (1, 4, 2), (1, 6, 2), (1, 8, 3))
    assert int(jnp.sum(problem.windows.weight > 0)) == 22
    assert bool(jnp.all(jnp.diff(problem.windows.t_input, axis=1) > 0))
    times = 5.0 + 0.1 * np.arange(13)  # of which 5.3 - 5.0 is less than 0.3 by rounding
    problem = Problem.of(pendulum, trial(t=times, measured={"theta1": np.sin(times)}), "mass", window=0.3)
    assert problem.slices == ((0, 0, 3), (0, 3, 3), (0, 6, 3), (0, 9, 4))


ENTRIES = {
    "Free": lambda **more: Free("mass", **more),
    "Gain": lambda **more: Gain("shoulder_torque", **more),
    "Offset": lambda **more: Offset("theta1", **more),
    "Delay": lambda **more: Delay("shoulder_torque", **more),
    "SpectralDensity": lambda **more: SpectralDensity("theta1_dot", **more),
    "NoiseScale": lambda **more: NoiseScale("theta1", **more),
}
NAN, INF = float("nan"), float("inf")
NO_NUMBERS = ["text", "1.0", True, 1j, [1.0, 2.0], {}]


def pose(free="mass", trials=None, **options):
    options = {"simulation": Simulation(step=0.1), "noise": None} | options
    return Problem.of(pendulum, trial() if trials is None else trials, free, **options)


def entry(kind, **more):
    noise = {"theta1_dot": 1.0} if kind in ("SpectralDensity", "NoiseScale") else None
    return pose(ENTRIES[kind](**more), noise=noise)


def bicycle_ride(**more):
    return Trial(t, {"roll": good}, sigma=0.1, initial={"speed": 5.0}, **more)


@pytest.mark.slow_cases(all_but=["NoiseScale"])
@pytest.mark.parametrize("kind", ENTRIES)
def test_start_scale_bounds_and_prior_must_be_real_numbers(kind):
    for bad in NO_NUMBERS:
        for more in ({"start": bad}, {"scale": bad}, {"bounds": (bad, 50.0)}, {"bounds": (0.0, bad)}):
            with pytest.raises(ValueError, match=r"(`start`|`scale`|a bound) must be a real number, got"):
                entry(kind, **more)
        for prior in ((1.0, bad), (bad, 1.0)):
            with pytest.raises(ValueError, match=r"`prior` must be \(mean, standard deviation\) .*, got"):
                entry(kind, prior=prior)
    for bad in ("text", 1.0, (1.0,), (0.0, 1.0, 2.0), {}):
        with pytest.raises(ValueError, match=r"`bounds` must be \(lower, upper\)"):
            entry(kind, bounds=bad)
    with pytest.raises(ValueError, match=r"'normal' or 'lognormal', got|distributions over groups are not supported"):
        entry(kind, prior="text")
    for bad in (1.0, (1.0,), (1.0, -0.1), (1.0, 0.0), (NAN, 1.0), (1.0, NAN), (INF, 1.0)):
        with pytest.raises(ValueError, match=r"`prior` must be \(mean, standard deviation\) .*, got"):
            entry(kind, prior=bad)
    for more in (
        {"start": NAN},
        {"start": INF},
        {"scale": NAN},
        {"scale": INF},
        {"scale": -1.0},
        {"bounds": (NAN, 2.0)},
    ):
        with pytest.raises(
            ValueError, match=r"the initial guess|(`start`|`scale`) must be positive|the lower bound must"
        ):
            entry(kind, **more)


@pytest.mark.parametrize("bad", [*NO_NUMBERS, NAN, -1.0], ids=str)
@pytest.mark.parametrize(
    ("ask", "named"),
    [
        (lambda x: trial(sigma=x), r"sigma"),
        (lambda x: trial(sigma={"theta1": x}), r"sigma\['theta1'\]"),
        (lambda x: Simulation(step=x), "`step`"),
        (lambda x: Simulation(rtol=x), "`rtol`"),
        (lambda x: Simulation(max_steps=x), "`max_steps`"),
        (lambda x: pose(window=x), "`window`"),
        (lambda x: LeastSquares(rtol=x), "LeastSquares: `rtol`"),
        (lambda x: LeastSquares(damping=x), "LeastSquares: `damping`"),
        (lambda x: LeastSquares(horizons=(x,)), "LeastSquares: .*`horizons`"),
        (lambda x: GradientDescent(rtol=x), "GradientDescent: `rtol`"),
        (lambda x: check_level(x), "`level`"),
        (lambda x: pose(noise={"theta1_dot": x}), "`noise`.* of theta1_dot"),
        (lambda x: pose(unknown={"theta1": x}), "`unknown`: the standard deviation of theta1"),
        (
            lambda x: pose(unknown="theta1", window=0.5, defect_std={"theta1": x}),
            "`defect_std`: the standard deviation",
        ),
        (lambda x: pose(("mass", Gain("theta1", each="trial", prior=(1.0, x)))), "gain of theta1: `prior` must be"),
        (lambda x: pose(priors={"mass": (1.0, x)}), "mass: `prior` must be"),
        (lambda x: pose(Free("mass", tied={"length": x})), "`tied`: the factor of length"),
        (lambda x: bicycle_problem(bicycle_ride(), BICYCLE, "c", priors={"c": (1.0, x)}), "c: `prior` must be"),
    ],
)
def test_errors_for_non_numeric_values_state_the_argument(ask, named, bad):
    with pytest.raises(ValueError, match=named) as error:
        ask(bad)
    assert "\n" not in str(error.value)


BICYCLE = WhippleBicycle.benchmark()


@pytest.mark.parametrize("bad", [*NO_NUMBERS, NAN, INF], ids=str)
@pytest.mark.parametrize("group", ["inputs", "initial"])
def test_known_values_of_a_trial_are_real_numbers(group, bad):
    with pytest.raises(ValueError, match=rf"swing 3: {group}\['theta1'\]"):
        trial(**{group: {"theta1": bad}})


@pytest.mark.parametrize(
    ("ask", "named"),
    [
        (lambda x: pose(free=x), "`free`"),
        (lambda x: pose(trials=x), "`trials`"),
        (lambda x: pose(simulation=x), "`simulation=`"),
        (lambda x: pose(noise=x), "`noise`"),
        (lambda x: pose(priors=x), "`priors`"),
        (lambda x: pose(window=0.5, defect_std=x), "`defect_std`"),
        (lambda x: pose(unknown=x), "Names must be strings"),
        (lambda x: pose(zero_order_hold=x), "Names must be strings"),
        (lambda x: Problem.of(x, trial(), "mass"), "`system`"),
        (lambda x: fit_bicycle(x, BICYCLE, "c"), "`trials`"),
        (lambda x: fit_bicycle(bicycle_ride(), x, "c"), "`bicycle`"),
        (lambda x: identifiability(x), "identifiability requires a Problem"),
        (lambda x: cross_validate(x), "cross_validate"),
    ],
)
def test_errors_for_wrong_types_state_the_argument(ask, named):
    with pytest.raises(TypeError, match=named):
        ask(3.5)


def test_empty_trials_and_unknown_names_are_rejected():
    for ask in (lambda: pose(trials=[]), lambda: fit_bicycle([], BICYCLE, "c")):
        with pytest.raises(ValueError, match="`trials` is empty"):
            ask()
    with pytest.raises(ValueError, match="WhippleBicycle has no channel theta1"):
        fit_bicycle(trial(initial={"speed": 5.0}), BICYCLE, "c")
    with pytest.raises(ValueError, match="`moments` must be three names, got 'IBxx'"):
        bicycle_problem(bicycle_ride(), BICYCLE, Inertia("IBxx"))
    with pytest.raises(ValueError, match="Inertia: `prior` contains unknown names: IHxx; did you mean"):
        bicycle_problem(bicycle_ride(), BICYCLE, Inertia(("IBxx", "IByy", "IBzz"), prior={"IHxx": (1.0, 0.1)}))


@pytest.mark.parametrize(
    "twice",
    [
        (Gain("shoulder_torque"), Gain("shoulder_torque", name="another")),
        (Gain("theta1"), Gain("theta1", of="sensor", name="another")),
        (Offset("theta1"), Offset("theta1", bounds=(-1.0, 1.0))),
        (Delay("theta1"), Delay("theta1", name="another")),
        (Free("mass", name="a"), Free("length", name="a")),
    ],
)
def test_duplicate_free_parameters_are_rejected(twice):
    with pytest.raises(ValueError, match=r"`free` sets .* more than once"):
        pose(twice)
    assert pose([Gain("theta1"), Gain("theta1", of="start")]).parameters.names == (
        "gain of theta1",
        "gain of start of theta1",
    )


def test_labels_group_trials():
    """A trial keeps its labels when it is cut or gets another initial state; a label is text or a number."""
    trial = Trial(t, {"x": good}, sigma=1.0, name="ride", labels={"rider": "anna", "speed": np.float32(4)})
    assert trial.labels == {"rider": "anna", "speed": 4.0}
    assert trial.between(0.0, 0.5).labels == trial.with_initial_state({"x": 0.0}).labels == trial.labels
    assert Trial(t, {"x": good}, sigma=1.0).labels == {}
    with pytest.raises(ValueError, match=r"ride: `labels` must be a dict by name.*got str"):
        Trial(t, {"x": good}, sigma=1.0, name="ride", labels="anna")
    with pytest.raises(ValueError, match=r"ride: labels\['speed'\] must be a real number"):
        Trial(t, {"x": good}, sigma=1.0, name="ride", labels={"speed": (1.0, 2.0)})
