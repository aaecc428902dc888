"""Solvers of nonlinear programs: IPOPT through CasADi or cyipopt, and SciPy's trust-region method.

`Ipopt` and `Cyipopt` run the same program. CasADi has wheels for all platforms; cyipopt is for those who have it, for
instance with the linear solvers of HSL. `TrustConstr` needs no other package, but takes many more iterations.
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

    def guarded(self, f: Callable[..., Any]) -> Callable[..., Any]:
        """The same function, whose exceptions are kept for the end: IPOPT would hide them."""

        def call(*args: Any) -> Any:
            try:
                return f(*args)
            except BaseException as error:
                self.error = self.error or error
                raise

        return call

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
        """The best iterate, after Ctrl-C."""
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
_IPOPT_CODES = {0: "Solve_Succeeded", 1: "Solved_To_Acceptable_Level", 2: "Infeasible_Problem_Detected"}
_IPOPT_CODES |= {3: "Search_Direction_Becomes_Too_Small", 4: "Diverging_Iterates", 5: "User_Requested_Stop"}
_IPOPT_CODES |= {6: "Feasible_Point_Found", -1: "Maximum_Iterations_Exceeded", -2: "Restoration_Failed"}
_IPOPT_CODES |= {-3: "Error_In_Step_Computation", -4: "Maximum_CpuTime_Exceeded", -5: "Maximum_WallTime_Exceeded"}
_IPOPT_CODES |= {-10: "Not_Enough_Degrees_Of_Freedom", -13: "Invalid_Number_Detected"}


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
        dense, none = ca.Sparsity.dense, ca.Sparsity.dense(0, 1)
        x_type, g_type, number = dense(n, 1), dense(m, 1), dense(1, 1)
        given = [x_type, none]
        jacobian = _casadi_sparsity(ca, m, n, *program.jacobian_structure)
        rows, columns = program.hessian_structure
        hessian = _casadi_sparsity(ca, n, n, columns, rows)  # CasADi has the upper triangle
        order = np.lexsort((columns, rows))

        def second(x: Any, p: Any, factor: Any, multipliers: Any) -> list[Any]:
            # CasADi passes None for zeros.
            factor = 0.0 if factor is None else float(factor[0])
            values = program.hessian(x.copy(), np.zeros(m) if multipliers is None else multipliers.copy(), factor)
            return [values[order]]

        functions = [
            _callback(ca, monitor, "functions", given, [number, g_type], lambda x, p: [f(x), g(x)]),
            _callback(ca, monitor, "cost_gradient", given, [number, x_type], lambda x, p: [f(x), df(x)]),
            _callback(ca, monitor, "constraint_jacobian", given, [g_type, jacobian], lambda x, p: [g(x), dg(x)]),
            _callback(ca, monitor, "lagrangian_hessian", [*given, number, g_type], [hessian], second),
        ]
        f, df, g, dg = (
            _of_copies(h) for h in (program.objective, program.gradient, program.constraints, program.jacobian)
        )
        iteration = _iteration_callback(ca, monitor, n, m)
        x = ca.MX.sym("x", n)
        cost, constraints = functions[0](x, ca.MX(0, 1))
        settings = {
            "grad_f": functions[1],
            "jac_g": functions[2],
            "hess_lag": functions[3],
            "iteration_callback": iteration,
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


def _of_copies(f: Callable[[np.ndarray], Any]) -> Callable[[np.ndarray], Any]:
    """A function of numbers in a buffer that IPOPT overwrites."""
    return lambda x: f(x.copy())


def _casadi_sparsity(ca: Any, n_rows: int, n_columns: int, rows: np.ndarray, columns: np.ndarray) -> Any:
    """The sparsity of entries that are ordered by columns, or will be."""
    return ca.Sparsity.triplet(n_rows, n_columns, rows.tolist(), columns.tolist())


def _callback(ca: Any, monitor: Monitor, name: str, inputs: Any, outputs: Any, f: Callable[..., Any]) -> Any:
    """A function of NumPy arrays as a function of CasADi."""
    guarded = monitor.guarded(f)

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
            arrays = [None if x is None else np.frombuffer(x, np.float64) for x in given]
            try:
                values = guarded(*arrays)
            except BaseException:
                return 1  # the exception is kept by the monitor
            for buffer, value in zip(results, values, strict=True):
                if buffer is not None:
                    np.frombuffer(buffer, np.float64)[:] = value
            return 0

    return Function()


def _iteration_callback(ca: Any, monitor: Monitor, n: int, m: int) -> Any:
    sizes = {"f": 1, "x": n, "lam_x": n, "g": m, "lam_g": m}

    class Iteration(ca.Callback):
        def __init__(self) -> None:
            ca.Callback.__init__(self)
            self.construct("iteration", {})

        def get_n_in(self) -> int:
            return ca.nlpsol_n_out()

        def get_n_out(self) -> int:
            return 1

        def get_sparsity_in(self, i: int) -> Any:
            return ca.Sparsity.dense(sizes.get(ca.nlpsol_out(i), 0), 1)

        def eval(self, given: Any) -> list[int]:
            try:
                return [int(monitor(np.array(given[0], float).ravel()))]
            except BaseException as error:
                monitor.error = monitor.error or error
                return [1]

    return Iteration()


@dataclasses.dataclass(frozen=True)
class Cyipopt:
    """IPOPT through the package cyipopt, with the linear solvers that it was built with."""

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
        import cyipopt  # pyright: ignore[reportMissingImports]

        latest = [z]

        class Functions:
            objective = staticmethod(monitor.guarded(_remembering(program.objective, latest)))
            gradient = staticmethod(monitor.guarded(_of_copies(program.gradient)))
            constraints = staticmethod(monitor.guarded(_of_copies(program.constraints)))
            jacobian = staticmethod(monitor.guarded(_of_copies(program.jacobian)))

            def jacobianstructure(self) -> Any:
                return program.jacobian_structure

            def hessianstructure(self) -> Any:
                return program.hessian_structure

            def hessian(self, x: np.ndarray, multipliers: np.ndarray, factor: float) -> np.ndarray:
                return monitor.guarded(program.hessian)(x.copy(), multipliers.copy(), factor)

            def intermediate(self, *_: Any) -> bool:
                current = problem.get_current_iterate() if hasattr(problem, "get_current_iterate") else None
                return not monitor(np.array(latest[0] if current is None else current["x"]))

        problem = cyipopt.Problem(
            n=program.n, m=program.m, problem_obj=Functions(), lb=program.lower, ub=program.upper,
            cl=program.g_lower, cu=program.g_upper,
        )  # fmt: skip
        for name, value in _ipopt_options(max_iterations, is_warm, options).items():
            problem.add_option(name, value)
        with monitor.interruptible():
            found, info = problem.solve(z)
        if monitor.error is not None:
            raise monitor.error
        bound_multipliers = np.asarray(info["mult_x_U"]) - np.asarray(info["mult_x_L"])
        if monitor.is_interrupted:
            return monitor.interrupted(found, info["mult_g"], bound_multipliers)
        name = _IPOPT_CODES.get(info["status"], str(info["status_msg"]))
        ok, status = _IPOPT_STATUS.get(name, (False, name))
        return Solution(found, np.asarray(info["mult_g"]), bound_multipliers, ok, status, monitor.iterations - 1)


def _remembering(f: Callable[[np.ndarray], float], latest: list[np.ndarray]) -> Callable[[np.ndarray], float]:
    def call(x: np.ndarray) -> float:
        latest[0] = x.copy()
        return f(latest[0])

    return call


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
        free = np.nonzero(program.lower < program.upper)[0]  # a variable with equal bounds has no interior

        def whole(part: np.ndarray) -> np.ndarray:
            every = z.copy()
            every[fixed] = program.lower[fixed]
            every[free] = part
            return every

        fixed = np.setdiff1d(np.arange(program.n), free)
        rows, columns = program.jacobian_structure
        h_rows, h_columns = program.hessian_structure

        def symmetric(values: np.ndarray) -> Any:
            lower = scipy.sparse.csc_matrix((values, (h_rows, h_columns)), (program.n, program.n))
            every = lower + lower.T - scipy.sparse.diags(lower.diagonal())
            return every.tocsr()[free][:, free]

        def jacobian(x: np.ndarray) -> Any:
            every = scipy.sparse.csc_matrix((program.jacobian(whole(x)), (rows, columns)), (program.m, program.n))
            return every[:, free]

        none = np.zeros(program.m)
        constraints: Any = scipy.optimize.NonlinearConstraint(
            lambda x: program.constraints(whole(x)), program.g_lower, program.g_upper, jac=jacobian,  # type: ignore[arg-type]
            hess=lambda x, v: symmetric(program.hessian(whole(x), v, 0.0)),
        )  # fmt: skip
        with monitor.interruptible():
            result = scipy.optimize.minimize(
                lambda x: program.objective(whole(x)),
                np.clip(z, program.lower, program.upper)[free],
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
    """IPOPT through CasADi or cyipopt if one of them is installed, else SciPy's method, with a warning once."""
    if importlib.util.find_spec("casadi") is not None:
        return Ipopt()
    if importlib.util.find_spec("cyipopt") is not None:
        return Cyipopt()
    warnings.warn(
        "IPOPT is not installed, so SciPy's trust-constr is used, which takes many more iterations. Run "
        "`pip install jaxkane[collocation]`, or pass solver=jaxkane.collocation.TrustConstr().",
        stacklevel=4,
    )
    return TrustConstr()


def show_progress(iteration: int, cost: float, violation: float) -> None:
    """One line that is overwritten in each iteration."""
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
