"""Optimal control problems: a system, its controls, the cost and the constraints; initial guesses of their motions."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._collocate.functions import Bound, Condition, Node, Now, Variables, bounds_of
from .._collocate.transcription import Motion, PhaseProblem
from .._common.lookup import as_names, real_number, refuse_unknown
from .._integrate.inputs import as_signals, is_samples
from .._integrate.jumps import names_of_jumps
from .._integrate.simulate import as_state
from .._integrate.trajectory import Trajectory
from .._kane.arguments import check_is_system, is_concrete, refuse_multipliers
from .._kane.checks import check_system
from .._kane.consistent_state import assemble
from .._kane.constraint_residuals import check_state, configuration_residual, projected
from .._kane.contact.forces import has_contacts
from .._kane.right_hand_side import output_names, vector_field
from .._scalarjit.cache_key import captured_tracers, jit
from .._scalarjit.compat import without_tangents
from .._scalarjit.components import Numbers
from .._system.parameters import in_batches
from .._system.system import State, System, packed, units_of
from ..fit.problem.parameters import Parameters
from ..fit.problem.specification import parameters_of

Values = Mapping[str, Condition] | State


@dataclasses.dataclass(frozen=True)
class Problem(PhaseProblem):
    """Find the controls of a motion of least cost, and optionally its duration and parameters of the system.

        problem = jk.collocation.Problem(
            bicycle, 3.0,
            controls={"steer_torque": (-10.0, 10.0)},
            cost=lambda t, now: now["steer_torque"] ** 2,
            start=jk.assemble(bicycle, {}, {"rear_wheel_rate": -20.0}),
            end={"y": 1.5, "roll": 0.0, "steer": 0.0, "yaw": 0.0, "roll_rate": 0.0, "steer_rate": 0.0},
        )
        plan = jk.collocation.solve(problem)

    The time starts at 0. In costs and constraints, `now["roll"]` is the value of any coordinate, speed, dependent
    speed, first-order state, input or output. `now.system` is the system with the current parameters (see `Now`).
    Bounds and path constraints hold at the nodes. If a control jumps from one bound to the other, it may exceed its
    bounds between the nodes.

    **Arguments:**

    - `system`: a `System` without contacts.
    - `duration`: the duration [s], or (least, greatest) if it is free.
    - `controls`: the inputs to find: a dict by name of (lower, upper) or None, or a sequence of names. None means no
        bound, also for `lower` or `upper` alone.
    - `cost`: a function (t, now) -> number. The integral of this number over time is minimized.
    - `final_cost`: a function (t, now) -> number. Its value at the end is added to the cost. For the shortest time,
        pass `lambda t, now: t`.
    - `start`, `end`: a `State`, or a dict by name. Each value is a number or (lower, upper). Names that are left out
        are free. Dependent speeds and outputs are also allowed. If `end` is a `State`, the dependent coordinates remain
        free, because the configuration constraints determine them.
    - `conditions`: a function (first, last, duration) -> dict by name. Each value is a number that must be zero, or
        (number, lower, upper). An example is {"periodic": last["roll"] - first["roll"]}.
    - `within`: a dict by name of (lower, upper), for the whole motion.
    - `path`: a function (t, now) -> dict by name, for the whole motion. Each value is a number that must not be
        negative, or (number, lower, upper).
    - `free`: parameters of the system to optimize: names, `jk.fit.Free` or `jk.fit.Inertia`, as in `jk.fit.fit`.
    - `inputs`: the inputs that are not controls, as in `simulate`: numbers, `Samples`, functions of (t, state). They
        must be continuous.

    **Raises:** `ValueError` and `TypeError` that name the argument.
    """

    system: System
    duration: float | tuple[float, float]
    _: dataclasses.KW_ONLY
    controls: Mapping[str, tuple[float | None, float | None] | None] | Sequence[str]
    cost: Callable[[Any, Now], Any] | None = None
    final_cost: Callable[[Any, Now], Any] | None = None
    start: Values | None = None
    end: Values | None = None
    conditions: Callable[[Now, Now, Any], Any] | None = None
    within: Mapping[str, tuple[float | None, float | None]] | None = None
    path: Callable[[Any, Now], Any] | None = None
    free: Any = ()
    inputs: Any = None
    concrete: Problem | None = dataclasses.field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        system = self.system
        check_is_system(system)
        self._check_tracers()
        if not is_concrete(system) and is_concrete(known := without_tangents(system)):
            # `solve` solves this problem, and adds the derivatives by the traced numbers to its plan.
            object.__setattr__(self, "concrete", dataclasses.replace(self, system=known))
            return
        self._check_system()
        for name in ("cost", "final_cost", "conditions", "path"):
            f = getattr(self, name)
            if f is not None and not callable(f):
                raise TypeError(f"Problem: `{name}` must be a function, got {f!r}.")
        shortest, longest = self.durations
        if shortest < 0 or not 0 < longest < math.inf:
            raise ValueError(
                f"Problem: `duration` must be a positive number of seconds, or (least, greatest) with "
                f"0 <= least < greatest; got {self.duration!r}."
            )
        controls = self.bounds_of_controls
        refuse_unknown(controls, system.inputs, f"Problem: {self.title} has no input", "it has")
        if not callable(self.inputs) and (both := controls.keys() & (self.inputs or {})):
            raise ValueError(f"Problem: {', '.join(both)} is in `controls` and in `inputs`. Omit it in one of them.")
        self._check_names()
        self.signals  # noqa: B018  raises an exception for wrong inputs
        self.parameters  # noqa: B018  the same for parameters

    def _check_tracers(self) -> None:
        for name in ("cost", "final_cost", "conditions", "path", "start", "end", "duration", "inputs"):
            value = getattr(self, name)
            if not is_concrete(value) or captured_tracers(value):
                raise TypeError(
                    f"Problem: `{name}` uses a traced number, but only `system` may. In functions, use `now.system`. "
                    "`plan.multipliers` and `plan.sensitivities` contain other derivatives."
                )

    def _check_system(self) -> None:
        system, leaves = self.system, jax.tree.leaves(self.system)
        refuse_multipliers(system)
        for is_wrong, reason in (
            (
                has_contacts(system),
                "has contacts, which change their state at unknown times. Describe the motion between two changes by a "
                "system without contacts, and link such phases (`Phases`).",
            ),
            (in_batches(system), "is a batch. Pass one member of it."),
            (
                not is_concrete(system),
                "is traced. Call this outside of jax.jit and vmap. For derivatives, use jax.jacfwd or jax.grad without "
                "them, or `plan.sensitivities`.",
            ),
            (
                jnp.result_type(float) != jnp.float64 or any(getattr(x, "dtype", None) == jnp.float32 for x in leaves),
                "needs float64 for collocation. Call jaxkane.configure() first, and create the system after it.",
            ),
        ):
            if is_wrong:
                raise (ValueError if is_concrete(system) else TypeError)(f"Problem: {self.title} {reason}")
        check_system(system, 0.0, None)

    def _check_names(self) -> None:
        known = [*self.names, *self.system.dependent_speeds, *self.bounds_of_controls, *output_names(self.system)]
        for label in ("start", "end", "within"):
            given = getattr(self, label)
            if given is None or isinstance(given, State):
                continue
            if not isinstance(given, Mapping):
                raise TypeError(f"Problem: `{label}` must be a dict by name, got {given!r}.")
            refuse_unknown(given, known, f"Problem: `{label}`: {self.title} has no", "it has")
            for name, value in given.items():
                low, high = (_pair if label == "within" else bounds_of)(f"`{label}` of {name!r}", value)
                outer = self.limits.get(name, (-math.inf, math.inf))
                if low > outer[1] or high < outer[0]:
                    raise ValueError(
                        f"Problem: `{label}` of {name!r} is {value!r}, but its bounds along the motion are {outer}."
                    )
        self._check_start()

    def _check_start(self) -> None:
        # The configuration constraints determine the dependent coordinates at the start, and thereby at the end.
        coordinates, n_h, n_u = self.system.coordinates, self.n_constraints, len(self.system.speeds)
        for label in ("start", "end"):
            values = {name: x for name, x in self.ends[label].items() if not isinstance(x, (tuple, list))}
            given = [name for name in (*self.system.speeds, *self.system.dependent_speeds) if name in values]
            fixed = [name for name in coordinates if name in values]
            wrong, of, more = [], "", ""
            if len(given) > n_u:
                wrong = [name for name in given if name in self.system.dependent_speeds]
                of, more = ", ".join(given), f"only {n_u} speeds are independent"
            elif n_h and label == "start" and len(fixed) == len(coordinates):
                check_state(self.system, 0.0, jnp.array([float(values[c]) for c in coordinates]))
            elif n_h and self._is_overdetermined(fixed):
                wrong = [c for c in self.system.dependent_coordinates if c in fixed] or ["a dependent one"]
                of, more = ", ".join(fixed), f"{n_h} of these follow from the others by the configuration constraints"
            if wrong:
                raise ValueError(f"Problem: `{label}` sets {of}, but {more}. Leave out {', '.join(wrong)}.")

    def _is_overdetermined(self, fixed: Sequence[str]) -> bool:
        # Whether the configuration constraints relate coordinates that are fixed, at a random configuration.
        coordinates = self.system.coordinates
        q = jnp.asarray(np.random.default_rng(0).uniform(0.1, 1.0, len(coordinates)))
        J = np.asarray(jax.jacfwd(lambda q: configuration_residual(self.system, jnp.zeros(()), q))(q))  # (n_h, n_q)
        if not np.all(np.isfinite(J)):
            return len(fixed) > len(coordinates) - len(J)
        free = [i for i, name in enumerate(coordinates) if name not in fixed]
        J = J / np.linalg.norm(J, axis=1, keepdims=True)
        return not free or int(np.linalg.matrix_rank(J[:, free], tol=1e-9)) < len(J)

    @property
    def durations(self) -> Bound:
        """The least and the greatest duration [s]."""
        return bounds_of("`duration`", self.duration)

    @property
    def bounds_of_controls(self) -> dict[str, Bound]:
        """The lower and the upper bound of each control, by name."""
        given = self.controls
        if isinstance(given, Mapping):
            return {name: _pair(f"`controls` of {name!r}", b or (None, None)) for name, b in given.items()}
        names = as_names(given, "controls")
        if len(set(names)) < len(names):
            raise ValueError(f"Problem: `controls` contains a name twice: {', '.join(names)}.")
        return dict.fromkeys(names, (-math.inf, math.inf))

    @property
    def limits(self) -> dict[str, Bound]:
        """Bounds for the whole motion by name, from `controls` and `within`."""
        limits = self.bounds_of_controls
        for name, value in (self.within or {}).items():
            low, high = _pair(f"`within` of {name!r}", value)
            first = limits.get(name, (-math.inf, math.inf))
            limits[name] = max(low, first[0]), min(high, first[1])
            if limits[name][0] > limits[name][1]:
                raise ValueError(f"Problem: `within` and `controls` of {name!r} exclude each other.")
        return limits

    @property
    def ends(self) -> dict[str, dict[str, Condition]]:
        """`start` and `end` by name."""
        found: dict[str, dict[str, Condition]] = {}
        for label in ("start", "end"):
            given = getattr(self, label)
            if isinstance(given, State):
                y = np.asarray(packed(as_state(self.system, given)), float)
                if y.shape != (len(self.names),) or not np.all(np.isfinite(y)):
                    raise ValueError(
                        f"Problem: `{label}` must be a State with finite numbers for {', '.join(self.names)}; got "
                        f"{given}."
                    )
                given = dict(zip(self.names, y.tolist(), strict=True))
                if label == "end" and self.n_constraints:
                    given = {k: v for k, v in given.items() if k not in self.system.dependent_coordinates}
            found[label] = dict(given or {})
        return found

    @property
    def signals(self) -> Any:
        """The inputs that are not controls, as `inputs_at` reads them."""
        for name, value in self.inputs.items() if isinstance(self.inputs, Mapping) else ():
            if not callable(value) and np.ndim(value) > 0:
                raise ValueError(f"Problem: the input {name!r} is an array. Pass jaxkane.Samples(times, values).")
        signals = as_signals(self.inputs, self.system.inputs, jnp.zeros(2), self.title)
        samples = {} if callable(signals) else {k: x for k, x in signals.items() if is_samples(x)}
        for name, x in samples.items():
            if x.zero_order_hold or not (x.ts[0] < self.durations[1] and x.ts[-1] > 0):
                raise ValueError(
                    f"Problem: the samples of the input {name!r} are from {x.ts[0]:.10g} to {x.ts[-1]:.10g} s, with "
                    f"zero_order_hold={x.zero_order_hold}. Collocation needs continuous inputs, without a zero-order "
                    "hold, and the motion starts at 0 s: subtract the time of its start from `ts`."
                )
        return signals

    @property
    def parameters(self) -> Parameters | None:
        """The free parameters, or None."""
        free = (self.free,) if isinstance(self.free, str) else self.free
        if isinstance(free, (tuple, list)) and not free:
            return None
        parameters = parameters_of(self.system, free)
        wrong = [x for x in parameters.all_entries if x.roles or x.group is not None]
        if wrong or parameters.has_prior.any():
            raise ValueError(
                f"Problem: `free` accepts parameters of {self.title} with bounds. Gains, delays, `each` and priors "
                "belong to measurements: see jaxkane.fit.fit."
            )
        return parameters


@dataclasses.dataclass(frozen=True)
class Phases:
    """Problems that are solved together, one after another in time.

        swing = jk.collocation.Problem(walker, (0.3, 1.5), controls=..., cost=...)
        gait = jk.collocation.Phases([swing], links=["heel_strike"])

    If there is one link fewer than phases, no link constrains the end of the last phase. If there are as many links as
    phases, the motion is periodic: the last link connects the end of the last phase with the start of the first one.

    In each phase, the time starts at 0 in costs and constraints, and in systems and inputs that depend on time. In
    `Plan.t`, the time continues from phase to phase.

    **Arguments:**

    - `phases`: the problems. Their systems need the same coordinates, speeds and states, unless the links are
        functions. All problems need the same `free`.
    - `links`: one link for each pair of phases.
        None: the state is continuous.
        The name of an event of the first system: the event function must be zero at the end of the first phase, and
        the jump (`then`) gives the first state of the next phase.
        A function (last, first) -> dict by name of numbers that must be zero.

    **Raises:** `ValueError` and `TypeError` that name the phase or the link.
    """

    phases: Sequence[Problem]
    links: Sequence[Any] = ()

    def __post_init__(self) -> None:
        if isinstance(self.phases, Problem) or isinstance(self.links, str):
            raise TypeError("Phases: pass sequences, such as Phases([problem], links=[None]).")
        phases, links = tuple(self.phases), tuple(self.links)
        if any(getattr(phase, "concrete", None) is not None for phase in phases):
            raise TypeError("Phases: a system is traced. Use `plan.sensitivities` for derivatives of several phases.")
        object.__setattr__(self, "phases", phases)
        object.__setattr__(self, "links", links)
        if not phases or not all(isinstance(phase, Problem) for phase in phases):
            raise TypeError(f"Phases: `phases` must be a sequence of Problem, got {self.phases!r}.")
        if len(links) not in (len(phases) - 1, len(phases)):
            raise ValueError(
                f"Phases: {len(phases)} phases need {len(phases) - 1} links, or {len(phases)} for a periodic motion; "
                f"got {len(links)}."
            )
        for i, link in enumerate(links):
            one, other = phases[i], phases[(i + 1) % len(phases)]
            if not (link is None or isinstance(link, str) or callable(link)):
                raise TypeError(f"Phases: link {i} must be None, the name of an event, or a function; got {link!r}.")
            if not callable(link) and one.names != other.names:
                raise ValueError(f"Phases: link {i}: the states have other names. Pass a function (last, first).")
            if isinstance(link, str):
                refuse_unknown([link], names_of_jumps(one.system), f"Phases: {one.title} has no jump", "it has")
        names = [() if p.parameters is None else p.parameters.names for p in phases]
        if len(set(names)) > 1:
            raise ValueError("Phases: all phases need the same `free`, because they share their parameters.")


def _pair(label: str, value: object) -> Bound:
    # Lower and upper bound of what must not be a number, because a bound of one side could be meant.
    if not isinstance(value, (tuple, list)):
        raise ValueError(f"Problem: {label} must be (lower, upper), with None for no bound; got {value!r}.")
    return bounds_of(label, value)


def boundaries(phases: Phases) -> list[np.ndarray]:
    """For each phase the values (2, n_y) at its start and end, NaN if they are unknown. If the state is continuous from
    phase to phase, they are on the straight line between known values."""
    ends = [[[_middle(p.ends[k].get(x), math.nan) for x in p.names] for k in ("start", "end")] for p in phases.phases]
    found = [*map(np.array, ends)]
    if len(found) > 1 and not any(phases.links[: len(found) - 1]):
        first, last = np.swapaxes(found, 0, 1)  # (phases, n_y)
        values = np.concatenate([first[:1], np.where(np.isnan(first[1:]), last[:-1], first[1:]), last[-1:]])
        t = np.cumsum([0.0, *(sum(p.durations) for p in phases.phases)])
        for x in values.T:
            if (known := np.isfinite(x)).any():
                x[:] = np.interp(t, t[known], x[known], left=math.nan, right=math.nan)
        found = [*np.stack([values[:-1], values[1:]], axis=1)]
    return found


def guess_of(problem: Problem, guess: object, s: np.ndarray, ends: np.ndarray) -> Motion:
    """The guess of a motion at nodes, which may violate bounds: see `Transcription`.

    **Arguments:**

    - `problem`: the problem.
    - `guess`: None, a `Trajectory`, or by name numbers, arrays (n,) of samples at even distances, or functions of time;
        with "duration" a number.
    - `s` (K,): the nodes, as fractions of the duration.
    - `ends` (2, n_y): see `boundaries`.

    **Raises:** `ValueError` for unknown names and for values that are not finite.
    """
    if isinstance(guess, Trajectory):
        return _of_trajectory(problem, guess, s)
    given = {} if guess is None else guess
    if not isinstance(given, Mapping):
        raise TypeError(
            "solve: `guess` must be None, a Plan, a Trajectory, a dict by name, or a sequence of these; "
            f"got {type(guess).__name__}."
        )
    names, controls = problem.names, tuple(problem.bounds_of_controls)
    refuse_unknown(given, [*names, *controls, "duration"], f"solve: `guess`: {problem.title} has no", "it has")
    duration = real_number(given.get("duration", 0.5 * sum(problem.durations)), "solve: `guess` of 'duration'")
    if not 0 < duration < math.inf:
        raise ValueError(f"solve: `guess` of 'duration' must be a positive number of seconds, got {duration!r}.")
    Y, W = _automatic(problem, s, duration, ends)
    for name, value in given.items():
        if name != "duration":
            target, i = (Y, names.index(name)) if name in names else (W, controls.index(name))
            target[:, i] = _values(problem, name, value, s, duration)
    return Motion(s, duration, Y, W)


def detoured(motion: Motion, detour: np.ndarray) -> Motion:
    """A motion with sines of the amplitudes (n_q, 3) added to its coordinates. Both ends stay where they are."""
    k = np.arange(1, detour.shape[1] + 1)
    Y = motion.Y.copy()
    Y[:, : len(detour)] += np.sin(np.pi * np.outer(motion.s, k)) @ detour.T
    return motion._replace(Y=Y)


def detours(problem: Problem, count: int, seed: int = 0) -> list[np.ndarray | None]:
    """Amplitudes of sines (n_q, 3) for random guesses. The first one is None."""
    rng, units = np.random.default_rng(seed), units_of(problem.system)
    sizes = []
    for name in problem.system.coordinates:
        spread = np.ptp([*problem.sizes_of(name), *[0.0] * (not problem.sizes_of(name))])
        sizes.append(1.0 if units.get(name, "") in ("", "rad") else spread)
    return [None, *(rng.normal(size=(3, len(sizes))).T * np.array(sizes)[:, None] for _ in range(count - 1))]


def _middle(value: Condition | None, otherwise: float) -> float:
    """The number, or a place between two bounds."""
    if value is None:
        return otherwise
    low, high = bounds_of("the guess", value)
    return 0.5 * (low + high) if math.isfinite(high - low) else min(max(otherwise, low), high)


def _automatic(problem: Problem, s: np.ndarray, duration: float, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Straight lines from the start to the end. Coordinates without an end continue with their initial rates."""
    system, names, limits = problem.system, problem.names, problem.limits
    controls, (first, last) = tuple(problem.bounds_of_controls), ends
    inside = np.array([_middle(limits.get(name), 0.0) for name in names])
    start = np.where(np.isnan(first), np.where(np.isnan(last), inside, last), first)
    start = _assembled(problem, start, first)
    W0 = np.array([min(max(0.0, limits[name][0]), limits[name][1]) for name in controls])
    y_dot = _rates(problem, start, W0)
    n_q = len(system.coordinates)
    moving = start + duration * np.where(np.arange(len(names)) < n_q, y_dot, 0.0)
    moving = np.where(np.isfinite(moving), moving, start)
    end = np.where(np.isnan(last), np.where(np.isnan(first), start, moving), last)
    if problem.n_constraints and np.isfinite(last[:n_q]).any():
        # Not by `assemble`, which sets unknown coordinates to zero, such as the distance that a bicycle travels.
        end[:n_q] = projected(system, 0.0, jnp.asarray(end[:n_q]))
    Y = start + s[:, None] * (end - start)
    return Y, np.tile(W0, (len(s), 1))


