"""Bicycles of the literature that take more than the four bodies of Whipple's. Knows their figures."""

from __future__ import annotations

from ._bicycle import Bicycle
from ._files import as_meijaard
from ._rider import rider_of
from ._tyre import Tyre

# BicycleParameters 1.5.2, `parameter_dicts.mooreriderlean2012_browser_jason`, with the names of Moore (2012), *Human
# control of a bicycle*: the measured Batavus Browser, with the legs of a rider in its rear frame C, and his upper body
# G from a geometric model of the person. Its k9 and c9 are zero.
_BROWSER_JASON = {
    "d1": 0.9631492634872098, "d2": 0.4338396131640938, "d3": 0.0705000000001252, "d4": -0.6704626684911591,
    "g": 9.81, "rf": 0.34352982332, "rr": 0.340958858855,
    "ic11": 2.296859222953584, "ic22": 2.9922715238, "ic31": 0.01594448114273473, "ic33": 1.5101858377464155,
    "id11": 0.0904106601579, "id22": 0.152467620286,
    "ie11": 0.2811355367159554, "ie22": 0.246138810935, "ie31": 0.0063377219110826045, "ie33": 0.06782113764394461,
    "if11": 0.0883819364527, "if22": 0.149389340425,
    "ig11": 2.038073562525466, "ig22": 1.692108544034995, "ig31": 0.002113501449812, "ig33": 1.100753962972129,
    "l1": 0.47759794513190806, "l2": -0.1680324796714025, "l3": -0.07654646159268344, "l4": -0.47166687226492093,
    "l5": 0.231223496809401, "l6": -0.271613547251923,
    "mc": 33.044, "md": 3.11, "me": 3.22, "mf": 2.02, "mg": 48.816,
}  # fmt: skip


def browser_jason(stiffness: float = 0.0, damping: float = 0.0) -> Bicycle:
    """A measured city bicycle with a rider whose upper body leans: the Batavus Browser with Jason, of Moore (2012).

    **Arguments:** `stiffness` [N m/rad] and `damping` [N m s/rad] at the rider's hinge, both zero in the source.
    """
    found, rider = as_meijaard("MooreRiderLean2012", {**_BROWSER_JASON, "k9": stiffness, "c9": damping})
    assert rider is not None  # the set of names holds one
    return Bicycle.from_parameters({**found, "rider": rider_of(rider)})


def toroidal(rear_crown: float = 0.02, front_crown: float = 0.02) -> Bicycle:
    """The benchmark bicycle on tyres with a round cross section, of these radii [m], that roll without slip."""
    return Bicycle.benchmark().with_parts(rear_tyre=Tyre(crown=rear_crown), front_tyre=Tyre(crown=front_crown))
