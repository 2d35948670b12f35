"""Fits of whole plants to records."""