def _assembled(problem: Problem, start: np.ndarray, given: np.ndarray) -> np.ndarray:
    """The start with coordinates that satisfy the configuration constraints."""
    system, n_q = problem.system, len(problem.system.coordinates)
    if not problem.n_constraints or np.all(np.isfinite(given[:n_q])):
        return start
    known = {c: float(start[i]) for i, c in enumerate(system.coordinates) if np.isfinite(given[i])}
    try:
        q = np.asarray(assemble(system, known).q)
    except ValueError:
        return start  # the solver closes the loop
    return np.concatenate([q, start[n_q:]])


def _rates(problem: Problem, y: np.ndarray, w: np.ndarray) -> np.ndarray:
    variables = problem.variables()
    n = problem.has_free_duration + (0 if variables.parameters is None else variables.parameters.size)
    known = {} if callable(problem.signals) else problem.signals
    samples = {k: f for k, f in known.items() if k not in variables.signals}
    node = {"s": jnp.zeros(()), "inputs": {k: f(0.0) for k, f in samples.items()}}
    return np.asarray(_rates_at(variables, node, np.concatenate([y, w, np.zeros(n)])))


@jit
def _rates_at(variables: Variables, node: Node, x: Array) -> Array:
    system, _, t, y, inputs = variables.at(node, x)
    return vector_field(system, t, y, inputs)


