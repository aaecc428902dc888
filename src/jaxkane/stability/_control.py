"""What control engineers do with a linear model, by scipy and python-control. Knows no mechanics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .._common.lookup import as_names, hint
from ._linearize import LinearModel

if TYPE_CHECKING:
    import scipy.signal


def transfer_function(model: LinearModel, input: str, output: str) -> scipy.signal.TransferFunction:
    """G(s) = C (s - A)^-1 B + D from an input to an output, as a `scipy.signal.TransferFunction`.

    Leading coefficients of the numerator that are rounding errors (1e-12 of the largest) are left out. `bode` needs no
    coefficients and is more accurate for many states.

    **Raises:** `ValueError` for an unknown name.
    """
    import scipy.signal  # which imports all of scipy.stats: a second that most have no use for

    A, B, C, D = _single(model, input, output)
    numerator, denominator = scipy.signal.ss2tf(A, B, C, D)
    small = np.abs(numerator[0]) <= 1e-12 * np.abs(numerator[0]).max()
    return scipy.signal.TransferFunction(numerator[0][np.argmin(small) :], denominator)


def bode(model: LinearModel, input: str, output: str, frequencies: Any) -> tuple[np.ndarray, np.ndarray]:
    """Magnitude [dB] and phase [deg, unwrapped] of G(i omega) at `frequencies` (m,) [rad/s], by solving for each.

    **Raises:** `ValueError` for an unknown name.
    """
    A, B, C, D = _single(model, input, output)
    s = 1j * np.asarray(frequencies, dtype=float)[:, None, None]
    G = (C @ np.linalg.solve(s * np.eye(len(A)) - A, np.broadcast_to(B, (len(s), *B.shape))) + D)[:, 0, 0]
    return 20 * np.log10(np.abs(G)), np.rad2deg(np.unwrap(np.angle(G)))


def lqr(
    model: LinearModel, Q: Any, R: Any, inputs: Sequence[str] | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The linear-quadratic regulator w = -K x that minimizes the integral of x' Q x + w' R w.

        A' P + P A - P B R^-1 B' P + Q = 0,   K = R^-1 B' P          (scipy.linalg.solve_continuous_are)

    **Arguments:** `Q` (n, n) or its diagonal (n,); `R` (m, m), its diagonal or a number; `inputs`: names of the inputs
    to use, by default all.

    **Returns:** K (m, n), P (n, n), and the eigenvalues (n,) of A - B K.

    **Raises:** `ValueError` for wrong shapes and for a model that these inputs cannot stabilize.
    """
    from scipy.linalg import solve_continuous_are

    names = model.inputs if inputs is None else as_names(inputs)
    A, B = np.asarray(model.A), np.asarray(model.B)[:, [_place(model.inputs, k, "input") for k in names]]
    Q, R = _weights(Q, len(A), "Q", "states"), _weights(R, B.shape[1], "R", "inputs")
    size = max(np.abs(A).max(), np.abs(B).max())
    for root in np.linalg.eigvals(A):  # Popov, Belevitch and Hautus: [root - A, B] must keep its rank where Re >= 0
        s = np.linalg.svd(np.hstack([root * np.eye(len(A)) - A, B]), compute_uv=False)
        if root.real > -1e-9 * size and s[-1] < 1e-9 * size:
            raise ValueError(
                f"lqr: no regulator of {', '.join(model.states)} by {', '.join(names)} exists: they do not reach the "
                f"mode with the eigenvalue {root:.4g}, which does not decay. Leave out the states that it moves: "
                "linearize(..., states=(...)), or add an input."
            )
    least_Q, least_R = (float(np.linalg.eigvalsh(0.5 * (W + W.T))[0]) for W in (Q, R))
    if not (least_Q >= -1e-12 * np.abs(Q).max() and least_R > 0.0):
        raise ValueError(
            "lqr: Q must have no negative eigenvalue and R only positive ones; "
            f"the least of them are {least_Q:.4g} and {least_R:.4g}."
        )
    P = solve_continuous_are(A, B, Q, R)
    K = np.linalg.solve(R, B.T @ P)
    return K, P, np.linalg.eigvals(A - B @ K)


def to_control(model: LinearModel) -> Any:
    """The model as a `control.StateSpace` of python-control, with its names. Needs the extra `control`."""
    try:
        import control  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ImportError('to_control needs python-control: pip install "jaxkane[control]".') from None
    names = {"states": list(model.states), "inputs": list(model.inputs), "outputs": list(model.outputs)}
    return control.StateSpace(*map(np.asarray, model), **names)


def _single(model: LinearModel, input: str, output: str) -> tuple[np.ndarray, ...]:
    i, o = _place(model.inputs, input, "input"), _place(model.outputs, output, "output")
    A, B, C, D = map(np.asarray, model)
    return A, B[:, [i]], C[[o]], D[[o]][:, [i]]


def _place(names: Sequence[str], name: str, what: str) -> int:
    if name not in names:
        raise ValueError(f"The model has no {what} {name!r}; {hint(name, names, 'it has')}")
    return list(names).index(name)


def _weights(W: Any, n: int, name: str, what: str) -> np.ndarray:
    W = np.asarray(W, dtype=float)
    W = np.diag(np.broadcast_to(W, (n,))) if W.ndim == 0 or W.shape == (n,) else W
    if W.shape != (n, n):
        raise ValueError(f"lqr: {name} is ({n}, {n}), or ({n},) for a diagonal: one for each of the {what}.")
    if not np.all(np.isfinite(W)):
        raise ValueError(f"lqr: {name} is not finite.")
    return W
