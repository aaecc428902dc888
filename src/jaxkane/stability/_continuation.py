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
from .._scalarjit.cache_key import jit
from .._system.system import System, names_of
from ._steady import SteadyEquations, SteadyMotion, as_motion, jacobian


class Family(eqx.Module):
    """Steady motions along a curve, by name: `turns["steer"]` (m,).

    Attributes: `q` (m, n_q), `u` (m, n_u), `u_dep` (m, k), `x` (m, n_x); `arclength` (m,), in the scaled unknowns;
    `residual` (m,); `inputs` by name; `reason`: why the family ends there. `turns.motion(i)` is the i-th
    `SteadyMotion`.
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

    def motion(self, i: Any) -> SteadyMotion:
        inputs = {k: x[i] if jnp.ndim(x) else x for k, x in self.inputs.items()}
        parts = (self.q[i], self.u[i], self.u_dep[i], self.x[i])
        return SteadyMotion(*parts, inputs, self.t, self.residual[i], self.names)

    def __getitem__(self, name: str) -> Float[Array, " m"]:
        groups = zip(self.names, (self.q, self.u, self.u_dep, self.x), strict=True)
        return by_name(name, groups, self.inputs, "this family")

    def __len__(self) -> int:
        return len(self.arclength)

    def __repr__(self) -> str:
        return f"Family({len(self)} steady motions over {float(self.arclength[-1]):.4g}: {self.reason})"


def family(
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

    z are the non-cyclic coordinates, the independent speeds and the inputs to find, the speeds divided by the largest
    of the start; F are the equations of `steady_turn`. The step is halved where Newton's method fails and grows where
    it is quick, so that folds, where no single quantity could lead on, are passed.

    **Arguments:**

    - `start`: from `steady_turn`. `hold`, `find`: as there, but hold one quantity less: the family is a curve.
    - `towards`: {name: +1 or -1}: the way to set out.
    - `until`: {name: value}, of coordinates and speeds, dependent ones too: stop exactly where the first of these
        values is passed.
    - `step`, `max_step` (by default four times the step): of arclength. `steps`: the largest number of them.

    **Returns:** a `Family`, the start first. Its members are not differentiable; pass one to `steady_turn` for that.

    **Raises:** `ValueError` where the start is not isolated on one curve: it names what moves.
    """
    label = f"family({type(system).__name__})"
    if not isinstance(start, SteadyMotion):
        raise TypeError(f"{label}: the start is a SteadyMotion, as from steady_turn; got {start!r}.")
    refuse_other_system(label, system, start)
    q, t = start.q, jnp.asarray(start.t, start.q.dtype)
    inputs = {**start.inputs, **{name: start.x[i] for i, name in enumerate(system.states)}}
    find, until = (*find, *system.states), dict(until or {})
    equations = SteadyEquations(system, find, tuple(hold))
    with_limits = SteadyEquations(system, find, (*hold, *until))
    values = [float(equations.quantity(system, t, q, start.u, k)) for k in hold]
    n_s = len(equations.places)
    scale = np.ones(len(equations.names))
    scale[n_s : n_s + len(system.speeds)] = max(1.0, float(jnp.abs(start.u).max(initial=0.0)))
    limits = np.array(list(until.values()), float)

    def evaluate(y):
        fixed = jnp.asarray([*values, *limits * 0.0], q.dtype)
        F, J = _residual_and_slope(with_limits, jnp.asarray(y * scale, q.dtype), (system, t, q, inputs, fixed))
        F, J = np.asarray(F), np.asarray(J) * scale
        m = len(F) - len(limits)
        return F[:m], J[:m], F[m:] - limits, J[m:]

    curve = _SolutionCurve(evaluate)
    y = np.asarray(equations.unknowns(q, start.u, inputs)) / scale
    tangent = curve.tangent(y, None)
    tangent = tangent * _direction_sign(equations, system, towards, tangent, curve, y)
    max_step = 4 * step if max_step is None else max_step
    points, arc, met = curve.follow(y, tangent, step, max_step, steps)
    reason = f"{steps} steps"
    if met is not None:
        name, value = list(until.items())[met]
        reason = f"{name} = {value:g}"
    elif len(points) <= steps:
        reason = "no further motion was found: equations or coordinates become singular"
    return _as_family(equations, system, t, q, inputs, values, np.array(points) * scale, arc, reason)


