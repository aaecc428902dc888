"""How long from the description of a bicycle to its first trajectory: SymPy's ways against jaxkane's."""

from __future__ import annotations

from collections.abc import Iterator

from ._figures import Figure
from ._peers import here
from ._process import Setting, answer

WAYS = {
    "lambdify": "SymPy + lambdify",
    "cython": "PyDy's Cython",
    "c": "SymPy + C",
}


def measure(setting: Setting) -> Iterator[Figure]:
    column = setting.column
    ways = ["jaxkane", *(way for way, name in WAYS.items() if here(name))]
    best, ends = dict.fromkeys(ways, float("inf")), {}
    for _ in range(1 if setting.quick else 3):
        for way in ways:
            native = ["--native"] * (setting.native and way == "jaxkane")
            told = answer("benchmarks._description", [way, *native])
            best[way], ends[way] = min(best[way], told["seconds"]), told["roll"]
    for way in ways[1:]:
        assert abs(ends[way] - ends["jaxkane"]) < 1e-6, f"{WAYS[way]} ends at another roll: {ends}"
    yield Figure("from_description", "description to first trajectory: jaxkane", best["jaxkane"], "s", column)
    for way in ways[1:]:
        yield Figure("from_description", f"description to first trajectory: {WAYS[way]}", best[way], "s", column)
    for way in ways[1:]:
        ratio = best[way] / best["jaxkane"]
        what = f"description to first trajectory, {WAYS[way]} against ours"
        yield Figure("from_description", what, ratio, column=column, at_least=3.0)
