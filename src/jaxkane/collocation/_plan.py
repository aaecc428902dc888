"""The result of `solve`: a planned motion, how it was found, and its simulation."""

from __future__ import annotations

import dataclasses
from collections import UserDict
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float

from .._collocate.lobatto import Lobatto
from .._collocate.program import padded
from .._collocate.solvers import Solution
from .._collocate.transcription import Motion, Transcription
from .._integrate.events import Status
from .._integrate.inputs import InputState, Signals, inputs_at
from .._integrate.simulate import simulate
from .._integrate.trajectory import Trajectory
from .._kane.api import _dependent_speeds
from .._kane.constraint_residuals import configuration_residual
from .._kane.right_hand_side import outputs_at, values_of, vector_field
from .._scalarjit.cache_key import jit
from .._scalarjit.compat import Tracer, concretely, on_device
from .._scalarjit.components import Component, Numbers
from .._system.parameters import wrapped
from .._system.system import State, System, has_outputs, names_of, units_of, unpacked
from ._mesh import ControlPolynomial, coefficients_of, interpolated, place_in_mesh, with_controls, without_events
from ._problem import Problem
from ._sensitivities import Sensitivity, derivatives_of, sensitivities_of, tangents_of


@dataclasses.dataclass(frozen=True)
class Plan:
    """A planned motion: `plan["roll"]` is any coordinate, speed, state, input or output at the nodes.

    A plan can be passed to `jaxkane.animate`, `jaxkane.positions`, the functions of `jaxkane.plot` and similar
    functions. It can also be the `guess` for another problem.

    Attributes:

    - `problem`: the problem that was solved.
    - `ok`: whether the solver found a local minimum and the local errors are below the tolerance.
    - `reason`: the result in words.
    - `cost`: the cost, of all phases together.
    - `duration`: the duration [s].
    - `estimates`: the values of the free parameters by name.
    - `system`: the system with these values.
    - `trajectory`: the `Trajectory` at the nodes; None for phases with different states.
    - `mesh` (N + 1,): the ends of the intervals [s].
    - `errors` (N,): the local error of each interval, relative to the size of each state; None if it was not computed.
    - `multipliers`: derivatives of the least cost by name; see `Multipliers`.
    - `costs`: the cost on each mesh.
    - `iterations`: the number of iterations of the solver, on all meshes together.
    - `violation`: the largest scaled violation of a constraint.
    - `dual_residual`: the largest scaled violation of the conditions of a minimum.
    - `unmet`: the scaled violations of constraints that are violated by more than the tolerance, by name.
    - `conflict`: if no motion nearby satisfies all constraints, the bounds, values at the ends and constraints that
        cause this, with their times, the most important one first.
    - `active`: the names of bounds and inequality constraints that are active somewhere.
    - `notes`: remarks as sentences, such as the names of what was clipped in the guess.
    - `starts`: if there were several guesses, the cost and the result of each.
    - `phases`: the plans of all phases; empty for a single problem. With phases, the names in `multipliers`, `unmet`
        and `active` start with the phase, as in "phase 0: roll".
    """

    problem: Problem
    ok: bool
    reason: str
    cost: float
    duration: float
    estimates: dict[str, float]
    system: System
    trajectory: Trajectory | None
    mesh: np.ndarray
    errors: np.ndarray | None
    multipliers: Multipliers
    costs: tuple[float, ...]
    iterations: int
    violation: float
    dual_residual: float
    unmet: dict[str, float]
    active: tuple[str, ...]
    conflict: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    starts: tuple[tuple[float, str], ...] = ()
    phases: tuple[Plan, ...] = ()
    motion: Motion = dataclasses.field(repr=False, kw_only=True)
    method: Lobatto = dataclasses.field(repr=False, kw_only=True)
    scales: np.ndarray = dataclasses.field(repr=False, kw_only=True)
    solved: tuple[Transcription, Solution] = dataclasses.field(repr=False, kw_only=True)

    @property
    def _whole(self) -> Trajectory:
        if self.trajectory is None:
            raise ValueError("Plan: the phases have different states. Use plan.phases[0], plan.phases[1], ...")
        return self.trajectory

    def __getitem__(self, name: str) -> Float[Array, " K"]:
        return self._whole[name]

    @property
    def t(self) -> Float[Array, " K"]:
        """Times (K,) of the nodes [s]."""
        return self._whole.t

    @property
    def q(self) -> Float[Array, "K n_q"]:
        """Coordinates (K, n_q) at the nodes."""
        return self._whole.q

    @property
    def u(self) -> Float[Array, "K n_u"]:
        """Independent speeds (K, n_u) at the nodes."""
        return self._whole.u

    @property
    def x(self) -> Float[Array, "K n_x"]:
        """First-order states (K, n_x) at the nodes."""
        return self._whole.x

    def state(self, i: int = -1) -> State:
        """The state at the i-th node."""
        return self._whole.state(i)

    @property
    def inputs(self) -> Any:
        """The inputs as functions of (t, state), for `simulate`. Controls are polynomials between the nodes.

        jk.simulate(plan.system, plan.state(0), ts, plan.inputs)
        """
        self._refuse_phases("inputs")
        C = coefficients_of(self.motion.W, self.method)
        controls = self.problem.bounds_of_controls
        mesh = jnp.asarray(self.mesh)
        polynomials = {name: ControlPolynomial(mesh, jnp.asarray(C[:, :, i])) for i, name in enumerate(controls)}
        return with_controls(self.problem.signals, polynomials)

    def at(self, ts: Numbers) -> dict[str, np.ndarray]:
        """States and controls by name at other times. They are interpolated by one polynomial for each interval.

        Between the nodes, the states are less accurate than at the nodes. For "hermite-simpson", the polynomials are
        parabolas.

        **Arguments:**

        - `ts` (n,): times from 0 to the duration [s].
        """
        self._refuse_phases("at")
        s = np.asarray(ts, float) / self.duration
        if s.ndim != 1 or not np.all((s >= -1e-12) & (s <= 1 + 1e-12)):
            raise ValueError(f"Plan.at: `ts` must be an array (n,) of times from 0 to {self.duration:.6g} s.")
        found = interpolated(self.motion, self.mesh / self.duration, self.method, np.clip(s, 0.0, 1.0))
        names = (*self.problem.names, *self.problem.bounds_of_controls)
        return dict(zip(names, np.concatenate([found.Y, found.W], axis=1).T, strict=True))

    def replay(
        self, ts: Numbers = None, *, feedback: bool = False, rtol: float = 1e-8, atol: float = 1e-8
    ) -> Trajectory:
        """Simulate the whole plan from its first state with its inputs.

        If the motion is unstable, rounding errors grow and the simulation diverges from the plan. With `feedback`, a
        linear-quadratic regulator corrects the controls.

        **Arguments:**

        - `ts` (n,): increasing times [s] from 0 on; by default the nodes.
        - `feedback`: whether to stabilize the motion.
        - `rtol`, `atol`: tolerances of the simulation.

        **Returns:** a `Trajectory`. Its inputs contain the corrections of the feedback.
        """
        self._refuse_phases("replay")
        ts = self.t if ts is None else ts
        inputs = self.inputs
        if feedback:
            Y, W = (jnp.asarray(coefficients_of(x, self.method)) for x in (self.motion.Y, self.motion.W))
            controls, gains = tuple(self.problem.bounds_of_controls), jnp.asarray(_gains(self))
            inputs = Regulator(jnp.asarray(self.mesh), Y, W, gains, self.problem.signals, controls)
        system = without_events(self.system)
        return simulate(
            system, self.state(0), ts, inputs, rtol=rtol, atol=atol, discontinuities=self.mesh[1:-1], max_steps=100_000
        )

    def deviation(self, ride: Trajectory) -> float:
        """The largest deviation of a simulation from the plan, relative to the size of each state.

        The states are compared at the ends of intervals, because the polynomials are less accurate inside an interval.
        """
        self._refuse_phases("deviation")
        Y = np.asarray(jnp.concatenate([ride.q, ride.u, ride.x], axis=1))
        if Y.shape != self.motion.Y.shape:
            raise ValueError(f"Plan.deviation: the simulation must have the {len(self.motion.Y)} times of plan.t.")
        every = len(self.method.c) - 1
        return float(np.max(np.abs(Y - self.motion.Y)[::every] / self.scales[: Y.shape[1]]))

    def sensitivities(self, free: Any) -> dict[str, Sensitivity]:
        """The derivatives of the least cost and of the optimal motion by parameters of the mechanism.

            plan.sensitivities(["rope", "load"])["rope"].cost

        The mesh, the values at both ends, bounds and inputs do not change with the parameters. With phases, all phases
        whose system has the parameter change together, and names start with the phase, as in "phase 0: roll".

        **Arguments:**

        - `free`: the parameters, as in `Problem`. They must not be free in the problem.

        **Returns:** a `Sensitivity` for each parameter by name.

        **Raises:** `ValueError` if the plan is not `ok`, and for unknown parameters.
        """
        if not self.ok:
            raise ValueError(f"Plan.sensitivities: the plan is not `ok`, so it is no minimum: {self.reason}.")
        return sensitivities_of(*self.solved, free)

    def _refuse_phases(self, what: str) -> None:
        if self.phases:
            raise ValueError(f"Plan.{what}: the plan has {len(self.phases)} phases. Use plan.phases[0].{what}, ...")

    def report(self) -> str:
        """A report in words: the solution, its accuracy, active bounds, and a simulation of the plan."""
        if self.phases:
            parts = [f"phase {i}\n{plan.report()}" for i, plan in enumerate(self.phases)]
            return "\n\n".join([repr(self), *parts])
        lines = [repr(self)]
        lines.append(f"violation {self.violation:.1e}, conditions of a minimum {self.dual_residual:.1e} (both scaled)")
        if self.unmet:
            worst = sorted(self.unmet.items(), key=lambda item: -item[1])[:8]
            lines.append("not met: " + ", ".join(f"{name} (by {x:.1e})" for name, x in worst))
        if self.conflict:
            lines.append("in conflict near this motion: " + ", ".join(self.conflict))
        lines.append("active: " + (", ".join(self.active) or "no bounds"))
        if len(self.costs) > 1:
            lines.append(f"cost on the last two meshes: {self.costs[-2]:.10g}, {self.costs[-1]:.10g}")
        if self.errors is not None:
            lines.append(f"largest local error {np.max(self.errors):.1e} of the size of a state")
        if self.problem.n_constraints:
            h = np.asarray(_drift(self.system, self.t, self.q))
            lines.append(f"configuration constraints: largest residual {np.max(np.abs(h)):.1e}")
        lines.append(self._words_of_replay())
        if self.starts:
            lines.append("guesses: " + ", ".join(f"{cost:.8g} ({words})" for cost, words in self.starts))
        return "\n".join(lines)

    def _words_of_replay(self) -> str:
        ride = self.replay()
        off = self.deviation(ride) if ride.ok else np.inf
        if off < 1e-3:
            return f"simulated over the whole duration, it deviates by {off:.1e} of the size of a state"
        ride = self.replay(feedback=True)
        stabilized = self.deviation(ride) if ride.ok else np.inf
        return (
            f"simulated over the whole duration, it deviates by {off:.1e} of the size of a state: the motion is "
            f"unstable or the mesh is coarse. With a stabilizing feedback it deviates by {stabilized:.1e}"
        )

    def __repr__(self) -> str:
        result = f"cost {self.cost:.8g}, {self.duration:.6g} s" if np.isfinite(self.cost) else f"{self.duration:.6g} s"
        text = f"Plan({type(self.system).__name__}: {self.reason}; {result}, {len(self.mesh) - 1} intervals, "
        text += f"{self.iterations} iterations)"
        if self.estimates:
            units = units_of(self.system)
            values = (f"{k} = {v:.6g} {units.get(k, '')}".strip() for k, v in self.estimates.items())
            text = f"{text}\n{wrapped(', '.join(values))}"
        return "\n".join([text, *self.notes])


