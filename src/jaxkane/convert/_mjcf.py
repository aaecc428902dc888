"""MJCF and URDF files as mechanisms of joints. MuJoCo reads and compiles them; nothing of it is needed afterwards."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

from ..joints import Mechanism
from ._mujoco_model import Reader
from ._urdf import for_mujoco, has_friction, mimics, robot_of

Path = str | os.PathLike[str]


def from_mjcf(
    model: Path, *, strict: bool = False, dependent: Sequence[str] | None = None, name: str | None = None
) -> Mechanism:
    """The mechanism of an MJCF file.

        arm = jk.convert.from_mjcf("arm.xml")
        jk.fit.fit(arm, trials, free=["mass.forearm", "damping.elbow"])

    **Arguments:**

    - `model`: a path, or the text of a file, which begins with "<".
    - `strict`: refuse what has no counterpart, instead of leaving it out with a warning.
    - `dependent`: hinges and sliders that are solved for where loops are closed, as of `jaxkane.joints.mechanism`.
    - `name`: of the class; by default the model's.

    **Returns:** a `jaxkane.joints.Mechanism` with the names of the file. `qpos` are its coordinates but for the order
    of the Euler parameters, scalar last here; `qvel` its speeds; `ctrl` its inputs. A dot in a name becomes an
    underscore; an actuator or a site that has the name of something else gets `_input` or `_site` behind its own.
    Masses and inertias are those that MuJoCo compiles, of geoms and meshes too.

    Taken: bodies, hinge, slide, ball and free joints with damping, stiffness, springref, armature and ref; gravity;
    sites; actuators on joints whose force is affine in control, length and velocity; `connect`, `weld` and `joint`
    equalities, as rigid constraints. What is not is listed in `left_out`: contacts, limits, friction, tendons, ...

    **Raises:** `ImportError` without MuJoCo; `ValueError` for a file that MuJoCo does not read, one without a moving
    body, two names that differ by a dot alone, and with `strict` for what would be left out.
    """
    mujoco = _mujoco()
    return Reader(mujoco, _compiled(mujoco, model), name).mechanism(strict, dependent)


def from_urdf(
    model: Path,
    *,
    floating: bool = False,
    strict: bool = False,
    gravity: Any = (0.0, 0.0, -9.81),
    dependent: Sequence[str] | None = None,
    name: str | None = None,
) -> Mechanism:
    """The mechanism of a URDF file; links and joints have its names.

    `floating`: the root link flies, by a free joint named `root`; by default it is part of the ground. A link without
    an `inertial` has no mass, whatever its shapes. `mimic` becomes a coupling, joint damping is taken; the rest, the
    other arguments and the errors are those of `from_mjcf`.
    """
    mujoco = _mujoco()
    text = _text(model)
    couplings = mimics(text)
    compiled = _compiled(mujoco, for_mujoco(text, floating))
    reader = Reader(mujoco, compiled, name or robot_of(text).get("name"))
    reader.gravity = gravity
    reader.left_out += ["friction of joints"] * has_friction(text)
    reader.loops += couplings
    return reader.mechanism(strict, dependent)


def _mujoco() -> Any:
    try:
        import mujoco  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError(
            "Reading MJCF and URDF files needs MuJoCo: `pip install mujoco`, or `pip install 'jaxkane[mujoco]'`."
        ) from error
    return mujoco


def _is_text(model: Path) -> bool:
    return isinstance(model, str) and model.lstrip().startswith("<")


def _text(model: Path) -> str:
    if _is_text(model):
        return str(model)
    with open(model, encoding="utf-8") as file:
        return file.read()


def _compiled(mujoco: Any, model: Path) -> Any:
    if not _is_text(model) and not os.path.exists(model):
        raise FileNotFoundError(f"There is no file {os.fspath(model)!r}. The text of a model begins with '<'.")
    try:
        spec = mujoco.MjSpec.from_string(model) if _is_text(model) else mujoco.MjSpec.from_file(os.fspath(model))
        spec.compiler.fusestatic = False
        return spec.compile()
    except ValueError as error:
        where = "the text" if _is_text(model) else repr(os.fspath(model))
        raise ValueError(f"MuJoCo does not read {where}: {error}") from error
