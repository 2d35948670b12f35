"""What a plant may be built of, by name: the registries of plants and of their components.

Each stands here without its kinds: these register in the files of this room that define them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..core.registry import Registry

PLANTS: Registry[Callable[..., Any]] = Registry("plant", __package__)
"""Plants of the library: called with a muscle, and their own arguments by name."""
FEEDS: Registry[Callable[..., Any]] = Registry("feed", __package__, argument="feed")
DAMPINGS: Registry[Callable[..., Any]] = Registry("damping", __package__, argument="damping")
LOSSES: Registry[Callable[..., Any]] = Registry("loss", __package__, argument="losses")
LOADS: Registry[Callable[..., Any]] = Registry("load", __package__, argument="loads")
TUBES: Registry[Callable[..., Any]] = Registry("tube", __package__, argument="tube", default="Tube")
SPOOLS: Registry[Callable[..., Any]] = Registry("spool", __package__, argument="spool")
SUPPLIES: Registry[Callable[..., Any]] = Registry("supply", __package__, argument="supply")
SOURCES: Registry[Callable[..., Any]] = Registry("source", __package__, argument="source")
QUICK_EXHAUSTS: Registry[Callable[..., Any]] = Registry(
    "quick exhaust", __package__, argument="quick_exhaust"
)
DEAD_TIMES: Registry[Callable[..., Any]] = Registry("dead time", __package__, argument="dead_time")
SENSORS: Registry[Callable[..., Any]] = Registry("sensor", __package__, argument="sensors")
