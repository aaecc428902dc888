"""Control theory for linear models, with scipy and python-control. Does not depend on mechanics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .._common.lookup import as_names
from ._frequency import place
from ._linearize import LinearModel


def lqr(
    model: LinearModel, Q: Any, R: Any, inputs: Sequence[str] | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The linear-quadratic regulator w = -K x that minimizes the integral of x' Q x + w' R w.

        A' P + P A - P B R^-1 B' P + Q = 0,   K = R^-1 B' P          (scipy.linalg.solve_continuous_are)

    The solution uses scaled states, inputs, time and cost, so that the gains do not depend on units.

    **Arguments:**

    - `model`: the linear model.
    - `Q`: (n, n) weights of the states, or their diagonal (n,).
    - `R`: (m, m) weights of the inputs, their diagonal (m,) or a number.
    - `inputs`: names of the inputs to use; all by default.

    **Returns:** K (m, n), P (n, n), and the eigenvalues (n,) of A - B K.

    **Raises:** `ValueError` for wrong shapes, if these inputs cannot stabilize the model, and if the solution does not
    satisfy the equation.
    """
    names = model.inputs if inputs is None else as_names(inputs, "inputs")
    A = np.asarray(model.A, float)
    B = np.asarray(model.B, float)[:, [place(model.inputs, k, "input") for k in names]]
    Q, R = _weights(Q, len(A), "Q", "states"), _weights(R, B.shape[1], "R", "inputs")
    d, e, tau, rho = _scales(A, B, Q, R)
    A1, B1, Q1, R1 = (
        tau * A * d / d[:, None],
        tau * B * e / d[:, None],
        rho * Q * d * d[:, None],
        rho * R * e * e[:, None],
    )
    size = max(np.abs(A1).max(), np.abs(B1).max(initial=0.0))
    for root in np.linalg.eigvals(A1):  # Popov, Belevitch and Hautus: [root - A, B] must keep its rank where Re >= 0
        s = np.linalg.svd(np.hstack([root * np.eye(len(A)) - A1, B1]), compute_uv=False)
        if root.real > -1e-9 * size and s[-1] < 1e-9 * size:
            raise ValueError(
                f"lqr: no regulator of {', '.join(model.states)} by {', '.join(names)} exists: these inputs cannot "
                f"control the mode with the eigenvalue {root / tau:.4g}, which does not decay. Omit the states of this "
                "mode, linearize(..., states=(...)), or add an input."
            )
    least_Q, least_R, *least = (float(np.linalg.eigvalsh(0.5 * (W + W.T))[0]) for W in (Q1, R1, Q, R))
    if not (least_Q >= -1e-12 * np.abs(Q1).max() and least_R > 0.0):
        raise ValueError(
            "lqr: Q must be positive semidefinite and R positive definite; their smallest eigenvalues are "
            "{:.4g} and {:.4g}.".format(*least)
        )
    P, K = _riccati(A1, B1, Q1, R1, model.states, names)
    K, P = K * e[:, None] / d, P * tau / (rho * d * d[:, None])
    return K, P, np.linalg.eigvals(A1 - B1 @ (K * d / e[:, None])) / tau


def _scales(A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Units of the states d (n,) and inputs e (m,), of time and of cost in which the entries are of order one.

    The scaled entries are tau A_ij d_j / d_i, tau B_ij e_j / d_i, rho Q_ij d_i d_j and rho R_ij e_i e_j. The logarithms
    of the nonzero ones have the least sum of absolute values, by reweighted least squares. In a sum of squares, entries
    that are rounding errors would outweigh the others.
    """
    n, m = B.shape
    of_state, of_input = np.eye(n + m + 2)[:n], np.eye(n + m + 2)[n : n + m]
    of_time, of_cost = np.eye(n + m + 2)[n + m :]
    rows, logs = [], []
    for W, left, right, common in (
        (A, -of_state, of_state, of_time),
        (B, -of_state, of_input, of_time),
        (Q, of_state, of_state, of_cost),
        (R, of_input, of_input, of_cost),
    ):
        for i, j in np.argwhere(W):
            rows.append(left[i] + right[j] + common)
            logs.append(-np.log(abs(W[i, j])))
    rows, logs = np.array(rows).reshape(-1, n + m + 2), np.array(logs)
    x = np.zeros(n + m + 2)
    for _ in range(20):
        weight = 1 / np.sqrt(np.maximum(1.0, np.abs(rows @ x - logs))) if x.any() else np.ones(len(logs))
        x = np.linalg.lstsq(rows * weight[:, None], logs * weight, rcond=1e-10)[0]
    x = np.exp2(np.round(x / np.log(2)))  # powers of two add no rounding
    return x[:n], x[n : n + m], float(x[-2]), float(x[-1])


def _riccati(A, B, Q, R, states: Sequence[str], inputs: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """P and K of the Riccati equation. The solution is checked, because SciPy returns wrong ones for bad scaling."""
    from scipy.linalg import solve_continuous_are

    wrong = f"lqr: the Riccati equation of {', '.join(states)} by {', '.join(inputs)} was not solved"
    remedy = "Check the weights Q and R and the eigenvalues of the model; or omit states that need no regulator."
    try:
        P = solve_continuous_are(A, B, Q, R)
    except np.linalg.LinAlgError as error:
        raise ValueError(f"{wrong}: {error} {remedy}") from None
    K = np.linalg.solve(R, B.T @ P)
    terms = np.abs(A.T) @ np.abs(P) + np.abs(P) @ np.abs(A) + np.abs(K.T) @ np.abs(R) @ np.abs(K) + np.abs(Q)
    size = np.sqrt(np.diag(terms))
    size = np.where(size > 0, size, 1.0)
    residual = float(np.abs((A.T @ P + P @ A - K.T @ R @ K + Q) / size / size[:, None]).max())
    growth = float(np.real(np.linalg.eigvals(A - B @ K)).max())
    if not (residual < 1e-6 and growth < 0.0):
        cause = f"the residual is {residual:.3g} of its terms" if growth < 0.0 else "the regulated model does not decay"
        raise ValueError(f"{wrong}: {cause}. {remedy}")
    return P, K


def to_control(model: LinearModel) -> Any:
    """The model as a `control.StateSpace` of python-control, with its names. Needs the extra `control`.

    G = control.tf(to_control(model)["roll", "steer_torque"])
    control.frequency_response(to_control(model)["roll", "steer_torque"], omega)
    """
    try:
        import control  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ImportError('to_control needs python-control: pip install "jaxkane[control]".') from None
    names = {"states": list(model.states), "inputs": list(model.inputs), "outputs": list(model.outputs)}
    return control.StateSpace(*map(np.asarray, model), **names)


def _weights(W: Any, n: int, name: str, what: str) -> np.ndarray:
    W = np.asarray(W, dtype=float)
    W = np.diag(np.broadcast_to(W, (n,))) if W.ndim == 0 or W.shape == (n,) else W
    if W.shape != (n, n) or not np.all(np.isfinite(W)):
        raise ValueError(
            f"lqr: {name} must be ({n}, {n}), or ({n},) for a diagonal: one finite weight for each of the {what}."
        )
    return W
