"""Equations as source code: C99 without dependencies, and Python with NumPy. Does not compile or run anything.

Both are written from one graph of scalars, each by a `Language`. Functions and names that all exports share come first.
"""

from __future__ import annotations

import builtins
import keyword
import re
import unicodedata
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from .._common.files import write_file
from .._common.lookup import refuse_unknown
from .._integrate.jumps import warn_of_jumps
from .._kane.expression_graph import JACOBIANS, OFFERED, Formulas
from .._scalarjit.components import Numbers
from .._scalarjit.graph import DTYPES, LIBRARY, needed
from .._scalarjit.source import (
    ARITHMETIC,
    COMPARED,
    COMPARISONS,
    LOOSE,
    NUMPY_NAMES,
    SIGNED,
    SUM,
    TIGHT,
    Form,
    Language,
    as_source,
    call,
)
from .._system.system import System, unit_of, units_of
from .._version import __version__

_VECTORS = ("q", "u", "inputs")  # kinds of arguments that are arrays of variables
_USUAL = ("rates", "equations", "dependent_speeds", *JACOBIANS)


def function_names(
    formulas: Formulas, functions: Sequence[str] | None, usual: Sequence[str] = _USUAL
) -> tuple[str, ...]:
    """Names of functions, after a check. Default: the usual ones that the system has."""
    if functions is None:
        needs = {"dependent_speeds": "u_dep", "input_jacobian": "inputs", "parameter_jacobian": "parameters"}
        usual = usual if formulas.names("q") or formulas.names("u") else ()  # else first-order states only
        available = tuple(name for name in usual if name not in needs or formulas.names(needs[name]))
        return (*available, "state_rates") if formulas.system.states else available
    if isinstance(functions, str):
        raise TypeError(f"`functions` must be a sequence of names, e.g. ({functions!r},).")
    functions = tuple(dict.fromkeys(functions))
    if not functions:
        raise ValueError(f"{formulas.name}: `functions` is empty. Omit it for the usual functions.")
    refuse_unknown(functions, OFFERED, f"{formulas.name}: there is no function", "there are")
    return functions


def parameters(system: System) -> dict[str, np.ndarray]:
    """A system's parameters by name, in the order of the arguments of exported functions.

    The name of a part's parameter is its path, e.g. "frame.mass". A parameter with axes is an array.
    """
    return Formulas(system).values()


def in_ascii(name: str) -> str:
    """A name of letters, digits and underscores that begins with a letter. Greek letters are written by name and
    accents are dropped; "frame.mass" becomes frame_mass, "moments[2]" becomes moments_2."""
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
    """A unique identifier for each name. A reserved or repeated name gets an underscore or a number."""
    unique: list[str] = []
    used = set(reserved)
    for name in names:
        own = unicodedata.normalize("NFKC", name)  # as Python normalizes it
        word = own if own.isidentifier() and not in_ascii_only else in_ascii(name)
        candidates = (word, f"{word}_", *(f"{word}_{i}" for i in range(2, 10_000)))
        unique.append(next(c for c in candidates if c not in used))
        used.add(unique[-1])
    return unique


def variable_units(system: System) -> dict[str, str]:
    """Units of coordinates, speeds and inputs, if declared."""
    declared = units_of(system)
    names = (*system.coordinates, *system.speeds, *system.dependent_speeds, *system.inputs, *system.states)
    return {name: unit_of(name, declared) for name in names}


def _title(formulas: Formulas) -> str:
    return f"{formulas.name}: Kane's equations M u_dot = f, written by jaxkane {__version__}."


def _meaning(formulas: Formulas, function: str) -> str:
    """A comment on the outputs of a function, if their names are not clear."""
    if function in JACOBIANS:
        by = {"state_jacobian": "(q, u)", "input_jacobian": "the inputs"}
        return f": derivatives of (q_dot, u_dot) by {by.get(function, 'the parameters, in their order')}"
    return f": {', '.join(formulas.names('u_dep'))}" if function == "dependent_speeds" else ""


