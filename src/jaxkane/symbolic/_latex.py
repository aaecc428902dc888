"""Names and equations as LaTeX, for notebooks. Knows SymPy's printer; knows no mechanics."""

from __future__ import annotations

import re
from typing import Any

from ._sympy import imported

_GREEK = frozenset(
    """alpha beta gamma delta epsilon zeta eta theta iota kappa lambda mu nu xi pi rho sigma tau upsilon phi chi psi
    omega Gamma Delta Theta Lambda Xi Pi Sigma Upsilon Phi Psi Omega""".split()
)


def name_in_latex(name: str, dots: int = 0) -> str:
    r"""theta1 as \theta_{1}, theta1_dot as \dot{\theta}_{1}, mB as m_{B}, engine_mass as \mathit{engine\_mass};
    `dots` more for time derivatives."""
    dotted = re.fullmatch(r"(.+)_dot", name)
    base = dotted[1] if dotted else name
    parts = re.fullmatch(r"([A-Za-z]+?)_?(\d*)", base)
    word, index = (parts[1], parts[2]) if parts else (base, "")
    if word in _GREEK:
        letter = f"\\{word}"
    elif len(word) == 1:
        letter = word
    elif len(word) == 2 and word.isalpha() and word.isascii():
        letter, index = word[0], word[1] + index
    else:
        letter = f"\\mathit{{{escaped(word)}}}"
    dots += dotted is not None
    letter = f"\\{'d' * dots}ot{{{letter}}}" if dots else letter
    return f"{letter}_{{{index}}}" if index else letter


def escaped(word: str) -> str:
    return re.sub(r"([_#$%&{}])", r"\\\1", word)


def in_latex(expression: Any, names: dict[Any, str]) -> str:
    return imported().latex(expression, symbol_names=names)


def aligned(lines: list[tuple[str, str]]) -> str:
    """Equations one below the other."""
    return "$\\displaystyle \\begin{aligned}" + r"\\ ".join(f"{a} &= {b}" for a, b in lines) + "\\end{aligned}$"
