"""Plans as moving pictures: the plant drawn by its positions,
muscles coloured by their pressure.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, require_count, require_instance, require_positive
from ..core.files import atomic_path
from ..planning.result import Plan
from ..plants.elastic import SeriesLoad
from ..plants.joint import AntagonisticJoint
from ..plants.slide import AntagonisticSlide
from .plan import GREY, colours_of, panels_of
from .trajectory import _figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..core.trajectory import Trajectory
    from ..plants.plant import Plant

__all__ = ["animate_plan"]

Array: TypeAlias = NDArray[np.float64]
Frame: TypeAlias = Callable[[int], None]

THICKNESS = 0.09
"""Radius of a stretched muscle in the picture, in parts of its length."""
CURVES = 3
"""Panels of curves beside the picture of the plant."""


def animate_plan(
    plan: Plan, path: str | Path, *, seconds: float | None = None, fps: int = 20
) -> Path:
    """Write a plan as an animated GIF: the plant moving, and the curves as they run.

    Slide, joint and plants with one muscle are drawn to scale (muscles as long as they are,
    coloured by pressure); any other plant by its curves alone.

    seconds : length of the film; by default the motion slowed down (or quickened) to 4 s. It
        repeats.
    fps : frames per second.

    Raises InputError when the ending is not .gif, PlanError for a plan that failed.
    """
    require_instance("plan", plan, Plan, "give what plan() returned")
    target = Path(path)
    if target.suffix.lower() != ".gif":
        raise InputError(f"{target.name}: an animation is written as .gif")
    length = require_positive("seconds", 4.0 if seconds is None else seconds, "s")
    require_count("fps", fps, 1, 50)
    from matplotlib.animation import FuncAnimation, PillowWriter

    _ = plan.trajectory  # a failed plan raises here
    assert plan.replay is not None  # of a plan that succeeded
    count = max(2, round(length * fps))
    motion = plan.replay.trajectory.at(np.linspace(0.0, plan.duration, count))
    figure, drawn = _film(plan, motion, length)

    def frame(i: int) -> list[Any]:
        for draw in drawn:
            draw(i)
        return []

    film = FuncAnimation(figure, frame, frames=count, blit=False)
    with atomic_path(target) as temporary:
        film.save(temporary, writer=PillowWriter(fps=fps), dpi=80)
    return target


def _film(plan: Plan, motion: Trajectory, length: float) -> tuple[Figure, list[Frame]]:
    """The figure, and what draws its parts at a frame."""
    scene = _scene(plan, motion)
    panels = list(panels_of(plan).items())[: CURVES if scene else 6]
    rows = len(panels)
    figure, axes = _figure(rows, 2 if scene else 1, size=(9.6 if scene else 7.0, 1.4 + 1.25 * rows))
    drawn: list[Frame] = []
    if scene:
        grid = axes[0, 0].get_gridspec()
        grid.set_width_ratios([1.15, 1.0])
        for ax in axes[:, 0]:
            ax.remove()
        stage = figure.add_subplot(grid[:, 0])
        drawn.append(scene(stage))
    for ax, (unit, names) in zip(axes[:, -1], panels, strict=True):
        drawn.append(_curves(ax, motion, unit, names))
    axes[-1, -1].set_xlabel("time [s]")
    for ax in axes[:-1, -1]:
        ax.tick_params(labelbottom=False)
    slower = length / plan.duration
    speed = f"{slower:.3g} times slower" if slower >= 1 else f"{1 / slower:.3g} times quicker"
    speed = "in real time" if abs(slower - 1) < 0.01 else speed
    figure.suptitle(
        f"{plan.plant.name}: {1e3 * plan.duration:.4g} ms, shown {speed}", fontsize="medium"
    )
    figure.draw_without_rendering()  # settles the layout once, so that nothing trembles
    figure.set_layout_engine("none")
    return figure, drawn


def _curves(ax: Axes, motion: Trajectory, unit: str, names: Sequence[str]) -> Frame:
    """Whole curves pale, the past dark, a dot at the present."""
    lines = []
    for name, colour in colours_of(names).items():
        variable = motion.variable(name)
        values = motion[name] / variable.display_factor
        style: dict[str, Any] = {"color": colour, "lw": 1.7}
        if variable.causality == "input":
            held = motion.interpolation == "previous"
            style |= {"lw": 0.9, "drawstyle": "steps-post" if held else "default"}
        ax.plot(motion.t, values, **style, alpha=0.25)
        (past,) = ax.plot([], [], **style, label=name)
        (now,) = ax.plot([], [], "o", color=colour, ms=4)
        lines.append((values, past, now))
    ax.set_ylabel(unit if unit != "1" else "")
    ax.set_xlim(motion.t[0], motion.t[-1])
    if len(names) <= 4:
        ax.legend(fontsize="x-small", loc="upper right", framealpha=0.75, edgecolor="none")

    def draw(i: int) -> None:
        for values, past, now in lines:
            past.set_data(motion.t[: i + 1], values[: i + 1])
            now.set_data(motion.t[i : i + 1], values[i : i + 1])

    return draw


# ---- plants --------------------------------------------------------------------------------------
def _scene(plan: Plan, motion: Trajectory) -> Callable[[Axes], Frame] | None:
    """Who draws the plant; None for one that is not known."""
    plant = plan.plant
    if isinstance(plant, AntagonisticSlide):
        return lambda ax: _slide(ax, plan, motion)
    if isinstance(plant, AntagonisticJoint):
        return lambda ax: _joint(ax, plan, motion)
    names = {v.name for v in plant.variables}
    if {"x", "muscle.contraction", "muscle.rest_length"} <= names:
        return lambda ax: _hanging(ax, plan, motion)
    return None


def _value(plant: Plant, name: str) -> float:
    return float(plant.variable(name).start or 0.0)


class _Muscle:
    """A spindle between two points, thicker the more it contracts, coloured by its pressure."""

    def __init__(self, ax: Axes, plan: Plan, motion: Trajectory, name: str, largest: float) -> None:
        from matplotlib import colormaps

        self.length = _value(plan.plant, f"{name}.rest_length")
        self.kappa = motion[f"{name}.contraction"]
        self.pressure = motion[f"{name}.pressure"] / largest
        self.colours = colormaps["YlOrRd"]
        (self.patch,) = ax.fill([], [], ec="#333333", lw=1.0, zorder=3)

    def draw(self, i: int, a: Sequence[float], b: Sequence[float]) -> None:
        """Between the points a and b [m]."""
        start, end = np.asarray(a, float), np.asarray(b, float)
        along = end - start
        across = np.array([-along[1], along[0]]) / np.hypot(*along)
        s = np.linspace(0.0, 1.0, 40)
        # a braid's volume hardly shrinks: what it loses in length it gains in girth
        bulge = THICKNESS * self.length / np.sqrt(max(1.0 - 2.0 * self.kappa[i], 0.2))
        half = bulge * (0.35 + 0.65 * np.sin(np.pi * s) ** 0.6)
        outline = start + np.outer(s, along)
        upper, lower = (outline + sign * np.outer(half, across) for sign in (1, -1))
        self.patch.set_xy(np.vstack([upper, lower[::-1]]))
        self.patch.set_facecolor(self.colours(0.05 + 0.9 * float(np.clip(self.pressure[i], 0, 1))))


def _stage(ax: Axes, plan: Plan, motion: Trajectory, names: Sequence[str]) -> list[_Muscle]:
    """An empty stage with a colour bar, and its muscles."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    largest = max(float(motion[f"{n}.pressure"].max()) for n in names)
    largest = max(largest, 1e4)
    ax.set_aspect("equal")
    ax.axis("off")
    ax.figure.colorbar(
        ScalarMappable(Normalize(0.0, largest / 1e5), "YlOrRd"),
        ax=ax,
        location="bottom",
        label="pressure [bar gauge]",
        fraction=0.05,
        pad=0.02,
        aspect=30,
    )
    return [_Muscle(ax, plan, motion, n, largest) for n in names]


