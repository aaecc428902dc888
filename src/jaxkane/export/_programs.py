"""One function of a system as a program: a `casadi.Function`, or StableHLO, which JAX loads without this package."""

from __future__ import annotations

import operator
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from .._common.files import write_file
from .._integrate.inputs import Coordinates, Speeds
from .._integrate.jumps import warn_of_jumps
from .._kane.expression_graph import Formulas
from .._scalarjit.graph import OPERATORS, NotScalarError, needed
from .._scalarjit.source import as_objects
from .._system.system import System
from ._source import function_names, in_ascii


def casadi(system: System, function: str = "rates", *, name: str | None = None) -> Any:
    """One of a system's functions as a `casadi.Function` of scalars (SX), which CasADi can differentiate.

        f = jk.export.casadi(pendulum)
        q_dot, u_dot = f(0.0, q, u, [0.0], list(jk.export.parameters(pendulum).values()))
        f(t=0.0, q=q, u=u, inputs=0.0, parameters=p)["u_dot"]; f.jacobian()

    Its inputs are `t`, `q`, `u`, `inputs` and `parameters`, columns in the order of the declared names. Parameters with
    axes are flattened row by row; `jaxkane.export.parameters` returns them by name. Its outputs are those of the
    function. Partial velocities V, W (b, 3, n) are matrices (3 b, n).

    Values are equal to those of JAX, with two exceptions: CasADi's `fmax` and `fmin` ignore NaN, and it simplifies 0 *
    x to 0, also for infinite x.

    **Arguments:**

    - `system`: the system.
    - `function`: as in `jaxkane.export.c`: "rates" (q_dot, u_dot), "equations" (M, f), "state_jacobian" ...
    - `name`: of the function in CasADi. Default: the names of the system and of the function.

    **Raises:** `ImportError` without casadi; `ValueError` as `jaxkane.export.c`.
    """
    try:
        import casadi as ca
    except ImportError as error:
        raise ImportError('jaxkane.export.casadi needs CasADi: pip install "jaxkane[casadi]".') from error
    formulas = _checked_formulas(system, "float64", function, "casadi")
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
        raise ValueError(f"{formulas.name}: the system computes some values in float32, which CasADi does not support.")
    try:
        objects = as_objects(graph, nodes, symbols, casadi_operations(ca), lambda v, _: ca.SX(float(v)), "CasADi")
    except NotScalarError as error:
        raise ValueError(f"{formulas.name}: {function!r} contains {error}.") from None
    outputs = [_matrix(ca, nodes, objects) for nodes in by_output.values()]
    # the form of names that CasADi accepts
    label = re.sub(r"_+", "_", in_ascii(name or f"{formulas.name}_{function}")).strip("_")
    return ca.Function(label, [ca.vertcat(*x) for x in columns.values()], outputs, [*columns], [*by_output])


def _checked_formulas(system: System, dtype: str, function: object, exporter: str) -> Formulas:
    """The formulas of a system. A value that is not the name of one function is refused."""
    warn_of_jumps(system, f"jaxkane.export.{exporter}")
    formulas = Formulas(system, dtype)
    if not isinstance(function, str):
        raise TypeError(f"{exporter} exports one function; `function` must be its name, got {function!r}.")
    function_names(formulas, (function,))
    return formulas


def _matrix(ca: ModuleType, nodes: np.ndarray, objects: dict[int, Any]) -> Any:
    rows = nodes.reshape(-1, nodes.shape[-1] if nodes.ndim > 1 else 1)
    matrix = ca.SX(*rows.shape)
    for (i, j), k in np.ndenumerate(rows):
        matrix[i, j] = objects[int(k)]
    return matrix


