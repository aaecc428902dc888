"""Compiled programs are freed with the functions that they were traced with, and beyond a number of memory mappings."""

import dataclasses
import functools
import gc
import os
import pickle
import threading
import warnings
import weakref

import jax
import numpy as np
import pytest

import jaxkane as jk
from jaxkane._integrate.integrate import solve
from jaxkane._scalarjit import cache
from jaxkane._scalarjit.cache import LIMIT, Cache, memory_mappings

TS = np.linspace(0.0, 0.2, 3)
START = jk.State(np.array([0.5]), np.zeros(1))
CELL = """
import jaxkane as jk
class Spring(jk.System):
    mass: jk.Scalar = jk.parameter(1.0)
    coordinates, speeds, inputs = ("x",), ("v",), ("push",)
    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(self.mass, 0.0, O.moving(q[0] * N.x, u[0] * N.x))])
    def loads(self, t, q, u, motion, inputs):
        return [jk.Force((inputs["push"] - STIFFNESS * q[0]) * motion.N.x, motion.bodies[0])]
"""

on_linux = pytest.mark.skipif(not os.path.exists("/proc/self/maps"), reason="only Linux limits memory mappings")


def class_of_cell(stiffness=4.0):
    """A class as a notebook cell defines it."""
    namespace = {"__name__": "__main__"}
    exec(CELL.replace("STIFFNESS", str(stiffness)), namespace)
    return namespace["Spring"]


def last(system, inputs=None, **options):
    return jk.simulate(system, START, TS, inputs, **options)["x"][-1]


def expected(stiffness, push=0.0):
    w = np.sqrt(stiffness)
    return push / stiffness + (0.5 - push / stiffness) * np.cos(w * TS[-1])


@pytest.fixture(scope="module")
def system():
    return class_of_cell()()


@pytest.fixture
def limit(monkeypatch):
    """`limit(n)`: programs are dropped when this process has n mappings more than now."""

    def set_to(more):
        gc.collect()
        monkeypatch.setattr(LIMIT, "mappings", memory_mappings()[0] + more)
        return LIMIT.mappings

    monkeypatch.setattr(LIMIT, "dropped", set())
    return set_to


CELLS = {
    "simulate": lambda kind: last(kind()),
    "differentiate": lambda kind: jax.grad(lambda mass: last(kind(mass)))(1.0),
    "fit": lambda kind: jk.fit.fit(kind(), jk.fit.Trial(TS, {"x": 0.5 * np.cos(TS)}, sigma=1.0), ["mass"]),
    "sweep": lambda kind: jk.sweep.sweep(kind(), START, TS, table={"mass": [1.0, 2.0]}),
}


@pytest.mark.weekly
@on_linux
@pytest.mark.parametrize(
    ("cell", "times", "each"), [("simulate", 40, 100), ("differentiate", 6, 500), ("fit", 8, 250), ("sweep", 8, 200)]
)
def test_rerunning_a_notebook_cell_frees_the_programs_of_the_old_class(cell, times, each, limit):
    """`each`: the mappings of one run. The process was ended after some 150 to 700 runs."""
    jk.forget()  # programs of other tests that are dropped and requested again would raise the bound
    CELLS[cell](class_of_cell())
    bound = limit(2 * each)
    for _ in range(times):
        CELLS[cell](class_of_cell())
    assert LIMIT.mappings == bound  # no program was requested again
    assert memory_mappings()[0] < bound + each


class Controller:
    """With an attribute that has no weak references."""

    def __init__(self, push):
        self.rng, self.push = np.random.default_rng(1), push

    def method(self, t, state):
        return self.push + 0.0 * self.rng.random()

    def __call__(self, t, state):
        return {"push": self.push}


@dataclasses.dataclass
class Constant:
    """Without a hash."""

    push: float

    def __call__(self, t, state):
        return {"push": self.push}


@dataclasses.dataclass(slots=True)
class ConstantWithSlots:
    """Without weak references."""

    push: float
    __call__ = Constant.__call__


class EqualToAll(Constant):
    __eq__ = lambda self, other: True  # noqa: E731
    __hash__ = lambda self: 1  # noqa: E731


