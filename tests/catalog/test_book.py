"""Every system of Kamman, Volume II, Unit 5, against its printed final equations.

The printed equations are typed by hand below, as left side minus right side at given accelerations; they are affine
in the accelerations, so that their matrix and right side are read off and compared with M and f of Kane's method. Where
the book multiplies an equation by a factor, `ROW_FACTORS` says what M and f must be multiplied by to meet it.
"""

import jax
import numpy as np
import pytest
from numpy import cos, sin

import jaxkane as jk
from jaxkane import catalog

RTOL = 1e-12
# Under jit, where inertias are not checked: those drawn or given at random need not be a body's.
accelerations = jax.jit(jk.accelerations)
equations_of_motion = jax.jit(jk.equations_of_motion)


def example_1(p, t, q, u, a, w):
    m, l, g = p["mass"], p["length"], p["gravity"]
    (th1, th2), (th1d, th2d), (th1dd, th2dd) = q, u, a
    M1, M2 = w["shoulder_torque"], w["elbow_torque"]
    C21, S21 = cos(th2 - th1), sin(th2 - th1)
    return [
        4 / 3 * m * l**2 * th1dd
        + 1 / 2 * m * l**2 * C21 * th2dd
        - 1 / 2 * m * l**2 * S21 * th2d**2
        + 3 / 2 * m * g * l * sin(th1)
        - (M1 - M2),
        1 / 2 * m * l**2 * C21 * th1dd
        + 1 / 3 * m * l**2 * th2dd
        + 1 / 2 * m * l**2 * S21 * th1d**2
        + 1 / 2 * m * g * l * sin(th2)
        - M2,
    ]


def example_2(p, t, q, u, a, w):
    m, I11, I22, I33 = p["mass"], p["I11"], p["I22"], p["I33"]
    u, v, w_, w1, w2, w3 = u
    ud, vd, wd, w1d, w2d, w3d = a
    return [
        m * (ud + w2 * w_ - w3 * v) - w["force1"],
        m * (vd + w3 * u - w1 * w_) - w["force2"],
        m * (wd + w1 * v - w2 * u) - w["force3"],
        I11 * w1d + (I33 - I22) * w2 * w3 - w["torque1"],
        I22 * w2d + (I11 - I33) * w1 * w3 - w["torque2"],
        I33 * w3d + (I22 - I11) * w1 * w2 - w["torque3"],
    ]


def example_3(p, t, q, u, a, w):
    m, l, d = p["mass"], p["length"], p["distance"]
    (_, th), (phid, thd), (phidd, thdd) = q, u, a
    return [
        (1 / 12 * m * l**2 * cos(th) ** 2 + m * d**2) * phidd
        - 1 / 6 * m * l**2 * sin(th) * cos(th) * thd * phid
        - w["frame_torque"],
        1 / 12 * m * l**2 * thdd + 1 / 12 * m * l**2 * sin(th) * cos(th) * phid**2 - w["bar_torque"],
    ]


def example_4(p, t, q, u, a, w):
    m, l, d = p["mass"], p["length"], p["distance"]
    (_, th), (vG, w2), (vGd, w2d) = q, u, a
    return [
        (m * d + 1 / (12 * d) * m * l**2 * cos(th) ** 2) * vGd
        - 1 / (6 * d) * m * l**2 * sin(th) * cos(th) * w2 * vG
        - w["frame_torque"],
        1 / 12 * m * l**2 * w2d + 1 / (12 * d**2) * m * l**2 * sin(th) * cos(th) * vG**2 - w["bar_torque"],
    ]


