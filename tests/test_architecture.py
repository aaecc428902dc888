"""The house: imports point down only, the public names are those agreed on, and importing changes nothing."""

import ast
import graphlib
import importlib
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import jaxkane as jk
import jaxkane.catalog
import jaxkane.export
import jaxkane.fit
import jaxkane.stability
import jaxkane.sweep
import jaxkane.symbolic

SOURCE = Path(jk.__file__).parent

# Rooms: each may import from those above it, and within itself. What the rooms do not say, is read in their own files:
# no file imports another that imports it, directly or by way of others.
FLOORS = """
_version _common _scalarjit rotations _system loads sensors _kane joints convert _integrate catalog sweep plot estimate
_collocate fit collocation data stability bicycles symbolic export _animate __main__
""".split()


def room_of(path):
    return path.relative_to(SOURCE).parts[0].removesuffix(".py")


def imports_of(path, types=False):
    """The files of this package that a file imports, also in functions; with `types` those for type checkers, too."""
    package = ("jaxkane", *path.relative_to(SOURCE).parent.parts)
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for_types = {
        node
        for block in ast.walk(tree)
        if isinstance(block, ast.If) and "TYPE_CHECKING" in ast.unparse(block.test)
        for node in ast.walk(block)
    }
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.ImportFrom) and (types or node not in for_types):
            base = package[: len(package) - node.level + 1] if node.level else ()
            full = (*base, *(node.module.split(".") if node.module else ()))
            names = [(*full, alias.name) for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [tuple(alias.name.split(".")) for alias in node.names]
        for name in names:
            if name[0] == "jaxkane":
                yield file_of(name) or file_of(name[:-1])


def file_of(name):
    place = SOURCE.joinpath(*name[1:])
    return next((file for file in (place.with_suffix(".py"), place / "__init__.py") if file.exists()), None)


FILES = sorted(path for path in SOURCE.rglob("*.py") if path != SOURCE / "__init__.py")


@pytest.mark.weekly
def test_modules_import_only_from_lower_layers():
    for path in FILES:
        room = room_of(path)
        assert room in FLOORS, f"{room} has no floor yet: give it one in this test"
        for imported in imports_of(path):
            if imported != SOURCE / "__init__.py":
                below = room_of(imported)
                fine = below == room or FLOORS.index(below) < FLOORS.index(room)
                assert fine, f"{path.relative_to(SOURCE)} imports {below}, which does not stand below it"


@pytest.mark.weekly
def test_no_circular_imports_including_imports_for_type_checking():
    graphlib.TopologicalSorter({path: set(imports_of(path, types=True)) - {path} for path in FILES}).prepare()


def test_top_level_modules_and_package_docstrings():
    """The public names, the public modules that are one file, and rooms that say what they are."""
    one_file = {"__init__.py", "__main__.py", "_version.py", "loads.py", "rotations.py", "sensors.py"}
    assert {path.name for path in SOURCE.glob("*.py")} == one_file
    rooms = [path for path in SOURCE.rglob("*") if path.is_dir() and any(path.glob("*.py"))]
    for path in rooms:
        assert ast.get_docstring(ast.parse((path / "__init__.py").read_text(encoding="utf-8"))), path


# What JAX and equinox do not promise: the one file that uses it says what happens where it is gone.
NOT_PROMISED = r"jax\.(core|extend|interpreters|experimental|_src)|equinox\._|jaxlib\.(?!__version__)|compiler_options"
OF_JAXPRS = r"(?<!_scalarjit)\.(eqns|invars|outvars|constvars|consts|jaxpr|primitive)\b"


def test_only_compat_uses_private_interfaces():
    the_file = SOURCE / "_scalarjit" / "compat.py"
    assert [path for path in SOURCE.rglob("*.py") if re.search(NOT_PROMISED, path.read_text())] == [the_file]


def test_only_the_integrator_uses_internals_of_equinox():
    users = [path for path in SOURCE.rglob("*.py") if re.search(r"equinox(\.| import )internal", path.read_text())]
    assert [room_of(path) for path in users] == ["_integrate"]


def test_only_scalarjit_reads_jaxprs():
    readers = {path for path in SOURCE.rglob("*.py") if re.search(OF_JAXPRS, path.read_text())}
    assert {room_of(path) for path in readers} == {"_scalarjit"}


def test_only_listed_modules_import_diffrax():
    users = {path for path in SOURCE.rglob("*.py") if "import diffrax" in path.read_text()}
    assert {room_of(path) for path in users} == {"_integrate", "fit", "stability"}
    of_integrate = {path.stem for path in users if room_of(path) == "_integrate"}
    assert of_integrate == {"simulate", "settings", "loop", "step_control", "integrate"}
    assert not [path for path in users if "diffrax._" in path.read_text()]  # what it does not promise


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
        for n in "Trial fit GradientDescent LeastSquares minimize identifiability fit_bicycle".split()
        if not hasattr(jk.fit, n)
    ]
    stability = "linearize equilibrium steady_turn eigenvalues critical_speeds frequency_response lqr family"
    assert not [name for name in stability.split() if not hasattr(jk.stability, name)]
    bicycle = jk.catalog.WhippleBicycle
    assert all(callable(getattr(bicycle, name)) for name in ("benchmark", "from_parameters", "from_file"))
    assert len(jk.catalog.CATALOG) >= 15


