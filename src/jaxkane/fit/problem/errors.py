"""Models of measurement errors: autoregressive, Student's t and Huber's. They do not depend on a system."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln
from jax.scipy.stats import norm
from jaxtyping import Array, Bool, Float, PyTree

from ..._common.lookup import positive_number, real_number, refuse_unknown
from ..._scalarjit.cache_key import jit
from ..._scalarjit.compat import on_device
from .trial import Trial
from .windows import Windows

LOG_2PI = 1.8378770664093453
LARGEST_PARTIAL_AUTOCORRELATION, MOST_DEGREES_OF_FREEDOM = 1 - 1e-5, 1e4
"""Upper bounds in the search for the parameters of an error model. A t distribution with 1e4 degrees of freedom is
practically normal."""
NORMAL = 1e12
"""Degrees of freedom, or a threshold, with which residuals of any size are treated as normal. With 1e4 degrees of
freedom, the first fit took 50 or more steps if residuals were 1e4 times `sigma`."""


class Numbers(eqx.Module):
    """The parameters of an error model, or, with a leading axis (n_c,), those of all channels.

    - `phi`: coefficients (2,) of the autoregression.
    - `scale`: the standard deviation or scale of the innovations, in units of `Trial.sigma`.
    - `shape`: degrees of freedom, or Huber's threshold in units of `scale`.
    - `slope`: square root of the Fisher information about u = residual / scale in one residual; 1 for normal errors.
    """

    phi: Float[Array, "*n_c 2"]
    scale: Float[Array, "*n_c"]
    shape: Float[Array, "*n_c"]
    slope: Float[Array, "*n_c"]


@functools.partial(jax.jit, static_argnums=0)
def _mean_cost(model: AutoRegressive | StudentT, theta: Array, smallest: Array, e: Array, seen: Array) -> Any:
    """Minus twice the log likelihood per sample of all windows (W, n_t), its gradient and Hessian, and the
    `Numbers`."""

    def cost(theta: Array):
        numbers = model.numbers(theta, smallest)
        losses = jax.vmap(lambda e, seen: model.whitened(numbers, e, seen)[2])(e, seen)
        return jnp.sum(jnp.where(seen, losses, 0.0)) / jnp.sum(seen, dtype=e.dtype)

    gradient = jax.jacfwd(cost)
    return cost(theta), gradient(theta), jax.jacfwd(gradient)(theta), model.numbers(theta, smallest)


def _most_likely(
    model: AutoRegressive | StudentT, theta: list[Any], e: np.ndarray, seen: np.ndarray, smallest: float
) -> Numbers:
    """Maximize the likelihood by Newton's method with steps of length 1 or less, from `theta`.

    SciPy's minimizers are not used: they compare values, so rounding hides the last steps, and they need several times
    as many evaluations.
    """
    x, data = np.array(theta), (on_device(smallest, e.dtype), on_device(e), on_device(seen))

    def evaluate(theta: np.ndarray):
        return jax.device_get(_mean_cost(model, on_device(theta, e.dtype), *data))

    value, gradient, hessian, numbers = evaluate(x)
    for _ in range(100):
        curvatures, V = np.linalg.eigh(hessian.astype(float))
        step = -V @ (V.T @ gradient / np.maximum(np.abs(curvatures), 1e-5))
        step /= max(1.0, float(np.linalg.norm(step)))
        tried = evaluate(x + step)
        while not tried[0] <= value + 1e-12 * (1 + abs(value)) and np.abs(step).max() > 1e-6:
            step /= 4
            tried = evaluate(x + step)
        x, (value, gradient, hessian, numbers) = x + step, tried
        if np.abs(step).max() <= 1e-9:
            break
    return numbers


def _robust(u: Array, psi: Array, slope: Array) -> Array:
    """Least-squares residuals r = psi / slope with the derivative `slope`.

    J^T r is then the gradient of the loss, and J^T J is the expected information. Do not use the derivative psi'
    instead: it is zero or negative for outliers.
    """
    return slope * u + jax.lax.stop_gradient(psi / slope - slope * u)


def _median_size(e: np.ndarray, smallest: float) -> float:
    """The standard deviation of normal errors with the same median of |e|."""
    return max(float(np.median(np.abs(e))) / 0.6744897501960817, smallest)


@dataclasses.dataclass(frozen=True)
class AutoRegressive:
    """Measurement errors that are correlated in time.

        e_t = phi_1 e_{t-1} + phi_2 e_{t-2} + innovation

    The likelihood is exact: the process is stationary, and missing samples (NaN) are integrated out by a Kalman filter
    (Jones, Technometrics 22, 1980). Each window starts with the stationary variance, independently of the one before.

    **Arguments:**

    - `order`: 1 or 2. Order 0 is white noise.

    **Raises:** `ValueError` for another order.
    """

    order: int = 1

    def __post_init__(self) -> None:
        if self.order not in (0, 1, 2):
            raise ValueError(f"AutoRegressive: `order` is {self.order!r}. Pass order=1 or order=2.")

    def __str__(self) -> str:
        return f"AR({self.order})" if self.order else "white noise"

    @property
    def n_estimated(self) -> int:
        return 1 + int(self.order)

    def whitened(self, n: Numbers, e: Array, seen: Array) -> tuple[Array, Array, Array]:
        u, log_variance = e / n.scale, jnp.zeros_like(e)
        if self.order:
            u, log_variance = innovations(n.phi, u, seen)
        return u, u, u**2 + log_variance + LOG_2PI + 2.0 * jnp.log(n.scale)

    def numbers(self, theta: Array, smallest: Array) -> Numbers:
        scale, one = jnp.sqrt(jnp.exp(2.0 * theta[0]) + smallest**2), jnp.ones((), theta.dtype)
        # Durbin and Levinson: partial autocorrelations with magnitudes below one always give a stationary process.
        pacf = LARGEST_PARTIAL_AUTOCORRELATION * jnp.tanh(theta[1:])
        pacf = jnp.concatenate([pacf, jnp.zeros(2 - self.order, theta.dtype)])
        return Numbers(jnp.stack([pacf[0] * (1.0 - pacf[1]), pacf[1]]), scale, one, one)

    def named(self, n: Numbers) -> dict[str, float]:
        return {"scale": float(n.scale), **{f"phi_{j + 1}": float(n.phi[j]) for j in range(self.order)}}

    def estimated(self, e: np.ndarray, seen: np.ndarray, smallest: float) -> Numbers:
        rms = max(float(np.sqrt(np.mean(np.asarray(e, float)[seen] ** 2))), smallest)
        if not self.order:
            return Numbers(np.zeros(2), rms, 1.0, 1.0)  # type: ignore[arg-type]
        both = seen[:, 1:] & seen[:, :-1]
        r = np.clip(np.sum(e[:, 1:] * e[:, :-1], where=both) / max(both.sum(), 1) / rms**2, -0.99, 0.99)
        theta = [np.log(rms * np.sqrt(1 - r**2)), np.arctanh(r), 0.0][: 1 + self.order]
        return _most_likely(self, theta, e, seen, smallest)


@dataclasses.dataclass(frozen=True)
class StudentT:
    """Measurement errors with heavy tails: Student's t distribution (Lange, Little and Taylor, JASA 84, 1989).

    **Arguments:**

    - `degrees_of_freedom`: a number of at least 1; by default (None) it is estimated.

    **Raises:** `ValueError` if the number is below 1 or not finite.
    """

    degrees_of_freedom: float | None = None

    def __post_init__(self) -> None:
        nu = self.degrees_of_freedom
        # Below 1, a few residuals of exactly zero make the likelihood infinite at scale zero.
        if nu is not None and not 1 <= real_number(nu, "StudentT: `degrees_of_freedom`") < np.inf:
            raise ValueError(f"StudentT: `degrees_of_freedom` is {nu!r}. Pass a finite number of at least 1.")

    def __str__(self) -> str:
        return "Student's t"

    @property
    def n_estimated(self) -> int:
        return 1 + (self.degrees_of_freedom is None)

    def whitened(self, n: Numbers, e: Array, seen: Array) -> tuple[Array, Array, Array]:
        u, nu = e / n.scale, n.shape
        log_norm = gammaln(0.5 * nu) - gammaln(0.5 * (nu + 1.0)) + 0.5 * jnp.log(jnp.pi * nu)
        # With 1e12 degrees of freedom, the difference of the two gammaln is lost in rounding, so use the normal limit.
        log_norm = jnp.where(nu < 10.0 * MOST_DEGREES_OF_FREEDOM, log_norm, 0.5 * LOG_2PI)
        loss = (nu + 1.0) * jnp.log1p(u**2 / nu) + 2.0 * (log_norm + jnp.log(n.scale))
        return u, _robust(u, (nu + 1.0) * u / (nu + u**2), n.slope), loss

    def numbers(self, theta: Array, smallest: Array) -> Numbers:
        given = self.degrees_of_freedom
        free = jnp.exp(math.log(MOST_DEGREES_OF_FREEDOM) * jax.nn.sigmoid(theta[-1]))
        nu = free if given is None else jnp.asarray(given, theta.dtype)
        scale = jnp.sqrt(jnp.exp(2.0 * theta[0]) + smallest**2)
        return Numbers(jnp.zeros(2, theta.dtype), scale, nu, jnp.sqrt((nu + 1.0) / (nu + 3.0)))

    def named(self, n: Numbers) -> dict[str, float]:
        return {"scale": float(n.scale), "degrees of freedom": float(n.shape)}

    def estimated(self, e: np.ndarray, seen: np.ndarray, smallest: float) -> Numbers:
        theta = [np.log(_median_size(np.asarray(e, float)[seen], smallest)), -1.7]  # four degrees of freedom
        return _most_likely(self, theta[: self.n_estimated], e, seen, smallest)


@dataclasses.dataclass(frozen=True)
class Huber:
    """Measurement errors with a few outliers: Huber's loss (Annals of Mathematical Statistics 35, 1964).

        loss = u^2 / 2 for |u| <= threshold, else threshold |u| - threshold^2 / 2,   u = residual / (scale sigma)

    The scale is the median of |residual / sigma|, divided by 0.6745. The covariance of the estimates is Huber's
    sandwich estimator.

    **Arguments:**

    - `threshold`: the threshold in units of the scale. With 1.345, the efficiency for normal errors is 95 %.

    **Raises:** `ValueError` if the threshold is not positive and finite.
    """

    threshold: float = 1.345
    n_estimated: ClassVar[int] = 1

    def __post_init__(self) -> None:
        positive_number(self.threshold, "Huber: `threshold`")

    def __str__(self) -> str:
        return f"Huber({self.threshold:g})"

    def whitened(self, n: Numbers, e: Array, seen: Array) -> tuple[Array, Array, Array]:
        u, c = e / n.scale, n.shape
        psi = jnp.clip(u, -c, c)
        log_norm = 0.5 * LOG_2PI + jnp.log(2.0 * norm.cdf(c) - 1.0 + 2.0 * norm.pdf(c) / c)
        return u, _robust(u, psi, n.slope), psi * (2.0 * u - psi) + 2.0 * (log_norm + jnp.log(n.scale))

    def named(self, n: Numbers) -> dict[str, float]:
        # A fit that was interrupted before the first estimate still has the normal limit `NORMAL` as its shape.
        return {"scale": float(n.scale) * (float(n.shape) / self.threshold if n.shape < 0.1 * NORMAL else 1.0)}

    def estimated(self, e: np.ndarray, seen: np.ndarray, smallest: float) -> Numbers:
        flat = np.asarray(e, float)[seen]
        median, c = _median_size(flat, smallest), self.threshold
        inside, square = np.mean(np.abs(flat) <= c * median), np.mean(np.clip(flat / median, -c, c) ** 2)
        # The loss is rescaled so that the mean square of its gradient equals the information. Channels are then
        # weighted by their information, and the covariance of the estimates is Huber's sandwich without a factor.
        root = np.sqrt(inside / square)
        return Numbers(np.zeros(2), median / root, c * root, np.sqrt(inside))  # type: ignore[arg-type]


WHITE = AutoRegressive(0)
ErrorModel = AutoRegressive | StudentT | Huber
"""The measurement errors of one channel.

