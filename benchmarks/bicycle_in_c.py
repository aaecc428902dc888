"""SymPy's bicycle as compiled C: common subexpressions once, -O3, one scalar evaluation after the other.

The generated file is a small extension module of Python, so that a call costs some tens of nanoseconds:

    rhs(y, t, p, dy)      one evaluation; the argument order of scipy's odeint
    rhs_ty(t, y, p, dy)   the same in the order of scipy's other solvers
    batch(p, y, dy)       a loop over the rows of y (b, n_y)
    rhs_c                 the first as a C function, which `by_ctypes` calls

y holds the coordinates, all speeds and the states of what was derived, as the 14 of `bicycle_in_sympy`, p its
parameters; each writes dy and returns it.
"""

from __future__ import annotations

import ctypes
import importlib.util
import os
import shutil
import subprocess
import sysconfig
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np

from .bicycle_in_sympy import Derived

FLAGS = ("-O3", "-march=native", "-fno-math-errno", "-shared", "-fPIC")


class Built(NamedTuple):
    module: ModuleType
    operations: int
    generate: float  # seconds
    compile: float  # seconds


def compiler() -> str | None:
    """The C compiler, where there is one that can build an extension module of this Python."""
    header = Path(sysconfig.get_path("include")) / "Python.h"
    found = shutil.which(os.environ.get("CC", "cc")) or shutil.which("gcc") or shutil.which("clang")
    return found if header.exists() else None


def build(derived: Derived, folder: Path) -> Built:
    """Generate, compile and load."""
    began = time.perf_counter()
    source, operations = written(derived)
    generated = time.perf_counter()
    folder.mkdir(parents=True, exist_ok=True)
    path, library = folder / "bicycle_in_c.c", folder / f"_bicycle_c{sysconfig.get_config_var('EXT_SUFFIX')}"
    path.write_text(source, encoding="utf-8")
    cc = compiler()
    assert cc is not None, "no C compiler with Python's headers was found"
    command = [cc, *FLAGS, f"-I{sysconfig.get_path('include')}", str(path), "-o", str(library), "-lm"]
    subprocess.run(command, check=True)
    spec = importlib.util.spec_from_file_location("_bicycle_c", library)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return Built(module, operations, generated - began, time.perf_counter() - generated)


def by_ctypes(module: ModuleType) -> Callable[..., np.ndarray]:
    """`rhs` called by way of ctypes, as a script would do it; that takes some microseconds a call."""
    f = ctypes.CDLL(str(module.__file__)).rhs_c
    f.argtypes, f.restype = [ctypes.c_void_p, ctypes.c_double, ctypes.c_void_p, ctypes.c_void_p], None

    def rhs(y, t, p, dy):
        f(y.ctypes.data, t, p.ctypes.data, dy.ctypes.data)
        return dy

    return rhs


def written(derived: Derived) -> tuple[str, int]:
    """The C source, and the number of its scalar operations without the solution of the linear equations."""
    import sympy as sm
    from sympy.codegen.rewriting import ReplaceOptim, create_expand_pow_optimization
    from sympy.physics.mechanics import msubs

    together = (*derived.q, *derived.u, *derived.x)
    y = sm.symbols(f"s:{len(together)}", real=True)
    plain = dict(zip(together, y))
    rates = sm.Matrix([*derived.q_dot, *derived.x_dot])
    exact = [msubs(m, plain) for m in (derived.M, derived.f, rates)]
    steps, (M, f, rates) = sm.cse(exact, sm.numbered_symbols("x"), order="none")
    operations = sum(map(sm.count_ops, [e for _, e in steps] + [e for m in (M, f, rates) for e in m]))
    # pow(x, 3) and pow(x, -1.5) are calls, x*x*x and 1/(x*sqrt(x)) are not.
    roots = ReplaceOptim(
        lambda e: e.is_Pow and e.exp.is_Rational and e.exp.q == 2,
        lambda e: sm.Mul(sm.Pow(e.base, sm.floor(e.exp)), sm.sqrt(e.base), evaluate=False),
    )
    products = create_expand_pow_optimization(4)
    c = lambda e: sm.ccode(products(roots(e)))  # noqa: E731
    n_q, n = len(derived.q), len(derived.u)
    first = n - 3  # three constraints
    # Constraints before Kane's equations and dependent speeds before independent ones: no pivots need be looked for.
    order = [*range(first, n), *range(first)]
    lines = [f"const double {name} = p[{i}];" for i, name in enumerate(derived.p)]
    lines += [f"const double {name} = y[{i}];" for i, name in enumerate(y)]
    lines += [f"const double {name} = {c(e)};" for name, e in steps]
    lines += [f"A[{i}][{j}] = {c(M[r, s])};" for i, r in enumerate(order) for j, s in enumerate(order)]
    lines += [f"A[{i}][{n}] = {c(f[r])};" for i, r in enumerate(order)]
    lines += [f"dy[{i if i < n_q else i + n}] = {c(e)};" for i, e in enumerate(rates)]
    places = ", ".join(str(n_q + s) for s in order)
    values = {"EQUATIONS": "\n    ".join(lines), "N_Y": len(together), "N": n, "PLACES": places}
    source = _TEMPLATE
    for name, value in values.items():
        source = source.replace(f"@{name}@", str(value))
    return source, int(operations)


