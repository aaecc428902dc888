"""A change of the units of length, mass and time changes nothing but units: the catalogue and its analysis.

A system is rescaled by multiplying its parameters, coordinates, speeds and inputs by the powers of length, mass and
time in their declared units. Results are divided by the factors of their units and compared with those in SI units.
"""

import dataclasses
import re
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
from mechanisms import declared

import jaxkane as jk
from jaxkane.catalog import CATALOG, WhippleBicycle
from jaxkane.stability import equilibrium, linearize, lqr, steady_turn

SYMBOLS = {"": (0, 0, 0), "1": (0, 0, 0), "rad": (0, 0, 0), "m": (1, 0, 0), "kg": (0, 1, 0), "s": (0, 0, 1)}
SYMBOLS["N"] = (1, 1, -2)


class Units(NamedTuple):
    """How many new units are one metre, one kilogram and one second."""

    length: float = 1.0
    mass: float = 1.0
    time: float = 1.0

    def factor(self, unit: str) -> float:
        """By what a number in a unit such as "N m s/rad" is multiplied."""
        powers = np.zeros(3)
        for sign, part in zip((1, -1), unit.split("/"), strict=False):
            for symbol in part.split():
                name, _, power = symbol.partition("^")
                powers += sign * int(power or 1) * np.array(SYMBOLS[name])
        return float(np.prod(np.array(self) ** powers))

    def of(self, system, names) -> np.ndarray:
        """The factors (n,) of coordinates, speeds and inputs by name; Euler parameters have no unit."""
        units, rate = system.units, re.compile("_(dot|rate)$")
        found = [units.get(k) or (units.get(rate.sub("", k), "") + "/s") * bool(rate.search(k)) for k in names]
        return np.array([self.factor(unit) if unit != "/s" else 1.0 for unit in found])

    def system(self, system):
        info = declared(system)
        new = {
            k: getattr(system, k) * np.asarray(self.factor(x.unit), getattr(system, k).dtype) for k, x in info.items()
        }
        return dataclasses.replace(system, **new)


def unlimited(cls):
    """The class without limits in units, such as the 20 m that no part of a bicycle exceeds."""
    limits = {k: x for k, x in declared(cls).items() if x.unit != "rad" and np.isfinite(x.within).any()}
    fields = {k: jk.parameter(positive=x.positive, unit=x.unit) for k, x in limits.items()}
    fields["g"] = jk.parameter(9.81, unit="m/s^2")
    return type(cls)(cls.__name__, (cls,), {"__annotations__": dict.fromkeys(fields, jk.Scalar), **fields})


BICYCLE = unlimited(WhippleBicycle)


def example(name, dtype=np.float64):
    """A system of the catalogue, its generic state and its equilibrium's guess, in one precision."""
    entry, system = CATALOG[name], CATALOG[name].example()
    if isinstance(system, WhippleBicycle):
        system = BICYCLE(**{k: getattr(system, k) for k in declared(system)})
    system = jax.tree.map(lambda x: x.astype(dtype), system)
    return system, np.array(entry.q, dtype), np.array(entry.u, dtype)


EIGENVALUE = 10.0  # [1/s] typical
TURNS = {
    # name: the guess of speeds, and what is held at the generic state
    "WhippleBicycle": ({"rear_wheel_rate": -12.0, "steer": 0.3}, ("roll",))
}
TRIMMED = {"WhippleBicycle": ("roll", "steer")}


def outcome(f, *args, **kwargs):
    """What f returns, or None where it refuses."""
    try:
        return f(*args, **kwargs)
    except ValueError:
        return None


