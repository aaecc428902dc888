"""Pseudo-arclength continuation of a curve of solutions through its folds; families of steady motions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._common.lookup import by_name, hint
from .._kane.constraint_residuals import coordinate_units
from .._kane.contact.forces import closed_contacts
from .._scalarjit.cache_key import jit
from .._scalarjit.components import Numbers
from .._system.parameters import text_of, wrapped
from .._system.system import System, names_of, unit_of, units_of
from ._steady import SteadyArguments, SteadyEquations, SteadyMotion, as_motion, jacobian, quantity, row_sizes


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


class SolutionCurve:
    """Newton's method on a curve F(y) = 0 with fewer equations than unknowns, and the tangents of the curve.

    - `scale` (n,): the unit of each unknown: z = y * scale. `first` (n,): the unknowns y at the start.
    - `until`: values of quantities by name. The curve ends where the first of them is reached.
    - `eps`: the rounding error.
    """

    stuck = ""

    def __init__(self, z: Array, scale: np.ndarray, until: Mapping[str, float], eps: float):
        self.scale, self.until, self.eps = scale, dict(until), eps
        self.first = np.asarray(z) / scale

    def equations(self, y: np.ndarray) -> tuple[Any, Any, Any, Any]:
        """F, dF/dy, and the quantities g of `until` with dg/dy."""
        raise NotImplementedError

    def evaluate(self, y: np.ndarray):
        """F, dF/dy, limits g, dg/dy, all relative to their sizes."""
        F, J, g, G = self.equations(y)
        limits = np.array(list(self.until.values()), float)
        size = np.maximum(np.abs(limits), np.linalg.norm(G, axis=1))
        size = np.where(size > 0, size, 1.0)
        return F, J, (g - limits) / size, G / size[:, None]

    def tangent(self, y: np.ndarray, before: np.ndarray | None) -> Any:
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

    def follow(
        self,
        place: int,
        sign: float,
        step: float,
        max_step: float | None,
        steps: int,
        ahead: np.ndarray | None = None,
    ) -> tuple[Any, list[float], str]:
        """Follow the curve from its start. `sign`: whether the unknown at `place` increases or decreases at first.
        `ahead`: the tangent there, if more than one curve passes through the start.

        **Returns:** unknowns z (m, n), arclengths (m,), and why the curve ends.
        """
        y, arc, h, reason = self.first, [0.0], step, ""
        points, max_step = [y], 4 * step if max_step is None else max_step
        tangent = self.tangent(y, None) if ahead is None else ahead
        tangent = tangent * float(np.sign(sign * tangent[place]) or 1.0)
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
                reason = "{} = {:g}".format(*list(self.until.items())[met])
                break
            y, tangent = z, self.tangent_ahead(z, new)
            h = min(max_step, 1.5 * h) if quick else h
        reason = reason or (f"{steps} steps" if len(points) > steps else self.stuck)
        return np.array(points) * self.scale, arc, reason

    def accepts(self, y: np.ndarray, tangent: np.ndarray, z: np.ndarray, new: np.ndarray, met: int | None) -> bool:
        """Whether the step from y to z is kept. Otherwise it is repeated with half of its length.

        `new`: the tangent at z. `met`: the limit that ends the curve at z, or None.
        """
        return True

    def tangent_ahead(self, y: np.ndarray, new: np.ndarray) -> Any:
        return new

    def _passed(self, y: np.ndarray, z: np.ndarray) -> list[int]:
        """The limits that change sign between two points. A limit that is zero at the first point is not counted
        again."""
        before, after = self.evaluate(y)[2], self.evaluate(z)[2]
        return [int(i) for i in np.nonzero((before < 0) != (after < 0))[0] if abs(before[i]) > 4e6 * self.eps]

    def correct(self, y: np.ndarray, tangent: np.ndarray):
        start = y
        for k in range(12):
            F, J, _, _ = self.evaluate(y)
            if not (np.all(np.isfinite(F)) and np.all(np.isfinite(J))):
                return None
            dy = np.linalg.lstsq(np.vstack([J, tangent]), -np.append(F, tangent @ (y - start)), rcond=1e-9)[0]
            y = y + dy
            if np.all(np.abs(dy) <= 4e3 * self.eps * np.maximum(1.0, np.abs(y))):
                F = self.evaluate(y)[0]
                return (y, k <= 4) if np.all(np.isfinite(F)) and np.abs(F).max() < self.eps**0.5 else None
        return None

    def land(self, a: np.ndarray, b: np.ndarray, tangent: np.ndarray, i: Numbers) -> Any:
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
            ahead = None if attempt is None else self.tangent(attempt[0], tangent)
            if attempt is None or ahead is None:
                return None
            y, tangent = attempt[0], ahead
        F, J, g, G = self.evaluate(y)
        bordered = np.vstack([J, G[[i]]])
        if np.linalg.svd(bordered, compute_uv=False)[-1] > 1e-7:
            y = y + np.linalg.lstsq(bordered, -np.append(F, g[i]), rcond=None)[0]
        return y


class SteadyCurve(SolutionCurve):
    """A curve of steady motions through one of them. The unknowns z and F are those of `steady_turn`."""

    stuck = "no further motion was found: equations or coordinates become singular, or a contact closes"

    def __init__(
        self,
        system: System,
        start: SteadyMotion,
        hold: tuple[str, ...],
        find: tuple[str, ...],
        until: Mapping[str, float],
    ):
        q, t, find = start.q, jnp.asarray(start.t, start.q.dtype), (*find, *system.states)
        inputs = {**start.inputs, **{name: start.x[i] for i, name in enumerate(system.states)}}
        self.steady, self.hold = SteadyEquations(system, find, tuple(hold)), hold
        SteadyEquations(system, find, tuple(until))  # refuses a name that is neither a coordinate nor a speed
        targets = [quantity(system, t, q, start.u, k) for k in self.steady.hold]
        targets = jnp.stack(targets) if targets else jnp.zeros(0, q.dtype)
        self.args = system, t, q, start.u, inputs, targets
        z = self.steady.unknowns(q, start.u, inputs)
        super().__init__(z, np.asarray(_scale(self.steady, z, self.args)), until, float(jnp.finfo(q.dtype).eps))

    def equations(self, y: np.ndarray):
        scale = jnp.asarray(self.scale)
        found = _residual_and_slope(self.steady, jnp.asarray(y) * scale, self.args, scale, tuple(self.until))
        F, J, g, G = map(np.asarray, found)
        return F, J * self.scale, g, G * self.scale

    def place(self, towards: Mapping[str, float]) -> int:
        """The index of the unknown that `towards` names. **Raises:** `ValueError` if there is no curve, or several."""
        label, names = f"family({type(self.args[0]).__name__})", self.steady.names
        if len(towards) != 1 or next(iter(towards)) not in (*names, *self.hold):
            one_of = hint(next(iter(towards), ""), names, "it is one of")
            raise ValueError(f"{label}: `towards` must be one name with +1 or -1, got {dict(towards)}; {one_of}")
        J, (name,) = self.evaluate(self.first)[1], towards
        s = np.zeros(J.shape[1])  # with inputs to find there are fewer equations than unknowns
        s[: len(J)] = np.linalg.svd(J, compute_uv=False)[: len(s)]
        for is_wrong, reason in (
            (s[-1] > max(1e-8, 100 * self.eps) * s[0], "no curve of steady motions passes through the start: too many "
             f"quantities are held ({', '.join(self.hold) or 'none'}). Remove one from `hold`."),
            (s[-2] < max(1e-10, 10 * self.eps) * s[0], "more than one curve of steady motions passes through the "
             "start. Add quantities to `hold`, or start at some distance from the bifurcation."),
            (name in self.hold, f"{name} is in `hold`, so it cannot change along the family. Name another."),
        ):  # fmt: skip
            if is_wrong:
                raise ValueError(f"{label}: {reason}")
        return names.index(name)

    def family(self, zs: np.ndarray, arc: list[float], reason: str) -> Family:
        """The members with unknowns z (m, n)."""
        system, t, q, u, inputs, _ = self.args

        @jax.jit
        @jax.vmap
        def members(z: Float[Array, " n"]):
            r = jnp.max(jnp.abs(_residual_and_slope(self.steady, z, self.args, jnp.asarray(self.scale), ())[0]))
            motion = as_motion(system, t, *self.steady.parts(z, q, u, inputs), r)
            trim = {k: motion.inputs[k] for k in self.steady.find if k in motion.inputs}
            return (motion.q, motion.u, motion.u_dep, motion.x), motion.residual, trim

        (q_all, u_all, u_dep, x), residual, trim = members(jnp.asarray(zs, q.dtype))
        inputs = {k: x for k, x in {**inputs, **trim}.items() if k not in system.states}
        names, units = names_of(system), tuple(units_of(system).items())
        return Family(q_all, u_all, u_dep, x, jnp.asarray(arc), residual, inputs, t, names, reason, units)


@jit
def _residual_and_slope(
    equations: SteadyEquations,
    z: Float[Array, " n"],
    args: SteadyArguments,
    scale: Float[Array, " n"],
    names: tuple[str, ...],
):
    """Residuals F (m,) relative to the sizes of their terms, quantities g by name, and the derivatives of both."""
    system, t, q, u, inputs, _ = args

    def both(z: Float[Array, " n"]):
        at = equations.parts(z, q, u, inputs)[:2]
        g = [quantity(system, t, *at, k) for k in names]
        return equations.residual(z, args), jnp.stack(g) if g else jnp.zeros(0, z.dtype)

    F, g = both(z)
    F = jnp.where(jnp.any(closed_contacts(system, t, equations.parts(z, q, u, inputs)[0])), jnp.nan, F)
    J, G = jacobian(both, z)
    sizes = row_sizes(J, (equations.sizes(z, jnp.abs(z), args)[0], scale))
    return F / sizes, J / sizes[:, None], g, G


@jit
def _scale(equations: SteadyEquations, z: Float[Array, " n"], args: SteadyArguments):
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
