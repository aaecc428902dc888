"""How long does a fit take, beside other ways to make it?

A single pendulum swings freely (Kaheman and co-workers, 2022): ten windows of two seconds, at 200 Hz. Three parameters
are common to all, and each window has an unknown angle and rate at its start: 23 unknowns, 4000 residuals, one cost.

    theta'' = -frequency^2 sin(theta - zero) - viscous theta'

    jaxkane     `jaxkane.fit.fit`, Levenberg-Marquardt with exact derivatives, the starts eliminated
    scipy       `least_squares` (trf) around `solve_ivp` (DOP853, rtol 1e-8), differences for derivatives
    scipy, exact  the same, with the variational equations written by hand, and starts known to be sparse
    mujoco      `mujoco.minimize.least_squares`, the optimizer of its system identification, around `mujoco.rollout`
                with RK4 steps of 5 ms; its toolbox takes starts as known, so the residuals are built here
    casadi      direct collocation (Legendre, degree 3, one interval a sample) and IPOPT: what opty does with SymPy's
                equations; opty itself needs cyipopt, which has no wheel

dynamax fits by gradient through its filters and smoothers; this problem has no process noise and is no such problem.

Run:      python -m benchmarks.fits [jaxkane] [scipy] [scipy-exact] [mujoco] [casadi]
Needs:    pip install mujoco casadi; what is not there is left out.
Appears:  of each, in a process of its own: seconds from the import to the first answer, seconds of a second fit, the
          sum of squares, and the frequency.
Takes:    three minutes.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

WINDOWS, SECONDS, SIGMA = 10, 2.0, 1e-3
FIRST = {"frequency": 7.0, "zero": 0.0, "viscous": 0.05}  # [rad/s], [rad], [1/s]


def measured() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (n,), angles from the lower vertical (W, n) and first rates (W,) of windows of the shipped recording."""
    import jaxkane as jk

    windows, rates = [], []
    for trial in jk.data.multi_arm_pendulum(1).trials:
        step, n = np.median(np.diff(trial.t)), round(SECONDS / np.median(np.diff(trial.t))) + 1
        for i in range(0, len(trial.t) - n + 1, n):
            windows.append(trial.measured["angle1"][i : i + n] - np.pi)
            rates.append((windows[-1][1] - windows[-1][0]) / step)
    return step * np.arange(n), np.array(windows[:WINDOWS]), np.array(rates[:WINDOWS])


def by_jaxkane(t: np.ndarray, y: np.ndarray, rates: np.ndarray) -> Callable[[], Any]:
    import jax.numpy as jnp

    import jaxkane as jk

    jk.configure(verbose=False, cache=False)

    class Pendulum(jk.System):
        frequency: jk.Scalar = jk.parameter(FIRST["frequency"], positive=True)
        zero: jk.Scalar = jk.parameter(FIRST["zero"])
        viscous: jk.Scalar = jk.parameter(FIRST["viscous"])
        coordinates, speeds = ("theta",), ("rate",)

        def motion(self, t, q, u):
            N, O = jk.inertial()
            arm = N.rotate(3, q["theta"] - self.zero, u["rate"])
            return jk.Motion([jk.Body(1.0, (0.0, 0.0, 1.0), O, arm, name="arm")])

        def loads(self, t, q, u, motion, inputs):
            torque = -(self.frequency**2) * jnp.sin(q["theta"] - self.zero) - self.viscous * u["rate"]
            return (jk.Torque(torque * motion.N.z, motion["arm"]),)

    trials = [
        jk.fit.Trial(t, {"theta": angle}, sigma=SIGMA, initial={"theta": angle[0], "rate": rate})
        for angle, rate in zip(y, rates, strict=True)
    ]

    def run():
        found = jk.fit.fit(Pendulum(), trials, tuple(FIRST), unknown=("theta", "rate"))
        return found.cost, found.estimates["frequency"]

    return run


