"""What makes a description pleasant to write: defaults, fields, named values, inertia about any point."""

import contextlib
import re
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk


class Beads(jk.System):
    """Beads on a line, in any number."""

    masses: jax.Array = jk.parameter([1.0, 2.0, 3.0], positive=True)  # [kg]
    matrix: jax.Array = jk.parameter(np.eye(2))
    gains: jax.Array = jk.parameter(jnp.array([1, 2]))
    links: int = eqx.field(static=True, default=3)

    @property
    def coordinates(self):
        return tuple(f"x{i}" for i in range(self.links))

    @property
    def speeds(self):
        return tuple(f"v{i}" for i in range(self.links))

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion(
            [jk.Body(self.masses[i], 0.0, O.moving(q[i] * N.x, u[i] * N.x), name=f"{i}") for i in range(self.links)]
        )


def test_parameters_have_arrays_and_lists_as_defaults():
    beads = Beads()
    assert beads.masses.shape == (3,)
    assert beads.gains.dtype == jnp.float64
    np.testing.assert_array_equal(jk.mass_matrix(beads, 0.0, [0.0] * 3, [0.0] * 3), np.diag([1.0, 2.0, 3.0]))
    with pytest.raises(ValueError, match=r"Beads\.masses must have the shape \(3,\)"):
        Beads(masses=[1.0, 2.0])
    with pytest.raises(ValueError, match=r"masses = .* must be positive"):
        Beads(masses=[1.0, -2.0, 1.0])
    default = [1.0, 2.0]
    Changed = type("Changed", (jk.System,), {"__annotations__": {"x": jax.Array}, "x": jk.parameter(default)})
    default[0] = 5.0
    np.testing.assert_array_equal(Changed().x, [1.0, 2.0])


@pytest.mark.parametrize(
    ("limits", "allowed"), [({"positive": True}, {0.5, 1.0, 2.0}), ({"within": (0, 1)}, {0, 0.5, 1})]
)
def test_parameters_have_bounds(limits, allowed):
    """The tests of sweeps contain members outside of bounds."""
    Bounded = type("Bounded", (jk.System,), {"__annotations__": {"x": jk.Scalar}, "x": jk.parameter(**limits)})
    for x in (-1.0, 0.0, 0.5, 1.0, 2.0, np.nan, np.inf):
        with contextlib.nullcontext() if x in allowed else pytest.raises(ValueError, match="x = "):
            Bounded(x)


@pytest.mark.parametrize("value", [4, True, "left", (1, 2)])
def test_a_field_that_must_be_static_raises_with_the_remedy(value):
    annotations = {"links": type(value)}
    Chain = type("Chain", (jk.System,), {"__annotations__": annotations})
    with pytest.raises(TypeError, match=r"Chain\.links = .*equinox\.field\(static=True\).*jk\.parameter"):
        Chain(value)
    Chain = type("Chain", (jk.System,), {"__annotations__": annotations, "links": eqx.field(static=True)})
    assert Chain(value).links == value


