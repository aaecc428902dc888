"""`solve`: from a problem to a plan, with mesh refinement."""

from __future__ import annotations

import dataclasses
import numbers
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._collocate.lobatto import Lobatto, lobatto
from .._collocate.program import NonlinearProgram
from .._collocate.solvers import (
    DIVERGES,
    INTERRUPTED,
    NOT_FINITE,
    TIME_IS_UP,
    Effort,
    Solution,
    casadi,
    minimized,
    minimum,
)
from .._collocate.transcription import Motion, Transcription, nodes_of, system_at
from .._common.lookup import positive_number
from .._integrate.trajectory import Trajectory
from .._scalarjit.compat import concretely
from .._scalarjit.components import Component
from ._mesh import interpolated, jumps_inside, local_errors, oscillating, quadrature_errors, refined, switch_errors
from ._plan import Multipliers, Plan, differentiable, trajectory_of
from ._problem import Phases, Problem, boundaries, detoured, detours, guess_of

Guess: TypeAlias = Plan | Trajectory | Mapping[str, Any] | Sequence[Any] | None
"""A guess of a motion, or a sequence of guesses."""

MAX_MESHES = 15
COARSE = 1e-2
"""The largest local error with which a plan on a mesh that is not refined is `ok`."""


def solve(
    problem: Problem | Phases,
    guess: Guess = None,
    *,
    intervals: int = 50,
    method: str = "hermite-simpson",
    tolerance: float | None = 1e-6,
    options: Mapping[str, Any] | None = None,
    starts: int = 1,
    seed: int = 0,
    max_iterations: int = 1000,
    max_seconds: float | None = None,
    max_intervals: int = 2000,
    progress: bool = False,
) -> Plan:
    """Find a motion of least cost by direct collocation.

    The states are polynomials in each interval of a mesh. They satisfy the equations of motion at the collocation
    points of a Lobatto IIIA method. IPOPT solves the problem with exact sparse first and second derivatives.

    After the solution, each interval is integrated from its own start to compute its local error. Intervals whose error
    is too large are divided. Then the problem is solved on the new mesh, from the present solution.

    **Arguments:**

    - `problem`: a `Problem`, or `Phases`.
    - `guess`: None for straight lines between the values at both ends; a `Plan`; a `Trajectory`; or a dict by name. It
        is clipped to the ends and bounds of the problem, and `plan.notes` names what was clipped. A
        value of the dict is a number, an array (n,) of equally spaced samples, or a function of time. The key
        "duration" sets the duration. If `guess` is a sequence of these, all are tried and the best solution is
        returned. For `Phases`, a sequence contains one guess for each phase.
    - `intervals`: the number of intervals of the first mesh.
    - `method`: "trapezoid" (order 2), "hermite-simpson" (order 4) or "lobatto" (order 6).
    - `tolerance`: the largest permitted local error of an interval, relative to the size of each state. None: the first
        mesh is not refined, and a plan with a local error above 1 % is not `ok`.
    - `options`: options of IPOPT, by its own names.
    - `starts`: the number of searches. The first one starts from `guess`. For the others, random deviations are added
        to the coordinates.
    - `seed`: the seed of these deviations.
    - `max_iterations`: the largest number of iterations for each guess, on all meshes together.
    - `max_seconds`: the longest time [s], or None. It is compared with the time after each iteration. The plan is then
        the best one so far.
    - `max_intervals`: the largest number of intervals of a phase.
    - `progress`: show the cost and the violation of each iteration in one line on stderr. On a terminal, this line is
        shown after 5 s in any case.

    **Returns:** a `Plan`. If no solution is found, `plan.ok` is False and `plan.reason` states why. The plan then
    contains the last or best iterate.

    **Raises:** `ValueError` and `TypeError` for invalid arguments, and if a function is not finite at the guess.
    `ImportError` without CasADi.
    """
    casadi()
    traced, problem = problem, getattr(problem, "concrete", None) or problem
    phases = problem if isinstance(problem, Phases) else Phases([problem]) if isinstance(problem, Problem) else None
    if phases is None:
        raise TypeError(f"solve: the first argument must be a Problem or Phases, got {problem!r}.")
    max_intervals = _integer("max_intervals", max_intervals, 1)
    intervals = _integer("intervals", intervals, 1, max_intervals)
    max_iterations, starts, seed = (
        _integer(name, x, least)
        for name, x, least in (("max_iterations", max_iterations, 0), ("starts", starts, 1), ("seed", seed, 0))
    )
    if tolerance is not None:
        tolerance = positive_number(tolerance, "solve: `tolerance`")
    if not isinstance(options, Mapping | None):
        raise TypeError(f"solve: `options` must be a dict by the names of IPOPT, got {options!r}.")
    if max_seconds is not None:
        max_seconds = positive_number(max_seconds, "solve: `max_seconds`")
    guesses = _guesses(problem, guess, starts, seed)
    plans: list[Plan] = []
    with Effort(max_iterations, max_seconds, progress) as effort, concretely():
        search = _Search(phases, lobatto(method), tolerance, options, effort, max_intervals)
        for one in guesses:
            plans.append(search.plan(intervals, one))
            if plans[-1].reason == INTERRUPTED or effort.is_over:
                break
    best = min(plans, key=lambda plan: (not plan.ok, plan.violation > 1e-6, plan.cost))
    if len(guesses) > 1:
        best = dataclasses.replace(best, starts=tuple((plan.cost, plan.reason) for plan in plans))
    return best if traced is problem else differentiable(traced, best)


