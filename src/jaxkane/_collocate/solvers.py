"""Solvers of nonlinear programs: IPOPT from the wheel of CasADi, and SciPy's trust-region method.

CasADi has wheels for all platforms. `TrustConstr` needs no other package, but takes many more iterations.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Protocol

import numpy as np
import scipy.optimize
import scipy.sparse

from .program import NonlinearProgram


@dataclasses.dataclass(frozen=True)
class Solution:
    """The result of a solver, in the scaled numbers of the program.

    - `z` (n,): variables.
    - `multipliers` (n_g,), `bound_multipliers` (n,): derivatives of the Lagrangian by constraints and bounds, positive
        at an upper bound.
    - `ok`: whether the solver reports a local minimum.
    - `status`: the result in words.
    - `iterations`: the number of iterations.
    """

    z: np.ndarray
    multipliers: np.ndarray
    bound_multipliers: np.ndarray
    ok: bool
    status: str
    iterations: int


class Monitor:
    """Shows progress, keeps the best iterate, and stops the solver after Ctrl-C or an exception.

    **Arguments:**

    - `program`: the nonlinear program.
    - `show`: a function of (iteration, cost, violation), or None.
    - `tolerance`: the largest violation of a feasible iterate.
    """

    def __init__(
        self,
        program: NonlinearProgram,
        show: Callable[[int, float, float], None] | None = None,
        tolerance: float = 1e-6,
    ):
        self.program, self.show, self.tolerance = program, show, tolerance
        self.best: np.ndarray | None = None
        self.error: BaseException | None = None
        self.is_interrupted = False
        self.iterations = 0
        self._best_merit = (np.inf, np.inf)

    def __call__(self, z: np.ndarray) -> bool:
        """Record an iterate. **Returns:** whether to stop."""
        if self.error is None:
            cost, violation = self.program.objective(z), self.program.violation(z)
            merit = (0.0, cost) if violation <= self.tolerance else (violation, cost)
            if merit <= self._best_merit:
                self._best_merit, self.best = merit, z.copy()
            if self.show is not None:
                self.show(self.iterations, cost * self.program.f_scale, violation)
            self.iterations += 1
        return self.is_interrupted or self.error is not None

    @contextlib.contextmanager
    def interruptible(self) -> Iterator[None]:
        """Ctrl-C stops the solver after its current iteration. A second Ctrl-C raises `KeyboardInterrupt`."""
        if threading.current_thread() is not threading.main_thread():
            yield  # only the main thread receives signals
            return

        def stop(number: int, frame: Any) -> None:
            if self.is_interrupted:
                raise KeyboardInterrupt
            self.is_interrupted = True

        before = signal.signal(signal.SIGINT, stop)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)

    def interrupted(self, z: np.ndarray, multipliers: np.ndarray, bound_multipliers: np.ndarray) -> Solution:
        best = z if self.best is None else self.best
        return Solution(best, multipliers, bound_multipliers, False, INTERRUPTED, self.iterations)


INTERRUPTED = "interrupted"
NOT_FINITE = "a function or a derivative is not finite"


class Solver(Protocol):
    """A solver of nonlinear programs."""

    def __call__(
        self,
        program: NonlinearProgram,
        z: np.ndarray,
        monitor: Monitor,
        *,
        is_warm: bool = False,
        max_iterations: int = 500,
        options: Mapping[str, Any] | None = None,
    ) -> Solution:
        """Solve a program.

        **Arguments:**

        - `program`: the nonlinear program.
        - `z` (n,): the initial guess of the scaled variables.
        - `monitor`: to be called with each iterate.
        - `is_warm`: whether the guess is close to the solution.
        - `max_iterations`: the largest number of iterations.
        - `options`: further options by the solver's own names.
        """
        ...


_IPOPT_STATUS = {
    "Solve_Succeeded": (True, "solved"),
    "Solved_To_Acceptable_Level": (True, "solved to a lower accuracy"),
    "Feasible_Point_Found": (True, "solved"),
    "Infeasible_Problem_Detected": (False, "the constraints contradict each other near the last iterate"),
    "Maximum_Iterations_Exceeded": (False, "the largest number of iterations was reached"),
    "Maximum_CpuTime_Exceeded": (False, "the longest CPU time was reached"),
    "Maximum_WallTime_Exceeded": (False, "the longest time was reached"),
    "Diverging_Iterates": (False, "the iterates diverge: the cost may have no lower bound"),
    "Search_Direction_Becomes_Too_Small": (False, "the steps became too small"),
    "Restoration_Failed": (False, "no feasible point was found near the last iterate"),
    "Error_In_Step_Computation": (False, "no step could be computed"),
    "Invalid_Number_Detected": (False, NOT_FINITE),
    "Not_Enough_Degrees_Of_Freedom": (False, "there are more equations than variables"),
    "User_Requested_Stop": (False, INTERRUPTED),
}


def _ipopt_options(max_iterations: int, is_warm: bool, options: Mapping[str, Any] | None) -> dict[str, Any]:
    chosen: dict[str, Any] = {
        "print_level": 0,
        "sb": "yes",
        "tol": 1e-9,
        "max_iter": max_iterations,
        "diverging_iterates_tol": 1e10,  # typical values are 1
        "nlp_scaling_method": "none",  # the program is scaled
        "fixed_variable_treatment": "make_parameter",
    }
    if is_warm:  # a large barrier would move the guess away from the solution that it is close to
        chosen |= {"mu_init": 1e-5, "bound_push": 1e-6, "bound_frac": 1e-6, "bound_mult_init_method": "mu-based"}
    return chosen | dict(options or {})


@dataclasses.dataclass(frozen=True)
class Ipopt:
    """IPOPT with MUMPS, from the wheel of CasADi: `pip install jaxkane[collocation]`."""

    def __call__(
        self,
        program: NonlinearProgram,
        z: np.ndarray,
        monitor: Monitor,
        *,
        is_warm: bool = False,
        max_iterations: int = 500,
        options: Mapping[str, Any] | None = None,
    ) -> Solution:
        import casadi as ca

        n, m = program.n, program.m
        x_type, g_type, number, none = (ca.Sparsity.dense(k, 1) for k in (n, m, 1, 0))
        rows, columns = program.hessian_structure
        order = np.lexsort((columns, rows))  # CasADi has the upper triangle

        def sparsity(k: int, rows: np.ndarray, columns: np.ndarray) -> Any:
            return ca.Sparsity.triplet(k, n, rows.tolist(), columns.tolist())

        def second(x: Any, p: Any, factor: Any, multipliers: Any) -> list[Any]:
            # CasADi passes None for zeros.
            factor = 0.0 if factor is None else float(factor[0])
            return [program.hessian(x, np.zeros(m) if multipliers is None else multipliers, factor)[order]]

        f, df, g, dg = program.objective, program.gradient, program.constraints, program.jacobian
        given, jacobian, hessian = [x_type, none], sparsity(m, *program.jacobian_structure), sparsity(n, columns, rows)
        of_iterate = [{"x": x_type, "lam_x": x_type, "g": g_type, "lam_g": g_type, "f": number}.get(name, none)
                      for name in map(ca.nlpsol_out, range(ca.nlpsol_n_out()))]  # fmt: skip
        functions = [
            _callback(ca, monitor, "functions", given, [number, g_type], lambda x, p: [f(x), g(x)]),
            _callback(ca, monitor, "cost_gradient", given, [number, x_type], lambda x, p: [f(x), df(x)]),
            _callback(ca, monitor, "constraint_jacobian", given, [g_type, jacobian], lambda x, p: [g(x), dg(x)]),
            _callback(ca, monitor, "lagrangian_hessian", [*given, number, g_type], [hessian], second),
            _callback(ca, monitor, "iteration", of_iterate, [number], lambda x, *_: [monitor(x)]),
        ]
        x = ca.MX.sym("x", n)
        cost, constraints = functions[0](x, ca.MX(0, 1))
        settings = {
            "grad_f": functions[1],
            "jac_g": functions[2],
            "hess_lag": functions[3],
            "iteration_callback": functions[4],
            "print_time": False,
            "no_nlp_grad": True,  # CasADi would differentiate the callback
            "show_eval_warnings": False,
            "ipopt": _ipopt_options(max_iterations, is_warm, options),
        }
        try:
            solve = ca.nlpsol("solve", "ipopt", {"x": x, "f": cost, "g": constraints}, settings)
        except RuntimeError as error:
            raise ValueError(f"solve: IPOPT refuses the `options` {dict(options or {})}: {error}") from None
        start = {"x0": z, "lbx": program.lower, "ubx": program.upper, "lbg": program.g_lower, "ubg": program.g_upper}
        with monitor.interruptible():
            result = solve(**start)
        if monitor.error is not None:
            raise monitor.error
        found, lam_g, lam_x = (np.array(result[k], float).ravel() for k in ("x", "lam_g", "lam_x"))
        if monitor.is_interrupted:
            return monitor.interrupted(found, lam_g, lam_x)
        stats = solve.stats()
        ok, status = _IPOPT_STATUS.get(stats["return_status"], (False, stats["return_status"].replace("_", " ")))
        return Solution(found, lam_g, lam_x, ok, status, int(stats["iter_count"]))


def _callback(ca: Any, monitor: Monitor, name: str, inputs: Any, outputs: Any, f: Callable[..., Any]) -> Any:
    """A function of NumPy arrays as a function of CasADi. The monitor keeps its exceptions, which IPOPT would hide."""

    class Function(ca.Callback):
        def __init__(self) -> None:
            ca.Callback.__init__(self)
            self.construct(name, {})

        def get_n_in(self) -> int:
            return len(inputs)

        def get_n_out(self) -> int:
            return len(outputs)

        def get_sparsity_in(self, i: int) -> Any:
            return inputs[i]

        def get_sparsity_out(self, i: int) -> Any:
            return outputs[i]

        def has_eval_buffer(self) -> bool:
            return True

        def eval_buffer(self, given: Any, results: Any) -> int:
            try:
                # copies, because IPOPT overwrites the buffers
                values = f(*(None if x is None else np.frombuffer(x, np.float64).copy() for x in given))
            except BaseException as error:
                monitor.error = monitor.error or error
                return 1
            for buffer, value in zip(results, values, strict=True):
                if buffer is not None:
                    np.frombuffer(buffer, np.float64)[:] = value
            return 0

    return Function()


@dataclasses.dataclass(frozen=True)
class TrustConstr:
    """SciPy's `trust-constr`, an interior point method with a trust region.

    It needs no other package. It takes tens of times as many iterations as IPOPT, so it suits small problems.
    """

    def __call__(
        self,
        program: NonlinearProgram,
        z: np.ndarray,
        monitor: Monitor,
        *,
        is_warm: bool = False,
        max_iterations: int = 500,
        options: Mapping[str, Any] | None = None,
    ) -> Solution:
        free = program.lower < program.upper  # a variable with equal bounds has no interior
        z = np.where(free, np.clip(z, program.lower, program.upper), program.lower)

        def whole(part: np.ndarray) -> np.ndarray:
            every = z.copy()
            every[free] = part
            return every

        def symmetric(values: np.ndarray) -> Any:
            lower = scipy.sparse.csr_matrix((values, program.hessian_structure), (program.n, program.n))
            return (lower + scipy.sparse.tril(lower, -1).T).tocsr()[free][:, free]

        def jacobian(x: np.ndarray) -> Any:
            values = program.jacobian(whole(x))
            return scipy.sparse.csc_matrix((values, program.jacobian_structure), (program.m, program.n))[:, free]

        none = np.zeros(program.m)
        constraints: Any = scipy.optimize.NonlinearConstraint(
            lambda x: program.constraints(whole(x)), program.g_lower, program.g_upper, jac=jacobian,  # type: ignore[arg-type]
            hess=lambda x, v: symmetric(program.hessian(whole(x), v, 0.0)),
        )  # fmt: skip
        with monitor.interruptible():
            result = scipy.optimize.minimize(
                lambda x: program.objective(whole(x)),
                z[free],
                jac=lambda x: program.gradient(whole(x))[free],
                hess=lambda x: symmetric(program.hessian(whole(x), none)),
                method="trust-constr",
                constraints=[constraints] if program.m else [],
                bounds=list(zip(program.lower[free], program.upper[free], strict=True)),
                callback=lambda x, _: monitor(whole(x)),
                options={"maxiter": 10 * max_iterations, "gtol": 1e-9, "xtol": 1e-11} | dict(options or {}),
            )
        found = whole(result.x)
        lam_g = np.asarray(result.v[0]) if program.m else np.zeros(0)
        lam_x = np.zeros(program.n)
        lam_x[free] = np.asarray(result.v[-1]) if len(result.v) > bool(program.m) else 0.0
        if monitor.is_interrupted:
            return monitor.interrupted(found, lam_g, lam_x)
        feasible = program.violation(found) <= monitor.tolerance
        ok = result.status in (1, 2) and feasible
        words = {0: "the largest number of iterations was reached", 1: "solved", 2: "solved"}
        status = words.get(result.status, str(result.message)) if feasible or not result.status else NOT_MET
        return Solution(found, lam_g, lam_x, bool(ok), status, int(result.niter))


NOT_MET = "the constraints are not met at the last iterate"


def default_solver() -> Solver:
    """IPOPT if CasADi is installed, else SciPy's method, with a warning once."""
    if importlib.util.find_spec("casadi") is not None:
        return Ipopt()
    warnings.warn(
        "IPOPT is not installed, so SciPy's trust-constr is used, which takes many more iterations. Run "
        "`pip install jaxkane[collocation]`, or pass solver=jaxkane.collocation.TrustConstr().",
        stacklevel=4,
    )
    return TrustConstr()


def show_progress(iteration: int, cost: float, violation: float) -> None:
    text = f"\riteration {iteration}: cost {cost:.6g}, violation {violation:.1e}".ljust(72)
    print(text, end="", file=sys.stderr, flush=True)


def run(solver: Solver, program: NonlinearProgram, z: np.ndarray, *, progress: bool, **arguments: Any) -> Solution:
    """Call a solver, with one line of progress if `progress` is True."""
    monitor = Monitor(program, show_progress if progress else None)
    try:
        return solver(program, z, monitor, **arguments)
    finally:
        if progress:
            print(file=sys.stderr)
