"""A fit as data: files of searches and of fits, pandas, xarray, JSON; and tables as text and HTML. The first row of a
table is its header.
"""

from __future__ import annotations

import dataclasses
import html
import importlib.metadata
import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree
from numpy.typing import ArrayLike

from ..._common.files import atomic_write, differences
from ..._common.lookup import refuse_unknown
from ..._scalarjit.compat import on_device
from ..._scalarjit.digest import digest
from ..._system.parameters import leaf_name
from ..._system.system import System
from ..problem.declarations import leaf_names
from ..problem.model import Model, Prediction, Simulation
from ..problem.parameters import Parameters
from ..problem.problem import Problem
from ..problem.trial import trial_names
from ..problem.windows import Windows
from ..solve.kalman import filtered
from ..solve.linearization import Blocks, Linearization

_RESUME = (
    "An earlier file with this name is unchanged. If it is a checkpoint, call again with the same arguments to resume."
)


def write_state(path: Path, key: Mapping[str, Any], trees: Mapping[str, Any]) -> None:
    """Write the arrays of trees atomically: after a crash while writing, the earlier file is unchanged."""
    arrays: dict[str, Any] = {"key": np.array(json.dumps(key))}
    for name, tree in trees.items():
        leaves = jax.tree.leaves(eqx.filter(tree, eqx.is_array_like))
        arrays |= {f"{name}/{i}": np.asarray(leaf) for i, leaf in enumerate(leaves)}
    atomic_write(path, lambda file: np.savez(file, **arrays), remedy=_RESUME)


