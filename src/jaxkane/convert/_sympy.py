"""SymPy's mechanics as a system: its bodies, loads and constraints. Derives nothing; Kane's method does, from these.

Of a model only the description is taken: velocities of points, orientations and angular velocities of frames, masses,
inertias, loads and constraints, as expressions in coordinates and speeds. SymPy turns them into one function with
common subexpressions; its equations of motion need not have been formed.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from .._common.lookup import hint
from .._description.bodies import Body, Force, Motion, Torque
from .._description.parameters import parameter
from .._description.system import System
from .._description.vectors import Frame, Point, Vector, inertial
from .._scalars.components import ZERO3, add, dot, mul, sub
from .._scalars.types import Component, Scalar
from ._lagrangian import Inertia, factor, factor_rate, inertia_of


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
    sympy = _sympy()
    words = _words_of(sympy, model, tuple(dependent), name)
    if origin is not None and not words.bodies:
        raise ValueError(
            f"{name}: positions from {origin} cannot be had, since this Lagrangian has no bodies. Leave `origin` out; "
            "or give what moves, LagrangesMethod(L, qs, bodies=bodies, frame=N, ...)."
        )
    taker = _Taker(sympy, words, origin if origin is not None else words.origin)
    plan = taker.plan()
    values = _values(taker, plan, parameters)
    return _class_of(plan)(**values)


def _sympy() -> Any:
    try:
        import sympy  # pyright: ignore[reportMissingImports]
        import sympy.physics.mechanics  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError(
            "Models of SymPy need SymPy: `pip install sympy`, or `pip install 'jaxkane[symbolic]'`."
        ) from error
    return sympy


class _Words(NamedTuple):
    """What a model says, in SymPy's own terms."""

    name: str
    N: Any
    q: list[Any]
    u: list[Any]  # independent
    u_dep: list[Any]
    u_aux: list[Any]
    q_dep: list[Any]
    rates: dict[Any, Any]  # of derivatives of coordinates, their expressions
    residuals: list[Any]  # of velocities
    configuration: list[Any]
    bodies: list[Any]
    loads: list[Any]
    forces: Sequence[Any] = ()  # along the speeds, beside the loads
    inertia: Inertia = Inertia()  # instead of bodies
    origin: Any = None


def _words_of(sympy: Any, model: Any, dependent: tuple[str, ...], name: str) -> _Words:
    mechanics = sympy.physics.mechanics
    kinds = [getattr(mechanics, kind, ()) for kind in ("KanesMethod", "System", "LagrangesMethod")]
    if isinstance(model, kinds[0]):
        return _of_kane(model, name)
    if isinstance(model, kinds[1]):
        return _of_system(mechanics, model, name)
    if isinstance(model, kinds[2]):
        return _of_lagrange(sympy, model, dependent, name)
    raise TypeError(f"from_sympy takes a KanesMethod, a System or a LagrangesMethod of SymPy, got {model!r}.")


def _of_kane(kane: Any, name: str, origin: Any = None) -> _Words:
    if not kane.bodies:
        raise ValueError(
            f"{name}: this KanesMethod knows no bodies. Give them, KanesMethod(..., bodies=bodies, forcelist=loads), "
            "or call its kanes_equations(bodies, loads) before."
        )
    u, u_dep, u_aux = list(kane.u), list(kane._udep), list(kane._uaux)
    residuals = list(kane._k_nh * kane.u + kane._f_nh) if u_dep else []
    return _Words(
        name,
        kane._inertial,
        list(kane.q),
        u[: len(u) - len(u_dep)],
        u_dep,
        u_aux,
        list(kane._qdep),
        kane.kindiffdict(),
        residuals,
        list(kane._f_h),
        list(kane.bodies),
        list(kane.loads or ()),
        origin=origin,
    )