def continuation(
    make: Callable[[Any], Problem | Phases], values: Iterable[Any], guess: Guess = None, **arguments: Any
) -> list[Plan]:
    """Solve a family of problems one after another. Each solution is the guess of the next problem.

        plans = jk.collocation.continuation(lambda load: crane(load), np.linspace(1.0, 20.0, 5))

    **Arguments:**

    - `make`: a function from a value to a `Problem`.
    - `values`: the values, in small steps.
    - `guess`: the guess for the first problem.
    - `arguments`: arguments of `solve`.

    **Returns:** a list of plans. If a plan is not `ok`, it is the last one in the list.
    """
    plans: list[Plan] = []
    for value in values:
        plans.append(solve(make(value), guess, **arguments))
        if not plans[-1].ok:
            break
        guess = list(plans[-1].phases) if plans[-1].phases else plans[-1]
    return plans


def check_derivatives(
    problem: Problem | Phases,
    guess: Guess = None,
    *,
    intervals: int = 2,
    method: str = "hermite-simpson",
    seed: int = 0,
) -> dict[str, float]:
    """Compare the sparse derivatives with dense derivatives computed by JAX, on a small mesh at a point near the guess.

    **Arguments:**

    - `problem`, `guess`, `intervals`, `method`: as in `solve`.
    - `seed`: the seed of the random point near the guess.

    **Returns:** the largest deviations by name, for "gradient", "jacobian" and "hessian", each relative to the largest
    entry.
    """
    phases = problem if isinstance(problem, Phases) else Phases([problem])
    found, mesh = lobatto(method), np.linspace(0.0, 1.0, intervals + 1)
    ends = zip(phases.phases, boundaries(phases), strict=True)
    motions = [_guessed(p, guess, nodes_of(mesh, found), None, e) for p, e in ends]
    theta, meshes = _theta(phases.phases[0], guess), [mesh] * len(motions)
    transcription = Transcription(phases.phases, phases.links, meshes, found, motions, theta)
    program = transcription.program
    rng = np.random.default_rng(seed)
    z = np.clip(transcription.z + 0.1 * rng.normal(size=program.n), program.lower, program.upper)
    weights = rng.normal(size=program.m)

    def lagrangian(z: Array) -> Any:
        cost, g = program.in_jax(z)
        return cost + jnp.asarray(weights) @ g

    gradient, jacobian = jax.jit(jax.jacfwd(program.in_jax))(jnp.asarray(z))
    hessian = np.asarray(jax.jit(jax.hessian(lagrangian))(jnp.asarray(z)))
    own = np.zeros((program.m, program.n))
    own[program.jacobian_structure] = program.jacobian(z)
    lower = np.zeros((program.n, program.n))
    lower[program.hessian_structure] = program.hessian(z, weights)
    pairs = {
        "gradient": (program.gradient(z), np.asarray(gradient)),
        "jacobian": (own, np.asarray(jacobian)),
        "hessian": (lower + np.tril(lower, -1).T, hessian),
    }
    return {
        k: float(np.max(np.abs(a - b), initial=0.0) / max(np.max(np.abs(b), initial=0.0), 1e-300))
        for k, (a, b) in pairs.items()
    }


