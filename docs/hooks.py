"""What the site is built from besides its pages: the notebooks, the reference, the gallery's animations, formulas."""

import ast
import os
import re
from pathlib import Path

import nbformat
from latex2mathml.converter import convert
from mkdocs.structure.files import File
from nbconvert import MarkdownExporter

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "jaxkane"
# Folder of NAME.html, as examples/draw_catalogue.py writes them; without it the gallery shows its pictures alone.
ANIMATIONS = os.environ.get("JAXKANE_ANIMATIONS")
# Folder of notebooks that have been run; by default those of the repository, which are kept without outputs.
NOTEBOOKS = Path(os.environ.get("JAXKANE_NOTEBOOKS") or ROOT / "notebooks")


def public_names(module):
    """What a module's `__init__.py` exports, `from ._x import y as y`, but for submodules."""
    tree = ast.parse((PACKAGE.joinpath(*module.split(".")[1:]) / "__init__.py").read_text(encoding="utf-8"))
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom) and node.module]
    return [alias.asname for node in imports for alias in node.names if alias.asname == alias.name]


def modules():
    """Public modules and packages of jaxkane."""
    files = [path.stem for path in PACKAGE.glob("*.py")] + [path.parent.name for path in PACKAGE.glob("*/__init__.py")]
    return ["jaxkane", *sorted(f"jaxkane.{name}" for name in files if not name.startswith("_"))]


def notebooks():
    return sorted(NOTEBOOKS.glob("*.ipynb"))


def on_config(config):
    """Notebooks and modules in the navigation, where the configuration names their folders."""
    found = {
        "notebooks/": [f"notebooks/{notebook.stem}.md" for notebook in notebooks()],
        "reference/": [{module: f"reference/{module}.md"} for module in modules()],
    }
    for entry in config.nav:
        for title, target in entry.items():
            entry[title] = found.get(target, target)
    return config


def reference(module):
    """The page of a module: its own words, then each of its names."""
    package = PACKAGE.joinpath(*module.split(".")[1:])
    head = f"# {module}\n\n::: {module}\n    options:\n      show_root_heading: false\n"
    if not package.is_dir():
        return head
    names = [f"::: {module}.{name}\n" for name in public_names(module)]
    return "\n".join([f"{head}      members: false\n", *names])


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


def on_page_markdown(markdown, page, config, files):
    if page.file.src_uri != "catalogue.md" or not ANIMATIONS:
        return markdown
    frame = r'<a href="animations/\1.html" title="watch it move" target="_blank">\g<0></a>'
    return re.sub(r'<img src="catalogue/(\w+)\.png"[^>]*>', frame, markdown)


def on_page_content(html, page, config, files):
    """Formulas as MathML, which browsers show themselves."""
    return re.sub(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', _formula, html, flags=re.DOTALL)


def _formula(match):
    text = match[2].replace("&amp;", "&").replace("&lt;", "<").replace("&gt;", ">")
    return convert(text, display="block" if match[1] == "div" else "inline")