def _of_system(mechanics: Any, system: Any, name: str) -> _Words:
    loads = (*system.loads, *(load for actuator in system.actuators for load in actuator.to_loads()))
    kane = mechanics.KanesMethod(
        system.frame,
        system.q_ind,
        system.u_ind,
        kd_eqs=system.kdes,
        q_dependent=system.q_dep,
        u_dependent=system.u_dep,
        configuration_constraints=system.holonomic_constraints,
        velocity_constraints=system.velocity_constraints,
        u_auxiliary=system.u_aux,
        forcelist=loads or None,
        bodies=system.bodies,
        explicit_kinematics=False,
    )
    return _of_kane(kane, name, system.fixed_point)


def _of_lagrange(sympy: Any, lagrange: Any, dependent: tuple[str, ...], name: str) -> _Words:
    bodies = list(lagrange._bodies or ())
    if bodies and lagrange.inertial is None:
        raise ValueError(f"{name}: the inertial frame of the bodies is not known. Give LagrangesMethod(..., frame=N).")
    q, N = list(lagrange.q), lagrange.inertial or sympy.physics.mechanics.ReferenceFrame("N")
    rates = list(lagrange._qdots)
    wrong = [x for x in dependent if x not in [str(c.func) for c in q]]
    if wrong or len(dependent) != len(lagrange.coneqs):
        raise ValueError(
            f"{name}: {len(lagrange.coneqs)} constraints determine as many coordinates; `dependent` names "
            f"{', '.join(dependent) or 'none'}. The coordinates are: {', '.join(str(c.func) for c in q)}."
        )
    speeds = [sympy.Function(f"{c.func}_dot")(*c.args) for c in q]
    to_speeds = dict(zip(rates, speeds))
    is_dep = [str(c.func) in dependent for c in q]
    order = [u for u, dep in zip(speeds, is_dep) if not dep], [u for u, dep in zip(speeds, is_dep) if dep]
    coordinate_of = dict(zip(speeds, q))
    of_speeds = {coordinate_of[u]: u for u in (*order[0], *order[1])}
    if bodies:
        inertia = Inertia(forces=_forces_of_potential(sympy, lagrange, bodies, to_speeds, of_speeds, name))
    else:
        inertia = inertia_of(sympy, lagrange, of_speeds, name)
    holonomic = list(lagrange._hol_coneqs)
    return _Words(
        name,
        N,
        q,
        *order,
        [],
        [c for c, dep in zip(q, is_dep) if dep][: len(holonomic)],
        to_speeds,
        [x.xreplace(to_speeds) for x in lagrange.coneqs],
        holonomic,
        bodies,
        list(lagrange.forcelist or ()) if bodies else [],
        inertia.forces,
        inertia,
    )


def _forces_of_potential(
    sympy: Any, lagrange: Any, bodies: list[Any], to_speeds: dict[Any, Any], of_speeds: dict[Any, Any], name: str
) -> list[Any]:
    """What stands in L beside the kinetic energy is a potential, whose forces are along the speeds."""
    potential = sum((body.kinetic_energy(lagrange.inertial) for body in bodies), sympy.S.Zero) - lagrange._L[0]
    potential = sympy.expand(sympy.simplify(potential.xreplace(to_speeds)))
    if potential.has(*of_speeds.values()):
        raise ValueError(f"{name}: the Lagrangian is not the kinetic energy of the bodies less a potential of q alone.")
    return [-potential.diff(c) for c in of_speeds]


# The description as expressions, and how they are put together again.

VectorPlan = tuple[tuple[int, tuple[int, int, int]], ...]  # (frame, places of three expressions), summed


class PointPlan(NamedTuple):
    name: str
    velocity: VectorPlan
    position: VectorPlan | None


class BodyPlan(NamedTuple):
    name: str
    mass: int
    inertia: tuple[int, ...]  # nine, or none for a particle
    frame: int  # in which the inertia stands
    point: int
    angular_velocity: VectorPlan


class LoadPlan(NamedTuple):
    point: int | None  # None: a torque
    angular_velocity: VectorPlan
    vector: VectorPlan


