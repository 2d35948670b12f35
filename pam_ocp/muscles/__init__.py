"""Muscles: force laws, gas, losses, and the catalogue of known ones."""

from .laws import braid as braid
from .laws import empirical as empirical
from .laws import thick_wall as thick_wall
