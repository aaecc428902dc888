"""The program that compares functions in C with numbers that JAX computed."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import jax
import numpy as np

from .._method.formulas import Formulas

COMPARE = """
/* Prints the largest difference, as a part of the largest expected number. */
static int compare(const char *name, int n, const {type} *found, const {type} *expected) {{
    double difference = 0.0, size = 0.0;
    int i;
    for (i = 0; i < n; i++) {{
        const double d = fabs((double)found[i] - (double)expected[i]);
        if (found[i] == expected[i] || (found[i] != found[i] && expected[i] != expected[i])) continue;
        if (!(d <= difference)) difference = d; /* also where it is not a number */
        if (fabs((double)expected[i]) > size) size = fabs((double)expected[i]);
    }}
    printf("%-40s %.1e\\n", name, size > 0.0 ? difference / size : difference);
    return !(difference <= {tolerance} * size);
}}
"""


def trial(formulas: Formulas, functions: Iterable[str]) -> tuple[dict[str, Any], dict[str, dict[str, np.ndarray]]]:
    """Time, coordinates, speeds and inputs, and what JAX computes there for this system; all of it finite."""
    state: dict[str, Any] = {}
    expected: dict[str, dict[str, np.ndarray]] = {}
    for seed in range(20):
        rng = np.random.default_rng(seed)
        draw = lambda n, rng=rng: rng.uniform(0.2, 0.8, n).astype(formulas.dtype)  # noqa: E731
        state = {"t": draw(()), **{kind: draw(len(formulas.names(kind))) for kind in ("q", "u", "inputs", "u_dep")}}
        args = [*state.values(), *formulas.values().values()]
        with jax.enable_x64(formulas.dtype == "float64"):
            for function in functions:
                outputs = jax.tree.map(np.asarray, formulas.by_jax(function, *args))
                expected[function] = dict(zip(formulas.nodes(function), outputs, strict=True))
        if all(np.all(np.isfinite(x)) for found in expected.values() for x in found.values()):
            break
    return state, expected
