"""Words and pictures of the tab Motion."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ...plants.plant import Plant
from .. import look

__all__ = ["also", "conflict", "curves", "with_unit"]


def curves(told: Mapping[str, Any]) -> dict[str, Any]:
    """All panels below each other, their units at the axes."""
    scale, unit = (1e3, "ms") if told["duration"] < 2 else (1.0, "s")
    t, rows = [scale * v for v in told["t"]], []
    for panel in told["panels"]:
        hover = f": %{{y:.4g}} {panel['unit']}<extra></extra>"
        drawn = []
        for k, name in enumerate(panel["names"]):
            colour, dash = style(name, k)
            more = {"line": {"dash": dash}, "hovertemplate": name + hover}
            drawn.append(look.line(t, told["columns"][name], name, colour, **more))
        rows.append((look.quantity(panel["unit"]), drawn))
    return look.panels(rows, f"time [{unit}]", each=130, hovermode="x")


# ---- words ---------------------------------------------------------------------------------------
def also(plant: Plant, variable: str) -> list[str]:
    """What stops may name beside the position: stiffness, pressures."""
    names = [v.name for v in (*plant.states, *plant.outputs)]
    chosen = ("stiffness", ".pressure")
    return [n for n in names if n != variable and n.endswith(chosen)]


def conflict(told: Mapping[str, Any]) -> tuple[str, int | None]:
    """(words, number of the stop in whose place they are said)."""
    for one in told["conflicts"]:
        if one["stop"] is not None:
            return one["words"], one["stop"]
    return (told["conflicts"][0]["words"], None) if told["conflicts"] else ("", None)


def style(name: str, k: int) -> tuple[str, str]:
    """Colour by muscle; commands and what else shares a muscle's colour are dashed."""
    owner = name.partition(".")[0]
    if owner.startswith("muscle"):
        number = owner.removeprefix("muscle")
        colour = look.COLOURS[(int(number) - 1 if number.isdigit() else 0) % len(look.COLOURS)]
        return colour, "dot" if name.endswith(".command") else "solid"
    return look.COLOURS[(k + 2) % len(look.COLOURS)], "solid"


def with_unit(plant: Plant, name: str, value: float) -> str:
    if name == "duration":
        return f"{1e3 * value:.5g} ms"
    if name.startswith("max("):
        return plant.variable(name[4:-1]).shown(value)
    return f"{value:.4g}"
