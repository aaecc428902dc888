"""The solvers give the same plans. Ctrl-C and the largest number of iterations keep the iterate."""

import dataclasses
import functools
import importlib.util
import os
import signal
from typing import Any

import numpy as np
import pytest
from mechanisms import Sled

from jaxkane.collocation import Ipopt, Problem, TrustConstr, solve


def needs(package):
    return pytest.mark.skipif(importlib.util.find_spec(package) is None, reason=f"{package} is not installed")


IPOPT = pytest.param(Ipopt(), marks=needs("casadi"))
SOLVERS = [IPOPT, TrustConstr()]


@functools.cache
def fastest():
    return Problem(
        Sled(), (0.1, 10.0), controls={"force": (-1.0, 1.0)}, final_cost=lambda t, now: t,
        start={"x": 0.0, "v": 0.0}, end={"x": 1.0, "v": 0.0}, path=lambda t, now: {"slow": 0.8 - now["v"]},
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS, ids=lambda solver: type(solver).__name__)
def test_all_solvers_converge_to_the_same_plan(solver):
    """2.05 s without the error of four intervals. A place that is farther by 1 m costs 1.25 s at the speed limit."""
    atol = 1e-5
    plan = solve(fastest(), intervals=4, solver=solver, tolerance=None)
    assert plan.ok, plan.reason
    assert plan.duration == pytest.approx(2.0775535, abs=atol)
    assert plan.multipliers["x"][-1] == pytest.approx(1.25, abs=0.1)
    assert plan.violation < 1e-6


@dataclasses.dataclass(frozen=True)
class Interrupted:
    """A solver, during which the user presses Ctrl-C at the n-th evaluation of the cost."""

    solver: Any
    n: int
    times: int = 1

    def __call__(self, program, z, monitor, **options):
        count, objective = [0], program.objective

        def counted(z):
            count[0] += 1
            if self.n <= count[0] < self.n + self.times:
                os.kill(os.getpid(), signal.SIGINT)
            return objective(z)

        program.objective = counted
        return self.solver(program, z, monitor, **options)


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda solver: type(solver).__name__)
def test_interrupt_returns_the_best_iterate(solver):
    before = signal.getsignal(signal.SIGINT)
    plan = solve(fastest(), intervals=4, solver=Interrupted(solver, 12), starts=3)
    assert (plan.ok, plan.reason) == (False, "interrupted")
    assert len(plan.starts) == 1  # the other guesses are not tried
    assert np.all(np.isfinite(plan["x"]))
    assert 0.1 <= plan.duration <= 10.0
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("solver", [IPOPT], ids=lambda solver: type(solver).__name__)
def test_a_second_interrupt_ends_the_program(solver):
    with pytest.raises(KeyboardInterrupt):
        solve(fastest(), intervals=4, solver=Interrupted(solver, 6, times=2))


@dataclasses.dataclass
class OnlyCoarse:
    """A solver that fails on the second mesh."""

    status: str
    calls: int = 0

    def __call__(self, program, z, monitor, **options):
        self.calls += 1
        solution = TrustConstr()(program, z, monitor, **options)
        return solution if self.calls == 1 else dataclasses.replace(solution, z=0 * z, ok=False, status=self.status)


@pytest.mark.slow_cases("interrupted")
@pytest.mark.parametrize("status", ["interrupted", "the largest number of iterations was reached"])
def test_failure_on_a_finer_mesh_keeps_the_solution(status):
    """The energy of a sled with a spring, whose mesh of one interval is too coarse."""
    problem = Problem(
        Sled(stiffness=4.0), 1.0, controls=["force"], cost=lambda t, now: now["force"] ** 2,
        start={"x": 0.0, "v": 0.0}, end={"x": 1.0, "v": 0.0},
    )  # fmt: skip
    plan = solve(problem, intervals=1, solver=OnlyCoarse(status))
    assert not plan.ok
    assert plan.reason == (status if status == "interrupted" else f"solved, but not on a finer mesh: {status}")
    assert (len(plan.mesh), len(plan.costs)) == (2, 1)
    assert float(plan["x"][-1]) == 1.0
    assert np.max(plan.errors) > 1e-6


def test_an_error_in_a_function_is_not_hidden():
    """Solvers would report an exception in a callback as a number that is not finite."""

    @dataclasses.dataclass(frozen=True)
    class Failing:
        def __call__(self, program, z, monitor, **options):
            def fails(z):
                raise RuntimeError("out of memory")

            program.hessian = program.gradient = fails
            return Ipopt()(program, z, monitor, **options)

    pytest.importorskip("casadi")
    with pytest.raises(RuntimeError, match="out of memory"):
        solve(fastest(), intervals=4, solver=Failing())


@pytest.mark.parametrize("solver", [IPOPT], ids=lambda solver: type(solver).__name__)
def test_largest_number_of_iterations(solver):
    plan = solve(fastest(), intervals=4, solver=solver, max_iterations=3)
    assert not plan.ok
    assert plan.iterations == 3
    assert plan.reason == "the largest number of iterations was reached"
    assert plan.unmet
    again = solve(fastest(), plan, intervals=4, solver=solver, tolerance=None)
    assert again.ok
    assert again.duration == pytest.approx(2.0775535, abs=1e-5)


def test_progress_is_shown_on_one_line(capsys):
    solve(fastest(), intervals=4, tolerance=None, progress=True)
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.startswith("\riteration 0: cost ")
    assert shown.err.endswith("\n")
    assert shown.err.count("\n") == 1


def test_the_default_solver_without_ipopt_is_reported(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)

    class Called(Exception):
        pass

    def called(*_, **options):
        raise Called

    monkeypatch.setattr(TrustConstr, "__call__", called)
    with pytest.warns(UserWarning, match=r"pip install jaxkane\[collocation\]"), pytest.raises(Called):
        solve(fastest(), intervals=4)