def example_5(p, t, q, u, a, w):
    mA, mE = p["airframe_mass"], p["engine_mass"]
    xE, yE, zE = p["engine_x"], p["engine_y"], p["engine_z"]
    xA, zA = -2 * mE * xE / mA, -2 * mE * zE / mA
    IxxE, IyyE = p["engine_axial_inertia"], p["engine_transverse_inertia"]
    # The aircraft about G: parallel axes. The book's I_xz is minus the matrix entry.
    Ixx = p["airframe_Ixx"] + mA * zA**2 + 2 * (IxxE + mE * (yE**2 + zE**2))
    Iyy = p["airframe_Iyy"] + mA * (xA**2 + zA**2) + 2 * (IyyE + mE * (xE**2 + zE**2))
    Izz = p["airframe_Izz"] + mA * xA**2 + 2 * (IyyE + mE * (xE**2 + yE**2))
    Ixz = -p["airframe_Ixz"] + mA * xA * zA + 2 * mE * xE * zE
    E1d, E2d = p["engine1_acceleration"], p["engine2_acceleration"]
    E1, E2 = p["engine1_speed"] + E1d * t, p["engine2_speed"] + E2d * t
    mT = mA + 2 * mE
    u, v, w_, w1, w2, w3 = u
    ud, vd, wd, w1d, w2d, w3d = a
    return [
        mT * (ud + w2 * w_ - w3 * v) - w["force1"],
        mT * (vd + w3 * u - w1 * w_) - w["force2"],
        mT * (wd + w1 * v - w2 * u) - w["force3"],
        Ixx * w1d - Ixz * w3d + IxxE * E1d + IxxE * E2d + (Izz - Iyy) * w2 * w3 - Ixz * w1 * w2 - w["torque1"],
        Iyy * w2d + (Ixx - Izz) * w1 * w3 + Ixz * (w1**2 - w3**2) + IxxE * (E1 + E2) * w3 - w["torque2"],
        Izz * w3d - Ixz * w1d + (Iyy - Ixx) * w1 * w2 + Ixz * w2 * w3 - IxxE * (E1 + E2) * w2 - w["torque3"],
    ]


def matrix_313(th):
    (S1, S2, S3), (C1, C2, C3) = sin(th), cos(th)
    return np.array(
        [
            [C1 * C3 - S1 * C2 * S3, S1 * C3 + C1 * C2 * S3, S2 * S3],
            [-C1 * S3 - S1 * C2 * C3, -S1 * S3 + C1 * C2 * C3, S2 * C3],
            [S1 * S2, -C1 * S2, C2],
        ]
    )


def example_6(p, t, q, u, a, w):
    m1, m2, l1, l2, g = p["mass1"], p["mass2"], p["length1"], p["length2"], p["gravity"]
    I111, I122, I133 = p["I11_1"], p["I22_1"], p["I33_1"]
    I211, I222, I233 = p["I11_2"], p["I22_2"], p["I33_2"]
    R1, R2 = matrix_313(q[:3]), matrix_313(q[3:])
    w11, w12, w13, w21, w22, w23 = u
    w11d, w12d, w13d, w21d, w22d, w23d = a
    first = np.array([w13d - w11 * w12, w13**2 + w11**2, -(w11d + w12 * w13)])
    second = np.array([w23d - w21 * w22, w23**2 + w21**2, -(w21d + w22 * w23)])
    return [
        (I111 + m1 * l1**2 / 4 + m2 * l1**2) * w11d
        + (I133 + m1 * l1**2 / 4 - I122 + m2 * l1**2) * w12 * w13
        - 1 / 2 * m2 * l1 * l2 * R1[2] @ R2.T @ second
        - (m1 / 2 + m2) * g * l1 * R1[2, 1],
        I122 * w12d + (I111 - I133) * w11 * w13,
        (I133 + m1 * l1**2 / 4 + m2 * l1**2) * w13d
        + (I122 - I111 - m1 * l1**2 / 4 - m2 * l1**2) * w11 * w12
        + 1 / 2 * m2 * l1 * l2 * R1[0] @ R2.T @ second
        + (m1 / 2 + m2) * g * l1 * R1[0, 1],
        (I211 + m2 * l2**2 / 4) * w21d
        + (I233 + m2 * l2**2 / 4 - I222) * w22 * w23
        - 1 / 2 * m2 * l1 * l2 * R2[2] @ R1.T @ first
        - 1 / 2 * m2 * g * l2 * R2[2, 1],
        I222 * w22d + (I211 - I233) * w21 * w23,
        (I233 + m2 * l2**2 / 4) * w23d
        + (I222 - I211 - m2 * l2**2 / 4) * w21 * w22
        + 1 / 2 * m2 * l1 * l2 * R2[0] @ R1.T @ first
        + 1 / 2 * m2 * g * l2 * R2[0, 1],
    ]


