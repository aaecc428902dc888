"""One call at the top of a script: precision, kept programs, devices. Each in a process of its own.

To import JAX takes longer than most of these scripts: one process does so for all of them, and starts nothing; each
script runs in a fork of it.
"""

import json
import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

from jaxkane._scalarjit import native
from jaxkane._scalarjit.configure import _made_folder, _split_cpu, configure
from jaxkane._scalarjit.native import switched_on

KERNELS = f"no native kernels ({native.why_not()})" if native.why_not() else "native kernels"
CLEAN = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "EQX_", "XLA_"))}
FORKS = """
import json, os, sys, traceback, warnings
import jaxkane as jk, numpy as np, jax

warnings.filterwarnings("ignore", "os.fork", RuntimeWarning)  # no thread of JAX has been started
for line in sys.stdin:
    case = json.loads(line)
    if not (child := os.fork()):
        status = 0
        for descriptor, file in enumerate(case["files"], start=1):
            os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), descriptor)
        try:
            exec(case["code"], {"__name__": "__main__", "jk": jk, "np": np, "jax": jax})
        except BaseException:
            traceback.print_exc()
            status = 1
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""
RIDE = """
hits, misses = [], []
jax.monitoring.register_event_listener(
    lambda event, **_: (hits if event.endswith("cache_hits") else misses if event.endswith("cache_misses") else []
                        ).append(event))
