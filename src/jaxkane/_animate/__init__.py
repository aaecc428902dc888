"""Animations of any system, as a page that needs nothing but a browser, or as a GIF."""

from ._animate import Animation as Animation
from ._animate import animate as animate
from ._figures import Sketch as Sketch