class Plan(NamedTuple):
    """All of a model: hashable, so that one model has one class. Expressions are told by their place."""

    name: str
    q: tuple[Any, ...]
    u: tuple[Any, ...]
    u_dep: tuple[Any, ...]
    u_aux: tuple[Any, ...]
    q_dep: tuple[str, ...]
    inputs: tuple[Any, ...]
    constants: tuple[Any, ...]
    t: Any
    of_motion: tuple[Any, ...]
    of_loads: tuple[Any, ...]
    rates: tuple[int, ...]
    residuals: tuple[int, ...]
    configuration: tuple[int, ...]
    frames: tuple[tuple[str, tuple[int, ...], VectorPlan], ...]
    points: tuple[PointPlan, ...]
    bodies: tuple[BodyPlan, ...]
    loads: tuple[LoadPlan, ...]
    forces: tuple[int, ...]
    inertia: tuple[tuple[int, ...], ...]  # rows of M, of a model without bodies
    inertia_rates: tuple[tuple[int, ...], ...]


class _Taker:
    """Takes the expressions of a model, each once."""

    def __init__(self, sympy: Any, words: _Words, origin: Any):
        self.sympy, self.words, self.origin = sympy, words, origin
        self.t = sympy.physics.mechanics.dynamicsymbols._t
        self.of_motion: dict[Any, int] = {}
        self.of_loads: dict[Any, int] = {}
        self.frames: dict[Any, int] = {words.N: 0}
        self.turned: list[tuple[str, tuple[int, ...], VectorPlan]] = []
        self.points: dict[Any, int] = {}
        self.placed: list[PointPlan] = []

    def plan(self) -> Plan:
        words, place = self.words, self._place
        # What rests in the inertial frame, as the ground that carries the joints, has no part in the motion.
        bodies = tuple(self._body(body) for body in words.bodies if not self._rests(body))
        loads = tuple(self._load(load) for load in words.loads if not self._rests(load[0]))
        rates = tuple(place(words.rates[c.diff(self.t)]) for c in words.q)
        residuals = tuple(place(x) for x in words.residuals)
        configuration = tuple(place(x) for x in words.configuration)
        forces = tuple(self._place(x, self.of_loads) for x in words.forces)
        inertia = tuple(tuple(place(x) for x in row) for row in words.inertia.M)
        inertia_rates = tuple(tuple(place(x, self.of_loads) for x in row) for row in words.inertia.M_dot)
        inputs, constants = self._symbols()
        return Plan(
            words.name,
            tuple(words.q),
            tuple(words.u),
            tuple(words.u_dep),
            tuple(words.u_aux),
            tuple(_name(c) for c in words.q_dep),
            inputs,
            constants,
            self.t,
            tuple(self.of_motion),
            tuple(self.of_loads),
            rates,
            residuals,
            configuration,
            tuple(self.turned),
            tuple(self.placed),
            bodies,
            loads,
            forces,
            inertia,
            inertia_rates,
        )

    def _place(self, expression: Any, among: dict[Any, int] | None = None) -> int:
        """The place of an expression, with the rates of coordinates in terms of the speeds."""
        among = self.of_motion if among is None else among
        expression = self.sympy.physics.mechanics.msubs(self.sympy.sympify(expression), self.words.rates)
        return among.setdefault(expression, len(among))

    def _vector(self, vector: Any, among: dict[Any, int] | None = None) -> VectorPlan:
        parts = [] if vector == 0 else vector.args
        return tuple((self._frame(frame), tuple(self._place(x, among) for x in column)) for column, frame in parts)  # type: ignore

    def _frame(self, frame: Any) -> int:
        if frame not in self.frames:
            self.frames[frame] = len(self.frames)
            self.turned.append(("", (), ()))  # keeps its place while its angular velocity is taken
            matrix = self._asked(lambda: frame.dcm(self.words.N), frame, "no orientation in the inertial frame")
            plan = frame.name, tuple(self._place(x) for x in matrix), self._omega(frame)
            self.turned[self.frames[frame] - 1] = plan
        return self.frames[frame]

    def _omega(self, frame: Any) -> VectorPlan:
        omega = self._asked(lambda: frame.ang_vel_in(self.words.N), frame, "no angular velocity in the inertial frame")
        return self._vector(omega)

    def _rests(self, part: Any) -> bool:
        N = self.words.N
        point, frame = (getattr(part, name, None) for name in ("masscenter", "frame"))
        if hasattr(part, "pos_from"):
            point = part
        elif hasattr(part, "dcm"):
            frame = part
        still = point is None or self._asked(lambda: point.vel(N), point, "no velocity in the inertial frame") == 0
        turns = frame is not None and (
            self._asked(lambda: frame.ang_vel_in(N), frame, "no angular velocity in the inertial frame") != 0
        )
        return still and not turns

    def _point(self, point: Any) -> int:
        if point not in self.points:
            self.points[point] = len(self.points)
            velocity = self._asked(lambda: point.vel(self.words.N), point, "no velocity in the inertial frame")
            position = None
            if self.origin is not None:
                what = f"no position from the origin {self.origin}"
                position = self._vector(self._asked(lambda: point.pos_from(self.origin), point, what))
            self.placed.append(PointPlan(point.name, self._vector(velocity), position))
        return self.points[point]

    def _asked(self, ask: Any, part: Any, what: str) -> Any:
        try:
            return ask()
        except ValueError as error:
            raise ValueError(f"{self.words.name}: {part} has {what}: {error}") from error

    def _body(self, body: Any) -> BodyPlan:
        if not hasattr(body, "central_inertia"):  # a Particle
            return BodyPlan(body.name, self._place(body.mass), (), 0, self._point(body.point), ())
        inertia = body.central_inertia
        frames = {unit.args[0][1] for _, *units in inertia.args for unit in units} if inertia != 0 else set()
        # where it stands as written it is constant, as of a disk in a frame that does not spin with it
        frame = frames.pop() if len(frames) == 1 else body.frame
        matrix = inertia.to_matrix(frame) if inertia != 0 else self.sympy.zeros(3)
        places = tuple(self._place(x) for x in matrix)
        point, mass = self._point(body.masscenter), self._place(body.mass)
        return BodyPlan(body.name, mass, places, self._frame(frame), point, self._omega(body.frame))

    def _load(self, load: Any) -> LoadPlan:
        part, vector = load
        part = getattr(part, "masscenter", part) if hasattr(part, "central_inertia") else part
        if isinstance(part, self.sympy.physics.mechanics.ReferenceFrame):
            return LoadPlan(None, self._omega(part), self._vector(vector, self.of_loads))
        return LoadPlan(self._point(part), (), self._vector(vector, self.of_loads))

    def _symbols(self) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        """Inputs, and constants, in the order of their names."""
        words, name = self.words, self.words.name
        known = {*words.q, *words.u, *words.u_dep, *words.u_aux}
        atoms = lambda kind, among: {x for e in among for x in e.atoms(*kind)}  # noqa: E731
        derivatives = atoms([self.sympy.Derivative], (*self.of_motion, *self.of_loads))
        if derivatives:
            raise ValueError(f"{name}: {_listed(derivatives)} follows from no kinematic equation of the model.")
        applied = self.sympy.core.function.AppliedUndef
        unknown = {
            x.func.__name__
            for x in atoms([self.sympy.Function, self.sympy.Integral], (*self.of_motion, *self.of_loads))
            if not isinstance(x, applied) and x.func.__name__ not in (*_FUNCTIONS, "Piecewise")
        }
        if unknown:
            raise ValueError(f"{name}: {_listed(unknown)} has no counterpart here: write it by other functions.")
        foreign = atoms([applied], self.of_motion) - known
        if foreign:
            raise ValueError(
                f"{name}: {_listed(foreign)} in the motion is neither coordinate nor speed. What is prescribed in time "
                "is written as an expression of time; an input stands in loads alone."
            )
        inputs = sorted(atoms([applied], self.of_loads) - known, key=str)
        odd = [x for x in inputs if tuple(x.args) != (self.t,)]
        if odd:
            raise ValueError(f"{name}: {_listed(odd)} is a function of something else than time.")
        symbols = {x for e in (*self.of_motion, *self.of_loads) for x in e.free_symbols} - {self.t}
        names = [str(x) for x in symbols]
        twice = {name for name in names if names.count(name) > 1}
        if twice:
            raise ValueError(
                f"{name}: two symbols are called {_listed(twice)}, with other assumptions (as positive=True): make one."
            )
        return tuple(inputs), tuple(sorted(symbols, key=str))