class Multipliers(UserDict[str, Any]):
    """Derivatives of the least cost, by the names of states, controls, conditions and path constraints.

    - `multipliers["roll"]` (K,): the derivative with respect to a shift of the bound of this state or control at each
        node. It is 0 at nodes where no bound is active. If the start is fixed, the first number is the derivative with
        respect to the initial value.
    - `multipliers["condition"]`: the derivative with respect to a shift of the required value of this condition. For a
        path constraint, it is an array (K,). If a variable has the same name, use "conditions: roll" or "path: roll".
    - `costate["roll"]` (N + 1,): the derivative with respect to a sudden change of this state at the ends of intervals,
        `plan.mesh`. Where a constraint makes it jump, it is the value after the jump.
    """

    def __init__(self, values: Mapping[str, Any], costate: Mapping[str, np.ndarray]):
        super().__init__(values)
        self.costate = dict(costate)

    def __repr__(self) -> str:
        return f"Multipliers({', '.join(self)})"


class Regulator(eqx.Module):
    """The controls of a plan, with feedback: w = w*(t) - K(t) (y - y*(t))."""

    mesh: Float[Array, " N_1"]
    Y: Float[Array, "N s n_y"]
    W: Float[Array, "N s n_w"]
    gains: Float[Array, "N n_w n_y"]
    signals: Any
    controls: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, t: Component, state: InputState) -> dict[str, Any]:
        i, u = place_in_mesh(self.mesh, t)
        powers = jnp.stack([u**k for k in range(self.Y.shape[1])])  # an array of integers would be promoted
        x = () if state.x is None else (jnp.asarray(state.x),)
        y = jnp.concatenate([jnp.asarray(state.q), jnp.asarray(state.u), *x])
        w = powers @ self.W[i] - self.gains[i] @ (y - powers @ self.Y[i])
        others = self.signals if isinstance(self.signals, dict) else self.signals(t, state)
        others = {k: f(t, state) if callable(f) else f for k, f in others.items()}
        return {**others, **{name: w[k] for k, name in enumerate(self.controls)}}