def words_by_node(formulas: Formulas, words: Mapping[str, Iterable[str]]) -> dict[int, str]:
    """The expressions of input nodes, from those of all elements of each kind of argument, in order."""
    remaining = {kind: iter(of_kind) for kind, of_kind in words.items()}
    pairs = [(a, nodes) for a, nodes in zip(formulas.arguments, formulas.inputs, strict=True) if a.kind in remaining]
    return {int(k): next(remaining[a.kind]) for a, nodes in pairs for k in nodes.flat}


def _is_read(word: str, text: str) -> bool:
    # Whether source code uses a variable; members of other objects may have the same name.
    return re.search(rf"(?<![\w.>]){re.escape(word)}(?!\w)", text) is not None


def _constant(false_true: Sequence[str], nan: str, infinity: str, single: str = "") -> Callable[[Any, str], str]:
    """The form of numbers in a language; `single` is the suffix of those in single precision."""

    def constant(value: float, dtype: str) -> str:
        if dtype == "bool":
            return false_true[bool(value)]
        if not np.isfinite(value):
            return nan if np.isnan(value) else infinity if value > 0 else f"-{infinity}"
        # The shortest digits that give the same number. `repr(float(np.float32(0.1)))` would be 0.10000000149011612.
        return f"{np.float32(value)!s}{single}" if dtype == "float32" else repr(float(value))

    return constant


# Reserved words of C99, C++ and their compilers, and macros of <math.h> and <stdio.h>.
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


TYPES = {"float64": "double", "float32": "float", "bool": "int"}
# `fmod` has the sign of the dividend, as JAX's `rem`. An operator % would differ between languages.
_IN_LIBRARY = {"abs": "fabs", "rem": "fmod", **{name: name for name in (*LIBRARY, "sqrt", "floor")}}
_C_FORMS = {
    **ARITHMETIC,
    **COMPARISONS,
    **{name: call(f"{word}{{s}}", 1 + (name in ("rem", "pow", "atan2"))) for name, word in _IN_LIBRARY.items()},
    "max": call("larger", 2),
    "min": call("smaller", 2),
    # `Form` has one level for comparisons, && and ||, but in C their precedences differ. So operands get parentheses.
    "and": Form("{0} && {1}", COMPARED, (TIGHT, TIGHT)),
    "or": Form("{0} || {1}", COMPARED, (TIGHT, TIGHT)),
    "xor": Form("{0} != {1}", COMPARED, (TIGHT, TIGHT)),
    "select": Form("{0} ? {1} : {2}", LOOSE, (SUM, SUM, SUM)),
    "convert": Form("({type}){0}", SIGNED, (TIGHT,)),
}
# As in JAX: NaN if one of the two is NaN, and -0 is less than 0.
HELPERS = {
    "max": "static {type} larger({type} a, {type} b) {{\n"
    "    return a != a || (a == b ? !signbit(a) : a > b) ? a : b;\n}}\n",
    "min": "static {type} smaller({type} a, {type} b) {{\n"
    "    return a != a || (a == b ? signbit(a) : a < b) ? a : b;\n}}\n",
}


C = Language(
    "C99",
    _C_FORMS,
    _constant(("0", "1"), "NAN", "INFINITY", single="f"),
    lambda name, text, dtype: f"const {TYPES[dtype]} {name} = {text};",
    TYPES,
    {"float64": "", "float32": "f", "bool": ""},
)


def six_a_line(texts: Sequence[str]) -> str:
    return ",\n    ".join(", ".join(texts[i : i + 6]) for i in range(0, len(texts), 6))


def in_comment(text: str) -> str:
    """A text that cannot end the comment that contains it."""
    return text.replace("*/", "* /").replace("\\", "/")


def listed(array: str, names: Sequence[str], units: Sequence[str | None] | None = None) -> str:
    """The elements of an array as lines of a comment in C."""
    units = [None] * len(names) if units is None else units
    lines = [
        in_comment(f"   {array}[{i}]: {name}{f' [{unit}]' if unit else ''}")
        for i, (name, unit) in enumerate(zip(names, units, strict=True))
    ]
    return "\n".join(lines or [f"   {array}: none; may be null"])


