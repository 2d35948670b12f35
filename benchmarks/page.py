"""What run.py writes: plots of growth and other tools for docs/benchmarks.md, and figures.md."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import harness
import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

HERE = Path(__file__).resolve().parent
DOCS = HERE.parent / "docs"
BEGIN, END = "<!-- figures: begin -->", "<!-- figures: end -->"
CURVES: dict[str, tuple[str, str, dict[str, str]]] = {
    "intervals": (
        "plan",
        "intervals",
        {"plan [s]": "pam_ocp", "plan, plain CasADi [s]": "plain CasADi"},
    ),
    "iterations": (
        "iterations of IPOPT",
        "intervals",
        {"iterations": "pam_ocp", "iterations, plain CasADi": "plain CasADi"},
    ),
    "horizon": (
        "Mpc, a step, converged",
        "horizon",
        {"Mpc, converged [ms]": "interpreted", "Mpc compiled, converged [ms]": "compiled"},
    ),
    "cells": (
        "fit",
        "cells",
        {"fit_force with intervals [s]": "fit_force", "SciPy LM [s]": "SciPy LM"},
    ),
    "states": (
        "simulation",
        "states",
        {"simulate [s]": "interpreted", "simulate, compiled [s]": "compiled"},
    ),
    "plans": ("plan, masses in a row", "states", {"plan, masses in a row [s]": "plan"}),
    "cases": (
        "simulate_many",
        "cases",
        {
            "simulate_many, a case [ms]": "a case, processor",
            "simulate_many, two processes, a case, wall [ms]": "a case, wall",
        },
    ),
}
"""Name of a plot: title, what grows, curves (figures NAME@SIZE) and what they are called in it."""
COLUMNS = 3
LIGHT = {"ink": "#222222", "grid": "#dddddd", "first": "#0072b2", "second": "#d55e00"}
DARK = {"ink": "#d0d0d0", "grid": "#444444", "first": "#56b4e9", "second": "#e69f00"}


def curve(figures: dict[str, Any], name: str) -> tuple[list[int], list[float]]:
    """Sizes and medians of a figure that was measured over sizes."""
    found = {
        int(n.rpartition("@")[2]): f["median"]
        for n, f in figures.items()
        if n.rpartition("@")[0] == name
    }
    return sorted(found), [found[size] for size in sorted(found)]


def exponent(sizes: list[int], values: list[float]) -> float | None:
    """p of values ~ sizes^p, least squares over the largest three; None without two of them."""
    kept = [(s, v) for s, v in zip(sizes, values, strict=True) if s > 0 and v > 0][-3:]
    if len(kept) < 2:
        return None
    return float(np.polyfit(*np.log(np.array(kept, float)).T, 1)[0])


def shown(figures: dict[str, Any]) -> dict[str, tuple[str, str, dict[str, str]]]:
    """The plots that have a curve of two sizes or more."""
    found = {}
    for key, (title, over, names) in CURVES.items():
        if drawn := {n: label for n, label in names.items() if len(curve(figures, n)[0]) > 1}:
            found[key] = title, over, drawn
    return found


def plot(figures: dict[str, Any], look: dict[str, str]) -> Figure:
    """All curves, in logarithmic scales; transparent, for a light or a dark page."""
    plots = shown(figures)
    rows = max(1, -(-len(plots) // COLUMNS))
    picture = Figure(figsize=(9.6, 2.9 * rows), layout="constrained")
    picture.patch.set_alpha(0)
    axes = picture.subplots(rows, COLUMNS, squeeze=False).ravel()
    for ax in axes[len(plots) :]:
        ax.set_visible(False)
    for ax, (title, over, names) in zip(axes, plots.values(), strict=False):
        each = zip(names.items(), ("first", "second"), "os", strict=False)
        for (name, label), colour, mark in each:
            sizes, values = curve(figures, name)
            power = exponent(sizes, values)
            label += "" if power is None else f", $n^{{{power:.2f}}}$"
            ax.loglog(sizes, values, color=look[colour], marker=mark, markersize=4, label=label)
        decorate(ax, title, over, next(iter(names)), look)
        sizes = sorted({size for name in names for size in curve(figures, name)[0]})
        ticks(ax, sizes)
    return picture


def decorate(ax: Axes, title: str, over: str, first: str, look: dict[str, str]) -> None:
    """Titles, a legend and the colours of the page."""
    ax.patch.set_alpha(0)
    unit = re.findall(r"\[(.+?)\]", first)
    ax.set_title(title, color=look["ink"], fontsize=10)
    ax.set_xlabel(over, color=look["ink"])
    ax.set_ylabel(unit[0] if unit else "iterations", color=look["ink"])
    ax.grid(True, which="major", color=look["grid"], linewidth=0.6)
    ax.margins(y=0.3)
    for side in ax.spines.values():
        side.set_color(look["grid"])
    ax.legend(frameon=False, fontsize=8, labelcolor=look["ink"])
    ax.tick_params(which="both", colors=look["ink"])


def ticks(ax: Axes, sizes: list[int]) -> None:
    """Marks at the sizes that were measured, and at 1, 2 and 5 of each decade upwards."""
    ax.set_xticks(sizes, [f"{size:g}" for size in sizes])
    low, high = ax.get_ylim()
    few = high / low > 100
    ax.yaxis.set_major_locator(LogLocator(subs=(1,) if few else (1, 2, 5)))
    ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_minor_formatter(NullFormatter())
    ax.tick_params(which="minor", length=0)


def table(result: dict[str, Any]) -> str:
    """What is wanted beside what was measured; of curves only the points that have a goal."""
    from run import WANTED, goal, reached

    lines: list[tuple[str, ...]] = []
    for name, figure in result["figures"].items():
        if "@" in name and name not in WANTED:
            continue
        low, high = min(figure["values"]), max(figure["values"])
        missed = " (not reached)" if reached(name, figure["median"]) is False else ""
        title, range_ = re.sub(r"@(\d+)$", r", \1", name), f"{low:.3g} .. {high:.3g}"
        lines.append((title, f"{figure['median']:.3g}", range_, goal(name) + missed))
    lines += [(name, f"not measured: {why}", "", "") for name, why in result["missing"].items()]
    return harness.table(("figure", "median", "least .. most", "wanted"), lines)


def growth(result: dict[str, Any]) -> str:
    """All curves as numbers, and their slopes."""
    lines = []
    for _, over, names in shown(result["figures"]).values():
        for name in names:
            sizes, values = curve(result["figures"], name)
            power = exponent(sizes, values)
            points = ", ".join(f"{s}: {v:.3g}" for s, v in zip(sizes, values, strict=True))
            lines.append((f"{name} over {over}", points, f"{power:.2f}" if power else ""))
    heads = ("growth", "size: median", "slope over the largest three")
    return harness.table(heads, lines) if lines else ""


def peers(result: dict[str, Any]) -> str:
    """A table a task: the tools' figures, or why one has none."""
    text = []
    for task, tools in result.get("peers", {}).items():
        if isinstance(tools, str):
            text.append(f"Peers, {task}: {tools}")
            continue
        found = {tool: said for tool, said in tools.items() if tool != "base"}
        heads = list(
            dict.fromkeys(h for said in found.values() if isinstance(said, dict) for h in said)
        )
        lines: list[list[str]] = []
        for tool, said in found.items():
            if isinstance(said, str):
                lines.append([tool, said, *[""] * (len(heads) - 1)])
            else:
                lines.append([tool, *(f"{said[h]:.5g}" if h in said else "" for h in heads)])
        text.append(harness.table((task, *heads), lines))
        if "base" in tools:
            seconds = ", ".join(f"{k} {v:g} s" for k, v in tools["base"].items())
            text.append(f"1 is {seconds} of the first line's tool.")
    return "\n\n".join(text)


