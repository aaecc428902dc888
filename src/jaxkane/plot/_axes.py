"""Axes, made or given; marks that are legible on light and dark pages. Knows matplotlib only."""

from __future__ import annotations

from typing import Any

import numpy as np

SOFT = "0.55"  # a grey that is seen on white and on black
STABLE = "#2ca02c"


def panels(axes: Any, rows: int, columns: int = 1, *, size: tuple[float, float], **options: Any) -> np.ndarray:
    """An array (rows, columns) of axes: those given, or of a new figure, `size` [inches] for each."""
    if axes is not None:
        given = np.ravel(axes)
        if given.size != rows * columns:
            raise ValueError(f"{rows * columns} axes are needed ({rows} rows, {columns} columns), got {given.size}.")
        return given.reshape(rows, columns)
    import matplotlib.pyplot as plt

    figsize = (size[0] * columns, size[1] * rows)
    return plt.subplots(rows, columns, figsize=figsize, squeeze=False, layout="constrained", **options)[1]


def one(ax: Any, size: tuple[float, float] = (6.4, 4.2), **options: Any) -> Any:
    """The axes given, or those of a new figure."""
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.subplots(figsize=size, layout="constrained", **options)[1]


def finish(ax: Any, legend: bool = True) -> None:
    """A faint grid, and a legend without a frame where something has a name."""
    ax.grid(alpha=0.25)
    if legend and ax.get_legend_handles_labels()[1]:
        ax.legend(frameon=False, fontsize="small")
