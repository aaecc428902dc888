"""Exported equations, compiled or loaded, give the results of the library. Errors name unsupported systems."""

import ctypes
import functools
import importlib.util
import os
import re
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import Bob, Odd, Part, case
from operations import ODD, OPERATIONS

import jaxkane as jk
from jaxkane.bicycles import Bicycle, ConstantSpeed, Drag

CC = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
needs_compiler = pytest.mark.skipif(CC is None, reason="no C compiler")
JACOBIANS = ("state_jacobian", "parameter_jacobian", "input_jacobian")
STRICT = ("-std=c99", "-Wall", "-Wextra", "-pedantic", "-Werror")


def by_library(system, t, q, u, w, functions):
    """The library's own numbers, by its public functions and JAX's derivatives of them."""
    given = lambda w: dict(zip(system.inputs, w, strict=True))  # noqa: E731

    def rates(system, q, u, w):
        rates = jk.coordinate_rates(system, t, q, u), jk.accelerations(system, t, q, u, given(w))
        return jnp.concatenate(rates)

    @functools.cache
    def jacobians():
        return jax.jit(jax.jacfwd(rates, (0, 1, 2, 3)))(system, q, u, w)

    def jacobian(*places):
        n = len(q) + len(u)
        blocks = [np.reshape(x, (n, -1)) for i in places for x in jax.tree.leaves(jacobians()[i])]
        return np.concatenate(blocks, axis=1)

    ways = {
        "rates": lambda: (jk.coordinate_rates(system, t, q, u), jk.accelerations(system, t, q, u, given(w))),
        "equations": lambda: jk.equations_of_motion(system, t, q, u, given(w)),
        "dependent_speeds": lambda: [jk.dependent_speeds(system, t, q, u)],
        "constraint_jacobian_rate": lambda: [jk.constraint_jacobian_rate(system, t, q, u)],
        "partial_velocities": lambda: jk.partial_velocities(system, t, q, u, given(w)),
        "kinetic_energy": lambda: [jk.kinetic_energy(system, t, q, u)],
        "state_jacobian": lambda: [jacobian(1, 2)],
        "parameter_jacobian": lambda: [jacobian(0)],
        "input_jacobian": lambda: [jacobian(3)],
    }
    return {function: [np.asarray(x) for x in ways[function]()] for function in functions}


def assert_close(found, expected, rtol, what=""):
    """To the size of the largest entry: a small one may be a difference of large ones."""
    assert len(found) == len(expected)
    for x, y in zip(found, expected, strict=True):
        assert np.shape(x) == y.shape, what
        np.testing.assert_allclose(x, y, rtol=0, atol=rtol * np.abs(y).max(initial=1e-3), err_msg=what)


def library_of(files, folder):
    """The functions of a C source, compiled."""
    target = folder / f"{files.source.stem}.so"
    subprocess.run([CC, *STRICT, "-O1", "-shared", "-fPIC", files.source, "-o", target, "-lm"], check=True)
    return ctypes.CDLL(str(target))


def call(library, name, t, arrays, outputs, real=ctypes.c_double):
    pointer = lambda x: x.ctypes.data_as(ctypes.POINTER(real))  # noqa: E731
    kind = np.dtype(real)
    arrays = [np.ascontiguousarray(x, kind) for x in arrays]
    found = [np.full(shape, np.nan, kind) for shape in outputs]
    getattr(library, name)(real(t), *map(pointer, arrays), *map(pointer, found))
    return found


SYSTEMS = ["DoublePendulum", "Odd", "Bob"]
# Of the catalogue those with most to go wrong; `test_symbolic` has the same formulas of all.
SLOW = [
    pytest.param(name, marks=pytest.mark.weekly) for name in ("Aircraft", "SpatialDoublePendulum", "WhippleBicycle")
]


# Who is told that something makes the library slow, is told so by other tests.
pytestmark = pytest.mark.filterwarnings("ignore:.*its description uses")