COMPARE = """
/* Prints the largest difference relative to `size`, or to the largest expected number if that is larger. */
static int compare(const char *name, int n, const {type} *computed, const {type} *expected, double size) {{
    double difference = 0.0;
    int i;
    for (i = 0; i < n; i++) {{ /* equal entries too have a size */
        if (fabs((double)expected[i]) > size && fabs((double)expected[i]) < HUGE_VAL) size = fabs((double)expected[i]);
    }}
    for (i = 0; i < n; i++) {{
        const double d = fabs((double)computed[i] - (double)expected[i]);
        if (computed[i] == expected[i] || (computed[i] != computed[i] && expected[i] != expected[i])) continue;
        if (!(d <= difference)) difference = d; /* also where it is not a number */
    }}
    printf("%-40s %.1e\\n", name, size > 0.0 ? difference / size : difference);
    return !(difference <= {tolerance} * size);
}}
"""


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
    """A system's equations as C99 that needs only the mathematical library.

        jk.export.c(bicycle, "generated/bicycle.c")
        # cc -std=c99 -O3 generated/bicycle.c generated/bicycle_test.c -lm -o test && ./test

    Every function takes `(t, q, u, inputs, parameters, outputs ...)`: time, arrays in the order of the declared names,
    a struct of the parameters, and an array for each output, with matrices row by row. Outputs must not overlap the
    other arguments. The header documents all arguments with units; `NAME_default` contains the parameters of this
    system. Functions do not allocate or keep anything, so threads may share them. NaN is propagated as by JAX.

    **Arguments:**

    - `system`: the system.
    - `path`: the source file, "FOLDER/NAME.c"; the folder is created. `NAME.h` and `NAME_test.c` are written to the
        same folder. The test is a program that compares every function with values that JAX computed.
    - `functions`: names of the functions. Default: rates (q_dot, u_dot), equations (M, f), dependent_speeds, and the
        derivatives of the rates, state_jacobian (by q, u), parameter_jacobian and input_jacobian. Also available:
        dependent_accelerations, constraint_jacobian, constraint_jacobian_rate, partial_velocities, kinetic_energy.
    - `name`: prefix of all function names. Default: the name of the file.
    - `dtype`: "float64", or "float32" for `float`.

    **Returns:** the paths `header`, `source` and `test`.

    **Raises:** `ValueError` for an unknown function, a batch of systems, and operations that are not formulas of
    scalars, such as those of LAPACK for more than 12 speeds.
    """
    path = Path(path)
    if path.suffix != ".c":
        raise ValueError(f"`path` must end with .c, e.g. 'generated/bicycle.c'; got {str(path)!r}.")
    warn_of_jumps(system, "jaxkane.export.c")
    formulas = Formulas(system, dtype)
    functions = function_names(formulas, functions)
    module = _CModule(formulas, functions, name or path.stem)
    files = ExportedFiles(path.with_suffix(".h"), path, path.with_name(f"{path.stem}_test.c"))
    texts = (module.header(), module.source(files.header.name), module.test(files.header.name))
    for file, text in zip(files, texts, strict=True):
        write_file(file, text)
    return files


def sections_of(template: str) -> dict[str, str]:
    """The sections of a template by name. Each section follows a line `// name`; a section "" precedes them."""
    text = (Path(__file__).parent / template).read_text(encoding="utf-8")
    parts = ["", *re.split(r"^// (\w+)\n", text, flags=re.MULTILINE)]
    return dict(zip(parts[::2], parts[1::2], strict=True))


