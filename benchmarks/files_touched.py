"""Through how many files does a call pass? For a reader who follows it, each is one more to open.

Counts the files of `src/jaxkane` whose functions are called by a first `jk.accelerations`, by a first `jk.simulate`,
and by `jk.fit.fit` before its optimizer's first step; each in a fresh process, for the double pendulum of the
catalogue. All modules are imported beforehand: what an import calls is not counted.

Run:      python -m benchmarks.files_touched [accelerations | simulate | fit ...]
Appears:  for each call the number of files, beside the largest that it may be, and their names.
Takes:    ten seconds. Needs Python 3.12.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import CodeType
from typing import Any

from ._process import ROOT, environment

AT_MOST = {"accelerations": 22, "simulate": 24, "fit": 18}


class FirstStep(Exception):
    """The optimizer begins its first step."""


def prepared(name: str) -> Callable[[], Any]:
    """The call of this name, with all that it needs."""
    import numpy as np

    import jaxkane as jk

    system = jk.catalog.DoublePendulum()
    q, u = (np.array([0.3, -0.2]), np.array([0.1, 0.4]))
    if name == "accelerations":
        return lambda: jk.accelerations(system, 0.0, q, u)
    if name == "simulate":
        return lambda: jk.simulate(system, jk.State(q, u), np.linspace(0.0, 1.0, 11))

    class OnlyPrepared(jk.fit.LeastSquares):
        def step(self, *args: Any) -> Any:
            raise FirstStep

    t = np.linspace(0.0, 1.0, 11)
    trial = jk.fit.Trial(t, {name: np.cos(t) for name in system.coordinates}, sigma=0.01)
    return lambda: jk.fit.fit(system, trial, ["length"], optimizer=OnlyPrepared(), steps=1)


def files_of(call: Callable[[], Any], package: Path) -> list[str]:
    """The files of the package whose functions a call calls, in the order of the first."""
    monitoring = sys.monitoring
    files: dict[str, None] = {}

    def started(code: CodeType, offset: int) -> Any:
        path = Path(code.co_filename)
        if code.co_flags & inspect.CO_OPTIMIZED and path.is_relative_to(package):  # no body of a module or a class
            files[str(path.relative_to(package))] = None
        return monitoring.DISABLE

    monitoring.use_tool_id(monitoring.PROFILER_ID, "files_touched")
    monitoring.register_callback(monitoring.PROFILER_ID, monitoring.events.PY_START, started)
    monitoring.set_events(monitoring.PROFILER_ID, monitoring.events.PY_START)
    try:
        call()
    except FirstStep:
        pass
    finally:
        monitoring.set_events(monitoring.PROFILER_ID, monitoring.events.NO_EVENTS)
        monitoring.free_tool_id(monitoring.PROFILER_ID)
    return list(files)


def report(name: str) -> None:
    import jaxkane

    for module in pkgutil.walk_packages(jaxkane.__path__, "jaxkane."):
        if not module.name.endswith("__main__"):  # these are programs
            importlib.import_module(module.name)
    files = files_of(prepared(name), Path(jaxkane.__file__).parent)
    print(f"{name}: {len(files)} files (at most {AT_MOST[name]})")
    for file in files:
        print(f"    {file}")


def main(arguments: list[str]) -> None:
    if arguments[:1] == ["--alone"]:
        report(arguments[1])
        return
    for name in arguments or AT_MOST:
        command = [sys.executable, "-m", "benchmarks.files_touched", "--alone", name]
        subprocess.run(command, cwd=ROOT, env=environment(None), check=True)


if __name__ == "__main__":
    main(sys.argv[1:])
