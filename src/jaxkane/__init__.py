"""Kane's equations in JAX: describe a mechanism; simulate, sweep, audit and identify it by gradients.

Modules are imported when one of their names is used (SPEC 1 of Scientific Python).
"""

import importlib as _importlib
import typing as _typing

from ._scalarjit.compat import switch_off_wrong_fusions as _switch_off_wrong_fusions
from ._version import __version__ as __version__

_switch_off_wrong_fusions()

if _typing.TYPE_CHECKING:  # the same names as below, for type checkers and the documentation
    from . import bicycles as bicycles
    from . import catalog as catalog
    from . import collocation as collocation
    from . import convert as convert
    from . import data as data
    from . import estimate as estimate
    from . import export as export
    from . import fit as fit
    from . import joints as joints
    from . import loads as loads
    from . import plot as plot
    from . import rotations as rotations
    from . import sensors as sensors
    from . import shapes as shapes
    from . import stability as stability
    from . import sweep as sweep
    from . import symbolic as symbolic
    from ._animate import Animation as Animation
    from ._animate import Sketch as Sketch
    from ._animate import animate as animate
    from ._integrate.audit import Audit as Audit
    from ._integrate.audit import audit as audit
    from ._integrate.events import Status as Status
    from ._integrate.events import falling as falling
    from ._integrate.events import rising as rising
    from ._integrate.inputs import Samples as Samples
    from ._integrate.simulate import ode_term as ode_term
    from ._integrate.simulate import simulate as simulate
    from ._integrate.trajectory import Trajectory as Trajectory
    from ._integrate.trajectory import constraint_forces as constraint_forces
    from ._integrate.trajectory import constraint_multipliers as constraint_multipliers
    from ._integrate.trajectory import orientations as orientations
    from ._integrate.trajectory import outputs as outputs
    from ._integrate.trajectory import positions as positions
    from ._integrate.trajectory import speed_rates as speed_rates
    from ._integrate.trajectory import state_rates as state_rates
    from ._integrate.trajectory import velocities as velocities
    from ._kane.api import accelerations as accelerations
    from ._kane.api import constraint_jacobian as constraint_jacobian
    from ._kane.api import constraint_jacobian_rate as constraint_jacobian_rate
    from ._kane.api import coordinate_rates as coordinate_rates
    from ._kane.api import dependent_accelerations as dependent_accelerations
    from ._kane.api import dependent_speeds as dependent_speeds
    from ._kane.api import equations_of_motion as equations_of_motion
    from ._kane.api import forcing as forcing
    from ._kane.api import generalized_active_forces as generalized_active_forces
    from ._kane.api import generalized_inertia_forces as generalized_inertia_forces
    from ._kane.api import kinetic_energy as kinetic_energy
    from ._kane.api import mass_matrix as mass_matrix
    from ._kane.api import partial_velocities as partial_velocities
    from ._kane.consistent_state import assemble as assemble
    from ._kane.constraint_residuals import best_dependent_speeds as best_dependent_speeds
    from ._kane.contact.declarations import Contact as Contact
    from ._kane.contact.declarations import DryFriction as DryFriction
    from ._kane.contact.impact import impact as impact
    from ._kane.contact.impulses import Impact as Impact
    from ._kane.multipliers import with_multipliers as with_multipliers
    from ._scalarjit.cache_key import forget as forget
    from ._scalarjit.components import Scalar as Scalar
    from ._scalarjit.configure import Configuration as Configuration
    from ._scalarjit.configure import configure as configure
    from ._system.kinematics import Frame as Frame
    from ._system.kinematics import Point as Point
    from ._system.kinematics import Vector as Vector
    from ._system.kinematics import inertial as inertial
    from ._system.motion import Body as Body
    from ._system.motion import Force as Force
    from ._system.motion import Motion as Motion
    from ._system.motion import Torque as Torque
    from ._system.motion import weight as weight
    from ._system.parameters import learned as learned
    from ._system.parameters import parameter as parameter
    from ._system.system import State as State
    from ._system.system import System as System

_PACKAGES = """
bicycles catalog collocation convert data estimate export fit joints loads plot rotations sensors shapes stability sweep
symbolic
""".split()
_NAMES = {
    "_animate": "Animation Sketch animate",
    "_integrate.audit": "Audit audit",
    "_integrate.events": "Status falling rising",
    "_integrate.inputs": "Samples",
    "_integrate.trajectory": "Trajectory constraint_forces constraint_multipliers orientations outputs positions "
    "speed_rates state_rates velocities",
    "_integrate.simulate": "ode_term simulate",
    "_kane.api": "accelerations constraint_jacobian constraint_jacobian_rate coordinate_rates "
    "dependent_accelerations dependent_speeds equations_of_motion forcing generalized_active_forces "
    "generalized_inertia_forces kinetic_energy mass_matrix partial_velocities",
    "_kane.consistent_state": "assemble",
    "_kane.constraint_residuals": "best_dependent_speeds",
    "_kane.contact.declarations": "Contact DryFriction",
    "_kane.contact.impact": "impact",
    "_kane.contact.impulses": "Impact",
    "_kane.multipliers": "with_multipliers",
    "_scalarjit.cache_key": "forget",
    "_scalarjit.components": "Scalar",
    "_scalarjit.configure": "Configuration configure",
    "_system.kinematics": "Frame Point Vector inertial",
    "_system.motion": "Body Force Motion Torque weight",
    "_system.parameters": "learned parameter",
    "_system.system": "State System",
}
_MODULE_OF = {name: module for module, names in _NAMES.items() for name in names.split()}
__all__ = ["__version__", *_PACKAGES, *_MODULE_OF]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> _typing.Any:
    if name in _PACKAGES:
        return _importlib.import_module(f".{name}", __name__)
    if name in _MODULE_OF:
        globals()[name] = thing = getattr(_importlib.import_module(f".{_MODULE_OF[name]}", __name__), name)
        return thing
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
