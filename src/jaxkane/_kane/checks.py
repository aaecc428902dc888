"""Checks of a system: physically impossible masses and inertias, and contradictions between its methods.

Velocities, frames and constraints are compared numerically, at random test points.
"""

from __future__ import annotations

import functools
import operator
import warnings
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._common.lookup import refuse_if
from .._scalarjit.cache import Cache
from .._scalarjit.compat import Tracer, concretely
from .._scalarjit.components import (
    Bool,
    Component,
    Numbers,
    Rows,
    as_vector,
    is_exact,
    is_zero,
    stack,
)
from .._scalarjit.nan import constant
from .._scalarjit.scalar_function import ScalarFunction
from .._system.kinematics import Frame, Point
from .._system.motion import Force, Load, Motion
from .._system.parameters import in_batches
from .._system.system import System
from .arguments import InputArrays, has_multipliers, is_concrete
from .constraint_residuals import configuration_residual, residual_sizes, scales_by_unit, violations
from .description import DescriptionEvaluator, at_random_point, frames_of, structure_of, turning_bodies
from .scaling import least_norm, nearest_root

ROUNDING, MEASURED = 2e-3, 0.05
ROTOR = 1e-12  # share of the largest moment of inertia: if the others are below it, the body is a rotor
ROTATION_ERROR = 1e-3
"""The largest permitted error of [R] [R]^T. Measured and integrated Euler parameters do not have exactly unit norm."""


def check_system(system: System, t: Component, q: Numbers, *, bodies: bool = True) -> None:
    """Raise an exception if a system contradicts itself, or if a body is physically impossible.

    **Arguments:**

    - `system`: the system. Contradictions are checked once for each structure. Traced numbers are replaced by
        their concrete values if these exist (in `jax.grad` without `jit`), otherwise by random numbers.
    - `t`: time [s].
    - `q`: coordinates (n_q,), or None for random coordinates.
    - `bodies`: whether to check the bodies. They are checked only if no number is traced.

    **Raises:** `ValueError` and `TypeError` as `check_description`; `ValueError` as `check_bodies`.
    """
    if in_batches(system):
        return
    system, t, q = constant((system, t, q))
    # Use one type for t: a Python number and an array would be compiled as two programs.
    t = t if isinstance(t, Tracer) else np.asarray(t, jnp.result_type(float) if q is None else q.dtype)
    with concretely(), np.errstate(invalid="ignore", over="ignore"):
        check_description(system, t, q)
        if bodies and q is not None and is_concrete(system, t, q):
            check_bodies(system, t, q)


# -- bodies


@ScalarFunction
def _masses_and_inertias(system: System, t: Component, q: Numbers):
    u = (0.0,) * (len(system.speeds) + len(system.dependent_speeds))
    bodies = DescriptionEvaluator(system).read("bodies", t, tuple(q[i] for i in range(len(system.coordinates))), u)
    return [(jnp.asarray(mass), stack(inertia)) for mass, inertia in bodies]


def check_bodies(system: System, t: Component, q: Numbers) -> None:
    """Raise an exception for physically impossible masses and inertias.

    The largest principal moment of inertia is at most the sum of the other two. An excess of up to 0.2 % is attributed
    to rounding. An excess of up to 5 % is attributed to measurement errors and causes a warning. A larger excess is
    rejected. With `check_inertia = False` in the class, every excess is accepted. A moment about one axis only,
    (0, 0, J), is accepted, too: it belongs to a rotor whose other moments are included in another body.

    **Raises:** `ValueError` with the name of the body.
    """
    bodies = _masses_and_inertias.numpy(system, t, q)
    masses = np.array([mass for mass, _ in bodies], float)  # (b,) [kg]
    inertias = np.array([I for _, I in bodies], float).reshape(-1, 3, 3)  # (b,3,3) [kg m^2]
    # All bodies at once, because a loop over 25 bodies takes 1 ms in each call of a public function.
    for i in np.flatnonzero(~is_possible(masses, inertias.transpose(1, 2, 0), system.check_inertia, ROUNDING)):
        u = (0.0,) * (len(system.speeds) + len(system.dependent_speeds))
        body, at = DescriptionEvaluator(system).motion(t, tuple(q), u).bodies[i], (masses[i], inertias[i])
        message = f"{type(system).__name__}, body {body.name!r}: " + why_no_body(*at, system.check_inertia, ROUNDING)
        if body.about is not None:
            message += f" These are central moments: the inertia was given about the point {body.about.name!r}."
        if why_no_body(*at, system.check_inertia):
            raise ValueError(message)
        warnings.warn(message, UserWarning, stacklevel=4)