class CText:
    """Elements of all C sources of a system: its name, the struct of its parameters, numbers, and bodies of
    functions."""

    def __init__(self, formulas: Formulas, name: str):
        self.formulas = formulas
        (self.name,) = identifiers([name], C_WORDS)
        self.type = TYPES[formulas.dtype]
        parameters = [a.name for a in formulas.of_kind("parameters")]
        self.members = dict(zip(parameters, identifiers(parameters, C_WORDS), strict=True))
        texts = {kind: [f"{kind}[{i}]" for i in range(len(formulas.names(kind)))] for kind in (*_VECTORS, "u_dep")}
        of_parameters = [
            f"p->{self.members[a.name]}" + f"[{i}]" * bool(a.shape)
            for a in formulas.of_kind("parameters")
            for i in range(len(a.elements))
        ]
        self.input_words = words_by_node(formulas, {"t": ["t"], **texts, "parameters": of_parameters})

    def constant(self, x: float) -> str:
        return C.constant(x, self.formulas.dtype)

    def struct(self) -> list[str]:
        """The lines of the struct of the parameters."""
        lines = ["typedef struct {"]
        for a in self.formulas.of_kind("parameters"):
            member = self.members[a.name]
            notes = f" {a.name}" if member != a.name else ""
            notes += f", {' x '.join(map(str, a.shape))}, row by row" if a.shape else ""
            notes += f" [{a.info.unit}]" if a.info.unit else ""
            comment = f" /* {in_comment(notes.strip(', '))} */" if notes else ""
            # C99 allows neither arrays of length zero nor empty initializers nor structs without members.
            size = f"[{max(1, len(a.elements))}]" if a.shape else ""
            lines.append(f"    {self.type} {member}{size};{comment}")
        if not self.members:
            lines.append("    char none; /* there are no parameters */")
        return [*lines, f"}} {self.name}_parameters;"]

    def default(self) -> str:
        """The initializer of that struct with the system's own values."""
        texts = []
        for x in self.formulas.values().values():
            numbers = ", ".join(map(self.constant, x.flat))
            texts.append(f"{{{numbers or '0'}}}" if x.shape else numbers)
        return six_a_line(texts or ["0"])

    def helpers(self, outputs: Sequence[np.ndarray]) -> list[str]:
        """Helper functions that the formulas of these outputs call."""
        used = {self.formulas.graph.nodes[k].operation for k in needed(self.formulas.graph.nodes, outputs)}
        return [text.format(type=self.type) for operation, text in HELPERS.items() if operation in used]

    def array(self, name: str, numbers: np.ndarray) -> str:
        return f"static const {self.type} {name}[] = {{\n    {self.numbers(numbers)}\n}};"

    def numbers(self, numbers: Numbers) -> str:
        return six_a_line([self.constant(x) for x in np.ravel(numbers)] or ["0"])

    def declaration(self, name: str, arguments: Iterable[str], by_output: Iterable[str]) -> str:
        """The declaration of a function, e.g. `void name(double t, const double *q, double *q_dot)`."""
        return f"void {name}({', '.join([*arguments, *(f'{self.type} *{output}' for output in by_output)])})"

    def function(
        self, name: str, arguments: Sequence[str], by_output: dict[str, np.ndarray], words: dict[int, str]
    ) -> str:
        """A function that computes these outputs from the declared arguments."""
        lines, outputs = as_source(self.formulas.graph, list(by_output.values()), words, C)
        for output, elements in zip(by_output, outputs, strict=True):
            lines += [f"{output}[{i}] = {text};" for i, text in enumerate(elements)]
        text = "\n    ".join(lines)
        # Without this use, compilers warn about an unused argument. All functions have the same arguments.
        read = [re.split(r"[ *]", argument)[-1] for argument in arguments]
        unused = [f"(void){word};" for word in (*read, *by_output) if not _is_read(word, text)]
        body = "\n    ".join([*unused, *lines])
        return f"{self.declaration(name, arguments, by_output)} {{\n    {body}\n}}\n"


