"""Faults put into the source, and which of them the tests see."""
