"""URDF files: every joint, mimics, inertias with faults, and files that are not trees of links."""

import sys

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxkane as jk

RTOL = 1e-10


def link(name, mass=None, moments=(0.02, 0.03, 0.04), products=(0.0, 0.0, 0.0), origin='xyz="0 0 0"'):
    if mass is None:
        return f'<link name="{name}"/>'
    xx, yy, zz, xy, xz, yz = (*moments, *products)
    return f"""<link name="{name}"><inertial><origin {origin}/><mass value="{mass}"/>
     <inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="{xy}" ixz="{xz}" iyz="{yz}"/></inertial></link>"""


def joint(name, parent, child, kind="revolute", axis="0 0 1", origin='xyz="0 0 0"', more=""):
    return f"""<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin {origin}/>
     <axis xyz="{axis}"/>{more}</joint>"""


def robot(*parts):
    return f'<robot name="r">{"".join(parts)}</robot>'


ONE = robot(link("base"), link("arm", 2.0), joint("j", "base", "arm"))


@pytest.fixture(autouse=True)
def without_mujoco(monkeypatch, request):
    """URDF files do not need MuJoCo."""
    if "mujoco" not in request.node.name:
        monkeypatch.setitem(sys.modules, "mujoco", None)


@pytest.mark.slow
def test_an_imported_urdf_agrees_with_mujoco(tmp_path, monkeypatch):
    mujoco = pytest.importorskip("mujoco")
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log there
    text = robot(
        link("base", 3.0, origin='xyz="0.1 0 0.2" rpy="0.1 0.2 0.3"'),
        link("shoulder"),
        link("arm", 2.0, products=(1e-3, -2e-3, 3e-3), origin='xyz="0 0.1 -0.2" rpy="-0.5 0.4 1.2"'),
        link("tool", 0.7, origin='xyz="0.05 0 0" rpy="0 0 0.7"'),
        link("slider", 0.5),
        joint("mount", "base", "shoulder", "fixed", origin='xyz="0 0.3 0.1" rpy="0.3 0 -0.2"'),
        joint("turn", "shoulder", "arm", "continuous", "1 2 0.5", 'xyz="0.1 0 0" rpy="0 0.5 1.5707963267948966"'),
        joint("flange", "arm", "tool", "fixed", origin='xyz="0 0.2 -0.4" rpy="1 -0.3 0.2"'),
        joint("extend", "tool", "slider", "prismatic", "0 1 0", 'xyz="0 0 -0.1" rpy="0.2 0 0"'),
    )
    system = jk.convert.from_urdf(text, floating=True)
    assert set(system.mass) == {"base", "arm", "slider"}  # the tool is part of the arm
    apart = jk.convert.from_urdf(text, floating=True, merge_fixed=False)
    assert set(apart.mass) == {"base", "arm", "tool", "slider"}
    free = '<link name="world"/><joint name="root" type="floating"><parent link="world"/><child link="base"/></joint>'
    options = '<mujoco><compiler fusestatic="false"/></mujoco></robot>'
    model = mujoco.MjModel.from_xml_string(text.replace("</robot>", free + options))
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    mujoco.mj_integratePos(model, data.qpos, rng.normal(size=model.nv), 1.0)
    data.qvel[:] = rng.normal(size=model.nv)
    mujoco.mj_forward(model, data)
    q = np.array(data.qpos)
    q[3:7] = np.roll(q[3:7], -1)
    np.testing.assert_allclose(jk.accelerations(system, 0.0, q, data.qvel), data.qacc, rtol=RTOL, atol=RTOL)
    tool = jk.positions(system, 0.0, q, data.qvel)["tool"]
    np.testing.assert_allclose(tool, data.body("tool").xpos, rtol=RTOL)


