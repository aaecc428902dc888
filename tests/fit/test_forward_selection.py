"""Forward selection finds the missing terms of simulated pendulums and selects no others."""

import dataclasses
import itertools

import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pytest
import systems
from systems import Cart, T, Track

import jaxkane as jk
from jaxkane.fit import (
    Candidate,
    Delay,
    Fit,
    Free,
    Gain,
    LeastSquares,
    Offset,
    Simulation,
    Trial,
    compare,
    cross_validate,
    fit,
    forward_selection,
    save_report,
)
from jaxkane.fit.result.linearized import LinearizedProblem, score_test, solved
from jaxkane.fit.result.statistics import predicts_as_well, serial_correlation
from jaxkane.fit.result.studies import energy_sources

TS = np.linspace(0.0, 2.0, 41)
NOISE = {"angle": 0.004, "rate": 0.02}
POSED = {"unknown": ("angle", "rate"), "optimizer": LeastSquares(), "simulation": Simulation(step=0.025)}


class Pendulum(systems.Pendulum):
    """With torques that may be absent."""

    stiffness: jk.Scalar = jk.parameter(20.0, positive=True)  # [1/s^2]
    damping: jk.Scalar = jk.parameter(0.3)
    dry: jk.Scalar = jk.parameter(0.0)
    quadratic: jk.Scalar = jk.parameter(0.0)
    spring: jk.Scalar = jk.parameter(0.0)
    both: jk.Scalar = jk.parameter(0.0)  # dry friction and a spring in one ratio
    unused: jk.Scalar = jk.parameter(1.0)

    def loads(self, t, q, u, motion, inputs):
        s, friction = u["rate"], jnp.tanh(u["rate"] / 0.1)
        torque = self.dry * friction + self.quadratic * s * jnp.abs(s) + self.spring * q["angle"]
        torque = torque + self.both * (0.5 * friction + q["angle"])
        return *super().loads(t, q, u, motion, inputs), jk.Torque(-torque * motion["B"].y, motion["bob"])


def record(seed, n=6, system=None, late=0, **changes):
    """Trials of a pendulum; `changes` are numbers added to channels. `late`: by how many samples the torque acts."""
    rng, trials, system = np.random.default_rng(seed), [], Pendulum() if system is None else system
    for i in range(n):
        times = np.linspace(-0.2, 2.0, 45)
        push = 3.0 * np.sin(4.0 * times + i) + 2.0 * np.cos(7.0 * times - i)
        acts = push[4 - late : 45 - late]
        start = jk.State({"angle": 0.9 - 0.25 * i}, {"rate": 0.5 * (i % 3)})
        ride = jk.simulate(system, start, jnp.asarray(TS), {"torque": jnp.asarray(acts)}, step=0.0125)
        y = {c: np.asarray(ride[c]) + changes.get(c, 0.0) + rng.normal(0.0, s, TS.size) for c, s in NOISE.items()}
        trials.append(Trial(TS, y, {"torque": push[4:]}, sigma=NOISE, name=f"swing {i}"))
    return trials


FREE = ("stiffness", "damping")
FIVE = ("dry", "quadratic", "spring", Gain("torque"), Offset("angle", scale=0.1))


def fitted(trials, *free, **more) -> Fit:
    return fit(Pendulum(), trials, (*FREE, *free), **{**POSED, **more})


@pytest.fixture(scope="module")
def rubbing():
    """A fit without dry friction of pendulums that have it."""
    return fitted(record(0, system=Pendulum(dry=0.4)))


@pytest.fixture(scope="module")
def found(rubbing):
    return forward_selection(rubbing, FIVE, depth=1, refits=1)


