"""Imported MJCF and URDF files, compared with the accelerations of MuJoCo. Without MuJoCo, the tests are skipped."""

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest

import jaxkane as jk

RTOL = 1e-10
FIGURES = json.loads((Path(__file__).parents[1] / "data" / "mujoco_tree.json").read_text())
pytestmark = pytest.mark.skipif(importlib.util.find_spec("mujoco") is None, reason="needs MuJoCo: pip install mujoco")

LOOP = """<mujoco model="fourbar"><option><flag contact="disable"/></option><worldbody>
 <body name="a"><joint name="j1" axis="0 1 0" damping="0.1"/><geom type="capsule" fromto="0 0 0 0 0 0.3" size=".02"/>
  <body name="b" pos="0 0 0.3"><joint name="j2" axis="0 1 0" armature="0.01"/>
   <geom type="capsule" fromto="0 0 0 0.5 0 0.1" size=".02"/></body></body>
 <body name="c" pos="0.5 0 0"><joint name="j3" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 0.4" size=".02"/></body>
</worldbody><equality><connect name="pin" body1="b" body2="c" anchor="0.5 0 0.1"/></equality></mujoco>"""

BODY = '<body name="a"><joint name="j" axis="0 1 0"{}/><geom size=".1" mass="1"/></body>'


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    """MuJoCo writes a log of what it does not read where it is called."""
    monkeypatch.chdir(tmp_path)


def mjcf(body, rest=""):
    return f"<mujoco><worldbody>{body}</worldbody>{rest}</mujoco>"


@pytest.mark.slow
def test_an_imported_kinematic_tree_agrees_with_mujoco():
    system = jk.convert.from_mjcf(FIGURES["model"], strict=True)  # nothing is left out
    assert type(system).__name__ == "tree"
    assert set(system.mass) == {"base", "arm", "hand", "plate", "leg"}
    assert system.inputs == ("turn", "extend_input", "hip", "twist")  # `extend` is a coordinate
    for state in FIGURES["states"]:
        inputs = dict(zip(system.inputs, state["inputs"], strict=True))
        u_dot = jk.accelerations(system, 0.0, np.array(state["q"]), np.array(state["u"]), inputs)
        np.testing.assert_allclose(u_dot, state["u_dot"], rtol=RTOL, atol=RTOL * np.abs(state["u_dot"]).max())


def test_a_file_is_read_from_its_path_and_sites_become_points(tmp_path):
    path = tmp_path / "tree.xml"
    path.write_text(FIGURES["model"])
    system = jk.convert.from_mjcf(path)
    assert type(system) is type(jk.convert.from_mjcf(FIGURES["model"]))
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(path))
    data, state = mujoco.MjData(model), FIGURES["states"][0]
    q = np.array(state["q"])
    data.qpos[:] = q
    for start in (3, 9):  # Euler parameters: MuJoCo has the scalar first
        data.qpos[start : start + 4] = np.roll(q[start : start + 4], 1)
    mujoco.mj_kinematics(model, data)
    tip = system.motion(0.0, q, np.zeros(len(system.speeds)))["tip"].position
    np.testing.assert_allclose(tip.to(tip.frame.root), data.site("tip").xpos, rtol=1e-12)


def test_accelerations_of_a_closed_loop_agree_with_mujoco():
    import mujoco

    system = jk.convert.from_mjcf(LOOP, dependent=("j2", "j3"))
    state = jk.assemble(system, {"j1": 0.3}, {"j1_rate": 1.2})
    rates = jk.speed_rates(system, 0.0, state.q, state.u)
    model = mujoco.MjModel.from_xml_string(LOOP)
    data = mujoco.MjData(model)
    data.qpos[:] = state.q
    data.qvel[:] = [1.2, *jk.dependent_speeds(system, 0.0, state.q, state.u)]
    mujoco.mj_forward(model, data)
    J, J_dot = np.zeros((2, 3, 3)), np.zeros((2, 3, 3))
    for k, (body, anchor) in enumerate(
        zip((model.eq_obj1id[0], model.eq_obj2id[0]), model.eq_data[0].reshape(-1)[:6].reshape(2, 3))
    ):
        place = data.xpos[body] + data.xmat[body].reshape(3, 3) @ anchor
        mujoco.mj_jac(model, data, J[k], None, place, body)
        mujoco.mj_jacDot(model, data, J_dot[k], None, place, body)
    J, J_dot = (J[0] - J[1])[[0, 2]], (J_dot[0] - J_dot[1])[[0, 2]]
    M = np.zeros((3, 3))
    for column, unit in zip(M, np.eye(3)):
        mujoco.mj_mulM(model, data, column, unit)
    # M a = f + J^T lambda, J a = -J_dot v: the connection without the softness that MuJoCo gives it
    whole = np.block([[M, J.T], [J, np.zeros((2, 2))]])
    expected = np.linalg.solve(whole, [*(M @ data.qacc_smooth), *(-J_dot @ data.qvel)])[:3]
    np.testing.assert_allclose([rates[f"j{i}_rate"] for i in (1, 2, 3)], expected, rtol=RTOL)


