"""The equations of a system as graphs of scalars, with the names of their inputs. Independent of the output language.

Every function is traced in the same way as in a simulation, and JAX computes the derivatives. All functions share one
graph, so common subexpressions occur once.
"""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._common.lookup import refuse_any, refuse_if
from .._scalarjit.compat import ClosedJaxpr, jaxpr_as_fun
from .._scalarjit.components import ELIMINATE_UP_TO, as_vector, is_written_out
from .._scalarjit.graph import Graph, NotScalarError, unrolled
from .._scalarjit.jaxpr import Direction, cse, jacobian, tangent_program
from .._system.parameters import ANY, ParameterInfo, declared, in_batches, leaf_name
from .._system.system import System
from .api import (
    constraint_jacobian,
    constraint_jacobian_rate,
    dependent_accelerations,
    dependent_speeds,
    equations_of_motion,
    kinetic_energy,
    partial_velocities,
)
from .arguments import Coordinates, InputArrays, Speeds, Time, as_row, check_is_system, is_concrete, refuse_multipliers
from .checks import check_system
from .description import DescriptionEvaluator
from .kanes_method import motion_rates_by_matrix
from .right_hand_side import rates


class Function(NamedTuple):
    """A function of (system, t, q, u, inputs, u_dep), and the names of its outputs."""

    outputs: tuple[str, ...]
    evaluate: Callable[..., tuple[Any, ...]]
    needs_constraints: bool = False
    needs_states: bool = False


# Derivatives of the rates (q_dot, u_dot) with respect to these kinds of arguments.
JACOBIANS = {
    "state_jacobian": ("q", "u"),
    "parameter_jacobian": ("parameters",),
    "input_jacobian": ("inputs",),
}
FUNCTIONS: dict[str, Function] = {
    "rates": Function(("q_dot", "u_dot"), lambda s, t, q, u, w, _: motion_rates_by_matrix(s, t, q, u, w)),
    "equations": Function(("M", "f"), lambda s, t, q, u, w, _: equations_of_motion(s, t, q, u, w)),
    "dependent_speeds": Function(("u_dep",), lambda s, t, q, u, w, _: (dependent_speeds(s, t, q, u),), True),
    "dependent_accelerations": Function(
        ("u_dep_dot",), lambda s, t, q, u, w, _: (dependent_accelerations(s, t, q, u, w),), True
    ),
    "constraint_jacobian": Function(("J",), lambda s, t, q, u, w, _: (constraint_jacobian(s, t, q),), True),
    "constraint_jacobian_rate": Function(
        ("J_dot",), lambda s, t, q, u, w, _: (constraint_jacobian_rate(s, t, q, u),), True
    ),
    "partial_velocities": Function(("V", "W"), lambda s, t, q, u, w, _: partial_velocities(s, t, q, u, w)),
    "state_rates": Function(("x_dot",), lambda s, t, q, u, w, _: (rates(s, t, q, u, w).x,), needs_states=True),
    "kinetic_energy": Function(("energy",), lambda s, t, q, u, w, _: (kinetic_energy(s, t, q, u),)),
}
OFFERED = (*FUNCTIONS, *JACOBIANS)
# As functions of all speeds, including the dependent ones.
FUNCTIONS |= {
    "coordinate_rates": Function(("q_dot",), lambda *args: _read(DescriptionEvaluator.rates, *args)),
    "velocity_residuals": Function(("c",), lambda *args: _read(DescriptionEvaluator.residuals, *args), True),
    "configuration_residuals": Function(
        ("h",), lambda *args: _read(lambda system, t, q, u: system.configuration(t, q), *args)
    ),
}


def _read(
    quantity: Callable[..., Any], system: System, t: Time, q: Coordinates, u: Speeds, w: InputArrays, u_dep: Speeds
) -> tuple[Any]:
    row = as_row(q, system.coordinates, "q")
    return (as_vector(quantity(DescriptionEvaluator(system), t, row, (*u, *u_dep)), q),)


class Argument(NamedTuple):
    """An array that functions read, with the name of each element. Each parameter is a separate argument."""

    kind: str  # "t", "q", "u", "inputs", "u_dep" or "parameters"
    name: str
    shape: tuple[int, ...]
    elements: tuple[str, ...]
    info: ParameterInfo = ANY


