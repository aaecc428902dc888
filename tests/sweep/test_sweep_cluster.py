"""Workers of a cluster compute the requested results, or raise an error."""

import logging
import sys
import types

import cloudpickle
import diffrax
import numpy as np
import pytest

import jaxkane as jk

TS = np.linspace(0.0, 1.0, 3)
STEPS = {"step": 0.5, "solver": diffrax.Midpoint()}  # exact for what falls freely

WEIGHT = """
import jaxkane as jk

gravity = 9.81

class Drop(jk.System):
    mass: jk.Scalar = jk.parameter(1.0)
    coordinates, speeds = ("x",), ("v",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(self.mass, 0.0, O.moving(q[0] * N.x, u[0] * N.x))])

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, gravity * motion.N.x)
"""


@pytest.fixture
def module(monkeypatch):
    made = types.ModuleType("falling_weights")
    monkeypatch.setitem(sys.modules, made.__name__, made)
    exec(WEIGHT, vars(made))
    return made


@pytest.fixture(scope="module")
def client():
    distributed = pytest.importorskip("distributed")  # takes a second
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    options = {"processes": False, "n_workers": 1, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.LocalCluster(**options) as cluster, distributed.Client(cluster) as client:
        yield client


def fallen(module, client):
    start, table = jk.State(q=[0.0], u=[0.0]), {"mass": np.linspace(1.0, 2.0, 3)}
    return jk.sweep.sweep(module.Drop(), start, TS, table=table, client=client, **STEPS)["x"][:, -1]


@pytest.mark.weekly
def test_a_worker_with_a_different_global_value_is_rejected(module, client, monkeypatch):
    assert cloudpickle.loads(cloudpickle.dumps(module.Drop)) is module.Drop  # travels by its name
    np.testing.assert_allclose(fallen(module, client), 9.81 / 2, rtol=1e-7)
    submit = client.submit

    def by_another(*args, **kwargs):  # the worker reads the module only now
        module.gravity = 1.62
        return submit(*args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(client, "submit", by_another)
        with pytest.raises(RuntimeError, match=r"different program. .* changed after the import"):
            fallen(module, client)
    np.testing.assert_allclose(fallen(module, client), 1.62 / 2, rtol=1e-7)  # now both have it


@pytest.mark.slow
def test_a_sweep_is_known_again_wherever_its_description_was_first_traced(module, tmp_path):
    def ends():
        table = {"mass": np.linspace(1.0, 2.0, 3)}
        return jk.sweep.sweep(module.Drop(), jk.State([0.0], [0.0]), TS, table=table, folder=tmp_path, **STEPS).q

    jk.accelerations(module.Drop(), 0.0, [0.0], [0.0])
    first = ends()
    module.Drop.note = "a program that uses the class is traced again"
    np.testing.assert_array_equal(ends(), first)
