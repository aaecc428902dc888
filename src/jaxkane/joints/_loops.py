"""Closed loops: which residuals are independent, and which speeds and coordinates they determine."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
import scipy.linalg

from .._common.lookup import as_names, checked, real_number, refuse_any, refuse_if, refuse_unknown
from .._scalarjit.compat import Tracer
from .._scalarjit.components import Numbers
from ._joints import JointType
from ._mechanism import Field, LinkStructure, LoopStructure, Structure, class_of, loop_residuals, polynomial

NEARLY_REDUNDANT = 1e-4
"""Files have coordinates of five digits. The axes of a plane loop are then parallel up to 1e-5, and the residual normal
to its plane is not exactly redundant. As a constraint, it would lock the loop."""

_ATTEMPTS = 6


def with_dependent(
    structure: Structure,
    fields: tuple[Field, ...],
    values: dict[str, Any],
    dependent: Sequence[str] | None = None,
    independent: Sequence[str] = (),
    pose: Mapping[str, float] | None = None,
) -> Structure:
    """The structure with its dependent speeds and coordinates, and with the independent residuals.

    **Arguments:**

    - `structure`, `fields`, `values`: of the mechanism.
    - `dependent`: hinges and sliders that are solved for. None: the best-conditioned choice.
    - `independent`: joints that must not be solved for.
    - `pose`: coordinates by name, at which the choice is made. None: near the reference.

    **Raises:** `ValueError` for unknown names.
    """
    norms = [joint.name + joint.coordinates[-1][0] for joint in structure.joints if len(joint.coordinates) > 1]
    coordinates = [name for joint in structure.joints for name in joint.names(joint.coordinates)]
    independent = as_names(independent, "independent")
    dependent = None if dependent is None else as_names(dependent, "dependent")
    checked(pose, Mapping | None, "`pose` must be a dict of coordinates by name")
    for what, names, known, kind in (
        ("independent", independent, [joint.name for joint in structure.joints], "the joints"),
        ("pose", pose or (), coordinates, "the coordinates"),
    ):
        refuse_unknown(names, known, f"`{what}` contains names that are not among {kind}:")
    for name, value in (pose or {}).items():
        number = real_number(value, f"`pose`: {name!r}")
        refuse_if(not np.isfinite(number), f"`pose`: {name!r} = {value!r} is not finite.")
    both = [name for name in dependent or () if name in independent]
    refuse_any(both, "`dependent` and `independent` both name", ". Name it in one of them.")
    if not (structure.loops or structure.couplings):
        refuse_any(dependent or (), "`dependent` names", ", but the mechanism has no loop. Omit `dependent`.")
        return structure._replace(dependent_coordinates=tuple(norms))
    with jax.ensure_compile_time_eval():  # trial numbers must be concrete also inside `jax.jit`
        trial = _Trial(structure, fields, values)
        is_concrete = not any(isinstance(x, Tracer) or np.ndim(x) for x in values.values())
        q, rows, redundant = _independent_residuals(trial, pose, is_concrete)
        speeds, coordinates = _dependent_names(trial, q, rows, dependent, independent, norms)
    if len(rows) == len(trial.speeds):
        warnings.warn(
            f"{structure.name}: no independent speed: {len(rows)} speeds, and {len(rows)} independent residuals of the "
            "loops. If the mechanism can move, pass a `pose` at which its loops are closed. Otherwise, remove a loop.",
            UserWarning,
            stacklevel=3,
        )
    first, loops = 0, []
    for loop in structure.loops:
        own = range(first, first + loop.size)
        kept, dropped = (tuple(i - first for i in own if i in places) for places in (rows, redundant))
        loops.append(loop._replace(independent=kept, dropped=dropped))
        first += loop.size
    return structure._replace(
        loops=tuple(loops),
        couplings=tuple(x._replace(is_independent=first + i in rows) for i, x in enumerate(structure.couplings)),
        dependent_speeds=tuple(name for name in trial.speeds if name in speeds),
        dependent_coordinates=tuple(name for name in trial.coordinates if name in coordinates),
    )


def _independent_residuals(
    trial: _Trial, pose: Mapping[str, float] | None, is_concrete: bool
) -> tuple[np.ndarray, list[int], list[int]]:
    """Coordinates at which the loops are closed, the residuals that are independent there, and those that nearly depend
    on them, which are omitted.
    """
    rng = np.random.default_rng(1)
    q = trial.start(pose)
    # Not at the reference: residuals that are independent elsewhere may be dependent there, if links are in line.
    beside = trial.beside(q, rng)
    q = q if pose is not None else beside
    rows, good = (trial.independent(q, smallest) for smallest in (0.0, NEARLY_REDUNDANT))
    n_open, closed = len(trial.independent(beside, NEARLY_REDUNDANT)), trial.closed(q, sorted(good))
    redundant = sorted(set(rows) - set(good))
    regular = [] if closed is None else trial.independent(closed, NEARLY_REDUNDANT)
    is_regular = n_open <= min(len(good), len(regular)) < len(trial.speeds)
    if is_concrete and not (closed is not None and is_regular and trial.gaps(closed, good, redundant).max() <= 1.0):
        every = list(range(len(trial.residual_units)))
        for attempt in range(_ATTEMPTS):
            other = trial.closed(trial.beside(q, rng, 0.2 * 2**attempt) if attempt else q, every)
            regular = every if other is None else trial.independent(other, NEARLY_REDUNDANT)
            if other is None or len(regular) == len(trial.speeds):
                continue
            # A residual that depends on others at every closed pose is redundant, although it is independent where the
            # loops are open. At a singular pose, it is independent again beside this pose.
            if len(regular) >= n_open or trial.are_implied(other, regular, rng):
                return other, sorted(regular), []
    if closed is None:
        return q, sorted(good), redundant
    if is_concrete:
        trial.check_implied(closed, good, redundant)
    return closed, sorted(good), redundant


def _dependent_names(
    trial: _Trial,
    q: np.ndarray,
    rows: list[int],
    dependent: Sequence[str] | None,
    independent: Sequence[str],
    norms: list[str],
) -> tuple[list[str], list[str]]:
    """Speeds and coordinates for which the residuals can be solved, including those for the `norms` of Euler
    parameters."""
    structure, C = trial.structure, trial.velocity_slopes(q)[rows]  # (k,n)
    if dependent is not None:
        return _named_dependent(trial, C, dependent, norms)
    follows = [f"{x.first}_rate" for x in structure.couplings]
    # The first joint of a coupling follows the second one, so its rate should be the dependent one.
    preferred = C * [1e3 if name in follows else 1.0 for name in trial.speeds]
    groups = _by_joints(structure, trial.speeds, lambda joint: joint.speeds, independent)
    chosen = _best_columns(preferred, groups)
    refuse_if(
        len(chosen) < len(rows),
        f"{structure.name}: the loops have {len(rows)} independent residuals, and cannot be solved without the "
        f"joints that `independent` names: {', '.join(independent)}. Name fewer.",
    )
    speeds = [trial.speeds[i] for i in chosen]
    if all(name.endswith("_rate") for name in speeds):
        return speeds, [*(name.removesuffix("_rate") for name in speeds), *norms]
    G = np.concatenate([trial.slopes(q)[rows], trial.norm_slopes(q)])
    groups = _by_joints(structure, trial.coordinates, lambda joint: joint.coordinates, independent)
    # The norms of Euler parameters of an independent ball joint remain constraints.
    groups.append([i for i, name in enumerate(trial.coordinates) if name in norms])
    return speeds, [trial.coordinates[i] for i in _best_columns(G, groups)]


def _named_dependent(
    trial: _Trial, C: np.ndarray, dependent: Sequence[str], norms: list[str]
) -> tuple[list[str], list[str]]:
    simple = [joint.name for joint in trial.structure.joints if len(joint.speeds) == 1]
    refuse_unknown(dependent, simple, "`dependent` contains names that are not among the hinges and sliders:")
    refuse_if(
        len(set(dependent)) != len(C),
        f"`dependent` names {len(set(dependent))} joints, but the loops have {len(C)} independent residuals. Name "
        "one joint for each.",
    )
    speeds = [f"{name}_rate" for name in dependent]
    columns = C[:, [trial.speeds.index(name) for name in speeds]]
    refuse_if(
        np.linalg.svd(columns, compute_uv=False)[-1] < 1e-9 * np.abs(C).max(),
        f"`dependent`: the loops cannot be solved for {', '.join(dependent)}. Name other joints.",
    )
    return speeds, [*dependent, *norms]


class _Closure:
    """A loop in a mechanism of its own: the links from the last link that carries both of its ends, which is fixed.

    The residuals of a loop depend on these links only. The time for all loops is then linear in the number of links.
    """

    def __init__(self, structure: Structure, fields: tuple[Field, ...], numbers: dict[str, float], loop: LoopStructure):
        links = {link.name: link for link in structure.links}
        sites = [next(site for site in structure.sites if site.name == end) for end in (loop.first, loop.second)]
        chains = [_chain_to(links, site.link) for site in sites]
        common = sum(a == b for a, b in zip(*chains, strict=False))
        own = [name for name in links if name in chains[0][common:] + chains[1][common:]]
        parts = {*own, loop.first, loop.second, *(joint.name for name in own for joint in links[name].joints)}
        kinematic = [
            field for field in fields if field[0].split(".")[0] in _KINEMATIC and field[0].split(".")[1] in parts
        ]
        alone = Structure(
            structure.name,
            tuple(links[x]._replace(parent=_within(own, links[x].parent), has_mass=False) for x in own),
            tuple(site._replace(link=_within(own, site.link)) for site in sites),
            loops=(loop,),
        )
        self.mechanism = class_of(alone, tuple(kinematic))(**{name: numbers[name] for name, *_ in kinematic})
        # Python numbers, because JAX would compile every operation
        self.mechanism = jax.tree.map(float, self.mechanism)
        self.coordinates, self.speeds, self.size = self.mechanism.coordinates, self.mechanism.speeds, loop.size
        places = [abs(numbers[name]) for name, _, unit in kinematic if unit == "m"]
        self.length = max(places, default=0.0) or 1.0  # [m]

    def residuals(self, q: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals of the configuration and of the velocities [m and rad]."""
        q_row, u_row = list(map(float, q)), list(map(float, u))
        by_name = dict(zip(self.coordinates, q_row, strict=True)), dict(zip(self.speeds, u_row, strict=True))
        h, c = loop_residuals(self.mechanism, self.mechanism.sites_at(*by_name), *by_name)
        return np.array([float(x) for x in h]), np.array([float(x) for x in c])

    def velocity_slopes(self, q: np.ndarray) -> np.ndarray:
        rest = np.zeros(len(self.speeds))
        # Velocity residuals are affine in the speeds, so differences are their exact derivatives, whatever the step.
        at_rest = self.residuals(q, rest)[1]
        return np.array([self.residuals(q, e)[1] - at_rest for e in np.eye(len(rest))]).reshape(-1, self.size).T

    def slopes(self, q: np.ndarray, steps: np.ndarray) -> np.ndarray:
        rest = np.zeros(len(self.speeds))

        def h(step: np.ndarray) -> np.ndarray:
            return self.residuals(q + step, rest)[0]

        # Central differences, because JAX would compile the residuals of each mechanism. Rounding limits their error
        # to about 1e-10.
        columns = [(h(d * e) - h(-d * e)) / (2.0 * d) for d, e in zip(1e-6 * steps, np.eye(len(q)), strict=True)]
        return np.array(columns).reshape(-1, self.size).T


