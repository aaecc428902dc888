"""The benchmarks without other programs: the chain, the names of missing packages, and the table of figures."""

import importlib.util
import os
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from benchmarks import _peers, assemblies, chain
from benchmarks._figures import Figure, digits, line
from benchmarks._picture import draw, times_faster
from benchmarks._process import child
from benchmarks._report import Results, markdown

ROOT = Path(__file__).parents[1]
CHAIN = chain.Chain(n=4)


@pytest.mark.parametrize("peer", ["mujoco", "pinocchio"])
def test_accelerations_of_the_chain_agree_with_other_engines(peer):
    rtol = 1e-9
    pytest.importorskip(peer)
    q, u = chain.states(CHAIN.n, 3)
    ours, theirs = (getattr(chain, f"accelerations_by_{who}")(CHAIN, q, u) for who in ("jaxkane", peer))
    np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=rtol * np.abs(ours).max())


def test_operation_counts_include_nested_programs():
    every = assemblies.assemblies()
    count = lambda name: assemblies.operations(every[name], assemblies.states(every[name], 1)[0])  # noqa: E731
    whipple, full = count(assemblies.WHIPPLE), count(assemblies.FULL)
    assert 1000 < whipple < full < 3 * whipple


def test_mjcf_and_sdf_files_contain_the_same_chain():
    bodies = list(ET.fromstring(chain.mjcf(CHAIN)).iter("body"))
    links = [link for link in ET.fromstring(chain.sdf(CHAIN)).iter("link") if link.get("name") != "ground"]
    assert (len(bodies), len(links)) == (CHAIN.n, CHAIN.n)
    for i, (body, link) in enumerate(zip(bodies, links)):
        inertial, joint, I = body.find("inertial"), body.find("joint"), link.find("inertial/inertia")
        moments = [float(x) for x in inertial.get("diaginertia").split()]
        assert moments == [float(I.find(name).text) for name in ("ixx", "iyy", "izz")]
        assert moments == [float(x) for x in CHAIN.inertia]
        assert joint.get("axis") == ("1 0 0", "0 1 0")[i % 2]
        assert body.get("pos") == ("0 0 -0.2" if i else "0 0 0.0")


def test_missing_packages_are_reported_by_name(monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "pinocchio" else found(name))
    assert "pip install pin" in _peers.missing()["Pinocchio"]
    monkeypatch.setenv("PATH", "")
    monkeypatch.setenv("CC", "no-such-compiler")
    assert {"Pinocchio", "SymPy + C", "PyDy's Cython"} <= set(_peers.missing())


@pytest.mark.weekly
def test_a_benchmark_runs_without_the_compared_packages(tmp_path):
    blocked = "import sys; sys.modules.update(dict.fromkeys(['mujoco', 'pinocchio', 'jaxsim', 'rod']))\n"
    (tmp_path / "sitecustomize.py").write_text(blocked)
    command = [sys.executable, "-m", "benchmarks", "chains", "--quick", "--out", str(tmp_path / "out")]
    run = subprocess.run(
        command, cwd=ROOT, env=os.environ | {"PYTHONPATH": str(tmp_path)}, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    assert "left out: MuJoCo (pip install mujoco)" in run.stdout
    table = (tmp_path / "out" / "results.md").read_text()
    assert "| 2 links, a state: jaxkane |" in table
    assert "not installed, and left out: Pinocchio" in table
    assert str(tmp_path) not in table


def test_figures_are_compared_with_their_limits():
    fast, slow = Figure("p", "a", 1.9, at_most=2.0), Figure("p", "a", 2.1, column="native", at_most=2.0)
    more, none = Figure("p", "b", 5.0, "rides/s", at_least=6.0), Figure("p", "c", 5.0, "ms")
    assert [f.met for f in (fast, slow, more, none)] == [True, False, False, None]
    assert times_faster(Figure("p", "a", 0.25, at_most=0.5)) == (4.0, 2.0)
    assert line(more).endswith("5 rides a second   at least 6: not met")
    assert [digits(x) for x in (0.0, 2e-5, 0.01234, 12.345, 12345.6, 1e7)] == [
        "0.00e+00", "2.00e-05", "0.0123", "12.3", "12346", "1.00e+07"
    ]  # fmt: skip


def test_the_table_has_parallel_columns_and_keeps_local_measurements(tmp_path):
    results = Results({"cores": "2"}, {"MJX": "pip install mujoco-mjx"})
    results.figures["rides"] = [
        Figure("rides", "faster than odeint", 3.0, column="XLA", at_least=2.5),
        Figure("rides", "faster than odeint", 7.0, column="native", at_least=8.0),
    ]
    results.words["eigenvalues"] = "nine a second\n"
    text = markdown(results)
    assert "| faster than odeint | 3 | at least 2.5: met | 7 | at least 8: **missed** |" in text
    assert "left out: MJX (pip install mujoco-mjx)" in text
    assert "```text\nnine a second\n```" in text
    results.write(tmp_path / "results.json")
    assert markdown(Results.read(tmp_path / "results.json", {"cores": "2"}, results.missing)) == text
    assert not Results.read(tmp_path / "results.json", {"cores": "4"}, {}).figures
    assert draw(results.figures["rides"], tmp_path / "speed.png")
    assert not draw([], tmp_path / "speed.png")


def test_a_failed_child_process_reports_the_reason():
    with pytest.raises(RuntimeError, match="No module named no_such_module"):
        list(child("no_such_module"))
