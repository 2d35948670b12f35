"""Plan: optimal motions by direct transcription."""

from ..core.lazy import from_stub

__getattr__, __dir__, __all__ = from_stub(__name__, __file__)
