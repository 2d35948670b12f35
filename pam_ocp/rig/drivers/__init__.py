"""Drivers: one way to a rig each, in a file of its own."""
