"""Two processes on the loopback fit as one does; and how windows are shared, in one."""

import json
import os
import socket
import subprocess
import sys
from typing import NamedTuple

import jax
import numpy as np
import pytest

from jaxkane.fit import _linearize as parallel
from jaxkane.fit._model import Unknowns

# Three pushed pendulums, windows of half a second: five a trial, so that the shares differ.
SCRIPT = """
import json, sys
import jax
import jaxkane as jk
import numpy as np
from scipy.integrate import solve_ivp

class Pendulum(jk.System):
    mass: jk.Scalar = jk.parameter(positive=True)
    length: jk.Scalar = jk.parameter(positive=True)
    coordinates, speeds, inputs = ("angle",), ("rate",), ("torque",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        rod = N.rotate(3, q[0], u[0])
        return jk.Motion([jk.Body(self.mass, 0.0, O.fixed(-self.length * rod.y), rod)])

    def loads(self, t, q, u, motion, inputs):
        return [*jk.weight(motion, -9.81 * motion.N.y), jk.Torque(inputs["torque"] * motion.N.z, motion.bodies[0])]

jk.configure(cache=sys.argv.pop(), verbose=False)
process, port = (int(x) for x in sys.argv[1:])
if port:
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(f"127.0.0.1:{port}", num_processes=2, process_id=process)
rng = np.random.default_rng(0)
t = np.linspace(0.0, 2.5, 41)
trials = []
for k in range(3):
    f = lambda t, y: [y[1], -9.81 / 1.1 * np.sin(y[0]) + 3 * np.sin(2 * t + k) / (2.0 * 1.1**2)]
    ride = solve_ivp(f, (0.0, 2.5), [0.1 + 0.2 * k, 0.0], t_eval=t, rtol=1e-10, atol=1e-10).y
    seen = {name: y + 0.01 * rng.normal(size=t.shape) for name, y in zip(("angle", "rate"), ride)}
    trials.append(jk.fit.Trial(t, seen, {"torque": 3 * np.sin(2 * t + k)}, sigma=0.01, name=f"pendulum {k}"))
windows = []
import jaxkane.fit._linearize as linearization
original = linearization.map_windows
linearization.map_windows = lambda f, args: (windows.append(jax.tree.leaves(args)[0].shape[0]), original(f, args))[1]

def fitted(given):
    return jk.fit.fit(
        Pendulum(mass=1.5, length=1.0), given, ("mass", "length"),
        unknown=("angle", "rate"), window=0.5, simulation=jk.fit.Simulation(step=0.0625), sensor_bias=("rate",),
        optimizer=jk.fit.LeastSquares(), processes=True)

found = fitted(trials)
values = {"estimates": found.estimates, "errors": found.standard_errors, "cost": found.cost,
          "z": np.asarray(found.point.z).tolist(), "b": np.asarray(found.point.b).tolist(),
          "windows": sorted(set(windows)), "status": found.status, "count": jax.process_count()}
if port:  # two processes with different trials
    try:
        fitted(trials[: 2 + process])
    except ValueError as error:
        values["error"] = str(error)
print(json.dumps(values))
"""


def free_port():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def run(script, port, processes):
    clean = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    started = [
        subprocess.Popen(
            [sys.executable, script, str(i), str(port), script.parent / "cache"],
            env=clean,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for i in range(processes)
    ]
    try:
        told = [process.communicate(timeout=300) for process in started]
    finally:
        for process in started:
            process.kill()
    assert [process.returncode for process in started] == [0] * processes, told
    return [json.loads(out.splitlines()[-1]) for out, _ in told]


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    path = tmp_path_factory.mktemp("script") / "fit.py"
    path.write_text(SCRIPT)
    return path


@pytest.mark.slow
def test_two_processes_fit_as_one_and_refuse_different_trials(script):
    rtol = 1e-10
    (alone,) = run(script, 0, 1)
    both = run(script, free_port(), 2)
    assert alone["status"] == "converged"
    assert abs(alone["estimates"]["mass"] - 2.0) < 4 * alone["errors"]["mass"]
    assert (alone["count"], alone["windows"]) == (1, [16])  # fifteen, and the next
    for one in both:
        assert "the processes pose different problems" in one.pop("error")
        assert (one["count"], one["windows"]) == (2, [9])  # eight, and the next
        for name in ("cost", "z", "b"):
            np.testing.assert_allclose(one[name], alone[name], rtol=rtol, atol=1e-12)
        for name in ("mass", "length"):
            np.testing.assert_allclose(one["estimates"][name], alone["estimates"][name], rtol=rtol)
            np.testing.assert_allclose(one["errors"][name], alone["errors"][name], rtol=1e-8)
    assert both[0] == both[1]


class Given(NamedTuple):
    trial: np.ndarray
    measured: np.ndarray


@pytest.mark.parametrize("processes", [1, 2, 3, 7])
def test_shares_put_together_are_the_whole(monkeypatch, processes):
    """What each of several processes finds about its share, in the order of the processes, without starting any."""
    windows = Given(np.arange(5), 10.0 * np.arange(5))
    point = Unknowns(np.array([2.0]), np.zeros((1, 0)), np.arange(5.0)[:, None])
    seen, said = [], []

    def evaluate(windows, point, starts):
        seen.append(len(windows.trial))
        return {"sum": windows.measured + point.x * point.z[:, 0] + starts, "trial": windows.trial}

    monkeypatch.setattr(jax, "process_count", lambda: processes)
    monkeypatch.setattr(parallel, "process_allgather", lambda found, tiled: said.append(found) or found)
    for i in range(processes):
        monkeypatch.setattr(jax, "process_index", lambda i=i: i)
        parallel._by_all_processes(evaluate, windows, point, 0.1 * np.arange(5))
    together = {name: np.concatenate([found[name] for found in said])[:5] for name in said[0]}
    np.testing.assert_array_equal(together["trial"], np.arange(5))
    np.testing.assert_allclose(together["sum"], 12.1 * np.arange(5), rtol=1e-15)
    assert set(seen) == {-(-5 // processes) + 1}  # one more than its share, to be compared with


def test_processes_with_different_problems_are_refused(monkeypatch):
    monkeypatch.setattr(parallel, "process_allgather", lambda own: np.stack([own, own]))
    parallel.check_same({"mass": np.ones(2)}, {"t": np.arange(3.0)})
    monkeypatch.setattr(parallel, "process_allgather", lambda own: np.stack([own, own + np.uint32(1)]))
    with pytest.raises(ValueError, match="the processes pose different problems"):
        parallel.check_same({"mass": np.ones(2)}, {"t": np.arange(3.0)})
