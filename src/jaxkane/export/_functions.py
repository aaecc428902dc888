"""What the exports have in common: which functions are asked for. Knows no language."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .._common.lookup import refuse_unknown
from .._description.system import System
from .._method.formulas import JACOBIANS, OFFERED, Formulas

USUAL = ("rates", "equations", "dependent_speeds", *JACOBIANS)


def chosen(formulas: Formulas, functions: Sequence[str] | None, usual: Sequence[str] = USUAL) -> tuple[str, ...]:
    """The functions that were asked for; by default the usual ones that the system has."""
    if functions is None:
        needs = {"dependent_speeds": "u_dep", "input_jacobian": "inputs", "parameter_jacobian": "parameters"}
        found = tuple(name for name in usual if name not in needs or formulas.names(needs[name]))
        return (*found, "state_rates") if formulas.system.states else found
    if isinstance(functions, str):
        raise TypeError(f"functions is a sequence of names; one is ({functions!r},).")
    functions = tuple(dict.fromkeys(functions))
    if not functions:
        raise ValueError(f"{formulas.name}: `functions` names none; leave it out for the usual ones.")
    refuse_unknown(functions, OFFERED, f"{formulas.name}: there is no function", "there are")
    return functions


def one_function(formulas: Formulas, function: Any, exporter: str) -> str:
    """The name of the one function that an exporter was asked for, checked."""
    if not isinstance(function, str):
        raise TypeError(f"{exporter} exports one function at a time; `function` is its name, got {function!r}.")
    refuse_unknown([function], OFFERED, f"{formulas.name}: there is no function", "there are")
    return function


def parameters(system: System) -> dict[str, np.ndarray]:
    """A system's parameters by name, in the order in which exported functions take them.

    A parameter of a part is called by its path, "frame.mass"; one with axes is an array.
    """
    return Formulas(system).values()