@pytest.mark.slow_cases(all_but=["<weld site1=*", '<connect body1="a" anchor=*'])
@pytest.mark.parametrize(
    "equality",
    [
        '<weld body1="a" body2="b"/>',
        '<weld body1="b" body2="a" anchor="0.1 0.2 0.3"/>',
        '<connect body1="a" body2="b" anchor="0.1 0.2 0.3"/>',
        '<connect body1="a" anchor="0.1 0.2 0.3"/>',
        '<weld site1="s" site2="s2"/>',
    ],
)
def test_a_loop_is_closed_at_the_poses_of_the_file(equality):
    """At qpos0 the bodies meet every equality, as MuJoCo's compiler makes it."""
    import mujoco

    bodies = '<body name="{}" pos="{}" euler="{}"><freejoint name="{}"/><geom size=".1" mass="1"/>{}</body>'
    one = bodies.format("a", "0.1 0.2 0.3", "20 30 40", "f", '<site name="s" pos="0 0 .1"/>')
    # the second site stands where the first does, so that the two may be welded
    two = bodies.format("b", "0.1 0.2 0.3", "20 30 40", "g", '<site name="s2" pos="0 0 .1"/>')
    if "site" not in equality:
        two = bodies.format("b", "-0.3 0.5 1", "-50 10 70", "g", "")
    text = mjcf(one + two, f"<option><flag contact='disable'/></option><equality>{equality}</equality>")
    system = jk.convert.from_mjcf(text)
    qpos = mujoco.MjModel.from_xml_string(text).qpos0.reshape(2, 7)
    q = np.concatenate([qpos[:, :3], np.roll(qpos[:, 3:], -1, axis=1)], axis=1).ravel()
    residuals = np.array([float(x) for x in system.configuration_constraints(0.0, q)])
    assert len(residuals) == (6 if "weld" in equality else 3) + 2  # and two norms
    np.testing.assert_allclose(residuals, 0.0, atol=1e-14)
    assert np.abs(system.configuration_constraints(0.0, q + 0.01)[0]) > 1e-4


@pytest.mark.slow
def test_joint_equalities_become_dependent_coordinates():
    degree = '<equality><joint joint1="k" joint2="j" polycoef="0 2 0.5 0 0"/></equality>'
    two = BODY.format("") + BODY.replace('"a"', '"b"').replace('"j"', '"k"').format("")
    text = mjcf(two, "<option><flag contact='disable'/></option>" + degree)
    system = jk.convert.from_mjcf(text)
    state = jk.assemble(system, {"j": 0.3}, {"j_rate": 1.0})
    assert float(state.q[1]) == pytest.approx(2 * 0.3 + 0.5 * 0.09, rel=1e-12)
    for angle, name in ((20, "j"), (-10, "k")):
        text = text.replace(f'name="{name}"', f'name="{name}" ref="{angle}"')
    state = jk.assemble(jk.convert.from_mjcf(text), {"j": 0.3}, {"j_rate": 1.0})
    turned, follows = 0.3 - np.deg2rad(20.0), float(state.q[1]) - np.deg2rad(-10.0)
    assert follows == pytest.approx(2 * turned + 0.5 * turned**2, rel=1e-12)


def test_omitted_elements_are_reported():
    text = mjcf(
        '<geom type="plane" size="1 1 1"/>' + BODY.format(' range="-90 90" frictionloss="0.1"'),
        '<option density="1.2"/><actuator><muscle name="m" joint="j"/><motor name="T" joint="j" ctrlrange="-1 1"/>'
        '</actuator><tendon><fixed name="t"><joint joint="j" coef="1"/></fixed></tendon>',
    )
    with pytest.warns(UserWarning, match="omitted") as told:
        system = jk.convert.from_mjcf(text)
    words = str(told[0].message)
    for what in ("contacts", "limits of joints", "friction of joints", "tendons", "'m', which has its own", "medium"):
        assert what in words
        assert any(what in each for each in system.left_out)
    assert "limits of controls" in words
    assert system.inputs == ("T",)
    with pytest.raises(ValueError, match=r"not supported: .*contacts"):
        jk.convert.from_mjcf(text, strict=True)