class _CModule(CText):
    def __init__(self, formulas: Formulas, functions: tuple[str, ...], name: str):
        super().__init__(formulas, name)
        self.functions, self.nodes = functions, {function: formulas.nodes(function) for function in functions}
        title, real = in_comment(_title(formulas)), self.type
        self.comment = f"/* {title}\n   The results depend only on the arguments; all numbers are {real}. */\n"
        self.arguments = [f"{real} t", *(f"const {real} *{kind}" for kind in ("q", "u", "inputs"))]
        self.arguments.append(f"const {self.name}_parameters *p")

    def header(self) -> str:
        guard, unit_of = f"{self.name.upper()}_H", variable_units(self.formulas.system)
        lines = [self.comment, f"#ifndef {guard}", f"#define {guard}", "", "#ifdef __cplusplus"]
        lines += ['extern "C" {', "#endif", "", *self.struct(), "", "/* The parameters that were exported. */"]
        lines += [f"extern const {self.name}_parameters {self.name}_default;", ""]
        lines += ["/* Arguments of the functions:", "", "   t: time [s]"]
        for kind in _VECTORS:
            names = self.formulas.names(kind)
            lines.append(listed(kind, names, [unit_of.get(name) for name in names]))
        lines += ["", "   Outputs, matrices row by row; they must not overlap the other arguments: */", ""]
        for function in self.functions:
            shapes = ", ".join(
                f"{output} ({' x '.join(map(str, nodes.shape)) or 'a number'})"
                for output, nodes in self.nodes[function].items()
            )
            lines.append(f"/* {shapes}{in_comment(_meaning(self.formulas, function))} */")
            declaration = self.declaration(f"{self.name}_{function}", self.arguments, self.nodes[function])
            lines += [f"{declaration};", ""]
        return "\n".join([*lines, "#ifdef __cplusplus", "}", "#endif", "", "#endif", ""])

    def source(self, header: str) -> str:
        outputs = [nodes for by_output in self.nodes.values() for nodes in by_output.values()]
        default = f"const {self.name}_parameters {self.name}_default = {{\n    {self.default()}\n}};\n"
        parts = [self.comment, f'#include "{header}"\n\n#include <math.h>\n', default, *self.helpers(outputs)]
        parts += [
            self.function(f"{self.name}_{function}", self.arguments, by_output, self.input_words)
            for function, by_output in self.nodes.items()
        ]
        return "\n".join(parts)

    def test(self, header: str) -> str:
        """A program that calls every function at one state, and compares with stored values."""
        state, expected, sizes = _state_and_outputs(self.formulas, self.functions)
        lines = [self.comment, f'#include "{header}"\n\n#include <math.h>\n#include <stdio.h>\n']
        lines += [self.array(kind, state[kind]) for kind in _VECTORS]
        calls, t = [], self.constant(state["t"])
        for function in self.functions:
            outputs = "".join(f", computed_{function}_{output}" for output in expected[function])
            calls.append(f"    {self.name}_{function}({t}, q, u, inputs, &{self.name}_default{outputs});")
            for output, numbers in expected[function].items():
                name, size = f"{function}_{output}", sizes[function][output]
                lines.append(self.array(name, numbers))
                lines.append(f"static {self.type} computed_{name}[{max(1, numbers.size)}];")
                calls.append(f'    wrong += compare("{name}", {numbers.size}, computed_{name}, {name}, {size!r});')
        lines.append(COMPARE.format(type=self.type, tolerance=1e-11 if self.type == "double" else 1e-3))
        return "\n".join([*lines, "int main(void) {", "    int wrong = 0;", *calls, "    return wrong;", "}", ""])


_SMALL_CHANGE = 1e-4
_LONG = 5000
"""Nodes from which JAX evaluates operation by operation. XLA took 108 of 115 s to compile the Jacobians of an arm of
eight joints, for two evaluations."""