def _integer(name: str, value: Component, least: int, most: int | None = None) -> int:
    is_integer = isinstance(value, numbers.Integral) and not isinstance(value, bool)
    if not is_integer or int(value) < least or (most is not None and int(value) > most):
        bounds = f"of at least {least}" if most is None else f"from {least} to {most}"
        raise ValueError(f"solve: `{name}` must be an integer {bounds}, got {value!r}.")
    return int(value)


def _guesses(problem: Problem | Phases, guess: Guess, starts: int, seed: int) -> list[list[tuple[Any, Any]]]:
    """For each start, for each phase: the guess, and the detour that is added."""
    problems = problem.phases if isinstance(problem, Phases) else (problem,)
    if isinstance(problem, Phases):
        if isinstance(guess, Plan):
            guess = guess.phases or (guess,)
        each = guess if isinstance(guess, (list, tuple)) else [guess] * len(problems)
        if len(each) != len(problems):
            raise ValueError(f"solve: `guess` has {len(each)} guesses for {len(problems)} phases.")
        several = [list(each)]
    else:
        several = [[one] for one in guess] if isinstance(guess, (list, tuple)) else [[guess]]
        if not several:
            raise ValueError("solve: `guess` is an empty sequence.")
    found = []
    for each in several:
        moved = [detours(p, starts, seed) for p in problems]
        found += [[(g, moved[p][k]) for p, g in enumerate(each)] for k in range(starts)]
    return found


