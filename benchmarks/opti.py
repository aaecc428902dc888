"""Optimal control by `jaxkane.collocation` against CasADi's Opti: CPU seconds of a first and a second solution.

A bar on a cart is swung up, with the same method, guess, solver and exact Hessian. Each first solution is made in a
fresh process, without stored programs; imports are left out. The second solution has another weight in the cost. For
it, Opti changes a parameter of its problem, or builds the problem anew, as jaxkane always does.
"""

import json
import sys
import time
from collections.abc import Callable, Iterator

import numpy as np

from ._figures import Figure
from ._process import Setting, answer, configure

T, M1, M2, L, G = 2.0, 2.0, 1.0, 1.0, 9.81


def measure(setting: Setting) -> Iterator[Figure]:
    for N in (50,) if setting.quick else (50, 1000):
        tries = {who: [answer("benchmarks.opti", [who, str(N)]) for _ in range(3)] for who in ("jaxkane", "Opti")}
        if abs(tries["jaxkane"][0][-1] / tries["Opti"][0][-1] - 1) > 1e-6:
            raise RuntimeError("The costs of jaxkane and Opti differ.")
        for who, found in tries.items():
            for what, value in zip(("first", "second", "second, built anew"), np.min(found, axis=0)):
                yield Figure("opti", f"{N} intervals, {who}: {what} solution, CPU time", float(value), "s")


def by_jaxkane(N: int) -> Callable[[float, bool], float]:
    import jax

    import jaxkane as jk

    configure(Setting(native=True))
    bar = jk.catalog.SliderWithPinnedBar(slider_mass=M1, bar_mass=M2, length=L, stiffness=0.0, damping=0.0)  # pyright: ignore
    rest = dict.fromkeys(bar.coordinates + bar.speeds, 0.0)
    squares = lambda weight, t, now: now["force"] ** 2 + weight * now["x"] ** 2  # noqa: E731
    given, plans, solved = {"start": rest, "end": rest | {"theta": np.pi}}, [None], jk.collocation.solve

    def solve(weight: float, is_anew: bool) -> float:
        cost = jax.tree_util.Partial(squares, jax.numpy.asarray(weight))
        problem = jk.collocation.Problem(bar, T, controls=["force"], cost=cost, **given)
        plans[0] = solved(problem, plans[0], intervals=N, tolerance=None)
        return plans[0].cost if plans[0].ok else np.nan

    return solve


def by_opti(N: int) -> Callable[[float, bool], float]:
    import casadi as ca

    h, K, kept = T / N, 2 * N + 1, {"Y": np.outer([0, np.pi, 0, 0], np.linspace(0, 1, 2 * N + 1)), "F": 0.0}

    def solve(weight: float, is_anew: bool) -> float:
        opti, Y, F, parameter = kept["problem"] = problem() if is_anew else kept["problem"]
        for x, value in ((Y, kept["Y"]), (F, kept["F"])):
            opti.set_initial(x, value)
        opti.set_value(parameter, weight)
        found = opti.solve()
        kept.update(Y=found.value(Y), F=found.value(F))
        return found.value(opti.f)

    def problem():
        y, u, opti, a = ca.SX.sym("y", 4), ca.SX.sym("u"), ca.Opti(), M2 * L / 2
        mass = ca.blockcat([[M1 + M2, a * ca.cos(y[1])], [a * ca.cos(y[1]), M2 * L**2 / 3]])
        right = ca.vertcat(u + a * ca.sin(y[1]) * y[3] ** 2, -a * G * ca.sin(y[1]))
        rates = ca.Function("rates", [y, u], [ca.vertcat(y[2:], ca.solve(mass, right))])
        Y, F, weight = opti.variable(4, K), opti.variable(1, K), opti.parameter()
        R = [rates(Y[:, k], F[k]) for k in range(K)]
        for k in range(0, K - 1, 2):
            opti.subject_to(Y[:, k + 1] == Y[:, k] + h * (5 * R[k] + 8 * R[k + 1] - R[k + 2]) / 24)
            opti.subject_to(Y[:, k + 2] == Y[:, k] + h * (R[k] + 4 * R[k + 1] + R[k + 2]) / 6)
        opti.subject_to(ca.horzcat(Y[:, 0], Y[:, -1]) == ca.DM([[0, 0], [0, np.pi], [0, 0], [0, 0]]))
        opti.minimize(h / 6 * ca.dot(ca.DM([1] + [4, 2] * (N - 1) + [4, 1]), (F**2 + weight * Y[0, :] ** 2).T))
        opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes", "tol": 1e-9})
        return opti, Y, F, weight

    return solve


if __name__ == "__main__":
    solve, seconds, cost = {"jaxkane": by_jaxkane, "Opti": by_opti}[sys.argv[1]](int(sys.argv[2])), [], np.nan
    for weight, is_anew in ((0.0, True), (10.0, False), (20.0, True)):
        began = time.process_time()
        cost = solve(weight, is_anew)
        seconds.append(time.process_time() - began)
    print(json.dumps([*seconds, cost]))
