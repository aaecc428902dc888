"""Checks of a description: masses and inertias that no body can have, and statements that contradict each other.

Whether velocities, frames and constraints contradict each other is judged by numbers, at random test points.
"""

from __future__ import annotations

import functools
import operator
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._scalarjit.cache_key import Cache
from .._scalarjit.compat import Tracer, concretely
from .._scalarjit.components import Component, Triple, as_vector, cross, dot, is_exact, mul, stack, sub, total
from .._scalarjit.function import ScalarFunction
from .._system.kinematics import Frame, Point
from .._system.motion import Force, Load, Motion
from .._system.parameters import in_batches
from .._system.system import System
from .arguments import is_concrete
from .constraints import configuration_residual
from .kanes_method import DescriptionEvaluator, at_random_point, frames_of, structure_of, turning_bodies

ROUNDING, MEASURED = 2e-3, 0.05
ROTATION_ERROR = 1e-3
"""The largest error of [R] [R]^T of a frame: measured and integrated Euler parameters are not of unit norm exactly."""


def check_system(system: System, t: Any, q: Any, *, bodies: bool = True) -> None:
    """Refuse a description that contradicts itself, once for each structure, and `bodies` that cannot be.

    What is traced is replaced by its value where it has one (in `jax.grad` alone), else by random numbers, as are
    coordinates that are None; bodies are checked where all numbers are known.

    **Raises:** `ValueError` as `check_description`; for a negative mass, and an inertia that no body can have, as
    `check_bodies` says.
    """
    if in_batches(system):
        return
    system, t, q = jax.tree.map(_value, (system, t, q))
    # Always of one type: a Python number and an array would be two programs.
    t = t if isinstance(t, Tracer) else np.asarray(t, jnp.result_type(float) if q is None else q.dtype)
    with concretely(), np.errstate(invalid="ignore", over="ignore"):
        check_description(system, t, q)
        if bodies and q is not None and is_concrete(system, t, q):
            check_bodies(system, t, q)


def _value(x: Any) -> Any:
    # `stop_gradient` of a number that is being differentiated is the number; of one that is traced it is traced.
    return jax.lax.stop_gradient(x) if isinstance(x, Tracer) else x


# -- bodies


@ScalarFunction
def _masses_and_inertias(system: System, t: Any, q: Any):
    u = (0.0,) * (len(system.speeds) + len(system.dependent_speeds))
    bodies = DescriptionEvaluator(system).read("bodies", t, tuple(q[i] for i in range(len(system.coordinates))), u)
    return [(jnp.asarray(mass), stack(inertia)) for mass, inertia in bodies]


def check_bodies(system: System, t: Any, q: Any) -> None:
    """Refuse masses and inertias that no body can have.

    The largest principal moment of inertia is at most the sum of the other two. By up to 0.2 % more it is taken for
    rounding, by up to 5 % for measured and warned about, beyond that refused, unless the class has
    `check_inertia = False`. A moment about one axis alone, (0, 0, J), is a rotor's: the other two are elsewhere.
    """
    for i, (mass, I) in enumerate(_masses_and_inertias.numpy(system, t, q)):
        mass, I = float(mass), np.asarray(I, dtype=float)  # [kg], (3,3) [kg m^2]
        fault = _fault(mass, I) or (_excess_in_words(I) if system.check_inertia else "")
        if fault:
            u = (0.0,) * (len(system.speeds) + len(system.dependent_speeds))
            body = DescriptionEvaluator(system).motion(t, tuple(q), u).bodies[i]
            message = f"{type(system).__name__}, body {body.name!r}: {fault}"
            if why_no_body(mass, I, system.check_inertia):
                raise ValueError(message)
            warnings.warn(message, UserWarning, stacklevel=4)


def why_no_body(mass: float, I: np.ndarray, check_inertia: bool) -> str:
    """Why no body has this mass and inertia (3, 3), even as measured; "" where one can."""
    return _fault(mass, I) or (_excess_in_words(I) if check_inertia and _excess(I) > MEASURED else "")


