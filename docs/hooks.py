"""What the site contains besides its pages: executed notebooks, the reference, animations, formulas.

`mkdocs build` executes the notebooks and draws the animations, which takes minutes. `mkdocs serve` leaves both out.
`JAXKANE_NOTEBOOKS` and `JAXKANE_ANIMATIONS` name folders that already contain them; then nothing is executed.
"""

import ast
import atexit
import os
import re
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import nbformat
from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError
from mkdocs.plugins import get_plugin_logger
from mkdocs.structure.files import File
from nbclient import NotebookClient
from nbconvert import MarkdownExporter

from jaxkane.catalog import CATALOG

LOG = get_plugin_logger("jaxkane")
ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "jaxkane"
# Folder of NAME.html, as examples/draw_catalogue.py writes them. None: the gallery shows its pictures alone.
ANIMATIONS = os.environ.get("JAXKANE_ANIMATIONS")
# Folder of executed notebooks. The notebooks of the repository have no outputs.
NOTEBOOKS = Path(os.environ.get("JAXKANE_NOTEBOOKS") or ROOT / "notebooks")


def execute(notebook, target):
    """Execute a notebook in the folder of `target`, which becomes the executed notebook."""
    os.environ.pop("MPLBACKEND", None)  # otherwise no figures are stored in the notebook
    content = nbformat.read(notebook, as_version=4)
    resources = {"metadata": {"path": str(Path(target).parent)}}
    NotebookClient(content, timeout=1800, kernel_name="python3", resources=resources).execute()
    nbformat.write(content, target)


def run(program):
    """Run a Python file with its arguments; returns what it wrote about an error, or an empty string."""
    done = subprocess.run([sys.executable, *program], capture_output=True, text=True)
    return done.stderr if done.returncode else ""


def on_startup(command, dirty):
    """Before `mkdocs build`: execute the notebooks and draw the animations, unless folders are given."""
    global NOTEBOOKS, ANIMATIONS
    if command == "serve" or {"JAXKANE_NOTEBOOKS", "JAXKANE_ANIMATIONS"} & set(os.environ):
        return
    scratch = Path(tempfile.mkdtemp(prefix="jaxkane-site-"))
    atexit.register(shutil.rmtree, scratch)
    programs = [[ROOT / "examples" / "draw_catalogue.py", "--out", scratch]]
    programs += [[__file__, file, scratch / file.name] for file in notebooks()]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for program, failed in zip(programs, pool.map(run, programs), strict=True):
            if failed:
                raise PluginError(f"{program}: {failed}")
            LOG.info("executed %s", program[1] if program[0] == __file__ else program[0])
    NOTEBOOKS, ANIMATIONS = scratch, scratch / "catalogue"


# The modules in the order of use, and the page that explains each.
MODULES = {
    "": "index",
    "catalog": "catalogue",
    "joints": "joints",
    "loads": "elements",
    "rotations": "describing",
    "shapes": "pictures",
    "sensors": "sensors",
    "sweep": "sweeps",
    "plot": "pictures",
    "stability": "stability",
    "collocation": "optimal_control",
    "fit": "fit",
    "data": "fit",
    "estimate": "state_estimation",
    "bicycles": "bicycles",
    "convert": "bringing_models",
    "symbolic": "symbolic",
    "export": "export",
}
# Headings on the page of a module: the package in which names are defined, a title, and the page that explains them.
SUBJECTS = {
    "": {
        "_system": ("Describe a system", "describing"),
        "_integrate": ("Simulate", "simulation"),
        "_animate": ("Animate", "pictures"),
        "_kane": ("Evaluate the equations of motion", "kane"),
        "_scalarjit": ("Configure JAX", "speed"),
    },
    "fit": {
        "solve": ("Fit", "fit"),
        "problem": ("Trials, unknowns, errors", "unknowns"),
        "result": ("Results, uncertainty, validation", "uncertainty"),
        "extend": ("Model extensions", "model_extensions"),
        "inverse": ("Inverse dynamics", "inverse_dynamics"),
        "_collocation": ("Fits by collocation", "process_noise"),
        "_bicycle": ("Bicycles", "bicycles_fit"),
    },
}
# Names that come first under their heading, in the order of use. The others follow in alphabetical order.
FIRST = """
System parameter learned Scalar State inertial Frame Point Vector Body Motion weight Force Torque
simulate Trajectory Status Samples falling rising Impact impact Contact DryFriction
outputs positions velocities constraint_forces audit
animate Animation Sketch assemble best_dependent_speeds with_multipliers
equations_of_motion accelerations mass_matrix forcing configure
CATALOG mechanism Link Loop Site Actuator Coupling hinge slide universal ball planar fixed free
sweep grid Table Sweep trajectories audit fits equilibrium steady_turn SteadyMotion linearize LinearModel eigenvalues
Eigenvalues critical_speeds solve Plan Phases Now continuation
fit minimize LeastSquares Fit Trial check_records Problem Free Offset Gain Delay LowPass
report save_report load begin predict update Filter Belief Innovation
Bicycle Part Ground Road Slope Tyre Contact RigidRider LeaningRider Rider equations Equations c numpy casadi stablehlo
""".split()


