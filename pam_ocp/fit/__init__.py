"""Fit: from measurements to parameters."""