@pytest.mark.weekly
@needs_compiler
@pytest.mark.parametrize("name", [*SYSTEMS, *SLOW])
def test_values_and_derivatives_in_c_agree_with_the_library(name, tmp_path):
    rtol, of_derivatives = 1e-13, 1e-12
    system, t, q, u, w = case(name)
    files = jk.export.c(system, tmp_path / "generated" / f"{name}.c")
    every = ("rates", "equations", "dependent_speeds", *JACOBIANS)
    functions = [f for f in every if f"_{f}(" in files.header.read_text()]
    assert ("dependent_speeds" in functions, "input_jacobian" in functions) == (
        bool(system.dependent_speeds), bool(system.inputs)
    )  # fmt: skip
    library = library_of(files, tmp_path)
    numbers = np.concatenate([x.ravel() for x in jk.export.parameters(system).values()])
    for function, expected in by_library(system, t, q, u, w, functions).items():
        found = call(library, f"{name}_{function}", t, [q, u, w, numbers], [x.shape for x in expected])
        assert_close(found, expected, of_derivatives if function in JACOBIANS else rtol, function)


class Bare(jk.System):
    coordinates, speeds = ("x",), ("v",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(1.0, 0.0, O.moving(q["x"] * N.x, u["v"] * N.x))])


class Balanced(Bare):
    """A particle between two equal forces: 0.1 * 3 - 0.3 is 5.6e-17."""

    left: jk.Scalar = jk.parameter(0.1)
    right: jk.Scalar = jk.parameter(0.3)

    def loads(self, t, q, u, motion, inputs):
        return jk.Force((3.0 * self.left - self.right) * motion.N.x, motion.bodies[0])


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize(
    ("make", "dtype", "changes"),
    [
        (Odd, "float64", {"": 0, "1.1 * ": 1}),
        pytest.param(Odd, "float32", {"": 0, "1.1f * ": 1}, marks=pytest.mark.weekly),
        (Balanced, "float64", {"": 0, "1e-17 + ": 0, "1e-3 + ": 1, "NAN + ": 1}),  # the size of the terms is 0.3 N
    ],
)
def test_the_test_program_passes_and_detects_errors(make, dtype, changes, tmp_path):
    files = jk.export.c(make(), tmp_path / "it.c", dtype=dtype)
    right = files.source.read_text()
    for change, status in changes.items():
        files.source.write_text(re.sub(r"(u_dot\[\d\] = )", rf"\g<1>{change}", right))
        subprocess.run([CC, *STRICT, "-O0", files.source, files.test, "-lm", "-o", tmp_path / "test"], check=True)
        run = subprocess.run([tmp_path / "test"], capture_output=True, text=True)
        assert run.returncode == status, (change, run.stdout)


@needs_compiler
@pytest.mark.skipif(shutil.which("c++") is None, reason="no C++ compiler")
def test_the_header_compiles_as_cpp(tmp_path):
    files = jk.export.c(Odd(), tmp_path / "double.c", functions=("rates",))
    command = ["c++", "-x", "c++", "-Wall", "-Werror", "-fsyntax-only", files.header]
    subprocess.run(command, check=True)
    header = files.header.read_text()
    for line in ("double register_; /* register [kg * /] */", "double theta0; /* θ0 */", "double moments[3];"):
        assert line in header
    assert "double part_mass; /* part.mass [kg] */" in header
    assert "inputs[0]: for" in header
    assert "q[0]: angle [rad]" in header
    assert "void double__rates(" in header


def test_parameters_with_similar_names_have_unique_identifiers(tmp_path):
    """ "extra[0].mass" and a field "extra_0_mass" would be one identifier."""

    class Cart(jk.System):
        extra: tuple[Part, ...] = (Part(mass=2.0), Part(mass=3.0))
        extra_0_mass: jk.Scalar = jk.parameter(5.0)
        extra_0__mass: jk.Scalar = jk.parameter(7.0)
        coordinates, speeds = ("x",), ("v",)

        def motion(self, t, q, u):
            N, O = jk.inertial()
            mass = self.extra[0].mass + 10.0 * self.extra[1].mass
            return jk.Motion([jk.Body(mass, 0.0, O.moving(q[0] * N.x, u[0] * N.x))])

        def loads(self, t, q, u, motion, inputs):
            return jk.Force((100.0 * self.extra_0_mass + 1000.0 * self.extra_0__mass) * motion.N.x, motion.bodies[0])

    header = jk.export.c(Cart(), tmp_path / "cart.c", ("equations",)).header.read_text()
    members = re.findall(r"double (\w+);(?: /\* (\S+))?", header)
    names = ["extra[0].mass", "extra[1].mass", "extra_0_mass", "extra_0__mass"]
    assert list(jk.export.parameters(Cart())) == names
    assert len(members) == len({member for member, _ in members}) == 4
    assert [own or member for member, own in members] == names
    module = {}
    exec(jk.export.numpy(Cart(), functions=("equations",)), module)
    assert [float(x.squeeze()) for x in module["equations"](0.0, [0.0], [0.0])] == [32.0, 7500.0]


