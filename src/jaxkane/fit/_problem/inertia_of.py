"""The `Inertia` of a body by its name, from how its description reads parameters. Knows bodies and no dynamics."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..._common.lookup import not_there
from ..._description.parameters import leaf_name
from ..._description.system import System
from ..._method.body_parts import origin_of
from ..._method.reading import Reading
from ..._scalars.versions import compiled
from .free import Inertia

_NAMES = ("m", "cx", "cy", "cz", "Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz")


def inertia_of(system: System, body: str, **more: Any) -> Inertia:
    """The `Inertia` of a body by its name, for `free` of a fit: which parameters its description takes for it.

        fit(arm, trials, free=(inertia_of(arm, "forearm"), "damping.elbow"))

    Mass and the place of its centre are in it where they are parameters of their own, and no others move with them.

    **Arguments:** `system`; `body`: its name, as in `motion["forearm"]`; `more`: `fixed` and `prior` of `Inertia`.

    **Raises:** `KeyError` for a name that is no body's; `ValueError` for moments of inertia that are no parameters of
    their own, as those of a rod by its mass and length, or of a body in a plane, which has one: free these by name.
    """
    names = _bodies(system)
    if body not in names:
        raise not_there(body, names, f"{type(system).__name__}, among its bodies with a mass and a frame")
    with_path, _ = jax.tree_util.tree_flatten_with_path(system)
    values, slopes = _values_and_slopes(system, names.index(body))
    owners = [_owner(values[i], slopes, i, with_path) for i in range(10)]
    found = [None if owner is None or owner[1] else owner[0] for owner in owners]
    kept: dict[str, Any] = {"mass": found[0], "center": tuple(found[1:4])}
    matrices = {owner[0] if owner and owner[1] == (3, 3) else "" for owner in owners[4:]}
    if len(matrices) == 1 and "" not in matrices:
        return Inertia(matrix=matrices.pop(), **kept, **more)
    missing = [name for name, owner in zip(_NAMES[4:7], found[4:7], strict=True) if owner is None]
    lost = [name for i, name in enumerate(_NAMES) if i > 6 and found[i] is None and values[i] != 0.0]
    if missing or lost:
        raise ValueError(
            f"{type(system).__name__}: {', '.join(missing + lost)} of {body!r} are no parameters of their own, each of "
            "one component, so that they cannot move as those of a body. Free what they follow from by name."
        )
    return Inertia(moments=tuple(found[4:7]), products=tuple(found[7:]), **kept, **more)  # type: ignore[arg-type]


def _numbers(system: System) -> list[tuple[str, Any]]:
    """By body: its mass, the last step to its centre, and its central inertia (10,)."""
    zero = jnp.zeros((), jnp.result_type(float))
    n_u = len(system.speeds) + len(system.dependent_speeds)
    q = tuple(zero + 0.3 for _ in system.coordinates)
    motion = Reading(system).motion(zero + 0.2, q, (zero,) * n_u)
    found = []
    for body in motion.bodies:
        if body.is_particle:
            continue
        step = body.center._offset if origin_of(body)[1] else None
        r = (0.0, 0.0, 0.0) if step is None else step.components_in(body.frame)
        I = body.inertia
        row = [body.mass, *r, I[0][0], I[1][1], I[2][2], I[0][1], I[0][2], I[1][2]]
        found.append((body.name, jnp.stack([jnp.asarray(x, zero.dtype) for x in row])))
    return found


def _bodies(system: System) -> list[str]:
    names: list[str] = []
    jax.eval_shape(lambda s: names.extend(name for name, _ in _numbers(s)), system)
    return names


@compiled
def _all_slopes(system):
    read = lambda s: jnp.stack([row for _, row in _numbers(s)])  # noqa: E731
    return read(system), jax.jacfwd(read)(system)


def _values_and_slopes(system: System, i: int) -> tuple[np.ndarray, list[np.ndarray]]:
    values, slopes = jax.device_get(_all_slopes(system))
    return np.asarray(values[i]), [np.asarray(x)[i] for x in jax.tree.leaves(slopes)]


def _owner(value: float, slopes: list[np.ndarray], i: int, with_path: Any) -> tuple[str, tuple[int, ...]] | None:
    """The one parameter that this number is, or is an entry of, and the shape of that."""
    moved = [(k, place) for k, slope in enumerate(slopes) for place in np.flatnonzero(slope[i])]
    if len(moved) != 1:
        return None
    k, place = moved[0]
    path, leaf = with_path[k]
    also = [row for row in range(10) if row != i and slopes[k][row].ravel()[place]]
    is_wheel = all(row in (4, 5, 6) for row in (i, *also))
    if slopes[k][i].ravel()[place] != 1.0 or float(np.ravel(leaf)[place]) != value or (also and not is_wheel):
        return None
    return leaf_name(path), np.shape(leaf)