def test_named_vectors_can_be_indexed_and_used_in_arithmetic():
    seen = []

    class Reader(jk.System):
        coordinates, speeds = ("x", "e1", "e2", "e3"), ("a", "b", "c", "d")

        def motion(self, t, q, u):
            seen.append(q)
            N, O = jk.inertial()
            return jk.Motion([jk.Body(1.0, 0.0, O.moving(q["x"] * N.x, u["a"] * N.x))])

    jk.positions(Reader(), 0.0, [1.0, 2.0, 3.0, 4.0], np.zeros(4))
    q = type(seen[0])([1.0, 2.0, 3.0, 4.0], Reader.coordinates)  # those of a trace have no numbers
    assert list(q["e1":"e3"]) == [2.0, 3.0, 4.0]
    assert q["e1":"e3"].names == ("e1", "e2", "e3")
    assert list(q[:"e1"]) == [1.0, 2.0]
    assert list(q["x", "e3"]) == list(q[[0, -1]]) == [1.0, 4.0]
    assert q["x", "e3"]["e3"] == 4.0
    assert "e1" in q
    assert "roll" not in q
    array = np.array([1.0, 2.0, 3.0, 4.0])
    arithmetic = (abs, lambda a: a**2, lambda a: 2.0**a, lambda a: +a, lambda a: a % 3.0, lambda a: a // 2.0)
    comparisons = (
        lambda a: a > 2,
        lambda a: a == 2.0,
        lambda a: 2.0 != a,
        lambda a: a == jnp.array([1.0, 0.0, 3.0, 0]),
    )
    for f in (*arithmetic, *comparisons):
        np.testing.assert_array_equal(f(q), f(array))
    for compare in (lambda: q == "e1", lambda: q < "e1", lambda: q == None):  # noqa: E711
        with pytest.raises(TypeError, match="can only be combined with numbers and arrays"):
            compare()
    with pytest.raises(KeyError, match="did you mean 'e1'"):
        q["e11":]
    with pytest.raises(AttributeError, match=r"jnp\.asarray\(q\)\.sum"):
        q.sum()
    with pytest.raises(AttributeError, match=r"write q\['roll'\]"):
        _ = q.roll
    with pytest.raises(TypeError, match="`in` requires a name"):
        _ = 1.0 in q


class Rod(jk.System):
    """A rod on a pin, with its inertia about the pin or about its mass centre."""

    mass: jk.Scalar = jk.parameter(2.0)
    about_pin: bool = eqx.field(static=True, default=True)
    wrong: bool = eqx.field(static=True, default=False)
    coordinates, speeds = ("angle", "tilt"), ("rate", "tilt_rate")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        A = N.rotate(3, q["angle"], u["rate"])
        B = A.rotate(1, q["tilt"], u["tilt_rate"])
        r = B.vector(0.3, 0.4, -0.5)
        G = O.fixed(r)
        if not self.about_pin:
            return jk.Motion([jk.Body(self.mass, np.diag([1.0, 2.0, 2.5]), G, B)])
        x = np.array([0.3, 0.4, -0.5])
        inertia = np.diag([1.0, 2.0, 2.5]) + self.mass * jnp.asarray(x @ x * np.eye(3) - np.outer(x, x))
        about = O.moving(0.0 * A.x, 1.0 * A.x) if self.wrong else O
        return jk.Motion([jk.Body(self.mass, inertia, G, B, about=about)])


@pytest.mark.slow
def test_inertia_about_another_point():
    at = ([0.3, 0.4], [0.5, 0.6])
    for function in (jk.mass_matrix, jk.forcing):
        about_pin, central = (function(Rod(about_pin=b), 0.0, *at) for b in (True, False))
        np.testing.assert_allclose(about_pin, central, rtol=1e-13, atol=1e-14)
    with pytest.raises(ValueError, match=r"'body'.*about a point that moves in its frame"):
        jk.mass_matrix(Rod(wrong=True), 0.0, *at)


class Wheel(jk.System):
    """A body on a pin in a plane, with its one moment about the pin or about its mass centre, 0.3 m from it."""

    moment: jk.Scalar = jk.parameter(0.2)
    about_pin: bool = eqx.field(static=True, default=True)
    coordinates, speeds = ("angle",), ("rate",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        B = N.rotate(3, q["angle"], u["rate"])
        G = O.fixed(-0.3 * B.y)
        return jk.Motion(
            [jk.Body(1.5, (0.0, 0.0, self.moment), G, B, name="wheel", about=O if self.about_pin else None)]
        )


@pytest.mark.slow
def test_a_single_moment_of_inertia_about_another_point():
    """M is the moment about the pin."""
    at = (0.0, [0.3], [0.5])
    np.testing.assert_allclose(jk.mass_matrix(Wheel(), *at), [[0.2]], rtol=1e-14)
    np.testing.assert_allclose(jk.mass_matrix(Wheel(moment=0.065, about_pin=False), *at), [[0.2]], rtol=1e-14)
    with pytest.raises(ValueError, match=r"-0.035, 0, 0 kg m\^2; none may be .* given about the point 'O'"):
        jk.mass_matrix(Wheel(moment=0.1), *at)


@pytest.mark.slow
def test_the_pendulum_of_the_sympy_page_agrees_with_sympy():
    """Figures: SymPy 1.14, `kane.mass_matrix.LUsolve(kane.forcing)` of the page at x = 0.6, vx = 0.5, m = 2, l = 1."""
    page = (Path(__file__).parents[2] / "docs" / "coming_from_sympy.md").read_text(encoding="utf-8")
    block = next(b for b in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "class Bob" in b)
    names = {}
    exec(block, names)
    np.testing.assert_allclose([names["rates"]["vx"], names["rates"]["vy"]], [-4.943175, -3.2191], rtol=1e-12)
    np.testing.assert_allclose(names["f"] / names["M"][0], -4.943175, rtol=1e-12)


class Slider(jk.System):
    """A particle on a line, and a light arm beside it; `what` acts on them."""

    what: object = eqx.field(static=True, default=None)
    coordinates, speeds, inputs = ("x", "angle"), ("v", "rate"), ("push",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        A = N.rotate(3, q["angle"], u["rate"])
        bead = jk.Body(2.0, 0.0, O.moving(q["x"] * N.x, u["v"] * N.x), name="bead")
        arm = jk.Body(1.0, (0.0, 0.0, 0.5), O, A, name="arm")
        return jk.Motion([bead, arm])

    def loads(self, t, q, u, motion, inputs):
        return self.what(motion, inputs)


@pytest.mark.parametrize(
    "what",
    [
        lambda motion, _: jk.Torque(motion.N.z, motion["bead"]),
        lambda motion, _: jk.loads.torsional_damper(motion["arm"], motion["bead"], motion.N.z, 0.1),
    ],
)
def test_a_torque_on_a_particle_is_refused(what):
    with pytest.raises(ValueError, match="'bead' is a particle"):
        jk.accelerations(Slider(what), 0.0, [0.1, 0.2], [0.3, 0.4])


@pytest.mark.parametrize(
    ("system", "q", "inputs", "words"),
    [
        (Slider, [0.1, 0.2], None, "Create one with Slider(...)"),
        (Slider(), [0.1j, 0.2], None, "Slider: q must be 2 real numbers"),
        (Slider(), "a", None, "Slider: q must be 2 numbers (x, angle), got"),
        (Slider(), [0.1, 0.2], {"push": [1.0, 2.0]}, "the input 'push' must be one number"),
    ],
)
def test_arguments_of_the_wrong_type_are_rejected_by_name(system, q, inputs, words):
    with pytest.raises((TypeError, ValueError), match=re.escape(words)):
        jk.accelerations(system, 0.0, q, [0.3, 0.4], inputs)


N, O = jk.inertial()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: N.x.dot(3.0), "dot needs a Vector"),
        (lambda: N.x.cross([1, 2, 3]), "cross needs a Vector"),
        (lambda: N.x.to(O), "components of a Vector need a Frame"),
        (lambda: O.fixed(3.0), "Point.fixed needs a Vector"),
        (lambda: O.moving(N.x, 2.0), "Point.moving, as the velocity, needs a Vector"),
        (lambda: jk.Body(1.0, 2.0, O, N, name="wheel"), "wheel: the inertia must be three principal moments"),
        (lambda: jk.Body(1.0, 0.0, O, about=O.fixed(N.x), name="wheel"), "'wheel' has an inertia, but no frame"),
    ],
)
def test_objects_that_are_not_vectors_frames_or_points_raise(call, words):
    with pytest.raises((TypeError, ValueError), match=re.escape(words)):
        call()


@pytest.mark.parametrize(
    "ask",
    [
        lambda s: jk.accelerations(s, 0.0, [0.1, 0.2], [0.0, 0.0]),
        lambda s: jk.positions(s, 0.0, [0.1, 0.2], [0.0, 0.0]),
        lambda s: jk.simulate(s, jk.State([0.1, 0.2], [0.0, 0.0]), [0.0, 1.0]),
        lambda s: jk.stability.equilibrium(s),
    ],
)
def test_functions_at_one_instant_reject_a_batch_of_systems_by_name(ask):
    with pytest.raises(ValueError, match=r"DoublePendulum: mass has more axes than declared.*jax.vmap"):
        ask(jk.catalog.DoublePendulum(mass=np.array([1.0, 2.0])))