def _wall(ax: Axes, x: tuple[float, float], y: tuple[float, float]) -> None:
    ax.fill(
        [x[0], x[1], x[1], x[0]],
        [y[0], y[0], y[1], y[1]],
        fc="#c9ced3",
        ec="#6b7278",
        hatch="///",
        lw=0.8,
    )


def _stop_values(plan: Plan, name: str) -> list[float]:
    """Where the plan's stops are."""
    stops = plan._problem.stops if plan._problem else ()
    return sorted({float(s[name]) for s in stops if name in s and np.ndim(s[name]) == 0})


def _slide(ax: Axes, plan: Plan, motion: Trajectory) -> Frame:
    """Muscle 2, the slide, muscle 1 in a row between two walls."""
    plant = plan.plant
    k0 = _value(plant, "pre_contraction")
    muscles = _stage(ax, plan, motion, ("muscle1", "muscle2"))
    one, two = (m.length * (1 - k0) for m in muscles)
    half = 0.12 * muscles[0].length
    right, left = half + one, -half - two
    wall = 0.08 * muscles[0].length
    _wall(ax, (right, right + wall), (-2 * half, 1.6 * half))
    _wall(ax, (left - wall, left), (-2 * half, 1.6 * half))
    ax.plot([left, right], [-1.15 * half] * 2, color="#6b7278", lw=3, zorder=1)
    middle = (left + right) / 2
    for value in _stop_values(plan, "x"):
        ax.plot([value] * 2, [-2.2 * half, -1.35 * half], color=GREY, lw=1.5)
        side = "right" if value < middle else "left"
        ax.annotate(
            f"{1e3 * value:g} mm",
            (value, -2.3 * half),
            ha=side,
            va="top",
            fontsize="small",
            color="#555555",
        )
    body = ax.fill([], [], fc="#5b6770", ec="#333333", zorder=4)[0]
    (needle,) = ax.plot([], [], color="#333333", lw=1.5, zorder=5)
    ax.set_xlim(left - 1.5 * wall, right + 1.5 * wall)
    ax.set_ylim(-3.6 * half, 2.4 * half)

    def draw(i: int) -> None:
        x = float(motion["x"][i])
        body.set_xy([(x - half, -half), (x + half, -half), (x + half, half), (x - half, half)])
        needle.set_data([x, x], [-1.35 * half, -half])
        muscles[0].draw(i, (x + half, 0.0), (right, 0.0))
        muscles[1].draw(i, (left, 0.0), (x - half, 0.0))

    return draw


