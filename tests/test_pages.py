"""The code of the pages of the documentation runs in order, and their links are valid."""

import importlib.util
import logging
import re
import types
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

import jaxkane as jk
from jaxkane.bicycles import PathFollower

DOCS = Path(__file__).parents[1] / "docs"
PAGES = sorted(DOCS.glob("*.md"))
WITHOUT_CODE = ("architecture", "bicycles_fit", "first_change", "glossary", "other_libraries")
AFTER_FIT = ("multiple_shooting", "process_noise", "uncertainty", "model_extensions")  # their code goes on from fit.md
RUN = [page for page in PAGES if page.stem not in ("constraints", *WITHOUT_CODE)]  # constraints: test_documentation.py


def blocks_of(page):
    return re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


def run(page, names):
    """Run the blocks of a page in a namespace, and yield after each."""
    for block in blocks_of(page):
        exec(compile(block, page.name, "exec"), names)
        yield


@pytest.fixture(scope="module")
def names_of_fit():
    """What the first block of fit.md defines; the rest of that page is run by its own test."""
    names = {}
    next(run(DOCS / "fit.md", names))
    return names


@pytest.mark.weekly_cases(
    "bicycles_control", "bicycles_riders", "bicycles_tyres", "diffrax", "gallery", "periodic_orbits"
)
@pytest.mark.slow
@pytest.mark.parametrize("page", RUN, ids=[page.stem for page in RUN])
def test_the_code_of_each_page_runs(page, tmp_path, monkeypatch, request):
    assert blocks_of(page), f"{page.name} has nothing to type in"
    if page.stem == "symbolic":
        pytest.importorskip("sympy")
    monkeypatch.chdir(tmp_path)
    names, systems = {}, {}
    if page.stem in AFTER_FIT:
        names |= request.getfixturevalue("names_of_fit")
    for _ in run(page, names):
        systems |= {id(x): x for x in names.values() if isinstance(x, jk.System)}
        for name, ride in names.items():
            assert not isinstance(ride, jk.Trajectory) or np.all(ride.ok), f"{page.name}: {name}: {ride}"
    plt.close("all")
    if page.stem in SIMULATED:
        kinds = {x for x in names.values() if isinstance(x, type) and issubclass(x, jk.System)} - {jk.System}
        made = [
            getattr(kind, "benchmark", kind)() for kind in kinds if not any(type(x) is kind for x in systems.values())
        ]
        for system in (*systems.values(), *made):
            assert_moves(system)


SIMULATED = ("bicycles", "bicycles_riders", "bicycles_tyres", "bicycles_control", "elements", "sensors")


def assert_moves(system):
    """Whatever a page puts together moves for half a second, keeps its energy, and is like its mirror image."""
    if not isinstance(system, jk.catalog.WhippleBicycle):
        ride_of(system, dict.fromkeys(system.coordinates, 0.01), {}, n=1001, most=1e-5)  # a gear has play
        return
    rolling = {} if "rear_wheel_rate" in system.dependent_speeds else {"rear_wheel_rate": -5.0 / float(system.rR)}
    right = ride_of(system, {"roll": 0.02, "steer": 0.01}, rolling)
    control = getattr(system, "control", None)
    if any(isinstance(part, PathFollower) for part in (control if isinstance(control, tuple) else ())):
        return  # a path leads to one side
    left = ride_of(system, {"roll": -0.02, "steer": -0.01}, rolling)
    sides = {"left": "right", "right": "left"}
    aside = {*system.lateral, "yaw", "y", "front_y"}
    aside |= {f"{name}_rate" for name in aside}
    for name in (*system.coordinates, *system.speeds, *system.dependent_speeds, *system.states):
        side, _, rest = name.partition("_")
        twin = f"{sides[side]}_{rest}" if side in sides else name
        sign = -1.0 if name in aside else 1.0
        np.testing.assert_allclose(left[name], sign * right[twin], rtol=0, atol=1e-9, err_msg=name)


def ride_of(system, q, u, n=101, most=1e-6):
    ride = jk.simulate(system, jk.assemble(system, q, u), jnp.linspace(0.0, 0.5, n))
    assert ride.ok, f"{system}: {ride}"
    audit = jk.audit(system, ride)
    assert audit.ok, audit
    assert audit.energy_balance < most
    return ride


def test_linked_files_and_pictures_exist():
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text) + re.findall(r'src="([^"]+)"', text):
            assert (DOCS / target).exists(), f"{page.name}: {target}"  # on GitHub as well: no `reference/` of the site


