"""Animations: everything is where the description says, and the page shows it, in a browser and without one."""

import base64
import json
import re
import tempfile
import time

import browser
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import moved
from PIL import Image
from scipy.spatial.transform import Rotation

import jaxkane as jk

needs_a_browser = pytest.mark.skipif(browser.PROGRAM is None, reason=browser.WHY_NOT)
SPEED = 5.0  # of the bicycle [m/s]


@pytest.fixture(scope="module")
def ride():
    """A bicycle that weaves gently for ten seconds; (system, trajectory)."""
    system = jk.catalog.WhippleBicycle.benchmark()
    t = np.linspace(0.0, 10.0, 1001)
    q, u, u_dep = np.zeros((1001, 8)), np.zeros((1001, 3)), np.zeros((1001, 3))
    q[:, 0], q[:, 2], q[:, 6] = 0.1 * np.sin(2 * t), 0.05 * np.sin(2 * t), SPEED * t
    u[:, 1], u_dep[:, 2] = -SPEED / float(system.rR), -SPEED / float(system.rF)
    q[:, 1], q[:, 5] = u[:, 1] * t, u_dep[:, 2] * t
    return system, moved(system, t, q, u, u_dep)


@pytest.fixture(scope="module")
def weaving(ride):
    return jk.animate(*ride)


@pytest.fixture(scope="module")
def swing():
    """A double pendulum, animated; (system, trajectory, animation)."""
    system, t = jk.catalog.DoublePendulum(), np.linspace(0.0, 2.0, 81)
    q = np.stack([0.6 * np.cos(3 * t), -0.4 * np.cos(5 * t)], axis=1)
    trajectory = moved(system, t, q, np.zeros((81, 2)))
    return system, trajectory, jk.animate(system, trajectory)


def shapes(animation, kind):
    return [shape for shape in animation.scene.shapes if shape.kind == kind]


@pytest.mark.slow
def test_bodies_and_points_have_the_positions_of_the_system(swing):
    """1e-12, at a time of the trajectory. N.y is up, so it is the page's z."""
    system, trajectory, animation = swing
    x, _ = animation.scene.at(trajectory.t[40])
    motion = system.motion(trajectory.t[40], trajectory.q[40], jnp.zeros(2))
    for shape in [*shapes(animation, "center"), *shapes(animation, "dot")]:
        part = motion["A" if shape.label == "O" else shape.label]
        place = np.zeros(3) if shape.label == "O" else getattr(part, "center", part).position.to(motion.N)
        right, up, towards = np.asarray(place)
        np.testing.assert_allclose(x[0, shape.first], [right, -towards, up], atol=1e-12)
    assert {shape.label for shape in shapes(animation, "center")} == {"link1", "link2"}


def test_consecutive_quaternions_are_continuous():
    """Through several turns of the first link."""
    system, turns = jk.catalog.DoublePendulum(), np.linspace(0.0, 30.0, 200)
    ride = moved(system, turns, np.stack([turns, 0.0 * turns], axis=1), np.zeros((200, 2)))
    e = jk.animate(system, ride).scene.rotation
    assert np.linalg.norm(np.diff(e, axis=0), axis=-1).max() == pytest.approx(2.0 * np.sin(30.0 / 199 / 4), rel=0.05)