def _state_and_outputs(formulas: Formulas, functions: Iterable[str]) -> tuple[dict[str, Any], ...]:
    """A random state, the outputs that JAX computes there for this system, and the sizes of these outputs.

    All outputs are finite, unless twenty states gave none. The size of an output is its largest entry or its relative
    change with all arguments, whichever is larger. The largest entry is not enough, because terms may cancel: u_dot of
    a ball on a turntable is 1e-17 instead of zero, and rounding differs between C and JAX.
    """
    state: dict[str, Any] = {}
    expected: dict[str, dict[str, np.ndarray]] = {}
    sizes: dict[str, dict[str, float]] = {}
    for seed in range(20):
        rng = np.random.default_rng(seed)

        def draw(n: int | tuple[()], rng: np.random.Generator = rng) -> np.ndarray:
            return rng.uniform(0.2, 0.8, n).astype(formulas.dtype)

        state = {"t": draw(()), **{kind: draw(len(formulas.names(kind))) for kind in ("q", "u", "inputs", "u_dep")}}
        args = [*state.values(), *formulas.values().values()]
        nearby = [np.asarray(x) * (1 + _SMALL_CHANGE * rng.uniform(-1.0, 1.0, np.shape(x))) for x in args]
        nearby = [x.astype(formulas.dtype) for x in nearby]
        with jax.enable_x64(formulas.dtype == "float64"):
            for function in functions:
                evaluate = jax.jit(formulas.by_jax, static_argnums=0)
                if len(formulas.graph.nodes) > _LONG:
                    evaluate = formulas.by_jax
                outputs, others = (jax.tree.map(np.asarray, evaluate(function, *x)) for x in (args, nearby))
                expected[function] = dict(zip(formulas.nodes(function), outputs, strict=True))
                pairs = zip(formulas.nodes(function), outputs, others, strict=True)
                with np.errstate(invalid="ignore"):  # infinite entries
                    sizes[function] = {name: _size(x, (other - x) / _SMALL_CHANGE) for name, x, other in pairs}
        if all(np.all(np.isfinite(x)) for outputs in expected.values() for x in outputs.values()):
            break
    return state, expected, sizes


def _size(*values: np.ndarray) -> float:
    return max(float(np.abs(x[np.isfinite(x)]).max(initial=0.0)) for x in values)


_PYTHON_FORMS = {
    **COMPARISONS,
    **{
        name: call(f"np.{word}", 1 + (name in ("pow", "atan2", "rem", "max", "min")))
        for name, word in NUMPY_NAMES.items()
    },
    **ARITHMETIC,
    "erf": call("_erf"),
    # In Python, & and | bind more tightly than comparisons, so comparisons need parentheses here.
    "and": Form("{0} & {1}", COMPARED, (TIGHT, TIGHT)),
    "or": Form("{0} | {1}", COMPARED, (TIGHT, TIGHT)),
    "xor": Form("{0} ^ {1}", COMPARED, (TIGHT, TIGHT)),
    "select": call("np.where", 3),
    "convert": call("np.{type}"),
}


