"""Folders of sweeps are recognized by their program and inputs, and remain valid if files are damaged."""

import dataclasses
import errno
import os
import subprocess
import sys
import threading
import warnings
from pathlib import Path

import diffrax
import jax
import numpy as np
import pytest
from test_sweep_scale import fail_after_two_chunks

import jaxkane as jk

TS = np.linspace(0.0, 0.2, 3)
REST = jk.State(np.zeros(1), np.zeros(1))
TABLE = {"mass": np.linspace(1.0, 2.0, 70)}  # three chunks
OPTIONS = {"table": TABLE, "chunk": 32, "step": 0.1, "solver": diffrax.Midpoint()}
GRAVITY = 9.81


class Drop(jk.System):
    """A particle whose acceleration is read in several ways."""

    mass: jk.Scalar = jk.parameter(2.0)
    coordinates, speeds, inputs = ("x",), ("v",), ("push",)
    numbers = {"one": [1.0]}
    array = np.ones(2)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(self.mass, 0.0, O.moving(q[0] * N.x, u[0] * N.x))])

    def loads(self, t, q, u, motion, inputs):
        gravity = (lambda: (lambda: GRAVITY)())() * self.numbers["one"][0] * self.array[0]
        return [jk.Force(self.mass * (gravity + inputs["push"]) * motion.N.x, motion.bodies[0])]


def run(folder=None, **options):
    return jk.sweep.sweep(Drop(), REST, TS, folder=folder, **{**OPTIONS, **options})


@pytest.fixture(scope="module")
def rides():
    return run()