@pytest.mark.weekly
def test_dry_friction_is_selected_from_five_candidates(rubbing, found):
    assert found.selected == ("dry",)
    assert found.best is found.rounds[0][0]
    assert len(found.rounds[0]) == 5
    best = found.best
    assert best.p < 1e-4
    assert abs(best.values["dry"] - 0.4) < 3.5 * best.errors["dry"] < 0.1
    assert best.cost == pytest.approx(found.fit.cost, rel=1e-6)
    assert best.predicted_cost == pytest.approx(best.cost, rel=0.05)
    assert found.fit.names == (*FREE, "dry")
    assert found.fit.variance < 1.3 < rubbing.variance
    # Clusters are enough: the scatter from trial to trial, not the formal errors.
    assert best.errors["dry"] == pytest.approx(found.fit.clustered_errors["dry"], rel=0.05)


@pytest.mark.weekly
def test_predicted_cost_agrees_with_a_new_fit(rubbing):
    """The predictions are compared with a new fit with one more parameter, and with refits without some trials."""
    found = forward_selection(rubbing, FIVE[:3], depth=3, refits=3)
    # Beside dry friction nothing stands: the search ends by itself.
    assert found.selected == ("dry",)
    assert len(found.rounds) == 2
    assert not any(row.accepted for row in found.rounds[1])
    anew = fit(Pendulum(), rubbing.problem.trials, (*FREE, "quadratic"), **POSED)
    row = next(row for row in found.rounds[0] if row.name == "quadratic")
    assert row.cost == pytest.approx(anew.cost, rel=1e-6)
    assert row.predicted_cost == pytest.approx(anew.cost, rel=0.1)
    assert dict(row.values) == pytest.approx(anew.estimates, rel=1e-3)
    assert row.held_out_cost == pytest.approx(cross_validate(anew).held_out.sum(), rel=0.05)


@pytest.mark.weekly
def test_beam_search_selects_terms_that_greedy_selection_misses():
    """Without gravity's sine, so that a spring is a term of its own."""
    trials = record(3, system=Pendulum(dry=0.4, spring=1.5))
    without = fit(Pendulum(), trials, ("damping",), **POSED)
    greedy, beam = (forward_selection(without, ("both", "dry", "spring"), depth=2, beam=n) for n in (1, 2))
    assert greedy.selected[0] == "both"
    assert not greedy.alternatives or all("both" in one.names or len(one.names) == 1 for one in greedy.alternatives)
    sets = [{*beam.selected}, *({*one.names} for one in beam.alternatives if one.is_as_good)]
    assert {"dry", "spring"} in sets  # beside `both` with one of them, which does the same
    assert {"both", "dry"} in sets or {"both", "spring"} in sets
    assert beam.fit.cost <= greedy.fit.cost * (1 + 1e-6)
    assert "These data do not distinguish it from" in str(beam)
    assert "Alternatives." in str(beam)
    costs = [one.held_out_cost for one in beam.alternatives]
    assert costs == sorted(costs)


@pytest.mark.weekly
def test_implausible_estimates_are_not_accepted(rubbing):
    asked = ("quadratic", Free("spring", bounds=(0.0, None)))
    plausible = {"damping": (0.0, 0.6), "quadratic": (0.0, None)}
    found = forward_selection(rubbing, asked, refits=None, level=0.9, plausible=plausible)
    assert not found.selected
    quadratic, spring = (row_of(found, name) for name in ("quadratic", "spring"))
    assert len(quadratic.bound_violations) == 2
    assert quadratic.reason.startswith("not plausible: damping = 0.9")
    # Its bound is where it starts: it is searched for on both sides, and plausible on one.
    assert spring.values["spring"] < 0
    assert spring.bound_violations[0].startswith("spring = -")


@pytest.mark.weekly
def test_a_common_offset_of_known_initial_states_is_selected():
    trials = [trial.with_initial_state({"rate": 0.5 * (i % 3) + 0.1}) for i, trial in enumerate(record(4))]
    found = forward_selection(fitted(trials, unknown="angle"), [Offset("rate", of="start"), "dry", "quadratic"])
    assert found.selected == ("offset of start of rate",)
    assert found.fit.estimates["offset of start of rate"] == pytest.approx(-0.1, abs=0.01)


