"""What a model of SymPy says, in SymPy's own terms: of Kane's method, of its systems, of Lagrange's equations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from ._lagrangian import Inertia, inertia_of


class Words(NamedTuple):
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


def words_of(sympy: Any, model: Any, dependent: tuple[str, ...], name: str) -> Words:
    mechanics = sympy.physics.mechanics
    kinds = [getattr(mechanics, kind, ()) for kind in ("KanesMethod", "System", "LagrangesMethod")]
    if isinstance(model, kinds[0]):
        return _of_kane(model, name)
    if isinstance(model, kinds[1]):
        return _of_system(mechanics, model, name)
    if isinstance(model, kinds[2]):
        return _of_lagrange(sympy, model, dependent, name)
    raise TypeError(f"from_sympy takes a KanesMethod, a System or a LagrangesMethod of SymPy, got {model!r}.")


def _of_kane(kane: Any, name: str, origin: Any = None) -> Words:
    if not kane.bodies:
        raise ValueError(
            f"{name}: this KanesMethod knows no bodies. Give them, KanesMethod(..., bodies=bodies, forcelist=loads), "
            "or call its kanes_equations(bodies, loads) before."
        )
    u, u_dep, u_aux = list(kane.u), list(kane._udep), list(kane._uaux)
    residuals = list(kane._k_nh * kane.u + kane._f_nh) if u_dep else []
    return Words(
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


def _of_system(mechanics: Any, system: Any, name: str) -> Words:
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


def _of_lagrange(sympy: Any, lagrange: Any, dependent: tuple[str, ...], name: str) -> Words:
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
    return Words(
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
