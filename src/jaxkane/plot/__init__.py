"""Pictures with matplotlib: trajectories, eigenvalues, modes, audits, fits.

Every function takes the axes that it draws into and returns them; without, it makes a figure. What is given as plain
arrays may come from anywhere. Colours, sizes and fonts are those of matplotlib's settings, so that a picture follows
`plt.style.use("dark_background")`, and a style sheet of one's own. matplotlib is imported at the first call.
"""

from ._stability import eigenvalues as eigenvalues
from ._stability import mode_shapes as mode_shapes
from ._stability import root_locus as root_locus
from ._trajectories import audit as audit
from ._trajectories import fits as fits
from ._trajectories import trajectories as trajectories