def public_names(module):
    """Names that a module's `__init__.py` exports by `from .x import y as y`, each with the package that defines it."""
    tree = ast.parse((PACKAGE / module / "__init__.py").read_text(encoding="utf-8"))
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module]
    names = {
        alias.asname: node.module.split(".")[0]
        for node in imports
        for alias in node.names
        if alias.asname == alias.name and not alias.name.startswith("_")
    }
    order = {name: i for i, name in enumerate(FIRST)}
    return dict(sorted(names.items(), key=lambda item: (order.get(item[0], len(order)), item[0].lower())))


def result_classes(module):
    """Classes that a module's functions return, but that it does not export."""
    package, exported = PACKAGE / module, public_names(module)
    tree = ast.parse((package / "__init__.py").read_text(encoding="utf-8"))
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    for file, level in dict.fromkeys((node.module, node.level) for node in imports):
        folder = package if level == 1 else package.parent  # `from .._collocate.functions import Now`
        body = ast.parse(folder.joinpath(*file.split(".")).with_suffix(".py").read_text(encoding="utf-8")).body
        classes = [node for node in body if isinstance(node, ast.ClassDef) and node.name in exported]
        functions = [
            node
            for nodes in (body, *(each.body for each in classes))
            for node in nodes
            if isinstance(node, ast.FunctionDef) and node.name in exported
        ]
        returns = [ast.unparse(function.returns) for function in functions if function.returns]
        returned = {name for text in returns for name in text.split(" | ")}
        for node in body:
            if isinstance(node, ast.ClassDef) and node.name in returned and node.name not in exported:
                owner = full_name(module) if level == 1 else "jaxkane"
                yield f"{owner}.{file}.{node.name}"


def full_name(module):
    return f"jaxkane.{module}".rstrip(".")


def modules():
    """Public modules and packages of jaxkane in the order of use; "" is jaxkane itself."""
    files = [path.stem for path in PACKAGE.glob("*.py")] + [path.parent.name for path in PACKAGE.glob("*/__init__.py")]
    public = {name for name in files if not name.startswith("_")}
    assert {*MODULES} == {"", *public}, f"MODULES and the public modules differ: {set(MODULES) ^ {'', *public}}"
    return list(MODULES)


def notebooks():
    return sorted(NOTEBOOKS.glob("*.ipynb"))


def on_config(config):
    """Notebooks and modules in the navigation, where a group names their folders."""
    folders = {
        "notebooks/": [f"notebooks/{notebook.stem}.md" for notebook in notebooks()],
        "reference/": [{full_name(module): f"reference/{full_name(module)}.md"} for module in modules()],
    }
    for group in config.nav:
        for pages in group.values():
            for entry in pages:
                entry |= {title: folders.get(target, target) for title, target in entry.items()}
    return config


def link(page):
    """A link from the reference to a page, with the page's own title."""
    title = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8").split("\n")[0].removeprefix("# ")
    return f"Explained in [{title}](../{page}.md).\n"