@dataclasses.dataclass(frozen=True)
class _Search:
    """The arguments of `solve` that are the same for all guesses."""

    phases: Phases
    method: Lobatto
    tolerance: float | None
    options: Mapping[str, Any] | None
    effort: Effort
    max_intervals: int

    def plan(self, intervals: int, guesses: Sequence[tuple[Any, Any]]) -> Plan:
        problems = self.phases.phases
        meshes = [
            guess.mesh / guess.duration
            if isinstance(guess, Plan) and not guess.phases and len(guess.mesh) > intervals
            else np.linspace(0.0, 1.0, intervals + 1)
            for guess, _ in guesses
        ]
        nodes = [nodes_of(mesh, self.method) for mesh in meshes]
        each = zip(problems, guesses, nodes, boundaries(self.phases), strict=True)
        motions = [_guessed(p, g, s, detour, ends) for p, (g, detour), s, ends in each]
        theta = _theta(problems[0], guesses[0][0])
        self.effort.iterations, is_warm = 0, isinstance(guesses[0][0], Plan)
        sizes = [g.scales if _is_similar(p, g) else None for p, (g, _) in zip(problems, guesses, strict=True)]
        transcription = self._transcribed(meshes, motions, theta, sizes)
        names = []
        for p, (problem, (guess, detour), motion) in enumerate(zip(problems, guesses, motions, strict=True)):
            clipped = [*transcription.clipped(p)]
            if not problem.durations[0] <= motion.duration <= problem.durations[1]:
                clipped.append("duration")
            given = () if guess is None or detour is not None else guess if isinstance(guess, Mapping) else clipped
            prefix = f"phase {p}: " * (len(problems) > 1)
            names += [prefix + name for name in dict.fromkeys(clipped) if name in given]
        plan = self._refined(transcription, meshes, is_warm)
        notes = [f"clipped in the guess, because of an end or a bound: {', '.join(names)}"] if names else []
        if transcription.implied:
            notes.append(f"dropped, because others imply it: {', '.join(transcription.implied)}")
        if not plan.ok and (corners := transcription.corners()):
            notes.append(f"{', '.join(corners)}, which has a corner: use slack controls (docs/optimal_control.md)")
        return dataclasses.replace(plan, notes=(*notes, *plan.notes))

    def _refined(self, transcription: Transcription, meshes: Sequence[np.ndarray], is_warm: bool) -> Plan:
        """The plan on a sufficiently fine mesh, from the problem on the first mesh."""
        costs: list[float] = []
        sizes, solved = transcription.sizes, None  # the solution on the mesh before, which must not be lost
        while True:
            solution = self._solved(transcription, is_warm)
            if solved is not None and not solution.ok:
                return self._unrefined(*solved, solution.status, costs)
            program, x = transcription.program, solution.z * transcription.x_scale
            costs.append(program.objective(solution.z) * program.f_scale)
            motions, theta = transcription.motions(x), transcription.theta(x)
            errors = None
            if solution.ok:
                try:
                    errors = self._errors(transcription, x)
                except KeyboardInterrupt:
                    return self._unrefined(transcription, solution, None, INTERRUPTED, costs)
            new, tolerance = None, None if transcription.unresolved else self.tolerance  # no mesh would help
            if errors is not None and tolerance is not None and any(np.max(e) > tolerance for e in errors):
                new = [
                    refined(mesh, e, tolerance, self.method.order, merges=len(costs) < 6)
                    if np.max(e) > tolerance
                    else mesh
                    for mesh, e in zip(meshes, errors, strict=True)
                ]
            if new is None or len(costs) == MAX_MESHES or max(len(m) for m in new) > self.max_intervals + 1:
                return self._plan(transcription, solution, errors, costs, new is not None)
            motions = [
                interpolated(motion, mesh, self.method, nodes_of(finer, self.method))
                for motion, mesh, finer in zip(motions, meshes, new, strict=True)
            ]
            solved = transcription, solution, errors
            try:
                transcription = self._transcribed(new, motions, theta, sizes)
            except (KeyboardInterrupt, ValueError) as error:  # a function may not be finite at a new node
                status = INTERRUPTED if isinstance(error, KeyboardInterrupt) else str(error)
                return self._unrefined(*solved, status, costs)
            meshes, is_warm = new, True

    def _unrefined(
        self,
        transcription: Transcription,
        solution: Solution,
        errors: Sequence[np.ndarray] | None,
        status: str,
        costs: Sequence[float],
    ) -> Plan:
        """The plan of a solution whose mesh should be finer, with the status of the finer mesh."""
        hint = _remedy(transcription, solution.z * transcription.x_scale, "pass more `intervals`")
        reason = status if status == INTERRUPTED else f"solved, but not on a finer mesh: {status}; {hint}"
        solution = dataclasses.replace(solution, ok=False, status=reason)
        return self._plan(transcription, solution, errors, costs, False)

    def _transcribed(
        self,
        meshes: Sequence[np.ndarray],
        motions: Sequence[Motion],
        theta: np.ndarray,
        sizes: Sequence[np.ndarray | None],
    ) -> Transcription:
        phases, links = self.phases.phases, self.phases.links
        return Transcription(phases, links, meshes, self.method, motions, theta, sizes=sizes)

    def _solved(self, transcription: Transcription, is_warm: bool) -> Solution:
        program, border = transcription.program, transcription.shared
        return minimum(program, transcription.z, border, self.effort, is_warm=is_warm, options=self.options)

    def _conflict(self, transcription: Transcription, solution: Solution) -> tuple[str, ...]:
        """The cause of an infeasible problem, from an elastic one: equations of motion are violated first."""
        program = transcription.program
        if (
            solution.ok
            or program.violation(solution.z) <= 1e-6
            or solution.status in (INTERRUPTED, TIME_IS_UP, NOT_FINITE)
        ):
            return ()
        weights = np.full(program.m, 1e3)
        for row in transcription.rows:
            if row.kind == "dynamics":
                weights[row.rows] = 1.0
        elastic, g = program.elastic(weights), program.constraints(transcription.z)
        slacks = np.maximum(program.g_lower - g, 0.0), np.maximum(g - program.g_upper, 0.0)
        found = minimized(elastic, np.concatenate([transcription.z, *slacks]), self.effort, options=self.options)
        return conflict_of(transcription, elastic, found) if found.ok and elastic.objective(found.z) > 1e-6 else ()

    def _errors(self, transcription: Transcription, x: np.ndarray) -> list[np.ndarray]:
        """The error of each interval: of states, relative to their sizes, and, if the mesh may be refined, of the cost,
        relative to the whole."""
        program = transcription.program
        size = program.f_scale * max(abs(program.objective(x / transcription.x_scale)), 1e-3)
        found = []
        for layout, motion in zip(transcription.layouts, transcription.motions(x), strict=True):
            scales = transcription.x_scale[layout.node(0)]
            errors = local_errors(layout, x, motion, self.method, scales, self.tolerance or COARSE)
            if self.tolerance is not None:  # no mesh resolves a cost of noisy measurements, which have their own nodes
                errors = np.maximum(errors, quadrature_errors(layout, x, motion, self.method) / size)
                errors = np.maximum(errors, switch_errors(layout, motion, self.method))
            found.append(errors)
        return found

    def _plan(
        self,
        transcription: Transcription,
        solution: Solution,
        errors: Sequence[np.ndarray] | None,
        costs: Sequence[float],
        is_coarse: bool,
    ) -> Plan:
        program, x = transcription.program, solution.z * transcription.x_scale
        ok, reason = solution.ok, solution.status
        worst = max((float(np.max(e)) for e in errors or ()), default=0.0)
        if ok and transcription.unresolved:
            names, hint = ", ".join(transcription.unresolved), "prescribe its rate, or pass method='lobatto'"
            ok, reason = False, f"solved, but the path equality of {names} may have wrong forces: {hint}"
        elif ok and self.tolerance is None and worst > COARSE:
            ok, reason = False, f"solved, but the local error is {worst:.1e}: pass more `intervals` or a `tolerance`"
        elif ok and is_coarse:
            hint = _remedy(transcription, x, "pass a larger `tolerance` or other bounds")
            ok, reason = False, f"solved, but the local error is {worst:.1e} instead of {self.tolerance:g}: {hint}"
        elif ok and program.violation(solution.z) > 1e-6:
            ok, reason = False, f"dropped constraints are violated: {', '.join(transcription.implied)}"
        if reason == DIVERGES:
            big = [name for layout in transcription.layouts for name, at in layout.by_name.items()
                   if np.max(np.abs(solution.z[at])) > 1e6]  # fmt: skip
            reason += f"; {', '.join(dict.fromkeys(big))} without a sufficient bound" * bool(big)
        if reason == NOT_FINITE and (names := transcription.not_finite(x)):
            reason = f"{', '.join(names)} is not finite at the last iterate"
        parameters = transcription.parameters
        values: Any = () if parameters is None else parameters.values(jnp.asarray(transcription.theta(x)))
        common = {
            "ok": ok,
            "reason": reason,
            "cost": costs[-1],
            "costs": tuple(costs),
            "iterations": self.effort.iterations,
            "violation": program.violation(solution.z),
            "dual_residual": dual_residual(program, solution),
            "conflict": self._conflict(transcription, solution),
            "solved": (transcription, solution),
            "estimates": dict(zip(() if parameters is None else parameters.names, map(float, values), strict=True)),
        }
        plans = [
            self._plan_of_phase(transcription, solution, x, p, None if errors is None else errors[p], common)
            for p in range(len(transcription.layouts))
        ]
        return plans[0] if len(plans) == 1 and not self.phases.links else _joined(plans)

    def _plan_of_phase(
        self,
        transcription: Transcription,
        solution: Solution,
        x: np.ndarray,
        p: int,
        errors: np.ndarray | None,
        common: dict[str, Any],
    ) -> Plan:
        layout, motion = transcription.layouts[p], transcription.motions(x)[p]
        system = system_at(transcription, p, x)
        trajectory = trajectory_of(system, self.phases.phases[p], motion)
        if common["ok"] and (jumps := jumps_inside(system, np.asarray(trajectory.t), motion.Y)):
            name, t = next(iter(jumps.items()))
            reason = f"solved, but the event {name!r} changes the state before {t:.4g} s: link two phases there"
            common = common | {"ok": False, "reason": reason}
        return Plan(
            problem=self.phases.phases[p],
            duration=motion.duration,
            system=system,
            trajectory=trajectory,
            mesh=layout.mesh * motion.duration,
            errors=errors,
            multipliers=multipliers_of(transcription, solution, p),
            unmet=unmet_of(transcription, solution, p),
            active=active_of(transcription, solution, p),
            motion=motion,
            method=self.method,
            scales=transcription.x_scale[layout.node(0)],
            **common,
        )


