"""Look up, convert and check names and numbers that callers pass. Does not depend on mechanics."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

Kind: TypeAlias = Any
"""A class, a union of classes or a tuple of them, as the second argument of `isinstance`."""

_LISTED = 12  # largest number of names in a message


def hint(wrong: str | Iterable[str], known: Iterable[str], have: str = "there are") -> str:
    """The end of an error message about unknown names: similar names, or a list of the known names.

    Examples are "did you mean 'steer'?" and "there are roll, steer.". `have` contains the words before the list.
    """
    wrong = [wrong] if isinstance(wrong, str) else list(wrong)
    known = list(dict.fromkeys(known))
    near = {name: difflib.get_close_matches(name, known, n=2) for name in map(str, wrong)}
    near = {name: matches for name, matches in near.items() if matches}
    if near:
        similar = {name: " or ".join(map(repr, matches)) for name, matches in near.items()}
        each = [words if len(wrong) == 1 else f"{words} for {name!r}" for name, words in similar.items()]
        return f"did you mean {', '.join(each)}?"
    more = f", ... ({len(known)} in all)" if len(known) > _LISTED else ""
    return f"{have} {', '.join(known[:_LISTED]) or 'none'}{more}."


def as_names(given: str | Iterable[str], argument: str) -> tuple[str, ...]:
    """A tuple of names. A single name may be given as a string. `argument` is its name in an error message."""
    names = (given,) if isinstance(given, str) or not isinstance(given, Iterable) else tuple(given)
    if not all(isinstance(name, str) for name in names):
        raise TypeError(f"`{argument}` must be a name or a sequence of names, got {given!r}. Names must be strings.")
    return names


def counted(n: int, noun: str) -> str:
    """A number and a noun: "1 trial", "2 trials"."""
    return f"{n} {noun}{'s' * (n != 1)}"


def label_of(name: str) -> str:
    """A name for matplotlib, which would render text between two dollar signs as mathematics."""
    return name.replace("$", r"\$")


def checked(value: object, kind: Kind, what: str, remedy: str = "") -> Any:
    """The value. `what` begins the message, e.g. "The axis of a hinge must be a Vector".

    **Raises:** `TypeError` if the value is not an instance of `kind`.
    """
    if not isinstance(value, kind):
        raise TypeError(f"{what}, got {value!r}.{remedy}")
    return value


def refuse(*rules: tuple[Any, str], error: type[Exception] = ValueError) -> None:
    """Raise an exception with the message of the first rule (is_wrong, message) whose condition is true."""
    for is_wrong, message in rules:
        if is_wrong:
            raise error(message)


def refuse_if(condition: object, message: str) -> None:
    """Raise `ValueError` if the condition is true."""
    refuse((condition, message))


def refuse_any(wrong: Iterable[Any], before: str, after: str) -> None:
    """Raise `ValueError` if there are `wrong` names. The message contains them between `before` and `after`."""
    names = [*map(str, wrong)]
    refuse_if(names, f"{before} {', '.join(names)}{after}")


def refuse_unknown(names: Iterable[str], known: Iterable[str], message: str, have: str = "there are") -> None:
    """Raise `ValueError` for unknown names. `message` precedes the names, e.g. "Bicycle: q has no"."""
    known = tuple(known)
    wrong = [str(name) for name in dict.fromkeys(names) if name not in known]
    refuse_any(wrong, message, "; " + hint(wrong, known, have))


def not_there(name: object, known: Iterable[str], where: str) -> KeyError:
    """The `KeyError` for a name that is not found. `where` is a phrase such as "this trajectory"."""
    return KeyError(f"There is no {name!r} in {where}; {hint(str(name), known)}")


def by_name(name: str, groups: Iterable[tuple[Sequence[str], Any]], more: Mapping[str, Any], where: str) -> Any:
    """An entry by name.

    **Arguments:**

    - `name`: the name.
    - `groups`: pairs of names and an array (..., n), whose last axis has these names.
    - `more`: a dict that is searched last.
    - `where`: a phrase for the error message, such as "this trajectory".

    **Raises:** `KeyError` with similar names.
    """
    groups = tuple(groups)
    for names, values in groups:
        if name in names:
            return values[..., names.index(name)]
    if name in more:
        return more[name]
    raise not_there(name, [*(n for names, _ in groups for n in names), *more], where)


DECIMAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


def decimal_number(text: str) -> float:
    """A finite number in decimal notation.

    Python also accepts 1_000, infinity and digits of other scripts. In a file, these are typing errors.

    **Raises:** `ValueError` for any other text.
    """
    number = float(text) if DECIMAL.fullmatch(text) else float("inf")
    refuse_if(abs(number) == float("inf"), f"{text!r} is not a finite decimal number.")
    return number


def real_number(value: npt.ArrayLike, what: str) -> float:
    """Convert one real number to a float. It may be infinite or NaN.

    **Raises:** `TypeError` for a tracer. `ValueError` for all other values, such as text, booleans and arrays.
    """
    try:
        array = np.asarray(value) if np.ndim(value) == 0 and not np.ma.is_masked(value) else None
    except TypeError:  # raised by JAX: a tracer has no value
        raise TypeError(
            f"{what} must be a concrete number, not one that is traced by jax.jit, jax.grad or jax.vmap; got "
            f"{value!r}. Compute it outside of the transformed function."
        ) from None
    if array is None or array.dtype.kind not in "iuf":
        raise ValueError(f"{what} must be a real number, got {value!r}.")
    return float(array)


def positive_number(value: npt.ArrayLike, what: str) -> float:
    """Convert one positive finite number to a float.

    **Raises:** `ValueError` for other numbers; otherwise as `real_number`.
    """
    number = real_number(value, what)
    refuse_if(not 0.0 < number < float("inf"), f"{what} must be positive and finite, got {value!r}.")
    return number


def whole_number(value: object, least: int, what: str) -> int:
    """One integer that is not smaller than `least`.

    **Raises:** `ValueError` for all other values, such as booleans and floats.
    """
    if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or value < least:
        raise ValueError(f"{what} must be an integer of at least {least}, got {value!r}.")
    return int(value)