P = jk.catalog.DoublePendulum(mass=1.0, length=1.0)
start = jk.State(np.array([0.5, -0.2]), np.zeros(2))
ride = jk.simulate(P, start, np.linspace(0.0, 1.0, 6), step=0.1)
rides = jk.sweep.sweep(P, start, np.linspace(0.0, 1.0, 6), table={"length": [1.0, 2.0, np.nan]}, step=0.1)
assert rides.reason == ["completed", "completed", "invalid"]
print(len(hits), len(misses), ride.q.dtype, np.asarray(ride.q).tobytes().hex(), rides.q.tobytes().hex())
"""


@pytest.fixture(scope="module")
def python(tmp_path_factory):
    if not hasattr(os, "fork"):
        pytest.skip("Windows has no fork")
    files = [tmp_path_factory.mktemp("streams") / name for name in ("stdout", "stderr")]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "bufsize": 1}
    with subprocess.Popen([sys.executable, "-c", FORKS], env=CLEAN, **pipes) as forks:

        def run(code, *, status=0):
            print(json.dumps({"code": code, "files": [*map(str, files)]}), file=forks.stdin)
            told = forks.stdout.readline().strip()
            stdout, stderr = (file.read_text() for file in files)
            assert told == str(status), stderr
            return SimpleNamespace(stdout=stdout, stderr=stderr)

        yield run
        forks.stdin.close()


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("programs") / "cache"


@pytest.fixture(scope="module")
def first(cache, python):
    return python(f"jk.configure(cache={str(cache)!r})\n" + RIDE).stdout.splitlines()


def test_compiled_simulations_are_reused_by_the_next_process(first, cache, python):
    assert first[0] == f"jaxkane: float64, {KERNELS}"
    assert first[1].startswith(f"  Compiled programs are stored in {cache} (none yet)")
    assert {"jit_solve", "jit__solve"} <= {path.name.rsplit("-", 2)[0] for path in cache.iterdir()}
    _, compiled, dtype, *bytes_of_first = first[-1].split()
    assert int(compiled) > 3
    second = python(f"jk.configure(cache={str(cache)!r}, verbose=False)\n" + RIDE).stdout.splitlines()
    hits, misses, dtype, *bytes_of_second = second[-1].split()
    assert (int(misses), dtype) == (0, "float64")
    assert int(hits) >= int(compiled)
    assert bytes_of_second == bytes_of_first
    assert len(second) == 1  # and nothing else was printed


def test_child_processes_inherit_the_configuration_without_repeated_output(cache, python):
    code = (
        f"import os, subprocess, sys\nfor _ in range(2): jk.configure(cache={str(cache)!r}, devices=3)\n"
        "print(len(jax.local_devices(backend='cpu')))\n"
        "c = 'import jax; print(jax.config.jax_enable_x64, jax.config.jax_compilation_cache_dir, "
        "jax.config.jax_persistent_cache_min_compile_time_secs)'\n"
        "print(subprocess.check_output([sys.executable, '-c', c], text=True).strip())"
    )
    lines = python(code).stdout.splitlines()
    assert lines[0] == f"jaxkane: float64, 3 CPU devices, {KERNELS}"
    assert lines[3:] == ["3", f"True {cache} 0.0"]


def test_without_a_cache_only_the_precision_changes(python):
    code = (
        "print(jk.configure(cache=False, native=False))\nimport equinox._errors as e\n"
        "print(e.EQX_ON_ERROR, jax.numpy.ones(1).dtype)"
    )
    assert python(code).stdout.splitlines() == [
        "jaxkane: float64, no native kernels (switched off); compiled programs are not stored.",
        "Configuration(float64=True, cache=None, devices=None, native=False)",
        "raise float64",
    ]


def test_configure_warns_if_called_too_late_and_rejects_zero_devices(python):
    code = (
        "x = jax.numpy.ones(3)\nimport warnings\nwith warnings.catch_warnings(record=True) as told:\n"
        "    warnings.simplefilter('always')\n    jk.configure(cache=False, devices=2, verbose=False)\n"
        "print(*[w.message for w in told], sep='\\n'); print(told[0].filename)\njk.configure(cache=False, devices=0)"
    )
    run = python(code, status=1)
    late, devices, where = run.stdout.splitlines()
    assert "called too late: 1 float32 array exists" in late
    assert "too late for devices=2: JAX has started with 1" in devices
    assert where == "<string>"
    assert "`devices` must be an integer of at least 1" in run.stderr


@pytest.mark.parametrize(("first", "n"), [("", 1), ("jk.configure(float64=False, cache=False, verbose=False)", 0)])
def test_simulations_in_float32_warn_once_unless_float32_was_chosen(python, first, n):
    code = (
        f"import warnings\n{first}\nP = jk.catalog.DoublePendulum(mass=1.0, length=1.0)\n"
        "with warnings.catch_warnings(record=True) as told:\n"
        "    warnings.simplefilter('always')\n"
        "    for _ in range(2):\n"
        "        try: jk.simulate(P, None, [0.0, 1.0])\n"
        "        except TypeError: pass\n"
        "print(sum('This simulation is in float32' in str(w.message) for w in told))"
    )
    assert python(code).stdout == f"{n}\n"


def test_without_llvm_xla_is_used_and_reported(python):
    code = (
        "import sys, warnings\nsys.modules['llvmlite'] = sys.modules['llvmlite.binding'] = None\n"
        "warnings.simplefilter('error')\njk.configure(cache=False)\n"
        "P = jk.catalog.DoublePendulum(mass=1.0, length=1.0)\n"
        "print(jk.accelerations(P, 0.0, np.array([0.5, -0.2]), np.zeros(2)).shape)\njk.configure(native=True)"
    )
    run = python(code, status=1)
    why = "llvmlite is not installed: pip install llvmlite"
    assert run.stdout.startswith(f"jaxkane: float64, no native kernels ({why});")
    assert f"UserWarning: jaxkane does not use native kernels: {why}." in run.stderr
    assert run.stdout.splitlines()[1] == "(2,)"


@pytest.mark.slow
def test_the_environment_may_switch_native_kernels_off():
    code = [sys.executable, "-c", "import jaxkane\njaxkane.configure(cache=False)"]
    assert b"switched off" in subprocess.check_output(code, env=CLEAN | {"JAXKANE_NATIVE": "0"})


@pytest.mark.parametrize(
    ("word", "is_on"),
    [("0", False), ("false", False), ("No", False), ("OFF", False), ("", True), ("1", True), ("True", True)],
)
def test_environment_values_for_on_and_off(word, is_on):
    assert switched_on(word) is is_on


def test_an_unknown_word_in_the_environment_is_refused():
    with pytest.raises(ValueError, match="JAXKANE_NATIVE='maybe' in the environment must be one of 1, true"):
        switched_on("maybe")


@pytest.mark.parametrize("option", [{"float64": "no"}, {"native": "off"}, {"native": 0}, {"cache": 3}])
def test_options_of_the_wrong_type_raise_before_any_setting_changes(option):
    with pytest.raises(TypeError, match=f"configure: `{next(iter(option))}` must be"):
        configure(**option)


@pytest.mark.parametrize("why", ["read only", "no home"])
def test_an_unwritable_cache_folder_warns_once_and_is_ignored(python, why):
    """As with a home that is read only, in a container or on a cluster."""
    refused = {
        "read only": "from pathlib import Path\ndef refuse(*_, **__): raise PermissionError(13, 'Permission denied')\n"
        "Path.mkdir = refuse\n",
        "no home": "import os\nfrom pathlib import Path\ndef refuse(*_): raise RuntimeError('no home')\n"
        "os.environ.pop('XDG_CACHE_HOME', None)\nPath.expanduser = refuse\n",
    }
    code = (
        refused[why] + "import warnings\nwith warnings.catch_warnings(record=True) as told:\n"
        "    warnings.simplefilter('default')\n    for _ in 'ab': done = jk.configure(native=False, verbose=False)\n"
        "print(done.cache, jax.config.jax_compilation_cache_dir, 'EQX_ON_ERROR' in os.environ)\n"
        "print(*[w.message for w in told], sep='\\n')"
    )
    state, *told = python("import os\n" + code).stdout.splitlines()
    assert state == "None None False"
    assert len(told) == 1
    assert told[0].startswith("jaxkane.configure: compiled programs cannot be stored")


def test_equinox_checks_of_the_user_raise_with_a_cache(cache, python):
    """Before, while and after jaxkane compiles a program; and with the cache switched off again."""
    code = (
        f"jk.configure(cache={str(cache)!r}, native=False, verbose=False)\n"
        "import equinox as eqx\n"
        "def raises():\n"
        "    check = eqx.filter_jit(lambda x: eqx.error_if(x, x > 0, 'too large'))\n"
        "    try: check(jax.numpy.ones(()))\n"
        "    except Exception as error: return 'too large' in str(error)\n"
        "before, inside = raises(), []\n"
        "def torque(t, state):\n"
        "    inside.append(eqx._errors.EQX_ON_ERROR)\n"
        "    return 0.0 * t\n"
        "P = jk.catalog.DoublePendulum(mass=1.0, length=1.0)\n"
        "start = jk.State(np.array([0.5, -0.2]), np.zeros(2))\n"
        "jk.simulate(P, start, np.linspace(0.0, 1.0, 6), {'shoulder_torque': torque}, step=0.1)\n"
        "print(before, raises(), 'nan' in inside, 'EQX_ON_ERROR' in __import__('os').environ)\n"
        "jk.configure(cache=False, native=False, verbose=False)\n"
        "print(jax.config.jax_compilation_cache_dir, raises())"
    )
    assert python(code).stdout.splitlines() == ["True True True False", "None True"]


@pytest.mark.parametrize("devices", ["2", True, 2.5, 0])
def test_an_invalid_number_of_devices_raises(devices):
    with pytest.raises(ValueError, match="`devices` must be an integer of at least 1, got"):
        _split_cpu(devices)


@pytest.mark.slow
def test_a_cache_folder_that_is_a_file_raises(tmp_path):
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "inside"):
        with pytest.raises(ValueError, match=r"file.* is a file, or is inside one. Pass the name of a folder"):
            _made_folder(folder)