@pytest.mark.parametrize(
    ("name", "expected"),
    {"θ̈": "theta", "int": "int_", "2x": "n2x", "Δ": "Delta", "车": "u8f66"}.items(),
)
def test_any_name_becomes_a_valid_identifier(name, expected, tmp_path):
    header = jk.export.c(Bare(), tmp_path / "it.c", ("kinetic_energy",), name=name).header.read_text()
    assert f"void {expected}_kinetic_energy(" in header


@pytest.mark.slow_cases(all_but=["Bob"])
@pytest.mark.parametrize("name", [*SYSTEMS, *SLOW])
def test_values_of_numpy_source_agree_with_the_library(name):
    rtol = 1e-13
    system, t, q, u, w = case(name)
    functions = ["rates", "equations", "partial_velocities", "kinetic_energy"]
    functions += ["dependent_speeds", "constraint_jacobian_rate"] * bool(system.dependent_speeds)
    text = jk.export.numpy(system, functions=functions)
    assert "jax." not in text
    module = {}
    exec(compile(text, name, "exec"), module)
    for function, expected in by_library(system, t, q, u, w, functions).items():
        found = module[function](t, q, u, w)
        assert_close(found if isinstance(found, tuple) else [found], expected, rtol, function)
    values = {key: float(x) if x.ndim == 0 else x.tolist() for key, x in jk.export.parameters(system).items()}
    np.testing.assert_array_equal(
        module["rates"](t, list(q), list(u), parameters=values)[1],
        module["rates"](t, q, u, 0.0 * w)[1],
        err_msg="inputs that are left out are zero, and plain numbers will do",
    )


def test_numpy_export_of_names_with_dots_and_spaces():
    bar = {"mass": 2.0, "center": (0.0, 0.0, -0.2), "inertia": (0.03, 0.03, 0.002)}
    hinge = jk.joints.hinge("shoulder", (0, 1, 0), damping=0.1)
    arm = jk.joints.mechanism([jk.joints.Link("upper arm", joints=hinge, **bar)])
    module = {}
    exec(jk.export.numpy(arm, functions=("rates",)), module)
    heavy = {**module["PARAMETERS"], "mass.upper arm": 3.0}
    # (I_yy + m z^2) q_ddot = m g_z z sin(q) - c q_dot, with z = -0.2 and g_z = -9.81
    expected = (3.0 * 9.81 * 0.2 * -np.sin(0.4) - 0.1 * 0.5) / (0.03 + 3.0 * 0.04)
    np.testing.assert_allclose(module["rates"](0.0, [0.4], [0.5], parameters=heavy)[1], [expected], rtol=1e-14)


@pytest.mark.slow
def test_numpy_source_in_float32_is_written_and_returns_float32(tmp_path):
    rtol = 1e-5
    system, t, q, u, w = case("Odd")
    text = jk.export.numpy(system, tmp_path / "new" / "odd.py", ("rates", "state_jacobian"), dtype="float32")
    assert (tmp_path / "new" / "odd.py").read_text(encoding="utf-8") == text
    module = {}
    exec(text, module)
    found = [*module["rates"](t, q, u, w), module["state_jacobian"](t, q, u, w)]
    assert {x.dtype for x in found} == {np.dtype("float32")}
    expected = by_library(system, t, q, u, w, ("rates", "state_jacobian"))
    assert_close(found, [*expected["rates"], *expected["state_jacobian"]], rtol)


