"""What a model of SymPy says, and its expressions as functions of components."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp

from .._scalarjit.components import Component, add, mul
from ._lagrangian import Inertia, inertia_of


def imported() -> Any:
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
            return f"sqrt({base})" if expr.exp == imported().S.Half else f"({base})**({exponent})"

        def _print_And(self, expr: Any) -> str:
            return self.call("_both", expr)

        def _print_Or(self, expr: Any) -> str:
            return self.call("_either", expr)

        def _print_Not(self, expr: Any) -> str:
            return self.call("_not", expr)

        def _print_Piecewise(self, expr: Any) -> str:
            value = "nan"
            for x, condition in reversed(expr.args):
                if condition is imported().true:
                    value = self._print(x)
                else:
                    value = f"_where({self._print(condition)}, {self._print(x)}, {value})"
            return value

        def _print_known(self, expr: Any) -> str:
            return self.call(expr.func.__name__, expr)

    for name in FUNCTIONS:
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