def _remedy(transcription: Transcription, x: np.ndarray, otherwise: str) -> str:
    """What to do about local errors that remain at variables (n,): controls may oscillate, or `otherwise`."""
    pairs = zip(transcription.layouts, transcription.motions(x), strict=True)
    names = ", ".join(name for pair in pairs for name in oscillating(*pair))
    return (
        f"{names} oscillates from node to node: bound it, or increase its cost or that of its rate"
        if names
        else otherwise
    )


def _is_similar(problem: Problem, guess: Guess) -> bool:
    """Whether a guess is a plan with the same states and controls."""
    both = [(*p.names, *p.bounds_of_controls) for p in (problem, getattr(guess, "problem", None)) if p is not None]
    return isinstance(guess, Plan) and not guess.phases and both[0] == both[1]


def _guessed(problem: Problem, guess: Any, s: np.ndarray, detour: np.ndarray | None, ends: np.ndarray) -> Motion:
    if _is_similar(problem, guess):
        found = interpolated(guess.motion, guess.mesh / guess.duration, guess.method, s)
        low, high = problem.durations
        found = found._replace(duration=min(max(guess.duration, low), high))
    else:
        found = guess_of(problem, getattr(guess, "trajectory", guess), s, ends)
    return found if detour is None else detoured(found, detour)


