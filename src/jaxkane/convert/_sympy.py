"""SymPy's mechanics as a system: its bodies, loads and constraints. Derives nothing."""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import jax

from .._common.lookup import as_names, hint
from .._scalarjit.components import ZERO3, Component, Scalar, dot, sub
from .._system.bodies import Body, Force, Torque
from .._system.kinematics import Frame, Point, Vector, inertial
from .._system.motion import Motion
from .._system.parameters import parameter
from .._system.system import System
from ._lagrangian import factor, factor_rate
from ._sympy_model import function, imported, words_of
from ._sympy_plan import Plan, Taker, VectorPlan, name_of


class _Made(Motion):
    """A motion that knows the frames and points of the plan by their number, and what torques and forces along speeds
    act on."""

    __slots__ = ("along_speeds", "placed", "turned", "under_torque")

    turned: list[Frame]
    placed: list[Point]
    under_torque: list[Any]  # a Body for each load; None where it is a force
    along_speeds: list[Body]


class SympySystem(System):
    """A model of SymPy; made by `jaxkane.convert.from_sympy`."""

    _plan: ClassVar[Plan]

    def __init__(self, **values: Any):
        for field in dataclasses.fields(self):
            setattr(self, field.name, values[field.name])

    def _read(self, q: Any, u: Any, t: Component) -> list[Any]:
        plan = self._plan
        missing = len(plan.u) + len(plan.u_dep) + len(plan.u_aux) - len(u)
        numbers = [getattr(self, str(x)) for x in plan.constants]
        return _functions_of(plan)[0](t, *q, *u, *(0.0,) * missing, *numbers)

    def q_dot(self, t, q, u):
        values = self._read(q, u, t)
        return [values[i] for i in self._plan.rates]

    def configuration_constraints(self, t, q):
        if not self._plan.configuration:
            return ()
        values = self._read(q, (), t)
        return [values[i] for i in self._plan.configuration]

    def motion(self, t, q, u):
        plan, values = self._plan, self._read(q, u, t)
        N, _ = inertial()
        frames = [N]
        for name, matrix, _ in plan.frames:
            a = [_exact(values[i]) for i in matrix]
            frames.append(Frame(name, N, (tuple(a[:3]), tuple(a[3:6]), tuple(a[6:])), ZERO3))  # type: ignore[arg-type]
        for frame, (_, _, omega) in zip(frames[1:], plan.frames, strict=True):
            frame._spin = _vector(frames, values, omega).components_in(frame)
        points = []
        for point in plan.points:
            v = _vector(frames, values, point.velocity)
            r = None if point.position is None else _vector(frames, values, point.position)
            points.append(Point.at(v, r, point.name))
        bodies = []
        for body in plan.bodies:
            mass, center = values[body.mass], points[body.point]
            if not body.inertia:
                bodies.append(Body(mass, 0.0, center, name=body.name))
                continue
            I = [_exact(values[i]) for i in body.inertia]
            omega = _vector(frames, values, body.angular_velocity)
            bodies.append(Body(mass, (I[:3], I[3:6], I[6:]), center, frames[body.frame], omega, body.name))
        for i, w in enumerate(self._of_inertia(values, u)):
            bodies.append(Body(1.0, 0.0, Point.at(N.vector(w, 0.0, 0.0)), name=f"inertia {i + 1}"))
        taken = {body.name for body in bodies}
        named = {point.name: made for point, made in zip(plan.points, points, strict=True) if point.name not in taken}
        motion = _Made(bodies, [values[i] for i in plan.residuals], points=named)
        motion.turned, motion.placed = frames, points
        self._carry_loads(motion, values, u)
        return motion

    def _carry_loads(self, motion: _Made, values: Sequence[Any], u: Any) -> None:
        center, N = motion.bodies[0].center, motion.N
        carrier = lambda omega: Body(0.0, 0.0, center, N, omega, "what the torque acts on")  # noqa: E731
        motion.under_torque = [
            carrier(_vector(motion.turned, values, load.angular_velocity)) if load.point is None else None
            for load in self._plan.loads
        ]
        # a force along a speed is the torque on what turns at that rate alone
        motion.along_speeds = [carrier(speed * N.x) for speed, _ in zip(u, self._plan.forces)]

    def loads(self, t, q, u, motion: Any, inputs):
        plan, made = self._plan, motion
        if not isinstance(made, _Made):
            made = self.motion(t, q, u)
        numbers = [getattr(self, str(x)) for x in plan.constants]
        given = [inputs[name_of(x)] for x in plan.inputs]
        values = _functions_of(plan)[1](t, *q, *u, *given, *numbers)
        loads: list[Any] = []
        for load, body in zip(plan.loads, made.under_torque, strict=True):
            vector = _vector(made.turned, values, load.vector)
            loads.append(Torque(vector, body) if load.point is None else Force(vector, made.placed[load.point]))
        along = [_exact(values[force]) for force in plan.forces]
        if plan.inertia:
            of_motion = self._read(q, u, t)
            C_dot = factor_rate(_rows(of_motion, plan.inertia), _rows(values, plan.inertia_rates))
            w = self._of_inertia(of_motion, u)
            along = [sub(force, dot(row, w[: len(row)])) for force, row in zip(along, C_dot, strict=True)]
        loads += [Torque(force * made.N.x, body) for force, body in zip(along, made.along_speeds, strict=True)]
        return loads

    def _of_inertia(self, values: Sequence[Any], u: Any) -> list[Component]:
        """w = C^T u of M = C C^T: the velocities of particles of mass 1 that have this inertia."""
        C = factor(_rows(values, self._plan.inertia))
        return [dot([row[i] for row in C[i:]], list(u)[i : len(C)]) for i in range(len(C))]


