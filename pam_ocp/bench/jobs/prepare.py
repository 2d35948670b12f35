"""What a process loads before its first job."""

from __future__ import annotations

from ...muscles.catalogue import muscle

__all__ = ["prepare"]


def prepare() -> None:
    """Load the modules of the first jobs of a session, and build one law's functions."""
    from . import data, plant
    from . import muscle as fits

    assert all((data, fits, plant))  # loading them is what is wanted
    muscle("DMSP-20-300").force(3e5, 0.1)
