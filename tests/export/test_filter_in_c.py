"""Exported filters, compiled, give the numbers of `jaxkane.estimate`."""

import ctypes
import dataclasses
import shutil
import subprocess
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import Crank, OnACircle

import jaxkane as jk
from jaxkane.estimate import Filter, begin, predict, update

CC = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
CXX = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
pytestmark = pytest.mark.skipif(CC is None, reason="no C compiler")
STRICT = ("-std=c99", "-Wall", "-Wextra", "-pedantic", "-Werror", "-O2")
METHODS = pytest.mark.parametrize("method", ["extended", "unscented"])


class Servo(jk.System):
    """A pendulum that a lagging motor turns, with an accelerometer, and names that C has reserved."""

    length: jk.Scalar = jk.parameter(0.8)
    double: jk.Scalar = jk.parameter(0.1)  # damping
    lags: jk.Scalar = jk.parameter(jnp.array([0.05, 2.0]))
    coordinates, speeds, states, inputs = ("angle",), ("rate",), ("torque",), ("command", "int")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        B = N.rotate(3, q["angle"], u["rate"])
        return jk.Motion([jk.Body(1.0, (0.0, 0.0, 0.01), O.fixed(self.length * B.x, B), B, name="bob")])

    def loads(self, t, q, u, motion, inputs):
        bob = motion["bob"]
        torque = inputs["torque"] - self.double * jnp.maximum(u["rate"], -3.0) + inputs["int"]
        return jk.weight(motion, 9.81 * motion.N.x), jk.Torque(torque * motion.N.z, bob.frame)

    def state_rates(self, t, q, u, x, motion, now):
        return {"torque": (now["command"] - now["torque"]) / self.lags[0]}

    def outputs(self, t, q, u, motion, now):
        bob = motion["bob"]
        return {"felt": (now.acceleration(bob.center) - 9.81 * motion.N.x).dot(bob.frame.y)}


def of_servo(**options):
    options = {"noise": {"int": 0.1, "torque": 0.2}, "drift": {"double": 1e-3, "length": 0.0}, "lag": 1} | options
    filter = Filter(Servo(), {"rate": 0.01, "felt": 0.2}, substeps=3, **options)
    start = jk.State(jnp.array([0.8]), jnp.array([-0.3]), jnp.array([0.1]))
    return filter, begin(filter, start, {"angle": 0.1, "rate": 0.2, "double": 0.05, "length": 0.1}, t=0.7)


def of_circle(**options):
    """Constraints, a dependent speed that is measured, and no noise."""
    filter = Filter(OnACircle(), {"y_dot": 0.05}, **options)
    start = jk.assemble(OnACircle(), {"x": 0.6, "y": 0.7}, {"x_dot": 0.4})
    return filter, begin(filter, start, {"x": 0.1, "y": 0.05, "x_dot": 0.2})


def of_crank(**options):
    """A constraint of an angle, a length in units of 3.3 cm, and a parameter that is estimated."""
    options = {"noise": {"rate": 0.05}, "drift": {"radius": 0.0}, "lag": 1} | options
    filter = Filter(Crank(unit=0.033), {"x": 0.5}, **options)
    start = jk.assemble(filter.system, {"angle": 0.4, "x": 117.0}, {"rate": 0.5}, free=["x"])
    return filter, begin(filter, start, {"angle": 0.1, "rate": 0.3, "radius": 0.05})


def of_bicycle(**options):
    bicycle = jk.catalog.WhippleBicycle.benchmark()
    start = jk.assemble(bicycle, {"roll": 0.05, "steer": 0.1}, {"roll_rate": 0.5, "rear_wheel_rate": -4.6 / 0.3})
    sensors = {"roll_rate": 0.01, "yaw_rate": 0.01, "steer": 0.01}
    filter = Filter(bicycle, sensors, noise={"roll_rate": 0.01, "steer_torque": 0.01}, **options)
    return filter, begin(filter, start, {"roll": 0.1, "roll_rate": 0.1, "steer": 0.1, "steer_rate": 0.1})