def _joint(ax: Axes, plan: Plan, motion: Trajectory) -> Frame:
    """Flexor and extensor below a pulley with a link, as long as their contractions make them."""
    plant = plan.plant
    names = ("muscle1", "muscle2")
    muscles = _stage(ax, plan, motion, names)
    arms = [
        float(np.mean(motion[f"{n}.radius"]))
        if f"{n}.radius" in motion
        else _value(plant, f"{n}.radius")
        for n in names
    ]
    k0 = _value(plant, "pre_contraction")
    base = -max(m.length * (1 - k0) for m in muscles) - 1.5 * max(arms)
    link = max(_value(plant, "link_length"), 3.0 * max(arms))
    gap = max(max(arms), 1.3 * THICKNESS * muscles[0].length)
    _wall(ax, (-2.6 * gap, 2.6 * gap), (base - 0.5 * gap, base))
    angle = np.linspace(0.0, 2 * np.pi, 60)
    ax.fill(
        max(arms) * np.cos(angle), max(arms) * np.sin(angle), fc="#dfe3e6", ec="#6b7278", zorder=2
    )
    for value in _stop_values(plan, "theta"):
        ax.plot(
            [0, 1.15 * link * np.sin(value)],
            [0, 1.15 * link * np.cos(value)],
            color=GREY,
            lw=1.0,
            ls=":",
        )
    (rod,) = ax.plot([], [], color="#333333", lw=6, solid_capstyle="round", zorder=5)
    cables = [ax.plot([], [], color="#555555", lw=1.5, zorder=1)[0] for _ in names]
    ax.set_xlim(-1.1 * link - gap, 1.1 * link + gap)
    ax.set_ylim(base - 0.8 * gap, 1.25 * link)

    def draw(i: int) -> None:
        theta = float(motion["theta"][i])
        rod.set_data([0.0, link * np.sin(theta)], [0.0, link * np.cos(theta)])
        # the flexor turns the link towards +theta: to the right, with its muscle on the right
        for muscle, cable, side, arm in zip(muscles, cables, (1, -1), arms, strict=True):
            top = base + muscle.length * (1 - float(muscle.kappa[i]))
            muscle.draw(i, (side * gap, base), (side * gap, top))
            cable.set_data([side * gap, side * arm], [top, 0.0])

    return draw


def _hanging(ax: Axes, plan: Plan, motion: Trajectory) -> Frame:
    """A muscle under the ceiling; what it moves below it, on a tendon if there is one."""
    (muscle,) = _stage(ax, plan, motion, ("muscle",))
    length = muscle.length
    half, gap = (
        0.16 * length,
        0.25 * length if isinstance(plan.plant, SeriesLoad) else 0.06 * length,
    )
    shorter = motion["muscle.contraction"] * length
    zero = float((shorter - motion["x"])[0])  # contraction at x = 0
    _wall(ax, (-1.6 * half, 1.6 * half), (0.0, 0.08 * length))
    for value in _stop_values(plan, "x"):
        y = -length + zero + value - gap
        ax.plot([1.15 * half, 1.9 * half], [y, y], color=GREY, lw=1.5)
        ax.annotate(
            f"{1e3 * value:g} mm", (2.0 * half, y), va="center", fontsize="small", color="#555555"
        )
    body = ax.fill([], [], fc="#5b6770", ec="#333333", zorder=4)[0]
    (rope,) = ax.plot([], [], color="#555555", lw=2, zorder=1)
    (needle,) = ax.plot([], [], color="#333333", lw=1.5, zorder=5)
    ax.set_xlim(-3.4 * half, 3.4 * half)
    ax.set_ylim(-1.15 * length - gap - 1.6 * half, 0.12 * length)

    def draw(i: int) -> None:
        top = -length + zero + float(motion["x"][i]) - gap
        end = -length + float(shorter[i])
        body.set_xy(
            [(-half, top), (half, top), (half, top - 1.4 * half), (-half, top - 1.4 * half)]
        )
        rope.set_data([0.0, 0.0], [end, top])
        needle.set_data([half, 1.15 * half], [top, top])
        muscle.draw(i, (0.0, end), (0.0, 0.0))

    return draw
