"""Pictures: drawn on a dark and on a light page, with what was asked for in them."""

import collections
import dataclasses
import io
import re
import types

import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pytest
from systems import POSED, TRIAL, Track

import jaxkane as jk


@pytest.fixture(autouse=True, params=["default", "dark_background"])
def style(request):
    with plt.style.context(request.param):
        yield request.param
    plt.close("all")


def is_legible(axes, style):
    """Whether the picture has ink on its paper, and no dark line on a dark page or light one on a light page."""
    axes = np.ravel(axes)
    figure = axes[0].figure
    figure.canvas.draw()
    picture = np.asarray(figure.canvas.buffer_rgba())[..., :3].mean(axis=-1) / 255.0
    paper = 0.0 if style == "dark_background" else 1.0
    assert picture[0, 0] == paper
    assert np.mean(np.abs(picture - paper) > 0.25) > 0.002
    for ax in axes:
        for line in ax.lines:
            if len(line.get_xdata()) and line.get_linestyle() != "None":
                r, g, b, *_ = matplotlib.colors.to_rgba(line.get_color())
                assert abs(0.3 * r + 0.6 * g + 0.1 * b - paper) > 0.15, (line.get_label(), line.get_color())
    return True


def trajectory(status=0, t_end=2.0, batch=()):
    """Roll, yaw rate and place over two seconds, without solving anything."""
    t = np.broadcast_to(np.linspace(0.0, 2.0, 41), (*batch, 41))
    q = np.stack([0.1 * np.sin(3 * t), 4.0 * t], axis=-1)
    q[..., 21:, :] = np.where(np.broadcast_to(np.asarray(status), batch)[..., None, None] == 0, q[..., 21:, :], np.nan)
    stats = {name: jnp.asarray(41) for name in ("steps", "accepted", "rejected")}
    none = np.zeros((*t.shape, 0))
    return jk.Trajectory(
        **{name: jnp.asarray(x) for name, x in dict(t=t, q=q, u=np.cos(t)[..., None], u_dep=none, x=none).items()},
        inputs={"steer_torque": jnp.ones_like(jnp.asarray(t))},
        outputs={},
        status=jnp.asarray(status),
        t_end=jnp.asarray(t_end),
        stats=stats,
        names=(("roll", "x"), ("yaw_rate",), (), ()),
        events=("fell_over",),
        adjoint="none",
        units=(("roll", "rad"), ("yaw_rate", "rad/s"), ("x", "m"), ("steer_torque", "N m")),
    )


def test_units_of_rates_follow_from_declared_units():
    units = {"roll_rate": "rad/s", "x_dot": "m/s", "heading_rate": "", "y_dot": "", "rate": ""}
    ride = trajectory()
    ride = dataclasses.replace(ride, names=(ride.names[0], tuple(units), (), ()), u=jnp.ones((41, 5)))
    labels = [ax.get_ylabel() for ax in jk.plot.trajectories(ride, list(units))]
    assert [label.partition("[")[2].rstrip("]") for label in labels] == list(units.values())


@pytest.mark.parametrize("name", jk.catalog.CATALOG)
def test_the_catalogue_declares_its_units(name):
    """All but Euler parameters, which have none."""
    system = jk.catalog.CATALOG[name].example()
    names = (*system.coordinates, *system.speeds, *system.dependent_speeds, *system.auxiliary_speeds, *system.inputs)
    declared = [n for n in names if {n, re.sub("_(dot|rate)$", "", n)} & system.units.keys()]
    assert [n for n in names if n not in declared] == [n for n in names if re.fullmatch(r"e\d", n)]
    assert len(re.findall(r"=[-\d.e]+ \S", repr(system).replace("\n", " "))) == len(vars(system))  # with a unit each