def by_scipy(t: np.ndarray, y: np.ndarray, rates: np.ndarray, exact: bool = False) -> Callable[[], Any]:
    from scipy.integrate import solve_ivp
    from scipy.optimize import least_squares
    from scipy.sparse import lil_matrix

    W, n = y.shape

    def rhs(_, s, frequency, zero, viscous):
        return [s[1], -(frequency**2) * np.sin(s[0] - zero) - viscous * s[1]]

    def variational(_, s, frequency, zero, viscous):
        """State, and its derivatives by the two starts and the three parameters."""
        sine, cosine, S = np.sin(s[0] - zero), np.cos(s[0] - zero), s[2:].reshape(2, 5)
        by_rate = -(frequency**2) * cosine * S[0] - viscous * S[1]
        by_rate[2:] += [-2 * frequency * sine, frequency**2 * cosine, -s[1]]
        return np.concatenate([[s[1], -(frequency**2) * sine - viscous * s[1]], S[1], by_rate])

    def simulated(x, w, f=rhs, more=()):
        start = np.concatenate([x[3 + 2 * w : 5 + 2 * w], more])
        return solve_ivp(f, (0.0, t[-1]), start, "DOP853", t, rtol=1e-8, atol=1e-10, args=tuple(x[:3])).y

    def residuals(x):
        return np.concatenate([simulated(x, w)[0] - y[w] for w in range(W)]) / SIGMA

    def jacobian(x):
        J, first = np.zeros((W * n, x.size)), np.zeros((2, 5))
        first[0, 0] = first[1, 1] = 1.0
        for w in range(W):
            S = simulated(x, w, variational, first.ravel())[2:7]
            J[w * n : (w + 1) * n, 3 + 2 * w : 5 + 2 * w], J[w * n : (w + 1) * n, :3] = S[:2].T, S[2:].T
        return J / SIGMA

    sparsity = lil_matrix((W * n, 3 + 2 * W), dtype=int)
    sparsity[:, :3] = 1
    for w in range(W):
        sparsity[w * n : (w + 1) * n, 3 + 2 * w : 5 + 2 * w] = 1
    options: dict[str, Any] = {"jac": jacobian} if exact else {"jac_sparsity": sparsity}
    x0 = np.concatenate([[*FIRST.values()], np.column_stack([y[:, 0], rates]).ravel()])

    def run():
        found = least_squares(residuals, x0, x_scale="jac", ftol=1e-10, xtol=1e-12, **options)
        return 2 * found.cost, found.x[0]

    return run


