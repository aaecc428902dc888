"""Equations as a compiled program for any batch, loaded by JAX alone. Knows `jax.export`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import numpy as np

from .._kane.formulas import Formulas
from .._system.system import System
from ._functions import one_function

PLATFORMS = ("cpu", "cuda", "rocm", "tpu")


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
        _refuse_without_flatbuffers()
    formulas = Formulas(system, dtype)
    one_function(formulas, function, "stablehlo")
    if isinstance(platforms, str):
        raise TypeError(f"platforms is a sequence of names; one is ({platforms!r},).")
    strange = [platform for platform in platforms if platform not in PLATFORMS]
    if strange or not platforms:
        raise ValueError(f"platforms are of {', '.join(PLATFORMS)}; got {platforms!r}.")
    u_dep = np.zeros(len(formulas.names("u_dep")), formulas.dtype)  # of which no such function knows

    def of_one(t, q, u, inputs, parameters):
        return formulas.by_jax(
            function, t, q, u, inputs, u_dep, *(parameters[a.name] for a in formulas.of_kind("parameters"))
        )

    axes = (0, 0, 0, 0, 0 if batch_parameters else None)
    with jax.enable_x64(formulas.dtype == "float64"):
        (b,) = export.symbolic_shape("b")
        of = lambda *shape: jax.ShapeDtypeStruct(shape, formulas.dtype)  # noqa: E731
        vectors = [of(b, len(formulas.names(kind))) for kind in ("q", "u", "inputs")]
        numbers = {a.name: of(*((b,) * batch_parameters), *a.shape) for a in formulas.of_kind("parameters")}
        exported = export.export(jax.jit(jax.vmap(of_one, axes)), platforms=platforms)(of(b), *vectors, numbers)
        if path is not None:
            Path(path).parent.mkdir(parents=True, exist_ok=True)
            Path(path).write_bytes(bytes(exported.serialize(vjp_order=derivatives)))
    return exported


def _refuse_without_flatbuffers() -> None:
    try:
        import flatbuffers  # noqa: F401
    except ImportError as error:
        raise ImportError(
            'JAX writes programs with flatbuffers: pip install "jaxkane[stablehlo]". Without a path none is needed.'
        ) from error
