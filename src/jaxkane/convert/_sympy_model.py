"""The contents of a KanesMethod, a System or a LagrangesMethod of SymPy: its expressions, each stored once, their use
in the model, and expressions as functions of numbers. Does not make a system.

A Lagrangian without bodies gives Lagrange's equations in momentum form, with L = 1/2 u.M u + b.u + L0 for the rates u
of the coordinates:

    d/dt (M u)_r = dL/dq_r + Q_r - db_r/dt
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import ModuleType
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp

from .._common.lookup import checked, refuse_if
from .._scalarjit.components import add, mul

SymPyObject: TypeAlias = Any
"""An expression, a vector, a point or a frame of SymPy, which is an optional dependency."""

Triangle = Sequence[Sequence[Any]]  # row i has i + 1 entries


class ModelData(NamedTuple):
    """A model in SymPy's objects."""

    name: str
    N: Any
    q: list[Any]
    u: list[Any]  # independent
    u_dep: list[Any]
    u_aux: list[Any]
    q_dep: list[Any]
    rates: dict[Any, Any]  # expressions of derivatives of coordinates
    residuals: list[Any]  # velocity residuals
    configuration: list[Any]
    bodies: list[Any]
    loads: list[Any]
    # Instead of bodies, expressions in the order of the speeds: M, dM/dt.
    M: Triangle = ()
    M_dot: Triangle = ()
    forces: Sequence[Any] = ()  # along the speeds, in addition to the loads
    origin: Any = None


def model_data(
    sympy: ModuleType, model: SymPyObject, dependent: tuple[str, ...], name: str, prescribed: tuple[Any, ...] = ()
) -> ModelData:
    mechanics = sympy.physics.mechanics
    kinds = tuple(getattr(mechanics, kind, ()) for kind in ("KanesMethod", "System", "LagrangesMethod"))
    checked(model, kinds, "from_sympy needs a KanesMethod, a System or a LagrangesMethod of SymPy")
    if isinstance(model, kinds[2]):
        return _of_lagrange(sympy, model, dependent, name, prescribed)
    if isinstance(model, kinds[0]):
        return _of_kane(model, name)
    loads = (*model.loads, *(load for actuator in model.actuators for load in actuator.to_loads()))
    kane = mechanics.KanesMethod(
        model.frame,
        model.q_ind,
        model.u_ind,
        kd_eqs=model.kdes,
        q_dependent=model.q_dep,
        u_dependent=model.u_dep,
        configuration_constraints=model.holonomic_constraints,
        velocity_constraints=model.velocity_constraints,
        u_auxiliary=model.u_aux,
        forcelist=loads or None,
        bodies=model.bodies,
        explicit_kinematics=False,
    )
    return _of_kane(kane, name, model.fixed_point)