def _name(x: Any) -> str:
    return str(getattr(x, "func", x)) if getattr(x, "args", ()) else str(x)


def _listed(things: Any) -> str:
    return ", ".join(sorted(map(str, things)))


def _values(taker: _Taker, plan: Plan, parameters: Mapping[Any, Any]) -> dict[str, Any]:
    given = {str(symbol): value for symbol, value in parameters.items()}
    names = [str(symbol) for symbol in plan.constants]
    missing = [name for name in names if name not in given]
    if missing:
        raise ValueError(f"{plan.name}: no value for {', '.join(missing)}: `parameters` gives every symbol a number.")
    unknown = [name for name in given if name not in names]
    if unknown:
        raise ValueError(f"{plan.name} has no symbol {unknown[0]!r}; {hint(unknown[0], names, 'it has')}")
    taken = [name for name in names if hasattr(_SympySystem, name) or "." in name]
    if taken:
        raise ValueError(
            f"{plan.name}: a parameter cannot be called {taken[0]!r}, which a system has, or which holds a dot: give "
            "the symbol another name, by `subs` before."
        )
    basic = taker.sympy.Basic
    return {name: float(given[name]) if isinstance(given[name], basic) else given[name] for name in names}


# The system.


class _Made(Motion):
    """A motion that knows the frames and points of the plan by their number, and what torques and forces along speeds
    act on."""

    __slots__ = ("along_speeds", "placed", "turned", "under_torque")

    turned: list[Frame]
    placed: list[Point]
    under_torque: list[Any]  # a Body for each load; None where it is a force
    along_speeds: list[Body]


