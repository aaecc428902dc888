"""The package: one version everywhere, types, citation, lower bounds of requirements, and supported Python versions."""

import importlib.metadata
import re
import runpy
import subprocess
import sys
import tomllib
from pathlib import Path

import jax
import pytest
import yaml

import jaxkane as jk

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
PYTHONS = re.findall(r"Python :: (3\.\d+)", " ".join(PROJECT["classifiers"]))


def test_there_is_one_version():
    assert re.fullmatch(r"\d+\.\d+\.\d+((a|b|rc)\d+)?(\.dev\d+)?", jk.__version__)
    assert importlib.metadata.version("jaxkane") == jk.__version__, "installed from other sources: pip install -e ."
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.search(r"^## \[(.+?)\]", changes, re.MULTILINE)[1] in (jk.__version__, "Unreleased")


def test_the_citation_file_has_this_version_and_its_references():
    """Required keys of the Citation File Format 1.2.0; a reference has at least its kind, title and authors."""
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["cff-version"] == "1.2.0"
    assert str(citation["version"]) == jk.__version__
    assert citation["license"] == PROJECT["license"].partition(" AND ")[0]
    assert {"message", "title", "authors"} <= set(citation)
    assert all({"type", "title", "authors"} <= set(reference) for reference in citation["references"])
    assert {reference.get("doi") for reference in citation["references"]} >= {
        "10.1098/rspa.2007.1857", "10.1098/rspa.2007.1849"
    }  # fmt: skip


def test_the_licence_expression_contains_the_licences_of_the_data():
    """The code is Apache-2.0. The data have licences of their own, whose files are part of the wheel."""
    terms = {"MIT License": "MIT", "licenses/by/3.0": "CC-BY-3.0", "Neither the name": "BSD-3-Clause"}
    terms |= {"The views and conclusions": "BSD-2-Clause-Views", "Redistribution and use": "BSD-2-Clause"}
    files = [path for pattern in PROJECT["license-files"] for path in ROOT.glob(pattern)]
    assert {path.parent for path in files} == {ROOT, *(ROOT / "src/jaxkane/data/files").iterdir()}
    texts = [path.read_text(encoding="utf-8") for path in files]
    named = {"Apache-2.0"} | {name for sign, name in terms.items() if any(sign in text for text in texts)}
    assert set(PROJECT["license"].split(" AND ")) == named
    recipe = yaml.safe_load((ROOT / "recipe/recipe.yaml").read_text(encoding="utf-8"))["about"]
    assert [recipe["license"], recipe["license_file"]] == [PROJECT["license"], PROJECT["license-files"]]


def test_the_library_is_typed():
    assert (Path(jk.__file__).parent / "py.typed").is_file()
    assert "Typing :: Typed" in PROJECT["classifiers"]


def test_every_supported_python_version_is_tested_in_ci():
    checks = yaml.safe_load((ROOT / ".github/workflows/checks.yml").read_text(encoding="utf-8"))
    assert checks["jobs"]["tests"]["strategy"]["matrix"]["python"] == PYTHONS
    assert PROJECT["requires-python"] == f">={PYTHONS[0]}"
    script = (ROOT / ".ci/run").read_text(encoding="utf-8")
    assert f"OLDEST={PYTHONS[0]} NEWEST={PYTHONS[-1]}" in script
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert f"Python {PYTHONS[0]} to {PYTHONS[-1]}" in readme


def test_requirements_have_lower_bounds_and_jax_an_upper_bound():
    run = subprocess.run([sys.executable, ROOT / ".ci/lowest"], capture_output=True, text=True, check=True)
    floors = dict(line.split("==") for line in run.stdout.splitlines())
    named = {re.match(r"[\w.-]+", entry)[0] for entry in PROJECT["dependencies"]}
    assert named <= set(floors)
    jax = next(entry for entry in PROJECT["dependencies"] if entry.startswith("jax>"))
    assert re.fullmatch(r"jax>=[\d.]+,<[\d.]+", jax)
    assert floors["jax"] == re.match(r"jax>=([\d.]+)", jax)[1]


def test_the_conda_recipe_has_the_requirements_of_the_wheel():
    text = (ROOT / "recipe/recipe.yaml").read_text(encoding="utf-8")
    recipe = yaml.safe_load(text)
    asked = {line.replace(" ", "").replace("-base", "") for line in recipe["requirements"]["run"][1:]}
    assert asked == {entry.replace(" ", "") for entry in PROJECT["dependencies"]}
    assert recipe["context"] == {"version": jk.__version__, "python_min": PYTHONS[0]}


