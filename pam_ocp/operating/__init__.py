"""Equilibria, paths of them, and linear systems there."""

from ..core.lazy import from_stub

__getattr__, __dir__, __all__ = from_stub(__name__, __file__)
