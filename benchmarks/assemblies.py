"""Bicycles with parts: what a state of the right-hand side costs, and what an operation, beside the Whipple bicycle."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxkane as jk
from jaxkane._kane.right_hand_side import _vector_field, vector_field
from jaxkane.bicycles import Bicycle, LateralSlip, LeaningRider, SteeringMotor, Tyre, separate_rider

from ._bicycle import agree
from ._figures import Figure
from ._peers import here
from ._process import Setting
from ._timing import in_turns

N = 4096
SPEED = 5.0  # [m/s]
WHIPPLE, FULL, SYMPY = "the Whipple bicycle", "rider, tyres and motor", "the same, SymPy's C"


def assemblies() -> dict[str, jk.System]:
    """By name; the last has a leaning rider, tyres that slip with relaxation, and a geared motor that lags."""
    rider = LeaningRider(
        mass=48.8, x=0.3, z=-1.1, Ixx=2.04, Iyy=2.5, Izz=1.1, Ixz=1.0, hinge_x=0.2, hinge_z=-0.85,
        stiffness=250.0, damping=30.0,
    )  # fmt: skip
    laws = (LateralSlip(c, k, 0.1) for c, k in ((4000.0, 340.0), (6500.0, 570.0)))
    front, rear = (Tyre(lateral=law) for law in laws)
    motor = SteeringMotor(lag=0.02, limit=20.0, rotor_inertia=1e-4, ratio=5.0)
    plain = Bicycle.benchmark()
    leaning = separate_rider(plain, rider)
    slipping = plain.with_parts(front_tyre=front, rear_tyre=rear)
    full = leaning.with_parts(front_tyre=front, rear_tyre=rear, steering=motor)
    return {
        WHIPPLE: jk.catalog.WhippleBicycle.benchmark(),
        "a bicycle without parts": plain,
        "a leaning rider": leaning,
        "tyres that slip": slipping,
        FULL: full,
    }


def states(bicycle: jk.System, n: int) -> jnp.ndarray:
    """(n, n_y): coordinates, speeds and states of n bicycles that lean and steer at random, as a solver packs them."""
    rng = np.random.default_rng(1)
    q, u, x = (np.zeros((n, len(names))) for names in (bicycle.coordinates, bicycle.speeds, bicycle.states))
    for name in ("roll", "steer"):
        q[:, bicycle.coordinates.index(name)] = rng.uniform(-0.3, 0.3, n)
    u += rng.normal(0.0, 0.1, u.shape)
    u[:, bicycle.speeds.index("rear_wheel_rate")] = -SPEED / float(bicycle.rR)
    x += rng.normal(0.0, 1e-3, x.shape)
    return jnp.asarray(np.concatenate([q, u, x], axis=-1))


def operations(bicycle: jk.System, y: jnp.ndarray) -> int:
    """Scalar operations of the right-hand side, with every common subexpression once."""
    _, program = _vector_field.program(bicycle, jnp.zeros(()), y, dict.fromkeys(bicycle.inputs, jnp.zeros(())))
    assert program is not None
    return len(program.program.jaxpr.eqns)


def in_c(setting: Setting, bicycle: jk.System, y: jnp.ndarray) -> tuple[Callable[[], Any], int] | None:
    """SymPy's equations of the same bicycle as C, in a loop over the states `y`, and the number of its operations.

    None where SymPy or a C compiler is missing, and in a quick run: the derivation takes half a minute.
    """
    if setting.quick or not here("SymPy + C"):
        return None
    from .bicycle_in_c import build
    from .bicycle_in_sympy import PARAMETERS
    from .parts_in_sympy import MORE, derive

    n_q, n_y = len(bicycle.coordinates), len(bicycle.coordinates) + len(bicycle.speeds)
    q, u, x = np.split(np.asarray(y), (n_q, n_y), axis=1)
    dependent = jax.jit(jax.vmap(lambda q, u: jk.dependent_speeds(bicycle, 0.0, q, u)))
    # our order of speeds ends with the slips and the rider, and has the dependent ones behind them
    speeds = (
        "roll_rate",
        "rear_wheel_rate",
        "steer_rate",
        "rear_lateral_slip",
        "front_lateral_slip",
        "rider_lean_rate",
    )
    assert bicycle.speeds == speeds, bicycle.speeds
    assert bicycle.states == ("rear_lateral_deflection", "front_lateral_deflection", "steer_motor_torque")
    together = np.ascontiguousarray(np.concatenate([q, u, dependent(q, u), x], axis=1))
    named = [*PARAMETERS, *MORE.values()]
    p = np.array([float(functools.reduce(getattr, name.split("."), bicycle)) for name in named])
    built, dy = build(derive(), Path(setting.folder) / "generated" / "parts"), np.empty_like(together)
    built.module.batch(p, together, dy)
    found = np.concatenate([dy[:, :n_y], dy[:, -x.shape[1] :]], axis=1)
    inputs = dict.fromkeys(bicycle.inputs, jnp.zeros(()))
    known = jax.jit(jax.vmap(lambda y: vector_field(bicycle, jnp.zeros(()), y, inputs)))(y)
    agree("SymPy + C", found, known, 1e-9)
    return lambda: built.module.batch(p, together, dy), built.operations


def measure(setting: Setting) -> Iterator[Figure]:
    rivals, counted, n = {}, {}, 64 if setting.quick else N
    for name, bicycle in assemblies().items():
        y = states(bicycle, n)
        inputs = dict.fromkeys(bicycle.inputs, jnp.zeros(()))
        of_all = jax.jit(jax.vmap(lambda y, b=bicycle, w=inputs: vector_field(b, jnp.zeros(()), y, w)))
        assert np.isfinite(np.asarray(of_all(y))).all(), name
        rivals[name] = lambda of_all=of_all, y=y: of_all(y).block_until_ready()
        counted[name] = operations(bicycle, y[0])
    peer = in_c(setting, bicycle, y)  # of the last, with all parts
    if peer:
        rivals[SYMPY], counted[SYMPY] = peer
    best = in_turns(rivals, 0.1 if setting.quick else 5.0)
    for name, seconds in best.items():
        yield Figure("assemblies", f"a state, {name}", 1e9 * seconds / n, "ns", setting.column)
        yield Figure("assemblies", f"operations, {name}", counted[name], "", setting.column)
    an_operation = {name: best[name] / counted[name] for name in best}
    what = "all parts, time of an operation against the Whipple bicycle's"
    yield Figure("assemblies", what, an_operation[FULL] / an_operation[WHIPPLE], column=setting.column, at_most=1.1)
    if peer:
        what = "all parts, time against SymPy's C, scalar loop"
        yield Figure("assemblies", what, best[FULL] / best[SYMPY], column=setting.column, at_most=0.3)