def _of_kane(kane: SymPyObject, name: str, origin: SymPyObject = None) -> ModelData:
    refuse_if(
        not kane.bodies,
        f"{name}: this KanesMethod has no bodies. Pass KanesMethod(..., bodies=bodies, forcelist=loads), or call "
        "its kanes_equations(bodies, loads) before.",
    )
    u, u_dep, u_aux = list(kane.u), list(kane._udep), list(kane._uaux)
    residuals = list(kane._k_nh * kane.u + kane._f_nh) if u_dep else []
    return ModelData(
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


def _of_lagrange(
    sympy: ModuleType, lagrange: SymPyObject, dependent: tuple[str, ...], name: str, prescribed: tuple[Any, ...]
) -> ModelData:
    bodies = list(lagrange._bodies or ())
    refuse_if(
        bodies and lagrange.inertial is None,
        f"{name}: the inertial frame of the bodies is missing. Pass LagrangesMethod(..., frame=N).",
    )
    q, N = list(lagrange.q), lagrange.inertial or sympy.physics.mechanics.ReferenceFrame("N")
    rates = list(lagrange._qdots)
    wrong = [x for x in dependent if x not in [str(c.func) for c in q]]
    refuse_if(
        wrong or len(dependent) != len(lagrange.coneqs),
        f"{name}: `dependent` must name {len(lagrange.coneqs)} coordinates, one for each constraint; got "
        f"{', '.join(dependent) or 'none'}. The coordinates are: {', '.join(str(c.func) for c in q)}.",
    )
    speeds = [sympy.Function(f"{c.func}_dot")(*c.args) for c in q]
    to_speeds = dict(zip(rates, speeds))
    is_dep = [str(c.func) in dependent for c in q]
    order = [u for u, dep in zip(speeds, is_dep) if not dep], [u for u, dep in zip(speeds, is_dep) if dep]
    coordinate_of = dict(zip(speeds, q))
    of_speeds = {coordinate_of[u]: u for u in (*order[0], *order[1])}
    if bodies:
        # The potential is the difference between the kinetic energy and L.
        potential = sum((body.kinetic_energy(lagrange.inertial) for body in bodies), sympy.S.Zero) - lagrange._L[0]
        potential = sympy.expand(sympy.simplify(potential.xreplace(to_speeds)))
        fault = f"{name}: the Lagrangian is not the kinetic energy of the bodies minus a potential of q."
        refuse_if(potential.has(*of_speeds.values()), fault)
        inertia = (), (), [-potential.diff(c) for c in of_speeds]
    else:
        inertia = inertia_of(sympy, lagrange, of_speeds, name, prescribed)
    holonomic = list(lagrange._hol_coneqs)
    return ModelData(
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
        *inertia,
    )


def inertia_of(
    sympy: ModuleType, lagrange: SymPyObject, speeds: dict[Any, Any], name: str, prescribed: tuple[Any, ...] = ()
) -> tuple[Triangle, Triangle, Sequence[Any]]:
    """M, dM/dt, and the forces of the momentum form of a `LagrangesMethod` without bodies.

    **Arguments:**

    - `sympy`: the module.
    - `lagrange`: the `LagrangesMethod`.
    - `speeds`: the coordinates with their speeds, in the order of the speeds.
    - `name`: of the model, for messages.
    - `prescribed`: functions of time that L may contain, with their derivatives.

    **Raises:** `ValueError` if L is not a quadratic function of the rates, for a load without an inertial frame for its
    velocity, and for one whose velocity does not follow from the rates of the coordinates. `TypeError` for a load that
    acts neither at a point nor on a frame.
    """
    t = sympy.physics.mechanics.dynamicsymbols._t
    to_speeds = {c.diff(t): u for c, u in speeds.items()}

    def rate(x: SymPyObject) -> SymPyObject:
        return x.diff(t).xreplace(to_speeds)

    L, u = lagrange._L[0].xreplace(to_speeds), list(speeds.values())
    strange = sorted(str(x) for x in L.atoms(sympy.Derivative) if x.expr not in prescribed)
    refuse_if(
        strange,
        f"{name}: the Lagrangian contains {', '.join(strange)}. It may contain only first derivatives of the "
        "coordinates. Pass prescribed motions as prescribed={...}.",
    )
    M = [[_without(sympy, L.diff(x, y), u, name) for y in u[: i + 1]] for i, x in enumerate(u)]
    # The momenta in addition to M u: L may contain terms of the first order in the rates, e.g. for a moving frame.
    at_rest = dict.fromkeys(u, sympy.S.Zero)
    forces = []
    for c, x in speeds.items():
        b = L.diff(x).xreplace(at_rest)
        forces.append(L.diff(c) - rate(b) + _of_loads(sympy, lagrange, c.diff(t), name))
    return M, [[rate(entry) for entry in row] for row in M], forces


def _without(sympy: ModuleType, entry: SymPyObject, speeds: list[Any], name: str) -> SymPyObject:
    entry = sympy.simplify(entry)
    if entry.has(*speeds):
        raise ValueError(
            f"{name}: the Lagrangian is not a quadratic function of the rates of the coordinates: a second derivative "
            f"with respect to them is {entry}. The mass matrix may depend on time and coordinates only.",
        )
    return entry


def _of_loads(sympy: ModuleType, lagrange: SymPyObject, rate: SymPyObject, name: str) -> Any:
    """The generalized force along one rate: F . dv/du + T . domega/du, summed."""
    mechanics, N, total = sympy.physics.mechanics, lagrange.inertial, sympy.S.Zero
    known = {*lagrange.q, *lagrange._qdots}
    for part, vector in lagrange.forcelist:
        refuse_if(N is None, f"{name}: a load at {part} needs the inertial frame. Pass LagrangesMethod(..., frame=N).")
        if not isinstance(part, (mechanics.Point, mechanics.ReferenceFrame)):
            raise TypeError(
                f"{name}: a load of LagrangesMethod must act at a Point or on a ReferenceFrame, got {part!r}."
            )
        try:
            v = part.ang_vel_in(N) if isinstance(part, mechanics.ReferenceFrame) else part.vel(N)
        except ValueError as error:
            raise ValueError(f"{name}: {part}, at which a load acts, has no velocity in {N}: {error}") from error
        unknown = sorted(mechanics.find_dynamicsymbols(v, reference_frame=N) - known, key=str) if v != 0 else []
        refuse_if(
            unknown,
            f"{name}: the velocity of {part}, at which a load acts, contains {', '.join(map(str, unknown))}, which is "
            f"neither a coordinate nor its rate. Write it with {rate} and similar rates.",
        )
        total += v.diff(rate, N).dot(vector) if v != 0 else 0
    return total


ExtractedVector = tuple[tuple[int, tuple[int, int, int]], ...]  # (frame, indices of three expressions), summed


class ExtractedPoint(NamedTuple):
    name: str
    velocity: ExtractedVector
    position: ExtractedVector | None


class ExtractedBody(NamedTuple):
    name: str
    mass: int
    inertia: tuple[int, ...]  # nine indices, or none for a particle
    frame: int  # index of the frame of the inertia
    point: int
    angular_velocity: ExtractedVector


class ExtractedLoad(NamedTuple):
    point: int | None  # None: a torque
    angular_velocity: ExtractedVector
    vector: ExtractedVector


class ExtractedModel(NamedTuple):
    """A whole model. It is hashable, so that one model has one class. Expressions are stored by their index."""

    name: str
    q: tuple[Any, ...]
    u: tuple[Any, ...]
    u_dep: tuple[Any, ...]
    u_aux: tuple[Any, ...]
    q_dep: tuple[str, ...]
    inputs: tuple[Any, ...]
    constants: tuple[Any, ...]
    prescribed: tuple[tuple[Any, Callable[[Any], Any], int], ...]  # symbol; function of time; order of its derivative
    t: Any
    of_motion: tuple[Any, ...]
    of_loads: tuple[Any, ...]
    rates: tuple[int, ...]
    residuals: tuple[int, ...]
    configuration: tuple[int, ...]
    frames: tuple[tuple[str, tuple[int, ...], ExtractedVector], ...]
    points: tuple[ExtractedPoint, ...]
    bodies: tuple[ExtractedBody, ...]
    loads: tuple[ExtractedLoad, ...]
    forces: tuple[int, ...]
    inertia: tuple[tuple[int, ...], ...]  # rows of M, for a model without bodies
    inertia_rates: tuple[tuple[int, ...], ...]


class Extractor:
    """Extracts the expressions of a model, each once."""

    def __init__(self, sympy: ModuleType, data: ModelData, origin: SymPyObject, prescribed: Mapping[Any, Any]):
        self.sympy, self.data, self.origin = sympy, data, origin
        self.prescribed = prescribed
        self.replaced: set[Any] = set()  # prescribed functions that occur
        self.derivatives: dict[Any, tuple[Any, Callable[[Any], Any], int]] = {}  # of prescribed functions that are used
        self.t = sympy.physics.mechanics.dynamicsymbols._t
        self.of_motion: dict[Any, int] = {}
        self.of_loads: dict[Any, int] = {}
        self.frames: dict[Any, int] = {data.N: 0}
        self.extracted_frames: list[tuple[str, tuple[int, ...], ExtractedVector]] = []
        self.points: dict[Any, int] = {}
        self.extracted_points: list[ExtractedPoint] = []

    def model(self) -> ExtractedModel:
        data, place = self.data, self._place
        in_loads = functools.partial(place, among=self.of_loads)
        parts = {
            # Bodies at rest in the inertial frame, such as the ground, do not affect the motion.
            "bodies": tuple(self._body(body) for body in data.bodies if not self._rests(body)),
            "loads": tuple(self._load(load) for load in data.loads if not self._rests(load[0])),
            "rates": tuple(place(data.rates[c.diff(self.t)]) for c in data.q),
            "residuals": tuple(map(place, data.residuals)),
            "configuration": tuple(map(place, data.configuration)),
            "forces": tuple(map(in_loads, data.forces)),
            "inertia": tuple(tuple(map(place, row)) for row in data.M),
            "inertia_rates": tuple(tuple(map(in_loads, row)) for row in data.M_dot),
        }
        self._check_prescribed()
        inputs, constants = self._symbols()
        return ExtractedModel(
            name=data.name,
            q=tuple(data.q),
            u=tuple(data.u),
            u_dep=tuple(data.u_dep),
            u_aux=tuple(data.u_aux),
            q_dep=tuple(name_of(c) for c in data.q_dep),
            inputs=inputs,
            constants=constants,
            prescribed=tuple(self.derivatives.values()),
            t=self.t,
            of_motion=tuple(self.of_motion),
            of_loads=tuple(self.of_loads),
            frames=tuple(self.extracted_frames),
            points=tuple(self.extracted_points),
            **parts,
        )

    def _place(self, expression: SymPyObject, among: dict[Any, int] | None = None) -> int:
        """The index of an expression, in which rates of coordinates are replaced by speeds."""
        among = self.of_motion if among is None else among
        expression = self.sympy.physics.mechanics.msubs(self.sympy.sympify(expression), self.data.rates)
        expression = self._with_prescribed(expression)
        return among.setdefault(expression, len(among))

    def _with_prescribed(self, expression: SymPyObject) -> SymPyObject:
        """The expression, in which prescribed functions and their derivatives are replaced."""
        if not self.prescribed:
            return expression
        replaced = {}
        for x in expression.atoms(self.sympy.Derivative, self.sympy.core.function.AppliedUndef):
            is_derivative = isinstance(x, self.sympy.Derivative)
            motion, order = x.expr if is_derivative else x, x.derivative_count if is_derivative else 0
            if motion not in self.prescribed:
                continue
            given = self.prescribed[motion]
            if isinstance(given, self.sympy.Basic):
                replaced[x] = given.diff(self.t, order)
                continue
            symbol = motion if not order else self.sympy.Function(f"{motion.func}_rate_{order}")(self.t)
            self.derivatives[x] = symbol, given, order
            replaced[x] = symbol
        self.replaced |= {x.expr if isinstance(x, self.sympy.Derivative) else x for x in replaced}
        return expression.xreplace(replaced)

    def _check_prescribed(self) -> None:
        """**Raises:** `ValueError` for prescribed functions that the model does not contain, or solves for."""
        data = self.data
        for x in self.prescribed:
            refuse_if(
                x in (*data.q, *data.u, *data.u_dep, *data.u_aux),
                f"{data.name}: `prescribed` contains {x}, a coordinate or a speed of the model.",
            )
            refuse_if(
                x not in self.replaced, f"{data.name}: `prescribed` contains {x}, which is not part of the model."
            )

    def _vector(self, vector: SymPyObject, among: dict[Any, int] | None = None) -> ExtractedVector:
        parts = [] if vector == 0 else vector.args
        return tuple((self._frame(frame), tuple(self._place(x, among) for x in column)) for column, frame in parts)  # type: ignore

    def _frame(self, frame: SymPyObject) -> int:
        if frame not in self.frames:
            self.frames[frame] = len(self.frames)
            self.extracted_frames.append(("", (), ()))  # reserves its index while its angular velocity is extracted
            matrix = self._evaluated(lambda: frame.dcm(self.data.N), frame, "no orientation in the inertial frame")
            extracted = frame.name, tuple(self._place(x) for x in matrix), self._vector(self._omega(frame))
            self.extracted_frames[self.frames[frame] - 1] = extracted
        return self.frames[frame]

    def _omega(self, frame: SymPyObject) -> SymPyObject:
        fault = "no angular velocity in the inertial frame"
        return self._evaluated(lambda: frame.ang_vel_in(self.data.N), frame, fault)

    def _velocity(self, point: SymPyObject) -> SymPyObject:
        return self._evaluated(lambda: point.vel(self.data.N), point, "no velocity in the inertial frame")

    def _evaluated(self, quantity: SymPyObject, part: SymPyObject, fault: str) -> SymPyObject:
        try:
            return quantity()
        except ValueError as error:
            raise ValueError(f"{self.data.name}: {part} has {fault}: {error}") from error

    def _rests(self, part: SymPyObject) -> bool:
        point, frame = (getattr(part, name, None) for name in ("masscenter", "frame"))
        if hasattr(part, "pos_from"):
            point = part
        elif hasattr(part, "dcm"):
            frame = part
        return (point is None or self._velocity(point) == 0) and (frame is None or self._omega(frame) == 0)

    def _point(self, point: SymPyObject) -> int:
        if point not in self.points:
            self.points[point] = len(self.points)
            velocity, position = self._velocity(point), None
            if self.origin is not None:
                fault = f"no position from the origin {self.origin}"
                position = self._vector(self._evaluated(lambda: point.pos_from(self.origin), point, fault))
            self.extracted_points.append(ExtractedPoint(point.name, self._vector(velocity), position))
        return self.points[point]

    def _body(self, body: SymPyObject) -> ExtractedBody:
        if not hasattr(body, "central_inertia"):  # a Particle
            return ExtractedBody(body.name, self._place(body.mass), (), 0, self._point(body.point), ())
        inertia = body.central_inertia
        frames = {unit.args[0][1] for _, *units in inertia.args for unit in units} if inertia != 0 else set()
        # constant in the frame in which it is written, e.g. of a disk in a frame that does not spin with it
        frame = frames.pop() if len(frames) == 1 else body.frame
        matrix = inertia.to_matrix(frame) if inertia != 0 else self.sympy.zeros(3)
        places = tuple(self._place(x) for x in matrix)
        point, mass = self._point(body.masscenter), self._place(body.mass)
        return ExtractedBody(body.name, mass, places, self._frame(frame), point, self._vector(self._omega(body.frame)))

    def _load(self, load: SymPyObject) -> ExtractedLoad:
        part, vector = load
        part = getattr(part, "masscenter", part) if hasattr(part, "central_inertia") else part
        if isinstance(part, self.sympy.physics.mechanics.ReferenceFrame):
            return ExtractedLoad(None, self._vector(self._omega(part)), self._vector(vector, self.of_loads))
        return ExtractedLoad(self._point(part), (), self._vector(vector, self.of_loads))

    def _symbols(self) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        data, name = self.data, self.data.name
        known = {*data.q, *data.u, *data.u_dep, *data.u_aux, *(symbol for symbol, _, _ in self.derivatives.values())}

        def atoms(kind: Sequence[Any], among: Iterable[Any]) -> set[Any]:
            return {x for e in among for x in e.atoms(*kind)}

        derivatives = atoms([self.sympy.Derivative], (*self.of_motion, *self.of_loads))
        refuse_if(
            derivatives,
            f"{name}: no kinematic equation of the model determines {_listed(derivatives)}. For a prescribed "
            "motion, pass prescribed={...: an expression or a function of time}.",
        )
        applied = self.sympy.core.function.AppliedUndef
        unknown = {
            x.func.__name__
            for x in atoms([self.sympy.Function, self.sympy.Integral], (*self.of_motion, *self.of_loads))
            if not isinstance(x, applied) and x.func.__name__ not in (*FUNCTIONS, "Piecewise")
        }
        refuse_if(unknown, f"{name}: {_listed(unknown)} is not supported. Use other functions.")
        undeclared = atoms([applied], self.of_motion) - known
        refuse_if(
            undeclared,
            f"{name}: {_listed(undeclared)} in the motion is neither a coordinate nor a speed. Pass "
            "prescribed={...: an expression or a function of time}. Inputs can occur in loads only.",
        )
        inputs = sorted(atoms([applied], self.of_loads) - known, key=str)
        odd = [x for x in inputs if tuple(x.args) != (self.t,)]
        refuse_if(odd, f"{name}: {_listed(odd)} must be a function of time only.")
        symbols = {x for e in (*self.of_motion, *self.of_loads) for x in e.free_symbols} - {self.t}
        names = [str(x) for x in symbols]
        twice = {name for name in names if names.count(name) > 1}
        refuse_if(
            twice,
            f"{name}: two symbols named {_listed(twice)} have different assumptions, e.g. positive=True. Use one.",
        )
        return tuple(inputs), tuple(sorted(symbols, key=str))


def prescribed_motions(sympy: ModuleType, prescribed: Mapping[Any, Any], name: str) -> dict[Any, Any]:
    """Prescribed motions by SymPy's function of time: expressions of SymPy, or functions.

    **Raises:** `TypeError` for a key or a motion of another kind.
    """
    t, motions = sympy.physics.mechanics.dynamicsymbols._t, {}
    for key, motion in prescribed.items():
        symbol = sympy.Function(key)(t) if isinstance(key, str) else key
        if not isinstance(symbol, sympy.core.function.AppliedUndef) or symbol.args != (t,):
            raise TypeError(f"{name}: `prescribed` must name functions of time, e.g. dynamicsymbols('v'); got {key!r}.")
        if isinstance(motion, sympy.Basic) or not callable(motion):  # symbols of SymPy are callable
            motion = sympy.sympify(motion)
        if isinstance(motion, sympy.Basic) and motion.atoms(sympy.core.function.AppliedUndef):
            raise TypeError(
                f"{name}: the prescribed motion of {symbol} must depend on time and constants, got {motion}."
            )
        motions[symbol] = motion
    return motions


def name_of(x: SymPyObject) -> str:
    return str(getattr(x, "func", x)) if getattr(x, "args", ()) else str(x)


def _listed(things: Iterable[Any]) -> str:
    return ", ".join(sorted(map(str, things)))


def imported() -> ModuleType:
    try:
        import sympy  # pyright: ignore[reportMissingImports]
        import sympy.physics.mechanics  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError(
            "Models of SymPy need SymPy: `pip install sympy`, or `pip install 'jaxkane[symbolic]'`."
        ) from error
    return sympy


FUNCTIONS = {
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


def function(arguments: Sequence[Any], expressions: Sequence[Any]) -> Any:
    """The expressions as one function of components, with common subexpressions."""
    modules = [FUNCTIONS | _ARITHMETIC, "math"]
    return imported().lambdify(arguments, list(expressions), modules=modules, printer=_printer(), cse=True)


@functools.cache
def _printer() -> Any:
    """A printer of Python code. Sums and products are functions that drop exact zeros, because velocities are evaluated
    along one speed while all others are exactly zero. Integer powers stay integer."""
    from sympy.printing.pycode import PythonCodePrinter  # pyright: ignore[reportMissingImports]

    class Printer(PythonCodePrinter):
        def call(self, name: str, expr: SymPyObject) -> str:
            return f"{name}({', '.join(self._print(x) for x in expr.args)})"

        def _print_Integer(self, expr: SymPyObject) -> str:
            return repr(float(expr))  # as floats, exact ones and zeros can be dropped

        _print_One = _print_Zero = _print_NegativeOne = _print_Integer

        def _print_Pow(self, expr: SymPyObject, rational: bool = False) -> str:
            base, exponent = (self._print(x) for x in expr.args)
            if expr.exp.is_Integer:
                return f"({base})**({int(expr.exp)})"
            return f"sqrt({base})" if expr.exp == imported().S.Half else f"({base})**({exponent})"

        def _print_Piecewise(self, expr: SymPyObject) -> str:
            value = "nan"
            for x, condition in reversed(expr.args):
                if condition is imported().true:
                    value = self._print(x)
                else:
                    value = f"_where({self._print(condition)}, {self._print(x)}, {value})"
            return value

    called = {"Add": "_sum", "Mul": "_product", "And": "_both", "Or": "_either", "Not": "_not"}
    for kind, name in {**called, **{name: name for name in FUNCTIONS}}.items():
        setattr(Printer, f"_print_{kind}", lambda self, expr, *_, name=name, **__: self.call(name, expr))
    return Printer({"fully_qualified_modules": False, "inline": True, "allow_unknown_functions": True})


_ARITHMETIC = {
    "_sum": lambda *terms: functools.reduce(add, terms),
    "_product": lambda *factors: functools.reduce(mul, factors),
    "_where": jnp.where,
    "_both": lambda *conditions: functools.reduce(jnp.logical_and, conditions),
    "_either": lambda *conditions: functools.reduce(jnp.logical_or, conditions),
    "_not": jnp.logical_not,
    "nan": float("nan"),
}