def casadi_operations(ca: ModuleType) -> dict[str, Any]:
    """CasADi's functions for the operations of graphs."""
    own = "sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh exp expm1 log log1p erf sqrt floor".split()
    return {name: getattr(ca, name) for name in own} | {
        **OPERATORS,
        "rem": ca.fmod,
        "pow": operator.pow,
        "exp2": lambda x: 2**x,
        # CasADi has no cube root, and a fractional power of a negative number is NaN.
        "cbrt": lambda x: ca.sign(x) * ca.fabs(x) ** (1 / 3),
        "abs": ca.fabs,
        "max": ca.fmax,
        "min": ca.fmin,
        **{name: getattr(operator, name) for name in ("eq", "ne", "lt", "le", "gt", "ge")},
        "and": ca.logic_and,
        "or": ca.logic_or,
        "xor": operator.ne,
        "select": ca.if_else,
        "convert": lambda x: x,  # of a comparison, which is 0 or 1 in CasADi
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
    """One of a system's functions as a program in StableHLO, which JAX loads without jaxkane, for any batch size.

        jk.export.stablehlo(bicycle, "bicycle.stablehlo")
        # elsewhere, without jaxkane:
        # f = jax.export.deserialize(bytearray(open("bicycle.stablehlo", "rb").read())).call
        # q_dot, u_dot = f(t, q, u, inputs, parameters)

    Its arguments have a leading axis of any length b: `t` (b,), `q` (b, n_q), `u` (b, n_u), `inputs` (b, n_inputs), in
    the order of the declared names. `parameters` is a dict of arrays by name, as from `jaxkane.export.parameters`.
    Outputs (b, ...) are a tuple. The program contains only operations of XLA and no native kernels. Its results are
    bit-identical to those of `jax.jit` without native kernels. Enable `jax_enable_x64` to call a float64 program.

    **Arguments:**

    - `system`: the system.
    - `path`: the file to write, or None.
    - `function`: as in `jaxkane.export.c`: "rates" (q_dot, u_dot), "equations" (M, f) and others.
    - `dtype`: "float64" or "float32".
    - `batch_parameters`: whether the parameters have the leading axis too.
    - `platforms`: where the program can run: "cpu", "cuda", "rocm", "tpu".
    - `derivatives`: how many times the loaded program can be differentiated in reverse mode.

    **Returns:** the `jax.export.Exported`.

    **Raises:** `ImportError` for a path without flatbuffers, which JAX needs to write; `ValueError` as
    `jaxkane.export.c`, except for operations, because all of them can be exported.
    """
    from jax import export

    if path is not None:
        try:
            import flatbuffers  # noqa: F401
        except ImportError as error:
            raise ImportError(
                'To save a program, JAX needs flatbuffers: pip install "jaxkane[stablehlo]". Or omit `path`.'
            ) from error
    formulas = _checked_formulas(system, dtype, function, "stablehlo")
    if isinstance(platforms, str) or not platforms or not all(x in _PLATFORMS for x in platforms):
        kind = TypeError if isinstance(platforms, str) else ValueError
        raise kind(f"`platforms` must be a sequence of some of {', '.join(_PLATFORMS)}; got {platforms!r}.")
    u_dep = np.zeros(len(formulas.names("u_dep")), formulas.dtype)  # the functions of `OFFERED` do not use them

    def of_one_state(t: Array, q: Coordinates, u: Speeds, inputs: Float[Array, " n_w"], parameters: dict[str, Array]):
        return formulas.by_jax(
            function, t, q, u, inputs, u_dep, *(parameters[a.name] for a in formulas.of_kind("parameters"))
        )

    axes = (0, 0, 0, 0, 0 if batch_parameters else None)
    with jax.enable_x64(formulas.dtype == "float64"):
        # With a symbolic size, one program serves batches of any length. A number would fix the length.
        (b,) = export.symbolic_shape("b")

        def array(*shape: Any) -> jax.ShapeDtypeStruct:
            return jax.ShapeDtypeStruct(shape, formulas.dtype)

        vectors = [array(b, len(formulas.names(kind))) for kind in ("q", "u", "inputs")]
        numbers = {a.name: array(*((b,) * batch_parameters), *a.shape) for a in formulas.of_kind("parameters")}
        exported = export.export(jax.jit(jax.vmap(of_one_state, axes)), platforms=platforms)(
            array(b), *vectors, numbers
        )
        if path is not None:
            write_file(path, bytes(exported.serialize(vjp_order=derivatives)))
    return exported
