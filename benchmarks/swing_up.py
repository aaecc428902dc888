"""Optimal control by `jaxkane.collocation` against opty, both with IPOPT: CPU seconds of a first and a second solution.

The problems are the swing-up of notebook 08 and the lane change of notebook 09. The time of the first solution includes
everything after the imports: equations of motion, compilation and solver. The second solution is that of the same
problem with another weight in the cost, from the first solution. Neither program compiles again for it: the objective
of opty is a function of NumPy, and that of jaxkane has the weight as an array.

Both have the same number of controls: N intervals of Hermite-Simpson, and 2 N + 1 nodes of opty's midpoint rule. The
swing-up has several minima, and the programs may find different ones. To compare one and the same minimum, the
solution of opty is the guess of a further solution by jaxkane.
"""

from __future__ import annotations

import importlib
import resource
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxkane as jk

from ._figures import Figure
from ._peers import here
from ._process import Setting

MASS, LENGTH, GRAVITY = 1.0, 0.5, 9.81
SPEED, ASIDE = 6.0, 1.5  # of the bicycle [m/s], [m]
STRAIGHT = ("roll", "steer", "yaw", "roll_rate", "steer_rate")  # they are zero at the end of the lane change


class Task(NamedTuple):
    """A problem for both programs.

    - `name`: in the table. `system`: the system.
    - `N`, `duration`: the number of intervals, and the duration [s].
    - `start`, `end`: values by name.
    - `controls`: names of the controls.
    - `weights`: the second weights of squared values in the cost, by name; the first ones are 1 for controls, else 0.
    - `equations`: a function that returns the equations of motion of opty, its states and its controls, in the order
        of the names, and its parameters.
    - `guess`: values (n, 2 N + 1) by name, of states and controls.
    """

    name: str
    system: jk.System
    N: int
    duration: float
    start: dict[str, float]
    end: dict[str, float]
    controls: tuple[str, ...]
    weights: dict[str, float]
    equations: Callable[[], tuple[Any, Sequence[Any], Sequence[Any], dict[Any, float]]]
    guess: dict[str, np.ndarray]


class Solved(NamedTuple):
    """A minimum: values by name, the cost, and the number of iterations."""

    values: dict[str, np.ndarray]
    cost: float
    iterations: int


def measure(setting: Setting) -> Iterator[Figure]:
    if not here("opty"):
        return
    for package in ("opty", "sympy.physics.mechanics"):
        importlib.import_module(package)  # not a part of the first solution
    for task in [swing_up()] if setting.quick else [swing_up(), lane_change()]:
        yield from compared(task)


def compared(task: Task) -> Iterator[Figure]:
    def figure(what: str, *args: Any, **target: float) -> Figure:
        return Figure("swing_up", f"{task.name}: {what}", *args, **target)

    weights = {name: float(name in task.controls) for name in task.weights}
    ours, seconds = _timed(lambda: by_jaxkane(task, task.guess, weights))
    _, seconds_second = _timed(lambda: by_jaxkane(task, ours.values, task.weights))
    opty = Opty(task)
    theirs, opty_seconds = _timed(lambda: opty.solve(task.guess, weights))
    _, opty_second = _timed(lambda: opty.solve(theirs.values, task.weights))
    refined = by_jaxkane(task, theirs.values, weights)
    yield figure("first solution, CPU time", seconds, "s")
    yield figure("opty, first solution, CPU time", opty_seconds, "s")
    yield figure("first solution, opty's time against it", opty_seconds / seconds, at_least=5.0)
    yield figure("second solution, CPU time", seconds_second, "s")
    yield figure("opty, second solution, CPU time", opty_second, "s")
    yield figure("second solution, opty's time against it", opty_second / seconds_second, at_least=20.0)
    yield figure("iterations of the first solution", ours.iterations, "")
    yield figure("opty, iterations of the first solution", theirs.iterations, "")
    yield figure("least cost", ours.cost, "N^2 m^2 s")
    yield figure("opty, least cost", theirs.cost, "N^2 m^2 s")
    off = abs(refined.cost / theirs.cost - 1)
    yield figure("opty, difference from the cost of the same minimum", off, "", at_most=0.01)


