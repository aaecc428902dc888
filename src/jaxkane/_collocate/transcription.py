"""From problems on meshes to one nonlinear program.

The variables are the states and controls at all nodes, node by node and phase by phase, then the free durations, then
the free parameters. With F = duration * y_dot, the equations of motion in an interval of the fraction s are

    y_j - y_0 - (s_1 - s_0) sum_l A_jl F_l = 0    for each point j but the first (see `Lobatto`).
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import PyTree

from .._integrate.inputs import is_samples
from .._kane.constraint_residuals import n_configuration_constraints
from .._system.system import System, names_of, units_of
from .functions import (
    Bound,
    Condition,
    Dynamics,
    Ends,
    Integrand,
    Link,
    Path,
    Variables,
    bounds_of,
    constraints_of,
    named,
)
from .lobatto import Lobatto
from .program import Block, Bounds, EvaluatedBlock, NonlinearProgram


class PhaseProblem:
    """A phase of a motion: see `jaxkane.collocation.Problem` for the meaning of each attribute.

    `parameters` has the method `apply` and the attribute `size`; its last `n_local` numbers belong to this phase alone,
    the others are shared by all phases. `ends` and `limits` are bounds by name. A control is continuous, with a value
    at each node. If `is_piecewise`, it jumps between intervals: a node between two of them has two values.
    """

    system: System
    durations: Bound
    bounds_of_controls: dict[str, Bound]
    limits: dict[str, Bound]
    ends: Mapping[str, Mapping[str, Condition]]
    signals: Any
    parameters: Any
    cost: Any = None
    final_cost: Any = None
    conditions: Any = None
    path: Any = None
    n_local = 0
    is_piecewise = False

    @property
    def title(self) -> str:
        """The name of the system, for messages."""
        return type(self.system).__name__

    @property
    def names(self) -> tuple[str, ...]:
        """Names of coordinates, independent speeds and first-order states, in the order of the variables of a node."""
        coordinates, speeds, _, states = names_of(self.system)
        return (*coordinates, *speeds, *states)

    @property
    def has_free_duration(self) -> bool:
        return self.durations[0] < self.durations[1]

    @property
    def n_constraints(self) -> int:
        q = jax.ShapeDtypeStruct((len(self.system.coordinates),), jnp.float64)
        return n_configuration_constraints(self.system, jnp.zeros(()), q)

    def sizes_of(self, name: str) -> list[float]:
        """The finite bounds of a state or control, and its finite values at the ends."""
        given = [self.limits.get(name), *(self.ends[label].get(name) for label in ("start", "end"))]
        return [b for v in given if v is not None for b in bounds_of(name, v) if math.isfinite(b)]

    def variables(self) -> Variables:
        """How the variables of a node are read."""
        signals = self.signals
        if not self.has_free_duration and not callable(signals):
            signals = {name: x for name, x in signals.items() if not is_samples(x)}  # they are data of the nodes
        return Variables(
            system=self.system,
            signals=signals,
            parameters=self.parameters,
            duration=None if self.has_free_duration else jnp.asarray(self.durations[0], float),
            origin=jnp.zeros(()),
            controls=tuple(self.bounds_of_controls),
            n_y=len(self.names),
        )


class Motion(NamedTuple):
    """States and controls of a phase at nodes.

    - `s` (K,): the nodes, as fractions of the duration.
    - `duration`: [s].
    - `Y` (K, n_y), `W` (K, n_w): packed states and controls.
    """

    s: np.ndarray
    duration: float
    Y: np.ndarray
    W: np.ndarray


class Row(NamedTuple):
    """A group of constraints: its kind, its phase or link, its name, and the indices of its rows."""

    kind: str
    phase: int
    name: str
    rows: np.ndarray


@dataclasses.dataclass(frozen=True)
class Layout:
    """Where the variables of a phase are.

    - `problem`, `variables`: the problem and how its nodes are read.
    - `mesh` (N + 1,): the ends of the intervals, as fractions of the duration. `s` (K,): the nodes.
    - `every`: the number of nodes from one end of an interval to the next one.
    - `first`: the index of the first variable. `duration`: the index of the duration, or None.
    - `parameters`: the indices of the parameters.
    """

    problem: PhaseProblem
    variables: Variables
    mesh: np.ndarray
    s: np.ndarray
    every: int
    first: int
    duration: int | None
    parameters: np.ndarray

    @property
    def K(self) -> int:
        return len(self.s)

    @property
    def shared(self) -> np.ndarray:
        return np.concatenate([[] if self.duration is None else [self.duration], self.parameters]).astype(int)

    def node(self, k: np.ndarray | int, interval: np.ndarray | None = None) -> np.ndarray:
        """The indices (..., n_z) of the states and controls at nodes k (...,).

        A control that jumps between intervals has the value in `interval` (...,), by default in the interval that
        begins at the node.
        """
        k, n_y, n_w = np.asarray(k), self.variables.n_y, len(self.variables.controls)
        if not self.problem.is_piecewise:
            return self.first + k[..., None] * (n_y + n_w) + np.arange(n_y + n_w)
        i = np.minimum(k // self.every, len(self.mesh) - 2) if interval is None else interval
        states = self.first + k[..., None] * n_y + np.arange(n_y)
        controls = self.first + self.K * n_y + (k + i)[..., None] * n_w + np.arange(n_w)
        return np.concatenate([states, controls], axis=-1)

    @property
    def by_name(self) -> dict[str, np.ndarray]:
        """The indices (B,) of each state and control where the equations of motion are evaluated, and (1,) of the
        duration if it is free."""
        names = (*self.problem.names, *self.variables.controls)
        found = dict(zip(names, self.dynamics[1].T, strict=False))
        return found if self.duration is None else found | {"duration": np.array([self.duration])}

    @property
    def size(self) -> int:
        n_y, n_w = self.variables.n_y, len(self.variables.controls)
        return self.K * n_y + len(self.dynamics[0]) * n_w

    @property
    def dynamics(self) -> tuple[np.ndarray, ...]:
        """Where the equations of motion are evaluated.

        **Returns:** the nodes (B,), the variables (B, n) and, for each point of each interval, its place (N, s) among
        them. A node between two intervals is evaluated twice if controls jump there.
        """
        N = len(self.mesh) - 1
        nodes = np.arange(N)[:, None] * self.every + np.arange(self.every + 1)  # (N, s)
        if not self.problem.is_piecewise:
            return np.arange(self.K), self.columns, nodes
        i = np.broadcast_to(np.arange(N)[:, None], nodes.shape).ravel()
        shared = np.tile(self.shared, (nodes.size, 1))
        columns = np.concatenate([self.node(nodes.ravel(), i), shared], axis=1)
        return nodes.ravel(), columns, np.arange(nodes.size).reshape(nodes.shape)

    @property
    def columns(self) -> np.ndarray:
        """For each node, the variables (K, n) that its functions use."""
        return np.concatenate([self.node(np.arange(self.K)), np.tile(self.shared, (self.K, 1))], axis=1)

    def quadrature(self, method: Lobatto) -> np.ndarray:
        """The weights (K,) of the nodes in an integral over the fraction of the duration."""
        weights, steps, every = np.zeros(self.K), np.diff(self.mesh), len(method.c) - 1
        for j, b in enumerate(method.b):
            np.add.at(weights, np.arange(len(steps)) * every + j, steps * b)
        return weights

    def node_data(self, s: np.ndarray) -> dict[str, Any]:
        """The data of nodes: their fractions, and the values of sampled inputs if their times are fixed."""
        signals = {} if callable(self.problem.signals) else self.problem.signals
        sampled = {k: x for k, x in signals.items() if is_samples(x)} if self.duration is None else {}
        times = float(self.variables.origin) + s * self.problem.durations[0]
        inputs = {name: np.asarray(jax.vmap(signal)(jnp.asarray(times))) for name, signal in sampled.items()}
        return {"s": s, "inputs": inputs}


def nodes_of(mesh: np.ndarray, method: Lobatto) -> np.ndarray:
    """The nodes (K,) of a mesh; neighbouring intervals share one."""
    inner = mesh[:-1, None] + np.diff(mesh)[:, None] * method.c[:-1]
    return np.append(inner.ravel(), mesh[-1])


class Transcription:
    """The nonlinear program of problems on meshes, around a guess, which is clipped: to the values that are required at
    both ends, and to all bounds.

    **Arguments:**

    - `phases`, `links`: the phases and what links them.
    - `meshes`: for each phase the ends (N + 1,) of its intervals.
    - `method`: the method of collocation.
    - `motions`: for each phase the guess at the nodes.
    - `theta` (p,): the guess of the free parameters, in their search variables.
    - `objectives`: a function of the builder and the layouts, which adds to the cost.
    - `sizes`: for each phase the sizes (n_z,) of states and controls on a coarser mesh, or None.

    **Raises:** `ValueError` if a function is not finite at the guess, or a constraint has no derivative.
    """

    def __init__(
        self,
        phases: Sequence[PhaseProblem],
        links: Sequence[Any],
        meshes: Sequence[np.ndarray],
        method: Lobatto,
        motions: Sequence[Motion],
        theta: np.ndarray,
        objectives: Callable[[Builder, Sequence[Layout]], None] | None = None,
        sizes: Sequence[np.ndarray | None] | None = None,
    ):
        self.method = method
        self.layouts = _layouts(phases, meshes, method)
        self.n = 1 + max(int(layout.columns.max()) for layout in self.layouts)
        self.parameters = self.layouts[0].variables.parameters
        self.x = np.zeros(self.n)
        for layout, motion in zip(self.layouts, motions, strict=True):
            nodes, columns, _ = layout.dynamics
            self.x[columns[:, : layout.variables.n_z]] = np.concatenate([motion.Y, motion.W], axis=1)[nodes]
            if layout.duration is not None:
                self.x[layout.duration] = motion.duration
        self.x[self.shared_parameters] = theta
        self.x_bounds, given = self._variable_bounds(), self.x
        self.x = np.clip(given, *self.x_bounds)
        dynamics = [_dynamics(layout) for layout in self.layouts]
        self._check_finite_dynamics(dynamics)
        self.x_scale = self._scales(dynamics, [None] * len(phases) if sizes is None else sizes)
        self._is_clipped = np.abs(self.x - given) > 1e-6 * self.x_scale
        builder = Builder(self.n, self.method)
        for p, (layout, block) in enumerate(zip(self.layouts, dynamics, strict=True)):
            builder.defects(p, layout, block, self.x_scale)
        for p, layout in enumerate(self.layouts):
            self._add_functions(builder, p, layout, follows=0 < p <= len(links) and not callable(links[p - 1]))
        for i, how in enumerate(links):
            self._add_link(builder, i, how, dynamics)
        if objectives is not None:
            objectives(builder, self.layouts)
        self.rows = builder.rows
        self._named_blocks = [*((block, "equations of motion") for block in dynamics), *builder.user_blocks]
        self._check_functions(builder)
        g_scale = builder.scales(self.x, self.x_scale)
        self.program = NonlinearProgram(*builder.arguments(), self.x_bounds, builder.bounds, self.x_scale, g_scale)
        for p, layout in enumerate(self.layouts):
            nodes, columns, _ = layout.dynamics
            self.program.places[columns[:, : layout.variables.n_z]] = (p + layout.s)[nodes, None]
        self.program.f_scale = self._cost_scale()
        self.implied = self._drop_implied()
        self.unresolved = self._unresolved(builder, dynamics)

    def clipped(self, p: int) -> list[str]:
        """The names of the variables of phase p whose guess was clipped."""
        return [name for name, at in self.layouts[p].by_name.items() if self._is_clipped[at].any()]

    @property
    def sizes(self) -> list[np.ndarray]:
        """For each phase the sizes (n_z,) of states and controls."""
        return [self.x_scale[layout.node(0)] for layout in self.layouts]

    @property
    def z(self) -> np.ndarray:
        """The guess (n,) in scaled variables."""
        return self.x / self.x_scale

    @property
    def shared_parameters(self) -> np.ndarray:
        """The indices (p,) of the parameters of all phases."""
        layout = self.layouts[0]
        return layout.parameters[: len(layout.parameters) - layout.problem.n_local]

    @property
    def shared(self) -> np.ndarray:
        """The indices of all durations and parameters."""
        return np.unique(np.concatenate([layout.shared for layout in self.layouts]))

    @property
    def local_parameters(self) -> np.ndarray:
        """The indices of the parameters that belong to one phase, of all phases."""
        n = len(self.shared_parameters)
        return np.concatenate([layout.parameters[n:] for layout in self.layouts])

    def motions(self, x: np.ndarray) -> list[Motion]:
        """The motions of all phases at variables (n,)."""
        found = []
        for layout in self.layouts:
            values = x[layout.node(np.arange(layout.K))]
            duration = layout.problem.durations[0] if layout.duration is None else float(x[layout.duration])
            n_y = layout.variables.n_y
            found.append(Motion(layout.s, duration, values[:, :n_y], values[:, n_y:]))
        return found

    def not_finite(self, x: np.ndarray) -> list[str]:
        """The functions whose values or derivatives are not finite at variables (n,)."""
        found = []
        for block, label in self._named_blocks:
            if not np.all(np.isfinite(block.values(x))):
                found.append(f"`{label}`")
            elif not np.all(np.isfinite(block.jacobian(x))):
                found.append(f"the derivative of `{label}`")
        return found

    def corners(self) -> list[str]:
        """The costs that contain primitives without a derivative at some places, in words."""
        found = []
        for label, layout in itertools.product(("cost", "final_cost"), self.layouts):
            if f := getattr(layout.problem, label):
                node = jax.tree.map(lambda a: jnp.asarray(a)[0], layout.node_data(layout.s[:1]))
                variables = dataclasses.replace(layout.variables, parameters=None)  # their maps are not the user's
                x = jnp.zeros(variables.n_z + (variables.duration is None))
                text = str(jax.make_jaxpr(Integrand(variables, f))(node, x))
                found += [f"`{label}` contains {name}" for name in re.findall(r"\] = (abs|sign|max|min)\b", text)]
        return [*dict.fromkeys(found)]

    def theta(self, x: np.ndarray) -> np.ndarray:
        return x[self.shared_parameters]

    def gradient_of_integrals(self, z: np.ndarray) -> np.ndarray:
        """The derivatives (n,) of the scaled cost without final costs, by the scaled variables."""
        return self.program.gradient(z, [i for i, (_, label) in enumerate(self._named_blocks) if label == "cost"])

    def _variable_bounds(self) -> Bounds:
        lower, upper = np.full(self.n, -math.inf), np.full(self.n, math.inf)
        for layout in self.layouts:
            problem, at = layout.problem, layout.by_name
            limits = problem.limits | ({} if layout.duration is None else {"duration": problem.durations})
            for name, bounds in limits.items():
                if name in at:
                    lower[at[name]], upper[at[name]] = bounds
            for label, k in (("start", 0), ("end", -1)):
                for name, value in problem.ends[label].items():
                    if name in at:
                        i, (low, high) = at[name][k], bounds_of(name, value)
                        lower[i], upper[i] = max(low, lower[i]), min(high, upper[i])
        return Bounds(lower, upper)

    def _check_finite_dynamics(self, blocks: Sequence[EvaluatedBlock]) -> None:
        for layout, block in zip(self.layouts, blocks, strict=True):
            values = block.values(self.x)
            if np.all(np.isfinite(values)):
                continue
            place = int(np.argmin(np.all(np.isfinite(values), axis=1)))
            names = [layout.problem.names[i] for i in np.nonzero(~np.isfinite(values[place]))[0]]
            k = layout.dynamics[0][place]
            at = dict(zip(layout.problem.names, self.x[layout.node(k)].round(6).tolist()))
            raise ValueError(
                f"Problem: with the initial guess, the rates of {', '.join(names)} are not finite at "
                f"{layout.s[k]:.3g} of the duration, where the state is {at}. Pass another guess to solve."
            )

    def _scales(self, blocks: Sequence[EvaluatedBlock], known_sizes: Sequence[np.ndarray | None]) -> np.ndarray:
        """Typical sizes (n,) of the variables: one for each name."""
        scale = np.ones(self.n)
        for layout, block, known in zip(self.layouts, blocks, known_sizes, strict=True):
            values = scales_of(layout, block, self.x)
            if known is not None:
                # A state that should be zero is as large as its error (2e-5 m beside 200 m in the flight of an
                # aircraft). Relative to that, no error is small, and the mesh would grow from 40 to 316 intervals.
                values = np.maximum(values, 1e-2 * known)
            scale[layout.dynamics[1][:, : len(values)]] = values
            if layout.duration is not None:
                scale[layout.duration] = max(self.x[layout.duration], 1e-3 * layout.problem.durations[1])
        return scale

    def _add_functions(self, builder: Builder, p: int, layout: Layout, follows: bool) -> None:
        problem, variables = layout.problem, layout.variables
        data = layout.node_data(layout.s)
        if problem.cost is not None:
            block = EvaluatedBlock(Block(Integrand(variables, problem.cost), data, layout.columns, 1))
            builder.cost(block, layout.quadrature(self.method))
        along = {k: v for k, v in problem.limits.items() if k not in (*problem.names, *variables.controls)}
        path = self._returned("path", Path(variables, (), problem.path), data, layout.columns)
        if along or path:
            function = Path(variables, tuple(along), problem.path)
            items = [*along.items(), *constraints_of("path", path, is_equality=False).items()]
            builder.constraints("path", p, EvaluatedBlock(Block(function, data, layout.columns, len(items))), items)
        self._add_ends(builder, p, layout, follows)

    def _add_ends(self, builder: Builder, p: int, layout: Layout, follows: bool) -> None:
        problem, variables = layout.problem, layout.variables
        names = (*problem.names, *variables.controls)
        by_name = {
            label: {k: bounds_of(k, v) for k, v in problem.ends[label].items() if k not in names}
            for label in ("start", "end")
        }
        fixed = [c for c in problem.system.coordinates if not isinstance(problem.ends["start"].get(c, ()), tuple)]
        # If the phase before gives all coordinates, its start satisfies the constraints, except for the drift. A second
        # time, they would contradict the equations of motion there: a drone was not solved in 1000 iterations.
        n_h = 0 if follows or len(fixed) == len(problem.system.coordinates) else problem.n_constraints
        places = np.array([0, layout.K - 1])
        columns = np.concatenate([*layout.node(places), layout.shared])[None]
        data = layout.node_data(layout.s[places])
        data = tuple(jax.tree.map(lambda x, i=i: np.asarray(x)[i : i + 1], data) for i in (0, 1))
        conditions = Ends(variables, None, problem.conditions, (), (), False)
        conditions = self._returned("conditions", conditions, data, columns)
        items = [*constraints_of("conditions", conditions, is_equality=True).items()]
        items += [(f"{name} at the {label}", b) for label in ("start", "end") for name, b in by_name[label].items()]
        items += [(f"configuration constraint {i}", (0.0, 0.0)) for i in range(n_h)]
        has_cost = problem.final_cost is not None
        if not items and not has_cost:
            return
        ends = Ends(
            variables, problem.final_cost, problem.conditions, tuple(by_name["start"]), tuple(by_name["end"]), n_h > 0
        )
        block = EvaluatedBlock(Block(ends, data, columns, has_cost + len(items)))
        builder.constraints("conditions", p, block, items, has_cost=has_cost)

    def _add_link(
        self, builder: Builder, i: int, how: str | Callable[..., Any] | None, dynamics: Sequence[EvaluatedBlock]
    ) -> None:
        j = (i + 1) % len(self.layouts)
        one, other = self.layouts[i], self.layouts[j]
        linked = other.problem.names
        if j <= i:  # the motion is periodic, except for coordinates that no rate depends on
            used = {c for block in dynamics for c in block.pattern.columns}
            n_q = len(other.problem.system.coordinates)
            linked = tuple(name for k, name in enumerate(linked) if k >= n_q or k in used)
        link = Link(one.variables, other.variables, how, linked, one is other)
        data = (one.node_data(one.s[-1:]), other.node_data(other.s[:1]))
        durations = dict.fromkeys(x.duration for x in (one, other) if x.duration is not None)
        columns = np.concatenate([one.node(one.K - 1), other.node(0), [*durations], one.parameters]).astype(int)[None]
        if callable(how):
            names = [*self._returned("how", link, data, columns)]
            if not names:
                raise ValueError("The function `links` returns no residuals. Return a dict of residuals.")
        else:
            names = [f"link {i}: {name}" for name in ([how] if how is not None else []) + [*linked]]
        block = EvaluatedBlock(Block(link, data, columns, len(names)))
        builder.constraints("links", i, block, [(name, (0.0, 0.0)) for name in names])

    def _returned(
        self, field: str, function: Path | Ends | Link, data: PyTree, columns: np.ndarray
    ) -> Mapping[str, Any]:
        """The values by name that a function of the user returns, which is a field of the function of a block."""
        found: dict[str, Any] = {}
        f = getattr(function, field)
        if f is None:
            return found

        def recorded(*args: Any) -> Any:
            values = f(*args)
            found.update(named("links" if field == "how" else field, values))
            return values or {"": 0.0}  # blocks of no values are not evaluated

        node = jax.tree.map(lambda a: jnp.asarray(a)[0], data)
        jax.eval_shape(dataclasses.replace(function, **{field: recorded}), node, jnp.asarray(self.x[columns[0]]))
        return found

    def _check_functions(self, builder: Builder) -> None:
        for block, label in builder.user_blocks:
            values = block.values(self.x)
            if not np.all(np.isfinite(values)):
                raise ValueError(
                    f"Problem: `{label}` is not finite at the initial guess. Pass another guess: solve(problem, guess)."
                )
        for row in builder.rows:
            if row.kind in ("path", "conditions", "links") and not builder.has_derivative(row):
                raise ValueError(
                    f"Problem: `{row.kind}`: the derivative of {row.name!r} is zero everywhere. Return a smooth signed "
                    "number, not a truth value or a rounded one."
                )

    def _drop_implied(self) -> list[str]:
        """Drop constraints of fixed values, and path equalities at ends that others imply, and return the equalities.

        With them the Jacobian of all constraints is singular, and IPOPT needs hundreds of iterations.
        """
        program, free = self.program, self.program.lower < self.program.upper
        names, of_ends, others = {}, [], []
        for row in (row for row in self.rows if row.kind != "dynamics"):
            path = {row.rows[0]: " at the start", row.rows[-1]: " at the end"} if row.kind == "path" else {}
            of_ends += path
            others += [] if path else [*row.rows]
            prefix = f"phase {row.phase}: " * (row.kind != "links" and len(self.layouts) > 1)
            names |= {i: f"{prefix}{row.name}{path.get(i, '')}" for i in row.rows}
        if not names:
            return []
        rows, columns = program.jacobian_structure
        g, off = program.constraints(self.z), np.isin(np.arange(program.m), rows[free[columns]], invert=True)
        off &= np.isin(np.arange(program.m), [*names])
        for i in np.flatnonzero(off & (np.maximum(program.g_lower - g, g - program.g_upper) > 1e-6)):
            value, low, high = (x[i] * program.g_scale[i] for x in (g, program.g_lower, program.g_upper))
            required = f"{low:g}" if low == high else f"from {low:g} to {high:g}"
            raise ValueError(f"Problem: fixed values make {names[i]!r} {value:.6g}, but it must be {required}.")
        program.is_implied |= off
        is_equality = program.g_lower == program.g_upper
        order = [i for i in (*others, *of_ends) if is_equality[i] and not off[i]]
        dependent = {i for i in order if i in of_ends}
        beside = np.clip(self.z + np.random.default_rng(0).uniform(-0.1, 0.1, self.n), program.lower, program.upper)
        for z in (self.z, beside) if dependent else ():  # gradients may depend on each other at the guess by chance
            A = program.jacobian_matrix(z)[order][:, free].toarray()
            size = np.maximum(np.linalg.norm(A, axis=1, keepdims=True), 1e-300)
            A = A / size if np.all(np.isfinite(size)) else np.eye(len(A))  # beside the guess it may not be finite
            ranks = [np.linalg.matrix_rank(A[:k], tol=1e-8) if k else 0 for k in range(len(A) + 1)]
            dependent &= {i for i, before, after in zip(order, ranks, ranks[1:]) if before == after}
        program.is_implied[[*dependent]] = True
        return [names[i] for i in np.flatnonzero(program.is_implied & is_equality)]

    def _unresolved(self, builder: Builder, dynamics: Sequence[EvaluatedBlock]) -> list[str]:
        """Path equalities that contain controls only after two or more differentiations, for "hermite-simpson".

        The Hermite cubic of an interval leaves a circle by h^4 / 384 times its fourth derivative. The speeds that
        correct this at the middles are of order h^2, but cause forces of order 1 in the direction of the equality:
        a puck on a circle had a cost of 42.67 instead of 41.37 on all meshes. The other methods converge there.
        """
        found = []
        beside = self.x + self.x_scale * np.random.default_rng(0).uniform(-0.1, 0.1, self.n)
        for row in (row for row in self.rows if row.kind == "path" and self.method.order == 4):
            if np.any(self.program.g_lower[row.rows] < self.program.g_upper[row.rows]):
                continue
            (block, values), rates = next(builder._block_of(row)), dynamics[row.phase].pattern
            variables, own = self.layouts[row.phase].variables, np.isin(block.pattern.rows, values)
            columns, slopes, depth = np.asarray(block.pattern.columns)[own], block.jacobian(beside)[:, own], 0
            rest = block.values(beside)[:, values[0]] - np.sum(slopes * beside[block.columns[: block.B, columns]], 1)
            if np.ptp(rest) < 1e-9 and np.all(np.ptp(slopes, axis=0) < 1e-9):
                continue  # polynomials satisfy linear equations with constant coefficients everywhere
            while depth <= variables.n_y and not np.any((columns >= variables.n_y) & (columns < variables.n_z)):
                columns, depth = np.asarray(rates.columns)[np.isin(rates.rows, columns)], depth + 1
            found += [row.name] * (1 < depth <= variables.n_y)
        return found

    def _cost_scale(self) -> float:
        # The size of the cost at the guess, or one third of a scale away from it: at the guess it may be zero.
        shift = np.random.default_rng(0).uniform(-0.3, 0.3, self.n)
        z = np.clip(self.z + shift, self.program.lower, self.program.upper)
        sizes = [abs(self.program.objective(place)) for place in (self.z, z)]
        finite = [size for size in sizes if math.isfinite(size) and size > 0]
        return max(finite, default=1.0)


def _dynamics(layout: Layout) -> EvaluatedBlock:
    nodes, columns, _ = layout.dynamics
    variables = layout.variables
    return EvaluatedBlock(Block(Dynamics(variables), layout.node_data(layout.s[nodes]), columns, variables.n_y))


class Builder:
    """Collects blocks, constraints and their bounds."""

    def __init__(self, n: int, method: Lobatto) -> None:
        self.n, self.m, self.method = n, 0, method
        self.blocks: list[EvaluatedBlock] = []
        self.weights: list[np.ndarray | None] = []
        self.entries: list[tuple[np.ndarray, ...] | None] = []  # rows, places of values, factors
        self.linear: list[tuple[np.ndarray, ...]] = []
        self.rows: list[Row] = []
        self.user_blocks: list[tuple[EvaluatedBlock, str]] = []
        self._lower: list[np.ndarray] = []
        self._upper: list[np.ndarray] = []
        self._scales: dict[int, np.ndarray] = {}

    def _new_rows(self, k: int) -> np.ndarray:
        self.m += k
        return np.arange(self.m - k, self.m)

    def defects(self, p: int, layout: Layout, block: EvaluatedBlock, x_scale: np.ndarray) -> None:
        method = self.method
        n_y, steps, s = layout.variables.n_y, np.diff(layout.mesh), len(method.c)
        N = len(steps)
        first = np.arange(N) * (s - 1)
        rows = self._new_rows(N * (s - 1) * n_y).reshape(N, s - 1, n_y)
        node = layout.node(np.arange(layout.K))[:, :n_y]
        one = np.ones((N, s - 1, n_y))
        inner = first[:, None] + np.arange(1, s)
        self.linear.append((rows.ravel(), node[inner].ravel(), one.ravel()))
        self.linear.append((rows.ravel(), np.broadcast_to(node[first][:, None], rows.shape).ravel(), -one.ravel()))
        values = layout.dynamics[2][:, None, :, None] * n_y + np.arange(n_y)  # (N, 1, s, n_y)
        factors = -steps[:, None, None, None] * method.A[None, :, :, None]
        shape = (N, s - 1, s, n_y)
        parts = (np.broadcast_to(x, shape).ravel() for x in (rows[:, :, None, :], values, factors))
        self._add(block, None, tuple(parts))
        self._bound(np.zeros(rows.size), np.zeros(rows.size))
        for i, name in enumerate(layout.problem.names):
            self.rows.append(Row("dynamics", p, name, rows[:, :, i]))
            self._scales[len(self.rows) - 1] = x_scale[layout.node(0)[i]]

    def cost(self, block: EvaluatedBlock, weights: np.ndarray) -> None:
        self._add(block, weights, None)
        self.user_blocks.append((block, "cost"))

    def constraints(
        self, kind: str, p: int, block: EvaluatedBlock, items: Sequence[tuple[str, Bound]], has_cost: bool = False
    ) -> None:
        """One row for each value of the block at each place; the first value may be a cost."""
        B, m = block.B, len(items)
        rows = self._new_rows(B * m).reshape(B, m)
        values = np.arange(B)[:, None] * block.block.size + np.arange(m) + has_cost
        weights = None
        if has_cost:
            weights = np.zeros(B * block.block.size)
            weights[0] = 1.0
        self._add(block, weights, (rows.ravel(), values.ravel(), np.ones(rows.size)))
        self._bound(*(np.tile([bounds[i] for _, bounds in items], B) for i in (0, 1)))
        self.user_blocks.append((block, "conditions` or `final_cost" if kind == "conditions" else kind))
        for i, (name, _) in enumerate(items):
            self.rows.append(Row(kind, p, name, rows[:, i]))

    def _add(
        self,
        block: EvaluatedBlock,
        weights: np.ndarray | None,
        entries: tuple[np.ndarray, ...] | None,
    ) -> None:
        self.blocks.append(block)
        self.weights.append(weights)
        self.entries.append(entries)

    def _bound(self, lower: np.ndarray, upper: np.ndarray) -> None:
        self._lower.append(np.asarray(lower, float))
        self._upper.append(np.asarray(upper, float))

    @property
    def bounds(self) -> Bounds:
        return Bounds(np.concatenate([*self._lower, []]), np.concatenate([*self._upper, []]))

    def arguments(self) -> tuple[Any, Any, Any, Any]:
        """Blocks, weights, matrices of constraints and the linear matrix, as `NonlinearProgram` takes them."""
        matrices = []
        for block, entries in zip(self.blocks, self.entries, strict=True):
            shape = (self.m, block.B * block.block.size)
            matrices.append(None if entries is None else _sparse(entries, shape))
        rows, columns, factors = (np.concatenate(x) for x in zip(*self.linear, strict=True))
        return self.blocks, self.weights, matrices, _sparse((rows, columns, factors), (self.m, self.n))

    def _block_of(self, row: Row) -> Iterator[tuple[EvaluatedBlock, np.ndarray]]:
        """The block that has the values of a group of constraints, and the places of these values in the block."""
        for block, entries in zip(self.blocks, self.entries, strict=True):
            if entries is not None:
                inside = np.isin(entries[0], row.rows.ravel())
                if inside.any():
                    yield block, np.unique(entries[1][inside] % block.block.size)

    def has_derivative(self, row: Row) -> bool:
        return any(np.isin(block.pattern.rows, values).any() for block, values in self._block_of(row))

    def scales(self, x: np.ndarray, x_scale: np.ndarray) -> np.ndarray:
        """Typical sizes (m,) of constraints: their changes if the variables change by their scales."""
        scale = np.ones(self.m)
        for i, row in enumerate(self.rows):
            if i in self._scales:
                scale[row.rows.ravel()] = self._scales[i]
                continue
            for block, values in self._block_of(row):
                entries = np.abs(block.jacobian(x)) * x_scale[block.columns[: block.B][:, list(block.pattern.columns)]]
                own = entries[:, np.isin(block.pattern.rows, values)]
                size = float(np.max(own, initial=0.0))
                if math.isfinite(size) and size > 0:
                    scale[row.rows.ravel()] = size
        return scale


def _sparse(entries: tuple[np.ndarray, ...], shape: tuple[int, int]) -> Any:
    rows, columns, factors = entries
    return scipy.sparse.csr_matrix((factors, (rows, columns)), shape)


def _layouts(problems: Sequence[PhaseProblem], meshes: Sequence[np.ndarray], method: Lobatto) -> list[Layout]:
    """The layouts of all phases: their nodes, then their durations, shared parameters, and parameters of phases."""
    layouts, first, none = [], 0, np.zeros(0, int)
    for problem, mesh in zip(problems, meshes, strict=True):
        s, every = nodes_of(mesh, method), len(method.c) - 1
        layouts.append(Layout(problem, problem.variables(), mesh, s, every, first, None, none))
        first += layouts[-1].size
    for i, layout in enumerate(layouts):
        if layout.problem.has_free_duration:
            layouts[i] = dataclasses.replace(layout, duration=first)
            first += 1
    sizes = [0 if x.variables.parameters is None else x.variables.parameters.size - x.problem.n_local for x in layouts]
    shared = np.arange(first, first + sizes[0])
    first += sizes[0]
    for i, layout in enumerate(layouts):
        local = np.arange(first, first + layout.problem.n_local)
        first += len(local)
        layouts[i] = dataclasses.replace(layout, parameters=np.concatenate([shared, local]))
    return layouts


def scales_of(layout: Layout, block: EvaluatedBlock, x: np.ndarray) -> np.ndarray:
    """Typical sizes (n_z,) of the states and controls of a phase.

    A size is the largest of the finite bounds, the values at the ends, and the guess. Where all of these are zero, an
    angle has the size 0.3 rad. Any other variable has the size of the change that causes a typical rate in equations
    whose sizes are known, so that sizes do not depend on units.
    """
    problem, variables = layout.problem, layout.variables
    names = (*problem.names, *variables.controls)
    units = units_of(problem.system)
    values = x[layout.node(np.arange(layout.K))]
    sizes = np.max(np.abs(values), axis=0)
    for i, name in enumerate(names):
        sizes[i] = max([sizes[i], *map(abs, problem.sizes_of(name))])
    # Without units, a place of 1 and a force of 1e18 are not comparable, but the forces are.
    groups = (*names_of(problem.system), variables.controls)
    kinds = [(next(i for i, group in enumerate(groups) if name in group), units.get(name, "")) for name in names]
    angles = np.array([units.get(name, "") == "rad" for name in names])
    # dF/dx at the nodes, where F is duration * y_dot
    slopes = np.zeros((variables.n_y, len(names)))
    entries = np.max(np.abs(block.jacobian(x)), axis=0, initial=0.0)
    for row, column, slope in zip(block.pattern.rows, block.pattern.columns, entries, strict=True):
        if column < len(names) and math.isfinite(slope):
            slopes[row, column] = slope
    # A size must not follow from a rounding error. With a roll angle of 1e-32 in the guess, the steer torque of a
    # bicycle turns its wheels by 1e-33.
    for kind in {*kinds}:
        same = np.array([each == kind for each in kinds])
        sizes[same & (sizes < 1e-8 * np.max(sizes[same]))] = 0.0
        rows = same[: variables.n_y, None]
        slopes[rows & (slopes < 1e-8 * np.max(slopes, axis=0, where=rows, initial=0.0))] = 0.0
    sizes[angles & (sizes == 0)] = 0.3
    changes = np.max(np.abs(block.values(x)), axis=0)  # over the whole duration, with the present rates
    for _ in range(len(names)):
        known = sizes[: variables.n_y] > 0
        typical = np.maximum(changes, sizes[: variables.n_y])
        new = sizes.copy()
        for i in np.nonzero(sizes == 0)[0]:
            effects = np.where(known, slopes[:, i], 0.0) / np.where(known, typical, 1.0)
            largest = max(size for size, kind in zip(sizes, kinds, strict=True) if kind == kinds[i])
            usable = effects > max(1e-8 * np.max(effects), 1e-8 / largest if largest > 0 else 0.0)
            if usable.any():
                new[i] = np.exp(-np.mean(np.log(effects[usable])))
        if np.array_equal(new, sizes):  # no rate depends on the others: their sizes are those of their own rates
            for i in np.nonzero(sizes[: variables.n_y] == 0)[0]:
                new[i] = np.max(slopes[i] * sizes)
        if np.array_equal(new, sizes):
            break
        sizes = new
    return np.where(sizes > 0, sizes, 1.0)


def system_at(transcription: Transcription, p: int, x: np.ndarray) -> System:
    """The system of phase p with the values of its free parameters."""
    system = transcription.layouts[p].problem.system
    if transcription.parameters is None:
        return system
    return transcription.parameters.apply(system, jnp.asarray(transcription.theta(x)))[0]
