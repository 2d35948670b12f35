"""Drivers: ways to a rig; those that speak lines of text share a file."""