def test_only_the_limits_in_stops_become_contacts():
    limited = BODY.format(' range="-9 9"').replace("<geom ", '<geom contype="0" ')
    three = "".join(limited.replace('"a"', f'"{name}"').replace('"j"', f'"{name}"') for name in "klm")
    five = three + "".join(limited.replace('"a"', f'"{name}"').replace('"j"', f'"{name}"') for name in "no")
    with pytest.raises(ValueError, match=r"10 contacts.* k, l, m, n, o. At most 8 .* fewer joints in `stops`"):
        jk.convert.from_mjcf(mjcf(five), stops=True)
    with pytest.warns(UserWarning, match="limits of joints"):
        system = jk.convert.from_mjcf(mjcf(three), stops=("k", "m"))
    assert set(system.lower) == {"k", "m"}
    contacts = system.contacts(0.0, [0.1, 0.2, 0.3], [0.0] * 3, None)
    assert list(contacts) == ["k lower", "k upper", "m lower", "m upper"]
    np.testing.assert_allclose(float(contacts["m upper"].gap), np.deg2rad(9.0) - 0.3)
    with pytest.raises(ValueError, match=r"`stops` contains n, which is not .* with a range are: k, l, m"):
        jk.convert.from_mjcf(mjcf(three), stops=["n"])
    with pytest.raises(TypeError, match="must be a list"):
        jk.convert.from_mjcf(mjcf(three), stops="k")
    off = "<option><flag limit='disable'/></option>"
    assert not jk.convert.from_mjcf(mjcf(three, off), stops=True, strict=True).lower


def test_limits_of_actuator_forces_on_a_joint_are_reported():
    limited = BODY.format(' actuatorfrcrange="-0.1 0.1"').replace("<geom ", '<geom contype="0" ')
    with pytest.warns(UserWarning, match="limits of controls and forces"):
        jk.convert.from_mjcf(mjcf(limited, '<actuator><motor joint="j"/></actuator>'))
    jk.convert.from_mjcf(mjcf(limited), strict=True)  # nothing is driven


@pytest.mark.parametrize(("first", "second"), [("j_1", "j.1"), ("j.1", "j_1")])
def test_names_that_become_identical_are_rejected(first, second):
    links = f"""<body name="a"><joint name="{first}" axis="0 1 0"/><geom size=".1"/>
      <body><joint name="{second}" axis="0 1 0"/><geom size=".1"/></body></body>"""
    with pytest.raises(ValueError, match=f"the joints '{first}' and '{second}' would both be 'j_1'"):
        jk.convert.from_mjcf(mjcf(links))
    motors = f'<actuator><motor name="{first}" joint="j"/><motor name="{second}" joint="j"/></actuator>'
    with pytest.raises(ValueError, match=f"the actuators '{first}' and '{second}' would both be 'j_1'"):
        jk.convert.from_mjcf(mjcf(BODY.format(""), motors))


def test_friction_of_joints_becomes_dry_friction():
    rough = BODY.format(' frictionloss="0.1"').replace("<geom ", '<geom contype="0" ')
    with pytest.warns(UserWarning, match="friction of joints"):
        jk.convert.from_mjcf(mjcf(rough))
    system = jk.convert.from_mjcf(mjcf(rough), friction=["j"], strict=True)
    friction = system.contacts(0.0, [0.0], [0.3], None)["j friction"]
    assert (float(friction.slip), float(friction.kinetic)) == (0.3, 0.1)
    off = "<option><flag frictionloss='disable'/></option>"
    assert not jk.convert.from_mjcf(mjcf(rough, off), friction=True, strict=True).friction


