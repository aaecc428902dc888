"""A million bicycles for a second each: `examples/sweep_a_million.py`, killed on its way and called again."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from ._figures import Figure
from ._process import ROOT, Setting, environment

MEMBERS = 1_000_000


def measure(setting: Setting) -> Iterator[Figure]:
    members = 8192 if setting.quick else MEMBERS
    folder = Path(setting.folder).absolute() / "million"
    shutil.rmtree(folder, ignore_errors=True)
    command = [sys.executable, str(ROOT / "examples" / "sweep_a_million.py"), "--members", str(members)]
    command += ["--folder", str(folder), "--out", setting.folder, "--devices", str(setting.devices)]
    began = time.perf_counter()
    run = subprocess.Popen(command, env=environment(setting.devices), stdout=subprocess.DEVNULL)
    total = -(-members // 4096)
    while len(list(folder.glob("*.npz"))) < max(1, total // 3) and run.poll() is None:
        time.sleep(0.02)
    os.kill(run.pid, signal.SIGKILL)
    run.wait()
    kept = len(list(folder.glob("*.npz")))
    assert 0 < kept < total, f"{kept} of {total} chunks were there when it was killed"
    told = subprocess.run(command, env=environment(setting.devices), capture_output=True, text=True, check=True).stdout
    seconds = time.perf_counter() - began
    shutil.rmtree(folder)
    memory = re.search(r"(\d+) MB of memory", told)
    yield Figure("million", f"{members} bicycles for 1 s, killed after {kept} of {total} chunks", seconds, "s")
    if memory:
        yield Figure("million", f"{members} bicycles, memory at most", float(memory[1]), "MB")
