"""65 536 rides of 5 s on a GPU, where JAX sees one, against one core: their motions on the host, or one number of each.

Each in a process of its own: `python -m benchmarks.gpu cuda 65536`, rides a second as JSON.
"""

from __future__ import annotations

import functools
import json
import os
import sys
from collections.abc import Iterator
from typing import Any

from ._figures import Figure
from ._process import Setting, answer
from ._timing import in_turns

RIDES = 65_536
TIMES_A_CORE = 50.0  # the target


def largest_roll(ride: Any) -> Any:
    return abs(ride["roll"]).max()


KEPT = {"51 samples of each, on the host": None, "the largest roll of each": largest_roll}


def measure(setting: Setting) -> Iterator[Figure]:
    rides = 256 if setting.quick else RIDES
    try:
        on_gpu = answer("benchmarks.gpu", ["cuda", str(rides)], cores=None)
    except RuntimeError:
        return  # JAX has no GPU here
    on_cpu = answer("benchmarks.gpu", ["cpu", str(rides // 8)])
    for kept in KEPT:
        yield Figure("gpu", f"{rides} rides on {on_gpu['device']}, {kept}", on_gpu[kept], "rides/s")
        yield Figure("gpu", f"{rides // 8} rides on one core, {kept}", on_cpu[kept], "rides/s")
        yield Figure("gpu", f"the GPU against one core, {kept}", on_gpu[kept] / on_cpu[kept], at_least=TIMES_A_CORE)


def main(platform: str, rides: int) -> None:
    os.environ["JAX_PLATFORMS"] = platform
    import jax

    import jaxkane as jk

    jk.configure(cache=False, verbose=False)
    from ._bicycle import BICYCLE, TIMES, starts

    options = {"chunk": rides if platform == "cuda" else 256}
    sweep = functools.partial(jk.sweep.sweep, BICYCLE, starts(rides), TIMES, **options)
    best = in_turns({kept: functools.partial(sweep, reduce=reduce) for kept, reduce in KEPT.items()}, 1.0)
    rates = {kept: rides / seconds for kept, seconds in best.items()}
    print(json.dumps(rates | {"device": jax.local_devices()[0].device_kind}))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
