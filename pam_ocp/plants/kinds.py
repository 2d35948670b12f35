"""What a plant may be built of, by name: the registries of plants and of their components.

Each stands here without its kinds: these register in the files of this room that define them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from ..core.registry import Registry

if TYPE_CHECKING:
    from .feeds import Feed
    from .loads import Load
    from .losses import Damping, Loss
    from .plant import Plant
    from .valves import Tube

__all__ = ["DAMPINGS", "FEEDS", "LOADS", "LOSSES", "PLANTS", "TUBES"]

PLANTS: Registry[Callable[..., Plant]] = Registry("plant", __package__)
"""Plants of the library: called with a muscle, and their own arguments by name."""
FEEDS: Registry[Callable[..., Feed]] = Registry("feed", __package__, argument="feed")
DAMPINGS: Registry[Callable[..., Damping]] = Registry("damping", __package__, argument="damping")
LOSSES: Registry[Callable[..., Loss]] = Registry("loss", __package__, argument="losses")
LOADS: Registry[Callable[..., Load]] = Registry("load", __package__, argument="loads")
TUBES: Registry[Callable[..., Tube]] = Registry("tube", __package__, argument="tube")
