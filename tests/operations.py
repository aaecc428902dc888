"""Functions that between them use every operation that a program of scalars may have."""

import jax
import jax.numpy as jnp


def on_x(*names):
    return [(name, getattr(jnp, name)) for name in names]


OPERATIONS = dict(
    on_x("sin", "cos", "tan", "arctan", "sinh", "cosh", "tanh", "arcsinh", "exp", "exp2", "expm1", "cbrt", "sign")
    + on_x("abs", "floor", "square", "negative", "isfinite")
) | {
    "arcsin": lambda x: jnp.arcsin(x / 4),
    "arccos": lambda x: jnp.arccos(x / 4),
    "arctanh": lambda x: jnp.arctanh(x / 4),
    "arccosh": lambda x: jnp.arccosh(4 + x),
    "log": lambda x: jnp.log(4 + x),
    "log1p": lambda x: jnp.log1p(4 + x),
    "sqrt": lambda x: jnp.sqrt(4 + x),
    "rsqrt": lambda x: jax.lax.rsqrt(4 + x),
    "erf": jax.scipy.special.erf,
    "logistic": jax.nn.sigmoid,
    "pow": lambda x: (4 + x) ** 1.7,
    "atan2": lambda x: jnp.arctan2(x, x[::-1]),
    "rem": lambda x: jax.lax.rem(x, jnp.asarray(0.7, x.dtype)),
    "mod": lambda x: [jnp.mod(x, 0.7), jnp.mod(x, -0.7), x // 0.7],
    "whole numbers": lambda x: [jnp.ceil(x), jnp.trunc(3 * x), jnp.round(3 * x), jax.lax.round(3 * x), jnp.round(x, 1)],
    "halves": lambda x: [f(jnp.round(5 * x) + 0.5) for f in (jnp.round, jax.lax.round)],
    "largest": lambda x: [jnp.max(x), jnp.min(x), jnp.prod(x), jnp.max(jnp.outer(x, x), axis=1)],
    "any and all": lambda x: [jnp.any(x > 0.5), jnp.all(x > -0.5), (x > 0.0) == (x < 0.5), (x > 0.0) != (x < 0.5)],
    "integer powers": lambda x: [jax.lax.integer_pow(x, n) for n in (-3, -1, 0, 2, 7)],
    "max and min": lambda x: [jnp.maximum(x, x[::-1]), jnp.minimum(x, 0.1), jnp.clip(x, -0.5, 0.5)],
    "comparisons": lambda x: [x < x[::-1], x <= 0.0, x > 0.0, x >= x, x == x[::-1], x != x],
    "logic": lambda x: [(x > 0.0) & (x < 1.0), (x > 0.0) | (x < -1.0), ~(x > 0.0), (x > 0.0) ^ (x < 1.0)],
    "where": lambda x: jnp.where(x > 0.0, x, 2 * x),
    "bool to float": lambda x: (x > 0.0).astype(x.dtype) * x,
    "other precision": lambda x: x.astype(jnp.float32) * jnp.float32(3),
    "sums": lambda x: [x.sum(), x[None, :].sum(0), x.reshape(3, 1).sum(1)],
    "moving": lambda x: [jnp.concatenate([x[1:], x[:1]]), jnp.outer(x, x).T[::-1, ::2], jnp.pad(x, (1, 2))],
    "holes": lambda x: jax.lax.pad(x, 0 * x[0], [(-1, 3, 1)]),
    "constants": lambda x: [jnp.zeros_like(x) + 0 * x, 1 * x, x - 0, 0 - x, x / 1, -1 * x, jnp.array([1.0, jnp.inf])],
}  # fmt: skip


# What is folded and what is not shows where a number is not finite, or a zero has a sign.
ODD = {
    "x + 0": lambda x: x + 0.0,
    "-0 + x": lambda x: -0.0 + x,
    "x - 0": lambda x: x - 0.0,
    "0 - x": lambda x: 0.0 - x,
    "-0 - x": lambda x: -0.0 - x,
    "0 x": lambda x: 0.0 * x,
    "-0 x": lambda x: -0.0 * x,
    "x (-1)": lambda x: x * -1.0,
    "x / -1": lambda x: x / -1.0,
    "0 / x": lambda x: 0.0 / x,
    "x - x": lambda x: x - x,
    "x / x": lambda x: x / x,
    "powers": lambda x: jnp.stack([jax.lax.integer_pow(x, n) for n in (-2, -1, 0, 1, 2)]),
    "both zeros": lambda x: jnp.stack([jnp.arctan2(0.0 * x, -1.0), jnp.arctan2(-0.0 * x, -1.0)]),
    "arctan2": lambda x: jnp.arctan2(0.0 - x, -1.0),
    "max and min": lambda x: jnp.stack([jnp.maximum(x, 0.0), jnp.maximum(-0.0, x), jnp.minimum(x, -0.0)]),
    "sign": jnp.sign,
    "abs": jnp.abs,
    "comparisons": lambda x: jnp.stack([x < 0.0, x >= -0.0, x == x, x != x, jnp.isfinite(x)]),
    "where": lambda x: jnp.where(x > 0.0, 0.0 * x, -x),
    "sums": lambda x: jnp.stack([x, 0.0 * x]).sum(),
    "tangent": lambda x: jax.jvp(lambda y: jnp.sqrt(y) * 0.0 + y * jnp.sin(y), (x,), (0.0 * x,))[1],
    "gradient": lambda x: jax.grad(lambda y: jnp.where(y > 0.0, jnp.log(y), 0.0 - y))(x),
    "nan": lambda x: x + jnp.nan,
    "inf": lambda x: 0.0 * (x + jnp.inf),
}