def test_plots_of_trajectories_show_names_units_and_the_end(style):
    ride = trajectory(status=jk.Status.EVENT, t_end=1.01)
    axes = jk.plot.trajectories(ride, ["roll", ("yaw_rate", "steer_torque"), "x"], degrees=True)
    assert is_legible(axes, style)
    assert [ax.get_ylabel() for ax in axes] == ["roll\n[deg]", "", "x\n[m]"]
    assert axes[-1].get_xlabel() == "time [s]"
    assert axes[0].get_title(loc="right") == "fell over at 1.01 s"
    np.testing.assert_allclose(axes[0].lines[0].get_ydata()[:21], np.degrees(ride["roll"][:21]))
    assert [text.get_text() for text in axes[1].get_legend().get_texts()] == ["yaw_rate", "steer_torque"]
    cross = next(line for line in axes[0].lines if line.get_marker() == "x")
    assert cross.get_xdata()[0] == pytest.approx(1.0)
    again = jk.plot.trajectories(trajectory(), ["roll", "x", "yaw_rate"], axes=axes, label="the other", color="C3")
    assert again is not axes
    assert all(a is b for a, b in zip(again, axes))
    assert axes[2].get_legend().get_texts()[-1].get_text() == "the other"


def test_a_line_has_a_gap_at_each_jump():
    """The values before and after it are those of the jump, not of the samples around it. A batch has its own jumps."""
    at = np.array([[0.52, 1.0, np.nan], [1.27, np.nan, np.nan]])
    before, after = (jk.State(sign * np.stack([at, at], axis=-1), (sign * at)[..., None]) for sign in (1.0, -1.0))
    inputs = tuple({"steer_torque": sign * at} for sign in (2.0, 3.0))
    count = np.array([2, 1])
    jumps = collections.namedtuple("Jumps", "t before after inputs count")(at, before, after, inputs, count)
    rides = dataclasses.replace(
        trajectory(status=np.array([0, 0]), t_end=np.array([2.0, 2.0]), batch=(2,)), jumps=jumps
    )
    axes = jk.plot.trajectories(rides, ["yaw_rate", "roll", "steer_torque"], degrees=True)
    degrees = np.degrees((1.0, -1.0))
    for ax, sides in zip(axes, (degrees, degrees, (2.0, 3.0))):
        for k, line in enumerate(ax.lines):
            t, y = (np.asarray(x) for x in line.get_data())
            gaps = np.flatnonzero(np.isnan(y))
            times = at[k, : count[k]]
            np.testing.assert_array_equal(t[gaps[:, None] + np.arange(-1, 2)], np.repeat(times[:, None], 3, axis=1))
            np.testing.assert_allclose(y[gaps - 1], sides[0] * times)
            np.testing.assert_allclose(y[gaps + 1], sides[1] * times)
            assert np.all(np.diff(t) >= 0)
            assert len(t) == 41 + 3 * count[k]


ODD = ("a$_{b$", "$c")


@pytest.mark.slow
def test_names_are_not_interpreted_as_mathematics():
    """Dollars in names are written as they stand."""
    ride = dataclasses.replace(
        trajectory(status=jk.Status.EVENT, t_end=1.01),
        names=(ODD, ("$u",), (), ()),
        events=("x$^{$",),
        units=(("a$_{b$", "m$^{$"),),
    )
    fit = fitted(2)
    fit.trial_names = ("$^$", "$_{$")
    fit.fitted, fit.residuals = (dict(zip(fit.trial_names, x.values())) for x in (fit.fitted, fit.residuals))
    drawn = [
        jk.plot.trajectories(ride, ["a$_{b$", ODD]),
        jk.plot.fits(fit),
        jk.plot.mode_shapes(np.array([-1.0, 2.0]), np.eye(2), ODD, modes=["m$_{$", "$_$"]),
        jk.plot.eigenvalues([0.0, 1.0], np.array([[-1.0, 2.0j], [1.0, 3.0j]]), modes=["m$_{$", "$_$"]),
    ]
    for axes in drawn:
        np.ravel(axes)[0].figure.savefig(io.BytesIO(), format="svg")
    assert drawn[0][0].get_ylabel() == r"a\$ {b\$" + "\n" + r"[m\$^{\$]"


def test_units_passed_as_an_argument():
    axes = jk.plot.trajectories(trajectory(), ["x"], units={"x": "rad"}, degrees=True)
    assert axes[0].get_ylabel() == "x\n[deg]"
    with pytest.raises(ValueError, match="none of x is declared to be an angle"):
        jk.plot.trajectories(trajectory(), ["x"], degrees=True)
    with pytest.raises(KeyError, match="no 'pitch' in this trajectory"):
        jk.plot.trajectories(trajectory(), ["pitch"])
    with pytest.raises(ValueError, match="2 axes are needed"):
        jk.plot.trajectories(trajectory(), ["roll", "x"], axes=axes)


