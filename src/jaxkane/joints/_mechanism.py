"""Mechanisms: a class for every structure, with its parameters by name, made from links."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

from .._common.lookup import hint
from .._scalarjit.components import Scalar
from .._system.parameters import parameter, parameter_info
from ._tree import KINDS, Named, Structure, Tree


class Mechanism(Tree):
    """A tree of links and joints; made by `jaxkane.joints.mechanism`, or from a file by `jaxkane.convert`.

    Parameters are read by kind and name, as `arm.mass["forearm"]` or `arm.center["forearm"]["z"]`, and named so in a
    fit or the columns of a sweep: "mass.forearm", "center.forearm.z". `arm.replace({"mass.forearm": 1.3})` is a copy.
    """

    left_out: ClassVar[tuple[str, ...]] = ()
    """What a file said and the mechanism does not have."""

    def __init__(self, **values: Any):
        for field in dataclasses.fields(self):  # names with a dot cannot be those of arguments
            setattr(self, field.name, values.pop(field.name) if field.name in values else _default(self, field))
        if values:
            raise TypeError(f"{type(self).__name__} has no parameter {', '.join(values)}.")

    def __reduce__(self) -> Any:
        if type(self) is not class_of(self.structure, _fields(type(self))):  # one that inherits from it
            return super().__reduce__()
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return _restored, (self.structure, _fields(type(self)), values)

    def replace(self, values: Mapping[str, Any]) -> Mechanism:
        """A copy with other parameters, by name. **Raises:** `ValueError` for a name that is none."""
        names = [field.name for field in dataclasses.fields(self)]
        wrong = [name for name in values if name not in names]
        if wrong:
            raise ValueError(f"{type(self).__name__} has no parameter {wrong[0]!r}; {hint(wrong, names, 'it has')}")
        return dataclasses.replace(self, **values)

    def with_outputs(self, outputs: Callable[..., Any], parameters: Mapping[str, Any] | None = None) -> Mechanism:
        """A copy that carries sensors: `outputs(self, t, q, u, motion, now)`, as that of a `System`.

            def outputs(self, t, q, u, motion, now):
                frame, point = motion.sites["imu"]
                box = frame.rotate_fixed((self.tilt, 0.0, 0.0))
                return {"imu": jk.sensors.imu(now, point, box, -9.81 * motion.N.z)}

            arm = arm.with_outputs(outputs, {"tilt": 0.0})

        **Arguments:** `parameters`: numbers by name that it reads of itself, parameters as all others. `motion.sites`
        are pairs of the frame and the point of every site.

        **Raises:** `ValueError` for a parameter that it has already, or that is no name of Python.
        """
        given = dict(parameters or {})
        twice = [name for name in given if hasattr(self, name) or not name.isidentifier()]
        if twice:
            raise ValueError(f"{type(self).__name__}: {twice[0]!r} cannot be the name of another parameter.")
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        kind: Any = type(self)
        return _equipped(kind, outputs, tuple(given))(**values, **given)


def _default(mechanism: Mechanism, field: dataclasses.Field[Any]) -> Any:
    """Of a parameter that a class which inherits from a mechanism's has besides."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    if field.default is not dataclasses.MISSING:
        return field.default
    raise TypeError(f"{type(mechanism).__name__}: the parameter {field.name} is missing, which has no default.")


def _view(kind: str) -> property:
    def read(self: Mechanism) -> Named:
        found = Named(kind, self.structure)
        for field in dataclasses.fields(self):
            first, *parents, last = field.name.split(".")
            if first == kind:
                inside = found
                for i, parent in enumerate(parents):
                    inside = inside.setdefault(parent, Named(".".join((kind, *parents[: i + 1])), self.structure))
                inside[last] = getattr(self, field.name)
        return found

    return property(read, doc=f"The parameters `{kind}.NAME`, by name.")


for _kind in KINDS.split():
    setattr(Mechanism, _kind, _view(_kind))

Field = tuple[str, bool, str]
"""Of a parameter: its name, whether it must be positive, its unit."""


@functools.lru_cache(maxsize=1000)
def class_of(structure: Structure, fields: tuple[Field, ...]) -> type[Mechanism]:
    """The class of a structure: the same one each time, since programs are kept by class."""
    joints = structure.joints
    coordinates = [pair for joint in joints for pair in zip(joint.names(joint.coordinates), joint.coordinates)]
    speeds = [pair for joint in joints for pair in zip(joint.names(joint.speeds), joint.speeds)]
    units = {name: unit for name, (_, unit) in (*coordinates, *speeds) if unit}
    of_parameters = {name: parameter(positive=positive, unit=unit) for name, positive, unit in fields}
    members: dict[str, Any] = {
        "__module__": __name__,
        "__doc__": f"A mechanism of {len(structure.links)} links and {len(joints)} joints.",
        "__annotations__": dict.fromkeys(of_parameters, Scalar),
        "__init__": Mechanism.__init__,
        "structure": structure,
        "left_out": structure.left_out,
        "coordinates": tuple(name for name, _ in coordinates),
        "speeds": tuple(name for name, _ in speeds if name not in structure.dependent_speeds),
        "dependent_speeds": structure.dependent_speeds,
        "dependent_coordinates": structure.dependent_coordinates,
        "inputs": tuple(actuator.name for actuator in structure.actuators),
        "units": units,
    }
    made: Any = type(Mechanism)(structure.name, (Mechanism,), members | of_parameters)  # pyright: ignore
    return made


@functools.lru_cache(maxsize=1000)
def _equipped(kind: type[Mechanism], outputs: Callable[..., Any], names: tuple[str, ...]) -> type[Mechanism]:
    """A class of mechanisms with outputs, and parameters that these read."""
    members: dict[str, Any] = {
        "__module__": __name__,
        "__doc__": kind.__doc__,
        "__annotations__": dict.fromkeys(names, Scalar),
        "__init__": Mechanism.__init__,
        "__reduce__": _reduced_with_outputs,
        "outputs": outputs,
        "equipment": (kind, outputs, names),
        **{name: parameter() for name in names},
    }
    return type(Mechanism)(kind.__name__, (kind,), members)  # pyright: ignore


def _reduced_with_outputs(self: Any) -> Any:
    kind, outputs, names = type(self).equipment
    own = {name: getattr(self, name) for name in names}
    rest = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name not in own}
    return _restored_with_outputs, (kind(**rest), outputs, own)


def _restored_with_outputs(mechanism: Mechanism, outputs: Callable[..., Any], own: dict[str, Any]) -> Mechanism:
    return mechanism.with_outputs(outputs, own)


def _restored(structure: Structure, fields: tuple[Field, ...], values: dict[str, Any]) -> Mechanism:
    return class_of(structure, fields)(**values)


def _fields(cls: type[Mechanism]) -> tuple[Field, ...]:
    return tuple((name, info.positive, info.unit) for name, info in parameter_info(cls).items())
