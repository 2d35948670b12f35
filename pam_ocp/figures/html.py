"""Any object as HTML, for notebooks."""

from __future__ import annotations

import inspect
from typing import Any

from ..core.shown import shown
from .sheet import DPI, Sheet
from .sheets import SHEETS

__all__ = ["html_of", "sheet_of"]


def html_of(thing: Any, dpi: int = DPI) -> str:
    """The form in notebooks of any noun or result; see :mod:`pam_ocp.figures.sheets`.

    dpi : of its picture; 0 leaves it out.
    """
    return sheet_of(thing).html(dpi)


def sheet_of(thing: Any) -> Sheet:
    """What an object shows: by its class, or its text and its picture."""
    for cls in type(thing).__mro__:
        if cls.__name__ in SHEETS and cls.__module__.startswith(f"{__package__.split('.')[0]}."):
            return SHEETS[cls.__name__](thing)
    return _plain(thing)


def _plain(thing: Any) -> Sheet:
    """Of a result without a sheet of its own: its text and its picture."""
    plot = getattr(thing, "plot", None)
    own = getattr(type(thing).plot, "__module__", "") != shown.__module__ if plot else False
    drawable = (
        own
        and callable(plot)
        and all(
            p.default is not p.empty or p.kind in (p.VAR_KEYWORD, p.VAR_POSITIONAL)
            for p in inspect.signature(plot).parameters.values()
        )
    )
    return Sheet(type(thing).__name__, text=str(thing), picture=plot if drawable else None)
