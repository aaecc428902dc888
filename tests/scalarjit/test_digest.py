"""Digests of programs: equal for equal programs, also in another process, and different for all others."""

import jax
import numpy as np
import pytest

from jaxkane._scalarjit.digest import CapturedValues, digest


def callback_of(k):
    called = lambda x: x * k if k in {"one", "two", 1.0, 2.0} else x  # noqa: E731
    return lambda x: jax.pure_callback(called, jax.ShapeDtypeStruct((), float), x)


def root_of(k):
    return lambda x: jax.lax.custom_root(lambda y: y - k * x, x, lambda f, x: x * k, lambda f, y: y)


@pytest.mark.parametrize("made", [callback_of, root_of])
def test_digests_depend_on_programs_nested_in_an_operation(made):
    code = lambda f: CapturedValues(f, lasting=True).version  # noqa: E731
    program = lambda k: digest(jax.make_jaxpr(made(k))(1.0), code)  # noqa: E731
    assert program(1.0) == program(1.0) != program(2.0)


def test_digests_of_programs():
    a = jax.make_jaxpr(lambda x, y: x * y + 1.0)(1.0, 2.0)
    same = jax.make_jaxpr(lambda other, name: other * name + 1.0)(3.0, 4.0)
    others = [lambda x, y: x * y + 2.0, lambda x, y: y * x + 1.0, lambda x, y: x + y + 1.0, lambda x, y: (x * y, 1.0)]
    programs = [a, *(jax.make_jaxpr(f)(1.0, 2.0) for f in others), jax.make_jaxpr(lambda x, y: x * y + 1.0)(1.0, 2)]
    assert digest(a) == digest(same)
    assert len({digest(p) for p in programs}) == len(programs)
    inner = jax.jit(lambda x: x * np.arange(3.0))
    constants = [jax.make_jaxpr(lambda x, k=k: inner(x) + np.full(3, k))(1.0) for k in (1.0, 2.0)]
    assert digest(constants[0]) != digest(constants[1])
