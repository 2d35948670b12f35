"""Verdicts on motions and loops, from a plant, a statement and signals alone."""
