"""The part of docs/benchmarks.md that run.py writes: a table, and plots of growth."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

DOCS = Path(__file__).resolve().parent.parent / "docs"
BEGIN, END = "<!-- figures: begin -->", "<!-- figures: end -->"
CURVES = {
    "intervals": ("plan", "intervals", ("plan [s]", "plan, plain CasADi [s]")),
    "iterations": ("IPOPT", "intervals", ("iterations", "iterations, plain CasADi")),
    "horizon": ("Mpc", "horizon", ("Mpc, converged [ms]", "Mpc compiled, converged [ms]")),
    "cells": ("fit", "cells", ("fit_force with intervals [s]", "SciPy LM [s]")),
    "states": ("simulation", "states", ("simulate [s]",)),
    "cases": ("many", "cases", ("simulate_many, two processes, a case, wall [ms]",)),
}
"""Name of a plot: title, what grows, curves (figures NAME@SIZE)."""
COLOURS = ("#0072b2", "#d55e00")
DARK = {"ink": "#d0d0d0", "grid": "#444444"}
LIGHT = {"ink": "#222222", "grid": "#dddddd"}


def curve(figures: dict[str, Any], name: str) -> tuple[list[int], list[float]]:
    """Sizes and medians of a figure that was measured over sizes."""
    found = {
        int(n.rpartition("@")[2]): f["median"]
        for n, f in figures.items()
        if n.rpartition("@")[0] == name
    }
    return sorted(found), [found[size] for size in sorted(found)]


def plot(figures: dict[str, Any], look: dict[str, str]) -> Figure:
    """All curves, in logarithmic scales; transparent, for a light or a dark page."""
    shown = {k: v for k, v in CURVES.items() if any(len(curve(figures, n)[0]) > 1 for n in v[2])}
    picture = Figure(figsize=(9.0, 2.7 * -(-len(shown) // 3)), layout="constrained")
    picture.patch.set_alpha(0)
    axes = picture.subplots(-(-len(shown) // 3), 3, squeeze=False).ravel()
    for ax in axes[len(shown) :]:
        ax.set_visible(False)
    for ax, (title, over, names) in zip(axes, shown.values(), strict=False):
        ax.patch.set_alpha(0)
        for name, colour, mark in zip(names, COLOURS, "os", strict=False):
            sizes, values = curve(figures, name)
            label = re.sub(r" \[.*|.*, (?=plain)", "", name)
            ax.loglog(sizes, values, color=colour, marker=mark, markersize=4, label=label)
        ax.set_xticks(sizes, [f"{size:g}" for size in sizes])
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_minor_formatter(NullFormatter())
        ax.tick_params(which="minor", length=0)
        unit = re.findall(r"\[(.+?)\]", names[0])
        ax.set_title(title, color=look["ink"], fontsize=10)
        ax.set_xlabel(over, color=look["ink"])
        ax.set_ylabel(unit[0] if unit else "", color=look["ink"])
        ax.grid(True, which="major", color=look["grid"], linewidth=0.6)
        ax.tick_params(which="both", colors=look["ink"])
        for side in ax.spines.values():
            side.set_color(look["grid"])
        if len(names) > 1:
            ax.legend(frameon=False, fontsize=8, labelcolor=look["ink"])
    return picture


def table(result: dict[str, Any]) -> str:
    """What is wanted beside what was measured; single figures, no curves."""
    from run import WANTED, reached

    lines = ["| figure | median | least .. most | wanted |", "|---|---|---|---|"]
    for name, figure in result["figures"].items():
        if "@" in name and name not in WANTED:
            continue
        low, high = min(figure["values"]), max(figure["values"])
        said = reached(name, figure["median"])
        goal = "" if said is None else "{} {:g}".format(*WANTED[name])
        goal += "" if said is None or said else " (not reached)"
        title = re.sub(r"@(\d+)$", r", \1", name)
        lines.append(f"| {title} | {figure['median']:.3g} | {low:.3g} .. {high:.3g} | {goal} |")
    for tool, said in result.get("peers", {}).items():
        words = said if isinstance(said, str) else ", ".join(f"{k} {v}" for k, v in said.items())
        lines.append(f"| {tool} | {words} | | |")
    lines += [f"| {name} | not measured: {why} | | |" for name, why in result["missing"].items()]
    return "\n".join(lines)


def section(result: dict[str, Any]) -> str:
    """The text between the marks."""
    versions = ", ".join(f"{k} {v}" for k, v in result["versions"].items())
    machine = result["machine"]
    size = "in small" if result["quick"] else "in full"
    load = f"load {result['load']:.1f} at the start"
    return f"""{BEGIN}
`python benchmarks/run.py --page`, {size}, {result["repeats"]} repetitions, medians; processor
seconds where nothing else is said. {result["time"][:10]}, commit {result["commit"]}, {load},
{machine["processors"]} x {machine["processor"]}, {versions}.
*plain*: CasADi as a careful user writes it (`benchmarks/plain.py`).

```{{image}} growth-light.svg
:class: only-light
:alt: Growth of times with intervals, horizon, cells, states and cases
```
```{{image}} growth-dark.svg
:class: only-dark
:alt: Growth of times with intervals, horizon, cells, states and cases
```

{table(result)}
{END}"""


def write_page(result: dict[str, Any], docs: Path = DOCS) -> list[Path]:
    """Put table and plots into the page."""
    page = docs / "benchmarks.md"
    text = page.read_text("utf-8")
    before, _, rest = text.partition(BEGIN)
    _, found, after = rest.partition(END)
    if not found:
        raise SystemExit(f"{page} has no marks {BEGIN} ... {END}")
    written = [page]
    for name, look in (("light", LIGHT), ("dark", DARK)):
        written.append(docs / f"growth-{name}.svg")
        plot(result["figures"], look).savefig(written[-1], metadata={"Date": None})
    page.write_text(before + section(result) + after, "utf-8")
    return written
