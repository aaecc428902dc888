"""Tyres that slip, against the equations of motion of another author's bicycle: mechmotum/bicycle-kickplate-model.

`data/kickplate.json` says how its figures were made. Its model has more than ours (tyres that give way vertically) and
other rules of rolling, so these parts of it are compared:

- with knife edges, of which its tyres are held at their sinkage: all accelerations, with lateral forces, aligning
  moments, torques and the normal loads; cambers; the rates of forces that relax;
- with toroidal tyres: the configuration. Its motion is not: its wheels roll on the radius of the rim, and its lateral
  forces have no moment about the middle of the tyre's section.

Its slip angle is taken over a signed speed, and its linear law lets camber push away from the lean; forces, and what
they relax to, are given to it as ours are.
"""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import jaxkane as jk
from jaxkane.bicycles import Bicycle, LateralSlip, Tyre

KNOWN = json.loads((Path(__file__).parents[1] / "data" / "kickplate.json").read_text())
ENDS = ("rear", "front")


def bicycle(folder, tyres, **radii):
    path = folder / "browser.yml"
    values = KNOWN["parameters"] | radii
    lines = [f"  {name}: {value!r}\n" for name, value in values.items()]
    path.write_text("parameterization: Moore2012\nvalues:\n" + "".join(lines))
    return Bicycle.from_file(path).with_parts(**{f"{end}_tyre": tyres[end] for end in ENDS})


@pytest.fixture
def instants(tmp_path):
    """Each known state, and the arguments that ask for what happens in it."""
    tyres = {end: Tyre(lateral=LateralSlip(**KNOWN["laws"][end])) for end in ENDS}
    made = bicycle(tmp_path, tyres)

    def arguments(state):
        q = jnp.array([state["q"][name] for name in made.coordinates])
        u = jnp.array([state["u"][name] for name in made.speeds])
        return made, 0.0, q, u, state["inputs"] | state["deflections"]

    return [(state, arguments(state)) for state in KNOWN["states"]]


@pytest.mark.slow
def test_accelerations_of_a_bicycle_with_tyre_slip(instants):
    """1e-11 of each; the front wheel's slip follows from the others. Forces and moments are those it was given."""
    for state, at in instants:
        for end in ENDS:
            law = LateralSlip(**KNOWN["laws"][end])
            force = law.force(state["deflections"][f"{end}_lateral_deflection"] / law.relaxation_length, 0.0, 0.0)
            np.testing.assert_allclose(force, state["forces"][end], rtol=1e-14)
            np.testing.assert_allclose(
                law.moment(force, 0.0, 0.0, state["cambers"][end]), state["moments"][end], rtol=1e-14
            )
        rates, known = jk.speed_rates(*at), state["accelerations"]
        np.testing.assert_allclose([rates[name] for name in known], list(known.values()), rtol=1e-12, atol=1e-11)


@pytest.mark.weekly
def test_normal_loads_of_a_bicycle_with_tyre_slip(instants):
    """1e-10 N."""
    for state, at in instants:
        forces = jk.constraint_forces(*at)
        found = [-forces[point][2] for point in ("P", "Q")]
        np.testing.assert_allclose(found, [state["loads"][end] for end in ENDS], atol=1e-10)


@pytest.mark.weekly
def test_tyre_relaxation_in_forward_and_backward_motion(instants):
    """1e-12 of the rates of the forces [N/s]: relaxation_length / |speed| F' + F = C1 slip + C2 camber."""
    directions = set()
    for state, at in instants:
        directions.add(state["u"]["rear_wheel_rate"] < 0.0)
        rates = jk.state_rates(*at)
        for end in ENDS:
            law, known = KNOWN["laws"][end], state["force_rates"][end]
            slope = law["cornering_stiffness"] / law["relaxation_length"]
            np.testing.assert_allclose(slope * rates[f"{end}_lateral_deflection"], known, rtol=1e-12, atol=1e-10)
    assert directions == {True, False}


@pytest.mark.slow
def test_configuration_of_toroidal_tyres(tmp_path):
    """1e-14: the pitch that puts both tyres on the ground, and where the front one touches it."""
    crowns = KNOWN["toroidal"]["crowns"]
    tyres = {end: Tyre(crown=crown) for end, crown in crowns.items()}
    radii = {f"r{end[0]}": KNOWN["parameters"][f"r{end[0]}"] + crown for end, crown in crowns.items()}
    made = bicycle(tmp_path, tyres, **radii)
    for state, known in zip(KNOWN["states"], KNOWN["toroidal"]["states"], strict=True):
        at = [name for name in made.coordinates if name != "pitch"]
        start = jk.assemble(made, {name: state["q"][name] for name in at})
        q = dict(zip(made.coordinates, start.q, strict=True))
        np.testing.assert_allclose(q["pitch"] + made.lam, known["tilt"], atol=1e-14)
        np.testing.assert_allclose(
            jk.positions(made, 0.0, start.q, start.u)["Q"], [*known["front_contact"], 0.0], atol=1e-14
        )