def test_links_with_fixed_joints_become_one_body():
    """Inertia about the common mass centre: I1 + I2 + m1 m2 / (m1 + m2) (d.d 1 - d d)."""
    text = robot(
        link("base"),
        link("arm", 2.0, (0.02, 0.03, 0.04), origin='xyz="0 0 0.1"'),
        link("box", 0.5, (0.001, 0.002, 0.0025), origin='xyz="0.1 0 0" rpy="0 0 0.3"'),
        joint("j", "base", "arm"),
        joint("f", "arm", "box", "fixed", origin='xyz="0 0.2 0.3" rpy="0.4 0 0"'),
    )
    system = jk.convert.from_urdf(text)
    in_arm = Rotation.from_euler("xyz", [0.4, 0.0, 0.0]).as_matrix()
    first, second = np.array([0.0, 0.0, 0.1]), np.array([0.0, 0.2, 0.3]) + in_arm @ [0.1, 0.0, 0.0]
    turn, d = in_arm @ Rotation.from_euler("z", 0.3).as_matrix(), second - first
    I = np.diag([0.02, 0.03, 0.04]) + turn @ np.diag([0.001, 0.002, 0.0025]) @ turn.T
    I += 2.0 * 0.5 / 2.5 * (d @ d * np.eye(3) - np.outer(d, d))
    body = system.motion(0.0, [0.0], [0.0]).bodies[0]
    np.testing.assert_allclose(np.array(body.inertia, float), I, rtol=1e-13)
    assert (body.name, float(body.mass)) == ("arm", 2.5)
    center = [float(system.center["arm"].get(x, 0.0)) for x in "xyz"]
    np.testing.assert_allclose(center, (2.0 * first + 0.5 * second) / 2.5, rtol=1e-13)


def test_a_massless_root_link_is_merged_with_its_fixed_child():
    text = robot(link("base"), link("trunk", 3.0), joint("f", "base", "trunk", "fixed", origin='xyz="0 0 0.5"'))
    system = jk.convert.from_urdf(text, floating=True)
    assert dict(system.mass) == {"trunk": 3.0}
    with pytest.raises(ValueError, match=r"nothing can move. Pass floating=True"):
        jk.convert.from_urdf(text)


def test_planar_and_floating_joints():
    text = robot(
        link("world"),
        link("cart", 2.0),
        link("bird", 0.5),
        joint("rail", "world", "cart", "planar", "0 0 1", 'rpy="0 0 1.5707963267948966"'),
        joint("wing", "cart", "bird", "floating", origin='xyz="0 0 1"'),
    )
    system = jk.convert.from_urdf(text)
    assert system.coordinates[:3] == ("rail_x", "rail_y", "rail_angle")
    assert system.coordinates[3:] == ("wing_x", "wing_y", "wing_z", *(f"wing_e{i}" for i in (1, 2, 3, 4)))
    q, u = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.0, 0.0, 0.0, 1.0]), np.zeros(len(system.speeds))
    places = jk.positions(system, 0.0, q, u)
    np.testing.assert_allclose(places["cart"], [-0.2, 0.1, 0.0], atol=1e-15)
    turn = Rotation.from_euler("z", np.pi / 2 + 0.3).as_matrix()
    np.testing.assert_allclose(places["bird"], [-0.2, 0.1, 0.0] + turn @ [0.4, 0.5, 1.6], rtol=1e-12)
    on_ground = robot(link("world"), link("bird", 0.5), joint("wing", "world", "bird", "floating"))
    assert jk.convert.from_urdf(on_ground).speeds[:2] == ("wing_vx", "wing_vy")


@pytest.mark.slow
def test_nested_mimic_joints_and_joints_without_mass():
    mimic = '<mimic joint="{}" multiplier="{}" offset="{}"/>'
    text = robot(
        link("base"),
        *(link(x, 1.0) for x in "abc"),
        link("d"),
        link("e"),
        joint("ja", "base", "a"),
        joint("jb", "base", "b", more=mimic.format("ja", -3, 0.1)),
        joint("jc", "base", "c", more=mimic.format("jb", 2, 0)),
        joint("jd", "c", "d"),
        joint("je", "c", "e", more=mimic.format("jd", 1, 0)),
    )
    with pytest.warns(UserWarning, match="joints that move no mass: jd, je"):
        system = jk.convert.from_urdf(text)
    assert (system.speeds, system.dependent_speeds) == (("ja_rate",), ("jb_rate", "jc_rate"))
    M = jk.mass_matrix(system, 0.0, jk.assemble(system, {"ja": 0.2}).q, [0.0])
    np.testing.assert_allclose(M, [[0.04 * (1 + 9 + 36)]], rtol=1e-12)


