"""The model inside an FMU: its variables, and its equations in C. Depends neither on files nor on compilers.

The C source contains the equations, which are written here, and templates that are the same for all systems: modes and
variables (`fmu_template.c`), events and integration (`fmu_steps_template.c`), and the functions of one version of the
interface (`fmu_2_template.c`, `fmu_3_template.c`).
"""

from __future__ import annotations

import functools
import re
from collections.abc import Sequence
from string import Template
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._integrate.events import Events, event_values, own_events_of
from .._integrate.inputs import Coordinates, Speeds
from .._integrate.jumps import StagesOf, after_jump
from .._kane.api import dependent_speeds
from .._kane.expression_graph import Formulas, Function
from .._kane.right_hand_side import output_names, outputs_at
from .._scalarjit.graph import needed
from .._system.system import State, System, packed, unit_of
from .._version import __version__
from ._filter import all_rates
from ._source import CText, in_comment, listed, sections_of, six_a_line, variable_units, words_by_node


class Role(NamedTuple):
    """The attributes `causality`, `variability` and `initial` of a variable, as FMI defines them."""

    causality: str
    variability: str = "continuous"
    initial: str = ""


TIME, INPUT = Role("independent"), Role("input")
TUNABLE, FIXED = Role("parameter", "tunable", "exact"), Role("parameter", "fixed", "exact")
STATE, GUESSED_STATE = Role("output", initial="exact"), Role("output", initial="approx")
OUTPUT, LOCAL = Role("output", initial="calculated"), Role("local", initial="calculated")


class Variable(NamedTuple):
    """A variable of an FMU. All variables are numbers in float64. The place of a variable is its value reference.

    Fields:

    - `name`, `role`, `unit`, `description`. The unit may be empty.
    - `start`: the start value, or None if it is computed.
    - `bounds`: lower and upper bound, inclusive.
    - `derivative`: for the rate of a state the place of the state.
    - `dependencies`: the places of states, inputs and the time that determine the variable; None if it is given.
    """

    name: str
    role: Role
    unit: str
    description: str
    start: float | None = None
    bounds: tuple[float, float] = (-np.inf, np.inf)
    derivative: int | None = None
    dependencies: tuple[int, ...] | None = None


