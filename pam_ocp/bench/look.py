"""One look for the page's pictures: figures of Plotly as plain mappings. No page is needed.

Colours are those of printed figures (figures/canvas.py); text, grid and background follow the
page's light and dark by bench.css.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..core.units import quantity_of
from ..figures.canvas import COLOURS as COLOURS

SYMBOLS = ("circle", "square", "triangle-up", "diamond", "triangle-down", "cross")
"""Beside the colours, so that points are told apart by shape, too."""
FAINT = "#8a949c"
"""Of what is switched off, or a reference: seen on light and on dark."""
SCALE = "Cividis"
"""Of surfaces and maps: even in lightness, the same to all eyes."""
GRID = "rgba(128,140,150,0.28)"
_AXIS = {
    "gridcolor": GRID,
    "zerolinecolor": "rgba(128,140,150,0.55)",
    "linecolor": "rgba(128,140,150,0.8)",
    "showline": True,
    "ticks": "outside",
    "ticklen": 4,
    "automargin": True,
}


def figure(
    data: Sequence[Mapping[str, Any]],
    x: str = "",
    y: str = "",
    *,
    height: int = 340,
    keep: str = "same",
    **layout: Any,
) -> dict[str, Any]:
    """A figure with axes named x and y, which name their units: "pressure [bar]".

    keep : while it stays the same, zoom and hidden curves do, too. layout : further, of Plotly's.
    """
    axes = {n: {**axis(w), **layout.pop(n, {})} for n, w in (("xaxis", x), ("yaxis", y))}
    return {
        "data": list(data),
        "layout": {
            "height": height,
            "margin": {"l": 56, "r": 12, "t": 12, "b": 42},
            "font": {"family": "system-ui, sans-serif", "size": 12, "color": "#6b7680"},
            "paper_bgcolor": "rgba(0,0,0,0)",
            "plot_bgcolor": "rgba(0,0,0,0)",
            "colorway": list(COLOURS),
            "hovermode": "closest",
            "showlegend": True,
            "legend": {
                "font": {"size": 11},
                "itemsizing": "constant",
                "x": 0.995,
                "y": 0.995,
                "xanchor": "right",
                "yanchor": "top",
            },
            "uirevision": keep,
            **axes,
            **layout,
        },
        "config": {
            "displaylogo": False,
            "responsive": True,
            "scrollZoom": False,
            "modeBarButtonsToRemove": ["select2d", "lasso2d", "autoScale2d"],
        },
    }


def blank(figure: Mapping[str, Any], words: str) -> dict[str, Any]:
    """A figure without data: no axes, and what will be there."""
    layout = figure["layout"]
    lines = "<br>".join(textwrap.wrap(words, 44))  # Plotly breaks no lines by itself
    note = {"text": lines, "showarrow": False, "xref": "paper", "yref": "paper", "x": 0.5, "y": 0.5}
    hidden = {k: {"visible": False} for k in layout if k.startswith(("xaxis", "yaxis"))}
    shown = {"annotations": [note], "height": min(layout["height"], 160), **hidden}
    return {**figure, "layout": {**layout, **shown}}


def described(figure: Mapping[str, Any]) -> str:
    """What a figure shows, in words: "6 curves; force from 0 to 1654 N"."""
    data, layout = figure["data"], figure["layout"]
    curves = [d for d in data if "lines" in d.get("mode", "") and "fill" not in d]
    marks = sum(len(d["x"]) for d in data if d.get("mode") == "markers")
    parts = [f"{n} {w}{'s' * (n != 1)}" for n, w in ((len(curves), "curve"), (marks, "point")) if n]
    scene = layout.get("scene")
    for key, side in (scene or layout).items():
        if key[:5] not in ("xaxis", "yaxis", "zaxis"):
            continue
        own = f"{key[0]}{key[5:]}"
        drawn = [
            d[key[0]]
            for d in data
            if key[0] in d and "fill" not in d and (scene or d.get(f"{key[0]}axis", key[0]) == own)
        ]
        parts += _range(side["title"]["text"], drawn)
    return "; ".join(parts)


def _range(title: str, drawn: Sequence[Any]) -> list[str]:
    """What an axis [unit] spans, on which this is drawn."""
    values = np.concatenate([np.zeros(0), *(np.asarray(d, float).ravel() for d in drawn)])
    values = values[np.isfinite(values)]
    name, _, unit = title.partition(" [")
    unit = "" if unit == "1]" else f" {unit[:-1]}"
    return [f"{name} from {values.min():.4g} to {values.max():.4g}{unit}"] if values.size else []


def quantity(unit: str) -> str:
    """The title of an axis of what is measured in a unit: "pressure [bar]"."""
    name = quantity_of(unit) or ("part" if unit in ("1", "%") else "value")
    return name if unit == "1" else f"{name} [{unit}]"


def colour(number: int) -> str:
    """Of a curve among others."""
    return COLOURS[number % len(COLOURS)]


def symbol(number: int) -> str:
    """Of points among others."""
    return SYMBOLS[number % len(SYMBOLS)]


def scale(words: str) -> dict[str, Any]:
    """What the colours of a picture mean, beside it."""
    return {"title": {"text": words}, "thickness": 12, "outlinewidth": 0}


ABOVE: dict[str, Any] = {
    "legend": {"orientation": "h", "x": 0.0, "y": 1.0, "yanchor": "bottom", "font": {"size": 11}},
    "margin": {"l": 56, "r": 12, "t": 48, "b": 42},
}
"""Layout of a figure whose many curves are named above it."""


def axis(title: str = "", **more: Any) -> dict[str, Any]:
    """A further axis of a figure, named with its unit."""
    return {**_AXIS, "title": {"text": title, "standoff": 6}, **more}


def panels(
    rows: Sequence[tuple[str, Sequence[Mapping[str, Any]]]], x: str, *, each: int = 150, **more: Any
) -> dict[str, Any]:
    """Rows (title of the axis, curves) below each other, ``each`` of so many pixels."""
    gap, count = 0.05, len(rows)
    high = (1 - gap * (count - 1)) / count
    data: list[Mapping[str, Any]] = []
    layout: dict[str, Any] = {}
    for i, (title, curves) in enumerate(rows):
        number, top = "" if i == 0 else str(i + 1), 1 - i * (high + gap)
        layout[f"yaxis{number}"] = axis(title, domain=[max(0.0, top - high), top])
        data += [{**curve, "yaxis": f"y{number}"} for curve in curves]
    made = figure(data, x, height=each * count + 90, **layout, **ABOVE, **more)
    made["layout"]["xaxis"]["anchor"] = f"y{count}" if count > 1 else "y"
    return made


def line(x: Any, y: Any, name: str = "", colour: str = COLOURS[0], **more: Any) -> dict[str, Any]:
    """A curve."""
    return _trace("line", {"color": colour, "width": 1.8}, x, y, name, more)


def points(x: Any, y: Any, name: str = "", colour: str = COLOURS[0], **more: Any) -> dict[str, Any]:
    """Markers."""
    return _trace("marker", {"color": colour, "size": 7}, x, y, name, more)


def _trace(
    kind: str, style: Mapping[str, Any], x: Any, y: Any, name: str, more: dict[str, Any]
) -> dict[str, Any]:
    shown = {"type": "scatter", "mode": f"{kind}s", "x": numbers(x), "y": numbers(y), "name": name}
    return {**shown, "showlegend": bool(name), kind: {**style, **more.pop(kind, {})}, **more}


def band(x: Any, low: Any, high: Any, colour: str = COLOURS[0], **more: Any) -> dict[str, Any]:
    """What lies between two curves, pale."""
    one = np.asarray(x, float)
    low, high = np.asarray(low, float), np.asarray(high, float)
    return {
        "type": "scatter",
        "mode": "lines",
        "fill": "toself",
        "hoverinfo": "skip",
        "x": numbers(np.concatenate([one, one[::-1]])),
        "y": numbers(np.concatenate([low, high[::-1]])),
        "line": {"width": 0},
        "fillcolor": rgba(colour, 0.16),
        "showlegend": False,
        **more,
    }


def rgba(colour: str, alpha: float) -> str:
    """A colour "#rrggbb" that lets others through."""
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},{alpha:g})"


def numbers(values: Any) -> list[Any]:
    """As JSON knows them: None for what is no finite number; nested as the array is."""
    array = np.asarray(values, float)
    found: list[Any] = array.tolist()
    if np.isfinite(array).all():
        return found
    held = array.astype(object)
    held[~np.isfinite(array)] = None
    found = held.tolist()
    return found
