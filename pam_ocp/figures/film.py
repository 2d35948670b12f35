"""Plans as moving pictures: the plant drawn by its positions,
muscles coloured by their pressure.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.arguments import with_kinds
from ..core.errors import InputError, require_count, require_instance, require_positive
from ..core.files import atomic_path, require_place
from ..core.interrupts import interruptible
from ..planning.result import Plan
from ..plants.sketch import Line, Mark, Polygon, Sketch, Spindle
from .canvas import new_figure
from .plan import GREY, colours_of, panels_of
from .scene import Places, outline, rim, sketch_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    from ..core.trajectory import Trajectory
    from ..plants.plant import Plant

__all__ = ["animate_plan"]

Array: TypeAlias = NDArray[np.float64]
Frame: TypeAlias = Callable[[int], None]

CURVES = 3
"""Panels of curves beside the picture of the plant."""


@with_kinds
@interruptible()
def animate_plan(
    plan: Plan, path: str | Path, *, seconds: float | None = None, fps: int = 20
) -> Path:
    """Write a plan as an animated GIF: the plant moving, and the curves as they run.

    A plant that has a ``sketch()`` (those of the library, and any with one muscle) is drawn to
    scale, muscles as long as they are and coloured by pressure; any other by its curves alone.

    seconds : length of the film; by default the motion slowed down (or quickened) to 4 s. It
        repeats.
    fps : frames per second.

    Raises InputError when the ending is not .gif, PlanError for a plan that failed.

    Examples
    --------
    >>> pam.figures.animate_plan(plan, "motion.gif", seconds=0.1, fps=10).name
    'motion.gif'
    """
    require_instance("plan", plan, Plan, "give what plan() returned")
    target = Path(path)
    if target.suffix.lower() != ".gif":
        raise InputError(f"{target.name}: an animation is written as .gif")
    require_place(target)
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
    figure, axes = new_figure(
        rows, 2 if scene else 1, size=(9.6 if scene else 7.0, 1.4 + 1.25 * rows)
    )
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
STYLES: dict[str, dict[str, Any]] = {
    "body": {"fc": "#5b6770", "ec": "#333333", "zorder": 4},
    "ground": {"fc": "#c9ced3", "ec": "#6b7278", "hatch": "///", "lw": 0.8},
    "disc": {"fc": "#dfe3e6", "ec": "#6b7278", "zorder": 2},
    "rod": {"color": "#333333", "lw": 6, "solid_capstyle": "round", "zorder": 5},
    "rope": {"color": "#555555", "lw": 1.5, "zorder": 1},
    "needle": {"color": "#333333", "lw": 1.5, "zorder": 5},
    "rail": {"color": "#6b7278", "lw": 3, "zorder": 1},
}
"""How the shapes of a plant's sketch are drawn."""


def _scene(plan: Plan, motion: Trajectory) -> Callable[[Axes], Frame] | None:
    """Who draws the plant; None for one that says nothing of how it looks."""
    sketch = sketch_of(plan.plant)
    return None if sketch is None else lambda ax: _drawn(ax, plan, motion, sketch)


def _drawn(ax: Axes, plan: Plan, motion: Trajectory, sketch: Sketch) -> Frame:
    """The sketch on its stage; what moves its shapes."""
    plant = plan.plant
    x, u = (motion.array([v.name for v in each]).T for each in (plant.states, plant.inputs))
    places = Places(plant, x, u)
    names = [s.muscle for s in sketch.shapes if isinstance(s, Spindle)]
    muscles = dict(zip(names, _stage(ax, plan, motion, names), strict=True))
    frames: list[Frame] = []
    for shape in sketch.shapes:
        if isinstance(shape, Spindle):
            frames.append(_spindle(muscles[shape.muscle], places.along([shape.start, shape.end])))
        elif isinstance(shape, Polygon):
            (patch,) = ax.fill([], [], **STYLES[shape.style])
            frames.append(_placed(patch.set_xy, places.along(shape.points)))
        elif isinstance(shape, Line):
            (line,) = ax.plot([], [], **STYLES[shape.style])
            frames.append(_stretched(line, places.along(shape.points)))
        else:
            (patch,) = ax.fill([], [], **STYLES["disc"])
            frames.append(_placed(patch.set_xy, places.along(rim(shape))))
    for mark in sketch.marks:
        _marked(ax, plan, mark, places)
    (left, low), (right, high) = places.along(list(zip(sketch.width, sketch.height, strict=True)))[
        0
    ]
    ax.set_xlim(left, right)
    ax.set_ylim(low, high)

    def draw(i: int) -> None:
        for frame in frames:
            frame(i)

    return draw


def _placed(place: Callable[[Array], Any], points: Array) -> Frame:
    return lambda i: place(points[i])


def _stretched(line: Line2D, points: Array) -> Frame:
    return lambda i: line.set_data(*points[i].T)


def _spindle(muscle: _Muscle, ends: Array) -> Frame:
    return lambda i: muscle.draw(i, ends[i, 0], ends[i, 1])


def _marked(ax: Axes, plan: Plan, mark: Mark, places: Places) -> None:
    """A tick, and its value in the unit in which it is shown, at each stop."""
    variable = plan.plant.variable(mark.state)
    values = _stop_values(plan, mark.state)
    middle = (min(values) + max(values)) / 2 if values else 0.0
    for value in values:
        points = places.where(mark.points, mark.state, value)
        style = {"lw": 1.5} if mark.label else {"lw": 1.0, "ls": ":"}
        ax.plot(*points.T, color=GREY, **style)
        if mark.label:
            below = mark.label == "below"
            side = "right" if below and value < middle else "left"
            ax.annotate(
                f"{1e3 * value:g} mm" if variable.unit == "m" else variable.shown(value),
                points[-1],
                (0, -2) if below else (2, 0),
                textcoords="offset points",
                ha=side,
                va="top" if below else "center",
                fontsize="small",
                color="#555555",
            )


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
        self.patch.set_xy(outline(a, b, self.kappa[i], self.length))
        self.patch.set_facecolor(self.colours(0.05 + 0.9 * float(np.clip(self.pressure[i], 0, 1))))


def _stage(ax: Axes, plan: Plan, motion: Trajectory, names: Sequence[str]) -> list[_Muscle]:
    """An empty stage with a colour bar, and its muscles."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    largest = max((1e4, *(float(motion[f"{n}.pressure"].max()) for n in names)))
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


def _stop_values(plan: Plan, name: str) -> list[float]:
    """Where the plan's stops are."""
    stops = plan._problem.stops if plan._problem else ()
    return sorted({float(s[name]) for s in stops if name in s and np.ndim(s[name]) == 0})
