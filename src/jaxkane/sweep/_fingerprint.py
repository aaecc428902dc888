"""What a sweep computes, as a digest that outlives a process."""

from __future__ import annotations

from importlib.metadata import version
from platform import python_version_tuple
from typing import Any

import equinox as eqx
import jax

from .._common.digest import digest
from .._scalars.reads import Reads
from ._solve import Job, Part


def traced(job: Job, own: Any) -> tuple[str, Part]:
    """The digest of the program for one member, `own` (shapes and types), and the shapes of what it gives."""
    numbers, rest = eqx.partition(job, eqx.is_array)  # numbers that are arguments are recorded by name elsewhere
    whole = lambda own, numbers: eqx.combine(numbers, rest).whole(own)  # noqa: E731
    program, like = jax.make_jaxpr(whole, return_shape=True)(own, numbers)
    return digest_of(program), like


def digest_of(program: Any) -> str:
    """The digest of a program of JAX; of functions that it calls back, with all that their code reads."""
    return digest(program, lambda f: Reads(f, lasting=True).version)


def versions() -> dict[str, str]:
    """Of what traces and runs a program, by name."""
    found = {name: version(name) for name in ("jaxkane", "jax", "jaxlib", "diffrax", "equinox")}
    return found | {"python": ".".join(python_version_tuple()[:2])}
