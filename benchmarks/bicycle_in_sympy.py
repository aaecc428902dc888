"""The nonlinear Whipple bicycle in SymPy, by `sympy.physics.mechanics.KanesMethod`: what jaxkane is measured against.

The same bicycle, coordinates, speeds and signs as `jaxkane.catalog.WhippleBicycle`, written as SymPy's users write
it; vectors are resolved in the frames that gave the fewest operations. The dependent speeds are part of the state,
which spares SymPy's code their solution.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import sympy as sm
import sympy.physics.mechanics as me

COORDINATES = ("roll", "rear_wheel_angle", "steer", "yaw", "pitch", "front_wheel_angle", "x", "y")
SPEEDS = ("roll_rate", "rear_wheel_rate", "steer_rate", "yaw_rate", "pitch_rate", "front_wheel_rate")
PARAMETERS = tuple(
    "w c lam rR mR IRxx IRyy xB zB mB IBxx IByy IBzz IBxz xH zH mH IHxx IHyy IHzz IHxz rF mF IFxx IFyy g".split()
)


class Derived(NamedTuple):
    """M (6, 6) and f (6,) of M u_dot = f for all speeds, three of Kane's equations and three constraints; rates of
    the coordinates (8,); symbols of coordinates, speeds and parameters in their order; seconds that it took; states of
    the first order and their rates, where there are such."""

    kane: me.KanesMethod
    M: sm.Matrix
    f: sm.Matrix
    q_dot: list[sm.Expr]
    q: list[Any]
    u: list[Any]
    p: list[sm.Symbol]
    seconds: float
    x: tuple[Any, ...] = ()
    x_dot: tuple[sm.Expr, ...] = ()


@functools.cache
def derive() -> Derived:
    began = time.perf_counter()
    q, u = me.dynamicsymbols(" ".join(COORDINATES)), me.dynamicsymbols(" ".join(SPEEDS))
    roll, rear_angle, steer, yaw, pitch, front_angle, _, _ = q
    roll_rate, rear_rate, steer_rate, yaw_rate, pitch_rate, front_rate = u
    p = sm.symbols(PARAMETERS, real=True)
    v = dict(zip(PARAMETERS, p))

    N = me.ReferenceFrame("N")
    Y, R, B, T, C, H, A, D = (me.ReferenceFrame(name) for name in "YRBTCHAD")
    Y.orient_axis(N, N.z, yaw)
    R.orient_axis(Y, Y.x, roll)
    B.orient_axis(R, R.y, pitch)
    T.orient_axis(B, B.y, v["lam"])
    C.orient_axis(T, T.z, steer)
    H.orient_axis(C, C.y, -v["lam"])
    A.orient_axis(B, B.y, rear_angle)
    D.orient_axis(C, C.y, front_angle)
    Y.set_ang_vel(N, yaw_rate * N.z)
    R.set_ang_vel(Y, roll_rate * Y.x)
    B.set_ang_vel(R, pitch_rate * R.y)
    C.set_ang_vel(T, steer_rate * T.z)
    A.set_ang_vel(B, rear_rate * B.y)
    D.set_ang_vel(C, front_rate * C.y)

    # S is on the steer axis, where the front assembly is fixed to; places upright, from the rear contact.
    cos, sin = sm.cos(v["lam"]), sm.sin(v["lam"])
    xS = (v["w"] + v["c"]) * cos * cos - v["rR"] * sin * cos
    zS = xS * sin / cos
    from_S = lambda x, z: (x - xS) * H.x + (z + v["rR"] + zS) * H.z  # noqa: E731
    contact, G_A = me.Point("P"), me.Point("G_A")
    G_A.set_pos(contact, -v["rR"] * R.z)
    G_A.set_vel(N, A.ang_vel_in(N).express(B).cross((-v["rR"] * R.z).express(B)))
    G_B = G_A.locatenew("G_B", v["xB"] * B.x + (v["zB"] + v["rR"]) * B.z)
    S = G_A.locatenew("S", xS * B.x - zS * B.z)
    G_C = S.locatenew("G_C", from_S(v["xH"], v["zH"]))
    G_D = S.locatenew("G_D", from_S(v["w"], -v["rF"]))
    for point, base, frame in ((G_B, G_A, B), (S, G_A, B), (G_C, S, C), (G_D, S, C)):
        point.v2pt_theory(base, N, frame)
    down = [N.z.dot(C.x), N.z.dot(C.z)]
    r_D_Q = v["rF"] * (down[0] * C.x + down[1] * C.z) / sm.sqrt(down[0] ** 2 + down[1] ** 2)
    Q = G_D.locatenew("Q", r_D_Q)
    v_Q = G_D.vel(N) + D.ang_vel_in(N).cross(r_D_Q)

    fork = me.inertia(H, v["IHxx"], v["IHyy"], v["IHzz"], izx=v["IHxz"])
    bodies = [
        me.RigidBody("rear_wheel", G_A, A, v["mR"], (me.inertia(B, v["IRxx"], v["IRyy"], v["IRxx"]), G_A)),
        me.RigidBody(
            "rear_frame", G_B, B, v["mB"], (me.inertia(B, v["IBxx"], v["IByy"], v["IBzz"], izx=v["IBxz"]), G_B)
        ),
        me.RigidBody("fork", G_C, C, v["mH"], (fork.express(C), G_C)),
        me.RigidBody("front_wheel", G_D, D, v["mF"], (me.inertia(C, v["IFxx"], v["IFyy"], v["IFxx"]), G_D)),
    ]
    kane = me.KanesMethod(
        N,
        q_ind=[*q[:4], q[5]],
        q_dependent=[pitch],
        u_ind=u[:3],
        u_dependent=u[3:],
        kd_eqs=[rate - angle.diff() for angle, rate in zip(q[:6], (roll_rate, rear_rate, steer_rate, *u[3:]))],
        configuration_constraints=[Q.pos_from(contact).dot(N.z)],
        velocity_constraints=[v_Q.dot(C.y), v_Q.dot(C.z), v_Q.dot(C.x)],
        constraint_solver="CRAMER",
    )
    kane.kanes_equations(bodies, [(body.masscenter, body.mass * v["g"] * N.z) for body in bodies])
    forward = -v["rR"] * (rear_rate + pitch_rate)
    rates = [*u, forward * sm.cos(yaw), forward * sm.sin(yaw)]
    return Derived(kane, kane.mass_matrix, kane.forcing, rates, q, u, list(p), time.perf_counter() - began)


def by_lambdify(derived: Derived) -> Callable[..., np.ndarray]:
    """f(y, t, p) -> dy (14,): `sympy.lambdify` with common subexpressions, and numpy's solve."""
    equations = sm.lambdify([derived.q, derived.u, derived.p], [derived.M, derived.f, derived.q_dot], cse=True)
    n = len(COORDINATES)

    def f(y, t, p):
        M, forcing, q_dot = equations(y[:n], y[n:], p)
        return np.concatenate([q_dot, np.linalg.solve(M, forcing)[:, 0]])

    return f


def by_pydy(derived: Derived, folder: Path) -> Callable[..., np.ndarray]:
    """f(y, t, p) -> dy (14,): PyDy's Cython generator, linear equations solved in its C."""
    from pydy.codegen.ode_function_generators import generate_ode_function

    return generate_ode_function(
        derived.f,
        derived.q,
        derived.u,
        derived.p,
        mass_matrix=derived.M,
        coordinate_derivatives=sm.Matrix(derived.q_dot),
        constants_arg_type="array",
        linear_sys_solver="sympy",
        generator="cython",
        tmp_dir=str(folder),
    )