class Compiled(NamedTuple):
    """A filter in C: steps from its start on."""

    library: ctypes.CDLL
    shape: tuple[int, ...]
    n_sensors: int
    real: type

    def step(self, dt, inputs, measured, age=0):
        real = np.dtype(self.real)
        given = [np.ascontiguousarray(x, real) for x in (inputs, measured)]
        found = [
            np.zeros(n, real) for n in (self.shape[0] * self.shape[1], int(np.prod(self.shape)), 3 * self.n_sensors)
        ]
        nis, pointer = self.real(), lambda x: x.ctypes.data_as(ctypes.POINTER(self.real))
        refused = self.library.step(self.real(dt), *map(pointer, given), age, *map(pointer, found), ctypes.byref(nis))
        mean, root, innovation = found
        return refused, mean, root.reshape(len(mean), -1), innovation.reshape(3, -1), nis.value


WRAPPER = """
#include "NAME.h"
#include <string.h>
static NAME_belief b;
void begin(void) { b = NAME_start; }
int step(REAL dt, const REAL *inputs, const REAL *measured, int age, REAL *mean, REAL *root, REAL *what, REAL *nis) {
    NAME_innovation i = {{0}, {0}, {0}, 0, 0};
    int refused;
    NAME_predict(&b, &NAME_default, dt, inputs);
    refused = NAME_update(&b, &NAME_default, measured, inputs, age, &i);
    memcpy(mean, b.mean, sizeof b.mean), memcpy(root, b.root, sizeof b.root), memcpy(what, &i, 3 * sizeof i.predicted);
    *nis = i.nis;
    return refused;
}
"""


def compiled(filter, belief, folder, real=ctypes.c_double):
    name = {ctypes.c_double: "double", ctypes.c_float: "float"}[real]
    jk.export.c_filter(filter, folder / "f.h", belief, dtype={"double": "float64", "float": "float32"}[name])
    (folder / "f.c").write_text(WRAPPER.replace("NAME", "f").replace("REAL", name))
    subprocess.run([CC, *STRICT, "-shared", "-fPIC", folder / "f.c", "-o", folder / "f.so", "-lm"], check=True)
    library = ctypes.CDLL(str(folder / "f.so"))
    library.begin()
    return Compiled(library, belief.root.shape, len(filter.sensors), real)


def assert_same_steps(filter, belief, in_c, rtol, n=5, dt=0.02):
    """Means as parts of a deviation or of their size, covariances as correlations are."""
    rng, lag, inputs = np.random.default_rng(0), filter.lag, filter.system.inputs
    for i in range(n):
        w, age = rng.normal(size=len(inputs)), i % (lag + 1)
        given = dict(zip(inputs, w, strict=True))
        belief = predict(filter, belief, dt, given)
        y = np.asarray(update(filter, belief, jnp.full(len(filter.sensors), jnp.nan), given, age=age)[1].predicted)
        y = y + np.asarray(filter.sigma) * rng.normal(size=len(y))
        y[rng.uniform(size=len(y)) < 0.3] = np.nan
        belief, innovation = update(filter, belief, jnp.asarray(y), given, age=age)
        refused, mean, root, (predicted, difference, deviation), nis = in_c.step(dt, w, y, age)
        assert refused == 0
        size = np.maximum(1.0, np.abs(belief.mean)).ravel()
        np.testing.assert_allclose(mean / size, np.ravel(belief.mean) / size, rtol=0, atol=rtol)
        S = np.reshape(belief.root, root.shape)
        P, s = S @ S.T, np.maximum(np.sqrt(np.sum(S**2, axis=1)), 1e-12)
        np.testing.assert_allclose(root @ root.T / np.outer(s, s), P / np.outer(s, s), rtol=0, atol=10 * rtol)
        np.testing.assert_allclose(predicted, innovation.predicted, rtol=rtol, atol=rtol)
        np.testing.assert_allclose(
            difference / deviation, innovation.difference / innovation.deviation, atol=100 * rtol
        )
        np.testing.assert_allclose(nis, innovation.nis, rtol=100 * rtol, atol=100 * rtol)


