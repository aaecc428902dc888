"""A woodpecker toy that hops down a pole: three contacts with friction, which stick, slide and strike in turn."""

from __future__ import annotations

from .._kane.contact import Contact
from .._scalarjit.components import Scalar
from .._system.kinematics import inertial
from .._system.motion import Body, Motion, Torque, weight
from .._system.parameters import parameter
from .._system.system import System
from ._entry import entry


@entry(
    "Leine et al. (2003)",
    "contacts that jam: a toy hops down a pole",
    q=(0.0, 0.05, 0.06),
    u=(-0.1, -3.0, -5.0),
    operations=121,
)
class Woodpecker(System):
    """A sleeve with play on a pole, and a bird on a spring at the sleeve (Leine et al., 2003).

    The source is Leine et al. (2003), *Nonlinear dynamics and modeling of various wooden toys with impact and
    friction*, Journal of Vibration and Control 9(1-2), with the equations and parameters of Glocker (1995). Angles are
    small: the gaps and the positions are linear in them. In each period of 0.146 s, the sleeve jams on the pole, slides
    down, tilts, and the beak strikes the pole.

    | parameter | source | meaning |
    |---|---|---|
    | `sleeve_mass`, `bird_mass` | m_M, m_S | [kg] |
    | `sleeve_inertia`, `bird_inertia` | J_M, J_S | about the mass centres [kg m^2] |
    | `stiffness` | c_phi | of the spring [N m/rad] |
    | `pole_radius`, `sleeve_radius` | r_0, r_M | of the pole, and inside the sleeve [m] |
    | `half_height` | h_M | half the height of the sleeve [m] |
    | `sleeve_to_spring` | l_M | from the centre of the sleeve [m] |
    | `spring_to_bird` | l_G | to the mass centre of the bird [m] |
    | `beak_length`, `beak_height` | l_S, h_S | from the mass centre of the bird to the beak: to the pole, and up [m] |
    | `friction` | mu | coefficient of friction of all contacts (no unit) |
    | `restitution` | e_1 | coefficient of restitution of the beak; that of the sleeve is 0 (no unit) |
    | `gravity` | g | along -N.y [m/s^2] |

    - Coordinates `height`: of the sleeve [m]; `sleeve`, `bird`: angles about N.z [rad].
    - Speeds `climb`, `sleeve_rate`, `bird_rate`: their rates [m/s, rad/s].
    - Contacts `beak`; `lower`, `upper`: the edges of the sleeve. Points of `motion` have the same names.
    """

    sleeve_mass: Scalar = parameter(0.0003, positive=True, unit="kg")
    sleeve_inertia: Scalar = parameter(5e-9, positive=True, unit="kg m^2")
    bird_mass: Scalar = parameter(0.0045, positive=True, unit="kg")
    bird_inertia: Scalar = parameter(7e-7, positive=True, unit="kg m^2")
    stiffness: Scalar = parameter(0.0056, positive=True, unit="N m/rad")
    pole_radius: Scalar = parameter(0.0025, positive=True, unit="m")
    sleeve_radius: Scalar = parameter(0.0031, positive=True, unit="m")
    half_height: Scalar = parameter(0.0058, positive=True, unit="m")
    sleeve_to_spring: Scalar = parameter(0.010, unit="m")
    spring_to_bird: Scalar = parameter(0.015, unit="m")
    beak_length: Scalar = parameter(0.0201, unit="m")
    beak_height: Scalar = parameter(0.020, unit="m")
    friction: Scalar = parameter(0.3, unit="1")
    restitution: Scalar = parameter(0.5, within=(0.0, 1.0), unit="1")
    gravity: Scalar = parameter(9.81, unit="m/s^2")

    coordinates = ("height", "sleeve", "bird")
    speeds = ("climb", "sleeve_rate", "bird_rate")
    units = {"height": "m", "sleeve": "rad", "bird": "rad", "climb": "m/s"} | dict.fromkeys(speeds[1:], "rad/s")

    def motion(self, t, q, u):
        N, O = inertial()
        sleeve = N.rotate(3, q["sleeve"], u["sleeve_rate"], "sleeve")
        bird = N.rotate(3, q["bird"], u["bird_rate"], "bird")

        def at(x, x_dot, arm, bird_arm):
            """A point at x that small angles move up by the arms [m]."""
            y = q["height"] + arm * q["sleeve"] + bird_arm * q["bird"]
            y_dot = u["climb"] + arm * u["sleeve_rate"] + bird_arm * u["bird_rate"]
            return O.moving(x * N.x + y * N.y, x_dot * N.x + y_dot * N.y)

        center = at(0.0, 0.0, self.sleeve_to_spring, self.spring_to_bird)
        play, reach = self.sleeve_radius - self.pole_radius, self.spring_to_bird - self.beak_length
        tilt, rate = self.half_height * q["sleeve"], self.half_height * u["sleeve_rate"]
        beak = self.sleeve_to_spring + reach - self.pole_radius - self.beak_height * q["bird"]
        bodies = [
            Body(self.sleeve_mass, (0.0, 0.0, self.sleeve_inertia), at(0.0, 0.0, 0.0, 0.0), sleeve, name="sleeve"),
            Body(self.bird_mass, (0.0, 0.0, self.bird_inertia), center, bird, name="bird"),
        ]
        points = {
            "beak": at(beak, -self.beak_height * u["bird_rate"], self.sleeve_to_spring, reach),
            "lower": at(play + tilt, rate, self.sleeve_radius, 0.0),
            "upper": at(play - tilt, -rate, self.sleeve_radius, 0.0),
        }
        return Motion(bodies, points=points)

    def loads(self, t, q, u, motion, inputs):
        torque = self.stiffness * (q["sleeve"] - q["bird"]) * motion.N.z
        spring = Torque(torque, motion["bird"]), Torque(-torque, motion["sleeve"])
        return weight(motion, -self.gravity * motion.N.y), *spring

    def contacts(self, t, q, u, motion):
        # The points have the distance from the pole as their x.
        N, mu = motion.N, self.friction
        beak = Contact(motion["beak"], N.x, friction=mu, restitution=self.restitution)
        return {"beak": beak, **{name: Contact(motion[name], N.x, friction=mu) for name in ("lower", "upper")}}
