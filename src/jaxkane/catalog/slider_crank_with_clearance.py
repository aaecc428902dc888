"""A slider-crank whose slider has clearance in its guide: four contacts at the corners of the slider."""

from __future__ import annotations

from .._kane.contact import Contact
from .._scalarjit.components import Scalar
from .._system.kinematics import inertial
from .._system.motion import Body, Motion, weight
from .._system.parameters import parameter
from .._system.system import System
from ._entry import entry


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

    def motion(self, t, q, u):
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

    def loads(self, t, q, u, motion, inputs):
        return weight(motion, -self.gravity * motion.N.y)

    def contacts(self, t, q, u, motion):
        N, half = motion.N, self.half_height + self.clearance
        laws = {"restitution": self.restitution, "friction": self.friction}
        contacts = {}
        for name in ("upper left", "upper right", "lower left", "lower right"):
            sign = -1.0 if name.startswith("upper") else 1.0
            height = motion[name].position.dot(N.y)
            contacts[name] = Contact(motion[name], sign * N.y, gap=half + sign * height, **laws)
        return contacts
