"""The bicycle of `assemblies` with all its parts in SymPy, by `KanesMethod`: a peer of the native kernel.

The same coordinates, speeds, states and signs as `jaxkane.bicycles`, in the same order: a leaning rider, tyres that
slip with relaxation, a geared motor that lags. Dependent speeds are part of the state, as in `bicycle_in_sympy`.
"""

from __future__ import annotations

import time

import sympy as sm
import sympy.physics.mechanics as me

from .bicycle_in_sympy import COORDINATES, PARAMETERS, Derived

ALL_COORDINATES = (*COORDINATES, "rider_lean")
INDEPENDENT = ("roll_rate", "rear_wheel_rate", "steer_rate", "rear_lateral_slip", "front_lateral_slip", "lean_rate")
ALL_SPEEDS = (*INDEPENDENT, "yaw_rate", "pitch_rate", "front_wheel_rate")
STATES = ("rear_deflection", "front_deflection", "motor_torque")
MORE = {
    **{name: f"rider.{name}" for name in "mass x z Ixx Iyy Izz Ixz hinge_x hinge_z stiffness damping".split()},
    **{f"{end}_cornering": f"{end}_tyre.lateral.cornering_stiffness" for end in ("rear", "front")},
    **{f"{end}_camber": f"{end}_tyre.lateral.camber_stiffness" for end in ("rear", "front")},
    "relaxation": "rear_tyre.lateral.relaxation_length",
    **{name: f"steering.{name}" for name in ("lag", "ratio", "rotor_inertia")},
}
"""Parameters of the parts: the symbol's name, and the parameter's in jaxkane."""


