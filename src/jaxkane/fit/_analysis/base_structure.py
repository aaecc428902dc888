"""Base parameters from the regressor at random states: which columns are sums of others, whatever moves.

Columns of the regressor that are always zero have no influence; columns that are always the same sum of others can only
be determined with those. What remains are base parameters: as many numbers as the equations of motion have, and no
fewer (Gautier and Khalil, Direct calculation of minimum set of inertial parameters of serial robots, IEEE Transactions
on Robotics and Automation, 1990; Gautier, Numerical calculation of the base inertial parameters of robots, Journal of
Robotic Systems, 1991).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import qr

from ..._description.system import System
from ..._method.assembly import assemble
from ..._method.drift import has_configuration_constraints
from ..._scalars.versions import compiled
from .._result.base_parameters import BaseParameters, sum_in_words
from .columns import Chosen, values_by_name
from .instants import Instants

_ORDER = ("Ixx", "Ixy", "Ixz", "Iyz", "Izz", "mx", "my", "mz", "Iacross", "Iyy", "m")
"""Of a body's parameters: what comes late is counted among what comes early, where it can be."""


def equations_at(chosen: Chosen, at: Instants) -> tuple[tuple[str, ...], np.ndarray, np.ndarray, np.ndarray]:
    """The names of the speeds, and Y (N, n, p), tau (N, n) and the trials (N,) of all instants at which they exist."""
    dtype = jnp.result_type(float)
    # Padded to a power of two with the last instant, so that few different sizes are compiled.
    n = len(at)
    places = np.minimum(np.arange(1 << (n - 1).bit_length()), n - 1)
    row = [jnp.asarray(x[places], dtype) for x in (at.t, at.q, at.u, at.u_dot)]
    inputs = {name: jnp.asarray(x[places], dtype) for name, x in at.inputs.items()}
    Y, tau = (x[:n] for x in jax.device_get(_at_all(chosen, *row[:3], inputs, row[3])))
    fine = np.all(np.isfinite(Y), axis=(1, 2)) & np.all(np.isfinite(tau), axis=1)
    if not fine.any():
        raise ValueError(
            f"{type(chosen.system).__name__}: the equations of motion exist at none of the {len(at)} instants: are the "
            "constraints singular there, or numbers not finite?"
        )
    return chosen.system.speeds, Y[fine], tau[fine], at.trial[fine]


@compiled
def _at_all(chosen, t, q, u, inputs, u_dot):
    found = jax.vmap(chosen.at)(t, q, u, inputs, u_dot)
    return found.matrix, found.forces


def random_states(system: System, n: int) -> Instants:
    """States that the constraints admit, near and far."""
    rng, dtype = np.random.default_rng(0), jnp.result_type(float)
    n_q, n_u = len(system.coordinates), len(system.speeds)
    t = rng.uniform(0.0, 1.0, n)
    q = rng.uniform(-2.5, 2.5, (n, n_q))
    if has_configuration_constraints(system, jnp.zeros((), dtype), jnp.zeros(n_q, dtype)):
        t = rng.uniform(0.0, 1.0, 12 * n)
        # Half of them anywhere; half at all distances from zero, where a closed loop is often drawn.
        sizes = np.concatenate([np.full(6 * n, np.pi), np.geomspace(0.05, 2.5, 6 * n)])
        q = sizes[:, None] * rng.uniform(-1.0, 1.0, (12 * n, n_q))
        q = np.array(_assembled(system, jnp.asarray(t, dtype), jnp.asarray(q, dtype)))
        fine = np.flatnonzero(np.all(np.isfinite(q), axis=1))
        if len(fine) < n:
            raise ValueError(
                f"{type(system).__name__}: {len(fine)} of {len(q)} random coordinates could be assembled, and {n} are "
                "needed to find what motions determine: give a Regressor of states of your own, by jax.vmap."
            )
        fine = fine[np.linspace(0, len(fine) - 1, n).astype(int)]
        t, q = t[fine], q[fine]
    inputs = {name: rng.normal(0.0, 3.0, n) for name in values_by_name(system)}
    return Instants(t, q, rng.normal(0.0, 3.0, (n, n_u)), rng.normal(0.0, 10.0, (n, n_u)), inputs)


@compiled
def _assembled(system, t, q):
    return jax.vmap(lambda t, q: assemble(system, q, t=t).q)(t, q)


def structure_of(
    names: Sequence[str], units: Sequence[str], values: np.ndarray, Y: np.ndarray, tau: np.ndarray
) -> BaseParameters:
    W = Y.reshape(-1, len(names)).astype(float)
    eps = float(np.finfo(Y.dtype).eps)
    norms = np.linalg.norm(W, axis=0)
    seen = norms > eps**0.75 * norms.max(initial=0.0)
    order = sorted((int(i) for i in np.flatnonzero(seen)), key=lambda i: _rank(names, i))
    places = _independent(W / np.where(seen, norms, 1.0), order, eps**0.5)
    B = np.zeros((len(places), len(names)))
    if places:
        others = [i for i in order if i not in places]
        beta = np.linalg.lstsq(W[:, places] / norms[places], W[:, others] / norms[others], rcond=None)[0]
        beta = np.where(np.abs(beta) > eps**0.5, beta, 0.0)
        B[:, others] = beta * norms[others] / norms[places][:, None]
        B[np.arange(len(places)), places] = 1.0
    size = np.abs(W) @ np.abs(values) if len(W) else np.zeros(1)
    free = bool(np.linalg.norm(tau) <= 1e3 * eps * np.linalg.norm(size)) and bool(places)
    b = len(places)
    texts = tuple(sum_in_words(names, B[j], place, [f"{abs(x):.4g}" for x in B[j]]) for j, place in enumerate(places))
    nothing = np.full(b, np.nan)
    return BaseParameters(
        tuple(names), tuple(units), values, tuple(int(i) for i in places), B, texts,
        tuple(names[i] for i in np.flatnonzero(~seen).tolist()), free, nothing, nothing, np.full((b, b), np.nan),
        np.full((b, b), np.nan), (), None, {},
        float("nan"),
    )  # fmt: skip


def _rank(names: Sequence[str], i: int) -> tuple[int, int]:
    """Bodies in their order, their parameters as in `_ORDER`; all others at the end."""
    bodies = list(dict.fromkeys(name.rpartition(".")[0] for name in names))
    body, _, last = names[i].rpartition(".")
    return (bodies.index(body), _ORDER.index(last)) if last in _ORDER else (len(names), i)


def _independent(W: np.ndarray, order: Sequence[int], tolerance: float) -> list[int]:
    """Places of the columns that are no sums of those before them in this order; by QR with pivoting where rounding
    makes the order a bad one."""
    Q = np.zeros((len(W), 0))
    places = []
    for i in order:
        rest = W[:, i]
        for _ in range(2):  # Gram and Schmidt, twice is enough
            rest = rest - Q @ (Q.T @ rest)
        size = np.linalg.norm(rest)
        if size > tolerance:
            Q = np.column_stack([Q, rest / size])
            places.append(i)
    chosen = W[:, list(order)]
    s = np.linalg.svd(chosen, compute_uv=False) if len(order) else np.zeros(0)
    rank = int(np.sum(s > tolerance * s[:1].max(initial=0.0)))
    if rank != len(places):
        found: Any = qr(chosen, mode="r", pivoting=True)
        pivots = found[1]
        places = sorted((order[i] for i in pivots[:rank]), key=list(order).index)
    return places
