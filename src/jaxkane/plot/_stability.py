"""Eigenvalues along a parameter, and their way through the complex plane. Knows arrays; knows no linear model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .._common.lookup import as_names, label_of
from ._axes import SOFT, STABLE, finish, one


def eigenvalues(
    values: Any,
    eigenvalues: Any = None,
    *,
    modes: Sequence[str] | None = None,
    xlabel: str | None = None,
    ylim: tuple[float, float] | None = None,
    ax: Any = None,
) -> Any:
    """Real parts (lines) and imaginary parts (thin, dotted) against a parameter; where all modes decay is shaded.

        found = jk.stability.eigenvalues(bicycle, jnp.linspace(0.0, 10.0, 401))
        jk.plot.eigenvalues(found)

    **Arguments:**

    - `values`: what `jaxkane.stability.eigenvalues` gives; or values (m,) of a parameter and
    - `eigenvalues` (m, n) [1/s], one column for each mode, NaN where there is none.
    - `modes`: names of the columns; those of one name share a colour. By default those of the result, if any.
    - `xlabel`: the parameter and its unit, by default as the result has it. `ylim`: by default what holds the real
        parts and the slower oscillations.

    **Returns:** the axes. The borders of the shaded ranges lie on straight lines between the values.
    """
    x, lam, names = _table(values, eigenvalues, modes)
    xlabel = getattr(values, "parameter", "parameter") if xlabel is None else xlabel
    ax = one(ax)
    low, high = _limits(lam) if ylim is None else ylim
    borders = []
    for start, stop in stable_ranges(x, lam):
        ax.axvspan(start, stop, color=STABLE, alpha=0.15, linewidth=0)
        borders += [border for border in (start, stop) if x[0] < border < x[-1]]
    ax.axhline(0.0, color=SOFT, linewidth=0.8)
    colors = {name: f"C{i}" for i, name in enumerate(dict.fromkeys(names))}
    for column, name in zip(lam.T, names, strict=True):
        ax.plot(x, column.real, color=colors[name], label=label_of(name) or "real part")
        swings = np.where(np.abs(column.imag) > 1e-9, column.imag, np.nan)
        if np.isfinite(swings).any() and np.nanmax(swings) > 0:
            label = f"{label_of(name)}, imaginary" if name else "imaginary part"
            ax.plot(x, np.where(swings > 0, swings, np.nan), ":", color=colors[name], linewidth=1.2, label=label)
    for border in borders:
        ax.annotate(f"{border:.3g}", (border, low), xytext=(2, 3), textcoords="offset points", fontsize="small")
    ax.set(xlabel=xlabel, ylabel="eigenvalues [1/s]", xlim=(x[0], x[-1]), ylim=(low, high))
    finish(ax, legend=False)
    _legend(ax)
    return ax


def root_locus(
    values: Any,
    eigenvalues: Any = None,
    *,
    label: str | None = None,
    ax: Any = None,
) -> Any:
    """The eigenvalues' way through the complex plane; the colour is the parameter, the decaying half is shaded.

    **Arguments:** `values`, `eigenvalues`: as for `eigenvalues`. `label`: of the colour bar, as `xlabel` there.

    **Returns:** the axes. A cross marks where each way starts.
    """
    from matplotlib.collections import LineCollection

    x, lam, _ = _table(values, eigenvalues, None)
    label = getattr(values, "parameter", "parameter") if label is None else label
    ax = one(ax)
    for column in lam.T:
        at = np.stack([column.real, column.imag], axis=1)  # (m, 2)
        pieces = np.stack([at[:-1], at[1:]], axis=1)
        lines = LineCollection(list(pieces), array=0.5 * (x[1:] + x[:-1]), cmap="cool", linewidth=2.0)
        lines.set_clim(x[0], x[-1])
        ax.add_collection(lines)
        ax.plot(*at[0], "x", color=SOFT, markersize=6)
    finite = lam[np.isfinite(lam)]
    width, height = np.ptp(finite.real), np.ptp(finite.imag)
    ax.set_xlim(finite.real.min() - 0.05 * width - 1e-3, max(finite.real.max(), 0.0) + 0.05 * width + 1e-3)
    ax.set_ylim(finite.imag.min() - 0.05 * height - 1e-3, finite.imag.max() + 0.05 * height + 1e-3)
    ax.axvspan(ax.get_xlim()[0], 0.0, color=STABLE, alpha=0.12, linewidth=0, zorder=0)
    ax.axhline(0.0, color=SOFT, linewidth=0.8)
    ax.axvline(0.0, color=SOFT, linewidth=0.8)
    ax.figure.colorbar(lines, ax=ax, label=label)
    ax.set(xlabel="real part [1/s]", ylabel="imaginary part [rad/s]")
    finish(ax, legend=False)
    return ax


def stable_ranges(x: Any, eigenvalues: Any) -> list[tuple[float, float]]:
    """Where all real parts are negative, by straight lines between the values x (m,)."""
    largest = eigenvalues.real.max(axis=1)  # NaN where any is
    ranges, start = [], None
    for k, y in enumerate(largest):
        before = largest[k - 1] if k else np.nan
        crossing = x[k - 1] - before * (x[k] - x[k - 1]) / (y - before) if before * y < 0 else x[k]
        if y < 0 and start is None:
            start = crossing
        elif not y < 0 and start is not None:
            ranges.append((float(start), float(crossing if y > 0 else x[k - 1])))
            start = None
    return ranges if start is None else [*ranges, (float(start), float(x[-1]))]


def _table(values: Any, eigenvalues: Any, modes: Sequence[str] | None) -> tuple[Any, Any, list[str]]:
    if eigenvalues is None:
        if not hasattr(values, "eigenvalues"):
            raise TypeError(
                "Give values (m,) and eigenvalues (m, n), or the result of jaxkane.stability.eigenvalues(...)."
            )
        modes = getattr(values, "modes", None) if modes is None else modes
        values, eigenvalues = values.values, values.eigenvalues
    x, lam = np.asarray(values, dtype=float), np.asarray(eigenvalues, dtype=complex)
    if lam.ndim != 2 or x.shape != lam.shape[:1] or len(x) < 2:
        raise ValueError(
            f"The eigenvalues (m, n) stand at m values of the parameter, at least two; got {lam.shape} at {x.shape}."
        )
    if not np.any(np.isfinite(lam)):
        raise ValueError("None of the eigenvalues is finite: there is no steady motion at these values.")
    names = [""] * lam.shape[1] if modes is None else list(as_names(modes))
    if len(names) != lam.shape[1]:
        raise ValueError(f"There are {lam.shape[1]} modes, and {len(names)} names: {', '.join(names)}.")
    return x, lam, names


def _limits(lam: Any) -> tuple[float, float]:
    """Holds the largest real part and oscillation; what decays much faster than anything oscillates runs out below."""
    finite = lam[np.isfinite(lam)]
    top = max(finite.real.max(), finite.imag.max(), 1e-6)
    return max(float(finite.real.min()), -1.2 * float(top)) - 0.05 * float(top), 1.05 * float(top)


def _legend(ax: Any) -> None:
    handles, labels = ax.get_legend_handles_labels()
    known = dict(zip(labels, handles, strict=True))
    ax.legend(known.values(), known.keys(), frameon=False, fontsize="small")
