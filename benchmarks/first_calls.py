"""What a fresh process waits for: the first call, and the first call of a second process that finds the cache filled.

Trace, compile and run, with one core; the imports are left out, but for the first trajectory, whose figure is the
processor's time from the start of Python on. Every call is made in a process of its own.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

from ._figures import Figure
from ._first import NAMES
from ._process import Setting, answer

MOST = {"start": 3.0, "simulate": 3.0, "batch": 5.0, "sensitivities": 8.0, "reverse": 15.0, "fit": 10.0}  # seconds
TOLD = {
    "start": "from the start of Python to a first trajectory",
    "simulate": "`simulate`, a ride of 5 s",
    "batch": "`sweep`, 256 rides",
    "sensitivities": "26 sensitivities",
    "reverse": "reverse gradient",
    "fit": "one optimizer step of `fit_bicycle`",
}


def measure(setting: Setting) -> Iterator[Figure]:
    column, chosen = setting.column, NAMES[:1] if setting.quick else NAMES
    with tempfile.TemporaryDirectory() as scratch:
        ride = Path(scratch) / "ride.npz"
        if "fit" in chosen:
            answer("benchmarks._first", ["prepare", "--rides", str(ride)])
        for name in chosen:
            tries = []
            for k in range(1 if setting.quick else 2):  # the better of two: what else the machine does slows one
                cache = Path(scratch) / f"{name}{k}"
                arguments = [name, "--cache", str(cache), "--rides", str(ride), *["--native"] * setting.native]
                tries.append([answer("benchmarks._first", arguments)["seconds"] for _ in range(2)])
            first, second = map(min, zip(*tries))
            most = MOST[name]
            yield Figure("first_calls", f"first call: {TOLD[name]}", first, "s", column, at_most=most)
            yield Figure("first_calls", f"second process: {TOLD[name]}", second, "s", column, at_most=most / 2)