@pytest.mark.weekly
@pytest.mark.parametrize("hold", [(), ("torque",)], ids=["linear", "held"])
def test_an_input_delay_is_selected(hold):
    """The delay is two samples of 0.05 s. With a zero-order hold, the estimate is half a sample shorter."""
    trials = record(5, late=2)
    asked = (Delay("torque"), Gain("torque"), "dry")
    found = forward_selection(fitted(trials, zero_order_hold=hold), asked, plausible={"delay of torque": (0.0, 0.3)})
    assert found.selected == ("delay of torque",)
    expected = 0.1 if not hold else 0.075  # what is linear between samples acts like what is held half a sample longer
    assert found.fit.estimates["delay of torque"] == pytest.approx(expected, abs=0.003)


class Lagging(Pendulum):
    """The torque follows its command with a lag."""

    lag: jk.Scalar = jk.parameter(0.1, positive=True)
    states = ("acting",)

    def loads(self, t, q, u, motion, inputs):
        return super().loads(t, q, u, motion, {"torque": inputs["acting"]})

    def state_rates(self, t, q, u, x, motion, now):
        return jk.sensors.low_pass(now["torque"], x["acting"], self.lag)[0]


@pytest.mark.weekly
def test_a_candidate_system_with_an_additional_state_is_selected():
    """No value of the lag gives the initial model, so the cost is not predicted, and the candidate is fitted."""
    trials = record(6, system=Lagging(lag=0.08))
    lag = Candidate("motor lag", system=Lagging(stiffness=3.0), free="lag", unknown="acting")
    found = forward_selection(fitted(trials), ["dry", Delay("torque"), lag], refits=3)
    assert found.selected == ("motor lag",)
    assert np.isnan(found.best.predicted_cost)
    assert found.fit.names == (*FREE, "lag")
    assert found.fit.estimates["lag"] == pytest.approx(0.08, abs=0.004)


@pytest.mark.weekly
def test_unidentifiable_candidates_are_reported(rubbing):
    posed = fitted(rubbing.problem.trials, Offset("torque", each="trial"))
    found = forward_selection(posed, ["unused", Offset("torque")])
    with pytest.raises(ValueError, match="own: a candidate with `each` is not supported"):
        forward_selection(posed, Candidate("own", free=Gain("torque", each="trial")))
    reasons = {row.name: row.reason for row in found.rounds[0]}
    assert reasons["unused"] == "these data do not depend on unused"
    assert reasons["offset of torque"] == "offset of torque cannot be distinguished from the free parameters"
    assert "unused" in str(found)
    assert np.isnan(next(row for row in found.rounds[0] if row.name == "unused").errors["unused"])


@pytest.mark.weekly
def test_selection_with_one_trial(rubbing):
    alone = fitted(rubbing.problem.trials[:1])
    found = forward_selection(alone, ["dry", "spring"])
    assert "there is no held-out cost" in found.tables[0][0]
    assert np.isnan(found.rounds[0][0].held_out_cost)
    assert found.selected == ("dry",)
    with pytest.raises(ValueError, match="needs at least two trials"):
        forward_selection(alone, "dry", folds=2)


