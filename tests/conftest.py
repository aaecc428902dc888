"""Settings of all tests: float64, no silent promotion of dtypes or shapes, and programs that are compiled once for all.

How to run them:

    pytest                        everything, in as many processes as there are cores, four at most
    pytest tests/system/test_kinematics.py  a file or a test, in this process
    pytest --cache-clear          compiles every program anew; by default they are kept for the next run, in pytest's
                                  own cache, and thrown away where they have become many
    JAXKANE_TEST_CACHE=FOLDER     keeps them elsewhere
    JAXKANE_TEST_CACHE=0          keeps none, and leaves XLA as a user has it
    pytest -m ""                  the slow ones too
    pytest -m "slow and not weekly"  the slow ones that CI runs
    JAXKANE_TEST_COSTS=FILE       writes the CPU seconds of each test
    JAXKANE_VALIDATION=docs/validation.md pytest -m published    writes the table of published figures
"""

import fnmatch
import gc
import os
import pathlib
import shutil
import tempfile
from typing import NamedTuple

import costs
import jax
import numpy as np
import psutil
import pytest
import touched

import jaxkane as jk
from jaxkane._scalarjit import native as native_kernels

CACHE, MOST_PROGRAMS = "JAXKANE_TEST_CACHE", 500_000_000  # bytes

# Most of the tests' time is compilation, and with XLA's newer way to write fused loops it takes a third longer. From
# JAX 0.11 on there is no other way, and XLA ends a process at a flag that it does not know.
if os.environ.get(CACHE) != "0" and jax.__version_info__ < (0, 11):
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_use_fusion_emitters=false"


def pytest_xdist_auto_num_workers(config):
    """Four processes at most, since each traces its tests' programs anew; and none for single files."""
    folders = any(os.path.isdir(argument) for argument in config.args)
    return min(4, psutil.cpu_count() or 1) if folders else 0


def pytest_configure(config):
    # Set by the process that the user started, and inherited by those that pytest-xdist starts.
    if CACHE not in os.environ:
        os.environ[CACHE] = str(_folder_of_programs(config))
    kept = os.environ[CACHE]
    jk.configure(cache=False if kept == "0" else kept, verbose=False)
    if kept != "0":
        # What runs for milliseconds need not be optimized for seconds; native kernels are written as ever. The variable
        # is for the processes that tests start.
        os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"
        _optimize(False)
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    jax.config.update("jax_numpy_rank_promotion", "raise")
    touched.watch(config)
    costs.watch(config)
    # A trace makes a million small objects, most of which live on: to look through all of them again and again took a
    # tenth of the tests' time.
    gc.set_threshold(100_000, 50, 50)


_is_optimized = True


def _optimize(on):
    global _is_optimized
    jax.clear_caches()
    jax.config.update("jax_disable_most_optimizations", not on)
    _is_optimized = on


def _folder_of_programs(config):
    """In pytest's own cache; a folder of this run alone where that is switched off."""
    if not hasattr(config, "cache"):
        folder = tempfile.mkdtemp(prefix="jaxkane-programs-")
        config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))
        return folder
    folder = config.cache.mkdir("programs")
    if sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) > MOST_PROGRAMS:
        shutil.rmtree(folder)
        folder.mkdir()
    return folder


