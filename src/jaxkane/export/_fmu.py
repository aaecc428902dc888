"""Export a system as a functional mock-up unit (FMU), which simulation programs import: the compiler, the archive and
its XML files (the model description of FMI 2.0 and 3.0, and the build description of FMI 3.0)."""

from __future__ import annotations

import os
import platform
import re
import shlex
import shutil
import subprocess
import tempfile
import uuid
import warnings
import zipfile
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import jax
import numpy as np

from .._common.files import write_file
from .._common.lookup import real_number, refuse_unknown
from .._kane.arguments import check_is_system, has_multipliers, is_concrete
from .._kane.consistent_state import assemble
from .._kane.contact.forces import has_contacts, layout_of
from .._scalarjit.components import is_written_out
from .._system.parameters import in_batches
from .._system.system import State, System
from .._version import __version__
from ._fmu_model import LOCAL, FMUModel, Variable
from ._source import C_WORDS, identifiers

VERSIONS = ("2.0", "3.0")
KINDS = {"model exchange": "ModelExchange", "co-simulation": "CoSimulation"}


def fmu(
    system: System,
    path: str | Path,
    *,
    fmi: str = "3.0",
    kind: str | Sequence[str] = ("model exchange", "co-simulation"),
    step: float = 1e-3,
    sources: bool = True,
    state: State | None = None,
) -> Path:
    """Export a system as an FMU, for Simulink, OpenModelica, Dymola, FMPy and other programs that support FMI.

        jk.export.fmu(pendulum, "pendulum.fmu")
        # fmpy.simulate_fmu("pendulum.fmu", start_values={"angle": 1.0, "mass": 2.0})

    | in the system | in the FMU |
    |---|---|
    | coordinates, independent speeds, first-order states | continuous states; they are also outputs |
    | dependent speeds, outputs | outputs |
    | inputs | inputs |
    | parameters | tunable parameters with bounds; fixed parameters if configuration constraints depend on them |
    | events without `then`, det C_dep = 0 | end of the simulation |
    | events with `then` | jumps of the states |

    All directional derivatives are exact, also those with respect to parameters. The state of the FMU can be stored,
    restored and serialized. Co-simulation uses the classical Runge-Kutta method of order 4. It divides each
    communication step into equal steps, and locates events. The FMU refuses values of parameters outside of their
    bounds.

    At the end of the initialization, the FMU solves the configuration constraints for the dependent coordinates. A
    system without dependent coordinates starts at the nearest coordinates that satisfy the constraints. Dependent
    speeds are always computed from the constraints.

    The equations are compiled with the C compiler of this computer: `$CC`, cc, gcc or clang. The FMU therefore runs on
    computers of the same kind. With `sources`, other programs can compile the FMU for other computers.

    **Arguments:**

    - `system`: the system, with at most 12 independent speeds.
    - `path`: the file to write, "FOLDER/NAME.fmu". The folder is created. An existing file is replaced.
    - `fmi`: the version of the interface, "3.0" or "2.0".
    - `kind`: "model exchange" (the importing program integrates), "co-simulation" (the FMU integrates), or both.
    - `step`: the longest step of the integration in co-simulation [s].
    - `sources`: whether the FMU contains its C source, one file without dependencies.
    - `state`: the start values. Default: `jaxkane.assemble(system, {}, {})`.

    **Returns:** the path.

    **Raises:** `ValueError` for contacts, for more than 12 speeds, for a batch of systems, for operations that are not
    formulas of scalars, and for start values that violate the constraints. `RuntimeError` if there is no compiler and
    `sources` is False. If there is no compiler and `sources` is True, the FMU contains only the source, with a warning.
    """
    kinds = (kind,) if isinstance(kind, str) else tuple(kind)
    path = _checked(system, path, fmi, kinds, step)
    model = _model(system, path, step, state)
    # The token depends on the contents only, so that equal systems give equal files.
    contents = model.source(fmi, "") + model_description(model, fmi, kinds, "", sources)
    token = str(uuid.uuid5(uuid.NAMESPACE_URL, contents))
    source = model.source(fmi, token)
    binary, problem = _compiled(source, model.name)
    if binary is None:
        if not sources:
            raise RuntimeError(f"fmu: {problem} Install a C compiler, or pass sources=True to export the C source.")
        warnings.warn(
            f"jaxkane.export.fmu: {problem} {path.name} contains only C source, which not all programs can import. "
            "Install a C compiler and export it again to add a binary.",
            stacklevel=2,
        )
    files: dict[str, str | bytes] = {"modelDescription.xml": model_description(model, fmi, kinds, token, sources)}
    if sources:
        files[f"sources/{model.name}.c"] = source
        if fmi == "3.0":
            files["sources/buildDescription.xml"] = build_description(model)
    if binary is not None:
        files[f"binaries/{_platform(fmi)}/{model.name}{_suffix()}"] = binary
    write_file(path, _zipped(files))
    return path


