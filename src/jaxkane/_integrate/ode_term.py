"""The equations of a system as a term for `diffrax.diffeqsolve`."""

from __future__ import annotations

from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np

from .._kane.arguments import check_is_system
from .._kane.right_hand_side import vector_field
from .._scalarjit.components import Inputs
from .._system.system import State, System, packed, unpacked
from .inputs import as_signals, inputs_at


def ode_term(system: System, inputs: Inputs = None) -> tuple[diffrax.ODETerm, Any]:
    """The equations of motion as a term of diffrax, and the arguments to pass with it.

        term, args = jk.ode_term(system, {"push": 1.0})
        solution = diffrax.diffeqsolve(term, diffrax.Tsit5(), 0.0, 1.0, 0.01, state, args)
        solution.ys.q  # (1, n_q)

    The solution is a `State`. The system and the state are not checked. Steps do not end at discontinuities or events.
    Pass `stepsize_controller=diffrax.ClipStepSizeController(...)` and `event=diffrax.Event(...)`, or use `simulate`.

    **Arguments:**

    - `system`: a `System`.
    - `inputs`: a dict with a number, `Samples` or a function (t, state) -> number for each input; or one function
        (t, state) -> dict.

    **Returns:**

    - a `diffrax.ODETerm` of (t, y, args), in which y is a `State` with arrays, as from `assemble`.
    - args: the system and its inputs. Solutions can be differentiated with respect to them.

    **Raises:** `ValueError` for an unknown input, or for an array of samples without times.
    """
    check_is_system(system)
    no_times: Any = np.zeros(0)
    signals = as_signals(inputs, system.inputs, no_times, type(system).__name__)

    def rates(t: Any, y: State, args: Any) -> State:
        system, signals = args
        t = jnp.asarray(t, y.q.dtype)
        return unpacked(system, vector_field(system, t, packed(y), inputs_at(system, signals, t, y)))

    return diffrax.ODETerm(rates), (system, signals)  # pyright: ignore[reportArgumentType]
