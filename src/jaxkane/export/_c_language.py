"""C99 as a language of formulas: its operations, numbers and comments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .._scalars.graph import LIBRARY
from .._scalars.written import ARITHMETIC, COMPARED, COMPARISONS, LOOSE, SIGNED, SUM, TIGHT, Form, Language, call

TYPES = {"float64": "double", "float32": "float", "bool": "int"}
_IN_LIBRARY = {"abs": "fabs", "rem": "fmod", **{name: name for name in (*LIBRARY, "sqrt", "floor")}}
_TWO = ("rem", "pow", "atan2")
_FORMS = {
    **ARITHMETIC,
    **COMPARISONS,
    **{name: call(f"{word}{{s}}", 1 + (name in _TWO)) for name, word in _IN_LIBRARY.items()},
    "max": call("larger", 2),
    "min": call("smaller", 2),
    "and": Form("{0} && {1}", COMPARED, (TIGHT, TIGHT)),
    "or": Form("{0} || {1}", COMPARED, (TIGHT, TIGHT)),
    "xor": Form("{0} != {1}", COMPARED, (TIGHT, TIGHT)),
    "select": Form("{0} ? {1} : {2}", LOOSE, (SUM, SUM, SUM)),
    "convert": Form("({type}){0}", SIGNED, (TIGHT,)),
}
# As JAX has them: not a number where one of the two is not, and -0 is less than 0.
HELPERS = {
    "max": "static {type} larger({type} a, {type} b) {{\n"
    "    return a != a || (a == b ? !signbit(a) : a > b) ? a : b;\n}}\n",
    "min": "static {type} smaller({type} a, {type} b) {{\n"
    "    return a != a || (a == b ? signbit(a) : a < b) ? a : b;\n}}\n",
}


def constant(value: Any, dtype: str) -> str:
    if dtype == "bool":
        return str(int(value))
    if not np.isfinite(value):
        return "NAN" if np.isnan(value) else "INFINITY" if value > 0 else "-INFINITY"
    return f"{np.float32(value)!s}f" if dtype == "float32" else repr(float(value))


C = Language(
    "C99",
    _FORMS,
    constant,
    lambda name, text, dtype: f"const {TYPES[dtype]} {name} = {text};",
    TYPES,
    {"float64": "", "float32": "f", "bool": ""},
)


def array(declaration: str, numbers: np.ndarray, dtype: str) -> str:
    texts = [constant(x, dtype) for x in numbers.flat] or ["0"]
    return f"static {declaration}[] = {{\n    {folded(texts)}\n}};"


def initial(x: np.ndarray, dtype: str) -> str:
    texts = [constant(v, dtype) for v in x.flat]
    return f"{{{', '.join(texts) or '0'}}}" if x.shape else texts[0]


def folded(texts: Sequence[str]) -> str:
    return ",\n    ".join(", ".join(texts[i : i + 6]) for i in range(0, len(texts), 6))


def as_comment(text: str) -> str:
    return f" /* {text} */" if text else ""


def without_end(text: str) -> str:
    """A text that cannot end a comment."""
    return text.replace("*/", "* /").replace("\\", "/")
