"""A model of SymPy's mechanics as a system: its bodies, loads and constraints. Does not derive equations."""

from __future__ import annotations

import dataclasses
import functools
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from .._common.lookup import as_names, refuse_any, refuse_if, refuse_unknown
from .._kane.description import jvp
from .._kane.right_hand_side import parameters_read
from .._scalarjit.components import ZERO3, Component, Numbers, Scalar, dot, is_exact, is_zero, sub
from .._system.kinematics import Frame, Point, Vector, inertial
from .._system.motion import Body, Force, Motion, Torque
from .._system.parameters import parameter
from .._system.system import System
from ._sympy_model import (
    ExtractedModel,
    ExtractedVector,
    Extractor,
    SymPyObject,
    function,
    imported,
    model_data,
    name_of,
    prescribed_motions,
)


def from_sympy(
    model: SymPyObject,
    parameters: Mapping[Any, Any],
    *,
    origin: SymPyObject = None,
    dependent: Sequence[str] = (),
    prescribed: Mapping[Any, Any] | None = None,
    name: str = "SympyModel",
) -> System:
    """The system of a model of `sympy.physics.mechanics`.

        system = jk.convert.from_sympy(kane, {m: 1.0, l: 0.5, g: 9.81})
        jk.simulate(system, jk.State({"q1": 0.3}, {}), ts)

    **Arguments:**

    - `model`: a `KanesMethod`, a `System`, or a `LagrangesMethod`. Its bodies and loads are used, or those that were
        passed to `kanes_equations`. Its equations need not have been formed. A Lagrangian without `bodies` gives the
        motion, but neither points nor frames.
    - `parameters`: a number for each constant symbol, by symbol or by name. They become the system's parameters. A
        symbol on which no equation depends needs no number and is zero, e.g. a moment of inertia about an axis about
        which the body does not turn.
    - `origin`: the point from which positions are measured, for `jk.positions` and animations. Default: the fixed point
        of a `System`; for other models positions are then not available.
    - `dependent`: for a `LagrangesMethod` with constraints, the names of the coordinates that these determine.
    - `prescribed`: motions that are given in time, by function of the model (e.g. v(t)) or by its name. Each is an
        expression of SymPy in time and constants, or a function of time [s] that JAX can differentiate. Rates of a
        prescribed function are its derivatives.
    - `name`: of its class.

    **Returns:** a `System`. Coordinates and speeds have the names of the dynamic symbols. The speeds of Lagrange's
    equations are named `q_dot` for a coordinate `q`. Other functions of time in the loads are inputs. Dependent
    coordinates and speeds, auxiliary speeds and constraints are the model's.

    Information that the model does not contain is not available: positions without an origin, units, and constraint
    forces except at named points and frames. For a Lagrangian without bodies none of these is available. Its kinetic
    energy is 1/2 u.M u; a mass matrix that is not positive definite gives NaN.

    **Raises:** `ImportError` without SymPy; `TypeError` for another kind of model. `ValueError` for a symbol without a
    value or a value without a symbol, a KanesMethod without bodies, and a point without a velocity. Also for a function
    of time in the motion that is neither coordinate nor speed nor prescribed, and a Lagrangian that is not quadratic in
    the rates.
    """
    sympy = imported()
    motions = prescribed_motions(sympy, prescribed or {}, name)
    data = model_data(sympy, model, as_names(dependent, "dependent"), name, tuple(motions))
    refuse_if(
        origin is not None and not data.bodies,
        f"{name}: positions from {origin} are not available, because this Lagrangian has no bodies. Omit `origin`, "
        "or pass the bodies: LagrangesMethod(L, qs, bodies=bodies, frame=N, ...).",
    )
    extractor = Extractor(sympy, data, origin if origin is not None else data.origin, motions)
    model = extractor.model()
    values = _values(extractor, model, parameters)
    return class_of(model)(**values)


def _values(extractor: Extractor, model: ExtractedModel, parameters: Mapping[Any, Any]) -> dict[str, Any]:
    numbers = {str(symbol): value for symbol, value in parameters.items()}
    names = [str(symbol) for symbol in model.constants]
    missing = [name for name in names if name not in numbers]
    if missing:
        numbers |= dict.fromkeys(_unread(model, missing), 0.0)
        missing = [name for name in missing if name not in numbers]
    refuse_if(missing, f"{model.name}: no value for {', '.join(missing)}. `parameters` needs a number per symbol.")
    refuse_unknown(numbers, names, f"{model.name} has no symbol", "it has")
    reserved = [name for name in names if hasattr(SympySystem, name) or "." in name]
    after = " cannot be the name of a parameter, because it is an attribute of systems or contains a dot. Rename it."
    refuse_any(reserved, f"{model.name}:", after)
    basic = extractor.sympy.Basic
    return {name: float(numbers[name]) if isinstance(numbers[name], basic) else numbers[name] for name in names}


