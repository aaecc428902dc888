"""Do exported C equations give the same motion as the library, and what do they look like?

A double pendulum (`jaxkane.catalog.DoublePendulum`) is released from above. `jaxkane.export.c` exports its equations as
C99. They are compiled together with a Runge-Kutta method, and the result is compared with `jaxkane.simulate`.

    variable                meaning                                       unit
    theta1, theta2          angle of each link from the downward vertical rad
    theta1_dot, theta2_dot  their rates                                   rad/s

Run:      python examples/write_equations_in_c.py [--out FOLDER]
Appears:  the files double_pendulum.h, .c and _test.c, which can be used elsewhere, and ride.c; printed are the output
          of the test program, the largest difference of the two simulations, and the time of a step in C. Without
          a C compiler, only the files are written.
Takes:    a few seconds.
"""

import argparse
import os
import shutil
import subprocess
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import jaxkane as jk

jk.configure()

STEPS, DURATION = 50_000, 5.0  # and its length [s]

RIDE = """
#include "double_pendulum.h"

#include <stdio.h>

enum { N = 4 };

static void rates(double t, const double *y, double *y_dot) {
    static const double inputs[2] = {0.0, 0.0};
    double_pendulum_rates(t, y, y + 2, inputs, &double_pendulum_default, y_dot, y_dot + 2);
}

/* Runge and Kutta's classical step; prints the angles a hundred times on the way. */
int main(void) {
    const int steps = @STEPS@;
    const double h = @DURATION@ / steps;
    double y[N] = {2.2, 2.9, 0.0, 0.0}, k[4][N], z[N];
    int i, j, s;
    for (i = 0; i <= steps; i++) {
        if (i % (steps / 100) == 0) printf("%.17g %.17g\\n", y[0], y[1]);
        rates(i * h, y, k[0]);
        for (s = 1; s < 4; s++) {
            const double part = s < 3 ? 0.5 * h : h;
            for (j = 0; j < N; j++) z[j] = y[j] + part * k[s - 1][j];
            rates(i * h + part, z, k[s]);
        }
        for (j = 0; j < N; j++) y[j] += h / 6.0 * (k[0][j] + 2.0 * k[1][j] + 2.0 * k[2][j] + k[3][j]);
    }
    return 0;
}
"""


def main(folder: Path) -> None:
    pendulum = jk.catalog.DoublePendulum()
    files = jk.export.c(pendulum, folder / "double_pendulum.c")
    for path in files:
        print(f"{path}: {len(path.read_text().splitlines())} lines")
    ride = folder / "ride.c"
    ride.write_text(RIDE.replace("@STEPS@", str(STEPS)).replace("@DURATION@", str(DURATION)))
    compiler = shutil.which(os.environ.get("CC", "cc")) or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        print("There is no C compiler here.")
        return
    compiled = {name: folder / name for name in ("test", "ride")}
    options = [compiler, "-std=c99", "-O3", str(files.source)]
    subprocess.run([*options, str(files.test), "-lm", "-o", str(compiled["test"])], check=True)
    subprocess.run([*options, str(ride), "-lm", "-o", str(compiled["ride"])], check=True)
    print("largest differences from what JAX computes, as parts of the largest numbers:")
    print(subprocess.run([compiled["test"]], check=True, capture_output=True, text=True).stdout)

    started = time.perf_counter()
    printed = subprocess.run([compiled["ride"]], check=True, capture_output=True, text=True).stdout
    seconds = time.perf_counter() - started
    in_c = np.array([line.split() for line in printed.splitlines()], float)  # (101, 2)
    start = jk.assemble(pendulum, {"theta1": 2.2, "theta2": 2.9})
    ts = jnp.linspace(0.0, DURATION, len(in_c))
    by_library = jk.simulate(pendulum, start, ts, rtol=1e-11, atol=1e-11)
    difference = np.abs(in_c - by_library.q).max()
    print(f"the two rides differ by at most {difference:.1e} rad; a step in C takes {1e6 * seconds / STEPS:.2f} us")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder (default: figures)")
    main(parser.parse_args().out)
