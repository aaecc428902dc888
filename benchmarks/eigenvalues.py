"""How many bicycles' eigenvalues a second, against BicycleParameters, SymPy and numpy?

10 000 bicycles, every parameter of the benchmark of Meijaard et al. (2007) moved by up to 5 %, each at its own speed of
1 to 9 m/s. jaxkane linearizes the nonlinear model of each by `jax.vmap` and takes the eigenvalues. For comparison:
BicycleParameters (Meijaard's formulas in Python), one bicycle after the other, and what it is fastest at, an array of
speeds of one bicycle; SymPy's equations of the nonlinear bicycle, linearized symbolically once, lambdified, and
evaluated for one bicycle after the other; and the canonical matrices, given beforehand, through numpy's eigenvalues
alone, all at once: nothing is linearized there.

The answers are compared first, to 1e-8 of the largest eigenvalue.

Run:      python benchmarks/eigenvalues.py
Appears:  one line for every figure, then the ratios. The target is 50 against BicycleParameters' and SymPy's bicycles.
Takes:    a minute, most of it SymPy's. BicycleParameters and SymPy are left out, and named, where they are missing.
"""

import dataclasses
import platform
import time
from collections.abc import Callable

import jax
import numpy as np

import jaxkane as jk
from jaxkane.stability import canonical, linearize, straight_ahead

jax.config.update("jax_enable_x64", True)

N = 10_000
FEW = 300
BICYCLE = jk.catalog.WhippleBicycle.benchmark()
NAMES = [f.name for f in dataclasses.fields(BICYCLE) if f.name != "steer_damping"]
LATERAL = ("roll", "steer", "roll_rate", "steer_rate")
RTOL = 1e-8


def main() -> None:
    print(f"{platform.processor() or platform.machine()}; jax {jax.__version__}, {jax.default_backend()}")
    rng = np.random.default_rng(0)
    parameters = {k: float(getattr(BICYCLE, k)) * rng.uniform(0.95, 1.05, N) for k in NAMES}
    speeds = rng.uniform(1.0, 9.0, N)  # [m/s]
    ours, found = by_jaxkane(parameters, speeds)
    ratios = {"numpy, matrices given": ours / by_numpy(parameters, speeds, found)}
    others = by_bicycle_parameters(parameters, speeds, found) | by_sympy(parameters, speeds, found)
    ratios |= {name: ours / rate for name, rate in others.items()}
    for name, ratio in ratios.items():
        report(f"ratio: jaxkane against {name}", f"{ratio:.1f}")


def by_jaxkane(parameters: dict[str, np.ndarray], speeds: np.ndarray) -> tuple[float, np.ndarray]:
    @jax.jit
    @jax.vmap
    def eigenvalues(parameters, v):
        bicycle = dataclasses.replace(BICYCLE, **parameters)
        return linearize(bicycle, straight_ahead(bicycle, v), states=LATERAL).eigenvalues

    run = lambda: jax.block_until_ready(eigenvalues(parameters, speeds))  # noqa: E731
    started = time.perf_counter()
    found = np.asarray(run())
    first = time.perf_counter() - started
    rate = N / best(run, 20)
    report(
        f"jaxkane: {N} nonlinear bicycles linearized by vmap, eig", f"{rate:.0f} a second (first call {first:.1f} s)"
    )
    return rate, found


def by_numpy(parameters: dict[str, np.ndarray], speeds: np.ndarray, found: np.ndarray) -> float:
    """A of the canonical matrices and numpy's eigenvalues, all at once: no model is linearized here."""
    given = jax.jit(jax.vmap(lambda p: canonical(dataclasses.replace(BICYCLE, **p))))(parameters)
    M, C1, K0, K2 = (np.asarray(x) for x in (given.M, given.C1, given.K0, given.K2))

    def run():
        v, g = speeds[:, None, None], parameters["g"][:, None, None]
        A = np.zeros((N, 4, 4))
        A[:, :2, 2:] = np.eye(2)
        A[:, 2:] = -np.linalg.solve(M, np.concatenate([g * K0 + v**2 * K2, v * C1], axis=2))
        return np.linalg.eigvals(A)

    compare(run(), found, "numpy")
    rate = N / best(run, 5)
    report("numpy: eigenvalues of canonical matrices that are given", f"{rate:.0f} a second")
    return rate