def test_all_members_of_a_batch_are_drawn(style):
    rides = trajectory(status=np.array([0, 1, 10]), t_end=np.array([2.0, 1.0, 1.0]), batch=(3,))
    (ax,) = jk.plot.trajectories(rides, ["roll"])
    assert is_legible(ax, style)
    lines = [line for line in ax.lines if line.get_marker() == "None"]
    assert len(lines) == 3
    assert len({line.get_color() for line in lines}) == 1
    assert len([line for line in ax.lines if line.get_marker() == "x"]) == 2


def canonical(v):
    """Eigenvalues (m, 4) of the benchmark bicycle: M, C1, K0, K2 of Meijaard et al. (2007), Table 2; g = 9.81."""
    M = np.array([[80.81722, 2.31941332208709], [2.31941332208709, 0.29784188199686]])
    C1 = np.array([[0.0, 33.86641391492494], [-0.85035641456978, 1.68540397397560]])
    K0 = np.array([[-80.95, -2.59951685249872], [-2.59951685249872, -0.80329488458618]])
    K2 = np.array([[0.0, 76.59734589573222], [0.0, 2.65431523794604]])
    A = [np.linalg.solve(M, np.concatenate([-9.81 * K0 - x**2 * K2, -x * C1], axis=1)) for x in v]
    A = [np.concatenate([np.eye(4)[2:], lower]) for lower in A]
    return np.linalg.eigvals(np.array(A))


def shaded(ax):
    """The stable ranges."""
    return [(patch.get_x(), patch.get_x() + patch.get_width()) for patch in ax.patches]


def test_eigenvalues_and_the_stable_range(style):
    """1e-3 m/s: weave and capsize speed of Meijaard et al. (2007), between values 0.02 m/s apart."""
    v = np.linspace(0.0, 10.0, 501)
    values = canonical(v)
    ax = jk.plot.eigenvalues(v, values)
    ((start, stop),) = shaded(ax)
    assert (start, stop) == pytest.approx((4.29238253634111, 6.02426201538837), abs=1e-3)
    assert is_legible(ax, style)
    assert {text.get_text() for text in ax.texts} == {"4.29", "6.02"}
    assert ax.get_xlabel() == "parameter"
    assert jk.plot.eigenvalues(v, values, ax=ax) is ax


@pytest.mark.slow
def test_the_axis_label_is_the_name_of_the_varied_quantity():
    """A parameter or a speed of the system with its unit, anything else by its name alone."""
    pendulum = jk.catalog.DoublePendulum()
    hanging = lambda length: (dataclasses.replace(pendulum, length=length), jk.State(jnp.zeros(2), jnp.zeros(2)))  # noqa: E731
    motions = {
        "length [m]": lambda system, length: hanging(length),
        "theta1 dot [rad/s]": lambda system, theta1_dot: hanging(theta1_dot),
        "arm length": lambda system, arm_length: hanging(arm_length),
    }
    for label, motion in motions.items():
        found = jk.stability.eigenvalues(pendulum, jnp.array([0.5, 0.6]), motion)
        assert jk.plot.eigenvalues(found).get_xlabel() == label


def test_stable_ranges_end_at_the_last_finite_value():
    for values, ranges in (
        ([-1.0, -1.0, 1.0, -1.0, -2.0], [(0.0, 1.5), (2.5, 4.0)]),
        ([-1.0, np.nan, -1.0, -1.0, 0.0], [(0.0, 0.0), (2.0, 3.0)]),
        ([1.0] * 5, []),
    ):
        assert shaded(jk.plot.eigenvalues(np.arange(5.0), np.array(values)[:, None] + 0j)) == ranges