def _checked(system: System, path: str | Path, fmi: str, kinds: tuple[str, ...], step: float) -> Path:
    """The path, after checks of the arguments and of what an FMU can contain."""
    check_is_system(system)
    name, path = type(system).__name__, Path(path)
    refuse_unknown(kinds, KINDS, "fmu: there is no kind")
    step = real_number(step, "fmu: `step`")
    if not is_concrete(system):
        raise TypeError(f"{name} is traced. Call this function outside of jax.jit, vmap and grad.")
    batched, contacts = in_batches(system), layout_of(system).names if has_contacts(system) else ()
    refused = {
        f"`path` must end with .fmu, e.g. 'generated/bicycle.fmu'; got {str(path)!r}.": path.suffix != ".fmu",
        f"`fmi` must be {' or '.join(map(repr, VERSIONS))}, got {fmi!r}.": fmi not in VERSIONS,
        f"`kind` is empty. Pass some of {', '.join(map(repr, KINDS))}.": not kinds,
        f"fmu: `step` [s] must be positive and finite, got {step!r}.": not 0 < step < np.inf,
        f"{name} is a batch: {', '.join(batched)} has additional leading axes. Pass one member of it.": batched,
        f"{name} has no coordinates and no first-order states, so an FMU would have no states.": not (
            system.coordinates or system.states
        ),
        f"{name}: an FMU cannot represent contacts: {', '.join(contacts)}. Replace them by spring forces in `loads`, "
        "or by events with `then`.": contacts,
        f"{name}: an FMU cannot represent multipliers. Export the system with dependent speeds.": has_multipliers(
            system
        ),
        f"{name}: an FMU supports at most 12 independent speeds, and this system has {len(system.speeds)}. "
        "jaxkane.export.stablehlo supports any number.": not is_written_out(len(system.speeds)),
    }
    for message, is_wrong in refused.items():
        if is_wrong:
            raise ValueError(message)
    return path


def _model(system: System, path: Path, step: float, state: State | None) -> FMUModel:
    (name,) = identifiers([path.stem], C_WORDS)
    if not isinstance(state, (State, type(None))):
        raise TypeError(f"fmu: `state` must be a jaxkane.State, got {state!r}.")
    try:
        start = assemble(system, {}, {}) if state is None else assemble(system, state.q, state.u, state.x)
    except ValueError as error:
        raise ValueError(f"fmu: there are no start values. {error} Pass other values as `state`.") from error
    with jax.enable_x64(True):
        model = FMUModel(system, start, name, step)
    # XML cannot contain control characters, and names of variables no line breaks.
    for text in (text for x in model.variables for text in (x.name, x.unit)):
        if not text.isprintable():
            raise ValueError(f"{model.formulas.name}: an FMU cannot contain the name or unit {text!r}. Rename it.")
    return model


def _compiled(source: str, name: str) -> tuple[bytes | None, str]:
    command = shlex.split(os.environ.get("CC", "")) or [x for x in ("cc", "gcc", "clang") if shutil.which(x)][:1]
    if not command:
        return None, "There is no C compiler ($CC, cc, gcc or clang)."
    with tempfile.TemporaryDirectory() as folder:
        file, target = Path(folder) / f"{name}.c", Path(folder) / f"{name}{_suffix()}"
        file.write_text(source, encoding="utf-8")
        options = ["-std=c99", "-O2", "-shared", "-fvisibility=hidden", "-ffp-contract=off"]
        options += [] if os.name == "nt" else ["-fPIC"]
        command = [*command, *options, str(file), "-o", str(target), "-lm"]
        try:
            run = subprocess.run(command, capture_output=True, text=True, check=False)
        except OSError as error:
            return None, f"The C compiler {command[0]!r} cannot be run: {error.strerror}."
        if run.returncode or not target.exists():
            lines = [line for line in run.stderr.splitlines() if "error" in line] or run.stderr.splitlines()
            reason = f": {lines[0].strip()}" if lines else f" (status {run.returncode})"
            return None, f"The C compiler {command[0]!r} failed{reason}."
        return target.read_bytes(), ""


def _suffix() -> str:
    return {"Windows": ".dll", "Darwin": ".dylib"}.get(platform.system(), ".so")


def _platform(fmi: str) -> str:
    system, machine = platform.system().lower(), platform.machine().lower()
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(machine, machine)
    if fmi == "3.0":
        return f"{machine}-{system}"
    short = {"windows": "win", "darwin": "darwin"}.get(system, system)
    return f"{short}{'64' if machine.endswith('64') else '32'}"


