"""The free numbers whose bodies are nearest to base parameters. Knows regressors and what a fit may move."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

from ..._description.system import System
from ..._scalars.versions import compiled
from .._problem.parameters import Parameters
from .._result.base_parameters import BaseParameters
from .columns import Chosen

_PULL = 1e-2  # of a free number towards its start, in standard deviations: decides what the data do not determine


def _values_at(chosen: Chosen, parameters: Parameters, x: Any) -> Any:
    return _values(chosen.of(parameters.apply(chosen.system, x)[0]))


def _values(chosen: Chosen) -> Any:
    return chosen.values(jnp.zeros(()), jnp.full(len(chosen.system.coordinates), 0.3))


_compiled_values = compiled(_values)


def column_values(chosen: Chosen, system: System) -> np.ndarray:
    return np.asarray(_compiled_values(chosen.of(system)))


def nearest(chosen: Chosen, parameters: Parameters, base: BaseParameters) -> tuple[np.ndarray, float]:
    """Free numbers (p,) whose base parameters are nearest to those that were found, and how far they are."""
    eigenvalues, V = np.linalg.eigh(base.information)
    root = np.sqrt(np.maximum(eigenvalues, 0.0))[:, None] * V.T
    if base.held is not None:
        # Held as firmly as the best determined number.
        hold = np.zeros(len(base.places))
        hold[base.held] = 10.0 * np.sqrt(max(eigenvalues.max(initial=0.0), 1e-300))
        root = np.vstack([root, hold])
    known = np.isfinite(np.asarray(parameters.prior_deviation))

    def residuals(x: Any) -> np.ndarray:
        columns, priors = look(x)[0]
        return np.concatenate([root @ (base.of(columns) - base.estimates), _PULL * x, priors[known]])

    def slopes(x: Any) -> np.ndarray:
        columns, priors = look(x)[1]
        return np.vstack([root @ base.matrix @ columns, _PULL * np.eye(len(x)), priors[known]])

    seen: dict[bytes, Any] = {}

    def look(x: Any) -> Any:
        if x.tobytes() not in seen:
            seen.clear()
            seen[x.tobytes()] = jax.device_get(
                values_with_slopes(chosen, parameters, jnp.asarray(x, parameters.start.dtype))
            )
        return seen[x.tobytes()]

    jac: Any = slopes
    found = least_squares(residuals, np.zeros(len(parameters.names)), jac, method="trf", x_scale=1.0, max_nfev=200)
    return found.x, float(np.linalg.norm(residuals(found.x)[: len(root)]))


@compiled
def values_with_slopes(chosen, parameters, x):
    """The values of the columns and the residuals of the priors, and how both change with the free numbers."""
    both = lambda x: (_values_at(chosen, parameters, x), parameters.prior_residuals(x))  # noqa: E731
    return both(x), jax.jacfwd(both)(x)
