"""A system describes, it never derives: what the files of the catalogue may import and call."""

import ast
import pathlib

import numpy as np
import pytest

from jaxkane import catalog

FILES = sorted(pathlib.Path(catalog.__file__).parent.glob("*.py"))
ROOMS_BELOW = {"_common", "_scalarjit", "rotations", "_system", "loads", ""}
OF_JUMPS = {("_integrate.events", "falling"), ("_integrate.events", "rising"), ("_kane.contact.impulses", "Impact")}
OF_JUMPS |= {("_kane.contact.declarations", "Contact"), ("_kane.contact.declarations", "DryFriction")}
METHOD = {"jvp", "vjp", "grad", "jacfwd", "jacrev", "linearize", "solve", "inv"}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_catalogue_systems_use_lower_layers_only_and_no_derivatives(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level == 2:
            names = {name.name for name in node.names}
            below = (node.module or "").split(".")[0] in ROOMS_BELOW
            assert below or {(node.module, name) for name in names} <= OF_JUMPS
            assert node.module or names <= ROOMS_BELOW
        if isinstance(node, ast.Attribute):
            assert node.attr not in METHOD


def test_every_system_is_exported_and_listed():
    systems = {name for name in vars(catalog) if isinstance(vars(catalog)[name], type) and name != "Entry"}
    assert systems == set(catalog.CATALOG)
    sources = {entry.book for entry in catalog.CATALOG.values()}
    assert len({source for source in sources if source.startswith(("Example", "Exercise"))}) == 7 + 8
    assert [name for name, entry in catalog.CATALOG.items() if not entry.book.startswith(("Example", "Exercise"))] == [
        "SliderCrankWithClearance",  # Flores
        "SimplestWalker",
        "CompassGait",
        "RockingBlock",  # Housner
        "KerbWheel",  # Irodov
        "Rattleback",
        "Woodpecker",  # Leine
        "RimlessWheel",
        "Backlash",  # Nordin
        "Belt",  # Popp
        "BouncingBall",
    ]


def test_entries_are_in_the_order_of_the_book():
    books = [entry.book for entry in catalog.CATALOG.values()]
    assert books == sorted(books)
    assert list(catalog.CATALOG)[:2] == ["DoublePendulum", "RigidBody"]
    assert not catalog.CATALOG["DiskAndBar"].conservative


@pytest.mark.parametrize("name", catalog.CATALOG)
def test_every_docstring_contains_the_reference_to_the_book(name):
    assert catalog.CATALOG[name].book in getattr(catalog, name).__doc__


def test_the_links_of_the_spatial_double_pendulum_are_uniform_rods():
    """Transverse moments m l^2 / 12, and a small moment about each rod; the first rod is longer and heavier."""
    system = catalog.SpatialDoublePendulum()
    links = ("mass1", "length1", "I11_1", "I22_1", "I33_1"), ("mass2", "length2", "I11_2", "I22_2", "I33_2")
    numbers = [[float(getattr(system, name)) for name in link] for link in links]
    assert [m for m, *_ in numbers] == [1.2, 0.8]
    assert [length for _, length, *_ in numbers] == [1.0, 0.75]
    for m, length, across, along, other in numbers:
        np.testing.assert_allclose([across, other], m * length**2 / 12, rtol=1e-14)
        assert 0.01 * across < along < 0.03 * across
    assert float(system.gravity) == 9.81