def _theta(problem: Problem, guess: Guess) -> np.ndarray:
    """The free parameters of a plan, if it has the same ones; else their own initial guesses."""
    parameters = problem.parameters
    if parameters is None:
        return np.zeros(0)
    if isinstance(guess, Plan) and set(guess.estimates) == set(parameters.names):
        return np.asarray(parameters.inverse(jnp.asarray([guess.estimates[name] for name in parameters.names])))
    return np.zeros(parameters.size)


def lagrangian_gradient(program: NonlinearProgram, solution: Solution) -> np.ndarray:
    """The derivatives (n,) of cost + multipliers . constraints with respect to the scaled variables."""
    rows, columns = program.jacobian_structure
    products = program.jacobian(solution.z) * solution.multipliers[rows]
    return program.gradient(solution.z) + np.bincount(columns, products, minlength=program.n)


def dual_residual(program: NonlinearProgram, solution: Solution) -> float:
    """The largest violation of the conditions of a minimum, without variables that are fixed."""
    residual = lagrangian_gradient(program, solution) + solution.bound_multipliers
    return float(np.max(np.abs(residual[program.lower < program.upper]), initial=0.0))


def of_bounds(program: NonlinearProgram, solution: Solution) -> np.ndarray:
    """The multipliers (n,) of all bounds. IPOPT omits fixed variables."""
    fixed = program.lower >= program.upper
    return np.where(fixed, -lagrangian_gradient(program, solution), solution.bound_multipliers)


