"""Imports point to lower layers only, public names have docstrings, and importing the library changes nothing."""

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

SOURCE = Path(jk.__file__).parent

# The layers, from the lowest to the highest. A module imports from lower layers and from its own.
LAYERS = """
_version _common _scalarjit rotations shapes _system loads sensors _kane joints convert _integrate catalog sweep plot
estimate _collocate fit collocation data stability bicycles symbolic export _animate __main__
""".split()


def layer_of(path):
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


def test_modules_import_only_from_lower_layers():
    for path in FILES:
        layer = LAYERS.index(layer_of(path))
        for imported in set(imports_of(path)) - {SOURCE / "__init__.py"}:
            lower = layer_of(imported)
            assert LAYERS.index(lower) <= layer, f"{path.relative_to(SOURCE)} imports {lower}, which is a higher layer"


@pytest.mark.weekly
def test_no_circular_imports_including_imports_for_type_checking():
    graphlib.TopologicalSorter({path: set(imports_of(path, types=True)) - {path} for path in FILES}).prepare()


def test_packages_have_docstrings():
    for path in SOURCE.rglob("__init__.py"):
        assert ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))), path


# Interfaces that JAX and equinox do not promise. One file uses them.
NOT_PROMISED = r"jax\.(core|extend|interpreters|experimental|_src)|equinox\._|jaxlib\.(?!__version__)|compiler_options"
OF_JAXPRS = r"(?<!_scalarjit)\.(eqns|invars|outvars|constvars|consts|jaxpr|primitive)\b"


def files_with(pattern):
    files = {path.relative_to(SOURCE).as_posix(): path.read_text() for path in SOURCE.rglob("*.py")}
    return {name for name, text in files.items() if re.search(pattern, text)}


def test_private_interfaces_and_jaxprs_are_used_in_one_place():
    assert files_with(NOT_PROMISED) == {"_scalarjit/compat.py"}
    assert {path.split("/")[0] for path in files_with(OF_JAXPRS)} == {"_scalarjit"}
    assert {path.split("/")[0] for path in files_with(r"equinox(\.| import )internal")} == {"_integrate"}
    assert {path.split("/")[0] for path in files_with("import diffrax")} == {"_integrate", "fit", "stability"}
    assert not files_with(r"diffrax\._")


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
    names = "loads sensors fit sweep stability catalog bicycles rotations symbolic export".split()
    for module in (jk, *(importlib.import_module(f"jaxkane.{name}") for name in names)):
        for name in getattr(module, "__all__", dir(module)):
            thing = getattr(module, name)
            ours = str(getattr(thing, "__module__", "")).startswith("jaxkane")
            if ours and not name.startswith("_") and "._scalarjit" not in thing.__module__:
                assert thing.__doc__, f"{module.__name__}.{name} has no docstring"


IMPORTS = """
import os, sys, jax
def settings():
    return {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}, jax.config.values.copy()

before = settings()
import jaxkane
unused = {"scipy", "optax", "matplotlib", "pandas", "tqdm", "jaxkane.fit", "jaxkane.plot", "jaxkane.sweep"}
assert not {*unused, "diffrax"} & sys.modules.keys(), sys.modules.keys()
jaxkane.System, jaxkane.simulate
assert not unused & sys.modules.keys(), unused & sys.modules.keys()
import jaxkane.stability
assert not {"scipy.signal", "scipy.stats"} & sys.modules.keys()
assert all(hasattr(jaxkane, name) for name in dir(jaxkane)) and unused & sys.modules.keys()
assert {"jaxkane.symbolic", "jaxkane.export"} < sys.modules.keys()
assert not {"sympy", "casadi", "mujoco"} & sys.modules.keys()
here = {}
exec("from jaxkane import *", here)
assert {"fit", "animate", "simulate"} <= here.keys()
assert settings() == before
assert not jax.config.jax_enable_x64
import jax._src.xla_bridge as bridge
assert not bridge.backends_are_initialized()
"""


@pytest.mark.weekly
def test_importing_changes_nothing_and_prints_nothing():
    """But for a flag of XLA with two releases of JAX that are repaired."""
    clean = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "EQX_", "XLA_"))}
    run = subprocess.run([sys.executable, "-c", IMPORTS], env=clean, capture_output=True, text=True, timeout=300)
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")