def test_limits_friction_and_damping():
    more = '<dynamics damping="0.3" friction="0.02"/><limit lower="-1" upper="2" effort="1" velocity="1"/>'
    text = robot(link("base"), link("wheel", 2.0), joint("j", "base", "wheel", more=more))
    with pytest.warns(UserWarning, match="limits of joints; friction of joints"):
        system = jk.convert.from_urdf(text)
    assert (system.left_out, float(system.damping["j"])) == (("limits of joints", "friction of joints"), 0.3)
    system = jk.convert.from_urdf(text, stops=True, friction=True, strict=True)
    contacts = system.contacts(0.0, [0.5], [0.1], None)
    assert list(contacts) == ["j lower", "j upper", "j friction"]
    assert (float(contacts["j upper"].gap), float(contacts["j friction"].kinetic)) == (1.5, 0.02)
    with pytest.raises(ValueError, match=r"`friction` contains x, which is not .* with friction are: j"):
        jk.convert.from_urdf(text, friction=["x"])
    wheels = [part for x in "abc" for part in (link(x, 1.0), joint(f"j{x}", "base", x, more=more))]
    with pytest.raises(ValueError, match=r"9 contacts.* the limits of ja, jb, jc and the dry friction of ja, jb, jc"):
        jk.convert.from_urdf(robot(link("base"), *wheels), stops=True, friction=True)


TWO = (link("base"), link("a", 1.0), joint("ja", "base", "a", axis="1 0 0"))
"""A link that turns about x. A further link on it about y has several axes."""


def further(moments):
    return robot(*TWO, link("b", 1.0, moments), joint("jb", "a", "b", axis="0 1 0"))


def test_small_violations_of_the_inertia_inequality_are_accepted_or_reported(recwarn):
    jk.convert.from_urdf(further((0.1, 0.1, 0.2003)))
    assert not recwarn
    with pytest.warns(UserWarning, match=r"r: inertias of the file:\n  b: principal moments 0.1, 0.1, 0.205 .*2.4 %"):
        system = jk.convert.from_urdf(further((0.1, 0.1, 0.205)))
    assert float(system.inertia["b"]["zz"]) == 0.205


@pytest.mark.parametrize("moments", [(0.1, 0.1, 0.3), (-0.01, 0.2, 0.2), (0.0, 0.0, -0.1)])
def test_impossible_inertias_are_refused_or_replaced(moments):
    with pytest.raises(ValueError, match=r'impossible inertias:\n  b: principal moments .*\n.*inertias="nearest"'):
        jk.convert.from_urdf(further(moments))
    if sum(moments) < 0:  # no possible inertia is near
        with pytest.raises(ValueError, match="impossible inertias"):
            jk.convert.from_urdf(further(moments), inertias="nearest")
        return
    with pytest.warns(UserWarning, match="b: .*; nearest: "):
        system = jk.convert.from_urdf(further(moments), inertias="nearest")
    # second moments: those below 0.5 % of the sum of the positive ones become 0.5 % of it
    sigma = 0.5 * sum(moments) - np.array(moments)
    sigma = np.maximum(sigma, 5e-3 * np.maximum(sigma, 0.0).sum())
    found = [float(system.inertia["b"][ij]) for ij in ("xx", "yy", "zz")]
    np.testing.assert_allclose(found, sigma.sum() - sigma, rtol=1e-12)
    assert max(found) < sum(found) - max(found)  # with a margin, so that a fit can start there
    with pytest.raises(ValueError, match='"refuse" or "nearest", got \'ignore\''):
        jk.convert.from_urdf(further(moments), inertias="ignore")


def test_impossible_inertias_without_effect_are_accepted():
    """A link that turns about one axis keeps its moment about this axis; one that only slides has no inertia."""
    parts = link("b", 1.0, (0.1, 0.1, 0.5)), joint("jb", "a", "b", axis="1 0 0", origin='rpy="0.4 0 0"')
    with pytest.warns(UserWarning, match="only its moment about the axis"):
        system = jk.convert.from_urdf(robot(*TWO, *parts))
    found = [float(system.inertia["b"][ij]) for ij in ("xx", "yy", "zz")]
    np.testing.assert_allclose(found, [0.1, 0.05, 0.05], rtol=1e-12)
    slider = robot(link("base"), link("s", 1.0, (0.1, 0.1, 0.5)), joint("j", "base", "s", "prismatic"))
    with pytest.warns(UserWarning, match="only its moment about the axis"):
        jk.accelerations(jk.convert.from_urdf(slider), 0.0, [0.0], [0.0])
    on_ground = robot(link("base", 1.0, (0.1, 0.1, 0.5)), link("arm", 1.0), joint("j", "base", "arm"))
    assert set(jk.convert.from_urdf(on_ground, strict=True).mass) == {"arm"}