@pytest.mark.slow
def test_derivatives_at_the_boundaries_of_branches():
    """Beside and on the edges of `where`, sqrt, sign, max and min: sides that are not taken have no derivative."""
    rtol = 1e-12
    system, t, q, u, w = case("Odd")
    given = dict(zip(system.inputs, w, strict=True))
    rates = lambda x: jk.accelerations(system, t, x[:2], x[2:], given)  # noqa: E731
    jacobian = jax.jit(jax.jacfwd(rates))
    module = {}
    exec(jk.export.numpy(system, functions=("state_jacobian",)), module)
    ways = [lambda q: module["state_jacobian"](t, q, u, w)[2:]]
    if importlib.util.find_spec("casadi"):
        f = jk.export.casadi(system)
        J = f.jacobian()
        numbers = np.concatenate([x.ravel() for x in jk.export.parameters(system).values()])

        def by_casadi(q):
            blocks = J(t, q, u, w, numbers, *f(t, q, u, w, numbers))
            return np.hstack([np.array(blocks[6]), np.array(blocks[7])])

        ways.append(by_casadi)
    for x0 in (-0.4, float(system.θ0), 0.0, 0.25):
        at = np.array([q[0], x0])
        expected = np.asarray(jacobian(np.concatenate([at, u])))
        assert np.all(np.isfinite(expected))
        for way in ways:
            assert_close([way(at)], [expected], rtol)


# What no number comes of, and which of two zeros, in source that others compile: bit for bit as XLA has it.

X = np.array([0.0, -0.0, 1.0, -1.0, np.inf, -np.inf, np.nan])
TAKEN = np.random.default_rng(0).normal(size=3)


def odd(x):
    return [f(x[0]) for f in ODD.values()]


def every(x):
    return [f(x) for name, f in OPERATIONS.items()]


def every_in_float64(x):
    return [f(x) for name, f in OPERATIONS.items() if name != "other precision"]


def flat(f):
    return lambda x: jnp.concatenate([jnp.ravel(y).astype(x.dtype) for y in jax.tree.leaves(f(x))])


def of_states(f):
    """A system whose first-order states have the rates f(inputs)."""
    n = jax.eval_shape(flat(f), TAKEN).size

    class Operated(Bare):
        inputs, states = ("a", "b", "c"), tuple(f"s{i}" for i in range(n))

        def state_rates(self, t, q, u, x, motion, now):
            return list(flat(f)(jnp.stack([now["a"], now["b"], now["c"]])))

    return Operated(), n


def in_c(f, folder):
    system, n = of_states(f)
    library = library_of(jk.export.c(system, folder / "f.c", ("state_rates",)), folder)
    none, states = np.zeros(1), np.zeros(n)
    return lambda x: call(library, "f_state_rates", 0.0, [none, none, np.concatenate([x, states]), none], [(n,)])[0]


def in_numpy(f, folder):
    (system, n), module = of_states(f), {}
    exec(jk.export.numpy(system, functions=("state_rates",)), module)

    def rates(x):
        with np.errstate(all="ignore"):
            return module["state_rates"](0.0, np.zeros(1), np.zeros(1), np.concatenate([x, np.zeros(n)]))

    return rates


def in_casadi(f, folder):
    pytest.importorskip("casadi")
    system, n = of_states(f)
    found = jk.export.casadi(system, "state_rates")
    return lambda x: np.array(found(0.0, [0.0], [0.0], np.concatenate([x, np.zeros(n)]), []))[:, 0]


IN_C = pytest.param(in_c, marks=needs_compiler)


@pytest.mark.slow_cases("in_c*", "in_casadi*")
@pytest.mark.parametrize(("language", "f"), [(in_c, every), (in_numpy, every), (in_casadi, every_in_float64)])
def test_every_operation_in_source(language, f, tmp_path):
    """But for float32 in CasADi, which is refused: see below."""
    found = language(f, tmp_path)(TAKEN)
    np.testing.assert_allclose(found, jax.jit(flat(f))(TAKEN), rtol=2e-13, atol=1e-14)


