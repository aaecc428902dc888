"""A ball that bounces, and systems with contacts and dry friction."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import jax.numpy as jnp

from .._integrate.events import falling
from .._kane.contact.declarations import Contact, DryFriction
from .._scalarjit.components import Component, Scalar
from .._system.kinematics import Point, inertial
from .._system.motion import Body, Force, Motion, Torque, weight
from .._system.parameters import parameter
from .._system.system import NamedVector, System
from ._entry import Loads, Quantity, Values, entry

Contacts: TypeAlias = Mapping[str, Contact | DryFriction]


@entry(
    "Timmerman and van der Weele (1999)",
    "an event that changes the state: a ball bounces",
    q=(1.0,),
    u=(-0.5,),
    operations=23,
    conservative=False,  # drag
)
class BouncingBall(System):
    """A ball that falls with quadratic drag and bounces on level ground.

    The drag is that of Timmerman and van der Weele (1999), *On the rise and fall of a ball with linear or quadratic
    drag*, American Journal of Physics 67(6). Each bounce multiplies the speed by `restitution` (Newton). The bounces
    accumulate at a finite time, so a long simulation ends after `max_jumps`.

    | parameter | source | meaning |
    |---|---|---|
    | `mass` | m | [kg] |
    | `drag` | k | the force of the air is k v^2 [kg/m] |
    | `restitution` | e | coefficient of restitution of the ground (no unit) |
    | `gravity` | g | along -N.y [m/s^2] |

    - Coordinate `height`: of the lowest point of the ball above the ground [m].
    - Speed `climb`: its rate [m/s].
    - Event `bounce`: the ball reaches the ground.
    """

    mass: Scalar = parameter(1.0, positive=True, unit="kg")
    drag: Scalar = parameter(0.1, unit="kg/m")
    restitution: Scalar = parameter(0.8, within=(0.0, 1.0), unit="1")
    gravity: Scalar = parameter(9.81, unit="m/s^2")

    coordinates = ("height",)
    speeds = ("climb",)
    units = {"height": "m", "climb": "m/s"}

    def motion(self, t: Component, q: NamedVector, u: NamedVector) -> Motion:
        N, O = inertial()
        P = O.moving(q["height"] * N.y, u["climb"] * N.y)
        return Motion([Body(self.mass, 0.0, P, name="ball")])

    def loads(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion, inputs: Values) -> Loads:
        v = u["climb"]
        resistance = -self.drag * v * jnp.abs(v) * motion.N.y
        return weight(motion, -self.gravity * motion.N.y), Force(resistance, motion["ball"])

    def events(self, t: Component, q: NamedVector, u: NamedVector) -> Mapping[str, Quantity]:
        return {"bounce": falling(q["height"], then={"climb": -self.restitution * u["climb"]})}


@entry(
    "Popp and Stelter (1990)",
    "dry friction: a block sticks to a belt and slips",
    q=(0.3,),
    u=(0.1,),
    operations=17,
)
class Belt(System):
    """A block on a belt, with a spring to the ground: a stick-slip oscillator (Popp and Stelter, 1990).

    The source is Popp and Stelter (1990), *Stick-slip vibrations and chaos*, Philosophical Transactions of the Royal
    Society A 332. The belt carries the block until the spring force equals `static`. Then the block slips until it has
    the speed of the belt again. Each stick phase has the same end, so a periodic orbit is reached after the first one.

    | parameter | source | meaning |
    |---|---|---|
    | `mass` | m | [kg] |
    | `stiffness` | k | of the spring [N/m] |
    | `speed` | v_0 | of the belt, along N.x [m/s] |
    | `kinetic` | | friction force while the block slips [N] |
    | `static` | | largest friction force while it sticks [N] |

    - Coordinate `x`: of the block; the spring is relaxed at x = 0 [m].
    - Speed `x_dot`: its rate [m/s].
    - Contact `belt`: it sticks while the block has the speed of the belt.
    """

    mass: Scalar = parameter(1.0, positive=True, unit="kg")
    stiffness: Scalar = parameter(4.0, unit="N/m")
    speed: Scalar = parameter(0.5, unit="m/s")
    kinetic: Scalar = parameter(2.5, unit="N")
    static: Scalar = parameter(4.0, unit="N")

    coordinates = ("x",)
    speeds = ("x_dot",)
    units = {"x": "m", "x_dot": "m/s"}

    def motion(self, t: Component, q: NamedVector, u: NamedVector) -> Motion:
        N, O = inertial()
        return Motion([Body(self.mass, 0.0, O.moving(q["x"] * N.x, u["x_dot"] * N.x), name="block")])

    def loads(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion, inputs: Values) -> Loads:
        return Force(-self.stiffness * q["x"] * motion.N.x, motion["block"])

    def contacts(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion) -> Contacts:
        return {"belt": DryFriction(u["x_dot"] - self.speed, self.kinetic, static=self.static)}


@entry(
    "Nordin and Gutman (2002)",
    "contacts defined by gaps: a coupling with play",
    q=(0.03, -0.02),
    u=(1.5, 0.5),
    operations=21,
)
class Backlash(System):
    """A motor and a load, which a coupling with play connects (Nordin and Gutman, 2002).

    The source is Nordin and Gutman (2002), *Controlling mechanical systems with backlash: a survey*, Automatica 38(10).
    There the shaft is elastic. Here the coupling is rigid, so its sides meet in impacts. After an impact with
    `restitution` 0, motor and load move together until the contact force is zero.

    | parameter | source | meaning |
    |---|---|---|
    | `motor_inertia` | J_m | about N.z [kg m^2] |
    | `load_inertia` | J_l | about N.z [kg m^2] |
    | `play` | 2 alpha | of the coupling [rad] |
    | `restitution` | | coefficient of restitution of both sides (no unit) |

    - Coordinates `motor`, `load`: angles about N.z [rad]. The coupling is centred if they are equal.
    - Speeds `motor_rate`, `load_rate`: their rates [rad/s].
    - Input `torque`: on the motor [N m].
    - Contacts `drive`, `coast`: the motor pushes the load forwards, and backwards.
    """

    motor_inertia: Scalar = parameter(1e-3, positive=True, unit="kg m^2")
    load_inertia: Scalar = parameter(5e-3, positive=True, unit="kg m^2")
    play: Scalar = parameter(0.2, unit="rad")
    restitution: Scalar = parameter(0.3, within=(0.0, 1.0), unit="1")

    coordinates = ("motor", "load")
    speeds = ("motor_rate", "load_rate")
    inputs = ("torque",)
    units = dict.fromkeys(coordinates, "rad") | dict.fromkeys(speeds, "rad/s") | {"torque": "N m"}

    def motion(self, t: Component, q: NamedVector, u: NamedVector) -> Motion:
        N, O = inertial()
        M = N.rotate(3, q["motor"], u["motor_rate"], "M")
        L = N.rotate(3, q["load"], u["load_rate"], "L")
        motor = Body(0.0, (0.0, 0.0, self.motor_inertia), O, M, name="motor")
        return Motion([motor, Body(0.0, (0.0, 0.0, self.load_inertia), O, L, name="load")])

    def loads(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion, inputs: Values) -> Loads:
        return Torque(inputs["torque"] * motion.N.z, motion["motor"])

    def contacts(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion) -> Contacts:
        lead = q["motor"] - q["load"]
        return {
            "drive": Contact(gap=0.5 * self.play - lead, restitution=self.restitution),
            "coast": Contact(gap=0.5 * self.play + lead, restitution=self.restitution),
        }


@entry(
    "Housner (1963)",
    "two contacts with friction: a block rocks on its corners",
    q=(0.04, 0.65, 0.25),
    u=(0.02, 0.1, -0.3),
    operations=31,
)
class RockingBlock(System):
    """A uniform rectangular block on level ground, which rocks, slides and lifts off (Housner, 1963).

    The source is Housner (1963), *The behavior of inverted pendulum structures during earthquakes*, Bulletin of the
    Seismological Society of America 53(2). A slender block with sufficient friction rotates about one corner until
    the other corner lands. With `restitution` 0, each landing multiplies the rate by 1 - 3/2 sin^2 alpha, where
    tan(alpha) = b / h. A start at rest on one corner:

        jk.assemble(block, {"angle": 0.25}, touching=("left",))

    | parameter | source | meaning |
    |---|---|---|
    | `half_width` | b | half the width [m] |
    | `half_height` | h | half the height [m] |
    | `mass` | W / g | [kg] |
    | `friction` | | coefficient of friction of both corners (no unit) |
    | `restitution` | | coefficient of restitution of both corners (no unit) |
    | `gravity` | g | along -N.y [m/s^2] |

    - Coordinates `x`, `y`: of the mass centre [m]; `angle`: about N.z, positive if the block rotates about its left
      corner [rad].
    - Speeds `x_dot`, `y_dot`, `rate`: their rates [m/s, rad/s].
    - Contacts `left`, `right`: the lower corners on the ground y = 0. Points of `motion` have the same names.
    """

    half_width: Scalar = parameter(0.2, positive=True, unit="m")
    half_height: Scalar = parameter(0.6, positive=True, unit="m")
    mass: Scalar = parameter(1.0, positive=True, unit="kg")
    friction: Scalar = parameter(0.8, unit="1")
    restitution: Scalar = parameter(0.0, within=(0.0, 1.0), unit="1")
    gravity: Scalar = parameter(9.81, unit="m/s^2")

    coordinates = ("x", "y", "angle")
    speeds = ("x_dot", "y_dot", "rate")
    units = {"x": "m", "y": "m", "angle": "rad", "x_dot": "m/s", "y_dot": "m/s", "rate": "rad/s"}

    def motion(self, t: Component, q: NamedVector, u: NamedVector) -> Motion:
        N, O = inertial()
        b, h = self.half_width, self.half_height
        B = N.rotate(3, q["angle"], u["rate"], "B")
        G = O.moving(q["x"] * N.x + q["y"] * N.y, u["x_dot"] * N.x + u["y_dot"] * N.y)
        I = self.mass * (b**2 + h**2) / 3.0
        corners = {"left": G.fixed(-b * B.x - h * B.y), "right": G.fixed(b * B.x - h * B.y)}
        return Motion([Body(self.mass, (0.0, 0.0, I), G, B, name="block")], points=corners)

    def loads(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion, inputs: Values) -> Loads:
        return weight(motion, -self.gravity * motion.N.y)

    def contacts(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion) -> Contacts:
        laws = {"restitution": self.restitution, "friction": self.friction}
        return {name: Contact(motion[name], motion.N.y, **laws) for name in ("left", "right")}


@entry(
    "Irodov (1981)",
    "a contact with an edge: a wheel drops from a kerb",
    q=(-0.3, 0.45, 0.1),
    u=(1.2, -0.2, 2.0),
    operations=29,
)
class KerbWheel(System):
    """A wheel in a vertical plane that rolls off a kerb onto a road.

    The contact with the edge is that of the rolling cylinder in Irodov (1981), *Problems in General Physics*, chapter
    1.5: the cylinder rolls over an edge, and leaves it if it is too fast. The point of the wheel that touches changes
    continuously, so its gap is passed to `Contact` together with this point.

    | parameter | source | meaning |
    |---|---|---|
    | `radius` | R | of the wheel [m] |
    | `kerb` | | height of the kerb above the road [m] |
    | `mass` | m | [kg] |
    | `inertia` | | about the axle [kg m^2]; the default is that of a uniform disc |
    | `friction` | | coefficient of friction of kerb and road (no unit) |
    | `restitution` | | coefficient of restitution of kerb and road (no unit) |
    | `gravity` | g | along -N.y [m/s^2] |

    - Coordinates `x`, `y`: of the axle [m], with the road at y = 0 and the edge at x = 0, y = `kerb`; `angle` of the
      wheel, positive if it rolls along N.x [rad].
    - Speeds `x_dot`, `y_dot`, `spin`: their rates [m/s, rad/s].
    - Contacts `kerb`: its surface and its edge; `road`.
    """

    radius: Scalar = parameter(0.35, positive=True, unit="m")
    kerb: Scalar = parameter(0.08, unit="m")
    mass: Scalar = parameter(2.0, positive=True, unit="kg")
    inertia: Scalar = parameter(0.1225, positive=True, unit="kg m^2")
    friction: Scalar = parameter(0.8, unit="1")
    restitution: Scalar = parameter(0.0, within=(0.0, 1.0), unit="1")
    gravity: Scalar = parameter(9.81, unit="m/s^2")

    coordinates = ("x", "y", "angle")
    speeds = ("x_dot", "y_dot", "spin")
    units = {"x": "m", "y": "m", "angle": "rad", "x_dot": "m/s", "y_dot": "m/s", "spin": "rad/s"}

    def motion(self, t: Component, q: NamedVector, u: NamedVector) -> Motion:
        N, O = inertial()
        W = N.rotate(3, -q["angle"], -u["spin"], "W")
        axle = O.moving(q["x"] * N.x + q["y"] * N.y, u["x_dot"] * N.x + u["y_dot"] * N.y)
        return Motion([Body(self.mass, (0.0, 0.0, self.inertia), axle, W, name="wheel")])

    def loads(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion, inputs: Values) -> Loads:
        return weight(motion, -self.gravity * motion.N.y)

    def contacts(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion) -> Contacts:
        N, wheel = motion.N, motion["wheel"]
        # From the nearest point of the kerb to the axle
        x, y = jnp.maximum(q["x"], 0.0), q["y"] - self.kerb
        distance = jnp.sqrt(x**2 + y**2)
        away = (x / distance) * N.x + (y / distance) * N.y
        touching = wheel.center.fixed(-self.radius * away, wheel.frame)
        bottom = wheel.center.fixed(-self.radius * N.y, wheel.frame)
        laws = {"restitution": self.restitution, "friction": self.friction}
        return {
            "kerb": Contact(touching, away, gap=distance - self.radius, **laws),
            "road": Contact(bottom, N.y, **laws),
        }


@entry(
    "Flores et al. (2010)",
    "a joint with clearance: four contacts with friction and restitution",
    q=(0.02, -0.009, 0.005),
    u=(150.0, -75.0, 2.0),
    operations=219,
)
class SliderCrankWithClearance(System):
    """A slider-crank mechanism with clearance between the slider and its guide (Flores et al., 2010).

    The source is Flores et al. (2010), *Modeling and analysis of planar rigid multibody systems with
    translational clearance joints based on the non-smooth dynamics approach*, Multibody System Dynamics 23(2). The
    corners of the slider collide with the guide and slide along it. The defaults are those of the source.

    | parameter | source | meaning |
    |---|---|---|
    | `crank_length`, `rod_length` | l_1, l_2 | [m] |
    | `half_length`, `half_height` | a, b | of the slider [m] |
    | `clearance` | c | on each side of the centred slider [m] |
    | `crank_mass`, `rod_mass`, `slider_mass` | m_1, m_2, m_3 | [kg]; the bars have their mass centres in the middle |
    | `crank_inertia`, `rod_inertia`, `slider_inertia` | J_1, J_2, J_3 | about the mass centres [kg m^2] |
    | `friction` | mu | coefficient of friction of the guide (no unit) |
    | `restitution` | epsilon | coefficient of restitution of the guide (no unit) |
    | `gravity` | g | along -N.y [m/s^2] |

    - Coordinates `crank`, `rod`, `slider`: angles of the bodies from N.x [rad].
    - Speeds `crank_rate`, `rod_rate`, `slider_rate`: their rates [rad/s].
    - Contacts `upper left`, `upper right`, `lower left`, `lower right`: the corners of the slider. Points of `motion`
      have the same names; "A" is the joint of crank and rod.
    """

    crank_length: Scalar = parameter(0.153, positive=True, unit="m")
    rod_length: Scalar = parameter(0.306, positive=True, unit="m")
    half_length: Scalar = parameter(0.05, positive=True, unit="m")
    half_height: Scalar = parameter(0.025, positive=True, unit="m")
    clearance: Scalar = parameter(0.001, unit="m")
    crank_mass: Scalar = parameter(0.038, positive=True, unit="kg")
    rod_mass: Scalar = parameter(0.038, positive=True, unit="kg")
    slider_mass: Scalar = parameter(0.076, positive=True, unit="kg")
    crank_inertia: Scalar = parameter(7.4e-5, positive=True, unit="kg m^2")
    rod_inertia: Scalar = parameter(5.9e-4, positive=True, unit="kg m^2")
    slider_inertia: Scalar = parameter(2.7e-6, positive=True, unit="kg m^2")
    friction: Scalar = parameter(0.01, unit="1")
    restitution: Scalar = parameter(0.4, within=(0.0, 1.0), unit="1")
    gravity: Scalar = parameter(9.81, unit="m/s^2")

    coordinates = ("crank", "rod", "slider")
    speeds = ("crank_rate", "rod_rate", "slider_rate")
    units = dict.fromkeys(coordinates, "rad") | dict.fromkeys(speeds, "rad/s")

    def motion(self, t: Component, q: NamedVector, u: NamedVector) -> Motion:
        N, O = inertial()
        crank, rod, slider = (N.rotate(3, q[name], u[f"{name}_rate"], name) for name in ("crank", "rod", "slider"))
        A = O.fixed(self.crank_length * crank.x)
        B = A.fixed(self.rod_length * rod.x)
        middle = O.fixed(0.5 * self.crank_length * crank.x), A.fixed(0.5 * self.rod_length * rod.x)
        bodies = [
            Body(self.crank_mass, (0.0, 0.0, self.crank_inertia), middle[0], crank, name="crank"),
            Body(self.rod_mass, (0.0, 0.0, self.rod_inertia), middle[1], rod, name="rod"),
            Body(self.slider_mass, (0.0, 0.0, self.slider_inertia), B, slider, name="slider"),
        ]
        along, across = self.half_length * slider.x, self.half_height * slider.y
        corners = {
            "upper left": B.fixed(across - along),
            "upper right": B.fixed(across + along),
            "lower left": B.fixed(-across - along),
            "lower right": B.fixed(along - across),
        }
        return Motion(bodies, points={"A": A, **corners})

    def loads(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion, inputs: Values) -> Loads:
        return weight(motion, -self.gravity * motion.N.y)

    def contacts(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion) -> Contacts:
        N, half = motion.N, self.half_height + self.clearance
        laws = {"restitution": self.restitution, "friction": self.friction}
        contacts = {}
        for name in ("upper left", "upper right", "lower left", "lower right"):
            sign = -1.0 if name.startswith("upper") else 1.0
            height = motion[name].position.dot(N.y)
            contacts[name] = Contact(motion[name], sign * N.y, gap=half + sign * height, **laws)
        return contacts


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

    def motion(self, t: Component, q: NamedVector, u: NamedVector) -> Motion:
        N, O = inertial()
        sleeve = N.rotate(3, q["sleeve"], u["sleeve_rate"], "sleeve")
        bird = N.rotate(3, q["bird"], u["bird_rate"], "bird")

        def at(x: Component, x_dot: Component, arm: Component, bird_arm: Component) -> Point:
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

    def loads(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion, inputs: Values) -> Loads:
        torque = self.stiffness * (q["sleeve"] - q["bird"]) * motion.N.z
        spring = Torque(torque, motion["bird"]), Torque(-torque, motion["sleeve"])
        return weight(motion, -self.gravity * motion.N.y), *spring

    def contacts(self, t: Component, q: NamedVector, u: NamedVector, motion: Motion) -> Contacts:
        # The points have the distance from the pole as their x.
        N, mu = motion.N, self.friction
        beak = Contact(motion["beak"], N.x, friction=mu, restitution=self.restitution)
        return {"beak": beak, **{name: Contact(motion[name], N.x, friction=mu) for name in ("lower", "upper")}}