def _zipped(files: dict[str, str | bytes]) -> bytes:
    buffer = BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            # A fixed date, so that equal systems give equal files.
            entry = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(entry, content)
    return buffer.getvalue()


def model_description(model: FMUModel, fmi: str, kinds: Sequence[str], token: str, has_sources: bool) -> str:
    """The text of modelDescription.xml.

    **Arguments:**

    - `model`: the model.
    - `fmi`: "2.0" or "3.0".
    - `kinds`: some of `KINDS`.
    - `token`: the text that identifies this version of the FMU.
    - `has_sources`: whether the FMU contains its source. Only FMI 2.0 lists the source in this file.
    """
    is_2, variables, has_exchange = fmi == "2.0", model.variables, "model exchange" in kinds
    root = ElementTree.Element("fmiModelDescription", fmiVersion=fmi, modelName=model.formulas.name)
    root.set("guid" if is_2 else "instantiationToken", token)
    # The first line of the docstring. Python gives a dataclass without one its signature.
    text = (type(model.formulas.system).__doc__ or "").strip()
    if text and not text.startswith(f"{model.formulas.name}("):
        root.set("description", " ".join(text.partition("\n\n")[0].split()))
    root.set("generationTool", f"jaxkane {__version__}")
    root.set("variableNamingConvention", "structured" if all(_PATH.fullmatch(x.name) for x in variables) else "flat")
    if is_2 and has_exchange:
        root.set("numberOfEventIndicators", str(len(model.g)))
    for kind, tag in KINDS.items():
        if kind in kinds:
            element = _element(root, tag, modelIdentifier=model.name, **_capabilities(kind, fmi))
            if is_2 and has_sources:
                _element(_element(element, "SourceFiles"), "File", name=f"{model.name}.c")
    _units(root, variables)
    _element(root, "DefaultExperiment", startTime="0", stepSize=_number(model.step))
    listed = _element(root, "ModelVariables")
    states = {x.derivative for x in variables} if any(model.events.stages) else set()
    for i, x in enumerate(variables):
        _variable(listed, i, x, fmi, can_jump=i in states)
    _structure(_element(root, "ModelStructure"), variables, fmi, has_exchange)
    return _text(root)


def build_description(model: FMUModel) -> str:
    """The text of sources/buildDescription.xml of FMI 3.0."""
    root = ElementTree.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = _element(root, "BuildConfiguration", modelIdentifier=model.name)
    _element(_element(configuration, "SourceFileSet", language="C99"), "SourceFile", name=f"{model.name}.c")
    return _text(root)


def _text(root: ElementTree.Element) -> str:
    ElementTree.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ElementTree.tostring(root, encoding="unicode")}\n'


def _capabilities(kind: str, fmi: str) -> dict[str, str]:
    names = ["canGetAndSetFMUState", "canSerializeFMUState", "providesDirectionalDerivatives"]
    if fmi == "2.0":
        names = ["canGetAndSetFMUstate", "canSerializeFMUstate", "providesDirectionalDerivative"]
        names.append("canNotUseMemoryManagementFunctions")
        names += ["completedIntegratorStepNotNeeded"] * (kind == "model exchange")
    names += ["canHandleVariableCommunicationStepSize"] * (kind == "co-simulation")
    return dict.fromkeys(names, "true")


def _element(parent: ElementTree.Element, tag: str, **attributes: Any) -> ElementTree.Element:
    """A new element. Attributes that are None or empty are omitted, except for a list of dependencies."""
    texts = {name: str(x) for name, x in attributes.items() if name == "dependencies" or x not in (None, "")}
    return ElementTree.SubElement(parent, tag, texts)


def _variable(parent: ElementTree.Element, place: int, x: Variable, fmi: str, can_jump: bool) -> None:
    first = int(fmi == "2.0")  # places are counted from 1
    lower, upper = (_number(bound) if np.isfinite(bound) else None for bound in x.bounds)
    common = {"name": x.name, "valueReference": place, **x.role._asdict(), "description": x.description}
    of_number = {
        "unit": x.unit,
        "start": None if x.start is None else _number(x.start),
        "min": lower,
        "max": upper,
        "reinit": "true" if can_jump else None,
        "derivative": None if x.derivative is None else x.derivative + first,
    }
    if fmi == "2.0":
        _element(_element(parent, "ScalarVariable", **common), "Real", **of_number)
    else:
        _element(parent, "Float64", **common, **of_number)


# Lists of unknowns in FMI 2.0, by the elements of FMI 3.0. FMI 2.0 does not list event indicators.
_LISTS = {"Output": "Outputs", "ContinuousStateDerivative": "Derivatives", "InitialUnknown": "InitialUnknowns"}


