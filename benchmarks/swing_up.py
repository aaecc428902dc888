"""A double pendulum swung up with the least torque: CasADi's export and IPOPT, against opty, which has IPOPT too.

The problem of notebook 08. There: 80 intervals of Hermite-Simpson, with torques at the ends and in the middle. opty:
the midpoint rule between 161 nodes, the same number of torques; its objective and gradient are written out here. The
problem has several minima, so that both start from the same eight motions, and end in different ones; each of opty's
solutions is refined by the other, to compare the costs of one and the same minimum.
"""

from __future__ import annotations

import time
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


class Solved(NamedTuple):
    """A minimum: states (4, 2 N + 1), torques (2, 2 N + 1), the integral of their squares, seconds."""

    states: np.ndarray
    torques: np.ndarray
    cost: float
    seconds: float


Solver = Callable[[np.ndarray, np.ndarray], Solved]


def measure(setting: Setting) -> Iterator[Figure]:
    if not here("opty"):
        return
    ours, build_ours = _timed(by_casadi)
    opty, build_opty = _timed(by_opty)
    still = np.zeros((2, 2 * N + 1))
    pairs = [(ours(line, still), opty(line, still)) for line in starts(1 if setting.quick else 8)]
    refined = [ours(theirs.states, theirs.torques).cost / theirs.cost for _, theirs in pairs]
    best, best_of_opty = (min(x.cost for x in solved) for solved in zip(*pairs))
    seconds, seconds_of_opty = (sum(x.seconds for x in solved) for solved in zip(*pairs))
    yield Figure("swing_up", "to build the problem", build_ours, "s")
    yield Figure("swing_up", "opty: to build the problem", build_opty, "s")
    yield Figure("swing_up", "a solution, mean of all starts", seconds / len(pairs), "s")
    yield Figure("swing_up", "opty: a solution, mean of all starts", seconds_of_opty / len(pairs), "s")
    yield Figure("swing_up", "time to solve against opty's", seconds / seconds_of_opty, at_most=1.0)
    off = max(abs(ratio - 1) for ratio in refined)
    yield Figure("swing_up", "costs of opty's minima, largest difference", off, "", at_most=0.01)
    yield Figure("swing_up", "least cost", best, "N^2 m^2 s")
    yield Figure("swing_up", "opty: least cost", best_of_opty, "N^2 m^2 s")
    yield Figure("swing_up", "least cost against opty's", best / best_of_opty, at_most=1.01)


def _timed(build: Callable[[], Solver]) -> tuple[Solver, float]:
    begin = time.perf_counter()
    return build(), time.perf_counter() - begin


def starts(count: int) -> Iterator[np.ndarray]:
    """States (4, 2 N + 1) to begin with: the straight line, then detours from it."""
    s, rng = np.linspace(0, 1, 2 * N + 1), np.random.default_rng(0)
    for i in range(count):
        detour = sum(rng.normal(size=(2, 1)) * np.sin(k * np.pi * s) for k in (1, 2, 3)) if i else 0.0
        line = np.outer(END, s)
        line[:2] += detour
        yield line


def by_casadi() -> Solver:
    import casadi as ca

    pendulum = jk.catalog.DoublePendulum(mass=MASS, length=LENGTH, gravity=GRAVITY)
    rates = jk.export.casadi(pendulum)
    p = np.array(list(jk.export.parameters(pendulum).values()), float)

    def f(x: Any, torque: Any) -> Any:
        return ca.vertcat(*rates(0.0, x[:2], x[2:], torque, p))

    opti, h, cost = ca.Opti(), T / N, 0
    X, U, W = opti.variable(4, N + 1), opti.variable(2, N + 1), opti.variable(2, N)
    for i in range(N):
        a, b = f(X[:, i], U[:, i]), f(X[:, i + 1], U[:, i + 1])
        middle = (X[:, i] + X[:, i + 1]) / 2 + h / 8 * (a - b)
        opti.subject_to(X[:, i + 1] - X[:, i] == h / 6 * (a + 4 * f(middle, W[:, i]) + b))
        cost += h / 6 * (ca.sumsqr(U[:, i]) + 4 * ca.sumsqr(W[:, i]) + ca.sumsqr(U[:, i + 1]))
    opti.minimize(cost)
    opti.subject_to(X[:, 0] == 0)
    opti.subject_to(X[:, N] == END)
    opti.solver("ipopt", {"print_time": False, "expand": True}, {"print_level": 0, "sb": "yes"})

    def solve(states: np.ndarray, torques: np.ndarray) -> Solved:
        for variable, value in ((X, states[:, ::2]), (U, torques[:, ::2]), (W, torques[:, 1::2])):
            opti.set_initial(variable, value)
        begin = time.perf_counter()
        solution = opti.solve()
        seconds = time.perf_counter() - begin
        return Solved(states, torques, float(solution.value(cost)), seconds)

    return solve


def by_opty() -> Solver:
    import sympy as sm
    import sympy.physics.mechanics as me
    from opty import Problem

    t, n = me.dynamicsymbols._t, 2 * N + 1
    h = T / (n - 1)
    a, b, v, w, shoulder, elbow = me.dynamicsymbols("a b v w shoulder elbow")
    at = lambda *parts: sm.Matrix([sum(l * f(x) for l, x in parts) for f in (sm.sin, sm.cos)])  # noqa: E731
    centers = at((LENGTH / 2, a)), at((LENGTH, a), (LENGTH / 2, b))  # to the side, and down
    L = MASS * LENGTH**2 / 24 * (a.diff(t) ** 2 + b.diff(t) ** 2)
    L += sum(MASS * (r.diff(t).dot(r.diff(t)) / 2 + GRAVITY * r[1]) for r in centers)
    eom = me.LagrangesMethod(L, [a, b]).form_lagranges_equations() - sm.Matrix([shoulder - elbow, elbow])
    eom = eom.subs({a.diff(t, 2): v.diff(t), b.diff(t, 2): w.diff(t)}).subs({a.diff(t): v, b.diff(t): w})
    states = (a, b, v, w)
    ends = [x.func(0.0) for x in states] + [x.func(T) - end for x, end in zip(states, END)]

    def cost(x: np.ndarray) -> float:
        U = x[4 * n :].reshape(2, n)
        return h * float(np.sum((U[:, 1:] + U[:, :-1]) ** 2)) / 4

    def gradient(x: np.ndarray) -> np.ndarray:
        U = x[4 * n :].reshape(2, n)
        sums, found = (U[:, 1:] + U[:, :-1]) * h / 2, np.zeros((6, n))
        found[4:, 1:] += sums
        found[4:, :-1] += sums
        return found.ravel()

    problem = Problem(
        cost,
        gradient,
        sm.Matrix([a.diff(t) - v, b.diff(t) - w, *eom]),
        states,
        n,
        h,
        instance_constraints=tuple(ends),
        integration_method="midpoint",
        time_symbol=t,
    )
    problem.add_option("print_level", 0)
    problem.add_option("sb", "yes")

    def solve(states: np.ndarray, torques: np.ndarray) -> Solved:
        begin = time.perf_counter()
        x, info = problem.solve(np.vstack([states, torques[::-1]]).ravel())
        seconds = time.perf_counter() - begin
        if info["status"] not in (0, 1):  # solved, and solved to the acceptable level
            raise RuntimeError(f"opty's IPOPT: {info['status_msg'].decode()}")
        found = x.reshape(6, n)
        return Solved(found[:4], found[:3:-1], float(info["obj_val"]), seconds)  # its torques stand by name

    return solve
