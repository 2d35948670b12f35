"""Measured tables that ship with the package; see README.md for their source."""