def by_mujoco(t: np.ndarray, y: np.ndarray, rates: np.ndarray) -> Callable[[], Any]:
    import mujoco
    from mujoco import minimize, rollout

    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="{t[1]}" integrator="RK4" gravity="0 0 0"/><worldbody><body>
        <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><joint name="j" type="hinge" axis="0 0 1" damping="0.1"/>
        <body pos="0 -1 0"><inertial pos="0 0 0" mass="1e-9" diaginertia="1e-9 1e-9 1e-9"/></body>
        </body></worldbody></mujoco>"""
    )
    # A unit inertia on the axis, and gravity on a small mass: the parameter is the gravity that makes the frequency.
    model.body_mass[2], (W, n) = 1e-9, y.shape
    inertia, data = 1.0 + 1e-9, mujoco.MjData(model)

    def one(x):
        model.dof_damping[0] = x[2] * inertia
        model.opt.gravity[:] = 0.0, -(x[0] ** 2) * inertia / 1e-9, 0.0
        states = np.zeros((W, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
        states[:, 1:3] = x[3:].reshape(W, 2)
        states[:, 1] -= x[1]
        moved, _ = rollout.rollout(model, data, states, nstep=n - 1)
        angles = np.concatenate([states[:, None, 1], moved[:, :, 1]], axis=1) + x[1]
        return ((angles - y) / SIGMA).ravel()

    def residuals(x):
        return np.stack([one(column) for column in x.T], axis=1) if x.ndim > 1 else one(x)

    x0 = np.concatenate([[*FIRST.values()], np.column_stack([y[:, 0], rates]).ravel()])

    def run():
        x, _ = minimize.least_squares(x0, residuals, verbose=0, max_iter=200)
        return float(np.sum(one(x) ** 2)), x[0]

    return run


def by_casadi(t: np.ndarray, y: np.ndarray, rates: np.ndarray) -> Callable[[], Any]:
    import casadi as ca

    (W, n), h, degree = y.shape, t[1], 3

    def run():
        tau = [0.0, *ca.collocation_points(degree, "legendre")]
        C, D = np.zeros((degree + 1, degree + 1)), np.zeros(degree + 1)
        for j in range(degree + 1):
            p = np.poly1d([1.0])
            for r in range(degree + 1):
                if r != j:
                    p *= np.poly1d([1.0, -tau[r]]) / (tau[j] - tau[r])
            D[j], slope = p(1.0), np.polyder(p)
            C[j] = [slope(s) for s in tau]
        x = ca.MX.sym("x", 3)
        f = lambda s: ca.vertcat(s[1, :], -(x[0] ** 2) * ca.sin(s[0, :] - x[1]) - x[2] * s[1, :])  # noqa: E731
        unknowns, first, conditions, cost = [x], [*FIRST.values()], [], 0.0
        for w in range(W):
            ends = ca.MX.sym(f"X{w}", 2, n)
            inner = [ca.MX.sym(f"K{w}_{j}", 2, n - 1) for j in range(degree)]
            nodes = [ends[:, :-1], *inner]
            for j in range(1, degree + 1):
                conditions.append(ca.vec(sum(C[r, j] * nodes[r] for r in range(degree + 1)) - h * f(nodes[j])))
            conditions.append(ca.vec(ends[:, 1:] - sum(D[r] * nodes[r] for r in range(degree + 1))))
            cost += ca.sumsqr((ends[0, :].T - y[w]) / SIGMA)
            guess = np.stack([y[w], np.gradient(y[w], h)])
            unknowns += [ca.vec(ends), *map(ca.vec, inner)]
            first += [*guess.T.ravel(), *np.tile(guess[:, :-1].T.ravel(), degree)]
        problem = {"x": ca.vertcat(*unknowns), "f": cost, "g": ca.vertcat(*conditions)}
        quiet = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-8}
        found = ca.nlpsol("fit", "ipopt", problem, quiet)(x0=first, lbg=0.0, ubg=0.0)
        return float(found["f"]), float(found["x"][0])

    return run


WAYS: dict[str, Callable[..., Callable[[], Any]]] = {
    "jaxkane": by_jaxkane,
    "scipy": by_scipy,
    "scipy-exact": lambda *data: by_scipy(*data, exact=True),
    "mujoco": by_mujoco,
    "casadi": by_casadi,
}


def timed(way: str) -> None:
    """Print what one way takes, as JSON."""
    data = measured()
    started = time.perf_counter()
    run = WAYS[way](*data)
    run()
    first = time.perf_counter() - started
    started = time.perf_counter()
    cost, frequency = run()
    second = time.perf_counter() - started
    print(json.dumps({"first": first, "second": second, "cost": cost, "frequency": frequency}))


def main(ways: list[str]) -> None:
    print(f"{'':<14}{'first fit [s]':>14}{'second [s]':>12}{'sum of squares':>16}{'frequency [rad/s]':>19}")
    for way in ways or WAYS:
        command = [sys.executable, "-m", "benchmarks.fits", "--timed", way]
        ran = subprocess.run(command, capture_output=True, text=True, check=False)
        if ran.returncode:
            print(f"{way:<14}{ran.stderr.strip().splitlines()[-1]}")
            continue
        numbers = json.loads(ran.stdout.strip().splitlines()[-1])
        print(
            f"{way:<14}{numbers['first']:>14.2f}{numbers['second']:>12.3f}"
            f"{numbers['cost']:>16.6g}{numbers['frequency']:>19.7f}"
        )


if __name__ == "__main__":
    if sys.argv[1:2] == ["--timed"]:
        timed(sys.argv[2])
    else:
        main(sys.argv[1:])