@pytest.fixture(scope="module")
def finished(rides, tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished") / "sweep"
    np.testing.assert_array_equal(run(folder).q, rides.q)
    return folder


@pytest.fixture
def copy(finished, tmp_path):
    for path in finished.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    return tmp_path


def contents(folder):
    return {path.name: path.read_bytes() for path in sorted(Path(folder).iterdir())}


CHANGES = {
    "a global in a nested lambda": lambda m: m.setattr(sys.modules[__name__], "GRAVITY", 1.62),
    "a dict on a class": lambda m: m.setitem(Drop.numbers, "one", [2.0]),
    "an array on a class": lambda m: m.setattr(Drop, "array", np.array([2.0, 1.0])),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CHANGES)
def test_values_read_by_the_system_are_part_of_the_digest(name, copy, monkeypatch, rides):
    CHANGES[name](monkeypatch)
    with pytest.raises(ValueError, match=r"belongs to another sweep. It differs in program \("):
        run(copy)
    monkeypatch.undo()
    np.testing.assert_array_equal(run(copy).q, rides.q)


@pytest.mark.slow
def test_values_read_by_inputs_and_reduce_are_part_of_the_digest(tmp_path):
    held = {"push": np.array([1.0]), "scale": [1.0]}
    inputs = {"push": lambda t, state: held["push"][0]}
    reduce = lambda ride: held["scale"][0] * ride["x"][-1]  # noqa: E731
    first = run(tmp_path, inputs=inputs, reduce=reduce).values
    for name, change in (("push", np.array([2.0])), ("scale", [3.0])):
        was, held[name] = held[name], change
        with pytest.raises(ValueError, match="It differs in program"):
            run(tmp_path, inputs=inputs, reduce=reduce)
        held[name] = was
    held["other"] = 1.0  # that nobody reads
    np.testing.assert_array_equal(run(tmp_path, inputs=inputs, reduce=reduce).values, first)


@pytest.mark.slow
def test_values_in_the_closure_of_a_callback_are_part_of_the_digest(tmp_path):
    """A function that the program calls back is part of it, with all that it reads."""

    def inputs(push):
        called = lambda t: np.asarray(push + 0.0 * t)  # noqa: E731
        like = jax.ShapeDtypeStruct((), float)
        return {"push": lambda t, state: jax.pure_callback(called, like, t, vmap_method="expand_dims")}

    few = {"table": {"mass": [1.0, 2.0]}}
    first = run(tmp_path, inputs=inputs(1.0), **few)
    np.testing.assert_array_equal(run(tmp_path, inputs=inputs(1.0), **few).q, first.q)
    with pytest.raises(ValueError, match="It differs in program"):
        run(tmp_path, inputs=inputs(2.0), **few)


SCRIPT = """
import sys, numpy as np, jaxkane as jk
jk.configure(cache=False, verbose=False)

class Bead(jk.System):  # on a ring, pushed
    mass: jk.Scalar = jk.parameter(1.0)
    coordinates, speeds, inputs = ("x", "y"), ("rate",), ("push",)
    dependent_coordinates = ("y",)
    def q_dot(self, t, q, u):
        return -q[1] * u[0], q[0] * u[0]
    def configuration_constraints(self, t, q):
        return [q[0] * q[0] + q[1] * q[1] - 1.0]
    def motion(self, t, q, u):
        N, O = jk.inertial()
        P = O.moving(q[0] * N.x + q[1] * N.y, -q[1] * u[0] * N.x + q[0] * u[0] * N.y)
        return jk.Motion([jk.Body(self.mass, 0.0, P)])
    def loads(self, t, q, u, motion, inputs):
        return [jk.Force(inputs["push"] * motion.N.x, motion.bodies[0])]
    def events(self, t, q, u):
        return {b: q[0] - 2.0 for b in {"left", "right"}}

k, start = float(sys.argv[2]), jk.State(np.array([0.0, 1.0]), np.ones(1))
push = {"push": lambda t, s: k * s["x"]}
jk.sweep.sweep(Bead(), start, [0.0, 1.0], push, table={"x": [0.1, 0.2]}, folder=sys.argv[1], step=0.1)
"""


@pytest.mark.weekly
def test_a_folder_is_known_again_in_another_process_and_refused_for_another_program(tmp_path):
    def process(seed, k):
        script = [sys.executable, "-c", SCRIPT, tmp_path / "sweep", str(k)]
        env = {**os.environ, "PYTHONHASHSEED": seed}
        return subprocess.run(script, env=env, capture_output=True, text=True, timeout=300, check=False)

    assert process("1", 1.0).returncode == 0
    before = contents(tmp_path / "sweep")
    assert process("2", 1.0).returncode == 0
    assert contents(tmp_path / "sweep") == before
    assert "belongs to another sweep" in process("1", 2.0).stderr


@pytest.mark.parametrize("name", ["sweep.json.4711.tmp", "chunk-00000000.npz.4711-ab.tmp"])
def test_temporary_files_of_a_killed_writer_are_removed(name, tmp_path, rides):
    (tmp_path / name).write_bytes(b"{")
    np.testing.assert_array_equal(run(tmp_path).q, rides.q)
    assert not list(tmp_path.glob("*.tmp"))


@pytest.mark.parametrize(
    ("bytes_", "message"),
    [
        *(
            (text, r"sweep\.json is damaged, or not the manifest of a sweep: .*Choose another folder, or delete")
            for text in (b"", bytes(100), b"\xff\xfe\x00", b'{"system": {"cl', b"[1, 2]", b'{"name": "vacuum"}')
        ),
        (b'{"system": {}, "times": "", "layout": {}}', r"differs in .*program \(nothing there"),
    ],
)
def test_unreadable_manifests_are_rejected(bytes_, message, copy):
    (copy / "sweep.json").write_bytes(bytes_)
    before = contents(copy)
    with pytest.raises(ValueError, match=message):
        run(copy)
    assert contents(copy) == before


def damaged(data, how):
    if how == "swapped bytes":
        middle = len(data) // 2
        return data[:middle] + bytes(x ^ 255 for x in data[middle : middle + 64]) + data[middle + 64 :]
    return {"empty": b"", "zeros": bytes(len(data)), "cut": data[:-30], "text": b"thesis"}[how]


@pytest.mark.slow
def test_the_order_of_columns_does_not_change_the_digest(tmp_path):
    columns = {"mass": [1.0, 2.0], "x": [0.1, 0.2]}
    first = run(tmp_path / "sweep", table=columns)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = run(tmp_path / "sweep", table=dict(reversed(columns.items())))
    np.testing.assert_array_equal(again.q, first.q)


def test_damaged_chunks_are_recomputed_with_one_warning(copy, finished, rides):
    files = sorted(copy.glob("chunk-*.npz"))
    for hows in (("empty", "zeros", "cut"), ("text", "swapped bytes", "foreign")):
        for path, how in zip(files, hows, strict=True):
            if how == "foreign":
                np.savez(path, a=[1.0])
            else:
                path.write_bytes(damaged(path.read_bytes(), how))
        with pytest.warns(UserWarning, match="3 chunks cannot be read and are computed again: chunk-00000000") as seen:
            np.testing.assert_array_equal(run(copy).q, rides.q)
        assert len(seen) == 1
        assert contents(copy) == contents(finished)


def test_swapped_chunks_are_recomputed(copy, finished, rides):
    first, second, last = sorted(copy.glob("chunk-*.npz"))
    whole = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(whole)
    last.write_bytes(whole)  # 32 members where 6 belong
    with pytest.warns(UserWarning, match=r"3 chunks cannot be read .*the file was renamed"):
        np.testing.assert_array_equal(run(copy).q, rides.q)
    assert contents(copy) == contents(finished)


def test_a_file_instead_of_a_folder_is_rejected(tmp_path):
    (tmp_path / "file").write_text("")
    for folder in ("file", "file/sweep"):
        with pytest.raises(OSError, match=r"sweep.json could not be written: .* A part of the path is a file"):
            run(tmp_path / folder)
    (tmp_path / "other" / "sweep.json").mkdir(parents=True)
    with pytest.raises(ValueError, match=r"sweep.json is damaged, or not the manifest of a sweep"):
        run(tmp_path / "other")


@pytest.mark.slow
def test_only_one_of_two_sweeps_starting_simultaneously_is_accepted(tmp_path):
    start, found = threading.Barrier(4), []

    def begin(last):
        start.wait()
        try:
            found.append(run(tmp_path, table={"mass": np.linspace(1.0, last, 70)})["mass"][-1])
        except ValueError as error:
            found.append(str(error))

    threads = [threading.Thread(target=begin, args=(last,)) for last in (2.0, 2.0, 3.0, 3.0)]
    [t.start() for t in threads]
    [t.join() for t in threads]
    refused = [text for text in found if isinstance(text, str)]
    assert len(refused) == 2
    assert all("belongs to another sweep" in text for text in refused)
    assert len({value for value in found if not isinstance(value, str)}) == 1


def test_two_simultaneous_runs_of_one_sweep_write_identical_files(tmp_path, finished, rides):
    found = []
    threads = [threading.Thread(target=lambda: found.append(run(tmp_path).q)) for _ in range(2)]
    [t.start() for t in threads]
    [t.join() for t in threads]
    assert len(found) == 2
    for q in found:
        np.testing.assert_array_equal(q, rides.q)
    assert contents(tmp_path) == contents(finished)


def test_a_chunk_is_written_after_another_run_removed_temporary_files(copy, monkeypatch, rides):
    put, before, calls = os.replace, contents(copy), []

    def tidied(scratch, path):
        calls.append(path)
        if len(calls) == 1:
            run(copy)  # which finishes the sweep, and tidies the folder
        put(scratch, path)

    (copy / "chunk-00000032.npz").unlink()
    monkeypatch.setattr(os, "replace", tidied)
    np.testing.assert_array_equal(run(copy).q, rides.q)
    assert len(calls) == 2
    assert contents(copy) == before


@pytest.fixture
def fails(monkeypatch):
    """A failure after the second chunk."""
    fail_after_two_chunks(monkeypatch, RuntimeError("out of memory"))


def test_finished_members_are_returned_after_an_exception(fails, rides):
    said = r"64 of 70 members are finished and returned; .* because of RuntimeError: out of memory. Pass `folder`"
    with pytest.warns(RuntimeWarning, match=said):
        part = run()
    assert part.counts == {"completed": 64, "interrupted": 6}
    np.testing.assert_array_equal(part.q[:64], rides.q[:64])
    assert np.isnan(part.q[64:]).all()


def test_an_exception_with_a_folder_states_how_to_resume(fails, rides, tmp_path, monkeypatch):
    with pytest.raises(RuntimeError, match="out of memory") as seen:
        run(tmp_path)
    monkeypatch.undo()
    assert f"64 of 70 members are finished and saved in {tmp_path}. Call sweep again" in seen.value.__notes__[0]
    np.testing.assert_array_equal(run(tmp_path).q, rides.q)


def test_the_error_for_a_full_disk_states_the_chunk_and_the_remedy(rides, tmp_path, monkeypatch):
    fsync, calls = os.fsync, []

    def full(handle):
        calls.append(1)
        if len(calls) == 5:  # manifest and its folder, a chunk and its folder
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(handle)

    monkeypatch.setattr(os, "fsync", full)
    said = r"chunk-00000032.npz could not be written: No space left on device. Free space .* call sweep again"
    with pytest.raises(OSError, match=said) as seen:
        run(tmp_path)
    assert seen.value.errno == errno.ENOSPC
    assert [*contents(tmp_path)] == ["chunk-00000000.npz", "sweep.json"]
    np.testing.assert_array_equal(run(tmp_path).q, rides.q)


def test_a_full_disk_is_reported_when_zipfile_raises_another_error(tmp_path, monkeypatch):
    """`zipfile` raises a ValueError of its own when it closes a file that the disk cut short."""

    def savez(file, **arrays):
        try:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        finally:
            raise ValueError("Can't close the ZIP file while there is an open writing handle on it.")

    monkeypatch.setattr(np, "savez", savez)
    with pytest.raises(OSError, match=r"chunk-00000000.npz could not be written: No space left on device"):
        run(tmp_path)


def test_a_missing_manifest_is_rewritten_only_for_chunks_of_the_same_sweep(copy, finished, rides, tmp_path_factory):
    (copy / "sweep.json").unlink()
    (copy / "chunk-00000032.npz").write_bytes(b"damaged")
    with pytest.warns(UserWarning, match="1 chunks cannot be read"):
        np.testing.assert_array_equal(run(copy).q, rides.q)
    assert contents(copy) == contents(finished)
    (copy / "sweep.json").unlink()
    with pytest.raises(ValueError, match=r"has no sweep.json, and its 3 files are not the chunks of this sweep"):
        run(copy, table={"mass": np.linspace(1.0, 3.0, 70)})
    only_damaged = tmp_path_factory.mktemp("damaged")
    (only_damaged / "chunk-00000000.npz").write_bytes(b"damaged")
    with pytest.raises(ValueError, match=r"has no sweep.json, and its 1 files"):
        run(only_damaged)


@pytest.mark.slow
def test_batches_of_none_and_of_one():
    for table, shape in (({"mass": []}, (0,)), (jk.sweep.grid(mass=[], x=[0.1, 0.2]), (0, 2))):
        none = run(table=table)
        assert none["x"].shape == (*shape, 3)
        assert none.status.shape == none["mass"].shape == shape
        assert none.reason == []
        assert run(table=table, reduce=lambda ride: {"end": ride["x"][-1]})["end"].shape == shape
    none = jk.sweep.sweep(Drop(mass=np.zeros(0)), REST, TS, step=0.1)
    assert none.q.shape == (0, 3, 1)
    one = run(table={"mass": [1.5]})
    np.testing.assert_allclose(one["x"], [0.5 * GRAVITY * TS**2], rtol=1e-7)


def test_duplicate_values_and_invalid_options_are_rejected():
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame([[1.0, 2.0]], columns=["mass", "mass"])
    with pytest.raises(ValueError, match="more than one column named mass"):
        run(table=frame)
    with pytest.raises(ValueError, match="more than one column named 1"):
        run(table={"1": [1.0], 1: [2.0]})
    for table in ({"mass": [1.0, 2.0]}, jk.sweep.grid(mass=[1.0, 2.0])):
        with pytest.raises(ValueError, match=r"passed twice: mass \(a column of the table, and in a batch of Drop\)"):
            jk.sweep.sweep(dataclasses.replace(Drop(), mass=np.ones(2)), REST, TS, table=table)
        with pytest.raises(ValueError, match=r"passed twice: push \(a column of the table, and in `inputs`\)"):
            jk.sweep.sweep(Drop(), REST, TS, {"push": 1.0}, table={**dict(mass=[1.0, 2.0]), "push": [0.0, 1.0]})
    table = {"mass": [1.0, 2.0]}
    for arguments, options, error, words in (
        ((Drop(), REST), {"foo": 1}, ValueError, "sweep has no option foo; there are rtol"),
        ((Drop(), REST), {"devices": [1]}, TypeError, "`devices` must contain at least one of jax"),
        ((Drop(), lambda system, row: {"height": 1.0}), {}, TypeError, "must return a jaxkane.State.*got dict"),
        ((lambda row: row["mass"], REST), {}, TypeError, "must return a System for each row"),
    ):
        with pytest.raises(error, match=words):
            jk.sweep.sweep(*arguments, TS, table=table, **options)
    with pytest.raises(TypeError, match="The column 'mass' of a table is traced"):
        jax.jit(lambda mass: jk.sweep.sweep(Drop(), REST, TS, table={"mass": mass}).q)(np.ones(2))
    for push in (np.arange(5.0), np.ma.array([[1.0], [2.0]], mask=[[True], [False]])):
        with pytest.raises(ValueError, match="The input 'push'"):
            jk.sweep.sweep(Drop(), REST, TS, {"push": push}, table=table)
    with pytest.raises(ValueError, match="`chunk` must be a positive number of members; got 0"):
        run(chunk=0)


@pytest.mark.parametrize(
    ("reduce", "message"),
    [
        ("x", r"`reduce` must be a function of a Trajectory, .*; got 'x'"),
        (lambda ride: "far", "`reduce` must return numbers and arrays, .*; got 'far'"),
        (lambda ride: {"end": np.array("far")}, "`reduce` must return numbers and arrays"),
        (lambda ride: None, r"got None. Does it end without a `return`\?"),
        (lambda ride: 1.0 if ride["x"][-1] > 0.0 else 0.0, "sweep: `reduce` uses a traced value"),
        (lambda ride: np.sin(ride["x"]), "sweep: `reduce` uses a traced value"),
    ],
)
def test_invalid_reductions_are_rejected(reduce, message, tmp_path):
    for folder in (None, tmp_path):
        with pytest.raises(TypeError, match=message):
            run(folder, reduce=reduce)


def test_the_error_for_a_traced_value_states_the_function_of_the_row():
    def start(system, row):
        return REST if row["speed"] > 0.0 else jk.State(np.ones(1), np.ones(1))

    with pytest.raises(TypeError, match="sweep: the function start uses a traced value"):
        jk.sweep.sweep(Drop(), start, TS, table={"speed": [1.0, 2.0]}, step=0.1)
