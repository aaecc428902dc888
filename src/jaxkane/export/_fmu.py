"""Export a system as a functional mock-up unit (FMU), which simulation programs import. Compiles it and writes it."""

from __future__ import annotations

import os
import platform
import shlex
import shutil
import subprocess
import tempfile
import uuid
import warnings
import zipfile
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import jax
import numpy as np

from .._common.files import write_file
from .._common.lookup import real_number, refuse_unknown
from .._kane.arguments import check_is_system, is_concrete
from .._kane.consistent_state import assemble
from .._kane.contact import has_contacts, has_multipliers, layout_of
from .._scalarjit.components import is_written_out
from .._system.parameters import in_batches
from .._system.system import State, System
from ._fmu_description import KINDS, build_description, model_description
from ._fmu_model import FMUModel
from ._source import C_WORDS, identifiers

VERSIONS = ("2.0", "3.0")


def fmu(
    system: System,
    path: str | Path,
    *,
    fmi: str = "3.0",
    kind: str | Sequence[str] = ("model exchange", "co-simulation"),
    step: float = 1e-3,
    sources: bool = True,
    state: State | None = None,
) -> Path:
    """Export a system as an FMU, for Simulink, OpenModelica, Dymola, FMPy and other programs that support FMI.

        jk.export.fmu(pendulum, "pendulum.fmu")
        # fmpy.simulate_fmu("pendulum.fmu", start_values={"angle": 1.0, "mass": 2.0})

    | in the system | in the FMU |
    |---|---|
    | coordinates, independent speeds, first-order states | continuous states; they are also outputs |
    | dependent speeds, outputs | outputs |
    | inputs | inputs |
    | parameters | tunable parameters with bounds; fixed parameters if configuration constraints depend on them |
    | events without `then`, det C_dep = 0 | end of the simulation |
    | events with `then` | jumps of the states |

    All directional derivatives are exact, also those with respect to parameters. The state of the FMU can be stored,
    restored and serialized. Co-simulation uses the classical Runge-Kutta method of order 4. It divides each
    communication step into equal steps, and locates events. The FMU refuses values of parameters outside of their
    bounds.

    At the end of the initialization, the FMU solves the configuration constraints for the dependent coordinates. A
    system without dependent coordinates starts at the nearest coordinates that satisfy the constraints. Dependent
    speeds are always computed from the constraints.

    The equations are compiled with the C compiler of this computer: `$CC`, cc, gcc or clang. The FMU therefore runs on
    computers of the same kind. With `sources`, other programs can compile the FMU for other computers.

    **Arguments:**

    - `system`: the system, with at most 12 independent speeds.
    - `path`: the file to write, "FOLDER/NAME.fmu". The folder is created. An existing file is replaced.
    - `fmi`: the version of the interface, "3.0" or "2.0".
    - `kind`: "model exchange" (the importing program integrates), "co-simulation" (the FMU integrates), or both.
    - `step`: the longest step of the integration in co-simulation [s].
    - `sources`: whether the FMU contains its C source, one file without dependencies.
    - `state`: the start values. Default: `jaxkane.assemble(system, {}, {})`.

    **Returns:** the path.

    **Raises:** `ValueError` for contacts, for more than 12 speeds, for a batch of systems, for operations that are not
    formulas of scalars, and for start values that violate the constraints. `RuntimeError` if there is no compiler and
    `sources` is False. If there is no compiler and `sources` is True, the FMU contains only the source, with a warning.
    """
    kinds = (kind,) if isinstance(kind, str) else tuple(kind)
    path = _checked(system, path, fmi, kinds, step)
    model = _model(system, path, step, state)
    # The token depends on the contents only, so that equal systems give equal files.
    contents = model.source(fmi, "") + model_description(model, fmi, kinds, "", sources)
    token = str(uuid.uuid5(uuid.NAMESPACE_URL, contents))
    source = model.source(fmi, token)
    binary, why_not = _compiled(source, model.name)
    if binary is None:
        if not sources:
            raise RuntimeError(f"fmu: {why_not} Install a C compiler, or pass sources=True to export the C source.")
        warnings.warn(
            f"jaxkane.export.fmu: {why_not} {path.name} contains only C source, which not all programs can import. "
            "Install a C compiler and export it again to add a binary.",
            stacklevel=2,
        )
    files: dict[str, str | bytes] = {"modelDescription.xml": model_description(model, fmi, kinds, token, sources)}
    if sources:
        files[f"sources/{model.name}.c"] = source
        if fmi == "3.0":
            files["sources/buildDescription.xml"] = build_description(model)
    if binary is not None:
        files[f"binaries/{_platform(fmi)}/{model.name}{_suffix()}"] = binary
    write_file(path, _zipped(files))
    return path