class _SympySystem(System):
    """A model of SymPy; made by `jaxkane.convert.from_sympy`."""

    _plan: ClassVar[Plan]

    def __init__(self, **values: Any):
        for field in dataclasses.fields(self):
            setattr(self, field.name, values[field.name])

    def _read(self, q: Any, u: Any, t: Component) -> list[Any]:
        plan = self._plan
        missing = len(plan.u) + len(plan.u_dep) + len(plan.u_aux) - len(u)
        numbers = [getattr(self, str(x)) for x in plan.constants]
        return _functions(plan)[0](t, *q, *u, *(0.0,) * missing, *numbers)

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
        given = [inputs[_name(x)] for x in plan.inputs]
        values = _functions(plan)[1](t, *q, *u, *given, *numbers)
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


_FUNCTIONS = {
    "Abs": jnp.abs,
    "Max": lambda *xs: functools.reduce(jnp.maximum, xs),
    "Min": lambda *xs: functools.reduce(jnp.minimum, xs),
    "acos": jnp.arccos,
    "acosh": jnp.arccosh,
    "asin": jnp.arcsin,
    "asinh": jnp.arcsinh,
    "atan": jnp.arctan,
    "atan2": jnp.arctan2,
    "atanh": jnp.arctanh,
    "cos": jnp.cos,
    "cosh": jnp.cosh,
    "exp": jnp.exp,
    "log": jnp.log,
    "sign": jnp.sign,
    "sin": jnp.sin,
    "sinh": jnp.sinh,
    "sqrt": jnp.sqrt,
    "tan": jnp.tan,
    "tanh": jnp.tanh,
}