def test_the_names_for_type_checkers_are_those_of_the_module():
    tree = ast.parse((SOURCE / "__init__.py").read_text(encoding="utf-8"))
    declared = {
        alias.asname: ".".join(filter(None, ("jaxkane", node.module)))
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.asname and not alias.asname.startswith("_")
    }
    assert declared.keys() | {"__version__"} == set(jk.__all__)
    for name, module in declared.items():
        assert getattr(importlib.import_module(module), name) is getattr(jk, name)


def test_every_public_name_has_a_docstring():
    rooms = (jk.loads, jk.sensors, jk.fit, jk.sweep, jk.stability, jk.catalog, jk.bicycles, jk.rotations)
    for module in (jk, *rooms, jk.symbolic, jk.export):
        for name in getattr(module, "__all__", dir(module)):
            thing = getattr(module, name)
            ours = str(getattr(thing, "__module__", "")).startswith("jaxkane")
            if ours and not name.startswith("_") and thing.__module__ != "jaxkane._scalarjit.components":
                assert thing.__doc__, f"{module.__name__}.{name} has no docstring"


@pytest.mark.weekly
def test_importing_changes_nothing_and_prints_nothing():
    code = (
        "import os, sys, jax; before = dict(os.environ), jax.config.values.copy(); import jaxkane; "
        "from jaxkane._scalarjit.compat import NO_FUSIONS, WRONG_FUSIONS; "  # but for two releases that are repaired
        "before[0].update({'XLA_FLAGS': f'{NO_FUSIONS}='} if jax.__version_info__ in WRONG_FUSIONS else {}); "
        "unused = {'scipy', 'optax', 'matplotlib', 'pandas', 'tqdm', 'jaxkane.fit', 'jaxkane.plot', 'jaxkane.sweep'}; "
        "assert not {*unused, 'diffrax', 'jaxkane._kane'} & sys.modules.keys(), sys.modules.keys(); "
        "jaxkane.System, jaxkane.simulate; assert not unused & sys.modules.keys(), unused & sys.modules.keys(); "
        "import jaxkane.stability; assert not {'scipy.signal', 'scipy.stats'} & sys.modules.keys(); "
        "assert all(hasattr(jaxkane, name) for name in dir(jaxkane)) and unused & sys.modules.keys(); "
        "assert {'jaxkane.symbolic', 'jaxkane.export'} < sys.modules.keys(); "
        "assert not {'sympy', 'casadi', 'mujoco'} & sys.modules.keys(); "
        "here = {}; exec('from jaxkane import *', here); assert {'fit', 'animate', 'simulate'} <= here.keys(); "
        "assert (dict(os.environ), jax.config.values) == before; assert not jax.config.jax_enable_x64; "
        "import jax._src.xla_bridge as bridge; assert not bridge.backends_are_initialized()"
    )
    clean = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "EQX_", "XLA_"))}
    run = subprocess.run([sys.executable, "-c", code], env=clean, capture_output=True, text=True, timeout=120)
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")