def _structure(parent: ElementTree.Element, variables: Sequence[Variable], fmi: str, has_indicators: bool) -> None:
    """Which variables are outputs, rates and event functions, and on which states, inputs and times they depend."""
    places = range(len(variables))
    outputs = [i for i in places if variables[i].role.causality == "output"]
    rates = [i for i in places if variables[i].derivative is not None]
    groups = {
        "Output": outputs,
        "ContinuousStateDerivative": rates,
        "InitialUnknown": [i for i in sorted(outputs + rates) if variables[i].role.initial != "exact"],
        "EventIndicator": [i for i in places if variables[i].role == LOCAL and i not in rates and has_indicators],
    }
    for tag, group in groups.items():
        if fmi == "3.0":
            for i in group:
                _element(parent, tag, valueReference=i, **_dependencies(tag, variables[i], i))
        elif group and tag in _LISTS:  # places are counted from 1
            unknowns = _element(parent, _LISTS[tag])
            for i in group:
                _element(unknowns, "Unknown", index=i + 1, **_dependencies(tag, variables[i], i, first=1))


def _dependencies(tag: str, x: Variable, place: int, first: int = 0) -> dict[str, str]:
    """The attribute with the places of the variables that determine a variable. A state determines itself. At the
    start, unknowns also depend on parameters and start values. Without a list, they depend on all."""
    places = (place,) if x.dependencies is None else x.dependencies
    text = " ".join(str(i + first) for i in places)
    return {} if tag == "InitialUnknown" else {"dependencies": text}


# Units of one letter or name as powers of SI base units.
_BASE: dict[str, dict[str, int]] = {name: {name: 1} for name in ("kg", "m", "s", "A", "K", "mol", "cd", "rad")} | {
    "1": {},
    "-": {},
    "N": {"kg": 1, "m": 1, "s": -2},
    "Pa": {"kg": 1, "m": -1, "s": -2},
    "J": {"kg": 1, "m": 2, "s": -2},
    "W": {"kg": 1, "m": 2, "s": -3},
    "Hz": {"s": -1},
    "C": {"A": 1, "s": 1},
    "V": {"kg": 1, "m": 2, "s": -3, "A": -1},
    "F": {"kg": -1, "m": -2, "s": 4, "A": 2},
    "ohm": {"kg": 1, "m": 2, "s": -3, "A": -2},
    "Wb": {"kg": 1, "m": 2, "s": -2, "A": -1},
    "T": {"kg": 1, "s": -2, "A": -1},
    "H": {"kg": 1, "m": 2, "s": -2, "A": -2},
}


def base_units(unit: str) -> dict[str, int] | None:
    """A unit as powers of SI base units, for example "N m/rad", "kg m^2", "N/(m/s)". None if it is not understood.

    A slash divides by one unit only: "W/m K" could mean two things, so it is not understood.
    """
    match = re.fullmatch(r"([^/()]+)((?:/(?:[^/() ]+|\([^()]*\)))*)", unit.strip())
    if not match:
        return None
    powers: dict[str, int] = {}
    parts = [(text, 1) for text in re.split(r"[ *·]+", match[1].strip())]
    parts += [(text, -1) for text in re.findall(r"/([^/() ]+|\([^()]*\))", match[2])]
    for text, sign in parts:
        name, _, power = text.partition("^")
        inner = base_units(text[1:-1]) if text.startswith("(") else _BASE.get(name)
        if inner is None or (power and not re.fullmatch(r"-?\d", power)):
            return None
        for base, exponent in inner.items():
            powers[base] = powers.get(base, 0) + sign * exponent * int(power or 1)
    return powers


def _units(root: ElementTree.Element, variables: Sequence[Variable]) -> None:
    """The definitions of units. A unit that is not understood has a name only."""
    definitions = _element(root, "UnitDefinitions")
    for name in sorted({x.unit for x in variables if x.unit}):
        element, powers = _element(definitions, "Unit", name=name), base_units(name)
        if powers is not None:
            _element(element, "BaseUnit", **{k: n for k, n in powers.items() if n})


def _number(x: float) -> str:
    """The shortest digits of a number, in the notation of XML."""
    return repr(float(x)) if np.isfinite(x) else "NaN" if np.isnan(x) else "INF" if x > 0 else "-INF"


# Names that importers can read as a path, such as "frame.moments[2]" or "der(angle)".
_IDENTIFIER = r"[A-Za-z_]\w*(?:\[\d+\])?(?:\.[A-Za-z_]\w*(?:\[\d+\])?)*"
_PATH = re.compile(rf"{_IDENTIFIER}|der\({_IDENTIFIER}\)", re.ASCII)