def _unread(model: ExtractedModel, names: Sequence[str]) -> list[str]:
    """Which of these constants affect neither the equations nor a position."""
    if any(hasattr(SympySystem, name) for name in names):
        return []
    kind = class_of(model)
    fields = [field.name for field in dataclasses.fields(kind)]
    ones = {field: jnp.ones(()) for field in fields}
    read = dict(zip(fields, parameters_read(kind(**ones)), strict=True))
    positions = [point.position for point in model.points if point.position is not None]
    shown = {i for position in positions for _, places in position for i in places}
    in_positions = {str(x) for i in shown for x in model.of_motion[i].free_symbols}
    return [name for name in names if not read[name] and name not in in_positions]


class _SympyMotion(Motion):
    """A motion with the model's frames and points by index, and massless bodies on which its torques act."""

    __slots__ = ("along_speeds", "model_frames", "model_points", "under_torque")

    model_frames: list[Frame]
    model_points: list[Point]
    under_torque: list[Any]  # a Body for each load; None for a force
    along_speeds: list[Body]  # each rotates at the rate of one speed: a torque on it is a force along this speed


class SympySystem(System):
    """A model of SymPy; made by `jaxkane.convert.from_sympy`."""

    _model: ClassVar[ExtractedModel]

    def __init__(self, **values: Any):
        for field in dataclasses.fields(self):
            setattr(self, field.name, values[field.name])

    def _read(self, q: Sequence[Component], u: Sequence[Component], t: Component) -> list[Any]:
        model = self._model
        missing = len(model.u) + len(model.u_dep) + len(model.u_aux) - len(u)
        numbers = [getattr(self, str(x)) for x in model.constants]
        return _functions_of(model)[0](t, *q, *u, *(0.0,) * missing, *_given(model, t), *numbers)

    def q_dot(self, t: Component, q: Sequence[Component], u: Sequence[Component]):
        values = self._read(q, u, t)
        return [values[i] for i in self._model.rates]

    def configuration_constraints(self, t: Component, q: Sequence[Component]):
        if not self._model.configuration:
            return ()
        values = self._read(q, (), t)
        return [values[i] for i in self._model.configuration]

    def motion(self, t: Component, q: Sequence[Component], u: Sequence[Component]):
        model, values = self._model, self._read(q, u, t)
        N, _ = inertial()
        frames = [N]
        for name, matrix, _ in model.frames:
            a = [_exact(values[i]) for i in matrix]
            frames.append(Frame(name, N, (tuple(a[:3]), tuple(a[3:6]), tuple(a[6:])), ZERO3))  # type: ignore[arg-type]
        for frame, (_, _, omega) in zip(frames[1:], model.frames, strict=True):
            frame._spin = _vector(frames, values, omega).components_in(frame)
        points = []
        for point in model.points:
            v = _vector(frames, values, point.velocity)
            r = None if point.position is None else _vector(frames, values, point.position)
            points.append(Point.at(v, r, point.name))
        bodies = []
        for body in model.bodies:
            mass, center = values[body.mass], points[body.point]
            if not body.inertia:
                bodies.append(Body(mass, 0.0, center, name=body.name))
                continue
            I = [_exact(values[i]) for i in body.inertia]
            omega = _vector(frames, values, body.angular_velocity)
            bodies.append(Body(mass, (I[:3], I[3:6], I[6:]), center, frames[body.frame], omega, body.name))
        for i, w in enumerate(self._inertia_velocities(values, u)):
            bodies.append(Body(1.0, 0.0, Point.at(N.vector(w, 0.0, 0.0)), name=f"inertia {i + 1}"))
        body_names = {body.name for body in bodies}
        named = {x.name: point for x, point in zip(model.points, points, strict=True) if x.name not in body_names}
        motion = _SympyMotion(bodies, [values[i] for i in model.residuals], points=named)
        motion.model_frames, motion.model_points = frames, points

        def carrier(omega: Vector) -> Body:
            return Body(0.0, 0.0, bodies[0].center, N, omega, "body under a torque")

        motion.under_torque = [
            carrier(_vector(frames, values, load.angular_velocity)) if load.point is None else None
            for load in model.loads
        ]
        motion.along_speeds = [carrier(speed * N.x) for speed, _ in zip(u, model.forces)]
        return motion

    def loads(
        self,
        t: Component,
        q: Sequence[Component],
        u: Sequence[Component],
        motion: Motion,
        inputs: Mapping[str, Component],
    ):
        model = self._model
        if not isinstance(motion, _SympyMotion):
            motion = self.motion(t, q, u)
        numbers = [getattr(self, str(x)) for x in model.constants]
        given = (*(inputs[name_of(x)] for x in model.inputs), *_given(model, t))
        values = _functions_of(model)[1](t, *q, *u, *given, *numbers)
        loads: list[Any] = []
        for load, body in zip(model.loads, motion.under_torque, strict=True):
            vector = _vector(motion.model_frames, values, load.vector)
            loads.append(Torque(vector, body) if load.point is None else Force(vector, motion.model_points[load.point]))
        along = [_exact(values[force]) for force in model.forces]
        if model.inertia:
            of_motion = self._read(q, u, t)
            M, M_dot = _rows(of_motion, model.inertia), _rows(values, model.inertia_rates)

            def factors(*entries: Component) -> list[list[Component]]:
                return _cholesky([entries[i * (i + 1) // 2 :][: i + 1] for i in range(len(M))])

            C_dot = jvp(factors, [x for row in M for x in row], [x for row in M_dot for x in row])[1]
            w = self._inertia_velocities(of_motion, u)
            along = [sub(force, dot(row, w[: len(row)])) for force, row in zip(along, C_dot, strict=True)]
        loads += [Torque(force * motion.N.x, body) for force, body in zip(along, motion.along_speeds, strict=True)]
        return loads

    def _inertia_velocities(self, values: Sequence[Any], u: Sequence[Component]) -> list[Component]:
        """w = C^T u of M = C C^T: the velocities of particles of mass 1 with this inertia.

        Kane's method gives C dw/dt for these n particles. With forces along the speeds this becomes the left side of
        Lagrange's equations in momentum form, because d/dt (C w) = C dw/dt + dC/dt w.
        """
        C = _cholesky(_rows(values, self._model.inertia))
        return [dot([row[i] for row in C[i:]], list(u)[i : len(C)]) for i in range(len(C))]


Rows = Sequence[Sequence[Component]]  # of a lower triangular matrix


def _rows(values: Sequence[Any], rows: Sequence[Sequence[int]]) -> list[list[Component]]:
    return [[_exact(values[i]) for i in row] for row in rows]


def _exact(x: Numbers) -> Component:
    return x if isinstance(x, jax.Array) else float(x)


def _vector(frames: Sequence[Frame], values: Sequence[Any], model: ExtractedVector) -> Vector:
    # Zero components are not dropped: the frame of a vector must not depend on the values of the speeds.
    parts = [frames[frame].vector(*(_exact(values[i]) for i in places)) for frame, places in model]
    return functools.reduce(operator.add, parts) if parts else frames[0].vector(*ZERO3)


@functools.lru_cache(maxsize=100)
def _functions_of(model: ExtractedModel) -> tuple[Any, Any]:
    """The expressions of the motion and of the loads, as functions of time, coordinates, speeds (and inputs) and
    constants."""
    state = (model.t, *model.q, *model.u, *model.u_dep, *model.u_aux)
    given = tuple(symbol for symbol, _, _ in model.prescribed)
    of_loads = function((*state, *model.inputs, *given, *model.constants), model.of_loads)
    return function((*state, *given, *model.constants), model.of_motion), of_loads


def _given(model: ExtractedModel, t: Component) -> list[Any]:
    """The values of the prescribed functions and of their derivatives."""
    values = []
    for _, motion, order in model.prescribed:
        for _ in range(order):
            motion = functools.partial(_rate, motion)
        values.append(jnp.asarray(motion(jnp.asarray(t, float) if is_exact(t) else t)))
    return values


def _rate(motion: Callable[[Any], Any], t: Component) -> Any:
    return jax.jvp(lambda t: jnp.asarray(motion(t)), (t,), (jnp.ones_like(t),))[1]


@functools.lru_cache(maxsize=100)
def class_of(model: ExtractedModel) -> type[System]:
    of_parameters: dict[str, Any] = {}
    for symbol in model.constants:
        of_parameters[str(symbol)] = parameter(positive=bool(symbol.is_positive))

    def names(symbols: Sequence[Any]) -> tuple[str, ...]:
        return tuple(name_of(x) for x in symbols)

    members: dict[str, Any] = {
        "__module__": __name__,
        "__doc__": "A model of SymPy.",
        "__annotations__": dict.fromkeys(of_parameters, Scalar),
        "__init__": SympySystem.__init__,
        "_model": model,
        "coordinates": names(model.q),
        "speeds": names(model.u),
        "dependent_speeds": names(model.u_dep),
        "auxiliary_speeds": names(model.u_aux),
        "dependent_coordinates": model.q_dep,
        "inputs": names(model.inputs),
    }
    cls: Any = type(SympySystem)(model.name, (SympySystem,), members | of_parameters)  # pyright: ignore
    return cls


def _cholesky(M: Rows) -> list[list[Component]]:
    """C of M = C C^T, lower triangular; exact zeros stay exact. NaN if M is not positive definite."""
    C: list[list[Component]] = []
    for i, row in enumerate(M):
        C.append([])
        for j in range(i + 1):
            entry = sub(row[j], dot(C[i][:j], C[j][:j]))
            C[i].append(_quotient(entry, C[j][j]) if j < i else _root(entry))
    return C


def _root(x: Component) -> Component:
    if is_exact(x):
        return math.sqrt(x) if x >= 0.0 else math.nan
    return jnp.sqrt(x)


def _quotient(a: Component, b: Component) -> Component:
    if is_zero(a):
        return 0.0
    return math.nan if is_zero(b) else a / b
