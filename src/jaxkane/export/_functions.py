"""What the exports have in common: functions, names, units. Knows no language."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Collection, Iterable, Sequence
from typing import Any

import numpy as np

from .._common.lookup import refuse_unknown
from .._kane.formulas import JACOBIANS, OFFERED, Formulas
from .._system.system import System, unit_of, units_of

USUAL = ("rates", "equations", "dependent_speeds", *JACOBIANS)


def chosen(formulas: Formulas, functions: Sequence[str] | None, usual: Sequence[str] = USUAL) -> tuple[str, ...]:
    """The functions that were asked for; by default the usual ones that the system has."""
    if functions is None:
        needs = {"dependent_speeds": "u_dep", "input_jacobian": "inputs", "parameter_jacobian": "parameters"}
        available = tuple(name for name in usual if name not in needs or formulas.names(needs[name]))
        return (*available, "state_rates") if formulas.system.states else available
    if isinstance(functions, str):
        raise TypeError(f"functions is a sequence of names; one is ({functions!r},).")
    functions = tuple(dict.fromkeys(functions))
    if not functions:
        raise ValueError(f"{formulas.name}: `functions` names none; leave it out for the usual ones.")
    refuse_unknown(functions, OFFERED, f"{formulas.name}: there is no function", "there are")
    return functions


def one_function(formulas: Formulas, function: Any, exporter: str) -> str:
    """The name of the one function that an exporter was asked for, checked."""
    if not isinstance(function, str):
        raise TypeError(f"{exporter} exports one function at a time; `function` is its name, got {function!r}.")
    refuse_unknown([function], OFFERED, f"{formulas.name}: there is no function", "there are")
    return function


def parameters(system: System) -> dict[str, np.ndarray]:
    """A system's parameters by name, in the order in which exported functions take them.

    A parameter of a part is called by its path, "frame.mass"; one with axes is an array.
    """
    return Formulas(system).values()


# Words that C99, C++ or their compilers have reserved, macros of <math.h> and <stdio.h> among them.
C_WORDS = frozenset(
    """auto break case char const continue default do double else enum extern float for goto if inline int long register
    restrict return short signed sizeof static struct switch typedef union unsigned void volatile while
    alignas alignof and and_eq asm bitand bitor bool catch char16_t char32_t char8_t class co_await co_return co_yield
    compl concept const_cast consteval constexpr constinit decltype delete dynamic_cast explicit export false friend
    module mutable namespace new noexcept not not_eq nullptr operator or or_eq private protected public
    reinterpret_cast requires static_assert static_cast template this thread_local throw true try typeid typename
    typeof using virtual wchar_t xor xor_eq linux unix i386 errno stdin stdout stderr NULL EOF NAN INFINITY HUGE_VAL
    HUGE_VALF HUGE_VALL DOMAIN SING OVERFLOW UNDERFLOW PLOSS TLOSS HUGE MAXFLOAT BUFSIZ L_tmpnam TMP_MAX FILENAME_MAX
    FOPEN_MAX""".split()
)


def in_ascii(name: str) -> str:
    """A name of letters, digits and underscores that begins with a letter: Greek letters by their names, accents
    dropped, "frame.mass" as frame_mass, "moments[2]" as moments_2."""
    words = []
    for letter in unicodedata.normalize("NFKD", name):
        if letter.isascii():
            words.append(letter)
        elif unicodedata.category(letter).startswith("L"):
            letter_name = unicodedata.name(letter, f"u{ord(letter):x}")
            greek = re.fullmatch(r"GREEK (SMALL|CAPITAL) LETTER (?:FINAL )?(\w+).*", letter_name)
            words.append(
                (greek[2].lower() if greek[1] == "SMALL" else greek[2].title()) if greek else f"u{ord(letter):x}"
            )
    word = re.sub(r"\W+", "_", "".join(words)).strip("_")
    return word if word[:1].isalpha() else f"n{word}"


def identifiers(names: Iterable[str], reserved: Collection[str], in_ascii_only: bool = True) -> list[str]:
    """For each name an identifier of its own: what is reserved, or equal to another, gets an underscore or a number."""
    unique: list[str] = []
    used = set(reserved)
    for name in names:
        own = unicodedata.normalize("NFKC", name)  # as Python reads it
        word = own if own.isidentifier() and not in_ascii_only else in_ascii(name)
        candidates = (word, f"{word}_", *(f"{word}_{i}" for i in range(2, 10_000)))
        unique.append(next(c for c in candidates if c not in used))
        used.add(unique[-1])
    return unique


def variable_units(system: System) -> dict[str, str]:
    """Units of coordinates, speeds and inputs, where they are declared."""
    declared = units_of(system)
    names = (*system.coordinates, *system.speeds, *system.dependent_speeds, *system.inputs, *system.states)
    return {name: unit_of(name, declared) for name in names}
