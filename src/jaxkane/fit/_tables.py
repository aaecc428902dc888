"""A fit as text: its title, its tables, its bodies and bias."""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from .._common.lookup import refuse_unknown
from .._system.system import System
from ._bijections import PossibleBody
from ._linearize import starts_of
from ._model import Prediction, Unknowns
from ._parameters import Parameters, leaf_names
from ._problem import Problem
from ._statistics import trial_names

if TYPE_CHECKING:
    from ._result import Fit


def plain(rows: Sequence[Sequence[str]], left: Sequence[int] = (0,)) -> str:
    """Rows of text, of which the first is the head, in columns; those named stand to the left."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    place = lambda i, cell: cell.ljust(widths[i]) if i in left else cell.rjust(widths[i])  # noqa: E731
    return "\n".join("  ".join(place(i, cell) for i, cell in enumerate(row)).rstrip() for row in rows)


def html_table(rows: Sequence[Sequence[str]]) -> str:
    """The same as HTML."""
    line = lambda cells, tag: "".join(f"<{tag}>{html.escape(c)}</{tag}>" for c in cells)  # noqa: E731
    body = "".join(f"<tr>{line(row, 'td')}</tr>" for row in rows[1:])
    return f"<table><tr>{line(rows[0], 'th')}</tr>{body}</table>"


def bodies_in_words(parameters: Parameters, x: Any) -> Iterator[str]:
    """Of everything that was freed as `Inertia(...)`: principal moments and axes; mass and centre where they moved."""
    first = 0
    for bijection, size in zip(parameters.bijections, parameters.sizes, strict=True):
        if isinstance(bijection, PossibleBody):
            values = np.asarray(bijection.all_values(bijection.factors(x[first : first + size])), float)
            yield f"body of {', '.join(parameters.names[first : first + size])}: {_in_words(values, bijection.moves)}"
        first += size


def _in_words(values: np.ndarray, moves: tuple[int, ...]) -> str:
    xx, yy, zz, xy, xz, yz = values[4:]
    moments, axes = np.linalg.eigh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
    words = [f"{values[0]:.5g} kg"] * (0 in moves)
    words += [f"centre at ({', '.join(f'{c:.4g}' for c in values[1:4])}) m"] * any(i in moves for i in (1, 2, 3))
    words.append(f"principal moments {', '.join(f'{moment:.5g}' for moment in moments)} kg m^2")
    if any((xy, xz, yz)):
        rows = [f"({', '.join(f'{a:.3f}' for a in axis * np.sign(axis[np.abs(axis).argmax()]))})" for axis in axes.T]
        words.append(f"along {', '.join(rows)}")
    return ", ".join(words)


def nuisance_by_trial(problem: Problem, point: Unknowns, seen: Prediction) -> dict[str, dict[str, Any]]:
    """By trial, values of the biases and gains, and of the starts of its windows (W,), by name."""
    n = problem.model.nuisance
    starts = np.asarray(starts_of(problem.model, problem.windows, point)[0])[:, problem.model.unknown_places]
    owner = np.array([k for k, _, _ in problem.slices])
    found = {}
    b = point.b if seen.unknowns is None else seen.unknowns  # with process noise a window is a trial
    given = np.isfinite(np.asarray(n.start_deviation)) & (problem.model.noise is not None)
    for k, name in enumerate(trial_names(problem)):
        found[name] = {}
        for j, (kind, what) in enumerate(n.trial):
            value = float(b[k, j]) + (1.0 if kind.startswith("gain") else 0.0)
            found[name][f"{kind.split()[0]} of {what}"] = value
        found[name] |= {f"start of {s}": starts[owner == k, j] for j, s in enumerate(n.start) if not given[j]}
    return found


STATUS = {
    "converged": "converged",
    "steps": "stopped after the last step, before it converged",
    "stuck": "stuck: no step lowers the cost",
    "interrupted": "interrupted: this is the best so far",
    "applied": "not fitted: these are the parameters of another fit",
}


def title(fit: Fit) -> str:
    """How much was fitted, in a line."""
    n_r, n_unknown = fit.problem.size
    return (
        f"{type(fit.problem.system).__name__}: {len(fit.problem.trials)} trials, "
        f"{len(fit.problem.slices)} windows, {n_r} residuals, {len(fit.names)} parameters, "
        f"{n_unknown - len(fit.names)} nuisance values"
    )


def summary(fit: Fit) -> str:
    """A fit as a text: what was fitted, the table of parameters, how it ended, and the notes."""
    name = fit.problem.cost_name
    end = f"{name} {fit.history[0]:.6g} -> {fit.cost:.6g} by {fit.method}: {STATUS[fit.status]}"
    bodies = bodies_in_words(fit.parameters, fit.point.x)
    return "\n".join([title(fit), table(fit), *bodies, end, *fit.notes])


def table(fit: Fit, truth: Mapping[str, float] | System | None = None) -> str:
    """Name, start, estimate and standard error of every parameter; and the truth, where it is known."""
    known = known_values(fit, truth)
    head = f"{'parameter':<22}{'start':>12}{'estimate':>12}{'std. error':>12}"
    lines = [head + (f"{'truth':>12}{'error':>9}" if known else "")]
    errors, start = fit.standard_errors, fit.start
    parameters = fit.parameters
    for name, unit, part in zip(fit.names, parameters.units, parameters.learned, strict=True):
        if part:
            continue
        value = fit.estimates[name]
        line = f"{name:<22}{start[name]:>12.5g}{value:>12.5g}{errors[name]:>12.2g}"
        if name in known:
            right = known[name]
            line += f"{right:>12.5g}{(value / right - 1 if right else value):>9.2{'%' if right else 'g'}}"
        lines.append(f"{line}  {unit}".rstrip())
    for part in dict.fromkeys(filter(None, parameters.learned)):
        own = [name for name, p in zip(fit.names, parameters.learned, strict=True) if p == part]
        size = [float(np.sqrt(np.mean([at[name] ** 2 for name in own]))) for at in (start, fit.estimates)]
        lines.append(f"{part:<22}{size[0]:>12.5g}{size[1]:>12.5g}  rms of {len(own)} learned numbers")
    return "\n".join(lines)


def known_values(fit: Fit, truth: Mapping[str, float] | System | None) -> dict[str, float]:
    """The true values of free parameters, from a system that has them or by name.

    **Raises:** `ValueError` for a name that is neither free nor a parameter; `TypeError` for another kind of system.
    """
    if truth is None:
        return {}
    system = fit.problem.system
    if isinstance(truth, Mapping):
        refuse_unknown(truth, (*fit.names, *leaf_names(system)), "`truth` names")
        return {name: float(truth[name]) for name in fit.names if name in truth}
    if type(truth) is not type(system):
        title = type(system).__name__
        raise TypeError(f"`truth` is a {title}, or values by name; got {type(truth).__name__}.")
    leaves = jax.tree.leaves(truth)
    targets = {e.name: e.targets[0] for e in fit.parameters.entries if e.targets}
    return {name: float(jnp.ravel(leaves[leaf])[place]) for name, (leaf, place, _) in targets.items()}