@functools.lru_cache(maxsize=100)
def _functions(plan: Plan) -> tuple[Any, Any]:
    """The expressions of the motion and of the loads, as functions of time, coordinates, speeds (and inputs) and
    constants."""
    state = (plan.t, *plan.q, *plan.u, *plan.u_dep, *plan.u_aux)
    made = lambda arguments, expressions: _sympy().lambdify(  # noqa: E731
        arguments, list(expressions), modules=[_FUNCTIONS | _ARITHMETIC, "math"], printer=_printer(), cse=True
    )
    return made((*state, *plan.constants), plan.of_motion), made((*state, *plan.inputs, *plan.constants), plan.of_loads)


@functools.cache
def _printer() -> Any:
    """Expressions as Python. Sums and products are functions that drop exact zeros: the method asks for velocities
    along one speed, where all others are exactly zero. Integer powers stay integer."""
    from sympy.printing.pycode import PythonCodePrinter  # pyright: ignore[reportMissingImports]

    class Printer(PythonCodePrinter):
        def call(self, name: str, expr: Any) -> str:
            return f"{name}({', '.join(self._print(x) for x in expr.args)})"

        def _print_Add(self, expr: Any, order: Any = None) -> str:
            return self.call("_sum", expr)

        def _print_Mul(self, expr: Any) -> str:
            return self.call("_product", expr)

        def _print_Integer(self, expr: Any) -> str:
            return repr(float(expr))  # exact ones and zeros are dropped where they are floats

        _print_One = _print_Zero = _print_NegativeOne = _print_Integer

        def _print_Pow(self, expr: Any, rational: bool = False) -> str:
            base, exponent = (self._print(x) for x in expr.args)
            if expr.exp.is_Integer:
                return f"({base})**({int(expr.exp)})"
            return f"sqrt({base})" if expr.exp == _sympy().S.Half else f"({base})**({exponent})"

        def _print_And(self, expr: Any) -> str:
            return self.call("_both", expr)

        def _print_Or(self, expr: Any) -> str:
            return self.call("_either", expr)

        def _print_Not(self, expr: Any) -> str:
            return self.call("_not", expr)

        def _print_Piecewise(self, expr: Any) -> str:
            value = "nan"
            for x, condition in reversed(expr.args):
                if condition is _sympy().true:
                    value = self._print(x)
                else:
                    value = f"_where({self._print(condition)}, {self._print(x)}, {value})"
            return value

        def _print_known(self, expr: Any) -> str:
            return self.call(expr.func.__name__, expr)

    for name in _FUNCTIONS:
        setattr(Printer, f"_print_{name}", Printer._print_known)
    return Printer({"fully_qualified_modules": False, "inline": True, "allow_unknown_functions": True})


def _sum(*terms: Component) -> Component:
    return functools.reduce(add, terms)


def _product(*factors: Component) -> Component:
    return functools.reduce(mul, factors)


_ARITHMETIC = {
    "_sum": _sum,
    "_product": _product,
    "_where": jnp.where,
    "_both": lambda *conditions: functools.reduce(jnp.logical_and, conditions),
    "_either": lambda *conditions: functools.reduce(jnp.logical_or, conditions),
    "_not": jnp.logical_not,
    "nan": float("nan"),
}


@functools.lru_cache(maxsize=100)
def _class_of(plan: Plan) -> type[System]:
    of_parameters: dict[str, Any] = {}
    for symbol in plan.constants:
        of_parameters[str(symbol)] = parameter(positive=bool(symbol.is_positive))
    names = lambda symbols: tuple(_name(x) for x in symbols)  # noqa: E731
    members: dict[str, Any] = {
        "__module__": __name__,
        "__doc__": "A model of SymPy.",
        "__annotations__": dict.fromkeys(of_parameters, Scalar),
        "__init__": _SympySystem.__init__,
        "_plan": plan,
        "coordinates": names(plan.q),
        "speeds": names(plan.u),
        "dependent_speeds": names(plan.u_dep),
        "auxiliary_speeds": names(plan.u_aux),
        "dependent_coordinates": plan.q_dep,
        "inputs": names(plan.inputs),
    }
    made: Any = type(_SympySystem)(plan.name, (_SympySystem,), members | of_parameters)  # pyright: ignore
    return made