def _checked(system: System, path: str | Path, fmi: str, kinds: tuple[str, ...], step: float) -> Path:
    """The path, after checks of the arguments and of what an FMU can contain."""
    check_is_system(system)
    name, path = type(system).__name__, Path(path)
    refuse_unknown(kinds, KINDS, "fmu: there is no kind")
    step = real_number(step, "fmu: `step`")
    if not is_concrete(system):
        raise TypeError(f"{name} is traced. Call this function outside of jax.jit, vmap and grad.")
    batched, contacts = in_batches(system), layout_of(system).names if has_contacts(system) else ()
    refused = {
        f"`path` must end with .fmu, e.g. 'generated/bicycle.fmu'; got {str(path)!r}.": path.suffix != ".fmu",
        f"`fmi` must be {' or '.join(map(repr, VERSIONS))}, got {fmi!r}.": fmi not in VERSIONS,
        f"`kind` is empty. Pass some of {', '.join(map(repr, KINDS))}.": not kinds,
        f"fmu: `step` [s] must be positive and finite, got {step!r}.": not 0 < step < np.inf,
        f"{name} is a batch: {', '.join(batched)} has additional leading axes. Pass one member of it.": batched,
        f"{name} has no coordinates and no first-order states, so an FMU would have no states.": not (
            system.coordinates or system.states
        ),
        f"{name}: an FMU cannot represent contacts: {', '.join(contacts)}. Replace them by spring forces in `loads`, "
        "or by events with `then`.": contacts,
        f"{name}: an FMU cannot represent multipliers. Export the system with dependent speeds.": has_multipliers(
            system
        ),
        f"{name}: an FMU supports at most 12 independent speeds, and this system has {len(system.speeds)}. "
        "jaxkane.export.stablehlo supports any number.": not is_written_out(len(system.speeds)),
    }
    for message, is_wrong in refused.items():
        if is_wrong:
            raise ValueError(message)
    return path


def _model(system: System, path: Path, step: float, state: State | None) -> FMUModel:
    (name,) = identifiers([path.stem], C_WORDS)
    if not isinstance(state, (State, type(None))):
        raise TypeError(f"fmu: `state` must be a jaxkane.State, got {state!r}.")
    try:
        start = assemble(system, {}, {}) if state is None else assemble(system, state.q, state.u, state.x)
    except ValueError as error:
        raise ValueError(f"fmu: there are no start values. {error} Pass other values as `state`.") from error
    with jax.enable_x64(True):
        model = FMUModel(system, start, name, step)
    # XML cannot contain control characters, and names of variables no line breaks.
    for text in (text for x in model.variables for text in (x.name, x.unit)):
        if not text.isprintable():
            raise ValueError(f"{model.formulas.name}: an FMU cannot contain the name or unit {text!r}. Rename it.")
    return model


def _compiled(source: str, name: str) -> tuple[bytes | None, str]:
    """A shared library, or None and the reason."""
    command = shlex.split(os.environ.get("CC", "")) or [x for x in ("cc", "gcc", "clang") if shutil.which(x)][:1]
    if not command:
        return None, "There is no C compiler ($CC, cc, gcc or clang)."
    with tempfile.TemporaryDirectory() as folder:
        file, target = Path(folder) / f"{name}.c", Path(folder) / f"{name}{_suffix()}"
        file.write_text(source, encoding="utf-8")
        options = ["-std=c99", "-O2", "-shared", "-fvisibility=hidden", "-ffp-contract=off"]
        options += [] if os.name == "nt" else ["-fPIC"]
        command = [*command, *options, str(file), "-o", str(target), "-lm"]
        try:
            run = subprocess.run(command, capture_output=True, text=True, check=False)
        except OSError as error:
            return None, f"The C compiler {command[0]!r} cannot be run: {error.strerror}."
        if run.returncode or not target.exists():
            lines = [line for line in run.stderr.splitlines() if "error" in line] or run.stderr.splitlines()
            reason = f": {lines[0].strip()}" if lines else f" (status {run.returncode})"
            return None, f"The C compiler {command[0]!r} failed{reason}."
        return target.read_bytes(), ""


def _suffix() -> str:
    return {"Windows": ".dll", "Darwin": ".dylib"}.get(platform.system(), ".so")


def _platform(fmi: str) -> str:
    """The name of the folder of the binary."""
    system, machine = platform.system().lower(), platform.machine().lower()
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(machine, machine)
    if fmi == "3.0":
        return f"{machine}-{system}"
    short = {"windows": "win", "darwin": "darwin"}.get(system, system)
    return f"{short}{'64' if machine.endswith('64') else '32'}"


def _zipped(files: dict[str, str | bytes]) -> bytes:
    buffer = BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            # A fixed date, so that equal systems give equal files.
            entry = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(entry, content)
    return buffer.getvalue()