@pytest.mark.weekly
def test_results_of_the_stability_module_are_plotted_directly(style):
    """Columns of one name share a colour; the number of names is checked."""
    bicycle = jk.catalog.WhippleBicycle.benchmark()
    found = jk.stability.eigenvalues(bicycle, jnp.linspace(0.0, 10.0, 101))
    ax = jk.plot.eigenvalues(found)
    assert is_legible(ax, style)
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    assert labels == ["weave", "weave, imaginary", "capsize", "castering"]
    assert ax.get_xlabel() == "forward speed [m/s]"
    locus = jk.plot.root_locus(found)
    assert is_legible(locus, style)
    assert locus.figure.axes[-1].get_ylabel() == "forward speed [m/s]"
    axes = jk.plot.mode_shapes(found, at=5.0, only=("roll", "steer"))
    assert is_legible(axes, style)
    assert [ax.get_title().split(":")[0] for ax in axes] == ["weave", "capsize", "castering"]
    with pytest.raises(ValueError, match=r"got \(101, 4\) .* 3 modes"):
        jk.plot.eigenvalues(found, modes=("a", "b", "c"))
    with pytest.raises(ValueError, match="pass `at`, a value"):
        jk.plot.mode_shapes(found)
    with pytest.raises(TypeError, match="or the result of"):
        jk.plot.eigenvalues(np.ones(3))


def test_root_locus_follows_the_columns(style):
    x = np.linspace(0.0, 1.0, 11)
    lam = np.stack([-x + 1j * x, -x - 1j * x, 0.3 - x], axis=1)
    ax = jk.plot.root_locus(x, lam, label="damping")
    assert is_legible(ax, style)
    paths = [collection.get_segments() for collection in ax.collections]
    assert len(paths) == 3
    np.testing.assert_allclose(paths[0][-1][-1], [-1.0, 1.0])
    assert ax.get_xlim()[0] < -1.0 < 0.3 < ax.get_xlim()[1]


def test_mode_shapes_are_normalized_to_their_largest_state():
    """A pair and a real mode: two panels; the arrows' ends to 1e-12."""
    vectors = np.array([[2.0j, -2.0j, 1.0], [1.0, 1.0, -0.5]])
    axes = jk.plot.mode_shapes(np.array([-1 + 2j, -1 - 2j, -3.0]), vectors, ["roll", "steer"])
    assert len(axes) == 2
    arrows = [[text.xy for text in ax.texts if text.arrow_patch is not None] for ax in axes]
    np.testing.assert_allclose(arrows[0], [(0.0, 1.0), (-np.pi / 2, 0.5)], atol=1e-12)
    np.testing.assert_allclose(arrows[1], [(0.0, 1.0), (np.pi, 0.5)], atol=1e-12)
    assert [ax.get_title() for ax in axes] == ["-1 ± 2i 1/s", "-3 1/s"]
    with pytest.raises(ValueError, match="the model has no state pitch; there are roll, steer"):
        jk.plot.mode_shapes(np.array([-3.0]), np.ones((2, 1)), ["roll", "steer"], only=("pitch",))


@pytest.fixture(scope="module")
def audited():
    system = jk.catalog.DoublePendulum()
    state = jk.State(jnp.array([0.7, -0.4]), jnp.array([1.1, -0.8]))
    return jk.audit(system, jk.simulate(system, state, jnp.linspace(0.0, 1.0, 11)))


def test_audits(style, audited):
    axes = jk.plot.audit(audited)
    assert axes.shape == (2, 2)
    assert is_legible(axes, style)
    np.testing.assert_allclose(axes[0, 0].lines[0].get_ydata(), audited.kinetic_energy)
    with pytest.raises(TypeError, match=r"needs an Audit, e\.g\. jk.audit\(system, trajectory\); got a str"):
        jk.plot.audit("ride")


BIKE = jk.catalog.WhippleBicycle.benchmark()


def fitted(n):
    """As much of a `Fit` as is drawn: n trials, "roll" in all, "yaw_rate" in all but the first."""
    t = np.linspace(0.0, 1.0, 21)
    measured = [{"roll": np.sin(t + k), **({"yaw_rate": np.cos(t + k)} if k else {})} for k in range(n)]
    simulated = [{name: y + 0.1 for name, y in trial.items()} for trial in measured]
    names = tuple(f"ride {k}" for k in range(n))
    trials = [types.SimpleNamespace(t=t, measured=m, name=name) for m, name in zip(measured, names)]
    return types.SimpleNamespace(
        problem=types.SimpleNamespace(trials=trials, channels=("roll", "yaw_rate"), system=BIKE),
        trial_names=names,
        fitted=dict(zip(names, simulated)),
        residuals=dict(zip(names, [{name: np.full(21, 0.5) for name in trial} for trial in measured])),
    )


