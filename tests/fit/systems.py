"""Mechanisms for tests of fits, and a small problem whose programs all share that ask for no other."""

import os

import numpy as np
from scipy import stats

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


T = np.linspace(0.0, 1.0, 11)
PUSH, SEEN = np.sin(3.0 * T), 0.4 * T**2 + 0.02 * np.cos(40.0 * T)
TRIAL = Trial(T, {"x": SEEN}, {"push": PUSH}, sigma=0.1)
POSED = {"unknown": ("x",), "simulation": Simulation(step=0.1)}  # of ["gain", "drift"] of a `Track`


def of_x(problem):
    """The log density over the free numbers x, minus half the cost, instead of over the parameters' values."""
    density = problem.log_density()
    return lambda point: density(point) - problem.parameters.log_determinant(point.parameters)
