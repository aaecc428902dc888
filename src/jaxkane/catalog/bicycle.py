from __future__ import annotations

import jax.numpy as jnp

from .. import _system as jk
from .._types import Scalar
from .._vectors import inertial


class WhippleBicycle(jk.System):
    w: Scalar = jk.parameter(positive=True)
    c: Scalar = jk.parameter()
    lam: Scalar = jk.parameter()
    g: Scalar = jk.parameter()
    rR: Scalar = jk.parameter(positive=True)
    mR: Scalar = jk.parameter(positive=True)
    IRxx: Scalar = jk.parameter(positive=True)
    IRyy: Scalar = jk.parameter(positive=True)
    xB: Scalar = jk.parameter()
    zB: Scalar = jk.parameter()
    mB: Scalar = jk.parameter(positive=True)
    IBxx: Scalar = jk.parameter(positive=True)
    IByy: Scalar = jk.parameter(positive=True)
    IBzz: Scalar = jk.parameter(positive=True)
    IBxz: Scalar = jk.parameter()
    xH: Scalar = jk.parameter()
    zH: Scalar = jk.parameter()
    mH: Scalar = jk.parameter(positive=True)
    IHxx: Scalar = jk.parameter(positive=True)
    IHyy: Scalar = jk.parameter(positive=True)
    IHzz: Scalar = jk.parameter(positive=True)
    IHxz: Scalar = jk.parameter()
    rF: Scalar = jk.parameter(positive=True)
    mF: Scalar = jk.parameter(positive=True)
    IFxx: Scalar = jk.parameter(positive=True)
    IFyy: Scalar = jk.parameter(positive=True)
    steer_damping: Scalar = jk.parameter(0.0)

    coordinates = ("roll", "rear_wheel_angle", "steer", "yaw", "pitch", "front_wheel_angle", "x", "y")
    speeds = ("roll_rate", "rear_wheel_rate", "steer_rate")
    dependent_speeds = ("yaw_rate", "pitch_rate", "front_wheel_rate")
    dependent_coordinates = ("pitch",)
    inputs = ("roll_torque", "drive_torque", "steer_torque")

    def _frames(self, q, u):
        roll, _, steer, yaw, pitch = q[:5]
        roll_rate, _, steer_rate, yaw_rate, pitch_rate, _ = u[:6]
        N, O = inertial()
        Y = N.rotate(3, yaw, yaw_rate, "Y")
        R = Y.rotate(1, roll, roll_rate, "R")
        B = R.rotate(2, pitch, pitch_rate, "B")
        C = B.rotate(2, self.lam, 0.0, "T").rotate(3, steer, steer_rate, "C")
        return N, O, Y, R, B, C

    def _fork(self):
        # the steer axis passes S, at xS b1 - zS b3 from the rear wheel's centre
        s, c = jnp.sin(self.lam), jnp.cos(self.lam)
        xS = (self.w + self.c) * c**2 - self.rR * s * c
        zS = xS * s / c
        dx, dz = self.w - xS, -self.rF + self.rR + zS  # G_D from S, aligned, resolved along x and z
        hx, hz = self.xH - xS, self.zH + self.rR + zS
        xD, zD = c * dx - s * dz, s * dx + c * dz
        xC, zC = c * hx - s * hz, s * hx + c * hz
        return xS, zS, xC, zC, xD, zD

    def q_dot(self, t, q, u):
        forward = -self.rR * (u[1] + u[4] + u[3] * jnp.sin(q[0]))
        return (*u[:6], forward * jnp.cos(q[3]), forward * jnp.sin(q[3]))

    def motion(self, t, q, u):
        N, O, Y, R, B, C = self._frames(q, u)
        rear_wheel_rate, front_wheel_rate = u[1], u[5]
        w_A = B.angular_velocity + rear_wheel_rate * B.y
        w_D = C.angular_velocity + front_wheel_rate * C.y
        xS, zS, xC, zC, xD, zD = self._fork()
        P = jk.Point.at(0.0 * N.x, q[6] * N.x + q[7] * N.y, "P")
        r_P_A = -self.rR * R.z
        A = jk.Point(w_A.cross(r_P_A), P, r_P_A, "G_A")
        G_B = A.fixed(self.xB * B.x + (self.zB + self.rR) * B.z, B)
        S = A.fixed(xS * B.x - zS * B.z, B)
        G_C = S.fixed(xC * C.x + zC * C.z, C)
        G_D = S.fixed(xD * C.x + zD * C.z, C)
        n1, n2, n3 = N.z.components_in(C)
        length = jnp.sqrt(n1 * n1 + n3 * n3)
        r_D_Q = C.vector(self.rF * n1 / length, 0.0, self.rF * n3 / length)
        Q = jk.Point(G_D.velocity + w_D.cross(r_D_Q), G_D, r_D_Q, "Q")
        bodies = (
            jk.Body(self.mR, (self.IRxx, self.IRyy, self.IRxx), A, R, w_A, "rear wheel"),
            jk.Body(
                self.mB, ((self.IBxx, 0, self.IBxz), (0, self.IByy, 0), (self.IBxz, 0, self.IBzz)), G_B, B, name="frame"
            ),
            jk.Body(self.mH, self._fork_inertia(), G_C, C, name="fork"),
            jk.Body(self.mF, (self.IFxx, self.IFyy, self.IFxx), G_D, C, w_D, "front wheel"),
        )
        return jk.Motion(bodies, [Q.velocity], points=dict(P=P, Q=Q, S=S), frames=dict(Y=Y, B=B, C=C))

    def _fork_inertia(self):
        s, c = jnp.sin(self.lam), jnp.cos(self.lam)
        xx, zz, xz = self.IHxx, self.IHzz, self.IHxz
        Cxx = c * c * xx - 2 * s * c * xz + s * s * zz
        Czz = s * s * xx + 2 * s * c * xz + c * c * zz
        Cxz = s * c * (xx - zz) + (c * c - s * s) * xz
        return ((Cxx, 0, Cxz), (0, self.IHyy, 0), (Cxz, 0, Czz))

    def loads(self, t, q, u, motion, inputs):
        A, B, C, D = motion.bodies
        return (
            jk.weight(motion, self.g * motion.N.z),
            jk.Torque(inputs["roll_torque"] * motion["Y"].x, B),
            jk.Torque(inputs["drive_torque"] * motion["B"].y, A, reaction_on=B),
            jk.Torque(
                (inputs["steer_torque"] - self.steer_damping * u["steer_rate"]) * motion["C"].z, C, reaction_on=B
            ),
        )
