"""65 536 rides of 5 s on a GPU, where JAX sees one, against two threads of the CPU.

Each in a process of its own: `python -m benchmarks.gpu cuda`, rides a second as JSON.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator

from ._figures import Figure
from ._process import Setting, answer
from ._timing import in_turns

RIDES = 65_536


def measure(setting: Setting) -> Iterator[Figure]:
    rides = 256 if setting.quick else RIDES
    try:
        on_gpu = answer("benchmarks.gpu", ["cuda", str(rides)], cores=None)
    except RuntimeError:
        return  # JAX has no GPU here
    on_cpu = answer("benchmarks.gpu", ["cpu", str(rides // 8)], cores=2)
    yield Figure("gpu", f"{rides} rides of 5 s on {on_gpu['device']}", on_gpu["rate"], "rides/s")
    yield Figure("gpu", f"{rides // 8} rides of 5 s, two threads of the CPU", on_cpu["rate"], "rides/s")
    yield Figure("gpu", "rides a second on the GPU against the CPU's two threads", on_gpu["rate"] / on_cpu["rate"])


def main(platform: str, rides: int) -> None:
    os.environ["JAX_PLATFORMS"] = platform
    import jax

    import jaxkane as jk

    jk.configure(cache=False, devices=2 if platform == "cpu" else None, verbose=False)
    from . import _bicycle as bicycle

    starts = bicycle.starts(rides)
    chunk = rides if platform == "cuda" else 256
    best = in_turns({"sweep": lambda: jk.sweep.sweep(bicycle.BICYCLE, starts, bicycle.TIMES, chunk=chunk)}, 1.0, 2)
    print(json.dumps({"rate": rides / best["sweep"], "device": jax.local_devices()[0].device_kind}))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
