"""Equations as plain NumPy source, to be read and taught from. Knows Python; runs nothing."""

from __future__ import annotations

import builtins
import keyword
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .._kane.formulas import JACOBIANS, Formulas
from .._scalarjit.backends.numpy import NUMPY_NAMES
from .._scalarjit.backends.source import ARITHMETIC, COMPARED, COMPARISONS, TIGHT, Form, Language, as_source, call
from .._scalarjit.graph import DTYPES
from .._system.system import System
from ._functions import chosen, identifiers, variable_units

_TWO = ("pow", "atan2", "rem", "max", "min")
_FORMS = {
    **COMPARISONS,
    **{name: call(f"np.{word}", 1 + (name in _TWO)) for name, word in NUMPY_NAMES.items()},
    **ARITHMETIC,
    "erf": call("_erf"),
    "and": Form("{0} & {1}", COMPARED, (TIGHT, TIGHT)),
    "or": Form("{0} | {1}", COMPARED, (TIGHT, TIGHT)),
    "xor": Form("{0} ^ {1}", COMPARED, (TIGHT, TIGHT)),
    "select": call("np.where", 3),
    "convert": call("np.{type}"),
}


def _constant(value: Any, dtype: str) -> str:
    if dtype == "bool":
        return str(bool(value))
    if not np.isfinite(value):
        return "np.nan" if np.isnan(value) else "np.inf" if value > 0 else "-np.inf"
    number = np.float32(value) if dtype == "float32" else float(value)
    return str(number)


PYTHON = Language(
    "NumPy",
    _FORMS,
    _constant,
    lambda name, text, dtype: f"{name} = {text}",
    {name: name for name in DTYPES},
)
# Names that the text of a function, or Python, uses.
_RESERVED = frozenset(
    (*keyword.kwlist, *keyword.softkwlist, *dir(builtins), *"np q u t inputs parameters _erf".split())
)


def numpy(
    system: System,
    path: str | Path | None = None,
    functions: Sequence[str] | None = None,
    *,
    dtype: str = "float64",
) -> str:
    """A system's equations as the source of a Python module that needs NumPy alone.

        print(jk.export.numpy(pendulum, functions=("equations",)))
        jk.export.numpy(pendulum, "pendulum.py")  # import pendulum; pendulum.rates(0.0, q, u)

    Every function is `f(t, q, u, inputs=(), parameters=PARAMETERS)`: arrays in the order of the declared names, inputs
    that are left out being zero; and the parameters by name. What is not a number comes out as NaN, as by JAX, without
    a warning.

    **Arguments:**

    - `path`: where the source is written; None writes none.
    - `functions`: which, as `jaxkane.export.c`; by default rates, equations, and dependent_speeds where there are some.
    - `dtype`: "float64", or "float32".

    **Returns:** the source.

    **Raises:** `ValueError` as `jaxkane.export.c`.
    """
    formulas = Formulas(system, dtype)
    text = _source(formulas, chosen(formulas, functions, ("rates", "equations", "dependent_speeds")))
    if path is not None:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        Path(path).write_text(text, encoding="utf-8")
    return text


def _source(formulas: Formulas, functions: Sequence[str]) -> str:
    from .. import __version__

    units = {a.name: a.info.unit for a in formulas.of_kind("parameters")}
    unit_of = variable_units(formulas.system)
    bodies = [_function(formulas, function, unit_of) for function in functions]
    lines = [
        f'"""{_in_docstring(formulas.name)}: Kane\'s equations M u_dot = f, written by jaxkane {__version__}."""',
        "",
    ]
    with_erf = any("_erf(" in body for body in bodies)
    lines += ["import math", ""] * with_erf + ["import numpy as np", ""]
    lines += ["_erf = np.vectorize(math.erf)", ""] * with_erf
    lines.append("PARAMETERS = {")
    for name, value in formulas.values().items():
        number = repr(value.tolist()) if value.shape or formulas.dtype == "float64" else str(value)
        number = (
            f"np.array({number}, np.{formulas.dtype})" if value.shape else f"np.{formulas.dtype}({_finite(number)})"
        )
        lines.append(f"    {name!r}: {number}," + (f"  # [{units[name]}]" if units[name] else ""))
    return "\n".join([*lines, "}", *bodies])


def _finite(number: str) -> str:
    return f"np.{number}" if number in ("nan", "inf") else number


def _in_docstring(text: str) -> str:
    return text.replace("\\", "/").replace('"""', "'''")


