"""The solver of nonlinear programs: IPOPT from the wheel of CasADi.

IPOPT stops where the gradient of the Lagrangian is zero. It is also zero at a maximum or a saddle point. At a minimum,
the Hessian H of the Lagrangian has no negative curvature along directions d with J d = 0 (J. Nocedal, S. Wright,
Numerical Optimization, 2006, section 12.5). The inertia of IPOPT's last KKT matrix usually proves this. If IPOPT had to
regularize this matrix, the curvature is computed. Here J contains the active constraints, and variables at their bounds
are fixed. The least curvature is computed by the method of Lanczos, which only needs products with H and projections
onto J d = 0. Each projection solves a system of linear equations with banded factors.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import FrameType, ModuleType
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.csgraph
import scipy.sparse.linalg

from .program import NonlinearProgram, Sparse


@dataclasses.dataclass(frozen=True)
class Solution:
    """The result of a solver, in the scaled numbers of the program.

    - `z` (n,): variables.
    - `multipliers` (n_g,), `bound_multipliers` (n,): derivatives of the Lagrangian by constraints and bounds, positive
        at an upper bound.
    - `ok`: whether the solver reports a local minimum.
    - `status`: the result in words.
    - `is_convex`: whether the last KKT matrix of the solver had the inertia of a minimum, without regularization.
    """

    z: np.ndarray
    multipliers: np.ndarray
    bound_multipliers: np.ndarray
    ok: bool
    status: str
    is_convex: bool = False


LATE = 5.0  # s


class Effort:
    """How long a search may take, and one line of its progress on stderr.

    **Arguments:**

    - `max_iterations`: the largest number of iterations of one search, on all its meshes together.
    - `max_seconds`: the longest time [s] from now on, or None.
    - `progress`: whether to show the line at once; if not, it is shown on a terminal after `LATE` seconds.
    """

    def __init__(self, max_iterations: int, max_seconds: float | None = None, progress: bool = False):
        self.max_iterations, self.iterations, self.progress, self.is_shown = max_iterations, 0, progress, False
        self.end = math.inf if max_seconds is None else time.monotonic() + max_seconds
        self.text = "compiling"
        self._timer = threading.Timer(LATE, self._late)

    def __enter__(self) -> Effort:
        if not self.progress and getattr(sys.stderr, "isatty", bool)():
            self._timer.daemon = True
            self._timer.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._timer.cancel()
        if self.is_shown:
            print(file=sys.stderr)

    def _late(self) -> None:
        self.progress = True
        self.show(self.text)

    def show(self, text: str) -> None:
        self.text = text
        if self.progress:
            print(f"\r{text}".ljust(72), end="", file=sys.stderr, flush=True)
            self.is_shown = True

    @property
    def is_over(self) -> bool:
        return time.monotonic() > self.end


class Monitor:
    """Shows progress, keeps the best iterate, and stops IPOPT after Ctrl-C, an exception or the longest time.

    **Arguments:**

    - `program`: the nonlinear program.
    - `effort`: its iterations are counted, and its time is limited.
    """

    def __init__(self, program: NonlinearProgram, effort: Effort):
        self.program, self.effort = program, effort
        self.best: np.ndarray | None = None
        self.error: BaseException | None = None
        self.is_interrupted = False
        self.iterations = -1  # the guess is no iteration
        self._best_merit = (np.inf, np.inf)

    def __call__(self, z: np.ndarray) -> bool:
        """Record an iterate. **Returns:** whether to stop."""
        if self.error is None:
            cost, violation = self.program.objective(z), self.program.violation(z)
            merit = (0.0, cost) if violation <= 1e-6 else (violation, cost)
            if merit <= self._best_merit:
                self._best_merit, self.best = merit, z.copy()
            self.iterations += 1
            count, cost = self.effort.iterations + self.iterations, cost * self.program.f_scale
            self.effort.show(f"iteration {count}: cost {cost:.6g}, violation {violation:.1e}")
        return self.is_interrupted or self.error is not None or self.effort.is_over

    @contextlib.contextmanager
    def interruptible(self) -> Iterator[None]:
        """Ctrl-C stops the solver after its current iteration. A second Ctrl-C raises `KeyboardInterrupt`."""
        if threading.current_thread() is not threading.main_thread():
            yield  # only the main thread receives signals
            return

        def stop(number: int, frame: FrameType | None) -> None:
            if self.is_interrupted:
                raise KeyboardInterrupt
            self.is_interrupted = True

        before = signal.signal(signal.SIGINT, stop)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)


INTERRUPTED = "interrupted"
TIME_IS_UP = "the longest time was reached"
NOT_FINITE = "a function or a derivative is not finite"
DIVERGES = "the iterates diverge: the cost may have no lower bound"


_IPOPT_STATUS = {
    "Solve_Succeeded": (True, "solved"),
    "Solved_To_Acceptable_Level": (True, "solved to a lower accuracy"),
    "Feasible_Point_Found": (True, "solved"),
    "Infeasible_Problem_Detected": (False, "the constraints contradict each other near the last iterate"),
    "Maximum_Iterations_Exceeded": (False, "the largest number of iterations was reached"),
    "Maximum_CpuTime_Exceeded": (False, "the longest CPU time was reached"),
    "Maximum_WallTime_Exceeded": (False, TIME_IS_UP),
    "Diverging_Iterates": (False, DIVERGES),
    "Search_Direction_Becomes_Too_Small": (False, "the steps became too small"),
    "Restoration_Failed": (False, "no feasible point was found near the last iterate: pass another guess"),
    "Error_In_Step_Computation": (False, "no step could be computed"),
    "Invalid_Number_Detected": (False, NOT_FINITE),
    "Not_Enough_Degrees_Of_Freedom": (False, "there are more equations than variables"),
    "User_Requested_Stop": (False, TIME_IS_UP),
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


def casadi() -> ModuleType:
    """CasADi, whose wheels contain IPOPT with the linear solver MUMPS.

    **Raises:** `ImportError` if it is not installed.
    """
    try:
        return importlib.import_module("casadi")
    except ImportError as error:
        raise ImportError('Collocation needs IPOPT, from CasADi: pip install "jaxkane[collocation]".') from error


def minimized(
    program: NonlinearProgram,
    z: np.ndarray,
    effort: Effort,
    *,
    is_warm: bool = False,
    options: Mapping[str, Any] | None = None,
) -> Solution:
    """Solve a program by IPOPT.

    **Arguments:**

    - `program`: the nonlinear program.
    - `z` (n,): the initial guess of the scaled variables.
    - `effort`: limits of iterations and time; the iterations are added to it.
    - `is_warm`: whether the guess is close to the solution.
    - `options`: further options by IPOPT's own names.
    """
    ca, monitor = casadi(), Monitor(program, effort)
    n, m = program.n, program.m
    x_type, g_type, number, none = (ca.Sparsity.dense(k, 1) for k in (n, m, 1, 0))
    rows, columns = program.hessian_structure
    order = np.lexsort((columns, rows))  # CasADi has the upper triangle

    def sparsity(k: int, rows: np.ndarray, columns: np.ndarray) -> Any:
        return ca.Sparsity.triplet(k, n, rows.tolist(), columns.tolist())

    def second(x: np.ndarray, p: np.ndarray, factor: np.ndarray | None, multipliers: np.ndarray | None) -> list[Any]:
        # CasADi passes None for zeros.
        weight = 0.0 if factor is None else float(factor[0])
        return [program.hessian(x, np.zeros(m) if multipliers is None else multipliers, weight)[order]]

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
        "ipopt": _ipopt_options(effort.max_iterations - effort.iterations, is_warm, options),
    }
    try:
        solve = ca.nlpsol("solve", "ipopt", {"x": x, "f": cost, "g": constraints}, settings)
    except RuntimeError as error:
        raise ValueError(f"solve: IPOPT refuses the `options` {dict(options or {})}: {error}") from None
    lower, upper = (
        np.where(program.is_implied, b, g) for b, g in ((-np.inf, program.g_lower), (np.inf, program.g_upper))
    )
    start = {"x0": z, "lbx": program.lower, "ubx": program.upper, "lbg": lower, "ubg": upper}
    with monitor.interruptible():
        result = solve(**start)
    if monitor.error is not None:
        raise monitor.error
    found, lam_g, lam_x = (np.array(result[k], float).ravel() for k in ("x", "lam_g", "lam_x"))
    stats = solve.stats()
    ok, status = _IPOPT_STATUS.get(stats["return_status"], (False, stats["return_status"].replace("_", " ")))
    if monitor.is_interrupted:
        ok, status = False, INTERRUPTED
    if status in (INTERRUPTED, TIME_IS_UP) and monitor.best is not None:
        found = monitor.best
    effort.iterations += int(stats["iter_count"])
    is_exact = "hessian_approximation" not in (options or {})  # the others are always convex
    is_convex = is_exact and stats["iter_count"] > 0 and stats["iterations"]["regularization_size"][-1] == 0.0
    return Solution(found, lam_g, lam_x, ok, status, is_convex)


def _callback(
    ca: ModuleType, monitor: Monitor, name: str, inputs: Sequence[Any], outputs: Sequence[Any], f: Callable[..., Any]
) -> Any:
    # A function of NumPy arrays as a function of CasADi. The monitor keeps its exceptions, which IPOPT would hide.

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

        def eval_buffer(self, given: Sequence[Any], results: Sequence[Any]) -> int:
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


NOT_A_MINIMUM = "stationary, but not a minimum: pass another guess"


def minimum(
    program: NonlinearProgram,
    z: np.ndarray,
    border: np.ndarray,
    effort: Effort,
    *,
    is_warm: bool = False,
    options: Mapping[str, Any] | None = None,
) -> Solution:
    """Solve a program by IPOPT. At a saddle point, often due to symmetry, continue in a direction in which it falls.

    If this does not lower the cost, the status is `NOT_A_MINIMUM`, unless the search was interrupted or its time is up.

    **Arguments:** as in `minimized`, and

    - `border`: the indices of the variables that occur in the equations of all nodes.
    """
    solution = minimized(program, z, effort, is_warm=is_warm, options=options)
    while (d := _downwards(program, border, solution)) is not None:
        beside = np.clip(solution.z + d, program.lower, program.upper)
        better = minimized(program, beside, effort, is_warm=True, options=options)
        if not better.ok or not program.objective(better.z) < program.objective(solution.z):
            status = better.status if better.status in (INTERRUPTED, TIME_IS_UP) else NOT_A_MINIMUM
            return dataclasses.replace(solution, ok=False, status=status)
        solution = better
    return solution


def _downwards(program: NonlinearProgram, border: np.ndarray, solution: Solution) -> np.ndarray | None:
    """A step (n,) along the active constraints that lowers the cost by more than rounding errors.

    It changes no variable by more than a tenth of its size. It is None at a minimum, or if there is no solution.
    """
    if not solution.ok or solution.is_convex:
        return None
    z, g = solution.z, program.constraints(solution.z)
    free = ~_at_bound(z, program.lower, program.upper, solution.bound_multipliers)
    active = _at_bound(g, program.g_lower, program.g_upper, solution.multipliers)
    H, J = program.hessian_matrix(z, solution.multipliers)[free][:, free], program.jacobian_matrix(z)
    is_border = np.isin(np.arange(program.n), border)[free]
    project = _Projection(J[active][:, free], is_border, program.places[free])
    v = project(project(np.random.default_rng(0).normal(size=int(free.sum()))))
    if not np.linalg.norm(v) > 1e-3:  # the constraints determine all variables
        return None
    V, diagonal, beside = np.zeros((min(_STEPS, v.size) + 1, v.size)), [], []
    V[0] = v / np.linalg.norm(v)
    for k in range(len(V) - 1):
        w = project(H @ V[k])
        diagonal.append(float(V[k] @ w))
        for _ in range(2):  # a single orthogonalization leaves rounding errors, which grow
            w = w - V[: k + 1].T @ (V[: k + 1] @ w)
        beside.append(float(np.linalg.norm(w)))
        if beside[-1] <= 1e-9 * max(np.abs(diagonal)):  # both are zero in a linear problem
            break
        V[k + 1] = w / beside[-1]
    _, vectors = scipy.linalg.eigh_tridiagonal(diagonal, beside[: len(diagonal) - 1], select="i", select_range=(0, 0))
    # The direction is a proof, whether or not Lanczos converged, if it meets the constraints: steps beyond the number
    # of directions add vectors of rounding errors, which the projection removes.
    d = project(V[: len(diagonal)].T @ vectors[:, 0])
    if abs(np.linalg.norm(d) - 1.0) > 1e-3:
        return None
    d *= 0.1 / np.max(np.abs(d))
    rounding = max(1e-7 * float(np.max(np.abs(H.data), initial=0.0)), 1e-8)
    if d @ (H @ d) > -max(rounding * (d @ d), 1e-7):
        return None
    found = np.zeros(program.n)
    found[free] = d
    return found


_STEPS = 80  # of the method of Lanczos


def response(
    program: NonlinearProgram, solution: Solution, gradient: np.ndarray, g: np.ndarray
) -> tuple[np.ndarray, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """How a solution changes with p constants of its program, by the implicit function theorem.

    **Arguments:** `gradient` (p, n), `g` (p, m): the derivatives by the constants of the gradient of the Lagrangian and
    of the constraints, at fixed variables and multipliers.

    **Returns:** the derivatives (p, n) of the scaled variables; and by sentences, which variables (n,) and constraints
    (m,) make derivatives wrong.
    """
    H, J = program.hessian_matrix(solution.z, solution.multipliers), program.jacobian_matrix(solution.z)

    def active_and_weak(
        x: np.ndarray, lower: np.ndarray, upper: np.ndarray, multipliers: np.ndarray, curvature: Any
    ) -> tuple[np.ndarray, np.ndarray]:
        # IPOPT's last product of distance and multiplier is about 1e-10. If both are zero at the solution, the
        # derivatives of the barrier and of the cost are as large as each other: multiplier = curvature * distance.
        distance = np.maximum(np.minimum(x - lower, upper - x), 1e-12)
        ratio = np.abs(multipliers) / (curvature * distance)
        is_weak = (lower < upper) & (distance < 1e-3) & (ratio > 0.1) & (ratio < 10.0)
        return (lower >= upper) | (ratio > 1.0), is_weak

    curvature, g_now = np.clip(H.diagonal(), 1e-4, 1.0), program.constraints(solution.z)
    fixed, weak = active_and_weak(solution.z, program.lower, program.upper, solution.bound_multipliers, curvature)
    active, g_weak = active_and_weak(g_now, program.g_lower, program.g_upper, solution.multipliers, 1.0)
    free, active = ~fixed, active & ~program.is_implied
    K: Any = scipy.sparse.bmat([[H[free][:, free], J[active][:, free].T], [J[active][:, free], None]], format="csr")
    scale, n = np.ones(K.shape[0]), int(free.sum())
    for _ in range(5):  # towards rows and columns whose largest entry is one
        size = abs(K).max(axis=1).toarray().ravel()
        D = scipy.sparse.diags_array(1.0 / np.sqrt(np.where(size > 0, size, 1.0)))
        scale, K = D @ scale, (D @ K @ D).tocsr()
    # With a small shift, the factors of a singular matrix exist, and show which variables are not determined.
    shift = scipy.sparse.diags_array(np.where(np.arange(len(scale)) < n, 1e-14, -1e-14))
    factors = scipy.sparse.linalg.splu((K + shift).tocsc())
    null = factors.solve(factors.solve(np.random.default_rng(0).normal(size=len(scale))))
    is_singular = np.linalg.norm(factors.solve(null)) > 1e12 * np.linalg.norm(null)
    right = -scale[:, None] * np.concatenate([gradient[:, free], g[:, active]], axis=1).T
    step = factors.solve(right)
    step += factors.solve(right - K @ step)
    dz, undetermined = np.zeros_like(gradient), np.zeros(program.n)
    dz[:, free], undetermined[free] = (scale[:, None] * step)[:n].T, np.abs(scale * null)[:n] * is_singular
    unmet = np.max(np.abs(dz @ J.T + g), axis=0) > 1e-6 * np.maximum(np.max(np.abs(g), axis=0), 1e-3)
    return dz, {
        UNMET: (np.zeros(0), unmet & program.is_implied & (program.g_lower == program.g_upper)),
        "the KKT matrix is singular: nothing determines {}. Add a small cost of it": (undetermined, np.zeros(0)),
        "{} is at a bound with a multiplier of zero, where the derivatives to both sides differ": (weak, g_weak),
    }


UNMET = "fixed values satisfy {} for these parameters only: leave one of these values out"


def _at_bound(x: np.ndarray, lower: np.ndarray, upper: np.ndarray, multipliers: np.ndarray) -> np.ndarray:
    # Whether numbers are at a bound. In an interior point method, their distance is then less than the multiplier.
    distance = np.minimum(x - lower, upper - x)
    return (lower >= upper) | (distance < np.maximum(1e-6, np.abs(multipliers)))


class _Projection:
    """The orthogonal projection onto J d = 0, for J (m, n).

    **Arguments:**

    - `J`: the sparse matrix.
    - `is_border` (n,): whether a column is eliminated last.
    - `places` (n,): see `NonlinearProgram.places`.
    """

    def __init__(self, J: Sparse, is_border: np.ndarray, places: np.ndarray):
        self.inner, self.border, m = np.flatnonzero(~is_border), np.flatnonzero(is_border), J.shape[0]
        part, of_border = J[:, self.inner], J[:, self.border].toarray()
        # With a small number instead of zero, constraints that depend on each other do not make the matrix singular.
        blocks = [[scipy.sparse.identity(part.shape[1]), part.T], [part, -1e-12 * scipy.sparse.identity(m)]]
        matrix = scipy.sparse.bmat(blocks, format="csr")
        order = banded_order(matrix, places[self.inner])
        self.factors = BandedFactors(matrix, order, order)
        self.coupling = np.concatenate([np.zeros((part.shape[1], len(self.border))), of_border])
        self.solved = self.factors.solve(self.coupling)
        self.schur = np.eye(len(self.border)) - self.coupling.T @ self.solved

    def __call__(self, v: np.ndarray) -> np.ndarray:
        right = np.concatenate([v[self.inner], np.zeros(len(self.coupling) - len(self.inner))])
        step = self.factors.solve(right[:, None])[:, 0]
        d, x = np.empty_like(v), np.linalg.solve(self.schur, v[self.border] - self.coupling.T @ step)
        d[self.border], d[self.inner] = x, (step - self.solved @ x)[: len(self.inner)]
        return d


def banded_order(matrix: Sparse, places: np.ndarray) -> np.ndarray:
    """An order in which a matrix of Karush, Kuhn and Tucker, [[H, J^T], [J, .]], has a narrow band.

    It is the order of the places of the variables, or that of Cuthill and McKee for motions whose ends are linked. The
    band of the latter is up to twice as wide. Beyond 64, LAPACK's band factors use the threads of the BLAS. Then 241
    nodes of a bicycle took 0.05 to 2.7 CPU s on two busy cores, instead of 0.009.

    **Arguments:**

    - `matrix`: the sparse matrix (n + m, n + m).
    - `places` (n,): the places of the variables. A constraint has the mean place of its variables.
    """
    n = len(places)
    occurs = scipy.sparse.csr_matrix(matrix[n:, :n] != 0, dtype=float)
    of_rows = (occurs @ places) / np.maximum(occurs @ np.ones(n), 1.0)
    # `round`, because the means of constraints of one interval differ by rounding errors
    by_place = np.argsort(np.concatenate([places, of_rows]).round(9), kind="stable")
    by_graph = np.asarray(scipy.sparse.csgraph.reverse_cuthill_mckee(matrix, symmetric_mode=True))
    i, j = matrix.nonzero()

    def width(order: np.ndarray) -> int:
        place = np.argsort(order)
        return int(np.max(np.abs(place[i] - place[j]), initial=0))

    return min(by_place, by_graph, key=width)


class BandedFactors:
    """The LU factors of a sparse matrix that is banded in a suitable order.

    **Arguments:**

    - `matrix`: a sparse matrix (n, n).
    - `rows`, `columns`: an order of its rows and columns in which it is banded.

    **Raises:** `np.linalg.LinAlgError` if it is singular.
    """

    def __init__(self, matrix: Sparse, rows: np.ndarray, columns: np.ndarray):
        self.rows, self.columns, n = rows, columns, matrix.shape[0]
        ordered = scipy.sparse.coo_matrix(matrix.tocsr()[rows][:, columns])
        ordered.eliminate_zeros()  # a condition at the start has zeros in the columns of the end
        i, j = ordered.row, ordered.col
        self.below, self.above = int(np.max(i - j, initial=0)), int(np.max(j - i, initial=0))
        band = np.zeros((2 * self.below + self.above + 1, n))
        band[self.below + self.above + i - j, j] = ordered.data
        factorize, self._solve = scipy.linalg.get_lapack_funcs(("gbtrf", "gbtrs"), (band,))
        self.lu, self.pivots, info = factorize(band, self.below, self.above, overwrite_ab=True)
        if info != 0:
            raise np.linalg.LinAlgError("The matrix is singular.")

    @property
    def log_determinant(self) -> float:
        return float(np.sum(np.log(np.abs(self.lu[self.below + self.above]))))

    def solve(self, b: np.ndarray) -> np.ndarray:
        """The solution (n, k) for right-hand sides (n, k)."""
        x, info = self._solve(self.lu, self.below, self.above, b[self.rows], self.pivots)
        if info != 0:
            raise np.linalg.LinAlgError("The matrix is singular.")
        solved = np.empty_like(x)
        solved[self.columns] = x
        return solved
