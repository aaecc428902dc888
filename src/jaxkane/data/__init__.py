"""Measured data of six real machines, shipped with the library: trials to fit, and the parameters that their authors
report."""

from ._recordings import Recording as Recording
from ._recordings import davis_rider as davis_rider
from ._recordings import driven_double_pendulum as driven_double_pendulum
from ._recordings import multi_arm_pendulum as multi_arm_pendulum
from ._recordings import robot_bicycle as robot_bicycle
from ._recordings import steer_by_wire as steer_by_wire
from ._recordings import tossed_elbow as tossed_elbow
