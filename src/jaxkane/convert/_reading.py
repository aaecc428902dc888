"""What the readers of MJCF and URDF files share: texts, names, selections of joints, omitted elements, and which
inertias are possible, affect the motion, or are the nearest possible ones."""

from __future__ import annotations

import os
import warnings
from collections.abc import Collection, Sequence
from pathlib import Path as FilePath
from typing import Any, Literal, NamedTuple

import numpy as np

from .._common.lookup import refuse_any, refuse_if
from .._kane.checks import ROUNDING, is_possible

Path = str | os.PathLike[str]

Selection = Sequence[str] | Literal[True]
"""Names of joints; True for all that are possible."""


def is_text(model: Path) -> bool:
    return isinstance(model, str) and model.lstrip("\ufeff \t\r\n").startswith("<")


def check_exists(model: Path) -> None:
    if not os.path.exists(model):
        raise FileNotFoundError(f"The file {os.fspath(model)!r} does not exist. The text of a model begins with '<'.")


def text_of(model: Path) -> str:
    """The text of a model, without a byte order mark.

    **Raises:** `FileNotFoundError`; `ValueError` for a file that is not text.
    """
    if is_text(model):
        return str(model).lstrip("\ufeff \t\r\n")
    check_exists(model)
    try:
        return FilePath(model).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"The file {os.fspath(model)!r} is not text in UTF-8: {error}.") from error


def selected(option: str, names: Selection, possible: Sequence[str], having: str, owner: str) -> list[str]:
    """The joints that an option such as `stops` selects.

    **Arguments:**

    - `option`: its name.
    - `names`: its value.
    - `possible`: the joints that can be selected.
    - `having`: what these have, e.g. "a range".
    - `owner`: the name of the mechanism.

    **Raises:** `TypeError` for a string; `ValueError` for a joint that cannot be selected.
    """
    if names is True:
        return list(possible)
    if isinstance(names, str):
        raise TypeError(f"{owner}: `{option}` must be a list of names, e.g. [{names!r}]; got {names!r}.")
    names = [without_dots(name) for name in names]
    wrong, known = [name for name in names if name not in possible], ", ".join(possible) or "none"
    after = f", which is not a hinge or a slider with {having}. Those with {having} are: {known}."
    refuse_any(wrong, f"{owner}: `{option}` contains", after)
    return names


def report_left_out(owner: str, left_out: Collection[str], strict: bool, stacklevel: int) -> tuple[str, ...]:
    """The elements of a file that are omitted, each once, after a warning.

    **Raises:** `ValueError` with `strict`.
    """
    unique = tuple(dict.fromkeys(left_out))
    refuse_if(
        unique and strict,
        f"{owner}: these elements are not supported: {'; '.join(unique)}. Pass strict=False to omit them.",
    )
    if unique:
        warnings.warn(
            f"{owner}: omitted, because not supported: {'; '.join(unique)}.", UserWarning, stacklevel=stacklevel + 1
        )
    return unique


def without_dots(name: str) -> str:
    """A dot separates the parts of a parameter's name, so names of a file have an underscore instead."""
    return name.replace(".", "_")


def names_without_dots(names: Sequence[str] | None) -> Any:
    """A list of names of a file, with underscores. A string is not a list, and is refused later."""
    return names if names is None or isinstance(names, str) else [without_dots(name) for name in names]


def check_distinct(owner: str, kinds: str, given: Sequence[str]) -> None:
    """**Raises:** `ValueError` for two names that become equal, because parts could then not be distinguished."""
    names = [without_dots(name) for name in given]
    for i, name in enumerate(names):
        if name and name in names[:i]:
            first = given[names.index(name)]
            why = f"would both be {name!r}, because a dot becomes an underscore" if first != given[i] else "are equal"
            raise ValueError(f"{owner}: the {kinds} {first!r} and {given[i]!r} {why}. Rename one in the file.")


def unused_name(name: str, used: Collection[str], ending: str) -> str:
    while name in used:
        name += ending
    return name


def unused_names(names: Sequence[str], used: Collection[str], ending: str) -> list[str]:
    """The names; a name that is already used gets a suffix that makes it unique."""
    return [unused_name(name + ending, {*used, *names}, ending) if name in used else name for name in names]


Choice = Literal["refuse", "nearest"]

_MARGIN = 5e-3
"""The smallest principal second moment of a nearest inertia, relative to the trace. A fit keeps inertias possible by
Cholesky factors, which do not exist for a body in a plane."""


