"""SymPy's mechanics as a system: its bodies, loads and constraints. Derives nothing; Kane's method does, from these.

Of a model only the description is taken: velocities of points, orientations and angular velocities of frames, masses,
inertias, loads and constraints, as expressions in coordinates and speeds. SymPy turns them into one function with
common subexpressions; its equations of motion need not have been formed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from .._common.lookup import as_names, hint
from .._description.system import System
from ._sympy_functions import imported
from ._sympy_model import words_of
from ._sympy_plan import Plan, Taker
from ._sympy_system import SympySystem, class_of


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
