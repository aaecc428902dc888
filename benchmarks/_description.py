"""From the description to a trajectory in a fresh process: `python -m benchmarks._description jaxkane`.

Prints its seconds as JSON. The imports are left out. SymPy: derive, generate, compile, and a ride by odeint.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

from ._process import Setting, configure
from ._timing import timed


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("way", choices=("jaxkane", "lambdify", "cython", "c"))
    parser.add_argument("--native", action="store_true")
    given = parser.parse_args()
    configure(Setting(native=given.native))
    with tempfile.TemporaryDirectory() as folder:
        run = by_jaxkane() if given.way == "jaxkane" else by_sympy(given.way, Path(folder))
        roll, seconds = timed(run)
    print(json.dumps({"seconds": seconds, "roll": float(roll)}))


def by_jaxkane():
    import jaxkane as jk

    from . import _bicycle as bicycle

    start = bicycle.member(bicycle.starts(1), 0)
    return lambda: jk.simulate(jk.catalog.WhippleBicycle.benchmark(), start, bicycle.TIMES)["roll"][-1]


def by_sympy(way: str, folder: Path):
    import numpy as np

    from . import _bicycle as bicycle
    from . import bicycle_in_c, bicycle_in_sympy

    y, p = bicycle.with_dependent_speeds(bicycle.starts(1))[0], bicycle.parameters()

    def run():
        derived = bicycle_in_sympy.derive()
        if way == "lambdify":
            f, rest = bicycle_in_sympy.by_lambdify(derived), (p,)
        elif way == "cython":
            f, rest = bicycle_in_sympy.by_pydy(derived, folder), (p,)
        else:
            f, rest = bicycle_in_c.build(derived, folder).module.rhs, (p, np.empty_like(y))
        return bicycle.ride_by(f, y, bicycle.TOLERANCE, *rest)[-1, 0]

    return run


if __name__ == "__main__":
    main()
