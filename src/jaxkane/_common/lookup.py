"""Names and numbers that callers give: looked up, converted, refused. Knows no mechanics."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

_LISTED = 12  # names in a message, at most


def hint(wrong: str | Iterable[str], known: Iterable[str], have: str = "there are") -> str:
    """The end of a message about names that are not there: what was probably meant, or else what there is.

    "did you mean 'steer'?", or "there are roll, steer."; `have` are the words before the list.
    """
    wrong = [wrong] if isinstance(wrong, str) else list(wrong)
    known = list(dict.fromkeys(known))
    near = {name: difflib.get_close_matches(name, known, n=2) for name in map(str, wrong)}
    near = {name: matches for name, matches in near.items() if matches}
    if near:
        one = lambda name: " or ".join(map(repr, near[name]))  # noqa: E731
        return f"did you mean {', '.join(one(n) if len(wrong) == 1 else f'{one(n)} for {n!r}' for n in near)}?"
    more = f", ... ({len(known)} in all)" if len(known) > _LISTED else ""
    return f"{have} {', '.join(known[:_LISTED]) or 'none'}{more}."


def as_names(given: str | Iterable[str]) -> tuple[str, ...]:
    """Names; one alone may be given as a string."""
    names = (given,) if isinstance(given, str) or not isinstance(given, Iterable) else tuple(given)
    if not all(isinstance(name, str) for name in names):
        raise TypeError(f"Names are strings, one or several; got {given!r}.")
    return names


def label_of(name: str) -> str:
    """A name as matplotlib is to write it, for which what stands between two dollars is mathematics."""
    return name.replace("$", r"\$")


def refuse_unknown(names: Iterable[str], known: Iterable[str], message: str, have: str = "there are") -> None:
    """`ValueError` for names that are not known; `message` stands before them: "Bicycle: q has no"."""
    known = tuple(known)
    wrong = [str(name) for name in dict.fromkeys(names) if name not in known]
    if wrong:
        raise ValueError(f"{message} {', '.join(wrong)}; {hint(wrong, known, have)}")


def not_there(name: Any, known: Iterable[str], where: str) -> KeyError:
    """The error for a name that is not found; `where` as in "this trajectory"."""
    return KeyError(f"There is no {name!r} in {where}; {hint(str(name), known)}")


def by_name(name: str, groups: Iterable[tuple[Sequence[str], Any]], more: Mapping[str, Any], where: str) -> Any:
    """An entry of arrays whose last axis is named, or of a dict.

    **Raises:** `KeyError` with what was probably meant.
    """
    groups = tuple(groups)
    for names, values in groups:
        if name in names:
            return values[..., names.index(name)]
    if name in more:
        return more[name]
    raise not_there(name, [*(n for names, _ in groups for n in names), *more], where)


_DECIMAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


def decimal_number(text: str) -> float:
    """A finite number in decimal notation: what Python reads besides (1_000, infinity, the digits of other scripts) is
    a slip of the pen in a file.

    **Raises:** `ValueError` for anything else.
    """
    number = float(text) if _DECIMAL.fullmatch(text) else float("inf")
    if abs(number) == float("inf"):
        raise ValueError(f"{text!r} is not a finite decimal number.")
    return number


def real_number(value: Any, what: str) -> float:
    """One real number that was given, as a float; it may be infinite or NaN.

    **Raises:** `ValueError` for text, truth values, complex numbers, arrays and all else.
    """
    array = np.asarray(value) if np.ndim(value) == 0 and not np.ma.is_masked(value) else None
    if array is None or array.dtype.kind not in "iuf":
        raise ValueError(f"{what} must be a real number, got {value!r}.")
    return float(array)


def positive_number(value: Any, what: str) -> float:
    """One positive finite number that was given, as a float.

    **Raises:** `ValueError` for anything else.
    """
    number = real_number(value, what)
    if not 0.0 < number < float("inf"):
        raise ValueError(f"{what} must be positive, got {value!r}.")
    return number