PICTURES = """```{image} growth-light.svg
:class: only-light
:alt: Growth of times with intervals, horizon, cells, states and cases
```
```{image} growth-dark.svg
:class: only-dark
:alt: Growth of times with intervals, horizon, cells, states and cases
```

"""


def origin(result: dict[str, Any]) -> str:
    """Where the figures come from: when, what, on which machine, under which load."""
    machine = result["machine"]
    size = "in small" if result["quick"] else "in full"
    load = "" if result["load"] is None else f" load {result['load']:.1f} at the start,"
    times = f"{result['repeats']} repetitions, medians"
    return f"""`python benchmarks/run.py --page`, {size}, {times}; processor
seconds where nothing else is said. {result["time"][:10]}, commit {result["commit"]},{load}
{machine["processors"]} x {machine["processor"]}"""


def section(result: dict[str, Any]) -> str:
    """The text between the marks."""
    pictures = PICTURES if shown(result["figures"]) else ""
    return f"""{BEGIN}
{origin(result)}.

{pictures}{peers(result)}
{END}"""


def goals(result: dict[str, Any]) -> str:
    """figures.md: curves, every figure with its goal, the versions of all that was measured."""
    versions = ", ".join(f"{k} {v}" for k, v in result["versions"].items())
    parts = (f"# Figures and goals\n\n{origin(result)}, {versions}.", growth(result), table(result))
    return "\n\n".join(part for part in parts if part) + "\n"


def write_page(
    result: dict[str, Any], docs: Path = DOCS, figures: Path = HERE / "figures.md"
) -> list[Path]:
    """Put plots and tools into the page; all figures with their goals into a file of their own."""
    page = docs / "benchmarks.md"
    text = page.read_text("utf-8")
    before, _, rest = text.partition(BEGIN)
    _, found, after = rest.partition(END)
    if not found:
        raise SystemExit(f"{page} has no marks {BEGIN} ... {END}")
    written = [page, figures]
    looks = (("light", LIGHT), ("dark", DARK)) if shown(result["figures"]) else ()
    for name, look in looks:
        written.append(docs / f"growth-{name}.svg")
        drawn = io.StringIO()
        with rc_context({"svg.hashsalt": "growth"}):  # the same figures, the same file
            plot(result["figures"], look).savefig(drawn, format="svg", metadata={"Date": None})
        lines = (line.rstrip() for line in drawn.getvalue().splitlines())
        harness.write(written[-1], "\n".join(lines) + "\n")
    harness.write(figures, goals(result))
    harness.write(page, before + section(result) + after)
    return written