def by_bicycle_parameters(parameters: dict[str, np.ndarray], speeds: np.ndarray, found: np.ndarray) -> dict[str, float]:
    try:
        from bicycleparameters.models import Meijaard2007Model
        from bicycleparameters.parameter_sets import Meijaard2007ParameterSet
    except ImportError:
        report("BicycleParameters", "not installed: pip install BicycleParameters")
        return {}

    def model(i):
        values = {k: float(parameters[k][i]) for k in NAMES} | {"v": float(speeds[i])}
        return Meijaard2007Model(Meijaard2007ParameterSet(values, False))

    def one_by_one():
        return np.stack([np.ravel(model(i).calc_eigen()[0]) for i in range(FEW)])

    compare(one_by_one(), found[:FEW], "BicycleParameters")
    alone = FEW / best(one_by_one, 3)
    report(f"BicycleParameters: {FEW} bicycles, one after the other", f"{alone:.0f} a second")
    many = np.linspace(1.0, 9.0, 1000)
    array = len(many) / best(lambda: model(0).calc_eigen(v=many), 3)
    report("BicycleParameters: 1000 speeds of one bicycle", f"{array:.0f} a second")
    return {"BicycleParameters, bicycles": alone, "BicycleParameters, speeds": array}


def by_sympy(parameters: dict[str, np.ndarray], speeds: np.ndarray, found: np.ndarray) -> dict[str, float]:
    try:
        import sympy  # noqa: F401
    except ImportError:
        report("SymPy", "not installed: pip install sympy")
        return {}
    matrix = linearized_by_sympy()

    def one_by_one():
        rows = ({k: parameters[k][i] for k in NAMES} | {"v": speeds[i]} for i in range(FEW))
        return np.stack([np.linalg.eigvals(matrix(row)) for row in rows])

    compare(one_by_one(), found[:FEW], "SymPy")
    rate = FEW / best(one_by_one, 3)
    report(f"SymPy, lambdified: {FEW} bicycles, one after the other", f"{rate:.0f} a second")
    return {"SymPy, bicycles": rate}


def linearized_by_sympy() -> Callable[[dict[str, float]], np.ndarray]:
    """A (4, 4) of a bicycle's parameters and speed.

    M u_dot = f and the constraints c = 0 are differentiated where the bicycle rides straight ahead; there u_dot is
    zero, and so is the slope of pitch. KanesMethod.linearize gives the same in minutes.
    """
    import sympy as sm
    from bicycle_in_sympy import PARAMETERS, derive

    derived, v = derive(), sm.Symbol("v")
    q, u, p = derived.q, derived.u, dict(zip(PARAMETERS, derived.p))
    straight = {**dict.fromkeys((*q, *u), sm.S.Zero), u[1]: -v / p["rR"], u[5]: -v / p["rF"]}
    c = derived.kane._k_nh * sm.Matrix(u) + derived.kane._f_nh
    lean_and_steer = [q[0], q[2]]
    parts = [derived.M, *(x.jacobian(by) for x in (derived.f, c) for by in (lean_and_steer, u))]
    evaluate = sm.lambdify([v, *derived.p], [x.xreplace(straight) for x in parts], cse=True)

    def matrix(row):
        M, f_q, f_u, c_q, c_u = evaluate(row["v"], *(row[k] for k in PARAMETERS))
        u_x = np.zeros((6, 4))
        u_x[[0, 2], [2, 3]] = 1.0
        u_x[3:] = -np.linalg.solve(c_u[:, 3:], np.hstack([c_q, c_u[:, [0, 2]]]))
        f_x = f_u @ u_x
        f_x[:, :2] += f_q
        return np.vstack([u_x[[0, 2]], np.linalg.solve(M, f_x)[[0, 2]]])

    return matrix


def compare(theirs: np.ndarray, ours: np.ndarray, name: str) -> None:
    """Every eigenvalue of theirs (b, n) is one of ours."""
    far = np.abs(theirs[:, :, None] - ours[:, None, :]).min(axis=2).max(axis=1) / np.abs(ours).max(axis=1)
    assert far.max() < RTOL, f"{name}: bicycle {far.argmax()} differs by {far.max():.1e}"


def best(f, runs: int) -> float:
    f()
    seconds = []
    for _ in range(runs):
        started = time.perf_counter()
        f()
        seconds.append(time.perf_counter() - started)
    return min(seconds)


def report(what: str, figure: str) -> None:
    print(f"{what:60s}{figure}", flush=True)


if __name__ == "__main__":
    main()
