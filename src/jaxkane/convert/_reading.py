"""Parts that the readers of MJCF and URDF files share: texts, names, selections of joints, omitted elements."""

from __future__ import annotations

import os
import warnings
from collections.abc import Collection, Sequence
from pathlib import Path as FilePath
from typing import Any, Literal

from .._common.lookup import refuse_any, refuse_if

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
