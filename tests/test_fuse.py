"""Scalar programs as one operation: the same numbers as plain JAX, in every transformation, and no aborted process."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxkane import _fuse
from jaxkane._fuse import fused, without_repetition


def plain(a, b, x):
    s, c = jnp.sin(x[0]), jnp.cos(x[0])
    y = s * a + c * x[1] / jnp.sqrt(b * b + 1.0)
    return jnp.stack([y * s, s * s + c, a + 0.0 * y]), y**3


program = fused(plain)
ARGUMENTS = (jnp.array(0.7), jnp.array(-1.2), jnp.array([0.3, 0.9]))


def total(f):
    return lambda *args: f(*args)[0].sum() + f(*args)[1]


TRANSFORMATIONS = {
    "itself": lambda f: f,
    "jit": jax.jit,
    "forward": lambda f: jax.jacfwd(f, argnums=(0, 1, 2)),
    "reverse": lambda f: jax.jacrev(f, argnums=(0, 1, 2)),
    "hessian": lambda f: jax.hessian(total(f), argnums=(0, 2)),
    "reverse of reverse": lambda f: jax.jacrev(jax.grad(total(f), argnums=2), argnums=(0, 2)),
    "linearize": lambda f: lambda *args: jax.linearize(f, *args)[1](*args),
    "batch": lambda f: lambda a, b, x: jax.vmap(f, in_axes=(0, None, 0))(jnp.stack([a, b]), b, jnp.stack([x, 2 * x])),
    "batch of gradients": lambda f: (
        lambda a, b, x: jax.vmap(jax.grad(total(f), argnums=(0, 2)), (None, 0, None))(a, jnp.stack([a, b]), x)
    ),
    "gradient of a batch": lambda f: jax.grad(
        lambda a, b, x: jax.vmap(total(f), in_axes=(None, None, 0))(a, b, jnp.stack([x, 2 * x, 3 * x])).sum(), (0, 1, 2)
    ),
    "checkpoint": lambda f: jax.grad(jax.checkpoint(total(f)), argnums=(0, 2)),
    "in a loop": lambda f: lambda a, b, x: jax.lax.scan(lambda c, _: (f(c, b, x)[1], c), a, length=5),
    "gradient of a loop": lambda f: jax.grad(
        lambda a, b, x: jax.lax.scan(lambda c, _: (f(c, b, x)[1], c), a, length=5)[0], (0, 1, 2)
    ),
}


@pytest.mark.parametrize("name", TRANSFORMATIONS)
@pytest.mark.parametrize("compiled", [False, True], ids=["eager", "jit"])
def test_the_same_as_plain_jax(name, compiled, kernels):
    transform = TRANSFORMATIONS[name]
    ours, theirs = transform(program), transform(plain)
    if compiled:
        ours = jax.jit(ours)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-14), ours(*ARGUMENTS), theirs(*ARGUMENTS)
    )


@pytest.mark.parametrize("name", ["jit", "reverse", "batch", "batch of gradients", "gradient of a loop"])
def test_a_long_program_in_pieces(name, by_xla, monkeypatch):
    monkeypatch.setattr(_fuse, "_WHOLE_UP_TO", 4)
    monkeypatch.setattr(_fuse, "_PIECE", 3)

    def chosen(a, b, x):
        left = x[0] < a  # what is not a float goes from piece to piece too
        y, z = plain(a, b, x)
        return jnp.where(left, y, 2.0 * y), z

    transform = TRANSFORMATIONS[name]
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-14),
        jax.jit(transform(fused(chosen)))(*ARGUMENTS),
        transform(chosen)(*ARGUMENTS),
    )


def test_repetition_goes():
    once = without_repetition(jax.make_jaxpr(lambda x: jnp.sin(x) + jnp.sin(x) * jnp.cos(x) + 0.0 * jnp.tan(x))(1.0))
    names = [e.primitive.name for e in once.jaxpr.eqns]
    assert names.count("sin") == 1


def test_it_is_traced_once():
    calls = []

    @fused
    def counted(x):
        calls.append(1)
        return jnp.sin(x)

    for _ in range(3):
        counted(jnp.array(1.0))
    jax.jit(lambda x: counted(x) + counted(2 * x))(jnp.array(1.0))
    assert len(calls) <= 2  # one for a strong type, one for what the tracer makes of it


# Each of these once ended the process: XLA checks, and aborts, where a parameter is never read.
CRASHES = """
import jax, jax.numpy as jnp
jax.config.update("jax_enable_x64", True)
from jaxkane._fuse import fused
program = fused(lambda a, b, t, x: (jnp.sin(x[0]) * a + t + jnp.cos(x[1]), 0.0 * b))
x = jnp.ones(3)
def loop(f, n=5):
    def body(c):
        i, x, big = c
        y = f(x)
        return i + 1, x.at[0].add(y), big.at[i].add(y)
    return jax.lax.while_loop(lambda c: c[0] < n, body, (0, x, jnp.zeros(1000)))[2].sum()
jax.jit(lambda a, b: loop(lambda x: program(a, b, 0.0, x)[0]))(1.0, 2.0)
jax.jit(lambda a: loop(lambda x: program(a, 3.0, 0.0, x)[0] + program(1.0, 2.0, 0.0, jnp.zeros(3))[0]))(1.0)
jax.jit(lambda: program(1.0, 2.0, 0.0, jnp.ones(3)))()
jax.jit(jax.vmap(lambda a: program(a, 2.0, 0.0, x)))(jnp.ones(5000))
jax.jit(jax.grad(lambda a: loop(lambda x: program(a, 2.0, 0.0, x)[0], 3) if False else program(a, 2.0, 0.0, x)[0]))(1.0)
jax.jit(jax.grad(lambda b: jax.vmap(lambda a: program(a, b, 0.0, x)[0] * b)(jnp.ones(5000)).sum()))(1.0)
jax.jit(lambda z: jax.lax.map(lambda a: program(a, 2.0, 0.0, x)[0], z))(jnp.ones(70))
print("alive")
"""


def test_the_process_stays_alive():
    run = subprocess.run([sys.executable, "-c", CRASHES], capture_output=True, text=True, timeout=300, check=False)
    assert run.stdout.strip() == "alive", run.stderr[-2000:]
