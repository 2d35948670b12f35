"""Figures as wide as a journal's columns."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any

from ..core.errors import InputError, with_kinds
from ..core.quantities import quantity

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.legend import Legend

WIDTHS = {"column": 0.088, "page": 0.180}
"""[m]"""
RANGE = (0.05, 0.5)
STACKED = 0.12
"""Below this width [m] panels that stand side by side stand one below the other."""
TALLEST = 9.4
"""Of a page [inch]."""
POINTS, THINNER, CHARACTER = 8.0, 0.6, 0.062
"""Size of letters; lines and marks beside those on a screen; the width of a letter [inch]."""
DASHES: tuple[Any, ...] = ("-", (0, (6, 1.5)), "-.", (0, (1, 1)), (0, (6, 1, 1, 1, 1, 1)), ":")
OUTSIDE = "outside upper left"
VECTORS: dict[Any, Any] = {"pdf.fonttype": 42, "ps.fonttype": 42, "svg.fonttype": "none"}
"""Letters stay letters in the file: they can be searched and edited."""
_WIDTH: ContextVar[float | None] = ContextVar("width of figures", default=None)


@with_kinds
@contextmanager
def for_paper(width: str | float = "column") -> Iterator[None]:
    """Figures that are made in this block (by any ``plot``) are for print: 8 pt letters, thin lines
    told apart without colour, letters as text in PDF and SVG, panels one below the other where the
    width asks for it.

    width : "column" (88 mm), "page" (180 mm), or a width of 50 .. 500 mm ("84 mm", or in m).

    Raises InputError for another width.

    Examples
    --------
    >>> with pam.figures.for_paper("column"):
    ...     figure = fit.plot()
    >>> figure.savefig("fit.pdf")
    >>> print(round(25.4 * figure.get_figwidth(), 6))
    88.0
    """
    known = "give 'column' (88 mm), 'page' (180 mm) or a width such as '84 mm'"
    word = width.isalpha() if isinstance(width, str) else False
    if word and width not in WIDTHS:
        raise InputError(f"width = {width!r}: {known}")
    metres = WIDTHS[str(width)] if word else quantity("width", width, "m")
    if not RANGE[0] <= metres <= RANGE[1]:
        raise InputError(f"width = {1e3 * metres:g} mm is outside 50 .. 500 mm; {known}")
    before = _WIDTH.set(metres)
    try:
        yield
    finally:
        _WIDTH.reset(before)


def paper_width() -> float | None:
    """Of figures that are made now [m]; None on a screen."""
    return _WIDTH.get()


def paper_size(
    size: tuple[float, float], rows: int = 1, columns: int = 1
) -> tuple[tuple[float, float], int, int]:
    """Size [inch], rows and columns on paper of a figure that has these on a screen."""
    metres = paper_width()
    if metres is None:
        return size, rows, columns
    wide, high = size
    if metres < STACKED:
        wide, high, rows, columns = wide / columns, high * columns, rows * columns, 1
    width = metres / 0.0254
    # letters do not shrink as much as the width does, nor do panels
    return (width, min(high * (width / wide) ** 0.7, TALLEST)), rows, columns


def adapt(figure: Figure) -> None:
    """Letters, lines and legends of a figure as paper needs them."""
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        text.set(fontsize=POINTS)
    for ax in figure.axes:
        ax.tick_params(labelsize=POINTS, width=0.5, length=2.5)
        for spine in ax.spines.values():
            spine.set_linewidth(0.5)
        _thin(ax)
        if figure.get_figwidth() < STACKED / 0.0254 and ax.get_xscale() == "linear" and ax.lines:
            ax.locator_params(axis="x", nbins=5)
        place = ax.get_position()
        for label, inches in (
            (ax.yaxis.label, place.height * figure.get_figheight()),
            (ax._left_title, place.width * figure.get_figwidth()),  # type: ignore[attr-defined]
        ):
            lines = label.get_text().split("\n")
            fitting = max(int(inches / CHARACTER), 8)
            label.set_text(
                "\n".join(textwrap.fill(line, fitting, break_long_words=False) for line in lines)
            )
        if (legend := ax.get_legend()) is not None:
            _fit_legend(figure, legend, ax)
    for legend in figure.legends:
        _fit_legend(figure, legend, figure)


def _thin(ax: Any) -> None:
    """Thinner lines and marks; solid lines with another dash for each colour, but for scales of
    colours (which no text names)."""
    solid = [n for n in ax.lines if isinstance(n.get_color(), str) and n.get_linestyle() == "-"]
    colours = list(dict.fromkeys(line.get_color() for line in solid))
    for line in ax.lines:
        line.set_linewidth(THINNER * line.get_linewidth())
        line.set_markersize(THINNER * line.get_markersize())
        if line in solid:
            line.set_linestyle(DASHES[colours.index(line.get_color()) % len(DASHES)])
    legend, drawn = ax.get_legend(), ax.get_legend_handles_labels()[0]
    for entry, line in zip(legend.legend_handles if legend else (), drawn, strict=False):
        if line in solid:
            entry.set(linestyle=line.get_linestyle(), linewidth=line.get_linewidth())


def _fit_legend(figure: Figure, legend: Legend, owner: Any) -> None:
    """A legend that stood beside a panel, above it; in as many columns as there is room for."""
    handles: list[Any] = legend.legend_handles
    labels = [text.get_text() for text in legend.get_texts()]
    panel = owner is not figure
    if not labels or (panel and legend.get_bbox_to_anchor().x0 < owner.bbox.x1 - 1):
        return
    if not panel:  # its lines have other dashes now
        handles = figure.axes[0].get_legend_handles_labels()[0]
    place = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0)} if panel else {"loc": OUTSIDE}
    tight = {"fontsize": POINTS, "handlelength": 1.8, "columnspacing": 1.0, "borderpad": 0.1}
    for columns in range(len(labels), 0, -1):
        legend.remove()
        legend = owner.legend(handles, labels, ncols=columns, frameon=False, **place, **tight)
        if legend.get_window_extent().width <= 0.9 * figure.bbox.width:
            break
    if panel and (title := owner.get_title("left")):
        height = 72 * legend.get_window_extent().height / figure.dpi
        owner.set_title(title, loc="left", fontsize=POINTS, pad=height + 8)
