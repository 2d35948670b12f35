"""Real rigs: drivers, a guard with its watchdog, twins, homing, identification, learning. Each name
is imported from its module.
"""

from ..core.lazy import from_stub

__getattr__, __dir__, __all__ = from_stub(__name__, __file__)
