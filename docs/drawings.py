"""The drawings of docs/model.md: ``python docs/drawings.py`` makes them anew."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

INK, MUSCLE, LOAD = "#333333", "#0072b2", "#d55e00"
HERE = Path(__file__).resolve().parent


def wall(ax: Axes, x: float, y: float, *, length: float = 1.0, turn: float = 0.0) -> None:
    """What stands still: a line, hatched behind."""
    along = np.array([np.cos(turn), np.sin(turn)])
    behind = np.array([-along[1], along[0]]) * 0.15
    a, b = np.array([x, y]) - along * length / 2, np.array([x, y]) + along * length / 2
    ax.plot(*zip(a, b, strict=True), color=INK, lw=1.5)
    for s in np.linspace(0, 1, 7):
        foot = a + s * (b - a)
        ax.plot(*zip(foot, foot + behind - along * 0.1, strict=True), color=INK, lw=0.7)


def muscle(ax: Axes, a: tuple[float, float], b: tuple[float, float], name: str) -> None:
    """A bulging tube from a to b."""
    start, end = np.array(a), np.array(b)
    along = end - start
    across = np.array([-along[1], along[0]]) / np.hypot(*along)
    s = np.linspace(0, 1, 60)[:, None]
    half = (0.06 + 0.13 * np.sin(np.pi * s) ** 0.7) * across
    edge = np.vstack([start + s * along + half, (start + s * along - half)[::-1]])
    ax.fill(*edge.T, facecolor=MUSCLE, alpha=0.25, edgecolor=MUSCLE, lw=1.2)
    ax.text(*((start + end) / 2), name, ha="center", va="center", color=INK, fontsize=10)


def spring(ax: Axes, a: tuple[float, float], b: tuple[float, float], name: str) -> None:
    start, end = np.array(a), np.array(b)
    along = end - start
    across = np.array([-along[1], along[0]]) / np.hypot(*along)
    s = np.linspace(0, 1, 15)
    swing = 0.12 * np.array([0, 0, *([1, -1] * 5), 0, 0, 0])
    ax.plot(*(start[:, None] + np.outer(along, s) + np.outer(across, swing)), color=INK, lw=1.0)
    ax.text(*((start + end) / 2 + 0.32 * across), name, ha="center", va="center", fontsize=10)


def block(ax: Axes, x: float, y: float, name: str, size: float = 0.6) -> None:
    ax.add_patch(
        Rectangle((x - size / 2, y - size / 2), size, size, fc=LOAD, ec=INK, alpha=0.6, lw=1)
    )
    ax.text(x, y, name, ha="center", va="center", fontsize=11)


def arrow(ax: Axes, a: tuple[float, float], b: tuple[float, float], name: str) -> None:
    ax.plot(*zip(a, b, strict=True), alpha=0)  # so that the axes make room
    ax.annotate("", xy=b, xytext=a, arrowprops={"arrowstyle": "->", "color": INK, "lw": 1.2})
    ax.text(b[0] + 0.08, b[1] + 0.08, name, fontsize=11, style="italic")


def hanging(ax: Axes) -> None:
    wall(ax, 0, 2.6, turn=0)
    muscle(ax, (0, 2.6), (0, 1.0), "F(p, κ)")
    block(ax, 0, 0.7, "m")
    arrow(ax, (0.7, 0.5), (0.7, 1.2), "x")
    arrow(ax, (0, 0.4), (0, -0.2), "m g")


def spring_over(ax: Axes) -> None:
    wall(ax, -1.6, 1, turn=np.pi / 2)
    muscle(ax, (-1.6, 1.25), (0.6, 1.25), "F")
    spring(ax, (-1.6, 0.75), (0.6, 0.75), "")
    ax.text(-0.5, 0.4, "preload + k x", ha="center", fontsize=10)
    block(ax, 0.9, 1, "m", 0.8)
    arrow(ax, (1.0, 1.75), (0.2, 1.75), "x")


def slide(ax: Axes) -> None:
    wall(ax, -2.1, 1, turn=np.pi / 2)
    wall(ax, 2.1, 1, turn=-np.pi / 2)
    muscle(ax, (-2.1, 1), (-0.3, 1), "F2")
    muscle(ax, (0.3, 1), (2.1, 1), "F1")
    block(ax, 0, 1, "m")
    arrow(ax, (0, 1.6), (0.8, 1.6), "x")


def joint(ax: Axes) -> None:
    wall(ax, 0, 2.9, length=1.6)
    for side, name in ((0.5, "F1"), (-0.5, "F2")):
        muscle(ax, (side, 2.9), (side, 1.1), name)
        ax.plot([side, side], [1.1, 0.6], color=INK, lw=1)
    ax.add_patch(Circle((0, 0.6), 0.5, fill=False, ec=INK, lw=1.2))
    ax.plot([-0.5, 0], [0.6, 0.6], color=INK, lw=0.8)
    ax.text(-0.3, 0.65, "r", fontsize=10, style="italic")
    ax.plot([0, 0.55], [0.6, -0.7], color=LOAD, lw=3)
    ax.text(0.65, -0.75, "I, m, d", fontsize=10)
    ax.plot([0, 0], [0.6, -0.6], ":", color=INK, lw=1)
    turn = np.linspace(-np.pi / 2, -1.17, 20)
    ax.plot(0.95 * np.cos(turn), 0.6 + 0.95 * np.sin(turn), color=INK, lw=1)
    ax.text(0.1, -0.62, "θ", fontsize=11, style="italic")


def series(ax: Axes) -> None:
    wall(ax, 0, 2.8)
    muscle(ax, (0, 2.8), (0, 1.6), "F")
    ax.plot(0, 1.6, "s", color=INK, ms=7)
    ax.text(0.15, 1.55, "m_e", fontsize=10)
    spring(ax, (0, 1.6), (0, 0.5), "")
    ax.text(0.25, 1.0, "T: k_t, c_t", fontsize=10)
    block(ax, 0, 0.2, "m")
    arrow(ax, (-0.5, 1.4), (-0.5, 1.9), "y")
    arrow(ax, (-0.5, 0.0), (-0.5, 0.5), "x")


def main(path: Path) -> None:
    titles = {
        "HangingLoad": hanging,
        "SpringOverMuscle": spring_over,
        "AntagonisticSlide": slide,
        "AntagonisticJoint": joint,
        "SeriesLoad": series,
    }
    figure = Figure(figsize=(13.0, 3.4), layout="constrained")
    widths = [1.2, 1.8, 2.2, 1.3, 1.2]
    for (title, draw), ax in zip(
        titles.items(), figure.subplots(1, 5, width_ratios=widths), strict=True
    ):
        draw(ax)
        ax.set(aspect="equal", title=title)
        ax.axis("off")
        ax.margins(0.12)
    same = {"svg.hashsalt": "pam_ocp", "svg.fonttype": "none"}  # the same bytes every time
    with rc_context(same):
        figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)


if __name__ == "__main__":
    main(HERE / "arrangements.svg")
