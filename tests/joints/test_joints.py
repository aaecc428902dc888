"""Mechanisms of joints, compared with SymPy's accelerations, closed forms and each other. MuJoCo: `test_convert.py`."""

import json
import pickle
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from benchmarks.chain import Chain
from programs import operations

import jaxkane as jk
from jaxkane.fit.problem.specification import parameters_of
from jaxkane.joints import (
    Actuator,
    Coupling,
    Link,
    Loop,
    Site,
    ball,
    free,
    hinge,
    mechanism,
    planar,
    slide,
    universal,
)

RTOL = 1e-11
DATA = Path(__file__).parents[1] / "data"
FOUR_BAR = json.loads((DATA / "sympy_kane_systems.json").read_text())["systems"]["four_bar_linkage"]
BAR = {"mass": 2.0, "center": (0.0, 0.0, -0.2), "inertia": (0.03, 0.03, 0.002)}


def pendulums(n=2, **more):
    """Bars that hang in a chain, on hinges along y and x in turn."""
    joints = [hinge(f"q{i}", ((0, 1, 0), (1, 0, 0))[i % 2], **more) for i in range(n)]
    places = [{"parent": f"link{i - 1}", "position": (0, 0, -0.4)} if i else {} for i in range(n)]
    return [Link(f"link{i}", joints=joints[i], **places[i], **BAR) for i in range(n)]


@pytest.mark.slow
def test_planar_and_universal_joints_equal_their_component_joints():
    disk = Link("disk", None, planar("p", ((0, 0, 1), (1, 0, 0)), damping=0.4), mass=2.0, inertia=(0.2, 0.3, 0.2))
    system = mechanism([disk], gravity=(0, 0, -9.0), actuators=[Actuator("F", "p_x"), Actuator("T", "p_angle")])
    u_dot = jk.accelerations(system, 0.0, [0.1, 0.2, 0.3], [1.0, 2.0, 3.0], {"F": 5.0, "T": 0.6})
    # m a = F - c v along z and x; I alpha = T - c omega
    np.testing.assert_allclose(u_dot, [(5 - 0.4) / 2 - 9.0, -0.8 / 2, (0.6 - 1.2) / 0.3], rtol=1e-13)
    links = [Link("cross", None, universal("u"), **BAR)]
    parts = [Link("cross", None, [hinge("u_1", (1, 0, 0)), hinge("u_2", (0, 1, 0))], **BAR)]
    one, two = (jk.accelerations(mechanism(x), 0.0, [0.3, 0.4], [1.0, -2.0]) for x in (links, parts))
    np.testing.assert_array_equal(one, two)


def test_a_ball_joint_spring_is_smooth_at_rest_and_takes_the_shorter_rotation():
    system = mechanism(
        [Link("a", None, ball("s", stiffness=2.0), mass=1.0, inertia=(0.5, 0.5, 0.5))], gravity=(0, 0, 0)
    )
    alpha = lambda angle, sign=1.0: jk.accelerations(  # noqa: E731
        system, 0.0, sign * jnp.stack([jnp.sin(angle / 2), 0.0 * angle, 0.0 * angle, jnp.cos(angle / 2)]), [0.0] * 3
    )
    for angle in (0.0, 1e-5, 1.9e-4, 2.1e-4, 1.0, 3.0):
        np.testing.assert_allclose(alpha(jnp.float64(angle))[0], -4.0 * angle, rtol=1e-12)
        np.testing.assert_allclose(alpha(jnp.float64(angle), -1.0)[0], -4.0 * angle, rtol=1e-12)
    slope = jax.jit(jax.vmap(jax.grad(lambda angle: alpha(angle)[0])))(jnp.array([0.0, 1e-5, 1.0]))
    np.testing.assert_allclose(slope, -4.0, rtol=1e-9)


@pytest.mark.weekly
@pytest.mark.parametrize("base", [free("base"), planar("base"), [ball("s"), slide("x", (1, 2, 0))]])
def test_motion_and_rates_of_a_tree_of_joints_are_consistent(base):
    """`check_description` relies on this and does not check trees."""
    links = [
        Link("trunk", None, base, **BAR),
        Link("leg", "trunk", universal("hip", anchor=(0, 0, 0.1)), (0.1, 0, 0), **BAR),
        Link("foot", "leg", [slide("x2", (0, 0, 1)), ball("ankle", anchor=(0, 0.1, 0))], (0, 0, -0.2), **BAR),
    ]
    system = mechanism(links, sites=[Site("toe", "foot", (0.1, 0, 0))])
    rng = np.random.default_rng(0)
    q = rng.uniform(-0.5, 0.5, len(system.coordinates))
    for i, name in enumerate(system.coordinates):
        if name.endswith("_e4"):
            q[i - 3 : i + 1] /= np.linalg.norm(q[i - 3 : i + 1])
    checked = with_class(system, type("Inherited", (type(system),), {}))
    assert np.isfinite(jk.kinetic_energy(checked, 0.0, q, rng.normal(size=len(system.speeds))))


