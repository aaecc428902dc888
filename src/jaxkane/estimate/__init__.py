"""Online estimation: Kalman filters as pure functions of one time step."""

from ._filter import Belief as Belief
from ._filter import Filter as Filter
from ._filter import Innovation as Innovation
from ._filter import begin as begin
from ._filter import nees as nees
from ._filter import predict as predict
from ._filter import update as update
