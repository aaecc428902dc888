"""The XML files of an FMU: the model description of FMI 2.0 and 3.0, and the build description of FMI 3.0."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any
from xml.etree import ElementTree

import numpy as np

from .._version import __version__
from ._fmu_model import LOCAL, FMUModel, Variable

KINDS = {"model exchange": "ModelExchange", "co-simulation": "CoSimulation"}


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
