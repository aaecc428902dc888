"""How a fit simulates: what a user chooses, and the settings that follow. Knows `simulate`'s options."""

from __future__ import annotations

import dataclasses
from typing import Any

import diffrax

from ..._common.real_numbers import real_number
from ..._simulation.settings import Settings, settings_for


@dataclasses.dataclass(frozen=True)
class Simulation:
    """How the motions of a fit are integrated.

        fit(system, trials, free, simulation=Simulation(step=0.01))

    By default, where inputs vary, one step of Bosh3 between neighbouring samples, halved until that changes what is
    simulated by less than a share of the noise, at the initial guess and again where the fit ended (`Fit.step_error`
    says what is left); elsewhere Tsit5 with a tolerance of 1e-6.

    **Arguments:**

    - `rtol`, `atol`: tolerances that the steps follow. `step` [s]: a fixed one, the same in all windows. Give
        tolerances or a step, not both.
    - `solver`: of diffrax. `max_steps`: of a window; by default as many as fixed steps take, and 4096 with tolerances.

    **Raises:** `ValueError` for numbers that are not positive and finite, and for a step beside tolerances.
    """

    rtol: float | None = None
    atol: float | None = None
    step: float | None = None
    solver: diffrax.AbstractSolver | None = None
    max_steps: int | None = None

    def __post_init__(self) -> None:
        for name in ("rtol", "atol", "step", "max_steps"):
            value = getattr(self, name)
            if value is not None and not 0 < real_number(value, f"`{name}`") < float("inf"):
                raise ValueError(f"`{name}` must be positive and finite, got {value}.")
        if self.step is not None and (self.rtol is not None or self.atol is not None):
            raise ValueError(
                "`step` fixes the step of integration, `rtol` and `atol` let it follow the error: give one."
            )

    def settings(self, t: Any, varying: bool) -> Settings:
        """For windows of the times t (n_t,), whose inputs vary or not. Each window has its own step, if it is fixed."""
        free = self.step is None and self.rtol is None and self.atol is None
        fixed = self.step is not None or (free and varying)
        solver = diffrax.Bosh3() if fixed else diffrax.Tsit5()
        return settings_for(
            t,
            rtol=None if fixed else 1e-6 if self.rtol is None else self.rtol,
            atol=self.atol,
            solver=solver if self.solver is None else self.solver,
            step=1.0 if fixed else None,
            adjoint="forward",
            # A fixed step is taken as often as it fits into the time.
            max_steps=self.max_steps if self.max_steps is not None or fixed else 4096,
        )