def derive() -> Derived:
    began = time.perf_counter()
    q, u, x = (me.dynamicsymbols([f"{name}_" for name in names]) for names in (ALL_COORDINATES, ALL_SPEEDS, STATES))
    roll, rear_angle, steer, yaw, pitch, front_angle, _, _, lean = q
    roll_rate, rear_rate, steer_rate, rear_slip, front_slip, lean_rate, yaw_rate, pitch_rate, front_rate = u
    names = (*PARAMETERS, *(f"part_{name}" for name in MORE))
    p = sm.symbols(names, real=True)
    b = dict(zip(PARAMETERS, p))
    r = dict(zip(MORE, p[len(PARAMETERS) :]))

    N, Y, R, B, T, C, H, A, D, U, M = (me.ReferenceFrame(name) for name in "NYRBTCHADUM")
    Y.orient_axis(N, N.z, yaw)
    R.orient_axis(Y, Y.x, roll)
    B.orient_axis(R, R.y, pitch)
    T.orient_axis(B, B.y, b["lam"])
    C.orient_axis(T, T.z, steer)
    H.orient_axis(C, C.y, -b["lam"])
    A.orient_axis(B, B.y, rear_angle)
    D.orient_axis(C, C.y, front_angle)
    U.orient_axis(B, B.x, lean)
    turning = ((Y, N, yaw_rate * N.z), (R, Y, roll_rate * Y.x), (B, R, pitch_rate * R.y), (C, T, steer_rate * T.z))
    turning += ((A, B, rear_rate * B.y), (D, C, front_rate * C.y), (U, B, lean_rate * B.x))
    for frame, parent, rate in (*turning, (M, T, r["ratio"] * steer_rate * T.z)):
        frame.set_ang_vel(parent, rate)

    cos, sin = sm.cos(b["lam"]), sm.sin(b["lam"])
    xS = (b["w"] + b["c"]) * cos * cos - b["rR"] * sin * cos
    zS = xS * sin / cos
    from_S = lambda x, z: (x - xS) * H.x + (z + b["rR"] + zS) * H.z  # noqa: E731
    P, G_A = me.Point("P"), me.Point("G_A")
    P.set_vel(N, rear_slip * Y.y)
    G_A.set_pos(P, -b["rR"] * R.z)
    G_A.set_vel(N, rear_slip * Y.y + A.ang_vel_in(N).express(B).cross((-b["rR"] * R.z).express(B)))
    G_B = G_A.locatenew("G_B", b["xB"] * B.x + (b["zB"] + b["rR"]) * B.z)
    S = G_A.locatenew("S", xS * B.x - zS * B.z)
    hinge = G_A.locatenew("hinge", r["hinge_x"] * B.x + (r["hinge_z"] + b["rR"]) * B.z)
    G_U = hinge.locatenew("G_U", (r["x"] - r["hinge_x"]) * U.x + (r["z"] - r["hinge_z"]) * U.z)
    G_C = S.locatenew("G_C", from_S(b["xH"], b["zH"]))
    G_D = S.locatenew("G_D", from_S(b["w"], -b["rF"]))
    fixed = ((G_B, G_A, B), (S, G_A, B), (hinge, G_A, B), (G_U, hinge, U), (G_C, S, C), (G_D, S, C))
    for point, base, frame in fixed:
        point.v2pt_theory(base, N, frame)

    down = [N.z.dot(C.x), N.z.dot(C.z)]
    cos_camber, sin_camber = sm.sqrt(down[0] ** 2 + down[1] ** 2), C.y.dot(N.z)
    below = (down[0] * C.x + down[1] * C.z) / cos_camber
    Q = G_D.locatenew("Q", b["rF"] * below)
    v_Q = G_D.vel(N) + D.ang_vel_in(N).cross(b["rF"] * below)
    Q.set_vel(N, v_Q)
    heading = C.y.cross(N.z) / cos_camber
    across = N.z.cross(heading)
    omega = D.ang_vel_in(N)
    spin = omega.dot(C.y) - omega.dot(below) / cos_camber * sin_camber

    fork = me.inertia(H, b["IHxx"], b["IHyy"], b["IHzz"], izx=b["IHxz"])
    rear, front = me.inertia(B, b["IRxx"], b["IRyy"], b["IRxx"]), me.inertia(C, b["IFxx"], b["IFyy"], b["IFxx"])
    frame = me.inertia(B, b["IBxx"], b["IByy"], b["IBzz"], izx=b["IBxz"])
    rider = me.inertia(U, r["Ixx"], r["Iyy"], r["Izz"], izx=r["Ixz"])
    heavy = [
        me.RigidBody("rear_wheel", G_A, A, b["mR"], (rear, G_A)),
        me.RigidBody("rear_frame", G_B, B, b["mB"], (frame, G_B)),
        me.RigidBody("fork", G_C, C, b["mH"], (fork.express(C), G_C)),
        me.RigidBody("front_wheel", G_D, D, b["mF"], (front, G_D)),
        me.RigidBody("rider", G_U, U, r["mass"], (rider, G_U)),
    ]
    motor = me.RigidBody("motor", S, M, 0, (me.inertia(T, 0, 0, r["rotor_inertia"]), S))
    rates = (roll_rate, rear_rate, steer_rate, yaw_rate, pitch_rate, front_rate, lean_rate)
    kane = me.KanesMethod(
        N,
        q_ind=[*q[:4], q[5], lean],
        q_dependent=[pitch],
        u_ind=u[:6],
        u_dependent=u[6:],
        kd_eqs=[rate - angle.diff() for angle, rate in zip((*q[:6], lean), rates)],
        configuration_constraints=[Q.pos_from(P).dot(N.z)],
        velocity_constraints=[v_Q.dot(across) - front_slip, v_Q.dot(N.z), v_Q.dot(heading)],
        constraint_solver="CRAMER",
    )
    slip = [deflection / r["relaxation"] for deflection in x[:2]]
    sideways = [(P, r["rear_cornering"] * slip[0] * Y.y), (Q, r["front_cornering"] * slip[1] * across)]
    held = -r["stiffness"] * lean - r["damping"] * lean_rate
    torques = [(U, held * B.x), (B, -held * B.x), (C, x[2] * C.z), (B, -x[2] * C.z)]
    weights = [(body.masscenter, body.mass * b["g"] * N.z) for body in heavy]
    kane.kanes_equations([*heavy, motor], [*weights, *sideways, *torques])

    forward = -b["rR"] * (rear_rate + pitch_rate)
    equivalent = [r[f"{end}_camber"] / r[f"{end}_cornering"] for end in ("rear", "front")]
    x_dot = (
        -rear_slip - sm.Abs(forward) * (slip[0] - equivalent[0] * roll),
        -front_slip - sm.Abs(b["rF"] * spin) * (slip[1] - equivalent[1] * sm.atan2(sin_camber, cos_camber)),
        -x[2] / r["lag"],
    )
    place = [forward * sm.cos(yaw) - rear_slip * sm.sin(yaw), forward * sm.sin(yaw) + rear_slip * sm.cos(yaw)]
    q_dot = [*rates[:6], *place, lean_rate]
    seconds = time.perf_counter() - began
    return Derived(kane, kane.mass_matrix, kane.forcing, q_dot, q, u, list(p), seconds, tuple(x), x_dot)
