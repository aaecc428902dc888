"""Sweeps that outgrow a device or a process: the same bytes, whatever happens on the way."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import tqdm

import jaxkane as jk
from jaxkane.catalog import DoublePendulum

PENDULUM = DoublePendulum(mass=1.0, length=1.0)
REST = jk.State(np.zeros(2), np.zeros(2))
TS = np.linspace(0.0, 30.0, 4)
TABLE = jk.sweep.grid(theta1=np.linspace(0.1, 3.0, 50), mass=np.linspace(1.0, 2.0, 12))
CHUNK = 32  # 19 chunks, the last one not full

# The same sweep in a process of its own.
SCRIPT = """
import sys
import jaxkane as jk
import numpy as np
from jaxkane.catalog import DoublePendulum

jk.configure(cache=False, verbose=False)
if __name__ == "__main__":
    rides = jk.sweep.sweep(
        DoublePendulum(mass=1.0, length=1.0),
        jk.State(np.zeros(2), np.zeros(2)),
        np.linspace(0.0, 30.0, 4),
        table=jk.sweep.grid(theta1=np.linspace(0.1, 3.0, 50), mass=np.linspace(1.0, 2.0, 12)),
        chunk=32,
        folder=sys.argv[1],
    )
    np.save(sys.argv[2], rides.q)
"""


def run(folder=None, **options):
    return jk.sweep.sweep(PENDULUM, REST, TS, table=TABLE, chunk=CHUNK, folder=folder, **options)


def contents(folder):
    return {path.name: path.read_bytes() for path in sorted(Path(folder).iterdir())}


def chunks(folder):
    return sorted(Path(folder).glob("chunk-*.npz"))


def wait_for_chunks(folder, n, process=None):
    until = time.monotonic() + 60
    while len(chunks(folder)) < n:
        assert time.monotonic() < until, "no chunk was written"
        assert process is None or process.poll() is None, "it ended early"
        time.sleep(0.002)


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    path = tmp_path_factory.mktemp("script") / "run.py"
    path.write_text(SCRIPT)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("whole") / "sweep"


@pytest.fixture(scope="module")
def rides(folder):
    return run(folder)


def fail_after_two_chunks(patch, error):
    """The progress bar is updated after each chunk."""
    calls = []

    def update(bar, n=1):
        calls.append(n)
        if len(calls) == 2:
            raise error

    patch.setattr(tqdm.tqdm, "update", update)


def same(a, b):
    for name in ("q", "u", "status", "t_end"):
        x, y = np.asarray(getattr(a, name)), np.asarray(getattr(b, name))
        assert x.tobytes() == y.tobytes()


@pytest.mark.weekly
def test_a_killed_sweep_is_resumed(rides, folder, script, tmp_path):
    process = subprocess.Popen([sys.executable, script, tmp_path / "sweep", tmp_path / "q.npy"])
    wait_for_chunks(tmp_path / "sweep", 3, process)
    process.send_signal(signal.SIGKILL)
    assert process.wait(timeout=20) == -signal.SIGKILL
    done = {path: path.stat().st_mtime_ns for path in chunks(tmp_path / "sweep")}
    assert 3 <= len(done) < 19
    (tmp_path / "sweep" / "chunk-00000576.npz.1.tmp").write_bytes(b"half of a chunk")  # as a killed writer leaves it
    same(run(tmp_path / "sweep"), rides)
    assert contents(tmp_path / "sweep") == contents(folder)
    assert {path: path.stat().st_mtime_ns for path in done} == done  # they were not computed again


@pytest.mark.slow_cases("folder")
@pytest.mark.parametrize("kept", [True, False], ids=["folder", "memory"])
def test_unfinished_members_are_interrupted_and_not_saved(rides, tmp_path, monkeypatch, kept):
    with monkeypatch.context() as patch:
        fail_after_two_chunks(patch, KeyboardInterrupt)
        part = run(tmp_path if kept else None)
    assert part.counts == {"interrupted": 600 - 64, "completed": 64}
    done, whole = (x.q.reshape(600, 4, 2) for x in (part, rides))
    np.testing.assert_array_equal(done[:64], whole[:64])
    assert np.isnan(done[64:]).all()
    if not kept:
        return
    assert len(chunks(tmp_path)) == 2
    same(run(tmp_path), rides)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rtol": 1e-6}, r"option rtol \(1e-08 there, 1e-06 here\)"),
        ({"reduce": lambda ride: ride.q[-1]}, r"reduce \(nothing there, "),
        ({"table": jk.sweep.grid(theta1=np.linspace(0.1, 3.0, 50), mass=np.linspace(1.0, 2.1, 12))}, r"table mass \("),
        ({"chunk": 64}, r"layout chunk \(32 there, 64 here\)"),
        ({"system": DoublePendulum(1.0, 1.0, gravity=1.62)}, r"parameter gravity \(9.81 there, 1.62 here\)"),
        ({"system": type("Other", (DoublePendulum,), {})(1.0, 1.0)}, r"system class \(DoublePendulum there, Other"),
        ({"state": jk.State(np.full(2, 0.1), np.zeros(2))}, r"state q \("),
        ({"ts": TS * 2}, r"times \("),
        ({"inputs": {"elbow_torque": 0.1}}, r"input elbow_torque \(nothing there, 0.1 here\)"),
        ({"inputs": lambda t, state: {"elbow_torque": 0.1}}, r"input \(nothing there, <lambda> "),
    ],
)
def test_a_folder_of_another_sweep_is_refused(rides, folder, change, message):
    before = contents(folder)
    arguments = {"system": PENDULUM, "state": REST, "ts": TS, "table": TABLE, "chunk": CHUNK} | change
    with pytest.raises(ValueError, match=rf"belongs to another sweep. It differs in .*{message}"):
        jk.sweep.sweep(**arguments, folder=folder)
    assert contents(folder) == before


@pytest.mark.weekly
def test_two_devices_give_identical_results(rides, script, tmp_path):
    flags = os.environ.get("XLA_FLAGS", "")  # the same code, to the last bit
    two = {**os.environ, "XLA_FLAGS": f"{flags} --xla_force_host_platform_device_count=2"}
    subprocess.run([sys.executable, script, tmp_path / "sweep", tmp_path / "q.npy"], env=two, check=True, timeout=300)
    np.testing.assert_array_equal(np.load(tmp_path / "q.npy"), rides.q)


@pytest.mark.weekly
def test_dependent_coordinates_are_assembled_on_two_devices():
    code = """
