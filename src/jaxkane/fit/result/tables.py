"""A fit as data (pandas, xarray, JSON), and tables as text and HTML. A table is a list of rows, the first is the
header.
"""

from __future__ import annotations

import dataclasses
import html
import importlib.metadata
import json
import math
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from ..._common.lookup import refuse_unknown
from ..._system.system import System
from ..problem.declarations import leaf_names

if TYPE_CHECKING:
    import pandas as pd

Rows = Sequence[Sequence[str]]
Tables = Sequence[tuple[str, Rows]]  # with their headings


def text_table(rows: Rows, left: Sequence[int] = (0,)) -> str:
    """Rows in aligned columns. The columns `left` are left-aligned."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]

    def place(i, cell):
        return cell.ljust(widths[i]) if i in left else cell.rjust(widths[i])

    return "\n".join("  ".join(place(i, cell) for i, cell in enumerate(row)).rstrip() for row in rows)


def html_text(text: str) -> str:
    """Text as HTML, with code instead of backticks."""
    return re.sub("`([^`]+)`", r"<code>\1</code>", html.escape(text))


def html_table(rows: Rows, left: Sequence[int] = (0,)) -> str:
    """Rows as an HTML table. Cells know the header of their column, which a narrow page writes before them."""
    align = [' style="text-align: left"' * (i in left) for i in range(len(rows[0]))]
    labels = [f' data-label="{html.escape(label, quote=True)}"' for label in rows[0]]
    head = "".join(f"<th{a}>{html_text(label)}</th>" for a, label in zip(align, rows[0], strict=True))
    body = ""
    for row in rows[1:]:
        cells = zip(align, labels, row, strict=True)
        body += f"<tr>{''.join(f'<td{a}{label}>{html_text(cell)}</td>' for a, label, cell in cells)}</tr>"
    return f"<table><tr>{head}</tr>{body}</table>"


def text_tables(tables: Tables, left: Sequence[int] = (0,)) -> str:
    return "\n\n".join(f"{heading}\n{text_table(rows, left)}" for heading, rows in tables)


def html_tables(tables: Tables) -> str:
    return "".join(f"<p>{html_text(heading)}</p>{html_table(rows)}" for heading, rows in tables)


def costs_in_words(fit: Any) -> str:
    """The cost at the initial guess and at the end, and the cost of trials left out in turn."""
    held_out = "" if math.isnan(fit.held_out_cost) else f" ({fit.held_out_cost:.6g} of trials left out in turn)"
    start = "" if fit.status == "validated" else f"{fit.history[0]:.6g} -> "
    return f"{start}{fit.cost:.6g}{held_out}"


def parameter_rows(fit: Any, truth: Mapping[str, float] | System | None = None, detailed: bool = False) -> Rows:
    """Rows of the table of parameters. The first row is the header.

    The columns are name, unit, initial guess, estimate, standard error, interval and kind of the error. If `detailed`,
    the formal error follows. If `truth` is passed, the true value and the deviation from it follow. All numbers of a
    learned function share one row.
    """
    known, learned, errors = _true_values(fit, truth), fit.parameters.learned, fit.errors
    formal, ends = fit.standard_errors, fit.intervals()
    head = ["parameter", "unit", "start", "estimate", "std. error", "95 % interval", "by"]
    head += ["formal error"] * detailed + ["truth", "error"] * bool(known)
    rows: list[list[str]] = [head]
    for name, unit, part in zip(fit.names, fit.parameters.units, learned, strict=True):
        if part:
            continue
        value = fit.estimates[name]
        row = [name, unit, f"{fit.start[name]:.5g}", f"{value:.5g}", f"{errors[name]:.2g}"]
        row += ["{:.4g} to {:.4g}".format(*ends[name]), fit.error_kinds[name], *[f"{formal[name]:.2g}"] * detailed]
        if name in known:
            right = known[name]
            row += [f"{right:.5g}", f"{value / right - 1:.2%}" if right else f"{value:.2g}"]
        rows.append(row)
    for part in dict.fromkeys(filter(None, learned)):
        own = [name for name, of in zip(fit.names, learned, strict=True) if of == part]
        start, end = (np.sqrt(np.mean([at[name] ** 2 for name in own])) for at in (fit.start, fit.estimates))
        rows.append([f"{part}, rms of {len(own)} learned numbers", "", f"{start:.5g}", f"{end:.5g}"])
    return [[*row, *[""] * (len(head) - len(row))] for row in rows]


def _true_values(fit: Any, truth: Mapping[str, float] | System | None) -> dict[str, float]:
    """True values of free parameters, from a system or by name.

    **Raises:** `ValueError` for a name that is neither free nor a parameter; `TypeError` for a system of another class.
    """
    if truth is None:
        return {}
    system = fit.problem.system
    if isinstance(truth, Mapping):
        refuse_unknown(truth, (*fit.names, *leaf_names(system)), "`truth` contains unknown names:", "the names are")
        return {name: float(truth[name]) for name in fit.names if name in truth}
    if type(truth) is not type(system):
        raise TypeError(
            f"`truth` must be a {type(system).__name__} or a dict of values by name, got {type(truth).__name__}."
        )
    leaves = jax.tree.leaves(truth)
    targets = {e.name: e.targets[0] for e in fit.parameters.entries if e.targets}
    return {name: float(jnp.ravel(leaves[leaf])[place]) for name, (leaf, place, _) in targets.items()}


def dataframe(fit: Any, level: float) -> pd.DataFrame:
    """See `Fit.to_pandas`."""
    import pandas as pd  # importing pandas takes half a second

    lower, upper = np.array([*fit.intervals(level).values()]).reshape(-1, 2).T
    columns = {
        "unit": fit.parameters.units,
        "start": [*fit.start.values()],
        "estimate": [*fit.estimates.values()],
        "error": [*fit.errors.values()],
        "lower": lower,
        "upper": upper,
    }
    return pd.DataFrame(columns, index=pd.Index(fit.names, name="parameter"))


def dataset(fit: Any) -> Any:
    """See `Fit.to_xarray`."""
    try:
        import xarray
    except ImportError as error:
        raise ImportError("to_xarray needs xarray. Install it: pip install 'jaxkane[xarray]'") from error
    trials, channels = fit.problem.trials, fit.problem.channels
    t = np.full((len(trials), max(len(trial.t) for trial in trials)), np.nan)
    values = {what: np.full((len(trials), len(channels), t.shape[1]), np.nan) for what in ("measured", "fitted")}
    values |= {what: values["measured"].copy() for what in ("sigma", "residual")}
    for k, (name, trial) in enumerate(zip(fit.trial_names, trials, strict=True)):
        n = len(trial.t)
        t[k, :n] = trial.t
        rows = (trial.measured, fit.fitted[name], trial.sigma, fit.residuals[name])
        for array, row in zip(values.values(), rows, strict=True):
            for j, channel in enumerate(channels):
                if channel in row:
                    array[k, j, :n] = row[channel]
    axes = ("trial", "channel", "sample")
    coords = {"trial": [*fit.trial_names], "channel": [*channels], "t": (("trial", "sample"), t, {"units": "s"})}
    return xarray.Dataset({what: (axes, array) for what, array in values.items()}, coords)


def json_text(fit: Any) -> str:
    """See `Fit.to_json`."""
    identifiability = fit.identifiability
    columns = dataframe(fit, 0.95).assign(standard_error=fit.standard_errors, clustered_error=fit.clustered_errors)
    report = {
        "system": type(fit.problem.system).__name__,
        "title": fit.title,
        "status": fit.status,
        "message": fit.message,
        "ok": fit.ok,
        "notes": fit.notes,
        "failed": fit.failed,
        "method": fit.method,
        "cost_name": fit.problem.cost_name,
        "cost": fit.cost,
        "history": fit.history,
        "held_out_cost": fit.held_out_cost,
        "variance": fit.variance,
        "degrees_of_freedom": fit.degrees_of_freedom,
        "step_error": fit.step_error,
        "parameters": columns.to_dict("index"),
        "correlation": fit.correlation,
        "directions": [
            {"direction": row[0], "singular_value": s, "deviation": deviation}
            for row, s, deviation in zip(
                identifiability.rows[1:], identifiability.singular_values, identifiability.deviations, strict=True
            )
        ],
        "variance_accounted_for": fit.variance_accounted_for,
        "costs": fit.costs,
        "tests": {
            name: {channel: dataclasses.asdict(test) for channel, test in tests.items()}
            for name, tests in fit.tests.items()
        },
        "nuisance": fit.nuisance,
        "versions": {name: importlib.metadata.version(name) for name in ("jaxkane", "jax", "diffrax")},
    }
    return json.dumps(_plain(report), allow_nan=False, indent=1)


def _plain(value: Any) -> Any:
    """The value with Python's own types. JSON has neither NaN (None here) nor infinity (text, which `float` reads)."""
    if isinstance(value, Mapping):
        return {str(key): _plain(x) for key, x in value.items()}
    if hasattr(value, "tolist"):  # arrays and numbers of NumPy and JAX
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(x) for x in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else ("Infinity" if value > 0 else "-Infinity")
    return value