def _fault(mass: float, I: np.ndarray) -> str:
    """What is wrong with a body, whatever the accuracy of its numbers."""
    slack = 1e-6 * max(np.abs(I).max(), 1e-300)
    if not mass >= 0:
        return f"the mass is {mass:.6g} kg; it must not be negative."
    if not np.all(np.isfinite(I)):
        return f"the inertia is not finite: {I.tolist()}."
    if np.abs(I - I.T).max() > slack:
        return f"the inertia matrix is not symmetric: {I.tolist()}."
    moments = np.linalg.eigvalsh(I)
    if moments[0] < -slack:
        return f"the principal moments of inertia are {_listed(moments)} kg m^2; none may be negative."
    return ""


def _excess_in_words(I: np.ndarray) -> str:
    if _excess(I) <= ROUNDING:
        return ""
    return (
        f"no body has the principal moments of inertia {_listed(np.linalg.eigvalsh(I))} kg m^2: the largest exceeds "
        "the sum of the other two (triangle inequality). Measured values may do so by a few per cent; beyond 5 % they "
        "are refused. A class that is to have them all the same says `check_inertia = False`."
    )


def _excess(I: np.ndarray) -> float:
    """By how much of itself the largest principal moment exceeds the sum of the other two; 0 for a rotor's."""
    a, b, c = np.linalg.eigvalsh(I)
    return 0.0 if b <= 1e-12 * c else float((c - a - b) / c)


def _listed(moments: np.ndarray) -> str:
    return ", ".join(f"{x:.6g}" for x in moments)


def bodies_are_possible(system: System, t: Any, q: Any) -> Any:
    """Whether the system has no body that `check_bodies` refuses: for members of a batch."""
    return _bodies_are_possible(*jax.tree.map(_value, (system, t, q)))


@ScalarFunction.once
def _bodies_are_possible(system: System, t: Any, q: Any) -> Any:
    bodies = _masses_and_inertias.__wrapped__(system, t, q)
    rows = [(mass, [(x, y, z) for x, y, z in I]) for mass, I in bodies]
    return functools.reduce(operator.and_, [_is_possible(mass, I, system.check_inertia) for mass, I in rows])


Matrix = Sequence[Triple]


