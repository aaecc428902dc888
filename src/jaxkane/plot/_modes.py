"""Mode shapes as phasors. Knows eigenvalues and eigenvectors as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .._common.lookup import as_names, label_of, refuse_unknown
from ._axes import SOFT


def mode_shapes(
    eigenvalues: Any,
    vectors: Any = None,
    states: Sequence[str] | None = None,
    *,
    at: float | None = None,
    modes: Sequence[str] | None = None,
    only: Sequence[str] | None = None,
    axes: Any = None,
) -> np.ndarray:
    """Each mode's eigenvector as arrows in the complex plane: how far and how much later each state moves.

        found = jk.stability.eigenvalues(bicycle, speeds)
        jk.plot.mode_shapes(found, at=5.0, only=("roll", "steer"))

    Every vector is turned and scaled so that its largest state has length one and phase zero. Of a conjugate pair one
    is drawn.

    **Arguments:**

    - `eigenvalues`: what `jaxkane.stability.eigenvalues` gives, with `at`, the value of its parameter (the nearest is
        taken); or eigenvalues (n,) [1/s] with
    - `vectors` (n_states, n): one column for each mode, and `states`: names of the rows.
    - `modes`: names of the columns. `only`: those states that are drawn; angles and rates have different units, so that
        their arrows cannot be compared.
    - `axes`: polar axes, as many as there are modes to draw.

    **Returns:** the axes (n_drawn,).
    """
    import matplotlib.pyplot as plt

    lam, X, labels, names, where = _one_point(eigenvalues, vectors, states, at, modes)
    chosen = labels if only is None else as_names(only)
    refuse_unknown(chosen, labels, "mode_shapes: there is no state")
    rows = [i for i, state in enumerate(labels) if state in chosen]
    drawn = [k for k in range(len(lam)) if lam[k].imag >= -1e-9 * abs(lam[k])]
    if not np.all(np.isfinite(lam)):
        raise ValueError("mode_shapes: the eigenvalues are not finite here: there is no steady motion, and no mode.")
    if axes is None:
        axes = plt.subplots(
            1,
            len(drawn),
            subplot_kw={"projection": "polar"},
            figsize=(3.1 * len(drawn), 3.6),
            squeeze=False,
            layout="constrained",
        )[1]
    axes = np.ravel(axes)
    if len(axes) != len(drawn):
        raise ValueError(f"mode_shapes: {len(drawn)} polar axes are needed, got {len(axes)}.")
    for ax, k in zip(axes, drawn, strict=True):
        phasors = X[rows, k] / X[rows, k][np.argmax(np.abs(X[rows, k]))]
        for i, (row, z) in enumerate(zip(rows, phasors, strict=True)):
            arrow = {"arrowstyle": "-|>", "color": f"C{i}", "linewidth": 2.0, "shrinkA": 0, "shrinkB": 0}
            ax.annotate("", (np.angle(z), abs(z)), (0.0, 0.0), arrowprops=arrow)
            ax.plot([], [], color=f"C{i}", linewidth=2.0, label=label_of(labels[row]).replace("_", " "))
        name = f"{label_of(names[k])}: " if names[k] else ""
        ax.set_title(f"{name}{_in_words(lam[k])}{where}", fontsize="medium")
        ax.set(rlim=(0.0, 1.05), yticks=[0.5, 1.0], yticklabels=[])
        ax.set_xticks(np.deg2rad([0, 90, 180, 270]))
        ax.tick_params(labelsize="small", labelcolor=SOFT)
        ax.grid(alpha=0.3)
    axes[0].legend(loc="upper left", bbox_to_anchor=(-0.15, -0.08), frameon=False, fontsize="small", ncols=2)
    return axes


def _one_point(found: Any, vectors: Any, states: Any, at: float | None, modes: Any) -> tuple[Any, ...]:
    where = ""
    if vectors is None:
        if not hasattr(found, "vectors"):
            raise TypeError(
                "Give eigenvalues (n,), vectors (n_states, n) and the states' names, or the result of "
                "jaxkane.stability.eigenvalues(...) and `at`."
            )
        values = np.asarray(found.values, dtype=float)
        if at is None and len(values) > 1:
            raise ValueError(f"mode_shapes: say `at` which value, between {values.min():g} and {values.max():g}.")
        i = 0 if at is None else int(np.argmin(np.abs(values - at)))
        where = f"\nat {values[i]:.4g}" if len(values) > 1 else ""
        states = found.states if states is None else states
        modes = getattr(found, "modes", None) if modes is None else modes
        found, vectors = found.eigenvalues[i], found.vectors[i]
    lam, X = np.asarray(found, dtype=complex), np.asarray(vectors, dtype=complex)
    if X.ndim != 2 or lam.shape != X.shape[1:]:
        raise ValueError(f"mode_shapes: vectors (n_states, n) for eigenvalues (n,), got {X.shape} for {lam.shape}.")
    states = [f"state {i + 1}" for i in range(X.shape[0])] if states is None else list(as_names(states))
    names = [""] * len(lam) if modes is None else list(as_names(modes))
    if len(states) != X.shape[0] or len(names) != len(lam):
        raise ValueError(f"mode_shapes: {len(states)} states and {len(names)} names for vectors of shape {X.shape}.")
    return lam, X, states, names, where


def _in_words(lam: complex) -> str:
    if abs(lam.imag) <= 1e-9 * abs(lam):
        return f"{lam.real:.3g} 1/s"
    return f"{lam.real:.3g} ± {abs(lam.imag):.3g}i 1/s"
