"""Measured tables and records, and how they are read."""
