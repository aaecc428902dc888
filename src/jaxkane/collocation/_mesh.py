"""Local errors of intervals, meshes that follow them, and polynomials between nodes."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate
from jaxtyping import Array, Float

from .._collocate.functions import Dynamics, Integrand, Now
from .._collocate.lobatto import Lobatto
from .._collocate.program import Block, EvaluatedBlock, padded
from .._collocate.transcription import Layout, Motion
from .._integrate.inputs import InputState, Signals
from .._scalarjit.cache_key import jit
from .._scalarjit.components import Component
from .._system.system import State, System, with_class


class ControlPolynomial(eqx.Module):
    """A control over time, as a function of (t, state): a polynomial in each interval of a mesh.

    Attributes:

    - `mesh` (N + 1,): the ends of the intervals [s].
    - `coefficients` (N, s): of powers of the fraction of the interval, from the constant on.
    """

    mesh: Float[Array, " N_1"]
    coefficients: Float[Array, "N s"]

    def __call__(self, t: Component, state: State | InputState | None = None) -> Array:
        i, u = place_in_mesh(jnp.asarray(self.mesh), t)
        value = jnp.zeros_like(u)
        for k in range(self.coefficients.shape[1] - 1, -1, -1):
            value = value * u + self.coefficients[i, k]
        return value


def place_in_mesh(mesh: Array, t: Component) -> tuple[Array, Array]:
    """The index of the interval that contains a time, and the fraction of the interval."""
    at = jax.lax.stop_gradient(jnp.asarray(t, mesh.dtype))
    i = jnp.clip(jnp.sum(mesh <= at, dtype=jnp.int32) - 1, 0, mesh.shape[0] - 2)
    return i, (t - mesh[i]) / (mesh[i + 1] - mesh[i])


def coefficients_of(values: np.ndarray, method: Lobatto) -> np.ndarray:
    """The coefficients (N, s, ...) of the polynomials through the values (K, ...) at the nodes of each interval."""
    s = len(method.c)
    N = (len(values) - 1) // (s - 1)
    inside = values[(np.arange(N) * (s - 1))[:, None] + np.arange(s)]
    powers = np.vander(method.c, s, increasing=True)
    return np.moveaxis(np.tensordot(np.linalg.inv(powers), inside, axes=(1, 1)), 0, 1)


def interpolated(motion: Motion, mesh: np.ndarray, method: Lobatto, s: np.ndarray) -> Motion:
    """The polynomials of a motion at other nodes (n,)."""
    i = np.clip(np.searchsorted(mesh, s, side="right") - 1, 0, len(mesh) - 2)
    u = (s - mesh[i]) / (mesh[i + 1] - mesh[i])
    powers = np.vander(u, len(method.c), increasing=True)

    def at(values: np.ndarray) -> np.ndarray:
        return np.einsum("nk,nki->ni", powers, coefficients_of(values, method)[i])

    return Motion(s, motion.duration, at(motion.Y), at(motion.W))


def local_errors(
    layout: Layout, x: np.ndarray, motion: Motion, method: Lobatto, scales: np.ndarray, tolerance: float
) -> np.ndarray:
    """The error (N,) of each interval at its end, relative to the sizes of the states, or to half of their range.

    Each interval is integrated from its own start with the polynomials of its controls, by 1, 2, 4, ... steps, until
    the error of the integration does not matter. An interval that needs more than 1024 steps has an infinite error.

    **Arguments:** as in `quadrature_errors`, and

    - `scales` (n_z,): typical sizes of states and controls.
    - `tolerance`: the error of the integration may be a tenth of it, or of the local error.
    """
    every, n_y = len(method.c) - 1, motion.Y.shape[1]
    function = Dynamics(dataclasses.replace(layout.variables, signals=layout.problem.signals))  # sampled inputs too
    C, errors, k = coefficients_of(motion.W, method), np.full(len(layout.mesh) - 1, np.inf), 1
    # A guess of coordinates alone tells little of speeds: their range in the solution may be fifty times as large.
    sizes = np.maximum(scales[:n_y], 0.5 * np.ptp(motion.Y, axis=0))
    unsure, starts, ends = np.arange(len(errors)), motion.Y[:-1:every], motion.Y[every::every]
    while len(unsure) and k <= 1024:
        found = []
        for i in range(0, len(unsure), _CHUNK):
            at = unsure[np.minimum(np.arange(i, i + _CHUNK), len(unsure) - 1)]
            s = layout.mesh[at], layout.mesh[at + 1]
            found.append(np.asarray(_integrated(function, *s, starts[at], C[at], x[layout.shared], k)))
        end, doubt = np.concatenate(found)[: len(unsure)].swapaxes(0, 1)
        error = np.max(np.abs(end - ends[unsure]) / sizes, axis=1)
        sure = np.max(doubt / sizes, axis=1) <= 0.1 * np.maximum(tolerance, error)  # False if anything is not finite
        errors[unsure[sure]] = error[sure]
        unsure, k = unsure[~sure], 2 * k
    return errors


_CHUNK = 64  # intervals that are integrated together, so that every mesh uses the same compiled program


@jit
def _integrated(
    function: Dynamics, first: Array, last: Array, Y: Array, C: Array, shared: Array, steps: Component
) -> Array:
    """The states at the ends of intervals, and the sums of their errors, (B, 2, n_y), by equal steps of DOP853.

    `simulate` would adapt its steps, but its program took 2 of the 4 s of a first solution.
    """
    method = scipy.integrate.DOP853
    A, b, c, e = (jnp.asarray(a) for a in (method.A[:12, :12], method.B, method.C[:12], method.E5[:12]))

    def one(first: Array, last: Array, y: Array, C: Array) -> Array:
        def rates(u: Array, y: Array) -> Array:
            powers = jnp.stack([u**k for k in range(C.shape[0])])  # an array of integers would be promoted
            node = {"s": first + u * (last - first), "inputs": {}}
            return (last - first) / steps * function(node, jnp.concatenate([y, powers @ C, shared]))

        def step(i: Array, reached: Array) -> Array:
            def stage(j: Array, K: Array) -> Array:
                return K.at[j].set(rates((i + c[j]) / steps, reached[0] + A[j] @ K))

            K = jax.lax.fori_loop(0, 12, stage, jnp.zeros((12, y.size)))
            return reached + jnp.stack([b @ K, jnp.abs(e @ K)])

        return jax.lax.fori_loop(0, steps, step, jnp.stack([y, jnp.zeros_like(y)]))

    return jax.vmap(one)(first, last, Y, C)


def without_events(system: System) -> System:
    """The system without its events: a planned motion ends where the problem states it."""
    own: Any = type(system)
    return system if own.events is System.events else with_class(system, _eventless(own))


@functools.cache  # a class for each class, so that compiled programs are used again
def _eventless(own: Any) -> Any:
    return type(own)(own.__name__, (own,), {"events": System.events, "__qualname__": own.__qualname__})


def jumps_inside(system: System, t: np.ndarray, Y: np.ndarray) -> dict[str, float]:
    """Events that would change the state inside a planned motion with the states Y (n_t, n_y): times by name.

    A function that is zero at the start or the end is not reported, because phases begin and end at events.
    """
    if type(system).events is System.events:
        return {}
    found = {}
    along = jax.tree.map(lambda a: np.asarray(a)[: len(t)], _events_along(system, padded(t), padded(Y)))
    for name, (g, when, direction) in along.items():
        near = np.abs(g) <= 1e-6 * np.max(np.abs(g))
        signs, times = np.sign(g)[~near], t[~near]
        crossed = (signs[1:] * signs[:-1] < 0) & (signs[1:] * direction[0] >= 0) & (when[~near][1:] > 0)
        if crossed.any():
            found[name] = float(times[1:][crossed][0])
    return found


@jit
def _events_along(system: System, t: Array, Y: Array) -> dict[str, tuple[Array, Array, Array]]:
    """The function, condition and direction (n_t,) each of the events that change the state."""

    def at(t: Array, y: Array) -> dict[str, Any]:
        events = Now(system, t, y, {}).events()
        like = lambda x: jnp.asarray(x, y.dtype)  # noqa: E731
        return {
            name: (like(e.value), like(1.0 if e.when is None else e.when), like(e.direction))
            for name, e in events.items()
            if e.stages
        }

    return jax.vmap(at)(t, Y)


def with_controls(signals: Signals, polynomials: dict[str, Any]) -> Any:
    """Other inputs together with controls, as `simulate` takes them."""
    if not callable(signals):
        return {**signals, **polynomials}

    def every(t: Component, state: InputState) -> dict[str, Any]:
        others: Any = signals(t, state)
        return {**others, **{name: f(t, state) for name, f in polynomials.items()}}

    return every


def refined(mesh: np.ndarray, errors: np.ndarray, tolerance: float, order: int, merges: bool = True) -> np.ndarray:
    """A finer mesh where errors are too large. If it `merges`, a coarser one where they are far below the tolerance.

    An interval of error e is divided into (e / tolerance)^(1 / order) parts, at most eight. Two neighbours become one
    interval if a tenth of the tolerance is not reached by its expected error, which grows with length^(order + 1).
    """
    with np.errstate(over="ignore"):
        parts = np.clip(np.ceil((errors / tolerance) ** (1.0 / order)), 1, 8).astype(int)
    new, i = [mesh[0]], 0
    roots = np.minimum(errors, 1.0) ** (1.0 / (order + 1))
    while i < len(errors):
        has_next = merges and i + 1 < len(errors) and parts[i] == parts[i + 1] == 1
        if has_next and (roots[i] + roots[i + 1]) ** (order + 1) < 0.1 * tolerance:
            new.append(mesh[i + 2])
            i += 2
            continue
        new.extend(np.linspace(mesh[i], mesh[i + 1], parts[i] + 1)[1:])
        i += 1
    return np.array(new)


def switch_errors(layout: Layout, motion: Motion, method: Lobatto) -> np.ndarray:
    """The error (N,) of intervals in which a control jumps between its bounds.

    Controls are continuous, so a jump takes one interval of length h. The time of the double integrator was too long by
    a third of (h / duration)^2, although the simulation of this interval is exact. An interval counts if a control
    changes by more than a third of the distance between its bounds. If this happens in more than a fifth of the
    intervals, the control oscillates, and shorter intervals would not help.
    """
    places = np.linspace(0.0, 1.0, 9)
    powers = np.vander(places, len(method.c), increasing=True)
    C = coefficients_of(motion.W, method)  # (N, s, n_w)
    errors = np.zeros(len(layout.mesh) - 1)
    for i, name in enumerate(layout.variables.controls):
        low, high = layout.problem.limits.get(name, (-math.inf, math.inf))
        if not low < high or not math.isfinite(high - low):
            continue
        share = np.ptp(C[:, :, i] @ powers.T, axis=1) / (high - low)
        if np.count_nonzero(share > _JUMP) <= 0.2 * len(errors):
            errors = np.maximum(errors, np.where(share > _JUMP, (share * np.diff(layout.mesh)) ** 2, 0.0))
    return errors


_JUMP = 1 / 3


def oscillating(layout: Layout, motion: Motion) -> list[str]:
    """The names of controls that oscillate from node to node, by two ratios.

    That of the second differences is 2 for a smooth control, 1 for jumps, 0.8 for noise, and 0 if all signs alternate.
    The mean change between nodes is a tenth of the range for 20 nodes per period, and a third for random jumps between
    two bounds.
    """
    D = np.diff(motion.W, 2, axis=0)
    alternates = np.sum(np.abs(D[1:] + D[:-1]), axis=0) < 0.9 * np.sum(np.abs(D), axis=0)
    jumps = np.mean(np.abs(np.diff(motion.W, axis=0)), axis=0) > 0.2 * np.ptp(motion.W, axis=0)
    return [name for name, x in zip(layout.variables.controls, alternates | jumps, strict=True) if x]


def quadrature_errors(layout: Layout, x: np.ndarray, motion: Motion, method: Lobatto) -> np.ndarray:
    """The error (N,) of the integral of the cost over each interval, against a quadrature with twice as many points.

    **Arguments:**

    - `layout`, `motion`: a phase and its motion.
    - `x` (n,): the variables of the nonlinear program.
    """
    cost = layout.problem.cost
    if cost is None:
        return np.zeros(len(layout.mesh) - 1)
    points, weights = np.polynomial.legendre.leggauss(2 * len(method.c))
    steps = np.diff(layout.mesh)
    inside = (padded(layout.mesh[:-1])[:, None] + padded(steps)[:, None] * (points + 1) / 2).ravel()
    fine = interpolated(motion, layout.mesh, method, inside)

    def values(s: np.ndarray, motion: Motion) -> np.ndarray:
        shared = np.tile(x[layout.shared], (len(s), 1))
        rows = np.concatenate([motion.Y, motion.W, shared], axis=1)
        columns = np.arange(rows.size).reshape(rows.shape)
        block = Block(Integrand(layout.variables, cost), layout.node_data(s), columns, 1)
        return EvaluatedBlock(block).values(rows.ravel()).ravel()

    at_nodes, every = values(layout.s, motion), len(method.c) - 1
    inside_nodes = (np.arange(len(steps)) * every)[:, None] + np.arange(every + 1)
    coarse = at_nodes[inside_nodes] @ method.b
    exact = (values(inside, fine).reshape(-1, len(weights)) @ (weights / 2))[: len(steps)]
    return np.abs(exact - coarse) * steps
