"""Export a Kalman filter with its model as one C99 header, for example for an embedded controller.

The equations and their derivatives are generated from a graph, as in `jaxkane.export.c`. The code around them, the
steps of `jaxkane.estimate.predict` and `update`, is a template that is the same for all systems. This module does not
compile or run C code.
"""

from __future__ import annotations

import re
from pathlib import Path
from string import Template
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._common.files import write_file
from .._common.lookup import real_number
from .._integrate.inputs import Coordinates, Speeds
from .._kane.arguments import is_concrete
from .._kane.constraint_residuals import coordinate_weights
from .._kane.expression_graph import Formulas, Function
from .._kane.kanes_method import motion_rates_by_matrix
from .._kane.right_hand_side import rates
from .._scalarjit.graph import NotScalarError
from .._system.system import System
from .._version import __version__
from ..estimate import Belief, Filter, predict, update
from ..estimate._filter import sensed
from ..estimate._filter_step import MODES
from ._source import COMPARE, C, CText, in_comment, listed, sections_of, variable_units


class ExportedFilter(NamedTuple):
    """Paths of the files that `jaxkane.export.c_filter` has written."""

    header: Path
    test: Path


def c_filter(
    filter: Filter,
    path: str | Path,
    belief: Belief,
    *,
    name: str | None = None,
    dtype: str = "float64",
    dt: float = 0.01,
) -> ExportedFilter:
    """Export a Kalman filter with its model as one C99 header. It requires only the C mathematical library.

        belief = jk.estimate.begin(filter, state, {"roll": 0.1, "roll_rate": 0.1})
        jk.export.c_filter(filter, "generated/roll.h", belief)
        # cc -std=c99 -O3 generated/roll_test.c -lm -o test && ./test

    In C, with NaN for sensors that were not measured:

        roll_belief belief = roll_start;
        roll_innovation innovation;
        roll_predict(&belief, &roll_default, 0.01, inputs);
        roll_update(&belief, &roll_default, measured, inputs, 0, &innovation);

    These functions correspond to `jaxkane.estimate.predict` and `update`. They use arrays of fixed size on the stack,
    and neither allocate memory nor keep data between calls. `roll_default` contains the parameters, the standard
    deviations of the sensors and the spectral densities. Copy it to use other values. Comments in the header state the
    order and the units of all arrays. Do not compile with `-ffast-math`, because the code tests for NaN.

    **Arguments:**

    - `filter`: a `jaxkane.estimate.Filter`.
    - `path`: path of the header, "FOLDER/NAME.h". The folder is created. A test program `NAME_test.c` is written to the
        same folder. It compares some steps with results of JAX.
    - `belief`: the initial belief, as returned by `jaxkane.estimate.begin`. In C, it is `NAME_start`.
    - `name`: prefix of all names in C. The default is the name of the file.
    - `dtype`: "float64" for `double`, "float32" for `float`.
    - `dt`: time step of the test program [s].

    **Returns:** the paths `header` and `test`.

    **Raises:** `TypeError` if `filter` is not a `Filter` or is traced. `ValueError` for a belief of another filter, for
    numbers that are not finite, and for a `dt` that is not positive. As in `jaxkane.export.c`, also for operations that
    cannot be written with scalars.
    """
    if not isinstance(filter, Filter):
        raise TypeError(f"c_filter needs a jaxkane.estimate.Filter, got {filter!r}.")
    m, n = filter.lag + 1, len(filter.names)
    if not isinstance(belief, Belief) or np.shape(belief.root) != (m, n, m * n):
        raise ValueError("c_filter: `belief` does not fit this filter. Pass the result of jaxkane.estimate.begin.")
    if not is_concrete(filter, belief):
        raise TypeError("c_filter: the filter or the belief is traced. Call it outside of jax.jit, vmap and grad.")
    if not all(np.all(np.isfinite(x)) for x in (belief.t, belief.mean, belief.root)):
        raise ValueError("c_filter: `belief` contains numbers that are not finite.")
    if not 0 < real_number(dt, "c_filter: `dt`") < np.inf:
        raise ValueError(f"c_filter: the time step `dt` [s] must be positive and finite, got {dt!r}.")
    path = Path(path).with_suffix(".h")
    text = _FilterText(filter, belief, name or path.stem, dtype)
    files = ExportedFilter(path, path.with_name(f"{path.stem}_test.c"))
    for file, content in zip(files, (text.header(), text.test(path.name, dt)), strict=True):
        write_file(file, content)
    return files


