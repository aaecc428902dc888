"""Ctrl-C and limits of the search keep the iterate; progress and errors are shown."""

import functools
import itertools
import os
import signal
import sys

import numpy as np
import pytest
from mechanisms import Sled

from jaxkane._collocate import solvers
from jaxkane._collocate.program import NonlinearProgram
from jaxkane.collocation import Problem, solve

pytest.importorskip("casadi")


@functools.cache
def fastest():
    return Problem(
        Sled(), (0.1, 10.0), controls={"force": (-1.0, 1.0)}, final_cost=lambda t, now: t,
        start={"x": 0.0, "v": 0.0}, end={"x": 1.0, "v": 0.0}, path=lambda t, now: {"slow": 0.8 - now["v"]},
    )  # fmt: skip


@pytest.mark.slow
def test_the_fastest_motion_below_a_speed_limit():
    """2.05 s without the error of four intervals. A place that is farther by 1 m costs 1.25 s at the speed limit."""
    atol = 1e-5
    plan = solve(fastest(), intervals=4, tolerance=None)
    assert plan.ok, plan.reason
    assert plan.duration == pytest.approx(2.0775535, abs=atol)
    assert plan.multipliers["x"][-1] == pytest.approx(1.25, abs=0.1)
    assert plan.violation < 1e-6


def interrupt(monkeypatch, first, times=1):
    """The user presses Ctrl-C at the n-th evaluation of the cost."""
    count, objective = itertools.count(1), NonlinearProgram.objective

    def counted(program, z):
        if first <= next(count) < first + times:
            os.kill(os.getpid(), signal.SIGINT)
        return objective(program, z)

    monkeypatch.setattr(NonlinearProgram, "objective", counted)


def test_interrupt_returns_the_best_iterate(monkeypatch):
    before = signal.getsignal(signal.SIGINT)
    interrupt(monkeypatch, 12)
    plan = solve(fastest(), intervals=4, starts=3)
    assert (plan.ok, plan.reason) == (False, "interrupted")
    assert len(plan.starts) == 1  # the other guesses are not tried
    assert np.all(np.isfinite(plan["x"]))
    assert 0.1 <= plan.duration <= 10.0
    assert signal.getsignal(signal.SIGINT) is before


def test_a_second_interrupt_ends_the_program(monkeypatch):
    interrupt(monkeypatch, 8, times=2)
    with pytest.raises(KeyboardInterrupt):
        solve(fastest(), intervals=4)


def test_failure_on_a_finer_mesh_keeps_the_solution():
    """The energy of a sled with a spring, whose mesh of one interval is too coarse."""
    problem = Problem(
        Sled(stiffness=4.0), 1.0, controls=["force"], cost=lambda t, now: now["force"] ** 2,
        start={"x": 0.0, "v": 0.0}, end={"x": 1.0, "v": 0.0},
    )  # fmt: skip
    plan = solve(problem, intervals=1, max_iterations=1)
    assert (plan.ok, plan.iterations) == (False, 1)  # of both meshes together
    assert plan.reason.startswith("solved, but not on a finer mesh: the largest number of iterations was reached")
    assert (len(plan.mesh), len(plan.costs)) == (2, 1)
    assert float(plan["x"][-1]) == 1.0
    assert np.max(plan.errors) > 1e-6


def test_an_error_in_a_function_is_not_hidden(monkeypatch):
    """IPOPT would report an exception in a callback as a number that is not finite."""

    def fails(*_):
        raise RuntimeError("out of memory")

    monkeypatch.setattr(NonlinearProgram, "hessian", fails)
    with pytest.raises(RuntimeError, match="out of memory"):
        solve(fastest(), intervals=4)


def test_largest_number_of_iterations():
    plan = solve(fastest(), intervals=4, max_iterations=3)
    assert not plan.ok
    assert plan.iterations == 3
    assert plan.reason == "the largest number of iterations was reached"
    assert plan.unmet
    again = solve(fastest(), plan, intervals=4, tolerance=None)
    assert again.ok
    assert again.duration == pytest.approx(2.0775535, abs=1e-5)


def test_the_longest_time_keeps_the_iterate():
    plan = solve(fastest(), intervals=4, max_seconds=1e-9, starts=2)
    assert (plan.ok, plan.reason, plan.iterations) == (False, "the longest time was reached", 0)
    assert len(plan.starts) == 1
    assert np.all(np.isfinite(plan["x"]))


def test_progress_is_shown_later_on_a_terminal_only(capsys, monkeypatch):
    monkeypatch.setattr(solvers, "LATE", 0.0)
    solve(fastest(), intervals=4, tolerance=None)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    solve(fastest(), intervals=4, tolerance=None)
    assert "\riteration 3: cost " in capsys.readouterr().err


def test_progress_is_shown_on_one_line(capsys):
    solve(fastest(), intervals=4, tolerance=None, progress=True)
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.startswith("\riteration 0: cost ")
    assert shown.err.endswith("\n")
    assert shown.err.count("\n") == 1


def test_missing_casadi_is_reported(monkeypatch):
    monkeypatch.setitem(sys.modules, "casadi", None)
    with pytest.raises(ImportError, match=r'pip install "jaxkane\[collocation\]"'):
        solve(fastest(), intervals=4)
