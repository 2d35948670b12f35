"""Muscles: force laws, gas, losses, and the catalogue of known ones."""

from . import braid, empirical, wall  # noqa: F401  (each registers its laws in force.LAWS)
