"""Five systems of SymPy's own tests agree with SymPy's accelerations."""

import numpy as np
import pytest
from sympy_systems import FIGURES, SYSTEMS, FourBarLinkage

import jaxkane as jk

RTOL = 1e-11


@pytest.mark.slow_cases("pendulum_cartesian_nonminimal", "four_bar_linkage", "n_link_pendulum_on_cart_n3")
@pytest.mark.parametrize("name", SYSTEMS)
def test_accelerations_of_all_speeds_agree_with_sympy(name):
    system = SYSTEMS[name](**FIGURES[name]["params"])
    speeds = (*system.speeds, *system.dependent_speeds)
    for state in FIGURES[name]["states"]:
        q = np.array([state["q"][x] for x in system.coordinates])
        u = np.array([state["u"][x] for x in system.speeds])
        at = (system, 0.0, q, u)
        u_all = np.concatenate([u, jk.dependent_speeds(*at) if system.dependent_speeds else []])
        np.testing.assert_allclose(u_all, [state["u"][x] for x in speeds], rtol=RTOL)
        u_dot = jk.accelerations(*at, state["inputs"])
        u_dep_dot = jk.dependent_accelerations(*at, state["inputs"]) if system.dependent_speeds else []
        expected = np.array([state["udot"][x] for x in speeds])
        np.testing.assert_allclose(np.concatenate([u_dot, u_dep_dot]), expected, rtol=RTOL)


@pytest.mark.slow
@pytest.mark.optimized
@pytest.mark.published
def test_accelerations_of_a_four_bar_linkage_agree_with_sympys_printed_state(published):
    printed = FIGURES["four_bar_linkage"]["published_in_test"]
    l1, l2, l3, l4, rho = printed["p"]
    system = FourBarLinkage(l1, l2, l3, l4, rho)
    at = (system, 0.0, np.array(printed["q"]), np.array(printed["u"][:1]))
    u_dot = np.concatenate([jk.accelerations(*at), jk.dependent_accelerations(*at)])
    # [M; A] u_dot = [f; -A_dot u], and the forcing is printed with eleven digits
    forcing = np.array(printed["forcing"])
    found = np.array(printed["mass"]) @ u_dot
    published("SymPy's tests", "forcing of a four-bar linkage", forcing, found, 1e-9 * np.abs(forcing))


def test_a_closed_loop_is_assembled_from_a_guess():
    system = FourBarLinkage(**FIGURES["four_bar_linkage"]["params"])
    for state in FIGURES["four_bar_linkage"]["states"]:
        q = [state["q"][x] for x in system.coordinates]
        found = jk.assemble(system, np.array([q[0], q[1] + 0.1, q[2] - 0.1]), np.array([state["u"]["u1"]]))
        np.testing.assert_allclose(found.q, q, rtol=1e-11)