class _SolutionCurve:
    """Newton's method on a curve F(y) = 0 of fewer equations than unknowns, and its tangents."""

    def __init__(self, evaluate: Any):
        self.evaluate = evaluate

    def tangent(self, y, before: Any) -> Any:
        J = self.evaluate(y)[1]
        if not np.all(np.isfinite(J)):
            return None
        _, s, Vt = np.linalg.svd(J)
        if before is None:
            return Vt[-1]
        # Where another family crosses, two directions lead on: keep to the one on which the curve came.
        null = Vt[np.append(s, np.zeros(len(Vt) - len(s))) < 1e-7 * s[0]]
        null = Vt[-1:] if len(null) == 0 else null
        ahead = null.T @ (null @ before)
        return ahead / np.linalg.norm(ahead)

    def follow(self, y, tangent, step: float, max_step: float, steps: int):
        """Points from y on, their arclengths, and which limit was met, or None."""
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
            if passed and not ends:  # nearer
                h /= 2
                continue
            if ends:
                z, met = min(ends, key=lambda end: np.linalg.norm(end[0] - y))
                return [*points, z], [*arc, arc[-1] + float(np.linalg.norm(z - y))], met
            arc.append(arc[-1] + float(np.linalg.norm(z - y)))
            y, tangent = z, new
            points.append(y)
            h = min(max_step, 1.5 * h) if quick else h
        return points, arc, None

    def _passed(self, y, z) -> list[int]:
        """The limits that lie between two points of the curve; one that stands at the first was met before."""
        before, after = self.evaluate(y)[2], self.evaluate(z)[2]
        return [int(i) for i in np.nonzero((before < 0) != (after < 0))[0] if abs(before[i]) > 1e-9]

    def correct(self, y, tangent, tries: int = 12):
        start = y
        for k in range(tries):
            F, J, _, _ = self.evaluate(y)
            if not (np.all(np.isfinite(F)) and np.all(np.isfinite(J))):
                return None
            dy = np.linalg.lstsq(np.vstack([J, tangent]), -np.append(F, tangent @ (y - start)), rcond=1e-9)[0]
            y = y + dy
            if np.abs(dy).max() < 1e-12:
                F = self.evaluate(y)[0]
                return (y, k <= 4) if np.all(np.isfinite(F)) and np.abs(F).max() < 1e-8 else None
        return None

    def land(self, a, b, tangent, i: Any) -> Any:
        """The point between a and b at which the i-th limit is met."""
        y = a
        for _ in range(20):  # along the curve, which may cross another one just there
            g, G = self.evaluate(y)[2:]
            slope = G[i] @ tangent
            ds = -g[i] / slope if slope else np.inf
            if abs(ds) < 1e-13:
                break
            if not abs(ds) <= 2 * np.linalg.norm(b - a):
                return None
            # Not all the way at once: at the crossing itself nothing holds Newton's method on this curve.
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
def _residual_and_slope(equations: SteadyEquations, z, args):
    return equations.residual(z, args), jacobian(lambda z: equations.residual(z, args), z)


def _direction_sign(equations: SteadyEquations, system: System, towards, tangent, curve: _SolutionCurve, y) -> float:
    (name, sign), *more = towards.items()
    if more or name not in equations.names:
        one_of = hint(name, equations.names, "it is one of")
        raise ValueError(f"family: `towards` is one name with +1 or -1, got {dict(towards)}; {one_of}")
    J = curve.evaluate(y)[1]
    s = np.zeros(J.shape[1])  # with inputs to find there are fewer equations than unknowns
    s[: len(J)] = np.linalg.svd(J, compute_uv=False)[: len(s)]
    if s[-1] > 1e-8 * s[0]:
        raise ValueError(
            f"{type(system).__name__}: the start does not stand on a curve of steady motions: too much is held "
            f"({', '.join(equations.hold) or 'nothing'})."
        )
    if s[-2] < 1e-10 * s[0]:
        raise ValueError(
            f"{type(system).__name__}: more than one curve of steady motions passes here. Hold more quantities, or "
            "start beside a bifurcation."
        )
    return float(np.sign(sign * tangent[equations.names.index(name)]) or 1.0)


def _as_family(equations: SteadyEquations, system: System, t, q, inputs, values, zs, arc, reason) -> Family:
    fixed = jnp.asarray(values, q.dtype)

    @jax.jit
    @jax.vmap
    def members(z):
        args = (system, t, q, inputs, fixed)
        r = jnp.max(jnp.abs(equations.residual(z, args)))
        motion = as_motion(system, t, *equations.parts(z, q, inputs), r)
        trim = {k: motion.inputs[k] for k in equations.find if k in motion.inputs}
        return (motion.q, motion.u, motion.u_dep, motion.x), motion.residual, trim

    (q, u, u_dep, x), residual, trim = members(jnp.asarray(zs, q.dtype))
    inputs = {k: x for k, x in {**inputs, **trim}.items() if k not in system.states}
    return Family(q, u, u_dep, x, jnp.asarray(arc), residual, inputs, t, names_of(system), reason)