def conflict_of(transcription: Transcription, program: NonlinearProgram, solution: Solution) -> tuple[str, ...]:
    """The bounds, fixed values and constraints with the largest multipliers in the elastic problem, and their times."""
    multipliers, found = of_bounds(program, solution), {}
    motions = transcription.motions(solution.z[: transcription.n] * transcription.x_scale)

    def add(label: str, sizes: np.ndarray, t: np.ndarray) -> None:
        if np.max(sizes) > 0:
            when = dict.fromkeys(f"{x:.3g}" for x in t[sizes > 1e-2 * np.max(sizes)][[0, -1]]) if len(sizes) > 1 else ()
            found[f"{label} ({' to '.join(when)} s)" if when else label] = float(np.sum(sizes))

    for p, (layout, motion) in enumerate(zip(transcription.layouts, motions, strict=True)):
        prefix, t = f"phase {p}: " * (len(motions) > 1), motion.s * motion.duration
        for name, at in layout.by_name.items():
            fixed, x = program.lower[at] >= program.upper[at], multipliers[at]
            for side, sizes in (("lower", -x), ("upper", x)):
                add(f"{prefix}{name} at its {side} bound", np.where(fixed, 0.0, np.maximum(sizes, 0.0)), t)
            for label, k in (("start", 0), ("end", -1)):
                add(f"{prefix}{name} at the {label}", np.abs(x[[k]]) * fixed[k], t)
        for row in transcription.rows:
            if row.phase == p and row.kind != "dynamics":
                add(prefix * (row.kind != "links") + row.name, np.abs(solution.multipliers[row.rows]), t)
    order = sorted(found, key=lambda label: -found[label])
    return tuple(label for label in order if found[label] > 0.01 * found[order[0]])[:8]


def multipliers_of(transcription: Transcription, solution: Solution, p: int) -> Multipliers:
    """See `Multipliers`. The derivative of the cost with respect to a bound is minus the multiplier of the bound."""
    program, layout = transcription.program, transcription.layouts[p]
    by_variable = -of_bounds(program, solution) * program.f_scale / program.x_scale
    by_constraint = -solution.multipliers * program.f_scale / program.g_scale
    values: dict[str, Any] = {name: by_variable[at] for name, at in layout.by_name.items()}
    if layout.duration is not None:
        values["duration"] = float(by_variable[layout.duration])
    for row in transcription.rows:
        if row.phase == p and row.kind != "dynamics":
            name = f"{row.kind}: {row.name}" if row.name in values else row.name
            values[name] = by_constraint[row.rows] if row.rows.size > 1 else float(by_constraint[row.rows[0]])
    return Multipliers(values, costates_of(transcription, solution, p))


def costates_of(transcription: Transcription, solution: Solution, p: int) -> dict[str, np.ndarray]:
    """The derivatives (N + 1,) of the least cost with respect to sudden changes of each state at the ends of intervals.

    The multipliers m_j of an interval are not costates. At its first node, the costate is the derivative of what the
    interval adds to the Lagrangian by the state y_0 there, and at the end of the motion, minus that by the last state:

        p = h b_0 dl/dy_0 + sum_j m_j . (-1 - h A_j0 df/dy_0)

    These are the nodes of the adjoint Lobatto IIIB method (W. Hager, Runge-Kutta methods in optimal control and the
    transformed adjoint system, Numerische Mathematik 87, 2000).
    """
    program, layout, z = transcription.program, transcription.layouts[p], solution.z
    rows = np.stack([row.rows for row in transcription.rows if row.phase == p and row.kind == "dynamics"], axis=-1)
    N, n_y, steps = len(rows), rows.shape[-1], np.diff(layout.mesh)  # rows (N, s - 1, n_y)
    columns = layout.node(np.arange(N + 1) * layout.every)[:, :n_y]
    interval, end, (i, j) = np.full(program.m, -1), np.full(program.n, -2), program.jacobian_structure
    interval[rows], end[columns] = np.arange(N)[:, None, None], np.arange(N + 1)[:, None]
    is_own = (interval[i] == end[j]) | ((interval[i] == N - 1) & (end[j] == N))
    of_rows = np.bincount(j, solution.multipliers[i] * program.jacobian(z) * is_own, minlength=program.n)[columns]
    integral = transcription.gradient_of_integrals(z)[columns]
    shares = np.append(steps, 0.0) / (np.append(steps, 0.0) + np.append(0.0, steps))  # of the interval after a node
    found = shares[:, None] * integral + of_rows
    found[-1] = -integral[-1] - of_rows[-1]
    return dict(zip(layout.problem.names, (found * program.f_scale / program.x_scale[columns]).T, strict=True))


