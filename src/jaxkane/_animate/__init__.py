"""Animations of any system, as a page for any browser or as a GIF."""

from ._animate import Animation as Animation
from ._animate import animate as animate
from ._figures import Sketch as Sketch