@pytest.mark.slow
def test_fits(style):
    fit = fitted(9)
    axes = jk.plot.fits(fit, degrees=True)
    assert axes.shape == (4, 3)
    assert is_legible(axes, style)
    assert [ax.get_title() for ax in axes[0]] == ["ride 0", "ride 4", "ride 8"]
    assert axes[0, 0].get_ylabel() == "roll\n[deg]"
    assert axes[2, 0].texts[0].get_text() == "not measured"
    dots, line = axes[0, 1].lines
    np.testing.assert_allclose(line.get_ydata() - dots.get_ydata(), np.degrees(0.1))
    np.testing.assert_allclose(axes[1, 1].lines[0].get_ydata(), 0.5)
    assert jk.plot.fits(fit, ["ride 3"], ["roll"], residuals=False).shape == (1, 1)
    with pytest.raises(ValueError, match="the fit has no trial 'ride 12'"):
        jk.plot.fits(fit, ["ride 12"])
    with pytest.raises(ValueError, match="no channel pitch; there are roll, yaw_rate"):
        jk.plot.fits(fit, channels=["pitch"])


@pytest.fixture(scope="module")
def real():
    return jk.fit.fit(Track(), [TRIAL], ["gain", "drift"], optimizer=jk.fit.LeastSquares(), steps=1, **POSED)


def test_a_real_fit_is_drawn(real):
    """What `fitted` stands in for: the names that are read are those of a `Fit`."""
    axes = jk.plot.fits(real)
    assert axes.shape == (2, 1)
    np.testing.assert_allclose(axes[0, 0].lines[1].get_ydata(), next(iter(real.fitted["trial"].values())))


def test_residuals_are_drawn_over_any_quantity(real, style):
    for over in ("t", "x", "push", "x_dot", lambda trial: trial.measured["x"] ** 2):
        axes = jk.plot.residuals(real, over, bins=3)
        dots, mean = axes[0, 0].lines
        assert (len(dots.get_xdata()), len(mean.get_xdata())) == (11, 2)
        assert np.average(mean.get_ydata(), weights=[6, 5]) == pytest.approx(np.mean(dots.get_ydata()), abs=1e-12)
    assert is_legible(axes, style)
    with pytest.raises(ValueError, match="residuals: the fit has no channel y"):
        jk.plot.residuals(real, channels=["y"])
    with pytest.raises(KeyError, match="pull"):
        jk.plot.residuals(real, "pull")


def test_costs_and_estimates_of_a_fit(real, style):
    ax = jk.plot.costs(real)
    assert [text.get_text() for text in ax.texts] == [f"{real.tests['trial']['x'].rms ** 2:.2g}"]
    assert is_legible([ax], style)
    ax = jk.plot.estimates({"one": real, "same": real}, start=True)
    assert [label.get_text() for label in ax.get_yticklabels()] == ["gain", "drift"]
    intervals = [line.get_xdata() for line in ax.lines if len(line.get_xdata()) == 2 and line.get_linewidth() == 3]
    np.testing.assert_allclose(intervals[0], intervals[2])
    low, high = (x / real.estimates["gain"] * 100 - 100 for x in real.intervals()["gain"])
    np.testing.assert_allclose(intervals[0], [low, high])


def test_the_path_of_a_selection(style):
    one = lambda name, cost, held_out, accepted: types.SimpleNamespace(  # noqa: E731
        name=name, cost=cost, held_out_cost=held_out, accepted=accepted
    )
    best, worse, last = one("dry", 50.0, 60.0, True), one("wet", 80.0, 90.0, True), one("wet", 49.0, 70.0, False)
    selection = types.SimpleNamespace(
        rounds=((best, worse), (last,)), costs=(100.0, 50.0), held_out_costs=(110.0, 60.0)
    )
    ax = jk.plot.selection_path(selection)
    others, more, fitted, held_out = ax.lines
    assert [*others.get_ydata(), *more.get_ydata()] == [90.0, 70.0]
    assert ([*fitted.get_ydata()], [*held_out.get_ydata()]) == ([100.0, 50.0], [110.0, 60.0])
    assert [label.get_text() for label in ax.get_xticklabels()] == ["before", "dry"]
    assert is_legible([ax], style)