- `whitened`: of residuals in units of `sigma`, each (n_t,): standardized innovations u, least-squares residuals r, and
    minus twice the log likelihood of each sample.
- `estimated`: the parameters from residuals (W, n_t); `smallest` is the smallest scale.
- `numbers`: the parameters from unconstrained variables, of which the first is for the scale.
- `named`: the parameters by name.
- `n_estimated`: the number of estimated parameters.
"""


class Errors(eqx.Module):
    """The error model of every channel. `numbers` is separate from `distributions`, so new values do not cause a
    recompilation."""

    distributions: tuple[ErrorModel, ...] = eqx.field(static=True)
    numbers: Numbers

    @classmethod
    def initial(cls, distributions: Sequence[ErrorModel]) -> Errors:
        """Independent normal errors with the given `sigma`, so that the first fit is ordinary least squares."""
        one = np.ones(len(distributions))
        numbers = Numbers(np.zeros((len(one), 2)), one, NORMAL * one, one)  # type: ignore[arg-type]
        return cls(tuple(distributions), jax.tree.map(lambda x: on_device(x, jnp.result_type(float)), numbers))

    def _by_channel(self) -> list[tuple[ErrorModel, Numbers]]:
        return [(d, jax.tree.map(lambda x, i=i: x[i], self.numbers)) for i, d in enumerate(self.distributions)]

    def whitened(self, difference: Array, weight: Array) -> tuple[Array, Array, Array]:
        """Whiten the residuals of one window.

        **Arguments:**

        - `difference`: (simulated - measured) / sigma (n_c, n_t), zero where `weight` is zero.
        - `weight`: 1 / sigma (n_c, n_t), zero where a sample is missing.

        **Returns:** standardized innovations (n_c, n_t), least-squares residuals r (n_c, n_t), and minus twice the log
        likelihood. J^T r is the gradient of half of it, and J^T J is the expected information.
        """
        seen = weight > 0
        parts = [d.whitened(n, difference[i], seen[i]) for i, (d, n) in enumerate(self._by_channel())]
        u, r, loss = (jnp.stack(rows) for rows in zip(*parts, strict=True))
        return u, r, jnp.sum(jnp.where(seen, loss - 2.0 * jnp.log(jnp.where(seen, weight, 1.0)), 0.0))

    def estimated(self, difference: np.ndarray, weight: np.ndarray, smallest: np.ndarray) -> Errors:
        """Estimate the parameters of the error models: by maximum likelihood, or Huber's scale from the median.

        **Arguments:**

        - `difference`: (simulated - measured) / sigma (W, n_c, n_t).
        - `weight`: 1 / sigma (W, n_c, n_t), zero where a sample is missing.
        - `smallest`: the smallest allowed scale of each channel (n_c,).
        """
        columns = [
            d.estimated(difference[:, i], weight[:, i] > 0, float(smallest[i])) if np.any(weight[:, i] > 0) else before
            for i, (d, before) in enumerate(self._by_channel())
        ]
        dtype = self.numbers.scale.dtype
        return Errors(self.distributions, jax.tree.map(lambda *xs: on_device(np.stack(xs), dtype), *columns))

    @property
    def n_estimated(self) -> int:
        """The number of estimated parameters: the scale of every channel, and coefficients or degrees of freedom."""
        return sum(d.n_estimated for d in self.distributions)

    @property
    def values(self) -> list[dict[str, float]]:
        """The parameters of every channel by name, with scales in units of `Trial.sigma`."""
        return [d.named(n) for d, n in self._by_channel()]

    def described(self, channels: Sequence[str]) -> str:
        parts = []
        for channel, d, values in zip(channels, self.distributions, self.values, strict=True):
            numbers = ", ".join(f"{name} {value:.4g}" for name, value in values.items())
            parts.append(f"{channel} {d} ({numbers})")
        return f"Errors, with scales in units of sigma: {'; '.join(parts)}"


@jit
def whitened(errors: Errors, windows: Windows, simulated: Array) -> Array:
    """Standardized innovations (W, n_c, n_t); NaN where a sample is missing."""

    def of_window(window: tuple[Array, Array, Array]):
        measured, weight, y = window
        u = errors.whitened(jnp.where(weight > 0, (y - measured) * weight, 0.0), weight)[0]
        return jnp.where(weight > 0, u, jnp.nan)

    return jax.vmap(of_window)((windows.measured, windows.weight, simulated))


def errors_of(
    errors: ErrorModel | Mapping[str, ErrorModel] | None, trials: Sequence[Trial], channels: Sequence[str]
) -> Errors | None:
    """The error models from the argument `errors` of a fit.

    **Raises:** `TypeError` if a value is not an error model; `ValueError` for an unknown channel, or for an
    autoregression of samples that are not equally spaced.
    """
    if errors is None:
        return None
    named: dict[str, Any] = dict(errors) if isinstance(errors, Mapping) else dict.fromkeys(channels, errors)
    refuse_unknown(named, channels, "`errors` contains unknown channels:", "the channels are")
    for name, d in named.items():
        if not isinstance(d, ErrorModel):
            raise TypeError(
                f"`errors` of {name} is {d!r}. Pass AutoRegressive(order=1), StudentT() or Huber(), for all channels "
                "or in a dict by channel."
            )
        own = [trial for trial in trials if name in trial.measured and isinstance(d, AutoRegressive) and d.order]
        interval = float(np.median(np.diff(own[0].t))) if own else 0.0
        for trial in own:
            wrong = np.abs(np.diff(trial.t) - interval) > 0.01 * interval
            i = int(np.argmax(wrong))
            if wrong[i]:
                raise ValueError(
                    f"{trial.name}: the samples at t = {trial.t[i]:.6g} s and {trial.t[i + 1]:.6g} s are not "
                    f"{interval:.6g} s apart. An autoregression of {name} needs equal intervals. Add rows of NaN where "
                    "samples are missing, or interpolate the channel."
                )
    return Errors.initial([named.get(channel, WHITE) for channel in channels])


def innovations(
    phi: Float[Array, " 2"], e: Float[Array, " n_t"], seen: Bool[Array, " n_t"]
) -> tuple[Float[Array, " n_t"], Float[Array, " n_t"]]:
    """Standardized innovations of a stationary autoregression, and the logarithm of their variance.

    The driving noise has variance one. The results are zero where a sample is not `seen`. Innovations are linear in e.
    """
    variance = (1.0 - phi[1]) / ((1.0 + phi[1]) * ((1.0 - phi[1]) ** 2 - phi[0] ** 2))
    covariance = phi[0] * variance / (1.0 - phi[1])
    one = jnp.ones((), e.dtype)

    def step(known: PyTree, now: tuple[Array, Array]) -> Any:
        (x, before), (p, q, s) = known  # predicted means of e_t and e_{t-1}; var e_t, covariance, var e_{t-1}
        y, there = now
        gain = jnp.where(there, q / p, 0.0)
        innovation = jnp.where(there, y - x, 0.0)
        out = innovation / jnp.sqrt(p), jnp.where(there, jnp.log(p), 0.0)
        # A measured e_t has exactly zero variance. Computing p - p^2 / p instead would leave a rounding error.
        x, before, s = jnp.where(there, y, x), before + gain * innovation, s - gain * q
        p, q = jnp.where(there, 0.0, p), jnp.where(there, 0.0, q)
        predicted = phi[0] ** 2 * p + 2.0 * phi[0] * phi[1] * q + phi[1] ** 2 * s + one
        return ((phi[0] * x + phi[1] * before, x), (predicted, phi[0] * p + phi[1] * q, p)), out

    zero = jnp.zeros_like(one)
    _, out = jax.lax.scan(step, ((zero, zero), (variance, covariance, variance)), (e, seen))
    return out
