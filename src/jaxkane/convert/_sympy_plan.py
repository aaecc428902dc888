"""A model of SymPy as expressions, each once, and how they are put together: hashable, so that one model has one class.

Reads what a model says; makes no system.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from ._sympy_model import FUNCTIONS, Words

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
    """All of a model: hashable, so that one model has one class. Expressions are referred to by their place."""

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


class Taker:
    """Takes the expressions of a model, each once."""

    def __init__(self, sympy: Any, words: Words, origin: Any):
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
            tuple(name_of(c) for c in words.q_dep),
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
            if not isinstance(x, applied) and x.func.__name__ not in (*FUNCTIONS, "Piecewise")
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


def name_of(x: Any) -> str:
    return str(getattr(x, "func", x)) if getattr(x, "args", ()) else str(x)


def _listed(things: Any) -> str:
    return ", ".join(sorted(map(str, things)))