def with_class(system, kind):
    """The system as an instance of a class that inherits from its own, which the library checks."""
    copy = object.__new__(kind)
    for field, value in vars(system).items():
        object.__setattr__(copy, field, value)
    return copy


def test_a_class_that_inherits_from_a_mechanism_is_checked():
    base = mechanism(pendulums(1))
    Wrong = type("Wrong", (type(base),), {"q_dot": lambda self, t, q, u: [2.0 * u["q0_rate"]]})
    with pytest.raises(ValueError, match="by the rates of its coordinates"):
        jk.accelerations(with_class(base, Wrong), 0.0, [0.3], [0.2])


# Loops


def four_bar(across=0.0, **more):
    p = FOUR_BAR["params"]
    rod = lambda l: {  # noqa: E731
        "mass": p["rho"] * l,
        "center": (l / 2, 0, 0),
        "inertia": (0, p["rho"] * l**3 / 12, p["rho"] * l**3 / 12),
    }
    links = [
        Link("l2", None, hinge("q1"), (p["l1"], 0, 0), **rod(p["l2"])),
        Link("l3", "l2", hinge("q2"), (p["l2"], 0, 0), **rod(p["l3"])),
        Link("l4", "l3", hinge("q3"), (p["l3"], 0, 0), **rod(p["l4"])),
    ]
    sites = [Site("ground", None), Site("end", "l4", (p["l4"], 0, across))]
    return mechanism(links, gravity=(0, 0, 0), sites=sites, loops=[Loop("ground", "end")], **more)


@pytest.mark.slow
def test_accelerations_of_a_four_bar_linkage_agree_with_sympy():
    system = four_bar(dependent=("q2", "q3"))
    assert system.dependent_speeds == ("q2_rate", "q3_rate")  # of three residuals two, since it lies in a plane
    for state in FOUR_BAR["states"]:
        q = [state["q"][x] for x in system.coordinates]
        rates = jk.speed_rates(system, 0.0, q, [state["u"]["u1"]], state["inputs"])
        expected = [state["udot"][x] for x in ("u1", "u2", "u3")]
        np.testing.assert_allclose([rates[x] for x in ("q1_rate", "q2_rate", "q3_rate")], expected, rtol=RTOL)


def test_dependent_coordinates_are_chosen_and_can_be_assembled():
    system = four_bar()
    assert len(system.dependent_speeds) == 2
    state = FOUR_BAR["states"][0]
    held = next(c for c in system.coordinates if c not in system.dependent_coordinates)
    guess = np.array([state["q"][c] + (0.0 if c == held else 0.05) for c in system.coordinates])
    found = jk.assemble(system, guess, [0.3])
    np.testing.assert_allclose(found.q, [state["q"][c] for c in system.coordinates], rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("kept", ["q1", "q2", "q3"])
def test_a_named_joint_is_independent(kept):
    pose = FOUR_BAR["states"][0]["q"]
    system = four_bar(independent=[kept], pose=pose, poses={"start": pose})
    assert system.speeds == (f"{kept}_rate",)
    assert system.poses == {"start": pose}
    assert pickle.loads(pickle.dumps(system)).poses == system.poses
    np.testing.assert_allclose(jk.assemble(system, pose).q, [pose[c] for c in system.coordinates], rtol=1e-9)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"independent": ["q1", "q2"]}, "2 independent residuals, and cannot be solved without .*: q1, q2. Name fewer"),
        ({"independent": ["q4"]}, "`independent` .* q4"),
        ({"independent": "q1"}, "`independent` must be a list of names"),
        ({"independent": ["q2"], "dependent": ["q2", "q3"]}, "both name q2"),
        ({"pose": {"q": 1.0}}, "`pose` .*: q;"),
        ({"poses": {"start": {"q1": 1.0}}}, "the pose 'start' needs one value per coordinate; see 'q2'"),
    ],
)
def test_invalid_choices_of_dependent_coordinates_raise(more, words):
    with pytest.raises((ValueError, TypeError), match=words):
        four_bar(**more)