@pytest.mark.parametrize("language", [IN_C, in_numpy])
def test_nan_and_signed_zeros_in_exported_source(language, tmp_path):
    """Bit for bit, but for the sign of NaN, and for the zero that NumPy's maximum of two zeros is."""
    by_jax, by_source = jax.jit(flat(odd)), language(odd, tmp_path)
    for number in X:
        x = np.array([number, 0.0, 0.0])
        expected, found = np.asarray(by_jax(x)), by_source(x)
        np.testing.assert_array_equal(found, expected)
        if language is in_c:
            signed = ~np.isnan(expected)
            np.testing.assert_array_equal(np.signbit(found[signed]), np.signbit(expected[signed]))


@pytest.mark.weekly
def test_four_coupled_constraints_are_exported():
    """A bicycle that holds its speed: 1e-12 at a start that leans and steers, with another mass too."""
    bicycle = Bicycle.benchmark().with_parts(drive=(Drag(), ConstantSpeed(5.0)))
    start = jk.assemble(bicycle, {"roll": 0.1, "steer": -0.2}, {"roll_rate": 0.3, "steer_rate": -0.1})
    q, u, module = np.asarray(start.q), np.asarray(start.u), {}
    exec(jk.export.numpy(bicycle, functions=("rates",)), module)
    for other in (bicycle, bicycle.with_parts(mB=90.0)):
        rates = module["rates"](0.3, q, u, np.zeros(len(bicycle.inputs)), jk.export.parameters(other))
        expected = jk.coordinate_rates(other, 0.3, q, u), jk.accelerations(other, 0.3, q, u)
        assert_close(rates, [np.asarray(x) for x in expected], 1e-12)


# CasADi


@pytest.mark.parametrize("name", [*SYSTEMS, *SLOW])
def test_values_and_derivatives_in_casadi_agree_with_the_library(name):
    rtol, of_derivatives = 1e-13, 1e-12
    pytest.importorskip("casadi")
    system, t, q, u, w = case(name)
    numbers = np.concatenate([x.ravel() for x in jk.export.parameters(system).values()])
    expected = by_library(system, t, q, u, w, ("rates", "equations", "state_jacobian"))
    f = jk.export.casadi(system)
    assert f.name_in() == ["t", "q", "u", "inputs", "parameters"]
    assert f.name_out() == ["q_dot", "u_dot"]
    args = (t, q, u, w, numbers)
    assert_close([np.array(x)[:, 0] for x in f(*args)], expected["rates"], rtol)
    M, right = jk.export.casadi(system, "equations")(*args)
    assert_close([np.array(M), np.array(right)[:, 0]], expected["equations"], rtol)
    own = f.jacobian()(*args, *f(*args))  # by CasADi: q_dot and u_dot, each by t, q, u, inputs, parameters
    blocks = np.block([[np.array(own[1]), np.array(own[2])], [np.array(own[6]), np.array(own[7])]])
    ours = np.array(jk.export.casadi(system, "state_jacobian")(*args))
    for found in (blocks, ours):
        assert_close([found], expected["state_jacobian"], of_derivatives)


# StableHLO

ELSEWHERE = """
import sys
class Refuses:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("jaxkane", "equinox", "llvmlite"):
            raise ImportError(name)
sys.meta_path.insert(0, Refuses())
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
f = jax.export.deserialize(bytearray(open(sys.argv[1], "rb").read()))
given = dict(np.load(sys.argv[2]))
t, q, u, w = (given.pop(name) for name in ("t", "q", "u", "w"))
found = {}
for b in (1, 3):
    out = f.call(t[:b], q[:b], u[:b], w[:b], given)
    found |= {f"{i} of {b}": np.asarray(x) for i, x in enumerate(out)}
gradient = jax.grad(lambda q: f.call(t, q, u, w, given)[1].sum())(q)
np.savez(sys.argv[3], gradient=gradient, **found)
"""