def test_conflicting_and_missing_names_are_replaced():
    off = "<option><flag contact='disable'/></option>"
    text = mjcf(
        '<body name="left foot.1"><joint axis="0 1 0"/><geom size=".1"/><site name="left foot.1"/>'
        '<body><joint axis="0 1 0"/><geom size=".1"/></body></body>',
        off,
    )
    system = jk.convert.from_mjcf(text)
    assert system.coordinates == ("joint0", "joint1")
    named = text.replace("<body><joint axis", '<body><joint name="joint0" axis')
    assert jk.convert.from_mjcf(named).coordinates == ("joint0_", "joint0")
    assert set(system.mass) == {"left foot_1", "body2"}
    motion = system.motion(0.0, [0.1, 0.2], [0.0, 0.0])
    assert {"left foot_1", "left foot_1_site"} <= {*motion.points, *(body.name for body in motion.bodies)}
    assert float(system.mass["body2"]) == pytest.approx(1000 * 4 / 3 * np.pi * 0.1**3)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<mujoco><worldbody>", "MuJoCo cannot read the text"),
        (mjcf('<body name="a"><joint/></body>'), "cannot read.*mass"),
        (mjcf('<geom size=".1"/>'), "no joint"),
        (mjcf('<body><joint/><geom type="mesh" mesh="m"/></body>'), "cannot read.*mesh"),
    ],
)
def test_a_file_that_is_not_a_mechanism_is_rejected(text, words):
    with pytest.raises(ValueError, match=words):
        jk.convert.from_mjcf(text)


def test_elements_disabled_by_flags_are_omitted():
    two = BODY.format(' stiffness="2" damping="1"') + BODY.replace('"a"', '"b"').replace('"j"', '"k"').format("")
    rest = '<equality><joint joint1="k" joint2="j"/></equality><actuator><motor joint="j" group="3"/></actuator>'
    flags = " ".join(f'{what}="disable"' for what in "contact gravity spring damper actuation equality".split())
    system = jk.convert.from_mjcf(mjcf(two, f"<option><flag {flags}/></option>{rest}"), strict=True)
    assert type(system).__name__ == "Mechanism"
    parts = lambda x: (x.stiffness, x.damping, x.gravity, x.inputs, x.dependent_speeds)  # noqa: E731
    assert not any(parts(system))
    with pytest.warns(UserWarning, match="contacts"):
        assert all(parts(jk.convert.from_mjcf(mjcf(two, rest))))
    off = '<option actuatorgroupdisable="0 3"><flag contact="disable"/></option>'
    assert not jk.convert.from_mjcf(mjcf(two, off + rest), strict=True).inputs


def test_a_missing_file_is_reported():
    with pytest.raises(FileNotFoundError, match=r"'nowhere.xml' does not exist"):
        jk.convert.from_mjcf("nowhere.xml")


def test_the_error_without_mujoco_states_the_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ImportError, match="pip install mujoco"):
        jk.convert.from_mjcf("<mujoco/>")


TRUSS = """<mujoco model="truss"><option><flag contact="disable"/></option><worldbody>
 <body name="a"><joint name="j1" axis="0 1 0" ref="10"/><geom type="capsule" fromto="0 0 0 0 0 .3" size=".02"/>
  <body name="b" pos="0 0 .3"><joint name="j2" axis="0 1 1e-5"/>
   <geom type="capsule" fromto="0 0 0 .5 0 .1" size=".02"/></body></body>
 <body name="c" pos=".5 0 0"><joint name="j3" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 .4" size=".02"/></body>
 <body name="d" pos="0 2 0"><joint name="s" type="ball"/><geom size=".1"/></body>
</worldbody><equality><connect name="pin" body1="b" body2="c" anchor=".5 0 .1"/></equality>
<keyframe><key name="bent" qpos=".1 .1 -.1 .5 .5 .5 .5"/></keyframe></mujoco>"""


def test_poses_of_a_file_and_nearly_redundant_loop_constraints():
    """An axis of five digits: the residual normal to the plane would lock the loop."""
    with pytest.warns(UserWarning, match=r"Loop\('pin_1', 'pin_2'\) \(.*\).*") as told:
        system = jk.convert.from_mjcf(TRUSS, pose="bent", independent=["j2"])
    assert "nearly depend" in str(told[0].message)
    assert system.dependent_speeds == ("j1_rate", "j3_rate")
    assert {name: list(pose.values()) for name, pose in system.poses.items()} == {
        "qpos0": [np.deg2rad(10.0), 0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
        "bent": [0.1, 0.1, -0.1, 0.5, 0.5, 0.5, 0.5],
    }
    start = jk.assemble(system, system.poses["bent"])
    assert float(start.q[1]) == 0.1
    assert np.abs(start.q - np.array([*system.poses["bent"].values()])).max() < 0.05
    h = np.array([float(x) for x in system.configuration_constraints(0.0, start.q)])
    np.testing.assert_allclose(h, 0.0, atol=1e-12)
    with pytest.raises(ValueError, match="`pose` is 'flat', but the poses of the file are qpos0, bent"):
        jk.convert.from_mjcf(TRUSS, pose="flat")