def reference(module):
    """The page of a module: its docstring, then each of its names under the headings of SUBJECTS."""
    parts = [f"# {full_name(module)}\n\n::: {full_name(module)}\n    options:\n      show_root_heading: false\n"]
    parts[0] += "      show_root_toc_entry: false\n"
    if not (PACKAGE / module).is_dir():
        return f"{parts[0]}\n{link(MODULES[module])}"
    parts[0] += "      members: false\n"
    entry = "::: {}\n    options:\n      heading_level: {}\n"
    names, subjects = public_names(module), SUBJECTS.get(module)
    if subjects:
        assert set(names.values()) == set(subjects), f"SUBJECTS and {full_name(module)} differ: {set(names.values())}"
        for package, (title, page) in subjects.items():
            parts.append(f"## {title}\n\n{link(page)}")
            parts += [entry.format(f"{full_name(module)}.{name}", 3) for name in names if names[name] == package]
    else:
        parts.append(link(MODULES[module]))
        parts += [entry.format(f"{full_name(module)}.{name}", 2) for name in names]
    results = [entry.format(name, 3) for name in result_classes(module)] if module else []
    return "\n".join([*parts, *(["## Results\n"] if results else []), *results])


# The code of notebooks has up to 120 columns.
HIDE_TOC, WIDE = "---\nhide: [toc]\n---\n", "<style>.md-grid {max-width: 72rem}</style>\n"


def pages_of(notebook):
    """A notebook as a page, and the pictures among its outputs."""
    resources = {"output_files_dir": f"{notebook.stem}_files", "unique_key": notebook.stem}
    content = nbformat.read(notebook, as_version=4)
    content.metadata["language_info"] = {"name": "python"}  # known to notebooks only once they have been run
    text, resources = MarkdownExporter().from_notebook_node(content, resources=resources)
    title, rest = text.split("\n", 1)
    outputs = any(cell.get("outputs") for cell in content.cells)
    how = f"!!! note\n    You can run this page as a notebook: `notebooks/{notebook.name}`."
    how += "" if outputs else " This site was built without its outputs. `mkdocs build` adds them."
    yield f"notebooks/{notebook.stem}.md", f"{HIDE_TOC}{title}\n\n{WIDE}\n{how}\n\n{rest}"
    for name, content in resources["outputs"].items():
        yield f"notebooks/{name}", content


def on_files(files, config):
    for notebook in notebooks():
        for path, content in pages_of(notebook):
            files.append(File.generated(config, path, content=content))
    for module in modules():
        files.append(File.generated(config, f"reference/{full_name(module)}.md", content=reference(module)))
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
    note = "" if ANIMATIONS else "!!! note\n    This site was built without animations. `mkdocs build` adds them.\n\n"
    return re.sub(f"{GALLERY}.*?-->", lambda _: f'{note}<div style="{STYLE}">\n{figures}\n</div>', markdown)


def on_page_content(html, page, config, files):
    """Formulas as MathML, which browsers show themselves."""
    return re.sub(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', _formula, html, flags=re.DOTALL)


def _formula(match):
    text = match[2].replace("&amp;", "&").replace("&lt;", "<").replace("&gt;", ">")
    return convert(text, display="block" if match[1] == "div" else "inline")


class _Page(HTMLParser):
    """Anchors and links of a page of the built site."""

    def __init__(self, path):
        super().__init__()
        self.anchors, self.links = {"", "__top"}, set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.anchors |= {attrs.get("id"), attrs.get("name")}
        self.links |= {attrs.get("href"), attrs.get("src")} - {None}


def on_post_build(config):
    """Every link of the site, from generated pages too, leads to a file and to an anchor that exist."""
    site = Path(config.site_dir)
    pages = {path: _Page(path) for path in site.rglob("*.html") if path.parent.name != "animations"}
    for path, page in pages.items():
        for target in page.links:
            url = urlsplit(target)
            file = (path.parent / unquote(url.path)).resolve() if url.path else path
            if url.scheme or url.netloc or url.path.startswith("/"):
                continue
            if not file.exists() or (file in pages and unquote(url.fragment) not in pages[file].anchors):
                LOG.warning("%s: %s leads nowhere", path.relative_to(site), target)


if __name__ == "__main__":
    execute(*sys.argv[1:])
