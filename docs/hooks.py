"""What the site is built from besides its pages: the notebooks, the reference, the gallery's animations, formulas."""

import ast
import os
import re
from pathlib import Path

import nbformat
from latex2mathml.converter import convert
from mkdocs.structure.files import File
from nbconvert import MarkdownExporter

from jaxkane.catalog import CATALOG

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "jaxkane"
# Folder of NAME.html, as examples/draw_catalogue.py writes them; without it the gallery shows its pictures alone.
ANIMATIONS = os.environ.get("JAXKANE_ANIMATIONS")
# Folder of notebooks that have been run; by default those of the repository, which are kept without outputs.
NOTEBOOKS = Path(os.environ.get("JAXKANE_NOTEBOOKS") or ROOT / "notebooks")


def public_names(module):
    """What a module's `__init__.py` exports, `from ._x import y as y`, with the room it is from; no submodules."""
    tree = ast.parse((PACKAGE.joinpath(*module.split(".")[1:]) / "__init__.py").read_text(encoding="utf-8"))
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module]
    names = [(alias, node.module.split(".")[0]) for node in imports for alias in node.names]
    return {a.asname: room for a, room in names if a.asname == a.name and not a.name.startswith("_")}


def modules():
    """Public modules and packages of jaxkane."""
    files = [path.stem for path in PACKAGE.glob("*.py")] + [path.parent.name for path in PACKAGE.glob("*/__init__.py")]
    return ["jaxkane", *sorted(f"jaxkane.{name}" for name in files if not name.startswith("_"))]


def notebooks():
    return sorted(NOTEBOOKS.glob("*.ipynb"))


def on_config(config):
    """Notebooks and modules in the navigation, where a group names their folders."""
    folders = {
        "notebooks/": [f"notebooks/{notebook.stem}.md" for notebook in notebooks()],
        "reference/": [{module: f"reference/{module}.md"} for module in modules()],
    }
    for group in config.nav:
        for pages in group.values():
            for entry in pages:
                entry |= {title: folders.get(target, target) for title, target in entry.items()}
    return config


# The heading for the names of each room, and the page that explains them.
SUBJECTS = {
    "_system": ("Describe a mechanism", "describing"),
    "_kane": ("Evaluate its equations", "kane"),
    "_integrate": ("Simulate", "simulation"),
    "_animate": ("Animate", "pictures"),
    "_scalarjit": ("Configure the process", "speed"),
}
# The page that explains a module.
PAGES = {
    "fit": "fit",
    "sweep": "sweeps",
    "stability": "stability",
    "bicycles": "bicycles",
    "plot": "pictures",
    "catalog": "catalogue",
    "convert": "bringing_models",
    "joints": "joints",
    "data": "fit",
    "symbolic": "symbolic",
    "export": "export",
    "loads": "elements",
    "rotations": "describing",
    "sensors": "sensors",
}


def link(page):
    """A link from the reference to a page, with the page's own title."""
    title = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8").split("\n")[0].removeprefix("# ")
    return f"Explained in [{title}](../{page}.md).\n"


def reference(module):
    """The page of a module: its docstring, then each of its names; those of the library itself by subject."""
    package = PACKAGE.joinpath(*module.split(".")[1:])
    head = f"# {module}\n\n::: {module}\n    options:\n      show_root_heading: false\n"
    page = PAGES.get(module.split(".")[-1])
    more = f"\n{link(page)}" if page else ""
    if not package.is_dir():
        return f"{head}{more}"
    entry = "::: {}.{}\n    options:\n      heading_level: {}\n"
    if package != PACKAGE:
        names = [entry.format(module, name, 2) for name in public_names(module)]
        return "\n".join([f"{head}      members: false\n{more}", *names])
    parts = [f"{head}      members: false\n"]
    names = public_names(module)
    assert set(names.values()) == set(SUBJECTS), f"SUBJECTS and the rooms of {module} differ: {set(names.values())}"
    for room, (title, page) in SUBJECTS.items():
        parts.append(f"## {title}\n\n{link(page)}")
        parts += [entry.format(module, name, 3) for name, home in names.items() if home == room]
    return "\n".join(parts)


def pages_of(notebook):
    """A notebook as a page, and the pictures among its outputs."""
    resources = {"output_files_dir": f"{notebook.stem}_files", "unique_key": notebook.stem}
    content = nbformat.read(notebook, as_version=4)
    content.metadata["language_info"] = {"name": "python"}  # known to notebooks only once they have been run
    text, resources = MarkdownExporter().from_notebook_node(content, resources=resources)
    title, rest = text.split("\n", 1)
    how = f"!!! note\n    This is `notebooks/{notebook.name}`: it is meant to be run, cell by cell.\n"
    yield f"notebooks/{notebook.stem}.md", f"{title}\n\n{how}\n{rest}"
    for name, content in resources["outputs"].items():
        yield f"notebooks/{name}", content


def on_files(files, config):
    for notebook in notebooks():
        for path, content in pages_of(notebook):
            files.append(File.generated(config, path, content=content))
    for module in modules():
        files.append(File.generated(config, f"reference/{module}.md", content=reference(module)))
    for page in sorted(Path(ANIMATIONS).glob("*.html")) if ANIMATIONS else ():
        files.append(File.generated(config, f"animations/{page.name}", abs_src_path=str(page)))
    return files


GALLERY = "<!-- The gallery"
STYLE = "display: grid; grid-template-columns: repeat(auto-fill, minmax(200px, 1fr)); gap: 1.2em"


def gallery():
    """Every entry of the catalogue: its picture, which leads to its animation where there is one, and its words."""
    for name, entry in CATALOG.items():
        picture = ""
        if (ROOT / "docs" / "catalogue" / f"{name}.png").exists():
            picture = f'<img src="catalogue/{name}.png" alt="{name}" width="220">'
        if ANIMATIONS and (Path(ANIMATIONS) / f"{name}.html").exists():
            where = f'href="animations/{name}.html" title="watch it move" target="_blank"'
            picture = f"<a {where}>{picture or 'animation'}</a>"
        words = f"<strong>{entry.book}</strong><br><code>{name}</code><br>{entry.shows}"
        yield f'<figure style="margin: 0">{picture}\n<figcaption>{words}</figcaption></figure>'


def on_page_markdown(markdown, page, config, files):
    if page.file.src_uri != "catalogue.md":
        return markdown
    assert GALLERY in markdown
    figures = "\n".join(gallery())
    return re.sub(f"{GALLERY}.*?-->", lambda _: f'<div style="{STYLE}">\n{figures}\n</div>', markdown)


def on_page_content(html, page, config, files):
    """Formulas as MathML, which browsers show themselves."""
    return re.sub(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', _formula, html, flags=re.DOTALL)


def _formula(match):
    text = match[2].replace("&amp;", "&").replace("&lt;", "<").replace("&gt;", ">")
    return convert(text, display="block" if match[1] == "div" else "inline")
