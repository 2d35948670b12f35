"""Pneumatic artificial muscles."""