class FMUModel(CText):
    """The variables and the C source of an FMU.

    **Arguments:**

    - `system`: a system without contacts.
    - `start`: its initial state.
    - `name`: the model identifier.
    - `step`: the longest internal step of co-simulation [s].

    **Raises:** as `Formulas`.
    """

    def __init__(self, system: System, start: State, name: str, step: float):
        zeros = State(*(jnp.zeros(len(names)) for names in (system.coordinates, system.speeds)))
        self.events, self.outputs = own_events_of(system, jnp.zeros(()), zeros), output_names(system)
        super().__init__(Formulas(system, "float64", _functions_of(system, self.events, self.outputs)), name)
        self.step, self.start = step, np.asarray(packed(start), np.float64)
        self.states = (*system.coordinates, *system.speeds, *system.states)
        # The coordinates for which the configuration constraints are solved.
        self.moved = [system.coordinates.index(name) for name in system.dependent_coordinates or system.coordinates]
        self.directions: dict[int, np.ndarray] = {}  # by argument, the nodes of a direction of differentiation
        self.input_words = self._words()
        self._write_formulas()
        self.variables = self._variables()

    def _words(self) -> dict[int, str]:
        """The C expressions of the input nodes: states are in y, inputs in w, parameters in p, directions in dy ..."""
        formulas, system = self.formulas, self.formulas.system
        n_q, n_motion = len(system.coordinates), len(system.coordinates) + len(system.speeds)
        inputs = [f"w[{i}]" for i in range(len(system.inputs))]
        words = {
            "t": ["t"],
            "q": [f"y[{i}]" for i in range(n_q)],
            "u": [f"y[{i}]" for i in range(n_q, n_motion)],
            "inputs": inputs + [f"y[{n_motion + i}]" for i in range(len(system.states))],
            "parameters": [f"p[{i}]" for i in range(len(formulas.names("parameters")))],
        }
        by_node, n = words_by_node(formulas, words), len(formulas.arguments)
        for i, (a, nodes) in enumerate(zip(formulas.arguments, formulas.inputs, strict=True)):
            if a.kind in words:  # not the dependent speeds, which these functions compute
                places = [(n + i, e, nodes.size) for e in range(nodes.size)]
                directions = [formulas.graph.add("input", place, formulas.dtype) for place in places]
                self.directions[i] = np.array(directions, np.int64).reshape(nodes.shape)
                by_node |= {d: f"d{by_node[int(k)]}" for d, k in zip(directions, nodes.flat, strict=True)}
        return by_node

    def _write_formulas(self) -> None:
        formulas, empty = self.formulas, np.zeros(0, np.int64)

        def nodes_of(function: str, n: int) -> list[np.ndarray]:
            return [*formulas.nodes(function).values()] if function in formulas.functions else [empty] * n

        (self.rate,), (self.sensed,) = nodes_of("motion", 1), nodes_of("outputs", 1)
        self.g, self.g_dot, self.condition = nodes_of("events", 3)
        self.singular = -1
        if formulas.system.dependent_speeds:  # the last function is det C_dep
            if self._reads(self.g[-1]):
                events, self.singular = self.events, len(self.events.names)
                self.events = events._replace(
                    names=(*events.names, "singular speeds"),
                    directions=(*events.directions, 0),
                    stages=(*events.stages, ()),
                    conditions=(*events.conditions, None),
                )
            else:  # it is constant
                self.g, self.g_dot = self.g[:-1], self.g_dot[:-1]
        (self.h,) = formulas.nodes("configuration_residuals").values()
        of_moved = [formulas.directions("q")[i] for i in self.moved]
        (self.G,) = formulas.derivatives("configuration_residuals", of_moved).values()

        def slopes_of(function: str) -> np.ndarray:
            if function not in formulas.functions:
                return empty
            return formulas.directional_derivative(function, self.directions)[0]

        self.slopes = {"rate": slopes_of("motion"), "sensed": slopes_of("outputs")}
        self.slopes["g"] = slopes_of("event functions")[: len(self.g)]

    def _reads(self, nodes: np.ndarray | int) -> set[str]:
        """The C expressions of the inputs of some nodes."""
        graph = self.formulas.graph.nodes
        found = needed(graph, [np.atleast_1d(np.asarray(nodes, np.int64))])
        return {self.input_words[k] for k in found if graph[k].operation == "input"}

    def _variables(self) -> list[Variable]:
        """All variables, in the order of the value references of `fmu_template.c`."""
        system, units = self.formulas.system, variable_units(self.formulas.system)
        variables = [Variable("time", TIME, "s", "time"), *self.parameters()]
        places = {"t": 0}
        for i, name in enumerate(system.inputs):
            places[f"w[{i}]"] = len(variables)
            variables.append(Variable(name, INPUT, units[name], "input", 0.0))
        first_state = len(variables)
        kinds = ["coordinate"] * len(system.coordinates) + ["independent speed"] * len(system.speeds)
        kinds += ["first-order state"] * len(system.states)
        for i, (name, kind) in enumerate(zip(self.states, kinds, strict=True)):
            places[f"y[{i}]"] = len(variables)
            is_solved = i in self.moved and self.h.size > 0
            text = f"{kind}; its start value is a guess, because the constraints determine it" if is_solved else kind
            role = GUESSED_STATE if is_solved else STATE
            variables.append(Variable(name, role, units[name], text, float(self.start[i])))

        def computed(name: str, role: Role, unit: str, text: str, node: int, state: int | None = None) -> Variable:
            read = sorted(places[word] for word in self._reads(node) if word in places)
            return Variable(name, role, unit, text, derivative=state, dependencies=tuple(read))

        for i, (name, node) in enumerate(zip(self.states, self.rate, strict=True)):
            text = f"time derivative of {name}"
            variables.append(computed(f"der({name})", LOCAL, _rate_of(units[name]), text, node, first_state + i))
        sensed = [(name, units[name], "dependent speed") for name in system.dependent_speeds]
        sensed += [(name, unit_of(name, system.units), "output") for name in self.outputs]
        variables += [
            computed(name, OUTPUT, unit, text, k) for (name, unit, text), k in zip(sensed, self.sensed, strict=True)
        ]
        variables += [
            computed(f"events.{name}", LOCAL, "", f"event function of {name}", k)
            for name, k in zip(self.events.names, self.g, strict=True)
        ]
        return _with_unique_names(variables)

    def parameters(self) -> list[Variable]:
        """The parameters as variables. A parameter of the configuration constraints is fixed, because its change during
        a simulation would violate the constraints."""
        formulas, read = self.formulas, self._reads(self.h)
        values = iter(np.concatenate([np.ravel(x) for x in formulas.values().values()] or [np.zeros(0)]))
        variables: list[Variable] = []
        for a in formulas.of_kind("parameters"):
            lower, upper = a.info.within
            text, lower = ("positive parameter", max(lower, 0.0)) if a.info.positive else ("parameter", lower)
            for name in a.elements:
                role = FIXED if f"p[{len(variables)}]" in read else TUNABLE
                variables.append(Variable(name, role, a.info.unit, text, float(next(values)), (lower, upper)))
        return variables

    def source(self, fmi: str, token: str) -> str:
        """The C source for a version of FMI. `token` identifies the FMU."""
        name, (_, head, state, variables) = self.formulas.name, sections_of("fmu_template.c").values()
        title = f"{name}: a functional mock-up unit of Kane's equations, written by jaxkane {__version__}."
        text = Template(head).substitute(
            title=in_comment(title),
            fmi=fmi,
            token=token,
            step=self.constant(self.step),
            parameters=len(self.formulas.names("parameters")),
            inputs=len(self.formulas.system.inputs),
            states=len(self.states),
            sensed=len(self.sensed),
            events=len(self.g),
            conditions=len(self.condition),
            constraints=len(self.h),
            moved=len(self.moved),
            singular=self.singular,
        )
        steps, interface = (sections_of(f"fmu_{x}_template.c")[""] for x in ("steps", fmi[0]))
        return "\n".join([text, self._arrays(), self._equations(), state, steps, variables, interface])

    def _arrays(self) -> str:
        """Start values, bounds and names, and the properties of the events."""
        parameters, events = self.parameters(), self.events
        groups = {"p": [x.name for x in parameters], "w": self.formulas.system.inputs, "y": self.states}
        comments = [listed(word, names) for word, names in groups.items()]
        is_positive = [a.info.positive for a in self.formulas.of_kind("parameters") for _ in a.elements]
        lines = [
            *["/* Parameters, inputs and states:", "", *comments, "*/"],
            self.array("default_p", np.array([x.start for x in parameters])),
            self.array("default_y", self.start),
            self.array("lower", np.array([x.bounds[0] for x in parameters])),
            self.array("upper", np.array([x.bounds[1] for x in parameters])),
            _integers("is_positive", is_positive),
            _integers("is_fixed", [x.role == FIXED for x in parameters]),
            _strings("parameter_names", [x.name for x in parameters]),
            _integers("moved", self.moved),
            _strings("event_names", events.names),
            _integers("directions", events.directions),
            _integers("is_end", [not stages for stages in events.stages]),
            _integers("condition_of", [-1 if place is None else place for place in events.conditions]),
        ]
        return "\n".join(lines) + "\n"

    def _equations(self) -> str:
        """C functions: rates, dependent speeds and outputs, event functions, constraints, derivatives, jumps."""
        functions = {
            "rate_of": {"rate": self.rate},
            "sensed_of": {"sensed": self.sensed},
            "events_of": {"g": self.g, "g_dot": self.g_dot, "condition": self.condition},
            "configuration_of": {"h": self.h, "G": self.G},
            "derivatives_of": self.slopes,
        }
        jumps = [i for i, stages in enumerate(self.events.stages) if stages]
        for i in jumps:
            functions[f"jump_{i}"] = self.formulas.nodes(_jump_name(self.events.names[i]))
        texts = self.helpers([nodes for outputs in functions.values() for nodes in outputs.values()])
        point = ["double t", "const double *y", "const double *w", "const double *p"]
        direction = ["double dt", "const double *dy", "const double *dw", "const double *dp"]
        for function, outputs in functions.items():
            arguments = [*point, *(direction if function == "derivatives_of" else ())]
            texts.append(f"static {self.function(function, arguments, outputs, self.input_words)}")
        lines = ["(void)event, (void)t, (void)w, (void)p;", "memcpy(after, y, N_Y * sizeof(double));"]
        lines += [f"if (event == {i}) jump_{i}(t, y, w, p, after);" for i in jumps]
        body = "\n    ".join(lines)
        texts.append(f"static void jump_of(int event, {', '.join(point)}, double *after) {{\n    {body}\n}}\n")
        return "\n".join(texts)


