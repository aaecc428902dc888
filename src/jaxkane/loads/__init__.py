"""Loads: springs, dampers, actuators, friction, drag, stops, backlash and motors.

Loads between points or frames return a tuple of `Force`s or `Torque`s, including the reaction on the second point or
frame, for `System.loads`:

    def loads(self, t, q, u, motion, inputs):
        P, Q = motion["P"], motion["Q"]
        return jk.loads.spring(P, Q, self.stiffness, self.length), jk.weight(motion, -9.81 * motion.N.y)

A follower force is `jk.Force(10.0 * B.x, P)`, which rotates with the frame B. For a nonlinear law, pass a function of
the extension, the rate or the angle instead of the coefficient: `lambda x: k * x + k3 * x**3`.

`coulomb`, `stribeck`, `quadratic` and `dead_zone` are such functions. `lugre` and `bouc_wen` also have a first-order
state. They return the resistance, which has the sign of the rate; the load has the opposite sign. Laws can be added and
used with any speed:

    friction = lambda w: jk.loads.stribeck(w, 0.3, 0.5, 0.1) + 0.02 * w
    jk.loads.torsional_damper(arm, None, N.z, friction)
"""

from ._between import Law as Law
from ._between import actuator as actuator
from ._between import damper as damper
from ._between import dc_motor as dc_motor
from ._between import drag as drag
from ._between import friction as friction
from ._between import rotor as rotor
from ._between import spring as spring
from ._between import torsional_damper as torsional_damper
from ._between import torsional_friction as torsional_friction
from ._between import torsional_spring as torsional_spring
from ._laws import bouc_wen as bouc_wen
from ._laws import coulomb as coulomb
from ._laws import dead_zone as dead_zone
from ._laws import lugre as lugre
from ._laws import quadratic as quadratic
from ._laws import smooth_abs as smooth_abs
from ._laws import smooth_sign as smooth_sign
from ._laws import stribeck as stribeck
