"""Contacts with other options: batches, sweeps, reverse mode, other solvers, float32; and what is refused."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import BouncingBall

import jaxkane as jk

TS = jnp.linspace(0.0, 3.0, 21)
TIGHT = {"rtol": 1e-12, "atol": 1e-12}
# A ball of 1 kg, 0.1 kg/m, e = 0.8, from 1 m: a closed form with 30 digits.
BOUNCES = [0.4590853109923369, 1.1280946846381106, 1.6405736265752897, 2.0400984767321484, 2.3546963595549943]
BOUNCES += [2.603903008180971, 2.802033708031122, 2.9599159114088045]
END = [0.016894590512326443, 0.22459525490753116]


def drop(height=1.0, restitution=0.8, drag=0.1, ts=TS, **options):
    h = jnp.asarray(height)
    numbers = {"mass": 1.0, "drag": drag, "restitution": restitution, "gravity": 9.81}
    system = BouncingBall(**{name: jnp.asarray(x, h.dtype) for name, x in numbers.items()})
    return jk.simulate(system, jk.State(h[None], jnp.zeros_like(h)[None]), ts, **{**TIGHT, **options})


@pytest.mark.weekly
def test_exceeding_max_jumps_ends_the_simulation():
    ride = drop(0.05, 0.985, 0.0, max_jumps=16)
    assert ride.reason == "max jumps"
    assert int(ride.jumps.count) == 16
    assert "max_jumps" in repr(ride)
    assert (ride.contacts["floor"][-1]) == -1


@pytest.mark.weekly
@pytest.mark.parametrize(
    ("options", "atol"),
    [
        ({}, 1e-10),
        ({"step": 0.005, "rtol": None, "atol": None}, 1e-6),
        ({"solver": diffrax.Kvaerno5(), "rtol": 1e-9, "atol": 1e-9}, 1e-6),
        ({"solver": diffrax.Dopri8()}, 1e-9),
    ],
    ids=["Tsit5", "fixed steps", "implicit", "Dopri8"],
)
def test_results_agree_for_other_solvers_and_options(options, atol):
    ride = drop(**options)
    assert ride.ok
    np.testing.assert_allclose(ride.jumps.t[:8], BOUNCES, atol=atol)
    np.testing.assert_allclose([ride.end.q[0], ride.end.u[0]], END, atol=100 * atol)
    rests = drop(0.2, 0.5, 0.0, **options)
    assert rests.ok
    np.testing.assert_allclose(rests.jumps.t[int(rests.jumps.count) - 1], 3 * np.sqrt(0.4 / 9.81), atol=10 * atol)
    np.testing.assert_allclose([rests.end.q, rests.end.u], 0.0, atol=1e-12)


class AnyContacts(jk.System):
    """A disc with the contacts that a function (motion, q, u) returns."""

    coordinates, speeds = ("x", "y", "angle"), ("vx", "vy", "w")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        B = N.rotate(3, q["angle"], u["w"], "B")
        C = O.moving(q["x"] * N.x + q["y"] * N.y, u["vx"] * N.x + u["vy"] * N.y)
        disc = jk.Body(1.0, (1.0, 1.0, 1.0), C, B, name="disc")
        return jk.Motion([disc], points={"C": C, "rim": C.fixed(-0.1 * N.y, B)})


def simulate_with(contacts, y=1.0, **speeds):
    kind = type("Disc", (AnyContacts,), {"contacts": lambda self, t, q, u, motion: contacts(motion, q, u)})
    return jk.simulate(kind(), jk.State({"y": y}, speeds), jnp.linspace(0.0, 1.0, 3))


BAD = {
    "not a dict": (lambda m, q, u: [jk.Contact(m["rim"], m.N.y)], "dict of contacts by name"),
    "not a contact": (lambda m, q, u: q["y"], "must be a jaxkane.Contact"),
    "no name": (lambda m, q, u: {1: jk.Contact(gap=q["y"])}, "must be a string"),
    "a point alone": (lambda m, q, u: jk.Contact(m["rim"]), "a point and a normal, or a gap"),
    "a surface alone": (lambda m, q, u: jk.Contact(gap=q["y"], surface=m["C"]), "surface"),
    "a boolean gap": (lambda m, q, u: jk.Contact(gap=q["y"] > 0), "gap"),
    "restitution": (lambda m, q, u: jk.Contact(gap=q["y"], restitution=1.5), "1.5"),
    "friction of a gap": (lambda m, q, u: jk.Contact(gap=q["y"], friction=0.1), "DryFriction"),
    "static friction": (lambda m, q, u: jk.Contact(m["rim"], m.N.y, friction=0.5, static=0.4), "smaller than the kin"),
    "negative dry friction": (lambda m, q, u: jk.DryFriction(u["vx"], -1.0), "negative"),
    "nine contacts": (lambda m, q, u: {str(i): jk.Contact(gap=q["y"] + i) for i in range(9)}, "At most 8 .*MuJoCo"),
    "gap against velocity": (lambda m, q, u: jk.Contact(m["rim"], m.N.y, gap=2.0 * q["y"]), "gap"),
    "a point beside the contact": (
        lambda m, q, u: jk.Contact(m["C"].fixed(0.1 * m.N.x, m["disc"].frame), m.N.y, gap=q["y"] - 0.1),
        "gap",
    ),
    "a gap of speeds": (lambda m, q, u: jk.Contact(gap=q["y"] + u["vy"]), "do not depend on the sp"),
    "a normal of speeds": (lambda m, q, u: jk.Contact(m["rim"], m.N.y + u["vx"] * m.N.x, gap=1.0), "'a'"),
    "a square slip": (lambda m, q, u: jk.DryFriction(u["vx"] ** 2, 1.0), "affine in the speeds"),
    "penetration": (lambda m, q, u: jk.Contact(gap=q["y"] - 2.0), "gap"),
}


@pytest.mark.parametrize("case", BAD)
def test_misuse_is_explained(case):
    contacts, message = BAD[case]

    def by_name(motion, q, u):
        found = contacts(motion, q, u)
        return found if isinstance(found, dict | list) else {"a": found}

    with pytest.raises((TypeError, ValueError), match=message):
        simulate_with(by_name)


class Particle(jk.System):
    """A point of 1 kg on a surface. With `turn` zero, each surface is described correctly."""

    turn: jk.Scalar = jk.parameter(0.0)
    coordinates, speeds = ("x", "y"), ("vx", "vy")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        P = O.moving(q["x"] * N.x + q["y"] * N.y, u["vx"] * N.x + u["vy"] * N.y)
        return jk.Motion([jk.Body(1.0, 0.0, P, name="particle")], points={"P": P, "O": O})


class TurningPlane(Particle):
    """Its normal turns, but the velocity of the surface is said to be zero."""

    def contacts(self, t, q, u, motion):
        N = motion.N
        return {"plane": jk.Contact(motion["P"], N.y * jnp.cos(self.turn * t) - N.x * jnp.sin(self.turn * t))}


class TurningPlaneWithSurface(Particle):
    """The surface point below the particle has the velocity of the surface there."""

    def contacts(self, t, q, u, motion):
        N = motion.N
        n, s = (N.y * jnp.cos(self.turn * t + a) - N.x * jnp.sin(self.turn * t + a) for a in (0.0, -0.5 * jnp.pi))
        along = motion["P"].position.dot(s)
        return {"plane": jk.Contact(motion["P"], n, surface=motion["O"].moving(along * s, self.turn * along * n))}


class Bowl(Particle):
    """y = x^2 / 2. The gap is a distance only where it is zero."""

    def contacts(self, t, q, u, motion):
        slope = q["x"]
        gap = (q["y"] - 0.5 * q["x"] ** 2) / jnp.sqrt(1.0 + slope**2)
        return {"bowl": jk.Contact(motion["P"], motion.N.y - (slope + self.turn * q["x"]) * motion.N.x, gap=gap)}


@pytest.mark.parametrize("surface", [TurningPlane, Bowl])
def test_a_gap_that_contradicts_the_velocity_elsewhere_is_refused(surface):
    """At the start it agrees. It depends on the parameter, whether it agrees at other coordinates and times."""
    rest, ts = jk.State({}, {}), jnp.linspace(0.0, 1.0, 3)
    assert jk.assemble(surface(), {}).q.shape == (2,)
    for refused in (
        lambda: jk.simulate(surface(0.5), rest, ts),
        lambda: jk.assemble(surface(0.5), {"x": 0.0, "y": 0.0}),
        lambda: jk.sweep.sweep(surface(jnp.array([0.0, 0.5])), rest, ts),
        lambda: jax.eval_shape(lambda turn: jk.simulate(surface(turn), rest, ts), jnp.array(0.5)),
    ):
        with pytest.raises(ValueError, match="but the velocity of its point along the normal"):
            refused()


def test_a_turning_plane_with_the_velocity_of_its_surface_is_accepted():
    assert jk.assemble(TurningPlaneWithSurface(0.5), {}).u.shape == (2,)


@pytest.mark.slow
def test_an_event_and_a_contact_need_different_names():
    class Both(BouncingBall):
        def events(self, t, q, u):
            return {"floor": jk.falling(q["height"])}

    with pytest.raises(ValueError, match="'floor' is used twice"):
        jk.simulate(Both(), jk.State({"height": 1.0}, {}), TS)


def test_a_controller_of_diffrax_does_not_support_contacts():
    controller = diffrax.PIDController(rtol=1e-6, atol=1e-6)
    with pytest.raises(ValueError, match="contact"):
        jk.simulate(BouncingBall(), jk.State({"height": 1.0}, {}), TS, controller=controller)