def _gains(plan: Plan) -> np.ndarray:
    """Gains (N, n_w, n_y) of the linear-quadratic regulator of the plan, by the Riccati recursion over its intervals.

    A deviation costs as much as a control if both are as large as their sizes.
    """
    every = len(plan.method.c) - 1
    mesh, Y, W = plan.mesh, plan.motion.Y[::every], plan.motion.W[::every]
    A, B = (np.asarray(x) for x in _linear(plan.system, plan.problem.signals, tuple(plan.problem.bounds_of_controls),
                                           jnp.asarray(mesh), Y, W))  # fmt: skip
    n_y, n_w = Y.shape[1], W.shape[1]
    Q, R = np.diag(plan.scales[:n_y] ** -2.0), np.diag(plan.scales[n_y:] ** -2.0)
    P, gains = Q, np.zeros((len(mesh) - 1, n_w, n_y))
    for i in range(len(mesh) - 2, -1, -1):
        h = mesh[i + 1] - mesh[i]
        block = np.zeros((n_y + n_w, n_y + n_w))
        block[:n_y] = h * np.concatenate([A[i], B[i]], axis=1)
        both = scipy.linalg.expm(block)[:n_y]
        F, G = both[:, :n_y], both[:, n_y:]
        gains[i] = np.linalg.solve(h * R + G.T @ P @ G, G.T @ P @ F)
        P = h * Q + F.T @ P @ (F - G @ gains[i])
        P = 0.5 * (P + P.T)
    return gains