@pytest.mark.parametrize(
    ("asked", "options", "message"),
    [
        ((), {}, "`candidates` is empty"),
        (("damping",), {}, "damping: the fit already estimates damping"),
        (("dry", "dry"), {}, "Two candidates have the name dry"),
        (("dry", Candidate("bound", free=Free("dry", bounds=(-1.0, 1.0)))), {}, "free dry with different options"),
        (("dyr",), {}, "Pendulum has no parameter 'dyr'; did you mean 'dry'"),
        ((Candidate("nothing"),), {}, "nothing: the candidate adds no parameter"),
        ((Candidate("again", unknown="angle"),), {}, "initial values of angle are already `unknown`"),
        ((Candidate("a", free="dry", plausible={"dyr": (0, 1)}),), {}, "a: `plausible` contains unknown names: dyr"),
        (("dry",), {"plausible": {"dyr": (0.0, 1.0)}}, "`plausible` contains unknown names: dyr"),
        (("dry",), {"plausible": {"damping": (1.0, 0.0)}}, "lower < upper"),
        (("dry",), {"plausible": {"dry": 0.2}}, "an initial guess other than zero; got 0.2"),
        (("dry",), {"level": 0.0}, "`level` must be a probability"),
        (("dry",), {"depth": 0}, "`depth` must be an integer of at least 1"),
        (("dry",), {"beam": 0}, "`beam` must be an integer of at least 1"),
        (("dry",), {"refits": -1}, "`refits` must be an integer of at least 0"),
        ((Offset("angel"),), {}, "no input or channel angel; did you mean 'angle'"),
        ((Gain("torque", of="start"),), {}, "no coordinate, independent speed or state torque"),
        ((Delay("angle", of="start"),), {}, "`of` must be 'input', 'sensor' or None"),
    ],
)
def test_invalid_candidates_and_options_are_rejected(rubbing, asked, options, message):
    with pytest.raises(ValueError, match=message):
        forward_selection(rubbing, asked, **options)


def test_forward_selection_requires_a_converged_fit(rubbing):
    with pytest.raises(TypeError, match="forward_selection requires a Fit"):
        forward_selection(rubbing.problem, "dry")
    with pytest.raises(ValueError, match="has not converged"):
        forward_selection(dataclasses.replace(rubbing, status="steps"), "dry")


@pytest.mark.weekly
def test_fits_are_compared_in_a_table(rubbing, found):
    held = record(9, system=Pendulum(dry=0.4))
    table = compare({"viscous": rubbing, "with friction": found.fit}, held, plausible={"damping": 0.5})
    assert table.held_out["with friction"].cost < 0.3 * table.held_out["viscous"].cost
    violation = "damping = 0.5362 is above 0.45"
    assert table.bound_violations["viscous"] == (violation,)
    for words in ("with friction", "dry", f"{found.fit.cost:.6g}", "swing 5", "residuals' correlation", "Held out"):
        assert words in str(table)
    assert f"{found.fit.cost:.6g}" in table._repr_html_()
    # A violation is a row: a cell of all of them would make every column as wide.
    (rows,) = [rows for heading, rows in table.tables if heading == "Bound violations"]
    assert rows == [["fit", "violation"], ["viscous", violation]]
    # An initial guess is not a plausible range: without a range, any value is plausible.
    assert compare({"viscous": rubbing}).bound_violations["viscous"] == ()
    said = {"damping": (0.0, 0.45), "gain of angle": 0.2}  # as a search was given
    assert compare({"viscous": rubbing}, plausible=said).bound_violations["viscous"]


def test_invalid_arguments_of_a_comparison_are_rejected(rubbing):
    for fits, options, error, message in (
        ([rubbing], {"plausible": {"dampign": 0.5}}, ValueError, "unknown names: dampign; did you mean 'damping'"),
        ({}, {}, ValueError, "`fits` is empty"),
        (rubbing, {}, TypeError, "`fits` is one Fit"),
        ([rubbing, rubbing], {}, ValueError, "same free parameters"),
        ([rubbing.problem], {}, TypeError, "compare requires a Fit"),
    ):
        with pytest.raises(error, match=message):
            compare(fits, **options)


@pytest.mark.weekly
def test_the_report_contains_the_forward_selection(found, tmp_path):
    page = save_report(found.fit, tmp_path / "fit.html", forward_selection=found).read_text(encoding="utf-8")
    assert "Model extensions" in page
    assert "no more than chance" in page
    ticks = [label.get_text() for label in jk.plot.selection_path(found).get_xticklabels()]
    assert ticks == ["before", *found.selected]
    plt.close("all")


class Squared(Track):
    """What is pushed acts by its square: neither system is a part of the other."""

    def loads(self, t, q, u, motion, inputs):
        return super().loads(t, q, u, motion, {"push": inputs["push"] ** 2})


