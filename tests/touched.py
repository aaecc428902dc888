"""Whether the tests that were run call every module of the library.

`pytest` leaves out the slow ones, and so does CI with the lowest versions. On Python 3.12 or later it looks at it, at
no cost, and fails if slow tests alone call a module, or none: mark other tests, or add a cheap one. Under
`pytest -m ""` all tests count, since a program that a slow one has compiled is not traced again by those that follow.
"""

import ast
import os
import sys
from pathlib import Path

import jax
import pytest

import jaxkane

SOURCE = Path(jaxkane.__file__).parent
PREFIX = f"{SOURCE}{os.sep}"
PROGRAM = "__name__ == '__main__'"
AT_IMPORT = {SOURCE / "catalog" / "_entry.py"}
"""Their functions run when classes are defined: in a test only if this test happens to be the first import."""
TOOL = 3  # an id of sys.monitoring that neither debuggers, nor coverage, nor profilers take


def modules_with_functions():
    """All but those that are programs of their own, which no process of the tests imports."""
    for path in sorted(SOURCE.rglob("*.py")):
        nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
        is_program = any(isinstance(node, ast.If) and ast.unparse(node.test) == PROGRAM for node in nodes)
        if not is_program and path not in AT_IMPORT and any(isinstance(node, ast.FunctionDef) for node in nodes):
            yield str(path)


class Touched:
    """Listens for the first call of every function of the library while a test runs."""

    def __init__(self, config):
        self.config, self.files, self.missing = config, set(), []
        self.in_a_test, self.ask_again = False, False
        sys.monitoring.use_tool_id(TOOL, "jaxkane's tests")
        sys.monitoring.register_callback(TOOL, sys.monitoring.events.PY_START, self._started)
        sys.monitoring.set_events(TOOL, sys.monitoring.events.PY_START)

    def _started(self, code, _):
        """The first call of a function; there is no second, unless that was between tests."""
        file = code.co_filename
        if file not in self.files and file.startswith(PREFIX):
            if self.in_a_test:
                self.files.add(file)
            else:
                self.ask_again = True
        return sys.monitoring.DISABLE

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item):
        self.in_a_test = True
        if self.ask_again:
            self.ask_again = False
            sys.monitoring.restart_events()
        try:
            return (yield)
        finally:
            self.in_a_test = False

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node):
        self.files |= set(getattr(node, "workeroutput", {}).get("touched", ()))

    def pytest_sessionfinish(self, session):
        sys.monitoring.set_events(TOOL, 0)
        sys.monitoring.free_tool_id(TOOL)
        if hasattr(self.config, "workeroutput"):  # a process of pytest-xdist: the first one has the word
            self.config.workeroutput["touched"] = sorted(self.files)
        # On other devices, the tests of native kernels are skipped.
        elif session.exitstatus == pytest.ExitCode.OK and jax.default_backend() == "cpu":
            self.missing = sorted(set(modules_with_functions()) - self.files)
            if self.missing:
                session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter):
        tests = "test" if self.config.option.markexpr == "" else "test that is not marked slow"
        for path in self.missing:
            terminalreporter.write_line(f"no {tests} calls {Path(path).relative_to(SOURCE)}", red=True)


def watch(config):
    """Register the above where all tests are run, and Python can tell."""
    everything = [Path(argument).resolve() for argument in config.args] == [Path(__file__).parent]
    chosen = config.option.markexpr not in ("", "not slow") or config.option.keyword or config.option.collectonly
    if sys.version_info >= (3, 12) and everything and not chosen:
        config.pluginmanager.register(Touched(config), "touched")
