"""Fits of force laws to tables."""
