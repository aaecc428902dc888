"""`Collocation`: the transcription of a fit by direct collocation, and its result."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..._collocate.functions import bounds_of
from ..._collocate.lobatto import lobatto
from ..._collocate.program import NonlinearProgram
from ..._collocate.solvers import INTERRUPTED, Solution, Solver, default_solver, refused_unless_minimum, run
from ..._collocate.transcription import Transcription
from ..._common.lookup import positive_number, refuse_unknown
from ..._integrate.jumps import refuse_jumps
from ..._scalarjit.cache_key import jit
from ..._system.system import System
from ..problem.declarations import Items
from ..problem.parameters import Parameters
from ..problem.problem import Problem
from ..problem.specification import ProblemSpec
from ..problem.trial import Trial, trial_names
from ..problem.windows import state_names
from ..result.statistics import intervals, t_quantile
from ..result.tables import parameter_rows, text_table
from ._marginal import Kkt, Marginal
from ._phases import TrialPhase, add_squares, guessed


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
    - `solver`: a solver of `jaxkane.collocation`; by default the first one that is installed.
    - `max_iterations`: the largest number of iterations.
    """

    intervals_per_sample: int = 1
    unknown_inputs: Mapping[str, float] = dataclasses.field(default_factory=dict)
    within: Mapping[str, tuple[float | None, float | None]] = dataclasses.field(default_factory=dict)
    method: str = "hermite-simpson"
    solver: Solver | None = None
    max_iterations: int = 500

    def __post_init__(self) -> None:
        n = self.intervals_per_sample
        if isinstance(n, bool) or not isinstance(n, int) or n < 1:
            raise ValueError(f"Collocation: `intervals_per_sample` must be a positive integer, got {n!r}.")
        for name in ("unknown_inputs", "within"):
            if not isinstance(getattr(self, name), Mapping):
                raise TypeError(f"Collocation: `{name}` must be a dict by name, got {getattr(self, name)!r}.")
        lobatto(self.method)

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
        return solved(problem, self, progress)


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


def solved(problem: Problem, how: Collocation, progress: bool) -> CollocationFit:
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
    solver = default_solver() if how.solver is None else how.solver
    shared, local = transcription.shared_parameters, transcription.local_parameters
    if densities:  # first the motion for the initial guess of the parameters
        program = with_fixed(program, shared, transcription.z)
    solution = run(solver, program, transcription.z, progress=progress, max_iterations=how.max_iterations)
    solution = refused_unless_minimum(program, transcription.shared, solution)
    if densities and solution.ok:
        point, covariance, ok = Marginal(transcription, shared, local).minimum(solution)
        status = solution.status if ok else "the largest number of steps of the parameters was reached"
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
class CollocationFit:
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
    def parameters(self) -> Parameters:
        return self.problem.parameters

    @property
    def names(self) -> tuple[str, ...]:
        return self.parameters.names

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
        """The cost divided by the number of measurements; about one if `sigma` and the spectral densities are right."""
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

    @property
    def start(self) -> dict[str, float]:
        return self._by_name(self.parameters.start)

    def _by_name(self, values: Any) -> dict[str, float]:
        return dict(zip(self.names, np.asarray(values, float).tolist(), strict=True))

    @functools.cached_property
    def system(self) -> System:
        """The system with the estimates. Parameters of groups keep their initial values."""
        return self.parameters.apply(self.problem.system, jnp.asarray(self._theta))[0]

    @functools.cached_property
    def covariance(self) -> np.ndarray:
        """The covariance (p, p) of the estimates; NaN if the data do not determine a parameter."""
        slopes = np.asarray(self.parameters.slopes(jnp.asarray(self._theta)))
        return slopes @ self.scaled_covariance @ slopes.T

    @property
    def standard_errors(self) -> dict[str, float]:
        return self._by_name(np.sqrt(np.diag(self.covariance)))

    errors = standard_errors

    @property
    def error_kinds(self) -> dict[str, str]:
        return dict.fromkeys(self.names, "formal")

    @property
    def correlation(self) -> np.ndarray:
        deviation = np.sqrt(np.diag(self.covariance))
        return self.covariance / np.outer(deviation, deviation)

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
def _read(variables: Any, data: Any, x: Any) -> Any:
    def at(node: Any, x: Any) -> Any:
        now = variables.now(node, x)
        _, calibration = variables.parameters.apply(variables.system, x[variables.n_z :])
        inputs = {name: now[name] for name in variables.system.inputs}
        return variables.model.as_read([now[c] for c in variables.model.channels], calibration), inputs

    return jax.vmap(at)(data, x)
