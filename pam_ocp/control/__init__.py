"""Controllers for plants and what tells how good they are. Each name is imported from its
module.
"""

from ..core.lazy import from_stub

__getattr__, __dir__, __all__ = from_stub(__name__, __file__)
