"""The peers: what each is called, what it needs, and which of them are missing here."""

from __future__ import annotations

import importlib.util

# Name: modules that it needs, how it is had.
PEERS = {
    "SymPy + lambdify": (("sympy",), "pip install sympy"),
    "SymPy + C": (("sympy", "cc"), "pip install sympy, and a C compiler with Python's headers"),
    "PyDy's Cython": (("pydy", "Cython", "setuptools", "cc"), "pip install pydy cython setuptools, and a C compiler"),
    "MuJoCo": (("mujoco",), "pip install mujoco"),
    "MJX": (("mujoco.mjx",), "pip install mujoco-mjx"),
    "Pinocchio": (("pinocchio",), "pip install pin"),
    "JaxSim": (("jaxsim", "rod"), "pip install jaxsim"),
    "opty": (
        ("opty", "casadi", "Cython", "setuptools", "cc"),
        "pip install cyipopt-wheels cython; opty --no-deps",
    ),
    "BicycleParameters": (("bicycleparameters",), "pip install BicycleParameters"),
}


def here(name: str) -> bool:
    """Whether all that a peer needs is installed."""
    return all(map(_found, PEERS[name][0]))


def missing() -> dict[str, str]:
    """The peers that are not here, and how to have them."""
    return {name: how for name, (_, how) in PEERS.items() if not here(name)}


def _found(module: str) -> bool:
    if module == "cc":
        from .bicycle_in_c import compiler

        return compiler() is not None
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:  # the package that holds the module
        return False
