"""The model inside an FMU: its variables, and its equations in C. Depends neither on files nor on compilers.

The C source is the equations between the sections of `fmu_template.c`, followed by the functions of one version of the
interface (`fmu_2_template.c`, `fmu_3_template.c`). Arrays in C have the order of the variables.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._integrate.events import event_values, own_events_of
from .._integrate.jumps import after_stages, stages_of
from .._kane.api import dependent_speeds
from .._kane.expression_graph import Formulas, Function
from .._kane.right_hand_side import output_names, outputs_at
from .._scalarjit.graph import needed
from .._system.system import State, System, packed, unit_of
from .._version import __version__
from ._filter import all_rates
from ._source import CText, in_comment, six_a_line, variable_units


class Variable(NamedTuple):
    """A variable of an FMU. All variables are numbers in float64.

    Fields:

    - `name`, `unit`, `description`: texts, which may be empty except for the name.
    - `causality`, `variability`, `initial`: as FMI defines them. `initial` is "" for inputs and the time.
    - `start`: the start value, or None if it is computed.
    - `bounds`: lower and upper bound, inclusive.
    - `derivative`: for the rate of a state the place of the state among the variables.
    - `dependencies`: the places of states, inputs and the time that determine it; None for variables that are given.
    """

    name: str
    causality: str
    variability: str = "continuous"
    initial: str = ""
    start: float | None = None
    unit: str = ""
    description: str = ""
    bounds: tuple[float, float] = (-np.inf, np.inf)
    derivative: int | None = None
    dependencies: tuple[int, ...] | None = None


class Crossings(NamedTuple):
    """The events of a system, and the sign of det C_dep if it can change.

    Fields: `names`; `directions`, 1, -1 or 0; `jumps`, whether an event changes the state, otherwise it ends the
    simulation; `conditions`, the place of the condition of an event, or -1; `n_conditions`.
    """

    names: tuple[str, ...]
    directions: tuple[int, ...]
    jumps: tuple[bool, ...]
    conditions: tuple[int, ...]
    n_conditions: int


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
        which = stages_of(self.events)

        def sensed(system, t, q, u, w, _):
            values = outputs_at(system, t, q, u, w) if self.outputs else {}
            u_dep = dependent_speeds(system, t, q, u) if system.dependent_speeds else ()
            return (jnp.stack([*u_dep, *(values[name] for name in self.outputs)]),)

        def after_jump(event):
            return lambda system, t, q, u, w, _: (after_stages(system, t, _packed(system, q, u, w), event, which)[0],)

        more = {"motion": Function(("rate",), all_rates)}
        if self.outputs or system.dependent_speeds:
            more["outputs"] = Function(("sensed",), sensed)
        if self.events.names or system.dependent_speeds:
            more["events"] = Function(("g", "g_dot", "condition"), _events)
            more["event functions"] = Function(("g",), _event_functions)
        self.jumps = [i for i, stages in enumerate(self.events.stages) if stages]
        for i in self.jumps:
            more[_jump_name(self.events.names[i])] = Function(("after",), after_jump(i))
        super().__init__(Formulas(system, "float64", more), name)
        self.functions, self.step = more, step
        self.states = (*system.coordinates, *system.speeds, *system.states)
        self.start = np.asarray(packed(start), np.float64)
        self.moved = [system.coordinates.index(name) for name in system.dependent_coordinates or system.coordinates]
        self.input_words = self._words()
        self._write_formulas()
        self.variables = self._variables()

    def _words(self) -> dict[int, str]:
        """The C expressions of the input nodes: states are in y, inputs in w, parameters in p."""
        formulas, system = self.formulas, self.formulas.system
        n_motion = len(system.coordinates) + len(system.speeds)
        words = {
            "t": ["t"],
            "q": [f"y[{i}]" for i in range(len(system.coordinates))],
            "u": [f"y[{i}]" for i in range(len(system.coordinates), n_motion)],
            "inputs": [f"w[{i}]" for i in range(len(system.inputs))]
            + [f"y[{n_motion + i}]" for i in range(len(system.states))],
            "parameters": [f"p[{i}]" for i in range(len(formulas.names("parameters")))],
        }
        self.direction: dict[int, np.ndarray] = {}
        in_order = {kind: iter(texts) for kind, texts in words.items()}
        by_node = {}
        for i, (a, nodes) in enumerate(zip(formulas.arguments, formulas.inputs, strict=True)):
            if a.kind in words:
                seeds = np.empty(nodes.shape, np.int64)
                for e, k in enumerate(nodes.flat):
                    text = next(in_order[a.kind])
                    place = (len(formulas.arguments) + i, e, len(a.elements))
                    seeds.flat[e] = formulas.graph.add("input", place, formulas.dtype)
                    by_node[int(k)], by_node[int(seeds.flat[e])] = text, f"d{text}"
                self.direction[i] = seeds
        return by_node

    def _write_formulas(self) -> None:
        """All functions as nodes."""
        formulas, empty = self.formulas, np.zeros(0, np.int64)

        def nodes_of(function: str, n: int = 1) -> list[np.ndarray]:
            return [*formulas.nodes(function).values()] if function in self.functions else [empty] * n

        (self.rate,), (self.sensed,) = nodes_of("motion"), nodes_of("outputs")
        self.g, self.g_dot, self.condition = nodes_of("events", 3)
        names, directions, jumps, conditions = self.events[0], self.events[1], self.events[2], self.events[3]
        if formulas.system.dependent_speeds:  # the last event function is det C_dep
            if self._inputs_of(self.g[-1]):
                names, directions, jumps, conditions = (
                    (*names, "singular speeds"), (*directions, 0), (*jumps, 0), (*conditions, None),
                )  # fmt: skip
            else:
                self.g, self.g_dot = self.g[:-1], self.g_dot[:-1]
        places = tuple(-1 if place is None else place for place in conditions)
        self.crossings = Crossings(names, directions, tuple(map(bool, jumps)), places, len(self.condition))
        (self.h,) = formulas.nodes("configuration_residuals").values()
        (self.G,) = formulas.derivatives(
            "configuration_residuals", [formulas.directions("q")[i] for i in self.moved]
        ).values()
        slopes = {
            function: formulas.directional_derivative(function, self.direction)[0]
            for function in ("motion", "outputs", "event functions")
            if function in self.functions
        }
        self.slopes = {
            "rate": slopes["motion"],
            "sensed": slopes.get("outputs", empty),
            "g": slopes.get("event functions", empty)[: len(names)],
        }

    def _inputs_of(self, *nodes: Any) -> set[str]:
        """The C expressions of the inputs of some nodes."""
        graph = self.formulas.graph.nodes
        found = needed(graph, [np.atleast_1d(np.asarray(x, np.int64)) for x in nodes])
        return {self.input_words[k] for k in found if graph[k].operation == "input"}

    def _variables(self) -> list[Variable]:
        formulas, system = self.formulas, self.formulas.system
        units = variable_units(system)
        variables = [Variable("time", "independent", unit="s", description="time")]
        variables += [x for x, _ in self._parameters()]
        places = {"t": 0}
        for i, name in enumerate(system.inputs):
            places[f"w[{i}]"] = len(variables)
            variables.append(Variable(name, "input", start=0.0, unit=units[name], description="input"))
        kinds = ["coordinate"] * len(system.coordinates) + ["independent speed"] * len(system.speeds)
        kinds += ["first-order state"] * len(system.states)
        first_state, solved = len(variables), set(self.moved if self.h.size else ())
        for i, (name, kind) in enumerate(zip(self.states, kinds, strict=True)):
            places[f"y[{i}]"] = len(variables)
            text = f"{kind}; its start value is a guess, because the constraints determine it" if i in solved else kind
            initial, x = "approx" if i in solved else "exact", float(self.start[i])
            variables.append(
                Variable(name, "output", initial=initial, start=x, unit=units[name], description=text)
            )

        def computed(name: str, causality: str, node: Any, unit: str, text: str, state: int | None = None) -> None:
            read = tuple(sorted(places[word] for word in self._inputs_of(node) if word in places))
            variables.append(
                Variable(
                    name, causality, initial="calculated", unit=unit, description=text, derivative=state,
                    dependencies=read,
                )
            )  # fmt: skip

        for i, (name, node) in enumerate(zip(self.states, self.rate, strict=True)):
            rate_unit = _rate_of(units[name])
            computed(f"der({name})", "local", node, rate_unit, f"time derivative of {name}", first_state + i)
        names = [(name, units[name], "dependent speed") for name in system.dependent_speeds]
        names += [(name, unit_of(name, system.units), "output") for name in self.outputs]
        for (name, unit, text), node in zip(names, self.sensed, strict=True):
            computed(name, "output", node, unit, text)
        for name, node in zip(self.crossings.names, self.g, strict=True):
            computed(f"events.{name}", "local", node, "", f"event function of {name}")
        return _with_unique_names(variables)

    def _parameters(self) -> Iterable[tuple[Variable, bool]]:
        """The parameters as variables, and whether each of them must be positive, not only nonnegative."""
        formulas = self.formulas
        read = self._inputs_of(self.h)
        values = iter(np.concatenate([np.ravel(x) for x in formulas.values().values()] or [np.zeros(0)]))
        i = 0
        for a in formulas.of_kind("parameters"):
            lower, upper = a.info.within
            for name in a.elements:
                # A parameter of a configuration constraint cannot change during a simulation: the coordinates would
                # violate the constraint.
                variability = "fixed" if f"p[{i}]" in read else "tunable"
                text = "positive parameter" if a.info.positive else "parameter"
                bounds = (max(lower, 0.0) if a.info.positive else lower, upper)
                yield (
                    Variable(name, "parameter", variability, "exact", float(next(values)), a.info.unit, text, bounds),
                    a.info.positive,
                )
                i += 1

    def source(self, fmi: str, token: str) -> str:
        """The C source for a version of FMI."""
        system = self.formulas.system
        title = f"{self.formulas.name}: a functional mock-up unit of Kane's equations, written by jaxkane {__version__}."
        head, core = _sections("fmu_template.c")
        text = Template(head).substitute(
            title=in_comment(title),
            fmi=fmi,
            token=token,
            step=self.constant(self.step),
            parameters=len(self.formulas.names("parameters")),
            inputs=len(system.inputs),
            coordinates=len(system.coordinates),
            states=len(self.states),
            sensed=len(self.sensed),
            events=len(self.g),
            conditions=len(self.condition),
            constraints=len(self.h),
            moved=len(self.moved),
            singular=len(self.events.names) if len(self.g) > len(self.events.names) else -1,
        )
        return "\n".join([text, self._arrays(), self._functions(), core, _file(f"fmu_{fmi[0]}_template.c")])

    def _arrays(self) -> str:
        parameters = [*self._parameters()]
        bounds = [x.bounds for x, _ in parameters]
        crossings = self.crossings
        lines = ["/* Parameters and states. */"]
        lines += [in_comment(f"/* p[{i}]: {_labelled(x)}").strip() + " */" for i, (x, _) in enumerate(parameters)]
        groups = {"w": self.formulas.system.inputs, "y": self.states}
        lines += [f"/* {word}[{i}]: {in_comment(x)} */" for word, names in groups.items() for i, x in enumerate(names)]
        lines += [
            self.array("default_p", np.array([x.start for x, _ in parameters])),
            self.array("default_y", self.start),
            self.array("lower", np.array([lower for lower, _ in bounds])),
            self.array("upper", np.array([upper for _, upper in bounds])),
            _integers("is_positive", [is_positive for _, is_positive in parameters]),
            _integers("is_fixed", [x.variability == "fixed" for x, _ in parameters]),
            _strings("parameter_names", [x.name for x, _ in parameters]),
            _integers("moved", self.moved),
            _strings("event_names", crossings.names),
            _integers("directions", crossings.directions),
            _integers("is_end", [not jumps for jumps in crossings.jumps]),
            _integers("condition_of", crossings.conditions),
        ]
        return "\n".join(lines) + "\n"

    def _functions(self) -> str:
        """The equations: rates, dependent speeds and outputs, event functions, constraints, derivatives, jumps."""
        outputs = {
            "rate_of": {"rate": self.rate},
            "sensed_of": {"sensed": self.sensed},
            "events_of": {"g": self.g, "g_dot": self.g_dot, "condition": self.condition},
            "configuration_of": {"h": self.h, "G": self.G},
            "derivatives_of": self.slopes,
        }
        for i in self.jumps:
            outputs[f"jump_{i}"] = self.formulas.nodes(_jump_name(self.events.names[i]))
        texts = [*self.helpers([x for by_output in outputs.values() for x in by_output.values()])]
        for function, by_output in outputs.items():
            seeds = ("dt", "dy", "dw", "dp") if function == "derivatives_of" else ()
            read = ("t", "y", "w", "p", *seeds)
            arguments = ["double t", "const double *y", "const double *w", "const double *p"]
            arguments += ["double dt", "const double *dy", "const double *dw", "const double *dp"] if seeds else []
            arguments += [f"double *{output}" for output in by_output]
            body = self.body(read, by_output, self.input_words)
            texts.append(f"static void {function}({', '.join(arguments)}) {body}")
        cases = [f"    if (event == {i}) jump_{i}(t, y, w, p, after);\n" for i in self.jumps]
        arguments = "int event, double t, const double *y, const double *w, const double *p, double *after"
        default = "    (void)event, (void)t, (void)w, (void)p;\n    memcpy(after, y, N_Y * sizeof(double));\n"
        texts.append(f"static void jump_of({arguments}) {{\n{default}{''.join(cases)}}}\n")
        return "\n".join(texts)


def _packed(system: System, q: Any, u: Any, w: Any) -> jax.Array:
    return packed(State(q, u, jnp.stack([w[name] for name in system.states]) if system.states else None))


def _events(system, t, q, u, w, _):
    """Event functions and det C_dep, their rates, and the conditions. The rate of det C_dep is not needed."""
    values = event_values(system, t, _packed(system, q, u, w), all_rates(system, t, q, u, w, _)[0])
    if not system.dependent_speeds:
        return values.values, values.rates, values.conditions
    rates = jnp.append(values.rates, jnp.zeros((), values.rates.dtype))
    return jnp.append(values.values, values.bound), rates, values.conditions


def _event_functions(system, t, q, u, w, _):
    values = event_values(system, t, _packed(system, q, u, w), None)
    return (jnp.append(values.values, values.bound) if system.dependent_speeds else values.values,)


def _jump_name(event: str) -> str:
    return f"`then` of the event {event}"


def _rate_of(unit: str) -> str:
    return f"{unit[:-2]}/s^2" if unit.endswith("/s") else f"{unit}/s" if unit else ""


def _labelled(x: Variable) -> str:
    return f"{x.name}, {x.description}{f' [{x.unit}]' if x.unit else ''}"


def _with_unique_names(variables: list[Variable]) -> list[Variable]:
    """The variables with unique names. Inputs, states and outputs keep theirs. A parameter may have the same name as a
    coordinate; then it is called "parameters.NAME"."""
    taken, result = {x.name for x in variables if x.causality in ("input", "output")}, []
    for x in variables:
        name = x.name
        if x.causality not in ("input", "output"):
            if name in taken and x.causality == "parameter":
                name = f"parameters.{name}"
            while name in taken:
                name += "_"
            taken.add(name)
        result.append(x._replace(name=name))
    return result


def _integers(name: str, numbers: Sequence[Any]) -> str:
    return f"static const int {name}[] = {{\n    {six_a_line([str(int(x)) for x in numbers] or ['0'])}\n}};"


def _strings(name: str, texts: Sequence[str]) -> str:
    literals = [f'"{_escaped(text)}"' for text in texts]
    return f"static const char *const {name}[] = {{\n    {six_a_line(literals or ['0'])}\n}};"


def _escaped(text: str) -> str:
    """A text inside a string literal. A question mark could begin a trigraph."""
    return re.sub(r'(["\\?])', r"\\\1", text)


def _file(name: str) -> str:
    return (Path(__file__).parent / name).read_text(encoding="utf-8")


def _sections(name: str) -> list[str]:
    """The sections of a template. Each section follows a line `// name`."""
    return re.split(r"^// \w+\n", _file(name), flags=re.MULTILINE)[1:]
