"""Judge: verdicts on motions and closed loops, from a plant, a statement and signals alone."""

from ..core.lazy import from_stub

__getattr__, __dir__, __all__ = from_stub(__name__, __file__)
