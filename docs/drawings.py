"""The drawings of docs/model.md and docs/air.md: ``python docs/drawings.py`` makes them anew."""

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


def vessel(ax: Axes, x: float, y: float, w: float, h: float, name: str, says: str) -> None:
    """A place that holds air: what it is, and its variables below."""
    ax.add_patch(Rectangle((x - w / 2, y - h / 2), w, h, fc="#dddddd", ec=INK, lw=1.2))
    ax.text(x, y + h / 2 + 0.12, name, ha="center", va="bottom", fontsize=10)
    ax.text(x, y, says, ha="center", va="center", fontsize=9, style="italic")


def pipe(ax: Axes, a: float, b: float, y: float, says: str = "", way: str = "->") -> None:
    """A flow between two places, and what it is called."""
    style = {"arrowstyle": way, "color": MUSCLE, "lw": 1.6}
    ax.annotate("", xy=(b, y), xytext=(a, y), arrowprops=style)
    ax.text((a + b) / 2, y + 0.08, says, ha="center", va="bottom", fontsize=9)


def upright(ax: Axes, x: float, a: float, b: float, says: str, color: str) -> None:
    """A flow up or down."""
    style = {"arrowstyle": "->", "color": color, "lw": 1.4}
    ax.annotate("", xy=(x, b), xytext=(x, a), arrowprops=style)
    ax.text(x + 0.08, (a + b) / 2, says, va="center", fontsize=9)


def air(ax: Axes) -> None:
    """The way of the air from the source to the surroundings."""
    pipe(ax, -0.9, 0.4, 1.0, "source")
    vessel(ax, 1.1, 1.0, 1.4, 0.8, "", "p, T, V")
    ax.text(0.4, 1.52, "receiver", ha="left", va="bottom", fontsize=10)
    upright(ax, 1.65, 1.4, 2.7, "to the next muscle", MUSCLE)
    pipe(ax, 1.8, 3.0, 1.0, "supply flow")
    ax.add_patch(Rectangle((3.0, 0.6), 1.2, 0.8, fc="white", ec=INK, lw=1.2))
    ax.plot([3.6, 3.6], [0.6, 1.4], color=INK, lw=1)
    ax.text(3.6, 1.52, "valve: spool s, C, b", ha="center", va="bottom", fontsize=10)
    upright(ax, 3.6, 0.6, -0.1, "to ambient", MUSCLE)
    for i in range(3):
        vessel(ax, 5.1 + 0.55 * i, 1.0, 0.5, 0.4, "", ("p$_1$", "...", "p$_n$")[i])
    pipe(ax, 4.2, 4.85, 1.0, way="<->")
    ax.text(5.65, 1.52, "tube: friction, inertance", ha="center", va="bottom", fontsize=10)
    upright(ax, 7.0, 0.95, -0.1, "quick exhaust, leak", MUSCLE)
    pipe(ax, 6.45, 7.6, 1.0, "flow m", way="<->")
    muscle(ax, (7.6, 1.0), (11.0, 1.0), "p, T, V(κ)")
    ax.text(9.3, 1.52, "muscle", ha="center", va="bottom", fontsize=10)
    upright(ax, 9.0, 0.25, 0.75, "Q = h A (T$_w$ - T)", LOAD)
    ax.text(9.0, 0.13, "rubber T$_w$", ha="center", va="top", fontsize=9)
    upright(ax, 9.0, -0.1, -0.5, "G (T$_w$ - T$_o$)", LOAD)
    pipe(ax, 11.05, 12.0, 1.0, "F, p dV/dt")
    ax.set(xlim=(-1, 12.3), ylim=(-0.7, 2.6))


def save(figure: Figure, path: Path) -> None:
    """The same bytes every time."""
    with rc_context({"svg.hashsalt": "pam_ocp", "svg.fonttype": "none"}):
        figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)


def path_of_air(path: Path) -> None:
    figure = Figure(figsize=(11.0, 2.8), layout="constrained")
    ax = figure.subplots()
    air(ax)
    ax.set_aspect("equal")
    ax.axis("off")
    save(figure, path)


def arrangements(path: Path) -> None:
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
    save(figure, path)


if __name__ == "__main__":
    arrangements(HERE / "arrangements.svg")
    path_of_air(HERE / "air.svg")