def exercise_5_1(p, t, q, u, a, w):
    m, l, mp, k, c, g = (p[x] for x in ("mass", "length", "piston_mass", "stiffness", "damping", "gravity"))
    (th,), (thd,), (thdd,) = q, u, a
    S, C = sin(th), cos(th)
    return [
        (1 / 3 * m * l**2 + mp * l**2 * S**2) * thdd
        + mp * l**2 * S * C * thd**2
        + c * l**2 * C**2 * thd
        + k * l**2 * S * C
        - (mp * g + 1 / 2 * m * g + w["force"]) * l * S
    ]


def exercise_5_2(p, t, q, u, a, w):
    m1, m2, l, k, c, g = (p[x] for x in ("slider_mass", "bar_mass", "length", "stiffness", "damping", "gravity"))
    (x, th), (xd, thd), (xdd, thdd) = q, u, a
    S, C = sin(th), cos(th)
    return [
        (m1 + m2) * xdd + m2 * l * C / 2 * thdd - m2 * l * S / 2 * thd**2 + c * xd + k * x - w["force"],
        m2 * l * C / 2 * xdd + 1 / 3 * m2 * l**2 * thdd + 1 / 2 * m2 * g * l * S,
    ]


def exercise_5_3(p, t, q, u, a, w):
    m, l, ms, r = p["mass"], p["length"], p["shaft_mass"], p["shaft_radius"]
    (_, th), (phid, thd), (phidd, thdd) = q, u, a
    S, C = sin(th), cos(th)
    return [
        (ms * r**2 / 2 + m * l**2 * S**2 / 12) * phidd + m * l**2 * S * C / 6 * thd * phid - w["shaft_torque"],
        m * l**2 / 12 * thdd - m * l**2 * S * C / 12 * phid**2 - w["bar_torque"],
    ]


def exercise_5_4(p, t, q, u, a, w):
    m, l = p["mass"], p["length"]
    (_, th), (w1, w2), (w1d, w2d) = q, u, a
    S, C = sin(th), cos(th)
    return [
        m * l**2 / 12 * S * w1d + m * l**2 / 12 * C * w1 * w2 + w["shaft_torque"],
        m * l**2 / 12 * w2d - m * l**2 * C / (12 * S) * w1**2 - w["bar_torque"],
    ]


def exercise_5_5(p, t, q, u, a, w):
    md, R, m, l, b = p["disk_mass"], p["disk_radius"], p["mass"], p["length"], p["pin_radius"]
    k, c, g = p["stiffness"], p["damping"], p["gravity"]
    (_, th), (phid, thd), (phidd, thdd) = q, u, a
    S, C = sin(th), cos(th)
    return [
        (md * R**2 / 2 + m * (b + l * S / 2) ** 2 + m * l**2 * S**2 / 12) * phidd
        + (m * b * l * C + 2 / 3 * m * l**2 * S * C) * thd * phid
        - w["disk_torque"],
        m * l**2 / 3 * thdd
        - (m * b * l * C / 2 + m * l**2 * S * C / 3) * phid**2
        + c * thd
        + k * th
        + m * g * l * S / 2
        - w["bar_torque"],
    ]


def exercise_5_6(p, t, q, u, a, w):
    m, L, g, I, I3 = p["mass"], p["distance"], p["gravity"], p["transverse_inertia"], p["axial_inertia"]
    (e1, e2, e3, e4), (w1, w2, w3), (w1d, w2d, w3d) = q, u, a
    return [
        (I + m * L**2) * w1d + (I3 - I - m * L**2) * w2 * w3 - 2 * m * g * L * (e2 * e3 + e1 * e4),
        (I + m * L**2) * w2d + (I + m * L**2 - I3) * w1 * w3 - 2 * m * g * L * (e2 * e4 - e1 * e3),
        I3 * w3d,  # omega3 = constant
    ]