def test_rows_of_the_validation_page_match_the_published_tests():
    page = (ROOT / "docs/validation.md").read_text(encoding="utf-8")
    rows = set(re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", page))
    marked = r"@pytest\.mark\.published\n(?:@.*\n)*def (\w+)"
    there = {
        (path.relative_to(ROOT).as_posix(), name)
        for path in (ROOT / "tests").rglob("test_*.py")
        for name in re.findall(marked, path.read_text(encoding="utf-8"))
    }
    assert rows == there


def test_test_files_have_unique_names():
    """pytest imports them by their names alone: two of one name end the whole run."""
    names = [path.name for path in (ROOT / "tests").rglob("test_*.py")]
    assert sorted(names) == sorted(set(names))


@pytest.mark.weekly
def test_the_self_test():
    run = subprocess.run([sys.executable, "-m", "jaxkane"], capture_output=True, text=True)
    assert (run.returncode, run.stderr) == (0, "")
    lines = run.stdout.splitlines()
    assert f"jaxkane {jk.__version__}, jax {jax.__version__}" in lines[1]
    assert [line.startswith("ok: ") for line in lines[-3:]] == [True] * 3


def test_a_failed_self_test_is_reported(monkeypatch, capsys):
    from jaxkane import __main__ as program

    monkeypatch.setattr(
        program, "CHECKS", {"one": lambda: (0.5, 0.1), "two": lambda: 1 / 0, "three": lambda: (0.0, 0.1)}
    )
    monkeypatch.setattr(jk, "configure", lambda verbose: jk.Configuration(True, None, None, False))
    assert program.main() == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in lines[-3:]] == ["FAILED", "FAILED", "ok"]
    assert "one (5.0e-01, at most 1e-01" in lines[-3]
    assert "ZeroDivisionError: division by zero" in lines[-2]
    monkeypatch.setattr(program, "CHECKS", {})
    assert program.main() == 0


def test_the_docs_extra_contains_the_packages_that_the_build_needs():
    """Signatures are formatted by ruff, and notebooks need their kernel and the packages that they import."""
    extra = " ".join(PROJECT["optional-dependencies"]["docs"])
    for package in ("ruff", "mkdocs>", "mkdocs-material", "mkdocstrings[python]", "nbconvert", "latex2mathml"):
        assert package in extra
    assert "jaxkane[notebooks,control,symbolic,casadi,collocation]" in extra


def test_headings_of_the_contributing_page_that_other_files_name_exist():
    headings = re.findall(r"^## (.+)$", (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"), re.MULTILINE)
    for name in ("pyproject.toml", "CITATION.cff"):
        named = re.findall(r'CONTRIBUTING\.md, "([^"]+)"', (ROOT / name).read_text(encoding="utf-8"))
        assert named, name
        assert set(named) <= set(headings), name


def test_all_files_name_the_same_owner():
    """`.ci/owner NAME` sets it."""
    names = runpy.run_path(str(ROOT / ".ci/owner"))
    assert len(set().union(*map(names["owners"], names["FILES"]))) == 1
    assert all(names["owners"](path) for path in names["FILES"])


def test_the_paper_has_the_sections_of_the_journal_and_its_references():
    text, references = ((ROOT / "paper" / name).read_text(encoding="utf-8") for name in ("paper.md", "paper.bib"))
    headings = re.findall(r"^# (.+)$", text, re.MULTILINE)
    needed = {"Statement of need", "State of the field", "Research impact statement", "AI usage disclosure"}
    assert needed <= set(headings)
    assert set(re.findall(r"@([a-z]+\d{4}\w*)", text)) == set(re.findall(r"^@\w+\{(\w+),", references, re.MULTILINE))


def test_the_tables_of_extras_are_the_same_and_complete():
    tables = []
    for page in ("README.md", "docs/installation.md"):
        rows = (ROOT / page).read_text(encoding="utf-8").partition("| extra |")[2].partition("\n\n")[0].splitlines()[2:]
        tables.append(rows)
        named = {name for row in rows for name in re.findall(r"`([a-z]+)`", row.split("|")[1])}
        assert named == set(PROJECT["optional-dependencies"]), page
    assert tables[0] == tables[1]


def test_pages_state_the_number_of_systems_in_the_catalogue():
    numbers = {5: "five", 6: "six", 7: "seven", 8: "eight"}
    systems = [type(entry.example()) for entry in jk.catalog.CATALOG.values()]
    with_contacts = sum(system.contacts is not jk.System.contacts for system in systems)
    for page in ("README.md", "CHANGELOG.md", "docs/catalogue.md"):
        text = " ".join((ROOT / page).read_text(encoding="utf-8").split())
        assert re.search(rf"{numbers[with_contacts]} systems with \[?contacts", text), page