def why_no_body(mass: float, I: np.ndarray, check_inertia: bool, accepted: float = MEASURED) -> str:
    """Why this mass and inertia (3, 3) are impossible, see `is_possible`. Return "" if they are possible."""
    if is_possible(mass, I, check_inertia, accepted):
        return ""
    if not mass >= 0:
        return f"the mass is {mass:.6g} kg; it must not be negative."
    if not np.all(np.isfinite(I)):
        return f"the inertia is not finite: {I.tolist()}."
    if np.abs(I - I.T).max() > 1e-6 * np.abs(I).max():
        return f"the inertia matrix is not symmetric: {I.tolist()}."
    moments = ", ".join(f"{x:.6g}" for x in np.linalg.eigvalsh(I))
    if not is_possible(mass, I, False):
        return f"the principal moments of inertia are {moments} kg m^2; none may be negative."
    return (
        f"no body has the principal moments of inertia {moments} kg m^2: the largest exceeds "
        "the sum of the other two (triangle inequality). An excess of up to 5 % causes a warning; a larger excess is "
        "rejected. Correct the inertia, or set `check_inertia = False` in the class of the system."
    )


def is_possible(mass: Numbers, I: Rows | np.ndarray, check_inertia: bool, accepted: float = MEASURED) -> Any:
    """Whether a mass and an inertia are physically possible. Checks of systems, batches and files all use this rule.

    **Arguments:**

    - `mass`: [kg], or (b,) for b bodies.
    - `I`: (3, 3) or (3, 3, b) [kg m^2].
    - `check_inertia`: whether to check the triangle inequality of the principal moments.
    - `accepted`: the accepted excess of the largest moment over the sum of the others, relative to the largest.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = I
    slack = 1e-6 * (abs(xx) + abs(yy) + abs(zz)) + float(jnp.finfo(jnp.result_type(xx, float)).tiny)
    skews = abs(xy - yx), abs(xz - zx), abs(yz - zy)
    possible = (mass >= 0) & (skews[0] <= slack) & (skews[1] <= slack) & (skews[2] <= slack)
    possible &= _is_semidefinite(xx + slack, yy + slack, zz + slack, xy, xz, yz)
    if not check_inertia:
        return possible
    # For moments a <= b <= c, c - a - b > x c if c > trace / (2 - x). Then trace / (2 - x) - I is not semidefinite.
    half, minors = (xx + yy + zz) / (2.0 - accepted) + slack, xx * yy + xx * zz + yy * zz - xy * xy - xz * xz - yz * yz
    is_rotor = minors <= ROTOR * (xx + yy + zz) ** 2
    return possible & (_is_semidefinite(half - xx, half - yy, half - zz, -xy, -xz, -yz) | is_rotor)


def _is_semidefinite(xx: Numbers, yy: Numbers, zz: Numbers, xy: Numbers, xz: Numbers, yz: Numbers) -> Any:
    # Use pivots: LAPACK is slow for the eigenvalues of many small matrices, and solves them in sequence.
    with np.errstate(all="ignore"):
        second = yy - xy * xy / xx
        return (xx > 0) & (second > 0) & (zz - xz * xz / xx - (yz - xy * xz / xx) ** 2 / second > 0)


def bodies_are_possible(system: System, t: Component, q: Numbers) -> Bool:
    """Whether `check_bodies` accepts all bodies of the system. Use this function for members of a batch."""
    return _bodies_are_possible(*constant((system, t, q)))


@ScalarFunction.compile_cheaply
def _bodies_are_possible(system: System, t: Component, q: Numbers) -> Bool:
    bodies = _masses_and_inertias.__wrapped__(system, t, q)
    rows = [(mass, [(x, y, z) for x, y, z in I]) for mass, I in bodies]
    each = (is_possible(mass, I, system.check_inertia) for mass, I in rows)
    return functools.reduce(operator.and_, each, jnp.array(True))


# -- contradictions in a system


Key = tuple[Any, ...]  # number, kind, names ...; the number preserves the order
Quantities = dict[Key, Any]
Quantity = tuple[tuple[str, ...], list[tuple[Component, ...]]]


@ScalarFunction
def consistency_quantities(system: System, t: Component, q: Numbers, u: Numbers, inputs: InputArrays) -> Quantities:
    evaluator = DescriptionEvaluator(system, inputs)
    q, u, like = tuple(q[i] for i in range(len(q))), tuple(u[i] for i in range(len(u))), q
    motion = evaluator.motion(t, q, u)
    loads = evaluator.loads_at(t, q, u, motion)
    twice = sorted({*motion.points, *motion.frames} & {*system.auxiliary_speeds})
    refuse_if(
        twice,
        f"{evaluator.name}: {', '.join(twice)} is the name of an auxiliary speed and of a point or a frame. "
        "constraint_forces returns a force by name for both. Rename one of them.",
    )
    of_frames = [(frame, [*frame._to_child, frame._spin]) for frame in frames_of(motion, loads)]
    quantities: list[Quantity] = [
        *((("rate", name), [(x,)]) for name, x in zip(system.coordinates, evaluator.rates(t, q, u), strict=True)),
        *((("residual", str(i)), [(x,)]) for i, x in enumerate(evaluator.residuals(t, q, u))),
        *((("constraint", str(i)), [(x,)]) for i, x in enumerate(evaluator.configuration(t, q))),
        *_of_bodies(motion),
        *_of_points(motion, loads),
        *(
            (("frame", frame.name, frame.parent.name), rows)  # type: ignore[union-attr]
            for frame, rows in of_frames
            if not all(is_exact(x) for row in rows for x in row) or any(frame._spin)
        ),
    ]
    return {(i, *key): stack(rows).astype(like.dtype) for i, (key, rows) in enumerate(quantities)}


def _of_bodies(motion: Motion) -> Iterator[Quantity]:
    for body in motion.bodies:
        center = body.center
        yield ("velocity", f"the velocity of {body.name!r}"), [center.velocity.components]
        yield ("velocity", f"the angular velocity of {body.name!r}"), [body.angular_velocity.components]
        if body.about is not None:
            r = body.about.position_from(center)
            carried = center.velocity + body.frame.angular_velocity.cross(r)
            velocities = [x.components_in(body.frame) for x in (body.about.velocity, carried)]
            yield ("about", body.name, body.frame.name), velocities
        if center.has_position and not all(_has_consistent_velocity(point) for point in center.chain()):
            rows = [x.components_in(motion.N) for x in (center.position, center.velocity)]
            yield ("center", f"the mass centre of {body.name!r}"), rows


def _of_points(motion: Motion, loads: Iterable[Load]) -> Iterator[Quantity]:
    """Named points, points of loads, and the points from which these points and the mass centres were created."""
    done: set[Point] = set()
    centers = {body.center: f"the mass centre of {body.name!r}" for body in motion.bodies}
    named = {point: f"the point {name!r}" for name, point in motion.points.items()}
    acted_on = {load.point: f"the point {load.point.name!r} of a load" for load in loads if isinstance(load, Force)}
    words = {**acted_on, **named, **centers}
    for point in words:
        if point not in centers:
            yield ("velocity", f"the velocity of {words[point]}"), [point.velocity.components]
        for link in point.chain():
            if link in done or link._relative_motion is None or (link._base is None and link in centers):
                continue
            done.add(link)
            frame, velocity = link._relative_motion
            rows = [link._offset.components_in(frame), velocity.components_in(frame)]  # type: ignore[union-attr]
            if not all(is_exact(x) for x in rows[0]) or not all(is_zero(x) for x in rows[1]):
                # A point that `loads` creates from a motion without speeds is at rest too, but is not a contact point.
                at_rest = link._base is None and frame is motion.N
                yield ("contact" if at_rest else "place", words.get(link, f"the point {link.name!r}"), frame.name), rows


def _has_consistent_velocity(point: Point) -> bool:
    """Whether the velocity of a point is the rate of its position, if its base and its relative motion are correct."""
    if point._base is not None:
        return point._relative_motion is not None
    known = (*point.velocity.components, *(point._offset.components if point._offset is not None else ()))
    return all(is_zero(x) for x in known)  # the origin


_CHECKED = Cache()  # structures
_SIZES = (-1.0, 1e-2, -20.0, 1e3, -1e3)  # multiples of test speeds of order 1


def check_description(system: System, t: Component, q: Numbers) -> None:
    """Raise an exception if a system contradicts itself.

    Most checks run once for each class and structure. Checks that depend on values run in every call, if no number is
    traced.

    **Arguments:**

    - `system`: the system. Its numbers may be traced.
    - `t`: time [s].
    - `q`: coordinates (n_q,), or None if they are unknown.

    **Raises:** `TypeError` if a method returns a wrong type or uses the value of a traced number. `ValueError` for

    - velocities or residuals that are not affine in the speeds,
    - frames and points whose velocities are not the rates of their orientations and positions,
    - frames whose orientation is not a rotation,
    - configuration constraints that the velocities violate,
    - a body whose inertia is not constant in its frame,
    - one name for two forces.
    """
    if q is not None and not isinstance(q, Tracer) and not np.all(np.isfinite(q)):
        return
    structure = structure_of(system)
    # The methods of a tree of joints agree by construction. A class that inherits from it may change them.
    if not vars(type(system)).get("is_tree_of_joints") and not _CHECKED.known(structure, False):
        rng = np.random.default_rng(0)
        _CHECKED.keep(structure, _Consistency(*at_random_point((system, t, q), rng), rng=rng).check())
    if q is not None and is_concrete(system, t, q):
        _check_numbers(system, t, q)


@ScalarFunction
def _rotations_and_residuals(system: System, t: Component, q: Numbers, u: Numbers) -> tuple[Any, Any, Any]:
    """Orientations of frames in their parents (f, 3, 3), and the velocity residuals (k,).

    Between them: angular velocities and inertias (b, 4, 3) of the bodies that rotate in their frames.
    """
    evaluator, like = DescriptionEvaluator(system), q
    q, u = tuple(q[i] for i in range(len(q))), tuple(u[i] for i in range(len(u)))
    orientations, spins = evaluator.read("orientations", t, q, u)
    orientations, spins = ([stack(x).astype(like.dtype) for x in xs] for xs in (orientations, spins))
    return orientations, spins, as_vector(evaluator.residuals(t, q, u), like)


def _check_numbers(system: System, t: Component, q: Numbers) -> None:
    """Checks that depend on values.

    Orientations of frames must be rotations. A body that rotates in its frame must be symmetric about the axis.
    """

    def read(u: np.ndarray) -> tuple[Any, Any, Any]:
        return _rotations_and_residuals.numpy(system, t, q, u.astype(q.dtype))

    u = np.linspace(0.7, 1.3, len(system.speeds) + len(system.dependent_speeds))
    orientations, spins, _ = read(u)
    R, x = np.array(orientations).reshape(-1, 3, 3), np.array(spins).reshape(-1, 4, 3)
    wrong = np.flatnonzero(_rotation_error(R) > ROTATION_ERROR)  # NaN is reported by another check
    if not wrong.size and np.all(_is_symmetric(x)):
        return
    name, motion = type(system).__name__, DescriptionEvaluator(system).motion(t, tuple(q), tuple(u))
    if wrong.size:
        raise ValueError(f"{name}: " + _no_rotation(frames_of(motion)[wrong[0]], orientations[wrong[0]]))
    _, spins, _ = read(_on_residuals(lambda u: read(u)[2], u))
    for body, x in zip(turning_bodies(motion), spins, strict=True):
        if not _is_symmetric(x):
            raise ValueError(
                f"{name}: the body {body.name!r} rotates in its frame {body.frame.name!r}, but its inertia is not "
                "symmetric about that axis, so it is not constant there. Pass a frame that rotates with the body."
            )


def _rotation_error(R: np.ndarray) -> np.ndarray:
    """The largest entry of R R^T - 1 of each matrix R (..., 3, 3)."""
    return np.max(np.abs(R @ R.swapaxes(-1, -2) - np.eye(3)), axis=(-1, -2), initial=0.0)


def _no_rotation(frame: Frame, R: np.ndarray) -> str:
    square = R @ R.T
    stretches = np.max(np.abs(square - np.eye(3) * square[0, 0])) <= 1e-6 * square[0, 0]
    cause = (
        f"its Euler parameters have the norm {np.trace(square / 3) ** 0.25:.6g} instead of 1"
        if stretches
        else f"[R] [R]^T differs from 1 by {_rotation_error(R):.3g}"
    )
    return (
        f"the orientation of the frame {frame.name!r} in {frame.parent.name!r} "  # type: ignore[union-attr]
        f"is not a rotation: {cause} at these coordinates and parameters. Pass Euler parameters of unit norm. "
        "jaxkane.assemble normalizes them if rotations.euler_parameter_norm is one of the configuration constraints."
    )


def _is_symmetric(x: np.ndarray) -> np.ndarray:
    """Whether each inertia is constant in a frame in which its body rotates. Also True if it is not finite.

    **Arguments:**

    - `x`: the angular velocity relative to the frame and, below it, the inertia (..., 4, 3).
    """
    s, I = x[..., :1, :], x[..., 1:, :]
    turned = np.cross(s, I.swapaxes(-1, -2)).swapaxes(-1, -2)  # [s x] I
    error = np.max(np.abs(turned + turned.swapaxes(-1, -2)), axis=(-1, -2), initial=0.0)
    size = np.max(np.abs(I), axis=(-1, -2), initial=0.0) * np.max(np.abs(s), axis=(-1, -2), initial=1.0)
    return ~(error > 1e-6 * size)


def _on_residuals(residual: Callable[[np.ndarray], np.ndarray], u: np.ndarray) -> np.ndarray:
    """Nearby speeds for which the velocity residuals are zero, or NaN if there are none."""
    c, c0 = residual(u), residual(0.0 * u)
    if not c.size:
        return u
    C = np.array([residual(e) - c0 for e in np.eye(len(u))]).T  # (k,n)
    if np.all(np.isfinite(C)) and np.all(np.isfinite(c)):
        nearest = u - least_norm(C, c)
        # A row that should be zero but is a rounding error gives speeds of 1e15: a bicycle that leans by 0.5 rad with a
        # straight fork.
        if np.max(np.abs(nearest)) > np.finfo(u.dtype).eps ** -0.7 * max(1.0, np.abs(u).max()):
            return np.full_like(u, np.nan)
        if not np.max(np.abs(residual(nearest))) > 1e-7 * max(1.0, np.abs(C).max(), np.abs(c).max()):
            return nearest
    return np.full_like(u, np.nan)


class _Consistency:
    """The quantities of a system as functions of numbers, and the relations between them that are checked."""

    def __init__(self, system: System, t: Component, q: np.ndarray, rng: np.random.Generator):
        self.system, self.t, self.q, self.rng = system, np.asarray(t, q.dtype), q, rng
        self.name = type(system).__name__
        self.speeds = (*system.speeds, *system.dependent_speeds)
        self.inputs = {name: np.asarray(0.7, q.dtype) for name in (*system.inputs, *system.states)}
        self.tolerance = float(jnp.finfo(q.dtype).eps) ** 0.5
        self.has_constraints = False
        self.smallest = 1.0  # [m/s] velocities below this are compared as if they had this size

    def check(self) -> bool:
        """Raise an exception for a contradiction. **Returns:** whether a check was possible with finite numbers."""
        self._check_affine(self.q)
        judged = self._check_motion(self.q)
        beside = self.q + self.rng.uniform(-0.1, 0.1, self.q.shape)
        self.t = self.t + np.asarray(0.3, self.t.dtype)  # prescribed motions often start at rest
        return self._check_motion(beside.astype(self.q.dtype)) or judged

    def _read(self, q: np.ndarray, u: np.ndarray) -> Quantities:
        return consistency_quantities.numpy(self.system, self.t, q, u.astype(q.dtype), self.inputs)

    def _rates(self, q: np.ndarray, u: np.ndarray, quantities: Quantities) -> Quantities:
        q_dot = np.array([x.item() for x in _of_kind(quantities, "rate").values()], q.dtype)
        at = self.system, self.t, q, u.astype(q.dtype), self.inputs
        along = None, np.ones((1,), q.dtype), q_dot[:, None], None, None
        return jax.tree.map(lambda x: x[..., 0], consistency_quantities.numpy_jvp(at, along))

    def _random_speeds(self) -> np.ndarray:
        n = len(self.speeds)
        return self.rng.uniform(0.5, 1.5, n) * self.rng.choice((-1.0, 1.0), n)

    def _set_smallest(self, quantities: Quantities) -> None:
        """Set `smallest`, the size that is assumed for smaller velocities in comparisons.

        Test speeds are of order 1. In a mechanism of nanometres, a velocity that is wrong by a factor of 2 differs by
        only 1e-9 m/s.
        """
        largest = max(
            [np.max(np.abs(x), initial=0.0) for key, x in quantities.items() if _is_translation(key)], default=0
        )
        is_rounding = not largest > 1e4 * float(jnp.finfo(self.q.dtype).eps)  # e.g. a gyroscope whose centre is at rest
        self.smallest = 1.0 if is_rounding else min(1.0, float(largest))

    def _differs(self, difference: np.ndarray, *sizes: Any, smallest: float = 1.0) -> bool:
        size = max([smallest, *(np.max(np.abs(x), initial=0.0) for x in sizes)])
        difference = np.max(np.abs(difference), initial=0.0)
        return bool(np.isfinite(difference) and difference > self.tolerance * size)

    # Velocities are affine in the speeds.

    def _check_affine(self, q: np.ndarray) -> None:
        a, b = self._random_speeds(), self._random_speeds()
        zero, at_a, at_b, at_both = (self._read(q, u) for u in (0.0 * a, a, b, a + b))
        self.has_constraints = bool(_of_kind(zero, "constraint"))
        self._set_smallest(at_a)
        curved = self._curved_along(q, a, zero)
        for key, z in zero.items():
            x, y, both = at_a[key], at_b[key], at_both[key]
            if key in curved or self._differs(both - x - y + z, both, x, y, z, smallest=self._smallest(key)):
                along = zip(self.speeds, np.eye(len(self.speeds)), strict=True)
                names = [name for name, direction in along if key in self._curved_along(q, direction, zero)]
                which = f"in {', '.join(names)}" if names else "in the speeds: it contains products of two speeds"
                raise ValueError(
                    f"{self.name}: {_in_words(key)} is not affine {which}. Kane's method needs velocities that are "
                    "linear in the speeds, plus a term that may depend on time and coordinates. Remove squares, abs() "
                    "and maximum() of speeds."
                )

    def _curved_along(self, q: np.ndarray, direction: np.ndarray, zero: Quantities) -> set[Any]:
        """The quantities that are not affine along a direction of the speeds. `zero`: their values at rest."""
        one, scaled = self._read(q, direction), {s: self._read(q, s * direction) for s in _SIZES}
        each = [(key, z, one[key], s, at[key]) for key, z in zero.items() for s, at in scaled.items()]
        differs = self._differs
        return {
            key for key, z, x, s, f in each if differs(f - z - s * (x - z), f, s * x, z, smallest=self._smallest(key))
        }

    def _smallest(self, key: Key) -> float:
        return self.smallest if _is_translation(key) else 1.0

    # Velocities are the rates of positions and orientations.

    def _check_motion(self, q: np.ndarray) -> bool:
        q, start = self._on_constraints(q), self._random_speeds()

        def residual(u: np.ndarray) -> np.ndarray:
            return np.array([x.item() for x in _of_kind(self._read(q, u), "residual").values()])

        u = _on_residuals(residual, start)
        quantities = self._read(q, u)
        judged = all(np.all(np.isfinite(x)) for x in quantities.values())
        if not judged or any(_rotation_error(x[:3]) > self.tolerance for x in _of_kind(quantities, "frame").values()):
            return False  # the coordinates have a relation that no constraint states: no check at nearby states
        largest_rate = max([0.0, *(np.max(np.abs(x)) for x in _of_kind(quantities, "rate").values())])
        if largest_rate * self.tolerance > np.max(np.abs(u), initial=1.0):
            return False  # gimbal lock: rates of 1e16 rad/s cancel except for rounding errors
        self._set_smallest(quantities)
        rates = self._rates(q, u, quantities)
        for key, x in quantities.items():
            self._check_quantity(key, x, rates[key])
        constraints = _of_kind(rates, "constraint")
        if constraints and not has_multipliers(self.system):
            # The sizes of the rates, from speeds that violate the velocity residuals.
            sizes = self._rates(q, start, self._read(q, start))
            # Nearly dependent residuals are satisfied to 3e-8 only, and so are the rates of the constraints.
            left = 10 / self.tolerance * np.max(np.abs(residual(u)), initial=0.0)
            for key, rate in constraints.items():
                self._check_constraint(key, rate, max(np.max(np.abs(sizes[key]), initial=0.0), left))
        return True

    def _on_constraints(self, q: np.ndarray) -> np.ndarray:
        """The nearest coordinates that satisfy the configuration constraints, or NaN if there are none nearby."""
        if not self.has_constraints:
            return q
        sizes, weights = residual_sizes(self.system, self.t, q)[0], scales_by_unit(self.system, self.t, q)
        sizes, along = np.where(sizes > 0, sizes, 1.0), (None, None, np.diag(weights))

        def scaled(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            h, G = configuration_residual.numpy(self.system, self.t, q), configuration_residual.numpy_jvp
            return h / sizes, G((self.system, self.t, q), along) / sizes[:, None]

        q = nearest_root(scaled, q, weights)
        violation = np.max(violations(self.system, self.t, q)[0], initial=0.0)
        return q if violation <= 0.1 * self.tolerance else np.full_like(q, np.nan)

    def _check_quantity(self, key: Key, value: np.ndarray, rate: np.ndarray) -> None:
        _, kind, part, *parent = key
        if kind == "frame":
            turning = rate[:3] @ value[:3].T  # -[omega x], for [R] from the parent's components to the frame's
            by_orientation = np.array([turning[1, 2], turning[2, 0], turning[0, 1]])
            relative_to = f"components in {part!r}, relative to {parent[0]!r}"
            self._compare(f"the frame {part!r} turns", "rad/s", by_orientation, value[3], relative_to)
        elif kind == "center":
            self._compare(f"{part} moves", "m/s", rate[0], value[1], "components in N")
        elif kind == "place" or (kind == "contact" and self._differs(value[1], smallest=self.smallest)):
            # A contact point at rest may be the point of the ground, which is a different one at every instant.
            relative_to = f"as seen in {parent[0]!r} from the point it was made from"
            self._compare(f"{part} moves", "m/s", rate[0], value[1], relative_to)
        elif kind == "about" and self._differs(value[0] - value[1], value[1], smallest=self.smallest):
            raise ValueError(
                f"{self.name}: the inertia of the body {part!r} is given about a point that moves in its frame "
                f"{parent[0]!r}, so it is not constant there. Pass it about a point of the body, or about the mass "
                "centre."
            )

    def _compare(self, what: str, unit: str, by_position: np.ndarray, stated: np.ndarray, relative_to: str) -> None:
        if self._differs(by_position - stated, stated, smallest=self.smallest if unit == "m/s" else 1.0):
            found, expected = ("(" + ", ".join(f"{a:.4g}" for a in x) + ")" for x in (by_position, stated))
            raise ValueError(
                f"{self.name}: {what} with {found} {unit} by the rates of its coordinates, but with "
                f"{expected} {unit} by its description ({relative_to}, at a random test point). Check three causes: "
                "a rate of a frame or a point contradicts q_dot; a point is declared fixed in a frame in which it "
                "moves; `loads` calls self.motion(t, q, ...) with other speeds than its own. For the point of a wheel "
                "that is in contact at this instant, write `center.fixed(r, wheel_frame)`."
            )

    def _check_constraint(self, key: Key, rate: np.ndarray, size: np.ndarray) -> None:
        if self._differs(rate, size, smallest=self.smallest):
            raise ValueError(
                f"{self.name}: the configuration constraint {key[2]} (counted from 0) changes at a rate of "
                f"{rate.item():.4g} 1/s while all velocity residuals are zero, so they or q_dot contradict it. "
                "With as many residuals as dependent speeds, the residuals must imply the constraint. Omit the "
                "residual that is its rate: the library then derives it."
            )


def _of_kind(quantities: Quantities, kind: str) -> Quantities:
    return {key: x for key, x in quantities.items() if key[1] == kind}


def _is_translation(key: tuple[Any, ...]) -> bool:
    return key[1] in ("center", "place", "contact", "about") or (key[1] == "velocity" and "angular" not in key[2])


def _in_words(key: tuple[Any, ...]) -> str:
    words = {
        "rate": "the rate of the coordinate {0!r}",
        "residual": "the velocity residual {0}",
        "constraint": "the configuration constraint {0}",
        "frame": "the angular velocity of the frame {0!r}",
        "place": "the velocity of {0}",
        "contact": "the velocity of {0}",
        "center": "the velocity of {0}",
        "about": "the velocity of the point about which the inertia of {0!r} is given",
    }
    return words.get(key[1], "{0}").format(key[2])