def _functions_of(system: System, events: Events, outputs: Sequence[str]) -> dict[str, Function]:
    """The functions that an FMU needs, by name. Events without a function do not exist."""

    def sensed(system: System, t: Array, q: Coordinates, u: Speeds, w: dict[str, Array], _: Array):
        values = outputs_at(system, t, q, u, w) if outputs else {}
        u_dep = dependent_speeds(system, t, q, u) if system.dependent_speeds else ()
        return (jnp.stack([*u_dep, *(values[name] for name in outputs)]),)

    def after(
        event: int, system: System, t: Array, q: Coordinates, u: Speeds, w: dict[str, Array], _: Array
    ) -> tuple[Any, ...]:
        y = _packed(system, q, u, w)
        return (after_jump(system, t, y, jnp.asarray(event, y.dtype), StagesOf.of(events, only=event))[0],)

    functions = {"motion": Function(("rate",), all_rates)}
    if outputs or system.dependent_speeds:
        functions["outputs"] = Function(("sensed",), sensed)
    if events.names or system.dependent_speeds:
        functions["events"] = Function(("g", "g_dot", "condition"), _events)
        functions["event functions"] = Function(("g",), lambda *args: _events(*args)[:1])
    for i, name in enumerate(events.names):
        if events.stages[i]:
            functions[_jump_name(name)] = Function(("after",), functools.partial(after, i))
    return functions