def exercise_5_7(p, t, q, u, a, w):
    mA, mD, b = p["frame_mass"], p["disk_mass"], p["distance"]
    I11A, I22A, I33A = p["frame_I11"], p["frame_I22"], p["frame_I33"]
    I11D, I22D, I33D = p["disk_transverse_inertia"], p["disk_axial_inertia"], p["disk_transverse_inertia"]
    (_, th, _), (w1, w2, _), (w1d, w2d, wDd) = q, u, a
    S, C = sin(th), cos(th)
    w3 = -w1 * C / S  # omega1 = -phi_dot S, omega3 = phi_dot C
    w3d = -w1d * C / S + w1 * w2 / S**2
    I1, I3 = I11A + mA * b**2 + I11D + 4 * mD * b**2, I33A + mA * b**2 + I33D + 4 * mD * b**2
    return [
        -I1 * S * w1d + I3 * C * w3d - I1 * C * w1 * w2 - I3 * S * w2 * w3 - w["column_torque"],
        (I22A + I22D) * w2d + I22D * wDd + (I11A - I33A) * w1 * w3 - w["frame_torque"],
        I22D * (w2d + wDd) - w["disk_torque"],
    ]


def exercise_5_8(p, t, q, u, a, w):
    m, L, g = p["mass"], p["length"], p["gravity"]
    FA1, FA3, FB = w["tip_force1"], w["tip_force3"], w["arm_force"]
    (S1, S2, S3), (C1, C2, C3) = sin(q), cos(q)
    (w1, w2, w3), (w1d, w2d, w3d) = u, a
    mLL = m * L**2
    return [
        7 / 12 * mLL * w1d + 7 / 12 * mLL * w2 * w3 - (L * FA3 + L * FB / 2 + m * g * L * S1 * C2),
        1 / 12 * mLL * w2d - 1 / 12 * mLL * w1 * w3 - (-L * FB / 2),
        2 / 3 * mLL * w3d - 1 / 2 * mLL * w1 * w2 - (-L * FA1 + m * g * L * (C1 * S3 + S1 * S2 * C3)),
    ]


PRINTED = {
    "DoublePendulum": example_1,
    "RigidBody": example_2,
    "RotatingFrameAndBar": example_3,
    "RotatingFrameAndBarChosenSpeeds": example_4,
    "Aircraft": example_5,
    "AircraftEulerParameters": example_5,
    "SpatialDoublePendulum": example_6,
    "BarWithPiston": exercise_5_1,
    "SliderWithPinnedBar": exercise_5_2,
    "ShaftAndBar": exercise_5_3,
    "LightShaftAndBar": exercise_5_4,
    "DiskAndBar": exercise_5_5,
    "SpinningTop": exercise_5_6,
    "ColumnFrameAndDisk": exercise_5_7,
    "Bracket": exercise_5_8,
}

ROW_FACTORS = {
    "RotatingFrameAndBarChosenSpeeds": lambda p, q: [p["distance"], 1.0],
    "LightShaftAndBar": lambda p, q: [sin(q[1]), 1.0],
    "ColumnFrameAndDisk": lambda p, q: [-sin(q[1]), 1.0, 1.0],
}


def random_example(name, rng):
    """The catalogue's example with parameters, state and inputs drawn about it."""
    entry = catalog.CATALOG[name]
    system = jax.tree.map(lambda x: x * rng.uniform(0.7, 1.4), entry.example())
    q = np.array(entry.q) + rng.uniform(-0.2, 0.2, len(entry.q))
    i = list(system.coordinates).index("e1") if "e1" in system.coordinates else None
    if i is not None:
        q[i:] /= np.linalg.norm(q[i:])
    u = np.array(entry.u) * rng.uniform(-1.5, 1.5, len(entry.u))
    inputs = {name: rng.uniform(-3.0, 3.0) for name in system.inputs}
    return system, rng.uniform(0.0, 5.0), q, u, inputs


