"""Many simulations at once: tables of members, chunks of bounded memory, devices, clusters, files to go on from."""

from ._result import Sweep as Sweep
from ._sweep import sweep as sweep
from ._table import Table as Table
from ._table import grid as grid
