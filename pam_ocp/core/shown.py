"""Objects that show themselves: one line as repr, tables and a picture in notebooks."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from .. import courtesy
from .errors import with_kinds

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

C = TypeVar("C", bound=type)
LONGEST = 100
"""Of a repr [characters]."""


def shown(cls: C) -> C:
    """Class decorator (above ``@dataclass``): a short repr, a form for notebooks, and arguments of
    the wrong kind named (:func:`with_kinds`).

    The repr is what ``_brief()`` says, or else the first line of ``str``; the form in notebooks is
    that of :mod:`pam_ocp.figures.sheets`. What the class does not have of ``plot``, ``report``,
    ``save``, ``to_excel`` and ``to_pandas`` it gets, by its table
    (:mod:`pam_ocp.figures.tables`).
    """
    own = vars(cls).get("__repr__")
    if own is None or hasattr(own, "__wrapped__"):  # none, or the one that dataclass makes
        setattr(cls, "__repr__", brief)  # noqa: B010 - a type checker sees another method there
    if "_repr_html_" not in vars(cls):
        setattr(cls, "_repr_html_", _Shows._repr_html_)  # noqa: B010
    for name in ("plot", "report", "save", "to_excel", "to_pandas"):
        if not hasattr(cls, name):
            setattr(cls, name, vars(_Shows)[name])
    return with_kinds(cls)


def brief(self: Any) -> str:
    """``<Plan verified: ...>``: the name of the class and a line."""
    said: Any = getattr(self, "_brief", None)
    has_text = "__str__" in {name for cls in type(self).__mro__[:-1] for name in vars(cls)}
    words = said() if said else str(self).partition("\n")[0] if has_text else ""
    line = f"<{type(self).__name__} {words}".rstrip()
    return f"{line[: LONGEST - 5]} ...>" if len(line) >= LONGEST else f"{line}>"


class _Shows:
    def _repr_html_(self) -> str:
        return courtesy.html_of(self)

    def plot(self) -> Figure:
        """The numbers of its table as bars. Returns the matplotlib Figure."""
        return courtesy.plot_table(self)

    def report(self) -> str:
        """All of it as text."""
        return courtesy.report_of(self)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write a page (.html), its table (.csv, .json, .xlsx) or its text (.txt)."""
        return courtesy.save_result(self, path)

    def to_excel(self, path: str | os.PathLike[str]) -> Path:
        """Write its table as a workbook (.xlsx)."""
        return courtesy.save_result(self, path)

    def to_pandas(self) -> pd.DataFrame:
        """Its table as a DataFrame: a row for each part, or for each number."""
        return courtesy.frame_of(self)
