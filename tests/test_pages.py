"""The documentation's pages can be typed in as they stand, one after the other, and lead somewhere."""

import re
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import pytest

import jaxkane as jk

DOCS = Path(__file__).parents[1] / "docs"
PAGES = sorted(path for path in DOCS.glob("*.md") if path.name != "describing.md")  # see test_documentation.py


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=[page.stem for page in PAGES])
def test_a_page_runs(page, tmp_path, monkeypatch):
    blocks = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    assert blocks, f"{page.name} has nothing to type in"
    if page.stem == "symbolic":
        pytest.importorskip("sympy")
    monkeypatch.chdir(tmp_path)
    names = {}
    for block in blocks:
        exec(compile(block, page.name, "exec"), names)
    plt.close("all")


def test_links_and_pictures_are_there():
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for target in re.findall(r"\]\(([^)#:]+)\)", text) + re.findall(r'src="([^"]+)"', text):
            if not target.startswith("reference/"):  # made when the site is built
                assert (DOCS / target).exists(), f"{page.name}: {target}"


def test_every_picture_of_the_gallery_is_of_an_entry():
    """The site's gallery is made from the catalogue; a picture is wanted of each, and of nothing else."""
    assert {path.stem for path in (DOCS / "catalogue").glob("*.png")} == set(jk.catalog.CATALOG)


def test_code_is_not_wider_than_its_box():
    for page in DOCS.glob("*.md"):
        for block in re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL):
            wide = [line for line in block.splitlines() if len(line) > 80]
            assert not wide, f"{page.name}: {wide[0]}"