@pytest.mark.weekly
def test_stablehlo_without_jaxkane_is_bit_identical_for_any_batch(on_cpu, tmp_path):
    rtol = 1e-13
    pytest.importorskip("flatbuffers")
    system, t, q, u, w = case("DoublePendulum")
    exported = jk.export.stablehlo(system, tmp_path / "it.stablehlo", derivatives=1)
    text = exported.mlir_module()
    assert text.count("custom_call") == text.count("@shape_assertion"), "something that only this process has"
    rng = np.random.default_rng(0)
    batch = {"t": np.full(3, t), "w": np.tile(w, (3, 1))}
    batch |= {"q": q + rng.normal(size=(3, 2)), "u": u + rng.normal(size=(3, 2))}
    np.savez(tmp_path / "given.npz", **batch, **jk.export.parameters(system))
    paths = [tmp_path / name for name in ("it.stablehlo", "given.npz", "found.npz")]
    little = {"JAX_DISABLE_MOST_OPTIMIZATIONS": str(jax.config.read("jax_disable_most_optimizations"))}
    subprocess.run([sys.executable, "-c", ELSEWHERE, *paths], env=os.environ | little, check=True)
    found = dict(np.load(tmp_path / "found.npz"))

    by_jit = jax.jit(exported.call)
    for b in (1, 3):
        for i, x in enumerate(
            by_jit(*(batch[name][:b] for name in ("t", "q", "u", "w")), jk.export.parameters(system))
        ):
            np.testing.assert_array_equal(found[f"{i} of {b}"], x)
    given = dict(zip(system.inputs, w, strict=True))
    rates = jax.vmap(lambda q, u: jk.accelerations(system, t, q, u, given))
    np.testing.assert_allclose(found["1 of 3"], rates(batch["q"], batch["u"]), rtol=rtol)
    gradient = jax.grad(lambda q: rates(q, batch["u"]).sum())(batch["q"])
    np.testing.assert_allclose(found["gradient"], gradient, rtol=1e-11)


def test_stablehlo_with_batched_parameters(on_cpu):
    rtol = 1e-12
    system, t, q, u, w = case("Odd")
    exported = jk.export.stablehlo(system, function="equations", batch_parameters=True)
    numbers = jk.export.parameters(system)
    twice = {name: np.stack([x, 1.5 * x]) for name, x in numbers.items()}
    M, f = exported.call(np.full(2, t), *(np.tile(x, (2, 1)) for x in (q, u, w)), twice)
    heavier = jax.tree.map(lambda x: 1.5 * x, system)
    for i, each in enumerate((system, heavier)):
        assert_close([M[i], f[i]], by_library(each, t, q, u, w, ["equations"])["equations"], rtol)


class Tower(jk.System):
    """More slides, one on the other, than are solved for among the scalars."""

    coordinates, speeds = (tuple(f"{letter}{i}" for i in range(13)) for letter in "xv")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        points = [O.moving(sum(q[: i + 1]) * N.x, sum(u[: i + 1]) * N.x) for i in range(13)]
        return jk.Motion([jk.Body(1.0, 0.0, P) for P in points])

    def loads(self, t, q, u, motion, inputs):
        return [jk.Force(-x * motion.N.x, body) for x, body in zip(q, motion.bodies, strict=True)]


@pytest.mark.slow
def test_many_speeds_are_exported_except_functions_that_use_lapack(on_cpu):
    tower, q, u = Tower(), np.linspace(0.1, 0.2, 13), np.linspace(-1.0, 1.0, 13)
    with pytest.raises(ValueError, match=r"Tower: 'rates' .* with 13 speeds .* by LAPACK.*functions=\('equations',\)"):
        jk.export.numpy(tower)
    module = {}
    exec(jk.export.numpy(tower, functions=("equations",)), module)
    expected = jk.equations_of_motion(tower, 0.0, q, u)
    assert_close(module["equations"](0.0, q, u), [np.asarray(x) for x in expected], 1e-13)
    rates = jk.export.stablehlo(tower).call(
        np.zeros(1), q[None], u[None], np.zeros((1, 0)), jk.export.parameters(tower)
    )
    assert_close([rates[1][0]], [np.asarray(jk.accelerations(tower, 0.0, q, u))], 1e-12)


class ByMatrix(Bob):
    """A description that multiplies matrices too large to be written out."""

    def loads(self, t, q, u, motion, inputs):
        x = jnp.concatenate([jnp.asarray(q), jnp.zeros(70)]) @ jnp.ones((70 + len(q), 2))
        return [jk.Force(x[0] * motion.N.x, motion.bodies[0])]


class InHalves(Bob):
    """A description that rounds in between."""

    def loads(self, t, q, u, motion, inputs):
        return [jk.Force(q["x"].astype(jnp.float32).astype(q["x"].dtype) * motion.N.x, motion.bodies[0])]


