"""Words and pictures of the tab Control."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ...plants.plant import Plant
from .. import look
from ..script import PUSH

__all__ = [
    "about",
    "bode_figure",
    "figure_said",
    "gain_units",
    "poles_figure",
    "run_figure",
    "step_figure",
]

Said = dict[str, Any]


def gain_units(kind: str, plant: Plant) -> dict[str, tuple[str, float]]:
    """{gain: (unit shown, shown value per SI value)} of a PID."""
    if kind != "pid":
        return {}
    v = plant.variable(next(iter(plant.positions)))
    u = next(u for u in plant.in_openings().inputs if not u.disturbance)
    unit = u.display_unit if u.display_unit != "1" else ""
    factor = v.display_factor / u.display_factor
    per = f"{unit or '1'}/{v.display_unit}"
    return {
        "proportional": (per, factor),
        "integral": (f"{per}/s", factor),
        "derivative": (f"{per} s", factor),
    }


def about(name: str, said: Said, units: Mapping[str, tuple[str, float]], usual: float) -> float:
    """Where the slider of a gain that is 0 begins."""
    if said["kind"] != "pid":
        return usual or 1.0
    shown = said["gains"]["proportional"] * units["proportional"][1]
    return float(f"{shown * {'derivative': 0.01, 'integral': 1.0}.get(name, 1.0) or 1.0:.2g}")


def figure_said(value: float | None, unit: str) -> str:
    return "unlimited" if value is None else f"{value:.3g} {unit}"


def poles_figure(found: Said) -> Said:
    data = []
    for key, words, symbol, colour in (
        ("open", "plant", "x-thin-open", look.FAINT),
        ("poles", "closed loop", "x", look.COLOURS[0]),
    ):
        if key in found:
            marker = {"symbol": symbol, "size": 9, "line": {"width": 2, "color": colour}}
            data.append(
                look.points(found[key]["re"], found[key]["im"], words, colour, marker=marker)
            )
    return look.figure(data, "real part [1/s]", "imaginary part [1/s]", height=300, **look.ABOVE)


def step_figure(found: Said, said: Said) -> Said:
    data = []
    if "step" in found:
        t = found["step"]["t"]
        data = [
            look.line(t, [1.0] * len(t), "wanted", look.FAINT, line={"dash": "dash"}),
            look.line(t, found["step"]["y"], "reached"),
        ]
    return look.figure(data, "time [s]", "position per step [1]", height=330, **look.ABOVE)


def bode_figure(found: Said) -> Said:
    log = {"type": "log"}
    if "hertz" not in found:
        return look.figure([], "frequency [Hz]", "gain [dB]")
    data = [look.line(found["hertz"], found["magnitude"], "gain", look.COLOURS[0])]
    if "phase" not in found:
        words = "largest gain of all inputs [dB]"
        return look.figure(data, "frequency [Hz]", words, height=300, xaxis=log)
    data.append(
        look.line(
            found["hertz"],
            found["phase"],
            "phase",
            look.COLOURS[1],
            yaxis="y2",
            line={"dash": "dash"},
        )
    )
    right = look.axis("phase [deg]", overlaying="y", side="right", showgrid=False)
    return look.figure(
        data, "frequency [Hz]", "gain [dB]", height=320, xaxis=log, yaxis2=right, **look.ABOVE
    )


def run_figure(found: Said) -> Said:
    position, t = found["position"], found["t"]
    first = [look.line(t, found["columns"][position], position, look.COLOURS[0])]
    if found["reference"] is not None:
        dashed = {"dash": "dash"}
        first.insert(0, look.line(t, found["reference"], "wanted", look.FAINT, line=dashed))
    # a push of nothing says nothing
    inputs = [n for n in found["inputs"] if n != PUSH or any(found["columns"][n])]
    rows: dict[str, list[Said]] = {found["units"][n]: [] for n in inputs}
    for i, name in enumerate(inputs):
        colour = look.COLOURS[(i + 1) % len(look.COLOURS)]
        rows[found["units"][name]].append(look.line(t, found["columns"][name], name, colour))
    titles = {unit: "openings" if unit == "1" else f"inputs [{unit}]" for unit in rows}
    return look.panels(
        [
            (f"{position} [{found['units'][position]}]", first),
            *((titles[unit], curves) for unit, curves in rows.items()),
        ],
        "time [s]",
        hovermode="x",
    )
