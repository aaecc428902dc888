"""The house: imports point down only, the public names are those agreed on, and importing changes nothing."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import jaxkane as jk
import jaxkane.catalog
import jaxkane.fit
import jaxkane.stability
import jaxkane.sweep

SOURCE = Path(jk.__file__).parent

# Each module may import from the lines above it, and within the same package.
FLOORS = [
    ["_jax_internals"],
    ["_lookup", "_digest", "_whole_file"],
    ["_types", "_components", "_linear", "_nan", "_native", "_reads", "_fuse", "_kinks"],
    ["_crossings"],
    ["_stops"],
    ["rotations", "_vectors"],
    ["_system", "_trajectory"],
    ["loads", "_units"],
    ["catalog"],
    ["_kane"],
    ["_description"],
    ["_check"],
    ["_drift"],
    ["_rates"],
    ["_diagnose"],
    ["_equations", "_assembly", "_signals"],
    ["_events", "_settings"],
    ["_ride"],
    ["_simulate"],
    ["_along"],
    ["_reactions"],
    ["sweep", "_audit", "_configure"],
    ["plot"],
    ["fit"],
    ["stability"],
    ["_animate"],
]
WITHIN_A_FLOOR = {
    "_trajectory": {"_system"},
    "_vectors": {"rotations"},
    "_components": {"_types"},
    "_linear": {"_types", "_components"},
    "_fuse": {"_native", "_reads"},
}


def unit_of(path):
    relative = path.relative_to(SOURCE)
    return relative.parts[0].removesuffix(".py")


def imports_of(path):
    """Names of the units of this package that a file imports."""
    package = ("jaxkane", *path.relative_to(SOURCE).parent.parts)
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            full = (*base, *(node.module.split(".") if node.module else ()))
            if full[:1] == ("jaxkane",):
                yield from (alias.name for alias in node.names) if len(full) == 1 else (full[1],)
        elif isinstance(node, ast.Import):
            yield from (a.name.split(".")[1] for a in node.names if a.name.startswith("jaxkane."))


def test_imports_point_down():
    floor = {unit: i for i, units in enumerate(FLOORS) for unit in units}
    for path in SOURCE.rglob("*.py"):
        unit = unit_of(path)
        if unit == "__init__":
            continue
        assert unit in floor, f"{unit} has no floor yet: give it one in this test"
        for imported in imports_of(path):
            fine = imported == unit or floor[imported] < floor[unit] or imported in WITHIN_A_FLOOR.get(unit, ())
            assert fine, f"{path.relative_to(SOURCE)} imports {imported}, which does not stand below it"


# What JAX and equinox do not promise: the one file that uses it says what happens where it is gone.
NOT_PROMISED = r"jax\.(extend|interpreters|experimental|_src)|equinox\._|jaxlib\.(?!__version__)|compiler_options"


def test_one_file_uses_what_is_not_promised():
    users = {unit_of(path) for path in SOURCE.rglob("*.py") if re.search(NOT_PROMISED, path.read_text())}
    assert users == {"_jax_internals"}
    others = [path for path in SOURCE.rglob("*.py") if path.stem != "_jax_internals"]
    of_core = {line for path in others for line in re.findall(r".*jax\.core.*", path.read_text())}
    assert of_core <= {"from jax.core import Tracer"}  # the rest of jax.core comes and goes


def test_few_files_see_the_integrator():
    users = {unit_of(path) for path in SOURCE.rglob("*.py") if "import diffrax" in path.read_text()}
    assert users <= {"_simulate", "_ride", "_settings", "_kinks", "_stops", "fit"}


def test_public_names():
    top = """
    System Body Vector Frame Point Motion State Force Torque weight inertial parameter equations_of_motion accelerations
    mass_matrix forcing partial_velocities generalized_active_forces generalized_inertia_forces dependent_speeds
    constraint_jacobian constraint_jacobian_rate assemble kinetic_energy simulate Trajectory
    """
    assert not [name for name in top.split() if not hasattr(jk, name)]
    assert callable(jaxkane.sweep.sweep)
    assert not [
        n
        for n in "Trial fit gradient_descent least_squares identifiability fit_bicycle".split()
        if not hasattr(jk.fit, n)
    ]
    stability = "linearize equilibrium steady_turn eigenvalues critical_speeds transfer_function bode lqr family"
    assert not [name for name in stability.split() if not hasattr(jk.stability, name)]
    bicycle = jk.catalog.WhippleBicycle
    assert all(callable(getattr(bicycle, name)) for name in ("benchmark", "from_parameters", "from_file"))
    assert len(jk.catalog.CATALOG) >= 15


def test_every_public_function_says_what_it_does():
    for module in (jk, jk.fit, jk.sweep, jk.stability, jk.catalog, jk.rotations):
        for name, thing in vars(module).items():
            ours = getattr(thing, "__module__", "").startswith("jaxkane")
            if ours and not name.startswith("_") and thing.__module__ != "jaxkane._components":
                assert thing.__doc__, f"{module.__name__}.{name} has no docstring"


def test_importing_changes_nothing_and_prints_nothing():
    code = (
        "import os, jax; before = dict(os.environ), jax.config.values.copy(); import jaxkane, jaxkane.fit; "
        "assert (dict(os.environ), jax.config.values) == before; assert not jax.config.jax_enable_x64; "
        "import jax._src.xla_bridge as bridge; assert not bridge.backends_are_initialized()"
    )
    clean = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "EQX_", "XLA_"))}
    run = subprocess.run([sys.executable, "-c", code], env=clean, capture_output=True, text=True, timeout=120)
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")