def _timed(f: Callable[[], Solved]) -> tuple[Solved, float]:
    """CPU seconds of this process and of the compilers that it starts."""
    begin = _cpu()
    return f(), _cpu() - begin


def _cpu() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def weighted_squares(weights: dict[str, Any], t: Any, now: jk.collocation.Now) -> Any:
    return sum(weight * now[name] ** 2 for name, weight in weights.items())


def by_jaxkane(task: Task, guess: dict[str, np.ndarray], weights: dict[str, float]) -> Solved:
    arrays = {name: jnp.asarray(weight) for name, weight in weights.items()}
    problem = jk.collocation.Problem(
        task.system,
        task.duration,
        controls=task.controls,
        cost=jax.tree_util.Partial(weighted_squares, arrays),  # a number would be compiled into the program
        start=task.start,
        end=task.end,
    )
    own = {name: guess[name] for name in (*problem.names, *task.controls)}  # without dependent speeds
    plan = jk.collocation.solve(problem, own, intervals=task.N, tolerance=None)
    if not plan.ok:
        raise RuntimeError(f"jaxkane: {plan.reason}")
    return Solved({name: np.asarray(plan[name]) for name in guess}, plan.cost, plan.iterations)


class Opty:
    """A task in opty. Its constraints are compiled at the first solution."""

    def __init__(self, task: Task) -> None:
        self.task, self.names = task, (*names_of(task.system), *task.controls)
        self.problem: Any = None
        self.order = self.names
        self.weights: dict[str, float] = {}

    def solve(self, guess: dict[str, np.ndarray], weights: dict[str, float]) -> Solved:
        self.weights = weights
        if self.problem is None:
            self.problem = self._problem()
        before = len(self.problem.obj_value)
        x, info = self.problem.solve(np.concatenate([guess[name] for name in self.order]))
        # -3: at the minimum of the lane change, IPOPT without second derivatives fails to meet its own tolerance.
        if info["status"] not in (0, 1, -3):
            raise RuntimeError(f"opty's IPOPT: {info['status_msg'].decode()}")
        values = dict(zip(self.order, x.reshape(len(self.order), -1), strict=True))
        return Solved(values, self._cost(x), len(self.problem.obj_value) - before)

    def _cost(self, x: np.ndarray) -> float:
        rows, h = x.reshape(len(self.order), -1), self.task.duration / (2 * self.task.N)
        pairs = ((weight, rows[self.order.index(name)]) for name, weight in self.weights.items())
        return h * sum(weight * float(np.sum((row[1:] + row[:-1]) ** 2)) / 4 for weight, row in pairs)

    def _gradient(self, x: np.ndarray) -> np.ndarray:
        rows, h = x.reshape(len(self.order), -1), self.task.duration / (2 * self.task.N)
        found = np.zeros_like(rows)
        for name, weight in self.weights.items():
            i = self.order.index(name)
            sums = weight * h / 2 * (rows[i, 1:] + rows[i, :-1])
            found[i, 1:] += sums
            found[i, :-1] += sums
        return found.ravel()

    def _problem(self) -> Any:
        from opty import Problem

        task = self.task
        equations, states, controls, parameters = task.equations()
        by_name = dict(zip(self.names, (*states, *controls), strict=True))
        # The equations of dependent speeds are differentiated constraints, so these speeds need initial values.
        start = {name: task.start.get(name, float(task.guess[name][0])) for name in names_of(task.system)}
        ends = [by_name[name].func(0.0) - value for name, value in start.items()]
        ends += [by_name[name].func(task.duration) - value for name, value in task.end.items()]
        # opty sorts the controls by the names of their symbols.
        self.order = (*self.names[: len(states)], *sorted(task.controls, key=lambda name: str(by_name[name])))
        problem = Problem(
            lambda free: self._cost(free),
            lambda free: self._gradient(free),
            equations,
            tuple(states),
            2 * task.N + 1,
            task.duration / (2 * task.N),
            known_parameter_map=parameters,
            instance_constraints=tuple(ends),
            integration_method="midpoint",
            time_symbol=importlib.import_module("sympy.physics.mechanics").dynamicsymbols._t,
        )
        problem.add_option("print_level", 0)
        problem.add_option("sb", "yes")
        return problem


