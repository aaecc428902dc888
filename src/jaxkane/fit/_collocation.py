"""`Collocation`: a fit by direct collocation, its result, its covariances, and the marginal likelihood.

At the minimum of half a sum of squares with the linearized constraints J dx = 0, the covariance of the variables x is
the upper left block of the inverse of the matrix of Karush, Kuhn and Tucker

    [ H  J^T ]
    [ J   0  ]

with the Hessian H of the Lagrangian (Y. Bard, Nonlinear Parameter Estimation, 1974, section 7-6). The variables of the
nodes are eliminated first. In the order of time this part of the matrix is banded, and LAPACK factorizes it in a
fraction of a second. SuperLU took 40 to 90 s for 23 000 variables: the parameters occur in all equations.

If inputs are unknown, the estimate of all unknowns together is biased: for unknown inputs w with few measurements each,
the most probable (w, parameters) is not near the most probable parameters. With Laplace's approximation of the integral
over w,

    -2 log p(parameters) = min_w cost(w, parameters) + log det (Hessian of half the cost by w) + constant

(for a linear system with normal noise this is exact and equals the likelihood of a Kalman filter). The Hessian is the
one with all states as functions of w and the initial state, so that its determinant is that of the matrix above divided
by det(dg/dy)^2, where y are the states that the equations g determine.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, Float, PyTree

from .._collocate.functions import bounds_of
from .._collocate.lobatto import lobatto
from .._collocate.program import NonlinearProgram
from .._collocate.solvers import (
    INTERRUPTED,
    TIME_IS_UP,
    BandedFactors,
    Effort,
    Solution,
    banded_order,
    casadi,
    minimum,
)
from .._collocate.transcription import Layout, Transcription
from .._common.lookup import positive_number, refuse_unknown
from .._integrate.jumps import refuse_jumps
from .._scalarjit.cache_key import jit
from .._system.system import System
from ._collocation_phases import TrialPhase, TrialVariables, add_squares, guessed
from .problem.declarations import Items
from .problem.problem import Problem
from .problem.specification import ProblemSpec
from .problem.trial import Trial, trial_names
from .problem.windows import state_names
from .result.data import Estimates, parameter_rows, text_table
from .result.statistics import intervals, t_quantile


class Kkt:
    """The matrix at a point, without variables that are fixed or at a bound.

    **Arguments:**

    - `program`: the nonlinear program. Its cost is a sum of squares, of which minus the log density is half.
    - `border`: the variables that are eliminated last: parameters.
    - `z` (n,), `multipliers` (n_g,): the point, in scaled numbers.
    """

    def __init__(self, program: NonlinearProgram, border: np.ndarray, z: np.ndarray, multipliers: np.ndarray):
        self.program = program
        is_free = (z - program.lower > 1e-7) & (program.upper - z > 1e-7)
        self.inner, self.border = np.setdiff1d(np.flatnonzero(is_free), border), border[is_free[border]]
        # Half of the cost, in its own unit, so that the matrix is the curvature of minus the log density.
        H = 0.5 * program.f_scale * program.hessian_matrix(z, multipliers)
        J = program.jacobian_matrix(z)
        inner, border = self.inner, self.border
        K = scipy.sparse.bmat([[H[inner][:, inner], J[:, inner].T], [J[:, inner], None]], format="csr")
        order = banded_order(K, program.places[inner])
        self.factors = BandedFactors(K, order, order)
        self.coupling = np.concatenate([H[inner][:, border].toarray(), J[:, border].toarray()])
        self.solved = self.factors.solve(self.coupling)
        self.schur = H[border][:, border].toarray() - self.coupling.T @ self.solved
        self.J = J

    def covariance(self, variables: np.ndarray) -> np.ndarray:
        """The covariance of some variables of the border, in their own units.

        It is zero for fixed variables, and NaN if the data do not determine the variables.
        """
        place = np.full(self.program.n, -1)
        place[self.border] = np.arange(len(self.border))
        own, scale = place[variables], self.program.x_scale[variables]
        result = inverse(self.schur)[np.ix_(own, own)] * np.outer(scale, scale)
        return np.where((own[:, None] < 0) | (own < 0), 0.0, result)


def inverse(information: np.ndarray) -> np.ndarray:
    """The inverse of a positive-definite matrix; NaN if it is not positive definite."""
    if not information.size:
        return information
    size = np.sqrt(np.abs(np.diag(information)))
    scaled = information / np.outer(size, size)
    if not np.all(np.isfinite(scaled)) or np.linalg.eigvalsh(scaled)[0] < 1e-12:
        return np.full_like(information, np.nan)
    return np.linalg.inv(scaled) / np.outer(size, size)


class Point(NamedTuple):
    """The most probable motion for some parameters.

    - `z` (n,), `multipliers` (n_g,): scaled variables and multipliers.
    - `value`: -2 log p.
    - `slopes` (n, p): derivatives of z by the scaled parameters, or None.
    """

    z: np.ndarray
    multipliers: np.ndarray
    value: float
    slopes: np.ndarray | None


@dataclasses.dataclass(frozen=True)
class Marginal:
    """-2 log p as a function of the shared parameters.

    - `transcription`: the nonlinear program.
    - `shared`: the indices of the shared parameters. `local`: those of the unknowns of trials.
    """

    transcription: Transcription
    shared: np.ndarray
    local: np.ndarray

    def at(self, theta: np.ndarray, start: Point) -> Point:
        """The value at scaled parameters theta (p,), by Newton's method from a motion for similar parameters."""
        program, half = self.transcription.program, 0.5 * self.transcription.program.f_scale
        z, multipliers = start.z.copy(), start.multipliers
        if start.slopes is not None:  # to first order
            z += start.slopes @ (theta - z[self.shared])
        z[self.shared] = theta
        for _ in range(_NEWTON):
            kkt = self._kkt(z, multipliers)
            is_local = np.isin(kkt.border, self.local)
            S = kkt.schur[np.ix_(is_local, is_local)]
            g, gradient = program.constraints(z), half * program.gradient(z)
            right = -np.concatenate([gradient[kkt.inner], g - np.clip(g, program.g_lower, program.g_upper)])
            step = kkt.factors.solve(right[:, None])[:, 0]
            change = np.linalg.solve(S, -gradient[kkt.border][is_local] - kkt.coupling[:, is_local].T @ step)
            step = step - kkt.solved[:, is_local] @ change
            n = len(kkt.inner)
            z[kkt.border[is_local]] += change
            z[kkt.inner] += step[:n]
            multipliers = step[n:] / half
            if np.max(np.abs(step[:n])) < 1e-6:
                break
        value = program.objective(z) * program.f_scale + kkt.factors.log_determinant
        for p, layout in enumerate(self.transcription.layouts):  # log |det dg/dy|
            rows, columns = determined(self.transcription, p, layout)
            order = np.arange(len(rows))
            value -= 2.0 * BandedFactors(kkt.J[rows][:, columns], order, order).log_determinant
        value += float(np.linalg.slogdet(S)[1])
        # the derivatives of the motion by the shared parameters that are not fixed
        slopes, free = np.zeros((program.n, len(self.shared))), np.isin(self.shared, kkt.border)
        is_shared = np.logical_not(is_local)
        of_local = -np.linalg.solve(S, kkt.schur[np.ix_(is_local, is_shared)])
        slopes[np.ix_(kkt.border[is_local], free)] = of_local
        slopes[np.ix_(kkt.inner, free)] = -(kkt.solved[:, is_shared] + kkt.solved[:, is_local] @ of_local)[:n]
        return Point(z, multipliers, value, slopes)

    def _kkt(self, z: np.ndarray, multipliers: np.ndarray) -> Kkt:
        border = np.concatenate([self.shared, self.local]).astype(int)
        return Kkt(self.transcription.program, border, z, multipliers)

    def minimum(self, solution: Solution, effort: Effort) -> tuple[Point, np.ndarray, bool]:
        """The most probable parameters, by Newton's method with a trust region.

        The gradient and the matrix of second derivatives are differences of values.

        **Arguments:**

        - `solution`: the most probable motion for the initial guess of the parameters.
        - `effort`: its time is compared with the time after each step.

        **Returns:** the point, the covariance (p, p) of the scaled parameters, NaN if the curvature is not positive
        definite, and whether the search converged.
        """
        now = self.at(solution.z[self.shared], Point(solution.z, solution.multipliers, np.inf, None))
        radius, ok = _FIRST, False
        gradient, curvature, width = self._quadratic(now)
        for k in range(_STEPS):
            effort.show(f"step {k} of the parameters: -2 log likelihood {now.value:.8g}")
            # the Newton step, with positive curvature, whose largest component is at most `radius`
            values, vectors = np.linalg.eigh(curvature * np.outer(width, width))
            sizes = np.maximum(np.abs(values), 1e-6 * np.max(np.abs(values), initial=1e-12))
            step = -width * (vectors @ ((vectors.T @ (width * gradient)) / sizes))
            step *= min(1.0, radius / max(float(np.max(np.abs(step))), 1e-300))
            predicted, ratio, new = gradient @ step + 0.5 * step @ curvature @ step, -1.0, None
            with np.errstate(all="ignore"), contextlib.suppress(np.linalg.LinAlgError, ValueError):
                new = self.at(now.z[self.shared] + step, now)
            if new is not None and np.isfinite(new.value):
                ratio = (new.value - now.value) / min(predicted, -1e-300)
                if ratio > 0.05 or abs(new.value - now.value) < 1e-6:
                    now, (gradient, curvature, width) = new, self._quadratic(new)
            radius = 2.0 * radius if ratio > 0.75 else 0.4 * radius if ratio < 0.25 else radius
            ok = bool(np.max(np.abs(step) / width) < 0.1)  # of a width, which is a third of a standard error
            if ok or radius < 1e-6 or effort.is_over:
                break
        return now, inverse(0.5 * curvature), ok

    def _quadratic(self, now: Point) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Gradient (p,) and curvature (p, p) at a point, by differences over the widths (p,): a third of a standard
        error."""
        p, theta = len(self.shared), now.z[self.shared]
        information = np.abs(np.diag(self._kkt(now.z, now.multipliers).schur)[:p])
        width = np.minimum(0.3 / np.sqrt(np.maximum(information, 1e-300)), _WIDEST)
        h = np.diag(width)

        def value(v: np.ndarray) -> float:
            return self.at(theta + v, now).value

        above, below = ([value(sign * v) for v in h] for sign in (1, -1))
        curvature = np.diag((np.array(above) + below - 2 * now.value) / width**2)
        for i in range(p):
            for j in range(i):
                both = value(h[i] + h[j]) - above[i] - above[j] + now.value
                curvature[i, j] = curvature[j, i] = both / (width[i] * width[j])
        return (np.array(above) - below) / (2 * width), curvature, width


_NEWTON = 8  # iterations for the motion
_STEPS = 30  # for the parameters
_WIDEST = 0.02  # of a typical change of a parameter
_FIRST = 0.3  # the first radius of the trust region, in the same unit


def determined(transcription: Transcription, p: int, layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """The equations of a phase, and as many states: dependent coordinates at the start, then all later states."""
    n_y, names = layout.variables.n_y, layout.problem.names
    first = [names.index(c) for c in layout.problem.system.dependent_coordinates]
    constraints = [row.rows for row in transcription.rows if row.phase == p and row.kind == "conditions"]
    first = first[: sum(map(len, constraints))]
    dynamics = np.stack([row.rows for row in transcription.rows if row.phase == p and row.kind == "dynamics"], axis=-1)
    columns = np.concatenate([layout.node(0)[first], layout.node(np.arange(1, layout.K))[:, :n_y].ravel()])
    rows = np.concatenate([*constraints, dynamics.ravel()]).astype(int)
    return rows, columns.astype(int)


@dataclasses.dataclass(frozen=True)
class Collocation:
    """Fit by direct collocation instead of simulation. The states at all samples are unknowns.

        jk.fit.fit(bicycle, trials, free, unknown=states, transcription=jk.fit.Collocation(
            unknown_inputs={"roll_torque": 4.0}, within={"roll": (-0.5, 0.5)}))

    The equations of motion are constraints, so a motion may be unstable and long. An unknown input w is also estimated,
    as a function of time. Its prior is white noise of a given spectral density S, so the cost contains the integral of
    w^2 / S. If there are unknown inputs, they are integrated out, and the parameters maximize the marginal likelihood.

    Omit `transcription`, or use `window`, if all inputs are recorded: both are faster.

    **Arguments:**

    - `intervals_per_sample`: the number of intervals of the mesh between two samples.
    - `unknown_inputs`: a dict by name of the spectral densities [unit^2 s] of inputs that were not recorded. If an
        input was recorded too, it is the sum of its record and the unknown part.
    - `within`: a dict by name of (lower, upper), for states and unknown inputs at all nodes. None means no bound.
    - `method`: "trapezoid", "hermite-simpson" or "lobatto".
    - `max_iterations`: the largest number of iterations of IPOPT.
    - `max_seconds`: the longest time [s], or None. The result is then the best one so far.
    """

    intervals_per_sample: int = 1
    unknown_inputs: Mapping[str, float] = dataclasses.field(default_factory=dict)
    within: Mapping[str, tuple[float | None, float | None]] = dataclasses.field(default_factory=dict)
    method: str = "hermite-simpson"
    max_iterations: int = 500
    max_seconds: float | None = None

    def __post_init__(self) -> None:
        n = self.intervals_per_sample
        if isinstance(n, bool) or not isinstance(n, int) or n < 1:
            raise ValueError(f"Collocation: `intervals_per_sample` must be a positive integer, got {n!r}.")
        for name in ("unknown_inputs", "within"):
            if not isinstance(getattr(self, name), Mapping):
                raise TypeError(f"Collocation: `{name}` must be a dict by name, got {getattr(self, name)!r}.")
        lobatto(self.method)
        if self.max_seconds is not None:
            positive_number(self.max_seconds, "Collocation: `max_seconds`")

    def fit(
        self,
        system: System,
        trials: Sequence[Trial] | Trial,
        free: Items,
        *,
        progress: bool = False,
        **options: Any,
    ) -> CollocationFit:
        """Fit by collocation. The arguments are those of `jaxkane.fit.fit`."""
        for name, reason in _NOT_SUPPORTED.items():
            if options.get(name):
                raise ValueError(f"`{name}` cannot be used with `transcription=Collocation()`. {reason}. Omit it.")
        problem = Problem.with_first_steps(ProblemSpec(system, free, **options), trials)
        _check_problem(problem)
        casadi()
        with Effort(self.max_iterations, self.max_seconds, progress) as effort:
            return solved(problem, self, effort)


_NOT_SUPPORTED = {
    "window": "Collocation has no windows",
    "defect_std": "Pass `unknown_inputs` for disturbances",
    "noise": "Pass `unknown_inputs` for disturbances",
    "errors": "Collocation supports independent normal errors only",
    "zero_order_hold": "Collocation needs continuous inputs",
    "simulation": "Collocation does not simulate",
}


def _check_problem(problem: Problem) -> None:
    supported = [f"{kind} of {of}" for kind in ("gain", "offset") for of in ("sensor", "input")] + ["delay of input"]
    entries = (*problem.parameters.all_entries, *problem.model.nuisance.trial)
    for kind, name in (role for entry in entries for role in entry.roles if role[0] not in supported):
        remedy = (
            f"Omit it, and add {name!r} to `unknown`."
            if kind.endswith("start")
            else "It compares measurements with the states at the same time. Use windows instead, or add the sensor's "
            "dynamics to the system as a state."
        )
        raise ValueError(f"Collocation does not support the {kind} {name}. {remedy}")
    refuse_jumps(problem.system, "Collocation", "Its motions are smooth. Omit `transcription`.")
    for is_wrong, reason in (
        (problem.model.nuisance.window, "has no windows: each='window' cannot be used. Pass each='trial'."),
        (problem.parameters.distributions, "does not support distributions over groups. Pass prior=(mean, deviation)."),
        (jnp.result_type(float) != jnp.float64, "needs float64. Call jaxkane.configure() first."),
    ):
        if is_wrong:
            raise ValueError(f"Collocation {reason}")


def solved(problem: Problem, how: Collocation, effort: Effort) -> CollocationFit:
    system, name = problem.system, type(problem.system).__name__
    refuse_unknown(how.unknown_inputs, system.inputs, f"`unknown_inputs`: {name} has no input", "it has")
    densities = {k: positive_number(v, f"`unknown_inputs` of {k!r}") for k, v in how.unknown_inputs.items()}
    refuse_unknown(
        how.within, (*state_names(system), *densities), f"`within`: {name} has no state or unknown input", "it has"
    )
    within = {k: bounds_of(f"`within` of {k!r}", value) for k, value in how.within.items()}
    method = lobatto(how.method)
    phases = [TrialPhase(problem, k, densities, within) for k in range(len(problem.slices))]
    meshes = [phase.mesh(how.intervals_per_sample) for phase in phases]
    motions = [guessed(phase, mesh, method) for phase, mesh in zip(phases, meshes, strict=True)]
    every = how.intervals_per_sample * (len(method.c) - 1)
    objectives = functools.partial(add_squares, problem, jnp.asarray([*densities.values()], float), every)
    theta = np.zeros(problem.parameters.size)
    transcription = Transcription(phases, (), meshes, method, motions, theta, objectives)
    program = transcription.program
    shared, local = transcription.shared_parameters, transcription.local_parameters
    if densities:  # first the motion for the initial guess of the parameters
        program = with_fixed(program, shared, transcription.z)
    solution = minimum(program, transcription.z, transcription.shared, effort)
    if densities and solution.ok:
        point, covariance, ok = Marginal(transcription, shared, local).minimum(solution, effort)
        status = "the largest number of steps of the parameters was reached"
        status = solution.status if ok else TIME_IS_UP if effort.is_over else status
        solution = dataclasses.replace(solution, z=point.z, multipliers=point.multipliers, ok=ok, status=status)
    else:
        covariance = np.full((len(shared),) * 2, np.nan)  # if it does not exist
        with contextlib.suppress(np.linalg.LinAlgError):
            border = np.concatenate([shared, local])
            covariance = Kkt(transcription.program, border, solution.z, solution.multipliers).covariance(shared)
    return CollocationFit(problem, how, transcription, solution, covariance)


def with_fixed(program: NonlinearProgram, variables: np.ndarray, z: np.ndarray) -> NonlinearProgram:
    """The same program, but with some variables fixed at their values in z (n,), in scaled numbers."""
    changed = copy.copy(program)
    changed.lower, changed.upper = program.lower.copy(), program.upper.copy()
    changed.lower[variables] = changed.upper[variables] = z[variables]
    return changed


@dataclasses.dataclass(frozen=True, repr=False)
class CollocationFit(Estimates):
    """The result of a fit by collocation.

    Attributes:

    - `estimates`: estimates by name, including gains, offsets and delays of inputs.
    - `start`: initial guesses by name.
    - `standard_errors`: standard errors by name. They are computed from the inverse of the matrix of Karush, Kuhn and
        Tucker, and with unknown inputs from the curvature of the marginal likelihood. `sigma` and the spectral
        densities are used as given.
    - `intervals(level)`: confidence intervals by name.
    - `covariance`, `correlation` (p, p): of the estimates, in the order of `names`.
    - `system`: the system with the estimates.
    - `cost`: the sum of three parts: the squared residuals, the squares of the priors, and the integrals of the squared
        unknown inputs divided by their spectral densities.
    - `residuals`: (fitted - measured) / sigma (n_t,), by trial and channel.
    - `fitted`: the fitted measurements (n_t,), by trial and channel.
    - `motions`: the estimated states and inputs at the samples (n_t,), by trial and name.
        All three are NaN at the first samples that `Delay(bounds=...)` excludes.
    - `status`, `message`: why the search ended, as a word and as a sentence.
    - `ok`: whether the search converged and the data determine all parameters. The error of the mesh is not checked:
        increase `intervals_per_sample` until the estimates do not change.
    """

    problem: Problem
    transcription_options: Collocation
    transcription: Transcription
    solution: Solution
    scaled_covariance: np.ndarray

    @property
    def status(self) -> str:
        if self.solution.ok:
            return "converged" if np.all(np.isfinite(self.covariance)) else "undetermined"
        return "interrupted" if self.solution.status == INTERRUPTED else "failed"

    @property
    def ok(self) -> bool:
        return self.status == "converged"

    @property
    def message(self) -> str:
        return {
            "converged": "The search converged.",
            "undetermined": "The search converged, but the data do not determine all parameters.",
            "interrupted": "The search was interrupted.",
            "failed": f"The search ended early: {self.solution.status}.",
        }[self.status]

    @functools.cached_property
    def _x(self) -> np.ndarray:
        return self.solution.z * self.transcription.x_scale

    @property
    def _theta(self) -> np.ndarray:
        return self.transcription.theta(self._x)

    @property
    def cost(self) -> float:
        return self.transcription.program.objective(self.solution.z) * self.transcription.program.f_scale

    @property
    def mean_square(self) -> float:
        """The cost divided by the number of measurements; about one if `sigma` and the spectral densities are right.

        It is also about one if a wrong parameter, such as a free mass, can compensate for wrong ones.
        """
        return self.cost / self._n_measured

    @property
    def _n_measured(self) -> int:
        return int(np.count_nonzero(np.asarray(self.problem.windows.weight) > 0))

    @property
    def notes(self) -> tuple[str, ...]:
        """Warnings as sentences."""
        n = self._n_measured
        if abs(self.cost - n) < 5.0 * np.sqrt(2.0 * n):
            return ()
        densities = " and the spectral densities of `unknown_inputs`" * bool(self.transcription_options.unknown_inputs)
        return (
            f"The mean square is {self.mean_square:.3g} instead of about 1, so the estimates and intervals cannot be "
            f"trusted. Check `sigma`{densities}.",
        )

    @property
    def estimates(self) -> dict[str, float]:
        return self._by_name(self.parameters.values(jnp.asarray(self._theta)))

    @functools.cached_property
    def system(self) -> System:
        """The system with the estimates. Parameters of groups keep their initial values."""
        return self.parameters.apply(self.problem.system, jnp.asarray(self._theta))[0]

    @functools.cached_property
    def covariance(self) -> np.ndarray:
        """The covariance (p, p) of the estimates; NaN if the data do not determine a parameter."""
        slopes = np.asarray(self.parameters.slopes(jnp.asarray(self._theta)))
        return slopes @ self.scaled_covariance @ slopes.T

    errors = Estimates.standard_errors

    @property
    def error_kinds(self) -> dict[str, str]:
        return dict.fromkeys(self.names, "formal")

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Confidence intervals by name, truncated at the bounds of the parameters."""
        half_widths = t_quantile(level, np.inf) * np.array([*self.standard_errors.values()])
        return intervals(self.parameters, self._theta, half_widths)

    @functools.cached_property
    def _at_samples(self) -> list[tuple[Trial, dict[str, np.ndarray], dict[str, np.ndarray]]]:
        """For each trial, states and inputs by name, and fitted measurements by channel. NaN before the window."""
        every = self.transcription_options.intervals_per_sample * (len(self.transcription.method.c) - 1)
        found, motions = [], self.transcription.motions(self._x)
        for (k, first, _), layout, motion in zip(self.problem.slices, self.transcription.layouts, motions, strict=True):
            places = np.arange(0, layout.K, every)
            data = layout.node_data(layout.s[places])
            read, inputs = _read(layout.variables, data, jnp.asarray(self._x[layout.columns[places]]))
            values = dict(zip(layout.problem.names, motion.Y[places].T, strict=True)) | inputs
            both = values, dict(zip(self.problem.channels, np.asarray(read).T, strict=True))
            before = np.full(first, np.nan)
            both = ({name: np.append(before, x) for name, x in each.items()} for each in both)
            found.append((self.problem.trials[k], *both))
        return found

    def _by_trial(self, values: Sequence[dict[str, Any]]) -> dict[str, dict[str, Any]]:
        names = trial_names(self.problem.trials)
        return {names[k]: value for (k, _, _), value in zip(self.problem.slices, values, strict=True)}

    @property
    def motions(self) -> dict[str, dict[str, np.ndarray]]:
        return self._by_trial([values for _, values, _ in self._at_samples])

    @property
    def fitted(self) -> dict[str, dict[str, np.ndarray]]:
        return self._by_trial([read for _, _, read in self._at_samples])

    @property
    def residuals(self) -> dict[str, dict[str, np.ndarray]]:
        return self._by_trial(
            [{c: (y[c] - x) / trial.sigma[c] for c, x in trial.measured.items()} for trial, _, y in self._at_samples]
        )

    def nuisance(self) -> dict[str, dict[str, float]]:
        """The estimates that belong to one trial only, by trial and name."""
        model, n = self.problem.model.nuisance, self.parameters.size
        values = [model.trial_center + self._x[layout.parameters[n:]] for layout in self.transcription.layouts]
        return self._by_trial([dict(zip(model.trial_names, np.asarray(x).tolist(), strict=True)) for x in values])

    def __repr__(self) -> str:
        head = f"{self.problem.title}. By collocation: {self.message} Cost {self.cost:.6g}."
        return "\n".join([head, *self.notes, text_table(parameter_rows(self), left=(0, 1))])


@jit
def _read(variables: TrialVariables, data: PyTree, x: Float[Array, "K n"]) -> Any:
    def at(node: PyTree, x: Float[Array, " n"]) -> Any:
        now = variables.now(node, x)
        _, calibration = variables.parameters.apply(variables.system, x[variables.n_z :])
        inputs = {name: now[name] for name in variables.system.inputs}
        return variables.model.as_read([now[c] for c in variables.model.channels], calibration), inputs

    return jax.vmap(at)(data, x)
