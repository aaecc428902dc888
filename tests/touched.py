"""Whether the tests that are not marked `slow` call every module of the library.

`pytest` runs those alone, and so does CI with the lowest versions. On Python 3.12 or later it looks at it, at no cost,
and names each module that slow tests alone call, or none: mark other tests, or add a cheap one.
"""

import ast
import sys
from pathlib import Path

import pytest

import jaxkane

SOURCE = Path(jaxkane.__file__).parent
TOOL = 3  # an id of sys.monitoring that neither debuggers, nor coverage, nor profilers take


def modules_with_functions():
    for path in sorted(SOURCE.rglob("*.py")):
        if any(isinstance(node, ast.FunctionDef) for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))):
            yield str(path)


class Touched:
    """Listens for the first call of every function of the library while a test runs that is not slow."""

    def __init__(self, config):
        self.config, self.files, self.counts, self.missing = config, set(), False, []
        sys.monitoring.use_tool_id(TOOL, "jaxkane's tests")
        sys.monitoring.register_callback(TOOL, sys.monitoring.events.PY_START, self._started)
        sys.monitoring.set_events(TOOL, sys.monitoring.events.PY_START)

    def _started(self, code, _):
        ours = code.co_filename.startswith(str(SOURCE))
        if ours and not self.counts:
            return None  # ask again
        if ours:
            self.files.add(code.co_filename)
        return sys.monitoring.DISABLE

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item):
        self.counts = item.get_closest_marker("slow") is None
        try:
            return (yield)
        finally:
            self.counts = False

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node):
        self.files |= set(getattr(node, "workeroutput", {}).get("touched", ()))

    def pytest_sessionfinish(self, session):
        sys.monitoring.set_events(TOOL, 0)
        sys.monitoring.free_tool_id(TOOL)
        if hasattr(self.config, "workeroutput"):  # a process of pytest-xdist: the first one has the word
            self.config.workeroutput["touched"] = sorted(self.files)
        elif session.exitstatus == pytest.ExitCode.OK:
            self.missing = sorted(set(modules_with_functions()) - self.files)

    def pytest_terminal_summary(self, terminalreporter):
        for path in self.missing:
            name = Path(path).relative_to(SOURCE)
            terminalreporter.write_line(f"no test that is not marked slow calls {name}", yellow=True)


def watch(config):
    """Register the above where all tests are run, and Python can tell."""
    everything = [Path(argument).resolve() for argument in config.args] == [Path(__file__).parent]
    chosen = config.option.markexpr not in ("", "not slow") or config.option.keyword or config.option.collectonly
    if sys.version_info >= (3, 12) and everything and not chosen:
        config.pluginmanager.register(Touched(config), "touched")
