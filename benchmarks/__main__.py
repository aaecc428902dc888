"""How fast is jaxkane, against its peers, on this machine? One command measures all of it.

    right_hand_side   one evaluation for the bicycle, in a batch: SymPy's lambdify, PyDy's Cython, generated C
    assemblies        the same for bicycles with parts, by the operation
    exported          the same as exported C: generated C
    rides             a thousand rides, and one: scipy's odeint and DOP853 around Cython and C; one and two devices
    sensitivities     all derivatives of a ride: finite differences with C
    first_calls       what a fresh process waits for, and a second one with the cache
    contacts          first calls with contacts, in first calls without (five minutes)
    from_description  from the description to the first trajectory: SymPy's ways
    chains            three-dimensional chains of 2 to 40 links: MuJoCo, Pinocchio, MJX, JaxSim
    gpu               65 536 rides on a GPU, where there is one
    walkers           20 steps of ten thousand walkers, and families of gaits: SciPy with events around C
    eigenvalues       eigenvalues of ten thousand bicycles: BicycleParameters, numpy
    identification    fits of the bicycle, and whether they can be trusted (four minutes)
    million           a million bicycles, killed on the way (five minutes)
    swing_up          optimal control by direct collocation: opty (one minute)
    opti              the same: CasADi's Opti (one minute)

Every answer is compared before it is timed; a peer that is not installed is named and left out (pip install
'jaxkane[benchmarks]').

Run:      python -m benchmarks [part ...] [--quick] [--out FOLDER] [--publish]
Appears:  every figure with its target; results.md, results.json and speed.png in the folder. Parts that were measured
          before, on the same machine with the same versions, stay in the table.
Takes:    about twenty-five minutes without the last four parts, which are measured only where they are named; some
          minutes with `--quick`, whose figures mean nothing.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from ._figures import Figure, line
from ._machine import machine
from ._peers import missing
from ._picture import draw
from ._process import ROOT, Setting, child, environment
from ._report import TITLES, Results, markdown

XLA, NATIVE = Setting(), Setting(native=True)
TWO = (XLA._replace(devices=2), NATIVE._replace(devices=2))
SETTINGS = {
    "right_hand_side": (XLA, NATIVE),
    "assemblies": (NATIVE,),
    "exported": (NATIVE,),
    "rides": (XLA, NATIVE, *TWO),
    "sensitivities": (XLA, NATIVE),
    "first_calls": (XLA, NATIVE),
    "contacts": (NATIVE,),
    "from_description": (XLA, NATIVE),
    "chains": (XLA, NATIVE),
    "gpu": TWO[:1],
    "walkers": (XLA, NATIVE),
    "million": TWO[1:],
    "swing_up": (XLA,),
    "opti": (NATIVE,),
}
SCRIPTS = {"eigenvalues": ("eigenvalues.py",), "identification": ("identification.py", "--repetitions", "50")}
NAMED_ONLY = ("identification", "million", "swing_up", "opti")


def main(arguments: list[str] | None = None) -> None:
    given = parse(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    told, absent, path = machine(), missing(), given.out / "results.json"
    for what, words in told.items():
        print(f"{what}: {words}")
    for name, how in absent.items():
        print(f"left out: {name} ({how})")
    results = Results(told, absent) if given.quick else Results.read(path, told, absent)
    failed = []
    for part in given.parts:
        print(f"\n{TITLES[part]}", flush=True)
        try:
            if part in SCRIPTS:
                results.words[part] = words_of(part)
            else:
                results.figures[part] = found = []
                for figure in figures_of(part, given.quick, given.out):
                    print(line(figure), flush=True)
                    found.append(figure)
                if not found:
                    print("  what this needs is not here")
        except (RuntimeError, subprocess.CalledProcessError) as error:
            failed.append(part)
            print(error, file=sys.stderr)
        results.write(path)
        (given.out / "results.md").write_text(markdown(results), encoding="utf-8")
    drawn = draw([f for figures in results.figures.values() for f in figures], given.out / "speed.png")
    if given.publish:
        (ROOT / "benchmarks" / "results.md").write_text(markdown(results), encoding="utf-8")
        if drawn:
            (ROOT / "docs" / "speed.png").write_bytes((given.out / "speed.png").read_bytes())
    print(f"\ntable: {given.out / 'results.md'}")
    if failed:
        sys.exit(f"These parts failed: {', '.join(failed)}.")


def parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        "python -m benchmarks", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    every = [part for part in TITLES if part in SETTINGS or part in SCRIPTS]
    usual = [part for part in every if part not in NAMED_ONLY]
    parser.add_argument("parts", nargs="*", metavar="part", help=f"any of {', '.join(every)}; without one, the usual")
    parser.add_argument("--quick", action="store_true", help="only see that everything runs")
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder (default: figures)")
    parser.add_argument(
        "--publish", action="store_true", help="write benchmarks/results.md and docs/speed.png of this checkout too"
    )
    given = parser.parse_args(arguments)
    unknown = sorted(set(given.parts) - set(every))
    if unknown:
        parser.error(f"there is no part {', '.join(unknown)}; there are {', '.join(every)}")
    if given.quick and given.publish:
        parser.error("figures of --quick mean nothing, so they are not published")
    given.parts = given.parts or usual
    return given


def figures_of(part: str, quick: bool, out: Path) -> Iterator[Figure]:
    """The figures of a part, each setting in a process of its own, bound to one core for each device."""
    for setting in SETTINGS[part]:
        options = ["--devices", str(setting.devices), "--folder", str(out.absolute())]
        options += ["--native"] * setting.native + ["--quick"] * quick
        for kept in child("benchmarks._part", [part, *options], cores=setting.devices):
            yield Figure(**kept | {"at_most": None, "at_least": None} if quick else kept)


def words_of(part: str) -> str:
    """What a script says that measures on its own, with all cores."""
    script, *options = SCRIPTS[part]
    command = [sys.executable, str(ROOT / "benchmarks" / script), *options]
    said = subprocess.run(command, env=environment(None), check=True, stdout=subprocess.PIPE, text=True).stdout
    print(said)
    return said


if __name__ == "__main__":
    main()