def read_state(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The key and the arrays in a file.

    **Raises:** `ValueError` if the file cannot be read.
    """
    try:
        # Unpickling could run code, and a checkpoint may come from another person.
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        return dict(json.loads(str(arrays.pop("key")))), arrays
    except (MemoryError, FileNotFoundError):
        raise
    except Exception as error:  # decoders raise exceptions of many types for invalid bytes
        raise ValueError(
            f"{path} cannot be read as the state of a fit ({type(error).__name__}: {error}). It is damaged, was "
            "written by another version of jaxkane, or is not a file of a fit. Delete it, or choose another file."
        ) from None


def tree_of(path: Path, arrays: Mapping[str, np.ndarray], name: str, like: PyTree) -> Any:
    """The saved tree with this name, with the structure of `like`.

    **Raises:** `ValueError` if a part of it is missing.
    """
    like, rest = eqx.partition(like, eqx.is_array_like)
    leaves, structure = jax.tree.flatten(like)
    new = [arrays.get(f"{name}/{i}") for i in range(len(leaves))]
    if any(x is None for x in new) or f"{name}/{len(leaves)}" in arrays:
        raise ValueError(f"{path} is incomplete: a part of the state of this fit ({name}) is missing. Delete it.")
    return eqx.combine(jax.tree.unflatten(structure, [jax.numpy.asarray(x) for x in new]), rest)


class Checkpoint:
    """A file with the state of a search, for one problem and method.

    **Arguments:**

    - `path`: the path of the file; with None, nothing is saved.
    - `problem`: the problem.
    - `method`: by name, other values on which the next step depends.
    """

    def __init__(self, path: str | os.PathLike[str] | None, problem: Problem, **method: Any):
        self.path = None if path is None else Path(path).expanduser()
        self.key = {} if path is None else {**method, **described(problem)}

    def write(self, **state: Any) -> None:
        if self.path is not None:
            write_state(self.path, self.key, state)

    def read(self, **like: Any) -> dict[str, Any] | None:
        """The state in the file; None if there is no file. `like`: by name, trees of the same structure.

        **Raises:** `ValueError` if the file belongs to another problem, data or method, or cannot be read.
        """
        if self.path is None or not self.path.exists():
            return None
        saved_key, arrays = read_state(self.path)
        wrong = differences(saved_key, self.key)
        if wrong:
            raise ValueError(
                f"{self.path} contains the state of another fit, which differs in {wrong}. Choose another file, or "
                "delete this one."
            )
        return {name: tree_of(self.path, arrays, name, tree) for name, tree in like.items()}


def described(problem: Problem) -> dict[str, Any]:
    """By name, all properties of a problem on which residuals and their derivatives depend."""
    problem = problem.with_errors_of(None)  # the estimated error models are not part of the problem
    model, settings = problem.model, problem.model.settings
    numbers, rest = eqx.partition(model, eqx.is_array)

    point = problem.start
    window, z, b = jax.tree.map(
        lambda x: np.asarray(x)[0], (problem.windows, point.window_starts, point.trial_unknowns)
    )
    changed = {number for entry in problem.parameters.entries for number, *_ in entry.targets}
    leaves = [
        (i, leaf_name(path), x) for i, (path, x) in enumerate(jax.tree_util.tree_leaves_with_path(problem.system))
    ]
    fixed = {name: x for i, name, x in leaves if eqx.is_array(x) and i not in changed}
    guessed = [x for i, _, x in leaves if eqx.is_array(x) and i in changed]

    def residuals(numbers: Model, window: Windows, z: Array, b: Array, x: Array):
        model = eqx.combine(numbers, rest)
        start = model.consistent(window, z, x)
        if model.noise is not None:
            return filtered(model, window, start, b, x)[:2], model.priors(window, z, b)
        return model.residuals(window, start, z, b, x)[0]

    return {
        "system": type(problem.system).__name__,
        "free parameters": ", ".join(problem.parameters.names),
        "unknown starts": ", ".join(model.nuisance.window_names) or "none",
        "unknowns of trials": ", ".join(model.nuisance.trial_names) or "none",
        "channels": ", ".join(model.channels),
        "process noise": ", ".join(model.noise.names) or "zero" if model.noise is not None else "none",
        "error models": "none" if model.errors is None else ", ".join(map(repr, model.errors.distributions)),
        "windows": len(problem.slices),
        "rtol": float(settings.rtol),
        # The ratio is compared with six digits: a fit scales atol with rtol, so its rounding errors differ.
        "atol": " ".join(f"{x:.6g}" for x in np.ravel(settings.atol) / float(settings.rtol)) + " of rtol",
        "max_steps": settings.max_steps,
        "solver": type(settings.solver).__name__,
        "fixed parameter": {name: digest(x) if np.ndim(x) else float(x) for name, x in fixed.items()},
        "initial guesses, priors": digest(jax.tree.leaves(dataclasses.replace(numbers, system=guessed))),
        "data": digest(jax.tree.leaves(problem.windows)),
        "program": digest(jax.make_jaxpr(residuals)(numbers, window, z, b, point.parameters)),
    }


if TYPE_CHECKING:
    import pandas as pd

Rows = Sequence[Sequence[str]]
Tables = Sequence[tuple[str, Rows]]  # with their headings


def text_table(rows: Rows, left: Sequence[int] = (0,)) -> str:
    """Rows in aligned columns. The columns `left` are left-aligned."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    sides = ["<" if i in left else ">" for i in range(len(widths))]
    lines = ([f"{cell:{side}{n}}" for cell, side, n in zip(row, sides, widths, strict=True)] for row in rows)
    return "\n".join("  ".join(cells).rstrip() for cells in lines)


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


class Estimates:
    """What the results of all fits have: names, values and formal errors of the parameters."""

    problem: Problem
    covariance: Any

    @property
    def parameters(self) -> Parameters:
        return self.problem.parameters

    @property
    def names(self) -> tuple[str, ...]:
        return self.parameters.names

    @property
    def start(self) -> dict[str, float]:
        return self._by_name(self.parameters.start)

    @property
    def standard_errors(self) -> dict[str, float]:
        return self._by_name(np.sqrt(self.covariance.diagonal()))

    @property
    def correlation(self) -> np.ndarray:
        deviation = np.sqrt(self.covariance.diagonal())
        with np.errstate(invalid="ignore"):
            return self.covariance / np.outer(deviation, deviation)

    def _by_name(self, values: ArrayLike) -> dict[str, float]:
        return dict(zip(self.names, np.asarray(values, float).tolist(), strict=True))


class Export(Estimates):
    """The methods of a `Fit` that return or write its contents as data."""

    def to_pandas(self: Any, level: float = 0.95) -> pd.DataFrame:
        """A table with one row per parameter.

        **Arguments:**

        - `level`: confidence level of the intervals, between 0 and 1.

        **Returns:** a `pandas.DataFrame` with the columns `unit`, `start`, `estimate`, `error` (from `errors`), `lower`
        and `upper` (from `intervals(level)`).
        """
        import pandas as pd  # importing pandas takes half a second

        lower, upper = np.array([*self.intervals(level).values()]).reshape(-1, 2).T
        columns = {
            "unit": self.parameters.units,
            "start": [*self.start.values()],
            "estimate": [*self.estimates.values()],
            "error": [*self.errors.values()],
            "lower": lower,
            "upper": upper,
        }
        return pd.DataFrame(columns, index=pd.Index(self.names, name="parameter"))

    def to_xarray(self: Any) -> Any:
        """Measurements and residuals as an `xarray.Dataset`.

        Requires xarray: `pip install 'jaxkane[xarray]'`.

        **Returns:** a dataset of `measured`, `fitted`, `sigma` and `residual`, each (trial, channel, sample), with the
        coordinate `t` (trial, sample) [s]. Shorter trials and channels that a trial does not measure are padded with
        NaN.
        """
        try:
            import xarray
        except ImportError as error:
            raise ImportError("to_xarray needs xarray. Install it: pip install 'jaxkane[xarray]'") from error
        trials, channels = self.problem.trials, self.problem.channels
        n_t, names = max(len(trial.t) for trial in trials), self.trial_names

        def padded(x: Sequence[float] | np.ndarray) -> np.ndarray:
            return np.pad(np.asarray(x, float), (0, n_t - len(x)), constant_values=np.nan)

        rows = {
            "measured": [trial.measured for trial in trials],
            "fitted": [self.fitted[name] for name in names],
            "sigma": [trial.sigma for trial in trials],
            "residual": [self.residuals[name] for name in names],
        }
        values = {what: [[padded(row.get(c, ())) for c in channels] for row in of] for what, of in rows.items()}
        t = ("trial", "sample"), [padded(trial.t) for trial in trials], {"units": "s"}
        axes = ("trial", "channel", "sample")
        coords = {"trial": [*names], "channel": [*channels], "t": t}
        return xarray.Dataset({what: (axes, np.array(array)) for what, array in values.items()}, coords)

    def to_json(self: Any) -> str:
        """The contents of the report as JSON text: estimates, errors, tests, costs, notes, versions.

        NaN becomes null. Infinity becomes the text "Infinity" or "-Infinity", which `float` reads.
        """
        identifiability = self.identifiability
        columns = self.to_pandas().assign(standard_error=self.standard_errors, clustered_error=self.clustered_errors)
        report = {
            "system": type(self.problem.system).__name__,
            "title": self.title,
            "status": self.status,
            "message": self.message,
            "ok": self.ok,
            "notes": self.notes,
            "failed": self.failed,
            "method": self.method,
            "cost_name": self.problem.cost_name,
            "cost": self.cost,
            "history": self.history,
            "held_out_cost": self.held_out_cost,
            "variance": self.variance,
            "degrees_of_freedom": self.degrees_of_freedom,
            "step_error": self.step_error,
            "parameters": columns.to_dict("index"),
            "correlation": self.correlation,
            "directions": [
                {"direction": row[0], "singular_value": s, "deviation": deviation}
                for row, s, deviation in zip(
                    identifiability.rows[1:], identifiability.singular_values, identifiability.deviations, strict=True
                )
            ],
            "variance_accounted_for": self.variance_accounted_for,
            "costs": self.costs,
            "tests": {
                name: {channel: dataclasses.asdict(test) for channel, test in tests.items()}
                for name, tests in self.tests.items()
            },
            "nuisance": self.nuisance,
            "versions": _versions(),
        }
        return json.dumps(_plain(report), allow_nan=False, indent=1)

    def table(self: Any, truth: Mapping[str, float] | System | None = None) -> str:
        """A text table of the parameters: name, initial guess, estimate, standard error and 95 % interval.

        **Arguments:**

        - `truth`: true values, by name or as a system. If passed, the table contains them and the deviation from them.

        **Returns:** the table.

        **Raises:** `ValueError` for a name in `truth` that is neither free nor a parameter; `TypeError` for a system of
        another class.
        """
        return text_table(parameter_rows(self, truth))

    def save(self: Any, path: str | os.PathLike[str]) -> Path:
        """Write this fit to one file. `jaxkane.fit.load(path, problem)` reads it.

        The file is written completely or not at all. It contains numbers only.

        **Arguments:**

        - `path`: file to write.

        **Returns:** the path.
        """
        path, parameters, windows = Path(path).expanduser(), self.problem.parameters, self.problem.windows
        key = {
            "fit": {
                "status": self.status,
                "method": self.method,
                "failed": dict(self.failed),
                "deviations": parameters.deviations.tolist(),
                "places": np.asarray(parameters.places).tolist(),
                "rest": np.asarray(parameters.rest).tolist(),
            },
            "versions": ", ".join(f"{name} {version}" for name, version in _versions().items()),
            **described(self.problem),
        }
        trees = {
            "point": self.point,
            "step": (windows.step, self.problem.model.settings.rtol),
            "history": np.array(self.history),
            "R": self.linearization.blocks.R,
            "prediction": self.linearization.prediction,
            "step_errors": self.step_errors,
            "errors": self.problem.model.errors,
        }
        write_state(path, key, trees)
        return path


def _versions() -> dict[str, str]:
    return {name: importlib.metadata.version(name) for name in ("jaxkane", "jax", "diffrax")}


# Largest relative difference of the cost that `load` accepts if the code has changed since the fit was saved.
SAME_COST = 1e-6


def read_fit(path: Path, problem: Problem) -> dict[str, Any]:
    """The fields of the `Fit` in a file. See `load`."""
    saved, arrays = read_state(path)
    of_fit: dict[str, Any] = saved.pop("fit", {})
    if not of_fit:
        raise ValueError(f"{path} is the checkpoint of a fit, not a saved fit. Pass it as `checkpoint=` of the fit.")
    names, failed = trial_names(problem.trials), of_fit["failed"]
    if failed and failed.keys() <= {*names}:
        kept = [trial for name, trial in zip(names, problem.trials, strict=True) if name not in failed]
        problem = problem.with_trials(kept)
    step, rtol = tree_of(path, arrays, "step", (problem.windows.step, problem.model.settings.rtol))
    if problem.chooses_steps and step.shape == problem.windows.step.shape:
        problem = problem.with_steps(step)
    elif (problem.specification.simulation or Simulation()).chooses:
        problem = problem.with_tolerances(rtol)
    parameters = problem.parameters.with_deviations(np.array(of_fit["deviations"]))
    if parameters.inequalities and {*of_fit["places"]} < {*np.asarray(parameters.places).tolist()}:  # some at a bound
        kept = np.flatnonzero(np.isin(np.asarray(parameters.places), of_fit["places"]))
        parameters = parameters.subset(kept.tolist(), problem.start.parameters)
        parameters = dataclasses.replace(parameters, rest=on_device(np.array(of_fit["rest"], parameters.rest.dtype)))
    problem = dataclasses.replace(problem, model=dataclasses.replace(problem.model, parameters=parameters))
    key = described(problem)
    wrong = differences(*({k: d[k] for k in d if k not in ("program", "versions")} for d in (saved, key)))
    if wrong:
        raise ValueError(
            f"{path} contains the fit of another problem, which differs in {wrong}. Create the problem with the "
            "original arguments."
        )
    of_filter = jnp.zeros(()) if problem.model.noise is not None else None
    cost = jnp.zeros(()) if problem.model.has_likelihood else None
    prediction = Prediction(jnp.zeros(()), jnp.zeros(()), of_filter, cost, of_filter)
    like = {"point": problem.start, "errors": problem.model.errors, "prediction": prediction}
    like |= dict.fromkeys(("R", "step_errors", "history"), 0.0)
    state: dict[str, Any] = {name: tree_of(path, arrays, name, tree) for name, tree in like.items()}
    point, model = state["point"], dataclasses.replace(problem.model, errors=state["errors"])
    problem = dataclasses.replace(problem, model=model)
    at = Linearization(Blocks.of(model, state["R"], problem.by_trial, point.parameters), state["prediction"])
    if saved["program"] != key["program"]:
        now = problem.cost(point)
        if not abs(now - at.cost) <= SAME_COST * at.squares:
            raise ValueError(
                f"{path}: the {problem.cost_name} is now {now:.6g}, but was {at.cost:.6g} when the fit was saved (by "
                f"{saved['versions']}). The code has changed since then. Fit again, for example from `start=`, or "
                "install these versions."
            )
    fields = {"problem": problem, "point": point, "linearization": at, "step_errors": np.asarray(state["step_errors"])}
    rest = {name: of_fit[name] for name in ("status", "method", "failed")}
    return {**fields, "history": tuple(np.asarray(state["history"], float).tolist()), **rest}


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
