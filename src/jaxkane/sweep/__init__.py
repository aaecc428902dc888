"""Parameter sweeps: many simulations in chunks of bounded memory, on several devices or a cluster, resumable from
files."""

from ._members import Table as Table
from ._members import grid as grid
from ._sweep import Sweep as Sweep
from ._sweep import sweep as sweep
