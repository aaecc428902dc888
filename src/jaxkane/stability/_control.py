"""Linear models with scipy and python-control: regulators, and frequency responses of measurements and models."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from .._common.lookup import as_names, counted, refuse_unknown
from .._scalarjit.components import Numbers
from ._linearize import LinearModel


def lqr(
    model: LinearModel, Q: Numbers, R: Numbers, inputs: Sequence[str] | None = None
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
    # Units of the states d (n,) and inputs e (m,), of time and of cost in which the entries are of order one.
    #
    # The scaled entries are tau A_ij d_j / d_i, tau B_ij e_j / d_i, rho Q_ij d_i d_j and rho R_ij e_i e_j. The
    # logarithms of the nonzero ones have the least sum of absolute values, by reweighted least squares. In a sum of
    # squares, entries that are rounding errors would outweigh the others.
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


def _riccati(
    A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray, states: Sequence[str], inputs: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    # P and K of the Riccati equation. The solution is checked, because SciPy returns wrong ones for bad scaling.
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


def _weights(W: Numbers, n: int, name: str, what: str) -> np.ndarray:
    W = np.asarray(W, dtype=float)
    W = np.diag(np.broadcast_to(W, (n,))) if W.ndim == 0 or W.shape == (n,) else W
    if W.shape != (n, n) or not np.all(np.isfinite(W)):
        raise ValueError(
            f"lqr: {name} must be ({n}, {n}), or ({n},) for a diagonal: one finite weight for each of the {what}."
        )
    return W


class Record(Protocol):
    """The attributes of a `jaxkane.fit.Trial` that are used here."""

    name: str
    t: np.ndarray
    measured: Mapping[str, np.ndarray]
    inputs: Mapping[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class FrequencyResponse:
    """A measured frequency response and that of a linear model, from `input` to `output`.

    - `frequencies` (m,) [rad/s].
    - `measured`, `model` (m,): complex, in the unit of the output divided by that of the input.
    - `coherence` (m,): the share of the output's power that is linear in this input, between 0 and 1.
    - `relative_error` (m,): the standard deviation of |measured| / |response|, due to the incoherent part.
    - `averages`: the number of segments.
    """

    input: str
    output: str
    frequencies: np.ndarray
    measured: np.ndarray
    model: np.ndarray
    coherence: np.ndarray
    relative_error: np.ndarray
    averages: int

    def __repr__(self) -> str:
        low, high = self.frequencies[[0, -1]]
        return (
            f"FrequencyResponse({self.input} to {self.output}, {len(self.frequencies)} frequencies from {low:.3g} to "
            f"{high:.3g} rad/s, {self.averages} segments, median coherence {np.median(self.coherence):.2f})"
        )


def frequency_response(
    model: LinearModel, trials: Sequence[Record] | Record, input: str, output: str, *, segment: float | None = None
) -> FrequencyResponse:
    """The frequency response of trials with its coherence, and that of a linear model.

        G = S_wy / S_ww,   coherence = |S_wy|^2 / (S_ww S_yy),   model: C (i omega - A)^-1 B + D

    The spectra are averages over half-overlapping segments of all trials with a Hann window (Welch 1967). The error of
    |G| is ((1 - coherence) / (2 n coherence))^1/2 with n independent segments (Bendat and Piersol, Random Data, ch. 9).

        model = jk.stability.linearize(system, equilibrium)
        jk.plot.frequency_response(jk.stability.frequency_response(model, trials, "torque", "angle"))

    **Arguments:**

    - `model`: the linear model about the motion from which the trials deviate.
    - `trials`: `jaxkane.fit.Trial`, one or several. Irregular samples are interpolated to the median interval.
    - `input`, `output`: names that exist in the model and in the trials.
    - `segment`: the length of a segment [s]. Default: an eighth of all trials, at most the shortest one. The lowest
        frequency is 2 pi / segment.

    The estimate is valid for one input: the other inputs must be zero or uncorrelated with it. If the input is computed
    from the output (a controller, a rider), the estimate is biased toward the inverse of the controller, whatever the
    coherence is.

    **Raises:** `ValueError` for an unknown name, a channel with gaps, an input without power, and fewer than two
    segments. With one segment the coherence is one for any data.
    """
    from scipy.signal import csd  # imports all of scipy.stats

    i, o = place(model.inputs, input, "input"), place(model.outputs, output, "output")
    every = list(trials) if isinstance(trials, Sequence) else [trials]
    records = [_even(trial, input, output) for trial in every]
    dt = float(np.median([step for step, _, _ in records]))
    records = [(w, y) if step == dt else _resampled(step, dt, w, y) for step, w, y in records]
    lengths = [len(w) for w, _ in records]
    n = min(*lengths, sum(lengths) // 8) if segment is None else round(segment / dt)
    n = n - n % 2
    if n < 8 or n > max(lengths):
        raise ValueError(
            f"frequency_response: a segment of {n} samples of {dt:.3g} s must have at least 8 samples and fit into a "
            f"trial. The longest trial has {max(lengths)}. Choose another `segment` [s]."
        )
    averages, S = 0, np.zeros((3, n // 2 + 1), complex)
    for w, y in records:
        count = (len(w) - n) // (n // 2) + 1  # segments of n samples, each shifted by n / 2
        if count > 0:
            spectra = [csd(a, b, 1 / dt, "hann", n, n // 2, detrend="constant")[1] for a, b in ((w, w), (w, y), (y, y))]
            S += count * np.array(spectra)
            averages += count
    if averages < 2:
        raise ValueError(
            f"frequency_response: the trials contain {counted(averages, 'segment')} of {n * dt:.3g} s; at least two "
            "are needed. Pass longer trials or a shorter `segment` [s]."
        )
    ww, wy, yy = S[:, 1:-1]  # without the mean, and without half the sampling frequency
    if not np.all(ww.real > 1e-20 * ww.real.max()):
        raise ValueError(f"frequency_response: the input {input} has no power at some frequencies. Choose another one.")
    coherence = np.clip(np.abs(wy) ** 2 / (ww.real * np.maximum(yy.real, np.finfo(float).tiny)), 0.0, 1.0)
    independent = averages / (1 + (averages > 1) / 18)  # half-overlapping Hann windows correlate by 1/6
    with np.errstate(divide="ignore"):
        error = np.sqrt((1 - coherence) / (2 * independent * coherence))
    omega = 2 * np.pi * np.arange(1, n // 2) / (n * dt)
    A, B, C, D = (np.asarray(x) for x in model)
    x = np.linalg.solve(1j * omega[:, None, None] * np.eye(len(A)) - A, B[None, :, [i]].astype(complex))
    of_model = (C[[o]] @ x)[:, 0, 0] + D[o, i]
    return FrequencyResponse(input, output, omega, wy / ww.real, of_model, coherence, error, averages)


def _even(trial: Record, input: str, output: str) -> tuple[float, np.ndarray, np.ndarray]:
    """The median interval [s], and input and output at equidistant times."""
    t, steps = trial.t, np.diff(trial.t)
    w = trial.inputs[input] if input in trial.inputs else np.zeros_like(t)
    refuse_unknown([output], trial.measured, f"{trial.name} has no channel", "the channels are")
    y = trial.measured[output]
    if not np.all(np.isfinite(y)):
        raise ValueError(f"{trial.name}: {output} has gaps. Cut them out with `Trial.between`.")
    dt = float(np.median(steps))
    if np.ptp(steps) > 1e-6 * dt:
        even = np.arange(t[0], t[-1] + 0.5 * dt, dt)
        w, y = np.interp(even, t, w), np.interp(even, t, y)
    return dt, w, y


def _resampled(step: float, dt: float, *signals: np.ndarray) -> tuple[np.ndarray, ...]:
    t = step * np.arange(len(signals[0]))
    even = np.arange(0.0, t[-1] + 0.5 * dt, dt)
    return tuple(np.interp(even, t, x) for x in signals)


def place(names: Sequence[str], name: str, what: str) -> int:
    """The index of a name. **Raises:** `ValueError` for an unknown name."""
    refuse_unknown([name], names, f"The model has no {what}", "it has")
    return list(names).index(name)