def pytest_collection_finish():
    """What has been imported stays."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def published(request):
    """`published(source, quantity, theirs, ours, atol)`: figures that a source prints, compared, and kept for the page
    that lists them. Without figures, `theirs` says what was compared otherwise."""

    def compare(source, quantity, theirs, ours=None, atol=0.0):
        if ours is None:
            row = [source, quantity, "", theirs, "", ""]
        else:
            theirs, ours, atol = np.ravel(theirs), np.ravel(ours), np.broadcast_to(atol, np.size(theirs))
            worst = np.argmax(np.abs(ours - theirs) - atol)
            assert np.all(np.abs(ours - theirs) <= atol), (theirs[worst], ours[worst], atol[worst])
            k = int(np.argmax([len(str(x)) for x in theirs]))
            digits = min(len(str(theirs[k]).partition(".")[2]), round(-np.log10(atol[k])))
            row = [source, quantity, str(theirs.size), str(theirs[k]), f"{ours[k]:.{digits}f}", f"{atol[k]:.0e}"]
        test = request.node.nodeid.split("[")[0]
        request.node.user_properties.append(("published", (*row, test)))

    return compare


def pytest_terminal_summary(terminalreporter, config):
    """The table of what tests have compared by `published`, into the file that JAXKANE_VALIDATION names."""
    if "JAXKANE_VALIDATION" not in os.environ or hasattr(config, "workerinput"):
        return
    reports = [report for name in ("passed", "failed") for report in terminalreporter.stats.get(name, [])]
    rows = {row for report in reports for name, row in report.user_properties if name == "published"}
    heads = ("source", "quantity", "figures", "for example: theirs", "ours", "within", "test")
    lines = [heads, ["---"] * len(heads), *([*row[:-1], f"`{row[-1]}`"] for row in sorted(rows))]
    path = pathlib.Path(os.environ["JAXKANE_VALIDATION"])
    before, _, after = path.read_text(encoding="utf-8").partition(MARK)
    table = "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
    path.write_text(f"{before}{MARK}\n\n{table}\n{after[after.index(END) :] if END in after else ''}", encoding="utf-8")


MARK, END = "<!-- begin: written by `JAXKANE_VALIDATION=docs/validation.md pytest -m published` -->", "\n<!-- end -->"


@pytest.fixture(autouse=True, scope="module")
def _programs_are_forgotten():
    """Thousands of compiled programs would fill the memory of a small machine, of which half is left to others; and
    each is several mappings of memory, of which Linux gives a process 65530 before it ends it."""
    yield
    processes = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    if psutil.Process().memory_info().rss > psutil.virtual_memory().total / (2 * processes) or _mapped() > 0.3:
        jax.clear_caches()


def _mapped() -> float:
    """The mappings of memory of this process, as a part of those that it may have; 0 where that is not told."""
    try:
        with open("/proc/self/maps") as mappings, open("/proc/sys/vm/max_map_count") as most:
            return sum(1 for _ in mappings) / int(most.read())
    except OSError:
        return 0.0


NATIVE = native_kernels.is_wanted()


class Compilation(NamedTuple):
    """How the programs of a test are compiled. Between two ways all programs are thrown away."""

    native: bool
    optimized: bool  # as a user has them

    @classmethod
    def of(cls, item):
        return cls(
            NATIVE if _kernels_of(item) is None else _kernels_of(item) == "native",
            os.environ[CACHE] == "0" or item.get_closest_marker("optimized") is not None,
        )


def _kernels_of(item):
    """Where a test asks for some: "native" or "XLA"."""
    for fixture, kernels in (("native", "native"), ("by_xla", "XLA")):
        if fixture in item.fixturenames:
            return kernels
    return item.callspec.params["kernels"] if "kernels" in item.fixturenames else None


def _has_case(item, name) -> bool:
    """Whether the marker `name` of a parametrized test selects this case. Patterns are those of `fnmatch`."""
    marker = item.get_closest_marker(name)
    if marker is None:
        return False
    case = item.callspec.id
    if "all_but" in marker.kwargs:
        return not any(fnmatch.fnmatchcase(case, pattern) for pattern in marker.kwargs["all_but"])
    return any(fnmatch.fnmatchcase(case, pattern) for pattern in marker.args)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Weekly tests are slow ones. Tests of a file that are compiled in one way follow each other."""
    for item in items:
        if _has_case(item, "weekly_cases"):
            item.add_marker(pytest.mark.weekly)
        if item.get_closest_marker("weekly") or _has_case(item, "slow_cases"):
            item.add_marker(pytest.mark.slow)
    files = {}
    items.sort(key=lambda item: (files.setdefault(item.path, len(files)), Compilation.of(item)))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    native, optimized = Compilation.of(item)
    if _kernels_of(item) == "native":
        if native_kernels.why_not():
            pytest.skip(f"no native kernels: {native_kernels.why_not()}")
        if jax.default_backend() != "cpu":
            pytest.skip(f"native kernels run on a CPU only, and JAX uses the {jax.default_backend()}")
    if item.get_closest_marker("many_steps") and jax.default_backend() != "cpu":
        pytest.skip(f"many steps in sequence take minutes on the {jax.default_backend()}")
    if native != native_kernels.is_wanted():
        native_kernels.use(native)
    if optimized != _is_optimized:
        _optimize(optimized)


@pytest.fixture(params=["native", "XLA"])
def kernels(request):
    """A test once with native kernels, and once without."""
    return request.param


@pytest.fixture
def native():
    """For tests of native kernels."""


@pytest.fixture
def by_xla():
    """For tests without native kernels."""


@pytest.fixture
def on_cpu():
    """For tests of programs that are compiled for a CPU."""
    if jax.default_backend() != "cpu":
        pytest.skip(f"the program is compiled for a CPU, and JAX uses the {jax.default_backend()}")
