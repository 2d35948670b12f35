"""Words and pictures of the tab Motion, and its lines of the script."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ...plants.plant import Plant
from .. import look
from ..jobs import motion as jobs
from ..script import call, figure_lines, literal

__all__ = ["also", "conflict", "curves", "motion_lines", "with_unit"]


def curves(told: Mapping[str, Any]) -> dict[str, Any]:
    """All panels below each other, their units at the axes."""
    scale = 1e3 if told["duration"] < 2 else 1.0
    t = [scale * v for v in told["t"]]
    panels, data = told["panels"], []
    layout: dict[str, Any] = {}
    gap = 0.05
    each = (1 - gap * (len(panels) - 1)) / len(panels)
    for i, panel in enumerate(panels):
        axis = "" if i == 0 else str(i + 1)
        top = 1 - i * (each + gap)
        layout[f"yaxis{axis}"] = {
            **look.axis(look.quantity(panel["unit"])),
            "domain": [max(0.0, top - each), top],
        }
        for k, name in enumerate(panel["names"]):
            colour, dash = style(name, k)
            data.append(
                look.line(
                    t,
                    told["columns"][name],
                    name,
                    colour,
                    yaxis=f"y{axis}",
                    line={"dash": dash},
                    hovertemplate=f"{name}: %{{y:.4g}} {panel['unit']}<extra></extra>",
                )
            )
    unit = "ms" if scale > 1 else "s"
    figure = look.figure(
        data,
        f"time [{unit}]",
        height=130 * len(panels) + 90,
        hovermode="x",
        **layout,
        **look.ABOVE,
    )
    figure["layout"]["xaxis"]["anchor"] = f"y{len(panels)}" if len(panels) > 1 else "y"
    return figure


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


# ---- the script ----------------------------------------------------------------------------------
def motion_lines(state: Mapping[str, Any]) -> list[str]:
    """Each motion as a call of pam.plan, with its figures."""
    lines: list[str] = []
    if state["muscle"] is None:
        return lines
    for motion in state["motions"]:
        said = jobs.arguments(motion)
        stops = ", ".join(
            literal(s) if isinstance(s, dict) else _stop_code(s) for s in said["stops"]
        )
        method = jobs.METHODS[motion["method"]][1]
        shown = {k: v for k, v in said.items() if k != "stops"}
        code = call("pam.plan", "plant", f"[{stops}]", **shown, time_limit=jobs.TIME_LIMIT)
        if method is not None:
            code = f"{code[:-1]}, method=pam.{method!r})"
        id = motion["id"]
        lines += [f"{id} = {code}", f"print({id})"]
        lines += figure_lines(
            id,
            {
                "duration": f"{id}.duration",
                "objective": f"{id}.objective",
                "replay_error": f"{id}.replay_error",
            },
        )
        lines += [
            "for v in (*plant.states, *plant.inputs):",
            f'    figures[f"{id}.max({{v.name}})"] = float({id}.trajectory[v.name].max())',
        ]
    return lines


def _stop_code(stop: Any) -> str:
    said = call("pam.Stop", literal(dict(stop.values)), rest=stop.rest)
    return f"{said[:-1]}, dwell={stop.dwell!r})" if stop.dwell else said
