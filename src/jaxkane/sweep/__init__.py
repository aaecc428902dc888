"""Many simulations at once: tables of members, chunks of bounded memory, devices, clusters, files to go on from."""

from ._members import Table as Table
from ._members import grid as grid
from ._result import Sweep as Sweep
from ._sweep import sweep as sweep