class _Names:
    """What variables, parameters and outputs of a function are called. A parameter may be called like a coordinate."""

    def __init__(self, formulas: Formulas, outputs: Iterable[str]):
        kinds = ("q", "u", "inputs", "parameters")
        named = [(kind, name) for kind in kinds for name in _names_of(formulas, kind)]
        named += [("outputs", name) for name in outputs]
        self.words = identifiers([name for _, name in named], _RESERVED, in_ascii_only=False)
        self.of = dict(zip(named, self.words, strict=True))

    def input_words(self, formulas: Formulas) -> dict[int, str]:
        """The names of input nodes."""
        words = {}
        for a, nodes in zip(formulas.arguments, formulas.inputs, strict=True):
            for place, k in np.ndenumerate(nodes):
                if a.kind == "parameters":
                    index = f"[{', '.join(map(str, place))}]" if place else ""
                    words[int(k)] = self.of["parameters", a.name] + index
                elif a.kind != "u_dep":
                    words[int(k)] = self.of[a.kind, a.elements[place[0]]] if place else "t"
        return words

    def temporary(self) -> str:
        """The pattern of the names of intermediate results, which no other name fits."""
        letters = ("x", "z", *(f"x{'_' * n}" for n in range(1, 10)))
        return next(f"{x}{{}}" for x in letters if not any(re.fullmatch(rf"{x}\d+", word) for word in self.words))


def _names_of(formulas: Formulas, kind: str) -> tuple[str, ...]:
    """Of parameters with axes the whole, of the others every element."""
    return tuple(a.name for a in formulas.of_kind(kind)) if kind == "parameters" else formulas.names(kind)


def _function(formulas: Formulas, function: str, unit_of: dict[str, str]) -> str:
    by_output = formulas.nodes(function)
    names = _Names(formulas, by_output)
    body, outputs = as_source(
        formulas.graph, list(by_output.values()), names.input_words(formulas), PYTHON, names.temporary()
    )
    text = "\n".join([*body, *(e for elements in outputs for e in elements)])
    lines = ["", '@np.errstate(all="ignore")']
    lines.append(f"def {function}(t, q, u, inputs=(), parameters=PARAMETERS):")
    lines.append(f'    """{", ".join(by_output)}{_meaning(formulas, function)}."""')
    for kind in ("q", "u", "inputs"):
        words = [names.of[kind, name] for name in formulas.names(kind)]
        if any(_reads(word, text) for word in words):
            units = ", ".join(unit_of.get(name) or "-" for name in formulas.names(kind))
            right = f"np.asarray({kind}, np.{formulas.dtype})"
            if kind == "inputs":
                right += f" if len(inputs) else np.zeros({len(words)}, np.{formulas.dtype})"
            lines.append(f"    {', '.join(words)}{',' * (len(words) == 1)} = {right}  # [{units}]")
    for name in _names_of(formulas, "parameters"):
        word = names.of["parameters", name]
        if _reads(word, text):
            lines.append(f"    {word} = np.{formulas.dtype}(parameters[{name!r}])")
    lines += [f"    {line}" for line in body]
    for output, nodes, elements in zip(by_output, by_output.values(), outputs, strict=True):
        array = f"np.array({_nested(elements, nodes.shape)}, np.{formulas.dtype})"
        array += "" if nodes.size else f".reshape({nodes.shape})"
        lines.append(f"    {names.of['outputs', output]} = {array}")
    results = ", ".join(names.of["outputs", output] for output in by_output)
    return "\n".join([*lines, f"    return {results}", ""])


def _nested(elements: Sequence[str], shape: tuple[int, ...]) -> str:
    """Elements as nested lists of this shape."""
    if not shape:
        return elements[0]
    step = int(np.prod(shape[1:]))
    return f"[{', '.join(_nested(elements[i * step : (i + 1) * step], shape[1:]) for i in range(shape[0]))}]"


def _meaning(formulas: Formulas, function: str) -> str:
    if function in JACOBIANS:
        by = {"state_jacobian": "(q, u)", "input_jacobian": "the inputs"}.get(function, "the parameters")
        return f": derivatives of (q_dot, u_dot) by {by}"
    return f": {', '.join(formulas.names('u_dep'))}" if function == "dependent_speeds" else ""


def _reads(word: str, text: str) -> bool:
    return re.search(rf"(?<![\w.]){re.escape(word)}(?!\w)", text) is not None
