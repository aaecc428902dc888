"""Mechanisms for tests of fits, and a small problem whose programs all share that ask for no other."""

import functools
import os

import jax.numpy as jnp
import numpy as np
from scipy import linalg, signal, stats

import jaxkane as jk
from jaxkane.fit import Simulation, Trial
from jaxkane.fit.solve.linearization import blocks_of


def programs():
    """The programs of windows. Their number may fall, because the least recently used ones are freed."""
    return {*blocks_of.programs._entries}


SETS = int(os.environ.get("JAXKANE_SETS", "100"))
"""The number of simulated data sets of a test of coverage. docs/uncertainty.md cites the results of 300."""


def coverage_band(n):
    """The lowest and highest share of n 95 % intervals that contain the truth.

    A correct method is outside the band with a probability of 1e-3. With 100 sets the band begins at 0.87. A method
    with a coverage of 0.75 is then outside with a probability of 0.998.
    """
    return stats.binom.ppf([5e-4, 1 - 5e-4], n, 0.95) / n


class Cart(jk.System):
    """m x'' + damping x' + stiffness x = push."""

    mass: jk.Scalar = jk.parameter(1.0, positive=True)  # [kg]
    stiffness: jk.Scalar = jk.parameter(4.0, positive=True)  # [N/m]
    damping: jk.Scalar = jk.parameter(0.3)  # [N s/m]

    coordinates = ("x",)
    speeds = ("x_dot",)
    inputs = ("push",)

    def motion(self, t, q, u):
        N, _ = jk.inertial()
        P = jk.Point.at(u[0] * N.x, q[0] * N.x, "P")
        return jk.Motion([jk.Body(self.mass, 0.0, P, name="cart")], frames={"N": N})

    def loads(self, t, q, u, motion, inputs):
        force = inputs["push"] - self.stiffness * q["x"] - self.damping * u["x_dot"]
        return (jk.Force(force * motion.N.x, motion["cart"]),)


@functools.partial(np.vectorize, signature="(),(),(),(2),(n),(n)->(n)")
def pushed(mass, stiffness, damping, start, t, push):
    """Positions (n_t,) of a `Cart` from `start` [x, x_dot], with a push linear between samples at equal intervals."""
    cart = signal.lti([[0.0, 1.0], [-stiffness / mass, -damping / mass]], [[0.0], [1.0 / mass]], [[1.0, 0.0]], [[0.0]])
    return signal.lsim(cart, push, t - t[0], start)[1]


@functools.cache
def transition(h, stiffness, damping, q):
    """Phi (2, 2) of a `Cart` of 1 kg over a time h, and the covariance (2, 2) that noise of its speed adds.

    Van Loan, Computing integrals involving the matrix exponential, 1978.
    """
    A = np.array([[0.0, 1.0], [-stiffness, -damping]])
    M = np.zeros((4, 4))
    M[:2, :2], M[2:, 2:], M[1, 3] = -A, A.T, q
    E = linalg.expm(M * h)
    return E[2:, 2:].T, E[2:, 2:].T @ E[:2, 2:]


class Pendulum(jk.System):
    """angle'' + damping angle' + stiffness sin(angle) = torque."""

    stiffness: jk.Scalar = jk.parameter(9.0, positive=True)  # gravity by length [1/s^2]
    damping: jk.Scalar = jk.parameter(0.2)
    coordinates = ("angle",)
    speeds = ("rate",)
    inputs = ("torque",)

    def motion(self, t, q, u):
        N, O = jk.inertial()
        B = N.rotate(2, q["angle"], u["rate"], "B")
        return jk.Motion([jk.Body(1.0, (1.0, 1.0, 1.0), O.fixed(0.0 * B.x), B, name="bob")], frames={"B": B})

    def loads(self, t, q, u, motion, inputs):
        torque = inputs["torque"] - self.stiffness * jnp.sin(q["angle"]) - self.damping * u["rate"]
        return (jk.Torque(torque * motion["B"].y, motion["bob"]),)

    def outputs(self, t, q, u, motion, now):
        return {"height": 1.0 - jnp.cos(q["angle"])}


class Track(jk.System):
    """x'' = gain push + drift: linear in both parameters and in the start, so least squares has a closed form."""

    gain: jk.Scalar = jk.parameter(1.0)  # [1/kg]
    drift: jk.Scalar = jk.parameter(0.0)  # [m/s^2]

    coordinates = ("x",)
    speeds = ("x_dot",)
    inputs = ("push",)

    def motion(self, t, q, u):
        N, _ = jk.inertial()
        P = jk.Point.at(u[0] * N.x, q[0] * N.x, "P")
        return jk.Motion([jk.Body(1.0, 0.0, P, name="cart")], frames={"N": N})

    def loads(self, t, q, u, motion, inputs):
        return (jk.Force((self.gain * inputs["push"] + self.drift) * motion.N.x, motion["cart"]),)


def responses(t, push):
    """Positions and speeds (n_t, 2) of a `Track` by gain and drift: from rest, with a push linear between samples."""
    s, h = t - t[0], np.diff(t)
    v = np.append(0.0, np.cumsum((push[:-1] + push[1:]) * h / 2))
    x = np.append(0.0, np.cumsum(v[:-1] * h + (2 * push[:-1] + push[1:]) * h**2 / 6))
    return np.column_stack([x, s**2 / 2]), np.column_stack([v, s])


T = np.linspace(0.0, 1.0, 11)
PUSH, SEEN = np.sin(3.0 * T), 0.4 * T**2 + 0.02 * np.cos(40.0 * T)
TRIAL = Trial(T, {"x": SEEN}, {"push": PUSH}, sigma=0.1)
POSED = {"unknown": ("x",), "simulation": Simulation(step=0.1)}  # of ["gain", "drift"] of a `Track`


def of_x(problem):
    """The log density over the free numbers x, minus half the cost, instead of over the parameters' values."""
    density = problem.log_density()
    return lambda point: density(point) - problem.parameters.log_determinant(point.parameters)
