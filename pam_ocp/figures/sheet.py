"""What objects show in notebooks: a verdict, tables with units, a small picture, as HTML."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

from ..core.units import significant

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["DPI", "Grid", "Sheet", "cell_text", "number_in"]

DPI = 60
"""Of pictures, which are there for a glance: ``.plot()`` gives the whole one."""
MOST_ROWS, SHORT = 60, 10


def cell_text(cell: str | float) -> str:
    """A text as it is, a number as people read it."""
    return cell if isinstance(cell, str) else significant(cell).replace("inf", "∞")


def number_in(cell: str | float) -> str | float:
    """The number of a cell, or its text."""
    try:
        return float(cell)
    except ValueError:
        return cell


def _cell(text: str) -> str:
    """Short ones are not broken where the page is narrow."""
    kind = ' class="short"' if len(text) <= SHORT else ""
    return f"<td{kind}>{escape(text)}</td>"


@dataclass(frozen=True)
class Grid:
    """A table: heads, and rows of texts and of numbers, which are rounded where they are shown. The
    first column is the row's name.
    """

    head: tuple[str, ...]
    rows: Sequence[Sequence[str | float]]
    title: str = ""

    def html(self) -> str:
        """As an HTML table without empty columns, cut after ``MOST_ROWS`` rows."""
        told = [j for j in range(len(self.head)) if any(row[j] != "" for row in self.rows)]
        head = "".join(f"<th>{escape(self.head[j])}</th>" for j in told)
        rows = [
            "<tr>" + "".join(_cell(cell_text(row[j])) for j in told) + "</tr>"
            for row in self.rows[:MOST_ROWS]
        ]
        if len(self.rows) > MOST_ROWS:
            more = f"... {len(self.rows) - MOST_ROWS} more rows"
            rows.append(f'<tr><td colspan="{len(told)}">{more}</td></tr>')
        caption = f"<caption>{escape(self.title)}</caption>" if self.title else ""
        body = f"<thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody>"
        return f"<table>{caption}{body}</table>"


@dataclass(frozen=True)
class Sheet:
    """What an object shows: heading, verdict (``good`` or not), tables, notes, text, picture."""

    heading: str
    verdict: str = ""
    good: bool = True
    grids: tuple[Grid, ...] = ()
    notes: tuple[str, ...] = ()
    text: str = ""
    picture: Callable[[], Figure] | None = None

    def html(self, dpi: int = DPI) -> str:
        """As a block of HTML without scripts; readable in light and dark."""
        parts = [f"<b>{escape(self.heading)}</b>"]
        if self.verdict:
            colour, mark = ("#009e73", "✓") if self.good else ("#d55e00", "✗")
            style = f"border-left:4px solid {colour};padding-left:8px;margin:6px 0"
            parts.append(f'<div style="{style}">{mark} {escape(self.verdict)}</div>')
        parts += [grid.html() for grid in self.grids if grid.rows]
        parts += [f"<div>⚠ {escape(note)}</div>" for note in self.notes]
        if self.text:
            parts.append(f'<pre style="line-height:1.25">{escape(self.text)}</pre>')
        if self.picture is not None and dpi:
            parts.append(_embedded(self.picture, dpi))
        return f'<div class="pam_ocp">{"".join(parts)}</div>'


def _embedded(picture: Callable[[], Figure], dpi: int) -> str:
    drawn = io.BytesIO()
    picture().savefig(drawn, format="png", dpi=dpi)
    data = base64.b64encode(drawn.getvalue()).decode("ascii")
    return f'<img alt="plot" style="max-width:100%" src="data:image/png;base64,{data}"/>'
