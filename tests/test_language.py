"""Patterns of unclear English that must not come back to the documentation, the notebooks and the examples."""

import ast
import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [*sorted((ROOT / "docs").glob("*.md")), ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"]
NOTEBOOKS, EXAMPLES = sorted((ROOT / "notebooks").glob("*.ipynb")), sorted((ROOT / "examples").glob("*.py"))
PATTERNS = {
    "write `is not`, not `is no`": r"(?<!there )(?<!There )\b(is|are) no\b (?!longer\b)",
    "name the subject, not `that which` or `what is not`": r"\b(that which|what is not|those that are not)\b",
    "no inversion: write `With more than ...`": r"(^|[.:] )Of (more|these|those|each|all|every|what)\b[^.]*, ",
    "software does not know, tell, want or promise": r"\b(library|fit|solver|filter|model|function|it) "
    r"(knows|tells|wants|promises|believes|notices)\b",
    "import and export, not `comes along` or `goes on`": r"\b(comes? along|goes on from|bring and take)\b",
    "house words": r"\b(kinks?|trial numbers|rooms? of `src|as it was told)\b",
}


def text_of(path):
    """The prose of a file, without code."""
    if path.suffix == ".ipynb":
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        text = "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
    elif path.suffix == ".py":
        text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    else:
        text = path.read_text(encoding="utf-8")
    return re.sub(r"```.*?```|`[^`\n]*`", "", text, flags=re.DOTALL)


@pytest.mark.parametrize("path", [*PAGES, *NOTEBOOKS, *EXAMPLES], ids=lambda path: path.name)
def test_plain_sentences(path):
    for rule, pattern in PATTERNS.items():
        for sentence in re.split(r"(?<=[.!?])\s+|\n\n|\|", text_of(path)):
            found = re.search(pattern, " ".join(sentence.split()))
            assert not found, f"{path.name}: {rule}: {' '.join(sentence.split())}"