def test_a_body_is_drawn_as_the_uniform_solid_with_its_inertia(swing):
    """1e-12: a slender link of 1 m; a cylinder with I = m r^2 / 2 along its axis; a box from its three moments."""
    rods = [s for s in shapes(swing[2], "line") if s.color != "grey"]
    vertex = swing[2].scene.vertex
    assert [np.linalg.norm(np.ptp(vertex[s.first : s.first + s.count], axis=0)) for s in rods] == pytest.approx(
        [1.0, 1.0]
    )

    top, t = jk.catalog.SpinningTop(mass=2.0, axial_inertia=0.01, transverse_inertia=0.02), np.linspace(0.0, 1.0, 41)
    q = np.stack([0.2 * np.sin(t), np.zeros(41), np.zeros(41), np.sqrt(1.0 - (0.2 * np.sin(t)) ** 2)], axis=1)
    scene = jk.animate(top, moved(top, t, q, np.zeros((41, 3)))).scene
    rim = next(s for s in scene.shapes if s.closed)
    place = scene.vertex[rim.first : rim.first + rim.count]
    np.testing.assert_allclose(np.hypot(place[:, 0], place[:, 1]), np.sqrt(2 * 0.01 / 2.0), rtol=1e-12)
    assert abs(place[0, 2]) == pytest.approx(0.5 * np.sqrt(12 * (0.02 - 0.01 / 2) / 2.0))

    sides = np.array([0.4, 0.9, 1.3])
    I = (np.sum(sides**2) - sides**2) / 12 * 3.0
    body = jk.catalog.RigidBody(mass=3.0, I11=I[0], I22=I[1], I33=I[2])
    q = np.stack([t, 0 * t, 0 * t, np.sin(t / 2), 0 * t, 0 * t, np.cos(t / 2)], axis=1)
    box = jk.animate(body, moved(body, t, q, np.zeros((41, 6)))).scene
    corners = np.concatenate([box.vertex[s.first : s.first + 4] for s in box.shapes if s.closed])
    np.testing.assert_allclose(np.sort(np.ptp(corners, axis=0)), sides, rtol=1e-12)


def test_points_at_fixed_distance_are_connected_by_lines(swing):
    """From the origin through the first link to the joint, and on to the second link's middle."""
    scene = swing[2].scene
    x, _ = scene.at(scene.t)
    joined = [s for s in scene.shapes if s.kind == "line" and s.color == "grey"]
    ends = {tuple(np.round(x[0, [s.first, s.first + 1]], 9).ravel()) for s in joined}
    lengths = [np.linalg.norm(x[:, s.first] - x[:, s.first + 1], axis=1) for s in joined]
    assert len(ends) == 3
    np.testing.assert_allclose(lengths, 0.5, rtol=1e-12)


@pytest.mark.slow
def test_spokes_rotate_with_the_wheel_angle(ride, weaving):
    """0.03 rad: the spokes turn by the wheel's angle, which the pose of its frame does not hold."""
    scene, system = weaving.scene, ride[0]
    spokes = [s for s in scene.shapes if s.kind == "pairs"]
    for s, radius in zip(spokes, (system.rR, system.rF), strict=True):
        k = scene.owner[s.first]
        axis = np.array([0.0, 1.0, 0.0])
        x, _ = scene.at([0.0, 0.1])
        before, after = x[:, s.first + 1] - x[:, s.first]
        assert np.linalg.norm(before) == pytest.approx(float(radius))
        assert k < scene.rotation.shape[1]
        # 0.1 s is too short for the weave to turn the wheel's plane by more than 0.02 rad
        turned = np.arctan2(np.cross(before, after) @ axis, before @ after) % (2 * np.pi)
        assert turned == pytest.approx(0.1 * SPEED / float(radius) % (2 * np.pi), abs=0.03)


def test_the_bicycle_is_drawn_on_the_ground_and_followed_by_the_camera(weaving):
    scene = weaving.scene
    x, center_of_mass = scene.at(np.linspace(0.0, 10.0, 50))
    tracks = [s.first for s in scene.shapes if s.kind == "trace"]
    np.testing.assert_allclose(x[:, tracks[0], 2], 0.0, atol=1e-6)
    assert scene.ground == pytest.approx(0.0, abs=0.01)
    assert scene.view.follow
    assert np.ptp(center_of_mass[:, 0]) == pytest.approx(50.0, rel=1e-3)