def _values(
    problem: Problem, name: str, value: Numbers | Callable[[float], Any], s: np.ndarray, duration: float
) -> np.ndarray:
    label = f"solve: `guess` of {name!r}"
    if callable(value):
        found = np.array([real_number(value(t), label) for t in s * duration])
    else:
        array = np.asarray(value)
        if array.dtype.kind not in "iuf" or array.ndim > 1 or array.size == 0:
            raise ValueError(
                f"{label} must be a number, an array (n,) of samples, or a function of time; got {value!r}."
            )
        found = np.interp(s, np.linspace(0, 1, array.size), array) if array.size > 1 else np.full(len(s), array)
    if not np.all(np.isfinite(found)):
        raise ValueError(f"{label} must be finite, got {value!r}.")
    return found


def _of_trajectory(problem: Problem, trajectory: Trajectory, s: np.ndarray) -> Motion:
    """A simulation as a guess, stretched to the duration of the problem."""
    t = np.asarray(trajectory.t)
    if t.ndim != 1:
        raise ValueError("solve: `guess` is a batch of trajectories. Pass one member of it.")
    reached = np.isfinite(np.asarray(trajectory.q)).all(axis=1)
    if reached.sum() < 2:
        raise ValueError(f"solve: the trajectory in `guess` has fewer than two finite states: {trajectory.reason}.")
    t = t[reached]
    low, high = problem.durations
    duration = min(max(float(t[-1] - t[0]), low), high)
    at = t[0] + s * (t[-1] - t[0])

    def sampled(names: Sequence[str]) -> np.ndarray:
        known = [np.asarray(trajectory[name])[reached] for name in names]
        return np.array([np.interp(at, t, x) for x in known]).reshape(len(known), len(s)).T

    Y, W = sampled(problem.names), sampled(tuple(problem.bounds_of_controls))
    return Motion(s, duration, Y, W)
