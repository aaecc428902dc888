"""Plots with matplotlib: trajectories, eigenvalues, modes, audits, fits.

Each function draws into the axes that are passed and returns them; without axes it makes a figure. Plain arrays may
come from any source. Colours, sizes and fonts follow matplotlib's settings, such as `plt.style.use("dark_background")`.
matplotlib is imported at the first call.
"""

from ._fits import costs as costs
from ._fits import estimates as estimates
from ._fits import fits as fits
from ._fits import profiles as profiles
from ._fits import residuals as residuals
from ._fits import selection_path as selection_path
from ._motions import audit as audit
from ._motions import eigenvalues as eigenvalues
from ._motions import frequency_response as frequency_response
from ._motions import mode_shapes as mode_shapes
from ._motions import root_locus as root_locus
from ._motions import trajectories as trajectories