def names_of(system: jk.System) -> tuple[str, ...]:
    """Coordinates and all speeds: the dependent ones are states of opty."""
    return (*system.coordinates, *system.speeds, *system.dependent_speeds)


def swing_up() -> Task:
    pendulum: Any = jk.catalog.DoublePendulum(mass=MASS, length=LENGTH, gravity=GRAVITY)  # pyright: ignore[reportCallIssue]
    names = names_of(pendulum)
    end = dict(zip(names, (np.pi, np.pi, 0.0, 0.0), strict=True))
    s = np.linspace(0.0, 1.0, 161)
    guess = {name: value * s for name, value in end.items()} | dict.fromkeys(pendulum.inputs, 0.0 * s)
    weights = dict(zip(pendulum.inputs, (1.0, 4.0), strict=True))
    start = dict.fromkeys(names, 0.0)
    return Task("swing-up", pendulum, 80, 2.0, start, end, pendulum.inputs, weights, pendulum_in_opty, guess)


def pendulum_in_opty() -> Any:
    import sympy as sm
    import sympy.physics.mechanics as me

    t = me.dynamicsymbols._t
    a, b, v, w, shoulder, elbow = me.dynamicsymbols("a b v w shoulder elbow")
    at = lambda *parts: sm.Matrix([sum(l * f(x) for l, x in parts) for f in (sm.sin, sm.cos)])  # noqa: E731
    centers: Any = (at((LENGTH / 2, a)), at((LENGTH, a), (LENGTH / 2, b)))  # to the side, and down
    L = MASS * LENGTH**2 / 24 * (a.diff(t) ** 2 + b.diff(t) ** 2)
    L += sum(MASS * (r.diff(t).dot(r.diff(t)) / 2 + GRAVITY * r[1]) for r in centers)
    eom = me.LagrangesMethod(L, [a, b]).form_lagranges_equations() - sm.Matrix([shoulder - elbow, elbow])
    eom = eom.subs({a.diff(t, 2): v.diff(t), b.diff(t, 2): w.diff(t)}).subs({a.diff(t): v, b.diff(t): w})
    return sm.Matrix([a.diff(t) - v, b.diff(t) - w, *eom]), (a, b, v, w), (shoulder, elbow), {}


def lane_change() -> Task:
    bicycle: Any = jk.catalog.WhippleBicycle.benchmark()
    rolling = jk.assemble(bicycle, {}, {"rear_wheel_rate": -SPEED / float(bicycle.rR)})
    independent = dict(zip((*bicycle.coordinates, *bicycle.speeds), (*rolling.q, *rolling.u), strict=True))
    start = {name: float(value) for name, value in independent.items()}
    end = {"y": ASIDE} | dict.fromkeys(STRAIGHT, 0.0)
    t = np.linspace(0.0, 3.0, 101)
    guess = {name: value + 0.0 * t for name, value in start.items()}
    front = -SPEED / float(bicycle.rF)
    guess |= {
        "x": SPEED * t,
        "y": ASIDE * t / 3.0,
        "rear_wheel_angle": start["rear_wheel_rate"] * t,
        "front_wheel_angle": front * t,
    }
    guess |= {"front_wheel_rate": front + 0.0 * t} | dict.fromkeys(("yaw_rate", "pitch_rate", "steer_torque"), 0.0 * t)
    weights = {"steer_torque": 1.0, "roll": 10.0}
    return Task("lane change", bicycle, 50, 3.0, start, end, ("steer_torque",), weights, bicycle_in_opty, guess)


def bicycle_in_opty() -> Any:
    import sympy as sm
    import sympy.physics.mechanics as me

    from .bicycle_in_sympy import derive

    derived, t, torque = derive(), me.dynamicsymbols._t, me.dynamicsymbols("steer_torque")
    bicycle = jk.catalog.WhippleBicycle.benchmark()
    u_dot = sm.Matrix([x.diff(t) for x in derived.u])
    dynamics = derived.M * u_dot - derived.f - sm.Matrix([0, 0, torque, 0, 0, 0])
    kinematics = [x.diff(t) - rate for x, rate in zip(derived.q, derived.q_dot, strict=True)]
    values = {symbol: float(getattr(bicycle, str(symbol))) for symbol in derived.p}
    return sm.Matrix([*kinematics, *dynamics]), (*derived.q, *derived.u), (torque,), values
