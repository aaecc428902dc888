"""Bicycles put together from parts: against the catalogue's bicycle and known limits."""

import jax.numpy as jnp
import numpy as np

import jaxkane as jk
from jaxkane.bicycles import Bicycle, Tyre
from jaxkane.catalog import CATALOG, WhippleBicycle
from jaxkane.stability import canonical

WHIPPLE = CATALOG["WhippleBicycle"]


def test_without_parts_it_is_the_bicycle_of_the_catalogue():
    """1e-13 asked; the operations are the same."""
    q, u = jnp.array(WHIPPLE.q), jnp.array(WHIPPLE.u)
    whipple, bicycle = WhippleBicycle.benchmark(), Bicycle.benchmark()
    np.testing.assert_allclose(
        jk.accelerations(bicycle, 0.0, q, u), jk.accelerations(whipple, 0.0, q, u), rtol=1e-13, atol=1e-13
    )


def test_crowns_change_only_what_gravity_does_in_roll_and_steer():
    """K0 of the benchmark changes in roll by the normal loads times the crown radii, 94 kg * 0.02 m."""
    tyre = Tyre(crown=0.02)
    found = canonical(Bicycle.benchmark().with_parts(rear_tyre=tyre, front_tyre=tyre))
    known = canonical(WhippleBicycle.benchmark())
    for name in ("M", "C1", "K2"):
        np.testing.assert_allclose(getattr(found, name), getattr(known, name), atol=1e-12)
    np.testing.assert_allclose(found.K0[0, 0] - known.K0[0, 0], 94.0 * 0.02, atol=1e-12)
