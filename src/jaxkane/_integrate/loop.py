"""The integration loop: the steps of `diffrax.diffeqsolve`, compiled in half the time, or `diffeqsolve` itself.

This is the only file that uses `equinox.internal`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import diffrax
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._scalarjit.nan import constant
from .discontinuities import rounding
from .events import Status
from .inputs import RateArguments
from .settings import rates_at_ends, with_scan_kind
from .step_control import ControllerState, StepSizeController
from .tangents import Probe, Probing, Replay

# How the loop of equinox is differentiated, by adjoint.
_KINDS: dict[type, str] = {
    diffrax.ForwardMode: "lax",
    diffrax.RecursiveCheckpointAdjoint: "checkpointed",
    diffrax.DirectAdjoint: "bounded",
}


class Jump(NamedTuple):
    """A jump of the state; or all jumps of a simulation, with a leading axis of at most `max_jumps`.

    Fields: the time `t` since the start [s], the `event` as a float, the packed states `before` and `after`, whether
    all of this is a `smooth` function of the arguments, the `impulses` (r,) of the contacts or of the event, and the
    `status`: 0 if the jump is possible. The table of all jumps has no status.
    """

    t: Array
    event: Array
    before: Array
    after: Array
    smooth: Array
    impulses: Array
    status: Any


class Steps(NamedTuple):
    """The result of a loop.

    Fields:

    - `motion` (n_t, n): packed states at the requested times. `reached` (n_t,): whether the steps reached each of them.
    - `t`, `y`: time since the start [s] and packed state where the steps end. `rates` (n,): the rates there, None if
      the solver does not evaluate them.
    - `state`: the state of the controller.
    - `taken`, `accepted`: numbers of steps.
    - `jumps`, `n_jumps`: the jumps and their number, or None if no event changes the state. Later rows are unused.
    - `replay`: the recorded steps if a tangent is integrated with the motion, or None.
    """

    motion: Array
    reached: Array
    t: Array
    y: Array
    rates: Array | None
    state: ControllerState
    taken: Array
    accepted: Array
    jumps: Jump | None = None
    n_jumps: Any = None
    replay: Replay | None = None


class Carry(NamedTuple):
    """The loop-carried values of the fast loop.

    Fields:

    - `t0`, `t1`: start and end of the next step [s].
    - `y`, `rates`: the packed state at the start, and its rates; None if they are not needed.
    - `solver_state`, `controller_state`: as in diffrax.
    - `made_jump`: whether the step begins at a discontinuity.
    - `running`: whether the steps continue.
    - `steps` (2,): numbers of steps, taken and accepted.
    - `motion` (n_t, n), `count`: the saved states, and their number.
    - `jumps`, `n_jumps`: the jumps so far and their number, or None.
    - `probe`: the tangent whose error is controlled, or None.
    """

    t0: Array
    t1: Array
    y: Array
    rates: Array | None
    solver_state: Any
    controller_state: Any
    made_jump: Any
    running: Array
    steps: Any
    motion: Any
    count: Any
    jumps: Any
    n_jumps: Any
    probe: Probe | None


def is_supported(
    solver: diffrax.AbstractSolver, controller: StepSizeController, adjoint: diffrax.AbstractAdjoint, progress: bool
) -> bool:
    return type(adjoint) in _KINDS and solver.term_structure is diffrax.AbstractTerm and not (
        progress or controller.inner
    )  # fmt: skip


def fast_loop(
    rates: Callable[..., Array],
    solver: Any,
    controller: StepSizeController,
    y0: Array,
    args: RateArguments,
    ts: Array,
    adjoint: diffrax.AbstractAdjoint,
    max_steps: int | None,
    may_begin: Array,
    jumps: tuple[Callable[[Array, Array, Array, Array], Jump], int] | None,
    probing: Probing | None = None,
    replay: Replay | None = None,
) -> Steps:
    """The steps of `diffeqsolve`, to the last digit. No steps are taken unless the simulation `may_begin`.

    `jumps`: a function (t, y, event, reach) -> `Jump`, from a time near the event, and the largest number of jumps.
    `probing`: integrate a tangent with the motion. A step is accepted only if the error of the tangent is small, too.
    `replay`: take the recorded steps of an earlier loop with a tangent, without error control and event functions.
    """
    kind: Any = _KINDS[type(adjoint)]
    checkpoints = getattr(adjoint, "checkpoints", None)
    kind = "lax" if max_steps is None and checkpoints is None else kind
    solver = solver if kind == "checkpointed" else with_scan_kind(solver, kind)
    term: Any = diffrax.ODETerm(rates if probing is None else probing.of_both)  # pyright: ignore[reportArgumentType]
    start, order = jnp.zeros_like(controller.duration), solver.error_order(term)
    duration, state = controller.duration, None

    def next_step(i: Array, t0: Array) -> tuple[Array, Array, Array]:
        assert replay is not None
        found = controller.discontinuities
        return replay.end(i, t0, duration, None if found is None else found.after(t0, duration))

    if replay is None:
        end, state = controller.init(term, start, duration, y0, None, args, solver.func, order)
    else:
        end = next_step(jnp.zeros((), int), start)[0]
        may_begin &= replay.count > 0
    begin, probe = (y0, None) if probing is None else probing.start(y0, max_steps, 0 if jumps is None else jumps[1])
    needs_rates = bool(controller.events.names) and rates_at_ends(solver)
    restart = controller.discontinuities is not None and controller.discontinuities.restart
    table = None
    if jumps is not None:
        times = jnp.zeros(jumps[1], y0.dtype)
        states, impulses = (jnp.zeros((jumps[1], n), y0.dtype) for n in (*y0.shape, controller.events.n_impulses))
        table = Jump(times, times, states, states, times, impulses, None)
    carry = Carry(
        start, end, begin, jnp.zeros_like(y0) if needs_rates else None, solver.init(term, start, end, begin, args),
        state, jnp.array(False) if restart else None, may_begin, jnp.zeros(2, int),
        jnp.zeros((len(ts), *y0.shape), y0.dtype), jnp.zeros((), int),
        table, None if jumps is None else jnp.zeros((), int), probe,
    )  # fmt: skip
    n_events = len(controller.events.names)

    def motion_of(y: Float[Array, "*two n"]) -> Any:
        return y if probing is None else y[..., 0, :]

    def step(c: Carry) -> Carry:
        # False must be a Python constant here: as an array, the loop would carry it and evaluate both cases.
        jump = c.made_jump if restart else False
        y1, error, dense, solver_state, result = solver.step(term, c.t0, c.t1, c.y, args, c.solver_state, jump)
        if not getattr(solver, "always_succeeds", False):
            failed = result != diffrax.RESULTS.successful
            y1, error = jax.tree.map(lambda x: jnp.where(failed, jnp.inf, x), (y1, error))
        i, probe, event, reach = c.steps[0], c.probe, c.t0, c.t0  # the last two only for jumps
        if replay is None:
            size = error_of_tangent = cast(Any, None)
            if probing is not None and probe is not None:
                error_of_tangent, size = probing.step(probe, y1, error)
            keep, t0, t1, jumped, state, ended = controller.adapt_step_size(
                c.t0, c.t1, motion_of(c.y), motion_of(y1), args, None if error is None else motion_of(error), order,
                c.controller_state, error_of_tangent,
            )  # fmt: skip
            running = ended == diffrax.RESULTS.successful
            if jumps is not None:
                now = ControllerState.unpacked(state[0], n_events)
                event, reach = now.jump, now.reach
            if probe is not None:
                probe = probe._replace(size=jnp.where(keep, size, probe.size))
                probe = probe.recorded(c.t1, keep, ~running, None if jumps is None else (c.n_jumps, event, reach))
        else:
            _, keep, jumped = next_step(i, c.t0)
            t0 = jnp.where(keep, c.t1, c.t0)
            t1, state, running = next_step(i + 1, t0)[0], None, i + 1 < replay.count
            if jumps is not None:
                event, reach = replay.jump_of(i, c.n_jumps, c.t1)

        def chosen(new: PyTree, old: PyTree) -> Any:
            return jax.tree.map(functools.partial(jnp.where, keep), new, old)

        k: Any = constant(motion_of(dense["k"])) if needs_rates else None
        interpolation = solver.interpolation_cls(t0=c.t0, t1=c.t1, **dense)
        y_next = chosen(y1, c.y)
        rates_next = chosen(k[-1], k[0]) / (c.t1 - c.t0) if needs_rates else None
        solver_state, cut = chosen(solver_state, c.solver_state), None
        following = Carry(
            t0, t1, y_next, rates_next, solver_state, state, None, running, None, None, None, c.jumps, c.n_jumps, None
        )  # fmt: skip
        if jumps is not None:
            # The loop runs once if a jump is due. In a batch it runs if a jump is due in any member: a condition would
            # be evaluated in every step.
            jump_at, most = jumps
            is_due = event >= 0

            def jumped_at(due_and_carry: tuple[Array, Carry]) -> tuple[Array, Carry]:
                due, a = due_and_carry
                start = jnp.where(keep, c.t1, c.t0)
                jump, fits = jump_at(start, motion_of(a.y), event, reach), a.n_jumps < most
                # A state that is not finite must not reach the solver.
                status_of_jump = jump.status
                is_possible = status_of_jump == float(Status.COMPLETED)
                jump = jump._replace(after=jnp.where(fits & is_possible, jump.after, jump.before), status=None)
                if replay is None:
                    end, (changed, inner) = controller.after_jump(a.controller_state, jump.t, jump.after, args)
                    status = jnp.where(is_possible, ControllerState.unpacked(changed, n_events).status, status_of_jump)
                    status = jnp.where(fits, status, float(Status.MAX_JUMPS))
                    state, goes_on = (changed.at[0].set(status), inner), status == float(Status.COMPLETED)
                else:
                    end, state, goes_on = next_step(i + 1, jump.t)[0], None, a.running
                y = jump.after if probing is None or probe is None else probing.again(jump.after, probe)
                # JAX drops a row that does not fit. In reverse mode, the arrays are objects of equinox.
                rows = [x.at[a.n_jumps].set(row) for x, row in zip(a.jumps[:-1], jump[:-1], strict=True)]
                return jnp.zeros_like(due), a._replace(
                    t0=jump.t, t1=end, y=y, rates=None if a.rates is None else jnp.zeros_like(a.rates),
                    solver_state=solver.init(term, jump.t, end, y, args), controller_state=state, running=goes_on,
                    jumps=Jump._make([*rows, None]), n_jumps=jnp.minimum(a.n_jumps + 1, most),
                )  # fmt: skip

            at_infinity = following._replace(t0=jnp.full_like(t1, jnp.inf))
            # Not the status, which is None.
            _, following = loop(lambda a: a[0], jumped_at, (is_due, at_infinity), 1, 1, lambda a: a[1].jumps[:-1])
            cut = constant(following.t0)
            cut = cut - 16 * rounding(jnp.where(is_due, cut, 0.0), controller.duration)
            following = following._replace(t0=jnp.where(is_due, following.t0, t0))

        def is_passed(kept: tuple[Array, Array]) -> Array:
            passed = keep & (kept[1] < len(ts)) & (ts[kept[1]] <= c.t1)
            # A sample at the time of a jump gets the state after it.
            return passed if cut is None else passed & (ts[kept[1]] < cut)

        def sampled(kept: tuple[Array, Array]) -> tuple[Array, Array]:
            return kept[0].at[kept[1]].set(motion_of(interpolation.evaluate(ts[kept[1]]))), kept[1] + 1

        motion, count = loop(is_passed, sampled, (c.motion, c.count), len(ts), len(ts), lambda kept: kept[0])
        steps = c.steps + jnp.stack([jnp.ones_like(count), keep.astype(count.dtype)])
        return following._replace(
            made_jump=chosen(jumped, c.made_jump) if restart else None,
            running=following.running if max_steps is None else following.running & (steps[0] < max_steps),
            steps=steps, motion=motion, count=count, probe=probe,
        )  # fmt: skip

    def loop(
        condition: Callable[..., Array],
        body: Callable[..., PyTree],
        carry: PyTree,
        most: int | None,
        checkpoints: int | None,
        buffers: Callable[..., PyTree],
    ) -> Any:
        # The loop of diffrax counts its steps if the derivative requires it.
        more: dict[str, Any] = {} if kind == "lax" else {"max_steps": most}
        more |= {"checkpoints": checkpoints} if kind == "checkpointed" else {}
        return eqxi.while_loop(condition, body, carry, buffers=buffers, kind=kind, **more)

    def buffers(c: Carry) -> Any:
        # Not `c.jumps is None`: equinox calls this with wrapped leaves.
        more = [*(() if jumps is None else c.jumps[:-1]), *(() if probing is None else [c.probe.ends])]  # pyright: ignore
        return [c.motion, *more]

    last = loop(lambda c: c.running, step, carry, max_steps, checkpoints, buffers)
    reached = jnp.arange(len(ts)) < last.count
    if replay is None:
        state = ControllerState.unpacked(last.controller_state[0], n_events)
        taken, accepted = last.steps
        after = None if last.jumps is None else last.jumps.after
        replay = None if last.probe is None else Replay.of(last.probe, after, state, taken, accepted)
    else:
        state, taken, accepted = replay.state, replay.taken, replay.accepted
    return Steps(
        last.motion, reached, last.t0, motion_of(last.y), last.rates, state, taken, accepted, last.jumps,
        last.n_jumps, replay,
    )  # fmt: skip


def diffrax_loop(
    rates: Callable[..., Array],
    solver: diffrax.AbstractSolver,
    controller: StepSizeController,
    y0: Array,
    args: RateArguments,
    ts: Array,
    adjoint: diffrax.AbstractAdjoint,
    max_steps: int | None,
    may_begin: Array,
    progress: bool,
) -> Steps:
    """The same steps by `diffrax.diffeqsolve`, with all of its features.

    For an implicit-explicit solver, all equations are implicit.
    """
    term: Any = diffrax.ODETerm(rates)  # pyright: ignore[reportArgumentType]
    if solver.term_structure is not diffrax.AbstractTerm:
        term = diffrax.MultiTerm(diffrax.ODETerm(lambda t, y, args: jnp.zeros_like(y)), term)
    start, order = jnp.zeros_like(controller.duration), solver.error_order(term)
    _, (state, inner) = controller.init(term, start, controller.duration, y0, None, args, solver.func, order)
    # If the initial check failed, the simulation ends after its first step.
    state = state.at[0].set(jnp.where(may_begin, state[0], float(Status.INVALID)))
    whole = not isinstance(adjoint, diffrax.BacksolveAdjoint)  # BacksolveAdjoint can save states at given times only
    saveat = diffrax.SaveAt(ts=ts)
    if whole:
        subs = [diffrax.SubSaveAt(ts=ts), diffrax.SubSaveAt(t1=True)]
        saveat = diffrax.SaveAt(subs=subs, controller_state=True)
    solution: Any = diffrax.diffeqsolve(
        term, solver, start, controller.duration, None, y0, args, saveat=saveat, stepsize_controller=controller,
        adjoint=adjoint, max_steps=max_steps, throw=False, controller_state=(state, inner),
        progress_meter=diffrax.TqdmProgressMeter() if progress else diffrax.NoProgressMeter(),
    )  # fmt: skip
    stats = (solution.stats["num_steps"], solution.stats["num_accepted_steps"])
    if whole:
        (kept_at, last_at), (motion, last) = solution.ts, solution.ys
        state = ControllerState.unpacked(solution.controller_state[0], len(controller.events.names))
        return Steps(motion, jnp.isfinite(kept_at), last_at[0], last[0], None, state, *stats)
    reached = jnp.isfinite(solution.ts)
    i = jnp.maximum(jnp.sum(reached) - 1, 0)
    long = solution.result == diffrax.RESULTS.max_steps_reached
    early = jnp.where(long, float(Status.MAX_STEPS), float(Status.STEP_TOO_SMALL))
    status = jnp.where(reached[-1], state[0], early)
    state = ControllerState.unpacked(state, len(controller.events.names))._replace(status=status)
    return Steps(solution.ys, reached, ts[i], solution.ys[i], None, state, *stats)
