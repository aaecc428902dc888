"""What a model lacks is found by name, what it does not lack is not; simulated pendulums whose truth is known."""

import dataclasses
import types

import jax.numpy as jnp
import numpy as np
import pytest
from systems import Track

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
    _problem,
    compare,
    cross_validate,
    fit,
    forward_selection,
    save_report,
)
from jaxkane.fit._candidates import AugmentedProblem, checked_candidates, compatible_groups
from jaxkane.fit._linearize import blocks_of
from jaxkane.fit._statistics import bic_change

TS = np.linspace(0.0, 2.0, 41)
NOISE = {"angle": 0.004, "rate": 0.02}
POSED = {"unknown": ("angle", "rate"), "optimizer": LeastSquares(), "simulation": Simulation(step=0.025)}


class Pendulum(jk.System):
    """Gravity and inertia in one, and what may act beside them."""

    stiffness: jk.Scalar = jk.parameter(20.0, positive=True)  # [1/s^2]
    damping: jk.Scalar = jk.parameter(0.3)
    dry: jk.Scalar = jk.parameter(0.0)
    quadratic: jk.Scalar = jk.parameter(0.0)
    spring: jk.Scalar = jk.parameter(0.0)
    unused: jk.Scalar = jk.parameter(1.0)
    coordinates = ("angle",)
    speeds = ("rate",)
    inputs = ("torque",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        B = N.rotate(2, q["angle"], u["rate"], "B")
        return jk.Motion([jk.Body(1.0, (1.0, 1.0, 1.0), O.fixed(0.0 * B.x), B, name="bob")], frames={"B": B})

    def loads(self, t, q, u, motion, inputs):
        s = u["rate"]
        torque = inputs["torque"] - self.stiffness * jnp.sin(q["angle"]) - self.damping * s
        torque = torque - self.dry * jnp.tanh(s / 0.1) - self.quadratic * s * jnp.abs(s) - self.spring * q["angle"]
        return jk.Torque(torque * motion["B"].y, motion["bob"])


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


def fitted(trials, **more) -> Fit:
    return fit(Pendulum(), trials, FREE, **{**POSED, **more})


@pytest.fixture(scope="module")
def rubbing():
    """A fit without dry friction of pendulums that have it."""
    return fitted(record(0, system=Pendulum(dry=0.4)))


@pytest.fixture(scope="module")
def found(rubbing):
    return forward_selection(rubbing, FIVE, depth=1, refits=1)


def test_dry_friction_is_found_among_five(rubbing, found):
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
    assert best.errors["dry"] == pytest.approx(found.fit.standard_errors["dry"], rel=0.05)


@pytest.mark.slow
def test_the_promise_is_that_of_a_fit(rubbing):
    """Beside a fit that is posed anew with one more parameter, and trials left out of it by refits."""
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


class Impostor(Pendulum):
    """With a parameter that does what dry friction and a spring do together, in another ratio."""

    both: jk.Scalar = jk.parameter(0.0)

    def loads(self, t, q, u, motion, inputs):
        torque = self.both * (0.5 * jnp.tanh(u["rate"] / 0.1) + q["angle"])
        return *as_loads(super().loads(t, q, u, motion, inputs)), jk.Torque(-torque * motion["B"].y, motion["bob"])


def as_loads(loads):
    return loads if isinstance(loads, tuple) else (loads,)


@pytest.fixture(scope="module")
def beams():
    """A search without gravity's sine, so that a spring is one of its own, by one way and by two."""
    trials = record(3, system=Pendulum(dry=0.4, spring=1.5))
    without = fit(Impostor(), trials, ("damping",), **POSED)
    return [forward_selection(without, ("both", "dry", "spring"), depth=2, beam=n) for n in (1, 2)]


def test_a_beam_finds_what_an_impostor_hides(beams):
    greedy, beam = beams
    assert greedy.selected[0] == "both"
    assert not greedy.alternatives or all("both" in one.names or len(one.names) == 1 for one in greedy.alternatives)
    sets = [{*beam.selected}, *({*one.names} for one in beam.alternatives if one.is_as_good)]
    assert {"dry", "spring"} in sets  # beside the impostor with one of them, which does the same
    assert {"both", "dry"} in sets or {"both", "spring"} in sets
    assert beam.fit.cost <= greedy.fit.cost * (1 + 1e-6)
    assert "These data do not tell it from" in str(beam)
    assert "Alternatives." in str(beam)
    assert "predicts as well" in beam._repr_html_()
    costs = [one.held_out_cost for one in beam.alternatives]
    assert costs == sorted(costs)


@pytest.mark.slow
def test_what_is_not_there_is_not_taken():
    taken = 0
    for seed in range(20):
        without = fitted(record(seed))
        taken += bool(forward_selection(without, ("dry", "spring", Offset("angle", scale=0.1)), refits=1).selected)
    assert taken <= 3  # at a level of 0.05 one is expected, and more than three come once in sixty


@pytest.mark.slow
def test_negative_friction_is_not_believed(rubbing):
    asked = ("quadratic", Free("spring", bounds=(0.0, None)))
    found = forward_selection(
        rubbing, asked, refits=None, level=0.9, plausible={"damping": (0.0, 0.6), "quadratic": (0.0, None)}
    )
    assert not found.selected
    quadratic, spring = (next(row for row in found.rounds[0] if row.name == name) for name in ("quadratic", "spring"))
    assert quadratic.bound_violations == ("damping = 0.9051 is above 0.6", "quadratic = -0.1769 is below 0") or (
        len(quadratic.bound_violations) == 2 and "quadratic" in quadratic.bound_violations[1]
    )
    assert quadratic.reason.startswith("not plausible: damping = 0.9")
    # Its bound is where it starts: it is searched for on both sides, and believed on one.
    assert spring.values["spring"] < 0
    assert spring.bound_violations[0].startswith("spring = -")


@pytest.mark.slow
def test_one_sensor_is_off_in_all_trials():
    trials = record(3, angle=0.05)
    kinds = (Offset("angle", scale=0.1), Offset("rate"), Gain("rate"), Delay("torque"), Delay("rate"), "dry")
    own = Candidate("zeros", sensor_bias="angle")  # of every trial: more unknowns for what is one number
    found = forward_selection(fitted(trials), (own, *kinds), refits=2)
    assert found.selected == ("offset of angle",)
    assert found.fit.estimates["offset of angle"] == pytest.approx(0.05, abs=4 * found.best.errors["offset of angle"])
    zeros = next(row for row in found.rounds[0] if row.name == "zeros")
    anew = fitted(trials, sensor_bias="angle")
    assert zeros.cost == pytest.approx(anew.cost, rel=1e-5)
    assert zeros.predicted_cost == pytest.approx(anew.cost, rel=0.05)


@pytest.mark.slow
def test_a_known_start_is_off_in_all_trials():
    trials = [trial.with_initial_state({"rate": 0.5 * (i % 3) + 0.1}) for i, trial in enumerate(record(4))]
    found = forward_selection(fitted(trials, unknown="angle"), [Offset("rate", of="start"), "dry", "quadratic"])
    assert found.selected == ("offset of start of rate",)
    assert found.fit.estimates["offset of start of rate"] == pytest.approx(-0.1, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("hold", [(), ("torque",)], ids=["linear", "held"])
def test_a_torque_that_acts_late(hold):
    """By two samples of 0.05 s; of a held one the delay is found to where its mean is taken for it."""
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


@pytest.mark.slow
def test_another_system_with_a_state():
    """What is not neutral anywhere is fitted; what its system begins with is not what is plausible."""
    trials = record(6, system=Lagging(lag=0.08))
    lag = Candidate("motor lag", system=Lagging(stiffness=3.0), free="lag", unknown="acting")
    found = forward_selection(fitted(trials), ["dry", Delay("torque"), lag], refits=3)
    assert found.selected == ("motor lag",)
    assert np.isnan(found.best.predicted_cost)
    assert found.fit.names == (*FREE, "lag")
    assert found.fit.estimates["lag"] == pytest.approx(0.08, abs=0.004)


@pytest.mark.slow
def test_what_data_cannot_tell_is_said(rubbing):
    posed = {"input_bias": "torque"}
    found = forward_selection(
        fitted(rubbing.problem.trials, **posed), ["unused", Offset("torque"), Candidate("own", input_gain="torque")]
    )
    reasons = {row.name: row.reason for row in found.rounds[0]}
    assert reasons["unused"] == "these data do not depend on unused"
    assert reasons["offset of torque"] == "offset of torque cannot be distinguished from what is free"
    assert "unused" in str(found)
    assert np.isnan(next(row for row in found.rounds[0] if row.name == "unused").errors["unused"])


@pytest.mark.slow
def test_one_trial_alone(rubbing):
    alone = fitted(rubbing.problem.trials[:1])
    found = forward_selection(alone, ["dry", "spring"])
    assert "nothing is left out" in found.tables[0][0]
    assert np.isnan(found.rounds[0][0].held_out_cost)
    assert found.selected == ("dry",)
    with pytest.raises(ValueError, match="one trial alone cannot be left out"):
        forward_selection(alone, "dry", folds=2)


@pytest.mark.parametrize(
    ("asked", "options", "message"),
    [
        ((), {}, "There is no candidate"),
        (("damping",), {}, "damping: damping is free in the fit already"),
        (("dry", "dry"), {}, "Two candidates are called dry"),
        (("dry", Candidate("bound", free=Free("dry", bounds=(-1.0, 1.0)))), {}, "free dry in different ways"),
        (("dyr",), {}, "Pendulum has no parameter 'dyr'; did you mean 'dry'"),
        ((Candidate("nothing"),), {}, "nothing: nothing is freed"),
        ((Candidate("again", unknown="angle"),), {}, "the start of angle is unknown already"),
        ((Candidate("a", free="dry", plausible={"dyr": (0, 1)}),), {}, "a: `plausible` names dyr"),
        pytest.param(("dry",), {"plausible": {"dyr": (0.0, 1.0)}}, "`plausible` names dyr", marks=pytest.mark.slow),
        (("dry",), {"plausible": {"damping": (1.0, 0.0)}}, "nothing lies between"),
        (("dry",), {"plausible": {"dry": 0.2}}, "a share is positive, and of a start that is not zero"),
        (("dry",), {"level": 0.0}, "`level` is a probability"),
        (("dry",), {"depth": 0}, "`depth` is a whole number of 1"),
        (("dry",), {"beam": 0}, "`beam` is a whole number of 1"),
        (("dry",), {"refits": -1}, "`refits` is a whole number of 0"),
        ((Offset("angel"),), {}, "no input or channel 'angel'; did you mean 'angle'"),
        ((Gain("torque", of="start"),), {}, "no coordinate, independent speed or state 'torque'"),
        ((Delay("angle", of="start"),), {}, "`of` is 'input' or 'sensor', or None"),
    ],
)
def test_what_cannot_be_asked_is_named(rubbing, asked, options, message):
    with pytest.raises(ValueError, match=message):
        forward_selection(rubbing, asked, **options)


def test_what_is_asked_of_a_fit_at_a_minimum(rubbing):
    with pytest.raises(TypeError, match="forward_selection takes a Fit"):
        forward_selection(rubbing.problem, "dry")
    with pytest.raises(ValueError, match="has not converged"):
        forward_selection(dataclasses.replace(rubbing, status="steps"), "dry")


def test_fits_beside_each_other(rubbing, found):
    held = record(9, system=Pendulum(dry=0.4))
    table = compare({"viscous": rubbing, "with friction": found.fit}, held, plausible={"damping": 0.5})
    assert table.held_out["with friction"].cost < 0.3 * table.held_out["viscous"].cost
    assert table.bound_violations["viscous"] == ("damping = 0.5362 is above 0.45",)
    text = str(table)
    # Where a search starts says nothing: of what nothing is said, anything is believed.
    assert compare({"viscous": rubbing}).bound_violations["viscous"] == ()
    for words in ("with friction", "dry", f"{found.fit.cost:.6g}", "swing 5", "neighbours' correlation", "Held out"):
        assert words in text
    assert f"{found.fit.cost:.6g}" in table._repr_html_()
    assert "status" in text
    # A violation is a row: a cell of all of them would make every column as wide.
    assert [row for heading, rows in table.tables if heading == "Bound violations" for row in rows] == [
        ["fit", "violation"],
        ["viscous", "damping = 0.5362 is above 0.45"],
    ]
    said = {"damping": (0.0, 0.45), "gain of angle": 0.2}  # as a search was given
    assert compare({"viscous": rubbing}, plausible=said).bound_violations["viscous"]
    with pytest.raises(ValueError, match="`plausible` names dampign; did you mean 'damping'"):
        compare([rubbing], plausible={"dampign": 0.5})
    with pytest.raises(ValueError, match="There is no fit"):
        compare({})
    with pytest.raises(TypeError, match="got one Fit"):
        compare(rubbing)
    with pytest.raises(ValueError, match="same free parameters"):
        compare([rubbing, rubbing])
    with pytest.raises(TypeError, match="compare takes a Fit"):
        compare([rubbing.problem])


def test_a_fit_of_one_candidate_runs_the_program_of_all(rubbing, monkeypatch):
    """Nothing is compiled for it, and it has the derivatives of a program of its own."""
    candidates = checked_candidates(rubbing, ["dry", Gain("torque"), "spring"])
    order, minimum = [c.name for c in candidates], (rubbing.problem, rubbing.point)
    augmented = AugmentedProblem.of(rubbing, minimum, candidates, (), order)
    augmented.problem.linearize(augmented.point)
    compiled = blocks_of.jitted._cached._cache_size()
    fits = [augmented.with_only(candidate, np.ones(0)) for candidate in candidates]
    together = [problem.linearize(dataclasses.replace(point, x=point.x + 0.01)) for problem, point in fits]
    assert blocks_of.jitted._cached._cache_size() == compiled
    monkeypatch.setattr(_problem, "MOST_SPARE_DERIVATIVES", 0)
    for (problem, point), at in zip(fits, together, strict=True):
        alone = problem.linearize(dataclasses.replace(point, x=point.x + 0.01))
        assert at.blocks.n_x == alone.blocks.n_x == 3
        np.testing.assert_allclose(at.simulated, alone.simulated, rtol=1e-12)
        squares = [np.swapaxes(R, 1, 2) @ np.asarray(R) for R in (at.blocks.R, alone.blocks.R)]
        np.testing.assert_allclose(*squares, rtol=1e-10, atol=1e-10)
    assert blocks_of.jitted._cached._cache_size() == compiled + 1


def test_a_page_of_the_report(found, tmp_path):
    page = save_report(found.fit, tmp_path / "fit.html", forward_selection=found).read_text(encoding="utf-8")
    assert "Model extensions" in page
    assert "no more than chance" in page
    assert "Selected: dry" in found._repr_html_()


@pytest.mark.parametrize("held", [("push",), ()])
def test_a_delay_of_what_is_held_is_asked_by_itself(held):
    """Its jumps are ramps: beside it no other candidate would be compared with the fit as it stands."""
    problem = types.SimpleNamespace(system=None, model=types.SimpleNamespace(zero_order_hold=held))
    asked = [Candidate("a", "mass"), Candidate("late", Delay("push")), Candidate("b", "stiffness")]
    groups = [[c.name for c in group] for group in compatible_groups(types.SimpleNamespace(problem=problem), asked)]
    assert groups == ([["a", "b"], ["late"]] if held else [["a", "late", "b"]])


class Squared(Track):
    """What is pushed acts by its square: neither system is a part of the other."""

    def loads(self, t, q, u, motion, inputs):
        return super().loads(t, q, u, motion, {"push": inputs["push"] ** 2})


def test_the_criterion_of_what_is_not_nested():
    """By hand, n log(after / before) + k log n; residuals that correlate are fewer."""
    rtol = 1e-12
    assert bic_change(3836.0, 455.0, 0, 400, 0.0) == pytest.approx(400 * np.log(455 / 3836), rel=rtol)
    assert bic_change(100.0, 99.0, 2, 400, 0.0) == pytest.approx(400 * np.log(0.99) + 2 * np.log(400), rel=rtol)
    assert bic_change(100.0, 90.0, 2, 400, 0.5) == pytest.approx(400 / 3 * np.log(0.9) + 2 * np.log(400 / 3), rel=rtol)


@pytest.mark.slow
@pytest.mark.parametrize(("n", "criterion"), [(4, "trials left out"), (1, "BIC")])
def test_what_is_not_nested_is_no_matter_of_an_f_test(n, criterion):
    """Another system without one parameter more, beside what is promising, with one refit."""
    rng, times, trials = np.random.default_rng(7), np.linspace(0.0, 3.0, 31), []
    for i in range(n):
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
    assert (row.criterion, row.accepted, np.isnan(row.p)) == (criterion, True, True)
    assert found.selected == ("squared",)
    assert f"squared (not nested: by {criterion})" in found.conclusion
    assert criterion in str(found)
    back = forward_selection(right, Candidate("not squared", system=Track()))
    assert not back.selected
    assert back.rounds[0][0].criterion == criterion
    assert forward_selection(wrong, asked, refits=0).rounds[0][-1].reason == "not nested, not fitted"