def headings_of(page):
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    return re.findall(r"^#+ (.*)", text, re.MULTILINE)


def test_links_of_the_readme_resolve_to_headings():
    """`mkdocs build --strict` checks the links of the pages, but not those of the README."""
    links = re.findall(r"\]\(([^)#:]+)(?:#([^)]+))?\)", (DOCS.parent / "README.md").read_text(encoding="utf-8"))
    for path, anchor in links:
        page = DOCS.parent / path
        assert page.exists() or path.startswith("../"), path
        if page.suffix == ".md":
            anchors = {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings_of(page)}
            assert not anchor or anchor in anchors, f"README: {path}#{anchor}"


@pytest.fixture(scope="module")
def hooks():
    for package in ("mkdocs", "nbconvert", "latex2mathml"):
        pytest.importorskip(package)
    spec = importlib.util.spec_from_file_location("hooks", DOCS / "hooks.py")
    hooks = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hooks)
    return hooks


def test_the_reference_is_in_the_order_of_use(hooks):
    modules = hooks.modules()
    assert modules.index("joints") < modules.index("stability") < modules.index("fit") < modules.index("export")
    page = hooks.reference("fit")
    assert page.index("jaxkane.fit.fit\n") < page.index("jaxkane.fit.Trial\n") < page.index("jaxkane.fit.bootstrap\n")
    packages = [module for module in modules if (hooks.PACKAGE / module).is_dir()]
    assert not set(hooks.FIRST) - {name for module in packages for name in hooks.public_names(module)}


def test_broken_links_are_reported(hooks, tmp_path, caplog):
    (tmp_path / "a.html").write_text('<h1 id="there">A</h1><a href="#there"></a><a href="b.html#missing"></a>')
    (tmp_path / "b.html").write_text('<a href="a.html#there"></a><img src="c.png">')
    with caplog.at_level(logging.WARNING):
        hooks.on_post_build(types.SimpleNamespace(site_dir=tmp_path))
    assert {f"{page}: {target}" for page, target in (record.args for record in caplog.records)} == {
        "a.html: b.html#missing", "b.html: c.png"
    }  # fmt: skip


def test_gallery_pictures_match_the_catalogue_entries():
    """The site's gallery is made from the catalogue; a picture is wanted of each, and of nothing else."""
    assert {path.stem for path in (DOCS / "catalogue").glob("*.png")} == set(jk.catalog.CATALOG)


def test_code_lines_fit_the_page_width():
    for page in PAGES:
        for block in re.findall(r"```(?:python|py)\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL):
            wide = [line for line in block.splitlines() if len(line) > 80]
            assert not wide, f"{page.name}: {wide[0]}"


SEARCHED = {
    "LCP": "contact#Equations", "complementarity": "contact#Equations", "Coulomb": "contact#Equations",
    "Newton's cradle": "contact#Newton's cradle", "compliant contact": "contact#Rigid or compliant",
    "trajectory optimization": "optimal_control#Optimal control", "warm start": "optimal_control#Guesses",
    "sparse": "optimal_control#Solver", "debugging NaN": "numerics#NaN", "float32": "numerics#Floating-point",
    "tutorial": "index#Getting started", "getting started": "index#Getting started", "memory": "caching#When programs",
    "muscles": "sensors#First-order states",
    "natural frequency": "stability#Eigenvalues", "PID": "describing#Parameters", "MPC": "optimal_control#Replay",
    "Monte Carlo": "sweeps#Parameter", "pickle": "simulation#Simulation", "computed torque": "inverse_dynamics#Joint",
    "inverse kinematics": "joints#Inverse", "CSV": "fit#Trials", "bang-bang": "optimal_control#Free duration",
    "Sobol": "sweeps#Parameter", "suspension": "index#What it does", "xacro": "bringing_models#URDF",
}  # fmt: skip


@pytest.mark.parametrize("word", SEARCHED)
def test_search_words_lead_to_their_section(word):
    """The site's search reads headings and text by section."""
    page, _, heading = SEARCHED[word].partition("#")
    text = re.sub(r"```.*?```", "", (DOCS / f"{page}.md").read_text(encoding="utf-8"), flags=re.DOTALL)
    section = re.search(rf"^#+ {heading}.*?(?=^#|\Z)", text, re.MULTILINE | re.DOTALL)[0]
    assert word.lower() in " ".join(section.split()).lower()
