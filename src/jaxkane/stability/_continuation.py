"""Families of steady motions by pseudo-arclength continuation, through their folds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._common.lookup import by_name, hint
from .._integrate.trajectory import refuse_other_system
from .._kane.constraint_residuals import coordinate_units
from .._scalarjit.cache_key import jit
from .._scalarjit.components import Numbers
from .._system.prints import text_of, wrapped
from .._system.system import System, names_of, unit_of, units_of
from ._steady import SteadyEquations, SteadyMotion, as_motion, jacobian, quantity, row_sizes


class Family(eqx.Module):
    """Steady motions along a curve, by name: `turns["steer"]` (m,). `turns.motion(i)` is the i-th `SteadyMotion`.

    Attributes:

    - `q` (m, n_q), `u` (m, n_u), `u_dep` (m, k): coordinates, independent and dependent speeds.
    - `x` (m, n_x): states of the first order.
    - `inputs`: by name.
    - `arclength` (m,): in the scaled unknowns.
    - `residual` (m,): as of a `SteadyMotion`.
    - `reason`: why the family ends.
    - `units`: pairs of a name and its unit, as the system declares them.
    """

    q: Float[Array, "m n_q"]
    u: Float[Array, "m n_u"]
    u_dep: Float[Array, "m k"]
    x: Float[Array, "m n_x"]
    arclength: Float[Array, " m"]
    residual: Float[Array, " m"]
    inputs: dict[str, Any]
    t: Any
    names: tuple[tuple[str, ...], ...] = eqx.field(static=True)
    reason: str = eqx.field(static=True)
    units: tuple[tuple[str, str], ...] = eqx.field(static=True, default=())

    def motion(self, i: Numbers) -> SteadyMotion:
        inputs = {k: x[i] if jnp.ndim(x) else x for k, x in self.inputs.items()}
        parts = (self.q[i], self.u[i], self.u_dep[i], self.x[i])
        return SteadyMotion(*parts, inputs, self.t, self.residual[i], self.names, self.units)

    def __getitem__(self, name: str) -> Float[Array, " m"]:
        groups = zip(self.names, (self.q, self.u, self.u_dep, self.x), strict=True)
        return by_name(name, groups, self.inputs, "this family")

    def __len__(self) -> int:
        return len(self.arclength)

    def __repr__(self) -> str:
        text = f"Family({len(self)} steady motions over {float(self.arclength[-1]):.4g}: {self.reason})"
        names, units = [*(name for group in self.names for name in group), *self.inputs], dict(self.units)
        columns = {name: np.asarray(self[name]) for name in names if np.ndim(self[name])}
        change = {name: np.ptp(column) for name, column in columns.items()}
        items = [
            f"{name} {text_of(column[0])} to {text_of(column[-1], unit_of(name, units))}"
            for name, column in columns.items()
            if change[name] > 1e-9 * max(change.values())
        ]
        return "\n".join([text, *map(wrapped, items)])


def steady_family(
    system: System,
    start: SteadyMotion,
    *,
    towards: Mapping[str, float],
    until: Mapping[str, float] | None = None,
    hold: tuple[str, ...] = (),
    find: tuple[str, ...] = (),
    step: float = 0.05,
    max_step: float | None = None,
    steps: int = 500,
) -> Family:
    """The family of steady motions through one of them, by pseudo-arclength continuation.

        F(z) = 0,   tangent . (z - z_predicted) = 0

    z are the unknowns of `steady_turn`: non-cyclic coordinates, independent speeds and inputs to find. F are its
    equations. The arclength is measured in scaled unknowns and has no unit. Angles are in rad; speeds and inputs are
    relative to their values at the start. Lengths and unknowns that are zero at the start are scaled by the change that
    balances the terms of an equation. The step is halved if Newton's method fails, and increased if it converges
    quickly. The curve can be followed through folds.

    **Arguments:**

    - `start`: a steady motion from `steady_turn`.
    - `towards`: {name: +1 or -1}, the initial direction.
    - `until`: {name: value} of coordinates and speeds, also dependent ones. The family ends exactly at the first of
        these values that it reaches.
    - `hold`: as in `steady_turn`, but one quantity less, because the family is a curve.
    - `find`: as in `steady_turn`.
    - `step`: the first step of arclength.
    - `max_step`: the largest step of arclength; four times `step` by default.
    - `steps`: the largest number of steps.

    **Returns:** a `Family`, whose first member is `start`. Its members are not differentiable; pass one to
    `steady_turn` for that.

    **Raises:** `ValueError` if no curve, or more than one, passes through the start.
    """
    label = f"family({type(system).__name__})"
    if not isinstance(start, SteadyMotion):
        raise TypeError(f"{label}: `start` must be a SteadyMotion, e.g. from steady_turn; got {start!r}.")
    refuse_other_system(label, system, start)
    q, t = start.q, jnp.asarray(start.t, start.q.dtype)
    inputs = {**start.inputs, **{name: start.x[i] for i, name in enumerate(system.states)}}
    find, until = (*find, *system.states), dict(until or {})
    equations = SteadyEquations(system, find, tuple(hold))
    SteadyEquations(system, find, tuple(until))  # refuses a name that is neither a coordinate nor a speed
    targets = [quantity(system, t, q, start.u, k) for k in equations.hold]
    targets = jnp.stack(targets) if targets else jnp.zeros(0, q.dtype)
    args = system, t, q, start.u, inputs, targets
    z0 = equations.unknowns(q, start.u, inputs)
    scale = np.asarray(_scale(equations, z0, args))
    limits, names = np.array(list(until.values()), float), tuple(until)

    def evaluate(y):
        found = _residual_and_slope(
            equations, jnp.asarray(y * scale, q.dtype), args, jnp.asarray(scale, q.dtype), names
        )
        F, J, g, G = map(np.asarray, found)
        G = G * scale
        size = np.maximum(np.abs(limits), np.linalg.norm(G, axis=1))
        size = np.where(size > 0, size, 1.0)
        return F, J * scale, (g - limits) / size, G / size[:, None]

    curve = SolutionCurve(evaluate, float(jnp.finfo(q.dtype).eps))
    y = np.asarray(z0) / scale
    tangent = curve.tangent(y, None)
    tangent = tangent * _direction_sign(equations, system, tuple(hold), towards, tangent, curve, y)
    max_step = 4 * step if max_step is None else max_step
    points, arc, met = curve.follow(y, tangent, step, max_step, steps)
    reason = f"{steps} steps"
    if met is not None:
        name, value = list(until.items())[met]
        reason = f"{name} = {value:g}"
    elif len(points) <= steps:
        reason = "no further motion was found: equations or coordinates become singular"
    return _as_family(equations, args, np.array(points) * scale, jnp.asarray(scale, q.dtype), arc, reason)


class SolutionCurve:
    """Newton's method on a curve F(y) = 0 with fewer equations than unknowns, and the tangents of the curve.

    - `evaluate`: (y) -> F, dF/dy, limits g, dg/dy, all relative to their sizes.
    - `eps`: their rounding error.
    """

    def __init__(self, evaluate: Any, eps: float):
        self.evaluate, self.eps = evaluate, eps

    def tangent(self, y, before: Any) -> Any:
        J = self.evaluate(y)[1]
        if not np.all(np.isfinite(J)):
            return None
        _, s, Vt = np.linalg.svd(J)
        if before is None:
            return Vt[-1]
        # At a bifurcation two directions are possible. Take the one nearest to the last step.
        null = Vt[np.append(s, np.zeros(len(Vt) - len(s))) < max(1e-7, 100 * self.eps) * s[0]]
        null = Vt[-1:] if len(null) == 0 else null
        ahead = null.T @ (null @ before)
        return ahead / np.linalg.norm(ahead)

    def follow(self, y, tangent, step: float, max_step: float, steps: int):
        """Follow the curve from y. **Returns:** points, their arclengths, and the index of the limit that ended it, or
        None."""
        points, arc, h = [y], [0.0], step
        while len(points) <= steps and h >= 1e-4 * step:
            attempt = self.correct(y + h * tangent, tangent)
            new = None if attempt is None else self.tangent(attempt[0], tangent)
            if attempt is None or new is None or new @ tangent < 0.9:
                h /= 2
                continue
            z, quick = attempt
            passed = self._passed(y, z)
            ends = [(end, i) for i in passed if (end := self.land(y, z, tangent, i)) is not None]
            if passed and not ends:  # the limit lies nearer than the step
                h /= 2
                continue
            z, met = min(ends, key=lambda end: np.linalg.norm(end[0] - y)) if ends else (z, None)
            if not self.accepts(y, tangent, z, new, met):
                h /= 2
                continue
            points.append(z)
            arc.append(arc[-1] + float(np.linalg.norm(z - y)))
            if met is not None:
                return points, arc, met
            y, tangent = z, self.tangent_ahead(z, new)
            h = min(max_step, 1.5 * h) if quick else h
        return points, arc, None

    def accepts(self, y, tangent, z, new, met: int | None) -> bool:
        """Whether the step from y to z is kept. Otherwise it is repeated with half of its length.

        `new`: the tangent at z. `met`: the limit that ends the curve at z, or None.
        """
        return True

    def tangent_ahead(self, y, new) -> Any:
        """The tangent with which the curve continues from y."""
        return new

    def _passed(self, y, z) -> list[int]:
        """The limits that change sign between two points. A limit that is zero at the first point is not counted
        again."""
        before, after = self.evaluate(y)[2], self.evaluate(z)[2]
        return [int(i) for i in np.nonzero((before < 0) != (after < 0))[0] if abs(before[i]) > 4e6 * self.eps]

    def correct(self, y, tangent, tries: int = 12):
        start = y
        for k in range(tries):
            F, J, _, _ = self.evaluate(y)
            if not (np.all(np.isfinite(F)) and np.all(np.isfinite(J))):
                return None
            dy = np.linalg.lstsq(np.vstack([J, tangent]), -np.append(F, tangent @ (y - start)), rcond=1e-9)[0]
            y = y + dy
            if np.all(np.abs(dy) <= 4e3 * self.eps * np.maximum(1.0, np.abs(y))):
                F = self.evaluate(y)[0]
                return (y, k <= 4) if np.all(np.isfinite(F)) and np.abs(F).max() < self.eps**0.5 else None
        return None

    def land(self, a, b, tangent, i: Numbers) -> Any:
        """The point between a and b at which the i-th limit is met."""
        y = a
        for _ in range(20):  # follow the curve: another one may cross it at the limit
            g, G = self.evaluate(y)[2:]
            slope = G[i] @ tangent
            ds = -g[i] / slope if slope else np.inf
            if abs(ds) < 400 * self.eps:
                break
            if not abs(ds) <= 2 * np.linalg.norm(b - a):
                return None
            # Take 0.9 of a long step: at a crossing, Newton's method may converge to the other curve.
            attempt = self.correct(y + (ds if abs(ds) < 1e-5 else 0.9 * ds) * tangent, tangent)
            tangent = None if attempt is None else self.tangent(attempt[0], tangent)
            if attempt is None or tangent is None:
                return None
            y = attempt[0]
        F, J, g, G = self.evaluate(y)
        bordered = np.vstack([J, G[[i]]])
        if np.linalg.svd(bordered, compute_uv=False)[-1] > 1e-7:
            y = y + np.linalg.lstsq(bordered, -np.append(F, g[i]), rcond=None)[0]
        return y


@jit
def _residual_and_slope(equations: SteadyEquations, z, args, scale, names: tuple[str, ...]):
    """Residuals F (m,) relative to the sizes of their terms, quantities g by name, and the derivatives of both."""
    system, t, q, u, inputs, _ = args

    def both(z):
        at = equations.parts(z, q, u, inputs)[:2]
        g = [quantity(system, t, *at, k) for k in names]
        return equations.residual(z, args), jnp.stack(g) if g else jnp.zeros(0, z.dtype)

    F, g = both(z)
    J, G = jacobian(both, z)
    sizes = row_sizes(J, (equations.sizes(z, jnp.abs(z), args)[0], scale))
    return F / sizes, J / sizes[:, None], g, G


@jit
def _scale(equations: SteadyEquations, z, args):
    """The scale (n,) of each unknown, in its unit, for the arclength.

    1 for an angle; the value itself for speeds and inputs. For lengths and small values, the scale is the change that
    changes the equations by the size of their terms.
    """
    sizes = equations.sizes(z, jnp.abs(z), args)
    J = jacobian(lambda z: equations.residual(z, args), z)
    length = jnp.linalg.norm(J / row_sizes(J, sizes)[:, None], axis=0)
    by_effect = jnp.where(length > 1e-9, 1 / jnp.where(length > 1e-9, length, 1.0), jnp.abs(z))
    units, names = dict(zip(args[0].coordinates, coordinate_units(args[0]), strict=True)), equations.names
    is_angle = np.array([units.get(k) == "rad" for k in names], bool)
    is_coordinate = np.arange(len(names)) < len(equations.q_free)
    scale = jnp.where(~is_coordinate & (jnp.abs(z) > 1e-3 * by_effect), jnp.abs(z), by_effect)
    return jnp.where(is_angle | ~(scale > 0), 1.0, scale)


def _direction_sign(
    equations: SteadyEquations, system: System, hold: tuple[str, ...], towards, tangent, curve: SolutionCurve, y
) -> float:
    label = type(system).__name__
    (name, sign), *more = towards.items()
    if more or name not in (*equations.names, *hold):
        one_of = hint(name, equations.names, "it is one of")
        raise ValueError(f"family: `towards` must be one name with +1 or -1, got {dict(towards)}; {one_of}")
    J = curve.evaluate(y)[1]
    s = np.zeros(J.shape[1])  # with inputs to find there are fewer equations than unknowns
    s[: len(J)] = np.linalg.svd(J, compute_uv=False)[: len(s)]
    if s[-1] > max(1e-8, 100 * curve.eps) * s[0]:
        raise ValueError(
            f"{label}: no curve of steady motions passes through the start: too many quantities are held "
            f"({', '.join(hold) or 'none'}). Remove one from `hold`."
        )
    if s[-2] < max(1e-10, 10 * curve.eps) * s[0]:
        raise ValueError(
            f"{label}: more than one curve of steady motions passes through the start. Add quantities to "
            "`hold`, or start at some distance from the bifurcation."
        )
    if name in hold:
        raise ValueError(f"{label}: {name} is in `hold`, so it cannot change along the family. Name another.")
    return float(np.sign(sign * tangent[equations.names.index(name)]) or 1.0)


def _as_family(equations: SteadyEquations, args, zs, scale, arc, reason) -> Family:
    system, t, q, u, inputs, _ = args

    @jax.jit
    @jax.vmap
    def members(z):
        r = jnp.max(jnp.abs(_residual_and_slope(equations, z, args, scale, ())[0]))
        motion = as_motion(system, t, *equations.parts(z, q, u, inputs), r)
        trim = {k: motion.inputs[k] for k in equations.find if k in motion.inputs}
        return (motion.q, motion.u, motion.u_dep, motion.x), motion.residual, trim

    (q_all, u_all, u_dep, x), residual, trim = members(jnp.asarray(zs, q.dtype))
    inputs = {k: x for k, x in {**inputs, **trim}.items() if k not in system.states}
    names, units = names_of(system), tuple(units_of(system).items())
    return Family(q_all, u_all, u_dep, x, jnp.asarray(arc), residual, inputs, t, names, reason, units)