import jaxkane as jk, numpy as np, jax
jk.configure(cache=False, devices=2, verbose=False)
from mechanisms import OnACircle

x = np.linspace(0.0, 0.9, 40)
rides = jk.sweep.sweep(OnACircle(), jk.State([0.0, 0.7], [0.0]), [0.0, 0.01], table={"x": x})
assert len(jax.local_devices()) == 2
np.testing.assert_allclose(rides["y"][:, 0], np.sqrt(1 - x**2), atol=1e-12)
"""
    clean = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    clean["PYTHONPATH"] = os.pathsep.join(sys.path)  # with the folder of `mechanisms`
    run = subprocess.run([sys.executable, "-c", code], env=clean, capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stderr


@pytest.mark.weekly
def test_a_sweep_completes_after_a_worker_is_killed(rides, folder, tmp_path):
    distributed = pytest.importorskip("distributed")
    workers = {"n_workers": 2, "threads_per_worker": 1, "processes": True, "host": "127.0.0.1"}
    with distributed.LocalCluster(**workers, dashboard_address=None) as cluster, distributed.Client(cluster) as client:
        pids = client.run(os.getpid)
        assert len(set(pids.values())) == 2
        victim = next(iter(pids.values()))

        def kill():
            wait_for_chunks(tmp_path, 2)
            os.kill(victim, signal.SIGKILL)
            left.append(19 - len(chunks(tmp_path)))

        left = []
        killer = threading.Thread(target=kill)
        killer.start()
        swept = run(tmp_path, client=client)
        killer.join()
        assert left[0] > 2, "it was over before the worker was killed"
        with pytest.raises(ProcessLookupError):
            os.kill(victim, 0)
    same(swept, rides)
    assert contents(tmp_path) == contents(folder)
