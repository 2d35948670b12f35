"""Muscles: force laws, gas, losses, and the catalogue of known ones."""