def results(name, units: Units, dtype: Any = np.float64) -> dict:
    """Results of the functions that read a system's equations, in SI units."""
    system, q, u = example(name, dtype)
    factor = lambda names: units.of(system, names).astype(dtype)  # noqa: E731
    f_q, f_u, f_w = factor(system.coordinates), factor(system.speeds), factor(system.inputs)
    scaled, q, u = units.system(system), q * f_q, u * f_u
    second, energy = np.asarray(units.time, dtype), np.asarray(units.factor("N m"), dtype)
    found = {}
    M, f = jk.equations_of_motion(scaled, 0.0, q, u)
    found["mass matrix"] = np.asarray(M) * f_u * f_u[:, None] / energy
    found["forces"] = np.asarray(f) * f_u / energy * second
    found["accelerations"] = np.asarray(jk.accelerations(scaled, 0.0, q, u)) / f_u * second
    model = linearize(scaled, jk.State(q, u), steady=False)
    f_x = factor(model.states)
    A = np.asarray(model.A) / f_x[:, None] * f_x * second
    found["linear model"] = A
    roots = np.asarray(model.eigenvalues) * second
    found["eigenvalues"] = np.poly(roots / EIGENVALUE).real  # the order of equal eigenvalues is that of their rounding
    B = np.asarray(model.B) / f_x[:, None] * f_w * second
    if B.any():
        regulator = outcome(lqr, model, 1.0 / f_x.astype(float) ** 2, 1.0 / f_w.astype(float) ** 2)
        found["regulator"] = None if regulator is None else regulator[0] * f_x / f_w[:, None]
    at_rest = outcome(equilibrium, scaled, q)
    found["equilibrium"] = None if at_rest is None else np.asarray(at_rest.q) / f_q
    if at_rest is not None:
        model = outcome(linearize, scaled, at_rest)
        found["model at rest"] = None if model is None else np.asarray(model.A) / f_x[:, None] * f_x * second
    found["is steady"] = np.array(float(outcome(linearize, scaled, jk.State(q, u)) is not None))
    trim = outcome(equilibrium, scaled, q, hold=TRIMMED.get(name, system.coordinates), find=system.inputs)
    found["trim"] = None if trim is None else np.array([trim[k] for k in system.inputs]) / f_w
    if name in TURNS:
        guess, hold = TURNS[name]
        start = f_u * np.array([guess.get(k, 0.0) for k in system.speeds], dtype)
        at = q * np.array([k in guess or k in hold for k in system.coordinates])
        turn = steady_turn(scaled, at, start, hold=hold)
        found["turn"] = np.concatenate([np.asarray(turn.q) / f_q, np.asarray(turn.u) / f_u])
    if system.dependent_coordinates:
        free = [k in system.dependent_coordinates for k in system.coordinates]
        guess = np.where(free, 1.1 * q + 0.01 * f_q, q).astype(dtype)
        found["assembled"] = np.asarray(jk.assemble(scaled, guess, u).q) / f_q
        open_loop = jk.State(np.where(free, 1.5 * q + 0.01 * f_q, q).astype(dtype), u)
        found["open loop"] = outcome(linearize, scaled, open_loop, steady=False)  # refused
    if system.dependent_speeds:
        choices = jk.best_dependent_speeds(scaled, 0.0, q)
        found["rank"] = np.array(choices.rank)
    return found


def assert_equal(found, expected, rtol, label):
    assert found.keys() == expected.keys()
    for key, x in expected.items():
        y = found[key]
        assert (x is None) == (y is None), f"{label}: {key} is {'refused' if y is None else 'given'}"
        if x is not None:
            largest = np.abs(x).max(initial=0.0)
            size = largest if largest > 1e-12 else 1.0  # such as an upright equilibrium, which is zero within rounding
            np.testing.assert_allclose(y / size, x / size, rtol=0, atol=rtol, err_msg=f"{label}: {key}")


CORNERS = [(1e-9, 1e-9, 1e-9), (1e9, 1e9, 1e9), (1e-9, 1e9, 1e-9)]
CORNERS += [(1e9, 1e-9, 1e9), (1e-9, 1e-9, 1e9), (1e9, 1e9, 1e-9)]
CORNERS += [(1e-2, 1.0, 1.0), (1.0, 1.0, 1e-9), (1.0, 1.0, 1e9), (1.0, 1e9, 1.0)]
COMBINATIONS = [Units(*x) for x in (*CORNERS, *10.0 ** np.random.default_rng(0).uniform(-9, 9, (14, 3)))]
MODERATE = [Units(1e-3, 1e-3, 1.0), Units(1e2, 1e2, 1e-2), Units(1e-2, 1.0, 1e3)]


@pytest.mark.weekly
@pytest.mark.parametrize("name", ["BarWithPiston", "DoublePendulum", "RotatingFrameAndBar", "WhippleBicycle"])
def test_results_do_not_depend_on_the_units_in_float32(name):
    """Within its range: an inertia of 1e-9 kg (1e-9 m)^2 times one of its kind is smaller than any number."""
    expected = results(name, Units())
    for units in (Units(), *MODERATE):
        assert_equal(results(name, units, np.float32), expected, 1e-3, f"{name} in {units}")


@pytest.mark.weekly
@pytest.mark.parametrize(("i", "name"), [*enumerate(CATALOG)])
def test_results_of_every_system_in_six_of_24_unit_systems(i, name):
    """Four systems in succession have all 24 units."""
    expected = results(name, Units())
    for units in COMBINATIONS[i % 4 :: 4]:
        assert_equal(results(name, units), expected, 1e-6, f"{name} in {units}")
