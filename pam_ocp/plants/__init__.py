"""Plants: muscles and a load, as named variables and CasADi expressions."""

from ..core.lazy import from_stub

__getattr__, __dir__, __all__ = from_stub(__name__, __file__)
