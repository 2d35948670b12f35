"""Controllers and estimators by the name that a problem file gives as their ``kind``.

Each is called with the model (a Plant) and its own arguments by name; those of a controller about a
equilibrium hold ``at``, which is the rest that a run starts from unless a file says another.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..core.block import Block
from ..core.registry import Registry

__all__ = ["BLOCKS", "CONTROLLERS", "ESTIMATORS"]

CONTROLLERS: Registry[Callable[..., Any]] = Registry("controller", __package__)
ESTIMATORS: Registry[Callable[..., Any]] = Registry("estimator", f"{__package__}.estimators")
BLOCKS: Registry[Callable[..., Block]] = Registry("block", __package__)
"""The functions that make a block of a controller's law, by the name of its class."""
