"""Jobs that use everything: the tour, the study of loads, studies out of one file."""

from ..core.lazy import from_stub

__getattr__, __dir__, __all__ = from_stub(__name__, __file__)
