"""Muscles: force laws, losses, and the catalogue of known ones."""