def unmet_of(transcription: Transcription, solution: Solution, p: int, tolerance: float = 1e-6) -> dict[str, float]:
    """The constraints and bounds that are violated, by name, with the largest scaled violation."""
    program, layout = transcription.program, transcription.layouts[p]
    g = program.constraints(solution.z)
    of_rows = np.maximum(program.g_lower - g, g - program.g_upper)
    of_variables = np.maximum(program.lower - solution.z, solution.z - program.upper)
    found = {}
    for row in transcription.rows:
        if row.phase == p:
            label = f"equations of motion of {row.name}" if row.kind == "dynamics" else row.name
            found[label] = max(found.get(label, 0.0), float(np.max(of_rows[row.rows])))
    found |= {f"bounds of {name}": float(np.max(of_variables[at])) for name, at in layout.by_name.items()}
    return {name: x for name, x in found.items() if not x <= tolerance}


def active_of(transcription: Transcription, solution: Solution, p: int) -> tuple[str, ...]:
    """The names of bounds and inequality constraints that are active somewhere. Fixed values are not included."""
    program, layout = transcription.program, transcription.layouts[p]

    def is_active(values: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> dict[str, bool]:
        distances = {"lower": values - lower, "upper": upper - values}
        return {side: bool(np.any((lower < upper) & (x < 1e-6))) for side, x in distances.items()}

    found = []
    for name, at in layout.by_name.items():
        sides = is_active(solution.z[at], program.lower[at], program.upper[at])
        found += [f"{name} at its {side} bound" for side, active in sides.items() if active]
    g = program.constraints(solution.z)
    for row in transcription.rows:
        is_own = row.phase == p and row.kind in ("path", "conditions")
        if is_own and any(is_active(g[row.rows], program.g_lower[row.rows], program.g_upper[row.rows]).values()):
            found.append(row.name)
    return tuple(found)


def _joined(plans: Sequence[Plan]) -> Plan:
    """One plan for all phases, whose trajectory contains them one after another."""
    first, worst = plans[0], min(plans, key=lambda plan: plan.ok)
    parts = [plan.trajectory for plan in plans if plan.trajectory is not None]
    trajectory = _concatenated(parts) if len({part.names for part in parts}) == 1 else None
    offsets = np.cumsum([0.0, *(plan.duration for plan in plans)])
    meshes = [plan.mesh + offset for plan, offset in zip(plans, offsets)]
    mesh = np.concatenate([meshes[0], *(mesh[1:] for mesh in meshes[1:])])
    errors = None if first.errors is None else np.concatenate([plan.errors for plan in plans])  # type: ignore[misc]
    active = tuple(f"phase {i}: {name}" for i, plan in enumerate(plans) for name in plan.active)

    def named(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        return {f"phase {i}: {k}": x for i, part in enumerate(parts) for k, x in part.items()}

    unmet, of_plans = named([plan.unmet for plan in plans]), [plan.multipliers for plan in plans]
    multipliers = Multipliers(named(of_plans), named([each.costate for each in of_plans]))
    return dataclasses.replace(
        first, duration=float(offsets[-1]), trajectory=trajectory, mesh=mesh, errors=errors, unmet=unmet, active=active,
        multipliers=multipliers, phases=tuple(plans), ok=worst.ok, reason=worst.reason,
    )  # fmt: skip


def _concatenated(parts: Sequence[Trajectory]) -> Trajectory:
    t, offset = [], 0.0
    for part in parts:
        t.append(part.t + offset)
        offset += float(part.t[-1])
    last = parts[-1]
    rows = {name: jnp.concatenate([getattr(part, name) for part in parts]) for name in ("q", "u", "u_dep", "x")}
    by_name = {
        name: {k: jnp.concatenate([getattr(part, name)[k] for part in parts]) for k in getattr(last, name)}
        for name in ("inputs", "outputs")
    }
    return dataclasses.replace(last, t=jnp.concatenate(t), t_end=jnp.asarray(offset), **rows, **by_name)