def test_rounded_zero_inertias_are_omitted_and_balanceinertia_is_applied():
    text = robot(*TWO, link("b", 1.0, (-5e-20, -5e-20, 0.0)), joint("jb", "a", "b", axis="0 1 0", origin='xyz="0 1 0"'))
    assert "b" not in jk.convert.from_urdf(text, strict=True).inertia
    balanced = further((0.1, 0.1, 0.4)).replace(
        "</robot>", '<mujoco><compiler balanceinertia="true"/></mujoco></robot>'
    )
    with pytest.warns(UserWarning, match="balanced: 0.2, 0.2, 0.2"):
        system = jk.convert.from_urdf(balanced)
    assert float(system.inertia["b"]["xx"]) == pytest.approx(0.2)


LOOP = robot(link("a", 1.0), link("b", 1.0), joint("j", "a", "b"), joint("k", "b", "a"))
MIMIC = ONE.replace("</joint>", '<mimic joint="{}"/></joint>')


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<robot><link>", "not a URDF: .*Check whether the file is complete"),
        (ONE[:-20], "not a URDF"),
        ("<mujoco/>", r"its root must be <robot>, got <mujoco>"),
        ('<robot name="r"/>', "r: the URDF has no link"),
        (
            ONE.replace("<robot", '<robot xmlns:xacro="x"').replace("</robot>", "<xacro:leg/></robot>"),
            "Expand them first",
        ),
        (ONE.replace('value="2.0"', 'value="${m}"'), "macros of xacro"),
        (ONE.replace('value="2.0"', 'value="nan"'), r'link \'arm\': <mass value="nan"> must be a finite number'),
        (ONE.replace('value="2.0"', 'value="-2"'), r"link 'arm': the mass is -2.0 kg; it must not be negative"),
        (ONE.replace('value="2.0"', 'value="2,0"'), "must be a finite number"),
        (ONE.replace('<mass value="2.0"/>', ""), "link 'arm': <inertial> has no <mass>"),
        (ONE.replace("</inertial>", "</inertial><inertial/>"), r"link 'arm': the link has 2 <inertial>\. Keep one"),
        (ONE.replace('iyy="0.03"', ""), "link 'arm': <inertia> has no iyy"),
        (ONE.replace('axis xyz="0 0 1"', 'axis xyz="0 0"'), "joint 'j': <axis xyz=\"0 0\"> must be 3 finite numbers"),
        (ONE.replace('axis xyz="0 0 1"', 'axis xyz="0 0 0"'), "joint 'j': the axis is zero"),
        (ONE.replace('type="revolute"', 'type="hinge"'), "joint 'j': the type must be one of .*; got 'hinge'"),
        (ONE.replace('<parent link="base"/>', ""), r"joint 'j': <parent link=\"...\"/> is missing"),
        (
            ONE.replace('<parent link="base"/>', '<parent link="foot"/>'),
            "joint 'j': There is no 'foot' in the links; there are base, arm",
        ),
        (
            ONE.replace('<origin xyz="0 0 0"/>\n     <axis', '<origin rpy="0 0 90"/><axis'),
            'rpy="0 0 90" exceeds a full',
        ),
        (ONE.replace("</joint>", '<limit lower="-90" upper="90"/></joint>'), "limits -90 and 90 are in degrees"),
        (ONE.replace("</joint>", '<dynamics damping="-1"/></joint>'), "joint 'j': the damping is -1.0; it must not"),
        (robot(link("a"), link("b")), "must have one root link; this one has a, b. Connect them"),
        (robot(link("a"), link("a")), "the links 'a' and 'a' are equal"),
        (robot(link("tool_tip"), link("tool.tip")), "would both be 'tool_tip'"),
        (LOOP, "one root link; this one has none. The joints form a loop"),
        (LOOP.replace("</robot>", '<link name="c"/></robot>'), "the joints j, k form a loop"),
        (robot(*TWO, joint("jb", "base", "a")), "the joints 'ja' and 'jb' both carry the link 'a'"),
        (MIMIC.format("x"), "'j' cannot mimic 'x': "),
        (MIMIC.format("j"), "the joints j mimic each other in a circle"),
    ],
)
def test_a_file_that_is_not_a_robot_is_rejected(text, words):
    with pytest.raises(ValueError, match=words):
        jk.convert.from_urdf(text)