class Formulas:
    """Functions of a system as arrays of nodes of one graph.

    The attribute `arguments` contains the inputs of the functions. The operands of an input node are the index of its
    argument, the index of its element in the argument, and the number of elements.

    **Arguments:**

    - `system`: the system.
    - `dtype`: "float64" or "float32".
    - `more`: functions by name, in addition to `FUNCTIONS`.

    **Raises:** `TypeError` if `system` is not a `System`, or if it is traced. `ValueError` for a batch, and for a
    system that contradicts itself. When a function is requested, `ValueError` if the system does not have it, or if its
    operations cannot be written with scalars.
    """

    def __init__(self, system: System, dtype: str = "float64", more: Mapping[str, Function] | None = None):
        check_is_system(system)
        refuse_multipliers(system)
        self.system, self.name, self.dtype = system, type(system).__name__, str(jnp.dtype(dtype))
        self.functions = {**FUNCTIONS, **(more or {})}
        refuse_if(
            self.dtype not in ("float64", "float32"),
            f"{self.name}: `dtype` must be 'float64' or 'float32', got {dtype!r}.",
        )
        after = " has additional leading axes. Pass one member of it."
        refuse_any(in_batches(system), f"{self.name} is a batch:", after)
        if not is_concrete(system):
            raise TypeError(f"{self.name} is traced. Call this function outside of jax.jit, vmap and grad.")
        check_system(system, 0.0, None)
        paths, self.structure = jax.tree_util.tree_flatten_with_path(system)
        self.leaves = [leaf for _, leaf in paths]
        self.is_float = [bool(jnp.issubdtype(jnp.result_type(leaf), jnp.floating)) for leaf in self.leaves]
        parameters = [
            Argument(
                "parameters", name := leaf_name(path), np.shape(x), _elements(name, np.shape(x)), declared(system, path)
            )
            for (path, x), is_float in zip(paths, self.is_float, strict=True)
            if is_float
        ]
        vectors = {"q": system.coordinates, "u": system.speeds}
        # At a given time, a first-order state is a number that `loads` reads, like an input.
        vectors |= {"inputs": (*system.inputs, *system.states)}
        vectors |= {"u_dep": system.dependent_speeds}
        self.arguments = (
            Argument("t", "t", (), ("t",)),
            *(Argument(kind, kind, (len(names),), tuple(names)) for kind, names in vectors.items()),
            *parameters,
        )
        self.graph = Graph()
        self.inputs = [
            np.array(
                [self.graph.add("input", (i, e, len(a.elements)), self.dtype) for e in range(len(a.elements))], np.int64
            ).reshape(a.shape)
            for i, a in enumerate(self.arguments)
        ]
        self.program = functools.cache(self._program)
        self.nodes = functools.cache(self._nodes)

    def values(self) -> dict[str, np.ndarray]:
        floats = [x for x, is_float in zip(self.leaves, self.is_float, strict=True) if is_float]
        return {a.name: np.asarray(x, self.dtype) for a, x in zip(self.of_kind("parameters"), floats, strict=True)}

    def of_kind(self, kind: str) -> list[Argument]:
        return [a for a in self.arguments if a.kind == kind]

    def names(self, kind: str) -> tuple[str, ...]:
        return tuple(name for a in self.of_kind(kind) for name in a.elements)

    def evaluate(self, function: str, *args: Any) -> tuple[Any, ...]:
        """Evaluate a function. `args` are arrays in the order of `arguments`."""
        t, q, u, w, u_dep, *parameters = args
        values = iter(parameters)
        leaves = [next(values) if is_float else x for x, is_float in zip(self.leaves, self.is_float, strict=True)]
        inputs = {name: w[i] for i, name in enumerate((*self.system.inputs, *self.system.states))}
        return tuple(
            self.functions[function].evaluate(jax.tree.unflatten(self.structure, leaves), t, q, u, inputs, u_dep)
        )

    def _program(self, function: str, keeps_solutions: bool = False) -> ClosedJaxpr:
        """A function as a JAX program without calls of other programs. `keeps_solutions`: see `cse`."""
        refuse_if(
            self.functions[function].needs_constraints and not self.system.dependent_speeds,
            f"{self.name} has no dependent speeds, so {function!r} does not exist. Omit it.",
        )
        refuse_if(
            self.functions[function].needs_states and not self.system.states,
            f"{self.name} has no first-order states, so {function!r} does not exist. Omit it.",
        )
        specs = [jax.ShapeDtypeStruct(a.shape, self.dtype) for a in self.arguments]
        with jax.enable_x64(self.dtype == "float64"):
            return cse(jax.make_jaxpr(functools.partial(self.evaluate, function))(*specs), keeps_solutions)

    def _nodes(self, function: str) -> dict[str, np.ndarray]:
        if function in JACOBIANS:
            blocks = self.derivatives("rates", self.directions(*JACOBIANS[function]))
            return {"jacobian": np.concatenate([*blocks.values()])}
        program = self.program(function)
        with self._explained(function):
            outputs = unrolled(program, self.inputs, self.graph)
        return dict(zip(self.functions[function].outputs, outputs, strict=True))

    def directions(self, *kinds: str) -> list[Direction]:
        """All numbers of the given kinds, as pairs: the index of the argument and the index in the argument."""
        return [(i, e) for i, a in enumerate(self.arguments) if a.kind in kinds for e in range(len(a.elements))]

    def derivatives(self, function: str, directions: Sequence[Direction]) -> dict[str, np.ndarray]:
        """The derivatives (..., d) of a function's outputs with respect to d numbers, as nodes."""
        with self._explained(function), jax.enable_x64(self.dtype == "float64"):
            outputs = jacobian(self.program(function, keeps_solutions=True), self.inputs, directions, self.graph)
        return dict(zip(self.functions[function].outputs, outputs, strict=True))

    def directional_derivative(self, function: str, direction: Mapping[int, np.ndarray]) -> list[np.ndarray]:
        """The derivatives of a function's outputs along one direction, as nodes. They are shorter than a Jacobian.

        `direction`: the direction as nodes, by the index of the argument, with the shape of the argument.
        """
        places = [i for i, nodes in direction.items() if nodes.size]
        outputs = self.nodes(function).values()
        with self._explained(function), jax.enable_x64(self.dtype == "float64"):
            program, has_tangent = tangent_program(self.program(function, keeps_solutions=True), places)
            tangents = iter(unrolled(program, [*self.inputs, *(direction[i] for i in places)], self.graph))
        zero = self.graph.constant(0.0, self.dtype)
        pairs = zip(has_tangent, outputs, strict=True)
        return [next(tangents) if has else np.full(nodes.shape, zero) for has, nodes in pairs]

    def by_jax(self, function: str, *args: Any) -> tuple[Any, ...]:
        """The values of a function or of a Jacobian by JAX. `args` are arrays in the order of `arguments`."""
        if function not in JACOBIANS:
            return tuple(jaxpr_as_fun(self.program(function))(*args))
        places = [i for i, a in enumerate(self.arguments) if a.kind in JACOBIANS[function]]

        def rates_of(values: Sequence[Array]):
            full = list(args)
            for i, x in zip(places, values, strict=True):
                full[i] = x
            return jnp.concatenate(jaxpr_as_fun(self.program("rates"))(*full))

        n = len(self.system.coordinates) + len(self.system.speeds)
        if not any(self.arguments[i].elements for i in places):
            return (jnp.zeros((n, 0), self.dtype),)
        blocks = jax.jacfwd(rates_of)([jnp.asarray(args[i]) for i in places])
        return (jnp.concatenate([block.reshape(n, math.prod(block.shape[1:])) for block in blocks], axis=1),)

    @contextlib.contextmanager
    def _explained(self, function: str) -> Iterator[None]:
        """**Raises:** `ValueError` for an operation that cannot be written with scalars."""
        n, k = len(self.system.speeds), len(self.system.dependent_speeds)
        if not is_written_out(n) and function not in ("equations", "coordinate_rates"):
            why = f"because the equations of a system with {n} speeds are solved by LAPACK"
            remedy = "Export M and f with functions=('equations',), and solve M u_dot = f in the other program"
        elif k > ELIMINATE_UP_TO:
            why, remedy = f"because {k} dependent speeds are computed by LAPACK", "Use fewer dependent speeds"
        else:
            why = "which its description uses"
            remedy = "Use functions of single numbers, jnp.where and constant indices"
        try:
            yield
        except NotScalarError as error:
            raise ValueError(
                f"{self.name}: {function!r} cannot be written as formulas of single numbers: it contains {error}, "
                f"{why}. {remedy}. Or use jaxkane.export.stablehlo, which supports every operation."
            ) from None


def _elements(name: str, shape: tuple[int, ...]) -> tuple[str, ...]:
    return tuple(name + "".join(f"[{i}]" for i in place) for place in np.ndindex(shape))
