"""Whether a description contradicts itself, found at trial states. Knows the method; knows no mechanism."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from .._common.lru_cache import LRUCache
from .._scalarjit.backends.numpy import derivative_in_numbers, in_numbers
from .._scalarjit.components import Component, is_exact
from .._scalarjit.function import fused
from .._scalarjit.linear import as_vector, stack
from .._system.bodies import Force, Load
from .._system.kinematics import Frame, Point
from .._system.motion import Motion
from .._system.system import System
from .constraints import configuration_residual
from .evaluate import DescriptionEvaluator, at_random_point, frames_of, structure_of, turning_bodies

Found = dict[tuple[Any, ...], Any]  # (number, kind, names ...) -> numbers; the number keeps the order of the reading


@fused
def consistency_quantities(system: System, t: Any, q: Any, u: Any, inputs: Any) -> Found:
    reading = DescriptionEvaluator(system, inputs)
    q, u, like = tuple(q[i] for i in range(len(q))), tuple(u[i] for i in range(len(u))), q
    motion = reading.motion(t, q, u)
    loads = reading.loads_at(t, q, u, motion)
    twice = sorted({*motion.points, *motion.frames} & {*system.auxiliary_speeds})
    if twice:
        raise ValueError(
            f"{reading.name}: {', '.join(twice)} is the name of an auxiliary speed and of a point or a frame: "
            "constraint_forces gives both a force by that name."
        )
    facts = [*_of_speeds(reading, t, q, u), *_of_bodies(motion), *_of_points(motion, loads), *_of_frames(motion, loads)]
    return {(i, *key): stack(rows).astype(like.dtype) for i, (key, rows) in enumerate(facts)}


@fused
def turning_of(system: System, t: Any, q: Any, u: Any) -> tuple[Any, Any, Any]:
    """Orientations of frames in their parents (f, 3, 3); of bodies that turn in their frames, how, and their inertia
    (b, 4, 3); and the velocity residuals (k,)."""
    reading, like = DescriptionEvaluator(system), q
    q, u = tuple(q[i] for i in range(len(q))), tuple(u[i] for i in range(len(u)))
    orientations, spins = reading.read("orientations", t, q, u)
    as_arrays = lambda xs: [stack(x).astype(like.dtype) for x in xs]  # noqa: E731
    return as_arrays(orientations), as_arrays(spins), as_vector(reading.residuals(t, q, u), like)


Fact = tuple[tuple[str, ...], list[tuple[Component, ...]]]


def _of_speeds(reading: DescriptionEvaluator, t: Any, q: Any, u: Any) -> Iterator[Fact]:
    for name, rate in zip(reading.system.coordinates, reading.rates(t, q, u), strict=True):
        yield ("rate", name), [(rate,)]
    for i, residual in enumerate(reading.residuals(t, q, u)):
        yield ("residual", str(i)), [(residual,)]
    for i, h in enumerate(reading.configuration(t, q)):
        yield ("constraint", str(i)), [(h,)]


def _of_bodies(motion: Motion) -> Iterator[Fact]:
    for body in motion.bodies:
        yield ("velocity", f"the velocity of {body.name!r}"), [body.center.velocity.components]
        yield ("velocity", f"the angular velocity of {body.name!r}"), [body.angular_velocity.components]
        if body.about is not None:
            r = body.about.position_from(body.center)
            carried = body.center.velocity + body.frame.angular_velocity.cross(r)
            velocities = [x.components_in(body.frame) for x in (body.about.velocity, carried)]
            yield ("about", body.name, body.frame.name), velocities
        if body.center.has_position and not all(_is_sure(point) for point in body.center.chain()):
            place, velocity = (x.components_in(motion.N) for x in (body.center.position, body.center.velocity))
            yield ("center", f"the mass centre of {body.name!r}"), [place, velocity]


def _of_points(motion: Motion, loads: Iterable[Load]) -> Iterator[Fact]:
    """Named points, what loads act on, and what these and the bodies were made from."""
    seen: set[Point] = set()
    centers = {body.center: f"the mass centre of {body.name!r}" for body in motion.bodies}
    named = {point: f"the point {name!r}" for name, point in motion.points.items()}
    acted_on = {load.point: f"the point {load.point.name!r} of a load" for load in loads if isinstance(load, Force)}
    words = {**acted_on, **named, **centers}
    for point in words:
        if point not in centers:
            yield ("velocity", f"the velocity of {words[point]}"), [point.velocity.components]
        for link in point.chain():
            if link in seen or link._relative_motion is None or (link._base is None and link in centers):
                continue
            seen.add(link)
            frame, velocity = link._relative_motion
            rows = [link._offset.components_in(frame), velocity.components_in(frame)]  # type: ignore[union-attr]
            if not all(is_exact(x) for x in rows[0]) or not all(is_exact(x) and x == 0.0 for x in rows[1]):
                # A point that `loads` made from a motion without speeds is at rest too, and is no point of contact.
                at_rest = link._base is None and frame is motion.N
                yield ("contact" if at_rest else "place", words.get(link, f"the point {link.name!r}"), frame.name), rows


def _of_frames(motion: Motion, loads: Iterable[Load]) -> Iterator[Fact]:
    for frame in frames_of(motion, loads):
        rows = [*frame._to_child, frame._spin]
        if not all(is_exact(x) for row in rows for x in row) or any(frame._spin):
            yield ("frame", frame.name, frame.parent.name), rows  # type: ignore[union-attr]


def _is_sure(point: Point) -> bool:
    """Whether a point moves as its place does, if what it was made from does and its claim is right."""
    if point._base is not None:
        return point._relative_motion is not None
    known = (*point.velocity.components, *(point._offset.components if point._offset is not None else ()))
    return all(is_exact(x) and x == 0.0 for x in known)  # the origin


_CHECKED = LRUCache()  # structures
ROTATION_ERROR = 1e-3
"""How far [R] [R]^T of frames may be from 1: measured and integrated Euler parameters are not of unit norm exactly."""
_SIZES = (-1.0, 1e-2, -20.0, 1e3, -1e3)  # multiples of trial speeds of order 1


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
    if structure not in _CHECKED:
        rng = np.random.default_rng(0)
        if _Description(*at_random_point((system, t, q), rng), rng=rng).check():
            _CHECKED[structure] = None
    if q is not None and not any(isinstance(x, Tracer) for x in jax.tree.leaves((system, t, q))):
        _check_numbers(system, t, q)


def _check_numbers(system: System, t: Any, q: Any) -> None:
    """Refuse what depends on the numbers: frames that no rotation turns, and bodies that turn in their frames about an
    axis about which they are not symmetric."""
    read = lambda u: in_numbers(turning_of, system, t, q, u.astype(q.dtype))  # noqa: E731
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


class _Description:
    """The description of a system as functions of numbers, and what must hold between them."""

    def __init__(self, system: System, t: Any, q: np.ndarray, rng: np.random.Generator):
        self.system, self.t, self.q, self.rng = system, np.asarray(t, q.dtype), q, rng
        self.name = type(system).__name__
        self.speeds = (*system.speeds, *system.dependent_speeds)
        self.inputs = {name: np.asarray(0.7, q.dtype) for name in (*system.inputs, *system.states)}
        self.tolerance = float(jnp.finfo(q.dtype).eps) ** 0.5

    def check(self) -> bool:
        """Refuse what contradicts itself. **Returns:** whether there were finite numbers to judge by."""
        self._check_affine(self.q)
        judged = self._check_state(self.q)
        beside = self.q + self.rng.uniform(-0.1, 0.1, self.q.shape)
        self.t = self.t + np.asarray(0.3, self.t.dtype)  # what is prescribed in time is often at rest where it begins
        return self._check_state(beside.astype(self.q.dtype)) or judged

    def read(self, q: np.ndarray, u: np.ndarray) -> Found:
        return in_numbers(consistency_quantities, self.system, self.t, q, u.astype(q.dtype), self.inputs)

    def read_along(self, q: np.ndarray, u: np.ndarray, now: Found) -> Found:
        """How all that is read changes along the motion [1/s]."""
        q_dot = np.concatenate([x.ravel() for x in _of_kind(now, "rate").values()])
        at = self.system, self.t, q, u.astype(q.dtype), self.inputs
        along = None, np.ones((1,), q.dtype), q_dot[:, None], None, None
        return jax.tree.map(lambda x: x[..., 0], derivative_in_numbers(consistency_quantities, at, along))

    def _trial_speeds(self) -> np.ndarray:
        n = len(self.speeds)
        return self.rng.uniform(0.5, 1.5, n) * self.rng.choice((-1.0, 1.0), n)

    def _differs(self, difference: Any, *sizes: Any) -> bool:
        size = max([1.0, *(np.max(np.abs(x), initial=0.0) for x in sizes)])
        difference = np.max(np.abs(difference), initial=0.0)
        return bool(np.isfinite(difference) and difference > self.tolerance * size)

    # -- velocities are affine in the speeds

    def _check_affine(self, q: np.ndarray) -> None:
        a, b = self._trial_speeds(), self._trial_speeds()
        zero, at_a, at_b, at_both = (self.read(q, u) for u in (0.0 * a, a, b, a + b))
        scaled = {s: self.read(q, s * a) for s in _SIZES}
        for key, z in zero.items():
            x, y, both = at_a[key], at_b[key], at_both[key]
            bent = self._differs(both - x - y + z, both, x, y, z)
            if bent or any(self._differs(f[key] - z - s * (x - z), f[key], s * x, z) for s, f in scaled.items()):
                curved = [name for i, name in enumerate(self.speeds) if self._is_curved(q, key, z, i)]
                which = f"in {_listed(curved)}" if curved else "in the speeds: it holds products of two speeds"
                raise ValueError(
                    f"{self.name}: {_in_words(key)} is not affine {which}. Kane's method needs velocities that are "
                    "linear in the speeds, plus a term that may depend on time and coordinates: no squares, no abs() "
                    "or maximum() of a speed."
                )

    def _is_curved(self, q: np.ndarray, key: tuple[Any, ...], zero: Any, i: int) -> bool:
        direction = np.eye(len(self.speeds))[i]
        one = self.read(q, direction)[key]
        values = {s: self.read(q, s * direction)[key] for s in _SIZES}
        return any(self._differs(x - zero - s * (one - zero), x, s * one, zero) for s, x in values.items())

    # -- places and orientations move as the rates of the coordinates say

    def _check_state(self, q: np.ndarray) -> bool:
        q, start = self._on_constraints(q), self._trial_speeds()
        residual = lambda u: np.array([x.item() for x in _of_kind(self.read(q, u), "residual").values()])  # noqa: E731
        u = _on_residuals(residual, start)
        now = self.read(q, u)
        judged = all(np.all(np.isfinite(x)) for x in now.values())
        if not judged or any(_rotation_error(x[:3]) > self.tolerance for x in _of_kind(now, "frame").values()):
            return False  # coordinates with a relation that no constraint states: nearby states cannot be checked
        rates = self.read_along(q, u, now)
        check = {
            "frame": self._check_frame,
            "place": self._check_place,
            "contact": self._check_contact,
            "center": self._check_center,
            "about": self._check_about,
        }
        for key, x in now.items():
            if key[1] in check:
                check[key[1]](key, x, rates[key])
        if _of_kind(now, "constraint"):
            self._check_constraints(rates, self.read_along(q, start, self.read(q, start)))
        return True

    def _on_constraints(self, q: np.ndarray) -> np.ndarray:
        """The nearest coordinates that meet the configuration constraints; NaN where there are none to be found."""
        residual = lambda q: in_numbers(configuration_residual, self.system, self.t, q).astype(float)  # noqa: E731
        h, step = residual(q), self.tolerance
        for _ in range(20):
            if not h.size or np.max(np.abs(h)) <= 0.1 * self.tolerance:
                return q
            moved = [residual(q + step * e.astype(q.dtype)) for e in np.eye(len(q))]
            G = (np.array(moved) - h).T / step  # (h,n_q)
            if not np.all(np.isfinite(G)):
                break
            q = q - (np.linalg.pinv(G, rcond=1e-6) @ h).astype(q.dtype)
            h = residual(q)
        return np.full_like(q, np.nan)

    def _check_frame(self, key: Any, now: Any, rate: Any) -> None:
        _, _, frame, parent = key
        turning = rate[:3] @ now[:3].T  # -[omega x], for [R] from the parent's components to the frame's
        by_orientation = np.array([turning[1, 2], turning[2, 0], turning[0, 1]])
        seen = f"components in {frame!r}, relative to {parent!r}"
        self._compare(f"the frame {frame!r} turns", "rad/s", by_orientation, now[3], seen)

    def _check_place(self, key: Any, now: Any, rate: Any) -> None:
        _, _, point, frame = key
        self._compare(f"{point} moves", "m/s", rate[0], now[1], f"as seen in {frame!r} from the point it was made from")

    def _check_contact(self, key: Any, now: Any, rate: Any) -> None:
        if self._differs(now[1], 0.0):  # what is at rest may be a point of the ground, another one at every instant
            self._check_place(key, now, rate)

    def _check_center(self, key: Any, now: Any, rate: Any) -> None:
        self._compare(f"{key[2]} moves", "m/s", rate[0], now[1], "components in N")

    def _compare(self, what: str, unit: str, by_position: Any, stated: Any, seen: str) -> None:
        if self._differs(by_position - stated, stated):
            show = lambda x: "(" + ", ".join(f"{a:.4g}" for a in x) + ")"  # noqa: E731
            raise ValueError(
                f"{self.name}: {what} with {show(by_position)} {unit} by the rates of its coordinates, but with "
                f"{show(stated)} {unit} by its description ({seen}, at a trial state). A rate that is given to a frame "
                "or a point contradicts q_dot; or a point is called fixed in a frame in which it moves; or `loads` "
                "reads self.motion(t, q, ...) with other speeds than its own. A point of a wheel that is in contact "
                "now is `center.fixed(r, wheel_frame)`."
            )

    def _check_constraints(self, rates: Found, free: Found) -> None:
        """`rates` along the motion, `free` along speeds that do not meet the residuals, for their size."""
        for key, rate in _of_kind(rates, "constraint").items():
            if self._differs(rate, free[key]):
                raise ValueError(
                    f"{self.name}: the configuration constraint {key[2]} (counted from 0) changes at a rate of "
                    f"{rate.item():.4g} 1/s while all velocity residuals are zero: they, or q_dot, contradict it. "
                    "Where there are as many residuals as dependent speeds, the constraint must follow from them; "
                    "leave out the residual that is its rate, and that is derived."
                )

    def _check_about(self, key: Any, now: Any, rate: Any) -> None:
        _, _, body, frame = key
        if self._differs(now[0] - now[1], now[1]):
            raise ValueError(
                f"{self.name}: the inertia of the body {body!r} is given about a point that moves in its frame "
                f"{frame!r}, so that it is not constant there. Give it about a point of the body, or about the mass "
                "centre."
            )


def _of_kind(found: Found, kind: str) -> Found:
    return {key: x for key, x in found.items() if key[1] == kind}


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


def _rotation_error(R: np.ndarray) -> float:
    return float(np.max(np.abs(R @ R.T - np.eye(3))))


def _listed(words: Iterable[str]) -> str:
    return ", ".join(words)
