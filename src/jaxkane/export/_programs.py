"""One function of a system as a program: a `casadi.Function`, or StableHLO, which JAX loads without this package."""

from __future__ import annotations

import operator
import re
from pathlib import Path
from typing import Any

import jax
import numpy as np

from .._kane.formulas import Formulas
from .._scalarjit.backends.source import as_objects
from .._scalarjit.graph import OPERATORS, NotScalarError, needed
from .._system.system import System
from ._source import check_function, in_ascii, write_file


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
    try:
        import casadi as ca
    except ImportError as error:
        raise ImportError('jaxkane.export.casadi needs CasADi: pip install "jaxkane[casadi]".') from error
    formulas = Formulas(system)
    check_function(formulas, function, "casadi")
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
        objects = as_objects(graph, nodes, symbols, casadi_operations(ca), lambda v, _: ca.SX(float(v)), "CasADi")
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


def casadi_operations(ca: Any) -> dict[str, Any]:
    """CasADi's functions for the operations of graphs."""
    own = "sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh exp expm1 log log1p erf sqrt floor".split()
    return {name: getattr(ca, name) for name in own} | {
        **OPERATORS,
        "rem": ca.fmod,
        "pow": operator.pow,
        "exp2": lambda x: 2**x,
        "cbrt": lambda x: ca.sign(x) * ca.fabs(x) ** (1 / 3),
        "abs": ca.fabs,
        "max": ca.fmax,
        "min": ca.fmin,
        **{name: getattr(operator, name) for name in ("eq", "ne", "lt", "le", "gt", "ge")},
        "and": ca.logic_and,
        "or": ca.logic_or,
        "xor": operator.ne,
        "select": ca.if_else,
        "convert": lambda x: x,  # of a comparison, which is 0 or 1
    }


_PLATFORMS = ("cpu", "cuda", "rocm", "tpu")


def stablehlo(
    system: System,
    path: str | Path | None = None,
    function: str = "rates",
    *,
    dtype: str = "float64",
    batch_parameters: bool = False,
    platforms: tuple[str, ...] = ("cpu",),
    derivatives: int = 0,
) -> Any:
    """One of a system's functions as a program in StableHLO, which JAX loads without jaxkane, for any batch.

        jk.export.stablehlo(bicycle, "bicycle.stablehlo")
        # elsewhere, without jaxkane:
        # f = jax.export.deserialize(bytearray(open("bicycle.stablehlo", "rb").read())).call
        # q_dot, u_dot = f(t, q, u, inputs, parameters)

    Its arguments have a leading axis of any one length b: `t` (b,), `q` (b, n_q), `u` (b, n_u), `inputs` (b, n_inputs),
    in the order of the declared names; `parameters` is a dict of arrays by name, as `jaxkane.export.parameters` gives
    it. Outputs (b, ...) come as a tuple. It holds operations of XLA alone, none of the native kernels: bit for bit what
    `jax.jit` gives without these. A float64 program is called where `jax_enable_x64` is on.

    **Arguments:**

    - `path`: where the program is written; None writes none.
    - `function`: as in `jaxkane.export.c`: "rates" (q_dot, u_dot), "equations" (M, f) and others.
    - `dtype`: "float64" or "float32".
    - `batch_parameters`: the parameters, too, have the leading axis.
    - `platforms`: where it may run: "cpu", "cuda", "rocm", "tpu".
    - `derivatives`: how many times the loaded program can be differentiated in reverse mode.

    **Returns:** the `jax.export.Exported`.

    **Raises:** `ImportError` for a path without flatbuffers, which JAX writes with; `ValueError` as `jaxkane.export.c`,
    but for operations, of which every one can be exported.
    """
    from jax import export

    if path is not None:
        try:
            import flatbuffers  # noqa: F401
        except ImportError as error:
            raise ImportError(
                'JAX writes programs with flatbuffers: pip install "jaxkane[stablehlo]". Without a path none is needed.'
            ) from error
    formulas = Formulas(system, dtype)
    check_function(formulas, function, "stablehlo")
    if isinstance(platforms, str):
        raise TypeError(f"platforms is a sequence of names; one is ({platforms!r},).")
    unknown = [platform for platform in platforms if platform not in _PLATFORMS]
    if unknown or not platforms:
        raise ValueError(f"platforms are of {', '.join(_PLATFORMS)}; got {platforms!r}.")
    u_dep = np.zeros(len(formulas.names("u_dep")), formulas.dtype)  # no function of `OFFERED` reads them

    def of_one_state(t, q, u, inputs, parameters):
        return formulas.by_jax(
            function, t, q, u, inputs, u_dep, *(parameters[a.name] for a in formulas.of_kind("parameters"))
        )

    axes = (0, 0, 0, 0, 0 if batch_parameters else None)
    with jax.enable_x64(formulas.dtype == "float64"):
        (b,) = export.symbolic_shape("b")
        of = lambda *shape: jax.ShapeDtypeStruct(shape, formulas.dtype)  # noqa: E731
        vectors = [of(b, len(formulas.names(kind))) for kind in ("q", "u", "inputs")]
        numbers = {a.name: of(*((b,) * batch_parameters), *a.shape) for a in formulas.of_kind("parameters")}
        exported = export.export(jax.jit(jax.vmap(of_one_state, axes)), platforms=platforms)(of(b), *vectors, numbers)
        if path is not None:
            write_file(path, bytes(exported.serialize(vjp_order=derivatives)))
    return exported
