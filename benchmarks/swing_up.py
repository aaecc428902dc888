"""Optimal control by `jaxkane.collocation` against opty, both with IPOPT: CPU seconds of a first and a second solution.

The problem is the swing-up of notebook 08. The time of the first solution includes everything after the imports: the
equations of motion, compilation and the solver. The second solution is that of the same problem with another weight in
the cost, from the first solution. Neither program compiles the equations again: the objective of opty is a function.

Both have the same number of torques: 80 intervals of Hermite-Simpson, and 161 nodes of opty's midpoint rule. The
initial guess is a straight line. The problem has several minima, and the programs may find different ones. To compare
one and the same minimum, the solution of opty is the guess of a further solution by jaxkane.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

import jaxkane as jk

from ._figures import Figure
from ._peers import here
from ._process import Setting

N, T = 80, 2.0  # intervals, s
MASS, LENGTH, GRAVITY = 1.0, 0.5, 9.81
END = np.array([np.pi, np.pi, 0.0, 0.0])
WEIGHT = 4.0  # of the torque of the elbow, in the second cost


class Solved(NamedTuple):
    """A minimum: states (4, 2 N + 1), torques (2, 2 N + 1), the cost, and the number of iterations."""

    states: np.ndarray
    torques: np.ndarray
    cost: float
    iterations: int


def measure(setting: Setting) -> Iterator[Figure]:
    if not here("opty"):
        return
    for package in ("opty", "sympy.physics.mechanics"):
        importlib.import_module(package)  # not a part of the first solution
    line = np.outer(END, np.linspace(0.0, 1.0, 2 * N + 1))
    still = np.zeros((2, 2 * N + 1))
    ours, seconds = _timed(lambda: by_jaxkane(line, still, 1.0))
    other, seconds_second = _timed(lambda: by_jaxkane(ours.states, ours.torques, WEIGHT))
    opty = Opty()
    theirs, opty_seconds = _timed(lambda: opty.solve(line, still, 1.0))
    theirs_other, opty_second = _timed(lambda: opty.solve(theirs.states, theirs.torques, WEIGHT))
    refined = by_jaxkane(theirs.states, theirs.torques, 1.0)
    part = "swing_up"
    yield Figure(part, "first solution, CPU time", seconds, "s")
    yield Figure(part, "opty: first solution, CPU time", opty_seconds, "s")
    yield Figure(part, "first solution: opty's time against it", opty_seconds / seconds, at_least=5.0)
    yield Figure(part, "second solution, CPU time", seconds_second, "s")
    yield Figure(part, "opty: second solution, CPU time", opty_second, "s")
    yield Figure(part, "second solution: opty's time against it", opty_second / seconds_second, at_least=20.0)
    yield Figure(part, "iterations of both solutions", ours.iterations + other.iterations, "")
    yield Figure(part, "opty: iterations of both solutions", theirs.iterations + theirs_other.iterations, "")
    yield Figure(part, "least cost of the first problem", ours.cost, "N^2 m^2 s")
    yield Figure(part, "opty: least cost of the first problem", theirs.cost, "N^2 m^2 s")
    yield Figure(part, "cost of opty's minimum, difference", abs(refined.cost / theirs.cost - 1), "", at_most=0.01)


def _timed(f: Callable[[], Solved]) -> tuple[Solved, float]:
    """CPU seconds of this process and of the compilers that it starts."""
    begin = _cpu()
    return f(), _cpu() - begin


def _cpu() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def by_jaxkane(states: np.ndarray, torques: np.ndarray, weight: float) -> Solved:
    pendulum = jk.catalog.DoublePendulum(mass=MASS, length=LENGTH, gravity=GRAVITY)
    names, (shoulder, elbow) = (*pendulum.coordinates, *pendulum.speeds), pendulum.inputs
    problem = jk.collocation.Problem(
        pendulum,
        T,
        controls=pendulum.inputs,
        cost=lambda t, now: now[shoulder] ** 2 + weight * now[elbow] ** 2,
        start=dict.fromkeys(names, 0.0),
        end=dict(zip(names, END.tolist(), strict=True)),
    )
    guess = dict(zip((*names, *pendulum.inputs), (*states, *torques), strict=True))
    plan = jk.collocation.solve(problem, guess, intervals=N, tolerance=None)
    if not plan.ok:
        raise RuntimeError(f"jaxkane: {plan.reason}")
    found = np.stack([np.asarray(plan[name]) for name in (*names, shoulder, elbow)])
    return Solved(found[:4], found[4:], plan.cost, plan.iterations)


class Opty:
    """The problem in opty. Its constraints are compiled at the first solution."""

    def __init__(self) -> None:
        self.problem: Any = None
        self.weight = 1.0

    def solve(self, states: np.ndarray, torques: np.ndarray, weight: float) -> Solved:
        self.weight = weight
        if self.problem is None:
            self.problem = self._problem()
        x, info = self.problem.solve(np.vstack([states, torques[::-1]]).ravel())
        if info["status"] not in (0, 1):  # solved, and solved to the acceptable level
            raise RuntimeError(f"opty's IPOPT: {info['status_msg'].decode()}")
        found = x.reshape(6, 2 * N + 1)
        # opty sorts the torques by name.
        return Solved(found[:4], found[:3:-1], float(info["obj_val"]), len(self.problem.obj_value))

    def _cost(self, x: np.ndarray) -> float:
        U, h = x[4 * (2 * N + 1) :].reshape(2, -1), T / (2 * N)
        squares = np.sum((U[:, 1:] + U[:, :-1]) ** 2, axis=1)
        return h * float(self.weight * squares[0] + squares[1]) / 4

    def _gradient(self, x: np.ndarray) -> np.ndarray:
        n, h = 2 * N + 1, T / (2 * N)
        U, found = x[4 * n :].reshape(2, n), np.zeros((6, n))
        sums = (U[:, 1:] + U[:, :-1]) * h / 2 * np.array([[self.weight], [1.0]])
        found[4:, 1:] += sums
        found[4:, :-1] += sums
        return found.ravel()

    def _problem(self) -> Any:
        import sympy as sm
        import sympy.physics.mechanics as me
        from opty import Problem

        t = me.dynamicsymbols._t
        a, b, v, w, shoulder, elbow = me.dynamicsymbols("a b v w shoulder elbow")
        at = lambda *parts: sm.Matrix([sum(l * f(x) for l, x in parts) for f in (sm.sin, sm.cos)])  # noqa: E731
        centers = at((LENGTH / 2, a)), at((LENGTH, a), (LENGTH / 2, b))  # to the side, and down
        L = MASS * LENGTH**2 / 24 * (a.diff(t) ** 2 + b.diff(t) ** 2)
        L += sum(MASS * (r.diff(t).dot(r.diff(t)) / 2 + GRAVITY * r[1]) for r in centers)
        eom = me.LagrangesMethod(L, [a, b]).form_lagranges_equations() - sm.Matrix([shoulder - elbow, elbow])
        eom = eom.subs({a.diff(t, 2): v.diff(t), b.diff(t, 2): w.diff(t)}).subs({a.diff(t): v, b.diff(t): w})
        states = (a, b, v, w)
        ends = [x.func(0.0) for x in states] + [x.func(T) - end for x, end in zip(states, END, strict=True)]
        problem = Problem(
            lambda free: self._cost(free),  # opty counts the arguments
            lambda free: self._gradient(free),
            sm.Matrix([a.diff(t) - v, b.diff(t) - w, *eom]),
            states,
            2 * N + 1,
            T / (2 * N),
            instance_constraints=tuple(ends),
            integration_method="midpoint",
            time_symbol=t,
        )
        problem.add_option("print_level", 0)
        problem.add_option("sb", "yes")
        return problem
