"""Systems that several tests of linear models share."""

import jaxkane as jk
from jaxkane import Scalar, parameter


class RodOnPin(jk.System):
    """A point on a rod in x and y, N.x down: x follows from y. SymPy's test_linearize_pendulum_kane_nonminimal."""

    length: Scalar = parameter(positive=True)  # [m]
    damping: Scalar = parameter(0.0)  # [N s/m]

    coordinates = ("y", "x")
    speeds = ("v",)
    dependent_speeds = ("x_dot",)
    dependent_coordinates = ("x",)
    inputs = ("push",)

    def configuration_constraints(self, t, q):
        return (q["x"] ** 2 + q["y"] ** 2 - self.length**2,)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        P = O.moving(N.vector(q["x"], q["y"], 0.0), N.vector(u["x_dot"], u["v"], 0.0))
        return jk.Motion([jk.Body(2.0, 0.0, P, N, name="point")])

    def loads(self, t, q, u, motion, inputs):
        N = motion.N
        return jk.weight(motion, 9.8 * N.x), jk.Force((inputs["push"] - self.damping * u["v"]) * N.y, motion["point"])