@jit
def _linear(system: System, signals: Signals, controls: tuple[str, ...], ts: Array, Y: Array, W: Array) -> Any:
    def rates(y: Array, w: Array, t: Array) -> Array:
        given = inputs_with(system, signals, controls, t, y, w)
        return vector_field(system, t, y, given)

    return jax.vmap(jax.jacfwd(rates, argnums=(0, 1)))(Y, W, ts)


def inputs_with(
    system: System, signals: Signals, controls: Sequence[str], t: Array, y: Array, w: Array
) -> dict[str, Any]:
    """All inputs by name. Those that are neither signals nor controls are zero."""
    others = inputs_at(system, signals, t, unpacked(system, y), all_of_them=True)
    return others | {name: w[i] for i, name in enumerate(controls)}


@jit
def _drift(system: System, t: Array, q: Array) -> Array:
    return jax.vmap(lambda t, q: configuration_residual(system, t, q))(t, q)


def trajectory_of(system: System, problem: Problem, motion: Motion) -> Trajectory:
    """A motion as a `Trajectory` at its nodes."""
    t, is_traced = motion.s * motion.duration, isinstance(motion.Y, Tracer)
    controls, own = tuple(problem.bounds_of_controls), (t, motion.Y, motion.W)
    along = _along(system, problem.signals, controls, *(own if is_traced else map(padded, own)))
    known = jax.tree.map(lambda a: a if is_traced else on_device(np.asarray(a)[: len(t)]), along)
    q, u, x, u_dep, inputs, outputs = known
    count, t = jnp.asarray(0), jnp.asarray(t) if is_traced else on_device(t)
    ends = (a[-1] if is_traced else on_device(np.asarray(a)[-1]) for a in ((q, u, x) if system.states else (q, u)))
    return Trajectory(
        t=t, q=q, u=u, u_dep=u_dep, x=x, inputs=inputs, outputs=outputs,
        status=jnp.asarray(int(Status.COMPLETED)), t_end=t[-1],
        stats={"steps": count, "accepted": count, "rejected": count}, names=names_of(system), events=(),
        adjoint="none", units=tuple(units_of(system).items()), end=State(*ends),
    )  # fmt: skip