def _rows(values: Sequence[Any], rows: Sequence[Sequence[int]]) -> list[list[Component]]:
    return [[_exact(values[i]) for i in row] for row in rows]


def _exact(x: Any) -> Component:
    return x if isinstance(x, jax.Array) else float(x)


def _vector(frames: Sequence[Frame], values: Sequence[Any], plan: VectorPlan) -> Vector:
    # What is zero now is not dropped: the frame in which a vector stands may not depend on the speeds.
    parts = [frames[frame].vector(*(_exact(values[i]) for i in places)) for frame, places in plan]
    return functools.reduce(operator.add, parts) if parts else frames[0].vector(*ZERO3)


@functools.lru_cache(maxsize=100)
def _functions_of(plan: Plan) -> tuple[Any, Any]:
    """The expressions of the motion and of the loads, as functions of time, coordinates, speeds (and inputs) and
    constants."""
    state = (plan.t, *plan.q, *plan.u, *plan.u_dep, *plan.u_aux)
    of_loads = function((*state, *plan.inputs, *plan.constants), plan.of_loads)
    return function((*state, *plan.constants), plan.of_motion), of_loads


@functools.lru_cache(maxsize=100)
def class_of(plan: Plan) -> type[System]:
    of_parameters: dict[str, Any] = {}
    for symbol in plan.constants:
        of_parameters[str(symbol)] = parameter(positive=bool(symbol.is_positive))
    names = lambda symbols: tuple(name_of(x) for x in symbols)  # noqa: E731
    members: dict[str, Any] = {
        "__module__": __name__,
        "__doc__": "A model of SymPy.",
        "__annotations__": dict.fromkeys(of_parameters, Scalar),
        "__init__": SympySystem.__init__,
        "_plan": plan,
        "coordinates": names(plan.q),
        "speeds": names(plan.u),
        "dependent_speeds": names(plan.u_dep),
        "auxiliary_speeds": names(plan.u_aux),
        "dependent_coordinates": plan.q_dep,
        "inputs": names(plan.inputs),
    }
    made: Any = type(SympySystem)(plan.name, (SympySystem,), members | of_parameters)  # pyright: ignore
    return made


def from_sympy(
    model: Any,
    parameters: Mapping[Any, Any],
    *,
    origin: Any = None,
    dependent: Sequence[str] = (),
    name: str = "SympyModel",
) -> System:
    """The system of a model of `sympy.physics.mechanics`.

        system = jk.convert.from_sympy(kane, {m: 1.0, l: 0.5, g: 9.81})
        jk.simulate(system, jk.State({"q1": 0.3}, {}), ts)

    **Arguments:**

    - `model`: a `KanesMethod`, a `System`, or a `LagrangesMethod`. Its bodies and loads are those that it was given,
        or that `kanes_equations` was called with; no equations need have been formed. A Lagrangian without `bodies`
        gives the motion, and neither points nor frames.
    - `parameters`: a number for every constant symbol, by symbol or by its name. They become the system's parameters.
    - `origin`: the point from which positions count, for `jk.positions` and pictures; of a `System` its fixed point.
        Without one velocities are known, and no positions.
    - `dependent`: of a `LagrangesMethod` with constraints, the names of the coordinates that these determine.
    - `name`: of its class.

    **Returns:** a `System`. Coordinates and speeds have the names of the dynamic symbols, those of Lagrange's
    equations `q_dot` behind a coordinate `q`; other functions of time in the loads are its inputs. Dependent
    coordinates and speeds, auxiliary speeds and constraints are the model's.

    What a model does not say cannot be had: positions without an origin, units, and constraint forces other than at
    the points and frames that it names. Of a Lagrangian without bodies none of these is known, and the kinetic energy
    is 1/2 u.M u; a mass matrix that is not positive definite gives NaN.

    **Raises:** `ImportError` without SymPy; `TypeError` for another kind of model; `ValueError` that names a symbol
    without a value or a value without a symbol, a KanesMethod without bodies, a point without a velocity, a function of
    time in the motion that is neither coordinate nor speed, and a Lagrangian that is not quadratic in the rates.
    """
    sympy = imported()
    words = words_of(sympy, model, as_names(dependent), name)
    if origin is not None and not words.bodies:
        raise ValueError(
            f"{name}: positions from {origin} cannot be had, since this Lagrangian has no bodies. Leave `origin` out; "
            "or give what moves, LagrangesMethod(L, qs, bodies=bodies, frame=N, ...)."
        )
    taker = Taker(sympy, words, origin if origin is not None else words.origin)
    plan = taker.plan()
    values = _values(taker, plan, parameters)
    return class_of(plan)(**values)


def _values(taker: Taker, plan: Plan, parameters: Mapping[Any, Any]) -> dict[str, Any]:
    given = {str(symbol): value for symbol, value in parameters.items()}
    names = [str(symbol) for symbol in plan.constants]
    missing = [name for name in names if name not in given]
    if missing:
        raise ValueError(f"{plan.name}: no value for {', '.join(missing)}: `parameters` gives every symbol a number.")
    unknown = [name for name in given if name not in names]
    if unknown:
        raise ValueError(f"{plan.name} has no symbol {unknown[0]!r}; {hint(unknown[0], names, 'it has')}")
    taken = [name for name in names if hasattr(SympySystem, name) or "." in name]
    if taken:
        raise ValueError(
            f"{plan.name}: a parameter cannot be called {taken[0]!r}, which a system has, or which holds a dot: give "
            "the symbol another name, by `subs` before."
        )
    basic = taker.sympy.Basic
    return {name: float(given[name]) if isinstance(given[name], basic) else given[name] for name in names}
