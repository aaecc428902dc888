"""Bicycles assembled from parts, compared with the catalogue's bicycle and known limits."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane.bicycles import Bicycle, Drag, LongitudinalSlip, Part, Tyre
from jaxkane.catalog import CATALOG, WhippleBicycle
from jaxkane.stability import canonical, eigenvalues, straight_ahead

WHIPPLE = CATALOG["WhippleBicycle"]


def test_a_bicycle_without_parts_equals_the_catalogue_bicycle():
    """1e-13 asked; the operations are the same."""
    q, u = jnp.array(WHIPPLE.q), jnp.array(WHIPPLE.u)
    whipple, bicycle = WhippleBicycle.benchmark(), Bicycle.benchmark()
    np.testing.assert_allclose(
        jk.accelerations(bicycle, 0.0, q, u), jk.accelerations(whipple, 0.0, q, u), rtol=1e-13, atol=1e-13
    )


@pytest.mark.weekly
def test_tyre_crowns_change_only_the_gravity_stiffness_of_roll_and_steer():
    """K0 of the benchmark changes in roll by the normal loads times the crown radii, 94 kg * 0.02 m."""
    tyre = Tyre(crown=0.02)
    found = canonical(Bicycle.benchmark().with_parts(rear_tyre=tyre, front_tyre=tyre))
    known = canonical(WhippleBicycle.benchmark())
    for name in ("M", "C1", "K2"):
        np.testing.assert_allclose(getattr(found, name), getattr(known, name), atol=1e-12)
    np.testing.assert_allclose(found.K0[0, 0] - known.K0[0, 0], 94.0 * 0.02, atol=1e-12)


class Seat(Part):
    """A child on a spring, which the weight compresses."""

    mass: jk.Scalar = jk.parameter(18.0, positive=True, unit="kg")
    stiffness: jk.Scalar = jk.parameter(2e4, unit="N/m")

    coordinates = ("seat_drop",)
    speeds = ("seat_drop_rate",)

    def motion(self, bicycle, motion, t, q, u):
        B, place = motion["B"], bicycle.on_frame(motion, -0.1, 0.0, -0.95)
        center = place.moving(q["seat_drop"] * B.z, u["seat_drop_rate"] * B.z)
        return motion.extended([jk.Body(self.mass, 0.0, center, name="child")], points={"seat": place})

    def loads(self, bicycle, t, q, u, motion, values):
        force = -self.stiffness * q["seat_drop"] * motion["B"].z
        return [jk.Force(force, motion["child"]), jk.Force(-force, motion["seat"])]

    def lateral(self):
        return ()


@pytest.mark.weekly
def test_straight_riding_balances_drag_and_seat_deflection():
    """1e-7, the smoothing of the drag at rest: density / 2 area v^2 rR, and weight over stiffness."""
    bicycle = Bicycle.benchmark().with_parts(drive=Drag(area=0.6), extra=[Seat()])
    motion = straight_ahead(bicycle, 5.0)
    np.testing.assert_allclose(motion["drive_torque"], -0.5 * 1.2 * 0.6 * 25.0 * bicycle.rR, rtol=1e-7)
    np.testing.assert_allclose(motion["seat_drop"], 18.0 * bicycle.g / 2e4, rtol=1e-12)


@pytest.mark.weekly
@pytest.mark.parametrize("slipping", [False, True])
def test_rolling_resistance_is_equivalent_to_shifted_normal_forces(slipping):
    """1e-9: eigenvalues with it are those with the moment of the normal forces about the contacts."""
    law = LongitudinalSlip(2e4, relaxation_length=0.1) if slipping else None
    resisting = Tyre(longitudinal=law, rolling_resistance=0.01)
    plain = Bicycle.benchmark().with_parts(rear_tyre=Tyre(longitudinal=law), front_tyre=Tyre(longitudinal=law))
    speeds = jnp.array([4.0, 5.0])
    found = eigenvalues(plain.with_parts(rear_tyre=resisting, front_tyre=resisting), speeds)
    known = eigenvalues(plain.with_parts(extra=[Ahead()]), speeds)
    assert found.modes == ("weave", "weave", "capsize", "castering")
    np.testing.assert_allclose(found.eigenvalues, known.eigenvalues, rtol=1e-9)


class Ahead(Part):
    """Normal forces that act ahead of the contacts."""

    share: jk.Scalar = jk.parameter(0.01)  # of the wheels' radii
    resists = True

    def loads(self, bicycle, t, q, u, motion, values):
        carried, found = bicycle.tyre_loads(motion), []
        for end, contact, radius in (("rear", motion.rear, bicycle.rR), ("front", motion.front, bicycle.rF)):
            moment = (self.share * radius * contact.heading).cross(-carried[end] * contact.normal)
            found.append(jk.Torque(moment, motion[f"{end} wheel"]))
        return found