@jit
def _along(system: System, signals: Signals, controls: tuple[str, ...], ts: Array, Y: Array, W: Array) -> Any:
    def at(t: Array, y: Array, w: Array) -> Any:
        state = unpacked(system, y)
        inputs = inputs_with(system, signals, controls, t, y, w)
        u_dep = _dependent_speeds(system, t, state.q, state.u, {}) if system.dependent_speeds else jnp.zeros(0)
        outputs = {}
        if has_outputs(system):
            outputs = outputs_at(system, t, state.q, state.u, values_of(system, state.x, inputs))
        x = jnp.zeros(0) if state.x is None else state.x
        return state.q, state.u, x, u_dep, inputs, outputs

    return jax.vmap(at)(ts, Y, W)


def differentiable(problem: Any, plan: Plan) -> Plan:
    """The plan of `problem.concrete` with the derivatives by the traced numbers in the system of `problem`.

    The cost, duration, estimates, system and trajectory have derivatives. The multipliers have none and are left out.
    """
    if not plan.ok:
        raise ValueError(f"solve: the derivatives of a plan that is not `ok` do not exist: {plan.reason}.")
    transcription, solution = plan.solved
    leaves = jax.tree.leaves(problem.system)
    directions = [[(i, k, 1.0)] for i, x in enumerate(leaves) if isinstance(x, Tracer) for k in range(np.size(x))]
    with concretely():
        tangent = tangents_of(plan.problem.system, directions)
        cost, x, reason = derivatives_of(transcription, solution, [tangent])
    if reason:
        raise ValueError(f"solve: a derivative does not exist: {reason}.")
    slopes = np.concatenate([cost[:, None], x], axis=1).T
    values = np.append(plan.cost, solution.z * transcription.x_scale)

    @jax.custom_jvp
    def optimum(_: Array) -> Array:
        return jnp.asarray(values)

    @optimum.defjvp
    def _(primals: Any, tangents: Any) -> Any:
        if isinstance(primals[0], Tracer):
            raise TypeError("solve: second derivatives are not supported. Use differences of `plan.sensitivities`.")
        return jnp.asarray(values), jnp.asarray(slopes) @ tangents[0]

    found = optimum(jnp.concatenate([jnp.ravel(x) for x in leaves if isinstance(x, Tracer)]))
    layout, own, x = transcription.layouts[0], transcription.parameters, found[1:]
    rows, n_y = x[layout.node(np.arange(layout.K))], layout.variables.n_y
    duration = plan.duration if layout.duration is None else x[layout.duration]
    motion = Motion(layout.s, duration, rows[:, :n_y], rows[:, n_y:])  # type: ignore[arg-type]
    theta, system = x[transcription.shared_parameters], problem.system
    estimates = {} if own is None else dict(zip(own.names, own.values(theta), strict=True))
    system = system if own is None else own.apply(system, theta)[0]
    return dataclasses.replace(
        plan, problem=problem, cost=found[0], duration=duration, estimates=estimates, system=system, motion=motion,
        trajectory=trajectory_of(system, plan.problem, motion), mesh=layout.mesh * duration, costs=(),
        multipliers=Multipliers({}, {}),
    )  # fmt: skip
