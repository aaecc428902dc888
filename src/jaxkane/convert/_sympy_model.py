"""The contents of a KanesMethod, a System or a LagrangesMethod of SymPy as one set of model data. Does not make a
system.

A Lagrangian without bodies gives Lagrange's equations in momentum form, with L = 1/2 u.M u + b.u + L0 for the rates u
of the coordinates:

    d/dt (M u)_r = dL/dq_r + Q_r - db_r/dt
"""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType
from typing import Any, NamedTuple, TypeAlias

SymPyObject: TypeAlias = Any
"""An expression, a vector, a point or a frame of SymPy, which is an optional dependency."""

Triangle = Sequence[Sequence[Any]]  # row i has i + 1 entries


class Inertia(NamedTuple):
    """SymPy's expressions in the order of the speeds: M, dM/dt, and the forces of the momentum form."""

    M: Triangle = ()
    M_dot: Triangle = ()
    forces: Sequence[Any] = ()


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
    forces: Sequence[Any] = ()  # along the speeds, in addition to the loads
    inertia: Inertia = Inertia()  # instead of bodies
    origin: Any = None


def model_data(
    sympy: ModuleType, model: Any, dependent: tuple[str, ...], name: str, prescribed: tuple[Any, ...] = ()
) -> ModelData:
    mechanics = sympy.physics.mechanics
    kinds = [getattr(mechanics, kind, ()) for kind in ("KanesMethod", "System", "LagrangesMethod")]
    if isinstance(model, kinds[0]):
        return _of_kane(model, name)
    if isinstance(model, kinds[1]):
        return _of_system(mechanics, model, name)
    if isinstance(model, kinds[2]):
        return _of_lagrange(sympy, model, dependent, name, prescribed)
    raise TypeError(f"from_sympy needs a KanesMethod, a System or a LagrangesMethod of SymPy, got {model!r}.")


def _of_kane(kane: Any, name: str, origin: Any = None) -> ModelData:
    if not kane.bodies:
        raise ValueError(
            f"{name}: this KanesMethod has no bodies. Pass KanesMethod(..., bodies=bodies, forcelist=loads), or call "
            "its kanes_equations(bodies, loads) before."
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


def _of_system(mechanics: ModuleType, system: Any, name: str) -> ModelData:
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


def _of_lagrange(
    sympy: ModuleType, lagrange: Any, dependent: tuple[str, ...], name: str, prescribed: tuple[Any, ...]
) -> ModelData:
    bodies = list(lagrange._bodies or ())
    if bodies and lagrange.inertial is None:
        raise ValueError(f"{name}: the inertial frame of the bodies is missing. Pass LagrangesMethod(..., frame=N).")
    q, N = list(lagrange.q), lagrange.inertial or sympy.physics.mechanics.ReferenceFrame("N")
    rates = list(lagrange._qdots)
    wrong = [x for x in dependent if x not in [str(c.func) for c in q]]
    if wrong or len(dependent) != len(lagrange.coneqs):
        raise ValueError(
            f"{name}: `dependent` must name {len(lagrange.coneqs)} coordinates, one for each constraint; got "
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
        inertia.forces,
        inertia,
    )


def _forces_of_potential(
    sympy: ModuleType, lagrange: Any, bodies: list[Any], to_speeds: dict[Any, Any], of_speeds: dict[Any, Any], name: str
) -> list[Any]:
    """Forces along the speeds of the potential, which is the difference between the kinetic energy and L."""
    potential = sum((body.kinetic_energy(lagrange.inertial) for body in bodies), sympy.S.Zero) - lagrange._L[0]
    potential = sympy.expand(sympy.simplify(potential.xreplace(to_speeds)))
    if potential.has(*of_speeds.values()):
        raise ValueError(f"{name}: the Lagrangian is not the kinetic energy of the bodies minus a potential of q.")
    return [-potential.diff(c) for c in of_speeds]


def inertia_of(
    sympy: ModuleType, lagrange: Any, speeds: dict[Any, Any], name: str, prescribed: tuple[Any, ...] = ()
) -> Inertia:
    """Inertia and forces of a `LagrangesMethod` without bodies.

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
    if strange:
        raise ValueError(
            f"{name}: the Lagrangian contains {strange[0]}. It may contain only first derivatives of the coordinates. "
            "Pass prescribed motions as prescribed={...}."
        )
    M = [[_without(sympy, L.diff(x, y), u, name) for y in u[: i + 1]] for i, x in enumerate(u)]
    # The momenta in addition to M u: L may contain terms of the first order in the rates, e.g. for a moving frame.
    at_rest = dict.fromkeys(u, sympy.S.Zero)
    forces = []
    for c, x in speeds.items():
        b = L.diff(x).xreplace(at_rest)
        forces.append(L.diff(c) - rate(b) + _of_loads(sympy, lagrange, c.diff(t), name))
    return Inertia(M, [[rate(entry) for entry in row] for row in M], forces)


def _without(sympy: ModuleType, entry: SymPyObject, speeds: list[Any], name: str) -> SymPyObject:
    entry = sympy.simplify(entry)
    if entry.has(*speeds):
        raise ValueError(
            f"{name}: the Lagrangian is not a quadratic function of the rates of the coordinates: a second derivative "
            f"with respect to them is {entry}. The mass matrix may depend on time and coordinates only."
        )
    return entry


def _of_loads(sympy: ModuleType, lagrange: Any, rate: Any, name: str) -> Any:
    """The generalized force along one rate: F . dv/du + T . domega/du, summed."""
    mechanics, N, total = sympy.physics.mechanics, lagrange.inertial, sympy.S.Zero
    known = {*lagrange.q, *lagrange._qdots}
    for part, vector in lagrange.forcelist:
        if N is None:
            raise ValueError(f"{name}: a load at {part} needs the inertial frame. Pass LagrangesMethod(..., frame=N).")
        if not isinstance(part, (mechanics.Point, mechanics.ReferenceFrame)):
            raise TypeError(
                f"{name}: a load of LagrangesMethod must act at a Point or on a ReferenceFrame, got {part!r}."
            )
        try:
            v = part.ang_vel_in(N) if isinstance(part, mechanics.ReferenceFrame) else part.vel(N)
        except ValueError as error:
            raise ValueError(f"{name}: {part}, at which a load acts, has no velocity in {N}: {error}") from error
        unknown = sorted(mechanics.find_dynamicsymbols(v, reference_frame=N) - known, key=str) if v != 0 else []
        if unknown:
            raise ValueError(
                f"{name}: the velocity of {part}, at which a load acts, contains {unknown[0]}, which is neither a "
                f"coordinate nor its rate. Write it with {rate} and similar rates."
            )
        total += v.diff(rate, N).dot(vector) if v != 0 else 0
    return total
