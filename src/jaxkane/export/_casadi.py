"""Equations as a function of CasADi, for Opti, IPOPT and acados. Knows CasADi, which is imported when asked for."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from .._kane.formulas import Formulas
from .._scalarjit.backends.source import as_objects
from .._scalarjit.graph import OPERATORS, NotScalarError, needed
from .._system.system import System
from ._functions import in_ascii, one_function


def casadi(system: System, function: str = "rates", *, name: str | None = None) -> Any:
    """One of a system's functions as a `casadi.Function` of scalars (SX), which CasADi differentiates itself.

        f = jk.export.casadi(pendulum)
        q_dot, u_dot = f(0.0, q, u, [0.0], list(jk.export.parameters(pendulum).values()))
        f(t=0.0, q=q, u=u, inputs=0.0, parameters=p)["u_dot"]; f.jacobian()

    Its inputs are `t`, `q`, `u`, `inputs` and `parameters`, columns in the order of the declared names (parameters with
    axes row by row; `jaxkane.export.parameters` has them by name), its outputs those of the function; partial
    velocities V, W (b, 3, n) come as matrices (3 b, n).

    Values are those of JAX, but for two things: CasADi's `fmax` and `fmin` drop what is not a number, and it writes 0
    for 0 * x, also where x is infinite.

    **Arguments:**

    - `function`: as in `jaxkane.export.c`: "rates" (q_dot, u_dot), "equations" (M, f), "state_jacobian" ...
    - `name`: of the function in CasADi; by default that of the system with that of the function.

    **Raises:** `ImportError` without casadi, `ValueError` as `jaxkane.export.c`.
    """
    ca = _imported()
    formulas = Formulas(system)
    one_function(formulas, function, "casadi")
    by_output = formulas.nodes(function)
    columns: dict[str, list[Any]] = {kind: [] for kind in ("t", "q", "u", "inputs", "parameters")}
    symbols = {}
    for a, nodes in zip(formulas.arguments, formulas.inputs, strict=True):
        for element, k in zip(a.elements, nodes.flat, strict=True):
            symbols[int(k)] = ca.SX.sym(element)
            if a.kind in columns:
                columns[a.kind].append(symbols[int(k)])
    graph = formulas.graph
    nodes = needed(graph.nodes, by_output.values())
    if any(graph.nodes[k].dtype == "float32" for k in nodes):
        raise ValueError(f"{formulas.name}: its description computes in float32 in between, which CasADi has not.")
    try:
        objects = as_objects(graph, nodes, symbols, table(ca), lambda v, _: ca.SX(float(v)), "CasADi")
    except NotScalarError as error:
        raise ValueError(f"{formulas.name}: {function!r} holds {error}.") from None
    outputs = [_matrix(ca, nodes, objects) for nodes in by_output.values()]
    label = re.sub(r"_+", "_", in_ascii(name or f"{formulas.name}_{function}")).strip("_")  # as CasADi wants names
    return ca.Function(label, [ca.vertcat(*x) for x in columns.values()], outputs, [*columns], [*by_output])


def _matrix(ca: Any, nodes: np.ndarray, objects: dict[int, Any]) -> Any:
    rows = nodes.reshape(-1, nodes.shape[-1] if nodes.ndim > 1 else 1)
    matrix = ca.SX(*rows.shape)
    for (i, j), k in np.ndenumerate(rows):
        matrix[i, j] = objects[int(k)]
    return matrix


def table(ca: Any) -> dict[str, Any]:
    own = "sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh exp expm1 log log1p erf sqrt floor".split()
    return {name: getattr(ca, name) for name in own} | {
        **OPERATORS,
        "rem": ca.fmod,
        "pow": lambda x, y: x**y,
        "exp2": lambda x: 2**x,
        "cbrt": lambda x: ca.sign(x) * ca.fabs(x) ** (1 / 3),
        "abs": ca.fabs,
        "max": ca.fmax,
        "min": ca.fmin,
        "eq": lambda x, y: x == y,
        "ne": lambda x, y: x != y,
        "lt": lambda x, y: x < y,
        "le": lambda x, y: x <= y,
        "gt": lambda x, y: x > y,
        "ge": lambda x, y: x >= y,
        "and": ca.logic_and,
        "or": ca.logic_or,
        "xor": lambda x, y: x != y,
        "select": ca.if_else,
        "convert": lambda x: x,  # of a comparison, which is 0 or 1
    }


def _imported() -> Any:
    try:
        import casadi
    except ImportError as error:
        raise ImportError('jaxkane.export.casadi needs CasADi: pip install "jaxkane[casadi]".') from error
    return casadi
