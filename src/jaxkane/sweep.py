"""Many simulations at once. Knows batches, chunks and `simulate`; knows no mechanism.

On the CPU the members of a chunk are solved in small groups, one group after the other: as many as the vector units
can use, and few enough that one that needs many steps keeps few others waiting. One that falls or is nonsense stops
where it is. On other devices a chunk goes in step (`vmap`).
"""

from __future__ import annotations

import sys
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from ._signals import Samples, as_signals
from ._simulate import Settings, checked_times, settings_for, solve
from ._system import State, System, parameter_info
from ._trajectory import Status, Trajectory
from ._types import Inputs

_GROUP = 32


def sweep(
    system: System,
    state: State,
    ts: Any,
    inputs: Inputs = None,
    *,
    chunk: int = 256,
    progress: bool = False,
    **options: Any,
) -> Trajectory:
    """`simulate` for a batch of systems, initial states or inputs, in chunks of bounded memory.

    **Arguments:**

    - `system`: any parameter may have a leading axis (b, ...) of members.
    - `state`: `q` (b, n_q) or (n_q,), `u` (b, n_u) or (n_u,).
    - `ts` (n_t,): times [s], the same for all.
    - `inputs`: as for `simulate`; samples may be (b, n_t), and numbers that differ from member to member (b, 1).
    - `chunk`: members in one compiled call. `progress`: show a progress bar.
    - `options`: those of `simulate`: rtol, atol, solver, step, adjoint, max_steps.

    **Returns:** a `Trajectory` with a leading axis (b,). A member that is not finite, has a parameter that must be
    positive and is not, or violates a constraint gets the status `Status.INVALID`; one that falls or breaks down its
    own status; all with NaN from there on. After Ctrl-C what is finished comes back, the rest as `INTERRUPTED`.

    **Raises:** `ValueError` when nothing is a batch, or two batches differ in length.
    """
    ts = checked_times(ts, state.q.dtype)
    settings = settings_for(ts, progress=False, **options)
    members, shared, n = _split(system, state, _signals(inputs, system, ts), ts)
    # The last chunk is filled up with copies of its last member, so that one program serves all.
    size = _GROUP * -(-min(chunk, n) // _GROUP) if n > _GROUP else n
    starts = range(0, n, size)
    done: list[Trajectory] = []
    try:
        for start in tqdm(starts, disable=not progress, unit="chunk", file=sys.stderr):
            places = np.minimum(np.arange(start, start + size), n - 1)
            part = _solve_chunk(jax.tree.map(lambda x: x[places], members), shared, ts, settings)  # noqa: B023
            part = jax.block_until_ready(part)
            done.append(jax.tree.map(lambda x: x[: min(n - start, size)], part))  # noqa: B023
    except KeyboardInterrupt:
        if not done:
            raise
    result = jax.tree.map(lambda *parts: jnp.concatenate(parts), *done)
    return _fill_up(result, n)


@eqx.filter_jit
def _solve_chunk(members: Any, shared: Any, ts: Any, settings: Settings) -> Trajectory:
    def one(member):
        system, state, signals = eqx.combine(member, shared)
        return solve(system, state, ts, signals, settings)

    if jax.default_backend() != "cpu":
        return jax.vmap(one)(members)
    n = jax.tree.leaves(members)[0].shape[0]
    group = min(n, _GROUP)  # n is a multiple of it
    groups = jax.tree.map(lambda x: x.reshape(n // group, group, *x.shape[1:]), members)
    return jax.tree.map(lambda x: x.reshape(n, *x.shape[2:]), jax.lax.map(jax.vmap(one), groups))


def _signals(inputs: Inputs, system: System, ts: Any) -> Any:
    """Signals as `simulate` takes them; samples may have a leading axis of members."""
    if inputs is None or callable(inputs):
        return as_signals(inputs, system.inputs, ts, type(system).__name__)
    single, batches = {}, {}
    for name, value in inputs.items():
        array = None if callable(value) else jnp.asarray(value, dtype=ts.dtype)
        if array is None or array.ndim < 2:
            single[name] = value
        elif array.ndim == 2 and array.shape[1] in (1, ts.shape[0]):
            batches[name] = array
        else:
            raise ValueError(
                f"The input {name!r} of a sweep is a number, samples (n_t,), or a batch (b, n_t) or (b, 1) with n_t = "
                f"{ts.shape[0]}; got the shape {array.shape}."
            )
    known = as_signals(single | dict.fromkeys(batches, 0.0), system.inputs, ts, type(system).__name__)
    for name, array in batches.items():
        known[name] = array[:, 0] if array.shape[1] == 1 else Samples(ts, array)
    return known


def _split(system: System, state: State, signals: Any, ts: Any) -> tuple[Any, Any, int]:
    """What differs from member to member, what is shared, and how many members there are."""
    is_member: dict[int, str] = {}
    for name, info in parameter_info(system).items():
        value = getattr(system, name)
        if np.ndim(value) == len(info.shape) + 1:
            is_member[id(value)] = name
    for name, value in (("q", state.q), ("u", state.u)):
        if value.ndim == 2:
            is_member[id(value)] = f"state.{name}"
    if isinstance(signals, dict):
        for name, signal in signals.items():
            values = signal.values if isinstance(signal, Samples) else signal
            if isinstance(values, jax.Array) and values.ndim == (2 if isinstance(signal, Samples) else 1):
                is_member[id(values)] = name
    tree = (system, state, signals)
    members, shared = eqx.partition(tree, jax.tree.map(lambda x: id(x) in is_member, tree))
    lengths = {is_member[id(x)]: x.shape[0] for x in jax.tree.leaves(members)}
    if not lengths:
        raise ValueError(
            "sweep: nothing here is a batch. Give a parameter, state.q, state.u or an input a leading axis; for one "
            "motion call jaxkane.simulate."
        )
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} ({n})" for name, n in lengths.items())
        raise ValueError(f"sweep: the batches differ in length: {listed}.")
    return members, shared, next(iter(lengths.values()))


def _fill_up(result: Trajectory, n: int) -> Trajectory:
    """The trajectory with members that were not reached, as NaN."""
    missing = n - result.status.shape[0]
    if not missing:
        return result

    def filled(x):
        empty = jnp.full((missing, *x.shape[1:]), jnp.nan if jnp.issubdtype(x.dtype, jnp.inexact) else 0, x.dtype)
        return jnp.concatenate([x, empty])

    status = jnp.concatenate([result.status, jnp.full(missing, Status.INTERRUPTED, result.status.dtype)])
    return eqx.tree_at(lambda r: r.status, jax.tree.map(filled, result), status)