@pytest.mark.weekly
def test_a_candidate_that_is_not_nested_is_compared_by_held_out_cost():
    """The candidate is another system with the same number of parameters. With one refit, held-out trials decide."""
    rng, times, trials = np.random.default_rng(7), np.linspace(0.0, 3.0, 31), []
    for i in range(4):
        push = 2.0 * np.sin(2.0 * times + i)
        ride = jk.simulate(Squared(gain=1.5, drift=-0.4), jk.State({"x": 0.2}, {"x_dot": 0.0}), jnp.asarray(times),
                           {"push": jnp.asarray(push)}, step=0.05)  # fmt: skip
        x = np.asarray(ride["x"]) + rng.normal(0.0, 0.05, times.size)
        trials.append(Trial(times, {"x": x}, {"push": push}, sigma=0.05, initial={"x": 0.2}, name=f"push {i}"))
    posed = {"optimizer": LeastSquares(), "simulation": Simulation(step=0.1)}
    right, wrong = (fit(system, trials, ["gain", "drift"], **posed) for system in (Squared(), Track()))
    asked = [Candidate("squared", system=Squared()), Offset("x"), Offset("push")]
    found = forward_selection(wrong, asked, refits=1)
    row = next(row for row in found.rounds[0] if row.name == "squared")
    assert row.cost == pytest.approx(right.cost, rel=1e-4)
    assert row.cost < 0.1 * wrong.cost
    assert (row.criterion, row.accepted, np.isnan(row.p)) == ("trials left out", True, True)
    assert found.selected == ("squared",)
    assert "squared (not nested: by trials left out)" in found.conclusion
    assert not forward_selection(right, Candidate("not squared", system=Track())).selected
    assert forward_selection(wrong, asked, refits=0).rounds[0][-1].reason == "not nested, not fitted"
    alone = fit(Track(), trials[:1], ["gain", "drift"], **posed)
    (row,) = forward_selection(alone, asked[0]).rounds[0]
    assert row.reason == "not nested, and no trial can be left out"


class Loaded(Cart):
    """A cart with forces that a search may add."""

    drag: jk.Scalar = jk.parameter(0.0)  # [N s^2/m^2]
    cubic: jk.Scalar = jk.parameter(0.0)  # [N/m^3]
    other: jk.Scalar = jk.parameter(0.0)  # [N s/m]

    def loads(self, t, q, u, motion, inputs):
        x, v = q["x"], u["x_dot"]
        more = self.drag * jk.loads.quadratic(v, 1.0) + self.cubic * x**3 + self.other * jnp.sin(3.0 * v) / 3.0
        return (*super().loads(t, q, u, motion, inputs), jk.Force(-more * motion.N.x, motion["cart"]))


TIMES = np.linspace(0.0, 3.0, 31)
POSE = {"optimizer": LeastSquares(), "simulation": Simulation(step=0.1)}


def carts(force, n=6, seed=0, sigma=0.01, mass=1.0, noise=None, size=lambda i: 1.0, **more):
    """Trials of x'' = push - 4 x - force(x, x'), by Runge and Kutta. `noise`: (n, n_t) in units of sigma."""
    rng, trials = np.random.default_rng(seed), []
    for i in range(n):
        push, state, xs = size(i) * 3.0 * np.sin((1.5 + 0.3 * i) * TIMES + i), np.array([0.3, 0.0]), [0.3]
        for a, b in itertools.pairwise(push):
            for k in range(4):
                rate = lambda s, f: np.array([s[1], f - 4.0 * s[0] - force(*s)])  # noqa: E731
                f, h = a + (b - a) * (k + np.array([0.0, 0.5, 1.0])) / 4, 0.025
                k1 = rate(state, f[0])
                k2 = rate(state + h / 2 * k1, f[1])
                k3 = rate(state + h / 2 * k2, f[1])
                state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(state + h * k3, f[2]))
            xs.append(state[0])
        y = np.array(xs) + sigma * (rng.normal(size=31) if noise is None else noise[i])
        labels = {key: value(i) for key, value in more.items()}
        start = {"x": 0.3, "x_dot": 0.0}
        trials.append(Trial(TIMES, {"x": y}, {"push": mass * push}, sigma=sigma, initial=start, labels=labels))
    return trials