def test_only_the_links_of_a_loop_enter_its_constraint():
    """A four-bar linkage at the end of a chain, whose links do not affect the loop."""
    side = [Link("left", "link4", hinge("l", (0, 1, 0)), **BAR), Link("right", "link4", hinge("r", (0, 1, 0)), **BAR)]
    links = [*pendulums(5), *side, Link("coupler", "left", hinge("c", (0, 1, 0)), (0, 0, -0.4), **BAR)]
    sites = [Site("end", "coupler", (0.3, 0, 0.1)), Site("pin", "right", (0.3, 0, -0.3))]
    system = mechanism(links, sites=sites, loops=[Loop("end", "pin")])
    assert len(system.dependent_speeds) == 2
    assert {name.removesuffix("_rate") for name in system.dependent_speeds} < {"l", "r", "c"}
    q = jk.assemble(system, {}).q
    J = jk.constraint_jacobian(system, 0.0, q)
    outside = [name not in ("l_rate", "r_rate", "c_rate") for name in system.speeds]
    np.testing.assert_allclose(J[:, np.array(outside)], 0.0, atol=1e-14)


def test_a_planar_loop_with_an_out_of_plane_offset_is_rejected():
    with pytest.raises(ValueError, match=r"Loop\('ground', 'end'\) is not satisfied: its residual is 0.1 "):
        four_bar(across=0.1)


@pytest.mark.weekly
def test_two_welded_bodies_move_as_one_body():
    slab = {"mass": 1.0, "inertia": (0.1, 0.2, 0.3), "center": (0.1, 0.2, 0.0)}
    a, b = Link("a", None, free("r"), **slab), Link("b", None, hinge("h", (0, 0, 1)), (0.1, 0.0, 0.0), **slab)
    turned = (0.0, 0.0, np.sin(0.2), np.cos(0.2))
    sites = [Site("on a", "a", (0.3, 0.1, 0.2), turned), Site("on b", "b", (0.3, 0.1, 0.2), turned)]
    welded = mechanism([a, b], sites=sites, loops=[Loop("on a", "on b", rigid=True)], gravity=(0, -9.81, 0))
    assert len(welded.dependent_speeds) == 6
    (speed,) = welded.speeds
    both = mechanism([b, Link("a", "b", **slab)], gravity=(0, -9.81, 0))
    q0 = {"h": 0.4, "r_x": 0.1, "r_e3": np.sin(0.2), "r_e4": np.cos(0.2)}
    state = jk.assemble(welded, [q0.get(c, 0.0) for c in welded.coordinates], [0.9])
    rate = jk.speed_rates(welded, 0.0, state.q, state.u)
    assert speed in ("h_rate", "r_w3")  # one and the same
    np.testing.assert_allclose(rate[speed], jk.accelerations(both, 0.0, [0.4], [0.9])[0], rtol=1e-10)


