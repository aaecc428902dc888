"""The XML files of an FMU: the model description of FMI 2.0 and 3.0, and the build description of FMI 3.0."""

from __future__ import annotations

import re
from collections.abc import Sequence
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
    is_2, variables = fmi == "2.0", model.variables
    root = ElementTree.Element("fmiModelDescription", fmiVersion=fmi, modelName=model.formulas.name)
    root.set("guid" if is_2 else "instantiationToken", token)
    if text := _first_line(model):
        root.set("description", text)
    root.set("generationTool", f"jaxkane {__version__}")
    root.set("variableNamingConvention", "structured" if all(map(_is_structured, variables)) else "flat")
    if is_2 and "model exchange" in kinds:
        root.set("numberOfEventIndicators", str(len(model.g)))
    for kind, tag in KINDS.items():
        if kind in kinds:
            element = ElementTree.SubElement(root, tag, {"modelIdentifier": model.name} | _capabilities(kind, fmi))
            if is_2 and has_sources:
                files = ElementTree.SubElement(element, "SourceFiles")
                ElementTree.SubElement(files, "File", name=f"{model.name}.c")
    _units(root, variables)
    ElementTree.SubElement(root, "DefaultExperiment", startTime="0", stepSize=_number(model.step))
    listed = ElementTree.SubElement(root, "ModelVariables")
    states = {x.derivative for x in variables} if any(model.events.stages) else set()
    for i, x in enumerate(variables):
        _variable(listed, i, x, fmi, can_jump=i in states)
    _structure(ElementTree.SubElement(root, "ModelStructure"), variables, fmi, "model exchange" in kinds)
    return _text(root)


def build_description(model: FMUModel) -> str:
    """The text of sources/buildDescription.xml of FMI 3.0."""
    root = ElementTree.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = ElementTree.SubElement(root, "BuildConfiguration", modelIdentifier=model.name)
    files = ElementTree.SubElement(configuration, "SourceFileSet", language="C99")
    ElementTree.SubElement(files, "SourceFile", name=f"{model.name}.c")
    return _text(root)


def _text(root: ElementTree.Element) -> str:
    ElementTree.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ElementTree.tostring(root, encoding="unicode")}\n'


def _first_line(model: FMUModel) -> str:
    """The first line of the docstring. Python gives a dataclass without one its signature."""
    text = (type(model.formulas.system).__doc__ or "").strip()
    return "" if text.startswith(f"{model.formulas.name}(") else " ".join(text.partition("\n\n")[0].split())


def _capabilities(kind: str, fmi: str) -> dict[str, str]:
    names = ["canGetAndSetFMUState", "canSerializeFMUState", "providesDirectionalDerivatives"]
    if fmi == "2.0":
        names = ["canGetAndSetFMUstate", "canSerializeFMUstate", "providesDirectionalDerivative"]
        names.append("canNotUseMemoryManagementFunctions")
        names += ["completedIntegratorStepNotNeeded"] * (kind == "model exchange")
    names += ["canHandleVariableCommunicationStepSize"] * (kind == "co-simulation")
    return dict.fromkeys(names, "true")


def _variable(parent: ElementTree.Element, place: int, x: Variable, fmi: str, can_jump: bool) -> None:
    common = {"name": x.name, "valueReference": str(place)}
    common |= {"causality": x.role.causality, "variability": x.role.variability}
    common |= {"initial": x.role.initial} if x.role.initial else {}
    common |= {"description": x.description} if x.description else {}
    of_number = {"unit": x.unit} if x.unit else {}
    of_number |= {"start": _number(x.start)} if x.start is not None else {}
    of_number |= {key: _number(b) for key, b in zip(("min", "max"), x.bounds, strict=True) if np.isfinite(b)}
    of_number |= {"reinit": "true"} if can_jump else {}
    if fmi == "2.0":  # places are counted from 1
        of_number |= {"derivative": str(x.derivative + 1)} if x.derivative is not None else {}
        ElementTree.SubElement(ElementTree.SubElement(parent, "ScalarVariable", common), "Real", of_number)
    else:
        of_number |= {"derivative": str(x.derivative)} if x.derivative is not None else {}
        ElementTree.SubElement(parent, "Float64", common | of_number)


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
    if fmi == "2.0":  # it has lists of unknowns, with places that are counted from 1, and none of event indicators
        names = {"Output": "Outputs", "ContinuousStateDerivative": "Derivatives", "InitialUnknown": "InitialUnknowns"}
        for tag, name in names.items():
            if groups[tag]:
                element = ElementTree.SubElement(parent, name)
                for i in groups[tag]:
                    read = {} if tag == "InitialUnknown" else _dependencies(variables[i], i, first=1)
                    ElementTree.SubElement(element, "Unknown", {"index": str(i + 1)} | read)
        return
    for tag, group in groups.items():
        for i in group:
            # At the start, unknowns also depend on parameters and start values. Without a list, they depend on all.
            read = {} if tag == "InitialUnknown" else _dependencies(variables[i], i, first=0)
            ElementTree.SubElement(parent, tag, {"valueReference": str(i)} | read)


def _dependencies(x: Variable, place: int, first: int) -> dict[str, str]:
    """The attribute with the places of the variables that determine a variable. A state determines itself."""
    places = (place,) if x.dependencies is None else x.dependencies
    return {"dependencies": " ".join(str(i + first) for i in places)}


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
    names = sorted({x.unit for x in variables if x.unit})
    definitions = ElementTree.SubElement(root, "UnitDefinitions")
    for name in names:
        element, powers = ElementTree.SubElement(definitions, "Unit", name=name), base_units(name)
        if powers is not None:
            ElementTree.SubElement(element, "BaseUnit", {k: str(n) for k, n in powers.items() if n})


def _number(x: float) -> str:
    """The shortest digits of a number, in the notation of XML."""
    return repr(float(x)) if np.isfinite(x) else "NaN" if np.isnan(x) else "INF" if x > 0 else "-INF"


_IDENTIFIER = r"[A-Za-z_]\w*(?:\[\d+\])?(?:\.[A-Za-z_]\w*(?:\[\d+\])?)*"


def _is_structured(x: Variable) -> bool:
    """Whether importers can read a name as a path, such as "frame.moments[2]" or "der(angle)"."""
    return re.fullmatch(rf"{_IDENTIFIER}|der\({_IDENTIFIER}\)", x.name, flags=re.ASCII) is not None