_KINEMATIC = ("position", "anchor", "site")


def _chain_to(links: Mapping[str, LinkStructure], name: str | None) -> list[str]:
    chain: list[str] = []
    while name is not None:
        chain.append(name)
        name = links[name].parent
    return chain[::-1]


def _within(names: Sequence[str], name: str | None) -> str | None:
    return name if name in names else None


class _Trial:
    """A mechanism with trial numbers for traced or batched parameters, because the independence of residuals is
    structural.

    Residuals are those of the loops and couplings, in their order. Coordinates are in units of the largest length of
    the mechanism, residuals of a loop in units of the largest length of this loop. Coordinates, speeds and residuals in
    m and in rad can then be compared, at any scale.
    """

    def __init__(self, structure: Structure, fields: tuple[Field, ...], values: dict[str, Any]):
        rng = np.random.default_rng(0)

        def number(x: Numbers) -> float:
            try:
                return float(np.ravel(np.asarray(x))[0])
            except Exception:  # a traced value is not available
                return float(rng.uniform(0.5, 1.5))

        self.structure = structure
        numbers = {name: number(x) for name, x in values.items()}
        names = [(joint, joint.names(joint.coordinates), joint.names(joint.speeds)) for joint in structure.joints]
        self.coordinates = tuple(name for _, coordinates, _ in names for name in coordinates)
        self.speeds = tuple(name for _, _, speeds in names for name in speeds)
        places = [abs(numbers[name]) for name, _, unit in fields if unit == "m"]
        places += [abs(joint.reference) for joint in structure.joints if joint.coordinates[0][1] == "m"]
        self.length = max(places, default=0.0) or 1.0  # [m]

        sizes, joints = {"m": self.length, "m/s": self.length}, structure.joints
        self.coordinate_units = np.array([sizes.get(unit, 1.0) for joint in joints for _, unit in joint.coordinates])
        self.speed_units = np.array([sizes.get(unit, 1.0) for joint in joints for _, unit in joint.speeds])
        self.closures = [_Closure(structure, fields, numbers, loop) for loop in structure.loops]
        self.in_q = [[self.coordinates.index(name) for name in closure.coordinates] for closure in self.closures]
        self.in_u = [[self.speeds.index(name) for name in closure.speeds] for closure in self.closures]
        loops = [closure.length if i < 3 else 1.0 for closure in self.closures for i in range(closure.size)]
        first = [self.coordinate_units[self.coordinates.index(x.first)] for x in structure.couplings]
        self.residual_units = np.array([*loops, *first])
        joints = [joint for joint in joints if len(joint.coordinates) > 1]
        last = [self.coordinates.index(joint.name + joint.coordinates[-1][0]) for joint in joints]
        self.euler_parameters = [slice(i - 3, i + 1) for i in last]

    def residuals(self, q: np.ndarray) -> np.ndarray:
        """Residuals of the configuration."""
        q = q * self.coordinate_units
        rows = [
            closure.residuals(q[places], np.zeros(len(closure.speeds)))[0]
            for closure, places in zip(self.closures, self.in_q, strict=True)
        ]
        for coupling in self.structure.couplings:
            value = polynomial(coupling.coefficients, self._of(q, coupling.second))[0]
            rows.append(np.array([self._of(q, coupling.first) - value]))
        return np.concatenate(rows) / self.residual_units

    def _of(self, q: np.ndarray, name: str | None) -> float:
        return float(q[self.coordinates.index(name)]) if name else 0.0

    def independent(self, q: np.ndarray, smallest: float) -> list[int]:
        """Residuals whose gradients have a part that does not depend on the others, of at least this relative size. The
        coefficients of couplings are exact, so only residuals of loops may be redundant because of rounding."""
        R, order = _qr(self.velocity_slopes(q).T)
        n, pivots = sum(closure.size for closure in self.closures), np.abs(np.diag(R))
        exact = max(1e-9 * pivots[0], 1e-13)
        return [int(i) for i, x in zip(order, pivots) if x > (max(exact, smallest * pivots[0]) if i < n else exact)]

    def beside(self, q: np.ndarray, rng: np.random.Generator, size: float = 0.2) -> np.ndarray:
        return self.normalized(q + rng.uniform(-size, size, q.shape))

    def are_implied(self, q: np.ndarray, rows: list[int], rng: np.random.Generator) -> bool:
        """Whether all residuals are zero wherever these are zero, also at a distance from the closed coordinates q."""
        G = np.concatenate([self.slopes(q)[rows], self.norm_slopes(q)])
        free = scipy.linalg.null_space(G, rcond=NEARLY_REDUNDANT)  # (n_q,d)
        for _ in range(2 if free.size else 0):
            way = free @ rng.normal(size=free.shape[1])
            moved = self.closed(self.normalized(q + 0.2 * way / np.linalg.norm(way)), rows)
            if moved is None or np.abs(self.residuals(moved)).max() > 1e-6:
                return False
        return True

    def velocity_slopes(self, q: np.ndarray) -> np.ndarray:
        """Derivatives of the velocity residuals with respect to the speeds (residuals, n)."""
        q = q * self.coordinate_units
        parts = [
            (places, closure.velocity_slopes(q[own]))
            for closure, own, places in zip(self.closures, self.in_q, self.in_u, strict=True)
        ]
        return self._assembled(parts, q, self.speeds, "_rate", self.speed_units)

    def slopes(self, q: np.ndarray) -> np.ndarray:
        """Derivatives of the residuals with respect to the coordinates (residuals, n_q)."""
        q, units = q * self.coordinate_units, self.coordinate_units
        parts = [
            (places, closure.slopes(q[places], units[places]))
            for closure, places in zip(self.closures, self.in_q, strict=True)
        ]
        return self._assembled(parts, q, self.coordinates, "", units)

    def _assembled(
        self,
        parts: list[tuple[list[int], np.ndarray]],
        q: np.ndarray,
        names: Sequence[str],
        ending: str,
        units: np.ndarray,
    ) -> np.ndarray:
        """One matrix of the derivatives of loops, each with respect to its own variables, and of couplings."""
        matrix, first = np.zeros((len(self.residual_units), len(names))), 0
        for places, slopes in parts:
            matrix[first : first + len(slopes), places] = slopes
            first += len(slopes)
        for row, coupling in zip(matrix[first:], self.structure.couplings, strict=True):
            row[names.index(coupling.first + ending)] = 1.0
            if coupling.second:
                slope = polynomial(coupling.coefficients, self._of(q, coupling.second))[1]
                row[names.index(coupling.second + ending)] -= float(slope)
        return matrix * units / self.residual_units[:, None]

    def norm_slopes(self, q: np.ndarray) -> np.ndarray:
        """Derivatives of the norms of Euler parameters with respect to all coordinates (norms, n_q)."""
        rows = np.zeros((len(self.euler_parameters), len(q)))
        for row, e in zip(rows, self.euler_parameters, strict=True):
            row[e] = 2.0 * q[e]
        return rows

    def normalized(self, q: np.ndarray) -> np.ndarray:
        for e in self.euler_parameters:
            q[e] /= np.linalg.norm(q[e])
        return q

    def start(self, pose: Mapping[str, float] | None) -> np.ndarray:
        q = np.array([1.0 if name.endswith("_e4") else 0.0 for name in self.coordinates])
        for joint in self.structure.joints:
            if len(joint.coordinates) == 1:
                q[self.coordinates.index(joint.name)] = joint.reference
        for name, value in (pose or {}).items():
            q[self.coordinates.index(name)] = value
        return self.normalized(q / self.coordinate_units)

    def closed(self, q: np.ndarray, rows: list[int]) -> np.ndarray | None:
        """Coordinates near q at which these residuals are zero; None if Newton's method does not converge."""
        weights = np.ones(len(q))  # prefer to change the coordinates that will be dependent
        for i, group in enumerate(_by_joints(self.structure, self.coordinates, lambda joint: joint.coordinates)):
            weights[group] = max(0.1**i, 1e-3)
        sizes = []
        for i in range(50):
            h = self.residuals(q)[rows]
            sizes.append(np.abs(h).max(initial=0.0))
            if sizes[-1] < 1e-12 or (i > 10 and sizes[-1] > 0.5 * sizes[-10]):
                break
            norms = 0.5 * self.norm_slopes(q)
            J = np.concatenate([self.slopes(q)[rows], norms])
            step = weights * np.linalg.lstsq(J * weights, -np.concatenate([h, np.zeros(len(norms))]), rcond=None)[0]
            # At most 0.5 (largest lengths or rad) in one step, so that a loop closes near q and not in another branch.
            q = self.normalized(q + step / max(1.0, 2.0 * np.linalg.norm(step)))
        return q if sizes[-1] < 1e-9 else None  # not closed from there: `assemble` reports it

    def gaps(self, q: np.ndarray, rows: list[int], redundant: list[int]) -> np.ndarray:
        """The residuals other than `rows`, relative to the largest permitted ones."""
        h = np.abs(self.residuals(q))
        h[rows] = 0.0
        return h / np.array([1e-2 if i in redundant else 1e-6 for i in range(len(h))])

    def check_implied(self, q: np.ndarray, rows: list[int], redundant: list[int]) -> None:
        """Check that residuals that depend on the independent ones are zero where the independent ones are zero.
        Residuals that nearly depend on them may be slightly different from zero, and are reported.

        **Raises:** `ValueError` for one that is not zero, e.g. if the sites of a planar loop are not in one plane.
        """
        h, gaps = np.abs(self.residuals(q)), self.gaps(q, rows, redundant)
        origins = [f"Loop({x.first!r}, {x.second!r})" for x in self.structure.loops for _ in range(x.size)]
        origins += [f"Coupling({x.first!r}, {x.second!r})" for x in self.structure.couplings]
        worst = int(np.argmax(gaps))
        if gaps[worst] > 1.0:
            off = h[worst] * self.residual_units[worst]
            raise ValueError(
                f"{self.structure.name}: {origins[worst]} is not satisfied: its residual is {off:.3g} where the others "
                "are zero. In a plane loop, place all sites in one plane. Two constraints on one joint must agree. If "
                "the loop can be closed, pass a `pose` at which it is."
            )
        if redundant:
            listed = ", ".join(f"{origins[i]} ({h[i] * self.residual_units[i]:.2g})" for i in redundant)
            warnings.warn(
                f"{self.structure.name}: these loops have residuals that nearly depend on the others and are omitted "
                f"(their sizes at the pose in brackets): {listed}.",
                UserWarning,
                stacklevel=5,
            )