class _FilterText(CText):
    def __init__(self, filter: Filter, belief: Belief, name: str, dtype: str):
        self.filter, self.belief, system = filter, belief, filter.system
        more = {"all_rates": Function(("rate",), all_rates)}
        more["sensed"] = Function(("z",), lambda system, *args: (sensed(system, filter.sensors, *args[:-1]),))
        more["weights"] = Function(("weight",), lambda system, t, q, *_: (coordinate_weights(system, t, q),))
        formulas = Formulas(system, dtype, more)
        super().__init__(formulas, name)
        inputs = formulas.directions("inputs")
        of_parameter = dict(zip(formulas.names("parameters"), formulas.directions("parameters"), strict=True))
        self.of_input = dict(zip(system.inputs, inputs, strict=False))
        self.rows = [*system.coordinates, *system.speeds, *system.states]  # quantities that have a rate
        self.estimated = [*formulas.directions("q"), *formulas.directions("u"), *inputs[len(system.inputs) :]]
        self.estimated += [of_parameter[name] for name in filter.parameters]
        places = [(len(formulas.arguments), i, len(filter.noise)) for i in range(len(filter.noise))]
        self.noise = [formulas.graph.add("input", place, formulas.dtype) for place in places]

    def _words(self, is_disturbed: bool) -> dict[int, str]:
        """The C expressions of input nodes: the estimated state is in v, inputs are in w, all others in *p."""

        def node_of(place: tuple[int, int]) -> int:
            return int(self.formulas.inputs[place[0]].flat[place[1]])

        words = self.input_words | {k: f"e[{i}]" for i, k in enumerate(self.noise)}
        words |= {node_of(place): f"v[{i}]" for i, place in enumerate(self.estimated)}
        for i, (name, place) in enumerate(self.of_input.items()):
            noise = f" + e[{self.filter.noise.index(name)}]" if is_disturbed and name in self.filter.noise else ""
            words[node_of(place)] = f"(w[{i}]{noise})" if noise else f"w[{i}]"
        return words

    def _model(self) -> str:
        """The system as C functions: rates, sensors, residuals of constraints, and derivatives."""
        formulas, filter, n = self.formulas, self.filter, len(self.estimated)
        is_extended = filter.method == "extended"
        rates_of, sensed_of = formulas.nodes("all_rates"), formulas.nodes("sensed")
        if is_extended:
            of_inputs = [self.of_input[name] for name in filter.noise if name in self.of_input]
            (slope,) = formulas.derivatives("all_rates", [*self.estimated, *of_inputs]).values()
            by_input = iter(slope[:, n:].T)

            def number(x: float) -> int:
                return formulas.graph.constant(float(x), formulas.dtype)

            columns = [
                next(by_input) if name in self.of_input else [number(name == row) for row in self.rows]
                for name in filter.noise
            ]
            rates_of = rates_of | {"slope": np.column_stack([slope[:, :n], *columns])}
            (slope,) = formulas.derivatives("sensed", self.estimated).values()
            sensed_of = sensed_of | {"slope": slope}
        else:  # noise of a rate is added to the rate
            (rate,) = rates_of.values()
            noise = {name: e for name, e in zip(filter.noise, self.noise, strict=True) if name in self.rows}

            def add(x: int, e: int) -> int:
                return formulas.graph.add("add", (int(x), e), formulas.dtype)

            disturbed = [add(x, noise[row]) if row in noise else x for row, x in zip(self.rows, rate, strict=True)]
            rates_of = {"rate": np.array(disturbed)}
        functions = {"rates": rates_of, "sensed": sensed_of}
        (h,) = formulas.nodes("configuration_residuals").values()
        if h.size:
            (G,) = formulas.derivatives("configuration_residuals", self.estimated).values()
            functions["constraints"] = {"h": h, "G": G, **formulas.nodes("weights")}
        helpers = self.helpers([x for outputs in functions.values() for x in outputs.values()])
        text = "\n".join([*helpers, *(self._function(*item) for item in functions.items())])
        return re.sub(r"\b(larger|smaller)\(", rf"{self.name}_\1(", text)

    def _function(self, function: str, outputs: dict[str, np.ndarray]) -> str:
        is_disturbed = function == "rates" and self.filter.method == "unscented"
        arguments = [f"{self.type} t", *(f"const {self.type} *{x}" for x in ("v", "w", *["e"] * is_disturbed))]
        arguments.append(f"const {self.name}_parameters *p")
        try:
            text = self.function(f"{self.name}_{function}", arguments, outputs, self._words(is_disturbed))
        except NotScalarError as error:
            raise ValueError(
                f"{self.formulas.name}: the filter cannot be written in C, because it contains {error}."
            ) from None
        return f"static inline {text}"

    def header(self) -> str:
        formulas, filter = self.formulas, self.filter
        has_constraints = formulas.nodes("configuration_residuals")["h"].size
        constraints = "with_constraints" if has_constraints else "without_constraints"
        text = _template("header", "common", constraints, filter.method, "end")
        units, eps = variable_units(filter.system), float(np.finfo(formulas.dtype).eps)
        of_parameter = {a.name: a.info.unit for a in formulas.of_kind("parameters")}
        in_mean = [*(units.get(name) for name in self.rows), *(of_parameter[name] for name in filter.parameters)]

        return text.substitute(
            title=in_comment(f"{formulas.name}: a Kalman filter, {filter.method}, written by jaxkane {__version__}"),
            name=self.name,
            NAME=self.name.upper(),
            real=self.type,
            s=C.suffix[formulas.dtype],
            n=len(self.estimated),
            rates=len(self.rows),
            coordinates=len(filter.system.coordinates),
            constraints=has_constraints,
            sensors=len(filter.sensors),
            noise=len(filter.noise),
            noise_size=max(1, len(filter.noise)),
            parameters=len(filter.parameters),
            parameters_size=max(1, len(filter.parameters)),
            times=filter.lag + 1,
            substeps=filter.substeps,
            modes=MODES,
            eps=eps,
            rank=eps ** (2 / 3),
            new_row=eps**0.75,
            of_mean=listed("mean", filter.names, in_mean),
            of_sensors=listed("measured", filter.sensors, [units.get(name) for name in filter.sensors]),
            of_inputs=listed("inputs", filter.system.inputs, [units.get(name) for name in filter.system.inputs]),
            of_noise=listed("density", filter.noise),
            of_drift=listed("drift", filter.parameters),
            parameters_struct="\n".join(self.struct()),
            default=self.default(),
            sigma=self.numbers(filter.sigma),
            density=self.numbers(filter.density),
            drift=self.numbers(filter.drift),
            start_t=self.numbers(self.belief.t),
            start_mean=self.numbers(self.belief.mean),
            start_root=self.numbers(self.belief.root),
            model=self._model(),
        )

    def test(self, header: str, dt: float) -> str:
        """A C program that performs some steps and compares the belief with the result of JAX."""
        steps, after = self._steps(dt)
        tolerance = "1e-11" if self.formulas.dtype == "float64" else "2e-3"
        n, k = after.mean.size, after.root.shape[2]
        root = np.reshape(after.root, (n, k))
        lines = [f"/* {in_comment(self.formulas.name)}: some steps of the filter. */", f'#include "{header}"\n']
        lines += ["#include <stdio.h>", COMPARE.format(type=self.type, tolerance=tolerance)]
        calls = []
        for i, (inputs, measured, age) in enumerate(steps):
            lines += [self.array(f"inputs_{i}", inputs), self.array(f"measured_{i}", measured)]
            calls.append(f"{self.name}_predict(&belief, &{self.name}_default, {self.constant(dt)}, inputs_{i});")
            update = f"{self.name}_update(&belief, &{self.name}_default, measured_{i}, inputs_{i}, {age}, &innovation)"
            calls.append(f"wrong += {update};")
        lines += [self.array("mean", np.asarray(after.mean)), self.array("covariance", root @ root.T), ""]
        steps_in_c = "\n    ".join(calls)
        lines.append(_template("test").substitute(name=self.name, real=self.type, n=n, k=k, steps=steps_in_c))
        return "\n".join(lines)

    def _steps(self, dt: float) -> tuple[list[tuple[np.ndarray, np.ndarray, int]], Belief]:
        """Inputs, measurements and ages of some steps (one gap, one late measurement), and the belief after them."""
        filter, belief, steps = self.filter, self.belief, []
        for i in range(4):
            inputs = 0.1 * np.sin(1.0 + i + np.arange(len(filter.system.inputs)))
            given, age = dict(zip(filter.system.inputs, inputs, strict=True)), filter.lag * (i == 3)
            belief = predict(filter, belief, dt, given)
            nothing = jnp.full(len(filter.sensors), jnp.nan)
            expected = np.asarray(update(filter, belief, nothing, given, age=age)[1].predicted)
            measured = expected + np.asarray(filter.sigma) * np.cos(2.0 * i + np.arange(len(expected)))
            if i == 1:
                measured[-1] = np.nan
            belief, _ = update(filter, belief, jnp.asarray(measured), given, age=age)
            steps.append((inputs, measured, age))
        return steps, jax.tree.map(np.asarray, belief)


def _template(*sections: str) -> Template:
    by_name = sections_of("filter_template.h")
    return Template("".join(by_name[name] for name in sections))


def all_rates(system: System, t: Array, q: Coordinates, u: Speeds, w: dict[str, Array], _: Array):
    """Rates of coordinates, independent speeds and first-order states, as one vector."""
    rows = [*motion_rates_by_matrix(system, t, q, u, w)]
    if system.states:
        rows.append(jnp.asarray(rates(system, t, q, u, w).x))
    return (jnp.concatenate(rows),)