class FileBody(NamedTuple):
    """A rigid body of a file.

    - `name`: of its link, with the links that are fixed to it.
    - `inertia` (3, 3) [kg m^2]: about its mass centre.
    - `axis` (3,): the only axis about which it can turn, a unit vector; zero if it cannot turn. None if it can turn
        about several axes.
    """

    name: str
    inertia: np.ndarray
    axis: np.ndarray | None


def possible_inertias(owner: str, bodies: Sequence[FileBody], choice: Choice, balance: bool) -> list[np.ndarray]:
    """The inertias of bodies, with changes where these are impossible.

    Inertias below 1e-14 of the largest one are rounding errors of the program that wrote the file, and become zero.

    The largest principal moment is at most the sum of the others. An excess of up to 0.2 % is attributed to rounding
    and accepted, an excess of up to 5 % causes a warning. A larger excess and negative moments are impossible. If only
    one moment affects the motion, the others are replaced, and the moment is kept.

    **Arguments:**

    - `owner`: the name of the mechanism.
    - `bodies`: with their inertias.
    - `choice`: "refuse" impossible inertias, or use the "nearest" possible ones.
    - `balance`: replace impossible moments by their mean, as MuJoCo does with `balanceinertia`.

    **Returns:** the inertias, each (3, 3).

    **Raises:** `ValueError` with a table of the impossible inertias.
    """
    refuse_if(choice not in ("refuse", "nearest"), f'`inertias` must be "refuse" or "nearest", got {choice!r}.')
    used, refused, reported = [], [], []
    largest = max((np.abs(body.inertia).max() for body in bodies), default=0.0)
    for body in bodies:
        if np.abs(body.inertia).max() <= 1e-14 * largest:
            used.append(np.zeros((3, 3)))
            continue
        moments = np.linalg.eigvalsh(body.inertia)
        excess = (moments[2] - moments[1] - moments[0]) / np.abs(moments).max()
        fault = "which are negative" if moments[0] < 0.0 else f"excess {100 * excess:.2g} %"
        change, I = _changed(body, moments, choice, balance)
        used.append(body.inertia if I is None else I)
        line = f"  {body.name}: principal moments {_listed(moments)} kg m^2, {fault}"
        if I is not None:
            reported.append(f"{line}; {change} {_listed(np.linalg.eigvalsh(I))}")
        elif change:
            refused.append(line)
        elif not is_possible(1.0, body.inertia, True, ROUNDING):
            reported.append(line)
    why = "The largest principal moment of inertia of a body is at most the sum of the other two, and none is negative."
    refuse_if(
        refused,
        f"{owner}: these links have impossible inertias:\n" + "\n".join(refused) + f"\n{why} Pass "
        'inertias="nearest" to use the nearest possible inertias, or correct the file.',
    )
    if reported:
        warnings.warn(f"{owner}: inertias of the file:\n" + "\n".join(reported) + f"\n{why}", stacklevel=4)
    return used


def _changed(body: FileBody, moments: np.ndarray, choice: Choice, balance: bool) -> tuple[str, np.ndarray | None]:
    """Why an impossible inertia is changed or refused, and the changed inertia."""
    if is_possible(1.0, body.inertia, True, *([ROUNDING] if balance else [])):
        return "", None
    if balance and moments.sum() >= 0.0:
        return "balanced:", np.eye(3) * moments.sum() / 3.0
    if body.axis is not None:
        moment = float(body.axis @ body.inertia @ body.axis)
        if moment >= 0.0:
            # a flat disc that turns about its axis
            I = 0.5 * moment * (np.eye(3) + np.outer(body.axis, body.axis))
            return "only its moment about the axis of its joint affects the motion, the others are replaced:", I
    if choice == "nearest" and moments.sum() > 0.0:
        return "nearest:", nearest_inertia(body.inertia)
    return "impossible", None


def _listed(moments: np.ndarray) -> str:
    return ", ".join(f"{x:.4g}" for x in moments)


def nearest_inertia(I: np.ndarray) -> np.ndarray:
    """The possible inertia (3, 3) whose second moments are nearest.

        Sigma = tr(I)/2 1 - I,    I = tr(Sigma) 1 - Sigma

    An inertia is possible if the matrix of second moments Sigma is positive semidefinite. Its negative eigenvalues
    become slightly positive, which gives the nearest matrix in the Frobenius norm.
    """
    moments, axes = np.linalg.eigh(I)
    sigma = 0.5 * moments.sum() - moments
    sigma = np.maximum(sigma, _MARGIN * np.maximum(sigma, 0.0).sum())
    return axes @ np.diag(sigma.sum() - sigma) @ axes.T
