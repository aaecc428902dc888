"""Equations as C99 without dependencies: a header, a source, and a program that tests it. Knows C; compiles nothing."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from .._kane.formulas import FUNCTIONS, Formulas
from .._scalarjit.backends.source import (
    ARITHMETIC,
    COMPARED,
    COMPARISONS,
    LOOSE,
    SIGNED,
    SUM,
    TIGHT,
    Form,
    Language,
    as_source,
    call,
)
from .._scalarjit.graph import LIBRARY, needed
from .._system.system import System
from ._functions import C_WORDS, chosen, identifiers, variable_units

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


COMPARE = """
/* Prints the largest difference, as a part of the largest expected number. */
static int compare(const char *name, int n, const {type} *computed, const {type} *expected) {{
    double difference = 0.0, size = 0.0;
    int i;
    for (i = 0; i < n; i++) {{
        const double d = fabs((double)computed[i] - (double)expected[i]);
        if (computed[i] == expected[i] || (computed[i] != computed[i] && expected[i] != expected[i])) continue;
        if (!(d <= difference)) difference = d; /* also where it is not a number */
        if (fabs((double)expected[i]) > size) size = fabs((double)expected[i]);
    }}
    printf("%-40s %.1e\\n", name, size > 0.0 ? difference / size : difference);
    return !(difference <= {tolerance} * size);
}}
"""


def trial(formulas: Formulas, functions: Iterable[str]) -> tuple[dict[str, Any], dict[str, dict[str, np.ndarray]]]:
    """Time, coordinates, speeds and inputs, and what JAX computes there for this system; all of it finite."""
    state: dict[str, Any] = {}
    expected: dict[str, dict[str, np.ndarray]] = {}
    for seed in range(20):
        rng = np.random.default_rng(seed)
        draw = lambda n, rng=rng: rng.uniform(0.2, 0.8, n).astype(formulas.dtype)  # noqa: E731
        state = {"t": draw(()), **{kind: draw(len(formulas.names(kind))) for kind in ("q", "u", "inputs", "u_dep")}}
        args = [*state.values(), *formulas.values().values()]
        with jax.enable_x64(formulas.dtype == "float64"):
            for function in functions:
                outputs = jax.tree.map(np.asarray, formulas.by_jax(function, *args))
                expected[function] = dict(zip(formulas.nodes(function), outputs, strict=True))
        if all(np.all(np.isfinite(x)) for outputs in expected.values() for x in outputs.values()):
            break
    return state, expected


class ExportedFiles(NamedTuple):
    """The files that `jaxkane.export.c` has written."""

    header: Path
    source: Path
    test: Path


def c(
    system: System,
    path: str | Path,
    functions: Sequence[str] | None = None,
    *,
    name: str | None = None,
    dtype: str = "float64",
) -> ExportedFiles:
    """A system's equations as C99 that needs the mathematical library alone.

        jk.export.c(bicycle, "generated/bicycle.c")
        # cc -std=c99 -O3 generated/bicycle.c generated/bicycle_test.c -lm -o test && ./test

    Every function takes `(t, q, u, inputs, parameters, outputs ...)`: time, arrays in the order of the declared names,
    a struct of the parameters, and an array for each output, matrices row by row. Outputs must not overlap what is
    read. The header says what is where, with units; `NAME_default` holds the parameters of this system. Nothing is
    allocated, kept or read but the arguments, so that threads may share it. What is not a number comes out as NaN, as
    by JAX.

    **Arguments:**

    - `path`: of the source, "FOLDER/NAME.c", whose folder is made; beside it `NAME.h`, and `NAME_test.c`,
        a program that compares every function with numbers that JAX computed.
    - `functions`: which; by default rates (q_dot, u_dot), equations (M, f), dependent_speeds, and the derivatives of
        the rates, state_jacobian (by q, u), parameter_jacobian and input_jacobian. There are also
        dependent_accelerations, constraint_jacobian, constraint_jacobian_rate, partial_velocities, kinetic_energy.
    - `name`: what the names of all functions begin with; by default that of the file.
    - `dtype`: "float64", or "float32" for `float`.

    **Returns:** the paths `header`, `source` and `test`.

    **Raises:** `ValueError` for a function that there is not, a batch of systems, and operations that cannot be written
    as formulas of single numbers, as those of LAPACK for more than 12 speeds.
    """
    path = Path(path)
    if path.suffix != ".c":
        raise ValueError(f"`path` is that of the source, which ends with .c: 'generated/bicycle.c'; got {str(path)!r}.")
    formulas = Formulas(system, dtype)
    functions = chosen(formulas, functions)
    module = _Module(formulas, functions, name or path.stem)
    written = ExportedFiles(path.with_suffix(".h"), path, path.with_name(f"{path.stem}_test.c"))
    header = written.header.name
    texts = (module.header(), module.source(header), module.test(header))
    path.parent.mkdir(parents=True, exist_ok=True)
    for file, text in zip(written, texts, strict=True):
        file.write_text(text, encoding="utf-8")
    return written


class _Module:
    """The texts of the files for some functions of a system."""

    def __init__(self, formulas: Formulas, functions: tuple[str, ...], name: str):
        self.formulas, self.functions = formulas, functions
        (self.name,) = identifiers([name], C_WORDS)
        self.type = TYPES[formulas.dtype]
        parameters = [a.name for a in formulas.of_kind("parameters")]
        self.members = dict(zip(parameters, identifiers(parameters, C_WORDS), strict=True))
        self.nodes = {function: formulas.nodes(function) for function in functions}
        self.input_words = {
            int(k): self._element(a.kind, a.name, i, a.shape)
            for a, nodes in zip(formulas.arguments, formulas.inputs, strict=True)
            for i, k in enumerate(nodes.flat)
        }

    def _element(self, kind: str, name: str, i: int, shape: tuple[int, ...]) -> str:
        if kind == "parameters":
            return f"p->{self.members[name]}" + (f"[{i}]" if shape else "")
        return f"{kind}[{i}]" if shape else kind

    def _comment(self) -> str:
        from .. import __version__

        return (
            f"/* {without_end(self.formulas.name)}: Kane's equations M u_dot = f, written by jaxkane {__version__}.\n"
            f"   Every function is a formula of its arguments; {self.type} throughout. */\n"
        )

    def _signature(self, function: str) -> str:
        read = f"{self.type} t, const {self.type} *q, const {self.type} *u, const {self.type} *inputs"
        written = "".join(f", {self.type} *{output}" for output in self.nodes[function])
        return f"void {self.name}_{function}({read}, const {self.name}_parameters *p{written})"

    def header(self) -> str:
        system, guard = self.formulas.system, f"{self.name.upper()}_H"
        unit_of = variable_units(system)
        lines = [self._comment(), f"#ifndef {guard}", f"#define {guard}", "", "#ifdef __cplusplus"]
        lines += ['extern "C" {', "#endif", "", "typedef struct {"]
        for a in self.formulas.of_kind("parameters"):
            member = self.members[a.name]
            unit = without_end(f" [{a.info.unit}]") if a.info.unit else ""
            own = f" {without_end(a.name)}" if member != a.name else ""
            own += f", {' x '.join(map(str, a.shape))}, row by row" if a.shape else ""
            size = f"[{max(1, len(a.elements))}]" if a.shape else ""
            lines.append(f"    {self.type} {member}{size};{as_comment((own + unit).strip(', '))}")
        if not self.members:
            lines.append("    char none; /* there are no parameters */")
        lines += [f"}} {self.name}_parameters;", ""]
        lines += [
            f"/* The parameters that were exported. */\nextern const {self.name}_parameters {self.name}_default;",
            "",
        ]
        lines += ["/* What the functions read:", "", "   t: time [s]"]
        for kind in ("q", "u", "inputs"):
            for i, each in enumerate(self.formulas.names(kind)):
                unit = unit_of.get(each, "")
                lines.append(without_end(f"   {kind}[{i}]: {each}" + (f" [{unit}]" if unit else "")))
            if not self.formulas.names(kind):
                lines.append(f"   {kind}: none; may be null")
        lines += ["", "   What they write, matrices row by row; it must not overlap what they read: */", ""]
        for function in self.functions:
            lines += [f"/* {self._meaning(function)} */", f"{self._signature(function)};", ""]
        return "\n".join([*lines, "#ifdef __cplusplus", "}", "#endif", "", "#endif", ""])

    def _meaning(self, function: str) -> str:
        shapes = ", ".join(
            f"{output} ({' x '.join(map(str, nodes.shape)) or 'a number'})"
            for output, nodes in self.nodes[function].items()
        )
        if function == "dependent_speeds":
            return without_end(f"{shapes}: {', '.join(self.formulas.names('u_dep'))}")
        if function in FUNCTIONS:
            return shapes
        by = {"state_jacobian": "(q, u)", "input_jacobian": "the inputs"}.get(
            function, "the parameters, in their order"
        )
        return f"{shapes}: derivatives of (q_dot, u_dot) by {by}"

    def source(self, header: str) -> str:
        outputs = [nodes for by_output in self.nodes.values() for nodes in by_output.values()]
        used = {self.formulas.graph.nodes[k].operation for k in needed(self.formulas.graph.nodes, outputs)}
        helpers = [text.format(type=self.type) for operation, text in HELPERS.items() if operation in used]
        values = self.formulas.values().values()
        numbers = [initial(x, self.formulas.dtype) for x in values] or ["0"]
        default = f"const {self.name}_parameters {self.name}_default = {{\n    {folded(numbers)}\n}};\n"
        parts = [self._comment(), f'#include "{header}"\n\n#include <math.h>\n', default, *helpers]
        return "\n".join([*parts, *(self._body(function) for function in self.functions)])

    def _body(self, function: str) -> str:
        by_output = self.nodes[function]
        lines, outputs = as_source(self.formulas.graph, list(by_output.values()), self.input_words, C)
        for output, elements in zip(by_output, outputs, strict=True):
            lines += [f"{output}[{i}] = {text};" for i, text in enumerate(elements)]
        text = "\n    ".join(lines)
        unused = [f"(void){word};" for word in ("t", "q", "u", "inputs", "p", *by_output) if not _is_read(word, text)]
        return f"{self._signature(function)} {{\n    " + "\n    ".join([*unused, *lines]) + "\n}\n"

    def test(self, header: str) -> str:
        """A program that asks every function at one state, and compares."""
        state, expected = trial(self.formulas, self.functions)
        lines = [self._comment(), f'#include "{header}"\n\n#include <math.h>\n#include <stdio.h>\n']
        t = constant(state["t"], self.formulas.dtype)
        for kind in ("q", "u", "inputs"):
            lines.append(array(f"const {self.type} {kind}", state[kind], self.formulas.dtype))
        calls = []
        for function in self.functions:
            for output, numbers in expected[function].items():
                lines.append(array(f"const {self.type} {function}_{output}", numbers, self.formulas.dtype))
                lines.append(f"static {self.type} computed_{function}_{output}[{max(1, numbers.size)}];")
            outputs = "".join(f", computed_{function}_{output}" for output in expected[function])
            calls.append(f"    {self.name}_{function}({t}, q, u, inputs, &{self.name}_default{outputs});")
            for output, numbers in expected[function].items():
                each = f"{function}_{output}"
                calls.append(f'    wrong += compare("{each}", {numbers.size}, computed_{each}, {each});')
        tolerance = "1e-11" if self.formulas.dtype == "float64" else "1e-3"
        lines.append(COMPARE.format(type=self.type, tolerance=tolerance))
        return "\n".join([*lines, "int main(void) {", "    int wrong = 0;", *calls, "    return wrong;", "}", ""])


def _is_read(word: str, text: str) -> bool:
    sign = "->" if word == "p" else "" if word == "t" else r"\["
    return re.search(rf"(?<!->)\b{word}\b{sign}", text) is not None