@pytest.mark.weekly
@pytest.mark.parametrize(
    "turned", [(1.0, 0.0, 0.0, 0.0), (0.0, 0.6, -0.8, 0.0), (0.5, 0.5, 0.5, 0.5), (0.0, 0.0, 0.0, 1.0)]
)
def test_a_rotated_weld_is_satisfied_in_one_orientation_only(turned):
    TOLERANCE = 1e-9
    slab = {"mass": 1.0, "inertia": (0.1, 0.2, 0.25)}
    sites = [Site("on a", "a", (0.0, 0.0, 0.1)), Site("on b", "b", (0.0, 0.0, -0.1), turned)]
    welded = mechanism(
        [Link("a", None, free("a"), **slab), Link("b", None, free("b"), **slab)],
        sites=sites,
        loops=[Loop("on a", "on b", rigid=True)],
    )
    assert {"a_x", "a_y", "a_z", "a_e1", "a_e2", "a_e3"}.isdisjoint(welded.dependent_coordinates)
    x, y, z, w = turned
    for guess in [(0.0, 0.0, 0.0, 1.0), (w, -z, y, -x), (y, -x, w, -z)]:  # the others are half a turn away
        q = [*(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), *(0.0, 0.0, 0.2), *guess]
        state = jk.assemble(welded, q)
        (A, P), (B, Q) = welded.motion(0.0, state.q, np.zeros(12)).sites.values()
        np.testing.assert_allclose(A.matrix(B), np.eye(3), rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(Q.position_from(P).to(A), 0.0, rtol=0, atol=TOLERANCE)


def triple_rocker(length=0.5, **more):
    """Three rockers that hang from the ground carry a table. The pin of the third one has no mass. With equal lengths,
    four of five residuals are independent where the loops are closed, and all five where they are open."""

    def rocker(name, x, length=0.5):
        inertia = (0, 0, length**2 / 12)
        return Link(name, None, hinge(name), (x, 0, 0), mass=1.0, center=(0, -length / 2, 0), inertia=inertia)

    table = Link("table", "a", hinge("t"), (0, -0.5, 0), mass=2.0, center=(1, 0, 0), inertia=(0, 0, 0.7))
    pin = Link("pin", "c", hinge("p"), (0, -length, 0))
    sites = [Site("end", "b", (0, -0.5, 0)), Site("middle", "table", (1, 0, 0))]
    sites += [Site("hook", "pin"), Site("right", "table", (2, 0, 0))]
    loops = [Loop("end", "middle"), Loop("hook", "right", rigid=True)]
    links = [rocker("a", 0.0), rocker("b", 1.0), rocker("c", 2.0, length), table, pin]
    return mechanism(links, gravity=(0, -9.81, 0), sites=sites, loops=loops, **more)


ROCKERS_CLOSED = {"a": 0.7, "b": 0.7, "c": 0.7, "t": -0.7, "p": -0.7}


def test_redundant_residuals_of_open_loops_are_omitted():
    system = triple_rocker()
    assert len(system.speeds) == 1
    assert sum(len(loop.independent) for loop in system.structure.loops) == 4


@pytest.mark.slow
def test_unequal_rockers_are_rejected_with_the_size_of_the_gap():
    with pytest.raises(
        ValueError, match=r"Loop.* is not satisfied: its residual is 0\.00498 where the others are zero"
    ):
        triple_rocker(0.51, pose=ROCKERS_CLOSED)


@pytest.mark.slow
@pytest.mark.parametrize("off", [None, 0.0, 0.01])
def test_a_parallel_third_rocker_does_not_change_the_motion(off):
    pose = None if off is None else {name: x + off * np.sin(9 * len(name) + x) for name, x in ROCKERS_CLOSED.items()}
    system = triple_rocker(pose=pose)
    state = jk.assemble(system, ROCKERS_CLOSED)
    rate = jk.speed_rates(system, 0.0, state.q, state.u)["a_rate"]
    J, k = 3 * (1 / 48 + 0.25**2) + 0.5, 9.81 * 1.75
    np.testing.assert_allclose(rate, -k * np.sin(0.7) / J, rtol=1e-12)


def test_mechanisms_without_an_independent_speed_cause_a_warning():
    link = Link("a", None, hinge("q"), mass=1.0, inertia=(0, 0, 0.1))
    with pytest.warns(UserWarning, match="Mechanism: no independent speed: 1 speeds, .* pass a `pose`"):
        mechanism([link], loops=[Coupling("q", coefficients=(0.2,))])


def test_a_pose_at_a_change_point_gives_one_independent_speed():
    system = four_bar_in_line(pose={"q1": 0.0, "q2": 0.0, "q3": np.pi})
    assert (len(system.speeds), len(system.dependent_speeds)) == (1, 2)


def four_bar_in_line(**more):
    """Four links of length 1."""
    bar = {"mass": 1.0, "center": (0.5, 0, 0), "inertia": (0, 0, 1 / 12)}
    links = [Link("l1", None, hinge("q1"), **bar)]
    links += [Link(f"l{i}", f"l{i - 1}", hinge(f"q{i}"), (1, 0, 0), **bar) for i in (2, 3)]
    return mechanism(
        links, sites=[Site("g", None, (1, 0, 0)), Site("e", "l3", (1, 0, 0))], loops=[Loop("g", "e")], **more
    )


def test_bennetts_linkage_is_closed_without_a_pose():
    """Four hinges in space: opposite links are equal, and sin(alpha) / a = sin(beta) / b (Bennett 1903)."""
    alpha, beta = 1.2, 0.9
    lengths, twists = (0.05, 0.05 * np.sin(beta) / np.sin(alpha)), (alpha, beta)
    links = [
        Link(f"l{i}", f"l{i - 1}" if i else None, hinge(f"q{i}"), (lengths[i % 2 - 1], 0, 0) if i else (0, 0, 0),
             ("1-2-3", (twists[i % 2 - 1], 0.0, 0.0)) if i else None, mass=1.0, inertia=(0.1, 0.1, 0.1))
        for i in range(4)
    ]  # fmt: skip
    sites = [Site("ground", None), Site("end", "l3", (lengths[1], 0, 0), ("1-2-3", (beta, 0.0, 0.0)))]
    system = mechanism(links, sites=sites, loops=[Loop("ground", "end", rigid=True)])
    assert len(system.speeds) == 1


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Mechanism. no independent speed")
def test_a_planar_rigid_loop_is_not_closed_at_half_a_turn():
    links = [Link("a", None, hinge("a"), mass=1.0), Link("b", "a", hinge("b"), (0.5, 0.0, 0.0), mass=1.0)]
    links.append(Link("c", "b", hinge("c"), (0.5, 0.0, 0.0), mass=1.0))
    sites = [Site("hand", "c"), Site("goal", None, (0.7, 0.2, 0.0), ("3-1-2", (np.pi, 0.0, 0.0)))]
    arm = mechanism(links, sites=sites, loops=[Loop("goal", "hand", rigid=True)])
    for start in (-3.0, 0.0, 3.0):
        q = jk.assemble(arm, [0.3, 0.4, start]).q
        np.testing.assert_allclose(np.cos(sum(q)), -1.0, rtol=1e-12)


def test_a_coupling_is_a_gear():
    gears = [Link(n, None, hinge(n), mass=1.0, inertia=(0, 0, I)) for n, I in (("g", 0.2), ("p", 0.03))]
    geared = mechanism(gears, loops=[Coupling("p", "g", (0.1, -3.0))], actuators=[Actuator("T", "g")])
    assert geared.dependent_speeds == ("p_rate",)
    alpha = jk.accelerations(geared, 0.0, [0.2, 0.1 - 0.6], [1.0], {"T": 2.0})
    np.testing.assert_allclose(alpha, [2.0 / (0.2 + 9 * 0.03)], rtol=1e-13)


def test_invalid_couplings_raise():
    """Text that reads as a number is none, here and in a gear; `dependent` is refused where nothing is solved."""
    gears = [Link(n, None, hinge(n), mass=1.0, inertia=(0, 0, I)) for n, I in (("g", 0.2), ("p", 0.03))]
    for coefficients in ("12", ("0", "2"), (0.0, np.nan), ()):
        with pytest.raises(ValueError, match="The coefficients of the coupling of 'p'"):
            mechanism(gears, loops=[Coupling("p", "g", coefficients)])
    with pytest.raises(ValueError, match="a joint cannot follow itself"):
        mechanism(gears, loops=[Coupling("p", "p", (0.0, -3.0))])
    with pytest.raises(ValueError, match="The gear of 'T' must be finite numbers, got '2'"):
        mechanism(gears, actuators=[Actuator("T", "g", gear="2")])
    with pytest.raises(ValueError, match="names p, but the mechanism has no loop"):
        mechanism(gears, dependent=("p",))


# Structure and parameters


def test_equal_structures_share_a_class_and_can_be_pickled():
    one, two = mechanism(pendulums()), mechanism([*reversed(pendulums())])
    assert type(one) is type(two)
    assert type(mechanism(pendulums(damping=0.1))) is not type(one)
    again = pickle.loads(pickle.dumps(one))
    assert type(again) is type(one)
    assert eqx.tree_equal(again, one)


def test_parameters_have_names_units_and_a_sign():
    arm = mechanism(pendulums(damping=0.1), actuators=[Actuator("m", "q0")])
    assert set(arm.mass) == {"link0", "link1"}
    assert arm.center == {"link0": {"z": -0.2}, "link1": {"z": -0.2}}  # zeros that are written as numbers are structure
    free_ones = ["mass.link1", "center.link0.z", "damping.q1", "gain.m"]
    found = parameters_of(arm, free_ones)
    assert found.names == tuple(free_ones)
    assert found.units == ("kg", "m", "N m s/rad", "")
    body = jk.fit.Inertia(
        moments=("inertia.link1.xx", "inertia.link1.yy", "inertia.link1.zz"),
        mass="mass.link1",
        center=(None, None, "center.link1.z"),
    )
    assert parameters_of(arm, body).names[:2] == ("mass.link1", "center.link1.z")
    assert float(arm.replace({"mass.link1": 3.0}).mass["link1"]) == 3.0
    with pytest.raises(ValueError, match=r"no parameter mass\.link7;"):
        arm.replace({"mass.link7": 3.0})
    with pytest.raises(ValueError, match=r"mass.link1 = -1.0 must be positive"):
        arm.replace({"mass.link1": -1.0})
    beside = Link("a", None, hinge("q", (0, 1, 0)), mass=1.0, center=(jnp.zeros(()), 0.0, 0.1), inertia=(1, 1, 1))
    assert set(mechanism([beside]).center["a"]) == {"x", "z"}  # a JAX zero is a parameter


@pytest.mark.slow
def test_a_mechanism_may_be_made_of_traced_numbers():
    def alpha(mass):
        bar = Link("a", None, hinge("q", (0, 1, 0)), mass=mass, center=(0.2, 0, 0), inertia=(0.1, 0.1, 0.1))
        return jk.accelerations(mechanism([bar], gravity=(0, 0, -10.0)), 0.0, [0.0], [0.0])[0]

    m = 1.5
    for derivative in (jax.grad, jax.jacfwd):  # alpha = 2 m / (0.1 + 0.04 m)
        np.testing.assert_allclose(jax.jit(derivative(alpha))(m), 0.2 / (0.1 + 0.04 * m) ** 2, rtol=1e-12)
    np.testing.assert_allclose(jax.vmap(alpha)(jnp.array([1.0, 2.0])), [2 / 0.14, 4 / 0.18], rtol=1e-12)


@pytest.mark.weekly
def test_a_loop_may_be_made_of_traced_numbers():
    def alpha(across):
        system = four_bar(across, dependent=("q2", "q3"))
        return jk.accelerations(system, 0.0, [state["q"][x] for x in system.coordinates], [state["u"]["u1"]])[0]

    state = FOUR_BAR["states"][0]
    expected = alpha(0.0)
    np.testing.assert_allclose(jax.jit(alpha)(0.0), expected, rtol=1e-12)
    np.testing.assert_allclose(jax.vmap(alpha)(jnp.zeros(2)), [expected, expected], rtol=1e-12)


A = Link("a", None, hinge("h"), **BAR)
ENDS = [Site("s", "a"), Site("t", "a", (0, 0, 0.5))]


@pytest.mark.parametrize(
    ("links", "more", "words"),
    [
        ([hinge("h")], {}, "needs a Link"),
        ([Link("a.b")], {}, "without a dot.*'a.b'"),
        ([A, A], {}, "Two links have the name 'a'"),
        ([Link("a", "c")], {}, "parent of the link 'a'.*c"),
        ([Link("a", "b"), Link("b", "a")], {}, "form a cycle: a, b"),
        ([A, Link("b", "a", hinge("h"), **BAR)], {}, "Two joints have the name h"),
        ([Link("a", None, hinge("h.1"), **BAR)], {}, "joint.*'h.1'"),
        ([A], {"actuators": [Actuator("T", "k")]}, "actuator 'T'.*k"),
        ([A], {"actuators": [Actuator("T", "h", (1, 2))]}, "gear of the actuator 'T'"),
        ([A], {"actuators": [Actuator("h", "h")]}, "'h' appears in `coordinates` and"),
        ([A], {"sites": [Site("s", "z")]}, "site 's'.*z"),
        ([A], {"sites": [Site("a", "a")]}, "sites or links have the name a"),
        ([A], {"loops": [Loop("s", "t")]}, "A loop .*: s;"),
        ([A], {"loops": [Loop("s", "s")], "sites": ENDS}, r"Loop\('s', 's'\).*Name two"),
        ([A], {"loops": [Loop("s", "t")], "sites": ENDS}, r"Loop\('s', 't'\) is not satisfied: its residual is 0.5"),
        ([A], {"loops": [Coupling(None, "h")]}, "Coupling: None is not a hinge or a slider"),
        ([Link("a", None, ball("h"), **BAR)], {"loops": [Coupling("h")]}, "Coupling: 'h' is not a hinge or a slider"),
        ([Link("a", None, hinge("h"), (1, 2), **BAR)], {}, "position.a must have three components"),
        ([Link("a", None, hinge("h"), orientation=np.diag([1, 1, -1]), **BAR)], {}, "'a': the orientation must be"),
        ([Link("a", None, hinge("h"), mass=1, inertia=2.0)], {}, "inertia of 'a'"),
        ([Link("a", None, hinge("h"), mass=1, inertia=jnp.eye(3) + jnp.eye(3, k=1))], {}, "not symmetric: 1.0 and 0.0"),
        ([A, Link("b", "a", free("f"), **BAR)], {}, "'b' has a free joint"),
        ([Link("a", None, hinge("h"))], {}, "no movable link has a mass"),
        ([Link("a", mass=1.0)], {}, "no link has a joint"),
        (
            [A, Link("b", None, hinge("k"), **BAR)],
            {"loops": [Coupling("k", "h", (0.0, -3.0)), Coupling("k", "h", (0.2, -3.0))]},
            r"Coupling\('k', 'h'\) is not satisfied: its residual is 0.2",
        ),
    ],
)
def test_invalid_mechanisms_raise_by_name(links, more, words):
    with pytest.raises((TypeError, ValueError), match=words):
        mechanism(links, **more)


def test_an_inertia_matrix_may_be_asymmetric_by_rounding_errors():
    turned = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    inertia = turned @ np.diag([0.1, 0.2, 0.25]) @ turned.T
    assert (inertia != inertia.T).any()
    assert mechanism([Link("a", None, hinge("h"), mass=1, inertia=inertia)]).inertia["a"]["xy"] == inertia[0, 1]


@pytest.mark.parametrize(
    ("what", "made"),
    {
        "axis of 'h'": lambda x: mechanism([Link("a", None, hinge("h", (0, 1, x)), **BAR)]),
        "reference of 'h'": lambda x: mechanism([Link("a", None, slide("h", reference=x), **BAR)]),
        "orientation of 'a'": lambda x: mechanism([Link("a", None, hinge("h"), orientation=("2", (x,)), **BAR)]),
        "gear of 'T'": lambda x: mechanism([A], actuators=[Actuator("T", "h", x)]),
    }.items(),
)
def test_structural_values_must_not_be_traced(what, made):
    made(0.1)
    with pytest.raises(TypeError, match=rf"The {what} is part of the structure.*is traced"):
        jax.jit(lambda x: made(x).mass["a"])(0.1)


def test_invalid_axes_raise():
    with pytest.raises(ValueError, match="two axes, but 'h' has 3"):
        universal("h", np.eye(3))
    with pytest.raises(ValueError, match="axis of 'h'"):
        hinge("h", (0, 0, 0))


def crank_with_slider(L, across=0.0):
    """A crank, a rod and a slider along x on the ground, of lengths around L."""
    bar = {"mass": 1.0, "center": (0.5 * L, 0, 0), "inertia": (0.01 * L**2, 0.1 * L**2, 0.1 * L**2)}
    links = [
        Link("crank", None, hinge("a"), (0, 0, 0), **bar),
        Link("rod", "crank", hinge("b"), (1.0 * L, 0, 0), **bar),
        Link("slider", None, slide("x", (1, 0, 0)), (0, 0, 0), **bar),
    ]
    sites = [Site("end", "rod", (2.0 * L, 0, 0)), Site("pin", "slider", (0.5 * L, 0, across))]
    return mechanism(links, sites=sites, loops=[Loop("end", "pin")])


@pytest.mark.parametrize("L", [1e-9, 1e9])
def test_loop_closure_does_not_depend_on_the_unit_of_length(L):
    right, system = crank_with_slider(1.0), crank_with_slider(L)
    assert system.dependent_coordinates == right.dependent_coordinates
    held = next(c for c in right.coordinates if c not in right.dependent_coordinates)
    value = {"a": 0.4, "b": -0.2, "x": 2.0}[held]
    units = np.where(np.array(right.coordinates) == "x", L, 1.0)
    given = {held: value * units[right.coordinates.index(held)]}
    found = jk.assemble(system, given).q / units
    np.testing.assert_allclose(found, jk.assemble(right, {held: value}).q, rtol=1e-9)
    with pytest.raises(ValueError, match="is not satisfied: its residual is"):
        crank_with_slider(L, across=1e-4 * L)


@pytest.mark.filterwarnings("ignore:Mechanism. no independent speed")
def test_a_weld_is_not_satisfied_at_half_a_turn():
    """sin(pi) = 0: the sines alone would say that it is closed."""
    welded = mechanism(
        [Link("a", None, free("a"), mass=1.0, inertia=(0.1, 0.2, 0.25))],
        sites=[Site("ground", None), Site("on a", "a")],
        loops=[Loop("ground", "on a", rigid=True)],
    )
    for axis in np.eye(3):
        q = np.array([0.0, 0.0, 0.0, *axis, 0.0])
        h = np.array([float(x) for x in welded.configuration_constraints(0.0, q)])
        np.testing.assert_array_equal(h[:6], [0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
        with pytest.raises(ValueError, match="violate the configuration constraints"):
            jk.simulate(welded, jk.State(q, np.zeros(0)), np.linspace(0.0, 1.0, 3))


@pytest.mark.slow
def test_named_coordinates_are_fixed_even_if_chosen_as_dependent():
    system = crank_with_slider(1.0)
    first, second = system.dependent_coordinates
    free_one = next(c for c in system.coordinates if c not in system.dependent_coordinates)
    value = {"a": 0.4, "b": -0.2, "x": 1.2}
    for name in (first, second):
        for state in (
            jk.assemble(system, {name: value[name]}),
            jax.jit(lambda x, name=name: jk.assemble(system, {name: x}))(value[name]),
        ):
            q = dict(zip(system.coordinates, map(float, state.q), strict=True))
            assert q[name] == value[name]
            h = np.array([float(x) for x in system.configuration_constraints(0.0, np.asarray(state.q))])
            np.testing.assert_allclose(h, 0.0, atol=1e-12)
    with pytest.raises(ValueError, match=rf"no {free_one} that satisfies .*Named values are fixed: omit"):
        jk.assemble(system, {first: value[first], second: value[second] + 0.3})
    # Where all are named, the dependent ones are where the search begins.
    found = jk.assemble(system, dict(zip(system.coordinates, state.q + 1e-3, strict=True))).q
    i = system.coordinates.index(free_one)
    assert found[i] == state.q[i] + 1e-3
    assert np.all(np.delete(found - state.q, i) != 1e-3)


def test_stops_are_contacts_of_a_mechanism():
    links = [
        Link("cart", None, slide("x", (1, 0, 0), stops=(0.0, 0.5)), mass=1.0),
        Link("bar", "cart", hinge("q", (0, 1, 0), stops=(None, 1.2)), **BAR),
    ]
    arm = mechanism(links)
    assert {name: float(arm.upper[name]) for name in arm.upper} == {"x": 0.5, "q": 1.2}
    assert "lower.x" not in arm.lower  # the number 0 is part of the structure
    assert parameters_of(arm, ["upper.x", "upper.q"]).units == ("m", "rad")
    for system in (arm, pickle.loads(pickle.dumps(arm)), arm.with_outputs(lambda *args: {})):
        contacts = system.contacts(0.0, [0.1, 0.3], [0.0, 0.0], None)
        assert list(contacts) == ["x lower", "x upper", "q upper"]
        np.testing.assert_allclose([float(x.gap) for x in contacts.values()], [0.1, 0.4, 0.9], rtol=1e-15)
    moved = arm.replace({"upper.x": 0.7}).contacts(0.0, [0.1, 0.3], [0.0, 0.0], None)
    np.testing.assert_allclose(float(moved["x upper"].gap), 0.6, rtol=1e-15)
    assert type(mechanism(pendulums())).contacts is jk.System.contacts


@pytest.mark.parametrize(
    "stops", [(1.0, 0.5), (1.0, 1.0), 0.3, (0.1,), ("a", 1.0), ((0.0, 1.0), 2.0), (float("nan"), 1.0)]
)
def test_stops_must_be_a_lower_and_a_larger_upper_limit(stops):
    with pytest.raises(ValueError, match="stops of 'q' must be a lower and a larger upper limit"):
        hinge("q", stops=stops)


def test_dry_friction_is_a_contact_of_a_mechanism():
    arm = mechanism(pendulums(2, friction=0.3))
    assert parameters_of(arm, ["friction.q0"]).units == ("N m",)
    contacts = arm.replace({"friction.q1": 0.4}).contacts(0.0, [0.1, 0.3], [1.0, 2.0], None)
    assert {name: (float(x.slip), float(x.kinetic)) for name, x in contacts.items()} == {
        "q0 friction": (1.0, 0.3),
        "q1 friction": (2.0, 0.4),
    }
    slider = mechanism([Link("cart", None, slide("x", friction=2.0), mass=1.0)])
    assert parameters_of(slider, ["friction.x"]).units == ("N",)


def test_the_number_of_stops_is_limited():
    limits = "the limits of q0, q1, q2, q3, q4"
    with pytest.raises(ValueError, match=rf"10 contacts, which are {limits}. At most 8 .* fewer joints"):
        mechanism(pendulums(5, stops=(-1.0, 1.0)))
    with pytest.raises(ValueError, match=r"9 contacts, .* At most 6 .* fewer joints"):
        mechanism(pendulums(3, stops=(-1.0, 1.0), friction=0.1))


# Chains of many links: columns of M and f by transposition


@pytest.mark.weekly
def test_the_energy_of_a_long_chain_is_conserved():
    chain, rng = Chain(n=14), np.random.default_rng(0)
    state = jk.State(0.3 * rng.uniform(-2, 2, 14), 0.5 * rng.normal(size=14))
    ride = jk.simulate(chain, state, jnp.linspace(0.0, 0.5, 6), rtol=1e-9, atol=1e-9)

    def energies(q, u):
        motion = chain.motion(0.0, q, u)
        height = sum(body.mass * body.center.position.to(motion.N)[2] for body in motion.bodies)
        return jk.kinetic_energy(chain, 0.0, q, u), 9.81 * height

    T, V = jax.jit(jax.vmap(energies))(ride.q, ride.u)
    np.testing.assert_allclose(T + V, T[0] + V[0], rtol=0, atol=1e-7 * T[-1])
    assert float(jnp.abs(ride.q[-1] - ride.q[0]).max()) > 0.3


@pytest.mark.slow
def test_the_operation_count_is_proportional_to_the_number_of_links():
    of_10, of_40 = (operations("column of M", Chain(n=n), jnp.ones(n), jnp.ones(n), jnp.ones(n)) for n in (10, 40))
    assert of_40 < 4.6 * of_10 < 4.6 * 700