_TEMPLATE = r"""
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <math.h>

static inline void evaluate(const double *restrict p, const double *restrict y, double *restrict dy) {
    double A[@N@][@N@ + 1], pivots[@N@];
    @EQUATIONS@
    static const int places[@N@] = {@PLACES@};
    for (int k = 0; k < @N@; k++) {
        pivots[k] = 1.0 / A[k][k];
        for (int i = k + 1; i < @N@; i++) {
            const double factor = A[i][k] * pivots[k];
            for (int j = k + 1; j <= @N@; j++) A[i][j] -= factor * A[k][j];
        }
    }
    for (int k = @N@ - 1; k >= 0; k--) {
        double x = A[k][@N@];
        for (int j = k + 1; j < @N@; j++) x -= A[k][j] * A[j][@N@];
        A[k][@N@] = x * pivots[k];
        dy[places[k]] = A[k][@N@];
    }
}

void rhs_c(const double *y, double t, const double *p, double *dy) { evaluate(p, y, dy); }

static PyObject *run(PyObject *p, PyObject *y, PyObject *dy) {
    Py_buffer P, Y, DY;
    if (PyObject_GetBuffer(p, &P, PyBUF_SIMPLE)) return NULL;
    if (PyObject_GetBuffer(y, &Y, PyBUF_SIMPLE)) { PyBuffer_Release(&P); return NULL; }
    if (PyObject_GetBuffer(dy, &DY, PyBUF_WRITABLE)) { PyBuffer_Release(&P); PyBuffer_Release(&Y); return NULL; }
    const Py_ssize_t rows = Y.len / (@N_Y@ * sizeof(double));
    for (Py_ssize_t i = 0; i < rows; i++)
        evaluate(P.buf, (const double *)Y.buf + i * @N_Y@, (double *)DY.buf + i * @N_Y@);
    PyBuffer_Release(&P);
    PyBuffer_Release(&Y);
    PyBuffer_Release(&DY);
    return Py_NewRef(dy);
}

static PyObject *rhs(PyObject *self, PyObject *const *args, Py_ssize_t n) { return run(args[2], args[0], args[3]); }
static PyObject *rhs_ty(PyObject *self, PyObject *const *args, Py_ssize_t n) { return run(args[2], args[1], args[3]); }
static PyObject *batch(PyObject *self, PyObject *const *args, Py_ssize_t n) { return run(args[0], args[1], args[2]); }

static PyMethodDef methods[] = {
    {"rhs", (PyCFunction)(void (*)(void))rhs, METH_FASTCALL, ""},
    {"rhs_ty", (PyCFunction)(void (*)(void))rhs_ty, METH_FASTCALL, ""},
    {"batch", (PyCFunction)(void (*)(void))batch, METH_FASTCALL, ""},
    {NULL, NULL, 0, NULL},
};
static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, "_bicycle_c", NULL, -1, methods};
PyMODINIT_FUNC PyInit__bicycle_c(void) { return PyModule_Create(&module); }
"""
