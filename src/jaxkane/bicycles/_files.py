"""Reads parameter files of the package BicycleParameters into parameters of a bicycle and its rider.

Its YAML files contain a header and `values`, or only names and numbers. Any other entry raises an exception. These sets
of names ("parameterizations") can be read:

| name | contents |
|---|---|
| Meijaard2007, benchmark | Meijaard's names; a rider, if any, is included in B |
| Moore2019, principal | a frame D and a rigid rider P, with radii of gyration about their principal axes |
| Moore2012 | Moore (2012), *Human control of a bicycle*: the rear frame C includes the rider |
| MooreRiderLean2012 | the same with legs in C and a leaning upper body G |
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from typing import Any

from .._common.lookup import hint
from ..catalog.bicycle import checked_entries, text_of
from ._rider import LeaningRider, RigidRider

_HEADER = ("parameterization", "parameters", "rider", "description", "values")

# Each set, and a name that no other set has except a larger one listed before it.
_SETS = {"MooreRiderLean2012": "ig11", "Moore2012": "ic11", "Moore2019": "kDaa", "Meijaard2007": "IBxx"}
_CALLED = {"benchmark": "Meijaard2007", "principal": "Moore2019"}

ParameterValues = dict[str, float]


def read_yaml(path: str | os.PathLike[str]) -> tuple[str, ParameterValues]:
    """Read a YAML file of BicycleParameters.

    **Returns:** the name of the set of parameters, and the values by name.

    **Raises:** `ValueError` with one line for every malformed or repeated entry, and for an unknown set of names.
    """
    import yaml

    name = os.fspath(path)
    try:
        # `yaml.safe_load` would drop repeated names, and read 010 as 8 and 1e-3 as text. Use the nodes instead.
        root = yaml.compose(text_of(path), Loader=yaml.SafeLoader)
    except yaml.YAMLError as error:
        raise ValueError(f"{name} is not a YAML file: {error}.") from None
    pairs = list(root.value) if isinstance(root, yaml.MappingNode) else []
    if not pairs:
        raise ValueError(f"{name} must contain lines of the form NAME: number.")
    header: dict[str, str] = {}
    entries = []
    for key, node in pairs:  # the list grows by the entries of `values`
        if key.value not in _HEADER:
            text = f"{key.value}: {node.value!r}"
            entries.append((key.start_mark.line + 1, text, key.value, (node.value,)))
            continue
        header[key.value] = node.value
        if key.value == "values" and isinstance(node, yaml.MappingNode):
            pairs += node.value
    values = {key: value for key, (value,) in checked_entries(path, entries, "NAME: number").items()}
    called = header.get("parameterization", "")
    kind = _CALLED.get(called, called) or next((kind for kind, own in _SETS.items() if own in values), "")
    if kind not in _SETS:
        fault = f"the parameterization {called!r} is not known" if called else "the file has no known parameterization"
        raise ValueError(f"{name}: {fault}; {hint([called], list(_SETS), 'the parameterizations are')}")
    return kind, values


def as_meijaard(kind: str, values: Mapping[str, float]) -> dict[str, Any]:
    """Convert a set of parameters to those of a `Bicycle`.

    **Arguments:**

    - `kind`: the name of the set.
    - `values`: numbers by name. The speed `v` is ignored.

    **Returns:** Meijaard's parameters, and "rider" if the set contains one.

    **Raises:** `ValueError` with the missing and the unknown names.
    """
    parameters = _Parameters(kind, values)
    parameters.pop("v", 0.0)
    converted, rider = _CONVERSIONS[kind](parameters)
    parameters.refuse_rest()
    if rider is None:
        return converted
    return {**converted, "rider": (LeaningRider if "hinge_z" in rider else RigidRider)(**rider)}


class _Parameters(dict[str, float]):
    """Parameters by name. Values are popped, so that all missing and remaining names are reported together."""

    def __init__(self, kind: str, values: Mapping[str, float]):
        super().__init__(values)
        self.kind = kind
        self.missing: list[str] = []

    def pop_values(self, *names: str) -> list[float]:
        self.missing += [name for name in names if name not in self]
        return [self.pop(name, math.nan) for name in names]

    def named(self, *names: str) -> ParameterValues:
        return dict(zip(names, self.pop_values(*names), strict=True))

    def refuse_rest(self) -> None:
        names = {"missing": self.missing, "unknown": [*self]}
        faults = [f"{fault}: {', '.join(wrong)}" for fault, wrong in names.items() if wrong]
        if faults:
            raise ValueError(f"the parameters of {self.kind}: {'; '.join(faults)}.")


def _meijaard(p: _Parameters) -> tuple[ParameterValues, None]:
    values = dict(p)  # `WhippleBicycle.from_parameters` checks these names
    p.clear()
    return values, None


def _principal(p: _Parameters) -> tuple[ParameterValues, ParameterValues]:
    """Moore and Hubbard (2019): radii of gyration k about principal axes a and b; a is rotated by alpha about y."""
    parameters = p.named("w", "c", "lam", "g", "rR", "rF", "mR", "mF", "mH", "xH", "zH")
    implied = {}  # implied by the others, or zero by symmetry; these may be in the file
    for wheel in "RF":
        implied[f"k{wheel}bb"], about_axle = p.pop_values(f"k{wheel}aa", f"k{wheel}yy")
        parameters[f"I{wheel}xx"] = parameters[f"m{wheel}"] * implied[f"k{wheel}bb"] ** 2
        parameters[f"I{wheel}yy"] = parameters[f"m{wheel}"] * about_axle**2
    parameters |= _named(_of_radii(p, "H", parameters["mH"]), "IH")
    frame = p.named("mD", "xD", "zD")
    parameters |= {f"{name[0]}B": value for name, value in frame.items()}
    parameters |= _named(_of_radii(p, "D", parameters["mB"]), "IB")
    mass, x, z = p.pop_values("mP", "xP", "zP")
    rider = {"mass": mass, "x": x, "z": z} | _named(_of_radii(p, "P", mass), "I")
    p.pop_values("lP", "wP")  # length and width of the rider's outline
    implied |= {"xF": parameters["w"], "zR": -parameters["rR"], "zF": -parameters["rF"]}
    implied |= dict.fromkeys(("xR", "alphaR", "alphaF", "yD", "yF", "yH", "yP", "yR"), 0.0)
    for name, value in implied.items():
        if abs(p.pop(name, value) - value) > 1e-9 * max(1.0, abs(value)):
            raise ValueError(
                f"the parameters of {p.kind}: {name} must be {value:.6g}, because the other parameters imply this "
                "value. Correct or omit it."
            )
    return parameters, rider


def _moore(p: _Parameters) -> tuple[ParameterValues, None]:
    """Moore (2012): positions and inertias of rear and front frame in axes of which the third is the steer axis."""
    d1, d2, d3, rR, rF = p.pop_values("d1", "d2", "d3", "rr", "rf")
    # Both wheels touch the level ground: (d1 + d3) sin(lam) - d2 cos(lam) = rF - rR.
    apart = math.hypot(d1 + d3, d2)
    if abs(rF - rR) >= apart:
        raise ValueError(
            f"the parameters of {p.kind}: the wheels are too close to touch level ground. Check d1, d2, d3, rr and rf."
        )
    lam = math.atan2(d2, d1 + d3) + math.asin((rF - rR) / apart)
    parameters = {"lam": lam, "rR": rR, "rF": rF, "g": p.pop_values("g")[0]}
    parameters["w"], _ = _level(lam, d1 + d3, d2)
    parameters["c"] = (rF * math.sin(lam) - d3) / math.cos(lam)
    # C is measured from the rear wheel's centre, E from the front wheel's.
    frames = (("c", "B", ("l1", "l2"), 0.0, -rR), ("e", "H", ("l3", "l4"), parameters["w"], -rF))
    for body, letter, along, from_x, from_z in frames:
        x, z = _level(lam, *p.pop_values(*along))
        parameters |= {f"x{letter}": from_x + x, f"z{letter}": from_z + z, f"m{letter}": p.pop_values(f"m{body}")[0]}
        moments = p.pop_values(*(f"i{body}{axes}" for axes in ("11", "22", "33", "31")))
        parameters |= _named(_turned(lam, *moments), f"I{letter}")
    for body, letter in (("d", "R"), ("f", "F")):
        wheel = p.pop_values(f"m{body}", f"i{body}11", f"i{body}22")
        parameters |= dict(zip((f"m{letter}", f"I{letter}xx", f"I{letter}yy"), wheel, strict=True))
    return parameters, None


def _moore_lean(p: _Parameters) -> tuple[ParameterValues, ParameterValues]:
    """The same with a leaning upper body G. Its hinge is level, `d4` below the rear wheel's centre. Its mass centre is
    `l5` before that centre and `l6` below the hinge."""
    parameters, _ = _moore(p)
    d4, l5, l6 = p.pop_values("d4", "l5", "l6")
    hinge = d4 - parameters["rR"]
    rider = {"x": l5, "z": hinge + l6, "hinge_x": 0.0, "hinge_z": hinge}
    names = ("mass", "Ixx", "Iyy", "Izz", "Ixz", "stiffness", "damping")
    values = p.pop_values("mg", "ig11", "ig22", "ig33", "ig31", "k9", "c9")
    return parameters, rider | dict(zip(names, values, strict=True))


def _level(lam: float, x: float, z: float) -> tuple[float, float]:
    """Components in level axes of a vector with components x, z in axes that are tilted by `lam`."""
    cos, sin = math.cos(lam), math.sin(lam)
    return cos * x + sin * z, cos * z - sin * x


def _turned(lam: float, Ixx: float, Iyy: float, Izz: float, Ixz: float) -> tuple[float, float, float, float]:
    """Moments and product of inertia in level axes, from those in axes that are tilted by `lam`."""
    cos, sin = math.cos(lam), math.sin(lam)
    xx = cos * cos * Ixx + 2 * cos * sin * Ixz + sin * sin * Izz
    zz = sin * sin * Ixx - 2 * cos * sin * Ixz + cos * cos * Izz
    return xx, Iyy, zz, cos * sin * (Izz - Ixx) + (cos * cos - sin * sin) * Ixz


def _of_radii(p: _Parameters, body: str, mass: float) -> tuple[float, float, float, float]:
    aa, bb, yy, alpha = p.pop_values(f"k{body}aa", f"k{body}bb", f"k{body}yy", f"alpha{body}")
    return _turned(alpha, mass * aa**2, mass * yy**2, mass * bb**2, 0.0)


def _named(moments: tuple[float, ...], prefix: str) -> ParameterValues:
    return {prefix + axes: value for axes, value in zip(("xx", "yy", "zz", "xz"), moments, strict=True)}


_CONVERSIONS = {
    "Meijaard2007": _meijaard, "Moore2019": _principal, "Moore2012": _moore, "MooreRiderLean2012": _moore_lean,
}  # fmt: skip