def loaded(trials, free=("stiffness",), **values):
    return fit(Loaded(**{"damping": 0.0, **values}), trials, free, **POSE)


def row_of(found, name):
    return next(row for round in found.rounds for row in round if row.name == name)


@pytest.mark.weekly
def test_selection_does_not_depend_on_units():
    """Masses of 1e-12 and 1e12 kg: a candidate that starts at zero has a scale of its own."""
    rows = []
    for mass in (1.0, 1e-12, 1e12):
        trials = carts(lambda x, v: 0.3 * v, n=4, mass=mass)
        found = forward_selection(loaded(trials, mass=mass, stiffness=4.0 * mass), ["damping", Offset("push")])
        assert found.selected == ("damping",)
        assert found.fit.identifiability.ok
        assert found.fit.estimates["damping"] == pytest.approx(0.3 * mass, rel=0.03)
        rows.append([(row.name, row.cost, row.predicted_cost, row.p) for row in found.rounds[0]])
    for other in rows[1:]:
        for one, same in zip(rows[0], other, strict=True):
            assert one[0] == same[0]
            assert one[1:] == pytest.approx(same[1:], rel=1e-4)


@pytest.mark.weekly
def test_a_term_is_replaced():
    """The fit has viscous friction, but the cart has drag. With drag in the model, viscous friction is removed."""
    before = loaded(carts(lambda x, v: 0.3 * v * abs(v)), ("stiffness", "damping"), damping=0.2)
    found = forward_selection(before, ["drag", "cubic"], remove="damping")
    assert (found.selected, found.removed) == (("drag",), ())  # the value of the system, 0.2, would stay
    without = fit(Loaded(damping=0.0), before.problem.trials, ["stiffness", Free("damping", start=0.1)], **POSE)
    found = forward_selection(without, ["drag", "cubic"], remove="damping")
    assert (found.selected, found.removed) == (("drag",), ("damping",))
    assert found.fit.names == ("stiffness", "drag")
    assert found.fit.estimates["drag"] == pytest.approx(0.3, abs=0.02)
    assert found.best.name == "drag instead of damping"
    assert found.best.predicted_cost == pytest.approx(found.best.cost, rel=0.3)  # about the dropped one at zero
    assert "Removed: damping." in found.conclusion
    assert found.fit.cost == pytest.approx(found.best.cost, rel=1e-6)
    kept = forward_selection(without, ["drag"])
    assert kept.fit.names == ("stiffness", "damping", "drag")
    with pytest.raises(ValueError, match="`remove` contains unknown names: dampign"):
        forward_selection(without, "drag", remove="dampign")


@pytest.mark.weekly
def test_a_pair_is_selected_if_neither_term_is_accepted_alone():
    """Two forces that are nearly alike, with opposite signs: only their difference acts."""
    trials = carts(lambda x, v: v - 1.6 * np.sin(3.0 * v) / 3.0, sigma=0.02, size=lambda i: 0.25)
    before = loaded(trials)
    alone = forward_selection(before, ["damping", "other", "cubic"], depth=2)
    assert not alone.selected
    found = forward_selection(before, ["damping", "other", "cubic"], depth=2, exchange=True)
    assert found.selected == ("damping", "other")
    assert found.best.name == "damping and other"
    assert found.best.p < 0.01
    with pytest.raises(ValueError, match="needs at least two trials"):
        forward_selection(loaded(trials[:1]), "damping", exchange=True)


