"""A system describes, it never derives: what the files of the catalogue may import and call."""

import ast
import pathlib

import numpy as np
import pytest

from jaxkane import catalog

FILES = sorted(pathlib.Path(catalog.__file__).parent.glob("*.py"))
LAYERS_BELOW = {"_common", "_scalarjit", "rotations", "_system", "loads", ""}
OF_JUMPS = {("_integrate.events", "falling"), ("_integrate.events", "rising"), ("_kane.contact.impulses", "Impact")}
OF_JUMPS |= {
    ("_integrate.events", "Crossing"),
    ("_kane.contact.declarations", "Contact"),
    ("_kane.contact.declarations", "DryFriction"),
}
METHOD = {"jvp", "vjp", "grad", "jacfwd", "jacrev", "linearize", "solve", "inv"}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_catalogue_systems_use_lower_layers_only_and_no_derivatives(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level == 2:
            names = {name.name for name in node.names}
            below = (node.module or "").split(".")[0] in LAYERS_BELOW
            assert below or {(node.module, name) for name in names} <= OF_JUMPS
            assert node.module or names <= LAYERS_BELOW
        if isinstance(node, ast.Attribute):
            assert node.attr not in METHOD


def test_every_system_is_exported_and_listed():
    systems = {name for name in vars(catalog) if isinstance(vars(catalog)[name], type) and name != "Entry"}
    assert systems == set(catalog.CATALOG)


def test_entries_are_in_the_order_of_the_book():
    books = [entry.book for entry in catalog.CATALOG.values()]
    assert books == sorted(books)
    assert list(catalog.CATALOG)[:2] == ["DoublePendulum", "RigidBody"]
    assert not catalog.CATALOG["DiskAndBar"].conservative


@pytest.mark.parametrize("name", catalog.CATALOG)
def test_every_docstring_contains_the_reference_to_the_book(name):
    assert catalog.CATALOG[name].book in getattr(catalog, name).__doc__


def test_the_links_of_the_spatial_double_pendulum_are_uniform_rods():
    """Transverse moments m l^2 / 12, and a small moment about each rod."""
    x = {name: float(value) for name, value in vars(catalog.SpatialDoublePendulum()).items()}
    for i in "12":
        transverse = x[f"mass{i}"] * x[f"length{i}"] ** 2 / 12
        np.testing.assert_allclose([x[f"I11_{i}"], x[f"I33_{i}"]], transverse, rtol=1e-14)
        assert 0.01 * transverse < x[f"I22_{i}"] < 0.03 * transverse
