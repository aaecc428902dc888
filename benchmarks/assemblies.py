"""Bicycles with parts: what a state of the right-hand side costs, and what an operation, beside the Whipple bicycle."""

from __future__ import annotations

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

import jaxkane as jk
from jaxkane._method.now import _packed_rates, packed_rates
from jaxkane.bicycles import Bicycle, LateralSlip, LeaningRider, SteeringMotor, Tyre, separate_rider

from ._figures import Figure
from ._process import Setting
from ._timing import in_turns

N = 4096
SPEED = 5.0  # [m/s]


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
        "the Whipple bicycle": jk.catalog.WhippleBicycle.benchmark(),
        "a bicycle without parts": plain,
        "a leaning rider": leaning,
        "tyres that slip": slipping,
        "rider, tyres and motor": full,
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
    """Scalar operations of the right-hand side, as they are traced."""
    inputs = dict.fromkeys(bicycle.inputs, jnp.zeros(()))
    leaves, structure = jax.tree.flatten((bicycle, jnp.zeros(()), y, inputs))
    plain = _packed_rates.__wrapped__
    return len(jax.make_jaxpr(lambda *x: plain(*jax.tree.unflatten(structure, x)))(*leaves).jaxpr.eqns)


def measure(setting: Setting) -> Iterator[Figure]:
    rivals, counted, n = {}, {}, 64 if setting.quick else N
    for name, bicycle in assemblies().items():
        y = states(bicycle, n)
        inputs = dict.fromkeys(bicycle.inputs, jnp.zeros(()))
        of_all = jax.jit(jax.vmap(lambda y, b=bicycle, w=inputs: packed_rates(b, jnp.zeros(()), y, w)))
        assert np.isfinite(np.asarray(of_all(y))).all(), name
        rivals[name] = lambda of_all=of_all, y=y: of_all(y).block_until_ready()
        counted[name] = operations(bicycle, y[0])
    best = in_turns(rivals, 0.1 if setting.quick else 5.0)
    for name, seconds in best.items():
        yield Figure("assemblies", f"a state, {name}", 1e9 * seconds / n, "ns", setting.column)
        yield Figure("assemblies", f"operations, {name}", counted[name], "", setting.column)
    whipple, *_, full = ((best[name] / counted[name], name) for name in best)
    what = "rider, tyres and motor: time of an operation against the Whipple bicycle's"
    yield Figure("assemblies", what, full[0] / whipple[0], column=setting.column, at_most=1.1)