def _packed(system: System, q: Coordinates, u: Speeds, w: dict[str, Array]) -> jax.Array:
    return packed(State(q, u, jnp.stack([w[name] for name in system.states]) if system.states else None))


def _events(system: System, t: Array, q: Coordinates, u: Speeds, w: dict[str, Array], _: Array):
    """Event functions and det C_dep, their rates, and the conditions. The rate of det C_dep is not needed."""
    values = event_values(system, t, _packed(system, q, u, w), all_rates(system, t, q, u, w, _)[0])
    if not system.dependent_speeds:
        return values.values, values.rates, values.conditions
    rates = jnp.append(values.rates, jnp.zeros((), values.rates.dtype))
    return jnp.append(values.values, values.bound), rates, values.conditions


def _jump_name(event: str) -> str:
    return f"`then` of the event {event}"


def _rate_of(unit: str) -> str:
    return f"{unit[:-2]}/s^2" if unit.endswith("/s") else f"{unit}/s" if unit else ""


def _with_unique_names(variables: list[Variable]) -> list[Variable]:
    """The variables with unique names. Inputs, states and outputs keep theirs. A parameter may have the same name as a
    coordinate; then it is called "parameters.NAME"."""
    taken, result = {x.name for x in variables if x.role.causality in ("input", "output")}, []
    for x in variables:
        name = x.name
        if x.role.causality not in ("input", "output"):
            if name in taken and x.role.causality == "parameter":
                name = f"parameters.{name}"
            while name in taken:
                name += "_"
            taken.add(name)
        result.append(x._replace(name=name))
    return result


def _integers(name: str, numbers: Sequence[Any]) -> str:
    return f"static const int {name}[] = {{\n    {six_a_line([str(int(x)) for x in numbers] or ['0'])}\n}};"


def _strings(name: str, texts: Sequence[str]) -> str:
    # A question mark could begin a trigraph.
    literals = ['"' + re.sub(r'(["\\?])', r"\\\1", text) + '"' for text in texts]
    return f"static const char *const {name}[] = {{\n    {six_a_line(literals or ['0'])}\n}};"