def test_meshes_comments_and_extensions_are_ignored():
    """Meshes need not exist, and a comment may contain a macro."""
    shape = '<visual><geometry><mesh filename="package://nowhere/a.stl"/></geometry></visual></link>'
    extension = "<!-- <xacro:leg/> ${x} --><drake:group name='g'/></robot>"
    text = ONE.replace("</inertial></link>", "</inertial>" + shape).replace("</robot>", extension)
    assert jk.convert.from_urdf(text, strict=True).left_out == ()
    text = text.replace("visual>", "collision>").replace("</robot>", "<transmission/><gazebo/></robot>")
    with pytest.warns(UserWarning, match="contacts; transmissions; extensions of Gazebo"):
        jk.convert.from_urdf("\ufeff\n" + text)


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace(
            "</robot>", '<ros2_control><param min="${-2*pi}">${x}</param></ros2_control></robot>'
        ),
        lambda text: text.replace("<robot", '<robot xmlns="http://example.org"'),
        lambda text: '\n<?xml version="1.0"?>\n' + text,
    ],
    ids=["macro in an element that is not read", "default namespace", "empty first line"],
)
def test_files_that_other_programs_read_are_read(change):
    system, expected = jk.convert.from_urdf(change(ONE)), jk.convert.from_urdf(ONE)
    assert jax.tree.leaves(system) == jax.tree.leaves(expected)
    assert system.structure == expected.structure


def test_a_gimbal_without_mass_has_moments_of_inertia():
    """Accelerations by Pinocchio 4.1."""
    inertial = '<inertial><mass value="{}"/><origin xyz="{}"/><inertia ixx="{}" iyy="{}" izz="{}"/></inertial>'
    text = (
        '<robot name="r"><link name="base"/>'
        f'<link name="gimbal">{inertial.format(0, "0 0 0", 0.002, 0.003, 0.004)}</link>'
        f'<link name="arm">{inertial.format(2, "0.1 0 0.2", 0.02, 0.03, 0.04)}</link>'
        '<joint name="a" type="continuous"><parent link="base"/><child link="gimbal"/><axis xyz="0 1 0"/></joint>'
        '<joint name="b" type="continuous"><parent link="gimbal"/><child link="arm"/><axis xyz="1 0 0"/></joint>'
        "</robot>"
    )
    found = jk.accelerations(jk.convert.from_urdf(text), 0.0, [0.3, -0.4], [0.2, 0.5])
    np.testing.assert_allclose(found, [22.516, -11.081], atol=5e-4)


def test_a_urdf_file_is_read_and_its_names_are_converted(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text("\ufeff" + ONE.replace('"arm"', '"fore.arm"'), encoding="utf-8")
    assert set(jk.convert.from_urdf(path).mass) == {"fore_arm"}
    assert type(jk.convert.from_urdf(str(path), name="Arm")).__name__ == "Arm"
    with pytest.raises(FileNotFoundError, match=r"'nowhere.urdf' does not exist"):
        jk.convert.from_urdf("nowhere.urdf")
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="is not text in UTF-8"):
        jk.convert.from_urdf(path)
    with pytest.raises(ValueError, match="'world' is the ground: omit floating=True"):
        jk.convert.from_urdf(ONE.replace('"base"', '"world"'), floating=True)


def test_a_shape_with_an_error_is_omitted_with_a_warning():
    visual = '<visual><geometry><cylinder radius="0.1"/></geometry></visual>'
    text = ONE.replace('<link name="base"/>', f'<link name="base">{visual}</link>')
    with pytest.warns(UserWarning, match=r"a shape: link 'base': <cylinder length=\"\"> must be a finite number"):
        system = jk.convert.from_urdf(text)
    assert len(system.left_out) == 1


def test_the_numbers_of_a_links_shape_must_be_exact():
    def mass_of(radius):
        link = jk.joints.Link("a", joints=jk.joints.hinge("j", (0, 1, 0)), mass=1.0, shape=jk.shapes.sphere(radius))
        return jk.joints.mechanism([link]).mass["a"]

    with pytest.raises(TypeError, match="A shape of 'a' is part of the structure and must be concrete"):
        jax.grad(mass_of)(0.1)
