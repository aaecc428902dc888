"""Families of periodic orbits by pseudo-arclength continuation, their bifurcations, and their start at Hopf points."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Array, Bool, Complex, Float

from .._common.lookup import not_there, refuse_if, refuse_unknown
from .._integrate.trajectory import refuse_other_system
from .._scalarjit.cache_key import jit
from .._scalarjit.components import Component
from .._system.parameters import parameters_in, with_parameters
from .._system.system import System, packed
from ._continuation import Family, SolutionCurve, SteadyCurve
from ._orbit_equations import OrbitArguments, OrbitEquations, packed_rates, repeats
from ._periodic import Orbit, as_orbit, normal_at, orbit_equations, scales_at
from ._steady import SteadyMotion


class Bifurcation(eqx.Module):
    """A special orbit of a family.

    Attributes:

    - `kind`: "fold" (the parameter turns back), "branch point" (a multiplier is 1), "period doubling" (a multiplier is
        -1) or "Neimark-Sacker" (a conjugate pair is on the unit circle).
    - `value`: of the parameter.
    - `orbit`: the `Orbit` there.
    """

    kind: str = eqx.field(static=True)
    value: float
    orbit: Orbit

    def __repr__(self) -> str:
        return f"{self.kind} at {float(self.value):.10g} (period {float(self.orbit.period):.6g} s)"


class OrbitFamily(eqx.Module):
    """Periodic orbits along a curve, by name: `cycles["mu"]` (m,) is the parameter, `cycles["x"]` (m,) are values at
    the start. `cycles.orbit(i)` is the i-th `Orbit`.

    Attributes:

    - `values` (m,): of the parameter; the periods if no parameter changes.
    - `period` (m,) [s].
    - `states` (m, n_y): the packed states at the start.
    - `multipliers` (m, k): the Floquet multipliers without the trivial one, the largest magnitude first.
    - `arclength` (m,): in the scaled unknowns.
    - `bifurcations`: the special orbits between the members, in their order.
    - `reason`: why the family ends.
    """

    values: Float[Array, " m"]
    period: Float[Array, " m"]
    states: Float[Array, "m n_y"]
    multipliers: Complex[Array, "m k"]
    arclength: Float[Array, " m"]
    unknowns: Float[Array, "m n"]
    start: Orbit
    bifurcations: tuple[Bifurcation, ...]
    parameter: str = eqx.field(static=True)
    reason: str = eqx.field(static=True)

    @property
    def stable(self) -> Bool[Array, " m"]:
        """Where all multipliers are inside the unit circle."""
        return jnp.all(jnp.abs(self.multipliers) < 1.0, axis=1)

    def orbit(self, i: int) -> Orbit:
        """The i-th orbit. It is differentiable if it is passed to `periodic` as a guess."""
        start = self.start
        return _orbit_at(start.equations, self.parameter, self.unknowns[i], start.arguments)

    def __getitem__(self, name: str) -> Float[Array, " m"]:
        system = self.start.system
        entries = (*system.coordinates, *system.speeds, *system.states)
        named = {"period": self.period, **dict(zip(entries, self.states.T, strict=True))}
        if self.parameter:
            named[self.parameter] = self.values
        if name not in named:
            raise not_there(name, named, "this family of orbits")
        return named[name]

    def __len__(self) -> int:
        return len(self.arclength)

    def __repr__(self) -> str:
        label = self.parameter or "period"
        found = "; ".join(map(repr, self.bifurcations)) or "no bifurcations"
        return (
            f"OrbitFamily({len(self)} orbits, {label} {float(self.values[0]):.6g} to {float(self.values[-1]):.6g}: "
            f"{found}; ended by {self.reason})"
        )


def family(
    system: System,
    start: SteadyMotion | Orbit,
    *,
    towards: Mapping[str, float],
    until: Mapping[str, float] | None = None,
    hold: tuple[str, ...] = (),
    find: tuple[str, ...] = (),
    step: float = 0.05,
    max_step: float | None = None,
    steps: int = 500,
    switch: str | None = None,
) -> Family | OrbitFamily:
    """The family of steady motions or periodic orbits through one of them, by pseudo-arclength continuation.

        F(z) = 0,   tangent . (z - z_predicted) = 0

    z are the unknowns of `steady_turn` or `periodic`, and F are its equations. The arclength is measured in scaled
    unknowns and has no unit. The step is halved if Newton's method fails, and increased if it converges quickly. The
    curve can be followed through folds.

    **Arguments:**

    - `start`: a steady motion from `steady_turn`, or an orbit from `periodic`.
    - `towards`: {name: +1 or -1}, the initial direction. For steady motions, a coordinate or a speed. For orbits, a
        parameter of the system or a constant input, which then changes along the family; or, for the family of a
        conservative system, "period" or a quantity at the start.
    - `until`: {name: value}. The family ends exactly at the first of these values that it reaches. Names are those of
        coordinates and speeds, also dependent ones; for orbits those of `towards`.
    - `hold`: for steady motions, as in `steady_turn`, but one quantity less, because the family is a curve. Orbits keep
        the quantities that `periodic` holds, except for the one in `towards`.
    - `find`: for steady motions, as in `steady_turn`.
    - `step`: the first step of arclength.
    - `max_step`: the largest step of arclength; four times `step` by default. Two bifurcations of the same kind within
        one step are not detected.
    - `steps`: the largest number of steps.
    - `switch`: "doubling" follows the orbits with twice the period, which begin at a period doubling. `start` is then
        the orbit there, `family.bifurcations[i].orbit`, and `towards` the side on which these orbits exist.

    Steady motions: angles are in rad; speeds and inputs are relative to their values at the start. Lengths and unknowns
    that are zero at the start are scaled by the change that balances the terms of an equation. Orbits: all unknowns are
    relative to their amplitudes, and the parameter is relative to its value at the start.

    **Returns:** a `Family` or an `OrbitFamily`, whose first member is `start`. Its members are not differentiable; pass
    one to `steady_turn` or `periodic` for that. An `OrbitFamily` contains folds, branch points, period doublings and
    Neimark-Sacker points.

    **Raises:** `ValueError` if no curve, or more than one, passes through the start, or if no period doubling is there.
    """
    label, until = f"family({type(system).__name__})", dict(until or {})
    refuse_unknown([switch] if switch else [], ["doubling"], f"{label}: `switch` cannot be", "it can be")
    if isinstance(start, SteadyMotion):
        refuse_if(switch is not None, f"{label}: `switch` needs an Orbit as `start`, with a multiplier of -1.")
        refuse_other_system(label, system, start)
        steady = SteadyCurve(system, start, tuple(hold), tuple(find), until)
        return steady.family(*steady.follow(steady.place(towards), sum(towards.values()), step, max_step, steps))
    if not isinstance(start, Orbit):
        raise TypeError(f"{label}: `start` must be a SteadyMotion, e.g. from steady_turn, or an Orbit; got {start!r}.")
    if hold or find or len(towards) != 1:
        raise ValueError(
            f"{label}: for orbits, `towards` must be one name with +1 or -1, got {dict(towards)}. Omit `hold` and "
            "`find`: the family uses the `hold` of `periodic`."
        )
    ((name, sign),) = towards.items()
    equations, parameter, args = _released(label, system, start, name)
    z = start.unknowns
    if switch:
        refuse_if(
            not parameter or np.min(np.abs(np.asarray(start.multipliers) + 1.0), initial=np.inf) > 1e-4,
            f"{label}: `start` has no multiplier of -1, or `towards` names no parameter. Pass the orbit of a period "
            "doubling, `family.bifurcations[i].orbit`.",
        )
        equations, args, z = _with_twice_the_period(label, equations, args, z)
    curve = _OrbitCurve(equations, parameter, args, z, until, label)
    if parameter and not equations.autonomous:
        other = _with_value(args, parameter, 1.01 * _value(args, parameter) + 1e-4)
        if not repeats(*other[:3], other.start, equations.period(z, other), equations.skipped(z, other)):
            raise ValueError(f"{label}: {name!r} changes the period of the force. Pass a function as its `period`.")
    if np.max(np.abs(curve.evaluate(curve.first)[0])) > 1e-6:
        raise ValueError(f"{label}: `start` is not an orbit of this system. Pass its own system, `start.system`.")
    curve.move_phase(curve.first)
    ahead = curve.across() if switch else None
    zs, arc, reason = curve.follow(curve.places[name], sign, step, max_step, steps, ahead)
    refuse_if(
        switch is not None and len(zs) > 1 and sign * (zs[1, -1] - zs[0, -1]) < 0,
        f"{label}: the orbits with twice the period exist on the other side. Reverse the sign in `towards`.",
    )
    rows = [curve.member(z / curve.scale) for z in zs]
    values, period, states, multipliers = map(jnp.asarray, map(np.array, zip(*rows, strict=True)))
    first = dataclasses.replace(start, equations=equations, arguments=args, system=system, unknowns=z)
    special = tuple(
        Bifurcation(kind, curve.member(y)[0], _orbit_at(equations, parameter, jnp.asarray(y * curve.scale), args))
        for kind, y in curve.found
        # Where the family begins, two curves meet: any sign there is a rounding error.
        if not switch or np.linalg.norm(y - curve.first) > 1e-3 * step
    )
    arc, zs = jnp.asarray(arc), jnp.asarray(zs)
    return OrbitFamily(values, period, states, multipliers, arc, zs, first, special, parameter, reason)


def _released(label: str, system: System, start: Orbit, name: str) -> tuple[OrbitEquations, str, OrbitArguments]:
    """The equations without the released entry; the name of the parameter that changes, "" if none changes; and the
    arguments."""
    equations, args = start.equations, start.arguments._replace(system=system, center=packed(start.state))
    parameters = [key for key, value, _ in parameters_in(system) if np.ndim(value) == 0]
    inputs = [] if callable(start.inputs) else [key for key, x in start.inputs.items() if not callable(x)]
    if name in parameters or name in inputs:
        return equations, name, args
    entries = (*system.coordinates, *system.speeds, *system.states)
    refuse_unknown([name], (*parameters, *inputs, *entries, "period"), f"{label}: `towards` has no quantity", "it has")
    if not equations.hold:
        raise ValueError(
            f"{label}: the orbit is isolated if no parameter changes, because `periodic` was called without `hold`. "
            f"Name a parameter in `towards`: {', '.join((*parameters, *inputs))}."
        )
    released = entries.index(name) if name in entries else equations.hold[0]
    if released not in equations.hold:
        raise ValueError(
            f"{label}: `towards` contains {name}, which is not in the `hold` of `periodic`. Name a quantity of this "
            "`hold`, or a parameter."
        )
    kept = np.array([k for k, i in enumerate(equations.hold) if i != released], int)
    equations = dataclasses.replace(equations, hold=tuple(i for i in equations.hold if i != released))
    return equations, "", args._replace(targets=args.targets[kept])


def _with_twice_the_period(
    label: str, equations: OrbitEquations, args: OrbitArguments, z: Array
) -> tuple[OrbitEquations, OrbitArguments, Array]:
    """The same orbit, run through twice."""
    refuse_if(equations.jumps and equations.segments > 1, f"{label}: `switch` needs an orbit with one segment.")
    states, T, own = equations.states(z, args), equations.period(z, args), equations.period_of
    many = {"returns" if equations.jumps else "segments": 2 * (equations.returns if equations.jumps else len(states))}
    states = states if equations.jumps else jnp.concatenate([states, states + args.advance[None]])
    period_of = None if own is None else lambda system: 2.0 * own(system)
    equations = dataclasses.replace(equations, **many, period_of=period_of)
    args = args._replace(period=2.0 * args.period, advance=2.0 * args.advance, skipped=0.5 * args.skipped)
    return equations, args, equations.unknowns(states, 2.0 * T)


class _OrbitCurve(SolutionCurve):
    """The curve of the orbits, with the unknowns (z, p)."""

    stuck = "Newton's method, which found no further orbit"

    def __init__(
        self,
        equations: OrbitEquations,
        parameter: str,
        args: OrbitArguments,
        z: Array,
        until: Mapping[str, float],
        label: str,
    ):
        self.orbit, self.parameter, self.args = equations, parameter, args
        entries = (*args.system.coordinates, *args.system.speeds, *args.system.states)
        self.places = {entries[k]: i for i, k in enumerate(equations.closed)}
        if equations.autonomous:
            self.places["period"] = z.size - 1
        sizes = np.asarray(equations.sizes(z, args))
        if parameter:
            self.places[parameter] = z.size
            p = float(_value(args, parameter))
            z, sizes = jnp.append(z, p), np.append(sizes, abs(p) or 1.0)
        refuse_unknown(until, self.places, f"{label}: `until` contains the unknown name")
        self._memory: dict[bytes, Any] = {}
        self.found: list[tuple[str, Any]] = []  # kinds and places of the bifurcations so far
        super().__init__(z, sizes, until, max(float(jnp.finfo(z.dtype).eps), equations.rtol))

    def _all(self, y: np.ndarray) -> Any:
        key = y.tobytes()
        if key not in self._memory:
            if len(self._memory) > 8:
                self._memory.pop(next(iter(self._memory)))
            found = _extended(self.orbit, self.parameter, jnp.asarray(y * self.scale), self.args)
            self._memory[key] = tuple(map(np.asarray, found))
        return self._memory[key]

    def equations(self, y: np.ndarray):
        F, J, rows, _, _ = self._all(y)
        G = np.diag(self.scale)[np.array([self.places[key] for key in self.until], int)]
        return F / rows, J * self.scale / rows[:, None], G @ y, G

    def move_phase(self, y: np.ndarray) -> None:
        # Let the phase condition contain the orbit's own start, so that it stays transversal along the family.
        if self.orbit.autonomous and not self.orbit.section:
            center, normal = _phase(self.orbit, self.parameter, jnp.asarray(y * self.scale), self.args)
            self.args = self.args._replace(center=center, normal=normal)
            self._memory.clear()
        if self.orbit.jumps:
            self.args = self.args._replace(period=jnp.asarray(self._all(y)[4][0]))

    def member(self, y: np.ndarray) -> tuple[Any, ...]:
        """The value of the parameter, the period, the packed state and the multipliers."""
        *_, M, (T, *state) = self._all(y)
        values = np.linalg.eigvals(M) if np.all(np.isfinite(M)) else np.full(len(M), np.nan)
        values = values[np.argsort(-np.abs(values), kind="stable")].astype(complex)
        return float(y[-1] * self.scale[-1] if self.parameter else T), float(T), np.array(state), values

    def tests(self, y: np.ndarray, tangent: np.ndarray) -> dict[str, float]:
        """Functions that change their sign at a bifurcation.

        Products of multipliers are used, because a single multiplier cannot be followed where two of them meet.
        """
        if not self.parameter:
            return {}
        M = self._all(y)[3]
        values = np.linalg.eigvals(M)
        found = {"fold": tangent[-1], "period doubling": np.linalg.det(M + np.eye(len(M)))}
        if not self.orbit.hold:
            pairs = [1.0 - a * b for i, a in enumerate(values) for b in values[i + 1 :]]
            found["Neimark-Sacker"] = float(np.real(np.prod(pairs))) if pairs else 1.0
            found["branch point"] = np.linalg.det(M - np.eye(len(M)))
        return found

    def across(self) -> np.ndarray:
        """The tangent of the second curve at a period doubling, along which the parameter does not change at first."""
        one, other = np.linalg.svd(self.evaluate(self.first)[1])[2][-2:]
        tangent = one * other[-1] - other * one[-1]
        return tangent / np.linalg.norm(tangent)

    def accepts(self, y: np.ndarray, tangent: np.ndarray, z: np.ndarray, new: np.ndarray, met: int | None) -> bool:
        new = new if met is None else self.tangent(z, tangent)
        special = None if new is None else self._between(y, tangent, z, new)
        self.found += special or []
        return special is not None

    def tangent_ahead(self, y: np.ndarray, new: np.ndarray) -> Any:
        self.move_phase(y)
        return self.tangent(y, new)

    def _between(
        self, y: np.ndarray, tangent: np.ndarray, z: np.ndarray, new: np.ndarray
    ) -> list[tuple[str, Any]] | None:
        """Kinds and places of the bifurcations between y and z, in their order. None if the search for one fails."""
        before, after = self.tests(y, tangent), self.tests(z, new)
        length, found = float(tangent @ (z - y)), []
        for kind in [kind for kind in before if before[kind] * after[kind] < 0]:

            def test(s: float, kind: str = kind):
                if s in (0.0, length):
                    return before[kind] if s == 0.0 else after[kind]
                attempt = self.correct(y + s * tangent, tangent)
                if attempt is None:
                    return np.nan
                ahead = self.tangent(attempt[0], tangent)
                return np.nan if ahead is None else self.tests(attempt[0], ahead)[kind]

            accuracy = {"xtol": 1e-13 * length, "rtol": np.float64(1e-13), "maxiter": 60}
            try:
                s: Any = scipy.optimize.toms748(test, 0.0, length, **accuracy)
            except (ValueError, RuntimeError):  # an orbit between y and z was not found
                return None
            attempt = self.correct(y + s * tangent, tangent)
            if attempt is None:
                return None
            values: Any = np.linalg.eigvals(self._all(attempt[0])[3])
            pairs = values[np.abs(values.imag) > 1e-7]
            # Two real multipliers whose product is 1 are not a Neimark-Sacker point.
            if kind != "Neimark-Sacker" or np.min(np.abs(np.abs(pairs) - 1.0), initial=1.0) < 1e-6:
                found.append((s, kind, attempt[0]))
        if any(kind == "fold" for _, kind, _ in found):  # a multiplier is 1 at a fold too
            found = [entry for entry in found if entry[1] != "branch point"]
        return [(kind, at) for _, kind, at in sorted(found, key=lambda entry: entry[0])]


def _value(args: OrbitArguments, name: str) -> Any:
    for key, value, _ in parameters_in(args.system):
        if key == name:
            return value
    return args.inputs[name]


def _with_value(args: OrbitArguments, name: str, value: Component) -> OrbitArguments:
    if any(key == name for key, _, _ in parameters_in(args.system)):
        return args._replace(system=with_parameters(args.system, {name: value}))
    return args._replace(inputs={**args.inputs, name: value})


def _split(parameter: str, z_p: Array, args: OrbitArguments) -> tuple[Array, OrbitArguments]:
    return (z_p[:-1], _with_value(args, parameter, z_p[-1])) if parameter else (z_p, args)


@jit
def _extended(equations: OrbitEquations, parameter: str, z_p: Array, args: OrbitArguments):
    """F, J, the sizes of the rows, the derivative of the return map, and the period with the packed state."""
    z, there = _split(parameter, z_p, args)
    at = equations.evaluate(z, args, z_p[z.size :], lambda p: _split(parameter, jnp.append(z, p), args)[1])
    rows = scales_at(equations, z, there, at)[1]
    matrix = equations.return_matrix(at.segments, z, there)
    return at.F, at.J, rows, matrix, jnp.append(equations.period(z, there), equations.states(z, there)[0])


@jit
def _phase(equations: OrbitEquations, parameter: str, z_p: Array, args: OrbitArguments):
    z, args = _split(parameter, z_p, args)
    return equations.states(z, args)[0], normal_at(equations, z, args)


@jit
def _orbit_at(equations: OrbitEquations, parameter: str, z_p: Array, args: OrbitArguments) -> Orbit:
    center, normal = _phase(equations, parameter, z_p, args)
    z, args = _split(parameter, z_p, args)
    args = args._replace(center=center, normal=normal, targets=center[np.array(equations.hold, int)])
    if equations.jumps:
        args = args._replace(period=equations.period(z, args))
    at = equations.evaluate(z, args)
    return as_orbit(equations, z, args, at.segments, scales_at(equations, z, args, at)[2])


def limit_cycle(
    system: System,
    motion: SteadyMotion,
    amplitude: Mapping[str, float],
    *,
    parameter: str,
    segments: int = 1,
    rtol: float | None = None,
    atol: float | None = None,
) -> Orbit:
    """A small periodic orbit about a steady motion near a Hopf point, from the eigenvector of the linear model.

    The parameter is changed such that an orbit with this amplitude exists. Follow the orbits to larger amplitudes with
    `family`: they exist on one side of the Hopf point.

    **Arguments:**

    - `motion`: a steady motion of `system`, with a pair of eigenvalues near the imaginary axis.
    - `amplitude`: {name: value}, the deviation of one coordinate, speed or first-order state from the steady motion at
        the start.
    - `parameter`: the name of a parameter of the system, or of an input of `motion`.
    - `segments`, `rtol`, `atol`: as for `periodic`.

    **Returns:** an `Orbit`, whose `system` has the new value of the parameter.

    **Raises:** `ValueError` if no pair of eigenvalues oscillates, or if no orbit is found.
    """
    label = f"limit_cycle({type(system).__name__})"
    if not isinstance(motion, SteadyMotion):
        raise TypeError(f"{label}: `motion` must be a SteadyMotion, e.g. from equilibrium; got {motion!r}.")
    entries = (*system.coordinates, *system.speeds, *system.states)
    if len(amplitude) != 1 or next(iter(amplitude)) not in entries:
        raise ValueError(
            f"{label}: `amplitude` must be one of {', '.join(entries)} with a number; got {dict(amplitude)}."
        )
    known = [*(key for key, value, _ in parameters_in(system) if np.ndim(value) == 0), *system.inputs]
    refuse_unknown([parameter], known, f"{label}: there is no parameter")
    ((name, deviation),) = amplitude.items()
    center = packed(motion.state)
    inputs = {key: motion.inputs[key] for key in system.inputs}
    equations, args = orbit_equations(
        system,
        center,
        inputs,
        hold={name: center[entries.index(name)] + deviation},
        segments=segments,
        rtol=rtol,
        atol=atol,
    )
    eigen: Any = np.linalg.eig(np.asarray(_slopes_at(equations, args, center)))
    values, vectors = eigen
    rising = values.imag > 1e-6 * np.max(np.abs(values))
    moves = np.abs(vectors[equations.closed.index(entries.index(name))]) > 1e-9
    pairs = np.nonzero(rising & moves)[0]
    if not len(pairs):
        raise ValueError(
            f"{label}: no pair of eigenvalues oscillates in {name}. Pass a steady motion near a Hopf point."
        )
    k = pairs[np.argmin(np.abs(values[pairs].real))]
    vector, omega = vectors[:, k], values[k].imag
    vector = vector * deviation / vector[equations.closed.index(entries.index(name))]
    phases = np.exp(2j * np.pi * np.arange(segments) / segments)
    rows = np.asarray(center)[equations.places] + np.real(phases[:, None] * vector[None, :])
    z = equations.unknowns(
        jnp.tile(center, (segments, 1)).at[:, equations.places].set(rows), jnp.asarray(2 * np.pi / omega)
    )
    normal = jnp.zeros_like(center).at[equations.places].set(vector.imag / np.linalg.norm(vector.imag) ** 2)
    args = args._replace(center=center, normal=normal)
    curve = _OrbitCurve(equations, parameter, args, z, {}, label)
    attempt = curve.correct(curve.first, np.zeros_like(curve.first))
    if attempt is None:
        raise ValueError(
            f"{label}: no orbit was found. Pass a smaller amplitude, or a motion nearer to the Hopf point."
        )
    free = dataclasses.replace(equations, hold=())
    return _orbit_at(free, parameter, jnp.asarray(attempt[0] * curve.scale), args)


@jit
def _slopes_at(equations: OrbitEquations, args: OrbitArguments, y: Array) -> Array:
    """The derivative (n, n) of the rates of the closed entries."""
    places = equations.places
    return jax.jacfwd(lambda x: packed_rates(args, args.t, y.at[places].set(x))[places])(y[places])