def test_a_parameter_with_a_lower_bound_has_a_one_sided_test():
    before = loaded(carts(lambda x, v: 0.006 * v, sigma=0.02))
    both = row_of(forward_selection(before, "damping", refits=0), "damping")
    one = row_of(forward_selection(before, Free("damping", bounds=(0.0, None)), refits=0), "damping")
    other = row_of(forward_selection(before, "damping", plausible={"damping": (None, 0.0)}, refits=0), "damping")
    assert both.values["damping"] > 0
    assert one.p == pytest.approx(both.p / 2, rel=1e-6)
    assert other.p == pytest.approx(1 - both.p / 2, rel=1e-6)
    assert other.bound_violations


@pytest.mark.slow
def test_trials_are_held_out_by_label():
    """A cubic spring stands in for drag as long as all amplitudes are alike."""
    trials = carts(lambda x, v: 0.5 * v, n=6, size=lambda i: 1.0 + i % 2, amplitude=lambda i: 1 + i % 2)
    found = forward_selection(loaded(trials), "damping", folds="amplitude")
    assert found.held_out == "each amplitude: 1, 2"
    assert "each amplitude: 1, 2" in found.conclusion
    by_numbers = forward_selection(loaded(trials), "damping", folds=[[0, 2, 4], [1, 3, 5]])
    assert found.held_out_costs == by_numbers.held_out_costs
    left_out = cross_validate(loaded(trials), folds="amplitude")
    assert "(left out: each amplitude: 1, 2)" in left_out.conclusion
    with pytest.raises(ValueError, match="trial has no label 'speed'; the labels of these trials are: amplitude"):
        cross_validate(found.fit, folds="speed")
    with pytest.raises(ValueError, match=r"all trials have the same amplitude, 1\.0"):
        cross_validate(loaded(trials[::2]), folds="amplitude")


@pytest.mark.weekly
def test_implausible_estimates_of_the_initial_model_are_reported():
    """A negative damping compensates an offset. It is reported, but does not prevent the selection of the offset."""
    trials = carts(lambda x, v: -0.1 * v + 0.3)
    before = loaded(trials, ("stiffness", "damping"))
    found = forward_selection(before, Offset("push"), plausible={"damping": (0.0, None)})
    assert found.selected == ("offset of push",)
    (violation,) = found.bound_violations
    assert violation.startswith("damping = -0.1")
    assert violation.endswith("is below 0")
    assert f"Not plausible: {violation}." in found.conclusion
    # Nobody has said what is plausible: what adds energy at every instant is not. A spring or an offset does not.
    sources = energy_sources(found.fit)
    assert [*sources] == ["damping"]
    assert "adds energy at every sample" in sources["damping"]
    assert energy_sources(loaded(carts(lambda x, v: 0.1 * v), ("stiffness", "damping"))) == {}


@pytest.mark.weekly
def test_selection_from_a_fit_with_a_parameter_at_its_bound():
    """Predictions do not move it beyond the bound. The fit of a candidate may take it off the bound."""
    trials = carts(lambda x, v: 0.1 * v - 0.2 * np.sin(3.0 * v), n=4, sigma=0.02, size=lambda i: 0.25)
    before = loaded(trials, ("stiffness", Free("damping", start=0.1, bounds=(0.0, None))))
    assert before.status == "bound"
    found = forward_selection(before, ["other", Offset("x")], refits=2)
    assert found.held_out_costs[0] == pytest.approx(before.held_out_cost, rel=1e-6)
    offset, other = (row_of(found, name) for name in ("offset of x", "other"))
    assert offset.predicted_cost == pytest.approx(offset.cost, rel=0.01)  # beyond the bound: lower by an eighth
    assert offset.values["damping"] == pytest.approx(0.0, abs=1e-6)
    assert other.values["damping"] == pytest.approx(0.1, abs=0.05)


@pytest.mark.slow
def test_a_thrust_is_not_reported_as_an_energy_source():
    """It adds energy as long as the cart moves forward, but not if the same motion is run backwards."""
    forward = Trial(T, {"x": 0.4 * T**2}, {"push": 0.0 * T}, sigma=0.1)
    assert energy_sources(fit(Track(), forward, "drift", simulation=Simulation(step=0.1))) == {}