Arm = jk.catalog.DoublePendulum


def test_systems_and_functions_that_cannot_be_exported_are_rejected(monkeypatch, tmp_path):
    with pytest.raises(ValueError, match="no function rate; did you mean 'rates'"):
        jk.export.c(Arm(), tmp_path / "a.c", functions=("rate",))
    with pytest.raises(TypeError, match=r"e\.g\. \('rates',\)"):
        jk.export.numpy(Arm(), functions="rates")
    with pytest.raises(ValueError, match=r"`platforms`.* cpu, cuda, rocm, tpu; got .*gpu"):
        jk.export.stablehlo(Arm(), platforms=("cpu", "gpu"))
    with pytest.raises(TypeError, match=r"`platforms`.* cpu, cuda, rocm, tpu; got .cpu"):
        jk.export.stablehlo(Arm(), platforms="cpu")
    with pytest.raises(ValueError, match=r"DoublePendulum has no dependent speeds.*Omit it"):
        jk.export.numpy(Arm(), functions=("dependent_speeds",))
    with pytest.raises(ValueError, match="DoublePendulum is a batch"):
        jk.export.numpy(Arm(mass=[1.0, 2.0]))
    with pytest.raises(TypeError, match="instance of a System"):
        jk.export.numpy(Arm)
    with pytest.raises(ValueError, match="'float64' or 'float32'"):
        jk.export.numpy(Arm(), dtype="float16")
    with pytest.raises(ValueError, match=r"must end with \.c.* got '.*folder'"):
        jk.export.c(Arm(), tmp_path / "folder")
    with pytest.raises(TypeError, match=r"DoublePendulum is traced"):
        jax.jit(lambda m: jk.export.numpy(Arm(mass=m)))(1.0)
    with pytest.raises(ValueError, match=r"ByMatrix: 'rates' .*dot_general.*export.stablehlo"):
        jk.export.numpy(ByMatrix())
    assert not [*tmp_path.iterdir()], "nothing was written"
    if importlib.util.find_spec("casadi"):
        with pytest.raises(ValueError, match="no function nothing"):
            jk.export.casadi(Arm(), "nothing")
        with pytest.raises(TypeError, match="exports one function"):
            jk.export.casadi(Arm(), ("rates",))
        with pytest.raises(ValueError, match=r"InHalves: .* float32, which CasADi does not support"):
            jk.export.casadi(InHalves())
    monkeypatch.setitem(sys.modules, "flatbuffers", None)
    with pytest.raises(ImportError, match=r'pip install "jaxkane\[stablehlo\]"'):
        jk.export.stablehlo(Arm(), tmp_path / "a.stablehlo")
    monkeypatch.setitem(sys.modules, "casadi", None)
    with pytest.raises(ImportError, match=r'pip install "jaxkane\[casadi\]"'):
        jk.export.casadi(Arm())


def test_no_parameters_no_inputs(tmp_path):
    assert "parameter_jacobian" not in jk.export.c(Bare(), tmp_path / "bare.c").header.read_text()
    assert "PARAMETERS = {\n}" in jk.export.numpy(Bare())
    module = {}
    exec(jk.export.numpy(Bare(), functions=("rates", "parameter_jacobian", "input_jacobian")), module)
    np.testing.assert_array_equal(module["rates"](0.0, [1.0], [2.0]), [[2.0], [0.0]])
    assert module["parameter_jacobian"](0.0, [1.0], [2.0]).shape == (2, 0)
    if CC:
        files = jk.export.c(Bare(), tmp_path / "bare.c", functions=("rates", "parameter_jacobian"))
        sources = [files.source, files.test]
        subprocess.run([CC, *STRICT, *sources, "-lm", "-o", tmp_path / "test"], check=True)
        subprocess.run([tmp_path / "test"], check=True, stdout=subprocess.DEVNULL)


def test_systems_with_multipliers_are_refused():
    """Their constraint forces are not part of M u_dot = f."""
    with pytest.raises(ValueError, match="has multipliers"):
        jk.export.c(jk.with_multipliers(Bob()), "never.c", ("rates",))
