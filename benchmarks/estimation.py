"""How long does a Kalman filter take for a step, against dynamax and filterpy?

A double pendulum of which one rate is measured, without noise in its motion: so the extended filters agree to
rounding, and the cubature filters but for the points that filterpy keeps from the prediction. All integrate by one step
of Runge and Kutta's classical method; filterpy by the equations in NumPy that `jaxkane.export.numpy` writes. The
exported filter in C runs where there is a compiler.

Run:      python -m benchmarks.estimation
Needs:    pip install dynamax filterpy; what is not there is left out.
Appears:  microseconds a step, and how far each is from jaxkane's extended filter, in standard deviations.
Takes:    half a minute.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxkane as jk

DT, N, SIGMA = 0.02, 2000, 0.05
DEVIATION = {"theta1": 0.05, "theta2": 0.05, "theta1_dot": 0.1, "theta2_dot": 0.1}
LOOP = """
#include "filter.h"
void run(int n, double dt, const double *measured, double *mean) {
    filter_belief belief = filter_start;
    filter_innovation innovation;
    const double inputs[2] = {0.0, 0.0};
    int i, j;
    for (i = 0; i < n; i++) {
        filter_predict(&belief, &filter_default, dt, inputs);
        filter_update(&belief, &filter_default, measured + i, inputs, 0, &innovation);
        for (j = 0; j < filter_n; j++) mean[i * filter_n + j] = belief.mean[j];
    }
}
"""


def best_of(run: Callable[[], Any], times: int = 5) -> tuple[Any, float]:
    """What it gives, and the shortest time of a step [us]."""
    result, seconds = jax.block_until_ready(run()), []
    for _ in range(times):
        started = time.perf_counter()
        jax.block_until_ready(run())
        seconds.append(time.perf_counter() - started)
    return np.asarray(result), 1e6 * min(seconds) / N


def by_jaxkane(filter: jk.estimate.Filter, belief: jk.estimate.Belief, ys: jax.Array) -> Callable[[], Any]:
    def step(belief, y):
        belief, _ = jk.estimate.update(filter, jk.estimate.predict(filter, belief, DT), y)
        return belief, belief.mean[0]

    run = jax.jit(lambda belief, ys: jax.lax.scan(step, belief, ys)[1])
    return lambda: run(belief, ys)


def by_c(filter: jk.estimate.Filter, belief: jk.estimate.Belief, ys: jax.Array) -> Callable[[], Any] | None:
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        return None
    folder = Path(tempfile.mkdtemp())
    jk.export.c_filter(filter, folder / "filter.h", belief)
    (folder / "run.c").write_text(LOOP)
    options = ["-std=c99", "-O3", "-shared", "-fPIC"]
    subprocess.run([compiler, *options, folder / "run.c", "-o", folder / "run.so", "-lm"], check=True)
    library, measured, mean = ctypes.CDLL(str(folder / "run.so")), np.ravel(ys), np.zeros((N, len(filter.names)))
    pointer = lambda x: x.ctypes.data_as(ctypes.POINTER(ctypes.c_double))  # noqa: E731

    def run():
        library.run(N, ctypes.c_double(DT), pointer(measured), pointer(mean))
        return mean

    return run


def rk4(rates: Callable[[Any], Any], y: Any) -> Any:
    k1 = rates(y)
    k2 = rates(y + DT / 2 * k1)
    k3 = rates(y + DT / 2 * k2)
    k4 = rates(y + DT * k3)
    return y + DT / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def by_dynamax(system: jk.System, mean: np.ndarray, P: np.ndarray, ys: jax.Array) -> Callable[[], Any] | None:
    try:
        from dynamax.nonlinear_gaussian_ssm import ParamsNLGSSM, extended_kalman_filter
    except ImportError:
        return None
    rates = lambda y: jnp.concatenate([y[2:], jk.accelerations(system, 0.0, y[:2], y[2:])])  # noqa: E731
    params = ParamsNLGSSM(
        initial_mean=rk4(rates, jnp.asarray(mean)),  # it updates first, and predicts then
        initial_covariance=(lambda A: A @ P @ A.T)(jax.jacfwd(lambda y: rk4(rates, y))(jnp.asarray(mean))),
        dynamics_function=lambda y: rk4(rates, y),
        dynamics_covariance=jnp.zeros((4, 4)),
        emission_function=lambda y: y[3:],
        emission_covariance=jnp.eye(1) * SIGMA**2,
    )
    run = jax.jit(lambda ys: extended_kalman_filter(params, ys).filtered_means)
    return lambda: run(ys)


def by_filterpy(system: jk.System, mean: np.ndarray, P: np.ndarray, ys: jax.Array) -> Callable[[], Any] | None:
    try:
        from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
    except ImportError:
        return None
    module: dict[str, Any] = {}
    exec(jk.export.numpy(system, functions=("rates",)), module)
    rates = lambda y: np.concatenate(module["rates"](0.0, y[:2], y[2:]))  # noqa: E731
    measured = np.asarray(ys)

    def run():
        points = MerweScaledSigmaPoints(4, alpha=1.0, beta=0.0, kappa=0.0)  # the cubature rule
        filter = UnscentedKalmanFilter(4, 1, DT, hx=lambda y: y[3:], fx=lambda y, dt: rk4(rates, y), points=points)
        filter.x, filter.P, filter.R, filter.Q = mean.copy(), P.copy(), np.eye(1) * SIGMA**2, np.zeros((4, 4))
        means = []
        for y in measured:
            filter.predict()
            filter.P += 1e-14 * np.eye(4)  # which its Cholesky factors need
            filter.update(y)
            means.append(filter.x)
        return np.array(means)

    return run


def main() -> None:
    jk.configure(verbose=False)
    system = jk.catalog.DoublePendulum()
    start = jk.State(q=[1.0, -0.5], u=[0.0, 0.0])
    ts = np.arange(N + 1) * DT
    truth = np.asarray(jk.simulate(system, start, ts, max_steps=None)["theta2_dot"])[1:]
    ys = jnp.asarray(truth + SIGMA * np.random.default_rng(0).standard_normal(N))[:, None]
    filters = {m: jk.estimate.Filter(system, {"theta2_dot": SIGMA}, method=m) for m in ("extended", "unscented")}
    belief = jk.estimate.begin(filters["extended"], start, DEVIATION)
    mean, P = np.asarray(belief.mean[0]), np.asarray(belief.covariance())
    runs = {
        "jaxkane, extended, under scan": by_jaxkane(filters["extended"], belief, ys),
        "the same, exported as C": by_c(filters["extended"], belief, ys),
        "dynamax, extended, under scan": by_dynamax(system, mean, P, ys),
        "jaxkane, unscented, under scan": by_jaxkane(filters["unscented"], belief, ys),
        "the same, exported as C ": by_c(filters["unscented"], belief, ys),
        "filterpy, unscented": by_filterpy(system, mean, P, ys),
    }
    reference = None
    for name, run in runs.items():
        if run is None:
            print(f"{name:<34} is not here")
            continue
        result, microseconds = best_of(run, 1 if "filterpy" in name else 5)
        reference = result if reference is None else reference
        apart = np.max(np.abs(result - reference)[: N // 20] / np.array([*DEVIATION.values()]))
        print(f"{name:<34} {microseconds:8.1f} us a step; in the first {N // 20} steps {apart:.0e} deviations apart")


if __name__ == "__main__":
    main()
