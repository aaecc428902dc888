"""The picture of the figures: how many times faster than each peer, on a page that is white or black."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ._figures import Figure

COLOURS = {"XLA": "#4c9be8", "native": "#e8833a", "": "#4c9be8"}
SOFT = "0.55"  # a grey that is seen on white and on black


def draw(figures: Sequence[Figure], path: Path) -> bool:
    """One row for every ratio: a dot for each column, a tick where the target is. False without any."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import LogLocator, NullFormatter

    ratios = [f for f in figures if f.unit == "x"]
    rows = list(dict.fromkeys(f.what for f in ratios))
    if not rows:
        return False
    plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False})
    figure, ax = plt.subplots(figsize=(9.5, 0.9 + 0.34 * len(rows)), layout="constrained")
    for f in ratios:
        y, faster, target = -rows.index(f.what), *times_faster(f)
        shift = 0.13 if f.column == "XLA" else -0.13 if f.column == "native" else 0.0
        ax.plot(faster, y + shift, "o", color=COLOURS[f.column], markersize=7)
        if target is not None:
            ax.plot(target, y + shift, "|", color=COLOURS[f.column], markersize=10, markeredgewidth=2)
    for name in ("XLA", "native"):
        ax.plot([], [], "o", color=COLOURS[name], label=f"jaxkane, {name}")
    ax.plot([], [], "|", color=SOFT, markersize=10, markeredgewidth=2, label="target")
    ax.axvline(1.0, color=SOFT, linewidth=1)
    ax.set_xscale("log")
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.set_yticks([-i for i in range(len(rows))], [shortened(row) for row in rows])
    ax.set_ylim(0.5 - len(rows), 0.5)
    ax.set_xlabel("times faster than the peer")
    ax.grid(alpha=0.3)
    ax.set_axisbelow(True)
    ax.tick_params(colors=SOFT, which="both")
    ax.xaxis.label.set_color(SOFT)
    for side in ("left", "bottom"):
        ax.spines[side].set_color(SOFT)
    figure.legend(loc="outside upper right", ncols=3, frameon=False, labelcolor=SOFT)
    figure.savefig(path, dpi=130, transparent=True)
    plt.close(figure)
    return True


def times_faster(figure: Figure) -> tuple[float, float | None]:
    """The figure and its target, the other way round where it is a share of the peer's time."""
    if figure.at_most is not None:
        return 1.0 / figure.value, 1.0 / figure.at_most
    return figure.value, figure.at_least


def shortened(row: str) -> str:
    for words in (", time against", ", rides a second against", ", times faster than"):
        row = row.replace(words, ":")
    return row.replace("first trajectory,", "first trajectory:").replace(" against ours", "")
