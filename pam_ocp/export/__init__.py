"""Export of a plant to other worlds: ``pam.export(plant, "slide.fmu")``; and checks of files."""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any

from ..core.lazy import from_stub

__getattr__, __dir__, __all__ = from_stub(__name__, __file__)
__module__ = None  # as of every module: that of its class would be found


class _Verb(ModuleType):
    """The room is a verb, too: a call is that of ``worlds.registry.export``."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        from .worlds.registry import export

        return export(*args, **kwargs)


sys.modules[__name__].__class__ = _Verb