PYTHON = Language(
    "NumPy",
    _PYTHON_FORMS,
    _constant(("False", "True"), "np.nan", "np.inf"),
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
    """A system's equations as the source of a Python module that needs only NumPy.

        print(jk.export.numpy(pendulum, functions=("equations",)))
        jk.export.numpy(pendulum, "pendulum.py")  # import pendulum; pendulum.rates(0.0, q, u)

    Every function is `f(t, q, u, inputs=(), parameters=PARAMETERS)`, with arrays in the order of the declared names and
    the parameters by name. Omitted inputs are zero. NaN is propagated as by JAX, without a warning.

    **Arguments:**

    - `system`: the system.
    - `path`: the file to write, or None.
    - `functions`: names as in `jaxkane.export.c`. Default: rates, equations, and dependent_speeds if the system has
        any.
    - `dtype`: "float64" or "float32".

    **Returns:** the source.

    **Raises:** `ValueError` as `jaxkane.export.c`.
    """
    formulas = Formulas(system, dtype)
    text = _source(formulas, function_names(formulas, functions, ("rates", "equations", "dependent_speeds")))
    if path is not None:
        write_file(path, text)
    return text


def _source(formulas: Formulas, functions: Sequence[str]) -> str:
    units = {a.name: a.info.unit for a in formulas.of_kind("parameters")}
    unit_of = variable_units(formulas.system)
    bodies = [_function(formulas, function, unit_of) for function in functions]
    title = _title(formulas).replace("\\", "/").replace('"""', "'''")
    with_erf = any("_erf(" in body for body in bodies)
    lines = [f'"""{title}"""', ""]
    lines += ["import math", ""] * with_erf + ["import numpy as np", ""]
    lines += ["_erf = np.vectorize(math.erf)", ""] * with_erf
    lines.append("PARAMETERS = {")
    for name, value in formulas.values().items():
        number = _nested([PYTHON.constant(x, formulas.dtype) for x in value.flat], value.shape)
        number = f"np.array({number}, np.{formulas.dtype})" if value.shape else f"np.{formulas.dtype}({number})"
        lines.append(f"    {name!r}: {number}," + (f"  # [{units[name]}]" if units[name] else ""))
    return "\n".join([*lines, "}", *bodies])


def _words(formulas: Formulas, outputs: Iterable[str]) -> dict[tuple[str, str], str]:
    """Identifiers of a function by kind and name: of every variable, of whole parameters, and of outputs. A parameter
    may have the name of a coordinate."""
    named = [(kind, name) for kind in _VECTORS for name in formulas.names(kind)]
    named += [("parameters", a.name) for a in formulas.of_kind("parameters")]
    named += [("outputs", name) for name in outputs]
    return dict(zip(named, identifiers([name for _, name in named], _RESERVED, in_ascii_only=False), strict=True))


def _function(formulas: Formulas, function: str, unit_of: dict[str, str]) -> str:
    by_output = formulas.nodes(function)
    words = _words(formulas, by_output)
    of_kind = {"t": ["t"], **{kind: [words[kind, name] for name in formulas.names(kind)] for kind in _VECTORS}}
    of_kind["parameters"] = [
        words["parameters", a.name] + (f"[{', '.join(map(str, place))}]" if place else "")
        for a in formulas.of_kind("parameters")
        for place in np.ndindex(a.shape)
    ]
    of_node = words_by_node(formulas, of_kind)
    # No other name has the form of the names of intermediate results.
    letters = ("x", "z", *(f"x{'_' * n}" for n in range(1, 10)))
    letter = next(x for x in letters if not any(re.fullmatch(rf"{x}\d+", word) for word in words.values()))
    body, outputs = as_source(formulas.graph, list(by_output.values()), of_node, PYTHON, f"{letter}{{}}")
    text = "\n".join([*body, *(e for elements in outputs for e in elements)])
    # `np.where` evaluates both branches, and the one that is not chosen may divide by zero.
    lines = ["", '@np.errstate(all="ignore")']
    lines.append(f"def {function}(t, q, u, inputs=(), parameters=PARAMETERS):")
    lines.append(f'    """{", ".join(by_output)}{_meaning(formulas, function)}."""')
    for kind in _VECTORS:
        names = of_kind[kind]
        if any(_is_read(word, text) for word in names):
            units = ", ".join(unit_of.get(name) or "-" for name in formulas.names(kind))
            right = f"np.asarray({kind}, np.{formulas.dtype})"
            if kind == "inputs":
                right += f" if len(inputs) else np.zeros({len(names)}, np.{formulas.dtype})"
            # A single name needs a comma, or it would be the whole array.
            lines.append(f"    {', '.join(names)}{',' * (len(names) == 1)} = {right}  # [{units}]")
    lines += [
        f"    {word} = np.{formulas.dtype}(parameters[{name!r}])"
        for (kind, name), word in words.items()
        if kind == "parameters" and _is_read(word, text)
    ]
    lines += [f"    {line}" for line in body]
    for output, nodes, elements in zip(by_output, by_output.values(), outputs, strict=True):
        array = f"np.array({_nested(elements, nodes.shape)}, np.{formulas.dtype})"
        array += "" if nodes.size else f".reshape({nodes.shape})"
        lines.append(f"    {words['outputs', output]} = {array}")
    return "\n".join([*lines, f"    return {', '.join(words['outputs', output] for output in by_output)}", ""])


def _nested(elements: Sequence[str], shape: tuple[int, ...]) -> str:
    if not shape:
        return elements[0]
    step = int(np.prod(shape[1:]))
    return f"[{', '.join(_nested(elements[i * step : (i + 1) * step], shape[1:]) for i in range(shape[0]))}]"