KINDS = {
    "closure": lambda push: {"push": lambda t, state: push},
    "default": lambda push: {"push": lambda t, state, push=push: push},
    "partial": lambda push: {"push": functools.partial(lambda push, t, state: push, push)},
    "method": lambda push: {"push": Controller(push).method},
    **{kind.__name__: kind for kind in (Controller, Constant, ConstantWithSlots, EqualToAll)},
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_input_functions_with_the_same_code_have_separate_programs(kind, system):
    for push in (1.0, 2.0):
        assert last(system, KINDS[kind](push), step=0.1) == pytest.approx(expected(4.0, push), rel=1e-5)


@pytest.mark.weekly
@pytest.mark.parametrize("kind", ["closure", "method"])
def test_programs_are_freed_with_the_functions_that_they_were_traced_with(kind, system):
    def simulated(push):
        f = KINDS[kind](push)["push"]
        last(system, {"push": f}, step=0.1)
        return weakref.ref(getattr(f, "__self__", f))

    gone = [simulated(1.0)]
    before, mapped = len(solve.programs), memory_mappings()[0]
    gone += [simulated(push) for push in (2.0, 3.0)]
    gc.collect()
    assert [ref() for ref in gone] == [None] * 3
    assert len(solve.programs) <= before
    assert memory_mappings()[0] < mapped + 30  # a program has some 80


@pytest.mark.slow
def test_reduce_functions_are_freed_with_their_programs(system):
    def swept(factor):
        reduce = lambda trajectory: factor * trajectory["x"][-1]  # noqa: E731
        table = {"mass": np.array([1.0, 2.0])}
        jk.sweep.sweep(system, START, TS, table=table, reduce=reduce, step=0.1)
        return weakref.ref(reduce)

    gone = swept(2.0)
    gc.collect()
    assert gone() is None


@pytest.mark.slow
def test_classes_of_the_same_name_have_separate_programs():
    systems = [class_of_cell(k)() for k in (4.0, 9.0)]
    assert [last(s) for s in systems] == pytest.approx([expected(4.0), expected(9.0)], rel=1e-5)


@pytest.mark.slow
def test_a_class_that_was_copied_by_cloudpickle_is_simulated():
    """`motion_number` was copied with it, and counted for itself."""
    cloudpickle = pytest.importorskip("cloudpickle")
    kind = class_of_cell()
    [last(kind(), step=0.1) for _ in range(2)]
    copy = pickle.loads(cloudpickle.dumps(kind))
    assert last(copy(), step=0.1) == pytest.approx(expected(4.0), rel=1e-5)


def process_with(monkeypatch, each, others=0):
    """A cache each of whose results is `each` memory mappings, in a process whose other code has `others`."""
    programs, limit = Cache(programs=True), cache._Limit()
    monkeypatch.setattr(cache, "memory_mappings", lambda: (others + each * len(programs), 65530))
    monkeypatch.setattr(Cache, "all", lambda: [programs])
    monkeypatch.setattr(cache, "LIMIT", limit)
    return programs, limit


def test_the_limit_increases_if_dropped_programs_are_used_again(monkeypatch):
    (programs, limit), made = process_with(monkeypatch, each=100), []
    for _ in range(5):
        made.append(0)
        for i in range(60):
            programs.get(i, lambda: made.__setitem__(-1, made[-1] + 1))
    assert (made[0], made[2:]) == (60, [0, 0, 0])
    assert limit.mappings == 8000


def test_a_warning_is_issued_before_the_limit_of_memory_mappings(monkeypatch):
    programs, _ = process_with(monkeypatch, each=10, others=50_000)
    with pytest.warns(UserWarning, match=r"50\d\d\d memory mappings, .* at 65530.*jaxkane.forget"):
        programs.keep(0, 0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        programs.keep(1, 1)


def test_caches_are_thread_safe_while_owners_are_deleted():
    class Owner:
        pass

    results, failed = Cache(50), []

    def use(start):
        try:
            for i in range(500):
                owner = Owner()
                results.keep(start + i % 60, i, [owner])
                results.known(start, None)
                len(results)
        except (RuntimeError, KeyError) as error:
            failed.append(error)

    threads = [threading.Thread(target=use, args=(1000 * n,)) for n in range(8)]
    [t.start() for t in threads]
    [t.join() for t in threads]
    assert not failed
    assert len(results) == 0
