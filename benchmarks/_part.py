"""One part of the suite in a process of its own: `python -m benchmarks._part rides --native`, figures as JSON."""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import json

from ._process import Setting, configure


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("part")
    parser.add_argument("--native", action="store_true")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--devices", type=int, default=1)
    parser.add_argument("--folder", default="figures")
    given = parser.parse_args()
    setting = Setting(given.native, given.devices, given.quick, given.folder)
    configure(setting)  # before a part is imported, since it makes arrays
    for figure in importlib.import_module(f".{given.part}", __package__).measure(setting):
        print(json.dumps(dataclasses.asdict(figure)), flush=True)


if __name__ == "__main__":
    main()