def white(rng, *shape):
    return rng.normal(size=shape)


def slow(rng, *shape):
    """White noise with a slow error of 0.4 sigma, of which neighbours correlate by 0.14 only."""
    e = rng.normal(size=shape)
    for k in range(1, shape[-1]):
        e[..., k] = 0.95 * e[..., k - 1] + (1 - 0.95**2) ** 0.5 * e[..., k]
    return rng.normal(size=shape) + 0.4 * e


@pytest.mark.weekly
@pytest.mark.parametrize("noise", [white, slow])
@pytest.mark.parametrize("T", [3, 6, 12])
def test_false_positives(T, noise):
    """Of 300 sets without any of three candidates, at a level of 5 %: at most 6 %, plus what 300 draws may be off."""
    rng, times, taken = np.random.default_rng(T), np.linspace(0.0, 6.0, 60), 0
    for _ in range(300):
        rates = np.array([1.0, 2.2, 1.5, 3.1, 0.6]) * (1 + 0.2 * rng.normal(size=(T, 1, 5)))
        A = np.sin(rates * times[:, None] + rng.uniform(0, 6, (T, 1, 5)))
        r = noise(rng, T, times.size)
        x = solved(A[..., :2].reshape(-1, 2), r.ravel())
        r = r + A[..., :2] @ x  # at the minimum of the model with two parameters
        residuals = {f"{k}": {"y": r[k]} for k in range(T)}
        rows = LinearizedProblem(np.concatenate([A, r[..., None]], axis=2), np.zeros((5, 6)),
                                 np.linalg.norm(A, axis=(0, 1)))  # fmt: skip
        c, freedom = max(serial_correlation(residuals).values()), r.size - 2
        p = [score_test(rows, [0, 1], [i], degrees_of_freedom=freedom, correlation=c).p for i in (2, 3, 4)]
        taken += min(p) < 0.05 / 3
    assert taken / 300 <= 0.06 + 2 * (0.05 * 0.95 / 300) ** 0.5, taken / 300


@pytest.mark.parametrize("n", [3, 5, 13, 39])
def test_one_dominating_fold_does_not_hide_that_a_model_predicts_worse(n):
    """The other model is worse in every fold, and in one fold by far."""
    better = np.full(n, 100.0)
    for dominating in (0.0, 1e3, 1e6):
        other = better + 10.0
        other[-1] += dominating
        assert not predicts_as_well(better, other)
    assert not predicts_as_well(np.append(better[1:], 1e4), np.append(better[1:] + 10.0, 1e6))
    assert predicts_as_well(better, better * (1 + 1e-12))
    assert not predicts_as_well(better, np.append(better[1:], np.inf))


def comparisons(n, factor, heavy, rng, sets=300):
    """The share of pairs of models that `predicts_as_well` separates, of `n` folds. One model is worse by `factor`."""
    draw = (lambda: rng.standard_t(3, (sets, n)) / 3**0.5) if heavy else lambda: rng.standard_normal((sets, n))
    size = 100 * np.exp(0.5 * draw())
    pairs = zip(size * np.exp(0.2 * draw()), factor * size * np.exp(0.2 * draw()), strict=True)
    return np.mean([not predicts_as_well(*sorted(pair, key=np.sum)) for pair in pairs])


@pytest.mark.parametrize("heavy", [False, True])
def test_comparison_of_held_out_costs_has_its_level_and_power(heavy):
    """docs/uncertainty.md has the figures of 1000 pairs."""
    rng, folds = np.random.default_rng(0), (3, 5, 13, 39)
    assert max(comparisons(n, 1.0, heavy, rng) for n in folds) < 0.09  # 5 %, and three standard deviations
    assert min(comparisons(n, 2.0, heavy, rng) for n in folds[1:]) > 0.9
    assert min(comparisons(n, 20.0, heavy, rng) for n in folds) > 0.99