def _is_possible(mass: Any, I: Matrix, check_inertia: bool) -> Any:
    # c - a - b > 5 % of c, where c > trace / 1.95: and no c is, where trace / 1.95 - I has no eigenvalue below zero.
    skew = _largest([sub(I[i][j], I[j][i]) for i, j in _PAIRS])
    possible = (mass >= 0) & (skew <= 1e-6 * _size(I)) & _is_semidefinite(I)
    if check_inertia:
        trace = total(I[i][i] for i in range(3))
        half = mul(1.0 / (2.0 - MEASURED), trace)
        (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = I
        xx, yy, zz = sub(half, xx), sub(half, yy), sub(half, zz)
        rest = [(xx, sub(0.0, xy), sub(0.0, xz)), (sub(0.0, yx), yy, sub(0.0, yz)), (sub(0.0, zx), sub(0.0, zy), zz)]
        is_rotor = total(_minors(I)) <= mul(1e-12, mul(trace, trace))
        possible &= _is_semidefinite(rest) | is_rotor
    return possible


_PAIRS = ((0, 1), (0, 2), (1, 2))


def _is_semidefinite(A: Matrix) -> Any:
    # By principal minors: LAPACK's eigenvalues of many small matrices would be slow, and wait for each other.
    size = _size(A)
    minors = [
        *((A[i][i], size) for i in range(3)),
        *((x, size**2) for x in _minors(A)),
        (dot(A[0], cross(A[1], A[2])), size**3),
    ]
    return functools.reduce(operator.and_, [x >= -1e-6 * scale for x, scale in minors])


def _size(A: Matrix) -> Any:
    return _largest([x for row in A for x in row])


def _largest(xs: Sequence[Component]) -> Any:
    return functools.reduce(jax.lax.max, map(jnp.abs, xs))


def _minors(A: Matrix) -> list[Any]:
    return [sub(mul(A[i][i], A[j][j]), mul(A[i][j], A[j][i])) for i, j in _PAIRS]


# -- a description that contradicts itself


Quantities = dict[tuple[Any, ...], Any]  # (number, kind, names ...) -> numbers; the number keeps the order
Quantity = tuple[tuple[str, ...], list[tuple[Component, ...]]]


@ScalarFunction
def consistency_quantities(system: System, t: Any, q: Any, u: Any, inputs: Any) -> Quantities:
    evaluator = DescriptionEvaluator(system, inputs)
    q, u, like = tuple(q[i] for i in range(len(q))), tuple(u[i] for i in range(len(u))), q
    motion = evaluator.motion(t, q, u)
    loads = evaluator.loads_at(t, q, u, motion)
    twice = sorted({*motion.points, *motion.frames} & {*system.auxiliary_speeds})
    if twice:
        raise ValueError(
            f"{evaluator.name}: {', '.join(twice)} is the name of an auxiliary speed and of a point or a frame: "
            "constraint_forces gives both a force by that name."
        )
    quantities = [
        *_of_speeds(evaluator, t, q, u),
        *_of_bodies(motion),
        *_of_points(motion, loads),
        *_of_frames(motion, loads),
    ]
    return {(i, *key): stack(rows).astype(like.dtype) for i, (key, rows) in enumerate(quantities)}


def _of_speeds(evaluator: DescriptionEvaluator, t: Any, q: Any, u: Any) -> Iterator[Quantity]:
    for name, rate in zip(evaluator.system.coordinates, evaluator.rates(t, q, u), strict=True):
        yield ("rate", name), [(rate,)]
    for i, residual in enumerate(evaluator.residuals(t, q, u)):
        yield ("residual", str(i)), [(residual,)]
    for i, h in enumerate(evaluator.configuration(t, q)):
        yield ("constraint", str(i)), [(h,)]


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
    """Named points, what loads act on, and what these and the bodies were made from."""
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
            if not all(is_exact(x) for x in rows[0]) or not all(is_exact(x) and x == 0.0 for x in rows[1]):
                # A point that `loads` made from a motion without speeds is at rest too, and is no point of contact.
                at_rest = link._base is None and frame is motion.N
                yield ("contact" if at_rest else "place", words.get(link, f"the point {link.name!r}"), frame.name), rows


def _of_frames(motion: Motion, loads: Iterable[Load]) -> Iterator[Quantity]:
    for frame in frames_of(motion, loads):
        rows = [*frame._to_child, frame._spin]
        if not all(is_exact(x) for row in rows for x in row) or any(frame._spin):
            yield ("frame", frame.name, frame.parent.name), rows  # type: ignore[union-attr]


def _has_consistent_velocity(point: Point) -> bool:
    """Whether a point moves as its place does, if what it was made from does and its relative motion is right."""
    if point._base is not None:
        return point._relative_motion is not None
    known = (*point.velocity.components, *(point._offset.components if point._offset is not None else ()))
    return all(is_exact(x) and x == 0.0 for x in known)  # the origin


_CHECKED = Cache()  # structures
_SIZES = (-1.0, 1e-2, -20.0, 1e3, -1e3)  # multiples of test speeds of order 1


def check_description(system: System, t: Any, q: Any) -> None:
    """Refuse a description that contradicts itself, once for each class and structure; by numbers, where they are all
    known, at every call.

    **Arguments:** the system, time [s] and coordinates (n_q,), any of whose numbers may be traced; coordinates may be
    None, where none are known.

    **Raises:** `ValueError` for velocities or residuals that are not affine in the speeds, frames and points that do
    not move as their coordinates' rates say, frames that are not turned by a rotation, configuration constraints that
    the motion violates, a body whose inertia is not constant in its frame, a name that stands for two forces.
    `TypeError` for methods that return something else than they should, or ask for the value of what is traced.
    """
    if q is not None and not isinstance(q, Tracer) and not np.all(np.isfinite(q)):
        return
    structure = structure_of(system)
    if not _CHECKED.known(structure, False):
        rng = np.random.default_rng(0)
        _CHECKED.keep(structure, _Consistency(*at_random_point((system, t, q), rng), rng=rng).check())
    if q is not None and is_concrete(system, t, q):
        _check_numbers(system, t, q)


@ScalarFunction
def _rotations_and_residuals(system: System, t: Any, q: Any, u: Any) -> tuple[Any, Any, Any]:
    """Orientations of frames in their parents (f, 3, 3); of bodies that turn in their frames, how, and their inertia
    (b, 4, 3); and the velocity residuals (k,)."""
    evaluator, like = DescriptionEvaluator(system), q
    q, u = tuple(q[i] for i in range(len(q))), tuple(u[i] for i in range(len(u)))
    orientations, spins = evaluator.read("orientations", t, q, u)
    as_arrays = lambda xs: [stack(x).astype(like.dtype) for x in xs]  # noqa: E731
    return as_arrays(orientations), as_arrays(spins), as_vector(evaluator.residuals(t, q, u), like)


def _check_numbers(system: System, t: Any, q: Any) -> None:
    """Refuse what depends on the numbers: frames that no rotation turns, and bodies that turn in their frames about an
    axis about which they are not symmetric."""
    read = lambda u: _rotations_and_residuals.numpy(system, t, q, u.astype(q.dtype))  # noqa: E731
    u = np.linspace(0.7, 1.3, len(system.speeds) + len(system.dependent_speeds))
    orientations, spins, _ = read(u)
    wrong = [i for i, R in enumerate(orientations) if _rotation_error(R) > ROTATION_ERROR]  # NaN is another check's
    if not wrong and all(map(_is_symmetric, spins)):
        return
    name, motion = type(system).__name__, DescriptionEvaluator(system).motion(t, tuple(q), tuple(u))
    if wrong:
        raise ValueError(f"{name}: " + _no_rotation(frames_of(motion)[wrong[0]], orientations[wrong[0]]))
    _, spins, _ = read(_on_residuals(lambda u: read(u)[2], u))
    for body, x in zip(turning_bodies(motion), spins, strict=True):
        if not _is_symmetric(x):
            raise ValueError(
                f"{name}: the body {body.name!r} turns in its frame {body.frame.name!r}, but its inertia is not "
                "symmetric about that axis, so it is not constant there. Give the body a frame that turns with it."
            )


def _rotation_error(R: np.ndarray) -> float:
    return float(np.max(np.abs(R @ R.T - np.eye(3))))


def _no_rotation(frame: Frame, R: np.ndarray) -> str:
    square = R @ R.T
    stretches = np.max(np.abs(square - np.eye(3) * square[0, 0])) <= 1e-6 * square[0, 0]
    cause = (
        f"its Euler parameters have the norm {np.trace(square / 3) ** 0.25:.6g} instead of 1"
        if stretches
        else f"[R] [R]^T differs from 1 by {_rotation_error(R):.3g}"
    )
    return (
        f"the frame {frame.name!r} is not turned from {frame.parent.name!r} by a rotation: {cause} at the "  # type: ignore[union-attr]
        "coordinates (or parameters) given. Give Euler parameters of unit norm, as jaxkane.assemble does "
        "where the constraint rotations.euler_parameter_norm is among the configuration constraints."
    )


def _is_symmetric(x: np.ndarray) -> bool:
    """Whether an inertia is constant in a frame in which its body turns; also where it is not finite."""
    s, I = x[0], x[1:]
    turned = np.cross(s, I.T).T  # [s x] I
    return not np.max(np.abs(turned + turned.T)) > 1e-6 * np.max(np.abs(I)) * max(1.0, np.max(np.abs(s)))


def _on_residuals(residual: Callable[[np.ndarray], np.ndarray], u: np.ndarray) -> np.ndarray:
    """The nearest speeds that meet the velocity residuals; NaN where there are none."""
    c, c0 = residual(u), residual(0.0 * u)
    if not c.size:
        return u
    C = np.array([residual(e) - c0 for e in np.eye(len(u))]).T  # (k,n)
    if np.all(np.isfinite(C)) and np.all(np.isfinite(c)):
        nearest = u - np.linalg.pinv(C, rcond=1e-9) @ c
        if not np.max(np.abs(residual(nearest))) > 1e-7 * max(1.0, np.abs(C).max(), np.abs(c).max()):
            return nearest
    return np.full_like(u, np.nan)


class _Consistency:
    """The description of a system as functions of numbers, and what must hold between them."""

    def __init__(self, system: System, t: Any, q: np.ndarray, rng: np.random.Generator):
        self.system, self.t, self.q, self.rng = system, np.asarray(t, q.dtype), q, rng
        self.name = type(system).__name__
        self.speeds = (*system.speeds, *system.dependent_speeds)
        self.inputs = {name: np.asarray(0.7, q.dtype) for name in (*system.inputs, *system.states)}
        self.tolerance = float(jnp.finfo(q.dtype).eps) ** 0.5
        self.has_constraints = False

    def check(self) -> bool:
        """Refuse what contradicts itself. **Returns:** whether there were finite numbers to judge by."""
        self._check_affine(self.q)
        judged = self._check_motion(self.q)
        beside = self.q + self.rng.uniform(-0.1, 0.1, self.q.shape)
        self.t = self.t + np.asarray(0.3, self.t.dtype)  # what is prescribed in time is often at rest where it begins
        return self._check_motion(beside.astype(self.q.dtype)) or judged

    def _read(self, q: np.ndarray, u: np.ndarray) -> Quantities:
        return consistency_quantities.numpy(self.system, self.t, q, u.astype(q.dtype), self.inputs)

    def _rates(self, q: np.ndarray, u: np.ndarray, quantities: Quantities) -> Quantities:
        """How all quantities change along the motion [1/s]."""
        q_dot = np.concatenate([x.ravel() for x in _of_kind(quantities, "rate").values()])
        at = self.system, self.t, q, u.astype(q.dtype), self.inputs
        along = None, np.ones((1,), q.dtype), q_dot[:, None], None, None
        return jax.tree.map(lambda x: x[..., 0], consistency_quantities.numpy_jvp(at, along))

    def _random_speeds(self) -> np.ndarray:
        n = len(self.speeds)
        return self.rng.uniform(0.5, 1.5, n) * self.rng.choice((-1.0, 1.0), n)

    def _differs(self, difference: Any, *sizes: Any) -> bool:
        size = max([1.0, *(np.max(np.abs(x), initial=0.0) for x in sizes)])
        difference = np.max(np.abs(difference), initial=0.0)
        return bool(np.isfinite(difference) and difference > self.tolerance * size)

    # Velocities are affine in the speeds.

    def _check_affine(self, q: np.ndarray) -> None:
        a, b = self._random_speeds(), self._random_speeds()
        zero, at_a, at_b, at_both = (self._read(q, u) for u in (0.0 * a, a, b, a + b))
        self.has_constraints = bool(_of_kind(zero, "constraint"))
        scaled = {s: self._read(q, s * a) for s in _SIZES}
        for key, z in zero.items():
            x, y, both = at_a[key], at_b[key], at_both[key]
            bent = self._differs(both - x - y + z, both, x, y, z)
            if bent or any(self._differs(f[key] - z - s * (x - z), f[key], s * x, z) for s, f in scaled.items()):
                curved = [name for i, name in enumerate(self.speeds) if self._is_curved(q, key, z, i)]
                which = f"in {', '.join(curved)}" if curved else "in the speeds: it holds products of two speeds"
                raise ValueError(
                    f"{self.name}: {_in_words(key)} is not affine {which}. Kane's method needs velocities that are "
                    "linear in the speeds, plus a term that may depend on time and coordinates: no squares, no abs() "
                    "or maximum() of a speed."
                )

    def _is_curved(self, q: np.ndarray, key: tuple[Any, ...], zero: Any, i: int) -> bool:
        direction = np.eye(len(self.speeds))[i]
        one = self._read(q, direction)[key]
        values = {s: self._read(q, s * direction)[key] for s in _SIZES}
        return any(self._differs(x - zero - s * (one - zero), x, s * one, zero) for s, x in values.items())

    # Places and orientations move as the rates of the coordinates say.

    def _check_motion(self, q: np.ndarray) -> bool:
        q, start = self._on_constraints(q), self._random_speeds()
        residual = lambda u: np.array([x.item() for x in _of_kind(self._read(q, u), "residual").values()])  # noqa: E731
        u = _on_residuals(residual, start)
        quantities = self._read(q, u)
        judged = all(np.all(np.isfinite(x)) for x in quantities.values())
        if not judged or any(_rotation_error(x[:3]) > self.tolerance for x in _of_kind(quantities, "frame").values()):
            return False  # coordinates with a relation that no constraint states: nearby states cannot be checked
        rates = self._rates(q, u, quantities)
        for key, x in quantities.items():
            self._check_quantity(key, x, rates[key])
        constraints = _of_kind(rates, "constraint")
        if constraints:
            # Along speeds that do not meet the residuals: their size.
            sizes = self._rates(q, start, self._read(q, start))
            for key, rate in constraints.items():
                self._check_constraint(key, rate, sizes[key])
        return True

    def _on_constraints(self, q: np.ndarray) -> np.ndarray:
        """The nearest coordinates that meet the configuration constraints; NaN where there are none nearby."""
        if not self.has_constraints:
            return q
        residual = lambda q: configuration_residual.numpy(self.system, self.t, q).astype(float)  # noqa: E731
        h, step = residual(q), self.tolerance
        for _ in range(20):
            if np.max(np.abs(h)) <= 0.1 * self.tolerance:
                return q
            displaced = [residual(q + step * e.astype(q.dtype)) for e in np.eye(len(q))]
            G = (np.array(displaced) - h).T / step  # (h,n_q)
            if not np.all(np.isfinite(G)):
                break
            q = q - (np.linalg.pinv(G, rcond=1e-6) @ h).astype(q.dtype)
            h = residual(q)
        return np.full_like(q, np.nan)

    def _check_quantity(self, key: Any, value: Any, rate: Any) -> None:
        _, kind, part, *parent = key
        if kind == "frame":
            turning = rate[:3] @ value[:3].T  # -[omega x], for [R] from the parent's components to the frame's
            by_orientation = np.array([turning[1, 2], turning[2, 0], turning[0, 1]])
            relative_to = f"components in {part!r}, relative to {parent[0]!r}"
            self._compare(f"the frame {part!r} turns", "rad/s", by_orientation, value[3], relative_to)
        elif kind == "center":
            self._compare(f"{part} moves", "m/s", rate[0], value[1], "components in N")
        elif kind == "place" or (kind == "contact" and self._differs(value[1], 0.0)):
            # A contact that is at rest may be a point of the ground, another one at every instant.
            relative_to = f"as seen in {parent[0]!r} from the point it was made from"
            self._compare(f"{part} moves", "m/s", rate[0], value[1], relative_to)
        elif kind == "about" and self._differs(value[0] - value[1], value[1]):
            raise ValueError(
                f"{self.name}: the inertia of the body {part!r} is given about a point that moves in its frame "
                f"{parent[0]!r}, so that it is not constant there. Give it about a point of the body, or about the "
                "mass centre."
            )

    def _compare(self, what: str, unit: str, by_position: Any, stated: Any, relative_to: str) -> None:
        if self._differs(by_position - stated, stated):
            show = lambda x: "(" + ", ".join(f"{a:.4g}" for a in x) + ")"  # noqa: E731
            raise ValueError(
                f"{self.name}: {what} with {show(by_position)} {unit} by the rates of its coordinates, but with "
                f"{show(stated)} {unit} by its description ({relative_to}, at a random test point). A rate that is "
                "given to a frame or a point contradicts q_dot; or a point is called fixed in a frame in which it "
                "moves; or `loads` reads self.motion(t, q, ...) with other speeds than its own. A point of a wheel "
                "that is in contact now is `center.fixed(r, wheel_frame)`."
            )

    def _check_constraint(self, key: Any, rate: Any, size: Any) -> None:
        if self._differs(rate, size):
            raise ValueError(
                f"{self.name}: the configuration constraint {key[2]} (counted from 0) changes at a rate of "
                f"{rate.item():.4g} 1/s while all velocity residuals are zero: they, or q_dot, contradict it. "
                "Where there are as many residuals as dependent speeds, the constraint must follow from them; "
                "leave out the residual that is its rate, and that is derived."
            )


def _of_kind(quantities: Quantities, kind: str) -> Quantities:
    return {key: x for key, x in quantities.items() if key[1] == kind}


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