@pytest.mark.weekly
@pytest.mark.parametrize("of", [of_servo, of_circle, of_crank, of_bicycle])
@METHODS
def test_filter_steps_in_c_agree_with_the_library(of, method, tmp_path):
    """Inputs, states of the first order, outputs, constraints, parameters that drift, gaps and late measurements."""
    filter, belief = of(method=method)
    assert_same_steps(filter, belief, compiled(filter, belief, tmp_path), 1e-12)


@pytest.mark.weekly
def test_single_precision_smoothed_states_and_invalid_times_in_c(tmp_path):
    filter, belief = of_servo(lag=0)
    in_c = compiled(filter, belief, tmp_path, ctypes.c_float)
    assert_same_steps(filter, belief, in_c, 2e-5)
    nothing, inputs = [np.nan] * 2, np.zeros(2)
    _, mean, root, *_ = in_c.step(0.0, inputs, nothing)
    refused, same, same_root, *_ = in_c.step(0.0, inputs, np.ones(2), age=1)
    assert refused == 1
    np.testing.assert_array_equal(mean, same)
    np.testing.assert_array_equal(root, same_root)
    _, mean, *_ = in_c.step(-0.1, inputs, nothing)
    assert np.isnan(mean[:3]).all()


@pytest.mark.weekly
@METHODS
def test_the_exported_test_program_passes(method, tmp_path):
    files = jk.export.c_filter(*(lambda f, b: (f, tmp_path / "servo.h", b))(*of_servo(method=method)))
    target = tmp_path / "test"
    for compiler, options in ((CC, STRICT), *([(CXX, ("-x", "c++", "-Wall"))] if CXX else [])):
        subprocess.run([compiler, *options, files.test, "-lm", "-o", target], check=True)
        ran = subprocess.run([target], capture_output=True, text=True)
        assert ran.returncode == 0, ran.stdout
    text = files.header.read_text()
    text = text.replace(f"{float(of_servo()[0].sigma[0])!r}, ", "0.02, ", 1)  # another deviation of a sensor
    files.header.write_text(text)
    subprocess.run([CC, *STRICT, files.test, "-lm", "-o", target], check=True)
    assert subprocess.run([target], capture_output=True).returncode != 0
    assert "measured[0]: rate" in text
    assert "malloc" not in text


def test_two_filters_compile_into_one_program(tmp_path):
    """Names of their own, from names that C does not allow."""
    filter, belief = of_circle()
    names = [jk.export.c_filter(filter, tmp_path / name, belief).header for name in ("a.h", "b-é.h")]
    (tmp_path / "two.c").write_text(
        "".join(f'#include "{path.name}"\n' for path in names) + "int main(void) {return 0;}"
    )
    subprocess.run([CC, *STRICT, tmp_path / "two.c", "-lm", "-o", tmp_path / "two"], check=True)
    assert "b_e_belief b_e_start" in names[1].read_text()


def test_filters_that_cannot_be_exported_are_rejected(tmp_path):
    filter, belief = of_servo()
    with pytest.raises(TypeError, match=r"needs a jaxkane\.estimate\.Filter, got"):
        jk.export.c_filter(Servo(), tmp_path / "f.h", belief)
    with pytest.raises(ValueError, match=r"Pass the result of jaxkane\.estimate\.begin"):
        jk.export.c_filter(filter, tmp_path / "f.h", of_servo(lag=0)[1])
    for part in ("t", "mean", "root"):
        wrong = dataclasses.replace(belief, **{part: getattr(belief, part).at[..., 0].set(jnp.nan)})
        with pytest.raises(ValueError, match="not finite"):
            jk.export.c_filter(filter, tmp_path / "f.h", wrong)
    with pytest.raises(ValueError, match="the time step `dt`"):
        jk.export.c_filter(filter, tmp_path / "f.h", belief, dt=-0.01)
    with pytest.raises(TypeError, match="is traced"):
        jax.jit(lambda belief: jk.export.c_filter(filter, tmp_path / "f.h", belief))(belief)
    assert not [*tmp_path.iterdir()]