def test_custom_figure_has_the_correct_positions(swing):
    """Lines keep their places whatever they are fixed in: a body, the ground, or nothing (1e-9 m)."""
    system, trajectory, _ = swing

    def figure(system, motion, s):
        N, A, link = motion.N, motion["A"].position, motion["link2"]
        s.line("red", motion["O"], motion["A"], link)  # turns with no single body
        s.line("#123456", A - 0.1 * N.x, A + 0.1 * N.x)  # carried without turning
        s.circle("blue", link, link.frame.x, link.frame.y, 0.2, fill=0.5)
        s.line("grey", -1.0 * N.x, 1.0 * N.x)
        s.axes(link, link.frame, 0.3)
        s.trace("gold", link)

    scene = jk.animate(system, trajectory, figure, up="z").scene
    x, _ = scene.at(trajectory.t[30])
    motion = system.motion(trajectory.t[30], trajectory.q[30], jnp.zeros(2))
    A, G = (np.asarray(p.position.to(motion.N)) for p in (motion["A"], motion["link2"].center))
    red, carried, circle, ground = (x[0, s.first : s.first + s.count] for s in scene.shapes[:4])
    np.testing.assert_allclose(red, [np.zeros(3), A, G], atol=1e-9)
    np.testing.assert_allclose(carried - A, [[-0.1, 0, 0], [0.1, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(circle - G, axis=1), 0.2, atol=1e-9)
    np.testing.assert_allclose(ground[:, 0], [-1.0, 1.0])
    assert [s.color for s in scene.shapes[4:7]] == ["red", "green", "blue"]


def test_the_page_is_small_and_has_no_external_resources(weaving):
    """At most 300 kB for ten seconds."""
    page = weaving.html()
    assert len(page.encode()) < 300e3
    assert not re.search(r"https?:|\bsrc=|@import|<link", page)
    scene = json.loads(re.search(r'application/json">(.*?)</script>', page, re.DOTALL).group(1))
    position = np.frombuffer(base64.b64decode(scene["position"]), "<f4").reshape(-1, scene["parts"], 3)
    np.testing.assert_allclose(position, weaving.scene.position, atol=1e-5)
    frame = weaving._repr_html_()
    assert frame.startswith("<iframe srcdoc=")
    assert '"' not in frame.split('srcdoc="')[1].split('" title=')[0]


def test_invalid_arguments_of_animate_are_rejected(ride, swing, tmp_path):
    system, trajectory, animation = swing
    two = jax.tree.map(lambda x: jnp.stack([x, x]), trajectory)
    with pytest.raises(ValueError, match="is a batch of shape"):
        jk.animate(system, two)
    with pytest.raises(ValueError, match="belongs to another system"):
        jk.animate(ride[0], trajectory)
    with pytest.raises(ValueError, match="must be positive"):
        jk.animate(system, trajectory, speed=0.0)
    with pytest.raises(ValueError, match="`fps` must be positive and finite, got -1"):
        animation.save(tmp_path / "swing.gif", fps=-1.0)
    with pytest.raises(ValueError, match=r"\.html .* or \.gif"):
        animation.save(tmp_path / "swing.mp4")
    with pytest.raises(ValueError, match="reached only 0"):
        jk.animate(system, jax.tree.map(lambda x: x * jnp.nan if x.dtype == float else x, trajectory))


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_a_gif_contains_every_colour_of_its_theme(swing, tmp_path, theme):
    path = jk.animate(*swing[:2], theme=theme).save(tmp_path / "swing.gif", size=(200, 160), seconds=1.0, fps=10)
    with Image.open(path) as image:
        assert image.n_frames == 10
        assert image.size == (200, 160)
        assert image.info["duration"] == 100
        first = np.asarray(image.convert("RGB")).astype(int)
        image.seek(5)
        assert np.any(np.asarray(image.convert("RGB")) != first)
    paper = first[0, 0].mean()
    assert (paper > 240) if theme == "light" else (paper < 40)
    warm = (first[..., 0] - first[..., 2]) > 60  # gold
    cold = (first[..., 2] - first[..., 0]) > 60  # blue
    assert warm.sum() > 40
    assert cold.sum() > 40


class Sprung(jk.System):
    """A particle between a spring and a damper, and a turning carrier without mass."""

    coordinates, speeds = ("x", "angle"), ("x_dot", "rate")

    def motion(self, t, q, u):
        N, O = jk.inertial()
        B = N.rotate(3, q["angle"], u["rate"])
        mass, wall = O.moving(q["x"] * N.x, u["x_dot"] * N.x), O.fixed(-1.0 * N.x)
        bodies = [jk.Body(1.0, 0.0, mass, name="mass"), jk.Body(0.0, 0.0, mass, B, name="carrier")]
        return jk.Motion(bodies, points={"wall": wall, "end": O.fixed(2.0 * N.x)})

    def loads(self, t, q, u, motion, inputs):
        mass, wall = motion["mass"], motion["wall"]
        beside = jk.loads.damper(wall, mass, 0.5), jk.loads.spring(mass, wall, 40.0, 1.0)
        return jk.weight(motion, -9.81 * motion.N.y), *beside, jk.loads.damper(mass, motion["end"], 1.0)


def test_springs_dampers_and_bodies_without_inertia_are_drawn(tmp_path):
    t = np.linspace(0.0, 1.0, 21)
    q = np.stack([0.3 * np.sin(4.0 * t), 2.0 * t], axis=1)
    animation = jk.animate(Sprung(), moved(Sprung(), t, q, np.zeros((21, 2))))
    x, _ = animation.scene.at(t[5])
    (spring,) = shapes(animation, "spring")
    ends = x[0, spring.first : spring.first + 2, 0]
    np.testing.assert_allclose(sorted(ends), [-1.0, q[5, 0]], atol=1e-12)
    lines = [np.ptp(x[0, s.first : s.first + s.count], axis=0) for s in shapes(animation, "line") if s.color == "grey"]
    np.testing.assert_allclose(lines, [[2.0 - q[5, 0], 0.0, 0.0]], atol=1e-12)  # not the damper beside the spring
    assert {s.color for s in shapes(animation, "line")} == {"grey", "red", "green", "blue"}  # the axes of the carrier
    assert {(s.label, s.width) for s in shapes(animation, "center")} == {("mass", 9.0)}
    assert np.isfinite(animation.scene.vertex).all()
    animation.save(tmp_path / "spring.gif", size=(200, 160), seconds=0.2)


class Bob(jk.System):
    """A particle on a string from a rail. The particle has no frame, so the string is a line that moves."""

    radius: jk.Scalar = jk.parameter(0.2)
    has_shapes = True
    coordinates, speeds = ("angle",), ("rate",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        bob = O.fixed(-0.5 * N.rotate(3, q["angle"], u["rate"]).y)
        string = jk.shapes.line((0, 0, 0), O.position_from(bob).components_in(N), color="grey")
        rail = jk.shapes.cylinder(0.01, 2.0, axes=((0, 1, 0), (0, 0, 1), (1, 0, 0)))
        shape = [jk.shapes.sphere(self.radius), string] if self.has_shapes else ()
        ground = jk.Body(0.0, 0.0, O, N, name="ground", shape=rail)
        return jk.Motion([jk.Body(1.0, 0.0, bob, name="bob", shape=shape), *([ground] if self.has_shapes else [])])

    def loads(self, t, q, u, motion, inputs):
        return jk.weight(motion, -9.81 * motion.N.y)


class WithoutShapes(Bob):
    has_shapes = False


def ends_of(scene, t, shape):
    x, _ = scene.at(t)
    return x[0, shape.first : shape.first + shape.count]


@pytest.fixture(scope="module")
def bob_on_a_string():
    t = np.linspace(0.0, 1.0, 21)
    return jk.animate(Bob(radius=0.3), moved(Bob(), t, np.sin(3.0 * t)[:, None], np.zeros((21, 1))))


def width_of_ball(pixels):
    """The ball is the only part that is gold or orange."""
    return np.ptp(np.flatnonzero((pixels[..., 0] - pixels[..., 2] > 20).any(axis=0)))


def test_declared_shapes_are_drawn_instead_of_solids_and_frames(bob_on_a_string, tmp_path):
    """1e-12, with N.y up, which is the page's z. A GIF shows the ball with its radius, within 3 pixels."""
    animation, t = bob_on_a_string, bob_on_a_string.scene.t
    scene = animation.scene
    (ball,), bob = shapes(animation, "ball"), 0.5 * np.array([np.sin(np.sin(3 * t[4])), 0, -np.cos(np.sin(3 * t[4]))])
    center, *surface = ends_of(scene, t[4], ball)
    np.testing.assert_allclose(center, bob, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(surface - bob, axis=1), 0.3, rtol=1e-12)
    string = next(s for s in shapes(animation, "line") if s.count == 2)
    np.testing.assert_allclose(ends_of(scene, t[4], string), [bob, np.zeros(3)], atol=1e-12)
    (sides,) = shapes(animation, "pairs")
    np.testing.assert_allclose(np.ptp(ends_of(scene, t[4], sides), axis=0), [2.0, 0.02, 0.02], atol=1e-12)
    assert {s.color for s in scene.shapes} == {"gold", "grey"}  # the ground is grey, and has no axes
    with Image.open(animation.save(tmp_path / "bob.gif", size=(300, 300), seconds=0.05)) as image:
        seen = np.asarray(image.convert("RGB")).astype(int)
    assert width_of_ball(seen) == pytest.approx(300 * 0.6 / scene.view.span, abs=3)


@pytest.mark.slow
def test_shapes_do_not_change_the_equations_of_motion():
    source = jk.export.numpy(Bob())
    assert source.replace("Bob", "WithoutShapes") == jk.export.numpy(WithoutShapes())


def test_shapes_of_a_urdf_are_drawn():
    """1e-12: a base without mass, an arm with its mass centre at 0.3 m, and a mesh, which is omitted."""
    place = '<origin xyz="0 0 {}" rpy="0 {} 0"/>'.format
    visual = "<visual>{}<geometry><{}/></geometry></visual>".format
    inertial = '<inertial><origin xyz="0 0 0.3"/><mass value="2"/><inertia ixx="0.1" iyy="0.1" izz="0.1"/></inertial>'
    arm = visual(place(0.3, np.pi / 2), 'cylinder radius="0.05" length="0.6"') + visual(
        place(0.6, 0), 'sphere radius="0.1"'
    )
    arm += visual("", 'mesh filename="package://none.dae"')
    text = f"""<robot name="r"><link name="base">{visual(place(-0.1, 0), 'box size="0.4 0.5 0.2"')}</link>
     <link name="arm">{inertial}{arm}</link>
     <joint name="j" type="revolute"><parent link="base"/><child link="arm"/>{place(0.05, 0)}<axis xyz="0 1 0"/></joint>
     </robot>"""
    system, t = jk.convert.from_urdf(text), np.linspace(0.0, 1.0, 21)
    animation = jk.animate(system, moved(system, t, t[:, None], np.zeros((21, 1))))
    scene, turned = animation.scene, Rotation.from_euler("y", t[7])
    assert {s.label for s in scene.shapes} == {"", "base", "base shape", "arm"}
    faces = [ends_of(scene, t[7], s) for s in shapes(animation, "line") if s.fill == 0.08]
    np.testing.assert_allclose(np.ptp(np.concatenate(faces), axis=0), [0.4, 0.5, 0.2], atol=1e-12)
    np.testing.assert_allclose(np.mean(faces, axis=(0, 1)), [0.0, 0.0, -0.1], atol=1e-12)
    (sides,) = shapes(animation, "pairs")
    in_arm = turned.inv().apply(ends_of(scene, t[7], sides) - [0.0, 0.0, 0.05])
    np.testing.assert_allclose(
        [in_arm.min(axis=0), in_arm.max(axis=0)], [[-0.3, -0.05, 0.25], [0.3, 0.05, 0.35]], atol=1e-7
    )
    (ball,) = shapes(animation, "ball")
    center, *surface = turned.inv().apply(ends_of(scene, t[7], ball) - [0.0, 0.0, 0.05])
    np.testing.assert_allclose(center, [0.0, 0.0, 0.6], atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(surface - center, axis=1), 0.1, rtol=1e-12)


@pytest.mark.slow
def test_shapes_of_an_mjcf_file_are_drawn():
    pytest.importorskip("mujoco")
    geoms = """<geom type="box" size=".1 .2 .3" pos="1 0 0" euler="0 0 90"/><geom type="capsule" fromto="0 0 0 0 .5 0"
     size=".02"/><geom size=".4" group="3"/><geom size=".3" pos="0 0 1"/>"""
    body = f'<body name="a" pos="0 0 2"><joint axis="0 0 1"/>{geoms}</body>'
    options = '<option><flag contact="disable"/></option>'
    system = jk.convert.from_mjcf(f"<mujoco>{options}<worldbody>{body}</worldbody></mujoco>")
    t = np.linspace(0.0, 1.0, 11)
    animation = jk.animate(system, moved(system, t, 0.0 * t[:, None], np.zeros((11, 1))))
    faces = np.concatenate([ends_of(animation.scene, 0.0, s) for s in shapes(animation, "line") if s.fill == 0.08])
    np.testing.assert_allclose([faces.min(0), faces.max(0)], [[0.8, -0.1, 1.7], [1.2, 0.1, 2.3]], atol=1e-6)
    (sides,), (ball,) = shapes(animation, "pairs"), shapes(animation, "ball")
    np.testing.assert_allclose(np.ptp(ends_of(animation.scene, 0.0, sides), axis=0), [0.04, 0.5, 0.04], atol=1e-6)
    np.testing.assert_allclose(ends_of(animation.scene, 0.0, ball)[0], [0.0, 0.0, 3.0], atol=1e-6)


def test_invalid_shapes_are_rejected():
    N, O = jk.inertial()
    with pytest.raises(TypeError, match=r"ball: `shape` must be a shape such as jk.shapes.sphere\(0.1\)"):
        jk.Body(1.0, 0.0, O, N, name="ball", shape=0.1)
    with pytest.raises(ValueError, match="edges of a box must be three numbers"):
        jk.shapes.box((1.0, 2.0))
    with pytest.raises(ValueError, match="centre of a sphere must be three numbers"):
        jk.shapes.sphere(0.1, (0.0, 1.0))
    with pytest.raises(TypeError, match="must be one number"):
        jk.shapes.sphere("0.1")


@pytest.fixture(scope="module")
def page():
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder, browser.Page(folder) as page:
        yield page


LOOKED = "document.getElementById('time').textContent > ''"


def pixels(page, tmp_path):
    with Image.open(page.screenshot(tmp_path / "screen.png")) as image:
        return np.asarray(image.convert("RGB")).astype(int)


@needs_a_browser
@pytest.mark.parametrize("dark", [False, True])
def test_a_browser_draws_the_animation_on_light_and_dark_pages(weaving, page, tmp_path, dark):
    page.show(weaving.save(tmp_path / "ride.html"), dark)
    page.wait(LOOKED)
    seen = pixels(page, tmp_path)
    paper, ink = ((16, 20, 29), (238, 241, 246)) if dark else ((251, 252, 254), (29, 36, 48))
    assert tuple(seen[60, 450]) == paper
    for color in (ink, (240, 171, 69) if dark else (179, 107, 0)):  # wheels, frame
        assert (np.abs(seen - color).max(axis=-1) < 12).sum() > 300
    assert page.errors == []


@needs_a_browser
def test_a_browser_draws_a_ball_with_its_radius(bob_on_a_string, page, tmp_path):
    """Within 3 pixels. Without tracks, which have the colour of the ball."""
    page.show(bob_on_a_string.save(tmp_path / "bob.html"))
    page.wait(LOOKED)
    page.key("t")
    page.value("(() => { const v = canvas.viewer; v.state.playing = false; v.state.time = 0; v.draw(); })()")
    size = min(page.value("[canvas.clientWidth, canvas.clientHeight]"))
    expected = size * 0.6 / bob_on_a_string.scene.view.span
    assert width_of_ball(pixels(page, tmp_path)) == pytest.approx(expected, abs=3)
    assert page.errors == []


@needs_a_browser
def test_all_controls_are_visible_on_a_phone(weaving, page, tmp_path):
    page("Emulation.setDeviceMetricsOverride", width=390, height=844, deviceScaleFactor=1, mobile=False)
    page.show(weaving.save(tmp_path / "ride.html"))
    page.wait(LOOKED)
    assert page.value("document.documentElement.scrollWidth") <= 390
    right = "Math.max(...[...document.querySelectorAll('#bar > *')].map(x => x.getBoundingClientRect().right))"
    assert page.value(right) < 390
    page("Emulation.setDeviceMetricsOverride", width=900, height=560, deviceScaleFactor=1, mobile=False)


@needs_a_browser
def test_the_projection_in_a_browser_equals_that_of_the_library(weaving, page, tmp_path):
    """Within 0.05 pixels: places are kept in 32 bits and orientations in 16."""
    page.show(weaving.save(tmp_path / "ride.html"))
    page.wait(LOOKED)
    page.value("(() => { const v = canvas.viewer; v.state.playing = false; v.state.time = 3.217; v.draw(); })()")
    width, height = page.value("[canvas.clientWidth, canvas.clientHeight]")
    view = weaving.scene.view
    x, center_of_mass = weaving.scene.at(3.217)
    r = (x[0] - center_of_mass[0]) / view.span_following
    turn = Rotation.from_euler("ZY", [view.azimuth, -view.elevation])  # x towards the eye, y to the right, z up
    near, right, up = turn.inv().apply(r).T
    p = np.stack([right, up], axis=1) / (1.0 - near[:, None] / 3.0)
    expected = np.array([width / 2, height / 2]) + min(width, height) * p * [1, -1]
    seen = np.array(page.value(f"Array.from({{length: {len(p)}}}, (_, v) => canvas.viewer.see(v))"))
    np.testing.assert_allclose(seen[:, :2], expected, atol=0.05)


@needs_a_browser
def test_mouse_and_keys_control_the_view_in_a_browser(weaving, page, tmp_path):
    page.show(weaving.save(tmp_path / "ride.html"))
    page.wait(LOOKED)
    state = lambda: page.value("canvas.viewer.state")  # noqa: E731
    before = state()
    page.mouse("mousePressed", 300, 200, button="left", clickCount=1)
    page.mouse("mouseMoved", 400, 250, button="left", buttons=1)
    page.mouse("mouseReleased", 400, 250, button="left", clickCount=1)
    page.mouse("mouseWheel", 300, 200, deltaX=0, deltaY=-300)
    page.wait("canvas.viewer.state.zoom > 1")
    after = state()
    assert after["azimuth"] == pytest.approx(before["azimuth"] - 0.8)
    assert after["elevation"] == pytest.approx(before["elevation"] + 0.4)
    page.key(" ")
    assert not state()["playing"]
    # At once: a frame that is still awaited would set the slider back to its own time.
    page.value("(slider => { slider.value = 500; slider.oninput() })(document.getElementById('slider'))")
    assert state()["time"] == pytest.approx(5.0, abs=1e-6)
    page.key("r")
    assert state()["zoom"] == 1
    assert page.errors == []


@needs_a_browser
def test_the_animation_is_drawn_only_when_visible(weaving, page, tmp_path):
    """In a notebook's frame far down a page: drawn only when it is scrolled to."""
    path = tmp_path / "notebook.html"
    path.write_text(
        f'<!doctype html><div style="height: 5000px"></div>{weaving._repr_html_().replace(" loading=", " x=")}'
    )
    page.show(path)
    shown = "document.querySelector('iframe').contentDocument.getElementById('time')?.textContent ?? null"
    page.wait(f"({shown}) !== null")
    time.sleep(0.3)
    assert page.value(shown) == ""
    page.value("document.querySelector('iframe').scrollIntoView()")
    page.wait(f"({shown}) > ''")
    assert page.errors == []


class Pushed(jk.System):
    """A point mass that a motor pushes, late."""

    coordinates, speeds, states = ("x",), ("v",), ("push",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        return jk.Motion([jk.Body(1.0, 0.0, O.moving(q["x"] * N.x, u["v"] * N.x))])

    def loads(self, t, q, u, motion, inputs):
        [body] = motion.bodies
        return [jk.weight(motion, -9.81 * motion.N.y), jk.Force(inputs["push"] * motion.N.x, body)]

    def state_rates(self, t, q, u, x, motion, now):
        return (10.0 - x["push"],)


@pytest.mark.slow
def test_up_is_opposite_to_the_weight_of_a_system_whose_loads_depend_on_states():
    """A motion along x with a weight along -y is seen from the front."""
    system, ts = Pushed(), np.linspace(0.0, 1.0, 3)
    scene = jk.animate(system, moved(system, ts, ts[:, None], np.ones((3, 1)))).scene
    np.testing.assert_allclose(scene.at(1.0)[1], [[1.0, 0.0, 0.0]], atol=1e-12)
    assert scene.ground is None or scene.ground <= 0.0