@pytest.mark.optimized
@pytest.mark.published
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", PRINTED)
def test_equations_of_motion_agree_with_the_printed_ones(name, seed, published):
    system, t, q, u, inputs = random_example(name, np.random.default_rng(seed))
    p = {key: float(value) for key, value in vars(system).items()}
    n = len(u)

    def left_minus_right(a):
        return np.array(PRINTED[name](p, t, q, u, a, inputs))

    b = -left_minus_right(np.zeros(n))
    A = np.stack([left_minus_right(a) + b for a in np.eye(n)], axis=1)
    M, f = map(np.asarray, equations_of_motion(system, t, q, u, inputs))
    factors = np.array(ROW_FACTORS[name](p, q) if name in ROW_FACTORS else np.ones(n))
    # The rows have units of their own, so each is held to its own size; a right side may be a small difference.
    for row_M, row_f, row_A, row_b in zip(factors[:, None] * M, factors * f, A, b, strict=True):
        np.testing.assert_allclose(row_M, row_A, rtol=0, atol=RTOL * np.abs(row_A).max())
        np.testing.assert_allclose(row_f, row_b, rtol=0, atol=RTOL * (np.abs(row_A).max() + np.abs(row_b)))
    u_dot = np.asarray(accelerations(system, t, q, u, inputs))
    np.testing.assert_allclose(u_dot, np.linalg.solve(A, b), rtol=0, atol=RTOL * np.linalg.cond(A) * abs(u_dot).max())
    what = "final equations of Examples 1 to 6, Exercises 5.1 to 5.8"
    published("Kamman, Volume II, Unit 5", what, f"at random states, {RTOL:.0e}")


def test_every_entry_of_the_book_is_compared_with_its_printed_equations():
    of_the_book = {name for name, entry in catalog.CATALOG.items() if entry.book.startswith(("Example", "Exercise"))}
    assert of_the_book - {"WhippleBicycle"} == set(PRINTED)  # the bicycle is tested by itself


def test_rates_of_euler_parameters_agree_with_the_printed_ones():
    # Example 2 and Exercise 5.6: {eps_dot} = 1/2 [E']^T {omega1, omega2, omega3, 0}
    e1, e2, e3, e4 = q = np.array(catalog.CATALOG["SpinningTop"].q)
    u = np.array([0.8, -0.6, 4.0])
    E = np.array([[e4, -e3, e2, e1], [e3, e4, -e1, e2], [-e2, e1, e4, e3], [-e1, -e2, -e3, e4]])
    q_dot = jk.coordinate_rates(catalog.SpinningTop(), 0.0, q, u)
    np.testing.assert_allclose(q_dot, 0.5 * E @ [*u, 0.0], rtol=1e-14)


def test_rates_of_angles_agree_with_the_printed_ones():
    # Example 6, note 3
    q, u = np.array(catalog.CATALOG["SpatialDoublePendulum"].q), np.array([0.7, -0.4, 0.5, -0.6, 0.3, 0.9])
    q_dot = np.array(jk.coordinate_rates(catalog.SpatialDoublePendulum(), 0.0, q, u))
    for (_, th2, th3), (w1, w2, w3), rates in zip(q.reshape(2, 3), u.reshape(2, 3), q_dot.reshape(2, 3), strict=True):
        printed = [
            (w1 * sin(th3) + w2 * cos(th3)) / sin(th2),
            w1 * cos(th3) - w2 * sin(th3),
            w3 - (w1 * sin(th3) + w2 * cos(th3)) * cos(th2) / sin(th2),
        ]
        np.testing.assert_allclose(rates, printed, rtol=1e-13)


@pytest.mark.parametrize(
    ("name", "q"),
    [
        ("Aircraft", [0, 0, 0, 0.3, np.pi / 2, 0.1]),
        ("SpatialDoublePendulum", [0.3, 0.0, 0.1, 0.3, 0.0, 0.1]),
        ("LightShaftAndBar", [0.3, 0.0]),
        ("ColumnFrameAndDisk", [0.3, 0.0, 0.2]),
        ("Bracket", [0.3, np.pi / 2, 0.1]),
    ],
)
def test_events_cross_zero_at_gimbal_lock(name, q):
    system = getattr(catalog, name)()

    def events(q):
        return np.array([float(x) for x in system.events(0.0, q, [0.0] * len(system.speeds)).values()])

    second = [i for i, x in enumerate(system.coordinates) if x in ("theta", "theta2", "theta12", "theta22")]
    step = np.zeros(len(q))
    step[second] = 0.1
    np.testing.assert_allclose(events(np.array(q)), 0.0, atol=1e-15)
    assert np.all(events(np.array(q) + step) * events(np.array(q) - step) < 0)