def _by_joints(
    structure: Structure,
    names: Sequence[str],
    endings: Callable[[JointType], tuple[tuple[str, str], ...]],
    without: Sequence[str] = (),
) -> list[list[int]]:
    """Indices in the order in which they are solved for. Balls and free links come first, those at the end of the tree
    first, so that a welded free link depends as a whole. Hinges and sliders follow."""
    joints = [joint for joint in reversed(structure.joints) if joint.name not in without]
    groups = [[names.index(x) for x in joint.names(endings(joint))] for joint in joints]
    return [group for group in groups if len(group) > 1] + [[i for group in groups if len(group) == 1 for i in group]]


def _best_columns(A: np.ndarray, groups: list[list[int]]) -> list[int]:
    """The columns for which A is best solved, as many as it has rows: all independent ones of the first groups
    first."""
    chosen, size = [], np.linalg.norm(A, axis=0)
    # A column that nearly depends on the chosen ones would be solved for with a large error. Only the last pass takes
    # it, if there is no other.
    every = [i for group in groups for i in group]
    for group, threshold in (*((group, 1e-2) for group in groups), (every, 0.0)):
        rest = [i for i in group if i not in chosen]
        if rest and len(chosen) < len(A):
            Q = np.linalg.qr(A[:, chosen])[0]
            R, order = _qr(A[:, rest] - Q @ (Q.T @ A[:, rest]))
            good = [rest[j] for j, r in zip(order, np.abs(np.diag(R)), strict=False) if r > threshold * size[rest[j]]]
            chosen += good[: len(A) - len(chosen)]
    return chosen


def _qr(A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    factors: Any = scipy.linalg.qr(A, mode="economic", pivoting=True)
    return factors[1], factors[2]
